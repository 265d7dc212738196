"""Registration against SciPy, exact motions, Monte Carlo, and the mug of the paper's text."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.robust import fit_rigid
from p2p_lib.method import registration
from p2p_lib.method.registration import Hypothesis, register
from p2p_lib.method.selection import select

DEFAULT, PAPER = preset("default").registration, preset("paper").registration
SELECTION = preset("default").selection, preset("paper").selection
BOTH = pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])


def generate(p_obj, p_cam, config, rng, *, sigma_m=None, priors=None) -> list[Hypothesis]:
    """As the presets ask for hypotheses: ``default`` with the noise of the sensor, ``paper`` with one threshold."""
    if sigma_m is None and config.sample_size == DEFAULT.sample_size:
        sigma_m = depth_noise_m(np.reshape(p_cam, (-1, 3))[:, 2])
    return register(p_obj, p_cam, config, rng, sigma_m=sigma_m, priors=priors)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return se3.from_rt(Rotation.random(random_state=rng).as_matrix(), rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.7]))


def box_points(rng: np.random.Generator, n: int, half_m: float = 0.06) -> np.ndarray:
    return rng.uniform(-half_m, half_m, (n, 3))


def error_deg_m(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    off = se3.inverse(truth) @ T
    return float(np.degrees(se3.angle_rad(off))), float(np.linalg.norm(off[:3, 3]))


def most_supported(hypotheses: list[Hypothesis]) -> Hypothesis:
    return max(hypotheses, key=lambda h: h.support)


# --- the closed form ---------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 40), noise=st.sampled_from([0.0, 0.002, 0.05]))
def test_fit_agrees_with_scipy(seed: int, n: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    p_obj, T, w = box_points(rng, n), random_pose(rng), rng.uniform(0.1, 3, n)
    p_cam = se3.transform(T, p_obj) + noise * rng.normal(size=(n, 3))
    mean_obj, mean_cam = np.average(p_obj, 0, w), np.average(p_cam, 0, w)
    R = Rotation.align_vectors(p_cam - mean_cam, p_obj - mean_obj, weights=w)[0].as_matrix()
    expected = se3.from_rt(R, mean_cam - R @ mean_obj)

    def cost(T: np.ndarray) -> float:
        return np.sum(w[:, None] * (se3.transform(T, p_obj) - p_cam) ** 2)

    fitted = fit_rigid(p_obj, p_cam, w)
    assert np.linalg.det(fitted[:3, :3]) == pytest.approx(1)
    assert cost(fitted) <= cost(expected) * (1 + 1e-9) + 1e-15
    if noise < 0.01 and n > 6:  # elsewhere several rotations cost nearly the same
        np.testing.assert_allclose(fitted, expected, atol=1e-6)


def test_fit_takes_leading_axes() -> None:
    rng = np.random.default_rng(1)
    p_obj = rng.normal(size=(3, 2, 7, 3))
    p_cam, w = rng.normal(size=(3, 2, 7, 3)), rng.uniform(size=(3, 2, 7))
    batched = fit_rigid(p_obj, p_cam, w)
    assert batched.shape == (3, 2, 4, 4)
    for k in np.ndindex(3, 2):
        np.testing.assert_allclose(batched[k], fit_rigid(p_obj[k], p_cam[k], w[k]), atol=1e-12)


def test_fit_never_mirrors() -> None:
    """A mirrored copy is fitted best by a reflection; a rigid fit must still be a rotation, and the best one."""
    rng = np.random.default_rng(2)
    p = box_points(rng, 20)
    mirrored = p * [-1, 1, 1]
    T = fit_rigid(p, mirrored)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    R = Rotation.align_vectors(mirrored - mirrored.mean(0), p - p.mean(0))[0].as_matrix()
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-9)


@pytest.mark.parametrize("flat", [0, 1, 2])
def test_fit_of_a_plane_is_exact(flat: int) -> None:
    rng = np.random.default_rng(3)
    p = box_points(rng, 12)
    p[:, flat] = 0.01
    T = random_pose(rng)
    np.testing.assert_allclose(fit_rigid(p, se3.transform(T, p)), T, atol=1e-9)


# --- hypotheses --------------------------------------------------------------------------------


@BOTH
def test_half_of_the_points_may_be_wrong(config) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        p_obj, T = box_points(rng, 100), random_pose(rng)
        p_cam = se3.transform(T, p_obj) + 0.001 * rng.normal(size=(100, 3))
        wrong = rng.permutation(100) < 50
        p_cam[wrong] = box_points(rng, 50) + T[:3, 3]
        best = most_supported(generate(p_obj, p_cam, config, np.random.default_rng(seed)))
        assert best.origin == "ransac 1"
        turn, shift = error_deg_m(best.T_cam_obj, T)
        assert turn < 1.0 and shift < 0.001
        assert best.inliers[~wrong].mean() > 0.97
        residual = np.linalg.norm(se3.transform(best.T_cam_obj, p_obj) - p_cam, axis=1)
        np.testing.assert_allclose(best.residual_m, residual, atol=1e-12)


def test_seven_of_ten_may_be_wrong_in_default() -> None:
    found = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        p_obj, T = box_points(rng, 100), random_pose(rng)
        p_cam = se3.transform(T, p_obj) + 0.001 * rng.normal(size=(100, 3))
        p_cam[:70] = box_points(rng, 70) + T[:3, 3]
        hypotheses = generate(p_obj, p_cam, DEFAULT, np.random.default_rng(seed))
        found += bool(hypotheses) and error_deg_m(most_supported(hypotheses).T_cam_obj, T)[0] < 1.5
    assert found == 20


@BOTH
def test_two_motions_are_found_in_the_order_of_their_size(config) -> None:
    rng = np.random.default_rng(5)
    p_obj, first, second = box_points(rng, 90), random_pose(rng), random_pose(rng)
    is_first = np.arange(90) < 55
    p_cam = np.where(is_first[:, None], se3.transform(first, p_obj), se3.transform(second, p_obj))
    p_cam += 0.001 * rng.normal(size=p_cam.shape)
    hypotheses = generate(p_obj, p_cam, config, np.random.default_rng(0))
    assert [h.origin for h in hypotheses] == ["ransac 1", "ransac 2"]
    for hypothesis, truth, members in zip(hypotheses, (first, second), (is_first, ~is_first), strict=True):
        assert error_deg_m(hypothesis.T_cam_obj, truth)[0] < 1
        np.testing.assert_array_equal(hypothesis.inliers & members, hypothesis.inliers)
        assert hypothesis.inliers[members].mean() > 0.95
    assert not (hypotheses[0].inliers & hypotheses[1].inliers).any()


@BOTH
def test_same_seed_same_hypotheses(config) -> None:
    rng = np.random.default_rng(6)
    p_obj, p_cam = box_points(rng, 60), box_points(rng, 60)
    p_cam[:30] = se3.transform(random_pose(rng), p_obj[:30])
    runs = [generate(p_obj, p_cam, config, np.random.default_rng(9)) for _ in range(2)]
    assert [h.origin for h in runs[0]] == [h.origin for h in runs[1]]
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a.T_cam_obj, b.T_cam_obj)
        np.testing.assert_array_equal(a.inliers, b.inliers)


def test_thresholds_follow_the_noise() -> None:
    """At 1.5 m a depth sensor's noise passes 6 mm: the constant threshold loses points that are right."""
    rng = np.random.default_rng(7)
    p_obj, T = box_points(rng, 80, 0.1), random_pose(rng)
    T[2, 3] = 1.5
    p_cam = se3.transform(T, p_obj)
    p_cam += depth_noise_m(p_cam[:, 2])[:, None] * rng.normal(size=p_cam.shape)
    ours = most_supported(generate(p_obj, p_cam, DEFAULT, np.random.default_rng(0)))
    constant = most_supported(generate(p_obj, p_cam, PAPER, np.random.default_rng(0)))
    assert ours.support >= 76 > 60 > constant.support
    assert error_deg_m(ours.T_cam_obj, T)[0] < error_deg_m(constant.T_cam_obj, T)[0]


