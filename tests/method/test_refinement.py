"""Refinement: derivatives, convergence on exact shapes, what a shape leaves free, robustness, selection."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core import se3
from p2p_lib.core.config import RefinementConfig, TsdfConfig, preset
from p2p_lib.method import refinement
from p2p_lib.method.observation import sample_cloud
from p2p_lib.method.refinement import Keypoints, refine, surface_distances, surface_jacobian
from p2p_lib.method.tsdf import TsdfVolume
from tests.method.analytic_scene import CAMERA, LUMP, around, box, can, look_from, render, union

CONFIG = RefinementConfig()


def surface_score(volume, p_cam, T_cam_obj) -> np.ndarray:
    """(H,) the paper's measure for choosing a hypothesis."""
    return surface_distances(volume, p_cam, T_cam_obj).mean(1)


WHITE = np.full((CAMERA.height, CAMERA.width, 3), 255, np.uint8)


class Exact:
    """An exact signed distance as a surface, clamped at tau like a volume."""

    tau_m, voxel_m = 0.02, 0.002

    def __init__(self, sdf):
        self.sdf = sdf

    def query(self, p):
        return np.clip(self.sdf(p), -self.tau_m, self.tau_m), np.isfinite(p).all(-1)

    def query_with_gradient(self, p):
        h = 0.5 * self.voxel_m
        gradient = [(self.query(p + h * e)[0] - self.query(p - h * e)[0]) / (2 * h) for e in np.eye(3)]
        value, valid = self.query(p)
        return value, np.asfortranarray(np.stack(gradient, -1)), valid


def noisy(depth, rng, sigma_m=0.0015):
    return np.where(depth > 0, depth + rng.normal(0, sigma_m, depth.shape), 0).astype(np.float32)


def fused(sdf, poses, rng=None):
    volume = TsdfVolume(TsdfConfig(voxel_m=0.003))
    for T in poses:
        depth, mask = render(sdf, T)
        depth = np.where(mask, noisy(depth, rng) if rng else depth, np.float32(1.0))
        volume.integrate(depth, WHITE, mask, CAMERA, T)
    return volume


def cloud_of(sdf, T, rng=None, n=700):
    depth, mask = render(sdf, T)
    return sample_cloud(noisy(depth, rng) if rng else depth, mask, CAMERA, n)


def error(T, T_true):
    """Rotation in degrees and translation in millimetres."""
    e = se3.log(se3.inverse(T_true) @ T)
    return np.degrees(np.linalg.norm(e[:3])), 1e3 * np.linalg.norm(e[3:])


def perturbation(rng, degrees, millimetres):
    w, t = rng.normal(size=(2, 3))
    return se3.exp(np.r_[np.radians(degrees) * w / np.linalg.norm(w), millimetres / 1e3 * t / np.linalg.norm(t)])


@pytest.fixture(scope="module")
def lump():
    return fused(LUMP, [*around(8), *around(4, height=-0.7)])


VIEW = look_from((0.8, 0.5, 0.6))


# -- derivatives ---------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_jacobian_equals_the_numerical_derivative_of_the_residual(seed):
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0, 0.5, 6))
    p_cam = se3.transform(T, rng.uniform(-0.1, 0.1, (9, 3)))
    H = rng.normal(size=(3, 3))

    def phi(p):  # a smooth field with a known gradient
        return np.einsum("ni,ij,nj->n", p, H, p) + np.sin(5 * p[:, 0])

    def gradient(p):
        return p @ (H + H.T) + np.stack([5 * np.cos(5 * p[:, 0]), 0 * p[:, 0], 0 * p[:, 0]], -1)

    def residual(xi):
        return phi(se3.transform(se3.inverse(T @ se3.exp(xi)), p_cam))

    p_obj = se3.transform(se3.inverse(T), p_cam)
    steps = 1e-6 * np.eye(6)
    numeric = np.stack([(residual(h) - residual(-h)) / 2e-6 for h in steps], -1)
    np.testing.assert_allclose(surface_jacobian(p_obj, gradient(p_obj)), numeric, atol=1e-6)


