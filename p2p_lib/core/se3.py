"""Rigid transformations SE(3), batched over leading axes.

A transformation ``T_a_b`` is a (..., 4, 4) float64 array that takes coordinates in frame b to
coordinates in frame a: ``p_a = T_a_b @ p_b``. Points are rows, (..., N, 3). Tangent vectors are
(..., 6), rotation first, then translation, applied on the right: ``T @ exp(xi)``, as in gtsam.

>>> T_cam_obj = exp(np.array([0, 0, np.pi / 2, 0, 0, 0]))  # a quarter turn about z
>>> transform(T_cam_obj, np.array([[1.0, 0, 0]])).round(6).tolist()
[[0.0, 1.0, 0.0]]
>>> transform(inverse(T_cam_obj), np.array([[0.0, 1, 0]])).round(6).tolist()
[[1.0, 0.0, 0.0]]
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.errors import BadInput

#: A rotation that is off by less may have been written with too few decimals.
_ROUNDED = 0.01
IDENTITY = np.eye(4)
IDENTITY.setflags(write=False)

# Below this squared angle the closed forms lose digits and their Taylor series are exact.
_SMALL_SQ = 1e-8


def from_rt(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Rotation (..., 3, 3) and translation (..., 3) to a (..., 4, 4) transformation."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T_a_b: np.ndarray) -> np.ndarray:
    """T_b_a, by transposing the rotation (exact for a rigid transformation)."""
    Rt, T = np.swapaxes(T_a_b[..., :3, :3], -1, -2), np.zeros(T_a_b.shape)
    T[..., :3, :3], T[..., :3, 3:], T[..., 3, 3] = Rt, -Rt @ T_a_b[..., :3, 3:], 1.0
    return T


def transform(T_a_b: np.ndarray, p_b: np.ndarray) -> np.ndarray:
    """p_a of points p_b: (..., 4, 4) and (..., N, 3) to (..., N, 3)."""
    return p_b @ np.swapaxes(T_a_b[..., :3, :3], -1, -2) + T_a_b[..., None, :3, 3]


def hat(w: np.ndarray) -> np.ndarray:
    """Skew matrix (..., 3, 3) with ``hat(a) @ b = a x b``."""
    w = np.asarray(w, float)
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return W


def exp(xi: np.ndarray) -> np.ndarray:
    """Exponential map: tangent (..., 6) [rotation rad, translation m] to (..., 4, 4)."""
    xi = np.asarray(xi, float)
    w, v = xi[..., :3], xi[..., 3:]
    sq = np.sum(w * w, -1)
    small = sq < _SMALL_SQ
    angle = np.sqrt(np.where(small, 1.0, sq))
    a = np.where(small, 1 - sq / 6, np.sin(angle) / angle)
    b = np.where(small, 0.5 - sq / 24, 2 * (np.sin(angle / 2) / angle) ** 2)  # 1 - cos would lose digits
    c = np.where(small, 1 / 6 - sq / 120, (angle - np.sin(angle)) / angle**3)
    W = hat(w)
    W2 = W @ W
    eye = np.eye(3)
    R = eye + a[..., None, None] * W + b[..., None, None] * W2
    V = eye + b[..., None, None] * W + c[..., None, None] * W2
    return from_rt(R, (V @ v[..., None])[..., 0])


def log(T: np.ndarray) -> np.ndarray:
    """Logarithm map: (..., 4, 4) to tangent (..., 6), inverse of :func:`exp` for angles < pi."""
    T = np.asarray(T, float)
    w = so3_log(T[..., :3, :3])
    sq = np.sum(w * w, -1)
    small = sq < _SMALL_SQ
    angle = np.sqrt(np.where(small, 1.0, sq))
    half = angle / 2
    d = np.where(small, 1 / 12 + sq / 720, (1 - half / np.tan(half)) / angle**2)
    W = hat(w)
    V_inv = np.eye(3) - 0.5 * W + d[..., None, None] * (W @ W)
    return np.concatenate([w, (V_inv @ T[..., :3, 3:])[..., 0]], -1)


def so3_log(R: np.ndarray) -> np.ndarray:
    """Rotation vector (..., 3) of rotation matrices (..., 3, 3); stable at angles 0 and pi."""
    from scipy.spatial.transform import Rotation

    R = np.asarray(R, float)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def quaternion_xyzw(T: np.ndarray) -> np.ndarray:
    """The unit quaternions (..., 4), scalar last and not negative, of transformations (4, 4) or (N, 4, 4)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)


