"""Tables for papers: cells with a number, its spread, its weight, and what is to be said of it; set in four ways."""

from __future__ import annotations

import csv
import html
import io
import string
from collections.abc import Sequence
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Cell:
    """One cell.

    text  as it is shown: a number, ``fail``, or a dash
    bold  the best of those that may be compared
    note  what has to be said of it; of a dash, its reason. Equal notes share a letter below the table
    """

    text: str = "-"
    bold: bool = False
    note: str = ""


def number(value: float | None, spread: float | None = None, digits: int = 2, note: str = "") -> Cell:
    """A number with its spread behind a ±; a dash where there is none."""
    if value is None or value != value:
        return Cell(note=note)
    shown = f"{value:.{digits}f}" + (f" ± {spread:.{digits}f}" if spread is not None else "")
    return Cell(shown, note=note)


def emboldened(cells: Sequence[Cell], more_is_better: bool) -> list[Cell]:
    """The cells of methods that may be compared, the best number in bold: as printed, so that equals share it.

    One that failed is beaten by any number; a dash is nobody to compare with.
    """
    values = [_printed(cell) for cell in cells]
    known = [value for value in values if value is not None]
    if not known or sum(cell.text != "-" for cell in cells) < 2:
        return list(cells)
    best = max(known) if more_is_better else min(known)
    return [replace(cell, bold=value == best) for cell, value in zip(cells, values, strict=True)]


def _printed(cell: Cell) -> float | None:
    try:
        return float(cell.text.partition(" ")[0])
    except ValueError:
        return None


