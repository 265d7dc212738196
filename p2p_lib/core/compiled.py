"""Inner loops as machine code: what runs many times a frame over few points, where NumPy mostly calls itself.

A function under :func:`compiled` is compiled when it is first called with new types and kept in a cache beside its
file, or in the user's cache folder where that cannot be written. It takes and gives arrays and numbers alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable)


def compiled(function: F) -> F:
    """The function, compiled. Sums keep their order (no ``fastmath``): results are the same in every run."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
