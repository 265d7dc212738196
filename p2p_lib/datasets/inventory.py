"""What of the datasets and checkpoints is on this machine: fetched, recorded, verified, described.

Nothing is downloaded but by :func:`fetch`. What was fetched, or found in its place and unpacked, is recorded in
``.p2p-NAME.json`` of its folder: checksums that the manifest does not know hold from the first time on.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel
from tqdm import tqdm

from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput, MissingData, P2PError
from p2p_lib.core.files import read_text, replace_text
from p2p_lib.core.findings import Finding
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.tables import as_text
from p2p_lib.datasets.archives import unpack
from p2p_lib.datasets.download import download, sha256
from p2p_lib.datasets.manifests import Manifest, RemoteFile, find_sequence, folder_of, manifest, names
from p2p_lib.datasets.schema import read_json
from p2p_lib.datasets.sequence import open_sequence


class _Recorded(BaseModel):
    files: dict[str, dict[str, Any]]


class _Record:
    """What ``.p2p-NAME.json`` of a manifest's folder says of its files: sha256, bytes, and which were unpacked."""

    def __init__(self, of: Manifest):
        self.of, self.folder = of, folder_of(of)
        self._path = self.folder / f".p2p-{of.name}.json"
        self._files: dict[str, dict[str, Any]] = {}
        if self._path.is_file():
            self._files = read_json(self._path, _Recorded, "a record of what was fetched").files

    def sha256(self, file: RemoteFile) -> str | None:
        """The checksum that a file must have: the manifest's, else that of the first time."""
        return file.sha256 or self._files.get(file.path, {}).get("sha256")

    def unpacked(self, file: RemoteFile) -> dict[str, int] | None:
        """Files out of an archive and their sizes; None where it was not unpacked."""
        return self._files.get(file.path, {}).get("unpacked")

    def keep(self, file: RemoteFile, digest: str, unpacked: dict[str, int] | None = None) -> None:
        """Write down what a file is like, and what came out of it."""
        known = {"sha256": digest, "bytes": (self.folder / file.path).stat().st_size}
        self._files[file.path] = known if unpacked is None else {**known, "unpacked": unpacked}
        replace_text(self._path, json.dumps({"files": self._files}, indent=1) + "\n")


# --- fetching --------------------------------------------------------------------------------------


def fetch(
    of: Manifest, only: tuple[str, ...] = (), progress: bool = True, source: str | Path | None = None
) -> Iterator[str]:
    """Download, check, record and unpack the files of a manifest; yields a line about each as it is done.

    only    parts of file names; by default all files
    source  one of the files, or a folder or an archive with them by their names: nothing is downloaded then

    An archive that lies in its place already, had by hand, is recorded and unpacked just so. Raises
    :class:`MissingData` with what to do where something must be requested by hand.
    """
    chosen = [file for file in of.files if not only or any(part in file.path for part in only)]
    if only and not chosen:
        raise BadInput("--only", ",".join(only), "part of one of " + ", ".join(file.path for file in of.files))
    record, by_hand = _Record(of), []
    if source is not None:
        _take(chosen, record, Path(source).expanduser())
    for file in chosen:
        here = (record.folder / file.path).is_file()
        if record.unpacked(file) and not here:
            yield f"{file.path}: unpacked already"
        elif file.url is None and not here:
            by_hand.append(file.path)
        else:
            yield _fetch_one(file, record, progress)
    if by_hand or not of.files:
        listed = f"{', '.join(by_hand)} must be had by hand and put into {record.folder}"
        raise MissingData(of.name, listed if by_hand else "must be had by hand", f"{of.how_to_get} Page: {of.page}")


def _take(files: list[RemoteFile], record: _Record, source: Path) -> None:
    """Copy files from where the user has them to their places, if they are those that the manifest means."""
    wanted = {PurePosixPath(file.path).name: file for file in files}
    record.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=record.folder, prefix=".p2p-") as unpacked:
        if source.is_file() and source.name not in wanted:
            unpack(source, unpacked, only=wanted)
        looked_in = Path(unpacked) if source.is_file() and source.name not in wanted else source
        found = {path.name: path for path in ([source] if looked_in.is_file() else sorted(looked_in.rglob("*")))}
        for name, file in wanted.items():
            if name not in found or not found[name].is_file():
                fix = f"See p2p data info {record.of.name} for where it is published."
                raise MissingData(str(source), f"no file {name} in it", fix)
            expected = record.sha256(file)
            if expected not in (None, digest := sha256(found[name])):
                raise BadInput(str(source), f"{name} of sha256 {digest}", f"sha256 {expected}", "It was not taken.")
            target = record.folder / file.path
            target.parent.mkdir(parents=True, exist_ok=True)
            part = target.with_name(f".{target.name}.part")
            shutil.copyfile(found[name], part)
            os.replace(part, target)


