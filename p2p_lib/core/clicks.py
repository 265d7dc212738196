"""Clicks that say where an object is: what a segmenter starts from, checked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import Frame


def check_clicks(name: str, clicks_px: ArrayLike, camera: Camera) -> np.ndarray:
    """Clicks as (N, 2) float64, or an error that names the object and the click."""
    try:
        clicks = np.asarray(clicks_px, float)
    except (TypeError, ValueError):
        clicks = np.zeros(0)
    if clicks.ndim != 2 or clicks.shape[1] != 2 or not len(clicks):
        raise BadInput(f"clicks on {name!r}", repr(clicks_px)[:60], "at least one [x, y] in pixels")
    outside = ~camera.inside(clicks, -0.5)
    if outside.any():
        got = "({:g}, {:g})".format(*clicks[outside][0])
        raise BadInput(f"clicks on {name!r}", got, f"pixels within {camera.width}x{camera.height}")
    return clicks


def check_apart(name: str, clicks: np.ndarray, others: Mapping[str, np.ndarray]) -> None:
    """Refuse a click that is also one of another object's in the same frame; ``others`` name to (M, 2)."""
    for other, taken in others.items():
        if (np.abs(taken[:, None] - clicks).max(-1) < 1).any():
            got = f"a click that is also one of {other!r}"
            raise BadInput(f"clicks on {name!r}", got, "a pixel that belongs to one object only")


def depths_at(clicks: np.ndarray, frame: Frame, radius: int = 2) -> np.ndarray:
    """(N,) median depth around each click; NaN where nothing is measured."""
    d = np.arange(-radius, radius + 1)
    around = np.stack(np.meshgrid(d, d), -1).reshape(-1, 2)
    u, v = nearest_px(np.rint(clicks)[:, None] + around, frame.shape)
    return np.ma.median(np.ma.masked_equal(frame.depth_m[v, u], 0), axis=1).astype(float).filled(np.nan)


def checked_clicks(clicks: Mapping[str, ArrayLike], camera: Camera, frame: Frame) -> dict[str, np.ndarray]:
    """New objects' clicks in a frame, (N, 2) float64 each: in the image, and where depth is measured."""
    checked = {name: check_clicks(name, at, camera) for name, at in clicks.items()}
    for name, at in checked.items():
        check_depth(name, at, frame)
    return checked


def check_depth(name: str, clicks: np.ndarray, frame: Frame) -> None:
    """Refuse clicks where nothing is measured."""
    missing = ~np.isfinite(depths_at(clicks, frame))
    if missing.any():
        got = "({:g}, {:g}) has no depth in frame {}".format(*clicks[missing][0], frame.index)
        raise BadInput(f"clicks on {name!r}", got, "pixels with a depth measurement", "Click beside the hole.")
