"""Pickles from the internet, read without running them: NumPy arrays and plain values, nothing else.

A pickle may call anything that it names. Here it may name only what a pickled array consists of, and gets a stand-in
that records the state: the arrays are made afterwards, from checked types, shapes and bytes. NumPy's own functions
are not handed out, since a hostile stream can change NumPy's types through them.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core.errors import BadInput, in_a_line
from p2p_lib.core.files import LARGEST_PICKLE, MOST_VALUES, UNREADABLE, read_bytes

EXPECTED = "a pickle of NumPy arrays and plain values"
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
        data = data.text if isinstance(data, _Bytes) else data
        if isinstance(data, str):  # Python 2 wrote its bytes as a string
            data = data.encode("latin1")
        if not isinstance(data, bytes | bytearray) or not isinstance(dtype, _Dtype) or order not in ("C", "F"):
            raise ValueError("an array of Python objects")
        # A copy: the data are read-only otherwise.
        return np.frombuffer(data, dtype.made()).reshape(shape, order=order).copy()


class _Bytes:
    """The text that protocol 2 rebuilds bytes from; the codecs that unpack archives stay out."""

    def __init__(self, text: str, encoding: str):
        if encoding != "latin1":
            raise ValueError(f"bytes encoded as {encoding!r}")
        self.text = text

    def made(self) -> bytes:
        return self.text.encode("latin1")


# NumPy moved these modules in version 2; a pickle has the names that were current when it was written.
_ADMITTED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Bytes,
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
    data = read_bytes(path, EXPECTED, LARGEST_PICKLE)
    try:
        for operation, argument, _ in pickletools.genops(data):
            # Python makes room for as many values as the largest of these numbers says, whatever there is.
            if operation.name.endswith("PUT") and isinstance(argument, int) and argument > len(data):
                raise ValueError(f"a value with the number {argument}")
        # latin1: HO-3D's files were written by Python 2, whose strings are bytes.
        return _Plain().value(_ArraysOnly(io.BytesIO(data), encoding="latin1").load(), 0)
    except UNREADABLE as error:
        raise BadInput(str(path), f"an unreadable or unsafe pickle ({in_a_line(error)})", EXPECTED) from None


class _Plain:
    """Makes arrays of what stands for them, within limits: values that are said once may be meant a million times."""

    def __init__(self) -> None:
        self._left = MOST_VALUES

    def value(self, value: Any, depth: int) -> Any:
        """The value with its arrays made; ValueError for anything that is no plain value."""
        self._left -= 1 + _size(value) // 64
        if depth > _DEEPEST or self._left < 0:
            raise ValueError(f"nested more than {_DEEPEST} deep" if depth > _DEEPEST else "too many values")
        if type(value) in (_Array, _Bytes):
            return value.made()
        if isinstance(value, dict):
            return {self.value(k, depth + 1): self.value(v, depth + 1) for k, v in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self.value(item, depth + 1) for item in value)
        if type(value) not in _PLAIN:
            raise ValueError(f"a value of type {type(value).__name__.strip('_')}")
        return value


def _size(value: Any) -> int:
    """Bytes that are copied when the value is made."""
    data = value.parts[0] if type(value) is _Array and value.parts else value
    data = data.text if type(data) is _Bytes else data
    return len(data) if data is not value and isinstance(data, str | bytes | bytearray) else 0
