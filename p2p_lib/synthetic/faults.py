"""A sequence in which something goes wrong, for a while or throughout: camera, depth or masks fail.

For what tracking is worth then, and for what ``p2p check`` finds. Each fault of :data:`FAULTS` is a function of what a
camera and a segmenter deliver, with a severity in the unit that its line says; equal seeds give equal faults.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.datasets.truth import ObjectTruth

Masks = dict[str, np.ndarray]
#: Readings that no depth camera should give.
_WILD_M = np.array([1e15, 9e3, 30.0, 0.05, -1.0, np.inf, np.nan])
#: A board passes at this share of the way to the nearest object.
_BOARD_SHARE = 0.7
#: After a cut to a turned view so many frames are left.
_LEFT = 60


@dataclass(frozen=True)
class Fault:
    """What a fault changes: images and time, masks (copies of the frame's), the camera, or which frames there are.

    Each but the camera's is told the sequence that it is in, and the frame of the original.

    shown     the frame whose images and masks are delivered
    left_out  the frames that are not there, (K,) indices
    """

    frame: Callable[[Frame, Faulty, int], Frame] = lambda frame, of, i: frame
    masks: Callable[[Masks, Faulty, int], Masks] = lambda masks, of, i: masks
    camera: Callable[[Camera, float], Camera] = lambda camera, by: camera
    shown: Callable[[Faulty, int], int] = lambda of, i: i
    left_out: Callable[[Faulty], np.ndarray] = lambda of: np.zeros(0, int)


@dataclass(frozen=True, eq=False)
class Faulty:
    """A :class:`~p2p_lib.datasets.sequence.Sequence` with a fault in its frames ``start`` to ``stop`` (None: the end).

    Truth and ``visible_px`` stay the original's, so that the same frames are scored. Where frames are left out, those
    that remain are counted anew.
    """

    original: Sequence
    fault: str
    severity: float = 1.0
    start: int = 0
    stop: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.fault not in FAULTS:
            raise BadInput("fault", repr(self.fault), "one of " + ", ".join(FAULTS))
        stop = len(self.original) if self.stop is None else self.stop
        if not 0 <= self.start < stop <= len(self.original):
            raise BadInput("frames of a fault", f"{self.start} to {stop}", f"some of {len(self.original)}")
        object.__setattr__(self, "stop", stop)

    @property
    def end(self) -> int:
        """The frame of the original after all of it."""
        return len(self.original) if self.stop is None else self.stop

    @cached_property
    def kept(self) -> np.ndarray:
        """The original's frames that are there."""
        return np.setdiff1d(np.arange(len(self.original)), FAULTS[self.fault].left_out(self))

    @property
    def during(self) -> tuple[int, int]:
        """The frames of the fault, from and to, as they are counted here; none of them where all are left out."""
        first, end = np.searchsorted(self.kept, (self.start, self.end))
        return int(first), int(end)

    @property
    def camera(self) -> Camera:
        """The camera as it is said to be."""
        return FAULTS[self.fault].camera(self.original.camera, self.severity)

    @property
    def times_s(self) -> np.ndarray:
        """Of the frames that are there."""
        return self.original.times_s[self.kept]

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Of the frames that are there."""
        return tuple(self.original.frame_names[i] for i in self.kept)

    @property
    def truth(self) -> dict[str, ObjectTruth]:
        """The original's, of the frames that are there."""
        known = self.original.truth.items()
        return {name: ObjectTruth(of.T_cam_model[self.kept], of.labelled[self.kept]) for name, of in known}

    def frame(self, i: int) -> Frame:
        """The i-th image with the fault, where it acts."""
        k, fault = self._acting(i)
        frame = self.original.frame(fault.shown(self, k))
        return fault.frame(replace(frame, index=i, time_s=float(self.original.times_s[k])), self, k)

    def masks(self, i: int) -> Masks | None:
        """The masks at frame i with the fault, where it acts."""
        k, fault = self._acting(i)
        masks = self.original.masks(fault.shown(self, k))
        return None if masks is None else fault.masks(masks, self, k)

    def visible_px(self, i: int) -> dict[str, int] | None:
        """The original's."""
        return self.original.visible_px(int(self.kept[i]))

    def rng(self, k: int) -> np.random.Generator:
        """Another one for each frame of the original."""
        return np.random.default_rng([self.seed, k])

    @property
    def before(self) -> int:
        """The frame before all of it."""
        return max(self.start - 1, 0)

    def _acting(self, i: int) -> tuple[int, Fault]:
        """What frame i is of the original, and the fault that acts there."""
        k = int(self.kept[i])
        return k, FAULTS[self.fault if self.start <= k < self.end else "none"]

    def __len__(self) -> int:
        return len(self.kept)

    def __getattr__(self, name: str) -> Any:
        """The original's name, objects and models."""
        return getattr(self.original, name)


def _depth(change: Callable[[np.ndarray, Faulty, int], np.ndarray]) -> Fault:
    """Changes depth (H, W) in metres."""
    return Fault(frame=lambda frame, of, i: replace(frame, depth_m=change(frame.depth_m, of, i).astype(np.float32)))


def _colour(change: Callable[[np.ndarray, Faulty, int], np.ndarray]) -> Fault:
    """Changes colour (H, W, 3), 0 to 255."""

    def faulty(frame: Frame, of: Faulty, i: int) -> Frame:
        return replace(frame, rgb=np.clip(np.rint(change(frame.rgb, of, i)), 0, 255).astype(np.uint8))

    return Fault(frame=faulty)


def _mask(change: Callable[[np.ndarray, Faulty, int], np.ndarray]) -> Fault:
    """Changes each object's mask (H, W) bool."""
    return Fault(masks=lambda masks, of, i: {name: change(mask, of, i) for name, mask in masks.items()})


def _where_measured(depth_m: np.ndarray, new_m: np.ndarray | float) -> np.ndarray:
    return np.where(depth_m > 0, new_m, 0)


def _wild(depth_m: np.ndarray, of: Faulty, i: int) -> np.ndarray:
    rng = of.rng(i)
    return np.where(rng.random(depth_m.shape) < of.severity, rng.choice(_WILD_M, depth_m.shape), depth_m)


def _wider(depth_m: np.ndarray, of: Faulty, i: int) -> np.ndarray:
    h, w = depth_m.shape
    seen = np.array([[0.75, 0, 0.125 * w + 12], [0, 0.75, 0.125 * h]])
    return cv2.warpAffine(depth_m, seen, (w, h), flags=cv2.INTER_NEAREST)


def _plain(rgb: np.ndarray, of: Faulty, i: int) -> np.ndarray:
    """Each object in the median of its colours, with noise."""
    rgb, rng = rgb.astype(float), of.rng(i)
    for mask in (of.original.masks(i) or {}).values():
        wide = _grown(mask, 4)
        if mask.any():
            rgb[wide] = np.median(rgb[mask], 0) + rng.normal(0, of.severity, (int(wide.sum()), 3))
    return rgb


def _on_objects(of: Faulty, i: int) -> np.ndarray:
    """(H, W) bool: the masks of all objects."""
    camera = of.original.camera
    nothing = np.zeros((camera.height, camera.width), bool)
    return np.logical_or.reduce([nothing, *(of.original.masks(i) or {}).values()])


def _shifted(image: np.ndarray, px: float) -> np.ndarray:
    """An image (H, W) of numbers moved to the right; what comes in is 0."""
    return cv2.warpAffine(image, np.array([[1.0, 0, px], [0, 1, 0]]), image.shape[::-1], flags=cv2.INTER_NEAREST)


def _grown(mask: np.ndarray, px: float) -> np.ndarray:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(px) + 1,) * 2)
    return cv2.dilate(mask.astype(np.uint8), disk) > 0


