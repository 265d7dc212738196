"""The offset between the camera's clock and that of motion capture, by optimisation.

The camera's poses of an object and motion capture's of its marker body are of one rigid thing, so how far it turns in
a fifth of a second is the same in both, whatever the frames: that gives a coarse offset. Then offset and the two
constants of :mod:`~p2p_lib.datasets.recording.hand_eye` are fitted together to all poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.recording.hand_eye import hand_eye, residuals
from p2p_lib.datasets.recording.tracks import PoseTrack

WINDOW_S = 0.2
STEP_S = 0.005


@dataclass(frozen=True, eq=False)
class Synchronisation:
    """What was found; mocap time = camera time + ``offset_s``.

    std_s  of the offset, from the residuals
    T_cam_world, T_body_obj  the constants found with it
    """

    offset_s: float
    std_s: float
    T_cam_world: np.ndarray
    T_body_obj: np.ndarray


def synchronise(camera: PoseTrack, mocap: PoseTrack, search_s: float = 1.0) -> Synchronisation:
    """The offset within +-``search_s``, from T_cam_obj on the camera's clock and T_world_body on the other.

    Raises :class:`BadInput` where the motion is too little to tell, or the two do not belong together.
    """
    from scipy.optimize import least_squares

    coarse_s = coarse_offset(camera, mocap, search_s)
    seen = camera.seen
    start = hand_eye(seen.T, mocap.at(seen.times_s + coarse_s))
    # Frames at the rim of a gap would come and go with the offset; those inside stay.
    inside = [np.isfinite(mocap.at(seen.times_s + coarse_s + d)).all((1, 2)) for d in (-2 * STEP_S, 0, 2 * STEP_S)]
    use = np.logical_and.reduce(inside)
    times_s, A = seen.times_s[use], seen.T[use]

    def unpacked(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        return start.T_cam_world @ se3.exp(x[:6]), start.T_body_obj @ se3.exp(x[6:12]), coarse_s + x[12]

    def misfit(x: np.ndarray) -> np.ndarray:
        X, Y, offset_s = unpacked(x)
        return residuals(X, Y, A, mocap.at(times_s + offset_s)).ravel()

    bound = np.r_[np.full(12, np.inf), 2 * STEP_S]
    scale = np.r_[np.ones(12), 0.01]  # seconds move the poses far more than radians and metres do
    fit = least_squares(misfit, np.zeros(13), loss="soft_l1", x_scale=scale, bounds=(-bound, bound))
    X, Y, offset_s = unpacked(fit.x)
    # Pseudo-inverse: a constant that the motion does not show must not hide that the offset is known.
    spread = np.median(np.abs(fit.fun)) * 1.4826
    std_s = float(spread * np.sqrt(np.linalg.pinv(fit.jac.T @ fit.jac)[12, 12]))
    if abs(fit.x[12]) > 1.99 * STEP_S or std_s > STEP_S:
        got = f"an offset of {offset_s:.3f} s known to {std_s * 1000:.1f} ms only"
        raise BadInput("synchronisation", got, "one clear optimum", "Record a livelier motion of the same object.")
    return Synchronisation(float(offset_s), std_s, X, Y)


def coarse_offset(camera: PoseTrack, mocap: PoseTrack, search_s: float) -> float:
    """The offset, to about 10 ms, at which the turns of the two tracks correlate best.

    Raises :class:`BadInput` where they hardly turn, hardly overlap or hardly correlate.
    """
    t_cam, turn_cam = _turns(camera, camera.seen.times_s)
    t_moc, turn_moc = _turns(mocap, mocap.seen.times_s)
    if len(t_cam) < 30 or len(t_moc) < 30 or np.std(turn_cam) < np.deg2rad(1.0):
        got = f"{len(t_cam)} frames that turn by {np.rad2deg(np.std(turn_cam)) if len(t_cam) else 0:.1f} degrees"
        raise BadInput("synchronisation", got, "a second at least, in which the object turns back and forth")
    offsets = np.arange(-search_s, search_s + STEP_S / 2, STEP_S)
    scores = np.array([_correlation(t_cam + d, turn_cam, t_moc, turn_moc) for d in offsets])
    best = int(np.argmax(scores))
    if scores[best] < 0.5:
        got = f"a correlation of {scores[best]:.2f} at best"
        raise BadInput(
            "synchronisation", got, "at least 0.5", "Is it the same object, and the offset within the search?"
        )
    return float(offsets[best])


def _turns(track: PoseTrack, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times, and by which angle in radians the body turns in the window around each."""
    begin, end = (track.at(times_s + s * WINDOW_S / 2) for s in (-1, 1))
    angle = se3.angle_rad(se3.inverse(begin) @ end)
    good = np.isfinite(angle)
    return times_s[good], angle[good]


def _correlation(t: np.ndarray, a: np.ndarray, t_other: np.ndarray, b: np.ndarray) -> float:
    inside = (t >= t_other[0]) & (t <= t_other[-1])
    if inside.sum() < 0.5 * len(t):
        return -1.0
    x, y = a[inside], np.interp(t[inside], t_other, b)
    # Ranks: a flipped tag pose makes an angle that would outweigh all others.
    x, y = (np.argsort(np.argsort(v)).astype(float) for v in (x, y))
    return float(np.corrcoef(x, y)[0, 1])
