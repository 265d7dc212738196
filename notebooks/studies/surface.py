"""Notebooks 04 and 06: a synthetic body on a turntable, the surface fused from its images, refinement against it.

Noisy images at known poses; the body's exact distance beside the fused one; from how far refinement pulls a pose back,
and the directions in which it must not pull.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from pandas import Series, cut
from scipy.spatial import cKDTree
from scipy.stats import beta

from p2p_lib.core import se3
from p2p_lib.core.config import RefinementConfig, TsdfConfig
from p2p_lib.figures import style
from p2p_lib.figures.plots import WIDTH_IN, logarithmic, panels
from p2p_lib.method.refinement import Keypoints, refine, surface_distances
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.motion import look_at
from p2p_lib.synthetic.noise import Sensor, measured_colour, measured_depth
from p2p_lib.synthetic.render import render
from p2p_lib.synthetic.scene import VGA

#: What stands behind the body: depth there lets the volume carve.
_BEHIND_M = 1.5
_UNSEEN = "#C8C8C8"
_MARGIN_M = 0.012  # of a slice around the surface


@dataclass(frozen=True, eq=False)
class Shot:
    """One noisy image: rgb (H, W, 3) uint8, depth_m (H, W), mask (H, W) bool, and the true T_cam_obj."""

    rgb: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray
    T_cam_obj: np.ndarray


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh and, where its shape is simple, how far points (..., 3) lie beyond its faces (..., k); inside negative."""

    name: str
    mesh: shapes.Mesh
    beyond_m: Callable[[np.ndarray], np.ndarray] | None = None

    def distance_m(self, p: np.ndarray) -> np.ndarray:
        """Exact signed distance (...) of points (..., 3), outside positive."""
        assert self.beyond_m is not None
        beyond = self.beyond_m(p)
        return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)


def carton(seed: int) -> Body:
    """A printed carton, centred, edges along the axes."""
    size_m = (0.08, 0.055, 0.11)
    half = np.array(size_m) / 2
    return Body("carton", shapes.box(np.random.default_rng(seed), size_m), lambda p: np.abs(p) - half)


def tin(seed: int) -> Body:
    """A printed tin about the z axis, centred."""
    radius_m, height_m = 0.037, 0.11

    def beyond_m(p: np.ndarray) -> np.ndarray:
        return np.stack([np.hypot(p[..., 0], p[..., 1]) - radius_m, np.abs(p[..., 2]) - height_m / 2], -1)

    return Body("tin", shapes.can(np.random.default_rng(seed), radius_m, height_m), beyond_m)


def block(seed: int) -> Body:
    """A leaning, five-sided stump: no two directions of it are alike."""
    return Body("block", shapes.block(np.random.default_rng(seed), 0.055, 0.10))


def board(seed: int) -> Body:
    """A plain board that fills the image: all that is seen of it is a plane."""
    return Body("board", shapes.slab(np.random.default_rng(seed), (1.2, 1.2, 0.02)))


def ring(count: int, distance_m: float = 0.5, elevation_deg: float = 30.0, turn_deg: float = 360.0) -> np.ndarray:
    """(count, 4, 4) T_cam_obj of a camera on a circle about the body's z axis, looking at its origin."""
    around = np.radians(turn_deg) * np.arange(count) / count
    up, out = np.sin(np.radians(elevation_deg)), np.cos(np.radians(elevation_deg))
    centres = distance_m * np.stack([out * np.cos(around), out * np.sin(around), np.full(count, up)], -1)
    return se3.inverse(np.stack([look_at(centre, np.zeros(3)) for centre in centres]))


