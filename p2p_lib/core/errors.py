"""What can go wrong, said so that the reader knows what to do next.

The command line prints the message on one line and leaves with ``exit_code``.
"""

from __future__ import annotations

import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches


class P2PError(Exception):
    """Any error the user can mend. ``str(error)`` is one line."""

    exit_code = 2
    _parts: tuple[str, ...] = ()  # what __init__ takes

    def __reduce__(self):
        # A worker process hands its error to the parent as a pickle, which makes it anew.
        return (type(self), tuple(getattr(self, p) for p in self._parts)) if self._parts else super().__reduce__()


class BadInput(P2PError, ValueError):
    """A value does not fit: names the thing, what came, what was expected, what to do."""

    _parts = ("name", "got", "expected", "fix")

    def __init__(self, name: str, got: object, expected: str, fix: str = ""):
        self.name, self.got, self.expected, self.fix = name, got, expected, fix
        super().__init__(_sentence(f"{name}: got {got}, expected {expected}", fix))


class MissingData(P2PError, FileNotFoundError):
    """A file or folder is not there (or cannot be read)."""

    _parts = ("name", "expected", "fix")

    def __init__(self, name: str, expected: str, fix: str = ""):
        self.name, self.expected, self.fix = name, expected, fix
        super().__init__(_sentence(f"{name}: {expected}", fix))


class MissingBackend(P2PError, ImportError):
    """An optional package or checkpoint was asked for by name and is not installed."""

    _parts = ("name", "missing", "fix")

    def __init__(self, name: str, missing: str, fix: str):
        self.missing, self.fix = missing, fix
        super().__init__(_sentence(f"{name}: {missing}", fix), name=name)


class WrongSize(BadInput):
    """An image of another size."""


def wrong_size(name: str, shape: tuple[int, ...], wanted: tuple[int, int], like: str, fix: str = "") -> WrongSize:
    """An image (H, W) of another size than that which ``like`` has: sizes are said width first, as those of files."""
    got = "{1}x{0}".format(*shape) if len(shape) == 2 else f"shape {shape}"
    return WrongSize(name, got, f"{wanted[1]}x{wanted[0]} (width x height) as {like}", fix)


def advised(error: P2PError, fix: str) -> P2PError:
    """The same error with more of what to do."""
    if isinstance(error, BadInput):
        return BadInput(error.name, error.got, error.expected, f"{error.fix} {fix}".strip())
    if isinstance(error, MissingData):
        return MissingData(error.name, error.expected, f"{error.fix} {fix}".strip())
    return error


#: The kind of doubt by which a run says that it moves depth onto its colour.
DEPTH_MOVED = "depth moved"


class Doubt(UserWarning):
    """What can be meant, and most often is not: tracking goes on.

    object  that it is about; None: all that was read
    kind    by which whoever does something about it knows it; empty where nobody does
    """

    def __init__(self, text: str, object: str | None = None, kind: str = ""):
        super().__init__(text)
        self.object, self.kind = object, kind

    def as_dict(self) -> dict[str, str | None]:
        """As ``run.json`` keeps it."""
        return {"text": str(self), "object": self.object, "kind": self.kind}


def doubt(name: str, got: object, fix: str, of: str | None = None, kind: str = "") -> str:
    """Warn of what came, saying what to do if it was not meant; the line named is the caller's of this library.

    of, kind  object and kind of the :class:`Doubt`

    Returns what it says.
    """
    level, at = 2, sys._getframe(1)
    while at.f_back is not None and at.f_globals.get("__name__", "").startswith(("p2p_lib.", "contextlib")):
        level, at = level + 1, at.f_back
    said = Doubt(_sentence(f"{name}: {got}", fix), of, kind)
    warnings.warn(said, stacklevel=level)
    return str(said)


class Doubts:
    """Doubts as they come: those that differ in numbers alone are one, with its count. Names in quotes differ."""

    def __init__(self) -> None:
        self._count: Counter[str] = Counter()
        self._first: dict[str, Doubt] = {}

    def add(self, doubt: Doubt) -> bool:
        """Whether it is the first of its kind."""
        alike = re.sub(r"('[^']*')|\d+", lambda found: found[1] or "N", str(doubt))
        self._first.setdefault(alike, doubt)
        self._count[alike] += 1
        return self._count[alike] == 1

    @property
    def more(self) -> list[str]:
        """A line for each of which more came than the first."""
        return [f"{count - 1} more like: {alike}" for alike, count in self._count.items() if count > 1]

    def __iter__(self) -> Iterator[Doubt]:
        """The first of each kind; of those that came again it says how often."""
        for alike, first in self._first.items():
            more = self._count[alike] - 1
            yield Doubt(f"{first} ({more} more like it)", first.object, first.kind) if more else first


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """``Did you mean NAME?``, of those known the nearest to a word, in capitals or not; empty where none is near.

    The word itself is no proposal: it may be known, and out of place.
    """
    called = {name.lower(): name for name in known if name != word}
    near = get_close_matches(word.lower(), called, n=1)
    return f"Did you mean {prefix}{called[near[0]]}?" if near else ""


def listed(words: Sequence[object], most: int) -> str:
    """The first of them in words, and how many more there are."""
    return ", ".join(map(str, words[:most])) + f" and {len(words) - most} more" * (len(words) > most)


def in_a_line(error: BaseException) -> str:
    """The first 160 letters of what a library says, or what kind of error it is where it says nothing."""
    return " ".join(str(error).split())[:160] or type(error).__name__


def _sentence(what: str, fix: str) -> str:
    """One line, whatever line breaks the parts have."""
    return " ".join((f"{what}. {fix}" if fix else what).split())
