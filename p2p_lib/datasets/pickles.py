"""Pickles from the internet, read without running them: NumPy arrays and plain values, nothing else.

A pickle is a program that may call anything. Here it may name only what a pickled array consists of, and even that
gets a stand-in that notes what was said: the arrays are made afterwards, from checked types, shapes and bytes.
(NumPy's own parts are not handed out: a hostile stream can reach into them and change what float32 means.)
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
_FAULTS = (
    pickle.UnpicklingError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    RecursionError,
)
_PLAIN = (str, bytes, int, float, complex, bool, type(None))
_TYPE = re.compile(r"[biufcSU]\d{1,4}")


class _Dtype:
    """What a pickled ``numpy.dtype`` says of itself."""

    __slots__ = ("code", "order")

    def __init__(self, code: str, align: object = False, copy: object = False):
        self.code, self.order = code, "|"

    def __setstate__(self, state: tuple) -> None:
        _version, self.order, subtype, names, fields = state[:5]
        if (subtype, names, fields) != (None, None, None):
            raise ValueError("an array of records")

    def made(self) -> np.dtype:
        if self.order not in ("<", ">", "|", "=") or not _TYPE.fullmatch(self.code):
            raise ValueError(f"an array of type {self.order}{self.code}")
        return np.dtype(self.order + self.code)


class _Array:
    """What a pickled ``numpy.ndarray`` says of itself: shape, type, whether in Fortran's order, bytes."""

    __slots__ = ("parts",)

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


def _reconstruct(*_: object) -> _Array:
    return _Array()


def _frombuffer(data: bytes, dtype: _Dtype, shape: tuple, order: str, *_: object) -> _Array:
    array = _Array()
    array.parts = data, dtype, shape, order
    return array


def _scalar(dtype: _Dtype, data: bytes) -> _Array:
    return _frombuffer(data, dtype, (), "C")


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
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _reconstruct for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _frombuffer for core in ("core", "_core")},
}


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
    except _FAULTS as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise BadInput(str(path), f"an unreadable or unsafe pickle ({reason})", EXPECTED) from None


def _plain(value: Any, depth: int) -> Any:
    """The value with its arrays made; ValueError for anything that is no plain value."""
    if depth > 20:
        raise ValueError("nested more than 20 deep")
    if isinstance(value, _Array):
        return value.made()
    if isinstance(value, dict):
        return {_plain(k, depth + 1): _plain(v, depth + 1) for k, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_plain(item, depth + 1) for item in value)
    if type(value) not in _PLAIN:
        raise ValueError(f"a value of type {type(value).__name__.strip('_')}")
    return value
