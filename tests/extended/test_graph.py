"""Merging of keyframes: exact poses, and noise against many trials."""

import numpy as np
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.extended.graph import merge_keyframes, misfit, remove, seen_from
from p2p_lib.method.factor_graph import Keyframe, Link


def cameras(angles_deg: list[float], distance_m: float = 0.6) -> np.ndarray:
    """T_obj_cam of cameras on a circle about the object, looking at it."""
    R = Rotation.from_rotvec(np.radians(angles_deg)[:, None] * [0, 1, 0]).as_matrix()
    return se3.inverse(se3.from_rt(R, np.tile([0.01, 0, distance_m], (len(angles_deg), 1))))


def keyframe(T_obj_cam: np.ndarray, ids, p_cam: np.ndarray, link: Link | None = None) -> Keyframe:
    sigma = np.tile([0.0015, 0.003], (len(ids), 1))
    return Keyframe(T_obj_cam, np.asarray(ids), p_cam, sigma, link)


def chain(T: np.ndarray, covariances: np.ndarray) -> dict[int, Keyframe]:
    empty = np.zeros((0, 3))
    links = [Link(k - 1, se3.inverse(T[k - 1]) @ T[k], covariances[k]) if k else None for k in range(len(T))]
    return {k: keyframe(T[k], [], empty, link) for k, link in enumerate(links)}


def test_removing_joins_the_links() -> None:
    T = cameras([0, 20, 50, 90])
    T[2] = T[2] @ se3.exp(np.array([0.7, 0, 0.4, 0.1, 0, 0]))  # off the circle: steps that do not commute
    root = np.random.default_rng(0).normal(size=(4, 6, 6))
    covariances = 1e-5 * root @ np.swapaxes(root, 1, 2)
    keyframes = chain(T, covariances)
    remove(keyframes, 1)
    assert sorted(keyframes) == [0, 2, 3] and keyframes[3].link.previous == 2
    joined = keyframes[2].link
    assert joined.previous == 0
    np.testing.assert_allclose(joined.T_previous_this, se3.inverse(T[0]) @ T[2], atol=1e-12)
    # The tangent of a chain of two noisy steps, drawn many times.
    rng = np.random.default_rng(1)
    first = se3.exp(rng.multivariate_normal(np.zeros(6), covariances[1], 20000))
    second = se3.exp(rng.multivariate_normal(np.zeros(6), covariances[2], 20000))
    end = se3.inverse(T[0]) @ T[1] @ first @ se3.inverse(T[1]) @ T[2] @ second
    sampled = np.cov(se3.log(se3.inverse(joined.T_previous_this) @ end).T)
    share = np.linalg.eigvals(np.linalg.solve(joined.covariance, sampled)).real
    assert 0.9 < share.min() and share.max() < 1.1


def test_observations_seen_from_elsewhere_keep_place_and_noise() -> None:
    T = cameras([0, 60])
    p_obj = np.array([[0.03, 0.02, -0.01]])
    exact = se3.transform(se3.inverse(T[0]), p_obj)
    moved, sigma = seen_from(keyframe(T[0], [7], exact), T[1])
    np.testing.assert_allclose(moved, se3.transform(se3.inverse(T[1]), p_obj), atol=1e-12)
    range_m = np.linalg.norm(exact)
    ray = exact / range_m
    rng = np.random.default_rng(2)
    basis = np.linalg.svd(ray)[2]  # the ray, then two axes across it
    scale = np.array([0.003, 0.0015 * range_m, 0.0015 * range_m])
    drawn = exact + (rng.normal(size=(20000, 3)) * scale) @ basis
    elsewhere = se3.transform(se3.inverse(T[1]) @ T[0], drawn)
    ranges = np.linalg.norm(elsewhere, axis=1)
    assert abs(np.std(ranges) / sigma[0, 1] - 1) < 0.05
    mean_ray = moved[0] / np.linalg.norm(moved[0])
    turn = np.linalg.norm(np.cross(elsewhere / ranges[:, None], mean_ray), axis=1)
    # Bearing noise is two axes with one number: it must cover their root mean square, not exceed the larger.
    assert np.sqrt(np.mean(turn**2) / 2) < sigma[0, 0] < 0.0031 / range_m * 1.05


def test_merging_averages_what_both_saw_and_keeps_what_one_saw() -> None:
    T, rng = cameras([0, 3, 80, 90]), np.random.default_rng(3)
    p_obj = rng.uniform(-0.05, 0.05, (40, 3))
    exact = se3.transform(se3.inverse(T), p_obj[None])
    noisy = exact + 0.001 * rng.normal(size=exact.shape)
    seen = [np.arange(0, 30), np.arange(10, 40), np.arange(40), np.arange(40)]
    keyframes = {k: keyframe(T[k], seen[k], noisy[k][seen[k]]) for k in range(4)}
    merge_keyframes(keyframes, 3)
    assert sorted(keyframes) == [0, 2, 3]  # 1 looks like 0, and the first stays
    host = keyframes[0]
    np.testing.assert_array_equal(host.ids, np.arange(40))
    assert host.factors is None
    np.testing.assert_allclose(host.p_cam[:10], noisy[0][:10], atol=1e-12)
    alone, both = np.linalg.norm(noisy[0] - exact[0], axis=1), np.linalg.norm(host.p_cam - exact[0], axis=1)
    shared = np.arange(10, 30)
    assert np.mean(both[shared]) < 0.85 * np.mean(alone[shared])
    np.testing.assert_allclose(host.sigma[:10], np.tile([0.0015, 0.003], (10, 1)), rtol=1e-9)
    one, two = 0.003, 0.003 / np.sqrt(2)
    assert (two < host.sigma[shared, 1]).all() and (host.sigma[shared, 1] < one).all()
    assert (host.sigma[30:, 1] > one).all()  # moved, and nothing to average with


def test_no_bound_and_nothing_to_merge() -> None:
    T = cameras([0, 10, 20])
    keyframes = chain(T, np.tile(np.eye(6), (3, 1, 1)))
    for most in (0, 3, 5):
        merge_keyframes(keyframes, most)
        assert sorted(keyframes) == [0, 1, 2]
    merge_keyframes(keyframes, 1)
    assert sorted(keyframes) == [0, 2]  # the first and the newest always stay


def test_misfit_counts_standard_deviations() -> None:
    p, sigma = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0.5]]), np.tile([0.002, 0.004], (3, 1))
    seen = np.array([[0, 0, 0.508], [0.5 * np.sin(0.006), 0, 0.5 * np.cos(0.006)], [0, 0, 0.5]])
    np.testing.assert_allclose(misfit(p, seen, sigma), [2, 3, 0], atol=1e-9)


def test_what_a_nearer_camera_sees_has_the_same_noise_across_and_a_wider_angle() -> None:
    """Along one ray: bearing noise is across noise over the new distance."""
    far, near = cameras([0], distance_m=0.8)[0], cameras([0], distance_m=0.4)[0]
    p_cam = np.array([[0.0, 0.0, 0.8]])
    moved, sigma = seen_from(keyframe(far, [3], p_cam), near)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.4, atol=1e-9)
    np.testing.assert_allclose(sigma, [[2 * 0.0015, 0.003]], rtol=1e-6)
