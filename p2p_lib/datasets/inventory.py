"""What of the datasets and checkpoints is on this machine: fetched, recorded, verified, described.

Nothing is downloaded but by :func:`fetch`. What was fetched, or found in its place and unpacked, is recorded in
``.p2p-NAME.json`` of its folder: checksums that the manifest does not know hold from the first time on.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput, MissingData, P2PError
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.archives import unpack
from p2p_lib.datasets.download import download, sha256
from p2p_lib.datasets.manifests import Manifest, RemoteFile, find_sequence, folder_of, manifest, names
from p2p_lib.datasets.sequence import open_sequence


@dataclass(frozen=True)
class Check:
    """One thing that was looked at; ``text`` says what was found."""

    what: str
    ok: bool
    text: str


# --- fetching --------------------------------------------------------------------------------------


def fetch(of: Manifest, only: tuple[str, ...] = (), progress: bool = True) -> Iterator[str]:
    """Download, check, record and unpack the files of a manifest; yields a line about each as it is done.

    only  parts of file names; by default all files

    An archive that lies in its place already, had by hand, is recorded and unpacked just so. Raises
    :class:`MissingData` with what to do where something must be requested by hand.
    """
    folder = folder_of(of)
    chosen = [file for file in of.files if not only or any(part in file.path for part in only)]
    if only and not chosen:
        raise BadInput("--only", ",".join(only), "part of one of " + ", ".join(file.path for file in of.files))
    record, by_hand = _read_record(folder, of), []
    for file in chosen:
        known = record.get(file.path, {})
        if known.get("unpacked") and not (folder / file.path).is_file():
            yield f"{file.path}: unpacked already"
        elif file.url is None and not (folder / file.path).is_file():
            by_hand.append(file.path)
        else:
            yield _fetch_one(of, file, folder, record, progress)
    if by_hand or not of.files:
        what = f"{', '.join(by_hand)} must be had by hand and put into {folder}" if by_hand else "must be had by hand"
        raise MissingData(of.name, what, f"{of.how_to_get} Page: {of.page}")


def _fetch_one(of: Manifest, file: RemoteFile, folder: Path, record: dict, progress: bool) -> str:
    known = record.get(file.path, {})
    expected = file.sha256 or known.get("sha256")
    if file.url is None:
        digest = sha256(folder / file.path)
        if expected not in (None, digest):
            raise BadInput(str(folder / file.path), f"sha256 {digest}", f"sha256 {expected}")
    else:
        digest = download(file, folder, expected, progress)
    new = known.get("sha256") != digest
    size = (folder / file.path).stat().st_size
    record[file.path] = {**({} if new else known), "sha256": digest, "bytes": size}
    _write_record(folder, of, record)
    said = "checked" if expected else "its checksum is recorded"
    if file.unpack_to is not None and "unpacked" not in record[file.path]:
        into = folder / file.unpack_to
        with progress_bar(f"unpacking {file.path}", unit="B", unit_scale=True, shown=progress) as bar:
            written = unpack(folder / file.path, into, bar.update)
        record[file.path]["unpacked"] = written
        _write_record(folder, of, record)
        said += f", {len(written)} files unpacked into {into}"
    return f"{file.path}: {human_size(size)}, {said}"


def require(of: Manifest) -> list[Path]:
    """The files of a manifest in their places, each with the sha256 that it must have.

    A file that was put there by hand and whose checksum nobody knows is recorded: it holds from then on.
    Raises :class:`MissingData` with the command that fetches it, :class:`BadInput` for a file that differs.
    """
    folder = folder_of(of)
    record = _read_record(folder, of)
    for file in of.files:
        path = folder / file.path
        if not path.is_file():
            raise MissingData(of.name, f"{path} is not there", f"Run: p2p data fetch {of.name}")
        digest, expected = sha256(path), file.sha256 or record.get(file.path, {}).get("sha256")
        if expected is None:
            record[file.path] = {"sha256": digest, "bytes": path.stat().st_size}
            _write_record(folder, of, record)
        elif digest != expected:
            fix = f"Delete it and run: p2p data fetch {of.name}"
            raise BadInput(str(path), f"sha256 {digest}", f"sha256 {expected}", fix)
    return [folder / file.path for file in of.files]


def _record_file(folder: Path, of: Manifest) -> Path:
    return folder / f".p2p-{of.name}.json"


def _read_record(folder: Path, of: Manifest) -> dict[str, dict[str, Any]]:
    path = _record_file(folder, of)
    try:
        return json.loads(path.read_text())["files"]
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError) as error:
        fix = "Delete it; files are then checked against the manifest alone."
        raise BadInput(str(path), f"unreadable ({error})", "a record of what was fetched", fix) from None


def _write_record(folder: Path, of: Manifest, record: dict) -> None:
    path = _record_file(folder, of)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps({"files": record}, indent=1) + "\n")
    os.replace(partial, path)


# --- verifying -------------------------------------------------------------------------------------


def verify(of: Manifest, every_frame: bool = False) -> Iterator[Check]:
    """Look at what is on disk: files against checksums, unpacked files, every sequence opened and its truth read.

    every_frame  read all images of every sequence, else the first and the last
    """
    folder = folder_of(of)
    if not folder.is_dir():
        yield Check(str(folder), False, f"not there. Next: p2p data info {of.name}")
        return
    record = _read_record(folder, of)
    for file in of.files:
        yield _verify_file(file, folder, record.get(file.path, {}))
    yield from _verify_listed(folder / "sequences.json")
    if of.format:
        yield from _verify_sequences(of, folder / of.sequences_in, every_frame)


def _verify_file(file: RemoteFile, folder: Path, known: dict) -> Check:
    path, expected = folder / file.path, file.sha256 or known.get("sha256")
    if not path.is_file():
        into = folder / (file.unpack_to or ".")
        gone = [name for name, size in known.get("unpacked", {}).items() if not _has_size(into / name, size)]
        if "unpacked" not in known:
            return Check(file.path, False, "not there")
        text = f"{len(gone)} unpacked files are missing or changed, {gone[0]} first" if gone else "unpacked, all there"
        return Check(file.path, not gone, text)
    digest = sha256(path)
    if expected is None:
        return Check(file.path, True, f"there, nothing to compare with; sha256 {digest}")
    return Check(file.path, digest == expected, "sha256 as expected" if digest == expected else f"sha256 {digest}")


def _has_size(path: Path, size: int) -> bool:
    return path.is_file() and path.stat().st_size == size


def _verify_listed(path: Path) -> Iterator[Check]:
    """The checksums that a dataset's own ``sequences.json`` lists, of those files that are there."""
    if not path.is_file():
        return
    try:
        listed = dict(_checksums(json.loads(path.read_text())))
    except ValueError as error:
        yield Check(path.name, False, f"unreadable ({error})")
        return
    here = {name: digest for name, digest in listed.items() if (path.parent / name).is_file()}
    wrong = [name for name, digest in here.items() if sha256(path.parent / name) != digest.lower()]
    text = f"{len(here)} of the {len(listed)} files it lists are here" + (
        f", wrong: {', '.join(wrong)}" if wrong else ""
    )
    yield Check(path.name, not wrong, text)


