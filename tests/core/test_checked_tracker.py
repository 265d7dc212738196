"""A tracker that keeps its promises is followed as it is; one that does not is told which it broke, and where."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core.backends import make_tracker
from p2p_lib.core.checked_tracker import CheckedTracker
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks

RGB, DEPTH = np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32)


def frame(index):
    return Frame(index, index / 30, RGB, DEPTH)


class Still:
    """Keeps every promise; ``spoil`` changes what it answers, by the name of the call or the column."""

    name, latency_frames = "still", 0

    def __init__(self, step=1, **spoil):
        self.step, self.spoil, self.next, self.ids = step, spoil, 0, np.zeros(0, np.int64)

    def said(self, what, value):
        return self.spoil.get(what, lambda same: same)(value)

    def start(self, frame, camera=None):
        self.next, self.ids = 0, self.ids[:0]

    def add(self, uv_px):
        new = self.next + self.step * np.arange(len(uv_px))
        self.next += self.step * len(uv_px)
        self.ids = np.concatenate([self.ids, new])
        return self.said("add", new)

    def track(self, frame, search=None, urgent=False):
        ids, n = self.said("rows", self.ids), len(self.said("rows", self.ids))
        columns = {"uv_px": np.ones((n, 2)), "visible": np.ones(n, bool), "uncertainty": np.zeros(n)}
        columns = {name: self.said(name, column) for name, column in columns.items()}
        return self.said("track", Tracks(self.said("ids", ids), **columns))

    def drop(self, ids):
        self.ids = self.ids[~np.isin(self.ids, ids)]

    def reject(self, ids):
        pass

    def suggest(self, ids, uv_px):
        return self.track(None) if len(ids) else None


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 5), st.randoms()), max_size=12), st.integers(1, 9))
def test_whatever_is_added_and_dropped_promises_that_are_kept_are_never_doubted(calls, step):
    plain, checked = Still(step), CheckedTracker(Still(step))
    for _ in range(2):
        assert plain.start(frame(0)) is checked.start(frame(0)) is None
        for k, (count, chance) in enumerate(calls):
            np.testing.assert_array_equal(plain.add(np.zeros((count, 2))), checked.add(np.zeros((count, 2))))
            gone = np.array([i for i in plain.ids if chance.random() < 0.3], np.int64)
            plain.drop(gone), checked.drop(gone)
            for one, other in (
                (plain.track(frame(k)), checked.track(frame(k))),
                (plain.suggest(plain.ids, None), checked.suggest(plain.ids, None)),
            ):
                for column in vars(one) if one else ():
                    np.testing.assert_array_equal(getattr(one, column), getattr(other, column))


BROKEN = {
    "add gives nothing": ("add", lambda ids: None, r"add\(\): got NoneType, expected the ids of 4 points, a NumPy arr"),
    "add gives a list": ("add", list, r"add\(\): got list, expected .* \(4,\) of whole numbers"),
    "add gives floats": ("add", lambda ids: ids / 1, r"add\(\): got float64 \(4,\), expected"),
    "add gives too few": ("add", lambda ids: ids[1:], r"add\(\): got int64 \(3,\), expected the ids of 4 points"),
    "ids given twice": ("add", lambda ids: ids % 3, r"add\(\): got id 0 after 2, expected ids that increase"),
    "ids decrease": ("add", lambda ids: ids[::-1], r"add\(\): got id 2 after 3, expected ids that increase"),
    "unsigned ids decrease": ("add", lambda ids: ids[::-1].astype(np.uint8), r"add\(\): got id 2 after 3"),
    "no tracks": ("track", lambda tracks: None, r"track\(\): got NoneType, expected Tracks\(ids, uv_px, vis"),
    "rows unsorted": (
        "ids",
        lambda ids: ids[::-1],
        r"track\(\): got a row of id 2 after one of id 3, expected rows so",
    ),
    "a row twice": (
        "ids",
        lambda ids: ids // 2 * 2,
        r"track\(\): got a row of id 0 after one of id 0, expected rows so",
    ),
    "rows missing": (
        "rows",
        lambda ids: ids[ids % 2 > 0],
        r"track\(\): got no row of 2 of 4 points, the first of id 0",
    ),
    "ids as a list": ("ids", list, r"track\(\) ids: got list, expected a NumPy array of whole numbers"),
    "visible as floats": ("visible", lambda seen: seen / 1, r"track\(\) visible: got float64 \(4,\), expected .* bool"),
    "visible as a list": ("visible", list, r"track\(\) visible: got list, expected a NumPy array of bool"),
    "visible nowhere": (
        "uv_px",
        lambda uv: uv * np.nan,
        r"track\(\): got 4 of 4 visible points at no pixel, the first",
    ),
    "columns of unequal length": (
        "visible",
        lambda seen: seen[1:],
        r"track\(\): got 4 ids, uv_px \(4, 2\), visible \(3,\), uncertainty \(4,\), expected",
    ),
    "unsure": ("uncertainty", lambda unsure: unsure + 2, r"track\(\): got uncertainty 2 of a visible point, expected"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_a_broken_promise_is_named_with_who_broke_it_and_in_which_frame(broken):
    what, spoil, said = BROKEN[broken]
    tracker = CheckedTracker(Still(**{what: spoil}))
    with pytest.raises(BadInput, match=rf"tracker 'still' \(Still\), frame [07]: {said}"):
        tracker.start(frame(0))
        tracker.add(np.zeros((4, 2)))
        tracker.track(frame(7))
    if what not in ("add", "track"):  # Still suggests what it tracks
        with pytest.raises(BadInput, match=said.replace("track", "suggest")):
            tracker.suggest(np.arange(4), np.zeros((4, 2)))


def test_ids_of_an_earlier_call_are_not_given_again():
    tracker = CheckedTracker(Still(add=lambda ids: ids % 4))
    tracker.start(frame(0))
    tracker.add(np.zeros((4, 2)))
    with pytest.raises(BadInput, match="got id 0 after 3"):
        tracker.add(np.zeros((1, 2)))


@pytest.mark.parametrize("late", [None, -1, 0.5])
def test_how_late_it_is_is_a_number_of_frames(late):
    tracker = Still()
    tracker.latency_frames = late
    with pytest.raises(BadInput, match=rf"latency_frames: got {late}, expected a whole number of frames from 0"):
        make_tracker(tracker, TrackingConfig())


def test_whatever_else_a_tracker_has_is_reached():
    tracker = make_tracker(Still(step=3), TrackingConfig())
    assert tracker.step == 3 and not hasattr(tracker, "weights")
