"""The whole loop on a small rendered scene whose poses are known exactly: cartons before a printed wall."""

import builtins
import re
import signal
import warnings
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config, preset
from p2p_lib.core.errors import BadInput, Doubt
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import DOUBTED, WITH_POSE, Frame, PoseEstimate, Status
from p2p_lib.extended.default import Point2Pose
from p2p_lib.method.object_model import CONFIRM_FRAMES
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.noise import Sensor, measured_colour, measured_depth
from p2p_lib.synthetic.render import render
from p2p_lib.trackers.builtin.tracker import BuiltinTracker

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERA = Camera(440.0, 442.0, 201.3, 148.6, 400, 300)
# A carton's front looks along -y and its top along +z; in the camera that is towards us and up.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
LENGTH = 28
Masks = dict[str, np.ndarray]


def path(start_m, step_m, turn_deg: float) -> np.ndarray:
    """T_cam_model (LENGTH, 4, 4): even motion while turning about the vertical, with a slight nod."""
    k = np.arange(LENGTH)
    vertical = Rotation.from_rotvec(np.radians(turn_deg) * (k / LENGTH)[:, None] * [0.1, 1, 0]).as_matrix()
    return se3.from_rt(vertical @ UPRIGHT, np.asarray(start_m) + k[:, None] * np.asarray(step_m))


TRUTH = {
    "left": path([-0.11, 0.01, 0.55], [0.0012, -0.0005, 0.0006], 32),
    "right": path([0.10, 0.0, 0.6], [-0.0008, 0.0008, -0.0008], -28),
}
UNSOUGHT = {"method.mechanisms": "all but redetection, rejection"}
HIDDEN = range(9, 14)  # frames in which a board stands before everything, in the film that has one


@cache
def film(board: bool = False) -> list[tuple[Frame, Masks]]:
    """LENGTH frames with their masks, as a depth camera sees them."""
    rng = np.random.default_rng(5)
    meshes = {"left": shapes.box(rng, (0.10, 0.05, 0.14)), "right": shapes.box(rng, (0.08, 0.07, 0.11))}
    corners = np.array([[-0.7, 0.5, 1.0], [0.7, 0.5, 1.0], [0.7, -0.5, 1.0], [-0.7, -0.5, 1.0]])
    wall = render([(shapes.plane(rng.integers(60, 200, (40, 60, 3), np.uint8), corners), np.eye(4))], CAMERA, np.eye(4))
    cover = shapes.slab(rng, (0.6, 0.01, 0.5))
    frames = []
    for k in range(LENGTH):
        bodies = [(meshes[name], TRUTH[name][k]) for name in TRUTH]
        if board and k in HIDDEN:
            bodies.append((cover, se3.from_rt(UPRIGHT, np.array([0, 0, 0.3]))))
        picture = render(bodies, CAMERA, np.eye(4), background=wall)
        noise = np.random.default_rng([9, k])
        sensor = Sensor(axial_per_m=0.002)
        depth = measured_depth(picture, CAMERA, sensor, noise)
        frame = Frame(k, k / 30, measured_colour(picture.rgb, sensor, 1.0, noise), depth.astype(np.float32))
        frames.append((frame, {name: picture.label == i for i, name in enumerate(TRUTH, 1)}))
    return frames


def quick(name: str = "default", seed: int = 0, **values) -> Config:
    """Points alone, without surface and graph: for what does not depend on them."""
    off = {"method.surface": False, "refinement.residuals": "none", "method.graph": False}
    return preset(name, seed).with_values(off | values)


def track(frames, names=("left", "right"), config: Config | None = None) -> list[dict[str, PoseEstimate]]:
    method = Point2Pose(CAMERA, config or quick())
    for name in names:
        method.add_object(name)
    return [method.step(frame, {n: masks[n] for n in names if n in masks}) for frame, masks in frames]


