"""Recordings made up for the tests: a body waved about, seen by motion capture and by a camera on another clock."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from p2p_lib.core import se3
from p2p_lib.datasets.recording import PoseLog


@dataclass(frozen=True)
class Recording:
    """camera: T_cam_obj at 30 Hz; mocap: T_world_body at 120 Hz; truth: T_world_body, without noise, camera's clock."""

    camera: PoseLog
    mocap: PoseLog
    truth: PoseLog
    T_cam_world: np.ndarray
    T_body_obj: np.ndarray
    offset_s: float


def seen(times_s, T):
    """A log without the samples in which the body was not seen."""
    keep = np.isfinite(T).all((1, 2))
    return PoseLog(times_s[keep], T[keep])


def noise(rng, n, deg, mm):
    return se3.exp(np.c_[rng.normal(0, np.deg2rad(deg), (n, 3)), rng.normal(0, mm / 1000, (n, 3))])


def record(seed, offset_s, seconds=20.0, turn_rad=0.5, drift=False, axis=None):
    """Noise as of real systems: camera 0.7 degrees and 3 mm a frame, 3 % wild, 5 % lost, stamps off by 0.5 ms; motion
    capture 0.1 degrees and 0.3 mm, blind for 3 % of the time. ``drift``: the camera's error wanders by 5 mm besides."""
    rng = np.random.default_rng(seed)
    t = np.arange(int((seconds + 4) * 200)) / 200
    xi = gaussian_filter1d(rng.normal(size=(len(t), 6)), 50, axis=0, mode="wrap")
    xi *= np.repeat([turn_rad, 0.1], 3) / xi.std(0)
    if axis is not None:
        xi[:, :3] = xi[:, :1] * axis
    T = se3.exp(np.c_[xi[:, :3], np.zeros((len(t), 3))])
    T[:, :3, 3] = xi[:, 3:] + [0.3, 0.2, 1.0]
    truth = PoseLog(t, T)
    T_cam_world = se3.exp(rng.normal(size=6))
    T_body_obj = se3.exp(np.r_[rng.normal(size=3), rng.normal(0, 0.05, 3)])
    frames = 2 + np.arange(int(seconds * 30)) / 30
    A = T_cam_world @ truth.at(frames) @ T_body_obj @ noise(rng, len(frames), 0.7, 3)
    if drift:
        walk = gaussian_filter1d(rng.normal(size=(len(frames), 6)), 20, axis=0)
        A = A @ se3.exp(walk / walk.std(0) * np.repeat([np.deg2rad(1.0), 0.005], 3))
    wild = rng.random(len(frames)) < 0.03
    A[wild] = A[wild] @ noise(rng, int(wild.sum()), 60, 50)
    A[rng.random(len(frames)) < 0.05] = np.nan
    samples = 0.5 + np.arange(int((seconds + 3) * 120)) / 120
    B = truth.at(samples) @ noise(rng, len(samples), 0.1, 0.3)
    B[int(len(B) * 0.40) : int(len(B) * 0.43)] = np.nan
    camera = seen(frames + rng.normal(0, 0.0005, len(frames)), A)
    return Recording(camera, seen(samples + offset_s, B), truth, T_cam_world, T_body_obj, offset_s)
