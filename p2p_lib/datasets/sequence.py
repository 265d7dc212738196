"""RGB-D sequences: the protocol that every layout fulfils, and :func:`open_sequence`, which opens any of them.

A layout is one module with ``load(folder, masks)``, and one line in :data:`FORMATS`. One of somebody else is a function
``load(folder, masks)``, named as ``package.module:load`` or offered as an entry point (:mod:`p2p_lib.core.plugins`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from traceback import walk_tb
from typing import Any, Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData, P2PError, doubt, in_a_line
from p2p_lib.core.paths import data_dir
from p2p_lib.core.plugins import find, loaded
from p2p_lib.core.types import Frame
from p2p_lib.datasets.images import called_otherwise, gaps_allowed
from p2p_lib.datasets.numbering import VIDEOS
from p2p_lib.datasets.truth import ObjectTruth, checked_truth

#: Layouts, each by the name of its module: what a folder of it holds, in the order in which they are tried.
FORMATS: dict[str, tuple[str, ...]] = {
    "ho3d": ("meta/*.pkl",),
    "bop": ("scene_camera.json",),
    "tum": ("rgb.txt",),
    "ycbmultitrack": ("annotated_poses/*/",),
    "ycbineoat": ("gt_mask/", "annotated_poses/*.txt"),
    "open3d": ("color/",),
    "folder": ("rgb/",),
}
#: Of these a folder shows no more than where its colour images are: layouts of others are tried before them.
_PLAIN = ("open3d", "folder")

#: Layouts that keep their truth in ``annotated_poses/``; a plain folder that has one is recognised as another of them.
_ANNOTATED = ("ycbmultitrack", "ycbineoat", "folder")

#: What a file is that may be given where a folder is meant.
RECORDINGS = {
    ".bag": "a recording of ROS 1 or a RealSense",
    ".db3": "a recording of ROS 2 or a RealSense",
    ".mcap": "a recording of ROS 2",
    ".mkv": "a recording of an Azure Kinect",
}

#: What a run's ``format`` is where its images came from a camera and were not kept.
LIVE = "live"
#: Sequences that are generated rather than read are called ``synthetic/NAME``.
SYNTHETIC = "synthetic/"
#: Renders those; imported when one is asked for.
_GENERATOR = "p2p_lib.synthetic"


class Sequence(Protocol):
    """RGB-D frames of one video, with masks and truth where the dataset has them."""

    @property
    def name(self) -> str:
        """What results call it."""

    @property
    def format(self) -> str:
        """The name of its layout."""

    @property
    def path(self) -> Path | None:
        """Its folder; None where it has none."""

    @property
    def camera(self) -> Camera:
        """The camera that all frames are of."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects it knows; a single unnamed one is called ``object``."""

    @property
    def times_s(self) -> np.ndarray:
        """(N,) seconds, increasing."""

    @property
    def frame_names(self) -> tuple[str, ...]:
        """What each frame's image is called, without its ending."""

    @property
    def truth(self) -> dict[str, ObjectTruth]:
        """Object to its truth, empty where there is none; read when first asked for."""

    @property
    def model_places(self) -> Mapping[str, tuple[Path, ...]]:
        """Object to the files and folders where its model may lie, best first."""

    def __len__(self) -> int: ...

    def frame(self, i: int) -> Frame:
        """The i-th frame, read now; :class:`BadInput` or :class:`MissingData` names a file that is wrong."""

    def masks(self, i: int) -> dict[str, np.ndarray] | None:
        """Object to (H, W) bool at frame i; None where the sequence has no masks (or none for this frame)."""

    def visible_px(self, i: int) -> dict[str, int] | None:
        """Object to the size of its visible mask at frame i, by the dataset's OWN masks whatever ``masks`` gives.

        Scoring uses this, so that the same frames count for every source of masks.
        """


def open_sequence(
    path_or_name: str | Path | Sequence,
    format: str | None = None,
    depth_scale: float | None = None,
    seed: int | None = None,
    masks: str | Path | None = None,
    gaps: bool = False,
    progress: bool = True,
) -> Sequence:
    """A sequence from a folder, a bundled one, or one below ``$P2P_DATA`` by its name alone.

    Bundled are ``synthetic/NAME`` and, drawn by another seed, ``synthetic/NAME@SEED``.
    One that is open already is given back as it is.

    Datasets are known by their manifests: ``mustard0``, or ``ycbineoat/mustard0`` where two datasets have one; any
    other folder by its path below ``$P2P_DATA``.

    format       one of :data:`FORMATS`, or somebody else's; by default the layout is recognised
    depth_scale  metres per raw unit of the depth images (default: the layout's, mostly 0.001 for millimetres)
    seed         of a synthetic scene whose name has none (default 0)
    masks        another folder of masks (a name inside the sequence, or a path); by default the dataset's own
    gaps         depth images may be missing: their frames cannot be read, all others can
    progress     a terminal shows how far a synthetic scene is that has to be rendered first

    Raises :class:`MissingData` where files are not there and :class:`BadInput` where they do not fit.
    """
    if not isinstance(path_or_name, str | Path):
        return path_or_name
    from p2p_lib.datasets.image_sequence import ImageSequence

    if depth_scale is not None and not 0 < depth_scale <= 1:
        fix = "Millimetres are 0.001, metres are 1."
        raise BadInput("depth_scale", depth_scale, "metres per raw unit, above 0 and at most 1", fix)
    read_folder = None if format is None else _loader(format)
    name = str(path_or_name)
    if name.startswith(SYNTHETIC):
        render = import_module(_GENERATOR).scenario_dir
        scenario, seed = _scene(name, seed)
        folder, format = render(scenario, seed, progress=progress), format or "ycbmultitrack"
    else:
        seed = None
        folder, format = _find(path_or_name, format)
        name = os.path.basename(os.path.abspath(folder))
    format = format or recognise(folder)
    with gaps_allowed(gaps), _named(format):
        read = (read_folder or _loader(format))(folder, masks)
        if not isinstance(read, ImageSequence):
            what = f"format {format}: what load(folder, masks) gives"
            raise BadInput(what, type(read).__name__, "an ImageSequence, see CONTRIBUTING.md")
        read.check_camera()
    found = replace(read, name=name, format=format, depth_scale=depth_scale or read.depth_scale, scene_seed=seed)
    return replace(found, read_truth=partial(_read_truth, found, found.read_truth))


