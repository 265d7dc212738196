"""Times add up within a frame, start again with the next, and survive errors."""

import pytest

from p2p_lib.core import stopwatch
from p2p_lib.core.stopwatch import Stopwatch


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is moved (seconds)."""
    now = [100.0]
    monkeypatch.setattr(stopwatch.time, "perf_counter", lambda: now[0])
    return now


def test_stages_add_up_within_a_frame(clock):
    watch = Stopwatch()
    with watch.frame():
        for ms in (3, 4):
            with watch("tracking"):
                clock[0] += ms / 1e3
        with watch("map"):
            clock[0] += 0.002
        clock[0] += 0.001
    assert watch.last_ms == pytest.approx({"tracking": 7, "map": 2, "total": 10})


def test_the_next_frame_starts_at_zero(clock):
    watch = Stopwatch()
    for ms in (5, 2):
        with watch.frame(), watch("tracking"):
            clock[0] += ms / 1e3
    assert watch.last_ms == pytest.approx({"tracking": 2, "total": 2})
    with watch.frame():
        pass
    assert watch.last_ms == {"total": 0}


def test_a_stage_within_a_stage_counts_in_both(clock):
    watch = Stopwatch()
    with watch.frame(), watch("outer"):
        clock[0] += 0.001
        with watch("inner"):
            clock[0] += 0.002
    assert watch.last_ms == pytest.approx({"inner": 2, "outer": 3, "total": 3})


def test_time_until_an_error_counts_too(clock):
    watch = Stopwatch()
    with pytest.raises(KeyError), watch.frame(), watch("map"):
        clock[0] += 0.004
        raise KeyError("x")
    assert watch.last_ms == pytest.approx({"map": 4, "total": 4})
