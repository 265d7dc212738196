"""What stands beside the notebooks in a clone of the repository, for the commands and the notebooks that need it."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from p2p_lib.core.errors import MissingData
from p2p_lib.core.packages import needed_for
from p2p_lib.core.paths import PROJECT


def study(name: str) -> ModuleType:
    """A module of ``notebooks/studies`` in the clone that is installed, or else in the one around the current folder.

    From then on ``import studies`` finds them all, wherever a command or a notebook was started.
    :class:`MissingData` where there is no clone; :class:`MissingBackend` without the packages of the notebooks.
    """
    for folder in (PROJECT, Path.cwd(), *Path.cwd().parents):
        if (folder / "notebooks" / "studies" / f"{name}.py").is_file():
            if str(folder / "notebooks") not in sys.path:
                sys.path.insert(0, str(folder / "notebooks"))
            with needed_for("notebooks"):
                return import_module(f"studies.{name}")
    fix = "Clone the repository and call this inside it (papermill: --cwd CLONE/notebooks)."
    raise MissingData("notebooks", "they are not part of the installed package", fix)