def errors(estimates: list[dict[str, PoseEstimate]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (deg) and translation (mm) errors where there is a pose; object frames fixed at the first of them."""
    with_pose = [e[name] for e in estimates if name in e and e[name].T_cam_obj is not None]
    T_cam_obj = np.stack([e.T_cam_obj for e in with_pose])
    T_cam_model = TRUTH[name][[e.frame_index for e in with_pose]]
    T_obj_model = se3.inverse(T_cam_obj[0]) @ T_cam_model[0]
    off = se3.inverse(T_cam_model) @ T_cam_obj @ T_obj_model
    return np.degrees(se3.angle_rad(off)), 1e3 * np.linalg.norm(off[:, :3, 3], axis=1)


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return (one & other).sum() / max((one | other).sum(), 1)


def statuses(estimates: list[dict[str, PoseEstimate]], name: str) -> list[str]:
    return [str(e[name].status) for e in estimates]


def assert_same(one: list[dict[str, PoseEstimate]], other: list[dict[str, PoseEstimate]]) -> None:
    """Bit for bit."""
    assert len(one) == len(other)
    for a, b in zip(one, other):
        assert a.keys() == b.keys()
        for name in a:
            left, right = vars(a[name]), vars(b[name])
            assert left.keys() == right.keys()
            for key in left:
                np.testing.assert_array_equal(left[key], right[key], f"{name} {key}")


def assert_honest(estimates: list[dict[str, PoseEstimate]]) -> None:
    """What every stream of estimates keeps to."""
    newest: dict[str, PoseEstimate] = {}
    for step in estimates:
        for name, e in step.items():
            assert e.object == name
            if e.T_cam_obj is not None:
                newest[name] = e
            else:
                assert e.reason and e.confidence == 0 and not e.keyframe and e.inliers == 0
            if name in newest:
                last, newer = newest[name], e is not newest[name]
                # Of a keyframe the pose that is known later is the graph's.
                off = 1e-3 if last.keyframe and newer else 0.0
                np.testing.assert_allclose(e.last_T_cam_obj, last.T_cam_obj, rtol=0, atol=off)
                assert e.last_seen_s == newest[name].time_s
            else:
                assert e.last_T_cam_obj is None and np.isnan(e.last_seen_s)
            assert e.status != Status.INITIALISING or name not in newest


# --- poses follow truth ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["default", "paper"])
def test_poses_follow_the_truth(name):
    """Two objects at once, everything on: surface, refinement, graph."""
    estimates = track(film(), config=preset(name))
    assert_honest(estimates)
    for k, (frame, _) in enumerate(film()):
        for e in estimates[k].values():
            assert (e.frame_index, e.time_s) == (frame.index, frame.time_s)
    for obj in TRUTH:
        assert set(statuses(estimates, obj)) == {"tracked"}
        angle_deg, shift_mm = errors(estimates, obj)
        assert len(angle_deg) == LENGTH
        assert np.median(angle_deg) < 1.5 and angle_deg.max() < 4
        assert np.median(shift_mm) < 2.5 and shift_mm.max() < 6
        assert sum(e[obj].keyframe for e in estimates) >= 2


def test_poses_follow_the_truth_by_points_alone():
    estimates = track(film(), config=quick())
    for obj in TRUTH:
        angle_deg, shift_mm = errors(estimates, obj)
        assert len(angle_deg) == LENGTH
        assert np.median(angle_deg) < 1.5 and np.median(shift_mm) < 2.5


def test_where_the_object_frame_starts():
    frame, masks = film()[0]
    paper, default = (track(film()[:1], config=quick(name))[0] for name in ("paper", "default"))
    for obj in TRUTH:
        np.testing.assert_array_equal(paper[obj].T_cam_obj, np.eye(4))
        T = default[obj].T_cam_obj
        np.testing.assert_array_equal(T[:3, :3], np.eye(3))
        v, u = np.nonzero(masks[obj] & (frame.depth_m > 0))
        cloud = CAMERA.unproject(np.stack([u, v], -1), frame.depth_m[v, u])
        np.testing.assert_allclose(T[:3, 3], np.median(cloud, 0), atol=1e-6)


def test_the_configuration_may_be_a_presets_name():
    assert Point2Pose(CAMERA, "paper").config == preset("paper")
    with pytest.raises(BadInput, match="preset: got 'papers', expected one of default, paper"):
        Point2Pose(CAMERA, "papers")
    with pytest.raises(BadInput, match="config: got dict, expected a Config, or the name of a preset"):
        Point2Pose(CAMERA, {"preset": "paper"})


def test_depth_in_millimetres_is_refused_and_a_far_background_doubted():
    frame, _ = film()[0]
    with pytest.raises(
        BadInput,
        match=r"depth of frame 0: got \d+ m and more, expected .* Is it in millimetres\? Give metres: divide by 1000",
    ):
        Point2Pose(CAMERA).step(replace(frame, depth_m=1000 * frame.depth_m))
    depth_m = frame.depth_m.copy()
    depth_m[: len(depth_m) * 6 // 10] = 400.0
    with pytest.warns(Doubt, match=r"depth of frame 0: 400 m in the middle. Is it in millimetres\?"):
        Point2Pose(CAMERA).step(replace(frame, depth_m=depth_m))


def test_an_object_that_was_named_alone_says_what_it_waits_for():
    method = Point2Pose(CAMERA, quick())
    method.add_object("left")
    waits = "not seen yet: it waits for a mask (step) or for clicks (correct)"
    assert method.step(film()[0][0])["left"].reason == method.step(film()[1][0])["left"].reason == waits
    assert method.step(film()[2][0], {"left": np.zeros((300, 400), bool)})["left"].reason == "not seen yet"
    started = [method.step(frame, {"left": masks["left"]})["left"].status for frame, masks in film()[3:5]]
    assert started[-1] is Status.TRACKED


def test_a_name_that_no_file_can_have_is_refused_before_anything_is_tracked():
    method = Point2Pose(CAMERA, quick())
    for name in ("a/b", ""):
        with pytest.raises(BadInput, match="object name"):
            method.add_object(name)
        with pytest.raises(BadInput, match="object name"):
            Prompt(name, points_px=[[200, 150]])
    assert not method.objects


def test_a_ctrl_c_that_a_library_takes_for_itself_is_heard(monkeypatch):
    """trimesh takes whatever is raised while it imports a library for that library's being missing."""

    def imported(name, *more, real=builtins.__import__):
        if name == "trimesh":
            with suppress(BaseException):
                signal.raise_signal(signal.SIGINT)
        return real(name, *more)

    method = Point2Pose(CAMERA)
    monkeypatch.setattr(builtins, "__import__", imported)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            method.add_object("left")
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("name", ["default", "paper"])
@pytest.mark.parametrize(
    ("scale", "says"),
    [
        (0, r"the frame has no usable depth"),
        (
            1000,
            r"(the frame has no usable depth; )?the depth of the frame is \d\d\d m and more: is it in millimetres\?",
        ),
        (None, r"0 of \d+ mask pixels have depth"),
    ],
)
def test_an_estimate_says_what_is_wrong_with_the_depth_of_its_frame(name, scale, says):
    (frame, masks), before = film()[6], film()[:6]
    depth_m = np.where(masks["left"], 0, frame.depth_m) if scale is None else scale * frame.depth_m
    *_, last = track([*before, (replace(frame, depth_m=depth_m), masks)], config=quick(name))
    assert last["left"].T_cam_obj is None and re.fullmatch(says, last["left"].reason)
    assert (last["right"].reason == "") == (scale is None), "the other one has its depth"


def test_a_frame_in_millimetres_counts_as_one_without_depth():
    """For tracks and masks, too: what comes after it is the same."""
    poses = []
    for scale in (0, 1000):
        frames = [
            (replace(f, depth_m=scale * f.depth_m) if k == 4 else f, masks) for k, (f, masks) in enumerate(film())
        ]
        poses.append([estimate["left"].T_cam_obj for estimate in track(frames[:8], names=("left",), config=quick())])
    assert all(np.array_equal(a, b) for a, b in zip(*poses, strict=True) if a is not None)
    assert [pose is None for pose in poses[0]] == [pose is None for pose in poses[1]]


def test_frames_of_one_time_say_so_once():
    frames = [(replace(frame, time_s=min(frame.time_s, 2 / 30)), masks) for frame, masks in film()[:6]]
    with pytest.warns(Doubt, match=r"time of frame 3"):
        reasons = [estimate["left"].reason for estimate in track(frames, names=("left",))]
    assert ["its time" in reason for reason in reasons] == [False, False, False, True, False, False]


def test_tracks_that_cannot_be_used_are_refused():
    """By whoever made them, what came, and what was expected."""

    class Lost(BuiltinTracker):
        wrong, value = "uv_px", np.nan

        def track(self, *args):
            tracks = super().track(*args)
            getattr(tracks, self.wrong)[:3] = self.value
            return tracks

    for Lost.wrong, Lost.value, says in (
        ("uv_px", np.nan, r"3 of \d+ visible points at no pixel, the first at \[nan, nan\], expected finite uv_px"),
        ("uncertainty", np.nan, r"uncertainty nan of a visible point, expected a number in \[0, 1\]"),
    ):
        config = quick()
        method = Point2Pose(CAMERA, config, Lost(config.tracking, np.random.default_rng(0)))
        method.add_object("left")
        method.step(film()[0][0], {"left": film()[0][1]["left"]})
        with pytest.raises(BadInput, match=rf"tracker 'builtin' \(Lost\), frame 1: track\(\): got {says}"):
            method.step(film()[1][0])


def test_time_that_runs_backwards_is_warned_of_once_and_statuses_are_logged(caplog):
    caplog.set_level("INFO", "p2p_lib")
    frames = [film()[k] for k in (0, 1, 2, 1, 0, 3)]
    with pytest.warns(Doubt) as said:
        estimates = track(frames, names=("left",))
    about_order = [str(of.message) for of in said if " of frame 1: " in str(of.message)]
    assert about_order == [
        "index of frame 1: not above that of the frame before (2). "
        "Count frames up: what is kept of earlier ones goes by it.",
        "time of frame 1: 0.033333 s, not later than the frame before (0.066667 s). "
        "Give frames in the order in which they were taken.",
    ]
    first = estimates[0]["left"].status
    assert caplog.messages[0].startswith(f"frame 0: left begins, is {first}")
    reasons = [estimate["left"].reason for estimate in estimates]
    told = [f"its time is {k / 30:.6f} s, not later than the frame before ({(k + 1) / 30:.6f} s)" for k in (1, 0)]
    assert [reason.partition("; ")[2] or reason for reason in reasons] == ["", "", "", *told, ""], "each in its frame"
    changes = 1 + sum(a["left"].status != b["left"].status for a, b in pairwise(estimates))
    assert len(caplog.messages) == changes and {record.name for record in caplog.records} == {"p2p_lib"}


@pytest.mark.parametrize(
    ("unit_s", "fix"),
    [(1, ""), (1e-3, "milliseconds by 1000"), (1e-6, "microseconds by 1e6"), (1e-9, "nanoseconds by 1e9")],
)
def test_times_in_another_unit_are_doubted_once(unit_s, fix):
    frames = [(replace(frame, time_s=1.7e9 + frame.time_s / unit_s), masks) for frame, masks in film()[:8]]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        track(frames, names=("left",))
    about_time = [str(of.message) for of in said if "time of frame" in str(of.message)]
    assert len(about_time) == (unit_s < 1)
    assert all("time of frame 3: 33" in text and f"divide {fix}." in text for text in about_time)


def test_a_mask_where_no_depth_is_says_so_until_it_is_given_again():
    method, frames = Point2Pose(CAMERA, quick()), film()[:5]
    frame, masks = frames[0]
    method.add_object("left", mask=masks["left"])
    found = [method.step(replace(frame, depth_m=np.zeros_like(frame.depth_m)))["left"]]
    found += [method.step(frame)["left"] for frame, _ in frames[1:3]]
    why = "mask of 'left': got no depth inside it in frame 0, expected measured pixels. Give it again in a frame with"
    assert str(method.refused["left"]).startswith(why) and all(each.T_cam_obj is None for each in found)
    assert [each.reason.startswith(why) for each in found[1:]] == [True, True]
    method.correct("left", mask=frames[3][1]["left"])
    assert method.step(frames[3][0])["left"].T_cam_obj is not None and not method.refused


def test_nobody_knows_the_masks():
    """The first mask alone; from then on the segmenter looks after every object."""
    method = Point2Pose(CAMERA, quick())
    for name in TRUTH:
        method.add_object(name, mask=film()[0][1][name])
    estimates = [method.step(frame) for frame, _ in film()]
    assert_honest(estimates)
    for obj in TRUTH:
        angle_deg, shift_mm = errors(estimates, obj)
        assert len(angle_deg) >= LENGTH - 2
        assert np.median(angle_deg) < 2 and np.median(shift_mm) < 3


# --- hiding and coming back --------------------------------------------------------------------


@pytest.fixture(scope="module")
def hidden_run() -> list[dict[str, PoseEstimate]]:
    return track(film(board=True), config=preset())


@pytest.mark.parametrize("obj", TRUTH)
def test_a_hidden_object_has_no_pose_and_says_so(hidden_run, obj):
    assert_honest(hidden_run)
    for k in HIDDEN:
        e = hidden_run[k][obj]
        assert e.status == Status.OCCLUDED and e.T_cam_obj is None and e.visible_points == 0
        assert e.last_seen_s == film()[HIDDEN.start - 1][0].time_s
    assert all(hidden_run[k][obj].status == Status.TRACKED for k in range(HIDDEN.start))


@pytest.mark.parametrize("obj", TRUTH)
def test_its_return_is_marked_and_true(hidden_run, obj):
    after = statuses(hidden_run, obj)[HIDDEN.stop :]
    marked = CONFIRM_FRAMES
    found = after.index("recovered")
    assert found <= preset().tracking.redetect_every
    assert after[:found] == ["lost"] * found
    assert after[found : found + marked] == ["recovered"] * marked
    assert set(after[found + marked :]) == {"tracked"}
    angle_deg, shift_mm = errors(hidden_run, obj)
    assert np.median(angle_deg[-6:]) < 3 and np.median(shift_mm[-6:]) < 5


def test_no_keyframe_while_hidden_or_just_back(hidden_run):
    for k, step in enumerate(hidden_run):
        for e in step.values():
            assert not (e.keyframe and (k in HIDDEN or e.status == Status.RECOVERED))


class Shy(BuiltinTracker):
    """After the hiding it finds but ``left`` points by itself; the others when it is told where to look."""

    def __init__(self, left: int):
        super().__init__(preset().tracking)
        self.left, self.expected = left, []

    def track(self, frame, search=None, urgent=False):
        tracks = super().track(frame, search, urgent)
        if frame.index < HIDDEN.stop:
            return tracks
        few = tracks.visible & (np.cumsum(tracks.visible) <= self.left)
        return replace(tracks, visible=few, uncertainty=np.where(few, tracks.uncertainty, 1.0))

    def suggest(self, ids, uv_px):
        self.expected.append(int(np.isfinite(uv_px[:, 0]).sum()))
        return super().suggest(ids, uv_px)


@pytest.mark.parametrize(("seeking", "left"), [(True, 5), (True, 2), (False, 5)])
def test_a_few_points_tell_where_the_others_are(seeking, left):
    """A rigid triple gives a pose, the pose places, and the tracker points there: back at once, with many."""
    tracker, frames = Shy(left), [(f, {"left": m["left"]}) for f, m in film(board=True)]
    method = Point2Pose(CAMERA, quick(**({} if seeking else UNSOUGHT)), tracker)
    method.add_object("left")
    estimates = [method.step(f, m) for f, m in frames[: HIDDEN.stop + 1]]
    back = estimates[-1]["left"]
    assert (back.status == Status.RECOVERED) == (seeking and left >= 5)
    if back.status == Status.RECOVERED:
        assert back.inliers >= 15 and max(tracker.expected) >= 15
        angle_deg, shift_mm = errors(estimates, "left")
        assert angle_deg[-1] < 3 and shift_mm[-1] < 5
    else:
        assert back.T_cam_obj is None and back.inliers < 8


def run_with(tracker, frames, config=None):
    method = Point2Pose(CAMERA, config or preset(), tracker)
    method.add_object("left")
    return [method.step(f, {"left": m["left"]})["left"] for f, m in frames]


def test_a_return_that_is_not_confirmed_is_taken_back():
    """Two good frames, then too few points: no pose, and what it was before the hiding is the last that is known."""

    class Fading(Shy):
        def track(self, frame, search=None, urgent=False):
            self.left = 99 if frame.index < HIDDEN.stop + 2 else 5
            return super().track(frame, search, urgent)

    told = run_with(Fading(99), film(board=True)[: HIDDEN.stop + 3], quick(**UNSOUGHT))
    before, taken = told[HIDDEN.start - 1], told[-1]
    assert [e.status for e in told[-3:]] == [Status.RECOVERED, Status.RECOVERED, Status.LOST]
    np.testing.assert_array_equal(taken.last_T_cam_obj, before.T_cam_obj)


def test_hidden_points_are_looked_for_in_the_masks_where_all_are_known():
    class Asked(BuiltinTracker):
        searches = []

        def track(self, frame, search=None, urgent=False):
            self.searches.append(search)
            return super().track(frame, search, urgent)

    (first, masks), (second, later), (third, _), (fourth, last) = film()[:4]
    method = Point2Pose(CAMERA, quick(), tracker=Asked(quick().tracking))
    method.add_object("left")
    method.add_object("right")
    method.step(first, masks)
    method.step(second, later)
    method.step(third)
    method.step(fourth, {"left": last["left"], "right": np.zeros_like(last["right"])})  # the other one is hidden
    both, unknown, left = Asked.searches
    np.testing.assert_array_equal(both, later["left"] | later["right"])
    np.testing.assert_array_equal(left, last["left"])
    assert unknown is None


def test_one_hides_the_other_goes_on():
    nothing = {"left": np.zeros((300, 400), bool)}
    frames = [(f, m | nothing if k in HIDDEN else m) for k, (f, m) in enumerate(film())]
    estimates = track(frames)
    assert [k for k in range(LENGTH) if statuses(estimates, "left")[k] == "occluded"] == list(HIDDEN)
    assert set(statuses(estimates, "right")) == {"tracked"}


@pytest.mark.parametrize("pixels", [0, 1, 99])
def test_a_few_pixels_are_as_good_as_hidden(pixels):
    sliver = np.zeros((300, 400), bool)
    sliver.ravel()[:pixels] = True
    frames = [*film()[:5], (film()[5][0], {"left": sliver, "right": film()[5][1]["right"]})]
    e = track(frames)[5]["left"]
    assert e.status == Status.OCCLUDED and f"{pixels} mask pixels" in e.reason


# --- objects come and go -----------------------------------------------------------------------


def test_a_late_object_starts_when_it_is_added():
    method, estimates = Point2Pose(CAMERA, quick()), []
    method.add_object("left")
    for k, (frame, masks) in enumerate(film()):
        if k == 12:
            method.add_object("right", mask=masks["right"])
        estimates.append(method.step(frame, {n: masks[n] for n in method.objects}))
    assert all("right" not in e for e in estimates[:12])
    assert estimates[12]["right"].status == Status.TRACKED and estimates[12]["right"].keyframe
    for obj in TRUTH:
        angle_deg, shift_mm = errors(estimates, obj)
        assert np.median(angle_deg) < 1.5 and np.median(shift_mm) < 2.5
    assert len(errors(estimates, "right")[0]) == LENGTH - 12


def test_an_object_waits_until_its_mask_has_come_and_stopped_growing():
    """Frames 8 and 9 show a part of it only; only in 11 is it known that no more is to come."""
    frames = [(f, {"left": m["left"]} if k < 8 else dict(m)) for k, (f, m) in enumerate(film()[:16])]
    for k, share in ((8, 0.2), (9, 0.6)):
        columns = np.flatnonzero(frames[k][1]["right"].any(0))
        frames[k][1]["right"] = frames[k][1]["right"] & (np.arange(CAMERA.width) < np.quantile(columns, share))
    estimates = track(frames)
    assert statuses(estimates, "right") == ["initialising"] * 11 + ["tracked"] * 5
    assert "coming into view" in estimates[9]["right"].reason
    assert_honest(estimates)
    at_once = track(
        frames,
        config=quick().with_values({"method.mechanisms": "all but growing"}),
    )
    assert statuses(at_once, "right").index("tracked") < 11


def test_the_first_mask_serves_the_next_frame_only():
    """From then on the segmenter looks; an empty mask says that the object is hidden."""
    method = Point2Pose(CAMERA, quick())
    method.add_object("left", mask=film()[0][1]["left"])
    assert method.step(film()[0][0])["left"].status == Status.TRACKED
    assert method.step(film()[1][0])["left"].status == Status.TRACKED
    assert iou(method.masks["left"], film()[1][1]["left"]) > 0.85
    hidden = {"left": np.zeros((300, 400), bool)}
    assert method.step(film()[2][0], hidden)["left"].status == Status.OCCLUDED


def test_a_removed_object_is_gone_and_its_points_with_it():
    method = Point2Pose(CAMERA, quick())
    for name in TRUTH:
        method.add_object(name)
    for frame, masks in film()[:6]:
        method.step(frame, masks)
    kept = set(method.objects["right"].map.ids.tolist())
    method.remove_object("left")
    step = method.step(film()[6][0], {"right": film()[6][1]["right"]})
    assert set(step) == {"right"} and step["right"].status == Status.TRACKED
    alive = method.tracker.track(film()[7][0])
    assert set(alive.ids.tolist()) >= kept
    assert set(alive.ids.tolist()) <= set(method.objects["right"].map.ids.tolist())
    # The name is free again, for an object that starts anew.
    method.add_object("left", mask=film()[8][1]["left"])
    assert method.step(film()[8][0], film()[8][1])["left"].keyframe


def test_objects_that_are_removed_before_they_start_leave_nothing():
    method = Point2Pose(CAMERA, quick())
    method.add_object("left", mask=film()[0][1]["left"])
    method.remove_object("left")
    assert method.step(film()[0][0], {}) == {}
    method.add_object("left")
    assert method.step(film()[1][0], {})["left"].status == Status.INITIALISING


def test_without_objects_nothing_happens():
    method = Point2Pose(CAMERA, quick())
    assert [method.step(frame) for frame, _ in film()[:3]] == [{}, {}, {}]


# --- the same every time, and never from the future --------------------------------------------


@pytest.mark.parametrize("name", ["default", "paper"])
def test_the_same_seed_gives_the_same_result(name):
    assert_same(*(track(film()[:8], config=preset(name, seed=3)) for _ in range(2)))


@pytest.mark.parametrize("stop", [1, HIDDEN.start + 2, HIDDEN.stop + 3])
def test_the_future_changes_nothing(hidden_run, stop):
    assert_same(hidden_run[:stop], track(film(board=True)[:stop], config=preset()))


@pytest.mark.parametrize("masks", ["given", "of the first frame"])
@pytest.mark.parametrize("name", ["default", "paper"])
def test_the_order_of_the_objects_means_nothing(name, masks):
    frames = film(board=True)[: HIDDEN.stop + 2]
    if masks != "given":  # then the segmenter, by hints of the objects
        frames = [frames[0], *((frame, {}) for frame, _ in frames[1:])]
    assert_same(*(track(frames, names, preset(name)) for names in (TRUTH, list(TRUTH)[::-1])))


def test_input_is_left_as_it_was():
    before = [(f.rgb.copy(), f.depth_m.copy(), {n: m.copy() for n, m in masks.items()}) for f, masks in film()[:8]]
    track(film()[:8], config=preset())
    for (frame, masks), (rgb, depth, masks_before) in zip(film(), before):
        np.testing.assert_array_equal(frame.rgb, rgb)
        np.testing.assert_array_equal(frame.depth_m, depth)
        for name in masks_before:
            np.testing.assert_array_equal(masks[name], masks_before[name])


# --- what an RGB-D camera may bring ------------------------------------------------------------


def without_depth(frame: Frame, where: np.ndarray, value: float = 0.0) -> Frame:
    depth = frame.depth_m.copy()
    depth[where] = value
    return Frame(frame.index, frame.time_s, frame.rgb, depth)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 9.0])