def _checksums(found: Any) -> Iterator[tuple[str, str]]:
    """(file, sha256) wherever an object has ``sha256`` beside the name of a file."""
    if isinstance(found, list):
        for item in found:
            yield from _checksums(item)
    elif isinstance(found, dict):
        name = next((found[key] for key in ("path", "file", "archive", "filename") if key in found), None)
        if isinstance(found.get("sha256"), str) and isinstance(name, str):
            yield name, found["sha256"]
        for item in found.values():
            yield from _checksums(item)


def _verify_sequences(of: Manifest, folder: Path, every_frame: bool) -> Iterator[Check]:
    frames = {entry.name: entry.frames for entry in of.sequences}
    found = sorted(path.parent.name for path in folder.glob("*/rgb") if path.is_dir())
    for name in [*frames, *(name for name in found if name not in frames)]:
        if name not in found:
            yield Check(name, False, "sequence not there")
            continue
        try:
            yield _verify_sequence(folder / name, of.format, frames.get(name), every_frame)
        except P2PError as error:
            yield Check(name, False, str(error))


def _verify_sequence(folder: Path, format: str | None, frames: int | None, every_frame: bool) -> Check:
    sequence = open_sequence(folder, format)
    for i in range(len(sequence)) if every_frame else {0, len(sequence) - 1}:
        sequence.frame(i)
        sequence.masks(i)
    truth = {obj: int((t.T_cam_model == t.T_cam_model).all((1, 2)).sum()) for obj, t in sequence.truth.items()}
    text = f"{len(sequence)} frames, truth " + (", ".join(f"{o} in {n}" for o, n in truth.items()) or "none")
    if frames is not None and frames != len(sequence):
        return Check(folder.name, False, f"{text}, expected {frames} frames")
    return Check(folder.name, True, text)


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
    rows = [("name", "kind", "here", "access", "what")]
    for of in map(manifest, names()):
        here = "?" if paths.data_dir() is None else "yes" if _holds_files(folder_of(of)) else "no"
        rows.append((of.name, of.kind, here, of.access, of.title))
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ["  ".join([*(cell.ljust(width) for cell, width in zip(row, widths)), row[4]]) for row in rows]
    root = paths.data_dir()
    lines.append(f"In {root}" if root else "$P2P_DATA is not set: it says in which folder datasets live.")
    return "\n".join(lines)


def _holds_files(folder: Path) -> bool:
    """Whether anything lies there; a download that broke off leaves only hidden files."""
    return any(path.is_file() and not path.name.startswith(".") for path in folder.rglob("*"))


def describe(of: Manifest) -> str:
    """All that its manifest says, for people."""
    place = f"$P2P_DATA/{of.folder}" if paths.data_dir() is None else str(folder_of(of))
    lines = [f"{of.title} ({of.name}, version {of.version})", f"licence   {of.licence}", f"page      {of.page}"]
    lines += [f"place     {place}", f"get it    {_access(of)} {of.how_to_get}"]
    lines += [f"used by   {of.used_by}"] if of.used_by else []
    lines += [f"unit      {what}: {unit}" for what, unit in of.units.items()]
    lines += [f"layout    {line}" for line in of.layout]
    for file in of.files:
        checksum = f"sha256 {file.sha256}" if file.sha256 else file.unknown
        lines.append(f"file      {file.path}, {human_size(file.bytes)}, {checksum}")
    lines += [f"files     {of.files_unknown}"] if of.files_unknown else []
    for entry in of.sequences:
        known = [f"{entry.frames} frames" if entry.frames else "", f"paper: {entry.paper}" if entry.paper else ""]
        lines.append(f"sequence  {', '.join([entry.name, *filter(None, known)])}")
    return "\n".join([*lines, f"cite      {of.citation}"])


def _access(of: Manifest) -> str:
    return f"p2p data fetch {of.name}." if of.access == "open" else "By hand."


def human_size(count: int | None) -> str:
    """``1.2 GB``; "size unknown" of None."""
    if count is None:
        return "size unknown"
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} bytes"
