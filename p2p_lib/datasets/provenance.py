"""Which code made a result."""

from __future__ import annotations

import ast
import hashlib
import platform
import subprocess
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib import __version__
from p2p_lib.core import paths

_PACKAGE = Path(__file__).resolve().parents[1]
# What only arranges, shows or hands on a result cannot change it, nor can the version's number; of benchmarks what
# opens, runs and scores a sequence decides, and what makes numbers of that.
_WITHOUT = {"__init__.py", "apps", "benchmark", "figures", "offline"}
_BUT = {f"benchmark/{name}.py" for name in ("execution", "jobs", "rows", "scoring")}
# No table's run begins with a memory, and what is kept of a tracker is asked when the last frame has been tracked.
_MEMORY = {f"extended/{name}.py" for name in ("remembered", "remembering", "saving")}
_MEMORY |= {"core/memory.py", "trackers/builtin/recogniser.py"}


@cache
def code_digest() -> str:
    """Twelve digits of the sources that decide a result: what is tracked, what tracks it, what scores it.

    Comments, docstrings and layout change nothing, nor does the version of Python.
    """
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        name = path.relative_to(_PACKAGE).as_posix()
        if (name.partition("/")[0] not in _WITHOUT and name not in _MEMORY) or name in _BUT:
            digest.update(f"{name} {_syntax(ast.parse(path.read_bytes()))}\n".encode())
    return digest.hexdigest()[:12]


def _syntax(node: Any) -> Any:
    """A syntax tree as nested tuples, without docstrings and without what is empty, which differs between Pythons."""
    if isinstance(node, list):
        return tuple(map(_syntax, node))
    if not isinstance(node, ast.AST):
        return node
    fields = dict(ast.iter_fields(node))
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False):
        fields["body"] = fields["body"][1:]
    return (type(node).__name__, *((key, _syntax(value)) for key, value in fields.items() if value not in (None, [])))


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
