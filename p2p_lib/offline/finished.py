"""A finished run with its images, masks and surfaces, and which of its poses are trusted."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.files import check_new
from p2p_lib.core.mask_length import CELL_PX
from p2p_lib.core.raycasting import cast, ray_scene
from p2p_lib.core.types import DOUBTED, Frame
from p2p_lib.datasets.mask_log import load_masks
from p2p_lib.datasets.models import read_mesh
from p2p_lib.datasets.runs import Run, load_run
from p2p_lib.datasets.sequence import Sequence, reopen
from p2p_lib.extended.depth_lag import as_the_run_took

#: The one rule of what is labelled; ``{0}`` is the least confidence.
RULE = (
    "An image is labelled where every object of the run either has a pose of confidence above {0:g}, or has neither"
    " a pose nor a pixel in the masks that the run used."
)

#: Pixels of a mask or a surface are beside the other if farther from it than this share of their own size, px.
_BESIDE, _FRINGE_PX = 0.03, 3


def load_posed(folder: str | Path, min_confidence: float = 0.0) -> Run:
    """The run in a folder; :class:`BadInput` for one of which nothing can be made: no pose, or none so confident."""
    check_confidence(min_confidence)
    run = load_run(folder)
    if not any(obj.has_pose.any() for obj in run.objects.values()):
        fix = "p2p check says what may be wrong with its data."
        raise BadInput(str(folder), "a run without a single pose", "poses of an object at least", fix)
    if not any(obj.of_confidence(min_confidence).has_pose.any() for obj in run.objects.values()):
        got = f"no pose of confidence {min_confidence:g} or more"
        raise BadInput(str(folder), got, "one at least", "Lower --min-confidence.")
    return run


def check_confidence(least: float) -> None:
    """Refuse what is no least confidence that a pose could pass."""
    if not 0 <= least < 1:
        raise BadInput("min_confidence", f"{least:g}", "at least 0 and below 1")


@dataclass(frozen=True, eq=False)
class Finished:
    """A run with its sequence; raises :class:`MissingData` and :class:`BadInput` if any of it is missing.

    run       as :func:`~p2p_lib.datasets.runs.load_run` reads it: poses of one map an object
    sequence  on which it was made
    """

    run: Run
    sequence: Sequence

    @classmethod
    def of(cls, folder: str | Path) -> Finished:
        """The run in a folder; it has poses, and all its images are still there."""
        run = load_posed(folder)
        sequence = reopen(run.info)
        if (last := max(int(obj.frame_index[-1]) for obj in run.objects.values())) >= len(sequence):
            got = f"{len(sequence)} images, and poses up to frame {last}"
            raise BadInput(sequence.name, got, "the images that the run was made on", "Have some been taken away?")
        return cls(run, sequence)

    @property
    def tracked(self) -> tuple[str, ...]:
        """The objects that have a pose in some frame."""
        return tuple(name for name, obj in self.run.objects.items() if obj.has_pose.any())

    @property
    def about(self) -> dict[str, Any]:
        """How the run was made, to be noted in its products."""
        keys = ("sequence", "tracker", "preset", "seed", "commit", "offline")
        return {key: self.run.info[key] for key in keys if self.run.info.get(key) is not None}

    @property
    def frames(self) -> np.ndarray:
        """(n,) frame numbers of the sequence that the run is over."""
        return next(iter(self.run.objects.values())).frame_index

    def frame(self, i: int) -> Frame:
        """Image i of the sequence, its depth moved onto its colour where the run had to do so."""
        return as_the_run_took(self.sequence, i, self.run.doubts)

    @cached_property
    def _coarse(self) -> Mapping[str, Any]:
        return load_masks(self.run.path / self.run.info.get("masks_in", ""))

    @cached_property
    def exact_masks(self) -> bool:
        """Whether the masks that the run used are there at full resolution (``--save-masks``, or the dataset's own)."""
        return bool(self.run.masks(self.sequence, int(self.frames[0])))

    def masks(self, frame: int) -> dict[str, np.ndarray]:
        """Object to the (H, W) bool mask used at a frame; by every fourth pixel, where no exact ones were kept."""
        if self.exact_masks:
            return self.run.masks(self.sequence, frame)
        shape = self.sequence.camera.height, self.sequence.camera.width
        rows = {name: (log, log.row(frame)) for name, log in self._coarse.items() if name in self.run.objects}
        cells = {name: log.cells(row, shape) for name, (log, row) in rows.items() if row is not None}
        return {n: c.repeat(CELL_PX, 0).repeat(CELL_PX, 1)[: shape[0], : shape[1]] for n, c in cells.items()}

    def beside(self, shown: np.ndarray, other: np.ndarray) -> float:
        """The share of a surface's pixels (H, W) bool that lie beside its mask, or the other way round; NaN of none.

        Coarse masks and lost fringes of a surface are no parts that lie beside.
        """
        px = np.count_nonzero(shown)
        reach_px = _FRINGE_PX + _BESIDE * np.sqrt(px) + (0 if self.exact_masks else CELL_PX)
        away_px = cv2.distanceTransform((~other).astype(np.uint8), cv2.DIST_L2, 5)
        return np.count_nonzero(shown & (away_px > reach_px)) / px if px else float("nan")

    def surface(self, name: str) -> Any:
        """The reconstructed surface of an object, a ``trimesh.Trimesh`` in its frame, metres, with colours."""
        path = self.run.path / "meshes" / f"{name}.ply"
        if not path.is_file():
            fix = "Was the run stopped before its end? Run it anew."
            raise MissingData(str(path), f"no surface of {name!r} in the run", fix)
        return read_mesh(path)

    def trusted(self, min_confidence: float = DOUBTED) -> dict[str, np.ndarray]:
        """Object to (n,) bool: its poses that are labels, by :data:`RULE`."""
        objects = {name: self.run.objects[name] for name in self.tracked}
        confident = {name: obj.has_pose & (obj.confidence > min_confidence) for name, obj in objects.items()}
        unseen = {name: np.ones(len(obj), bool) for name, obj in objects.items()}
        for k, frame in enumerate(self.frames):
            if all(of[k] for of in confident.values()):
                continue
            for name, mask in self.masks(int(frame)).items():
                if name in unseen:
                    unseen[name][k] = not mask.any()
        kept = np.logical_and.reduce([confident[name] | (unseen[name] & ~objects[name].has_pose) for name in objects])
        return {name: of & kept for name, of in confident.items()}


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A surface as a camera sees it: a cut of an image that may reach beyond its borders.

    corner   column and row of its first pixel in the image
    depth_m  (h, w) along the optical axis, infinite where it is not met
    face     (h, w) which face, -1 where none
    """

    corner: tuple[int, int]
    depth_m: np.ndarray
    face: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """(h, w) bool."""
        return np.isfinite(self.depth_m)

    def inside(self, image: np.ndarray) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Rows and columns of an image (H, W, ...) that the cut covers, and the same of the cut."""
        (left, top), (h, w) = self.corner, self.depth_m.shape
        rows = slice(min(max(top, 0), image.shape[0]), max(min(top + h, image.shape[0]), 0))
        columns = slice(min(max(left, 0), image.shape[1]), max(min(left + w, image.shape[1]), 0))
        own = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
        return (rows, columns), own

    def depth_in(self, image: np.ndarray) -> np.ndarray:
        """(H, W) float32 metres in an image (H, W, ...), infinite where the surface is not met."""
        depth_m = np.full(image.shape[:2], np.inf, np.float32)
        at, own = self.inside(image)
        depth_m[at] = self.depth_m[own]
        return depth_m


class Renderer:
    """Casts rays of a camera against one surface (V, 3), (F, 3) in its object frame."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, camera: Camera):
        self.vertices, self.faces, self.camera = np.asarray(vertices, float), np.asarray(faces), camera
        self._scene = ray_scene(vertices, faces)

    def __call__(self, T_cam_obj: np.ndarray) -> Silhouette:
        """The surface at a pose, up to an image's size beyond each border; empty if any of it is behind the camera."""
        camera = self.camera
        uv_px = camera.project(se3.transform(T_cam_obj, self.vertices))
        size = np.array([camera.width, camera.height])
        low, high = np.zeros(2, int), np.zeros(2, int)
        if np.isfinite(uv_px).all():
            low = np.clip(np.floor(uv_px.min(0)), -size, 2 * size).astype(int)
            high = np.clip(np.ceil(uv_px.max(0)) + 1, -size, 2 * size).astype(int)
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        rays = camera.unproject(np.stack([u, v], -1), np.ones(u.shape)).reshape(-1, 3)
        T_obj_cam = se3.inverse(T_cam_obj)
        if not len(rays):
            return Silhouette((0, 0), np.zeros(u.shape), np.zeros(u.shape, int))
        met = cast(self._scene, T_obj_cam[:3, 3], rays @ T_obj_cam[:3, :3].T)
        depth_m, face = met["t_hit"].reshape(u.shape), met["primitive_ids"].reshape(u.shape)
        return Silhouette((int(low[0]), int(low[1])), depth_m, face)


@contextmanager
def new_folder(out: str | Path) -> Iterator[Path]:
    """A folder to write into that is renamed to ``out`` when all is written, and removed if that fails.

    Raises :class:`BadInput` if ``out`` holds something already.
    """
    out = Path(out)
    check_new(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    partial.mkdir()
    try:
        yield partial
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
