"""Unpacking archives from the internet: only files and folders, only below the folder that was named.

Links, devices, absolute paths, ``..`` and passwords are refused before the member is touched.
"""

from __future__ import annotations

import lzma
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from p2p_lib.core.errors import BadInput, MissingData

_FAULTS = (zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error, lzma.LZMAError, NotImplementedError)


@dataclass(frozen=True)
class _Member:
    """One entry: ``refused`` says why it may not be unpacked, ``open`` gives its bytes (None: a folder)."""

    name: str
    size: int
    refused: str
    open: Callable[[], IO[bytes] | None] | None


def unpack(archive: str | Path, folder: str | Path, progress: Callable[[int], object] | None = None) -> dict[str, int]:
    """Unpack a .zip or .tar (.gz, .bz2, .xz) into a folder; returns path below it to bytes, for every file.

    progress  called with the bytes of each file once it is written

    Raises :class:`BadInput` naming the archive and the member where it would leave the folder, holds anything
    but files and folders, is damaged, or needs more room than there is.
    """
    archive, folder = Path(archive), Path(folder)
    if not archive.is_file():
        raise MissingData(str(archive), "no such archive")
    folder.mkdir(parents=True, exist_ok=True)
    written: dict[str, int] = {}
    try:
        for member in _members(archive):
            target = _target(archive, folder, member)
            if member.open is None:
                target.mkdir(parents=True, exist_ok=True)
                continue
            if member.size > shutil.disk_usage(folder).free:
                raise BadInput(str(archive), f"{member.name} of {member.size} bytes", f"room for it in {folder}")
            target.parent.mkdir(parents=True, exist_ok=True)
            with member.open() as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink, 1 << 20)
            written[target.relative_to(folder).as_posix()] = target.stat().st_size
            if progress is not None:
                progress(member.size)
    except _FAULTS as error:
        raise _damaged(archive, error) from None
    except OSError as error:
        if error.errno is not None:  # the disk's, not the archive's
            raise
        raise _damaged(archive, error) from None
    return written


def _damaged(archive: Path, error: Exception) -> BadInput:
    fix = "Fetch it again: p2p data fetch replaces an archive whose checksum is wrong."
    return BadInput(str(archive), f"a damaged archive ({' '.join(str(error).split())[:100]})", "a whole one", fix)


def _members(archive: Path) -> Iterator[_Member]:
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as opened:
            for info in opened.infolist():
                yield _zipped(opened, info)
    else:
        with tarfile.open(archive) as opened:
            for info in opened:
                yield _tarred(opened, info)


def _zipped(opened: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Member:
    kind = stat.S_IFMT(info.external_attr >> 16)
    refused = "" if kind in (0, stat.S_IFREG, stat.S_IFDIR) else "a link or a device"
    if info.flag_bits & 1:
        refused = "locked by a password"
    # The name as stored: zipfile's own has backslashes and NULs already mended.
    return _Member(info.orig_filename, info.file_size, refused, None if info.is_dir() else lambda: opened.open(info))


def _tarred(opened: tarfile.TarFile, info: tarfile.TarInfo) -> _Member:
    refused = "" if info.isreg() or info.isdir() else "a link or a device"
    return _Member(info.name, info.size, refused, None if info.isdir() else lambda: opened.extractfile(info))


def _target(archive: Path, folder: Path, member: _Member) -> Path:
    """Where a member goes; :class:`BadInput` where that is not below the folder."""
    path, refused = PurePosixPath(member.name), member.refused
    if not refused and (path.is_absolute() or ".." in path.parts or set("\\\0") & set(member.name)):
        refused = "a path that leaves the folder"
    target = folder / path
    # A link that lay there before leads wherever it wants.
    if not refused and not target.resolve().is_relative_to(folder.resolve()):
        refused = "a path that leaves the folder through a link"
    if refused:
        fix = "Nothing of it was written; if you trust the archive, unpack it by hand."
        raise BadInput(str(archive), f"{member.name!r}, {refused}", "files and folders inside the archive's own", fix)
    return target
