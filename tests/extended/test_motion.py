"""The motion that outlives a gap, against exact paths."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.extended.motion import Motion


def turning(time_s: float) -> np.ndarray:
    """About an axis of the camera with 40 degrees a second, and moving by 10 cm a second."""
    R = Rotation.from_rotvec(np.radians(40) * time_s * np.array([0.6, 0.0, 0.8])) * Rotation.from_euler(
        "xyz", [1, 2, 3]
    )
    return se3.from_rt(R.as_matrix(), np.array([0.1, 0, -0.05]) * time_s + [0, 0, 0.7])


def followed(times, noise=lambda: np.zeros(6)) -> Motion:
    motion = Motion(turning(times[0]), times[0])
    for time_s in times[1:]:
        motion = motion.followed_by(turning(time_s) @ se3.exp(noise()), time_s)
    return motion


def off(motion: Motion, time_s: float) -> tuple[float, float]:
    deg, mm = se3.error_deg_mm(motion.at(time_s), turning(time_s))
    return float(deg), float(mm)


def test_what_moves_evenly_is_where_it_would_be_after_a_gap():
    motion = followed(np.arange(90) / 30)
    assert off(motion, 4.0) == (pytest.approx(0, abs=0.1), pytest.approx(0, abs=0.1))
    skipped = followed(np.delete(np.arange(90) / 30, [40, 41, 42, 60]))
    assert off(skipped, 4.0) == (pytest.approx(0, abs=0.1), pytest.approx(0, abs=0.1)), "poses may be missing"


def test_the_noise_of_single_poses_is_smoothed():
    rng = np.random.default_rng(0)
    motion = followed(np.arange(90) / 30, lambda: rng.normal(size=6) * np.repeat([0.01, 0.001], 3))
    last = followed([88 / 30, 89 / 30], lambda: rng.normal(size=6) * np.repeat([0.01, 0.001], 3))
    last = Motion(last.T_cam_obj, last.time_s, 10 * last.velocity)  # of the newest two poses alone
    assert off(motion, 4.0)[0] < 8 < off(last, 4.0)[0]


def test_at_rest_it_stays():
    motion = Motion(turning(0.0), 0.0)
    np.testing.assert_allclose(motion.at(1.0), turning(0.0))
    assert motion.holds(1.0) and not motion.holds(2.0)


def test_it_is_the_same_of_another_object_frame():
    T_old_new = se3.exp(np.array([0.3, -1.0, 0.2, 0.0, 0.0, 0.0]))
    motion = followed(np.arange(30) / 30)
    np.testing.assert_allclose(motion.in_frame(T_old_new).at(1.5), motion.at(1.5) @ T_old_new, atol=1e-12)