def test_keypoint_system_equals_the_numerical_derivatives_of_its_cost():
    rng = np.random.default_rng(3)
    T = se3.exp(rng.normal(0, 0.4, 6))
    p_obj = rng.uniform(-0.05, 0.05, (12, 3))
    p_cam = se3.transform(T, p_obj + rng.normal(0, 0.002, p_obj.shape))
    cloud = se3.transform(T, rng.uniform(-0.05, 0.05, (50, 3)))
    keypoints = Keypoints(p_obj, p_cam, rng.uniform(0.01, 0.02, 12))
    problem = refinement._Problem.about(T, cloud, Exact(LUMP), CONFIG, keypoints)
    H, g = problem.keypoint_system(problem.keypoints, T)

    def residual(step):
        q = se3.transform(se3.inverse(problem.moved(T, step)), p_cam)
        return ((q - p_obj) / keypoints.sigma_m[:, None]).ravel()

    J = np.stack([(residual(h) - residual(-h)) / 2e-6 for h in 1e-6 * np.eye(6)], -1)
    np.testing.assert_allclose(H, J.T @ J, rtol=1e-4, atol=1e-4 * np.abs(H).max())
    np.testing.assert_allclose(g, J.T @ residual(np.zeros(6)), rtol=1e-4, atol=1e-4 * np.abs(g).max())


def test_the_gradient_is_the_derivative_of_the_robust_cost():
    """A seventh of the depth points and a third of the keypoints lie beyond Huber's thresholds."""
    rng = np.random.default_rng(3)
    T, p_obj = VIEW @ perturbation(rng, 3, 4), rng.uniform(-0.05, 0.05, (12, 3))
    p_cam = se3.transform(VIEW, p_obj + rng.normal(0, 0.002, p_obj.shape))
    p_cam[:4] += rng.normal(0, 0.03, (4, 3))
    keypoints = Keypoints(p_obj, p_cam, np.full(12, 0.002))
    problem = refinement._Problem.about(T, cloud_of(LUMP, VIEW), Exact(LUMP), CONFIG, keypoints)
    at = problem.surface(T, widest_m=0.012)
    assert (np.abs(at.distance_m) > CONFIG.huber_m).mean() > 0.12 and len(at.rows) == len(at.distance_m)

    def cost(step):
        return problem.cost(problem.surface(problem.moved(T, step)), at)

    numeric = np.array([(cost(h) - cost(-h)) / 2e-6 for h in 1e-6 * np.eye(6)])
    _, g = problem.joint(at)
    np.testing.assert_allclose(2 * g, numeric, atol=0.01 * np.abs(numeric).max())


# -- convergence ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["default", "paper"])
def test_recovers_a_perturbed_pose_on_a_fused_surface(lump, name):
    config = preset(name).refinement
    rng = np.random.default_rng(0)
    p_cam = cloud_of(LUMP, VIEW, n=config.max_points)
    floor = error(refine(VIEW, p_cam, lump, config).T_cam_obj, VIEW)
    assert floor[0] < 1.0 and floor[1] < 1.0
    for degrees, millimetres in ((2, 3), (5, 5), (8, 10)):
        for _ in range(4):
            found = refine(VIEW @ perturbation(rng, degrees, millimetres), p_cam, lump, config)
            turned, moved = error(found.T_cam_obj, VIEW)
            assert turned < 1.5 and moved < 1.5, (degrees, millimetres, turned, moved)
            assert found.refined and found.inliers > 0.7 and found.rms_m < 0.002


def test_recovers_a_perturbed_pose_exactly_on_an_exact_surface(monkeypatch):
    monkeypatch.setattr(refinement, "_TOLERANCE", 1e-9)
    rng = np.random.default_rng(1)
    p_cam = cloud_of(LUMP, VIEW)
    exact = RefinementConfig(iterations=40)
    for _ in range(5):
        found = refine(VIEW @ perturbation(rng, 4, 5), p_cam, Exact(LUMP), exact)
        turned, moved = error(found.T_cam_obj, VIEW)
        assert turned < 0.02 and moved < 0.02


