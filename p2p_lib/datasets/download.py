"""Fetching one file: checked against its checksum, and resumed where the connection broke.

A part of a file is kept as ``.NAME.part`` beside its place, with the server's mark of its version; the next call
asks the server to go on from there, and starts anew where the file has changed since.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

from p2p_lib.core.errors import BadInput, MissingData, in_a_line
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.manifests import RemoteFile

CHUNK = 1 << 16  # what a broken connection loses at most
TIMEOUT_S = 30.0


def sha256(path: Path) -> str:
    """The checksum of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def download(file: RemoteFile, folder: Path, known_sha256: str | None, progress: bool = True) -> str:
    """Put a file in its place below ``folder``, if it is not there with this checksum; returns its sha256.

    known_sha256  the manifest's or that of an earlier download; None: whatever comes is taken, once

    Raises :class:`MissingData` where the server does not give it, :class:`BadInput` where it is not what was expected.
    """
    import requests

    if file.url is None:
        raise MissingData(file.path, "it is had by hand only", "See p2p data info.")
    target = folder / file.path
    if target.is_file() and known_sha256 in (None, digest := sha256(target)):
        return digest
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{target.name}.part")
    try:
        _fetch(file.url, part, progress)
    except requests.RequestException as error:
        fix = "Run the command again: it goes on where it stopped."
        raise MissingData(file.url, f"cannot be fetched ({in_a_line(error)})", fix) from None
    _mark(part).unlink(missing_ok=True)
    size, digest = part.stat().st_size, sha256(part)
    if file.bytes in (None, size) and known_sha256 in (None, digest):
        os.replace(part, target)
        return digest
    part.unlink()
    if file.bytes not in (None, size):
        raise BadInput(file.url, f"{size} bytes", f"{file.bytes}, as the manifest says")
    fix = "It was not kept. If the publisher has changed the file, compare with its page."
    raise BadInput(file.url, f"sha256 {digest}", f"sha256 {known_sha256}", fix)


def _mark(part: Path) -> Path:
    return part.with_name(f"{part.name}.mark")


def _fetch(url: str, part: Path, progress: bool) -> None:
    """Fill ``part`` with all of the file, or with what comes after that which it holds."""
    import requests

    mark = _mark(part)
    begun = part.stat().st_size if part.is_file() and mark.is_file() else 0
    # Without the mark the server could append the end of one version to the start of another.
    headers = {"Range": f"bytes={begun}-", "If-Range": mark.read_text()} if begun else {}
    # Bytes as they are: a range counts them before any compression on the way.
    headers["Accept-Encoding"] = "identity"
    with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT_S) as response:
        if response.status_code == 416:  # nothing after what is there: begin anew
            part.unlink()
            return _fetch(url, part, progress)
        response.raise_for_status()
        begun = begun if response.status_code == 206 else 0
        mark.unlink(missing_ok=True)
        # A weak ETag does not vouch for bytes; the time of the last change has to do.
        version = response.headers.get("ETag", "")
        version = version if version and not version.startswith("W/") else response.headers.get("Last-Modified", "")
        if version:
            mark.write_text(version)
        left = int(response.headers.get("Content-Length", 0))
        if left > shutil.disk_usage(part.parent).free:
            raise BadInput(url, f"{left} bytes", f"room for them in {part.parent}")
        name = part.name.removeprefix(".").removesuffix(".part")
        bar = progress_bar(name, begun + left or None, unit="B", unit_scale=True, initial=begun, shown=progress)
        with bar, part.open("ab" if begun else "wb") as sink:
            for chunk in response.iter_content(CHUNK):
                sink.write(chunk)
                bar.update(len(chunk))
    came = part.stat().st_size
    if left and came != begun + left:
        raise requests.ConnectionError(f"{came} of {begun + left} bytes came")
    return None
