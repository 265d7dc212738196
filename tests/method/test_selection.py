"""Which hypothesis is taken, on distances made up for it."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.extended.motion import MOTION_DEG, MOTION_M, motion_weight
from p2p_lib.method.registration import Hypothesis
from p2p_lib.method.selection import select

DEFAULT, PAPER = preset("default").selection, preset("paper").selection


def made(support: int, n: int = 100) -> Hypothesis:
    return Hypothesis(se3.exp(np.full(6, support * 1e-3)), np.arange(n) < support, np.full(n, 0.001), str(support))


def test_the_paper_takes_the_least_mean_distance():
    row, reason = select([made(80), made(6), made(12)], np.array([0.0020, 0.00199, np.nan])[:, None], PAPER)
    assert row == 1 and "surface" in reason


@pytest.mark.parametrize(("sigmas", "gap", "wins"), [(2.0, 2.5, True), (2.0, 1.5, False), (4.0, 2.5, False)])
def test_ours_goes_by_the_surface_only_beyond_chance(sigmas, gap, wins):
    """Points whose preference is even but for a shift of the mean: the shift counts in its standard errors."""
    noise = np.random.default_rng(0).normal(0, 1, 400)
    noise = (noise - noise.mean()) / noise.std() * 2.5e-3
    nearer = noise + gap * 2.5e-3 / np.sqrt(400)
    config = replace(DEFAULT, surface_sigmas=sigmas)
    row, reason = select([made(80), made(12)], np.stack([0.003 + nearer, np.full(400, 0.003)]), config)
    assert row == int(wins) and ("nearest" in reason) == wins


@pytest.mark.parametrize(
    ("support", "weight", "gap", "wins"),
    [(8, 1, 4, False), (8, 1, 5, True), (40, 1, 3, True), (40, 0.1, 3, False), (80, 1, 2, False)],
    ids=["few against it", "few and surer", "half as many", "half as many, off its motion", "as many, within chance"],
)
def test_the_more_points_agree_with_it_too_the_less_sure_the_surface_has_to_be(support, weight, gap, wins):
    """A glossy mug's mirror image holds most of the points, and the mug half as many; a stray pose holds a few."""
    noise = np.random.default_rng(0).normal(0, 1, 400)
    nearer = ((noise - noise.mean()) / noise.std() + gap / np.sqrt(400)) * 2.5e-3
    distance_m = np.stack([0.003 + nearer, np.full(400, 0.003)])
    both = [made(80), replace(made(support), residual_m=np.full(100, 0.002))]
    assert select(both, distance_m, DEFAULT, np.array([1, weight]))[0] == int(wins)


@pytest.mark.parametrize(("gap_m", "wins"), [(1.9e-4, False), (2.1e-4, True)])
def test_ours_needs_a_margin_too(gap_m, wins):
    distance_m = np.tile([[0.002], [0.002 - gap_m]], 50)  # certain, but is it enough?
    assert select([made(80), made(12)], distance_m, DEFAULT)[0] == int(wins)


@pytest.mark.parametrize(("nearest_m", "wins"), [(0.003, True), (0.006, False)])
def test_a_surface_that_no_pose_fits_does_not_choose(nearest_m, wins):
    """It is bent, or depth and colour are not of one moment: many points that agree are more than that."""
    distance_m = np.tile([[nearest_m + 0.002], [nearest_m]], 50)
    assert select([made(80), made(12)], distance_m, DEFAULT)[0] == int(wins)
    assert select([made(80), made(12)], distance_m, PAPER)[0] == 1


@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])
def test_nothing_and_one_need_no_surface(config):
    row, reason = select([], None, config)
    assert row is None and "too few" in reason
    assert select([made(5)], None, config) == (0, "the only hypothesis")


def test_distances_that_are_not_finite_fall_back_on_inliers():
    assert select([made(10), made(20)], np.full((2, 3), np.nan), DEFAULT)[0] == 1
    assert select([made(10), made(20)], np.array([[np.nan], [0.002]]), PAPER)[0] == 1
    for config in (DEFAULT, PAPER):
        assert select([made(10), made(20)], np.array([[0.002], [np.nan]]), config)[0] == 0


def test_of_equal_support_the_tighter_fit_is_taken():
    tight = replace(made(12), residual_m=np.full(100, 0.0002))
    assert select([made(12), tight], None, DEFAULT)[0] == 1


def test_support_counts_less_for_what_is_off_the_motion():
    """1 on a prior, 1/2 at that turn or move from the nearest, and so a jump loses to a third as many."""
    turn = [se3.exp(np.array([np.radians(deg), 0, 0, 0, 0, 0])) for deg in (0, MOTION_DEG, 20)]
    move = se3.exp(np.array([0, 0, 0, MOTION_M, 0, 0]))
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.05, 0.7]))
    poses = [T @ turn[0], T @ turn[1], T @ turn[2], T @ move, T @ turn[2] @ turn[1]]
    priors = [T, T @ turn[2]]
    np.testing.assert_allclose(motion_weight(poses, priors), [1, 0.5, 1, 0.5, 0.5], atol=1e-6)
    assert motion_weight(poses, []).tolist() == [1] * 5
    same = np.zeros((2, 50))
    assert select([made(30), made(12)], same, DEFAULT)[0] == 0
    assert select([made(30), made(12)], same, DEFAULT, np.array([0.1, 1.0]))[0] == 1
