"""Where things live on this machine: one place for every folder decision."""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path

#: The checkout this package runs from (notebooks/, data_manifests/, figures/ and out/ are beside it).
PROJECT = Path(__file__).resolve().parents[2]

#: The file of ``data_manifests/`` that holds the paper's numbers instead of a dataset.
PAPER_REPORTED = "paper_reported.json"


def seen_from(folder: str | Path, path: str | Path) -> str:
    """A path as seen from a folder, by which it is found where both were moved together."""
    return os.path.relpath(full(path), full(folder))


def named_path(given: str | Path) -> tuple[str | None, str]:
    """NAME and PATH of ``NAME=PATH``; None and the whole of what is a path itself."""
    name, equals, path = str(given).partition("=")
    return (name, path) if equals and not Path(given).exists() else (None, str(given))


def full(path: str | Path) -> Path:
    """The whole path, with links left as they are: datasets are often put together of links."""
    return Path(os.path.abspath(Path(path).expanduser()))


def manifest_dir() -> Path:
    """``data_manifests/`` of the checkout; where there is none, the copy that the wheel installs."""
    local = PROJECT / "data_manifests"
    return local if local.is_dir() else Path(sysconfig.get_path("data")) / "share" / "p2p_lib" / "data_manifests"


def cache_dir() -> Path:
    """Generated data that may be deleted at any time: ``$P2P_CACHE``, else the user's cache folder."""
    return _given("P2P_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "p2p"


def data_dir() -> Path | None:
    """The user's datasets: ``$P2P_DATA``, or None where it is not set."""
    return _given("P2P_DATA")


def figure_dir() -> Path:
    """Where images go: ``$P2P_FIGURES``, else ``figures/`` of the project."""
    return _given("P2P_FIGURES") or _home() / "figures"


def table_dir() -> Path:
    """Where tables go: ``$P2P_TABLES``, else ``out/tables/`` of the project."""
    return _given("P2P_TABLES") or _home() / "out" / "tables"


def run_dir(name: str) -> Path:
    """Where a notebook keeps the run ``name``: below ``$P2P_RUNS``, else ``out/runs/`` of the project."""
    return (_given("P2P_RUNS") or _home() / "out" / "runs") / name


def benchmark_dir(profile: str, given: str = "") -> Path:
    """Where a notebook finds the results of ``p2p benchmark``: the folder given, as seen from the project.

    Else ``out/benchmark/`` of the project; those of the quick profile are with the notebook's own runs.
    """
    return _home() / (given or "out/benchmark") if given or profile == "full" else run_dir("benchmark")


def _given(variable: str) -> Path | None:
    return Path(os.environ[variable]).expanduser() if os.environ.get(variable) else None


def _home() -> Path:
    """The checkout; the current folder where the package was installed without one."""
    return PROJECT if (PROJECT / "pyproject.toml").is_file() else Path.cwd()