def test_without_depth_an_object_goes_on_initialising(value):
    frames = [(without_depth(f, m["left"], value) if k < 6 else f, m) for k, (f, m) in enumerate(film()[:9])]
    estimates = track(frames)
    assert statuses(estimates, "left") == ["initialising"] * 6 + ["tracked"] * 3
    assert set(statuses(estimates, "right")) == {"tracked"}
    assert_honest(estimates)


def test_depth_may_fail_for_a_while():
    frames = [(without_depth(f, m["left"]) if 8 <= k < 12 else f, m) for k, (f, m) in enumerate(film()[:20])]
    estimates = track(frames)
    assert_honest(estimates)
    assert not {estimates[k]["left"].status for k in range(8, 12)} & {*WITH_POSE, Status.OCCLUDED}
    assert set(statuses(estimates, "left")[13:]) <= {"recovered", "tracked"}
    assert set(statuses(estimates, "right")) == {"tracked"}


@pytest.mark.parametrize("half", ["depth_m", "rgb"])
def test_depth_and_colour_of_different_moments_are_no_measurement(half):
    standing = {half: getattr(film()[9][0], half)}
    frames = [(replace(f, **standing) if f.index in range(10, 16) else f, masks) for f, masks in film()[:20]]
    with pytest.warns(Doubt, match="repeats the same image"):
        estimates = track(frames)
    # A camera may deliver one more seldom than the other: for less than a tenth of a second it serves.
    assert [e["left"].T_cam_obj is not None for e in estimates] == [True] * 12 + [False] * 4 + [True] * 4
    deg, mm = errors(estimates, "left")
    assert deg[-4:].max() < 1 and mm[-4:].max() < 3
    paper = track(frames, config=quick("paper"))
    assert paper[14]["left"].T_cam_obj is not None, "the paper doubts nothing"


