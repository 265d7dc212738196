"""A rectangle of an RGB-D image on a small grid, on which segmentation is cheap, and its geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin import random_walk
from p2p_lib.segmenters.builtin.colours import colour_codes

#: Depth changes from pixel to pixel of the grid by this much on surfaces seen at a slant.
_SLANT_M = 0.004
#: A plane that holds less than this share of the pixels supports nothing.
_SUPPORTS = 0.2


@dataclass(frozen=True)
class Box:
    """Columns [left, right) and rows [top, bottom) of an image."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.bottom - self.top, self.right - self.left

    @property
    def slices(self) -> tuple[slice, slice]:
        """To index an image with."""
        return np.s_[self.top : self.bottom, self.left : self.right]


def around(centre: np.ndarray, half: np.ndarray, shape: tuple[int, int]) -> Box:
    """The box of ``half`` (x, y) to each side of a centre (x, y), cut to the image; never empty."""
    size = np.array(shape[::-1])
    low = np.clip(np.floor(centre - half).astype(int), 0, size - 2)
    high = np.clip(np.ceil(centre + half).astype(int) + 1, low + 2, size)
    return Box(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


@dataclass(frozen=True, eq=False)
class Patch:
    """A box of a frame, no side longer than ``config.side_px``.

    rgb       (h, w, 3) uint8, averaged
    depth_m   (h, w) nearest reading, 0 = not measured
    sigma_m   (h, w) noise of the depth
    """

    box: Box
    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray
    sigma_m: np.ndarray

    @classmethod
    def of(cls, frame: Frame, box: Box, camera: Camera, config: SegmentationConfig) -> Patch:
        """The patch of a frame's box."""
        h, w = box.shape
        scale = min(1.0, config.side_px / max(h, w))
        size = max(2, round(w * scale)), max(2, round(h * scale))
        rgb = cv2.resize(frame.rgb[box.slices], size, interpolation=cv2.INTER_AREA)
        z = cv2.resize(frame.depth_m[box.slices], size, interpolation=cv2.INTER_NEAREST)
        return cls(box, camera, rgb, z, depth_noise_m(z))

    @cached_property
    def gray(self) -> np.ndarray:
        """(h, w) uint8."""
        return cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY)

    @cached_property
    def codes(self) -> np.ndarray:
        """(h, w) int, see :func:`colour_codes`."""
        return colour_codes(self.rgb)

    @cached_property
    def step_m(self) -> np.ndarray:
        """(h, w): a larger change of depth from pixel to pixel is an edge, beyond noise and slant."""
        return depth_step_m(self.depth_m)

    @cached_property
    def smooth(self) -> np.ndarray:
        """(h, w) bool: measured, and no depth edge to the right or below."""
        z, step, smooth = self.depth_m, self.step_m, self.depth_m > 0
        smooth[:, :-1] &= np.abs(z[:, 1:] - z[:, :-1]) <= np.maximum(step[:, 1:], step[:, :-1])
        smooth[:-1] &= np.abs(z[1:] - z[:-1]) <= np.maximum(step[1:], step[:-1])
        return smooth

    @cached_property
    def edge_weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Of neighbours, see :func:`p2p_lib.segmenters.builtin.random_walk.edge_weights`."""
        lab = cv2.cvtColor(self.rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
        return random_walk.edge_weights(lab, self.depth_m, self.step_m)

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the grid."""
        return self.depth_m.shape

    def down(self, image: np.ndarray) -> np.ndarray:
        """A float image (H, W), averaged onto the grid."""
        return cv2.resize(image[self.box.slices], self.shape[::-1], interpolation=cv2.INTER_AREA)

    def nearest(self, image: np.ndarray) -> np.ndarray:
        """An image (H, W) on the grid, each pixel that of its nearest."""
        return cv2.resize(image[self.box.slices], self.shape[::-1], interpolation=cv2.INTER_NEAREST)

    def up(self, values: np.ndarray) -> np.ndarray:
        """Values (h, w) of the grid at the pixels of the box."""
        h, w = self.box.shape
        return cv2.resize(values.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)

    def grid(self, uv_px: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of the image as nearest columns and rows of the grid; those outside it are left out."""
        (h, w), size = self.shape, np.array(self.box.shape[::-1])
        at = (np.asarray(uv_px, float) - [self.box.left, self.box.top] + 0.5) * (np.array([w, h]) / size) - 0.5
        at = np.rint(at).astype(int)
        return at[((at >= 0) & (at < [w, h])).all(1)]

    def dots(self, uv_px: np.ndarray, radius: int) -> np.ndarray:
        """(h, w) bool: squares around pixels of the image."""
        at, dots = self.grid(uv_px), np.zeros(self.shape, bool)
        dots[at[:, 1], at[:, 0]] = True
        return dilated(dots, radius)

    def nearer(self, one: np.ndarray, other: np.ndarray, like: float) -> np.ndarray:
        """(h, w) bool: the pixels that are nearer to ``one`` (h, w) bool than to ``other``, over like pixels.

        like  length of a step between pixels that are alike; one across the strongest edge has length 1
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        number = np.arange(self.depth_m.size).reshape(self.shape)
        right, below = self.edge_weights
        ends = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
        starts = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
        length = like + 1 - np.concatenate([right.ravel(), below.ravel()])
        grid = coo_array((length, (starts, ends)), shape=(number.size,) * 2).tocsr()
        to_one, to_other = (
            dijkstra(grid, directed=False, indices=number[of], min_only=True) if of.any() else np.inf
            for of in (one, other)
        )
        return np.broadcast_to(to_one < to_other, number.size).reshape(self.shape)

    def border(self) -> np.ndarray:
        """(h, w) bool: the outermost pixels."""
        edge = np.ones(self.shape, bool)
        edge[1:-1, 1:-1] = False
        return edge

    def points(self) -> np.ndarray:
        """(h, w, 3) in the camera's frame; 0 where nothing is measured."""
        x, y = self.rays()
        return np.stack(np.broadcast_arrays(x, y[:, None], 1.0), -1) * self.depth_m[..., None]

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """The slopes x / z of the columns (w,) and y / z of the rows (h,)."""
        (h, w), (rows, cols) = self.shape, self.box.shape
        u = (np.arange(w) + 0.5) * (cols / w) - 0.5 + self.box.left
        v = (np.arange(h) + 0.5) * (rows / h) - 0.5 + self.box.top
        return (u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy


def depth_step_m(depth_m: np.ndarray) -> np.ndarray:
    """Of what depth (...,): a larger change than this is an edge, beyond noise and slant."""
    return 3 * depth_noise_m(depth_m) + _SLANT_M


def dilated(region: np.ndarray, radius: int) -> np.ndarray:
    """A region (h, w) bool with ``radius`` pixels around it."""
    return cv2.dilate(region.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0


def connected(region: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The parts of a region (h, w) bool that hold a seed."""
    count, part = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
    holds = np.zeros(count, bool)
    holds[part[seeds]] = True
    holds[0] = False
    return holds[part]


def support_plane(patch: Patch, where: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """(4,) n, d with n . p = d and n towards the camera: the plane of at least a fifth of the pixels; else None."""
    v, u = np.nonzero(where)
    if len(v) < 100:
        return None
    some = rng.integers(0, len(v), 400)
    x, y = patch.rays()
    z = patch.depth_m[v, u][some].astype(float)
    p = np.stack([x[u[some]] * z, y[v[some]] * z, z], -1)
    within = 2 * patch.sigma_m[v, u][some]
    a, b, c = np.moveaxis(p[rng.integers(0, len(p), (80, 3))], 1, 0)
    n = np.cross(b - a, c - a)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
    off = np.abs(p @ n.T - (n * a).sum(1))
    best = (off < within[:, None]).sum(0).argmax()
    inliers = off[:, best] < within
    for _ in range(3):
        if inliers.mean() < _SUPPORTS:
            return None
        centre = p[inliers].mean(0)
        q = p[inliers] - centre
        normal = np.linalg.eigh(q.T @ q)[1][:, 0]
        d = normal @ centre
        inliers = np.abs(p @ normal - d) < within
    return np.append(normal, d) * (-1 if d > 0 else 1)


def plane_heights(patch: Patch, plane: np.ndarray) -> np.ndarray:
    """(h, w) metres above a plane, towards the camera; those of unmeasured pixels mean nothing."""
    x, y = patch.rays()
    return (plane[0] * x + plane[1] * y[:, None] + plane[2]) * patch.depth_m - plane[3]
