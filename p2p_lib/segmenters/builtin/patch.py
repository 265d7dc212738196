"""A rectangle of an RGB-D image on a small grid, on which segmentation is cheap, and its geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.depth_edges import depth_step_m
from p2p_lib.core.image import ends_px
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin import random_walk
from p2p_lib.segmenters.builtin.colours import colour_codes

#: At most so many values are used for a median.
_ENOUGH = 400
#: Points drawn to find a support plane, and planes tried.
_PLANE_POINTS, _PLANES = 250, 150
#: Twice the area of the smallest triangle that determines a plane, m2.
_SMALLEST_M2 = 1e-3
#: The three points of each plane, by a low-discrepancy sequence (Roberts 2018).
_STEPS = np.array([0.8191725134, 0.6710436067, 0.5497004779])
_TRIPLES = ((0.5 + np.arange(_PLANES) * _STEPS[:, None]) % 1 * _PLANE_POINTS).astype(int)
#: A support plane holds at least this share of the pixels.
_SUPPORTS = 0.2
#: What ends within a patch may cover up to this share of its border by accident.
AT_THE_BORDER = 0.02


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

    def near(self, other: Box, within_px: int) -> bool:
        """Whether the gap to another box is smaller than this in both directions."""
        across = max(self.left, other.left) - min(self.right, other.right)
        return max(across, max(self.top, other.top) - min(self.bottom, other.bottom)) < within_px


def around(centre: np.ndarray, half: np.ndarray, shape: tuple[int, int]) -> Box:
    """The box of ``half`` (x, y) to each side of a centre (x, y), cut to the image; never empty."""
    size = np.array(shape[::-1])
    low = np.clip(np.floor(centre - half).astype(int), 0, size - 2)
    high = np.clip(np.ceil(centre + half).astype(int) + 1, low + 2, size)
    return Box(*low.tolist(), *high.tolist())


@dataclass(frozen=True, eq=False)
class Patch:
    """A box of a frame on a grid of square cells, no side longer than ``config.side_px`` cells.

    cell_px   side of a cell in pixels: a whole number, by which images are scaled several times faster
    rgb       (h, w, 3) uint8, averaged
    depth_m   (h, w) reading at the centre, 0 = not measured
    sigma_m   (h, w) standard deviation of the depth
    """

    box: Box
    cell_px: int
    camera: Camera
    rgb: np.ndarray
    depth_m: np.ndarray
    sigma_m: np.ndarray

    @classmethod
    def of(cls, frame: Frame, box: Box, camera: Camera, config: SegmentationConfig) -> Patch:
        """The patch of a frame's box, enlarged to whole cells; at the end of the image it may be cut instead."""
        cell_px = -(-max(box.shape) // config.side_px)
        return cls.like(frame, _whole_cells(box, cell_px, frame.shape), cell_px, camera)

    @classmethod
    def like(cls, frame: Frame, box: Box, cell_px: int, camera: Camera) -> Patch:
        """The patch of a frame on a given grid: a box of whole cells."""
        rgb, z = _averaged(frame.rgb[box.slices], cell_px), _middles(frame.depth_m[box.slices], cell_px)
        return cls(box, cell_px, camera, rgb, z, depth_noise_m(z))

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
        """(h, w): a larger change of depth from cell to cell is an edge, beyond noise and slant."""
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
        """Ties of neighbouring cells, see :func:`p2p_lib.segmenters.builtin.random_walk.edge_weights`."""
        lab = cv2.cvtColor(self.rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
        return random_walk.edge_weights(lab, self.depth_m, self.step_m)

    def outline_tie(self, mask: np.ndarray) -> float:
        """Mean tie across the outline of a mask (h, w) bool: 0 if all of it is edges, 1 if none is or there is none."""
        right, below = self.edge_weights
        ties = np.concatenate([right[mask[:, 1:] != mask[:, :-1]], below[mask[1:] != mask[:-1]]])
        return float(ties.mean()) if len(ties) else 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the grid."""
        return self.depth_m.shape

    def down(self, image: np.ndarray) -> np.ndarray:
        """A float image (H, W), averaged onto the grid."""
        return _averaged(image[self.box.slices], self.cell_px)

    def nearest(self, image: np.ndarray) -> np.ndarray:
        """An image (H, W) on the grid, sampled at the cells' middles."""
        return _middles(image[self.box.slices], self.cell_px)

    def up(self, values: np.ndarray) -> np.ndarray:
        """Values (h, w) of the grid, interpolated at the pixels of the box."""
        h, w = self.box.shape
        return cv2.resize(values.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)

    def dots(self, uv_px: np.ndarray, radius: int) -> np.ndarray:
        """(h, w) bool: squares of ``radius`` cells around pixels (N, 2) of the image; those outside are left out."""
        dots = np.zeros(self.shape, bool)
        at = np.rint((uv_px - [self.box.left, self.box.top] + 0.5) / self.cell_px - 0.5).astype(int)
        u, v = at[((at >= 0) & (at < self.shape[::-1])).all(1)].T
        dots[v, u] = True
        return dilated(dots, radius)

    def ends_px(self, region: np.ndarray) -> np.ndarray:
        """(2, 2) x, y of the first pixel of a region (h, w) bool in the image, and of the first beyond it."""
        return ends_px(region) * self.cell_px + [self.box.left, self.box.top]

    def nearer(self, one: np.ndarray, other: np.ndarray, like: float) -> np.ndarray:
        """(h, w) bool: the cells that are nearer to ``one`` (h, w) bool than to ``other``, see :meth:`away`."""
        return self.away(one, like) < self.away(other, like)

    def away(self, region: np.ndarray, like: float) -> np.ndarray:
        """(h, w) lengths of paths along like cells to a region (h, w) bool; infinite where it is empty.

        like  length of a step between cells that are alike; one across the strongest edge is longer by 1
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        if not region.any():
            return np.full(self.shape, np.inf)
        number = np.arange(self.depth_m.size).reshape(self.shape)
        right, below = self.edge_weights
        ends = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
        starts = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
        length = like + 1 - np.concatenate([right.ravel(), below.ravel()])
        grid = coo_array((length, (starts, ends)), shape=(number.size,) * 2).tocsr()
        return dijkstra(grid, directed=False, indices=number[region], min_only=True).reshape(self.shape)

    def border(self) -> np.ndarray:
        """(h, w) bool: the outermost pixels."""
        edge = np.ones(self.shape, bool)
        edge[1:-1, 1:-1] = False
        return edge

    def encloses(self, region: np.ndarray) -> bool:
        """Whether a region (h, w) bool ends within the patch, rather than going on beyond it."""
        return bool(region[self.border()].mean() <= AT_THE_BORDER)

    def points(self) -> np.ndarray:
        """(h, w, 3) in the camera's frame; 0 where nothing is measured."""
        x, y = self.rays()
        return np.stack(np.broadcast_arrays(x, y[:, None], 1.0), -1) * self.depth_m[..., None]

    def squared_distances_m2(self, p_cam: np.ndarray) -> np.ndarray:
        """(h, w) from a point (3,) in the camera's frame; meaningless where nothing is measured."""
        x, y = self.rays()
        z, (x_m, y_m, z_m) = self.depth_m, p_cam.astype(np.float32)
        return (x.astype(np.float32) * z - x_m) ** 2 + (y[:, None].astype(np.float32) * z - y_m) ** 2 + (z - z_m) ** 2

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """The slopes x / z of the columns (w,) and y / z of the rows (h,)."""
        u, v = self.centres_px()
        return (u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy

    def centres_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Image coordinates of the middles of the grid's columns (w,) and rows (h,)."""
        u, v = ((np.arange(n) + 0.5) * self.cell_px - 0.5 for n in self.shape[::-1])
        return u + self.box.left, v + self.box.top


def _whole_cells(box: Box, cell_px: int, shape: tuple[int, int]) -> Box:
    """A box of whole cells around another, inside an image where that is possible."""
    low, high, end = np.array([box.left, box.top]), np.array([box.right, box.bottom]), np.array(shape[::-1])
    size = np.minimum(np.maximum(-(-(high - low) // cell_px), 2), end // cell_px) * cell_px
    low = np.minimum(low, end - size)
    return Box(*low.tolist(), *(low + size).tolist())


def _averaged(image: np.ndarray, cell_px: int) -> np.ndarray:
    """The means of an image (rows, columns, ...) over its cells."""
    size = image.shape[1] // cell_px, image.shape[0] // cell_px
    return image.copy() if cell_px == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _middles(image: np.ndarray, cell_px: int) -> np.ndarray:
    """An image (rows, columns, ...) sampled at the middle of each cell."""
    return image[cell_px // 2 :: cell_px, cell_px // 2 :: cell_px].copy()


def approximate_median(values: np.ndarray) -> float:
    """The median of values (N,), by some hundreds of them where there are many: exact medians are slow."""
    return float(np.median(values[:: 1 + len(values) // _ENOUGH]))


def dilated(region: np.ndarray, radius: int) -> np.ndarray:
    """A region (h, w) bool with ``radius`` pixels around it."""
    return cv2.dilate(region.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0


def connected_components(region: np.ndarray) -> np.ndarray:
    """(h, w) int: the number of each connected component of a region (h, w) bool, 0 outside it."""
    return cv2.connectedComponents(region.astype(np.uint8), connectivity=4)[1]


def components_touching(part: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """(h, w) bool: the components, see :func:`connected_components`, that hold a seed."""
    holds = np.zeros(part.max() + 1, bool)
    holds[part[seeds]] = True
    holds[0] = False
    return holds[part]


def keep_seeded_components(x: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The probabilities (h, w) without the components that hold no seed (h, w) bool."""
    return np.where(components_touching(connected_components(x > 0.5), seeds) | (x <= 0.5), x, 0)


def support_plane(patch: Patch, where: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray | None:
    """(4,) n, d with n . p = d and n towards the camera: the plane of at least a fifth of the pixels; else None.

    where   (h, w) bool, the pixels that may belong to it; fewer than 100 have no plane
    weight  (h, w) of each; None: all the same

    Planes through three of some evenly spread pixels are compared, and the best is refitted: a deterministic RANSAC.
    """
    at = np.flatnonzero(where)
    if len(at) < 100:
        return None
    v, u = np.divmod(at[np.linspace(0, len(at) - 1, _PLANE_POINTS).astype(int)], patch.shape[1])
    x, y = patch.rays()
    z = patch.depth_m[v, u].astype(float)
    p = np.stack([x[u] * z, y[v] * z, z], -1)
    share = np.ones(len(p)) if weight is None else weight[v, u].astype(float)
    share /= share.sum()
    within = 2 * patch.sigma_m[v, u]
    a, b, c = p[_TRIPLES]
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n /= np.maximum(length, 1e-9)
    off = np.abs(p @ n.T - (n * a).sum(1))
    inliers_of = np.where(length[:, 0] > _SMALLEST_M2, share @ (off < within[:, None]), 0)
    best = inliers_of.argmax()
    inliers = off[:, best] < within
    for _ in range(3):
        if share @ inliers < _SUPPORTS:
            return None
        centre = share[inliers] @ p[inliers] / share[inliers].sum()
        q = p[inliers] - centre
        normal = np.linalg.eigh(q.T @ (q * share[inliers, None]))[1][:, 0]
        d = normal @ centre
        inliers = np.abs(p @ normal - d) < within
    return np.append(normal, d) * (-1 if d > 0 else 1)


def plane_heights(patch: Patch, plane: np.ndarray) -> np.ndarray:
    """(h, w) metres above a plane, towards the camera; meaningless where nothing is measured."""
    x, y = patch.rays()
    return (plane[0] * x + plane[1] * y[:, None] + plane[2]) * patch.depth_m - plane[3]
