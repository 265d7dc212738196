"""Inner loops as machine code: what runs many times a frame over few points, where NumPy mostly calls itself.

A function under :func:`compiled` takes and gives arrays and numbers alone, and calls no compiled function of another
file: the cache of one file does not know when another changes. What it is called with is said beside it, so that
:func:`warm_up` can have all of them ready before the first frame.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from importlib import import_module
from time import monotonic
from types import FrameType
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable)

#: The modules that have compiled functions. The first tells whether they have been compiled before; two processes that
#: compile take about as long for the others before and after the gap.
LOOPS = (
    "p2p_lib.trackers.builtin.features",
    "p2p_lib.core.depth",
    "p2p_lib.core.voxels",
    "p2p_lib.extended.scene",
    "p2p_lib.trackers.builtin.appearance",
    "p2p_lib.extended.image_search",
    "p2p_lib.core.robust",
)
LOOPS_IN_BACKGROUND = (
    "p2p_lib.trackers.builtin.rigid_motion",
    "p2p_lib.method.refinement",
    "p2p_lib.trackers.builtin.direct_alignment",
)
_waiting: dict[str, list[Callable]] = {}
_arguments: dict[tuple[str, str], tuple[str, ...]] = {}  # (module, function) to the types it is called with
_warm: set[str] = set()
_compiling = threading.Lock()


def compiled(*arguments: str) -> Callable[[F], F]:
    """Decorates a function that numba compiles when a function of its file is first called, or :func:`warm_up` is.

    arguments  the types of its arguments in numba's words, ``"f8[:,::1], f8"``; several where it is called with
               several, none where compiled functions of its file alone call it. Others still work, and are compiled
               when they come

    An array assigned to a slice (``a[:3] = b``) takes seconds to compile, for the words of the error if it does not
    fit, and so does ``np.partition``: neither is in them.

    The machine code is kept beside the file, or in the user's cache folder where that cannot be written. Sums keep
    their order (no ``fastmath``): results are the same in every run.
    """

    def declare(function: F) -> F:
        _waiting.setdefault(function.__module__, []).append(function)
        _arguments[function.__module__, function.__name__] = arguments

        @wraps(function)
        def first(*args: Any) -> Any:
            _compile(function.__module__)
            return getattr(sys.modules[function.__module__], function.__name__)(*args)

        return cast(F, first)

    return declare


def warm_up(say: Callable[[str], object] = lambda line: None) -> float:
    """Compile everything that a run can meet, or load it where an earlier process did; returns the seconds it took.

    Compiled code is kept for later processes (see :func:`compiled`): the first call on a machine takes 10 to 25 s on
    two free cores, longer where other programs run; later ones a second. Without it a step compiles what it is the
    first to meet, as at an object's first absence, and takes as long. Safe to call again, and in any thread.

    say  told a line when the first function is not kept from before; nothing where all is only loaded
    """
    start_s = monotonic()
    child: subprocess.Popen | None = None
    line = "Compiling inner loops, once on this machine: 10 to 25 s, longer where other programs run."
    missed = cache(lambda: say(line))  # once, however many are missed
    try:
        for module in (name for name in (*LOOPS, *LOOPS_IN_BACKGROUND) if name not in _warm):
            if module == LOOPS_IN_BACKGROUND[0] and child is not None:
                child.wait()  # what it has compiled is loaded; what it has not is compiled here
            if _ready(module, missed) and module == LOOPS[0]:
                child = _compile_in_background() if len(os.sched_getaffinity(0)) > 1 else None
    finally:
        if child is not None:
            child.kill()
            child.wait()
    return monotonic() - start_s


def _ready(module: str, missed: Callable[[], object] = lambda: None) -> bool:
    """Have all functions of a module compiled; whether any was not kept from before, and ``missed`` called at each."""
    import_module(module)
    _compile(module)
    from numba.core.sigutils import normalize_signature

    any_missed = False
    _warm.add(module)
    for (of, name), arguments in _arguments.items():
        if of == module and arguments:
            function = getattr(sys.modules[module], name)
            for types in arguments:
                # Kept by what it is given: by words, who calls the function without this compiles it again.
                function.compile(normalize_signature(f"({types},)")[0])
            if sum(function.stats.cache_misses.values()):
                any_missed = True
                missed()
    return any_missed


def _compile_in_background() -> subprocess.Popen | None:
    """A process that compiles :data:`LOOPS_IN_BACKGROUND`: numba compiles one function of a process at a time."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from p2p_lib.core import compiled as c\n"
    code += "for module in c.LOOPS_IN_BACKGROUND: c._ready(module)"
    quiet = subprocess.DEVNULL
    try:
        return subprocess.Popen([sys.executable, "-c", code], stdin=quiet, stdout=quiet, stderr=quiet)
    except OSError:  # it may not start any: then all is compiled here
        return None


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
