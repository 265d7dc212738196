"""What plots share: panels, logarithmic axes, spans of frames. Nothing is shown or saved here."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core.packages import needed_for
from p2p_lib.datasets.runs import ObjectRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

#: The width in inches of a figure that fills a page.
WIDTH_IN = 8.0


def panels(
    count: int, size_in: tuple[float, float], ratios: list[float] | None = None, side_by_side: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure without global state, and its axes below each other (sharing time) or side by side."""
    with needed_for("notebooks"):
        from matplotlib.figure import Figure

    figure = Figure(size_in, layout="constrained")
    if side_by_side:
        axes = figure.subplots(1, count, width_ratios=ratios, squeeze=False)[0]
    else:
        axes = figure.subplots(count, 1, height_ratios=ratios, sharex=True, squeeze=False)[:, 0]
    return figure, list(axes)


def logarithmic(*axes: Axis, base: float = 10) -> None:
    """Logarithmic scales (``axes.xaxis``, ``axes.yaxis``) with plain numbers at their ticks."""
    for axis in axes:
        getattr(axis.axes, f"set_{axis.axis_name}scale")("log", base=base)
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def status_intervals(status: np.ndarray) -> list[tuple[str, int, int]]:
    """Spans of equal values, without holes: (value, start, stop) of every span [start, stop), in order."""
    status = np.asarray(status)
    edges = [0, *(np.flatnonzero(status[1:] != status[:-1]) + 1).tolist(), len(status)]
    return [(str(status[a]), a, b) for a, b in pairwise(edges) if a < b]


def gaps(obj: ObjectRun, at_least: int = 5) -> list[tuple[int, int]]:
    """Spans [start, stop) of at least so many frames without a pose, after the object was first seen."""
    return [(a, b) for has, a, b in status_intervals(obj.has_pose) if has == "False" and a > 0 and b - a >= at_least]
