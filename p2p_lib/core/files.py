"""Files: what is read is bounded, and faults name the file; what is written is whole or not there at all.

Every limit of what is read is here. What is above it is a mistake or an attack, and refused before it costs anything.
"""

from __future__ import annotations

import csv
import errno
import json
import lzma
import os
import pickle
import re
import stat
import struct
import tarfile
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from p2p_lib.core.errors import BadInput, MissingData

T = TypeVar("T")

#: Bytes of any file; of JSON and tables; of a pickle; of TOML and its lines, the square of which its reader takes.
LARGEST_FILE, LARGEST_TEXT, LARGEST_PICKLE = 1 << 28, 1 << 26, 1 << 22
LARGEST_TOML, LONGEST_TOML_LINE = 1 << 16, 1 << 10
#: Pixels of an image: more than 8K video.
LARGEST_IMAGE_PX = 1 << 25
#: Bytes of the arrays of an ``.npz`` file; values of a pickle, counted as often as they are meant, 64 bytes as one.
LARGEST_ARRAYS, MOST_VALUES = 1 << 30, 1 << 18
#: An archive unpacks to at most so many times its size, and so many bytes besides.
UNPACKED_RATIO, UNPACKED_BYTES = 100, 1 << 26
#: What parsers raise at bytes that nobody expected.
UNREADABLE: tuple[type[Exception], ...]
UNREADABLE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, EOFError, OSError, MemoryError)
UNREADABLE += (RuntimeError, SyntaxError, NameError, struct.error, tokenize.TokenError, csv.Error, pickle.PickleError)
UNREADABLE += (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError)

_NAME = re.compile(r"\w[\w .+-]{0,99}")


# --- reading ---------------------------------------------------------------------------------------


def read_bytes(path: Path, expected: str, largest: int = LARGEST_FILE, fix: str = "") -> bytes:
    """What a regular file holds; ``expected`` says what that should be, ``fix`` what to do where there is none.

    Raises :class:`MissingData` for no file and one that cannot be read, :class:`BadInput` for a pipe, a device and
    more than ``largest`` bytes.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode) and not stat.S_ISDIR(about.st_mode):
            raise BadInput(str(path), "a pipe or a device", f"a file: {expected}")
        if about.st_size > largest:
            raise BadInput(str(path), f"{about.st_size} bytes", f"{expected}, of at most {largest} bytes")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise MissingData(str(path), f"no such file, expected {expected}", fix) from None
    except OSError as error:
        raise MissingData(str(path), f"cannot be read ({error.strerror}), expected {expected}", fix) from None


def read_text(path: Path, expected: str, fix: str = "") -> str:
    """A file of UTF-8 by :func:`read_bytes`; bytes that are none become question marks."""
    return read_bytes(path, expected, LARGEST_TEXT, fix).decode("utf-8", "replace")


def parse_json(text: str | bytes, name: str, expected: str) -> Any:
    """The plain values of JSON; :class:`BadInput` calls it ``name``."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadInput(name, f"unreadable JSON ({error})", expected) from None


def read_toml(path: Path, expected: str, fix: str = "") -> dict[str, Any]:
    """The tables of a TOML file; raises as :func:`read_bytes`, and :class:`BadInput` for what is no TOML."""
    data = read_bytes(path, expected, LARGEST_TOML, fix)
    if (longest := max(map(len, data.splitlines()), default=0)) > LONGEST_TOML_LINE:
        raise BadInput(str(path), f"a line of {longest} bytes", f"{expected}, in lines of at most {LONGEST_TOML_LINE}")
    try:
        return tomllib.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise BadInput(str(path), f"unreadable TOML ({error})", expected) from None


def read_array(path: Path, expected: str) -> np.ndarray:
    """The array of an ``.npy`` file without pickles; raises as :func:`read_bytes`."""
    data = BytesIO(read_bytes(path, expected))
    try:
        return np.lib.format.read_array(data, allow_pickle=False)
    except UNREADABLE as error:
        raise BadInput(str(path), f"an unreadable array ({error})", expected) from None


