"""A synthetic body on a turntable: noisy pictures of it at known poses, the surface fused from them, exact distances.

What the notebooks on the surface share: rendered with the noise of a real depth camera, so that only poses are ideal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

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


@dataclass(frozen=True, eq=False)
class Shot:
    """One noisy picture: rgb (H, W, 3) uint8, depth_m (H, W), mask (H, W) bool, and the true T_cam_obj."""

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
    """A plain board that fills the picture: all that is seen of it is a plane."""
    return Body("board", shapes.slab(np.random.default_rng(seed), (1.2, 1.2, 0.02)))


def ring(count: int, distance_m: float = 0.5, elevation_deg: float = 30.0, turn_deg: float = 360.0) -> np.ndarray:
    """(count, 4, 4) T_cam_obj of a camera on a circle about the body's z axis, looking at its origin."""
    around = np.radians(turn_deg) * np.arange(count) / count
    up, out = np.sin(np.radians(elevation_deg)), np.cos(np.radians(elevation_deg))
    eyes = distance_m * np.stack([out * np.cos(around), out * np.sin(around), np.full(count, up)], -1)
    return se3.inverse(np.stack([look_at(eye, np.zeros(3)) for eye in eyes]))


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
