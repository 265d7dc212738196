"""How far SDF refinement can pull a pose back, and where it must not pull at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import RefinementConfig
from p2p_lib.method.refinement import Keypoints, refine
from p2p_lib.method.tsdf import TsdfVolume


def pose_error(T: np.ndarray, T_true: np.ndarray, centre_m: np.ndarray | None = None) -> tuple[float, float]:
    """Degrees, and millimetres at ``centre_m`` of the object frame (its origin by default)."""
    apart = se3.inverse(T_true) @ T
    at = np.zeros(3) if centre_m is None else np.asarray(centre_m)
    shift = se3.transform(apart, at[None])[0] - at
    return float(np.degrees(se3.angle_rad(apart))), float(1e3 * np.linalg.norm(shift))


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
    """(R, S, trials, 2) errors after refinement, in degrees and millimetres, from starts off by that much.

    The depth points p_cam (N, 3) alone, without keypoints, decide.
    """
    errors = np.zeros((len(degrees), len(millimetres), trials, 2))
    for i, j, k in np.ndindex(*errors.shape[:3]):
        rng = np.random.default_rng([seed, i, j, k])
        start = perturbed(T_true, degrees[i], millimetres[j], rng)
        errors[i, j, k] = pose_error(refine(start, p_cam, volume, config).T_cam_obj, T_true)
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
    left = []
    for k, p_cam in enumerate(clouds):
        found = refine(start, p_cam, volume, config, keypoints=None if keypoints is None else keypoints[k])
        left.append(np.degrees(se3.log(se3.inverse(T_true) @ found.T_cam_obj)[2]))
    return np.array(left)


def label_points(
    p_obj: np.ndarray, normals: np.ndarray, T_cam_obj: np.ndarray, count: int, sigma_m: float, rng: np.random.Generator
) -> Keypoints:
    """Map points of a printed surface seen again: ``count`` of those that face the camera, with noise ``sigma_m``."""
    p_cam, n_cam = se3.transform(T_cam_obj, p_obj), normals @ T_cam_obj[:3, :3].T
    facing = np.flatnonzero(np.einsum("ni,ni->n", p_cam, n_cam) < -0.4 * np.linalg.norm(p_cam, axis=1))
    rows = rng.choice(facing, count, replace=False)
    return Keypoints(p_obj[rows], p_cam[rows] + sigma_m * rng.normal(size=(count, 3)), np.full(count, sigma_m))
