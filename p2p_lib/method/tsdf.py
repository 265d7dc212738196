"""3D reconstruction: one truncated signed distance volume per object (paper: 3D Reconstruction, appendix).

A dense grid in the object frame, in memory or on a CUDA device (:mod:`p2p_lib.core.voxels`).
The grid grows in blocks with the object, never beyond ``max_voxels``. Weighted sums and weights are kept
apart, so that an observation can be taken out and fused again where the factor graph has moved its keyframe.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.voxels import CpuGrid, MaskedImage, TorchGrid

if TYPE_CHECKING:
    import trimesh

#: The grid's sides are multiples of this many voxels, so that it grows seldom.
BLOCK = 8
#: Room around new surface when the grid grows.
_PADDING_M = 0.02
#: Depth pixels looked at to decide where the object is.
_REGION_POINTS = 4000
#: A jump in sorted depth that separates the object from whatever else the mask caught.
_DEPTH_GAP_M = 0.05
#: Step of the numeric gradient (the release's).
_GRADIENT_VOXELS = 0.5
#: A pose may be off a rigid one by this: annotated poses are rounded, and fusing needs an affine map only.
_POSE_TOLERANCE = 5e-3
#: Background this near to the mask does not carve: mask and pose are not exact to a pixel.
_CARVE_MARGIN_PX = 1


@dataclass(frozen=True, eq=False)
class View(MaskedImage):
    """One masked RGB-D observation with a border of a pixel; its box is kept, so that it can be taken out exactly.

    corner    column and row in the image of the cut's first pixel inside the border
    """

    corner: tuple[int, int]
    camera: Camera
    T_cam_obj: np.ndarray

    @cached_property
    def centre_cam(self) -> np.ndarray:
        """(3,) middle of the cut's pixels at the median depth."""
        (h, w), (left, top) = self.inside.shape, self.corner
        return self.camera.unproject(np.array([left + w / 2, top + h / 2]), np.median(self.depth_m[self.inside]))


