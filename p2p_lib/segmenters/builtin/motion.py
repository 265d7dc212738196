"""What moves with an object: pixels of this frame, compared with an earlier one under the object's motion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.depth_edges import depth_step_m
from p2p_lib.core.image import shares
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import AT_THE_BORDER, Patch, dilated

#: Two views of one point differ by less than this in colour, as a mean over the channels.
_SAME_COLOUR = 40.0
#: A part follows if more of it agrees with the object's motion, less with standing still, and something behind it was
#: seen through less of it in any frame; of a still scene more stays.
_AGREES, _UNDECIDED, _EMPTY, _STAYS = 0.75, 0.5, 0.3, 0.7
#: A part of fewer cells of the grid proves nothing; one within so many cells of the object may belong to it.
_FEWEST, _NEAR = 12, 4
#: One frame in so many is remembered, and so many besides the first are kept.
EVERY, _KEPT = 5, 6
#: Something was seen through if what is behind is so many steps of depth farther, over so many cells across.
_FAR_BEHIND, _THICK = 4.0, 5
#: One row and column in so many of the scene is looked at, in a small image more of them: so many columns at least.
_SCENE_STRIDE, _SCENE_COLUMNS = 24, 26
#: The camera stayed where it was if in so many of the image's tiles, this many a side, more than so much did.
_TILES, _TILES_THAT_STAY, _TILE_STAYS = 4, 0.25, 0.9


@dataclass(frozen=True, eq=False)
class Motions:
    """How an object moved until ``now``: since a ``recent`` frame, and since all that are ``compared``.

    Each is that frame and T_then_now (4, 4): as part of the object, from camera coordinates of now to those of then.
    """

    now: Frame
    recent: tuple[Frame, np.ndarray]
    compared: tuple[tuple[Frame, np.ndarray], ...]


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
        """The motions since all that is remembered, the first frame first; None without frames.

        ``recent`` is each but the first in turns.
        """
        if not self.seen:
            return None
        T_obj_cam = se3.inverse(T_cam_obj)
        compared = tuple((then, T_then_obj @ T_obj_cam) for then, T_then_obj in self.seen)
        recent = compared[1:] or compared
        return Motions(now, recent[now.index % len(recent)], compared)


def agrees(p_cam: np.ndarray, rgb: np.ndarray, camera: Camera, then: Frame, T_then_now: np.ndarray) -> np.ndarray:
    """(...,) bool: whether points p_cam (..., 3) of now, with colours rgb (..., 3), moved by T_then_now, were seen."""
    (v, u), behind_m, step_m = _looked_at(p_cam, camera, then, T_then_now)
    alike = np.abs(then.rgb[v, u].astype(np.int16) - rgb).mean(-1) < _SAME_COLOUR
    return (np.abs(behind_m) < step_m) & alike


def _looked_at(
    p_cam: np.ndarray, camera: Camera, then: Frame, T_then_now: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Where points p_cam (..., 3) of now were in the image ``then``, rows and columns (...,).

    Besides, what was seen there: how far behind them, NaN if nothing was, and what is a step of depth, (...,) m.
    """
    p_then = se3.transform(T_then_now, p_cam)
    uv_px = camera.project(p_then)
    inside = camera.inside(uv_px, -0.5)
    u, v = np.moveaxis(np.rint(np.where(inside[..., None], uv_px, 0)).astype(int), -1, 0)
    z = then.depth_m[v, u]
    return (v, u), np.where(inside & (z > 0), z - p_then[..., 2], np.nan), depth_step_m(z)


def free_before(patch: Patch, motions: Motions) -> np.ndarray:
    """(h, w) bool: what something behind it was seen through, in a frame that is compared, as a part of the object.

    So it came since, as a hand that takes the object. Not where that is thin: poses are off by a cell or two. Only by
    frames that were taken from where the camera still is: where it has moved, all edges of depth are off by more.
    """
    p_cam, free, scene = patch.points(), np.zeros(patch.shape, bool), _scene_around(patch, motions.now)
    for then, T_then_now in motions.compared:
        if _camera_stayed(*scene, patch.camera, then):
            _, behind_m, step_m = _looked_at(p_cam, patch.camera, then, T_then_now)
            free |= behind_m > _FAR_BEHIND * step_m
    free &= patch.depth_m > 0
    return cv2.morphologyEx(free.astype(np.uint8), cv2.MORPH_OPEN, np.ones((_THICK,) * 2, np.uint8)) > 0


