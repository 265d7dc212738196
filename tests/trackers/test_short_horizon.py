"""SH(n): whatever tracker it is put before, points invisible for n frames in a row never come back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core.backends import make_tracker
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.short_horizon import ShortHorizon


class Script:
    """A tracker whose visibility is written down: rows of ``plan`` are frames, columns are ids."""

    name, latency_frames = "script", 0

    def __init__(self, plan):
        self.plan, self.ids, self.t, self.rejected, self.suggested = np.asarray(plan, bool), [], 0, [], []

    def start(self, frame, camera=None):
        self.ids, self.t = [], 0

    def add(self, uv_px):
        new = len(self.ids) + np.arange(len(uv_px))
        self.ids += list(new)
        return new

    def track(self, frame, search=None, urgent=False):
        self.t += 1
        ids = np.array(self.ids, np.int64)
        return Tracks(ids, np.ones((len(ids), 2)) * ids[:, None], self.plan[self.t, ids], np.full(len(ids), 0.5))

    def drop(self, ids):
        assert set(ids) <= set(self.ids), "dropped twice"
        self.ids = [i for i in self.ids if i not in set(ids)]

    def reject(self, ids):
        self.rejected += list(ids)

    def suggest(self, ids, uv_px):
        self.suggested += list(zip(ids, uv_px[:, 0], strict=True))


FRAME = Frame(0, 0.0, np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32))


def played(plan, n):
    """Visibility (T, N) that SH(n) reports of a script; frame 0 is where the points are added."""
    inner = Script(plan)
    tracker = ShortHorizon(inner, n)
    tracker.start(FRAME)
    ids = tracker.add(np.zeros((inner.plan.shape[1], 2)))
    rows = [tracker.track(FRAME).select(ids).visible for _ in inner.plan[1:]]
    return np.array([np.ones(len(ids), bool), *rows]), inner


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_visible_is_what_the_tracker_says_until_n_hidden_frames(n, seed):
    plan = np.random.default_rng(seed).random((30, 5)) < 0.6
    plan[0] = True
    got, inner = played(plan, n)
    for k, column in enumerate(plan.T):
        hidden, forgotten = 0, False
        for t in range(1, len(column)):
            assert got[t, k] == (column[t] and not forgotten)
            hidden = 0 if column[t] else hidden + 1
            forgotten |= hidden >= n
        assert (k in inner.ids) == (not forgotten)


def test_rows_stay_until_dropped_and_calls_reach_the_living():
    plan = np.ones((10, 3), bool)
    plan[1:, 1] = False
    inner = Script(plan)
    tracker = ShortHorizon(inner, 2)
    tracker.start(FRAME)
    tracker.add(np.zeros((3, 2)))
    for _ in range(3):
        tracks = tracker.track(FRAME)
    assert tracks.ids.tolist() == [0, 1, 2] and tracks.visible.tolist() == [True, False, True]
    assert np.isnan(tracks.uv_px[1]).all() and tracks.uncertainty.tolist() == [0.5, 1, 0.5]
    tracker.reject(np.array([0, 1]))
    tracker.suggest(np.array([1, 2]), np.array([[7.0, 7], [8, 8]]))
    assert inner.rejected == [0] and inner.suggested == [(2, 8.0)]
    tracker.drop(np.array([1, 2]))
    assert tracker.track(FRAME).ids.tolist() == [0] and inner.ids == [0]


def test_it_is_put_before_any_tracker_by_the_configuration_alone():
    inner = Script(np.ones((2, 1)))
    assert make_tracker(inner, TrackingConfig()).name == "script"
    short = make_tracker(inner, TrackingConfig(forget_after=10))
    assert isinstance(short, ShortHorizon) and short.name == "script-sh(10)"
    assert make_tracker("lk", TrackingConfig(forget_after=3)).name == "lk-sh(3)"
    with pytest.raises(BadInput, match="got 'lkk', expected one of"):
        make_tracker("lkk", TrackingConfig())
