"""Inner loops as machine code: what runs many times a frame over few points, where NumPy mostly calls itself.

A function under :func:`compiled` takes and gives arrays and numbers alone, and calls no compiled function of another
file: the cache of one file does not know when another changes.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import FrameType
from typing import TypeVar, cast

F = TypeVar("F", bound=Callable)

_waiting: dict[str, list[Callable]] = {}
_compiling = threading.Lock()


def compiled(function: F) -> F:
    """The function, compiled by numba when a function of its file is first called.

    The machine code is kept beside the file, or in the user's cache folder where that cannot be written. Sums keep
    their order (no ``fastmath``): results are the same in every run.
    """
    _waiting.setdefault(function.__module__, []).append(function)

    @wraps(function)
    def first(*args):
        _compile(function.__module__)
        return getattr(sys.modules[function.__module__], function.__name__)(*args)

    return cast(F, first)


def _compile(module: str) -> None:
    """Put the compiled functions of a module in the place of those that wait; numba takes long to import."""
    import numba

    with _compiling:
        for function in _waiting.pop(module, ()):
            try:
                ready = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
            except RuntimeError:  # there is nowhere to keep it: it is compiled in every process
                ready = numba.njit(nogil=True, error_model="numpy")(function)
            setattr(sys.modules[module], function.__name__, ready)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM that come within are answered at its end, and a second one at once.

    A compiled function cannot be interrupted: it raises SystemError in the place of KeyboardInterrupt. Only the main
    thread hears signals; in another this does nothing.
    """
    came: list[int] = []

    def hold(number: int, at: FrameType | None) -> None:
        came.append(number)
        if len(came) > 1:
            answers[number](number, at)

    in_main = threading.current_thread() is threading.main_thread()
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM) if in_main}
    answers: dict[int, Callable] = {number: answer for number, answer in found.items() if callable(answer)}
    for number in answers:
        signal.signal(number, hold)
    try:
        yield
    finally:
        for number, answer in answers.items():
            signal.signal(number, answer)
        if came:
            answers[came[0]](came[0], None)