def test_recovers_under_noise_and_outliers():
    rng = np.random.default_rng(2)
    volume = fused(LUMP, [*around(8), *around(4, height=-0.7)], rng)
    p_cam = cloud_of(LUMP, VIEW, rng)
    wild = rng.random(len(p_cam)) < 0.2
    p_cam[wild] += rng.normal(0, 0.05, (wild.sum(), 3))
    for _ in range(4):
        found = refine(VIEW @ perturbation(rng, 3, 4), p_cam, volume, CONFIG)
        turned, moved = error(found.T_cam_obj, VIEW)
        assert turned < 2 and moved < 2
        assert found.inliers < 0.95


#: A block on a plate: seen from above, few points hold it against sliding.
BLOCK = union(box((0, 0, 0), (0.08, 0.08, 0.01)), box((0, 0, 0.02), (0.025, 0.015, 0.01)))


def test_the_few_points_that_hold_a_direction_are_no_outliers_at_first():
    T = look_from((0.7, 0.5, 1.0))
    found = refine(T @ se3.exp([0, 0, 0, -0.008, 0, 0]), cloud_of(BLOCK, T), Exact(BLOCK), CONFIG)
    assert error(found.T_cam_obj, T)[1] < 0.5


@pytest.mark.parametrize("seed", range(3))
def test_flying_points_do_not_pull(seed):
    """A fifth of the points float 12 mm above the surface."""
    T, rng = look_from((0.7, 0.5, 1.0)), np.random.default_rng(seed)
    p_cam = cloud_of(BLOCK, T)
    flying = rng.random(len(p_cam)) < 0.2
    p_cam[flying] += 0.012 * T[:3, 2]
    found = refine(T @ se3.exp([0.02, -0.03, 0, 0.002, 0.002, 0.002]), p_cam, Exact(BLOCK), CONFIG)
    assert abs((se3.inverse(T) @ found.T_cam_obj)[2, 3]) < 2e-4


def test_the_true_pose_is_left_where_it_is_within_the_reported_covariance():
    rng = np.random.default_rng(4)
    normalised = []
    for _ in range(8):
        volume = fused(LUMP, around(6), rng)
        found = refine(VIEW, cloud_of(LUMP, VIEW, rng), volume, CONFIG)
        e = se3.log(se3.inverse(found.T_cam_obj) @ VIEW)
        normalised.append(e @ np.linalg.solve(found.covariance, e))
        assert np.linalg.eigvalsh(found.covariance).min() > 0
    # Chi square of 6: the covariance may be somewhat cautious, but never boastful.
    assert 0.2 < np.mean(normalised) < 12


def test_more_iterations_never_make_the_objective_worse(lump):
    p_cam = cloud_of(LUMP, VIEW)
    start = VIEW @ se3.exp([0.05, -0.06, 0.04, 0.004, 0.003, -0.005])
    scores = [
        surface_score(lump, p_cam, refine(start, p_cam, lump, RefinementConfig(iterations=n)).T_cam_obj)[0]
        for n in (1, 2, 4, 8)
    ]
    assert scores[-1] < 0.5 * surface_score(lump, p_cam, start)[0]
    assert np.all(np.diff(scores) < 2e-4)


def test_steps_are_clipped(lump, monkeypatch):
    monkeypatch.setattr(refinement, "_MAX_STEP_M", 1e-4)
    monkeypatch.setattr(refinement, "_MAX_STEP_RAD", 1e-3)
    p_cam = cloud_of(LUMP, VIEW)
    start = VIEW @ se3.exp([0.1, 0, 0, 0.008, 0, 0])
    config = RefinementConfig(iterations=1)
    found = refine(start, p_cam, lump, config)
    e = se3.log(se3.inverse(start) @ found.T_cam_obj)
    assert 0 < np.linalg.norm(e[:3]) <= 1.01e-3
    centre = se3.transform(se3.inverse(start), p_cam).mean(0)[None]
    shift = se3.transform(se3.inverse(found.T_cam_obj) @ start, centre) - centre
    assert np.linalg.norm(shift) <= 1.3e-4


# -- what the shape leaves free ------------------------------------------------------------------------

