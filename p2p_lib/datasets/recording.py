"""Truth of a recording by motion capture, written as YCBMultiTrack keeps it.

A camera's poses of an object and motion capture's of the marker body fixed to it are of one rigid thing, on two clocks:

    T_cam_model(t) = T_cam_world @ T_world_body(t + offset_s) @ T_body_model

The camera's poses, of a tag detector or a tracker, may be noisy, wild at times and have gaps: they give the offset and
the two constants. Rotations by the singular vectors of the sum of Kronecker products (Shah, J. Mechanisms and Robotics
2013), translations by linear least squares, at each offset of a grid; then all of it refined together.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets import images
from p2p_lib.datasets.models import load_points
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.datasets.ycbmultitrack import write_truth

# A longer gap in a log is not bridged: at 0.3 m/s a hand has moved 3 cm by then.
MAX_GAP_S = 0.1
SEARCH_S, STEP_S = 1.0, 0.02  # of the grid of offsets: near enough for the refinement
SIGMA = np.repeat([0.01, 0.003], 3)  # rad and m: what a pose from an image is off by, as the scale of residuals
# Below this the motion turns about one axis only, and the shift along it is anyone's guess.
MIN_TURN_RAD = np.deg2rad(5.0)
LEAST_POSES = 30


@dataclass(frozen=True, eq=False)
class PoseLog:
    """Poses T (M, 4, 4) at increasing times_s (M,), where the body was seen."""

    times_s: np.ndarray
    T: np.ndarray

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """(K, 4, 4) poses between the two nearest samples, with constant twist; NaN outside and in gaps."""
        after = np.clip(np.searchsorted(self.times_s, times_s, side="right"), 1, len(self.times_s) - 1)
        begin, end = self.times_s[after - 1], self.times_s[after]
        fraction = (times_s - begin) / (end - begin)
        good = (fraction >= 0) & (fraction <= 1) & (end - begin <= MAX_GAP_S)
        T = np.full((len(times_s), 4, 4), np.nan)
        T[good] = se3.interpolate(self.T[after[good] - 1], self.T[after[good]], fraction[good])
        return T


@dataclass(frozen=True, eq=False)
class Calibration:
    """Motion capture's time minus the camera's, its standard deviation, and the two constants (4, 4)."""

    offset_s: float
    std_s: float
    T_cam_world: np.ndarray
    T_body_model: np.ndarray


def read_log(path: Path) -> PoseLog:
    """The poses of a TUM or CSV file; rows with a NaN are left out."""
    form = f"{LEAST_POSES} rows or more of time_s tx ty tz qx qy qz qw at increasing times (# before a header)"
    rows = np.atleast_2d(images.read_numbers(path, form))
    rows = rows[np.isfinite(rows).all(1)]
    if rows.shape[1] != 8 or len(rows) < LEAST_POSES or (np.diff(rows[:, 0]) <= 0).any():
        raise BadInput(str(path), f"{rows.shape[0]} rows of {rows.shape[1]} numbers", form)
    if (np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) > 0.1).any():
        raise BadInput(str(path), "quaternions that are not of unit length", form)
    return PoseLog(rows[:, 0], se3.from_rt(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]))


def record_truth(folder: Path, name: str, camera: Path, mocap: Path, model: Path | None = None) -> Calibration:
    """Add the truth of one object to a folder of images, which then is a YCBMultiTrack sequence.

    camera, mocap  logs of T_cam_model on the images' clock and of T_world_body on another, see :func:`read_log`
    model          the object's model, to tell whether it is in the image; without it, where its origin is

    Where motion capture does not see the object its last pose is repeated, as in the paper's dataset, and
    ``is_mask_visible`` says that it does not count, as where its mask, if there are masks, is empty.
    """
    sequence, log = open_sequence(folder, format="folder"), read_log(mocap)
    points = np.zeros((1, 3)) if model is None else load_points(model)
    found = calibrate(read_log(camera), log)
    T = found.T_cam_world @ log.at(sequence.times_s + found.offset_s) @ found.T_body_model
    seen = np.isfinite(T).all((1, 2))
    if not seen.any():
        raise BadInput(str(mocap), "no pose at the times of the images", "a log that covers the recording")
    visible, in_image = seen.copy(), np.zeros(len(T), bool)
    for i in np.flatnonzero(seen):
        counts = sequence.visible_px(int(i))
        visible[i] = counts is None or counts.get(name, 1) > 0
        in_image[i] = sequence.camera.inside(sequence.camera.project(se3.transform(T[i], points))).any()
    last = np.maximum.accumulate(np.where(seen, np.arange(len(T)), np.argmax(seen)))
    write_truth(folder, name, sequence.frame_names, T[last], visible, in_image)
    return found


def calibrate(camera: PoseLog, mocap: PoseLog) -> Calibration:
    """The offset of the clocks within +-:data:`SEARCH_S`, and the two constants.

    Raises :class:`BadInput` where the motion is too little to tell, or the two do not belong together.
    """
    from scipy.optimize import least_squares

    offsets_s = np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S)
    fits = [_constants(camera.T, mocap.at(camera.times_s + offset_s)) for offset_s in offsets_s]
    misfits = np.array([fit[2] for fit in fits])
    best = int(np.argmin(misfits))
    if best in (0, len(fits) - 1) or not misfits[best] < 0.5 * np.median(misfits):
        fix = "Is it the same object, does it turn back and forth, do the clocks differ by less than the search?"
        raise BadInput("clocks", f"no clear optimum within {SEARCH_S:g} s", "one offset that fits best", fix)
    X0, Y0, _ = fits[best]
    # Frames at the rim of a gap would come and go with the offset; those inside stay.
    nearby = [mocap.at(camera.times_s + offsets_s[best] + d) for d in (-STEP_S, 0, STEP_S)]
    use = np.isfinite(nearby).all((0, 2, 3))
    _check_turns(nearby[1][use])
    times_s, A = camera.times_s[use], camera.T[use]

    def unpacked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        return X0 @ se3.exp(x[:6]), Y0 @ se3.exp(x[6:12]), offsets_s[best] + x[12]

    def misfit(x: np.ndarray) -> np.ndarray:
        X, Y, offset_s = unpacked(x)
        return _residuals(X, Y, A, mocap.at(times_s + offset_s)).ravel()

    bound = np.r_[np.full(12, np.inf), STEP_S]
    scale = np.r_[np.ones(12), 0.01]  # seconds move the poses far more than radians and metres do
    fit = least_squares(misfit, np.zeros(13), loss="soft_l1", x_scale=scale, bounds=(-bound, bound))
    X, Y, offset_s = unpacked(fit.x)
    # Pseudo-inverse: a constant that the motion does not show must not hide that the offset is known.
    noise = np.median(np.abs(fit.fun)) * 1.4826
    std_s = float(noise * np.sqrt(np.linalg.pinv(fit.jac.T @ fit.jac)[12, 12]))
    return Calibration(float(offset_s), std_s, X, Y)


def _constants(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """X and Y with A(i) = X B(i) Y, and their median residual; without those pairs that a first fit misses most."""
    good = np.isfinite(B).all((1, 2))
    if good.sum() < max(LEAST_POSES, 0.5 * len(A)):
        return se3.IDENTITY, se3.IDENTITY, np.inf
    A, B = A[good], B[good]
    keep = np.ones(len(A), bool)
    for _ in range(4):
        X, Y = _closed_form(A[keep], B[keep])
        size = np.linalg.norm(_residuals(X, Y, A, B), axis=1)
        keep = size <= 3 * np.median(size)
    return X, Y, float(np.median(size))


def _closed_form(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    # A Z = X B with Z = inv(Y): the sum of the Kronecker products takes vec(R_Z) to vec(R_X), N times over.
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9))
    RX, RZ = (v.reshape(3, 3).T for v in (U[:, 0], Vt[0]))
    RX, RZ = (se3.orthonormalised(se3.from_rt(R * np.sign(np.linalg.det(R)), np.zeros(3)))[:3, :3] for R in (RX, RZ))
    M = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], -1).reshape(-1, 6)
    t = np.linalg.lstsq(M, (B[:, :3, 3] @ RX.T - A[:, :3, 3]).ravel(), rcond=None)[0]
    return se3.from_rt(RX, t[3:]), se3.inverse(se3.from_rt(RZ, t[:3]))


def _residuals(X: np.ndarray, Y: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """(N, 6) tangents between A(i) and X B(i) Y, in units of :data:`SIGMA`."""
    return se3.log(se3.inverse(A) @ X @ B @ Y) / SIGMA


def _check_turns(B: np.ndarray) -> None:
    """Two directions of rotation at least: along a common axis the translations are not told apart."""
    turns = se3.so3_log(np.swapaxes(B[:1, :3, :3], 1, 2) @ B[:, :3, :3])
    second = np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns))
    if second < MIN_TURN_RAD:
        got = f"a motion that turns {np.rad2deg(second):.1f} degrees about a second axis"
        raise BadInput("motion", got, f"at least {np.rad2deg(MIN_TURN_RAD):.0f}", "Turn the object about two axes.")