def test_given_noise_weighs_the_points() -> None:
    """Half of the points are ten times noisier; told so, the fit is far better than their plain mean."""
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        p_obj, T = box_points(rng, 60), random_pose(rng)
        sigma = np.where(np.arange(60) < 30, 0.0005, 0.005)
        p_cam = se3.transform(T, p_obj) + sigma[:, None] * rng.normal(size=(60, 3))
        told = most_supported(generate(p_obj, p_cam, DEFAULT, np.random.default_rng(0), sigma_m=sigma))
        errors.append((error_deg_m(told.T_cam_obj, T)[1], error_deg_m(fit_rigid(p_obj, p_cam), T)[1]))
    told, plain = np.mean(errors, 0)
    assert told < plain / 3


# --- priors ------------------------------------------------------------------------------------


def test_a_prior_saves_the_true_pose_when_chance_misses_it() -> None:
    """Six true points of a hundred: no sample hits them, the last pose does, and is refit on them."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        p_obj, T = box_points(rng, 100), random_pose(rng)
        p_cam = box_points(rng, 100) + T[:3, 3]
        p_cam[:6] = se3.transform(T, p_obj[:6])
        last = T @ se3.exp(np.array([0.02, -0.01, 0.02, 0.001, -0.001, 0.001]))
        few = replace(DEFAULT, iterations=40)
        hypotheses = generate(p_obj, p_cam, few, np.random.default_rng(seed), priors={"last pose": last})
        mine = [h for h in hypotheses if h.origin == "last pose"]
        assert len(mine) == 1 and mine[0].inliers[:6].all()
        assert error_deg_m(mine[0].T_cam_obj, T)[0] < error_deg_m(last, T)[0]


def test_a_prior_that_says_the_same_is_not_repeated() -> None:
    rng = np.random.default_rng(8)
    p_obj, T = box_points(rng, 60), random_pose(rng)
    p_cam = se3.transform(T, p_obj) + 0.0005 * rng.normal(size=(60, 3))
    priors = {"last pose": T, "constant velocity": T @ se3.exp(np.full(6, 1e-3)), "broken": np.full((4, 4), np.nan)}
    assert [h.origin for h in generate(p_obj, p_cam, DEFAULT, np.random.default_rng(0), priors=priors)] == ["ransac 1"]


def test_on_a_line_a_prior_keeps_the_roll_that_the_points_leave_free() -> None:
    rng = np.random.default_rng(9)
    p_obj = np.zeros((30, 3))
    p_obj[:, 0] = np.linspace(-0.08, 0.08, 30)
    T = random_pose(rng)
    p_cam = se3.transform(T, p_obj) + 0.0003 * rng.normal(size=p_obj.shape)
    assert generate(p_obj, p_cam, DEFAULT, np.random.default_rng(0)) == []
    prior = T @ se3.exp(np.array([0, 0.02, -0.02, 0, 0, 0]))
    (only,) = generate(p_obj, p_cam, DEFAULT, np.random.default_rng(0), priors={"last pose": prior})
    off = np.degrees(se3.log(se3.inverse(T) @ only.T_cam_obj)[:3])
    assert abs(off[0]) < 1.5 and np.abs(off[1:]).max() < 0.2  # across: measured; roll: as the prior had it


# --- the mug of the paper's text ---------------------------------------------------------------


def mug_handle(t: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Surface of half an elliptic ring of tube radius 6 mm beside a cylinder of radius 40 mm."""
    centre = np.stack([0.04 + 0.04 * np.cos(t), 0.04 * np.sin(t), np.zeros_like(t)], -1)
    outward = np.stack([np.cos(t), np.sin(t), np.zeros_like(t)], -1)
    tube = np.cos(around)[:, None] * outward + np.sin(around)[:, None] * np.array([0, 0, 1.0])
    return centre + 0.006 * tube


