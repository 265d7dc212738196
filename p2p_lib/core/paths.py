"""Where things live on this machine: one place for every folder decision."""

from __future__ import annotations

import os
from pathlib import Path

#: The checkout this package runs from (notebooks/, data_manifests/, figures/ and out/ are beside it).
PROJECT = Path(__file__).resolve().parents[2]


def cache_dir() -> Path:
    """Generated data that may be deleted at any time: ``$P2P_CACHE``, else the user's cache folder."""
    if os.environ.get("P2P_CACHE"):
        return Path(os.environ["P2P_CACHE"]).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "p2p"


def data_dir() -> Path | None:
    """The user's datasets: ``$P2P_DATA``, or None where it is not set."""
    return Path(os.environ["P2P_DATA"]).expanduser() if os.environ.get("P2P_DATA") else None
