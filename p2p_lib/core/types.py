"""The values that pass between the packages: frames, tracks, pose estimates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, fields, is_dataclass
from enum import StrEnum
from functools import cached_property
from numbers import Real
from typing import Any, ClassVar, Protocol, Self, TypeVar

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, wrong_size

#: What can be depth in any unit: so wide that ``p2p check`` still tells millimetres that were taken for metres.
NEAREST_M, FARTHEST_M = 0.001, 1e4
#: Every eighth pixel of every eighth row: where some of an image tells enough.
SPARSE = np.s_[::8, ::8]


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image.

    index    counts the images of its sequence or camera, from 0
    rgb      (H, W, 3) uint8, red first
    depth_m  (H, W) float32, metres along the optical axis, registered to rgb; 0 = no measurement, which NaN
             and any reading outside :data:`NEAREST_M` to :data:`FARTHEST_M` become
    time_s   seconds, increasing within a sequence
    T_world_cam  (4, 4) pose of the camera in a static world, where somebody knows it (a robot, SLAM)

    The arrays are copied: a camera driver may refill the buffers that they came in.

    >>> rgb, depth_mm = np.zeros((480, 640, 3), np.uint8), np.full((480, 640), 700, np.uint16)
    >>> Frame(index=0, time_s=0.0, rgb=rgb, depth_m=depth_mm / np.float32(1000)).shape
    (480, 640)
    >>> Frame(0, 0.0, rgb, depth_mm)
    Traceback (most recent call last):
    p2p_lib.core.errors.BadInput: frame 0 depth: got uint16, expected metres as floats. Apply the depth scale first.
    """

    index: int
    time_s: float
    rgb: np.ndarray
    depth_m: np.ndarray
    T_world_cam: np.ndarray | None = None

    def __post_init__(self) -> None:
        rgb, depth = self.rgb, self.depth_m
        if isinstance(self.index, bool) or not isinstance(self.index, int | np.integer) or self.index < 0:
            raise BadInput("frame index", repr(self.index), "a whole number from 0")
        object.__setattr__(self, "index", int(self.index))  # NumPy's is no number to JSON
        for what, image in (("colour", rgb), ("depth", depth)):
            if not isinstance(image, np.ndarray):
                raise BadInput(f"frame {self.index} {what}", type(image).__name__, "a NumPy array")
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise BadInput(f"frame {self.index} colour", f"{rgb.shape} {rgb.dtype}", "(H, W, 3) uint8")
        if depth.shape != rgb.shape[:2]:
            fix = "Register the depth to the colour camera first."
            raise wrong_size(f"frame {self.index} depth", depth.shape, rgb.shape[:2], "the colour image", fix)
        if not np.issubdtype(depth.dtype, np.floating):
            raise BadInput(f"frame {self.index} depth", depth.dtype, "metres as floats", "Apply the depth scale first.")
        if not isinstance(self.time_s, Real) or not np.isfinite(self.time_s):
            raise BadInput(f"frame {self.index} time_s", self.time_s, "a finite time in seconds")
        if self.T_world_cam is not None:
            T_world_cam = se3.check(f"frame {self.index} T_world_cam", self.T_world_cam)
            object.__setattr__(self, "T_world_cam", T_world_cam.copy())
        object.__setattr__(self, "rgb", rgb.copy())
        # A sensor's NaN, infinity, negative and impossible readings all mean "no measurement", which is 0 here.
        with np.errstate(over="ignore"):
            clean = depth.astype(np.float32, order="C")
        clean[~((clean >= NEAREST_M) & (clean <= FARTHEST_M))] = 0
        object.__setattr__(self, "depth_m", clean)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.depth_m.shape

    @property
    def remark(self) -> str:
        """What whoever looked at it before found wrong with it, in words."""
        return ""

    @cached_property
    def sparse(self) -> dict[str, np.ndarray]:
        """``rgb`` and ``depth_m`` at :data:`SPARSE`: copies, since a stride reads the whole image."""
        return {name: getattr(self, name)[SPARSE].copy() for name in ("rgb", "depth_m")}

    @cached_property
    def lab(self) -> np.ndarray:
        """(H, W, 3) uint8, the colours in CIELAB; converted when first asked for."""
        return cv2.cvtColor(self.rgb, cv2.COLOR_RGB2LAB)


@dataclass(frozen=True, eq=False)
class Tracks:
    """What a 2D point tracker says of its live queries at one frame (paper: u_t, delta_t, sigma_t).

    ids          (N,) int64, as returned when the queries were added
    uv_px        (N, 2) float64; where not visible: the tracker's best guess or NaN
    visible      (N,) bool
    uncertainty  (N,) float in [0, 1]
    """

    ids: np.ndarray
    uv_px: np.ndarray
    visible: np.ndarray
    uncertainty: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.ids)
        shapes = np.shape(self.uv_px), np.shape(self.visible), np.shape(self.uncertainty)
        if shapes != ((n, 2), (n,), (n,)):
            got = "uv_px {}, visible {}, uncertainty {}".format(*shapes)
            raise BadInput(Tracks.__name__, f"{n} ids, {got}", "(N,), (N, 2), (N,), (N,)")

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, ids: np.ndarray) -> Tracks:
        """The rows of these ids, in this order. ``self.ids`` is sorted, as trackers return it."""
        ids = np.asarray(ids, np.int64)
        at = np.searchsorted(self.ids, ids)
        if len(ids) and (len(self.ids) == 0 or (self.ids[np.minimum(at, len(self.ids) - 1)] != ids).any()):
            raise BadInput("track ids", "ids the tracker does not hold", "ids returned by add() and not dropped")
        return Tracks(ids, self.uv_px[at], self.visible[at], self.uncertainty[at])


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Arrays = TypeVar("Arrays", bound=_Dataclass)
#: Of a field of :class:`Rows`: what is joined has the first one's.
SHARED = {"shared": True}