def mug_body(angle: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([0.04 * np.sin(angle), y, -0.04 * np.cos(angle)], -1)


class Mug:
    """A mug that has turned by 20 degrees; its plain body's 80 points all claim that it has not."""

    def __init__(self, seed: int, turn_deg: float = 20.0):
        rng = np.random.default_rng(seed)
        before = se3.from_rt(np.eye(3), [0.02, 0, 0.55]) @ se3.exp(np.array([0.3, 0, 0, 0, 0, 0]))
        self.truth = before @ se3.exp(np.array([0, np.radians(turn_deg), 0, 0, 0, 0]))
        body = mug_body(rng.uniform(-1.2, 1.2, 80), rng.uniform(-0.05, 0.05, 80))
        handle = mug_handle(rng.uniform(-1.4, 1.4, 15), rng.uniform(-np.pi, 0, 15))
        self.p_obj = np.concatenate([body, handle])
        p_cam = np.concatenate([se3.transform(before, body), se3.transform(self.truth, handle)])
        self.p_cam = p_cam + 0.001 * rng.normal(size=p_cam.shape)
        self.surface = np.concatenate(
            [
                mug_body(rng.uniform(-np.pi, np.pi, 20000), rng.uniform(-0.05, 0.05, 20000)),
                mug_handle(rng.uniform(-1.5, 1.5, 6000), rng.uniform(-np.pi, np.pi, 6000)),
            ]
        )
        toward_camera = se3.transform(self.truth, self.surface)[:, 2] < self.truth[2, 3] + 0.002
        seen = rng.choice(np.flatnonzero(toward_camera), 1500, replace=False)
        self.depth_points = se3.transform(self.truth, self.surface[seen]) + 0.001 * rng.normal(size=(1500, 3))

    def distances_m(self, hypotheses: list[Hypothesis], truncation_m: float = 0.025) -> np.ndarray:
        """Of the depth points to the exact surface, cut at a TSDF's truncation."""
        tree = cKDTree(self.surface)
        poses = [se3.inverse(h.T_cam_obj) for h in hypotheses]
        distance = [np.minimum(tree.query(se3.transform(T, self.depth_points))[0], truncation_m) for T in poses]
        return np.stack(distance)


@BOTH
def test_mug_ours_is_right_and_a_single_hypothesis_fails(config) -> None:
    """The handle's 15 points win against the body's 80.

    At 1 mm noise the handle alone determines its pose to 1.8 degrees rms, so a hypothesis before any
    refinement cannot always lie within 3: it must in 9 of 10, and err as its own covariance says.
    """
    ours, nees, most_inliers, svd = [], [], [], []
    for seed in range(40):
        mug = Mug(seed)
        hypotheses = generate(mug.p_obj, mug.p_cam, config, np.random.default_rng(seed))
        rule = SELECTION[config is PAPER]
        row, reason = select(hypotheses, mug.distances_m(hypotheses), rule)
        chosen = hypotheses[row]
        assert "surface" in reason and chosen.inliers[80:].sum() >= 12 and not chosen.inliers[:80].any()
        ours.append(error_deg_m(chosen.T_cam_obj, mug.truth)[0])
        cov = registration.covariance(chosen, mug.p_obj, mug.p_cam, 0.001)
        off = se3.log(se3.inverse(mug.truth) @ chosen.T_cam_obj)
        nees.append(off @ np.linalg.solve(cov, off))
        row, reason = select(hypotheses, None, rule)
        assert reason == "most inliers; there is no surface to compare with"
        most_inliers.append(error_deg_m(hypotheses[row].T_cam_obj, mug.truth)[0])
        single = generate(mug.p_obj, mug.p_cam, replace(config, method="svd"), np.random.default_rng(seed))
        assert [h.origin for h in single] == ["svd"]
        svd.append(error_deg_m(single[0].T_cam_obj, mug.truth)[0])
    assert np.mean(np.array(ours) < 3.0) >= 0.9 and np.sqrt(np.mean(np.square(ours))) < 2.0
    assert 4.5 < np.mean(nees) < 8  # 6 degrees of freedom
    assert min(most_inliers) > 15 and min(svd) > 10


# --- bad input ---------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("multi", [True, False])
def test_degenerate_sets_give_nothing(config, multi: bool) -> None:
    config = config if multi else replace(config, method="svd")
    rng = np.random.default_rng(11)
    T = random_pose(rng)
    line = np.linspace(-0.1, 0.1, 40)[:, None] * np.array([[0.6, 0.8, 0.0]])
    point = np.full((40, 3), 0.03)
    for p_obj in (line, point, line + 0.0005 * rng.normal(size=line.shape), np.zeros((0, 3)), box_points(rng, 2)):
        p_cam = se3.transform(T, p_obj) + 0.0005 * rng.normal(size=p_obj.shape)
        assert generate(p_obj, p_cam, config, np.random.default_rng(0)) == []


@BOTH
def test_a_line_within_a_body_never_turns_the_pose(config) -> None:
    """Most points on a line, few beside it: a sample of the line alone must not win with any roll."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        line = np.linspace(-0.1, 0.1, 60)[:, None] * np.array([[1.0, 0, 0]])
        p_obj, T = np.concatenate([line, box_points(rng, 12)]), random_pose(rng)
        p_cam = se3.transform(T, p_obj) + 0.0005 * rng.normal(size=p_obj.shape)
        best = most_supported(generate(p_obj, p_cam, config, np.random.default_rng(seed)))
        assert error_deg_m(best.T_cam_obj, T)[0] < 1.5


@BOTH
def test_a_line_with_a_motion_of_its_own_does_not_hide_the_body(config) -> None:
    """More points slide along an edge than move with the body: the body's pose is found."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        line = np.linspace(-0.1, 0.1, 60)[:, None] * np.array([[1.0, 0, 0]])
        body, T = box_points(rng, 30), random_pose(rng)
        p_obj = np.concatenate([line, body])
        p_cam = np.concatenate([se3.transform(random_pose(rng), line), se3.transform(T, body)])
        hypotheses = generate(p_obj, p_cam + 0.0005 * rng.normal(size=p_obj.shape), config, rng)
        assert min(error_deg_m(h.T_cam_obj, T)[0] for h in hypotheses) < 1.5


@BOTH
def test_rows_that_are_not_finite_are_left_out(config) -> None:
    rng = np.random.default_rng(12)
    p_obj, T = box_points(rng, 50), random_pose(rng)
    p_cam = se3.transform(T, p_obj)
    p_obj[3, 1], p_cam[7], p_cam[9, 2] = np.nan, np.inf, np.nan
    (only,) = generate(p_obj, p_cam, config, np.random.default_rng(0))
    bad = np.isin(np.arange(50), [3, 7, 9])
    np.testing.assert_array_equal(only.inliers, ~bad)
    assert np.isinf(only.residual_m[bad]).all() and np.isfinite(only.residual_m[~bad]).all()
    np.testing.assert_allclose(only.T_cam_obj, T, atol=1e-9)
    assert generate(np.full((50, 3), np.nan), p_cam, config, np.random.default_rng(0)) == []


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 12),
    scale_obj=st.sampled_from([0.0, 1e-9, 0.003, 0.05, 1e3]),
    scale_cam=st.sampled_from([0.0, 1e-9, 0.003, 0.05, 1e3]),
    paper=st.booleans(),
)
def test_any_points_give_rigid_poses_or_none(seed, n, scale_obj, scale_cam, paper) -> None:
    rng = np.random.default_rng(seed)
    p_obj, p_cam = scale_obj * rng.normal(size=(n, 3)), scale_cam * rng.normal(size=(n, 3)) + [0, 0, 0.6]
    config = PAPER if paper else DEFAULT
    for hypothesis in generate(p_obj, p_cam, config, rng, priors={"last pose": random_pose(rng)}):
        se3.check("hypothesis", hypothesis.T_cam_obj)
        cov = registration.covariance(hypothesis, p_obj, p_cam, 0.002)
        assert np.isfinite(cov).all() and np.linalg.eigvalsh(cov).min() > 0


