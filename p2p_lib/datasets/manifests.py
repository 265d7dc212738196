"""What is known of every dataset and checkpoint: ``data_manifests/*.json`` and ``data_manifests/checkpoints/*.json``.

One file each, named by its ``name``. The schema is the classes below: an unknown or missing field, a checksum that
is none, or a null without its reason is an error that names the file and the field.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.schema import Strict, read_json

CHECKPOINTS = "checkpoints"


def _inside(value: str) -> str:
    path = PurePosixPath(value)
    if path.is_absolute() or ".." in path.parts or "\\" in value or not value:
        raise ValueError(f"{value!r} must be a relative path that stays inside")
    return value


Below = Annotated[str, AfterValidator(_inside)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_]*$")]
Text = Annotated[str, Field(min_length=1)]
Url = Annotated[str, Field(pattern=r"^https?://[^\s/]+(/\S*)?$")]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class RemoteFile(Strict):
    """One file as its publisher offers it.

    path       where it lies below the manifest's folder
    url        None: it is had by hand only
    bytes      size, None where unknown; sha256 in hex, None where unknown: it is recorded at the first download
    unknown    why bytes or sha256 is null
    unpack_to  an archive's contents go there, below the manifest's folder; None: it is no archive
    """

    path: Below
    url: Url | None
    bytes: Annotated[int, Field(gt=0)] | None
    sha256: Sha256 | None
    unknown: str = ""
    unpack_to: Below | None = None

    @model_validator(mode="after")
    def _reasons(self) -> RemoteFile:
        if (self.bytes is None or self.sha256 is None) and not self.unknown:
            raise ValueError(f"{self.path}: bytes or sha256 is null, so 'unknown' must say why")
        return self


class SequenceEntry(Strict):
    """One sequence of a dataset.

    frames   None where unknown
    paper    what the paper's tables call it, "" where they do not have it
    objects  object's name in this project to its model, as a folder below the dataset's ``models/``
    """

    name: Text
    frames: Annotated[int, Field(gt=0)] | None = None
    paper: str = ""
    objects: dict[str, str] = {}


class Manifest(Strict):
    """A dataset or a checkpoint.

    licence           in plain words
    page              where it is published, and asked for
    access            "open": every file has a URL; "by hand": the page's owner hands it out
    how_to_get        what has to be done by hand, or what there is to know before fetching
    folder            where it lies below ``$P2P_DATA``
    files_unknown     why there is no list of files
    size              about how large it is, as somebody says who has it; "" where nobody does
    units, layout     what the numbers mean; the folders and files once unpacked
    format            which loader reads its sequences (see :data:`p2p_lib.datasets.sequence.FORMATS`)
    sequences_in      the folder of sequences, below ``folder``
    used_by           of a checkpoint: the option that needs it, such as ``--tracker NAME``
    """

    kind: Literal["dataset", "checkpoint"]
    name: Name
    title: Text
    version: Text
    licence: Text
    page: Url
    access: Literal["open", "by hand"]
    how_to_get: Text
    folder: Below
    files: list[RemoteFile]
    files_unknown: str = ""
    size: str = ""
    units: dict[str, str]
    layout: list[str]
    citation: Text
    format: str | None = None
    sequences_in: Below = "."
    sequences: list[SequenceEntry] = []
    used_by: str = ""

    @model_validator(mode="after")
    def _complete(self) -> Manifest:
        if not self.files and not self.files_unknown:
            raise ValueError("there are no files, so 'files_unknown' must say why")
        if self.access == "open" and (not self.files or any(file.url is None for file in self.files)):
            raise ValueError("access is 'open', so every file needs a url")
        if self.kind == "checkpoint" and not self.used_by:
            raise ValueError("a checkpoint's 'used_by' must name the option that needs it")
        for what, given in (("path", [f.path for f in self.files]), ("sequence", [s.name for s in self.sequences])):
            if len(set(given)) < len(given):
                raise ValueError(f"a {what} is listed twice")
        return self


def names(kind: str | None = None) -> tuple[str, ...]:
    """Names of all manifests, or of those of one kind ("dataset", "checkpoint"), sorted."""
    return tuple(sorted(path.stem for path in _files() if kind in (None, _kind(path))))


def manifest(name: str) -> Manifest:
    """The manifest of this name; :class:`BadInput` names the known ones, or the field that is wrong."""
    found = next((path for path in _files() if path.stem == name), None)
    if found is None:
        raise BadInput("name", repr(name), "one of " + ", ".join(names()))
    return read_manifest(found)


@cache
def read_manifest(path: Path) -> Manifest:
    """One file, checked: it lies and is called as it says."""
    read: Manifest = read_json(path, Manifest, f"a manifest (see {__name__})")
    if (read.name, read.kind) != (path.stem, _kind(path)):
        got = f"the {read.kind} {read.name!r}"
        raise BadInput(str(path), got, f"the {_kind(path)} {path.stem!r}, as the file lies and is called")
    return read


def folder_of(of: Manifest) -> Path:
    """Where it lies on this machine; :class:`MissingData` where ``$P2P_DATA`` is not set."""
    root = paths.data_dir()
    if root is None:
        fix = "Say where datasets live: export P2P_DATA=DIR"
        raise MissingData(of.name, "no folder for datasets, $P2P_DATA is not set", fix)
    return root / of.folder


def find_sequence(name: str) -> tuple[Path, Manifest] | None:
    """The folder of ``SEQUENCE`` or ``DATASET/SEQUENCE`` below ``$P2P_DATA``, and its dataset; None if there is none.

    :class:`BadInput` where several datasets have one of this name.
    """
    if paths.data_dir() is None:
        return None
    dataset, _, sequence = name.rpartition("/")
    found = []
    for of in map(manifest, names("dataset")):
        folder = folder_of(of) / of.sequences_in / sequence
        if of.format and dataset in ("", of.name) and sequence not in ("", ".", "..") and folder.is_dir():
            found.append((folder, of))
    if len(found) > 1:
        raise BadInput("sequence", name, "one of " + ", ".join(f"{of.name}/{sequence}" for _, of in found))
    return found[0] if found else None


def _files() -> list[Path]:
    root = paths.manifest_dir()
    if not root.is_dir():
        raise MissingData(str(root), "no such folder, expected the data manifests", "Install p2p-lib anew.")
    datasets = [path for path in root.glob("*.json") if path.name != paths.PAPER_REPORTED]
    return sorted([*datasets, *(root / CHECKPOINTS).glob("*.json")])


def _kind(path: Path) -> str:
    return "checkpoint" if path.parent.name == CHECKPOINTS else "dataset"
