"""Depth of another moment than its colour, moved onto it (not in the paper; ours).

Many cameras do not take the two together: while they turn fast, depth lies tens of pixels beside colour, and an object
gets the depth of what is behind it. It then lies along the way that the image has moved since the frame before, so
that one number is looked for: after which share of that way do steps of depth lie on edges of brightness?
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from p2p_lib.core.depth_edges import brightness_edges, near_sides
from p2p_lib.core.errors import DEPTH_MOVED, Doubt
from p2p_lib.core.types import Frame

if TYPE_CHECKING:
    from p2p_lib.datasets.sequence import Sequence

#: Widths of the images in which the camera's motion, and the offset of depth, are looked for, px.
_FLOW_PX, _EDGES_PX = 160, 320
#: Mean change of brightness, grey levels, below which the camera does not move.
_STILL = 2.0
#: Every so many pixels a motion is taken; most of them have to agree, within so many pixels, with that of the image.
_STRIDE_PX, _AGREE_PX, _AGREEING = 8, 3.0, 0.5
#: Shares of the way that are tried: depth may be late by up to a frame, or early.
_SHARES = np.linspace(-1, 1, 17)
#: With fewer pixels on the near side of steps there is no answer.
_MIN_STEPS = 150
#: The gradient of brightness on steps has to be above its mean, and above that where depth lies, by so many of its
#: standard deviations.
_MIN_FIT, _MIN_GAIN = 0.3, 0.1
#: A way that is too short to tell, as a fraction of the image's width; and an offset after which a camera is known to
#: take the two apart, so that smaller ones are no noise: of cameras that take both together 0.015 is found at most.
_SHORT, _OFF = 0.005, 0.02


class DepthLag:
    """What moves depth onto the colour of the same frame, in a stream of them.

    off_px  the first offset that is too large for a camera that takes both together; 0.0 until one is seen
    """

    def __init__(self) -> None:
        self.off_px = 0.0
        self._before: np.ndarray | None = None
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    @property
    def doubt(self) -> tuple[str, str]:
        """What is wrong with a camera that takes them apart, in words, and what to do."""
        got = f"of different moments while the camera moves, {self.off_px:.0f} px apart"
        return got, "Depth is moved onto colour from then on; poses are better of a camera that takes both together."

    def moved(self, frame: Frame) -> np.ndarray | None:
        """The depth (H, W) of the next frame where it has to be moved; where it moves in from outside, unmeasured."""
        per_frame = self._motion(frame.rgb)
        if per_frame is None:
            return None
        height, width = frame.shape
        way_px = float(np.hypot(*per_frame @ [width / 2, height / 2, 1]))
        share = _late(frame, per_frame) if way_px > (_SHORT if self.off_px else _OFF) * width else 0.0
        if not self.off_px and abs(share) * way_px > _OFF * width:
            self.off_px = abs(share) * way_px
        if not share or not self.off_px:
            return None
        onto = share * per_frame + np.eye(2, 3)
        return cv2.warpAffine(frame.depth_m, onto, (width, height), flags=cv2.INTER_NEAREST)

    def _motion(self, rgb: np.ndarray) -> np.ndarray | None:
        """(2, 3) how far the image has moved at a pixel (u, v, 1) since the frame before; None where nothing tells."""
        height, width = rgb.shape[:2]
        small = (_FLOW_PX, round(height * _FLOW_PX / width))
        if small[1] < _STRIDE_PX:
            return None  # a strip
        gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), small, interpolation=cv2.INTER_AREA)
        before, self._before = self._before, gray
        if before is None or before.shape != gray.shape or cv2.absdiff(before, gray).mean() < _STILL:
            return None
        flow = self._flow.calc(before, gray, None)
        v, u = (_STRIDE_PX * at.ravel() + _STRIDE_PX // 2 for at in np.indices([n // _STRIDE_PX for n in gray.shape]))
        at = np.stack([u, v], -1).astype(np.float32)
        found, agree = cv2.estimateAffinePartial2D(at, at + flow[v, u], ransacReprojThreshold=_AGREE_PX, maxIters=200)
        if found is None or agree.mean() < _AGREEING:
            return None
        motion, scale = found - np.eye(2, 3), width / _FLOW_PX
        motion[:, 2] = scale * motion[:, 2] - motion[:, :2].sum(1) * (scale - 1) / 2
        return motion


def as_the_run_took(sequence: Sequence, i: int, doubts: Iterable[Doubt]) -> Frame:
    """Frame i of a run's sequence, its depth moved onto its colour where the run had to do so.

    doubts  of the run
    """
    frame, lag = sequence.frame(i), DepthLag()
    if not i or not any(doubt.kind == DEPTH_MOVED for doubt in doubts):
        return frame
    lag.off_px = 1.0  # small offsets count, too
    lag.moved(sequence.frame(i - 1))
    depth_m = lag.moved(frame)
    return frame if depth_m is None else replace(frame, depth_m=depth_m)


def _late(frame: Frame, per_frame: np.ndarray) -> float:
    """The share of the way since the frame before after which depth fits brightness best; 0.0 in doubt."""
    stride = max(1, frame.shape[1] // _EDGES_PX)
    steps = near_sides(np.ascontiguousarray(frame.depth_m[::stride, ::stride]))
    v, u = np.nonzero(steps)
    if len(u) < _MIN_STEPS:
        return 0.0
    edges = brightness_edges(cv2.resize(frame.rgb, steps.shape[::-1], interpolation=cv2.INTER_AREA))
    edges = np.pad((edges - edges.mean()) / max(float(edges.std()), 1e-6), 1)  # beyond the image nothing speaks
    at = np.stack([u, v], -1)
    way = np.column_stack([stride * at, np.ones(len(at))]) @ per_frame.T / stride
    end = np.rint(at + _SHARES[:, None, None] * way).astype(int) + 1
    end = np.clip(end, 0, np.array(edges.shape[::-1]) - 1)
    fits = edges[end[..., 1], end[..., 0]].mean(1)
    best = fits.argmax()
    clear = fits[best] > max(_MIN_FIT, fits[len(_SHARES) // 2] + _MIN_GAIN)
    return float(_SHARES[best]) if clear else 0.0
