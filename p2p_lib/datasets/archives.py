"""Unpacking archives from the internet: only files and folders, only below the folder that was named.

Links, devices, absolute paths, ``..`` and passwords are refused before the member is touched.
"""

from __future__ import annotations

import errno
import shutil
import stat
import tarfile
import zipfile
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO

from p2p_lib.core.errors import BadInput, MissingData, in_a_line
from p2p_lib.core.files import UNPACKED_BYTES, UNPACKED_RATIO, UNREADABLE

#: What a member costs however small it is.
_MEMBER_BYTES = 512
#: Name as stored, size, why it may not be unpacked ("": it may), what gives its bytes (None: a folder).
_Member = tuple[str, int, str, Callable[[], IO[bytes] | None] | None]


def unpack(
    archive: str | Path,
    folder: str | Path,
    progress: Callable[[int], object] | None = None,
    only: Collection[str] | None = None,
) -> dict[str, int]:
    """Unpack a .zip or .tar (.gz, .bz2, .xz) into a folder; returns path below it to bytes, for every file.

    progress  called with the bytes of each file once it is written
    only      file names: files that are called otherwise stay packed

    Raises :class:`BadInput` naming the archive and the member where it would leave the folder, holds anything
    but files and folders, is damaged, or needs more room than there is.
    """
    archive, folder = Path(archive), Path(folder)
    if not archive.is_file():
        raise MissingData(str(archive), "no such archive")
    folder.mkdir(parents=True, exist_ok=True)
    written: dict[str, int] = {}
    left = largest = UNPACKED_RATIO * archive.stat().st_size + UNPACKED_BYTES
    try:
        for name, size, refused, open_member in _members(archive):
            if only is not None and PurePosixPath(name).name not in only:
                continue
            target = _target(archive, folder, name, refused)
            left -= size + _MEMBER_BYTES
            if left < 0:
                fix = "If you trust the archive, unpack it by hand."
                raise BadInput(str(archive), f"{name!r}, more than it may unpack to", f"at most {largest} bytes", fix)
            if open_member is None:
                target.mkdir(parents=True, exist_ok=True)
                continue
            if size > shutil.disk_usage(folder).free:
                raise BadInput(str(archive), f"{name} of {size} bytes", f"room for it in {folder}")
            target.parent.mkdir(parents=True, exist_ok=True)
            if (content := open_member()) is None:
                raise BadInput(str(archive), f"{name!r}, which is neither a file nor a folder", "files and folders")
            with content as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink, 1 << 20)
            written[target.relative_to(folder).as_posix()] = target.stat().st_size
            if progress is not None:
                progress(size)
    except BadInput:
        raise
    except UNREADABLE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):  # the disk's, not the archive's
            raise
        fix = "Fetch it again: p2p data fetch replaces an archive whose checksum is wrong."
        raise BadInput(str(archive), f"a damaged archive ({in_a_line(error)})", "a whole one", fix) from None
    return written


def _members(archive: Path) -> Iterator[_Member]:
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as zipped:
            for entry in zipped.infolist():
                kind = stat.S_IFMT(entry.external_attr >> 16)
                refused = "" if kind in (0, stat.S_IFREG, stat.S_IFDIR) else "a link or a device"
                refused = "locked by a password" if entry.flag_bits & 1 else refused
                reader: Callable[[], IO[bytes] | None] | None = None if entry.is_dir() else partial(zipped.open, entry)
                # The name as stored: zipfile's own has backslashes and NULs already mended.
                yield entry.orig_filename, entry.file_size, refused, reader
    else:
        with tarfile.open(archive) as tarred:
            for member in tarred:
                refused = "" if member.isreg() or member.isdir() else "a link or a device"
                reader = None if member.isdir() else partial(tarred.extractfile, member)
                yield member.name, member.size, refused, reader


def _target(archive: Path, folder: Path, name: str, refused: str) -> Path:
    """Where a member goes; :class:`BadInput` where that is not below the folder."""
    path = PurePosixPath(name)
    if not refused and (path.is_absolute() or ".." in path.parts or set("\\\0") & set(name)):
        refused = "a path that leaves the folder"
    target = folder / path
    # A link that lay there before leads wherever it wants.
    if not refused and not target.resolve().is_relative_to(folder.resolve()):
        refused = "a path that leaves the folder through a link"
    if refused:
        fix = "Nothing of it was written; if you trust the archive, unpack it by hand."
        raise BadInput(str(archive), f"{name!r}, {refused}", "files and folders inside the archive's own", fix)
    return target
