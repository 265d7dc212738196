"""The paths in ``run.json``: how they are written, and what they mean where they are read.

Whole ones, for a run is read from other folders, where a relative path may be another video's. A model in the folder of
its sequence is kept as it is seen from there, and moves along with it. A bundled sequence has no path, and neither have
its own models: each machine renders it into a folder of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from p2p_lib.core.options import located
from p2p_lib.core.paths import full, seen_from
from p2p_lib.datasets.sequence import SYNTHETIC, Sequence


def written_paths(out: str | Path, sequence: Sequence, models: Mapping[str, Path]) -> dict[str, Any]:
    """``path``, ``path_from_run`` and ``models`` for the ``run.json`` of a run in ``out``."""
    path = None if _is_bundled(sequence.name) or sequence.path is None else full(sequence.path)
    return {**written_path(out, path), "models": {name: _inside(sequence.path, file) for name, file in models.items()}}


def written_path(out: str | Path, path: str | Path | None) -> dict[str, str | None]:
    """``path`` and ``path_from_run`` of a sequence in the whole path ``path``; None: it has none."""
    return {
        "path": None if path is None else str(path),
        "path_from_run": None if path is None else seen_from(out, path),
    }


def read_paths(folder: Path, info: Mapping[str, Any]) -> dict[str, Any]:
    """The paths that the ``run.json`` of the run in ``folder`` says, as :func:`written_paths` writes them today.

    Relative paths, which earlier versions wrote, are as seen from the current folder. A sequence that is not where it
    was any more is looked for where it was as seen from the run.
    """
    at = info["path"] and full(info["path"])
    if at and not at.exists() and (moved := folder / (info.get("path_from_run") or at)).exists():
        at = full(moved)
    own = _is_bundled(info["sequence"])
    models = {
        name: file if own or (at and (at / file).is_file()) else str(full(file))
        for name, file in info["models"].items()
    }
    options = {"options": located(info["options"], at)} if info.get("options") else {}
    return {"path": at and str(at), "models": models} | options


def _is_bundled(name: str) -> bool:
    return name.startswith(SYNTHETIC)


def _inside(folder: Path | None, path: Path) -> str:
    """The path as seen from the folder where it lies in there, else the whole path."""
    path, inside = full(path), folder and full(folder)
    return str(path.relative_to(inside) if inside is not None and path.is_relative_to(inside) else path)
