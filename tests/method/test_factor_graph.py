"""The keyframe graph against exact geometry, Monte Carlo and its own input."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig, preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.robust import fit_rigid
from p2p_lib.extended.graph import BoundedGraph
from p2p_lib.method import factor_graph
from p2p_lib.method.factor_graph import GraphResult, ObjectGraph

pytest.importorskip("gtsam")

SIGMA_RAD, SIGMA_M = 0.0015, 0.003
DEFAULT = replace(preset("default").factor_graph, range_sigma_m=SIGMA_M)
PAPER = preset("paper").factor_graph
ALL = replace(DEFAULT, max_keyframes=0)


@dataclass
class Turntable:
    """A bottle-sized ellipsoid whose points are seen while they face the camera."""

    p_obj: np.ndarray
    T_cam_obj: np.ndarray
    seen: list[np.ndarray]
    p_cam: list[np.ndarray]

    @classmethod
    def made(cls, seed: int, keyframes: int, step_deg: float = 15.0, points: int = 150, noise: float = 1.0):
        rng = np.random.default_rng(seed)
        normal = rng.normal(size=(points, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        p_obj = normal * [0.05, 0.08, 0.05]
        angle, k = np.radians(step_deg) * np.arange(keyframes), np.arange(keyframes)
        zero = np.zeros(keyframes)
        turn = se3.exp(np.stack([zero, angle, zero, zero, zero, zero], 1))
        tilt = se3.exp(np.stack([0.3 * np.sin(0.3 * k), zero, zero, zero, zero, zero], 1))
        T = tilt @ turn
        T[:, :3, 3] = np.stack([0.03 * np.sin(0.2 * k), zero, 0.6 + 0.05 * np.cos(0.4 * k)], 1)
        seen, observed = [], []
        for T_cam_obj in T:
            p_cam = se3.transform(T_cam_obj, p_obj)
            facing = -np.einsum(
                "ni,ni->n", normal @ T_cam_obj[:3, :3].T, p_cam / np.linalg.norm(p_cam, axis=1)[:, None]
            )
            ids = np.flatnonzero(facing > 0.4)
            seen.append(ids)
            observed.append(measured(p_cam[ids], noise, rng))
        return cls(p_obj, T, seen, observed)


def measured(p_cam: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Bearing and range with the default noise, times ``noise``."""
    range_m = np.linalg.norm(p_cam, axis=1, keepdims=True)
    bearing = p_cam / range_m + noise * SIGMA_RAD * rng.normal(size=p_cam.shape)
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    return bearing * (range_m + noise * SIGMA_M * rng.normal(size=range_m.shape))


def run(world: Turntable, config: FactorGraphConfig) -> tuple[ObjectGraph, GraphResult, np.ndarray]:
    """All keyframes in turn, each registered to the map as it stands; also the poses that went in."""
    graph, result, known, given = BoundedGraph(config), None, {}, []
    for ids, p_cam, truth in zip(world.seen, world.p_cam, world.T_cam_obj, strict=True):
        shared = [k for k, i in enumerate(ids.tolist()) if i in known]
        T = fit_rigid(np.array([known[ids[k]] for k in shared]), p_cam[shared]) if known else truth
        graph.add_keyframe(T, ids, p_cam, p_obj_init=se3.transform(se3.inverse(T), p_cam))
        result = graph.optimise()
        assert result.ok, result.reason
        known |= dict(zip(result.point_ids.tolist(), result.p_obj, strict=True))
        given.append(T)
    return graph, result, np.array(given)


