"""Paths of objects and cameras: smooth poses from a few keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core import se3


def varied(rng: np.random.Generator, keys: ArrayLike, yaw_deg: float = 0.0, mirrored: float = 1.0) -> np.ndarray:
    """Keys (K, 7) of :func:`path` moved by about a centimetre and a few degrees, turned, perhaps mirrored (-1)."""
    at = np.array(keys, float)
    at[:, 1:4] += rng.uniform(-0.008, 0.008, (len(at), 3))
    at[:, 4:] += rng.uniform(-3, 3, (len(at), 3))
    at[:, 4] += yaw_deg
    at[:, [1, 4, 6]] *= mirrored
    return at


def path(keys: np.ndarray, frames: int) -> np.ndarray:
    """Smooth poses (frames, 4, 4) through keys of frame, x, y, z, yaw, pitch, roll (metres, degrees)."""
    from scipy.spatial.transform import Rotation

    # Monotone cubics have kinks in velocity at the keys; a hand has not.
    sigma = max(1, round(6 * frames / 300))
    at = through(keys[:, 0], keys[:, 1:], np.linspace(keys[0, 0], keys[-1, 0], frames), sigma)
    return se3.from_rt(Rotation.from_euler("ZXY", at[:, 3:], degrees=True).as_matrix(), at[:, :3])


def wander(rng: np.random.Generator, frames: int, reach_m: float, reach_deg: float, period: float) -> np.ndarray:
    """Smooth poses (frames, 4, 4) about the identity: slow sways of about ``period`` frames in all six directions."""
    time = np.arange(frames)[:, None]
    pace = 2 * np.pi / (period * rng.uniform(0.8, 1.25, (2, 6)))
    phase = rng.uniform(0, 2 * np.pi, (2, 6))
    sway = 0.75 * np.sin(pace[0] * time + phase[0]) + 0.25 * np.sin(2 * pace[1] * time + phase[1])
    T = se3.exp(np.concatenate([np.radians(reach_deg) * sway[:, :3], np.zeros((frames, 3))], 1))
    T[:, :3, 3] = reach_m * sway[:, 3:]
    return T


def through(keys: ArrayLike, values: ArrayLike, frames: np.ndarray, sigma: float) -> np.ndarray:
    """Values (T, ...) at frames (T,), by monotone cubics through values (K, ...) at keys (K,), see :func:`eased`."""
    from scipy.interpolate import PchipInterpolator

    return eased(PchipInterpolator(keys, values)(frames), sigma)


def eased(values: np.ndarray, sigma: float) -> np.ndarray:
    """Values (T, ...) smoothed over time by a Gaussian of ``sigma`` frames."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, sigma, axis=0, mode="nearest")


def turned(T: np.ndarray, yaw_rad: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) turned about their own z axis by angles (T,), and moved by ``centre`` (3,) or (T, 3)."""
    T = T @ se3.exp(yaw_rad[:, None] * np.array([0, 0, 1.0, 0, 0, 0]))
    T[:, :3, 3] += centre
    return T


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_world_cam of an upright camera (x right, y down, z forward)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return se3.from_rt(np.stack([right, np.cross(forward, right), forward], 1), eye)


def standing(eye: np.ndarray, target: np.ndarray, frames: int) -> np.ndarray:
    """T_world_cam (frames, 4, 4) of an upright camera that stands still."""
    return np.broadcast_to(look_at(eye, target), (frames, 4, 4))


def minimum_jerk(frames: int) -> np.ndarray:
    """How much of its way a hand has gone at frames 0 to ``frames``, (frames + 1,) (Flash and Hogan, 1985)."""
    s = np.arange(frames + 1) / frames
    return s**3 * (10 - 15 * s + 6 * s**2)


def carried(T0: np.ndarray, T1: np.ndarray, frames: int, pivot: np.ndarray) -> np.ndarray:
    """Poses (frames, 4, 4) after T0 up to T1 at minimum jerk; the point ``pivot`` of the model goes straight."""
    s = minimum_jerk(frames)[1:]
    R = T0[:3, :3] @ se3.exp(s[:, None] * np.r_[se3.so3_log(T0[:3, :3].T @ T1[:3, :3]), 0, 0, 0])[:, :3, :3]
    start, end = (T[:3, :3] @ pivot + T[:3, 3] for T in (T0, T1))
    return se3.from_rt(R, start + s[:, None] * (end - start) - R @ pivot)


def spun(T: np.ndarray, deg: float, axis: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """A pose turned about an axis (any length) in the world through the model's point ``pivot``."""
    R = se3.exp(np.r_[np.radians(deg) * axis / np.linalg.norm(axis), 0, 0, 0])[:3, :3]
    centre = T[:3, :3] @ pivot + T[:3, 3]
    return se3.from_rt(R @ T[:3, :3], centre + R @ (T[:3, 3] - centre))
