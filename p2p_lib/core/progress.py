"""Progress of something long: a bar on a terminal, a notebook's own in JupyterLab, one line at the end elsewhere.

What is waited for before anything can be counted is a line of its own, shown at once.
"""

from __future__ import annotations

import io
import os
import sys
from typing import Any

from tqdm import tqdm

#: A terminal that says it has no columns and lines, as a container's may, is taken for one of so many.
_COLUMNS, _LINES = 80, 24


def progress_bar(
    title: str, total: int | None = None, unit: str = "frame", shown: bool = True, first: str = "", **options: Any
) -> tqdm:
    """A tqdm bar, a context manager; where notebooks are run headless (``P2P_PROGRESS=off``) nothing is shown.

    first  what its first step waits for; said from the beginning, by a line of its own where there is no bar
    """
    options = {"desc": title, "total": total, "unit": unit, **options}
    if not shown or os.environ.get("P2P_PROGRESS") == "off":
        return tqdm(disable=True, **options)
    if _in_notebook():
        from tqdm.auto import tqdm as of_notebook

        bar = of_notebook(**options)
    elif sys.stderr.isatty():
        bar = tqdm(**_size(), **options)
    else:
        if first:
            sys.stderr.write(f"{first} ...\n")
        return _AtTheEnd(**options)
    if first:
        bar.set_postfix_str(first)
    return bar


def waiting_for(what: str, shown: bool = True) -> tqdm:
    """Says what one waits for, a context manager: on a terminal until its end, elsewhere by a line that stays.

    ``clear`` of what it gives makes room for another line.
    """
    shown = shown and os.environ.get("P2P_PROGRESS") != "off" and not _in_notebook()
    on_terminal = shown and sys.stderr.isatty()
    if shown and not on_terminal:
        sys.stderr.write(f"{what} ...\n")
    size = _size() if on_terminal else {}
    return tqdm(desc=what, bar_format="{desc} ...", leave=False, disable=not on_terminal, **size)


def _size() -> dict[str, int]:
    """The columns and lines of a terminal that does not say them; of others tqdm knows, but with 0 it shows nothing."""
    try:
        said = os.get_terminal_size(sys.stderr.fileno())
    except OSError:
        return {}
    return ({} if said.columns else {"ncols": _COLUMNS}) | ({} if said.lines else {"nrows": _LINES})


def _in_notebook() -> bool:
    """Whether this code runs in a notebook's cell; whoever drives notebooks has imported their packages too."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")


class _AtTheEnd(tqdm):
    """Into a file or a pipe, where a bar that redraws itself would leave hundreds of lines."""

    def __init__(self, **options: Any) -> None:
        super().__init__(file=io.StringIO(), **options)

    def close(self) -> None:
        """Write the one line."""
        line = "" if self.disable else str(self)
        super().close()
        if line:
            sys.stderr.write(f"{line}\n")