def errors(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Root mean square of rotation (deg) and of translation (m), the gauge's part taken out."""
    off = se3.log(se3.inverse(truth) @ T)
    off = off - off.mean(0)
    return float(np.degrees(np.sqrt((off[:, :3] ** 2).sum(1).mean()))), float(np.sqrt((off[:, 3:] ** 2).sum(1).mean()))


def map_error_m(p_obj: np.ndarray, world: Turntable, result: GraphResult) -> float:
    """Root mean square per axis of the result's points at p_obj, under the best rigid alignment."""
    truth = world.p_obj[result.point_ids]
    return float(np.sqrt(np.mean((se3.transform(fit_rigid(truth, p_obj), truth) - p_obj) ** 2)))


def perturbed(T: np.ndarray, seed: int, sigma_rad: float = 0.03, sigma_m: float = 0.004) -> np.ndarray:
    xi = np.random.default_rng(seed).normal(size=(len(T), 6)) * np.repeat([sigma_rad, sigma_m], 3)
    xi[0] = 0
    return T @ se3.exp(xi)


def added_at_once(world: Turntable, config: FactorGraphConfig, T: np.ndarray) -> tuple[ObjectGraph, GraphResult]:
    graph = ObjectGraph(config)
    for k, (ids, p_cam) in enumerate(zip(world.seen, world.p_cam, strict=True)):
        assert graph.add_keyframe(T[k], ids, p_cam, p_obj_init=se3.transform(se3.inverse(T[k]), p_cam)) == k
    return graph, graph.optimise()


# --- what it solves ----------------------------------------------------------------------------


def test_exact_observations_give_exact_poses_and_points(monkeypatch) -> None:
    monkeypatch.setattr(factor_graph, "_RELATIVE_TOLERANCE", 1e-12)
    world = Turntable.made(0, 10, noise=0)
    config = replace(ALL, between=False, iterations=50)
    _, result = added_at_once(world, config, perturbed(world.T_cam_obj, 1))
    assert result.ok and result.error_after < 1e-6 * result.error_before
    np.testing.assert_allclose(result.T_cam_obj, world.T_cam_obj, atol=2e-5)
    np.testing.assert_allclose(result.p_obj, world.p_obj[result.point_ids], atol=2e-5)


def test_agrees_with_scipy(monkeypatch) -> None:
    """The minimum of the same loss (bearing angle and range in sigmas, Huber) found by another solver."""
    monkeypatch.setattr(factor_graph, "_RELATIVE_TOLERANCE", 1e-14)
    world = Turntable.made(2, 3, step_deg=20, points=25)
    config = replace(ALL, between=False, huber=1e6, iterations=60)
    _, result = added_at_once(world, config, world.T_cam_obj)
    ids, poses = result.point_ids, len(world.T_cam_obj)

    def residuals(x: np.ndarray) -> np.ndarray:
        T = world.T_cam_obj[1:] @ se3.exp(x[: 6 * (poses - 1)].reshape(-1, 6))
        p_obj, out = x[6 * (poses - 1) :].reshape(-1, 3), []
        for T_cam_obj, seen, p_cam in zip([world.T_cam_obj[0], *T], world.seen, world.p_cam, strict=True):
            expected = se3.transform(T_cam_obj, p_obj[np.searchsorted(ids, seen)])
            near, far = np.linalg.norm(expected, axis=1), np.linalg.norm(p_cam, axis=1)
            across = np.cross(expected / near[:, None], p_cam / far[:, None])  # sine and angle agree at 1e-3
            out += [(across / SIGMA_RAD).ravel(), (near - far) / SIGMA_M]
        return np.concatenate(out)

    start = np.concatenate([np.zeros(6 * (poses - 1)), world.p_obj[ids].ravel()])
    best = least_squares(residuals, start, xtol=1e-14, ftol=1e-14)
    T = world.T_cam_obj[1:] @ se3.exp(best.x[: 6 * (poses - 1)].reshape(-1, 6))
    assert result.error_after == pytest.approx(best.cost, rel=1e-3)
    np.testing.assert_allclose(se3.log(se3.inverse(T) @ result.T_cam_obj[1:]), 0, atol=2e-4)


@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])
def test_better_than_what_goes_in(config: FactorGraphConfig) -> None:
    before, after, map_before, map_after = [], [], [], []
    for seed in range(4):
        world = Turntable.made(seed, 24)
        _, result, given = run(world, config)
        before.append(errors(given, world.T_cam_obj))
        after.append(errors(result.T_cam_obj, world.T_cam_obj))
        first_seen = {}
        for T, ids, p_cam in zip(given, world.seen, world.p_cam, strict=True):
            for i, p in zip(ids.tolist(), se3.transform(se3.inverse(T), p_cam), strict=True):
                first_seen.setdefault(i, p)
        map_before.append(map_error_m(np.array([first_seen[i] for i in result.point_ids.tolist()]), world, result))
        map_after.append(map_error_m(result.p_obj, world, result))
    assert np.mean(after, 0)[0] < 0.95 * np.mean(before, 0)[0]
    assert np.mean(map_after) < 0.5 * np.mean(map_before)


