"""What is known of an object, to take away: a plain value, and one file of it (not in the paper).

A memory is of the object alone. It is metric, so that another camera, another place and another day change nothing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.files import check_arrays, file_name, load_arrays, parse_json, save_arrays

#: Of the files that this library writes, and reads.
VERSION = 2
_KIND = "p2p object memory"
_EXPECTED = "a memory as p2p run writes it (maps/OBJECT.npz)"
#: Keyframe poses were rounded to this and more.
_POSE_TOLERANCE = 5e-3


@dataclass(frozen=True, eq=False)
class SurfaceMemory:
    """A fused surface, by the M voxels that were observed (:class:`~p2p_lib.method.tsdf.TsdfVolume`).

    voxel_m        the lattice's step, and tau_m, the distance that a value of 1 stands for; metres
    origin_m       (3,) where the lattice is anchored in the object frame; lo (3,) index of its first voxel
    shape          (3,) voxels
    index          (M,) which voxels, counted in C order; value (M,) from -1, inside, to 1; weight (M,)
    rgb            (M, 3) uint8, and rgb_weight (M,), 0 where no colour was seen
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
        m = len(self.index)
        single = {"voxel_m": (), "tau_m": (), "origin_m": (3,), "lo": (3,), "shape": (3,)}
        of_each = {"value": (m,), "weight": (m,), "rgb": (m, 3), "rgb_weight": (m,)}
        check_arrays("memory surface", self, single | of_each, finite=True)
        voxels = np.prod(self.shape.astype(float))
        if not (0 < float(self.voxel_m) < 1 and float(self.tau_m) > 0 and (self.shape > 1).all() and voxels < 1 << 31):
            raise BadInput("memory surface", f"{self.shape} voxels of {self.voxel_m} m", "a grid of voxels")
        if not m or self.index.min() < 0 or self.index.max() >= voxels:
            raise BadInput("memory surface", "no voxels, or some outside the grid", "observed voxels of the grid")


@dataclass(frozen=True, eq=False)
class ObjectMemory:
    """An object as it was learnt, in its object frame.

    name         of the object
    p_obj        (N, 3) its landmarks, metres
    descriptors  (N, scales, SIZE) uint8: how each looks on the surface
    confidence   (N,) of the poses that placed them
    T_cam_obj    (V, 4, 4) poses of its keyframes: from where it was seen
    covariance   (6, 6) of the newest keyframe, right tangent of T_cam_obj
    seen_m2      the most that a keyframe showed of it, across the line of sight
    surface      with colours
    made_of      where it comes from: plain values
    """

    name: str
    p_obj: np.ndarray
    descriptors: np.ndarray
    confidence: np.ndarray
    T_cam_obj: np.ndarray
    covariance: np.ndarray
    seen_m2: np.ndarray
    surface: SurfaceMemory
    made_of: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        file_name("memory name", self.name)
        n, v = len(self.p_obj), len(self.T_cam_obj)
        if not n or not v:
            what = f"{n} landmarks and {v} keyframes"
            fix = "Learn the object from more or sharper frames, or with more texture."
            raise BadInput(f"memory of {self.name!r}", what, "an object that can be found again by them", fix)
        if self.descriptors.ndim != 3 or self.descriptors.dtype != np.uint8:
            raise BadInput("memory descriptors", f"{self.descriptors.shape}", "(N, scales, SIZE) uint8")
        shapes = {"p_obj": (n, 3), "descriptors": (n, *self.descriptors.shape[1:]), "confidence": (n,)}
        shapes |= {"T_cam_obj": (v, 4, 4), "covariance": (6, 6), "seen_m2": ()}
        check_arrays(f"memory of {self.name!r}", self, shapes, finite=True)
        for T in self.T_cam_obj:
            se3.check("memory T_cam_obj", T, _POSE_TOLERANCE)


def save_memory(path: str | Path, memory: ObjectMemory) -> None:
    """Write a memory as one ``.npz`` file of arrays and JSON, whole or not at all."""
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
    arrays = load_arrays(path)
    head = arrays.pop("about", np.zeros(0, np.uint8))
    head = parse_json(head.tobytes(), str(path), expected) if head.dtype == np.uint8 and head.size else {}
    if not isinstance(head, dict) or head.get("kind") != kind:
        raise BadInput(str(path), "an archive of something else", expected)
    if head.get("version") != VERSION:
        fix = "Make it again with this version."
        raise BadInput(str(path), f"version {head.get('version')}", f"{expected} of version {VERSION}", fix)
    try:
        return dict(head["about"]), {name: _memory(name, of, arrays) for name, of in head["objects"].items()}
    except (KeyError, AttributeError, TypeError) as error:
        raise BadInput(str(path), f"a file without {error}", expected) from None
    except BadInput as error:
        raise BadInput(f"{path}: {error.name}", error.got, error.expected, error.fix) from None


def _memory(name: str, made_of: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> ObjectMemory:
    surface = SurfaceMemory(*(arrays[f"{name}/surface/{f.name}"] for f in fields(SurfaceMemory)))
    own = {f.name: arrays[f"{name}/{f.name}"] for f in _array_fields(ObjectMemory)}
    return ObjectMemory(name, **own, surface=surface, made_of=dict(made_of))


def load_memories(paths: Sequence[str | Path]) -> dict[str, ObjectMemory]:
    """Object to its memory, of files and of all those in a run's folder or in its ``maps/``.

    Raises as :func:`load_memory`, and :class:`BadInput` for two of one name.
    """
    found: dict[str, ObjectMemory] = {}
    for path in (file for given in paths for file in _files(Path(given))):
        memory = load_memory(path)
        if memory.name in found:
            fix = "Give one of them; in Python, add_object takes the other under another name."
            raise BadInput("memory", f"two of {memory.name!r}", "one an object", fix)
        found[memory.name] = memory
    return found


def _files(path: Path) -> list[Path]:
    """A file itself; of a folder, the memories in it."""
    if not path.is_dir():
        return [path]
    folder = path / "maps" if (path / "maps").is_dir() else path
    if folder is path and (path / "run.json").is_file():
        fix = "An offline pass keeps none: give the run that it was made of."
        raise MissingData(str(path), f"a run without maps, expected {_EXPECTED}", fix)
    if not (files := sorted(folder.glob("*.npz"))):
        raise MissingData(str(folder), f"no file in it, expected {_EXPECTED}")
    return files


def _array_fields(kind: type) -> list[Any]:
    return [f for f in fields(kind) if f.name not in ("name", "surface", "made_of")]
