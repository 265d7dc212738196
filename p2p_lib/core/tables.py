"""The one way to render a table: a pandas DataFrame as text for a terminal, as Markdown, or as HTML.

Numbers stand to the right and words to the left, a missing value is a dash, the index is left out. Where numbers are
text already, with their spread or in bold, ``words`` says how many columns at the left hold words.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pandas import DataFrame

_HTML = "padding: 2px 5px; white-space: normal; font-size: 11px; text-align: "


def as_text(table: DataFrame) -> str:
    """Lines for a terminal."""
    left = _words(table)
    rows = [[shown(value) for value in row] for row in [table.columns, *_rows(table)]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [[f"{cell:{'<' if k in left else '>'}{widths[k]}}" for k, cell in enumerate(row)] for row in rows]
    return "\n".join("  ".join(line).rstrip() for line in lines)


def as_markdown(table: DataFrame, words: int | None = None) -> str:
    """A Markdown table, one line a row."""
    left = _words(table, words)
    sides = ["---" if k in left else "---:" for k in range(table.shape[1])]
    rows = [[shown(value).replace("|", "\\|") for value in row] for row in [table.columns, *_rows(table)]]
    return "".join("| " + " | ".join(line) + " |\n" for line in [rows[0], sides, *rows[1:]])


def as_html(table: DataFrame, words: int | None = None, rules: Collection[int] = (), escape: bool = True) -> str:
    """An HTML table for a notebook, with a line above the rows ``rules``; ``escape`` False where cells are HTML."""
    from pandas.io.formats.style import Styler

    css = [("th, td", f"{_HTML}right"), ("th[colspan]", "text-align: center")]
    css += [(f".col{k}", "text-align: left") for k in _words(table, words)]
    css += [(f"td.row{k}", "border-top: 1px solid #999") for k in rules]
    name = hashlib.sha256(table.to_csv().encode()).hexdigest()[:8]
    html = Styler(table, uuid=name, cell_ids=False).hide(axis="index")
    html.format(shown, escape="html" if escape else None).format_index(axis=1, escape="html")
    html.set_table_styles([{"selector": selector, "props": props} for selector, props in css])
    # A dollar in an element of its own: two of them would be taken for an equation.
    return html.to_html().replace("$", "<span>$</span>")


def shown(value: Any) -> str:
    """A cell as it is printed: at most six digits, a dash where there is none."""
    if value is None or value != value:  # NaN
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _rows(table: DataFrame) -> list[tuple]:
    return list(table.itertuples(index=False, name=None))


def _words(table: DataFrame, words: int | None = None) -> list[int]:
    """Which columns stand to the left: the first ``words``, by default those that hold no numbers."""
    numeric = [kind.kind in "fiu" for kind in table.dtypes]
    return [k for k, number in enumerate(numeric) if not number] if words is None else list(range(words))