def _clear_of(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels farther than :data:`_CARVE_MARGIN_PX` from the mask."""
    kernel = np.ones((2 * _CARVE_MARGIN_PX + 1,) * 2, np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel) == 0


class TsdfVolume:
    """The fused surface of one object (paper: V(v), W(v) and their colours).

    Voxel (i, j, k) of the lattice is centred on ``anchor_m + voxel_m * (i, j, k)`` in the object frame;
    the arrays hold lattice indices ``lo`` to ``lo + shape``. With ``origin_m`` and ``shape`` the grid is
    fixed there and does not grow.

    Raises :class:`BadInput` for a fixed grid beyond ``config.max_voxels``, :class:`MissingBackend` without the device.
    """

    def __init__(
        self,
        config: TsdfConfig,
        *,
        origin_m: np.ndarray | None = None,
        shape: tuple[int, ...] = (0, 0, 0),
        device: str = "cpu",
    ):
        self.config = config
        self.voxel_m, self.tau_m = config.voxel_m, config.voxel_m * config.truncation_voxels
        self.grows = 0 in shape
        self.anchor_m = np.zeros(3) if origin_m is None else np.asarray(origin_m, float)
        if np.prod(shape) > config.max_voxels:
            raise BadInput("tsdf shape", "x".join(map(str, shape)), f"at most {config.max_voxels} voxels")
        self.views: dict[int, View] = {}  # observations of keyframes, oldest first, that are kept for re-integration
        self._total = 0.0  # of all weights
        self.lo = np.zeros(3, int)
        self._grid = CpuGrid(shape) if device == "cpu" else TorchGrid(shape, device)

    # -- state ---------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels per axis; (0, 0, 0) before the first observation."""
        return tuple(self._grid.weight.shape)

    @property
    def empty(self) -> bool:
        """Whether no voxel has been observed."""
        return self._total == 0

    @property
    def origin_m(self) -> np.ndarray:
        """(3,) centre of the first voxel in the object frame."""
        return self.anchor_m + self.voxel_m * self.lo

    def corners_m(self) -> np.ndarray:
        """(8, 3) corners of the grid in the object frame."""
        corners = np.array(np.meshgrid(*zip(self.lo, self.lo + self.shape, strict=True), indexing="ij"))
        return self.anchor_m + self.voxel_m * corners.reshape(3, -1).T

    def values(self) -> np.ndarray:
        """(nx, ny, nz) float32: V(v) = the mean of min(1, d / tau), normalised to [-1, 1]; NaN where unobserved."""
        return self._grid.host(self._grid.value)

    def weights(self) -> np.ndarray:
        """(nx, ny, nz) float32: W(v), the sum of observation weights."""
        return self._grid.host(self._grid.weight)

    def colours(self) -> np.ndarray:
        """(nx, ny, nz, 4) float32: sums of weighted red, green and blue (0 to 255) and of their weights.

        Averaged over the observations that met the voxel inside the truncation band; those that looked
        past it saw the colour of something else.
        """
        return np.moveaxis(self._grid.host(self._grid.colour), 0, -1)

    # -- fusing --------------------------------------------------------------------------------

    def integrate(
        self,
        depth_m: np.ndarray,
        rgb: np.ndarray,
        mask: np.ndarray,
        camera: Camera,
        T_cam_obj: np.ndarray,
        key: int | None = None,
    ) -> int:
        """Fuse one masked RGB-D image; returns how many voxels it touched.

        Projective update of the appendix: d(v) = D(pi(v)) - z(v) with depth sampled at the nearest
        pixel; a voxel outside the image or mask, at an invalid depth, or with d < -tau is left alone;
        the others take min(1, d / tau) into their weighted mean. With ``config.carve`` (ours) voxels
        before the background, d >= tau, take 1, too.

        depth_m (H, W) metres, 0 or not finite = invalid; rgb (H, W, 3) uint8; mask (H, W) bool.
        With ``key`` the observation is kept and can be moved (:meth:`move`) or taken out (:meth:`remove`),
        whether or not the grid has grown.
        An empty mask or one without any valid depth touches nothing.

        Raises :class:`BadInput` for arrays of other shapes or a pose that is not rigid.
        """
        T_cam_obj = se3.check("tsdf T_cam_obj", T_cam_obj, _POSE_TOLERANCE)
        view = self._view(depth_m, rgb, mask, camera, T_cam_obj)
        if view is None:
            return 0
        if key is not None:
            self.remove(key)
            self.views[key] = view
        return self._fuse(view, 1.0)

    def put(self, lo: np.ndarray, index: np.ndarray, value: np.ndarray, weight: np.ndarray, rgbw: np.ndarray) -> None:
        """Set voxels as :meth:`CpuGrid.put` does, in a grid that begins at lattice index ``lo`` (3,) and may grow."""
        self._grid.put(index, value, weight, rgbw)
        self.lo, self.grows, self._total = lo.copy(), True, float(weight.sum())

    def remove(self, key: int) -> bool:
        """Take a kept keyframe's observation out of the volume; False if there is none."""
        view = self.views.pop(key, None)
        if view is not None:
            self._fuse(view, -1.0)
        return view is not None

    def keep_only(self, keys: Iterable[int]) -> None:
        """Let go of the kept observations of all other keyframes: they stay fused, and cannot be moved any more."""
        kept = set(map(int, keys))
        self.views = {key: view for key, view in self.views.items() if key in kept}

    def move(self, poses: Mapping[int, np.ndarray], limit: int | None = None) -> list[int]:
        """Re-integrate the kept observations of keyframes that the graph has moved (T_cam_obj by key).

        Those whose cloud moved by more than half a voxel or 0.5 degrees, the farthest first and at most
        ``limit`` of them (None: all); the rest stay where they are for a later
        call. Poses that are not finite are passed over. Returns the keys moved.
        """
        known = [key for key in poses if key in self.views]
        if not known:
            return []
        T_new = np.stack([np.asarray(poses[key], float) for key in known])
        T_old = np.stack([self.views[key].T_cam_obj for key in known])
        centre = np.stack([self.views[key].centre_cam for key in known])[:, None]
        shift = se3.transform(se3.inverse(T_new), centre) - se3.transform(se3.inverse(T_old), centre)
        excess = np.maximum(
            np.linalg.norm(shift[:, 0], axis=-1) / (0.5 * self.voxel_m),
            se3.angle_rad(se3.inverse(T_old) @ T_new) / np.deg2rad(0.5),
        )
        order = [i for i in np.argsort(-excess, kind="stable") if excess[i] > 1 and np.isfinite(T_new[i]).all()]
        for i in order[:limit]:
            view = self.views[known[i]]
            self._fuse(view, -1.0)
            self._put(known[i], view, T_new[i])
        return [known[i] for i in order[:limit]]

    def join(self, other: TsdfVolume, T_obj_other: np.ndarray, shift: int) -> None:
        """Fuse another volume's kept observations, moved into this frame by T_obj_other (4, 4), at keys + ``shift``.

        Observations that it has let go of are lost.
        """
        for key, view in other.views.items():
            self._put(key + shift, view, view.T_cam_obj @ se3.inverse(T_obj_other))

    def _put(self, key: int, view: View, T_cam_obj: np.ndarray) -> None:
        """Fuse and keep a view at a pose."""
        moved = replace(view, T_cam_obj=T_cam_obj)
        self._grow(moved)
        lo, hi = self._frustum_box(moved)
        self.views[key] = moved = replace(moved, lo=lo, hi=hi)
        self._fuse(moved, 1.0)

    def _view(self, depth_m, rgb, mask, camera: Camera, T_cam_obj) -> View | None:
        depth_m, mask = np.asarray(depth_m), np.asarray(mask, bool)
        want = (camera.height, camera.width)
        if depth_m.shape != want or mask.shape != want or np.shape(rgb) != (*want, 3):
            got = f"depth {depth_m.shape}, mask {mask.shape}, rgb {np.shape(rgb)}"
            raise BadInput("tsdf image", got, f"{want} as the camera")
        rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if len(rows) == 0:
            return None
        image = (depth_m, rgb, mask, camera, T_cam_obj)
        view = self._cut(cols[0], rows[0], cols[-1] + 1, rows[-1] + 1, *image)
        if not view.inside.any():
            return None
        self._grow(view)
        if self.config.carve:
            view = self._cut(*self._window(view), *image)
        lo, hi = self._frustum_box(view)
        return replace(view, lo=lo, hi=hi)

    def _cut(self, left, top, right, bottom, depth_m, rgb, mask, camera, T_cam_obj) -> View:
        """The view of these columns and rows of an image."""
        cut = np.s_[top:bottom, left:right]
        depth, mask = np.asarray(depth_m[cut], np.float32), mask[cut]
        measured = (depth > 0) & (depth < np.inf)
        inside = np.pad(mask & measured, 1)
        used = inside[1:-1, 1:-1] | (measured & _clear_of(mask) if self.config.carve else False)
        depth = np.pad(np.where(used, depth, -np.inf), 1, constant_values=-np.inf)
        rgbw = np.ones((4, *inside.shape), np.uint8)
        rgbw[:3, 1:-1, 1:-1] = np.moveaxis(np.asarray(rgb)[cut], -1, 0)
        return View(depth, inside, rgbw, self.lo, self.lo, (left, top), camera, T_cam_obj)

    def _window(self, view: View) -> tuple[int, int, int, int]:
        """Window [left, top, right, bottom) that the grid projects to; the whole image where it reaches the camera."""
        p_cam = se3.transform(view.T_cam_obj, self.corners_m())
        width, height = view.camera.width, view.camera.height
        if p_cam[:, 2].min() <= 0.01:
            return 0, 0, width, height
        uv = view.camera.project(p_cam)
        left, top = np.clip(np.floor(uv.min(0)), 0, (width - 1, height - 1)).astype(int)
        right, bottom = np.clip(np.ceil(uv.max(0)) + 1, (left + 1, top + 1), (width, height)).astype(int)
        return int(left), int(top), int(right), int(bottom)

    def _region(self, view: View) -> np.ndarray:
        """(2, 3) robust bounds of the masked cloud in the object frame, unpadded.

        The largest run of depths without a gap, and of it all but the outermost half percent on each
        side: a mask that bleeds onto the background or a wild pixel does not move them.
        """
        v, u = np.nonzero(view.inside)
        keep = np.linspace(0, len(u) - 1, min(len(u), _REGION_POINTS)).astype(int)
        v, u = v[keep], u[keep]
        z = view.depth_m[v, u].astype(float)
        ranked = np.sort(z)
        run = max(np.split(ranked, np.flatnonzero(np.diff(ranked) > _DEPTH_GAP_M) + 1), key=len)
        own = (z >= run[0]) & (z <= run[-1])
        uv_px = np.stack([u[own] - 1 + view.corner[0], v[own] - 1 + view.corner[1]], -1)
        p_obj = se3.transform(se3.inverse(view.T_cam_obj), view.camera.unproject(uv_px, z[own]))
        return np.percentile(p_obj, [0.5, 99.5], axis=0)

    def _grow(self, view: View) -> None:
        """Make room for the view's cloud."""
        if not self.grows:
            return
        region = self._region(view)
        pad = max(_PADDING_M, self.tau_m)
        want_lo = np.floor((region[0] - pad - self.anchor_m) / self.voxel_m / BLOCK).astype(int) * BLOCK
        want_hi = np.ceil((region[1] + pad - self.anchor_m) / self.voxel_m / BLOCK).astype(int) * BLOCK
        old_lo, old_hi = self.lo, self.lo + self.shape
        if 0 in self.shape:
            old_lo = (want_lo + want_hi) // 2 // BLOCK * BLOCK
            old_hi = old_lo + BLOCK
        lo, hi = self._capped(old_lo, old_hi, np.minimum(want_lo, old_lo), np.maximum(want_hi, old_hi))
        if (lo != self.lo).any() or (hi - lo != self.shape).any():
            self._grid.enlarge(tuple((hi - lo).tolist()), tuple((self.lo - lo).tolist()))
            self.lo = np.array(lo, int)

    def _capped(self, old_lo, old_hi, want_lo, want_hi) -> tuple[np.ndarray, np.ndarray]:
        """The largest share of the wanted growth, equal on all sides, that stays within ``max_voxels``."""
        if np.prod((want_hi - want_lo).astype(float)) <= self.config.max_voxels:
            return want_lo, want_hi
        lo, hi = old_lo, old_hi
        low, high = 0.0, 1.0
        for _ in range(24):
            share = (low + high) / 2
            a = old_lo + np.ceil((want_lo - old_lo) * share / BLOCK).astype(int) * BLOCK
            b = old_hi + np.floor((want_hi - old_hi) * share / BLOCK).astype(int) * BLOCK
            if np.prod((b - a).astype(float)) <= self.config.max_voxels:
                low, lo, hi = share, a, b
            else:
                high = share
        return lo, hi

    def _frustum_box(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Lattice box [lo, hi) of the grid's voxels that project into the view and lie before its depth + tau."""
        lo, hi = self.lo, self.lo + self.shape
        corners = np.array(np.meshgrid(*zip(lo, hi - 1, strict=True), indexing="ij")).reshape(3, -1).T
        z = se3.transform(view.T_cam_obj, self.anchor_m + self.voxel_m * corners)[:, 2]
        far = min(float(view.depth_m.max()) + self.tau_m, z.max())
        near = max(z.min(), 0.0)
        if far <= near:
            return lo, lo
        h, w = view.depth_m.shape
        u, v = (view.corner[0] + np.array([-1.5, w - 1.5]), view.corner[1] + np.array([-1.5, h - 1.5]))
        uvz = np.array(np.meshgrid(u, v, [near, far], indexing="ij")).reshape(3, -1).T
        p_obj = se3.transform(se3.inverse(view.T_cam_obj), view.camera.unproject(uvz[:, :2], uvz[:, 2]))
        index = (p_obj - self.anchor_m) / self.voxel_m
        box_lo = np.clip(np.floor(index.min(0)).astype(int), lo, hi)
        return box_lo, np.clip(np.ceil(index.max(0)).astype(int) + 1, box_lo, hi)

    def _fuse(self, view: View, weight: float) -> int:
        """Fuse a view, or take it out with weight -1; returns how many voxels it touched."""
        if (view.hi <= view.lo).any():
            return 0
        cam = view.camera
        K = np.array([[cam.fx, 0, cam.cx - view.corner[0] + 1], [0, cam.fy, cam.cy - view.corner[1] + 1], [0, 0, 1.0]])
        A = K @ view.T_cam_obj[:3, :3] * self.voxel_m
        b = K @ se3.transform(view.T_cam_obj, self.anchor_m[None])[0]
        touched = self._grid.fuse(view, A, b, self.lo, weight, self.tau_m, self.config.carve)
        self._total += weight * touched
        return touched

    # -- asking --------------------------------------------------------------------------------

    def query(self, p_obj: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance in metres (tau times the normalised V) at points (..., 3) of the object frame.

        Trilinear. Returns (value_m (...,) float64, valid (...,) bool); a point is valid where all eight
        voxels around it have been observed, and its value is 0 where it is not. Positive is outside.
        """
        p_obj = np.asarray(p_obj, float)
        value, valid = self._sample(p_obj.reshape(-1, 3), np.zeros((1, 3)))
        return np.where(valid, value[0], 0.0).reshape(p_obj.shape[:-1]), valid.reshape(p_obj.shape[:-1])

    def query_with_gradient(self, p_obj: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value in metres and its numeric gradient (no unit) by central differences over +- half a voxel.

        Points (N, 3) to (value_m (N,), gradient (N, 3), valid (N,)); valid where the value and all six
        neighbours are, and both are 0 where not.
        """
        offsets = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * _GRADIENT_VOXELS
        value, valid = self._sample(np.asarray(p_obj, float).reshape(-1, 3), offsets)
        gradient = (value[1:4] - value[4:7]).T / (2 * _GRADIENT_VOXELS * self.voxel_m)
        return np.where(valid, value[0], 0.0), np.where(valid[:, None], gradient, 0.0), valid

    def _sample(self, p_obj: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (K, N), m, at points (N, 3) moved by offsets (K, 3) in voxels; (N,) whether all K are valid."""
        if min(self.shape) < 2 or not len(p_obj):
            return np.zeros((len(offsets), len(p_obj))), np.zeros(len(p_obj), bool)
        index = (p_obj - self.origin_m) / self.voxel_m
        value = self._grid.at(index, offsets)
        return value * self.tau_m, ~np.isnan(value.sum(0))

    def mesh(self, min_component: float = 0.1) -> trimesh.Trimesh:
        """The zero level with vertex colours, see :func:`p2p_lib.core.mesh.extract`."""
        from p2p_lib.core.mesh import extract

        return extract(self.values(), self.colours(), self.origin_m, self.voxel_m, min_component)
