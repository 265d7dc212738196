"""The unit of depth images: whether things stand where depth counts, and which unit would put them there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.image import ends_px
from p2p_lib.core.types import Frame

#: Metres per unit of depth images in the field, likeliest first, and whose they are.
UNITS_M = {
    0.001: "millimetres",
    1.0: "metres",
    1 / 5000: "TUM RGB-D",
    1 / 4000: "1/4000 m, as of some LiDAR cameras",
    0.0001: "tenths of millimetres, as of YCB-Video and short-range stereo",
    1e-6: "micrometres",
    0.01: "centimetres",
}
#: Where things stand that are tracked, m.
_STANDS_M = (0.15, 5.0)
#: So far away hardly anything is tracked, m, and so near hardly any depth camera measures.
_FAR_M, _CLOSE_M = 2.5, 0.2
#: The part of a scene in which the objects are, a share of its pixels: in 13 videos it ended 0.4 to 1.2 m away.
_NEAR_PART = 0.1
#: Of a scene that is tracked half is not so near, m: 0.6 at least in ten, five of them real.
_NEAR_SCENE_M = 0.3
#: How long they are, m: a spatula and a keyboard have 0.4, what of a tin looks out behind another one 0.035.
_LONG_M = (0.02, 0.8)
#: Where less of what was measured than this share is at distances that count, the unit may be another.
_USED_SHARE = 0.3
#: Fraction of a mask that should have a depth.
MEASURED_SHARE = 0.5


def likely_units(median_m: float, scale: float) -> str:
    """The units of the field that bring a depth to where things stand before a camera, likeliest first, in words."""
    fits = [(unit, what, median_m * unit / scale) for unit, what in UNITS_M.items() if not np.isclose(unit, scale)]
    fits = [(unit, what, m) for unit, what, m in fits if _STANDS_M[0] <= m <= _STANDS_M[1]][:3]
    units = [f"{unit:g} ({what}) would make it {m:.2g} m" for unit, what, m in fits]
    return f"A unit of {', of '.join(units)}" if units else ""


def distance_m(frame: Frame, mask: np.ndarray) -> float:
    """Median depth of what is measured of a mask; NaN where nothing is, or too little of it."""
    depth_m = frame.depth_m[mask]
    measured = depth_m[depth_m > 0]
    enough = len(measured) and len(measured) >= MEASURED_SHARE * len(depth_m)
    return float(np.median(measured)) if enough else float("nan")


def beyond(away_m: Mapping[str, float], limits: DepthConfig, scale: float) -> tuple[str, str] | None:
    """What to say of objects that are all too far away, or all too near, and what to do: most likely a wrong unit.

    Those that are too far, or too near, to count (:func:`uncounted`), and those that are where hardly anything is.

    away_m  object to its distance
    scale   metres per unit, as depth was read
    """
    distances, ((_, first_m), *others) = np.array(list(away_m.values())), away_m.items()
    text = f"{first_m:.2f} m away"
    text += f" ({', '.join(f'{name} {other_m:.2f} m' for name, other_m in others)})" if others else ""
    unless = f"if it was not, {_wrong_scale(first_m, scale)}"
    if uncounted(away_m, limits):
        far = bool((distances > limits.max_m).all())
        wider = f"max_m={2 * distances.max():.1f}" if far else f"min_m={distances.min() / 2:.2g}"
        return f"{text}, but {limits.min_m:g} to {limits.max_m:g} m count", f"If it was, --set depth.{wider}; {unless}"
    if (distances > _FAR_M).all():
        off_m = depth_noise_m(distances.max())
        return f"{text}, where depth is off by about {100 * off_m:.0f} cm", f"If it was, poses are as rough; {unless}"
    return None


def uncounted(away_m: Mapping[str, float], limits: DepthConfig) -> bool:
    """Whether all objects are too far away, or all too near, for their depth to count."""
    distances = np.array(list(away_m.values()))
    return bool((distances > limits.max_m).all() or (distances < limits.min_m).all())


def hardly_counts(frames: Iterable[Frame], limits: DepthConfig, scale: float) -> tuple[str, str] | None:
    """What to say of depth of which hardly any is at distances that count, and what to do; None where enough is."""
    every_m = np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames])
    used = float(((every_m >= limits.min_m) & (every_m <= limits.max_m)).mean()) if len(every_m) else 1.0
    if used >= _USED_SHARE:
        return None
    guess = likely_units(float(np.median(every_m)), scale)
    fix = f"Is the unit right (--depth-scale)? {guess}." if guess else ""
    text = f"{100 * used:.0f} % of these between {limits.min_m:g} and {limits.max_m:g} m, which count"
    return text, f"{fix} What is farther away counts with --set depth.max_m=METRES.".strip()


def odd_scene(frames: Iterable[Frame], scale: float) -> tuple[str, str] | None:
    """What to say of a scene whose near part is where nobody tracks anything, and what to do; None where it may be."""
    every_m = np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames])
    near_m = float(np.quantile(every_m, _NEAR_PART)) if len(every_m) else 1.0
    if _CLOSE_M <= near_m <= _FAR_M:
        return None
    if near_m < _CLOSE_M:
        why, so = "nearer than most depth cameras measure", "all is fine"
    else:
        why, so = f"off by about {100 * depth_noise_m(np.array(near_m)):.0f} cm", "poses are as rough"
    text = f"the nearest {100 * _NEAR_PART:.0f} % up to {near_m:.2g} m away, {why}"
    return text, f"If it was, {so}; if it was not, {_wrong_scale(near_m, scale)}"


def near_scene(frames: Iterable[Frame], scale: float) -> tuple[str, str] | None:
    """What to say of a scene of which more than half is so near as nobody films it, and what to do; None where not.

    Objects in it may well be where depth counts, and no shorter than some are.
    """
    every_m = np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames])
    median_m = float(np.median(every_m)) if len(every_m) else 1.0
    if median_m >= _NEAR_SCENE_M:
        return None
    fix = f"If it was filmed from so near, all is fine; if it was not, {_wrong_scale(median_m, scale)}"
    return f"half of all nearer than {_NEAR_SCENE_M:g} m", fix


def odd_size(mask: np.ndarray, away_m: float, camera: Camera, scale: float) -> tuple[str, str] | None:
    """What to say of an object so long, or so short, as nothing is that is tracked, and what to do; NaN: not measured.

    mask  (H, W) bool: how long it is follows from its outline, at the distance away_m: depth is wild at edges
    """
    length_m = float((np.ptp(ends_px(mask), 0) / [camera.fx, camera.fy]).max() * away_m)
    if not (length_m < _LONG_M[0] or length_m > _LONG_M[1]):
        return None
    fix = f"If it is not, its mask is of something else, or {_wrong_scale(away_m, scale)}"
    return f"{100 * length_m:.3g} cm long, {away_m:.2f} m away", fix


def _wrong_scale(away_m: float, scale: float) -> str:
    """That depth may have another unit, and which would put what is so far away where things stand."""
    guess = f". {units}" if (units := likely_units(away_m, scale)) else ""
    return f"the depth scale is wrong (--depth-scale){guess}."
