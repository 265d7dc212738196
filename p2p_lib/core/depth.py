"""Measured depth: its noise, its edges, and points lifted with it (paper: section "Sampling Strategy")."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import compiled
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.errors import BadInput, doubt
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import Frame

# Holds the slope back where few or collinear readings would let noise choose it; nine readings outweigh it twelvefold.
_RIDGE = 0.5
#: Few depth cameras see half of their pixels farther than this, m.
_FAR_M = 50.0
#: The share of pixels among which the nearest may be wild.
_NEAREST = 0.05
#: A smaller share of an object's pixels with depth does not say where it is.
_HARDLY = 0.02
_MILLIMETRES = "is it in millimetres?"
#: What depth cameras have about: the built-in tracker and segmenter assume it of any.
USUAL = DepthConfig()


def depth_noise_m(z_m: np.ndarray, config: DepthConfig = USUAL) -> np.ndarray:
    """Standard deviation of depth measured at z_m: that of a depth sensor, growing with the range squared."""
    return config.noise_m + config.noise_per_m2 * z_m**2


def in_range(depth_m: np.ndarray, config: DepthConfig) -> np.ndarray:
    """(H, W) bool: measured, and neither too near nor too far."""
    return (depth_m >= config.min_m) & (depth_m <= config.max_m)


def check_metres(frame: Frame) -> None:
    """Refuse depth that cannot be in metres, since nothing is near; warn of what hardly is."""
    if not frame.depth_m.any():
        return
    near_m, middle_m = _near_and_middle_m(frame.depth_m)
    what = f"depth of frame {frame.index}"
    fix = f"{_MILLIMETRES.capitalize()} Give metres: divide by 1000 (files, in p2p: --depth-scale 0.001)."
    if near_m > _FAR_M:
        raise BadInput(what, f"{near_m:.0f} m and more", f"objects nearer than {_FAR_M:g} m", fix)
    if middle_m > _FAR_M:
        doubt(what, f"{middle_m:.0f} m in the middle", fix)


def depth_trouble(frame: Frame, mask: np.ndarray | None) -> str:
    """Why depth does not say where an object is, in words; "" where it may.

    mask  (H, W) bool: the object's pixels; None where they are unknown
    """
    if not frame.depth_m.any():
        return "the frame has no usable depth"
    if far := far_depth(frame):
        return far
    measured, pixels = (0, 0) if mask is None else (np.count_nonzero(frame.depth_m[mask]), np.count_nonzero(mask))
    return f"{measured} of {pixels} mask pixels have depth" if measured < _HARDLY * pixels else ""


def far_depth(frame: Frame) -> str:
    """That depth cannot be in metres, since nothing is near, in words; "" where it may."""
    some_m = frame.sparse["depth_m"]
    if some_m.any() and (near_m := _near_and_middle_m(some_m)[0]) > _FAR_M:
        return f"the depth of the frame is {near_m:.0f} m and more: {_MILLIMETRES}"
    return ""


def _near_and_middle_m(depth_m: np.ndarray) -> tuple[float, float]:
    """How far the nearest of what is measured is, but for a few wild readings, and its middle."""
    near_m, middle_m = np.quantile(depth_m[depth_m > 0], [_NEAREST, 0.5]).tolist()
    return near_m, middle_m


def off_edges(depth_m: np.ndarray, edge_m: float) -> np.ndarray:
    """(H, W) bool: the whole 3x3 neighbourhood is measured and holds no step larger than ``edge_m``."""
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth_m, around), cv2.dilate(depth_m, around)
    return (low > 0) & (high - low <= edge_m)


def of_one_surface(
    depth_m: np.ndarray, mask: np.ndarray, border_px: int, edge_m: float, narrow: bool = True
) -> np.ndarray:
    """(H, W) bool: pixels of a mask whose depth does not mix two surfaces.

    Off a border of the mask, with a whole 3x3 neighbourhood that holds no step larger than ``edge_m``.

    narrow  whether parts that are too narrow for this keep the pixels that agree with what is around them in the mask
    """
    border, near = (np.ones((2 * reach_px + 1,) * 2, np.uint8) for reach_px in (border_px, 2 * border_px))
    inner = cv2.erode(mask.astype(np.uint8), border, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    found = (inner > 0) & off_edges(depth_m, edge_m)
    thin = mask & (cv2.dilate(inner, near) == 0)  # the corner of something wide is not narrow
    if narrow and thin.any():
        found |= _agreeing(np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(mask, bool), thin, edge_m)
    return found


@compiled("f4[:,::1], b1[:,::1], b1[:,::1], f8")
def _agreeing(depth_m: np.ndarray, mask: np.ndarray, part: np.ndarray, edge_m: float) -> np.ndarray:
    """(H, W) bool: pixels of a part of a mask that most of what the mask measures around them agrees with.

    Around is the 5x5 neighbourhood, of which it measures two pixels at least; readings agree that differ by
    ``edge_m`` at most. On something a few pixels wide no neighbourhood is whole.
    """
    height, width = depth_m.shape
    out = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            if not (part[v, u] and depth_m[v, u] > 0):
                continue
            measured, near = 0, 0
            for j in range(max(v - 2, 0), min(v + 3, height)):
                for i in range(max(u - 2, 0), min(u + 3, width)):
                    if mask[j, i] and depth_m[j, i] > 0:
                        measured += 1
                        near += abs(depth_m[j, i] - depth_m[v, u]) <= edge_m
            out[v, u] = near > 2 and 2 * near > measured
    return out


def depths_at(uv_px: np.ndarray, frame: Frame, radius: int = 2) -> np.ndarray:
    """(N,) median depth around each pixel (N, 2); NaN where nothing is measured."""
    d = np.arange(-radius, radius + 1)
    around = np.stack(np.meshgrid(d, d), -1).reshape(-1, 2)
    u, v = nearest_px(np.rint(uv_px)[:, None] + around, frame.shape)
    return np.ma.median(np.ma.masked_equal(frame.depth_m[v, u], 0), axis=1).astype(float).filled(np.nan)


def lift(frame: Frame, uv_px: np.ndarray, camera: Camera, config: DepthConfig) -> np.ndarray:
    """Points p_cam (N, 3) behind pixels uv_px (N, 2); NaN rows where there is no trustworthy depth.

    Depth is that of a plane, least squares through the readings in the 3x3 neighbourhood that lie within
    ``config.edge_m`` of the nearest pixel's: it averages sensor noise without mixing two surfaces, and gives a
    slanted surface its depth at the pixel's fraction too. Depth outside ``config.min_m`` to ``config.max_m`` is
    invalid.
    """
    uv_px = np.ascontiguousarray(uv_px, float)
    depth_m = _plane_depths(frame.depth_m, uv_px, config.min_m, config.max_m, config.edge_m)
    return camera.unproject(uv_px, depth_m)


@compiled("f4[:,::1], f8[:,::1], f8, f8, f8")
def _plane_depths(depth_m: np.ndarray, uv_px: np.ndarray, min_m: float, max_m: float, edge_m: float) -> np.ndarray:
    """(N,) depth at each pixel (N, 2), NaN where there is none to trust."""
    height, width = depth_m.shape
    out = np.full(len(uv_px), np.nan)
    for row in range(len(uv_px)):
        u, v = uv_px[row]
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):  # NaN is outside as well
            continue
        column, line = int(np.rint(u)), int(np.rint(v))
        centre_m = depth_m[line, column]
        if not min_m <= centre_m <= max_m:
            continue
        # Sums over the readings on its surface: of their offsets from the middle, of their depths from the middle's.
        n, x, y, xx, yy, xy, d, xd, yd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(max(line - 1, 0), min(line + 2, height)):
            for i in range(max(column - 1, 0), min(column + 2, width)):
                z = depth_m[j, i]
                if min_m <= z <= max_m and abs(z - centre_m) <= edge_m:
                    a, b, c = float(i - column), float(j - line), float(z) - float(centre_m)
                    n, x, y, xx, yy, xy = n + 1, x + a, y + b, xx + a * a, yy + b * b, xy + a * b
                    d, xd, yd = d + c, xd + a * c, yd + b * c
        d, x, y = d / n, x / n, y / n
        xx, yy, xy = xx - n * x * x + _RIDGE, yy - n * y * y + _RIDGE, xy - n * x * y
        xd, yd = xd - n * x * d, yd - n * y * d
        determinant = xx * yy - xy * xy
        along_x, along_y = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
        out[row] = centre_m + d + along_x * (u - column - x) + along_y * (v - line - y)
    return out
