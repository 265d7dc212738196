"""Pickles from the internet, read without running them: NumPy arrays and plain values, nothing else.

A pickle may call anything that it names. Here it may name only what a pickled array consists of, and gets a stand-in
that records the state: the arrays are made afterwards, from checked types, shapes and bytes. NumPy's own functions
are not handed out, since a hostile stream can change NumPy's types through them.
"""

from __future__ import annotations

import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core.errors import BadInput, MissingData

EXPECTED = "a pickle of NumPy arrays and plain values"
# What a damaged or hostile stream makes the unpickler raise.
_FAULTS = (pickle.UnpicklingError, EOFError, ValueError, TypeError, LookupError, AttributeError)
_LIMITS = (ArithmeticError, MemoryError, RecursionError)
_PLAIN = (str, bytes, int, float, complex, bool, type(None))
_TYPE = re.compile(r"[<>|=][biufcSU]\d{1,4}")
_DEEPEST = 20


class _Dtype:
    """The state of a pickled ``numpy.dtype``."""

    def __init__(self, code: str, align: object = False, copy: object = False):
        self.code, self.order = code, "|"

    def __setstate__(self, state: tuple) -> None:
        _version, self.order, subtype, names, fields = state[:5]
        if (subtype, names, fields) != (None, None, None):
            raise ValueError("an array of records")

    def made(self) -> np.dtype:
        if not _TYPE.fullmatch(self.order + self.code):
            raise ValueError(f"an array of type {self.order}{self.code}")
        return np.dtype(self.order + self.code)


class _Array:
    """The state of a pickled ``numpy.ndarray``: bytes, type, shape, order of its axes."""

    def __init__(self, *parts: Any):
        self.parts = parts

    def __setstate__(self, state: tuple) -> None:
        _version, shape, dtype, fortran, data = state
        self.parts = data, dtype, shape, "F" if fortran else "C"

    def made(self) -> np.ndarray:
        data, dtype, shape, order = self.parts
        if isinstance(data, str):  # Python 2 wrote its bytes as a string
            data = data.encode("latin1")
        if not isinstance(data, bytes | bytearray) or not isinstance(dtype, _Dtype) or order not in ("C", "F"):
            raise ValueError("an array of Python objects")
        # A copy: the data are read-only otherwise.
        return np.frombuffer(data, dtype.made()).reshape(shape, order=order).copy()


def _latin1(text: str, encoding: str) -> bytes:
    """What protocol 2 calls to rebuild bytes; the codecs that unpack archives stay out."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}")
    return text.encode("latin1")


# NumPy moved these modules in version 2; a pickle has the names that were current when it was written.
_ADMITTED = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _latin1,
}
for _core in ("numpy.core", "numpy._core"):
    _ADMITTED[f"{_core}.multiarray", "_reconstruct"] = lambda *_: _Array()
    _ADMITTED[f"{_core}.multiarray", "scalar"] = lambda dtype, data: _Array(data, dtype, (), "C")
    _ADMITTED[f"{_core}.numeric", "_frombuffer"] = lambda *parts: _Array(*parts[:4])


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ADMITTED[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}") from None


def load_plain(path: str | Path) -> Any:
    """What a pickle holds: arrays, numbers, strings, None, and lists, tuples and dicts of these.

    NumPy's scalars come as arrays without dimensions. Raises :class:`BadInput` naming the file where it asks for
    anything else or is damaged; nothing of it is run.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MissingData(str(path), f"cannot be read ({error.strerror}), expected {EXPECTED}") from None
    try:
        # latin1: HO-3D's files were written by Python 2, whose strings are bytes.
        return _plain(_ArraysOnly(io.BytesIO(data), encoding="latin1").load(), 0)
    except (*_FAULTS, *_LIMITS) as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise BadInput(str(path), f"an unreadable or unsafe pickle ({reason})", EXPECTED) from None


def _plain(value: Any, depth: int) -> Any:
    """The value with its arrays made; ValueError for anything that is no plain value."""
    if depth > _DEEPEST:
        raise ValueError(f"nested more than {_DEEPEST} deep")
    if type(value) is _Array:
        return value.made()
    if isinstance(value, dict):
        return {_plain(k, depth + 1): _plain(v, depth + 1) for k, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_plain(item, depth + 1) for item in value)
    if type(value) not in _PLAIN:
        raise ValueError(f"a value of type {type(value).__name__.strip('_')}")
    return value