def test_the_same_image_again_and_again_is_doubted():
    """A camera that hangs: what it shows may have moved on. A few times the same image is a camera that is slow."""
    frozen, masks = film()[9]
    frames = [
        (replace(f, rgb=frozen.rgb, depth_m=frozen.depth_m), masks) if f.index in range(10, 16) else (f, m)
        for f, m in film()[:20]
    ]
    estimates = track(frames)
    doubted = [e["left"].confidence <= DOUBTED for e in estimates]
    assert doubted == [False] * 12 + [True] * 4 + [False] * 4
    assert {(e["left"].status, e["left"].keyframe) for e in estimates[12:16]} == {(Status.DEGRADED, False)}
    assert "same image" in estimates[12]["left"].reason
    assert track(frames, config=quick("paper"))[14]["left"].status is Status.TRACKED, "the paper doubts nothing"


def test_nan_depth_is_no_depth():
    rng = np.random.default_rng(0)
    holes = rng.random((300, 400)) < 0.2
    runs = [track([(without_depth(f, holes, v), m) for f, m in film()[:10]]) for v in (0.0, np.nan, -1.0)]
    assert_same(runs[0], runs[1])
    assert_same(runs[0], runs[2])
    assert np.median(errors(runs[0], "left")[1]) < 3


@pytest.mark.parametrize("name", ["default", "paper"])
def test_a_plain_object_is_no_trouble(name):
    """Without any texture there may be no pose, but there is an answer at every frame."""
    frames = []
    for frame, masks in film()[:8]:
        rgb = frame.rgb.copy()
        rgb[masks["left"]] = (120, 130, 140)
        frames.append((Frame(frame.index, frame.time_s, rgb, frame.depth_m), masks))
    estimates = track(frames, config=preset(name))
    assert_honest(estimates)
    assert set(statuses(estimates, "right")) == {"tracked"}


