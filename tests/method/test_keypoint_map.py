"""The keypoint map: the appendix's promotion rule step by step, retirement, and rows that stay together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core.config import KeypointMapConfig
from p2p_lib.method.keypoint_map import _HISTORY, KeypointMap

CFG = KeypointMapConfig()
HERE = np.array([0.1, -0.05, 0.02])
NAN = np.full(3, np.nan)


def pending(n: int = 1, cfg: KeypointMapConfig = CFG, at: np.ndarray = HERE) -> KeypointMap:
    points = KeypointMap(cfg)
    points.add(np.arange(n) + 10, np.tile(at, (n, 1)))
    return points


def see(points: KeypointMap, at: np.ndarray = HERE, *, uncertainty: float = 0.1, stable: bool = True) -> list[int]:
    """All points are observed at one place; the ids promoted by it."""
    n = len(points)
    return points.observe(np.tile(at, (n, 1)), np.full(n, uncertainty), stable).tolist()


# --- promotion, rule by rule -------------------------------------------------------------------


def test_the_third_verified_frame_in_a_row_promotes():
    points = pending()
    assert [see(points) for _ in range(5)] == [[], [], [10], [], []]
    assert points.promoted.tolist() == [True]


@pytest.mark.parametrize("streak", [1, 2, 5])
def test_the_streak_is_as_long_as_configured(streak):
    points = pending(cfg=replace(CFG, streak=streak))
    assert [bool(see(points)) for _ in range(6)] == [k == streak for k in range(1, 7)]


MISSES = {
    "not seen": {"at": NAN},
    "uncertain": {"uncertainty": 0.3},  # "falls below a strict threshold": 0.3 itself does not
    "very uncertain": {"uncertainty": 1.0},
    "uncertainty unknown": {"uncertainty": np.nan},
    "pose unstable": {"stable": False},
}
EVERY_MISS = pytest.mark.parametrize("miss", MISSES.values(), ids=MISSES.keys())


@EVERY_MISS
@pytest.mark.parametrize("after", [0, 1, 2])
def test_a_miss_starts_the_streak_anew(miss, after):
    points = pending()
    for _ in range(after):
        assert see(points) == []
    assert see(points, **miss) == []
    assert [see(points) for _ in range(3)] == [[], [], [10]]


@EVERY_MISS
def test_what_never_passes_is_never_promoted(miss):
    points = pending()
    assert [see(points, **miss) for _ in range(CFG.pending_ttl)] == [[]] * CFG.pending_ttl
    assert len(points) == 1 and not points.promoted.any()


def test_just_below_the_uncertainty_threshold_counts():
    points = pending()
    assert [see(points, uncertainty=0.2999) for _ in range(3)] == [[], [], [10]]


def test_only_verified_frames_are_observations():
    points = pending()
    for _ in range(6):
        see(points, HERE + 0.5, stable=False)
    assert [see(points) for _ in range(3)] == [[], [], [10]]
    np.testing.assert_allclose(points.p_obj[0], HERE)


@pytest.mark.parametrize(("far_m", "promoted"), [(0.0079, True), (0.0081, False)])
def test_spread_is_the_median_distance_from_the_median(far_m, promoted):
    """Four observations at 0, 0, +x, +x along one axis: the median is x/2, the median deviation x/2."""
    points = pending(at=np.zeros(3))
    x = np.array([2 * far_m, 0, 0])
    assert see(points, np.zeros(3)) == [] and see(points, x) == []
    assert see(points, x) == ([10] if promoted else [])


def test_one_outlier_among_the_observations_does_no_harm():
    points = pending()
    see(points, HERE + np.array([0, 0, 0.2]))
    assert see(points) == []
    assert see(points) == [10]
    np.testing.assert_allclose(points.p_obj[0], HERE)


def test_a_scattered_point_is_promoted_when_it_has_settled():
    points = pending()
    scattered = HERE + 0.05 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    assert [see(points, p) for p in scattered] == [[]] * 5
    promoted = [see(points) for _ in range(8)]
    # With its first observation HERE, one of six was; most must lie within 8 mm: from the fifth more on.
    assert promoted.index([10]) == 4
    np.testing.assert_allclose(points.p_obj[0], HERE)


def test_the_keypoint_is_the_median_of_its_observations():
    points, rng = pending(), np.random.default_rng(0)
    seen = HERE + rng.normal(0, 0.002, (3, 3))
    assert [see(points, p) for p in seen][-1] == [10]
    np.testing.assert_allclose(points.p_obj[0], np.median([HERE, *seen], 0))


def test_a_pending_point_stays_where_it_was_sampled():
    points = pending()
    see(points, HERE + 0.003)
    np.testing.assert_array_equal(points.p_obj[0], HERE)


def test_promoted_points_do_not_move_with_what_is_observed():
    points = KeypointMap(CFG)
    points.add(np.array([3]), HERE[None], promoted=True)
    assert [see(points, HERE + 1) for _ in range(5)] == [[]] * 5
    np.testing.assert_array_equal(points.p_obj[0], HERE)


def test_the_oldest_observations_give_way():
    """Far more observations than are kept: only the newest decide."""
    points = pending(cfg=replace(CFG, streak=3 * _HISTORY - 1))
    drift = HERE + np.arange(1, 3 * _HISTORY)[:, None] * [1e-4, 0, 0]
    promoted = [see(points, p) for p in drift]
    assert promoted[:-1] == [[]] * (len(drift) - 1) and promoted[-1] == [10]
    np.testing.assert_allclose(points.p_obj[0], np.median(drift[-_HISTORY:], 0))


# --- promotion against a slow account of every point --------------------------------------------


class SlowPoint:
    def __init__(self, p_obj: np.ndarray):
        self.seen, self.streak, self.done, self.p_obj = [p_obj], 0, False, p_obj

    def observe(self, p_obj: np.ndarray, uncertainty: float, stable: bool, cfg: KeypointMapConfig) -> bool:
        if self.done:
            return False
        if not (stable and not np.isnan(p_obj[0]) and uncertainty < cfg.max_uncertainty):
            self.streak = 0
            return False
        self.streak += 1
        self.seen.append(p_obj)
        if self.streak < cfg.streak:
            return False
        kept = np.array(self.seen[-_HISTORY:])
        centre = np.median(kept, 0)
        self.done = float(np.median([np.linalg.norm(p - centre) for p in kept])) < cfg.max_scatter_m
        self.p_obj = centre if self.done else self.p_obj
        return self.done


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    streak=st.integers(1, 5),
    noise_m=st.sampled_from([0.0, 0.003, 0.005, 0.02]),
    hit=st.sampled_from([0.5, 0.8, 0.97]),
)
def test_promotion_is_that_of_a_slow_account(seed, streak, noise_m, hit):
    cfg = replace(CFG, streak=streak)
    rng = np.random.default_rng(seed)
    points, slow = KeypointMap(cfg), {}
    for _ in range(40):
        if rng.random() < 0.1:  # more points come later
            new = np.arange(3) + 7 * len(slow)
            at = rng.normal(0, 0.1, (3, 3))
            points.add(new, at)
            slow |= {int(i): SlowPoint(p) for i, p in zip(new, at)}
        n, stable = len(points), bool(rng.random() < hit)
        seen = points.p_obj + rng.normal(0, noise_m, (n, 3))
        seen[rng.random(n) > hit] = np.nan
        uncertainty = rng.uniform(0, 0.32, n)
        got = points.observe(seen, uncertainty, stable)
        want = [i for k, i in enumerate(slow) if slow[i].observe(seen[k], uncertainty[k], stable, cfg)]
        assert got.tolist() == want
        assert points.promoted.tolist() == [p.done for p in slow.values()]
        np.testing.assert_allclose(points.p_obj, np.array([p.p_obj for p in slow.values()]).reshape(-1, 3), atol=1e-15)


# --- retirement --------------------------------------------------------------------------------


def test_pending_points_have_their_time():
    points = pending(3)
    for _ in range(CFG.pending_ttl):
        see(points, NAN)
        assert points.retire()[0].tolist() == []
    see(points, NAN)
    assert points.retire()[0].tolist() == [10, 11, 12]
    assert len(points) == 0


def test_keypoints_have_no_such_limit():
    points = KeypointMap(CFG)
    points.add(np.array([1, 2]), np.zeros((2, 3)), promoted=True)
    for _ in range(5 * CFG.pending_ttl):
        see(points, NAN)
    assert points.retire()[0].tolist() == [] and len(points) == 2


def keypoints(n: int, cfg: KeypointMapConfig = CFG) -> KeypointMap:
    points = KeypointMap(cfg)
    points.add(np.arange(n), np.arange(3.0 * n).reshape(n, 3), promoted=True)
    return points


@pytest.mark.parametrize(
    ("agreed", "disagreed", "goes"),
    [(0, 9, False), (0, 10, True), (2, 8, True), (3, 7, False), (29, 71, True), (31, 69, False), (50, 0, False)],
)
def test_keypoints_that_mostly_disagree_go(agreed, disagreed, goes):
    points = keypoints(2)
    for k in range(agreed + disagreed):
        points.count(np.array([True, True]), np.array([k < agreed, True]))
    assert points.retire()[0].tolist() == ([0] if goes else [])


def test_without_a_bound_every_keypoint_is_kept():
    points = keypoints(400, replace(CFG, max_points=0))
    for _ in range(20):
        points.count(np.ones(400, bool), np.zeros(400, bool))
    assert not len(points.retire()[0])


def test_what_took_no_part_is_not_counted():
    points = keypoints(2)
    for _ in range(40):
        points.count(np.array([True, False]), np.array([True, False]))
    assert points.retire()[0].tolist() == []


def test_pending_points_do_not_go_for_disagreeing():
    points = pending()
    for _ in range(20):
        points.count(np.array([True]), np.array([False]))
    assert points.retire()[0].tolist() == []


def live(points: KeypointMap, shares: np.ndarray, frames: int = 40) -> None:
    """Frames pass; each point agrees in a share of them."""
    n = len(points)
    for k in range(frames):
        points.observe(np.full((n, 3), np.nan), np.ones(n), True)
        used = points.promoted & ((k + 1) * shares // 1 > k * shares // 1)
        points.count(used, used)


def test_beyond_the_cap_the_least_seen_go_first():
    points = keypoints(14, replace(CFG, max_points=10))
    shares = np.array([0.9, 0.1, 0.5, 0.8, 0.3, 0.7, 0.05, 0.6, 1.0, 0.2, 0.95, 0.4, 0.85, 0.75])
    live(points, shares)
    assert points.retire()[0].tolist() == np.sort(np.argsort(shares)[:4]).tolist()
    assert points.retire()[0].tolist() == []
    assert len(points) == 10


def test_below_the_cap_nothing_goes():
    assert keypoints(14, replace(CFG, max_points=16)).retire()[0].tolist() == []


def test_among_equals_the_oldest_go():
    points = keypoints(13, replace(CFG, max_points=10))
    assert points.retire()[0].tolist() == [0, 1, 2]


def test_a_full_map_still_learns():
    """The object turns: new points must become keypoints although the map is full of well-proven old ones."""
    cfg = replace(CFG, max_points=20)
    points = keypoints(20, cfg)
    live(points, np.full(20, 0.9), 100)
    points.add(np.arange(100, 110), np.tile(HERE, (10, 1)))
    assert points.retire()[0].tolist() == []  # the pending have their time
    for _ in range(3):
        promoted = see(points)
    assert promoted == list(range(100, 110))
    assert points.retire()[0].tolist() == list(range(10))
    assert points.promoted.all() and set(range(100, 110)) <= set(points.keys.tolist())


def test_memory_stays_bounded():
    """New points at every frame for a long time: never more than the cap and what may be pending."""
    cfg, rng = replace(CFG, max_points=50), np.random.default_rng(0)
    points, next_id, most = KeypointMap(cfg), 0, 0
    for k in range(400):
        points.add(np.arange(next_id, next_id + 5), rng.normal(0, 0.1, (5, 3)))
        next_id += 5
        seen = np.where(rng.random((len(points), 1)) < 0.8, points.p_obj, np.nan)
        points.observe(seen, np.zeros(len(points)), k % 7 > 0)
        points.count(points.promoted, rng.random(len(points)) < 0.9)
        points.retire()[0]
        assert points.promoted.sum() <= 50
        most = max(most, len(points))
    assert most <= 50 + 5 * (cfg.pending_ttl + 1)


# --- moving, and rows that belong together -----------------------------------------------------


def test_move_sets_the_keypoints_it_knows():
    points = keypoints(5)
    before = points.p_obj.copy()
    points.move(np.array([3, 99, 0, -1, 4]), np.arange(15.0).reshape(5, 3) + 100)
    moved = [[106, 107, 108], before[1], before[2], [100, 101, 102], [112, 113, 114]]
    np.testing.assert_array_equal(points.p_obj, moved)


def test_move_does_not_need_sorted_keys():
    points = KeypointMap(CFG)
    points.add(np.array([2, 4, 7, 9]), np.zeros((4, 3)))
    points.move(np.array([9, 7, 5]), np.array([[9.0, 0, 0], [7, 0, 0], [5, 0, 0]]))
    assert points.p_obj[:, 0].tolist() == [0, 0, 7, 9]


def test_ids_of_the_tracker_are_assigned_by_key():
    """Those of points that are gone again come back, for the tracker to drop."""
    points = KeypointMap(CFG)
    points.add(np.array([2, 4, 7]), np.zeros((3, 3)))
    assert points.ids.tolist() == [-1, -1, -1]
    unused = points.assign(np.array([7, 3, 2]), np.array([30, 31, 32]))
    assert unused.tolist() == [31] and points.ids.tolist() == [32, -1, 30]
    points.age[:] = CFG.pending_ttl + 1
    keys, ids = points.retire()
    assert keys.tolist() == [2, 4, 7] and ids.tolist() == [32, 30]


@pytest.mark.parametrize("ids", [[], [1, 2]])
def test_move_in_an_empty_map(ids):
    points = KeypointMap(CFG)
    points.move(np.array(ids, np.int64), np.zeros((len(ids), 3)))
    assert len(points) == 0


def test_nothing_known_nothing_moved():
    points = keypoints(3)
    before = points.p_obj.copy()
    points.move(np.array([50, 60]), np.ones((2, 3)))
    points.move(np.zeros(0, np.int64), np.zeros((0, 3)))
    np.testing.assert_array_equal(points.p_obj, before)


def test_an_empty_map_is_no_trouble():
    points = KeypointMap(CFG)
    assert points.observe(np.zeros((0, 3)), np.zeros(0), True).tolist() == []
    points.count(np.zeros(0, bool), np.zeros(0, bool))
    points.add(np.zeros(0, np.int64), np.zeros((0, 3)))
    assert points.retire()[0].tolist() == [] and len(points) == 0


def test_rows_stay_together_when_points_go():
    """Whatever goes from between, the rest is promoted, moved and retired as if it had been alone."""
    rng = np.random.default_rng(1)
    together = KeypointMap(CFG)
    together.add(np.arange(6), np.tile(HERE, (6, 1)) + np.arange(6)[:, None])
    alone = {}
    for i in (1, 4):
        alone[i] = KeypointMap(CFG)
        alone[i].add(np.array([i]), HERE[None] + i)
    for i in (0, 2, 3, 5):  # these are never seen and go when their time is up
        together.age[i] = CFG.pending_ttl - 2
    for k in range(5):
        seen = together.p_obj + rng.normal(0, 1e-3, (len(together), 3))
        seen[~np.isin(together.keys, (1, 4))] = np.nan
        promoted = together.observe(seen, np.full(len(together), 0.1), True).tolist()
        together.count(together.promoted, together.promoted)
        for i, single in alone.items():
            at = int(np.flatnonzero(together.keys == i)[0])
            assert single.observe(seen[[at]], np.array([0.1]), True).tolist() == [i] * (i in promoted)
            single.count(single.promoted, single.promoted)
        gone = together.retire()[0]
        assert gone.tolist() == ([0, 2, 3, 5] if k == 2 else [])
    assert together.keys.tolist() == [1, 4]
    for name, value in vars(together).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, np.concatenate([getattr(alone[i], name) for i in (1, 4)]), name)


def test_every_point_keeps_the_confidence_it_came_with():
    points = KeypointMap(CFG)
    points.add(np.array([7, 8]), np.zeros((2, 3)), promoted=True)
    points.add(np.array([9]), np.ones((1, 3)), confidence=0.25)
    assert points.confidence.tolist() == [1.0, 1.0, 0.25]
    for _ in range(CFG.pending_ttl + 1):
        points.observe(np.full((3, 3), np.nan), np.ones(3), stable=True)
    assert points.retire()[0].tolist() == [9]
    assert points.confidence.tolist() == [1.0, 1.0]


# --- a point has to move with the object -------------------------------------------------------


def turned(points: KeypointMap, in_object: np.ndarray, in_camera: np.ndarray, noise_m: np.ndarray) -> list[int]:
    """Each point's promotions while it is observed, frame by frame, with the same noise in both frames."""
    promoted = []
    for p_obj, p_cam, noise in zip(in_object, in_camera, noise_m):
        promoted += points.observe(p_obj + noise, np.zeros(len(p_obj)), True, p_cam + noise).tolist()
    return promoted


