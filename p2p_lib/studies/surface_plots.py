"""Pictures of fused surfaces: slices of signed distance and errors, beside the exact ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.figures import style
from p2p_lib.figures.plots import panels
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.studies.fused_surface import exact_distance
from p2p_lib.studies.turntable import Body, around_surface, draw_slice, slice_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def slices_beside_exact(volume: TsdfVolume, body: Body, heights_m: Sequence[float]) -> Figure:
    """A row per height: the fused distance, the exact one where it was observed, and their difference."""
    low = np.min([around_surface(volume, z)[0] for z in heights_m], 0)
    high = np.max([around_surface(volume, z)[1] for z in heights_m], 0)
    with style.applied():
        figure, axes = _grid(len(heights_m), 3, (8.6, 1.75 * len(heights_m) + 0.6))
        for row, z in zip(axes, heights_m, strict=True):
            points = slice_points(low, high, z)
            fused, exact = exact_distance(volume, body, points)
            left = draw_slice(row[0], points, fused, volume.tau_m)
            draw_slice(row[1], points, exact, volume.tau_m)
            right = draw_slice(row[2], points, fused - exact, 0.005, "PuOr", zero_level=False)
            row[0].set_ylabel(f"z = {1e3 * z:.0f} mm\ny [mm]")
        for axis, title in zip(
            axes[0], ("fused: $\\tau V$", f"exact: synthetic {body.name}", "fused - exact"), strict=True
        ):
            axis.set_title(title)
        for axis in axes[-1]:
            axis.set_xlabel("x [mm]")
        bars = (left, axes[:, :2], "signed\ndistance\n[mm]"), (right, axes[:, 2], "differ-\nence\n[mm]")
        for shown, beside, words in bars:
            figure.colorbar(shown, ax=beside, shrink=0.8).ax.set_title(words, fontsize=8, loc="left")
    return figure


def _grid(rows: int, columns: int, size_in: tuple[float, float]) -> tuple[Figure, np.ndarray]:
    from matplotlib.figure import Figure

    figure = Figure(size_in, layout="constrained")
    return figure, figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)


def fused_against_exact(fused_m: np.ndarray, exact_m: np.ndarray, tau_m: float) -> Figure:
    """Fused over exact distance at many points: median and the middle 80 % in bins of the exact one."""
    edges = np.linspace(-tau_m, tau_m, 41)
    inside = np.isfinite(fused_m) & (np.abs(exact_m) < 0.999 * tau_m)
    fused, exact = fused_m[inside], exact_m[inside]
    bins = np.digitize(exact, edges) - 1
    kept = [b for b in range(len(edges) - 1) if (bins == b).sum() > 20]
    low, middle, high = np.array([np.quantile(fused[bins == b], [0.1, 0.5, 0.9]) for b in kept]).T
    at = 1e3 * (edges[kept] + np.diff(edges)[0] / 2)
    with style.applied():
        figure, (axis,) = panels(1, (5.6, 4.2), [1])
        axis.fill_between(at, 1e3 * low, 1e3 * high, color="#A9CCE8", lw=0, label="middle 80 % of the voxels")
        axis.plot(at, 1e3 * middle, color=style.OBJECTS[0], label="median")
        limits = 1e3 * np.array([-tau_m, tau_m])
        axis.plot(limits, limits, color="#222222", linestyle="--", linewidth=1, label="fused = exact")
        axis.set(xlabel="exact distance [mm] (synthetic)", ylabel=r"fused distance $\tau V$ [mm]", aspect="equal")
        axis.legend(loc="upper left")
    return figure


def errors_over_keyframes(counts: Sequence[int], errors_m: np.ndarray, bar_mm: float) -> Figure:
    """Mesh errors both ways (len(counts), 2) over the number of keyframes."""
    names = ("mesh to exact surface", "seen surface to mesh")
    lines = ((style.OBJECTS[0], "o-"), (style.OBJECTS[1], "s--"))
    with style.applied():
        figure, (axis,) = panels(1, (6.4, 3.2), [1])
        for values, name, (colour, line) in zip(1e3 * errors_m.T, names, lines, strict=True):
            axis.plot(counts, values, line, color=colour, markersize=5, label=name)
        axis.axhline(bar_mm, color=style.STATUS["lost"][0], linestyle=":", linewidth=1)
        axis.set_xscale("log", base=2)
        axis.set_yscale("log")
        axis.set_xticks(counts, counts)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("")
        axis.set(xlabel="keyframes fused (synthetic)", ylabel="mean distance [mm]")
        axis.legend(loc="upper right")
    return figure