def _fetch_one(file: RemoteFile, record: _Record, progress: bool) -> str:
    path, expected = record.folder / file.path, record.sha256(file)
    digest = sha256(path) if file.url is None else download(file, record.folder, expected, progress)
    if expected not in (None, digest):
        raise BadInput(str(path), f"sha256 {digest}", f"sha256 {expected}")
    unpacked = record.unpacked(file)
    record.keep(file, digest, unpacked)
    unknown = f"no checksum is published: sha256 {digest} is what came, and is checked from now on"
    state = "checked" if expected else unknown
    if file.unpack_to is not None and unpacked is None:
        into = record.folder / file.unpack_to
        with progress_bar(f"unpacking {file.path}", unit="B", unit_scale=True, shown=progress) as bar:
            unpacked = unpack(path, into, bar.update)
        record.keep(file, digest, unpacked)
        state += f", {len(unpacked)} files unpacked into {into}"
    return f"{file.path}: {tqdm.format_sizeof(path.stat().st_size, 'B')}, {state}"


def require(of: Manifest) -> list[Path]:
    """The files of a manifest in their places, each with the sha256 that it must have.

    A file that was put there by hand and whose checksum nobody knows is recorded: it holds from then on.
    Raises :class:`MissingData` with the command that fetches it, :class:`BadInput` for a file that differs.
    """
    record = _Record(of)
    for file in of.files:
        path = record.folder / file.path
        if not path.is_file():
            raise MissingData(of.name, f"{path} is not there", f"Run: p2p data fetch {of.name}")
        digest, expected = sha256(path), record.sha256(file)
        if expected is None:
            record.keep(file, digest)
        elif digest != expected:
            fix = f"Delete it and run: p2p data fetch {of.name}"
            raise BadInput(str(path), f"sha256 {digest}", f"sha256 {expected}", fix)
    return [record.folder / file.path for file in of.files]


# --- verifying -------------------------------------------------------------------------------------


def verify(of: Manifest, every_frame: bool = False) -> Iterator[Finding]:
    """Look at what is on disk: files against checksums, unpacked files, every sequence opened and its truth read.

    every_frame  read all images of every sequence, else the first and the last
    """
    folder = folder_of(of)
    if not folder.is_dir():
        yield Finding.whether(False, str(folder), "not there", f"Next: p2p data info {of.name}")
        return
    record = _Record(of)
    for file in of.files:
        yield _verify_file(file, record)
    if (folder / "sequences.json").is_file():
        yield _verify_listed(folder / "sequences.json")
    if of.format:
        yield from _verify_sequences(of, folder / of.sequences_in, every_frame)


def _verify_file(file: RemoteFile, record: _Record) -> Finding:
    path, expected, unpacked = record.folder / file.path, record.sha256(file), record.unpacked(file)
    if path.is_file():
        digest = sha256(path)
        if expected is None:
            return Finding.whether(True, file.path, f"there, nothing to compare with; sha256 {digest}")
        text = "sha256 as expected" if digest == expected else f"sha256 {digest}"
        return Finding.whether(digest == expected, file.path, text)
    if unpacked is None:
        return Finding.whether(False, file.path, "not there")
    into = record.folder / (file.unpack_to or ".")
    gone = [n for n, size in unpacked.items() if not ((into / n).is_file() and (into / n).stat().st_size == size)]
    text = f"{len(gone)} unpacked files are missing or changed, {gone[0]} first" if gone else "unpacked, all there"
    return Finding.whether(not gone, file.path, text)