def test_revisited_points_close_a_drifted_chain() -> None:
    """A full turn of frame-to-frame poses has drifted by many degrees; the points seen again undo it."""
    world = Turntable.made(3, 30, step_deg=15)
    rng = np.random.default_rng(4)
    steps = se3.exp(rng.normal(size=(30, 6)) * np.repeat([0.02, 0.002], 3) + np.repeat([0.01, 0.0], 3))
    drifted = [world.T_cam_obj[0]]
    for before, now, slip in zip(world.T_cam_obj[:-1], world.T_cam_obj[1:], steps[1:], strict=True):
        drifted.append(drifted[-1] @ se3.inverse(before) @ now @ slip)
    drifted = np.array(drifted)
    assert errors(drifted, world.T_cam_obj)[0] > 5
    _, chain_only = added_at_once(world, replace(ALL, observations=False), drifted)
    np.testing.assert_allclose(chain_only.T_cam_obj, drifted, atol=1e-6)
    _, result = added_at_once(world, replace(ALL, iterations=30), drifted)
    assert errors(result.T_cam_obj, world.T_cam_obj)[0] < 1.5


def test_robust_to_gross_outliers() -> None:
    world = Turntable.made(5, 20)
    clean = errors(run(world, DEFAULT)[1].T_cam_obj, world.T_cam_obj)
    rng = np.random.default_rng(6)
    for p_cam in world.p_cam:
        wrong = rng.random(len(p_cam)) < 0.1
        p_cam[wrong] += rng.uniform(-0.04, 0.04, (wrong.sum(), 3))
    graph = ObjectGraph(DEFAULT)
    T = perturbed(world.T_cam_obj, 7, 0.02, 0.002)
    for k, (ids, p_cam) in enumerate(zip(world.seen, world.p_cam, strict=True)):
        graph.add_keyframe(T[k], ids, p_cam, p_obj_init=se3.transform(se3.inverse(T[k]), p_cam))
    result = graph.optimise()
    turn, shift = errors(result.T_cam_obj, world.T_cam_obj)
    assert turn < 1.5 * clean[0] + 0.2 and shift < 1.5 * clean[1] + 2e-4


def test_forgotten_points_leave_with_their_observations() -> None:
    """Two tracks that slide along the surface are forgotten: the loss falls, and the rest goes on."""
    world = Turntable.made(8, 12, step_deg=5)
    sliding = np.flatnonzero(np.bincount(np.concatenate(world.seen), minlength=len(world.p_obj)) >= 8)[:2]
    rng = np.random.default_rng(9)
    for ids, p_cam in zip(world.seen, world.p_cam, strict=True):
        rows = np.isin(ids, sliding)
        p_cam[rows] += 0.015 * rng.normal(size=(rows.sum(), 3))
    graph, result = added_at_once(world, DEFAULT, world.T_cam_obj)
    graph.forget(sliding)
    again = graph.optimise()
    assert not np.isin(sliding, again.point_ids).any() and again.error_after < result.error_after


# --- covariance --------------------------------------------------------------------------------


def test_covariance_is_that_of_many_trials(monkeypatch) -> None:
    """Rotation first, right tangent of T_cam_obj: the same small problem with 150 draws of its noise.

    The keyframe looks from 0.6 m at an object that has turned by 40 degrees, so that the tangents of
    X and T, left and right, and either order of rotation and translation all differ by far.
    """
    monkeypatch.setattr(factor_graph, "_RELATIVE_TOLERANCE", 1e-9)
    config = replace(ALL, huber=1e6, iterations=20)
    off, covariance = [], []
    exact = Turntable.made(10, 3, step_deg=20, points=60, noise=0)
    for seed in range(150):
        rng = np.random.default_rng(seed)
        noisy = Turntable(exact.p_obj, exact.T_cam_obj, exact.seen, [measured(p, 1.0, rng) for p in exact.p_cam])
        _, result = added_at_once(noisy, replace(config, between=False), exact.T_cam_obj)
        off.append(se3.log(se3.inverse(exact.T_cam_obj[-1]) @ result.T_cam_obj[-1]))
        covariance.append(result.covariance)
    off, predicted = np.array(off), np.mean(covariance, 0)
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    assert 5.2 < nees.mean() < 6.9  # 6 degrees of freedom; its standard error is 0.28
    share = np.linalg.eigvals(np.linalg.solve(predicted, np.cov(off.T))).real
    assert share.min() > 0.55 and share.max() < 1.6
    sigma_deg = np.degrees(np.sqrt(np.diag(predicted)[:3]))
    assert (sigma_deg > 0.1).all() and (sigma_deg < 5).all()


def test_covariance_stays_honest_when_keyframes_are_merged() -> None:
    nees = []
    for seed in range(12):
        world = Turntable.made(seed, 24)
        _, result, _ = run(world, replace(DEFAULT, max_keyframes=12))
        off = se3.log(se3.inverse(world.T_cam_obj[-1]) @ result.T_cam_obj[-1])
        nees.append(off @ np.linalg.solve(result.covariance, off))
    assert 3 < np.mean(nees) < 12  # a factor 2 around 6


# --- bounded cost ------------------------------------------------------------------------------


