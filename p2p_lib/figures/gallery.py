"""One self-contained page that lists results: an image, a title, a line and a small table each."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
section {{ display: flex; gap: 1.5rem; padding: 1.5rem 0; border-top: 1px solid #ddd; }}
h2 {{ margin: 0; font-size: 1.2rem; }} a {{ color: #06c; text-decoration: none; }} .failed {{ color: #b00; }}
img {{ width: 20rem; border: 1px solid #eee; }} td {{ padding-right: 1.5rem; }}
</style></head><body><h1>{title}</h1><p>{summary}</p>
{entries}
</body></html>
"""


@dataclass(frozen=True)
class GalleryEntry:
    """A result: ``link`` is relative to the page, ``picture_png`` is base64 or empty, ``failure`` empty when fine."""

    title: str
    line: str
    link: str
    picture_png: str
    table: Mapping[str, str]
    failure: str = ""


def gallery_page(title: str, entries: Sequence[GalleryEntry], summary: str = "") -> str:
    """The HTML of the page, images included; the summary is followed by how many of the results failed."""
    failed = sum(bool(entry.failure) for entry in entries)
    outcome = f'<b class="failed">{failed} failed</b>' if failed else "none failed"
    line = f"{html.escape(summary)}, {outcome}" if summary else ""
    return _PAGE.format(title=html.escape(title), summary=line, entries="\n".join(map(_section, entries)))


def _section(entry: GalleryEntry) -> str:
    link = html.escape(entry.link, quote=True)
    picture = f'<img alt="{html.escape(entry.title, quote=True)}" src="data:image/png;base64,{entry.picture_png}">'
    image = f'<a href="{link}">{picture}</a>'
    rows = [f"<tr><td>{html.escape(key)}</td><td>{html.escape(value)}</td></tr>" for key, value in entry.table.items()]
    words = [
        f'<h2><a href="{link}">{html.escape(entry.title)}</a></h2><p>{html.escape(entry.line)}</p>',
        f'<p class="failed">{html.escape(entry.failure)}</p>' if entry.failure else "",
        f"<table>{''.join(rows)}</table>",
    ]
    return f"<section>{image if entry.picture_png else ''}<div>{''.join(words)}</div></section>"
