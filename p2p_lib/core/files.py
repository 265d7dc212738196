"""Files that are never half written, and archives of arrays without pickles."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from p2p_lib.core.errors import BadInput


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write that then takes the place of ``path``: readers and crashes see either the old or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with partial.open("wb") as file:
        yield file
    os.replace(partial, path)


def replace_text(path: Path, text: str) -> None:
    """Write text as UTF-8 by :func:`replacing`."""
    with replacing(path) as file:
        file.write(text.encode())
        file.flush()
        os.fsync(file.fileno())


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file by name, none where there is no file; :class:`BadInput` where it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        return {}
    except (ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise BadInput(str(path), f"an unreadable archive ({error})", "arrays as p2p run wrote them") from None
