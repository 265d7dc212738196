"""Parts that others bring: by ``package.module:Class``, or by the name under which an installed package offers them.

A package offers parts as entry points of the groups ``p2p_lib.trackers``, ``p2p_lib.segmenters``,
``p2p_lib.detectors`` and ``p2p_lib.datasets``; names of this package come first.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from p2p_lib.core.errors import BadInput, MissingBackend, did_you_mean, in_a_line

#: What users call a kind where that is another word: --format.
_SAID = {"dataset": "format"}
_WHERE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


def is_place(name: str) -> bool:
    """Whether a name is written ``package.module:Class``."""
    return bool(_WHERE.fullmatch(name))


def offered(kind: str) -> dict[str, EntryPoint]:
    """What installed packages offer of a kind (``tracker``, ``segmenter``, ``detector``, ``dataset``), by name."""
    return _offered(f"p2p_lib.{kind}s", tuple(sys.path))


@cache
def _offered(group: str, path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """By name; on one path it is read once, since the files of every installed package are opened for it."""
    return {point.name: point for point in entry_points(group=group)}


def knows(kind: str, name: str, known: Iterable[str]) -> bool:
    """Whether a name stands for a part."""
    return name in known or is_place(name) or name in offered(kind)


def find(kind: str, name: str, known: Mapping[str, str], has: Iterable[str] = ()) -> Any:
    """What a name stands for: one of ``known`` (name to place), an offered one, or what lies at a place.

    has  attributes that it, not being ours, must have

    :class:`BadInput` lists the names where this is none, and says what is lacking at the place that it names;
    :class:`MissingBackend` says why it cannot be loaded.
    """
    if name in known:
        return load(known[name])
    if is_place(name):
        with _working_folder_first():
            return _checked(kind, name, name, has)
    points = offered(kind)
    if name not in points:
        names = [*known, *points]
        expected = f"one of {', '.join(names)}, or your own as package.module:Class"
        raise BadInput(_SAID.get(kind, kind), repr(name), expected, did_you_mean(name, names))
    return _checked(kind, name, points[name].value, has)


@contextmanager
def _working_folder_first() -> Iterator[None]:
    """Where the working folder is on the path, what lies there is meant, and no installed module of the same name.

    Only while a named part is imported: otherwise a file there could stand in for any library.
    """
    here = [""] if "" in sys.path else []
    sys.path[:0] = here
    try:
        yield
    finally:
        if here:
            sys.path.remove("")


def load(where: str) -> Any:
    """What lies at ``module:attribute``."""
    module, _, attribute = where.partition(":")
    return getattr(import_module(module), attribute)


def _checked(kind: str, name: str, where: str, has: Iterable[str]) -> Any:
    """What somebody else's code brings, with what is wrong with it said in one line."""
    module, _, attribute = where.partition(":")
    try:
        found = import_module(module)
    except ImportError as error:
        fix = "Is its folder on PYTHONPATH, or its package installed in this environment?"
        raise MissingBackend(f"{kind} {name}", f"{module} cannot be imported ({in_a_line(error)})", fix) from error
    if attribute and not hasattr(found, attribute):
        near = did_you_mean(attribute, [key for key in vars(found) if not key.startswith("_")], f"{module}:")
        raise BadInput(_SAID.get(kind, kind), repr(name), f"something called {attribute} in {found.__name__}", near)
    part = getattr(found, attribute) if attribute else found
    if lacking := [key for key in has if isinstance(part, type) and not _promises(part, key)]:
        raise BadInput(f"{kind} {name}", f"a class without {', '.join(lacking)}", f"a {kind}, see CONTRIBUTING.md")
    return part


def _promises(part: type, key: str) -> bool:
    """Whether instances have it: a method, a value of the class, or one that it annotates."""
    return hasattr(part, key) or any(key in vars(c).get("__annotations__", {}) for c in part.__mro__)


def check_part(kind: str, part: object, has: Iterable[str]) -> None:
    """Refuse what is given as a part and lacks some of ``has``; :class:`BadInput` says what."""
    if isinstance(part, type):
        raise BadInput(kind, f"the class {part.__name__}", f"a {kind}: an instance, or a name")
    if lacking := [key for key in has if not hasattr(part, key)]:
        got = f"{type(part).__name__} without {', '.join(lacking)}"
        raise BadInput(kind, got, f"a {kind}, see CONTRIBUTING.md")
