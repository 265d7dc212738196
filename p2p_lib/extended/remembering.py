"""What is known of an object as a memory, and a surface from one (:mod:`p2p_lib.core.memory`; not in the paper).

Landmarks are described in the keyframe images that the surface keeps, independently of the 2D tracker: a memory that
was made with one tracker serves another.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import backends, se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.image import in_image
from p2p_lib.core.memory import ObjectMemory, SurfaceMemory
from p2p_lib.core.types import Frame
from p2p_lib.extended.agreement import outline_share
from p2p_lib.method.tsdf import TsdfVolume

if TYPE_CHECKING:
    from p2p_lib.method.object_model import Known

#: Most landmarks of a memory, and the largest difference from the measured depth of a keypoint that shows, m.
_LANDMARKS, _SHOWS_M = 1500, 0.01
#: Voxel weights are cut at this, so that later frames still change the average.
_MOST_WEIGHT = 200.0
#: The share of its outline with a depth step of an object whose views show none, and pixels around a view.
_OUTLINE, _AROUND_PX = 0.75, 8
#: So many origins are kept: the first, which the object frame is of, and the newest.
_ORIGINS = 100


def memory_of(name: str, known: Known, made_of: dict[str, Any], before: ObjectMemory | None = None) -> ObjectMemory:
    """What is known of an object; :class:`BadInput` where that is too little to find it again.

    made_of  plain values that say where it comes from
    before   what its map began with; its landmarks are kept, and where it comes from
    """
    surface = known.model.surface
    if surface is None or surface.empty:
        raise BadInput(f"memory of {name!r}", "no surface", "an object with a reconstructed surface")
    columns = [_landmarks(known, surface)]
    if before is not None:
        columns.append((before.p_obj, before.descriptors, before.confidence))
        made_of = made_of | {"before": _origins(before)}
    columns = [column for column in columns if len(column[0])] or columns[:1]
    p_obj, descriptors, confidence = (np.concatenate(of) for of in zip(*columns, strict=True))
    kept = np.sort(np.random.default_rng(0).permutation(len(p_obj))[:_LANDMARKS])
    landmarks = p_obj[kept], descriptors[kept], confidence[kept]
    outline = np.array(_outline(surface, _OUTLINE if before is None else float(before.outline)))
    rest = known.model.views.T_cam_obj, known.model.covariance, np.array(getattr(known.life, "seen_m2", 0.0)), outline
    return ObjectMemory(name, *landmarks, *rest, _surface_memory(surface), made_of)


def _origins(before: ObjectMemory) -> list[dict[str, Any]]:
    """Where a memory, and those that it began with, come from, the oldest first."""
    own = dict(before.made_of)
    every = [*own.pop("before", []), own]
    return every[:1] + every[1:][1 - _ORIGINS :]


def _landmarks(known: Known, surface: TsdfVolume) -> tuple[np.ndarray, ...]:
    """p_obj (L, 3), descriptors and confidence (L,) of the corners and keypoints that the kept views show."""
    points = known.map
    own, confidence = points.p_obj[points.promoted], points.confidence[points.promoted]
    middling = float(np.median(confidence)) if len(confidence) else 0.0
    found: list[tuple[np.ndarray, ...]] = []
    for view in surface.views.values():
        (height, width), (left, top), lens = view.inside.shape, view.corner, view.camera
        camera = Camera(lens.fx, lens.fy, lens.cx - left + 1, lens.cy - top + 1, width, height)
        depth_m = np.where(view.inside, view.depth_m, np.float32(0))
        frame = Frame(0, 0.0, np.ascontiguousarray(np.moveaxis(view.rgbw[:3], 0, -1)), depth_m)
        p_cam = se3.transform(view.T_cam_obj, own)
        uv_px = camera.project(p_cam)
        inside = np.flatnonzero((p_cam[:, 2] > 0) & in_image(uv_px, depth_m.shape))
        u, v = np.rint(uv_px[inside]).astype(int).T
        shown = inside[np.abs(depth_m[v, u] - p_cam[inside, 2]) < _SHOWS_M]
        p_cam, descriptors = backends.make_recogniser(camera).describe(frame, view.inside, uv_px[shown])
        p_obj = _on_surface(surface, se3.transform(se3.inverse(view.T_cam_obj), p_cam))
        found.append((p_obj, descriptors, np.full(len(p_obj), middling)))
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 1, 1), np.uint8), np.zeros(0)
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def _outline(surface: TsdfVolume, unseen: float) -> float:
    """The share of its outline at which depth has a step, in the middle view; ``unseen`` where no view shows any."""
    shares = []
    for view in surface.views.values():
        depth_m = np.pad(np.where(view.depth_m > 0, view.depth_m, np.float32(0)), _AROUND_PX)
        frame = Frame(0, 0.0, np.zeros((*depth_m.shape, 3), np.uint8), depth_m)
        shares.append(outline_share(frame, np.pad(view.inside, _AROUND_PX), own=True))
    measured = [share for share in shares if share is not None]
    return float(np.median(measured)) if measured else unseen


def _on_surface(surface: TsdfVolume, p_obj: np.ndarray) -> np.ndarray:
    """Points (N, 3) measured in one image, moved onto the fused surface."""
    distance_m, gradient, valid = surface.query_with_gradient(p_obj)
    slope = np.maximum((gradient**2).sum(1), 0.25)
    return p_obj - np.where(valid, distance_m / slope, 0.0)[:, None] * gradient


def _surface_memory(surface: TsdfVolume) -> SurfaceMemory:
    value, weight, colours = surface.values(), surface.weights(), surface.colours()
    index = np.flatnonzero(np.isfinite(value.ravel()) & (weight.ravel() > 0))
    rgb_weight = colours.reshape(-1, 4)[index, 3]
    rgb = colours.reshape(-1, 4)[index, :3] / np.maximum(rgb_weight, 1e-6)[:, None]
    return SurfaceMemory(
        np.array(surface.voxel_m),
        np.array(surface.tau_m),
        surface.anchor_m.copy(),
        surface.lo.copy(),
        np.array(surface.shape),
        index.astype(np.int32),
        value.ravel()[index].astype(np.float16),
        np.minimum(weight.ravel()[index], _MOST_WEIGHT).astype(np.float16),
        np.clip(np.rint(rgb), 0, 255).astype(np.uint8),
        np.minimum(rgb_weight, _MOST_WEIGHT).astype(np.float16),
    )


def restored(kept: SurfaceMemory, config: TsdfConfig, device: str) -> TsdfVolume:
    """The surface of a memory, which grows on."""
    volume = TsdfVolume(config, origin_m=kept.origin_m, shape=tuple(kept.shape.tolist()), device=device)
    rgb_weight = kept.rgb_weight.astype(np.float32)[:, None]
    weight = kept.weight.astype(np.float32)
    rgbw = np.hstack([kept.rgb * rgb_weight, rgb_weight])
    volume.put(kept.lo, kept.index, kept.value.astype(np.float32), weight, rgbw)
    return volume