def angle_rad(T: np.ndarray) -> np.ndarray:
    """Rotation angle (...,) in [0, pi] of (..., 4, 4) or (..., 3, 3)."""
    R = np.asarray(T, float)[..., :3, :3]
    off = R - np.swapaxes(R, -1, -2)
    # Twice the sine and twice the cosine: exact for small angles and at pi.
    return np.arctan2(np.sqrt((off * off).sum((-2, -1)) / 2), np.trace(R, axis1=-2, axis2=-1) - 1)


def error_deg_mm(T: np.ndarray, T_true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation in degrees (...,) and translation in millimetres (...,) between two poses; NaN where one is NaN."""
    T_error = inverse(T_true) @ T
    return np.degrees(angle_rad(T_error)), 1e3 * np.linalg.norm(T_error[..., :3, 3], axis=-1)


def adjoint(T: np.ndarray) -> np.ndarray:
    """Ad_T (..., 6, 6), rotation first: ``T exp(xi) T^-1 = exp(Ad_T xi)``."""
    R = T[..., :3, :3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return A


def interpolate(T_a_b: np.ndarray, T_a_c: np.ndarray, s: float | np.ndarray) -> np.ndarray:
    """The pose a share s of the way from b to c along the geodesic (constant twist)."""
    step = log(inverse(T_a_b) @ T_a_c)
    return T_a_b @ exp(np.asarray(s)[..., None] * step)


def median(T: np.ndarray) -> np.ndarray:
    """The (4, 4) in the middle of (n, 4, 4), of which a few may be wild: the medians of the tangents there are 0."""
    centre = T[len(T) // 2]
    for _ in range(20):
        centre = centre @ exp(np.median(log(inverse(centre) @ T), axis=0))
    return centre


def orthonormalised(T: np.ndarray) -> np.ndarray:
    """The rigid transformation nearest to T (rotation by SVD, proper)."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U = U * np.where(np.arange(3) == 2, np.linalg.det(U @ Vt)[..., None, None], 1.0)
    return from_rt(U @ Vt, T[..., :3, 3])


def check(name: str, T: np.ndarray, tolerance: float = 1e-4) -> np.ndarray:
    """T as (4, 4) float64 if it is a rigid transformation, else :class:`BadInput` naming it."""
    try:
        T = np.asarray(T, float)
    except (TypeError, ValueError):
        raise BadInput(name, repr(T)[:60], "a 4x4 transformation") from None
    if T.shape != (4, 4):
        raise BadInput(name, f"shape {T.shape}", "a 4x4 transformation")
    if not np.isfinite(T).all():
        raise BadInput(name, "NaN or infinite entries", "a finite 4x4 transformation")
    R = T[:3, :3]
    off, det = float(np.abs(R @ R.T - np.eye(3)).max()), float(np.linalg.det(R))
    if off > tolerance or det < 0:
        got = f"a matrix that is not a rotation (R R^T is off by {off:.2g}; it scales by {np.cbrt(det):.5g})"
        fix = "Of rounded numbers: write more decimals, or U V^T of the SVD of R." if det > 0 and off < _ROUNDED else ""
        raise BadInput(name, got, f"an orthonormal, right-handed 3x3 block, to {tolerance:g}", fix)
    if np.abs(T[3] - IDENTITY[3]).max() > tolerance:
        raise BadInput(name, f"last row {T[3].tolist()}", "0 0 0 1")
    return T
