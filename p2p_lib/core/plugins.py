"""Parts that others bring: by ``package.module:Class``, or by the name under which an installed package offers them.

A package offers parts as entry points of the groups ``p2p_lib.trackers``, ``p2p_lib.segmenters``,
``p2p_lib.detectors`` and ``p2p_lib.datasets``; names of this package come first.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from p2p_lib.core.errors import BadInput, MissingBackend, did_you_mean, doubt, in_a_line, listed

#: What users call a kind where that is another word: --format.
_SAID = {"dataset": "format"}
#: What a part of each kind is called with.
CALLED_WITH = {
    "tracker": ("config", "rng"),
    "detector": ("config", "rng"),
    "segmenter": ("camera", "config"),
    "dataset": ("folder", "masks"),
    "camera": (),
}
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


def loaded(kind: str) -> Iterator[tuple[str, Any]]:
    """What installed packages offer of a kind, by name; what cannot be loaded is left out, and doubted."""
    for name, point in offered(kind).items():
        try:
            yield name, _theirs(kind, name, point.value)
        except Exception as error:  # noqa: BLE001 what a package of somebody else's raises says nothing of what is asked
            package = point.dist.name if point.dist else "an installed package"
            fix = f"It is left out: mend {package}, or uninstall it."
            doubt(f"{_SAID.get(kind, kind)} {name!r}, offered by {package}", in_a_line(error), fix)


def knows(kind: str, name: str, known: Iterable[str]) -> bool:
    """Whether a name stands for a part."""
    return name in known or is_place(name) or name in offered(kind)


def find(kind: str, name: str, known: Mapping[str, str]) -> Callable[..., Any]:
    """What a name stands for: one of ``known`` (name to place), an offered one, or what lies at a place.

    :class:`BadInput` lists the names where this is none, and says what is wrong at the place that it names, also where
    that cannot be called as its kind is (:data:`CALLED_WITH`); :class:`MissingBackend` says why it cannot be loaded.
    """
    if name in known:
        if name in offered(kind):
            place = offered(kind)[name].value
            doubt(f"{_SAID.get(kind, kind)} {name!r}", f"ours is used, not {place}", f"Name that one {place}.")
        return load(known[name])
    if is_place(name):
        with _working_folder_first():
            return _theirs(kind, name, name)
    points = offered(kind)
    if name not in points:
        names = list(dict.fromkeys([*known, *points]))
        expected = f"one of {', '.join(names)}, or your own as package.module:Class"
        raise BadInput(_SAID.get(kind, kind), repr(name), expected, did_you_mean(name, names))
    return _theirs(kind, name, points[name].value)


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


def _theirs(kind: str, name: str, where: str) -> Callable[..., Any]:
    """What somebody else's code brings, with what is wrong with it said in one line."""
    module, _, attribute = where.partition(":")
    said = _SAID.get(kind, kind)
    try:
        found = import_module(module)
    except SyntaxError as error:
        got = f"a syntax error in {error.filename}:{error.lineno} ({error.msg})"
        raise BadInput(f"{said} {name}", got, "a module that can be imported", "Mend that line.") from error
    except ImportError as error:
        what, fix = "cannot be imported", "Is its folder on PYTHONPATH, or its package installed in this environment?"
        if not (isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")):
            what = "is there, but not what it imports"
            fix = f"Install that, or mend the import: python -c 'import {module}' shows where it is."
        raise MissingBackend(f"{said} {name}", f"{module} {what} ({in_a_line(error)})", fix) from error
    if attribute and not hasattr(found, attribute):
        own = [key for key, value in vars(found).items() if callable(value) and not key.startswith("_")]
        theirs = [key for key in own if getattr(vars(found)[key], "__module__", "") == found.__name__]
        near = did_you_mean(attribute, own, f"{module}:") or (f"It has {listed(theirs, 8)}." if theirs else "")
        raise BadInput(said, repr(name), f"something called {attribute} in {found.__name__}", near)
    part = getattr(found, attribute) if attribute else found
    call = f"{attribute}({', '.join(CALLED_WITH[kind])})"
    if not callable(part):
        of = type(part).__name__
        fix = f"Did you mean {module}:{of}?" if hasattr(found, of) else ""
        raise BadInput(f"{said} {name}", f"an instance of {of}", f"a class or a function, called as {call}", fix)
    if trouble := _cannot_be_called(part, CALLED_WITH[kind]):
        raise BadInput(f"{said} {name}", f"{attribute}{trouble}", f"{call}, see CONTRIBUTING.md")
    return part


def check_part(kind: str, part: Any, has: Mapping[str, tuple[str, ...] | None], name: str = "") -> None:
    """Refuse a part without a ``name``, or some of ``has``; :class:`BadInput` says what.

    has   what it has: a method with what it is called with, or None for what is no method
    name  by which it was asked for
    """
    said = f"{kind} {name}".strip()
    if isinstance(part, type):
        raise BadInput(said, f"the class {part.__name__}", f"a {kind}: an instance, or a name")
    if lacking := [key for key in ("name", *has) if not hasattr(part, key)]:
        got = f"{type(part).__name__} without {', '.join(lacking)}"
        raise BadInput(said, got, f"a {kind}, see CONTRIBUTING.md")
    if not isinstance(part.name, str):
        raise BadInput(f"{said}: name", repr(part.name), "a text")
    for key, called_with in has.items():
        own = getattr(part, key)
        if called_with is None and inspect.ismethod(own):
            fix = "Put @property before it."
            raise BadInput(f"{said} ({type(part).__name__}): {key}", "a method", "a value, not a method", fix)
        if called_with is not None and (trouble := _cannot_be_called(own, called_with)):
            got, expected = f"{key}{trouble}", f"{key}({', '.join(called_with)}), see CONTRIBUTING.md"
            raise BadInput(f"{said} ({type(part).__name__})", got, expected)


def _cannot_be_called(part: Any, arguments: tuple[str, ...]) -> str:
    """What comes instead of something that can be called with these arguments; empty where it can."""
    if not callable(part):
        return f" = {part!r}"
    try:
        signature = inspect.signature(part)
    except ValueError:  # of compiled code nobody knows
        return ""
    try:
        signature.bind(*arguments)
    except TypeError as error:
        return f"{signature}, which cannot be called so ({error})"
    return ""