def _left_part(mask: np.ndarray, of: Faulty, i: int) -> np.ndarray:
    """Without a share of its columns, the right ones."""
    columns = np.flatnonzero(mask.any(0))
    return mask & (np.arange(mask.shape[1]) < np.quantile(columns, 1 - of.severity)) if len(columns) else mask


def _board(frame: Frame, of: Faulty, i: int) -> Frame:
    """A board as wide as a share of the image, before the objects, from the left to the right; no mask knows of it."""
    h, w = frame.shape
    objects = _on_objects(of, i)
    behind = frame.depth_m[(objects if objects.any() else True) & (frame.depth_m > 0)]
    near_m = _BOARD_SHARE * np.percentile(behind, 5) if len(behind) else 0.3
    wide = max(int(of.severity * w), 1)
    left = round((i - of.start + 0.5) / (of.end - of.start) * (w + wide)) - wide
    grain = np.random.default_rng(of.seed).integers(90, 170, (h // 8 + 1, wide // 8 + 1, 3), np.uint8)
    texture = cv2.resize(grain, (wide, h))
    seen = np.arange(max(left, 0), min(left + wide, w))
    rgb, depth_m = frame.rgb.copy(), frame.depth_m.copy()
    rgb[:, seen], depth_m[:, seen] = texture[:, seen - left], near_m
    return replace(frame, rgb=rgb, depth_m=depth_m)


def _until_turned(of: Faulty) -> np.ndarray:
    """The frames from its start to where the first object with a truth is turned most, of those with 60 after them."""
    for truth in of.original.truth.values():
        seen = truth.labelled & np.isfinite(truth.T_cam_model).all((1, 2))
        seen[: of.start + 1], seen[max(len(of.original) - _LEFT, 0) :] = False, False
        if seen.any():
            T_last = truth.T_cam_model[of.before]
            turned_rad = se3.angle_rad(se3.inverse(T_last) @ truth.T_cam_model[seen])
            return np.arange(of.start, np.flatnonzero(seen)[turned_rad.argmax()])
    return np.arange(of.start, of.stop)


#: Fault to what it does, with the unit of its severity where it has one.
FAULTS: dict[str, Fault] = {
    "none": Fault(),
    # Depth as it was before all of it.
    "depth frozen": _depth(lambda depth_m, of, i: of.original.frame(of.before).depth_m),
    # Frames: of a camera that takes colour and depth at different moments.
    "depth late": _depth(lambda depth_m, of, i: of.original.frame(max(i - round(of.severity), 0)).depth_m),
    # A factor.
    "depth scaled": _depth(lambda depth_m, of, i: depth_m * of.severity),
    # Another factor in every image, which differs from 1 by so much at most: a network for single images.
    "depth scaled anew": _depth(lambda depth_m, of, i: depth_m * of.rng(i).uniform(1 - of.severity, 1 + of.severity)),
    # Metres.
    "depth offset": _depth(lambda depth_m, of, i: _where_measured(depth_m, np.maximum(depth_m + of.severity, 0))),
    # Pixels to the right.
    "depth misaligned": _depth(lambda depth_m, of, i: _shifted(depth_m, of.severity)),
    # As a D435's depth camera sees it: a wider view, and 15 mm beside the colour camera.
    "depth not registered": _depth(_wider),
    # Standard deviation, metres.
    "depth noise": _depth(lambda z, of, i: _where_measured(z, np.abs(z + of.rng(i).normal(0, of.severity, z.shape)))),
    # A share of the pixels.
    "depth holes": _depth(lambda z, of, i: np.where(of.rng(i).random(z.shape) < of.severity, 0, z)),
    "depth wild": _depth(_wild),
    # Dark, shiny, transparent.
    "depth missing on objects": _depth(lambda depth_m, of, i: np.where(_on_objects(of, i), 0, depth_m)),
    "colour frozen": _colour(lambda rgb, of, i: of.original.frame(of.before).rgb),
    "colour black": _colour(lambda rgb, of, i: np.zeros_like(rgb)),
    # Standard deviation of the blur, pixels.
    "colour blurred": _colour(lambda rgb, of, i: cv2.GaussianBlur(rgb, (0, 0), of.severity)),
    # Standard deviation, grey levels.
    "colour noise": _colour(lambda rgb, of, i: rgb + of.rng(i).normal(0, of.severity, rgb.shape)),
    # Grey levels of red more and of blue less.
    "colour cast": _colour(lambda rgb, of, i: rgb + of.severity * np.array([1.0, 0, -1])),
    # Standard deviation of a camera's noise on objects of one colour, grey levels.
    "colour plain on objects": _colour(_plain),
    # A factor.
    "exposure": _colour(lambda rgb, of, i: rgb * of.severity),
    # Pixels to all sides.
    "mask wide": _mask(lambda mask, of, i: _grown(mask, of.severity)),
    "mask whole image": _mask(lambda mask, of, i: np.ones_like(mask)),
    "mask empty": _mask(lambda mask, of, i: np.zeros_like(mask)),
    # Empty in every second frame.
    "mask flickers": _mask(lambda mask, of, i: mask & bool((i - of.start) % 2)),
    # Pixels to the right.
    "mask misplaced": _mask(lambda mask, of, i: _shifted(mask.astype(np.uint8), of.severity) > 0),
    # The share that is missing.
    "mask cut": _mask(_left_part),
    # The share of the image that the board is wide.
    "board unmasked": Fault(frame=_board),
    "frames black": Fault(
        frame=lambda frame, of, i: replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))
    ),
    "frames frozen": Fault(shown=lambda of, i: of.before),
    # Each frame twice: a recorder that was faster than its camera.
    "frames twice": Fault(shown=lambda of, i: i - (i - of.start) % 2),
    "frames dropped": Fault(left_out=lambda of: np.arange(of.start, of.stop)),
    # The share of the frames that is missing, evenly.
    "frames thinned": Fault(left_out=lambda of: np.arange(of.start, of.stop, 1 / of.severity).astype(int)),
    # Until the object shows another side.
    "frames dropped, turned": Fault(left_out=_until_turned),
    # Seconds.
    "time shifted": Fault(frame=lambda frame, of, i: replace(frame, time_s=frame.time_s + of.severity)),
    "time standing": Fault(frame=lambda frame, of, i: replace(frame, time_s=float(of.original.times_s[of.before]))),
    # A factor of both focal lengths; of the whole run, wherever the fault acts.
    "focal length off": Fault(camera=lambda camera, by: replace(camera, fx=camera.fx * by, fy=camera.fy * by)),
}