def test_merging_keeps_gauge_points_and_accuracy() -> None:
    bounded, unbounded = [], []
    for seed in range(3):
        world = Turntable.made(seed, 36, step_deg=12)
        _, everything, _ = run(world, ALL)
        _, few, _ = run(world, replace(DEFAULT, max_keyframes=12))
        assert len(everything.keys) == 36 and len(few.keys) == 13  # merged after the result is made
        assert few.keys[0] == 0 and few.keys[-1] == 35
        np.testing.assert_allclose(few.T_cam_obj[0], world.T_cam_obj[0], atol=1e-3)
        np.testing.assert_array_equal(few.point_ids, everything.point_ids)
        for result, out in ((few, bounded), (everything, unbounded)):
            out.append(map_error_m(result.p_obj, world, result))
    assert np.mean(bounded) < 1.3 * np.mean(unbounded)


# --- terms, noise, failures --------------------------------------------------------------------


def test_every_term_can_be_switched_off() -> None:
    world = Turntable.made(11, 6)
    T = perturbed(world.T_cam_obj, 12, 0.06, 0.008)  # several times what the points can resolve
    solved = {}
    for off in ("", "prior", "between", "observations"):
        _, result = added_at_once(world, replace(ALL, **({off: False} if off else {})), T)
        assert result.ok and np.isfinite(result.T_cam_obj).all()
        solved[off] = result
    assert solved[""].covariance is not None and solved["between"].covariance is not None
    assert solved["prior"].covariance is None and "anchor" in solved["prior"].reason
    np.testing.assert_allclose(solved["observations"].T_cam_obj, T, atol=1e-6)
    assert not np.allclose(solved["between"].T_cam_obj, solved[""].T_cam_obj, atol=1e-6)
    assert errors(solved[""].T_cam_obj, world.T_cam_obj)[0] < 0.5 * errors(T, world.T_cam_obj)[0]


def test_the_registrations_covariance_weighs_its_pose() -> None:
    """Few noisy points and a relative pose: the surer the pose is said to be, the less it is moved."""
    world = Turntable.made(13, 2, points=30, noise=3)
    T = perturbed(world.T_cam_obj, 14)
    moved = []
    for sigma in (1e-4, 1e-2, 1.0):
        graph = ObjectGraph(ALL)
        for k in range(2):
            init = se3.transform(se3.inverse(T[k]), world.p_cam[k])
            cov = np.diag(np.repeat([sigma, sigma * 0.1], 3) ** 2) if k else None
            graph.add_keyframe(T[k], world.seen[k], world.p_cam[k], p_obj_init=init, covariance=cov)
        moved.append(se3.angle_rad(se3.inverse(T[1]) @ graph.optimise().T_cam_obj[1]))
    assert moved[0] < 1e-3 and moved[0] < moved[1] < moved[2]


def test_the_noise_of_each_observation_weighs_it() -> None:
    """Half of the bearings and ranges are ten times worse; told so, the poses come out nearer to the truth."""
    told, untold = [], []
    for seed in range(4):
        world = Turntable.made(seed, 8, noise=0)
        rng = np.random.default_rng(seed)
        factor = [np.where(rng.random(len(ids)) < 0.5, 10.0, 1.0) for ids in world.seen]
        p_cam = [measured(p, 1.0, rng) for p in world.p_cam]
        p_cam = [p + (f > 1)[:, None] * rng.normal(size=p.shape) * 0.02 for p, f in zip(p_cam, factor, strict=True)]
        for weighs, out in ((True, told), (False, untold)):
            graph = ObjectGraph(replace(ALL, huber=1e6))
            for k, T in enumerate(perturbed(world.T_cam_obj, 15, 0.01, 0.001)):
                sigma = factor[k] if weighs else np.ones(len(factor[k]))
                init = se3.transform(se3.inverse(T), p_cam[k])
                graph.add_keyframe(
                    T, world.seen[k], p_cam[k], p_obj_init=init, sigma_rad=SIGMA_RAD * sigma, sigma_m=SIGMA_M * sigma
                )
            out.append(errors(graph.optimise().T_cam_obj, world.T_cam_obj)[0])
    assert np.mean(told) < 0.7 * np.mean(untold)


