"""Tables for papers: cells with a number, its spread and its reason."""

from __future__ import annotations

import html
import string
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from pandas import DataFrame, MultiIndex, Series, to_numeric

from p2p_lib.core.tables import as_html, as_markdown


@dataclass(frozen=True)
class Cell:
    """One cell of a table for papers.

    text  as it is shown: a number, ``fail``, or a dash
    bold  the best of those that may be compared
    note  what has to be said of it; of a dash, its reason. Equal notes share a letter below the table
    """

    text: str = "-"
    bold: bool = False
    note: str = ""


def number(value: float | None, spread: float | None = None, digits: int = 2) -> Cell:
    """A number with its spread behind a ±; a dash where there is none."""
    if value is None or value != value:
        return Cell()
    return Cell(f"{value:.{digits}f}" + (f" ± {spread:.{digits}f}" if spread is not None else ""))


def emboldened(cells: Sequence[Cell], more_is_better: bool) -> list[Cell]:
    """The cells of methods that may be compared, the best number in bold: as printed, so that equals share it.

    A number beats one that failed; a dash takes no part.
    """
    values = to_numeric(Series([cell.text.partition(" ")[0] for cell in cells]), errors="coerce")
    if values.isna().all() or sum(cell.text != "-" for cell in cells) < 2:
        return list(cells)
    best = float(values.max() if more_is_better else values.min())
    return [replace(cell, bold=value == best) for cell, value in zip(cells, values.tolist(), strict=True)]


_TEX: dict[str, str | int | None] = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}"}
_TEX |= {"±": r"$\pm$", "Δ": r"$\Delta$", "°": r"$^\circ$"}
_TEX |= {c: "\\" + c for c in "&%$#_{}"} | {"^": r"\textasciicircum{}"}


def _tex(text: str) -> str:
    return "--" if text == "-" else text.translate(str.maketrans(_TEX))


def _tex_row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


@dataclass(frozen=True)
class _Language:
    """How a format writes text, bold text, and the letter of a note."""

    escape: Callable[[str], str]
    bold: str
    letter: str

    def cell(self, cell: Cell, letters: dict[str, str]) -> str:
        text = self.escape(cell.text)
        text = self.bold.format(text) if cell.bold else text
        return text + (self.letter.format(letters[cell.note]) if cell.note else "")


_MARKDOWN = _Language(str, "**{}**", " ({})")
_HTML = _Language(html.escape, "<b>{}</b>", "<sup>{}</sup>")
_LATEX = _Language(_tex, r"\textbf{{{}}}", r"\textsuperscript{{{}}}")

#: As many columns with heads of several words stand beside each other on a page of 1,280 px.
_MARKDOWN_COLUMNS = 10


@dataclass(frozen=True)
class Table:
    """A table for papers.

    groups  heads above the heads, each with the number of columns it spans; none where empty
    words   how many columns at the left are words
    rules   rows above which a line is drawn
    notes   sentences below it that belong to the whole
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()
    words: int = 1
    rules: Sequence[int] = ()
    notes: Sequence[str] = ()

    def letters(self) -> dict[str, str]:
        """Note to its letter, in the order in which they occur."""
        found = dict.fromkeys(cell.note for row in self.rows for cell in row if cell.note)
        names = [a + b for a in ["", *string.ascii_lowercase] for b in string.ascii_lowercase]
        return dict(zip(found, names, strict=False))

    def markdown(self) -> str:
        """For pages and README files: one table, or where that is wider than a page, one for each group."""
        whole, groups = self._frame(_MARKDOWN, ": "), [span for _, span in self.groups]
        columns: list[Sequence[int]] = [range(len(self.heads))]
        if groups and len(self.heads) > _MARKDOWN_COLUMNS:
            columns = [[*range(groups[0]), *range(a, b)] for a, b in pairwise(np.cumsum(groups).tolist())]
        table = "\n".join(as_markdown(whole.iloc[:, list(at)], self.words) for at in columns)
        notes = "".join(f"{line}  \n" for line in self._lettered_notes("({}) "))
        return f"**{self.title}**\n\n{table}\n" + notes.replace("$", r"\$")  # else it is an equation

    def html(self) -> str:
        """For notebooks: small, with the groups in a line of their own, so that all columns fit on a page."""
        table = as_html(self._frame(_HTML), self.words, self.rules, escape=False)
        notes = "<br>\n".join(map(html.escape, self._lettered_notes("({}) "))).replace("$", "<span>$</span>")
        return f'<p><b>{html.escape(self.title)}</b></p>\n{table}\n<p style="font-size: 11px">{notes}</p>\n'

    def latex(self) -> str:
        """For papers; needs the package booktabs."""
        cells = self._frame(_LATEX).to_numpy().tolist()
        rows = [rf"\midrule {_tex_row(row)}" if k in self.rules else _tex_row(row) for k, row in enumerate(cells)]
        spans = [rf"\multicolumn{{{n}}}{{c}}{{{_tex(group)}}}" if n > 1 else _tex(group) for group, n in self.groups]
        heads = [_tex_row(spans)] * bool(spans) + [_tex_row(map(_tex, self.heads))]
        sides = "l" * self.words + "c" * (len(self.heads) - self.words)
        notes = " ".join(self._lettered_notes(r"\textsuperscript{{{}}}~", _tex))
        lines = [r"\begin{table}", r"\centering", rf"\caption{{{_tex(self.title)}}}"]
        lines += [rf"\begin{{tabular}}{{@{{}}{sides}@{{}}}}", r"\toprule", *heads, r"\midrule", *rows]
        lines += [r"\bottomrule", r"\end{tabular}", rf"\par\footnotesize {notes}", r"\end{table}"]
        return "".join(f"{line}\n" for line in lines)

    def csv(self) -> str:
        """Values alone, and a column that says why some are missing."""
        table = self._frame(_Language(lambda text: "" if text == "-" else text, "{}", ""), " ")
        noted = [[f"{h}: {cell.note}" for h, cell in zip(table.columns, row) if cell.note] for row in self.rows]
        table["notes"] = ["; ".join(dict.fromkeys(reasons)) for reasons in noted]
        return table.to_csv(index=False, lineterminator="\n")

    def files(self) -> dict[str, str]:
        """Suffix to the text of a file."""
        return {".csv": self.csv(), ".md": self.markdown(), ".tex": self.latex()}

    def _frame(self, language: _Language, between: str = "") -> DataFrame:
        """The cells as a format writes them; groups are a level of their own, or stand before ``between`` and head."""
        letters = self.letters()
        cells = [[language.cell(cell, letters) for cell in row] for row in self.rows]
        groups = [group for group, span in self.groups for _ in range(span)]
        if not between:
            heads = [language.escape(head) for head in self.heads]
            columns = MultiIndex.from_arrays([list(map(language.escape, groups)), heads]) if groups else heads
            return DataFrame(cells, columns=columns)
        pairs = zip(groups or [""] * len(self.heads), self.heads, strict=True)
        return DataFrame(cells, columns=[f"{group}{between}{head}" if group else head for group, head in pairs])

    def _lettered_notes(self, letter: str, escape: Callable[[str], str] = str) -> list[str]:
        """What stands below the table: its notes with their letters, then those of the whole."""
        noted = [letter.format(name) + _ended(escape(note)) for note, name in self.letters().items()]
        return [*noted, *(_ended(escape(note)) for note in self.notes)]


def _ended(sentence: str) -> str:
    """With its full stop, unless it ends already."""
    return sentence if sentence.endswith((".", "?")) else f"{sentence}."
