"""Which code made a result."""

from __future__ import annotations

import platform
import subprocess
from contextlib import suppress
from typing import Any

import numpy as np

from p2p_lib import __version__
from p2p_lib.core import paths


def provenance() -> dict[str, Any]:
    """The versions that matter for a number, and the commit where this is a checkout. Names no machine."""
    import cv2

    versions = {"p2p_lib": __version__, "python": platform.python_version()}
    return {"versions": versions | {"numpy": np.__version__, "opencv": cv2.__version__}, **_commit()}


def _commit() -> dict[str, Any]:
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(paths.PROJECT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    with suppress(OSError, subprocess.SubprocessError):
        if (paths.PROJECT / ".git").exists():
            changed = git("status", "--porcelain", "--untracked-files=no", "--", "p2p_lib")
            return {"commit": git("rev-parse", "HEAD"), "modified": bool(changed)}
    return {"commit": None, "modified": None}
