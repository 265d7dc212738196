"""A synthetic body on a turntable, for the notebooks on the surface.

Noisy images of it at known poses, the surface fused from them, its exact distance, and slices through both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.motion import look_at
from p2p_lib.synthetic.noise import Sensor, measured_colour, measured_depth
from p2p_lib.synthetic.render import render
from p2p_lib.synthetic.scene import VGA

#: What stands behind the body: depth there lets the volume carve.
_BEHIND_M = 1.5
_UNSEEN = "#C8C8C8"


@dataclass(frozen=True, eq=False)
class Shot:
    """One noisy image: rgb (H, W, 3) uint8, depth_m (H, W), mask (H, W) bool, and the true T_cam_obj."""

    rgb: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray
    T_cam_obj: np.ndarray


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh and, where its shape has one in closed form, its signed distance (..., 3) -> (...), outside positive."""

    name: str
    mesh: shapes.Mesh
    distance_m: Callable[[np.ndarray], np.ndarray] | None = None


def carton(seed: int, size_m: tuple[float, float, float] = (0.08, 0.055, 0.11)) -> Body:
    """A printed carton, centred, edges along the axes."""
    half = np.array(size_m) / 2

    def distance_m(p: np.ndarray) -> np.ndarray:
        beyond = np.abs(p) - half
        return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)

    return Body("carton", shapes.box(np.random.default_rng(seed), size_m), distance_m)


def tin(seed: int, radius_m: float = 0.037, height_m: float = 0.11) -> Body:
    """A printed tin about the z axis, centred."""

    def distance_m(p: np.ndarray) -> np.ndarray:
        beyond = np.stack([np.hypot(p[..., 0], p[..., 1]) - radius_m, np.abs(p[..., 2]) - height_m / 2], -1)
        return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)

    return Body("tin", shapes.can(np.random.default_rng(seed), radius_m, height_m), distance_m)


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


def photograph(
    body: Body, T_cam_obj: np.ndarray, seed: int, sensor: Sensor | None = None, camera: Camera = VGA
) -> list[Shot]:
    """The body alone at poses (n, 4, 4), with the sensor's noise."""
    sensor, taken = sensor or Sensor(), []
    for k, T in enumerate(T_cam_obj):
        rng = np.random.default_rng([seed, k])
        exact = render([(body.mesh, se3.IDENTITY)], camera, se3.inverse(T))
        rgb, depth_m = measured_colour(exact.rgb, sensor, 1.0, rng), measured_depth(exact, camera, sensor, rng)
        mask = exact.label == 1
        taken.append(Shot(rgb, np.where(mask, depth_m, _BEHIND_M).astype(np.float32), mask, T))
    return taken


def fuse(
    shots: Sequence[Shot], config: TsdfConfig, poses: np.ndarray | None = None, camera: Camera = VGA
) -> TsdfVolume:
    """The surface fused from shots, kept under keys 0, 1, ..., at their true poses or at ``poses`` (n, 4, 4)."""
    volume = TsdfVolume(config)
    for key, shot in enumerate(shots):
        T = shot.T_cam_obj if poses is None else poses[key]
        volume.integrate(shot.depth_m, shot.rgb, shot.mask, camera, T, key=key)
    return volume


def slice_points(low_m: np.ndarray, high_m: np.ndarray, z_m: float, step_m: float = 0.0005) -> np.ndarray:
    """(rows, columns, 3) points of the plane z = ``z_m`` between two corners (3,); rows run along y."""
    x, y = (np.arange(low_m[k], high_m[k] + step_m / 2, step_m) for k in (0, 1))
    return np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z_m)], -1)


def seen_distance(volume: TsdfVolume, p_obj: np.ndarray) -> np.ndarray:
    """Fused signed distance in metres at points (..., 3), NaN where nothing was observed."""
    value, valid = volume.query(p_obj)
    return np.where(valid, value, np.nan)


def around_surface(volume: TsdfVolume, z_m: float, margin_m: float = 0.012) -> np.ndarray:
    """(2, 3) corners of the part of the slice at ``z_m`` within the truncation distance of the surface."""
    points = slice_points(volume.corners_m().min(0), volume.corners_m().max(0), z_m, step_m=0.002)
    near = points[np.abs(seen_distance(volume, points)) < 0.98 * volume.tau_m]
    return np.stack([near.min(0) - margin_m, near.max(0) + margin_m])


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
