"""Robust rigid fits on made-up points: what samples, refits and pairs of equal length make of wrong ones."""

import numpy as np
import pytest

from p2p_lib.core import robust, se3

LIMIT_M = 0.006


def moved(seed: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_a_b, points of a hand's size, and where it takes them."""
    rng = np.random.default_rng(seed)
    T, p_b = se3.exp(rng.normal(size=6) * np.repeat([0.5, 0.1], 3)), rng.uniform(-0.06, 0.06, (n, 3))
    return T, p_b, se3.transform(T, p_b)


def off_m(T: np.ndarray, truth: np.ndarray, p_b: np.ndarray) -> float:
    """By how much the worst of the points is misplaced."""
    return float(np.linalg.norm(se3.transform(T, p_b) - se3.transform(truth, p_b), axis=1).max())


# --- samples ------------------------------------------------------------------------------------


def test_of_samples_with_equally_many_inliers_the_tightest_wins() -> None:
    """All points are inliers of all samples; the one chosen fits as the best of a hundred, not as any of them."""
    rank = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        _, p_b, p_a = moved(seed, 30)
        p_a = p_a + rng.normal(0, 0.0005, p_a.shape)
        found = robust.ransac(p_b, p_a, np.full(30, 0.05), 3, 100, rng)
        sample = np.array([rng.permutation(30)[:3] for _ in range(100)])
        others = robust.residual_m(robust.fit_rigid(p_b[sample], p_a[sample]), p_b, p_a).mean(1)
        rank.append((others < robust.residual_m(found, p_b, p_a).mean()).mean())
    assert np.mean(rank) < 0.05


def test_samples_that_no_rigid_motion_fits_are_not_tried() -> None:
    """Each fits a few of twice as large a cloud, those in its middle: a consensus all the same, by chance."""
    _, p_b, p_a = moved(0, 300)
    limit = np.full(300, LIMIT_M)
    assert robust.ransac(p_b, 2 * p_a, limit, 3, 50, np.random.default_rng(0)) is None
    assert robust.ransac(p_b, p_a, limit, 3, 50, np.random.default_rng(0)) is not None


def test_a_refit_lets_go_of_what_agreed_with_the_start_alone() -> None:
    """The start lies between 30 right points and 8 that are 9 mm off: it agrees with both, the truth does not."""
    T, p_b, p_a = moved(1, 38)
    p_a[30:] += [0.009, 0, 0]
    start = T.copy()
    start[0, 3] += 0.005
    fit = robust.refit(start, p_b, p_a, np.full(38, LIMIT_M), np.ones(38), 5, np.ones(38, bool))
    assert (robust.residual_m(start, p_b, p_a) < LIMIT_M).all()
    assert fit.inliers[:30].all() and not fit.inliers[30:].any() and off_m(fit.T_a_b, T, p_b) < 1e-9


# --- pairs of equal length ----------------------------------------------------------------------


def test_pairs_that_most_others_go_together_with_are_tried_first() -> None:
    """Twelve right pairs come after two hundred wrong ones, of which many are as far apart by chance."""
    rng = np.random.default_rng(2)
    T, p_b, p_a = moved(2, 212)
    p_a[:200] = rng.uniform(-0.06, 0.06, (200, 3))
    found, agrees = robust.consensus(p_b, p_a, 0.004)
    assert agrees[200:].all() and off_m(found, T, p_b[200:]) < 0.004


def test_pairs_that_lie_close_say_nothing() -> None:
    """Thirty matches within a centimetre, on both sides: a motion of its own, whose turn nothing determines."""
    rng = np.random.default_rng(3)
    T, p_b, p_a = moved(3, 42)
    p_b[:30] = rng.uniform(-0.002, 0.002, (30, 3))
    p_a[:30] = 0.05 + rng.uniform(-0.002, 0.002, (30, 3))
    found, agrees = robust.consensus(p_b, p_a, 0.008)
    assert agrees[30:].all() and off_m(found, T, p_b[30:]) < 1e-6


@pytest.mark.parametrize("once", [True, False])
def test_several_pairs_of_one_source_count_once(once) -> None:
    """Eight corners move one way; four others, each matched three times, another."""
    (T, p_b, p_a), (other, q_b, q_a) = moved(4, 8), moved(5, 4)
    p_b, p_a = np.concatenate([p_b, np.repeat(q_b, 3, 0)]), np.concatenate([p_a, np.repeat(q_a, 3, 0)])
    corner = np.concatenate([np.arange(8), 8 + np.repeat(np.arange(4), 3)])
    found, agrees = robust.consensus(p_b, p_a, 0.008, corner if once else None)
    assert off_m(found, T if once else other, p_b) < 0.004
    assert agrees.sum() == (8 if once else 12)
