"""What the tracker needs of a frame, computed once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.image import in_image, in_mask, nearest_px
from p2p_lib.core.types import Frame

#: Pyramid levels of Lucas-Kanade above full resolution: with a window of 13 px it follows jumps of about 50 px.
_LEVELS = 3


@dataclass(frozen=True, eq=False)
class Image:
    """One frame. Pixels uv_px (N, 2) may lie outside of it, or be NaN.

    gray     (H, W) uint8; fine and coarse: the same and half as large, float32
    chroma   (H/4, W/4, 2) float32, CIELAB a and b
    half     (H/2, W/2, 3) uint8, of every other row and column, smoothed
    depth_m  (H, W), 0 where not measured
    """

    gray: np.ndarray
    fine: np.ndarray
    coarse: np.ndarray
    chroma: np.ndarray
    half: np.ndarray
    depth_m: np.ndarray
    camera: Camera

    @classmethod
    def of(cls, frame: Frame, camera: Camera) -> Image:
        """Of a frame taken by this camera."""
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        quarter = cv2.resize(frame.rgb, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        chroma = cv2.cvtColor(quarter, cv2.COLOR_RGB2LAB)[..., 1:].astype(np.float32)
        fine, coarse = gray.astype(np.float32), cv2.pyrDown(gray).astype(np.float32)
        return cls(gray, fine, coarse, chroma, cv2.pyrDown(frame.rgb), frame.depth_m, camera)

    def chroma_at(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 2) around pixels."""
        return sampled(self.chroma, ((uv_px + 0.5) / 4 - 0.5).astype(np.float32)[..., None])[:, 0]

    def depth_at(self, uv_px: np.ndarray) -> np.ndarray:
        """(N,) metres at the nearest pixels, 0 where nothing was measured."""
        u, v = nearest_px(uv_px, self.depth_m.shape)
        return self.depth_m[v, u].astype(float)

    def inside(self, uv_px: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
        """(N,) bool: pixels in the image, and in the region (H, W) if there is one."""
        inside = in_image(uv_px, self.gray.shape)
        return inside if region is None else inside & in_mask(uv_px, region)


def sampled(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N, P, ...) values of an image at pixels (N, 2, P) float32, bilinear, the border repeated."""
    if not len(at):
        return np.zeros((0, at.shape[2], *image.shape[2:]), np.float32)
    return cv2.remap(image, at[:, 0], at[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def flow(before: Image, after: Image, uv_px: np.ndarray, window_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Lucas-Kanade from pixels (N, 2) float32: where they went, and whether (N,) they were found.

    Only the part of the images around the pixels is read.
    """
    h, w = before.gray.shape
    reach = window_px << _LEVELS
    x0, y0 = np.maximum(np.floor(uv_px.min(0)).astype(int) - reach, 0)
    x1, y1 = np.minimum(np.ceil(uv_px.max(0)).astype(int) + reach, [w, h])
    if min(x1 - x0, y1 - y0) < reach:
        x0, y0, x1, y1 = 0, 0, w, h
    part, origin = np.s_[y0:y1, x0:x1], np.array([x0, y0], np.float32)
    there, window = np.empty_like(uv_px), (window_px, window_px)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before.gray[part], after.gray[part], uv_px - origin, there, winSize=window, maxLevel=_LEVELS
    )
    return moved + origin, found[:, 0] > 0
