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
from p2p_lib.core.files import file_name, load_arrays, parse_json, replacing

#: Of the files that this library writes, and reads.
VERSION = 1
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
        _check_shapes(self, single | {"value": (m,), "weight": (m,), "rgb": (m, 3), "rgb_weight": (m,)}, "surface")
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
    keypoint     (N,) bool: those that were tracked, and kept by the graph
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
    keypoint: np.ndarray
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
        shapes |= {"keypoint": (n,), "T_cam_obj": (v, 4, 4), "covariance": (6, 6), "seen_m2": ()}
        _check_shapes(self, shapes, f"of {self.name!r}")
        for T in self.T_cam_obj:
            se3.check("memory T_cam_obj", T, _POSE_TOLERANCE)


def _check_shapes(value: Any, shapes: Mapping[str, tuple[int, ...]], what: str) -> None:
    for key, shape in shapes.items():
        got = getattr(value, key)
        if got.shape != shape or got.dtype.kind not in "iufb" or not np.isfinite(got).all():
            raise BadInput(f"memory {what}: {key}", f"{got.dtype} {got.shape}", f"finite numbers {shape}")


def save_memory(path: str | Path, memory: ObjectMemory) -> None:
    """Write a memory as one ``.npz`` file of arrays and JSON, whole or not at all."""
    about = {"kind": _KIND, "version": VERSION, "name": memory.name, "made_of": dict(memory.made_of)}
    arrays = {f.name: getattr(memory, f.name) for f in _array_fields(ObjectMemory)}
    arrays |= {f"surface/{f.name}": getattr(memory.surface, f.name) for f in fields(SurfaceMemory)}
    with replacing(Path(path)) as file:
        np.savez_compressed(file, about=np.frombuffer(json.dumps(about).encode(), np.uint8), **arrays)


def load_memory(path: str | Path) -> ObjectMemory:
    """Read a memory.

    Raises :class:`MissingData` where there is none, :class:`BadInput` for a file that is damaged, cut short, empty, of
    another kind or of another version.
    """
    path = Path(path)
    if not path.exists():
        raise MissingData(str(path), f"no such file, expected {_EXPECTED}", "See maps/ of a run's folder.")
    arrays = load_arrays(path)
    about = arrays.pop("about", np.zeros(0, np.uint8))
    about = parse_json(about.tobytes(), str(path), _EXPECTED) if about.dtype == np.uint8 and about.size else {}
    if not isinstance(about, dict) or about.get("kind") != _KIND:
        raise BadInput(str(path), "an archive of something else", _EXPECTED)
    if about.get("version") != VERSION:
        fix = "Make it again from its video with this version: p2p run."
        raise BadInput(str(path), f"a memory of version {about.get('version')}", f"version {VERSION}", fix)
    try:
        surface = SurfaceMemory(*(arrays[f"surface/{f.name}"] for f in fields(SurfaceMemory)))
        own = {f.name: arrays[f.name] for f in _array_fields(ObjectMemory)}
        return ObjectMemory(about["name"], **own, surface=surface, made_of=dict(about.get("made_of") or {}))
    except KeyError as error:
        raise BadInput(str(path), f"a memory without {error}", _EXPECTED) from None
    except BadInput as error:
        raise BadInput(f"{path}: {error.name}", error.got, error.expected, error.fix) from None


def load_memories(paths: Sequence[str | Path]) -> dict[str, ObjectMemory]:
    """Object to its memory; :class:`BadInput` for two of one name, too."""
    found: dict[str, ObjectMemory] = {}
    for path in paths:
        memory = load_memory(path)
        if memory.name in found:
            fix = "Give one of them, or learn the objects under different names."
            raise BadInput("memory", f"two of {memory.name!r}", "one an object", fix)
        found[memory.name] = memory
    return found


def _array_fields(kind: type) -> list[Any]:
    return [f for f in fields(kind) if f.name not in ("name", "surface", "made_of")]
