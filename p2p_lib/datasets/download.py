"""Fetching one file by pooch, which checks the checksum, with a downloader that resumes where it stopped.

A part of a file is kept as ``.NAME.part`` beside its place, with the server's mark of its version; the next call
asks the server to go on from there, and starts anew where the file has changed since.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

from p2p_lib.core.errors import BadInput, MissingData
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
    import pooch
    import requests

    target = folder / file.path
    target.parent.mkdir(parents=True, exist_ok=True)
    pooch.get_logger().setLevel("WARNING")
    try:
        pooch.retrieve(
            url=file.url,
            known_hash=known_sha256,
            fname=target.name,
            path=target.parent,
            downloader=_Resuming(target, file.bytes, progress),
        )
    except BadInput:
        raise
    except requests.RequestException as error:
        reason = " ".join(str(error).split())[:160]
        fix = "Run the command again: it goes on where it stopped."
        raise MissingData(file.url, f"cannot be fetched ({reason})", fix) from None
    except ValueError as error:  # pooch's word for a wrong checksum
        fix = "It was not kept. If the publisher has changed the file, compare with its page."
        raise BadInput(file.url, " ".join(str(error).split())[:300], f"sha256 {known_sha256}", fix) from None
    return sha256(target)


class _Resuming:
    """A downloader for pooch: called with a URL and the path of a temporary file to fill."""

    def __init__(self, target: Path, size: int | None, progress: bool):
        self.part = target.with_name(f".{target.name}.part")
        self.mark = target.with_name(f".{target.name}.part.mark")
        self.size, self.progress = size, progress

    def __call__(self, url: str, output_file: str, pooch: object, check_only: bool = False) -> None:
        import requests

        begun = self.part.stat().st_size if self.part.is_file() and self.mark.is_file() else 0
        # Without the mark the server could append the end of one version to the start of another.
        headers = {"Range": f"bytes={begun}-", "If-Range": self.mark.read_text()} if begun else {}
        # Bytes as they are: a range counts them before any compression on the way.
        headers["Accept-Encoding"] = "identity"
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT_S) as response:
            if response.status_code == 416:  # nothing after what is there: begin anew
                self._forget()
                return self(url, output_file, pooch)
            response.raise_for_status()
            self._write(response, begun if response.status_code == 206 else 0)
        got = self.part.stat().st_size
        if self.size in (None, got):
            os.replace(self.part, output_file)
        self._forget()
        if self.size not in (None, got):
            raise BadInput(url, f"{got} bytes", f"{self.size}, as the manifest says")
        return None

    def _write(self, response, begun: int) -> None:
        import requests

        mark = response.headers.get("ETag", "")
        # A weak ETag does not vouch for bytes; the time of the last change has to do.
        mark = mark if mark and not mark.startswith("W/") else response.headers.get("Last-Modified", "")
        self.mark.unlink(missing_ok=True)
        if mark:
            self.mark.write_text(mark)
        left = int(response.headers.get("Content-Length", 0))
        if left > shutil.disk_usage(self.part.parent).free:
            raise BadInput(response.url, f"{left} bytes", f"room for them in {self.part.parent}")
        name = self.part.name.removeprefix(".").removesuffix(".part")
        options = {"unit": "B", "unit_scale": True, "initial": begun, "shown": self.progress}
        bar = progress_bar(name, begun + left or None, **options)
        with bar, self.part.open("ab" if begun else "wb") as sink:
            for chunk in response.iter_content(CHUNK):
                sink.write(chunk)
                bar.update(len(chunk))
        came = self.part.stat().st_size
        if left and came != begun + left:
            raise requests.ConnectionError(f"{came} of {begun + left} bytes came")

    def _forget(self) -> None:
        self.part.unlink(missing_ok=True)
        self.mark.unlink(missing_ok=True)
