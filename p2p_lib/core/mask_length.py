"""How long what a mask holds is, by depth, and whether a correction has made it much longer than it was."""

from __future__ import annotations

from collections import deque

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import doubt
from p2p_lib.core.types import Frame, median_of_known

#: One pixel of a square of this side is looked at.
CELL_PX = 4
#: These pixels of an image.
CELLS = np.s_[::CELL_PX, ::CELL_PX]
#: Of what a mask holds, so much is left out at each end when it is measured: depth is wild at an object's edges.
_ENDS = 0.05
#: A mask that holds something so many times as long as usual holds something else besides.
GROWN = 1.3
#: It is measured in every so many frames, and of so many the usual length is taken.
_MEASURED, _LENGTHS = 5, 300


def mask_length_m(frame: Frame, mask: np.ndarray, camera: Camera) -> float:
    """The length along its longest axis of what a mask (H, W) bool holds, by depth; NaN where nothing is measured."""
    return length_and_middle(measured_in(frame, mask, camera))[0]


def whole_length_m(frame: Frame, mask: np.ndarray, camera: Camera) -> float:
    """The same, and NaN, too, where the mask reaches the image's border, which may cut what it holds."""
    cut = any(side.any() for side in (mask[:CELL_PX], mask[-CELL_PX:], mask[:, :CELL_PX], mask[:, -CELL_PX:]))
    return float("nan") if cut else mask_length_m(frame, mask, camera)


def measured_in(frame: Frame, mask: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 3) what was measured of a mask at the pixels :data:`CELLS`."""
    at = np.argwhere(mask[CELLS])
    depth_m = frame.depth_m[CELLS][mask[CELLS]]
    return camera.unproject(CELL_PX * at[depth_m > 0, ::-1], depth_m[depth_m > 0])


def length_and_middle(p_cam: np.ndarray) -> tuple[float, np.ndarray]:
    """The length of points (N, 3) along their longest axis without the outermost at both ends, and their median."""
    if len(p_cam) < 3:
        return float("nan"), np.full(3, np.nan)
    centre_m = np.median(p_cam, axis=0)
    low, high = np.quantile(p_cam[:, 2], [_ENDS, 1 - _ENDS])
    near = p_cam[(p_cam[:, 2] >= low) & (p_cam[:, 2] <= high)]
    axis = np.linalg.eigh(np.cov(near.T))[1][:, -1] if len(near) > 3 else np.array([1.0, 0, 0])
    along_m = np.quantile(p_cam @ axis, [_ENDS, 1 - _ENDS])
    return float(np.ptp(along_m)) / (1 - 2 * _ENDS), centre_m


class UsualLengths:
    """How long what each object's masks hold uncut usually is; tells a correction that makes it much longer."""

    def __init__(self, camera: Camera):
        self._camera = camera
        self._lengths_m: dict[str, deque[float]] = {}

    def forget(self, name: str) -> None:
        """Nothing is known of an object any more."""
        self._lengths_m.pop(name, None)

    def doubt(self, name: str, frame: Frame, mask: np.ndarray | None, prompted: bool) -> str:
        """What is doubtful about an object's mask (H, W) bool in a frame, ``prompted`` there or not; often nothing."""
        before_m = self._lengths_m.setdefault(name, deque(maxlen=_LENGTHS))
        if mask is None or not (prompted or frame.index % _MEASURED == 0 or not before_m):
            return ""
        said = ""
        if prompted:
            said = doubt_growth(name, frame.index, mask_length_m(frame, mask, self._camera), np.array(before_m))
        before_m.append(whole_length_m(frame, mask, self._camera))
        return said


def doubt_growth(name: str, frame_index: int, length_m: float, before_m: np.ndarray) -> str:
    """Warn of a correction that makes an object's mask much longer than it was in frames before, m; NaN: unknown.

    Returns the warning; empty where there is none.
    """
    factor = length_m / median_of_known(before_m)
    if not factor > GROWN:
        return ""
    got = f"its mask is {100 * length_m:.0f} cm long now, {factor:.1f} times as long as before"
    fix = "If it holds more than the object: negative clicks on what is not it, a box, or a painted mask."
    return doubt(f"correction of {name!r} in frame {frame_index}", got, fix, name)