CAN = can(0.033, 0.05)
SLAB = box((0, 0, 0), (0.3, 0.3, 0.01))


def slab_cloud(T, rng):
    depth, mask = render(SLAB, T)
    window = np.zeros_like(mask)
    window[40:140, 60:180] = True
    return noisy(depth, rng), mask & window


def spin_deg(T, T_true):
    """Turn about the object's z axis between two poses, in degrees."""
    return np.degrees(se3.log(se3.inverse(T_true) @ T)[2])


@pytest.mark.parametrize("noise_free", [True, False])
def test_a_can_is_not_spun_by_its_surface_but_by_its_keypoints(noise_free):
    rng = np.random.default_rng(5)
    source = None if noise_free else rng
    volume = fused(CAN, [look_from((np.cos(a), np.sin(a), 0.5)) for a in np.linspace(0, 1.2, 6)], source)
    T = look_from((1, 0.4, 0.5))
    p_cam = cloud_of(CAN, T, source)
    start = T @ se3.exp([0, 0, np.radians(6), 0, 0, 0])

    alone = refine(start, p_cam, volume, CONFIG)
    assert alone.refined and "1 of 6" in alone.reason
    assert alone.eigenvalues[0] < CONFIG.min_eigenvalue < alone.eigenvalues[1]
    # A radian about the can's own axis, not about the cloud's centre.
    assert alone.free_rotations.shape == (1, 6)
    np.testing.assert_allclose(np.abs(alone.free_rotations[0]), [0, 0, 1, 0, 0, 0], atol=0.06)
    assert abs(spin_deg(alone.T_cam_obj, T) - 6) < 0.7
    assert np.degrees(np.sqrt(alone.covariance[2, 2])) > 3  # and it says that it does not know

    angle = rng.uniform(-0.8, 0.8, 14)
    p_obj = np.stack([0.033 * np.cos(angle), 0.033 * np.sin(angle), rng.uniform(-0.04, 0.04, 14)], -1)
    seen = se3.transform(T, p_obj) + rng.normal(0, 0.0005, p_obj.shape)
    both = refine(start, p_cam, volume, CONFIG, keypoints=Keypoints(p_obj, seen, np.full(14, 0.002)))
    assert abs(spin_deg(both.T_cam_obj, T)) < 1
    assert np.degrees(np.sqrt(both.covariance[2, 2])) < 2


def test_a_can_is_still_moved_where_its_surface_holds_it():
    volume = fused(CAN, [look_from((np.cos(a), np.sin(a), 0.5)) for a in np.linspace(0, 1.2, 6)])
    T = look_from((1, 0.4, 0.5))
    found = refine(T @ se3.exp([0.05, -0.04, 0, 0, 0, 0.003]), cloud_of(CAN, T), volume, CONFIG)
    axis = found.T_cam_obj[:3, 2]
    assert np.degrees(np.arccos(axis @ T[:3, 2])) < 1
    assert abs((se3.inverse(T) @ found.T_cam_obj)[2, 3]) < 0.0015


def test_a_plane_fixes_three_directions_and_leaves_three():
    rng = np.random.default_rng(6)
    volume = TsdfVolume(TsdfConfig(voxel_m=0.003))
    poses = [look_from((0.2 * np.cos(a), 0.2 * np.sin(a), 1), up=(0, 1, 0)) for a in range(6)]
    for T in poses:
        depth, mask = slab_cloud(T, rng)
        volume.integrate(depth, WHITE, mask, CAMERA, T)
    T = poses[1]
    p_cam = sample_cloud(*slab_cloud(T, rng), CAMERA, 700)
    start = T @ se3.exp([0.03, -0.02, 0.05, 0.004, -0.003, 0.003])
    found = refine(start, p_cam, volume, CONFIG)
    assert "3 of 6" in found.reason
    assert found.free_rotations.shape == (1, 6)  # the two others are shifts
    np.testing.assert_allclose(np.abs(found.free_rotations[0, :3]), [0, 0, 1], atol=0.03)
    left = se3.log(se3.inverse(T) @ found.T_cam_obj)
    assert np.degrees(np.abs(left[:2])).max() < 0.7 and abs(left[5]) < 0.001  # tilt and height are mended
    assert abs(left[2] - 0.05) < 0.006  # the turn within the plane is not touched
    assert np.linalg.norm(left[3:5] - [0.004, -0.003]) < 0.0015


