"""Notebook 06: how good a fused surface is, against a body whose exact signed distance is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from matplotlib.figure import Figure
from pandas import Series, cut
from scipy.spatial import cKDTree

from p2p_lib.core import se3
from p2p_lib.core.config import TsdfConfig
from p2p_lib.figures import style
from p2p_lib.figures.plots import logarithmic, panels
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.studies.turntable import Body, Shot, around_surface, draw_slice, fuse, seen_distance, slice_points


def exact_distance(volume: TsdfVolume, body: Body, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(fused, exact) signed distance in metres at points (..., 3), both NaN where nothing was observed.

    The exact one is cut off at the truncation distance, as the fused one is.
    """
    fused = seen_distance(volume, points)
    exact = np.clip(body.distance_m(points), -volume.tau_m, volume.tau_m)
    return fused, np.where(np.isfinite(fused), exact, np.nan)


def seen_points(body: Body, T_cam_obj: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) points of a convex body's surface that face at least one of the cameras (m, 4, 4) by 75° or less."""
    p, normals = body.mesh.sample(count, rng)
    to_camera = se3.inverse(T_cam_obj)[:, None, :3, 3] - p
    cosine = np.einsum("mni,ni->mn", to_camera, normals) / np.linalg.norm(to_camera, axis=-1)
    return p[(cosine > np.cos(np.radians(75))).any(0)]


def mesh_errors(mesh: trimesh.Trimesh, body: Body, seen: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Mean distance in metres from the mesh to the exact surface, and from the seen points (n, 3) to the mesh."""
    on_mesh, _ = trimesh.sample.sample_surface(mesh, 20000, seed=int(rng.integers(2**31)))
    to_mesh, _ = cKDTree(on_mesh).query(seen)
    return float(np.abs(body.distance_m(on_mesh)).mean()), float(to_mesh.mean())


def errors_by_keyframes(
    shots: Sequence[Shot], counts: Sequence[int], body: Body, config: TsdfConfig, seed: int = 0
) -> np.ndarray:
    """(len(counts), 2) mesh errors in metres, both ways, after so many of the shots, spread evenly.

    Completeness is always that of everything that all shots together have seen.
    """
    rng = np.random.default_rng([seed, 5])
    seen = seen_points(body, np.stack([s.T_cam_obj for s in shots]), 6000, rng)
    picked = [np.linspace(0, len(shots), count, endpoint=False).astype(int) for count in counts]
    return np.array([mesh_errors(fuse([shots[k] for k in p], config).mesh(), body, seen, rng) for p in picked])


def drifted(T_cam_obj: np.ndarray, degrees: float, millimetres: float, rng: np.random.Generator) -> np.ndarray:
    """Poses (n, 4, 4) with a drift that grows evenly, up to so much at the last."""
    axis, along = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    fraction = np.linspace(0, 1, len(T_cam_obj))[:, None]
    return T_cam_obj @ se3.exp(fraction * np.r_[np.radians(degrees) * axis, millimetres / 1e3 * along])


@style.styled
def slices_beside_exact(volume: TsdfVolume, body: Body, heights_m: Sequence[float]) -> Figure:
    """A row per height: the fused distance, the exact one where it was observed, and their difference."""
    corners = np.array([around_surface(volume, z) for z in heights_m])
    figure = Figure((8.6, 1.75 * len(heights_m) + 0.6), layout="constrained")
    axes = figure.subplots(len(heights_m), 3, sharex=True, sharey=True, squeeze=False)
    for row, z in zip(axes, heights_m, strict=True):
        points = slice_points(corners[:, 0].min(0), corners[:, 1].max(0), z)
        fused, exact = exact_distance(volume, body, points)
        left = draw_slice(row[0], points, fused, volume.tau_m)
        draw_slice(row[1], points, exact, volume.tau_m)
        right = draw_slice(row[2], points, fused - exact, 0.005, "PuOr", zero_level=False)
        row[0].set_ylabel(f"z = {1e3 * z:.0f} mm\ny [mm]")
    titles = "fused: $\\tau V$", f"exact: synthetic {body.name}", "fused - exact"
    for top, bottom, title in zip(axes[0], axes[-1], titles, strict=True):
        top.set_title(title)
        bottom.set_xlabel("x [mm]")
    bars = (left, axes[:, :2], "signed\ndistance\n[mm]"), (right, axes[:, 2], "differ-\nence\n[mm]")
    for shown, beside, title in bars:
        figure.colorbar(shown, ax=beside, shrink=0.8).ax.set_title(title, fontsize=8, loc="left")
    return figure


@style.styled
def fused_against_exact(fused_m: np.ndarray, exact_m: np.ndarray, tau_m: float) -> Figure:
    """Fused over exact distance at many points: median and the middle 80 % in bins of the exact one."""
    inside = np.isfinite(fused_m) & (np.abs(exact_m) < 0.999 * tau_m)
    bins = cut(1e3 * exact_m[inside], 1e3 * np.linspace(-tau_m, tau_m, 41))
    groups = Series(1e3 * fused_m[inside]).groupby(bins, observed=True)
    table = groups.quantile([0.1, 0.5, 0.9]).unstack()[groups.count() > 20]
    figure, (axis,) = panels(1, (5.6, 4.2))
    middles = table.index.categories[table.index.codes].mid
    axis.fill_between(middles, table[0.1], table[0.9], color="#A9CCE8", lw=0, label="middle 80 % of the voxels")
    axis.plot(middles, table[0.5], color=style.OBJECTS[0], label="median")
    axis.axline((0, 0), slope=1, color="#222222", linestyle="--", linewidth=1, label="fused = exact")
    axis.set(xlabel="exact distance [mm] (synthetic)", ylabel=r"fused distance $\tau V$ [mm]", aspect="equal")
    axis.legend(loc="upper left")
    return figure


@style.styled
def errors_over_keyframes(counts: Sequence[int], errors_m: np.ndarray, bar_mm: float) -> Figure:
    """Mesh errors both ways (len(counts), 2) over the number of keyframes."""
    figure, (axis,) = panels(1, (6.4, 3.2))
    accuracy_mm, completeness_mm = 1e3 * errors_m.T
    axis.plot(counts, accuracy_mm, "o-", color=style.OBJECTS[0], markersize=5, label="mesh to exact surface")
    axis.plot(counts, completeness_mm, "s--", color=style.OBJECTS[1], markersize=5, label="seen surface to mesh")
    axis.axhline(bar_mm, color=style.STATUS["lost"][0], linestyle=":", linewidth=1)
    logarithmic(axis.xaxis, base=2)
    logarithmic(axis.yaxis)
    axis.set_xticks(counts, counts)
    axis.set(xlabel="keyframes fused (synthetic)", ylabel="mean distance [mm]")
    axis.legend(loc="upper right")
    return figure