@contextmanager
def _named(format: str) -> Iterator[None]:
    """What goes wrong in a layout of somebody else's is said with its name; ours say themselves what is wrong."""
    try:
        yield
    except Exception as error:
        if format in FORMATS or isinstance(error, P2PError):
            raise
        what, got = f"format {format}", f"{type(error).__name__}: {in_a_line(error)}"
        frames = [(str(f.f_globals.get("__name__")), f.f_code, line) for f, line in walk_tb(error.__traceback__)]
        ran = [(module.partition(".")[0], code, line) for module, code, line in frames]
        package = next((of for of, _, _ in ran if of not in ("p2p_lib", "contextlib")), None)
        if theirs := [(code, line) for of, code, line in ran if of == package]:
            got += f" in {theirs[0][0].co_qualname} ({theirs[-1][0].co_filename}:{theirs[-1][1]})"
        if isinstance(error, OSError):
            raise MissingData(what, f"its loader could not read a file, {got}") from error
        fix = "--debug shows the traceback."
        raise BadInput(what, got, "a loader that ends without an error", fix) from error


def _read_truth(sequence: Sequence, read: Callable[[], Any]) -> dict[str, ObjectTruth]:
    """What a layout's ``read_truth`` gives, checked."""
    with _named(sequence.format):
        given = read()
    return checked_truth(given, f"(format {sequence.format})", sequence.camera, len(sequence))


def no_truth_said(sequence: Sequence) -> str:
    """Where the truth of a sequence that has none was looked for, in brackets; empty where its layout has no place."""
    if sequence.format in _ANNOTATED:
        return " (looked for in annotated_poses/ of a folder)"
    return "" if sequence.format in FORMATS else " (its loader gives none, see CONTRIBUTING.md)"


def _scene(name: str, seed: int | None) -> tuple[str, int]:
    """The scenario and the seed of a synthetic scene's name; ``seed`` where that has none."""
    scenario, named, number = name.removeprefix(SYNTHETIC).partition("@")
    if named and not number.isdecimal():
        raise BadInput(name, f"the seed {number!r}", f"{SYNTHETIC}{scenario}@SEED, a whole number from 0")
    return scenario, int(number) if named else seed or 0


def reopen(info: Mapping[str, Any]) -> Sequence:
    """The sequence that a run was made on, as its ``run.json`` says; raises as :func:`open_sequence`.

    Warns where its camera is another one since: poses and meshes are of the camera that the run was made with.
    """
    if info["format"] == LIVE:
        fix = "To have them afterwards, record them as a folder and give that to p2p run."
        raise MissingData(f"images of {info['sequence']}", "it was a live camera's, of which none are kept", fix)
    asked = info.get("options") or {}
    depth_scale, gaps = asked.get("depth_scale"), bool(asked.get("skip_bad"))
    seed = info["seed"] if info.get("scene_seed") is None else info["scene_seed"]  # of older runs both are the same
    found = open_sequence(info["path"] or info["sequence"], info["format"], depth_scale, seed, gaps=gaps)
    check_images(info, found)
    was, now = (info.get("camera"), asdict(found.camera))
    if was is not None and was != now:
        k = next((key for key in now if was.get(key) != now[key]), "fx")
        fix = "Its poses and meshes are of the camera that it had: run it again, or give it that camera back."
        doubt(f"camera of {found.name}", f"{k} = {now[k]:g}, and {was.get(k)} when the run was made", fix)
    return found


def reopen_if_there(info: Mapping[str, Any]) -> tuple[Sequence | None, str]:
    """As :func:`reopen`, or None and why; :class:`OtherImages` is raised, for they would tell of another video."""
    try:
        return reopen(info), ""
    except OtherImages:
        raise
    except P2PError as error:
        return None, str(error)


class OtherImages(BadInput):
    """Images that are not those that a run was made on."""