def test_without_the_refusal_noise_moves_the_free_direction():
    """The refusal is not idle: the same can, with every direction allowed, is spun by its noise."""
    spun = {0.0: [], CONFIG.min_eigenvalue: []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        volume = fused(CAN, [look_from((1, 0, 0.5))], rng)
        T = look_from((1, 0, 0.5)) @ se3.exp([0, 0, np.radians(20), 0, 0, 0])
        start, p_cam = T @ se3.exp([0, 0, np.radians(6), 0, 0, 0]), cloud_of(CAN, T, rng)
        for min_eigenvalue, turned in spun.items():
            found = refine(start, p_cam, volume, RefinementConfig(min_eigenvalue=min_eigenvalue))
            turned.append(abs(spin_deg(found.T_cam_obj, T) - 6))
    assert max(spun[CONFIG.min_eigenvalue]) < 0.4
    assert np.median(spun[0.0]) > 0.5 and max(spun[0.0]) > 1.5


# -- bad numbers ---------------------------------------------------------------------------------------


def test_nan_and_infinite_points_take_no_part(lump):
    p_cam = cloud_of(LUMP, VIEW, n=400)
    start = VIEW @ se3.exp([0.03, 0, 0, 0, 0.003, 0])
    dirty = np.concatenate([p_cam, np.full((50, 3), np.nan), np.full((50, 3), np.inf)])
    a, b = refine(start, p_cam, lump, CONFIG), refine(start, dirty, lump, CONFIG)
    np.testing.assert_allclose(a.T_cam_obj, b.T_cam_obj, atol=1e-9)


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (np.zeros((0, 3)), "0 depth points"),
        (np.full((100, 3), np.nan), "0 depth points"),
        (np.array([[0, 0, 0.4]] * 9), "9 depth points"),
        (np.full((100, 3), 9.0), "fewer than 10 depth points lie on observed surface"),
    ],
)
def test_too_little_to_go_by_returns_the_pose_with_the_reason(lump, cloud, words):
    found = refine(VIEW, cloud, lump, CONFIG)
    np.testing.assert_array_equal(found.T_cam_obj, VIEW)
    assert words in found.reason and not found.refined and found.covariance is None


def test_empty_volume_and_nan_pose_are_reasons_not_exceptions(lump):
    p_cam = cloud_of(LUMP, VIEW)
    found = refine(VIEW, p_cam, TsdfVolume(TsdfConfig()), CONFIG)
    assert "observed surface" in found.reason and (found.T_cam_obj == VIEW).all()
    assert "not finite" in refine(np.full((4, 4), np.nan), p_cam, lump, CONFIG).reason


def test_a_degenerate_cloud_gives_a_finite_pose(lump):
    on = se3.transform(VIEW, lump.mesh().vertices[:1])
    line = on + np.linspace(0, 0.01, 50)[:, None] * [1, 0, 0]
    for cloud in (np.repeat(on, 60, 0), line):
        found = refine(VIEW, cloud, lump, CONFIG)
        assert np.isfinite(found.T_cam_obj).all()
        assert found.covariance is None or np.isfinite(found.covariance).all()
        se3.check("refined", found.T_cam_obj)


def test_bad_keypoints_are_left_out(lump):
    p_cam = cloud_of(LUMP, VIEW)
    start = VIEW @ se3.exp([0.02, 0.02, 0, 0, 0.002, 0])
    rng = np.random.default_rng(8)
    p_obj = rng.uniform(-0.03, 0.03, (6, 3))
    good = Keypoints(p_obj, se3.transform(VIEW, p_obj), np.full(6, 0.003))
    nan, sigma = np.full((3, 3), np.nan), np.array([0.0, -1.0, np.nan])
    bad = Keypoints(
        np.concatenate([p_obj, nan, p_obj[:3]]),
        np.concatenate([good.p_cam, nan, good.p_cam[:3]]),
        np.concatenate([good.sigma_m, np.full(3, 0.003), sigma]),
    )
    a, b = (refine(start, p_cam, lump, CONFIG, keypoints=k).T_cam_obj for k in (good, bad))
    np.testing.assert_allclose(a, b, atol=1e-12)


