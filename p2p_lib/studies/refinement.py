"""Notebook 04: from how far SDF refinement pulls a pose back, and the directions in which it must not pull."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from p2p_lib.core import se3
from p2p_lib.core.config import RefinementConfig
from p2p_lib.figures import style
from p2p_lib.figures.plots import logarithmic, panels
from p2p_lib.method.refinement import Keypoints, refine
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.studies.turntable import around_surface, draw_slice, seen_distance, slice_points


def perturbed(T: np.ndarray, degrees: float, millimetres: float, rng: np.random.Generator) -> np.ndarray:
    """T turned and shifted by so much, each in a random direction."""
    axis, along = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return T @ se3.exp(np.r_[np.radians(degrees) * axis, millimetres / 1e3 * along])


def basin_of_convergence(
    volume: TsdfVolume,
    p_cam: np.ndarray,
    T_true: np.ndarray,
    config: RefinementConfig,
    degrees: Sequence[float],
    millimetres: Sequence[float],
    trials: int,
    seed: int = 0,
) -> np.ndarray:
    """(R, S, trials, 2) errors after refinement, degrees and millimetres, from starts that far off.

    Depth points p_cam (N, 3) alone, without keypoints.
    """
    errors = np.zeros((len(degrees), len(millimetres), trials, 2))
    for i, j, k in np.ndindex(*errors.shape[:3]):
        start = perturbed(T_true, degrees[i], millimetres[j], np.random.default_rng([seed, i, j, k]))
        errors[i, j, k] = se3.error_deg_mm(refine(start, p_cam, volume, config).T_cam_obj, T_true)
    return errors


def spin_errors(
    volume: TsdfVolume,
    clouds: Sequence[np.ndarray],
    T_true: np.ndarray,
    start_deg: float,
    config: RefinementConfig,
    keypoints: Sequence[Keypoints] | None = None,
) -> np.ndarray:
    """(n,) degrees of spin about the body's z axis that are left of ``start_deg``, one per cloud of depth points."""
    start = T_true @ se3.exp(np.r_[0, 0, np.radians(start_deg), 0, 0, 0])
    pairs = zip(clouds, keypoints or [None] * len(clouds), strict=True)
    found = np.stack([refine(start, p_cam, volume, config, keypoints=points).T_cam_obj for p_cam, points in pairs])
    return np.degrees(se3.log(se3.inverse(T_true) @ found)[:, 2])


def label_points(
    p_obj: np.ndarray, normals: np.ndarray, T_cam_obj: np.ndarray, count: int, sigma_m: float, rng: np.random.Generator
) -> Keypoints:
    """Map points of a printed surface seen again: ``count`` of those that face the camera, with noise ``sigma_m``."""
    p_cam, n_cam = se3.transform(T_cam_obj, p_obj), normals @ T_cam_obj[:3, :3].T
    facing = np.flatnonzero(np.einsum("ni,ni->n", p_cam, n_cam) < -0.4 * np.linalg.norm(p_cam, axis=1))
    rows = rng.choice(facing, count, replace=False)
    return Keypoints(p_obj[rows], p_cam[rows] + sigma_m * rng.normal(size=(count, 3)), np.full(count, sigma_m))


@style.styled
def onto_the_surface(volume: TsdfVolume, p_cam: np.ndarray, poses: Mapping[str, np.ndarray]) -> Figure:
    """The slice z = 0 through the fused surface, with the measured points within 6 mm of it as each pose puts them."""
    points = slice_points(*around_surface(volume, 0.0), 0.0)
    figure, axes = panels(len(poses), (4.2 * len(poses), 4.0), side_by_side=True)
    for axis, (name, T_cam_obj) in zip(axes, poses.items(), strict=True):
        shown = draw_slice(axis, points, seen_distance(volume, points), volume.tau_m)
        p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
        near_mm = 1e3 * p_obj[np.abs(p_obj[:, 2]) < 0.006]
        axis.plot(*near_mm[:, :2].T, "o", color=style.AXES[0], markersize=3.5, markeredgecolor="white", mew=0.4)
        axis.set_title(f"synthetic: {name}")
        axis.set(xlabel="x [mm]")
    axes[0].set_ylabel("y [mm]")
    figure.colorbar(shown, ax=axes, label=r"signed distance $\Phi$ [mm]", shrink=0.85)
    return figure


