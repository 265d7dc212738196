"""What moves with an object: pixels of this frame, compared with an earlier one under the object's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.depth_edges import depth_step_m
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import Patch, dilated

#: Two views of one point differ by less than this in colour, as a mean over the channels.
_SAME_COLOUR = 40.0
#: A part follows if more of it agrees with the object's motion, less with standing still; of a still scene more stays.
_AGREES, _UNDECIDED, _STAYS = 0.75, 0.5, 0.7
#: A part of which this share was not there in the first frame has come to the object since.
_ABSENT = 0.3
#: A part of fewer cells of the grid proves nothing; one within so many cells of the object may belong to it.
_FEWEST, _NEAR = 12, 4
#: A part may cover up to this share of the patch's border by accident.
_AT_THE_BORDER = 0.02
#: One frame in so many is remembered, and so many besides the first are kept.
EVERY, _KEPT = 5, 6
#: One row and column in so many of the scene is looked at.
_SCENE_STRIDE = 24


@dataclass(frozen=True, eq=False)
class Motions:
    """How an object moved until ``now``: since a recent frame, and since the first that it was seen in.

    Each is that frame and T_then_now (4, 4): as part of the object, from camera coordinates of now to those of then.
    """

    now: Frame
    recent: tuple[Frame, np.ndarray]
    first: tuple[Frame, np.ndarray]


@dataclass(frozen=True, eq=False)
class Past:
    """Frames that an object was seen in, with its poses T_cam_obj (4, 4): the first, and some recent ones."""

    seen: tuple[tuple[Frame, np.ndarray], ...] = ()

    @property
    def full(self) -> bool:
        """Whether the object has been followed for a while: its first masks may still grow."""
        return len(self.seen) > _KEPT

    def due(self, frame: Frame) -> bool:
        """Whether a frame is to be remembered."""
        return not self.seen or frame.index >= self.seen[-1][0].index + EVERY

    def with_frame(self, frame: Frame, T_cam_obj: np.ndarray) -> Past:
        """With one more frame; beyond the limit the oldest but the first is dropped."""
        return Past((*self.seen[:1], *self.seen[1:][1 - _KEPT :], (frame, T_cam_obj)))

    def motions(self, now: Frame, T_cam_obj: np.ndarray) -> Motions | None:
        """The motions since one of the recent frames, taken in turns, and since the first; None without frames."""
        if not self.seen:
            return None
        T_obj_cam, recent = se3.inverse(T_cam_obj), self.seen[1:] or self.seen
        both = recent[now.index % len(recent)], self.seen[0]
        return Motions(now, *((then, T_then_obj @ T_obj_cam) for then, T_then_obj in both))


def agrees(
    p_cam: np.ndarray, rgb: np.ndarray, camera: Camera, then: Frame, T_then_now: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether points p_cam (..., 3) of now, with colours rgb (..., 3), moved by T_then_now, were seen in ``then``.

    Returns (...,) bool those that were, and those that were not there: what is behind them was seen.
    """
    p_then = se3.transform(T_then_now, p_cam)
    uv_px = camera.project(p_then)
    inside = camera.inside(uv_px, -0.5)
    u, v = np.moveaxis(np.rint(np.where(inside[..., None], uv_px, 0)).astype(int), -1, 0)
    z = then.depth_m[v, u]
    behind_m, step_m = z - p_then[..., 2], depth_step_m(z)
    known = inside & (z > 0)
    alike = np.abs(then.rgb[v, u].astype(np.int16) - rgb).mean(-1) < _SAME_COLOUR
    return known & (np.abs(behind_m) < step_m) & alike, known & (behind_m > 2 * step_m)


def scene_stays(patch: Patch, motions: Motions) -> bool:
    """Whether what lies around a patch stayed in the camera frame, rather than moved as the object did.

    With a moving camera all that is at rest moves alike; with a slow one walls of one colour seem to have stayed.
    """
    frame, (then, T_then_now) = motions.now, motions.recent
    around = np.ones(frame.shape, bool)
    around[patch.box.slices] = False
    v, u = np.mgrid[: frame.shape[0] : _SCENE_STRIDE, : frame.shape[1] : _SCENE_STRIDE]
    some = around[v, u] & (frame.depth_m[v, u] > 0)
    v, u = v[some], u[some]
    p_cam = patch.camera.unproject(np.stack([u, v], -1), frame.depth_m[v, u])
    both = patch.camera.inside(patch.camera.project(se3.transform(T_then_now, p_cam)), -0.5)
    p_cam, rgb = p_cam[both], frame.rgb[v, u][both]
    if len(p_cam) < _FEWEST:
        return False
    stayed, _ = agrees(p_cam, rgb, patch.camera, then, np.eye(4))
    moved, _ = agrees(p_cam, rgb, patch.camera, then, T_then_now)
    return stayed.mean() > max(_STAYS, moved.mean())


def parts_that_follow(patch: Patch, part: np.ndarray, component: np.ndarray, motions: Motions) -> np.ndarray:
    """(h, w) bool: parts beside an object's component (h, w) bool that moved as it did and did not stay.

    part  (h, w) int, see :func:`p2p_lib.segmenters.builtin.patch.connected_components`

    What was not there in the first frame, as a hand that took the object since, does not belong to it.
    """
    size = np.bincount(part.ravel())
    count = len(size)
    adjacent = np.zeros(count, bool)
    adjacent[part[dilated(component, _NEAR) & ~component]] = True
    adjacent[part[component]] = False
    adjacent &= size >= _FEWEST
    adjacent[0] = False
    at_border = np.bincount(part[patch.border()], minlength=count) / patch.border().sum()
    adjacent &= at_border < _AT_THE_BORDER
    v, u = np.nonzero(adjacent[part])
    if not len(v) or not scene_stays(patch, motions):
        return np.zeros(patch.shape, bool)
    p_cam, rgb = patch.points()[v, u], patch.rgb[v, u]
    moved, _ = agrees(p_cam, rgb, patch.camera, *motions.recent)
    stayed, _ = agrees(p_cam, rgb, patch.camera, motions.recent[0], np.eye(4))
    _, absent = agrees(p_cam, rgb, patch.camera, *motions.first)
    moved, stayed, absent = (np.bincount(part[v, u], w, count) / np.maximum(size, 1) for w in (moved, stayed, absent))
    return (adjacent & (moved > _AGREES) & (stayed < _UNDECIDED) & (absent < _ABSENT))[part]
