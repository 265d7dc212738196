"""True tracks of any pixel of a sequence with truth: lifted onto the true surface, carried by the true pose.

A query is lifted onto the object's mesh at its true pose by a ray, or by the measured depth where there is no
mesh. In another frame the point is *visible* when it lies in the image and in the object's mask, its surface
faces the camera, no other part of the mesh is in front of it, and the depth measured at its pixel lies within
:data:`DEPTH_TOLERANCE_M` of the true surface (a pixel without a measurement agrees where there is a mask).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import lift
from p2p_lib.core.errors import MissingData
from p2p_lib.core.image import in_mask, nearest_px
from p2p_lib.core.raycasting import cast, ray_scene
from p2p_lib.core.types import Frame, Rows, joined
from p2p_lib.datasets.models import MESHES, find_models, given_models, load_mesh
from p2p_lib.datasets.sequence import Sequence

#: Wide enough for a truth that jitters by degrees and for a sensor that is off by millimetres, thinner than a hand.
DEPTH_TOLERANCE_M = 0.02
#: Surfaces seen at less than this cosine (84 degrees) do not count as facing the camera.
MIN_COSINE = 0.1
# A mesh in front of a point by more than this hides it.
_SELF_OCCLUSION_M = 0.002
# Where there is no mesh: readings that count, and half the base of the normal.
_DEPTH, _BASE_PX = DepthConfig(min_m=0.1, max_m=5.0, edge_m=0.02), 2


@dataclass(frozen=True, eq=False)
class SurfacePoints(Rows):
    """Points on true surfaces. object (N,) index; p_model (N, 3) metres; normal (N, 3), NaN where unknown."""

    object: np.ndarray
    p_model: np.ndarray
    normal: np.ndarray


NO_POINTS = SurfacePoints(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class TrueTracks:
    """Surface points as truth has them, in one frame (N, ...) or in all frames of a sequence (T, N, ...).

    uv_px    (..., 2) NaN where the object's pose is not known
    visible  (...,) bool
    known    (...,) bool: truth can say whether the point is visible
    view     (..., 3) unit vectors from the point to the camera, in the model frame
    """

    uv_px: np.ndarray
    visible: np.ndarray
    known: np.ndarray
    view: np.ndarray


class TrueScene:
    """The true surfaces of a sequence's objects: knows where any of their points is in any frame.

    meshes    object to mesh file; objects without one are lifted by the measured depth
    surfaces  object to its mesh, ready for rays

    Raises :class:`MissingData` for a sequence without truth.
    """

    def __init__(self, sequence: Sequence, meshes: Mapping[str, str | Path] | None = None):
        if not sequence.truth:
            fix = "Give a sequence with annotated_poses/, or synthetic/crossing."
            raise MissingData(sequence.name, "has no true poses", fix)
        self.sequence = sequence
        self.objects = tuple(sequence.truth)
        self.surfaces = {name: ray_scene(*load_mesh(path)) for name, path in (meshes or {}).items()}

    @classmethod
    def of(cls, sequence: Sequence, models: Mapping[str, str | Path] | None = None) -> TrueScene:
        """With the meshes in the sequence's ``models/``, and those given (files or folders, by object)."""
        meshes = find_models(sequence, MESHES)
        # A cloud of points serves for scoring poses, but is no surface.
        given = {name: path for name, path in (models or {}).items() if Path(path).suffix.lower() != ".xyz"}
        return cls(sequence, meshes | given_models(given, sequence.objects, MESHES))

    def owners(self, frame: Frame, uv_px: np.ndarray) -> np.ndarray:
        """(N,) index of the object whose mask holds each pixel; -1 where none does."""
        masks = self.masks(frame.index)
        owner = np.full(len(uv_px), -1)
        for k, name in enumerate(self.objects):
            if name in masks:
                owner[in_mask(uv_px, masks[name]) & self.sequence.camera.inside(uv_px)] = k
        return owner

    def lift(self, frame: Frame, object: np.ndarray, uv_px: np.ndarray) -> SurfacePoints:
        """The surface points behind pixels (N, 2) of given objects (N,); NaN where no surface is met."""
        p_model, normal = np.full((len(uv_px), 3), np.nan), np.full((len(uv_px), 3), np.nan)
        for k, name in enumerate(self.objects):
            rows = np.flatnonzero(object == k)
            T_cam_model = self.sequence.truth[name].T_cam_model[frame.index]
            if not len(rows) or not np.isfinite(T_cam_model).all():
                continue
            if name in self.surfaces:
                rays = self.sequence.camera.unproject(uv_px[rows], np.ones(len(rows))) @ T_cam_model[:3, :3]
                p_model[rows], normal[rows] = self._lift_by_ray(name, T_cam_model, rays)
            else:
                p_model[rows], normal[rows] = self._lift_by_depth(frame, uv_px[rows], T_cam_model)
        return SurfacePoints(np.asarray(object, np.int64), p_model, normal)

    def see(self, frame: Frame, points: SurfacePoints) -> TrueTracks:
        """Where the points are in this frame and which of them are visible."""
        n = len(points)
        true = TrueTracks(np.full((n, 2), np.nan), np.zeros(n, bool), np.zeros(n, bool), np.full((n, 3), np.nan))
        masks = self.masks(frame.index)
        for k, name in enumerate(self.objects):
            rows = np.flatnonzero(points.object == k)
            if not len(rows):
                continue
            truth, mask = self.sequence.truth[name], masks.get(name)
            T_cam_model = truth.T_cam_model[frame.index]
            posed = bool(np.isfinite(T_cam_model).all() and truth.labelled[frame.index])
            # Without a valid pose an object is certainly invisible only where its mask is there and empty.
            true.known[rows] = posed or (mask is not None and not mask.any())
            if np.isfinite(T_cam_model).all():
                true.uv_px[rows], visible, true.view[rows] = self._look(
                    frame, name, mask, T_cam_model, points.select(rows)
                )
                true.visible[rows] = visible & posed
        return true

    def _look(
        self, frame: Frame, name: str, mask: np.ndarray | None, T_cam_model: np.ndarray, points: SurfacePoints
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels, visibility and view of one object's points at its pose."""
        centre = se3.inverse(T_cam_model)[:3, 3]
        away = centre - points.p_model
        distance_m = np.linalg.norm(away, axis=1)
        view = away / distance_m[:, None]
        p_cam = se3.transform(T_cam_model, points.p_model)
        uv = self.sequence.camera.project(p_cam)
        u, v = nearest_px(uv, frame.shape)
        measured_m = frame.depth_m[v, u]
        agrees = np.abs(measured_m - p_cam[:, 2]) <= DEPTH_TOLERANCE_M
        cosine = np.einsum("nc,nc->n", points.normal, view)
        visible = self.sequence.camera.inside(uv) & ~(cosine < MIN_COSINE)  # an unknown normal hides nothing
        visible &= agrees if mask is None else mask[v, u] & (agrees | (measured_m == 0))
        if name in self.surfaces:
            visible &= cast(self.surfaces[name], centre, -view)["t_hit"] > distance_m - _SELF_OCCLUSION_M
        return uv, visible, view

    def _lift_by_depth(self, frame: Frame, uv_px: np.ndarray, T_cam_model: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        steps = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]) * _BASE_PX
        around = (uv_px[None] + steps[:, None]).reshape(-1, 2)
        p_cam = lift(frame, around, self.sequence.camera, _DEPTH).reshape(5, -1, 3)
        normal = np.cross(p_cam[4] - p_cam[3], p_cam[2] - p_cam[1])  # y down times x right: towards the camera
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return se3.transform(se3.inverse(T_cam_model), p_cam[0]), normal @ T_cam_model[:3, :3]

    def _lift_by_ray(self, name: str, T_cam_model: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        centre = se3.inverse(T_cam_model)[:3, 3]
        hit = cast(self.surfaces[name], centre, rays)
        distance_m, normal = hit["t_hit"].astype(float)[:, None], hit["primitive_normals"].astype(float)
        met = np.isfinite(distance_m)
        # Towards the camera, so that a mesh wound the other way round serves as well.
        normal *= -np.sign(np.einsum("nc,nc->n", normal, rays))[:, None]
        reach = np.where(met, distance_m, 0)
        return np.where(met, centre + reach * rays, np.nan), np.where(met, normal, np.nan)

    def masks(self, i: int) -> dict[str, np.ndarray]:
        """Those of a frame; none where the sequence has none."""
        return self.sequence.masks(i) or {}


@dataclass(frozen=True, eq=False)
class Queries(Rows):
    """Query points of a sequence: frame (N,), uv_px (N, 2) and the surface points behind them, by frame."""

    frame: np.ndarray
    uv_px: np.ndarray
    points: SurfacePoints


def draw_queries(scene: TrueScene, rng: np.random.Generator, count: int = 256, at: int = 4) -> Queries:
    """``count`` queries uniform in the visible masks of ``at`` frames spread over the sequence.

    The frames start the ``at`` equal parts of the sequence; where nothing is visible there, the next one in
    which something is. A query is visible by the rule of this module. Raises :class:`MissingData` where the
    sequence has no masks or nothing is ever visible.
    """
    total = len(scene.sequence)
    starts = [k * total // at for k in range(at)] + [total]
    drawn = []
    for k in range(at):
        wanted = (k + 1) * count // at - k * count // at
        for i in range(starts[k], starts[k + 1]):
            found = _draw(scene, scene.sequence.frame(i), wanted, rng)
            if len(found):
                drawn.append(found)
                break
    if not drawn:
        raise MissingData(scene.sequence.name, "no visible point to ask for", "Masks and true poses are needed.")
    return joined(drawn)


def true_tracks(scene: TrueScene, points: SurfacePoints) -> TrueTracks:
    """The true tracks of surface points over the whole sequence."""
    return joined([scene.see(scene.sequence.frame(i), points) for i in range(len(scene.sequence))], np.stack)


def _draw(scene: TrueScene, frame: Frame, wanted: int, rng: np.random.Generator) -> Queries:
    """Up to ``wanted`` visible pixels of a frame, in random order."""
    masks = scene.masks(frame.index)
    anything = np.logical_or.reduce([np.zeros(frame.shape, bool), *(masks[n] for n in scene.objects if n in masks)])
    v, u = np.nonzero(anything)
    # Some pixels fall out (no surface, depth that disagrees): draw four times as many as are wanted.
    uv = rng.permutation(np.stack([u, v], 1).astype(float))[: 4 * wanted]
    points = scene.lift(frame, scene.owners(frame, uv), uv)
    seen = np.flatnonzero(scene.see(frame, points).visible)[:wanted]
    return Queries(np.full(len(seen), frame.index), uv[seen], points.select(seen))