def test_a_reflection_is_no_keypoint_and_a_print_is():
    """On a mug of 4 cm that turns by a degree a frame before a noisy camera."""
    rng, frames = np.random.default_rng(0), np.radians(np.arange(1, 21.0))
    still = np.array([0.0, 0.0, -0.04])
    moves = 0.04 * np.stack([np.sin(frames), 0 * frames, -np.cos(frames)], -1)
    back = 0.04 * np.stack([-np.sin(frames), 0 * frames, -np.cos(frames)], -1)
    points = KeypointMap(CFG)
    points.add(np.array([1, 2]), np.stack([still, still]), p_cam=np.stack([still, still]))
    in_object = np.stack([np.broadcast_to(still, (20, 3)), back], 1)
    in_camera = np.stack([moves, np.broadcast_to(still, (20, 3))], 1)
    noise_m = rng.normal(0, 0.0003, (20, 2, 3))
    assert turned(points, in_object, in_camera, noise_m) == [1]
    # The appendix asks for no more than to be tight.
    plain = pending(2, at=still)
    assert 11 in [key for p, n in zip(in_object, noise_m) for key in plain.observe(p + n, np.zeros(2), True).tolist()]


def test_where_it_was_at_its_keyframe_counts():
    points = KeypointMap(replace(CFG, streak=1))
    points.add(np.array([1]), HERE[None], p_cam=HERE[None])
    assert turned(points, HERE[None, None], HERE[None, None] + 0.01, np.zeros((1, 1, 3))) == [1]


def test_where_nothing_moves_nothing_is_promoted():
    points = KeypointMap(CFG)
    points.add(np.array([1]), HERE[None], p_cam=HERE[None])
    assert turned(points, np.full((20, 1, 3), HERE), np.full((20, 1, 3), HERE), np.zeros((20, 1, 3))) == []
