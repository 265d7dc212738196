"""Two constants at once: where the camera is in the world, and where the observed frame sits on the marker body.

The camera sees an object, T_cam_obj(i); motion capture sees the body it is fixed to, T_world_body(i). Then

    T_cam_obj(i) = T_cam_world @ T_world_body(i) @ T_body_obj

Rotations by the singular vectors of the sum of Kronecker products (Shah, J. Mechanisms and Robotics 2013), then
translations by linear least squares, then all of it refined on the residual poses with outliers held down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput

SIGMA = np.repeat([0.01, 0.003], 3)  # rad and m: what a pose from a picture is off by, as the scale of residuals
# Below this the motion turns about one axis only, and the shift along it is anyone's guess.
MIN_TURN_RAD = np.deg2rad(5.0)


@dataclass(frozen=True, eq=False)
class HandEye:
    """The two constants, and the median residual of the poses they were found from."""

    T_cam_world: np.ndarray
    T_body_obj: np.ndarray
    rotation_rad: float
    translation_m: float


def hand_eye(T_cam_obj: np.ndarray, T_world_body: np.ndarray) -> HandEye:
    """From pairs of poses (N, 4, 4); pairs with a NaN are left out, wild ones are outvoted.

    Raises :class:`BadInput` where there are fewer than 4 pairs or the motion turns about one axis only.
    """
    good = np.isfinite(T_cam_obj).all((1, 2)) & np.isfinite(T_world_body).all((1, 2))
    A, B = T_cam_obj[good], T_world_body[good]
    if len(A) < 4:
        raise BadInput("hand-eye", f"{len(A)} pairs of poses", "at least 4, of several orientations")
    _check_turns(B)
    keep = np.ones(len(A), bool)
    for _ in range(5):  # a few wild poses bend the closed form: leave out what it fits worst
        X, Y = closed_form(A[keep], B[keep])
        size = np.linalg.norm(residuals(X, Y, A, B), axis=1)
        keep = size <= 3 * np.median(size)
    X, Y = _refined(X, Y, A, B)
    left = np.abs(residuals(X, Y, A, B) * SIGMA)
    rotation, translation = (np.linalg.norm(left[:, k : k + 3], axis=1) for k in (0, 3))
    return HandEye(X, Y, float(np.median(rotation)), float(np.median(translation)))


def closed_form(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X and Y with A(i) = X B(i) Y, in the least-squares sense; A and B are (N, 4, 4)."""
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    # A Z = X B with Z = inv(Y): the sum of the Kronecker products takes vec(R_Z) to vec(R_X), N times over.
    K = np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    RX, RZ = (_rotation(v.reshape(3, 3).T) for v in (U[:, 0], Vt[0]))
    M = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], -1).reshape(-1, 6)
    right = (B[:, :3, 3] @ RX.T - A[:, :3, 3]).reshape(-1)
    t = np.linalg.lstsq(M, right, rcond=None)[0]
    return se3.from_rt(RX, t[3:]), se3.inverse(se3.from_rt(RZ, t[:3]))


def residuals(X: np.ndarray, Y: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """(N, 6) tangents between A(i) and X B(i) Y, in units of :data:`SIGMA`."""
    return se3.log(se3.inverse(A) @ X @ B @ Y) / SIGMA


def _rotation(M: np.ndarray) -> np.ndarray:
    """The rotation nearest to a multiple of M, whatever its sign."""
    return se3.orthonormalised(se3.from_rt(M * np.sign(np.linalg.det(M)), np.zeros(3)))[:3, :3]


def _refined(X: np.ndarray, Y: np.ndarray, A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.optimize import least_squares

    def moved(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return X @ se3.exp(x[:6]), Y @ se3.exp(x[6:])

    fit = least_squares(lambda x: residuals(*moved(x), A, B).ravel(), np.zeros(12), loss="soft_l1")
    return moved(fit.x)


def _check_turns(B: np.ndarray) -> None:
    """Two directions of rotation at least: along a common axis the translations are not told apart."""
    turns = se3.so3_log(np.swapaxes(B[:1, :3, :3], 1, 2) @ B[:, :3, :3])
    second = np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns))
    if second < MIN_TURN_RAD:
        got = f"a motion that turns {np.rad2deg(second):.1f} degrees about a second axis"
        raise BadInput("hand-eye", got, f"at least {np.rad2deg(MIN_TURN_RAD):.0f}", "Turn it about two axes.")