def scene_stays(patch: Patch, motions: Motions) -> bool:
    """Whether what lies around a patch stayed in the camera frame, rather than moved as the object did.

    With a moving camera all that is at rest moves alike; with a slow one walls of one colour seem to have stayed.
    """
    then, T_then_now = motions.recent
    p_cam, rgb = _scene_around(patch, motions.now)
    both = patch.camera.inside(patch.camera.project(se3.transform(T_then_now, p_cam)), -0.5)
    if np.count_nonzero(both) < _FEWEST:
        return False
    p_cam, rgb = p_cam[both], rgb[both]
    stayed = agrees(p_cam, rgb, patch.camera, then, np.eye(4))
    moved = agrees(p_cam, rgb, patch.camera, then, T_then_now)
    return stayed.mean() > max(_STAYS, moved.mean())


def _scene_around(patch: Patch, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Some points (N, 3) of a frame around a patch, in the camera's frame, and their colours (N, 3)."""
    around = np.ones(frame.shape, bool)
    around[patch.box.slices] = False
    stride = max(min(frame.shape[1] // _SCENE_COLUMNS, _SCENE_STRIDE), 1)
    v, u = np.mgrid[: frame.shape[0] : stride, : frame.shape[1] : stride]
    some = around[v, u] & (frame.depth_m[v, u] > 0)
    v, u = v[some], u[some]
    return patch.camera.unproject(np.stack([u, v], -1), frame.depth_m[v, u]), frame.rgb[v, u]


def _camera_stayed(p_cam: np.ndarray, rgb: np.ndarray, camera: Camera, then: Frame) -> bool:
    """Whether points of the scene were at the same places of an earlier image, but for where people are."""
    v, u = np.moveaxis(camera.project(p_cam)[:, ::-1] / then.shape * _TILES, -1, 0).astype(int)
    share = shares(v * _TILES + u, agrees(p_cam, rgb, camera, then, np.eye(4)), _FEWEST)
    return len(share) > 0 and float(np.quantile(share, 1 - _TILES_THAT_STAY)) > _TILE_STAYS


def parts_that_follow(patch: Patch, part: np.ndarray, component: np.ndarray, motions: Motions) -> np.ndarray:
    """(h, w) bool: parts beside an object's component (h, w) bool that moved as it did, did not stay and did not come.

    part  (h, w) int, see :func:`p2p_lib.segmenters.builtin.patch.connected_components`
    """
    size = np.bincount(part.ravel())
    count = len(size)
    adjacent = np.zeros(count, bool)
    adjacent[part[dilated(component, _NEAR) & ~component]] = True
    adjacent[part[component]] = False
    adjacent &= size >= _FEWEST
    adjacent[0] = False
    at_border = np.bincount(part[patch.border()], minlength=count) / patch.border().sum()
    adjacent &= at_border < AT_THE_BORDER
    v, u = np.nonzero(adjacent[part])
    if not len(v) or not scene_stays(patch, motions):
        return np.zeros(patch.shape, bool)
    p_cam, rgb = patch.points()[v, u], patch.rgb[v, u]
    moved = agrees(p_cam, rgb, patch.camera, *motions.recent)
    stayed = agrees(p_cam, rgb, patch.camera, motions.recent[0], np.eye(4))
    empty = np.zeros(len(v), bool)
    for then, T_then_now in motions.compared:
        _, behind_m, step_m = _looked_at(p_cam, patch.camera, then, T_then_now)
        empty |= behind_m > step_m
    moved, stayed, empty = (np.bincount(part[v, u], w, count) / np.maximum(size, 1) for w in (moved, stayed, empty))
    return (adjacent & (moved > _AGREES) & (stayed < _UNDECIDED) & (empty < _EMPTY))[part]