# --- covariance --------------------------------------------------------------------------------


def test_covariance_is_that_of_many_trials() -> None:
    rng = np.random.default_rng(13)
    p_obj, T, sigma = box_points(rng, 30) * [1, 0.5, 0.2] + [0.02, 0, 0.05], random_pose(rng), 0.002
    p_cam = se3.transform(T, p_obj) + sigma * rng.normal(size=(4000, 30, 3))
    tangents = se3.log(se3.inverse(T) @ fit_rigid(np.broadcast_to(p_obj, p_cam.shape), p_cam))
    sampled = np.cov(tangents.T)
    everyone = Hypothesis(T, np.ones(30, bool), np.zeros(30), "truth")
    predicted = registration.covariance(everyone, p_obj, se3.transform(T, p_obj), sigma)
    # The shares of predicted variance along all directions at once: generalised eigenvalues.
    ratio = np.linalg.eigvals(np.linalg.solve(predicted, sampled)).real
    assert ratio.min() > 1 / 1.3 and ratio.max() < 1.3


def test_covariance_grows_with_the_residuals() -> None:
    rng = np.random.default_rng(14)
    p_obj, T = box_points(rng, 200), random_pose(rng)
    everyone = Hypothesis(T, np.ones(200, bool), np.zeros(200), "truth")
    noisy = se3.transform(T, p_obj) + 0.006 * rng.normal(size=p_obj.shape)
    told = registration.covariance(everyone, p_obj, noisy, 0.006)
    untold = registration.covariance(everyone, p_obj, noisy, 0.002)
    np.testing.assert_allclose(np.diag(untold), np.diag(told), rtol=0.3)