@dataclass(frozen=True)
class Table:
    """A table.

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
    notes: Sequence[str] = field(default=())

    def letters(self) -> dict[str, str]:
        """Note to its letter, in the order in which they occur."""
        found = dict.fromkeys(cell.note for row in self.rows for cell in row if cell.note)
        names = [a + b for a in ["", *string.ascii_lowercase] for b in string.ascii_lowercase]
        return dict(zip(found, names, strict=False))

    def markdown(self) -> str:
        """For pages and README files."""
        letters = self.letters()
        spans = [f"{group}: " for group, span in self.groups for _ in range(span)] or [""] * len(self.heads)
        heads = [(group if group != ": " else "") + head for group, head in zip(spans, self.heads, strict=True)]
        lines = [heads, ["---"] * self.words + ["---:"] * (len(heads) - self.words)]
        lines += [[_markdown_cell(cell, letters) for cell in row] for row in self.rows]
        table = "".join("| " + " | ".join(line) + " |\n" for line in lines)
        said = "".join(f"{line}  \n" for line in self._said(letters)).replace("$", r"\$")  # else it is an equation
        return f"**{self.title}**\n\n{table}\n{said}"

    def html(self) -> str:
        """For notebooks: small, with the groups in a line of their own, so that all columns fit on a page."""
        letters = self.letters()
        sides = [_LEFT] * self.words + [_RIGHT] * (len(self.heads) - self.words)
        above, heads, at = "", "", 0
        for group, span in self.groups or [("", len(self.heads))]:
            cells = "".join(
                f'<th style="{side}"{"" if group else _BOTH * bool(self.groups)}>{_html(head)}</th>'
                for head, side in zip(self.heads[at : at + span], sides[at:], strict=False)
            )
            above += f'<th colspan="{span}" style="{_MIDDLE}">{_html(group)}</th>' if group else cells
            heads += cells if group else ""
            at += span
        lines = [above, heads] if heads else [above]
        for at, row in enumerate(self.rows):
            rule = "; border-top: 1px solid #999" if at in self.rules else ""
            cells = [_html_cell(cell, letters) for cell in row]
            pairs = zip(sides, cells, strict=True)
            lines.append("".join(f'<td style="{side}{rule}">{text}</td>' for side, text in pairs))
        table = "".join(f"<tr>{line}</tr>\n" for line in lines)
        said = "<br>\n".join(map(_html, self._said(letters)))
        title = f"<p><b>{_html(self.title)}</b></p>"
        return f'{title}\n<table style="font-size: 11px">\n{table}</table>\n<p style="font-size: 11px">{said}</p>\n'

    def _said(self, letters: dict[str, str]) -> list[str]:
        """What stands below the table: its notes with their letters, then those of the whole."""
        return [*(f"({letter}) {note}." for note, letter in letters.items()), *(f"{note}." for note in self.notes)]

    def latex(self) -> str:
        """For papers; needs the package booktabs."""
        letters = self.letters()
        lines = [r"\begin{table}", rf"\caption{{{_tex(self.title)}}}", r"\centering"]
        lines += [rf"\begin{{tabular}}{{@{{}}{'l' * self.words}{'c' * (len(self.heads) - self.words)}@{{}}}}"]
        lines += [r"\toprule"]
        if self.groups:
            spans = [rf"\multicolumn{{{span}}}{{c}}{{{_tex(group)}}}" if group else "" for group, span in self.groups]
            lines += [" & ".join(spans) + r" \\"]
        lines += [" & ".join(map(_tex, self.heads)) + r" \\", r"\midrule"]
        for at, row in enumerate(self.rows):
            lines += [r"\midrule"] if at in self.rules else []
            lines += [" & ".join(_latex_cell(cell, letters) for cell in row) + r" \\"]
        lines += [r"\bottomrule", r"\end{tabular}", ""]
        said = [rf"\textsuperscript{{{letter}}}~{_tex(note)}." for note, letter in letters.items()]
        said += [f"{_tex(note)}." for note in self.notes]
        lines += [r"\par\footnotesize " + " ".join(said)] if said else []
        return "\n".join([*lines, r"\end{table}", ""])

    def csv(self) -> str:
        """Values alone, and a column that says why some are missing."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        spans = [f"{group} " if group else "" for group, span in self.groups for _ in range(span)]
        heads = [(spans[k] if spans else "") + head for k, head in enumerate(self.heads)]
        writer.writerow([*heads, "notes"])
        for row in self.rows:
            said = dict.fromkeys(f"{heads[k]}: {cell.note}" for k, cell in enumerate(row) if cell.note)
            writer.writerow([*("" if cell.text == "-" else cell.text for cell in row), "; ".join(said)])
        return file.getvalue()


def _markdown_cell(cell: Cell, letters: dict[str, str]) -> str:
    text = cell.text.replace("|", "\\|")
    text = f"**{text}**" if cell.bold else text
    return f"{text} ({letters[cell.note]})" if cell.note else text


_BOTH = ' rowspan="2"'
_LEFT, _MIDDLE, _RIGHT = (
    f"text-align: {side}; padding: 2px 5px; white-space: normal" for side in ("left", "center", "right")
)


def _html(text: str) -> str:
    """Plain words; a dollar stands in an element of its own, else two of them are taken for an equation."""
    return html.escape(text).replace("$", "<span>$</span>")


def _html_cell(cell: Cell, letters: dict[str, str]) -> str:
    text = f"<b>{_html(cell.text)}</b>" if cell.bold else _html(cell.text)
    return f"{text}<sup>{letters[cell.note]}</sup>" if cell.note else text


def _latex_cell(cell: Cell, letters: dict[str, str]) -> str:
    text = rf"\textbf{{{_tex(cell.text)}}}" if cell.bold else "--" if cell.text == "-" else _tex(cell.text)
    return rf"{text}\textsuperscript{{{letters[cell.note]}}}" if cell.note else text


_TEX = {"\\": r"\textbackslash{}", "±": r"$\pm$", "Δ": r"$\Delta$", "°": r"$^\circ$", "~": r"\textasciitilde{}"}
_TEX |= {c: "\\" + c for c in "&%$#_{}"} | {"^": r"\textasciicircum{}"}


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in text)
