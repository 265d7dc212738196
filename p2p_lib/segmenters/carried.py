"""A mask of an earlier frame in a later one: what it holds moves as the object has moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.depth_edges import depth_step_m
from p2p_lib.core.image import bounds, nearest_px
from p2p_lib.core.types import Frame

#: Less than this of the mask seen again, as a share, says that the motion or the mask is wrong.
_SEEN_AGAIN = 0.5
#: Pixels that a mask is looked for around where its measured points are now.
_ROOM_PX = 8


@dataclass(frozen=True, eq=False)
class Moment:
    """An object in a frame: its pose T_cam_obj (4, 4), None where it is not known, and its mask (H, W) bool."""

    frame: Frame
    T_cam_obj: np.ndarray | None
    mask: np.ndarray


def carried(then: Moment, now: Moment, camera: Camera) -> np.ndarray | None:
    """(H, W) bool: the mask of ``then`` in the frame of ``now``; None for an unknown pose, or too little seen again.

    Each measured pixel of now is looked up where it was then, if it moved as the object did. What was hidden then, and
    what is not measured, stays as the mask of ``now`` has it.
    """
    if then.T_cam_obj is None or now.T_cam_obj is None:
        return None
    T_then_now = then.T_cam_obj @ se3.inverse(now.T_cam_obj)
    moved_px = _moved_px(then, se3.inverse(T_then_now), camera)
    if not len(moved_px):
        return None
    region = now.mask.copy()
    u, v = nearest_px(moved_px, region.shape)
    region[v, u] = True
    box = bounds(region, _ROOM_PX)
    z_m = now.frame.depth_m[box]
    v, u = np.mgrid[box]
    p_then = se3.transform(T_then_now, camera.unproject(np.stack([u, v], -1).astype(float), z_m))
    uv_then = camera.project(p_then)
    inside = (z_m > 0) & camera.inside(uv_then, -0.5)
    u, v = nearest_px(np.where(inside[..., None], uv_then, np.nan), region.shape)
    measured_m = then.frame.depth_m[v, u]
    looked_up = inside & (measured_m > 0) & (np.abs(measured_m - p_then[..., 2]) < depth_step_m(measured_m))
    held = looked_up & then.mask[v, u]
    if np.count_nonzero(held) < _SEEN_AGAIN * len(moved_px):
        return None
    mask = np.zeros_like(now.mask)
    mask[box] = np.where(looked_up, held, now.mask[box])
    return mask


def _moved_px(then: Moment, T_now_then: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 2) where the measured pixels of a mask are now; those that have left the image are left out."""
    v, u = np.nonzero(then.mask & (then.frame.depth_m > 0))
    p_now = se3.transform(T_now_then, camera.unproject(np.stack([u, v], -1).astype(float), then.frame.depth_m[v, u]))
    uv_px = camera.project(p_now)
    return uv_px[camera.inside(uv_px, -0.5)]