@pytest.mark.parametrize("name", ["default", "paper"])
def test_a_black_blind_camera_is_no_trouble(name):
    nothing = [
        (Frame(k, k / 30, np.zeros((300, 400, 3), np.uint8), np.zeros((300, 400), np.float32)), masks)
        for k, (_, masks) in enumerate(film()[:6])
    ]
    assert set(statuses(track(nothing, config=preset(name)), "left")) == {"initialising"}
    suddenly = [*film()[:4], *nothing]
    estimates = track(suddenly, config=preset(name))
    assert set(statuses(estimates, "left")[4:]) == {"lost"}


def test_masks_may_touch_the_border_and_be_everything():
    everything = np.ones((300, 400), bool)
    with pytest.warns(Doubt, match="mask of 'left': the whole image in frame 0"):
        estimates = track([(f, {"left": everything}) for f, _ in film()[:4]], names=("left",), config=preset())
    assert statuses(estimates, "left")[0] == "tracked"


# --- refusals ----------------------------------------------------------------------------------


def test_refusals_name_what_came_and_what_is_known():
    method = Point2Pose(CAMERA, quick())
    frame, masks = film()[0]
    with pytest.raises(BadInput, match="masks: got unknown object 'left', expected objects added before: none yet"):
        method.step(frame, masks)
    method.add_object("left")
    with pytest.raises(BadInput, match="masks: got unknown object 'right', expected objects added before: left"):
        method.step(frame, masks)
    with pytest.raises(
        BadInput, match=r"mask of 'left': got 300x400, expected 400x300 \(width x height\) as the camera"
    ):
        method.step(frame, {"left": masks["left"].T})
    with pytest.raises(BadInput, match=r"mask of 'left': got shape \(300, 400, 3\), expected 400x300"):
        method.step(frame, {"left": np.zeros((300, 400, 3), bool)})
    with pytest.raises(BadInput, match=r"mask of 'right': got 10x10, expected 400x300"):
        method.add_object("right", mask=np.ones((10, 10), bool))
    likely = np.where(masks["left"], 0.9, 0.1)
    with pytest.raises(BadInput, match=r"mask of 'left': got values from 0.1 to 0.9, expected .*mask > 0.5"):
        method.step(frame, {"left": likely})
    with pytest.raises(BadInput, match=r"got values from 1 to 2, expected .*labels == k"):
        method.add_object("right", mask=masks["left"] + 2 * masks["right"].astype(np.uint8))
    np.testing.assert_array_equal(Prompt("left", 0, mask=255 * masks["left"].astype(np.uint8)).mask, masks["left"])
    small = Frame(3, 0.0, frame.rgb[:200, :300], frame.depth_m[:200, :300])
    with pytest.raises(BadInput, match=r"frame 3: got 300x200, expected 400x300 \(width x height\) as the camera"):
        method.step(small, {})
    with pytest.raises(
        BadInput, match=r"frame: got ndarray \(300, 400, 3\), expected Frame\(index, time_s, rgb, depth_m\)"
    ):
        method.step(frame.rgb)
    with pytest.raises(BadInput, match=r"add_object: got 'left', expected a name not in use. In use: left"):
        method.add_object("left")
    with pytest.raises(BadInput, match="remove_object: got 'cup', expected one of left"):
        method.remove_object("cup")
    with pytest.raises(BadInput, match=r"correct: got \['left'\], expected one of left. Did you mean left\?"):
        method.correct(["left"], clicks=[[5, 5]])
    with pytest.raises(BadInput, match=r"clicks on 'left': got \(999, 5\), expected pixels within 400x300$"):
        method.correct("left", clicks=[[999, 5]])  # of which frame is not known yet
    for wrong in ([masks["left"]], masks["left"], "left", 3, []):
        with pytest.raises(BadInput, match=rf"masks: got {type(wrong).__name__}, expected a dictionary"):
            method.step(frame, wrong)
    for wrong in ("x", {}, [[1], [1, 2]], np.full((300, 400), "x")):
        with pytest.raises(BadInput, match=r"mask of 'left': got .*, expected \(H, W\) bool"):
            method.correct("left", mask=wrong)
    assert list(method.objects) == ["left"]