def load_arrays(path: Path, expected: str = "arrays as p2p run wrote them") -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file by name, none where there is no file; :class:`BadInput` where it is damaged."""
    if not path.exists():
        return {}
    if not path.is_file():
        raise BadInput(str(path), "no regular file", expected)
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size <= LARGEST_ARRAYS:
            with np.load(path, allow_pickle=False) as file:
                return {name: np.asarray(file[name]) for name in file.files}
    except UNREADABLE as error:
        raise BadInput(str(path), f"an unreadable archive ({error})", expected) from None
    raise BadInput(str(path), f"arrays of {size} bytes", f"at most {LARGEST_ARRAYS}")


def load_by_object(path: Path, kind: type[T]) -> dict[str, T]:
    """Object to its arrays, fields of the dataclass ``kind``, of a file that holds them as ``OBJECT/FIELD``.

    Empty where there is no file; :class:`BadInput` where one is damaged or lacks a field.
    """
    arrays = load_arrays(path)
    names = dict.fromkeys(key.rsplit("/", 1)[0] for key in arrays)
    try:
        return {n: kind(*(arrays[f"{n}/{f.name}"] for f in fields(kind))) for n in names}  # type: ignore[arg-type]
    except (KeyError, TypeError) as error:
        raise BadInput(str(path), f"an archive without {error}", "arrays as p2p run wrote them") from None


#: What an array holds, and numpy's letters for that.
_INTEGERS = np.typecodes["AllInteger"]
_LETTERS = {"numbers": _INTEGERS + np.typecodes["Float"], "whole numbers": _INTEGERS, "bytes": "B", "yes or no": "?"}


def check_arrays(what: str, of: Any, kind: str, /, *, finite: bool = True, **shapes: tuple[int | None, ...]) -> None:
    """Raise :class:`BadInput` for a field that is no array of this kind and shape (None: any length), all finite.

    kind    ``numbers``, ``whole numbers``, ``bytes`` or ``yes or no``
    finite  False where NaN stands for what is not known
    """
    for key, shape in shapes.items():
        got, expected = getattr(of, key), f"{kind} {of_shape(shape) or 'alone'}"
        if not isinstance(got, np.ndarray):
            raise BadInput(f"{what}: {key}", "no array", expected)
        fits = len(shape) == got.ndim and all(w in (None, n) for w, n in zip(shape, got.shape, strict=True))
        if not fits or got.dtype.char not in _LETTERS[kind]:
            raise BadInput(f"{what}: {key}", f"{got.dtype} {of_shape(got.shape) or 'alone'}", expected)
        if finite and not np.isfinite(got).all():
            raise BadInput(f"{what}: {key}", "some that are not finite", f"finite {expected}")


def of_shape(shape: Iterable[int | None]) -> str:
    """A shape in words; None is any length."""
    return " x ".join("any" if n is None else str(n) for n in shape)


def file_name(what: str, name: object) -> str:
    """``name``, where a file may be called so wherever it was read: it can lead nowhere else."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        expected = "up to 100 letters, digits, '_', '-', '.', '+' or spaces: it names a file"
        raise BadInput(what, repr(name)[:120], expected)
    return name


# --- writing ---------------------------------------------------------------------------------------


@contextmanager
def replacing(path: Path, durable: bool = True) -> Iterator[BinaryIO]:
    """A file to write that then takes the place of ``path``: readers and crashes see either the old or the new one.

    durable  whether it is on the disk then, so that the computer may crash, too; that takes milliseconds
    """
    if path.is_dir():
        raise BadInput(str(path), "a folder", "a file to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def replace_text(path: Path, text: str) -> None:
    """Write text as UTF-8 by :func:`replacing`."""
    with replacing(path) as file:
        file.write(text.encode())


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = False) -> None:
    """Write arrays by name as an ``.npz`` file by :func:`replacing`."""
    with replacing(path) as file:
        (np.savez_compressed if compressed else np.savez)(file, allow_pickle=False, **arrays)


def check_new(out: str | Path) -> None:
    """Refuse a file, and a folder that holds anything: what is written there would be mixed with it."""
    out = Path(out)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise BadInput(str(out), "what is there already", "a new or empty folder", "Name another one.")


def append(path: Path, line: str) -> None:
    """Write a line at the end of a file, all of it or, where the disk is full, nothing."""
    with path.open("ab", buffering=0) as file:
        before, data = file.tell(), line.encode()
        try:
            if file.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        except OSError:
            with suppress(OSError):
                file.truncate(before)
            raise


@contextmanager
def writing_alone(folder: Path) -> Iterator[None]:
    """Hold a folder, which is made: :class:`BadInput` where another process (or this one) holds it already.

    It is the system's lock of the folder itself: nothing stays behind when a process is killed. Where the file system
    has no such locks nobody is kept out.
    """
    import fcntl  # there is none on Windows

    if folder.exists() and not folder.is_dir():
        raise BadInput(str(folder), "a file", "a folder for the results")
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise BadInput(str(folder), "a folder that may not be written", "one for the results")
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fix = "Wait until it has ended, or name another folder."
            raise BadInput(str(folder), "a folder that another run is writing to", "one of its own", fix) from None
        except OSError:
            pass
        yield
    finally:
        os.close(held)
