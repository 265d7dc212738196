"""The pinhole camera. OpenCV axes: x right, y down, z forward; an integer pixel is a pixel centre."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.image import in_image

#: No camera without distortion has a focal length of a smaller share of its image's width: it sees 157 degrees.
_WIDEST = 0.1
#: Nor does any see farther off its axis than that to one side, which holds for each part of its image, too.
_OFF_AXIS = 0.5 / _WIDEST


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels and image size in pixels, no distortion.

    >>> camera = Camera(fx=600, fy=600, cx=319.5, cy=239.5, width=640, height=480)
    >>> camera.project([0.1, 0, 0.5]).tolist()
    [439.5, 239.5]
    >>> camera.unproject([439.5, 239.5], 0.5).tolist()
    [0.1, 0.0, 0.5]
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        numbers = all(isinstance(value, Real) and np.isfinite(value) for value in values)
        if not numbers or self.fx <= 0 or self.fy <= 0:
            raise BadInput("camera", f"fx, fy, cx, cy = {values}", "finite numbers, focal lengths above 0 (pixels)")
        if self.width < 1 or self.height < 1:
            raise BadInput("camera", f"{self.width}x{self.height}", "an image size of at least 1x1 pixels")
        self._check_view()
        for name, value in zip(("fx", "fy", "cx", "cy"), values):
            object.__setattr__(self, name, float(value))

    @classmethod
    def from_K(cls, K: np.ndarray, width: int, height: int, name: str = "K") -> Camera:
        """From a 3x3 matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], or its nine numbers as ROS gives them.

        ``name`` is what errors call it.
        """
        K = np.asarray(K, float)
        K = K.reshape(3, 3) if K.shape == (9,) else K
        if K.shape != (3, 3):
            raise BadInput(name, f"shape {K.shape}", "a 3x3 camera matrix")
        pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
        if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K - pinhole).max() > 1e-6:
            turned = K[2, 2] == 1 and K[2, 0] > 0 and K[2, 1] > 0 and not K[:2, 2].any()
            fix = "Is it transposed? cx and cy end the first and the second row." * bool(turned)
            raise BadInput(name, " ".join(f"{x:g}" for x in K.ravel()), "fx 0 cx 0 fy cy 0 0 1 with fx, fy > 0", fix)
        try:
            return cls(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), int(width), int(height))
        except BadInput as error:
            raise BadInput(name, error.got, error.expected, error.fix) from None

    def _check_view(self) -> None:
        """Refuse what no camera sees."""
        fields = (("x", "columns", self.fx, self.cx, self.width), ("y", "rows", self.fy, self.cy, self.height))
        for axis, what, f, c, size in fields:
            if f < _WIDEST * size:
                fix = "Normalised ones times the width, the height below, are pixels."
                raise BadInput("camera", f"f{axis} = {f:g} for {size} {what}", "focal lengths in pixels", fix)
            if (off := max(c + 0.5, size - 0.5 - c) / f) > _OFF_AXIS:
                got = f"c{axis} = {c:g} for {size} {what}, of which one is {_degrees(off)} degrees off the axis"
                fix = "Take fx, fy, cx and cy at the images' size; of a part of larger images cx and cy may be outside."
                raise BadInput("camera", got, f"{_degrees(_OFF_AXIS)} degrees at most", fix)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same images at another size in pixels."""
        sx, sy = width / self.width, height / self.height
        # Integer pixels are pixel centres: an image begins half a pixel before its first one.
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return Camera(self.fx * sx, self.fy * sy, cx, cy, width, height)

    @property
    def K(self) -> np.ndarray:
        """(3, 3) camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, p_cam: np.ndarray) -> np.ndarray:
        """Points (..., 3) in metres to pixels (..., 2); points at or behind the camera give NaN."""
        p_cam = np.asarray(p_cam, float)
        z = np.where(p_cam[..., 2] > 1e-9, p_cam[..., 2], np.nan)
        return np.stack([self.fx * p_cam[..., 0] / z + self.cx, self.fy * p_cam[..., 1] / z + self.cy], -1)

    def unproject(self, uv_px: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) and depth along the optical axis (...,) to points (..., 3) in metres."""
        uv_px, z = np.asarray(uv_px, float), np.asarray(depth_m, float)
        x = (uv_px[..., 0] - self.cx) / self.fx * z
        y = (uv_px[..., 1] - self.cy) / self.fy * z
        return np.stack([x, y, z], -1)

    @cached_property
    def rays(self) -> np.ndarray:
        """(H, W, 3) float32: the point at unit depth behind every pixel."""
        v, u = np.mgrid[: self.height, : self.width]
        return self.unproject(np.stack([u, v], -1), np.ones((self.height, self.width))).astype(np.float32)

    def inside(self, uv_px: np.ndarray, margin_px: float = 0.0) -> np.ndarray:
        """Which pixels (..., 2) lie in the image; NaN does not."""
        return in_image(uv_px, (self.height, self.width), margin_px)


def _degrees(tangent: float) -> str:
    return f"{np.degrees(np.arctan(tangent)):.0f}"