def photograph(body: Body, T_cam_obj: np.ndarray, seed: int, sensor: Sensor | None = None) -> list[Shot]:
    """The body alone at poses (n, 4, 4), with the sensor's noise."""
    sensor, taken = sensor or Sensor(), []
    for k, T in enumerate(T_cam_obj):
        rng = np.random.default_rng([seed, k])
        exact = render([(body.mesh, se3.IDENTITY)], VGA, se3.inverse(T))
        rgb, depth_m = measured_colour(exact.rgb, sensor, 1.0, rng), measured_depth(exact, VGA, sensor, rng)
        mask = exact.label == 1
        taken.append(Shot(rgb, np.where(mask, depth_m, _BEHIND_M).astype(np.float32), mask, T))
    return taken


def fuse(shots: Sequence[Shot], config: TsdfConfig, poses: np.ndarray | None = None) -> TsdfVolume:
    """The surface fused from shots, kept under keys 0, 1, ..., at their true poses or at ``poses`` (n, 4, 4)."""
    volume = TsdfVolume(config)
    for key, shot in enumerate(shots):
        T = shot.T_cam_obj if poses is None else poses[key]
        volume.integrate(shot.depth_m, shot.rgb, shot.mask, VGA, T, key=key)
    return volume


def slice_points(low_m: np.ndarray, high_m: np.ndarray, z_m: float, step_m: float = 0.0005) -> np.ndarray:
    """(rows, columns, 3) points of the plane z = ``z_m`` between two corners (3,); rows run along y."""
    x, y = (np.arange(low_m[k], high_m[k] + step_m / 2, step_m) for k in (0, 1))
    return np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z_m)], -1)


def seen_distance(volume: TsdfVolume, p_obj: np.ndarray) -> np.ndarray:
    """Fused signed distance in metres at points (..., 3), NaN where nothing was observed."""
    value, valid = volume.query(p_obj)
    return np.where(valid, value, np.nan)


def around_surface(volume: TsdfVolume, z_m: float) -> np.ndarray:
    """(2, 3) corners of the part of the slice at ``z_m`` within the truncation distance of the surface."""
    points = slice_points(volume.corners_m().min(0), volume.corners_m().max(0), z_m, step_m=0.002)
    near = points[np.abs(seen_distance(volume, points)) < 0.98 * volume.tau_m]
    return np.stack([near.min(0) - _MARGIN_M, near.max(0) + _MARGIN_M])


def draw_slice(
    axis: Axes, points: np.ndarray, value_m: np.ndarray, limit_m: float, colours: str = "BrBG", zero_level: bool = True
) -> AxesImage:
    """Signed distance (rows, columns) over slice points: negative brown, positive green, NaN grey."""
    x, y = 1e3 * points[0, :, 0], 1e3 * points[:, 0, 1]
    shown = axis.imshow(
        1e3 * value_m,
        matplotlib.colormaps[colours].with_extremes(bad=_UNSEEN),
        extent=(x[0], x[-1], y[0], y[-1]),
        origin="lower",
        vmin=-1e3 * limit_m,
        vmax=1e3 * limit_m,
    )
    if zero_level and np.nanmin(value_m) < 0 < np.nanmax(value_m):
        axis.contour(x, y, value_m, [0.0], colors="#222222", linewidths=0.9)
    axis.grid(visible=False)
    axis.set(aspect="equal")
    return shown


# --- the fused surface against the exact one -------------------------------------------------------


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


