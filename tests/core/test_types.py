"""The values that pass between stages: what they refuse, what they put right, how rows are picked."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import WITH_POSE, Frame, PoseEstimate, Status, Tracks

RGB = np.zeros((4, 6, 3), np.uint8)
DEPTH = np.full((4, 6), 0.5, np.float32)
POSES = pytest.mark.parametrize("status", sorted(WITH_POSE))
NO_POSES = pytest.mark.parametrize("status", sorted(set(Status) - WITH_POSE))


# --- Frame -------------------------------------------------------------------------------------


def test_frame_keeps_good_pictures_as_they_are_whatever_becomes_of_the_buffers():
    rgb, depth, T_world_cam = RGB.copy(), DEPTH.copy(), np.eye(4)
    frame = Frame(3, 0.1, rgb, depth, T_world_cam)
    rgb[:], depth[:], T_world_cam[:] = 7, 7, 7
    assert (frame.rgb == RGB).all() and (frame.depth_m == DEPTH).all() and frame.shape == (4, 6)
    assert (frame.T_world_cam == np.eye(4)).all()


@pytest.mark.parametrize("reading", [np.nan, np.inf, -np.inf, -0.3, -1e-9, 1e15, 1e300, 1e-30])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_readings_that_are_none_become_zero(reading, dtype):
    depth = DEPTH.astype(dtype)
    depth[1, 2] = reading
    before = depth.copy()
    frame = Frame(0, 0.0, RGB, depth)
    assert frame.depth_m.dtype == np.float32
    assert frame.depth_m[1, 2] == 0 and (np.delete(frame.depth_m.ravel(), 8) == 0.5).all()
    np.testing.assert_array_equal(depth, before)  # the caller's picture is not touched


@pytest.mark.parametrize(
    ("rgb", "depth", "time_s", "words"),
    [
        (RGB.tolist(), DEPTH, 0.0, "frame 7 colour: got list, expected a NumPy array"),
        (RGB, DEPTH.tolist(), 0.0, "frame 7 depth: got list, expected a NumPy array"),
        (RGB[..., 0], DEPTH, 0.0, r"frame 7 colour: got \(4, 6\) uint8, expected \(H, W, 3\) uint8"),
        (RGB.astype(float), DEPTH, 0.0, r"frame 7 colour: got \(4, 6, 3\) float64"),
        (np.zeros((4, 6, 4), np.uint8), DEPTH, 0.0, r"frame 7 colour: got \(4, 6, 4\)"),
        (RGB, DEPTH[:3], 0.0, r"frame 7 depth: got 6x3, expected 6x4 \(width x height\) as the colour image. Register"),
        (RGB, DEPTH[..., None], 0.0, r"frame 7 depth: got shape \(4, 6, 1\), expected 6x4"),
        (RGB, np.full((4, 6), 500, np.uint16), 0.0, "frame 7 depth: got uint16, expected metres as floats"),
        (RGB, DEPTH, np.nan, "frame 7 time_s: got nan"),
        (RGB, DEPTH, np.inf, "frame 7 time_s: got inf"),
        (RGB, DEPTH, None, "frame 7 time_s: got None, expected a finite time in seconds"),
        (RGB, DEPTH, "0.1", "frame 7 time_s: got 0.1, expected a finite time"),
    ],
)
def test_frame_refuses(rgb, depth, time_s, words):
    with pytest.raises(BadInput, match=words):
        Frame(7, time_s, rgb, depth)


@pytest.mark.parametrize("T_world_cam", ["x", {}, [[1, 2], [3]], [["x"] * 4] * 4, 3])
def test_a_camera_pose_that_is_no_matrix_is_refused(T_world_cam):
    with pytest.raises(BadInput, match=r"frame 7 T_world_cam: got .*, expected a 4x4 transformation"):
        Frame(7, 0.0, RGB, DEPTH, T_world_cam)


@pytest.mark.parametrize("index", [None, "a", 1.5, 2.0, -1, True, np.float64(3)])
def test_a_frame_is_numbered_from_0(index):
    with pytest.raises(BadInput, match=r"frame index: got .*, expected a whole number from 0"):
        Frame(index, 0.0, RGB, DEPTH)
    assert type(Frame(np.int64(3), 0.0, RGB, DEPTH).index) is int


def test_values_are_frozen():
    for value in (Frame(0, 0.0, RGB, DEPTH), some_tracks([1]), PoseEstimate("a", 0, 0.0, Status.LOST)):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(value, dataclasses.fields(value)[0].name, 1)


# --- Tracks ------------------------------------------------------------------------------------


def some_tracks(ids) -> Tracks:
    """Rows that tell by their values which id they belong to."""
    ids = np.array(ids, np.int64)
    return Tracks(ids, np.stack([ids, ids + 0.5], -1).astype(float), ids % 2 == 0, ids / 1000)


@given(st.sets(st.integers(0, 999), max_size=30).flatmap(lambda s: st.tuples(st.just(sorted(s)), subsets(sorted(s)))))
def test_select_picks_the_rows_of_the_ids_in_their_order(drawn):
    held, wanted = drawn
    picked = some_tracks(held).select(np.array(wanted, np.int64))
    expected = some_tracks(wanted)
    for f in dataclasses.fields(Tracks):
        np.testing.assert_array_equal(getattr(picked, f.name), getattr(expected, f.name))
    assert len(picked) == len(wanted)


def subsets(of: list[int]) -> st.SearchStrategy[list[int]]:
    """In any order, also with repetitions."""
    return st.lists(st.sampled_from(of), max_size=20) if of else st.just([])


@pytest.mark.parametrize(("held", "wanted"), [([1, 5, 9], [4]), ([1, 5], [1, 6]), ([1, 5], [0]), ([], [3])])
def test_select_refuses_ids_that_are_not_there(held, wanted):
    with pytest.raises(BadInput, match="track ids: got ids the tracker does not hold"):
        some_tracks(held).select(np.array(wanted))


@pytest.mark.parametrize("field", ["uv_px", "visible", "uncertainty"])
def test_rows_must_belong_together(field):
    values = dataclasses.asdict(some_tracks([1, 2, 3]))
    values[field] = values[field][:-1]
    with pytest.raises(BadInput, match=rf"Tracks: got 3 ids.*{field} \(2"):
        Tracks(**values)


# --- PoseEstimate ------------------------------------------------------------------------------


def estimate(status: Status, **change) -> PoseEstimate:
    values = {"T_cam_obj": np.eye(4) if status in WITH_POSE else None} | change
    return PoseEstimate("mug", 12, 0.4, status, **values)


@POSES
def test_a_pose_is_required_where_the_status_says_there_is_one(status):
    assert estimate(status, confidence=0.5).T_cam_obj.shape == (4, 4)
    with pytest.raises(BadInput, match=f"'mug' at frame 12: got no pose with status {status}"):
        estimate(status, T_cam_obj=None)


@NO_POSES
def test_no_pose_is_a_value_and_never_carries_one(status):
    assert estimate(status).T_cam_obj is None and estimate(status).confidence == 0
    with pytest.raises(BadInput, match=f"'mug' at frame 12: got a pose with status {status}"):
        estimate(status, T_cam_obj=np.eye(4))
    with pytest.raises(BadInput, match=r"confidence: got 0\.2, expected .* 0 without a pose"):
        estimate(status, confidence=0.2)


def test_the_statuses_are_the_words_that_are_written_to_disk():
    assert [str(s) for s in Status] == ["initialising", "tracked", "degraded", "occluded", "lost", "recovered"]
    assert {"tracked", "degraded", "recovered"} == WITH_POSE


@pytest.mark.parametrize("confidence", [-0.01, 1.01, np.nan, np.inf])
def test_confidence_is_a_share(confidence):
    with pytest.raises(BadInput, match="frame 12: confidence"):
        estimate(Status.TRACKED, confidence=confidence)


@pytest.mark.parametrize(
    "T",
    [np.full((4, 4), np.nan), np.eye(3), 2 * np.eye(4), np.diag([1.0, 1, -1, 1])],
    ids=["nan", "3x3", "2", "mirror"],
)
def test_a_pose_that_is_none_is_refused(T):
    with pytest.raises(BadInput, match="estimate of 'mug' at frame 12"):
        estimate(Status.TRACKED, T_cam_obj=T)


@pytest.mark.parametrize("covariance", [np.eye(3), np.full((6, 6), np.nan), np.full((6, 6), np.inf)])
def test_a_covariance_is_six_by_six_and_finite(covariance):
    with pytest.raises(BadInput, match="frame 12: covariance"):
        estimate(Status.TRACKED, covariance=covariance)