@pytest.mark.parametrize("what", ["tracker", "detector", "segmenter"])
def test_unknown_backends_are_refused(what):
    with pytest.raises(BadInput, match=f"{what}: got 'nope', expected one of "):
        Point2Pose(CAMERA, quick(), **{what: "nope"})


def test_a_refused_frame_changes_nothing():
    method = Point2Pose(CAMERA, quick())
    for name in TRUTH:
        method.add_object(name, mask=film()[0][1][name])
    estimates = []
    for frame, masks in film()[:10]:
        with pytest.raises(BadInput):
            method.step(frame, masks | {"left": np.ones((2, 2), bool)})
        with pytest.raises(BadInput):
            method.step(frame, masks | {"cup": masks["left"]})
        estimates.append(method.step(frame, masks))
    assert_same(estimates, track(film()[:10]))


def test_masks_of_numbers_count_where_they_are_above_zero():
    frames = [(f, {n: (200 * m[n]).astype(np.uint8) for n in m}) for f, m in film()[:8]]
    assert_same(track(frames), track(film()[:8]))


def test_a_mask_of_none_is_one_left_out():
    """As the pipeline's own ``masks`` say it of an object of which nobody knows."""
    frames = film()[:6]
    with_none = [(f, m if k < 3 else {"left": m["left"], "right": None}) for k, (f, m) in enumerate(frames)]
    left_out = [(f, m if k < 3 else {"left": m["left"]}) for k, (f, m) in enumerate(frames)]
    assert_same(track(with_none), track(left_out))


@pytest.mark.parametrize("depth_m", [1e15, 1e-30, np.nan])
def test_impossible_depth_is_none(depth_m):
    """A third of the readings wild: poses are those without the readings."""
    rng, frames = np.random.default_rng(0), film()[:8]
    holes = [rng.random(f.shape) < 0.3 * (k > 3) for k, (f, _) in enumerate(frames)]

    def given(value: float) -> list[dict[str, PoseEstimate]]:
        made = [replace(f, depth_m=np.where(h, np.float32(value), f.depth_m)) for (f, _), h in zip(frames, holes)]
        return track([(f, m) for f, (_, m) in zip(made, frames)])

    assert_same(given(depth_m), given(0.0))


def test_time_is_told_stage_by_stage():
    method = Point2Pose(CAMERA, preset())
    method.add_object("left")
    for frame, masks in film()[:4]:
        method.step(frame, {"left": masks["left"]})
    ms = method.stopwatch.last_ms
    assert {"tracking", "registration", "refinement", "map", "total"} <= set(ms)
    assert ms["total"] >= max(v for k, v in ms.items() if k != "total") > 0


# --- clicks ------------------------------------------------------------------------------------


def clicks_on(mask: np.ndarray, seed: int = 0) -> np.ndarray:
    """Three pixels (x, y) well inside a mask."""
    v, u = np.nonzero(cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8)))
    at = np.random.default_rng(seed).choice(len(v), 3, replace=False)
    return np.stack([u[at], v[at]], 1)


def test_three_clicks_serve_as_well_as_masks():
    method = Point2Pose(CAMERA, preset())
    for name, mask in film()[0][1].items():
        method.add_object(name, clicks=clicks_on(mask))
    estimates = []
    for frame, masks in film():
        estimates.append(method.step(frame))
        for name, mask in masks.items():
            assert iou(method.masks[name], mask & (frame.depth_m > 0)) > 0.85  # measured pixels alone are labelled
        assert not (method.masks["left"] & method.masks["right"]).any()
    assert_honest(estimates)
    for name in TRUTH:
        angle_deg, shift_mm = errors(estimates, name)
        assert len(angle_deg) == LENGTH and angle_deg.max() < 4 and shift_mm.max() < 6


def test_what_a_board_hides_is_absent_and_comes_back():
    method = Point2Pose(CAMERA, preset())
    frames = film(board=True)
    for name, mask in frames[0][1].items():
        method.add_object(name, clicks=clicks_on(mask))
    estimates = []
    for frame, _ in frames:
        estimates.append(method.step(frame))
        if frame.index in HIDDEN:
            assert not any(mask.any() for mask in method.masks.values())
    for name in TRUTH:
        got = statuses(estimates, name)
        assert {got[k] for k in HIDDEN} == {"occluded"}
        assert got[-1] == "tracked" and "recovered" in got
        assert iou(method.masks[name], frames[-1][1][name]) > 0.85