def test_covariance_says_which_direction_is_free() -> None:
    line = np.linspace(-0.08, 0.08, 20)[:, None] * np.array([[0, 1.0, 0]])
    T = random_pose(np.random.default_rng(15))
    for p_obj, free in ((line, [1]), (line[:1], [0, 1, 2]), (line[:0], [0, 1, 2, 3, 4, 5])):
        hypothesis = Hypothesis(T, np.ones(len(p_obj), bool), np.zeros(len(p_obj)), "truth")
        cov = registration.covariance(hypothesis, p_obj, se3.transform(T, p_obj), 0.002)
        sigma = np.sqrt(np.diag(cov))
        unknown = np.array([np.pi] * 3 + [1.0] * 3)
        assert np.isfinite(cov).all()
        np.testing.assert_allclose(sigma[free], unknown[free], rtol=0.05)
    hypothesis = Hypothesis(T, np.ones(20, bool), np.zeros(20), "truth")
    sigma = np.sqrt(np.diag(registration.covariance(hypothesis, line, se3.transform(T, line), 0.002)))
    assert sigma[[0, 2]].max() < 0.02 and sigma[3:].max() < 0.001


def test_refit_grows_from_a_pose_what_agrees_with_it() -> None:
    rng = np.random.default_rng(11)
    p_obj, T, wrong = box_points(rng, 60), random_pose(rng), random_pose(rng)
    p_cam = np.concatenate([se3.transform(wrong, p_obj[:45]), se3.transform(T, p_obj[45:])])
    p_cam += 0.0005 * rng.normal(size=(60, 3))
    p_cam[50] = np.nan
    near = T @ se3.exp(np.array([0.01, 0, 0, 0, 0.001, 0]))
    (found,) = registration.refit(near, "surface", p_obj, p_cam, DEFAULT, depth_noise_m(p_cam[:, 2]))
    assert found.origin == "surface" and found.support == 14 and not found.inliers[:45].any()
    assert error_deg_m(found.T_cam_obj, T)[0] < 0.5
    assert registration.refit(random_pose(rng), "surface", p_obj, p_cam, DEFAULT, depth_noise_m(p_cam[:, 2])) == []


def test_the_covariance_of_few_points_counts_the_degrees_of_freedom_that_the_pose_takes():
    """Eight points leave 18 of 24: the mean of chi squared over them is 1, so that only larger residuals inflate it."""
    rng, sigma_m = np.random.default_rng(4), 0.002
    p_obj = rng.uniform(-0.05, 0.05, (8, 3))
    plain = None
    for excess in (1.0, 2.0):
        residual = rng.normal(size=(8, 3))
        residual *= sigma_m * np.sqrt(excess * (3 * 8 - 6) / (residual**2).sum())
        found = Hypothesis(np.eye(4), np.ones(8, bool), np.linalg.norm(residual, axis=1), "made up")
        told = registration.covariance(found, p_obj, p_obj + residual, sigma_m)
        plain = told if plain is None else plain
    np.testing.assert_allclose(told, 2 * plain, rtol=1e-3)