# -- selection and sampling ----------------------------------------------------------------------------


def test_score_is_least_for_the_true_pose_and_counts_unseen_points_as_truncation(lump):
    rng = np.random.default_rng(9)
    p_cam = cloud_of(LUMP, VIEW)
    T = np.stack([VIEW @ perturbation(rng, 8, 10) for _ in range(9)] + [VIEW])
    score = surface_score(lump, p_cam, T)
    assert score.shape == (10,) and np.argmin(score) == 9
    one_by_one = [
        np.where((q := lump.query(se3.transform(se3.inverse(t), p_cam)))[1], np.abs(q[0]), lump.tau_m).mean() for t in T
    ]
    np.testing.assert_allclose(score, one_by_one, rtol=1e-6)
    far = surface_score(lump, p_cam, VIEW @ se3.exp([0, 0, 0, 5, 0, 0]))
    assert far[0] == pytest.approx(lump.tau_m)


def test_sampled_points_are_measured_spread_inside_and_clear_of_edges():
    depth, mask = render(LUMP, VIEW)
    step = depth.copy()
    step[:, 118:] += 0.1 * (step[:, 118:] > 0)  # a depth edge through the middle
    p_cam = sample_cloud(step, mask, CAMERA, 300)
    uv = CAMERA.project(p_cam)
    px = np.rint(uv).astype(int)
    np.testing.assert_allclose(uv, px, atol=1e-6)
    np.testing.assert_allclose(p_cam[:, 2], step[px[:, 1], px[:, 0]], rtol=1e-6)
    assert 200 <= len(p_cam) <= 300
    assert len(np.unique(px, axis=0)) == len(px)
    assert mask[px[:, 1], px[:, 0]].all() and not np.isin(px[:, 0], (117, 118)).any()
    for dv, du in np.ndindex(5, 5):  # two pixels clear of the mask's border
        assert mask[px[:, 1] + dv - 2, px[:, 0] + du - 2].all()
    v, u = np.nonzero(mask)
    np.testing.assert_allclose(px.mean(0), [u.mean(), v.mean()], atol=3)
    np.testing.assert_allclose(px.std(0), [u.std(), v.std()], rtol=0.15)
    np.testing.assert_array_equal(p_cam, sample_cloud(step, mask, CAMERA, 300))
    every_column = CAMERA.project(sample_cloud(step, mask, CAMERA, 10**6))[:, 0].round()
    assert {116, 119} <= set(every_column) and not {117, 118} & set(every_column)


@pytest.mark.parametrize("narrow", [True, False])
def test_a_stick_of_three_pixels_has_points_that_are_its_own(narrow):
    """Half of the depth beside its edges is missing, and some is that of the wall behind it."""
    rng, (v, u) = np.random.default_rng(0), np.mgrid[: CAMERA.height, : CAMERA.width]
    mask = (np.abs(v - 90 - (u - 120) // 3) <= 1) & (np.abs(u - 120) < 60)
    depth = np.where(mask, 0.5 + 0.0005 * u, 1.5).astype(np.float32)
    lost, wild = rng.random((2, *mask.shape))
    depth[mask & (lost < 0.4)] = 0
    depth[mask & (wild < 0.15)] = 1.5
    p_cam = sample_cloud(depth, mask, CAMERA, 700, narrow)
    assert len(p_cam) > 0.3 * np.count_nonzero(mask & (depth > 0)) if narrow else not len(p_cam)
    assert not narrow or (p_cam[:, 2] < 0.7).mean() > 0.97


def test_nothing_to_sample_gives_no_points():
    depth, mask = render(LUMP, VIEW)
    for d, m in ((depth * 0, mask), (np.full_like(depth, np.nan), mask), (depth, np.zeros_like(mask))):
        assert sample_cloud(d, m, CAMERA, 100).shape == (0, 3)