def test_a_late_object_is_clicked_while_another_has_masks():
    method = Point2Pose(CAMERA, quick())
    method.add_object("left")
    for frame, masks in film()[:14]:  # by then it has moved, and so told what is of it
        if frame.index == 5:
            method.add_object("right", clicks=clicks_on(masks["right"]))
        estimates = method.step(frame, {"left": masks["left"]})
        np.testing.assert_array_equal(method.masks["left"], masks["left"])
    assert {str(e.status) for e in estimates.values()} == {"tracked"}
    assert iou(method.masks["right"], masks["right"]) > 0.85
    method.correct("right", clicks=clicks_on(film()[14][1]["right"]))
    with pytest.warns(
        Doubt, match="correction of 'right': it is ignored: mask of 'right': got a mask and clicks in frame 14"
    ):
        estimates = method.step(film()[14][0], film()[14][1])
    assert {str(e.status) for e in estimates.values()} == {"tracked"}
    np.testing.assert_array_equal(method.masks["right"], film()[14][1]["right"])
    method.remove_object("right")
    assert set(method.step(film()[15][0], {"left": film()[15][1]["left"]})) == {"left"} == set(method.masks)


def test_clicks_that_do_not_fit_are_refused_and_leave_no_object_behind():
    method, masks = Point2Pose(CAMERA, quick()), film()[0][1]
    good = clicks_on(masks["left"])
    for clicks, what in {
        ((400, 10),): r"\(400, 10\), expected pixels within 400x300",
        ((-1, 10),): r"\(-1, 10\)",
        ((np.nan, 10),): r"\(nan, 10\)",
        ((1, 2, 3),): "at least one",
        (): "at least one",
        "left": "at least one",
    }.items():
        with pytest.raises(BadInput, match=f"clicks on 'cup'.*{what}"):
            method.add_object("cup", clicks=clicks)
    with pytest.raises(BadInput, match="object 'cup': got a mask and clicks"):
        method.add_object("cup", mask=masks["left"], clicks=good)
    with pytest.raises(BadInput, match="object 'cup': got an empty mask"):
        method.add_object("cup", mask=np.zeros((300, 400), bool))
    method.add_object("left", clicks=good)
    with pytest.raises(BadInput, match="clicks on 'cup': got a click that is also one of 'left'"):
        method.add_object("cup", clicks=[good[1] + 0.2, [10, 10]])
    method.add_object("held", mask=masks["right"])
    with pytest.raises(BadInput, match=r"mask of 'cup': got .* pixels are also of 'held'"):
        method.add_object("cup", mask=masks["right"] & (np.indices(masks["right"].shape)[1] % 20 > 0))
    method.remove_object("held")
    with pytest.raises(BadInput, match="mask of 'cup': got the whole image"):
        method.add_object("cup", mask=np.ones((300, 400), bool))
    with pytest.raises(BadInput, match=r"box around 'cup': got \[500.0, .*, expected a box within 400x300"):
        method.add_object("cup", box=(500, 10, 600, 90))
    with pytest.raises(BadInput, match="clicks on 'cup': got a positive and a negative click on one pixel"):
        method.add_object("cup", clicks=[[5, 5], [9, 9]], negative=[[9, 9]])
    for beside_alone in ({"negative": [[9, 9]]}, {"mask": np.zeros((300, 400), bool)}):
        with pytest.raises(BadInput, match=r"object 'left': got (negative clicks alone|an empty mask)"):
            method.correct("left", **beside_alone)  # it has not started yet
    with pytest.raises(BadInput, match="correct: got 'cup', expected one of left"):
        method.correct("cup", clicks=good)
    assert list(method.objects) == ["left"]


def test_a_click_on_anothers_mask_is_refused():
    method, (frame, masks) = Point2Pose(CAMERA, quick()), film()[0]
    on_left = clicks_on(masks["left"])
    method.add_object("left", mask=masks["left"])
    with pytest.raises(BadInput, match=r"clicks on 'right': got \(\d+, \d+\) on the mask of 'left'"):
        method.add_object("right", clicks=on_left)
    assert list(method.objects) == ["left"]
    method.remove_object("left")
    method.add_object("left")
    method.add_object("right", clicks=on_left)
    estimates = method.step(frame, {"left": masks["left"]})
    assert str(estimates["left"].status) == "tracked" and str(estimates["right"].status) == "initialising"
    assert "on the mask of 'left' in frame 0" in estimates["right"].reason
    frame, masks = film()[1]
    method.correct("right", clicks=clicks_on(masks["right"]))  # the last word counts
    assert {str(e.status) for e in method.step(frame, {"left": masks["left"]}).values()} == {"tracked"}
    assert not method.refused
    np.testing.assert_array_equal(method.masks["left"], masks["left"])
    assert iou(method.masks["right"], masks["right"]) > 0.85


@pytest.mark.parametrize("start", ["mask", "clicks", "box", "first step", "some steps"])
def test_every_start_leads_to_the_same_road(start):
    """Whatever says where the objects are at first, the segmenter looks after every frame without a mask."""
    method, frames = Point2Pose(CAMERA, preset()), film()
    for name, mask in frames[0][1].items():
        v, u = np.nonzero(mask)
        how = {"mask": mask, "clicks": clicks_on(mask), "box": (u.min(), v.min(), u.max(), v.max())}
        method.add_object(name, **{start: how[start]} if start in how else {})
    estimates = []
    for k, (frame, masks) in enumerate(frames):
        given = {"first step": k == 0, "some steps": k % 5 == 0}.get(start, False)
        estimates.append(method.step(frame, masks if given else None))
        measured = frame.depth_m > 0
        assert all(iou(method.masks[name] & measured, mask & measured) > 0.85 for name, mask in masks.items())
    assert_honest(estimates)
    for name in TRUTH:
        angle_deg, shift_mm = errors(estimates, name)
        assert len(angle_deg) == LENGTH and angle_deg.max() < 4 and shift_mm.max() < 6


def test_a_correction_mends_what_was_wrong():
    """The right object is started with the left one's half as well; a click there says that it is not of it."""
    method, frames = Point2Pose(CAMERA, quick()), film()
    wrong = frames[0][1]["left"] | frames[0][1]["right"]
    method.add_object("right", mask=wrong)
    method.step(frames[0][0])
    method.step(frames[1][0])
    assert iou(method.masks["right"], frames[1][1]["right"]) < 0.7
    method.correct("right", clicks=clicks_on(frames[2][1]["right"]), negative=clicks_on(frames[2][1]["left"]))
    for frame, masks in frames[2:8]:
        method.step(frame)
        assert iou(method.masks["right"], masks["right"] & (frame.depth_m > 0)) > 0.85