def test_an_unheld_keyframe_is_left_out_and_the_rest_stays() -> None:
    world = Turntable.made(16, 4)
    config = replace(ALL, between=False)
    graph, before = added_at_once(world, config, world.T_cam_obj)
    strange = np.array([9001, 9002, 9003, 9004])
    p_cam = np.random.default_rng(0).uniform([-0.05, -0.05, 0.55], [0.05, 0.05, 0.65], (4, 3))
    graph.add_keyframe(world.T_cam_obj[0], strange, p_cam, p_obj_init=p_cam)
    failed = graph.optimise()
    assert not failed.ok and "0 points shared" in failed.reason and "keyframe 4" in failed.reason
    np.testing.assert_array_equal(failed.T_cam_obj, before.T_cam_obj)
    np.testing.assert_array_equal(failed.point_ids, before.point_ids)
    np.testing.assert_array_equal(failed.p_obj, before.p_obj)
    np.testing.assert_array_equal(failed.covariance, before.covariance)
    key = graph.add_keyframe(world.T_cam_obj[3], world.seen[3], world.p_cam[3], p_obj_init=0 * world.p_cam[3])
    after = graph.optimise()
    assert after.ok and key == 5 and after.keys.tolist() == [0, 1, 2, 3, 5]


def test_nothing_and_next_to_nothing() -> None:
    graph = ObjectGraph(DEFAULT)
    empty = graph.optimise()
    assert not empty.ok and "no keyframes" in empty.reason and empty.T_cam_obj.shape == (0, 4, 4)
    T = se3.from_rt(np.eye(3), [0, 0, 0.6])
    graph.add_keyframe(T, np.zeros(0, int), np.zeros((0, 3)), p_obj_init=np.zeros((0, 3)))
    bare = graph.optimise()
    assert bare.ok and bare.p_obj.shape == (0, 3) and np.allclose(bare.T_cam_obj[0], T)
    # Only the prior speaks, of the camera's pose: 1e-4 rad there are 0.06 mm at the object, beside its own 0.1.
    at_object = np.hypot(1e-4, 0.6e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(bare.covariance)), [1e-4] * 3 + [at_object] * 2 + [1e-4], rtol=1e-6)


def test_points_seen_once_stay_where_they_were_seen() -> None:
    world = Turntable.made(17, 1)
    _, result = added_at_once(world, DEFAULT, world.T_cam_obj)
    assert result.ok and result.error_after < 1e-9
    seen = se3.transform(se3.inverse(world.T_cam_obj[0]), world.p_cam[0])
    np.testing.assert_allclose(result.p_obj, seen[np.argsort(world.seen[0])], atol=1e-6)


def test_rows_that_are_not_finite_are_left_out() -> None:
    world = Turntable.made(18, 3)
    world.p_cam[1][2], world.p_cam[2][4, 1], world.p_cam[2][5] = np.nan, np.inf, 0
    graph = ObjectGraph(DEFAULT)
    for T, ids, p_cam in zip(world.T_cam_obj, world.seen, world.p_cam, strict=True):
        init = np.nan_to_num(se3.transform(se3.inverse(T), p_cam), posinf=0, neginf=0)
        bad = np.full((6, 6), np.nan)
        graph.add_keyframe(T, ids, p_cam, p_obj_init=init, covariance=bad)
    result = graph.optimise()
    assert result.ok and np.isfinite(result.T_cam_obj).all() and np.isfinite(result.p_obj).all()


def test_hostile_numbers_never_raise_nor_reach_the_result() -> None:
    """Wild but finite observations and starts: either solved with finite numbers, or left out with a reason."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        graph = BoundedGraph(replace(DEFAULT, between=bool(seed % 2), prior=bool(seed % 3), max_keyframes=seed % 4))
        for _ in range(6):
            ids = rng.permutation(20)[:8]
            scale = 10.0 ** rng.integers(-6, 9)
            p_cam, init = rng.normal(size=(8, 3)) * scale, rng.normal(size=(8, 3)) * 10.0 ** rng.integers(-6, 9)
            T = se3.exp(rng.normal(size=6) * 10.0 ** rng.integers(-3, 2))
            graph.add_keyframe(T, ids, p_cam, p_obj_init=init, covariance=np.zeros((6, 6)))
            result = graph.optimise()
            assert result.ok or result.reason
            assert np.isfinite(result.T_cam_obj).all() and np.isfinite(result.p_obj).all()
            assert result.covariance is None or np.isfinite(result.covariance).all()


def test_a_call_that_cannot_be_meant_is_refused() -> None:
    graph = ObjectGraph(DEFAULT)
    p = np.ones((2, 3))
    with pytest.raises(BadInput, match="keyframe points"):
        graph.add_keyframe(np.eye(4), np.array([1, 1]), p, p_obj_init=p)
    with pytest.raises(BadInput, match="keyframe T_cam_obj"):
        graph.add_keyframe(np.full((4, 4), np.nan), np.array([1, 2]), p, p_obj_init=p)
