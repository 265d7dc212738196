"""Pictures of surfaces: slices of signed distance, meshes, and how refinement moves onto them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.figures import style
from p2p_lib.figures.plots import panels
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.studies.fused_surface import exact_distance
from p2p_lib.studies.turntable import Body

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Signed distance: inside the body brown, outside blue, the surface white; not observed is grey.
DISTANCE_MAP, UNSEEN = "BrBG", "#C8C8C8"


def slice_points(
    low_m: Sequence[float], high_m: Sequence[float], at_m: float, axis: int = 2, step_m: float = 0.0005
) -> np.ndarray:
    """(rows, columns, 3) points of the plane ``axis`` = ``at_m`` between two corners, rows along the later axis."""
    first, second = (k for k in range(3) if k != axis)
    a, b = (np.arange(low_m[k], high_m[k] + step_m / 2, step_m) for k in (first, second))
    p = np.full((len(b), len(a), 3), float(at_m))
    p[..., first], p[..., second] = a[None], b[:, None]
    return p


def draw_distance(axis: Axes, points: np.ndarray, value_m: np.ndarray, limit_m: float, along: tuple[int, int] = (0, 1)):
    """Signed distance (rows, columns) over a slice of points, NaN where unobserved, with its zero level drawn."""
    import matplotlib

    colours = matplotlib.colormaps[DISTANCE_MAP].with_extremes(bad=UNSEEN)
    x, y = 1e3 * points[0, :, along[0]], 1e3 * points[:, 0, along[1]]
    shown = axis.imshow(
        1e3 * value_m,
        extent=(x[0], x[-1], y[0], y[-1]),
        origin="lower",
        cmap=colours,
        vmin=-1e3 * limit_m,
        vmax=1e3 * limit_m,
    )
    if np.nanmin(value_m) < 0 < np.nanmax(value_m):
        axis.contour(x, y, value_m, [0.0], colors="#222222", linewidths=0.9)
    axis.grid(visible=False)
    axis.set(aspect="equal")
    return shown


def onto_the_surface(
    volume: TsdfVolume, p_cam: np.ndarray, poses: Mapping[str, np.ndarray], at_m: float = 0.0, thick_m: float = 0.006
) -> Figure:
    """A slice through the fused surface, with the measured points near it where each pose puts them."""
    points = slice_points(*_around_surface(volume, at_m), at_m)
    value = seen_distance(volume, points)
    with style.applied():
        figure, axes = panels(len(poses), (4.2 * len(poses), 4.0), [1] * len(poses), side_by_side=True)
        for axis, (name, T_cam_obj) in zip(axes, poses.items(), strict=True):
            shown = draw_distance(axis, points, value, volume.tau_m)
            p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
            near = p_obj[np.abs(p_obj[:, 2] - at_m) < thick_m]
            axis.plot(
                *(1e3 * near[:, :2].T), "o", color=style.AXES[0], markersize=3.5, markeredgecolor="white", mew=0.4
            )
            axis.set_title(f"synthetic: {name}")
            axis.set(xlabel="x [mm]")
        axes[0].set_ylabel("y [mm]")
        figure.colorbar(shown, ax=axes, label=r"signed distance $\Phi$ [mm]", shrink=0.85)
    return figure


def _around_surface(volume: TsdfVolume, at_m: float, margin_m: float = 0.012) -> np.ndarray:
    """(2, 3) corners of the part of a slice within the truncation distance of the surface, with a margin."""
    points = slice_points(volume.corners_m().min(0), volume.corners_m().max(0), at_m, step_m=0.002)
    near = np.abs(seen_distance(volume, points)) < 0.98 * volume.tau_m
    return np.stack([points[near].min(0) - margin_m, points[near].max(0) + margin_m])


def seen_distance(volume: TsdfVolume, points: np.ndarray) -> np.ndarray:
    """Fused distance in metres, NaN where unobserved."""
    value, valid = volume.query(points)
    return np.where(valid, value, np.nan)


def basins(
    errors: Mapping[str, np.ndarray], degrees: Sequence[float], millimetres: Sequence[float], limit: tuple[float, float]
) -> Figure:
    """The share of starts that come back to within ``limit`` (degrees, millimetres), by how far they were off."""
    with style.applied():
        figure, axes = panels(len(errors), (4.0 * len(errors), 3.4), [1] * len(errors), side_by_side=True)
        for axis, (name, found) in zip(axes, errors.items(), strict=True):
            share = 100 * (found <= limit).all(-1).mean(-1)
            axis.imshow(share, cmap="cividis", vmin=0, vmax=100, origin="lower", aspect="auto")
            for (i, j), value in np.ndenumerate(share):
                axis.text(j, i, f"{value:.0f}", ha="center", va="center", color="white" if value < 55 else "black")
            axis.set_xticks(range(len(millimetres)), millimetres)
            axis.set_yticks(range(len(degrees)), degrees)
            axis.set(xlabel="start off by [mm] (synthetic block)")
            axis.set_title(
                f"{name}: back within {limit[0]:g}° and {limit[1]:g} mm [%], n = {found.shape[2]}", fontsize=9
            )
            axis.grid(visible=False)
        axes[0].set_ylabel("start off by [°]")
    return figure


def step_by_step(errors: np.ndarray) -> Figure:
    """Error (starts, steps + 1, 2) after every iteration, degrees and millimetres, a line per start."""
    with style.applied():
        figure, axes = panels(2, (8.0, 2.8), [1, 1], side_by_side=True)
        for axis, values, unit in zip(
            axes, np.moveaxis(errors, -1, 0), ("rotation [°]", "translation [mm]"), strict=True
        ):
            axis.plot(values.T, color=style.OBJECTS[0], alpha=0.6, marker=".", markersize=4)
            axis.set(xlabel="iterations", ylabel=unit)
            axis.set_yscale("log")
            axis.set_yticks([0.1, 0.2, 0.5, 1, 2, 5, 10])
            axis.set_ylim(0.7 * values.min(), 1.3 * values.max())
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("")
        axes[0].set_title("synthetic block, one line per start")
    return figure


def held_directions(strengths: Mapping[str, np.ndarray], needed: float) -> Figure:
    """How firmly each shape holds the six directions of its pose, least first; below the line it is left alone."""
    floor = needed / 12
    with style.applied():
        figure, axes = panels(len(strengths), (8.0, 2.7), [1] * len(strengths), side_by_side=True)
        for axis, (name, values) in zip(axes, strengths.items(), strict=True):
            held = values >= needed
            colours = np.where(held, style.OBJECTS[0], style.STATUS["lost"][0])
            axis.bar(range(1, 7), np.maximum(values, floor * 1.5), color=colours, bottom=0)
            axis.axhline(needed, color="#222222", linestyle="--", linewidth=1)
            axis.set_yscale("log")
            axis.set_ylim(floor, 2)
            axis.set_title(f"{name}: {int((~held).sum())} of 6 free")
            axis.set_xticks(range(1, 7))
            axis.set(xlabel="direction")
            axis.grid(axis="x", visible=False)
        axes[0].set_ylabel("strength")
        for axis in axes[1:]:
            axis.set_yticklabels([])
    return figure


def spins_left(spins_deg: Mapping[str, np.ndarray], start_deg: float) -> Figure:
    """The spin that is left after refinement, a dot per noisy picture, for each way to refine."""
    with style.applied():
        figure, (axis,) = panels(1, (8.0, 0.9 + 0.4 * len(spins_deg)), [1])
        for k, values in enumerate(spins_deg.values()):
            axis.plot(
                values, k + np.linspace(-0.15, 0.15, len(values)), "o", color=style.OBJECTS[0], markersize=5, alpha=0.8
            )
        axis.axvline(0, color="#222222", linewidth=1)
        axis.axvline(start_deg, color=style.STATUS["lost"][0], linewidth=1, linestyle="--")
        axis.set_yticks(range(len(spins_deg)), list(spins_deg))
        axis.set_ylim(len(spins_deg) - 0.5, -0.5)
        axis.set(xlabel=f"spin left about the tin's axis [°] (synthetic); dashed: the start, {start_deg:g}°")
    return figure


def slices_beside_exact(volume: TsdfVolume, body: Body, heights_m: Sequence[float]) -> Figure:
    """A row per height: the fused distance, the exact one where it was observed, and their difference."""
    low = np.min([_around_surface(volume, z)[0] for z in heights_m], 0)
    high = np.max([_around_surface(volume, z)[1] for z in heights_m], 0)
    with style.applied():
        figure, axes = _grid(len(heights_m), 3, (8.6, 1.75 * len(heights_m) + 0.6))
        for row, z in zip(axes, heights_m, strict=True):
            points = slice_points(low, high, z)
            fused, exact = exact_distance(volume, body, points)
            left = draw_distance(row[0], points, fused, volume.tau_m)
            draw_distance(row[1], points, exact, volume.tau_m)
            right = _draw_difference(row[2], points, fused - exact)
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


def _draw_difference(axis: Axes, points: np.ndarray, difference_m: np.ndarray, limit_m: float = 0.005):
    import matplotlib

    colours = matplotlib.colormaps["PuOr"].with_extremes(bad=UNSEEN)
    x, y = 1e3 * points[0, :, 0], 1e3 * points[:, 0, 1]
    limits = {"vmin": -1e3 * limit_m, "vmax": 1e3 * limit_m}
    shown = axis.imshow(1e3 * difference_m, extent=(x[0], x[-1], y[0], y[-1]), origin="lower", cmap=colours, **limits)
    axis.grid(visible=False)
    return shown


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
