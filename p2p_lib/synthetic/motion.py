"""Paths of hands and cameras: smooth poses from a few keys."""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3


def varied(rng: np.random.Generator, keys: list[tuple], yaw_deg: float, mirrored: float) -> np.ndarray:
    """Keys (K, 7) moved by about a centimetre and a few degrees, turned by a yaw, perhaps mirrored left to right."""
    keys = np.array(keys, float)
    keys[:, 1:4] += rng.uniform(-0.008, 0.008, (len(keys), 3))
    keys[:, 4:] += rng.uniform(-3, 3, (len(keys), 3))
    keys[:, 4] += yaw_deg
    keys[:, [1, 4, 6]] *= mirrored
    return keys


def path(keys: np.ndarray, frames: int) -> np.ndarray:
    """Smooth poses (frames, 4, 4) through keys of frame, x, y, z, yaw, pitch, roll (degrees)."""
    from scipy.interpolate import PchipInterpolator

    time = np.linspace(keys[0, 0], keys[-1, 0], frames)
    at = PchipInterpolator(keys[:, 0], keys[:, 1:])(time)
    # Monotone cubics have kinks in velocity at the keys; a hand has not.
    at = eased(at, max(1, round(6 * frames / 300)))
    x, y, z = np.eye(3)
    angles = np.radians(at[:, 3:])
    yaw, pitch, roll = (turn(axis, angles[:, k]) for k, axis in enumerate((z, x, y)))
    T = yaw @ pitch @ roll
    T[:, :3, 3] = at[:, :3]
    return T


def wander(rng: np.random.Generator, frames: int, reach_m: float, reach_deg: float, period: float) -> np.ndarray:
    """Smooth poses (frames, 4, 4) about the identity: slow sways of about ``period`` frames in all six directions."""
    time = np.arange(frames)[:, None]
    pace = 2 * np.pi / (period * rng.uniform(0.8, 1.25, (2, 6)))
    phase = rng.uniform(0, 2 * np.pi, (2, 6))
    sway = 0.75 * np.sin(pace[0] * time + phase[0]) + 0.25 * np.sin(2 * pace[1] * time + phase[1])
    T = se3.exp(np.concatenate([np.radians(reach_deg) * sway[:, :3], np.zeros((frames, 3))], 1))
    T[:, :3, 3] = reach_m * sway[:, 3:]
    return T


def eased(values: np.ndarray, sigma: float) -> np.ndarray:
    """Values (T, ...) smoothed over time by a Gaussian of ``sigma`` frames."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, sigma, axis=0, mode="nearest")


def turn(axis: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Rotations (T, 4, 4) about one axis."""
    return se3.exp(np.concatenate([angle_rad[:, None] * axis, np.zeros((len(angle_rad), 3))], 1))


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_world_cam of an upright camera (x right, y down, z forward)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return se3.from_rt(np.stack([right, np.cross(forward, right), forward], 1), eye)


def sweep(eye: np.ndarray, frames: int, first: tuple, second: tuple, mirrored: float) -> np.ndarray:
    """A board that comes in from the side, stays in the line of sight to one object, then to another, and leaves.

    ``first`` and ``second`` are (T_world_model, from, to) with frames counted in 300.
    """
    scale = (frames - 1) / 299
    side = np.array([-mirrored * 0.42, -0.2, 0.25])
    keys, points = [0.0], [side]
    for T, start, stop in (first, second):
        for t in np.linspace(start, stop, 6):
            keys.append(t)
            points.append(eye + 0.62 * (T[round(t * scale), :3, 3] - eye))
    keys += [keys[-1] + 10, 299.0]
    points += [side * [-1, 1, 1]] * 2
    keys.insert(1, first[1] - 10)
    points.insert(1, side)
    from scipy.interpolate import PchipInterpolator

    at = eased(PchipInterpolator(keys, np.array(points))(np.linspace(0, 299, frames)), scale)
    T = np.broadcast_to(se3.exp(np.array([-0.4, 0, 0, 0, 0, 0.0])), (frames, 4, 4)).copy()
    T[:, :3, 3] = at
    return T