def first_image(sequence: Sequence, start: int) -> str | None:
    """What tells the images at frame ``start`` from others, for ``run.json``; None where no files are known."""
    digest = getattr(sequence, "digest", None)
    return digest(start) if digest is not None else None


def check_images(info: Mapping[str, Any], sequence: Sequence) -> None:
    """:class:`OtherImages` where a sequence does not hold what the run was made on that ``run.json`` tells of."""
    was, start = info.get("first_image"), info.get("start") or 0
    now = first_image(sequence, start) if was and start < len(sequence) else None
    if now and now != was:
        what, got = f"{sequence.path}: images of frame {start}", f"others ({sequence.frame_names[start]}, sha256 {now})"
        fix = "Put those back, or run it anew on these: p2p run."
        raise OtherImages(what, got, f"those that the run of {info['sequence']} was made on (sha256 {was})", fix)


def _find(path_or_name: str | Path, format: str | None) -> tuple[Path, str | None]:
    """An existing folder, and the layout where its dataset's manifest says it."""
    folder = Path(path_or_name).expanduser()
    if folder.is_file() or is_recording(folder):
        raise _not_a_folder(folder)
    if folder.is_dir():
        return folder, format
    from p2p_lib.datasets.manifests import find_sequence, names

    name = str(path_or_name)
    if found := find_sequence(name):
        return found[0], format or found[1].format
    home = data_dir()
    if home is not None and (home / folder).is_dir():
        return home / folder, format
    dataset = name.partition("/")[0]
    if dataset in names("dataset"):
        where = "not below $P2P_DATA" + ", which is not set" * (home is None)
        raise MissingData(name, where, f"See p2p data info {dataset}.")
    fix = f"Give a folder, a bundled sequence such as {SYNTHETIC}crossing, or one of `p2p data list`."
    where = "$P2P_DATA is not set" if home is None else f"no sequence of this name below {home}"
    what = "file" if folder.suffix else "folder"
    raise MissingData(name, f"no such {what}, and {where}", fix)


def is_recording(path: Path) -> bool:
    """Whether ``p2p convert`` makes a folder of it: a file of :data:`RECORDINGS`, or a ROS 2 recording's folder."""
    return path.suffix.lower() in RECORDINGS if path.is_file() else (path / "metadata.yaml").is_file()


def _not_a_folder(path: Path) -> BadInput:
    """What a file is that was given where a folder is meant, and what to do with it."""
    suffix = path.suffix.lower()
    if is_recording(path):
        fix = f"Make a folder of it: p2p convert {path} --out FOLDER"
        return BadInput(str(path), RECORDINGS.get(suffix, "a recording of ROS 2"), "a folder of images", fix)
    if suffix in VIDEOS:
        fix = "Record with a depth camera; a depth image for each colour image goes into depth/, cam_K.txt beside it."
        return BadInput(str(path), "a video of colour alone", "colour and depth", f"Its depth is missing. {fix}")
    return BadInput(str(path), "a file", "a folder with rgb/, depth/ and cam_K.txt", "Give the folder that it is in.")


def recognise(folder: Path) -> str:
    """The name of a folder's layout; :class:`BadInput` where no layout fits."""
    if layout := _layout(folder):
        return layout
    holds = ", ".join(sorted(p.name + "/" * p.is_dir() for p in folder.iterdir())[:8]) or "nothing"
    parts = [folder / part for part in ("rgb", "depth")]
    renamed = [fix for part in parts if not part.is_dir() and (fix := called_otherwise(part))]
    own = not parts[0].is_dir() and (parts[1].is_dir() or (folder / "cam_K.txt").is_file())
    if own or len(renamed) == len(parts):
        fix = " ".join(renamed) or "rgb/ is missing: put the colour images there, one for each depth image."
        raise BadInput(str(folder), f"a folder with {holds}", "rgb/, depth/ and cam_K.txt", fix)
    fix = f"Name the layout with --format ({', '.join(FORMATS)})."
    if _layout(folder.parent):
        fix = f"Give the folder that it is in: {folder.parent}"
    elif inside := next((path for path in sorted(folder.iterdir()) if path.is_dir() and _layout(path)), None):
        fix = f"Give a folder that is in it: {inside}"
    expected = "rgb/, depth/ and cam_K.txt (and masks/, annotated_poses/ where there are any)"
    raise BadInput(str(folder), f"a folder with {holds}", expected, fix)


def _layout(folder: Path) -> str | None:
    """By patterns; those of others are tried before the plain ones of ours, which take almost everything."""

    def tried() -> Iterator[tuple[str, tuple[str, ...]]]:
        yield from ((name, patterns) for name, patterns in FORMATS.items() if name not in _PLAIN)
        yield from ((name, getattr(load, "patterns", ())) for name, load in loaded("dataset") if name not in FORMATS)
        yield from ((name, FORMATS[name]) for name in _PLAIN)

    return next((name for name, patterns in tried() if any(next(folder.glob(p), None) for p in patterns)), None)


def _loader(format: str) -> Callable[[Path, str | Path | None], Any]:
    """The function that reads a layout."""
    return find("dataset", format, {name: f"p2p_lib.datasets.{name}:load" for name in FORMATS})