def test_a_correction_onto_another_thing_begins_a_new_map():
    """What was followed was something else: nothing has to be lost first, and what came before stays in its own map."""
    method, frames = Point2Pose(CAMERA, quick()), film()
    method.add_object("left", clicks=clicks_on(frames[0][1]["right"]))
    told = []
    for k, (frame, masks) in enumerate(frames[:9]):
        if k == 5:
            method.correct("left", clicks=clicks_on(masks["left"]), negative=clicks_on(masks["right"]))
        if k == 7:
            method.correct("left", clicks=clicks_on(masks["left"]))  # of the same thing: nothing begins anew
        told.append(method.step(frame)["left"])
    assert [e.map_id for e in told] == [0] * 5 + [1] * 4 and all(e.inliers > 20 for e in told)
    assert told[5].status is Status.RECOVERED and "by the correction" in told[5].reason


def with_holes(frame: Frame, at: np.ndarray) -> Frame:
    """A frame without depth around pixels (N, 2)."""
    depth_m = frame.depth_m.copy()
    for x, y in at:
        depth_m[y - 4 : y + 5, x - 4 : x + 5] = 0
    return Frame(frame.index, frame.time_s, frame.rgb, depth_m)


def test_a_click_without_depth_stops_nobody_and_is_not_used_later():
    """The others go on as if it had not been; the estimate says why there is none, until better clicks come."""
    method, alone, frames = Point2Pose(CAMERA, quick()), Point2Pose(CAMERA, quick()), film()[:9]
    for each in (method, alone):
        each.add_object("left", clicks=clicks_on(frames[0][1]["left"]))
    on_right = clicks_on(frames[2][1]["right"])
    for k, (frame, masks) in enumerate(frames):
        frame = with_holes(frame, on_right) if k == 2 else frame
        if k == 2:
            method.add_object("right", clicks=on_right)
        if k == 6:
            method.correct("right", clicks=clicks_on(masks["right"]))
            alone.add_object("right", clicks=clicks_on(masks["right"]))
        estimates, expected = method.step(frame), alone.step(frame)
        assert_same([{"left": estimates["left"]}], [{"left": expected["left"]}])
        if 2 <= k < 6:
            assert str(estimates["right"].status) == "initialising" and not method.masks["right"]
            x, y = on_right[0]
            why = f"clicks on 'right': got ({x}, {y}) has no depth in frame 2"
            assert estimates["right"].reason.startswith(why) and str(method.refused["right"]).startswith(why)
    assert str(estimates["right"].status) == "tracked" and not method.refused


def test_a_correction_without_depth_is_doubted_and_changes_nothing():
    method, alone, frames = Point2Pose(CAMERA, quick()), Point2Pose(CAMERA, quick()), film()[:6]
    for each in (method, alone):
        each.add_object("left", clicks=clicks_on(frames[0][1]["left"]))
    for k, (frame, masks) in enumerate(frames):
        at = clicks_on(masks["left"])
        frame = with_holes(frame, at) if k == 3 else frame
        expected = alone.step(frame)
        if k == 3:
            method.correct("left", clicks=at)
            with pytest.warns(Doubt, match=r"correction of 'left': it is ignored: .* has no depth in frame 3"):
                estimates = method.step(frame)
            told = estimates["left"].reason
            assert "it is ignored" in told and "has no depth in frame 3" in told, "whoever reads that alone knows"
            estimates["left"] = replace(estimates["left"], reason=expected["left"].reason)
        else:
            estimates = method.step(frame)
        assert_same([estimates], [expected])


def test_buffers_that_a_camera_refills_change_nothing():
    """One buffer each for colour, depth, the camera's pose and the masks, as a driver has them."""
    fresh, reused, frames = Point2Pose(CAMERA, preset()), Point2Pose(CAMERA, preset()), film()
    rgb, depth_m = np.empty_like(frames[0][0].rgb), np.empty_like(frames[0][0].depth_m)
    mask, T_world_cam = np.empty(depth_m.shape, bool), np.empty((4, 4))
    for each in (fresh, reused):
        each.add_object("left")
        each.add_object("right", clicks=clicks_on(frames[0][1]["right"]))
    for frame, masks in frames:
        rgb[:], depth_m[:], mask[:], T_world_cam[:] = frame.rgb, frame.depth_m, masks["left"], np.eye(4)
        got = reused.step(Frame(frame.index, frame.time_s, rgb, depth_m, T_world_cam), {"left": mask})
        expected = fresh.step(replace(frame, T_world_cam=np.eye(4)), {"left": masks["left"]})
        rgb[:], depth_m[:], mask[:], T_world_cam[:] = 0, 0, True, np.nan
        assert_same([got], [expected])


def test_ctrl_c_in_the_middle_of_a_frame_is_heard_after_it(monkeypatch, ctrl_c):
    """Compiled functions that are interrupted raise another error, and half a frame would be no state to go on from."""
    method = Point2Pose(CAMERA, quick())
    method.add_object("left")
    follow = method.tracker.track
    steps = []
    for frame, masks in film()[:6]:
        with monkeypatch.context() as m:
            if frame.index == 3:
                m.setattr(method.tracker, "track", lambda *now: (signal.raise_signal(signal.SIGINT), follow(*now))[1])
                with pytest.raises(KeyboardInterrupt):
                    method.step(frame, {"left": masks["left"]})
            else:
                steps.append(method.step(frame, {"left": masks["left"]}))
    whole = track(film()[:6], ["left"])
    assert_same(steps, whole[:3] + whole[4:])


def test_where_the_segmenter_finds_nothing_only_tracks_on_others_are_misplaced():
    """An object that comes out from behind another has tracks before it has a mask."""
    method, nothing = Point2Pose(CAMERA, quick()), np.zeros((CAMERA.height, CAMERA.width), bool)
    for name in TRUTH:
        method.add_object(name)
    for frame, masks in film()[:4]:
        method.step(frame, masks)
    method.objects["left"].life = method.objects["left"].life.without_pose(Status.OCCLUDED)
    seen = {
        name: obj.observe(frame, nothing if name == "left" else masks[name], method.tracks)
        for name, obj in method.objects.items()
    }
    ids = method.objects["left"].map.ids[seen["left"].tracks.visible]
    for found, given, rejected in (
        (masks["right"], None, 0),  # its tracks lie where nobody else is
        (masks["left"], None, len(ids)),  # on another
        (masks["right"], nothing, len(ids)),  # it is said to be hidden
    ):
        method.front.masks = {"left": nothing, "right": found}
        requests = method.front._misplaced(seen, {"left": given, "right": masks["right"]})
        assert len(np.intersect1d(requests["left"].reject, ids)) == rejected and len(ids) > 10
