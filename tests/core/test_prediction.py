"""The motion filter against closed forms and simulated motion."""

import numpy as np
import pytest
from scipy.stats import chi2

from p2p_lib.core import se3
from p2p_lib.core.prediction import _FORGOTTEN_S, _MOVES, _TURNS, Predictor
from p2p_lib.core.types import PoseEstimate, Status

NOISE = np.diag(np.repeat([0.01, 0.002], 3) ** 2)


def seen(T, time_s, covariance=NOISE, confidence=0.9, map_id=0):
    pose = {"T_cam_obj": T, "confidence": confidence, "covariance": covariance, "map_id": map_id}
    return PoseEstimate("mug", round(30 * time_s), time_s, Status.TRACKED, **pose)


def test_even_motion_goes_on_as_the_closed_form_says():
    start, velocity = se3.exp(np.array([0.3, -0.2, 0.1, 0.1, 0, 0.7])), np.array([0.4, -0.8, 0.2, 0.05, 0.1, -0.08])
    predictor = Predictor()
    for k in range(40):
        predictor.add(seen(start @ se3.exp(velocity * k / 30), k / 30), None)
    said = predictor.predict("mug", 39 / 30 + 0.25)
    np.testing.assert_allclose(said.velocity, velocity, atol=0.01)
    np.testing.assert_allclose(said.T_cam_obj, start @ se3.exp(velocity * (39 / 30 + 0.25)), atol=0.003)


def test_its_covariance_is_that_of_the_motion_that_it_assumes():
    """Normalised squared errors of predictions of simulated motion are chi-squared."""
    rng, normalised = np.random.default_rng(0), []
    spread = np.sqrt(np.repeat([_TURNS, _MOVES], 3))
    for _ in range(60):
        predictor, T, velocity, fine = Predictor(), np.eye(4), np.zeros(6), 10
        for k in range(30 * fine + 1):
            if k <= 24 * fine and not k % fine:
                predictor.add(seen(T @ se3.exp(rng.normal(0, np.sqrt(np.diag(NOISE)))), k / 30 / fine), None)
            velocity = velocity + rng.normal(0, spread) * np.sqrt(1 / 30 / fine)
            T = T @ se3.exp(velocity / 30 / fine)
        said = predictor.predict("mug", 30 / 30)
        off = se3.log(se3.inverse(said.T_cam_obj) @ T)
        normalised.append(off @ np.linalg.solve(said.covariance, off))
    low, high = chi2.ppf([0.001, 0.999], 6 * 60) / 60
    assert low < np.mean(normalised) < high


def test_the_covariance_grows_with_the_time_ahead():
    predictor = Predictor()
    for k in range(10):
        predictor.add(seen(np.eye(4), k / 30), None)
    ahead = [np.diag(predictor.predict("mug", 0.3 + s).covariance) for s in (0, 0.1, 0.5)]
    assert (ahead[0] < ahead[1]).all() and (ahead[1] < ahead[2]).all() and (ahead[0] < np.diag(NOISE)).all()


@pytest.mark.parametrize(
    "another",
    [{"map_id": 1}, {"time_s": 0.3 + 1.1 * _FORGOTTEN_S}],
    ids=["another object frame", "a long time without a pose"],
)
def test_it_begins_anew_with(another):
    predictor, elsewhere = Predictor(), se3.exp(np.array([1.0, 0, 0, 0.5, 0, 0]))
    for k in range(10):
        predictor.add(seen(np.eye(4), k / 30), None)
    predictor.add(seen(elsewhere, **{"time_s": 1 / 3} | another), None)
    said = predictor.predict("mug", 5.0)
    np.testing.assert_allclose(said.T_cam_obj, elsewhere, atol=1e-9)
    assert not said.velocity.any()


def test_a_doubted_pose_moves_nothing():
    predictor = Predictor()
    for k in range(10):
        predictor.add(seen(np.eye(4), k / 30), None)
    predictor.add(seen(se3.exp(np.array([1.0, 0, 0, 0.5, 0, 0])), 1 / 3, confidence=0.5), None)
    np.testing.assert_allclose(predictor.predict("mug", 0.4).T_cam_obj, np.eye(4), atol=1e-9)


def test_a_frame_that_misses_its_world_does_not_stop_the_motion():
    """The camera drives past an object at rest, and the transform of one frame is late; later all are, for too long."""
    predictor, lies = Predictor(), se3.exp(np.array([0.1, 0.2, 0.3, 0.5, 0.1, 1.0]))

    def drives(k: int) -> np.ndarray:
        return se3.exp(np.array([0, 0, 0, 0.01 * k, 0, 0]))

    for k in range(80):
        T_world_cam = drives(k) if k != 12 and k < 40 else None
        predictor.add(seen(se3.inverse(drives(k)) @ lies, k / 30), T_world_cam)
        said = predictor.predict("mug", k / 30)
        if k < 65:
            np.testing.assert_allclose(said.T_world_obj, lies, atol=1e-6)
            np.testing.assert_allclose(said.velocity, 0, atol=1e-6)
    assert said.T_world_obj is None and abs(np.linalg.norm(said.velocity[3:]) - 0.3) < 0.05, "against the camera again"


def test_what_is_not_seen_is_predicted_in_the_camera_of_the_newest_frame():
    predictor, lies = Predictor(), se3.exp(np.array([0.1, 0.2, 0.3, 0.5, 0.1, 1.0]))
    turns = [se3.exp(np.array([0, 0.02 * k, 0, 0, 0, 0])) for k in range(15)]
    for k, T_world_cam in enumerate(turns):
        hidden = PoseEstimate("mug", k, k / 30, Status.OCCLUDED)
        predictor.add(seen(se3.inverse(T_world_cam) @ lies, k / 30) if k < 10 else hidden, T_world_cam)
    said = predictor.predict("mug", 14 / 30)
    np.testing.assert_allclose(said.T_cam_obj, se3.inverse(turns[-1]) @ lies, atol=1e-6)
