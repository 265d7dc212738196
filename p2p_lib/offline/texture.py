"""The texture of a model: each texel what most of the sharp views all around have there, by how well they show it.

The exposure of the views is evened out first: a gain per view and channel, from points that several of them show. What
no view shows keeps the surface's own colour.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import evenly
from p2p_lib.offline.finished import Finished, Renderer

#: Views that a texture is baked from, at most, each the sharpest of so many near it.
VIEWS, _SHARPEST_OF = 96, 2
#: One in so many frames with a trusted pose is held out of the texture, to measure its error.
HELD_OUT_EVERY = 10
#: A pixel shows a surface point that is at most so far behind the rendered depth, if that is at most so far off the
#: measured one, m.
_BEHIND_M, _MEASURED_M = 0.004, 0.015
#: Texels seen more obliquely than this cosine are not taken from a view.
_FACING = 0.25
#: Pixels along a mask's border that may belong to something else.
_BORDER_PX = 3
#: So often a texel's colours are weighed anew by how near they are to its colour; as near as this is as good, of 255.
_REWEIGHED, _NEAR = 3, 4.0


@dataclass(frozen=True, eq=False)
class View:
    """An image of an object: rgb (H, W, 3) float32, ``shows`` (H, W) bool where it reliably shows it, and sharpness.

    depth_m (H, W) of the surface as rendered, infinite where it is not met.
    """

    frame: int
    T_cam_obj: np.ndarray
    rgb: np.ndarray
    shows: np.ndarray
    depth_m: np.ndarray
    sharpness: float


def view_of(made: Finished, name: str, row: int, render: Renderer) -> View:
    """The object in the ``row``-th frame of a run."""
    i, T = int(made.frames[row]), made.run.objects[name].T_cam_obj[row]
    frame, mask = made.sequence.frame(i), made.masks(i).get(name)
    depth_m = render(T).depth_in(frame.rgb)
    near = (frame.depth_m == 0) | (np.abs(frame.depth_m - depth_m) < _MEASURED_M)
    shows = np.isfinite(depth_m) & near if mask is None else np.isfinite(depth_m) & near & mask
    shows = cv2.erode(shows.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2)) > 0
    edges = cv2.Laplacian(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), cv2.CV_32F)
    sharp = float(edges[shows].std()) if shows.sum() > 100 else 0.0
    return View(i, T, frame.rgb.astype(np.float32), shows, depth_m, sharp)


def chosen_rows(made: Finished, name: str, rows: np.ndarray, render: Renderer) -> list[View]:
    """Of the frames ``rows`` the sharpest of some near each of :data:`VIEWS` directions that lie far apart."""
    T_obj_cam = se3.inverse(made.run.objects[name].T_cam_obj[rows])
    way = T_obj_cam[:, :3, 3] / np.linalg.norm(T_obj_cam[:, :3, 3], axis=1, keepdims=True)
    seeds, far = [0], np.linalg.norm(way - way[0], axis=1)
    while len(seeds) < min(VIEWS, len(rows)) and far.max() > 1e-3:
        seeds.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(way - way[seeds[-1]], axis=1))
    nearest = np.linalg.norm(way[:, None] - way[seeds][None], axis=-1).argmin(1)
    best: list[View] = []
    for k in range(len(seeds)):
        members = np.flatnonzero(nearest == k)
        views = (view_of(made, name, int(rows[member]), render) for member in evenly(members, _SHARPEST_OF))
        sharpest = max(views, key=lambda view: view.sharpness)
        best += [sharpest] if sharpest.sharpness > 0 else []
    return best


def sampled(view: View, camera: Camera, p_obj: np.ndarray, normal: np.ndarray):
    """Which of surface points (N, 3) with normals (N, 3) show in a view (M,), their colours (M, 3), and how well (M,).

    What faces away is left out first, then what the image does not show: of all points few are looked up.
    """
    T = view.T_cam_obj.astype(np.float32)
    away = p_obj - se3.inverse(view.T_cam_obj)[:3, 3].astype(np.float32)
    towards = -np.einsum("ij,ij->i", normal, away)
    rows = np.flatnonzero(towards > _FACING * np.sqrt(np.einsum("ij,ij->i", away, away)))
    p_cam = p_obj[rows] @ T[:3, :3].T + T[:3, 3]
    uv = np.nan_to_num(camera.project(p_cam), nan=-9.0).astype(np.float32)
    u, v = nearest_px(uv, view.shows.shape)
    seen = camera.inside(uv) & view.shows[v, u] & (p_cam[:, 2] < view.depth_m[v, u] + _BEHIND_M)
    rows, z, uv = rows[seen], p_cam[seen, 2], uv[seen]
    cosine = towards[rows] / np.linalg.norm(away[rows], axis=1)
    return rows, lookup(view.rgb, uv), cosine * view.sharpness * camera.fx / np.maximum(z, 1e-3)


def lookup(image: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
    """(N, 3) an image (H, W, 3) interpolated at (N, 2), in parts, since OpenCV limits the columns of an image."""
    if not len(uv_px):
        return np.zeros((0, image.shape[2]), image.dtype)
    parts = np.array_split(uv_px.astype(np.float32), -(-len(uv_px) // 30_000))
    return np.concatenate([cv2.remap(image, p[None, :, 0], p[None, :, 1], cv2.INTER_LINEAR)[0] for p in parts])


def evened(views: list[View], camera: Camera, p_obj: np.ndarray, normal: np.ndarray) -> list[View]:
    """The views with gains, on average 1, that make their colours of common surface points (N, 3) agree."""
    value = np.full((len(views), len(p_obj), 3), np.nan)
    for of, view in zip(value, views):
        rows, colour, _ = sampled(view, camera, p_obj, normal)
        usable = ((colour > 12) & (colour < 245)).all(1)
        of[rows[usable]] = np.log(colour[usable])
    usable = np.isfinite(value[..., 0])
    gain = np.zeros((len(views), 3))
    shared = usable.sum(0) > 1
    for _ in range(10 if shared.any() else 0):
        mean = np.nanmean(value[:, shared] - gain[:, None], axis=0)
        enough = usable[:, shared].sum(1) > 20
        off = np.zeros_like(gain)
        off[enough] = np.nanmedian(value[enough][:, shared] - mean, axis=1)
        gain = off - off[enough].mean(0) if enough.any() else gain
    return [replace(view, rgb=np.clip(view.rgb / np.exp(g), 0, 255).astype(np.float32)) for view, g in zip(views, gain)]


def baked(
    views: Collection[View], camera: Camera, p_obj: np.ndarray, normal: np.ndarray, own: np.ndarray
) -> np.ndarray:
    """(N, 3) uint8 of surface points (N, 3): near the median of views, weighted by how well each shows it, or ``own``.

    A reflection, or a finger, is elsewhere in most views. Not the best view: its pose is off by a pixel or two, and so
    is that of the next image.
    """
    colour = np.zeros((len(p_obj), 3), np.float32)
    for weighed in range(1 + _REWEIGHED):
        total, weight = np.zeros_like(colour), np.zeros(len(p_obj), np.float32)
        for view in views:
            rows, seen, shown = sampled(view, camera, p_obj, normal)
            w = shown.astype(np.float32)
            if weighed:  # iteratively reweighted least squares, for the least sum of distances
                w /= _NEAR + np.abs(seen - colour[rows]).mean(1)
            total[rows] += w[:, None] * seen
            weight[rows] += w
        found = weight > 0
        colour[found] = total[found] / weight[found, None]
    return np.clip(np.rint(np.where(found[:, None], colour, own)), 0, 255).astype(np.uint8)


def colour_error(view: View, rendered: np.ndarray, shown: np.ndarray) -> float:
    """Mean absolute difference (0 to 255) of a rendered image (H, W, 3) where it is ``shown`` (H, W).

    Under the gains, one per channel, by which it is least: the medians of the ratios, weighted by what is multiplied.
    """
    use = view.shows & shown
    if use.sum() < 50:
        return float("nan")
    mine, true = np.maximum(rendered[use], 1).astype(float), view.rgb[use].astype(float)
    ratio = true / mine
    order = ratio.argsort(0, kind="stable")
    below = np.take_along_axis(mine, order, 0).cumsum(0)
    middle = (below < below[-1] / 2).sum(0)
    gain = np.take_along_axis(ratio, order, 0)[middle, np.arange(3)]
    return float(np.abs(np.clip(mine * gain, 0, 255) - true).mean())