@style.styled
def step_by_step(errors: np.ndarray) -> Figure:
    """Error (starts, steps + 1, 2) after every iteration, degrees and millimetres, a line per start."""
    figure, axes = panels(2, (8.0, 2.8), side_by_side=True)
    for axis, values, unit in zip(axes, np.moveaxis(errors, -1, 0), ("rotation [°]", "translation [mm]"), strict=True):
        axis.plot(values.T, color=style.OBJECTS[0], alpha=0.6, marker=".", markersize=4)
        logarithmic(axis.yaxis)
        axis.set(xlabel="iterations", ylabel=unit, yticks=[0.1, 0.2, 0.5, 1, 2, 5, 10])
        axis.set_ylim(0.7 * values.min(), 1.3 * values.max())
    axes[0].set_title("synthetic block, one line per start")
    return figure


@style.styled
def basins(
    errors: Mapping[str, np.ndarray], degrees: Sequence[float], millimetres: Sequence[float], limit: tuple[float, float]
) -> Figure:
    """The share of starts that come back to within ``limit`` (degrees, millimetres), by how far they were off."""
    figure, axes = panels(len(errors), (4.0 * len(errors), 3.4), side_by_side=True)
    for axis, (name, found) in zip(axes, errors.items(), strict=True):
        share = 100 * (found <= limit).all(-1).mean(-1)
        axis.imshow(share, cmap="cividis", vmin=0, vmax=100, origin="lower", aspect="auto")
        for (i, j), value in np.ndenumerate(share):
            axis.text(j, i, f"{value:.0f}", ha="center", va="center", color="white" if value < 55 else "black")
        axis.set_xticks(range(len(millimetres)), millimetres)
        axis.set_yticks(range(len(degrees)), degrees)
        axis.set(xlabel="start off by [mm] (synthetic block)")
        axis.set_title(f"{name}: back within {limit[0]:g}° and {limit[1]:g} mm [%], n = {found.shape[2]}", fontsize=9)
        axis.grid(visible=False)
    axes[0].set_ylabel("start off by [°]")
    return figure


@style.styled
def held_directions(eigenvalues: Mapping[str, np.ndarray], needed: float) -> Figure:
    """Observability of the six directions of each shape's pose, least first; below ``needed`` one is left alone."""
    lowest = needed / 12
    figure, axes = panels(len(eigenvalues), (8.0, 2.7), side_by_side=True)
    for axis, (name, values) in zip(axes, eigenvalues.items(), strict=True):
        held = values >= needed
        colours = np.where(held, style.OBJECTS[0], style.STATUS["lost"][0])
        axis.bar(range(1, 7), np.maximum(values, 1.5 * lowest), color=colours)
        axis.axhline(needed, color="#222222", linestyle="--", linewidth=1)
        axis.set(xlabel="direction", yscale="log", ylim=(lowest, 2), xticks=range(1, 7))
        axis.set_title(f"{name}: {(~held).sum()} of 6 free")
        axis.grid(axis="x", visible=False)
        axis.label_outer()
    axes[0].set_ylabel("eigenvalue")
    return figure


@style.styled
def spins_left(spins_deg: Mapping[str, np.ndarray], start_deg: float) -> Figure:
    """The spin that is left after refinement, a dot per noisy image, for each way to refine."""
    figure, (axis,) = panels(1, (8.0, 0.9 + 0.4 * len(spins_deg)))
    for k, values in enumerate(spins_deg.values()):
        at = k + np.linspace(-0.15, 0.15, len(values))
        axis.plot(values, at, "o", color=style.OBJECTS[0], markersize=5, alpha=0.8)
    axis.axvline(0, color="#222222", linewidth=1)
    axis.axvline(start_deg, color=style.STATUS["lost"][0], linewidth=1, linestyle="--")
    axis.set_yticks(range(len(spins_deg)), list(spins_deg))
    axis.set_ylim(len(spins_deg) - 0.5, -0.5)
    axis.set(xlabel=f"spin left about the tin's axis [°] (synthetic); dashed: the start, {start_deg:g}°")
    return figure
