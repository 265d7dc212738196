"""A 2D tracker that answers late makes the estimates late and changes nothing else of them."""

from collections import deque

import numpy as np
import pytest

from p2p_lib.core.backends import make_tracker
from p2p_lib.core.config import preset
from p2p_lib.core.types import Tracks
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.extended.default import Point2Pose
from p2p_lib.run import run

FRAMES = range(0, 60, 4)
# A late tracker cannot look again in a frame that is past: on time, it must not either.
CONFIG = preset().with_values(
    {"method.mechanisms": "all but redetection, rejection", "method.surface": False, "method.graph": False}
)


class Late:
    """A tracker held back by some frames; it is not told where to search, since that would be of another frame."""

    name = "late"

    def __init__(self, latency_frames, config=CONFIG):
        self.latency_frames = latency_frames
        self._inner = make_tracker("builtin", config.tracking, np.random.default_rng(0))
        self._waiting, self._started = deque(), False

    def start(self, frame, camera=None):
        self._waiting.clear()
        self._started = False
        self._take(frame)

    def track(self, frame, search=None, urgent=False):
        told = self._take(frame)
        return told if told is not None else Tracks(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))

    def _take(self, frame):
        self._waiting.append(frame)
        if len(self._waiting) <= self.latency_frames:
            return None
        frame = self._waiting.popleft()
        if not self._started:
            self._started = True
            return self._inner.start(frame)
        return self._inner.track(frame)

    def __getattr__(self, name):  # add, drop, reject, suggest
        return getattr(self._inner, name)


@pytest.fixture(scope="module")
def crossing():
    return open_sequence("synthetic/crossing")


def estimates(crossing, late, frames=FRAMES):
    method = Point2Pose(crossing.camera, CONFIG, Late(late))
    for name in crossing.objects:
        method.add_object(name)
    told = [method.step(crossing.frame(t), crossing.masks(t)) for t in frames]
    return told, list(method.finish())


@pytest.fixture(scope="module")
def on_time(crossing):
    told, owed = estimates(crossing, 0)
    assert not owed and sum(e["box"].T_cam_obj is not None for e in told) > 10
    return told


def assert_same(one, other):
    assert [e.keys() for e in one] == [e.keys() for e in other]
    for a, b in zip(one, other, strict=True):
        for name in a:
            for key, value in vars(a[name]).items():
                np.testing.assert_array_equal(value, vars(b[name])[key], f"{name} {key}")


@pytest.mark.parametrize("late", [1, 7])
def test_late_estimates_are_the_same_estimates(crossing, on_time, late):
    told, owed = estimates(crossing, late)
    assert told[:late] == [{}] * late
    assert_same(told[late:] + owed, on_time)
    assert [e["box"].frame_index for e in told[late:] + owed] == list(FRAMES)


def test_the_frame_is_that_of_the_estimates(crossing):
    method = Point2Pose(crossing.camera, CONFIG, Late(2))
    method.add_object("box")
    for stream in ((0, 1, 2, 3), (4, 5)):
        for k, t in enumerate(stream):
            method.step(crossing.frame(t), {"box": crossing.masks(t)["box"]})
            assert (method.frame is None) if k < 2 else method.frame.index == stream[k - 2]
        assert [method.frame.index for _ in method.finish()] == list(stream[-2:])


def test_a_stream_shorter_than_the_delay_is_finished_too(crossing, on_time):
    told, owed = estimates(crossing, 7, FRAMES[:3])
    assert told == [{}] * 3
    assert_same(owed, on_time[:3])
    assert not list(Point2Pose(crossing.camera, CONFIG, Late(7)).finish())


def test_a_run_writes_each_estimate_to_its_frame(crossing, tmp_path):
    settings = {"method.surface": False, "method.graph": False}
    for late in (0, 5):
        run(crossing, tmp_path / str(late), settings=settings, tracker=Late(late), stop=12, progress=False)
    one, other = (load_run(tmp_path / str(late)) for late in (0, 5))
    for name, obj in one.objects.items():
        np.testing.assert_array_equal(obj.frame_index, np.arange(12))
        np.testing.assert_array_equal(obj.T_cam_obj, other.objects[name].T_cam_obj)
        np.testing.assert_array_equal(obj.visible_px, other.objects[name].visible_px)


def test_clicks_mean_the_frame_they_were_made_in(crossing):
    """Segmentation waits with the estimates: the same masks and poses, some frames later."""
    clicks = {}
    for name, mask in crossing.masks(3).items():
        v, u = np.nonzero(mask)
        clicks[name] = np.stack([u, v], -1)[len(u) // 2 + np.array([-40, 0, 40])]
    told = {}
    for late in (0, 5):
        method, told[late] = Point2Pose(crossing.camera, CONFIG, Late(late)), []
        for t in range(10):
            for name in clicks if t == 3 else ():
                method.add_object(name, clicks=clicks[name])
            told[late].append((method.step(crossing.frame(t)), method.masks))
        told[late] += [(estimates, method.masks) for estimates in method.finish()]
    assert_same([e for e, _ in told[0]], [e for e, _ in told[5][5:]])
    for (_, one), (_, other) in zip(told[0], told[5][5:], strict=True):
        assert one.keys() == other.keys()
        assert all((one[name] == other[name]).all() for name in one)
    assert all(mask.any() for mask in told[0][-1][1].values())
