"""What is known of an object, to take away: a plain value, and one file of it (not in the paper).

A memory is of the object alone. It is metric, so that another camera, another place and another day change nothing of
its poses; only a camera that shows it in far fewer pixels finds it less often (:func:`far_fewer_pixels`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.files import check_arrays, file_name, load_arrays, of_shape, parse_json, read_text, save_arrays
from p2p_lib.core.paths import named_path

#: Of the files that this library writes, and reads.
VERSION = 3
#: Scales and bytes of a landmark's descriptor, as the recogniser makes and compares them.
DESCRIPTOR = (2, 128)
_KIND = "p2p object memory"
_EXPECTED = "a memory as p2p run writes it (maps/OBJECT.npz)"
#: Keyframe poses were rounded to this and more.
_POSE_TOLERANCE = 5e-3
#: What is farther away than a depth camera sees is in other units, m; so are landmarks that are so many times the
#: lattice's longest side away from it (the lattice of a large object ends where its voxels are used up).
_FARTHEST_M, _BESIDE = 100.0, 10
#: Above the weight that is written.
_MOST_WEIGHT = 1e6
#: A camera with less than this share of the focal length, px, shows an object in far fewer pixels.
_FEWER = 0.7


@dataclass(frozen=True, eq=False)
class SurfaceMemory:
    """A fused surface, by the M voxels that were observed (:class:`~p2p_lib.method.tsdf.TsdfVolume`).

    voxel_m        the lattice's step, and tau_m, the distance that a value of 1 stands for; metres
    origin_m       (3,) where the lattice is anchored in the object frame; lo (3,) index of its first voxel
    shape          (3,) voxels
    index          (M,) which voxels, counted in C order, ascending; value (M,) from -1, inside, to 1; weight (M,)
    rgb            (M, 3) uint8, and rgb_weight (M,), 0 where no colour was seen

    Raises :class:`BadInput` for what is no such surface.
    """

    voxel_m: np.ndarray
    tau_m: np.ndarray
    origin_m: np.ndarray
    lo: np.ndarray
    shape: np.ndarray
    index: np.ndarray
    value: np.ndarray
    weight: np.ndarray
    rgb: np.ndarray
    rgb_weight: np.ndarray

    def __post_init__(self) -> None:
        what = "memory surface"
        check_arrays(what, self, "numbers", voxel_m=(), tau_m=(), origin_m=(3,))
        check_arrays(what, self, "whole numbers", lo=(3,), shape=(3,), index=(None,))
        m = len(self.index)
        check_arrays(what, self, "numbers", value=(m,), weight=(m,), rgb_weight=(m,))
        check_arrays(what, self, "bytes", rgb=(m, 3))
        voxels = np.prod(self.shape.astype(float))
        if not (0 < float(self.voxel_m) < 1 and 0 < float(self.tau_m) < 1 and (self.shape > 1).all()):
            got = f"{of_shape(self.shape)} voxels of {self.voxel_m} m, which end {self.tau_m} m from the surface"
            raise BadInput(what, got, "a grid of voxels")
        if voxels >= 1 << 31:
            raise BadInput(what, f"{of_shape(self.shape)} voxels", "as many as a computer holds")
        if np.abs(self.corners_m).max() > _FARTHEST_M:
            raise BadInput(what, f"voxels {np.abs(self.corners_m).max():.3g} m away", "metres, near the object frame")
        index = self.index.astype(np.int64)
        if not m or index.min() < 0 or index.max() >= voxels or (np.diff(index) <= 0).any():
            raise BadInput(f"{what}: index", "none, some twice, or some outside the grid", "voxels of it, ascending")
        for key, (least, most) in {
            "value": (-1, 1),
            "weight": (0, _MOST_WEIGHT),
            "rgb_weight": (0, _MOST_WEIGHT),
        }.items():
            _check_between(f"{what}: {key}", getattr(self, key), least, most)

    @property
    def corners_m(self) -> np.ndarray:
        """(2, 3) the first and the last corner of the lattice in the object frame."""
        lo = self.lo.astype(float)
        return self.origin_m + float(self.voxel_m) * np.stack([lo, lo + self.shape])


@dataclass(frozen=True, eq=False)
class ObjectMemory:
    """An object as it was learnt, in its object frame.

    name         of the object
    p_obj        (N, 3) its landmarks, metres
    descriptors  (N, scales, SIZE) uint8: how each looks on the surface (:data:`DESCRIPTOR`)
    confidence   (N,) of the poses that placed them
    T_cam_obj    (V, 4, 4) poses of its keyframes: from where it was seen
    covariance   (6, 6) of the newest keyframe, right tangent of T_cam_obj
    seen_m2      the most that a keyframe showed of it, across the line of sight
    outline      the share of its outline at which the depth had a step in its keyframes: low for what lies in a
                 surface, as a book in a stack
    surface      with colours
    made_of      where it comes from: plain values, among them the ``camera`` (:func:`camera_words`), and as ``before``
                 a list of the same of the memories that it began with, the oldest first, whose object frame it is in

    There is one covariance, not one a keyframe: that of the map, to which the covariance of a frame is added, is its
    newest keyframe's. How well the older ones were known is in the landmarks, each with the ``confidence`` of the pose
    that placed it; nothing is measured from those keyframes again.

    Raises :class:`BadInput` for what is no such memory, and for one of which too little is known.
    """

    name: str
    p_obj: np.ndarray
    descriptors: np.ndarray
    confidence: np.ndarray
    T_cam_obj: np.ndarray
    covariance: np.ndarray
    seen_m2: np.ndarray
    outline: np.ndarray
    surface: SurfaceMemory
    made_of: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        what = f"memory of {file_name('memory name', self.name)!r}"
        check_arrays(
            what, self, "numbers", p_obj=(None, 3), T_cam_obj=(None, 4, 4), covariance=(6, 6), seen_m2=(), outline=()
        )
        n, v = len(self.p_obj), len(self.T_cam_obj)
        if not n or not v:
            fix = "Learn the object from more or sharper frames, or with more texture."
            got, expected = f"{n} landmarks and {v} keyframes", "an object that can be found again by them"
            raise BadInput(what, got, expected, fix)
        check_arrays(what, self, "bytes", descriptors=(n, *DESCRIPTOR))
        check_arrays(what, self, "numbers", confidence=(n,))
        _check_between(f"{what}: confidence", self.confidence, 0, 1)
        _check_between(f"{what}: seen_m2", self.seen_m2, 0, _FARTHEST_M**2)
        _check_between(f"{what}: outline", self.outline, 0, 1)
        for T in self.T_cam_obj:
            se3.check(f"{what}: T_cam_obj", T, _POSE_TOLERANCE)
        far_m = np.linalg.norm(self.T_cam_obj[:, :3, 3], axis=1).max()
        if far_m > _FARTHEST_M:
            raise BadInput(f"{what}: T_cam_obj", f"a keyframe {far_m:.3g} m away", "metres")
        first, last = self.surface.corners_m
        beside_m = np.maximum(first - self.p_obj, self.p_obj - last).max()
        if beside_m > _BESIDE * (last - first).max():
            raise BadInput(f"{what}: p_obj", f"landmarks {beside_m:.3g} m beside the surface", "metres, on the surface")
        if not _is_covariance(self.covariance):
            raise BadInput(f"{what}: covariance", "no covariance", "a symmetric matrix without negative variances")
        _check_origins(what, self.made_of)


def _check_between(what: str, values: np.ndarray, least: float, most: float) -> None:
    low, high = float(values.min()), float(values.max())
    if low < least or high > most:
        raise BadInput(what, f"{low:g} to {high:g}", f"{least:g} to {most:g}")


def _is_covariance(matrix: np.ndarray) -> bool:
    """Whether it is symmetric and has no negative variance, but for rounding."""
    tolerance = 1e-3 * np.abs(matrix).max()
    symmetric = np.abs(matrix - matrix.T).max() <= tolerance
    return bool(symmetric and np.linalg.eigvalsh((matrix + matrix.T) / 2).min() >= -tolerance)


def _check_origins(what: str, made_of: Mapping[str, Any]) -> None:
    before = made_of.get("before", []) if isinstance(made_of, Mapping) else None
    if not isinstance(before, list) or not all(isinstance(origin, Mapping) for origin in before):
        raise BadInput(f"{what}: made_of", repr(made_of)[:120], "values by name, and before, a list of such")


def camera_words(camera: Camera) -> dict[str, float]:
    """What a memory says of the camera that it was learnt with."""
    return {"fx": camera.fx, "width": camera.width, "height": camera.height}


def far_fewer_pixels(memory: ObjectMemory, camera: Camera) -> str:
    """What there is to say of a camera that shows an object in far fewer pixels than the one it was learnt with did.

    Nothing of any other, and of a memory that does not say with which camera it was learnt.
    """
    origins = [memory.made_of, *memory.made_of.get("before", [])]
    cameras = [of["camera"] for of in origins if isinstance(of.get("camera"), Mapping)]
    focal_px = [fx for of in cameras if isinstance(fx := of.get("fx"), int | float)]
    if not focal_px or camera.fx >= _FEWER * min(focal_px):
        return ""
    return f"learnt with a focal length of {min(focal_px):.0f} px, looked for with {camera.fx:.0f} px"


def save_memory(path: str | Path, memory: ObjectMemory) -> None:
    """Write a memory as one ``.npz`` file of arrays and JSON, whole or not at all."""
    if not isinstance(memory, ObjectMemory):
        raise BadInput("save_memory", type(memory).__name__, "a path and a memory, as tracker.memory(NAME) gives it")
    save_memories(path, {memory.name: memory}, _KIND, {})


def load_memory(path: str | Path) -> ObjectMemory:
    """Read a memory.

    Raises :class:`MissingData` where there is none, :class:`BadInput` for a file that is damaged, cut short, empty, of
    another kind or of another version.
    """
    _, memories = read_memories(path, _KIND, _EXPECTED)
    if len(memories) != 1:
        raise BadInput(str(path), f"{len(memories)} objects", _EXPECTED)
    return next(iter(memories.values()))


def save_memories(path: str | Path, memories: Mapping[str, ObjectMemory], kind: str, about: Mapping[str, Any]) -> None:
    """Write memories with plain values ``about`` them all as one file of this ``kind``, whole or not at all."""
    made_of = {name: dict(memory.made_of) for name, memory in memories.items()}
    head = json.dumps({"kind": kind, "version": VERSION, "objects": made_of, "about": dict(about)})
    arrays = {"about": np.frombuffer(head.encode(), np.uint8)}
    for name, memory in memories.items():
        arrays |= {f"{name}/{f.name}": getattr(memory, f.name) for f in _array_fields(ObjectMemory)}
        arrays |= {f"{name}/surface/{f.name}": getattr(memory.surface, f.name) for f in fields(SurfaceMemory)}
    save_arrays(Path(path), arrays, compressed=True)


def read_memories(path: str | Path, kind: str, expected: str) -> tuple[dict[str, Any], dict[str, ObjectMemory]]:
    """What :func:`save_memories` wrote: ``about``, and object to memory; raises as :func:`load_memory`."""
    path = Path(path)
    if not path.exists():
        raise MissingData(str(path), f"no such file, expected {expected}")
    arrays = load_arrays(path, expected)
    head = arrays.pop("about", np.zeros(0, np.uint8))
    head = parse_json(head.tobytes(), str(path), expected) if head.dtype == np.uint8 and head.size else {}
    if not isinstance(head, dict) or head.get("kind") != kind:
        raise BadInput(str(path), "an archive of something else", expected)
    if head.get("version") != VERSION:
        got, fix = json.dumps(head.get("version"))[:40], "Make it again with this version."
        raise BadInput(str(path), f"version {got}", f"{expected} of version {VERSION}", fix)
    about, objects = head.get("about"), head.get("objects")
    if not isinstance(about, dict) or not isinstance(objects, dict):
        raise BadInput(str(path), "a file that does not say what is in it", expected)
    try:
        return about, {name: _memory(name, of, arrays) for name, of in objects.items()}
    except KeyError as error:
        raise BadInput(str(path), f"a file without {error}", expected) from None
    except BadInput as error:
        raise BadInput(f"{path}: {error.name}", error.got, error.expected, error.fix) from None


def _memory(name: str, made_of: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> ObjectMemory:
    surface = SurfaceMemory(*(arrays[f"{name}/surface/{f.name}"] for f in fields(SurfaceMemory)))
    own = {f.name: arrays[f"{name}/{f.name}"] for f in _array_fields(ObjectMemory)}
    return ObjectMemory(name, **own, surface=surface, made_of=made_of)


def load_memories(paths: Sequence[str | Path]) -> dict[str, ObjectMemory]:
    """Object to its memory, of files and of all those in a run's folder or in its ``maps/``.

    ``NAME=PATH``, of what is no path itself, is the one memory there under another name. Raises as
    :func:`load_memory`, and :class:`BadInput` for two of one name.
    """
    found: dict[str, tuple[Path, ObjectMemory]] = {}
    for path, name in (of for given in paths for of in _named(given)):
        memory = load_memory(path)
        memory = memory if name is None else replace(memory, name=name)
        if memory.name in found:
            got = f"two of {memory.name!r}: {found[memory.name][0]} and {path}"
            fix = f"Give one of them, or one under another name: --memory NAME={path}."
            raise BadInput("memory", got, "one an object", fix)
        found[memory.name] = path, memory
    return {name: memory for name, (_, memory) in found.items()}


def _named(given: str | Path) -> list[tuple[Path, str | None]]:
    """The files that are given as a path or as ``NAME=PATH``, each with its name if it is to have another one."""
    name, path = named_path(given)
    if name is None:
        return [(file, None) for file in _files(Path(path))]
    if not path:
        raise BadInput("memory", repr(given), "NAME=PATH, or a path")
    if len(files := _files(Path(path))) > 1:
        raise BadInput("memory", f"{given}, a folder of {len(files)}", "one for one name", f"Give one: {files[0]}.")
    return [(files[0], file_name("memory name", name))]


def _files(path: Path) -> list[Path]:
    """A file itself; of a folder, the memories in it."""
    if not path.is_dir():
        return [path]
    folder = path / "maps" if (path / "maps").is_dir() else path
    if folder is path and (path / "run.json").is_file():
        raise MissingData(str(path), f"a run without maps, expected {_EXPECTED}", _why_without(path / "run.json"))
    if not (files := sorted(folder.glob("*.npz"))):
        raise MissingData(str(folder), f"no file in it, expected {_EXPECTED}")
    return files


def _why_without(run_json: Path) -> str:
    """Why a run has no maps, and what to do."""
    expected = "what p2p run writes"
    info = parse_json(read_text(run_json, expected), str(run_json), expected)
    if isinstance(info, dict) and info.get("offline"):
        return "An offline pass keeps none: give the run that it was made of."
    why = "No object was learnt well enough in it, or it was cut short before it kept any."
    return f"{why} Learn from more or sharper frames, or go on with it (--resume)."


def _array_fields(kind: type) -> list[Any]:
    return [f for f in fields(kind) if f.name not in ("name", "surface", "made_of")]