class Rows:
    """What dataclasses have in common whose fields are arrays (or such dataclasses again) of one row per item.

    A field with ``metadata=SHARED`` is one value for all items.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def select(self, rows: np.ndarray) -> Self:
        """The items at these rows or under this mask."""
        columns = ((getattr(self, f.name), f.metadata) for f in fields(self))
        return type(self)(*(c if about else c.select(rows) if isinstance(c, Rows) else c[rows] for c, about in columns))


def median_of_known(values: np.ndarray) -> float:
    """Of those that are known; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def evenly(rows: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of the rows (n, ...), evenly spread; of several the first and the last are among them."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), max(most, 0))).astype(int)]


def joined(parts: Sequence[Arrays], join: Callable[..., np.ndarray] = np.concatenate) -> Arrays:
    """Values of one dataclass that holds arrays (or such dataclasses again), one after the other."""
    columns = (([getattr(part, f.name) for part in parts], f.metadata) for f in fields(parts[0]))
    return type(parts[0])(
        *(c[0] if about else joined(c, join) if is_dataclass(c[0]) else join(c) for c, about in columns)
    )


class Status(StrEnum):
    """What a pose estimate is worth; `WITH_POSE` lists those that carry a pose."""

    INITIALISING = "initialising"  # the object has not been seen yet, or its map is still being started
    TRACKED = "tracked"
    DEGRADED = "degraded"  # a pose, but weakly supported: `reason` says by what
    OCCLUDED = "occluded"  # nothing of the object is visible
    LOST = "lost"  # something is visible, but no pose was found
    RECOVERED = "recovered"  # the first frames after occluded or lost


#: How the reason of an occlusion begins where the object has left the image, and where nobody knows what hides it.
OUT_OF_VIEW, NOT_FOUND = "out of view", "not found"
#: The reason of an object of which nothing has been seen, or too little.
NOT_SEEN = "not seen yet"
#: What an object waits for that was added by its name alone.
WAITS = ": it waits for a mask (step) or for clicks (correct)"


def status_word(status: str, reason: str) -> str:
    """A status as people are told it: nothing occludes an object that has left the image, or is just not found."""
    return next((known for known in (OUT_OF_VIEW, NOT_FOUND) if reason.startswith(known)), str(status))


def status_text(status: str, reason: str) -> str:
    """The same with the reason behind it."""
    if reason.startswith(NOT_FOUND):
        return reason
    return f"{status_word(status, reason)}: {reason.removeprefix(f'{OUT_OF_VIEW}: ')}"


#: Statuses that carry a pose of this very frame.
WITH_POSE = frozenset({Status.TRACKED, Status.DEGRADED, Status.RECOVERED})
#: A pose of no more confidence is doubted; one that nothing has told from others that look alike has no more.
DOUBTED = 0.5


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """One object's pose at one frame, or the absence of it.

    T_cam_obj       (4, 4) or None. None whenever the status is not one of :data:`WITH_POSE`
    covariance      (6, 6) or None: right tangent of T_cam_obj, [rotation rad, translation m]
    confidence      in [0, 1]; 0 without a pose
    reason          why the status is what it is, in words; empty when tracked, unless something is wrong with the frame
                    or the pose is doubted for a reason that can be told
    visible_points  the object's points that the 2D tracker saw; those that this very frame adds are not among them
    inliers         keypoints that agree on the pose; in the frame in which a map begins, those it begins with
    keyframe        whether the frame was taken into the map
    map_id          0, and one more for each map that was started since: another map has another object frame
    joined          (id, T_obj_joined) of a map that became part of this one at this frame, else None: a point of its
                    object frame is T_obj_joined times it in this one
    last_T_cam_obj  the newest pose known, a keyframe's as the graph has it, and last_seen_s its time: for a guess
    T_world_obj     (4, 4) the pose in the world, where there is a pose and the frame brought ``T_world_cam``; else None
    """

    object: str
    frame_index: int
    time_s: float
    status: Status
    T_cam_obj: np.ndarray | None = None
    confidence: float = 0.0
    covariance: np.ndarray | None = None
    reason: str = ""
    visible_points: int = 0
    inliers: int = 0
    last_T_cam_obj: np.ndarray | None = None
    last_seen_s: float = float("nan")
    keyframe: bool = False
    map_id: int = 0
    joined: tuple[int, np.ndarray] | None = None
    T_world_obj: np.ndarray | None = None

    def __post_init__(self) -> None:
        name = f"estimate of {self.object!r} at frame {self.frame_index}"
        if (self.T_cam_obj is not None) != (self.status in WITH_POSE):
            came = "a pose" if self.T_cam_obj is not None else "no pose"
            expected = "a pose exactly when tracked, degraded, recovered"
            raise BadInput(name, f"{came} with status {self.status}", expected)
        if self.T_cam_obj is not None:
            object.__setattr__(self, "T_cam_obj", se3.check(name, self.T_cam_obj))
        if not 0 <= self.confidence <= (self.T_cam_obj is not None):
            raise BadInput(f"{name}: confidence", self.confidence, "a number in [0, 1], 0 without a pose")
        if self.covariance is not None and (self.covariance.shape != (6, 6) or not np.isfinite(self.covariance).all()):
            raise BadInput(f"{name}: covariance", f"shape {self.covariance.shape}", "a finite (6, 6) matrix or None")