def _verify_listed(path: Path) -> Finding:
    """The checksums that a dataset's own ``sequences.json`` lists, of those files that are there."""
    listed: dict[str, str] = {}

    def note(found: dict[str, Any]) -> dict[str, Any]:
        name = next((found[key] for key in ("path", "file", "archive", "filename") if key in found), None)
        if isinstance(found.get("sha256"), str) and isinstance(name, str):
            listed[name] = found["sha256"].lower()
        return found

    try:
        json.loads(read_text(path, "checksums"), object_hook=note)
    except (ValueError, RecursionError) as error:
        return Finding.whether(False, path.name, f"unreadable ({error})")
    here = [name for name in listed if (path.parent / name).is_file()]
    wrong = [name for name in here if sha256(path.parent / name) != listed[name]]
    text = f"{len(here)} of the {len(listed)} files it lists are here"
    return Finding.whether(not wrong, path.name, f"{text}, wrong: {', '.join(wrong)}" if wrong else text)


def _verify_sequences(of: Manifest, folder: Path, every_frame: bool) -> Iterator[Finding]:
    frames = {entry.name: entry.frames for entry in of.sequences}
    found = sorted(path.parent.name for path in folder.glob("*/rgb") if path.is_dir())
    for name in dict.fromkeys([*frames, *found]):
        try:
            yield _verify_sequence(folder / name, of.format, frames.get(name), every_frame)
        except P2PError as error:
            yield Finding.whether(False, name, str(error))


def _verify_sequence(folder: Path, format: str | None, frames: int | None, every_frame: bool) -> Finding:
    sequence = open_sequence(folder, format)
    for i in range(len(sequence)) if every_frame else {0, len(sequence) - 1}:
        sequence.frame(i)
        sequence.masks(i)
    truth = {obj: int((t.T_cam_model == t.T_cam_model).all((1, 2)).sum()) for obj, t in sequence.truth.items()}
    text = f"{len(sequence)} frames, truth " + (", ".join(f"{o} in {n}" for o, n in truth.items()) or "none")
    complete = frames in (None, len(sequence))
    return Finding.whether(complete, folder.name, text if complete else f"{text}, expected {frames} frames")


# --- describing ------------------------------------------------------------------------------------


def where(name: str) -> Path:
    """The folder of a dataset, checkpoint or sequence; :class:`MissingData` where it is not there."""
    if name in names():
        folder = folder_of(manifest(name))
        if not folder.is_dir():
            raise MissingData(name, f"not there, expected in {folder}", f"Next: p2p data info {name}")
        return folder
    found = find_sequence(name)
    if found is None:
        fix = "Known: " + ", ".join(names())
        raise MissingData(name, "no such dataset, checkpoint, or sequence below $P2P_DATA", fix)
    return found[0]


def overview() -> str:
    """A table of all manifests: name, kind, whether it is here, how it is had, title."""
    from pandas import DataFrame

    root = paths.data_dir()
    rows = []
    for of in map(manifest, names()):
        # A download that broke off leaves only hidden files.
        here = "?" if root is None else "yes" if any(p.is_file() for p in folder_of(of).rglob("[!.]*")) else "no"
        rows.append((of.name, of.kind, here, of.access, of.title))
    table = as_text(DataFrame(rows, columns=["name", "kind", "here", "access", "what"]))
    return f"{table}\n" + (f"In {root}" if root else "$P2P_DATA is not set: it says in which folder datasets live.")


def describe(of: Manifest) -> str:
    """All that its manifest says, for people."""
    place = f"$P2P_DATA/{of.folder}" if paths.data_dir() is None else str(folder_of(of))
    how = f"p2p data fetch {of.name}." if of.access == "open" else "By hand."
    lines = [f"{of.title} ({of.name}, version {of.version})", f"licence   {of.licence}", f"page      {of.page}"]
    lines += [f"place     {place}", f"get it    {how} {of.how_to_get}"]
    lines += [f"used by   {of.used_by}"] if of.used_by else []
    lines += [f"unit      {what}: {unit}" for what, unit in of.units.items()]
    lines += [f"layout    {line}" for line in of.layout]
    for file in of.files:
        size = tqdm.format_sizeof(file.bytes, "B") if file.bytes else "size unknown"
        checksum = f"sha256 {file.sha256}" if file.sha256 else file.unknown
        lines.append(f"file      {file.path}, {size}, {checksum}")
    lines += [f"files     {of.files_unknown}"] if of.files_unknown else []
    for entry in of.sequences:
        known = [f"{entry.frames} frames" if entry.frames else "", f"paper: {entry.paper}" if entry.paper else ""]
        lines.append(f"sequence  {', '.join([entry.name, *filter(None, known)])}")
    return "\n".join([*lines, f"cite      {of.citation}"])
