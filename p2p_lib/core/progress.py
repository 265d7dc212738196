"""Progress of something long: a bar on a terminal, a notebook's own in JupyterLab, one line at the end elsewhere."""

from __future__ import annotations

import io
import os
import sys
from typing import Any

from tqdm import tqdm


def progress_bar(title: str, total: int | None = None, unit: str = "frame", shown: bool = True, **options: Any) -> tqdm:
    """A tqdm bar, a context manager; where notebooks are run headless (``P2P_PROGRESS=off``) nothing is shown."""
    options = {"desc": title, "total": total, "unit": unit, **options}
    if not shown or os.environ.get("P2P_PROGRESS") == "off":
        return tqdm(disable=True, **options)
    if _in_notebook():
        from tqdm.auto import tqdm as of_notebook

        return of_notebook(**options)
    return tqdm(**options) if sys.stderr.isatty() else _AtTheEnd(**options)


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