def perturbed(
    T: np.ndarray, degrees: float | np.ndarray, millimetres: float | np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Poses T (..., 4, 4) turned and shifted by so much, each in a random direction."""
    axis, along = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return T @ se3.exp(np.concatenate([np.radians(degrees) * axis, millimetres / 1e3 * along], -1))


def drifted(T_cam_obj: np.ndarray, degrees: float, millimetres: float, rng: np.random.Generator) -> np.ndarray:
    """Poses (n, 4, 4) with a drift that grows evenly, up to so much at the last."""
    fraction = np.linspace(0, 1, len(T_cam_obj))[:, None]
    return perturbed(T_cam_obj, fraction * degrees, fraction * millimetres, rng)


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


# --- refinement against the surface ----------------------------------------------------------------


def basin_of_convergence(
    volume: TsdfVolume,
    p_cam: np.ndarray,
    T_true: np.ndarray,
    config: RefinementConfig,
    off: np.ndarray,
    seed: int = 0,
) -> np.ndarray:
    """(n, 2) errors after refinement, degrees and millimetres, from starts that are ``off`` (n, 2) by so much.

    Depth points p_cam (N, 3) alone, without keypoints.
    """
    starts = [perturbed(T_true, deg, mm, np.random.default_rng([seed, k])) for k, (deg, mm) in enumerate(off)]
    return np.array([se3.error_deg_mm(refine(T, p_cam, volume, config).T_cam_obj, T_true) for T in starts])


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
    of_cloud: Sequence[Keypoints | None] = keypoints or [None] * len(clouds)
    pairs = zip(clouds, of_cloud, strict=True)
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
    low_m, high_m = around_surface(volume, 0.0)
    points = slice_points(low_m, high_m, 0.0)
    figure, axes = panels(len(poses), (4.2 * len(poses), 4.0), side_by_side=True)
    for axis, (name, T_cam_obj) in zip(axes, poses.items(), strict=True):
        shown = draw_slice(axis, points, seen_distance(volume, points), volume.tau_m)
        p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
        near_mm = 1e3 * p_obj[np.abs(p_obj[:, 2]) < 0.006]
        axis.plot(*near_mm[:, :2].T, "o", color=style.AXES[0], markersize=3.5, markeredgecolor="white", mew=0.4)
        axis.set(xlabel="x [mm]", title=f"synthetic: {name}")
    axes[0].set_ylabel("y [mm]")
    figure.colorbar(shown, ax=axes, label=r"signed distance $\Phi$ [mm]", shrink=0.85)
    return figure


def dragged(volume: TsdfVolume, p_cam: np.ndarray, T_true: np.ndarray, shift_mm: float, turn_deg: float) -> Figure:
    """:func:`onto_the_surface`, the pose shifted along x and turned about z, and how far off all points are then."""
    T_cam_obj = T_true @ se3.exp(np.array([0, 0, np.radians(turn_deg), shift_mm / 1e3, 0, 0]))
    off_m = surface_distances(volume, p_cam, T_cam_obj[None]).mean()
    return onto_the_surface(volume, p_cam, {f"mean distance {1e3 * off_m:.1f} mm": T_cam_obj})


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
def basins(errors: Mapping[str, np.ndarray], off: np.ndarray, limit: tuple[float, float]) -> Figure:
    """Which starts, ``off`` (n, 2) degrees and millimetres, come back to within ``limit``, and the share by shift."""
    figure, axes = panels(len(errors) + 1, (WIDTH_IN, 2.9), side_by_side=True)
    bins = np.linspace(0, off[:, 1].max(), 7)
    of = np.digitize(off[:, 1], bins[1:-1])
    for axis, colour, (name, found) in zip(axes, style.METHODS, errors.items(), strict=False):
        back = np.atleast_1d((found <= limit).all(-1))
        for rows, mark, shade in ((back, "o", colour), (~back, "x", style.STATUS["lost"][0])):
            axis.plot(off[rows, 1], off[rows, 0], mark, color=shade, markersize=4, alpha=0.8)
        axis.set(xlabel="start off by [mm]", title=f"{name}: {back.sum()} of {len(back)} back")
        tries, hits = np.bincount(of, minlength=6), np.bincount(of, back, minlength=6)
        middle, low, high = (100 * beta.ppf(q, hits + 0.5, tries - hits + 0.5) for q in (0.5, 0.025, 0.975))
        at = (bins[1:] + bins[:-1]) / 2
        axes[-1].plot(at, middle, "o-", color=colour, markersize=4, label=name)
        axes[-1].fill_between(at, low, high, color=colour, alpha=0.15, lw=0)
    axes[0].set_ylabel("start off by [°]")
    axes[-1].set(xlabel="start off by [mm]", ylim=(0, 102), title="share that came back [%]")
    axes[-1].legend(loc="lower left", fontsize=8)
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
