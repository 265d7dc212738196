"""Depth of another moment than its colour is moved onto it, and depth of the same moment stays where it is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import DEPTH_MOVED, Doubt
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets.runs import ObjectRun
from p2p_lib.evaluation.evidence import depth_as_taken, surface_in_view
from p2p_lib.extended.default import compose
from p2p_lib.extended.depth_lag import DepthLag
from p2p_lib.extended.frame_guard import FrameGuard
from p2p_lib.figures.playback import Playback
from p2p_lib.offline.finished import Finished
from tests.fixtures.late_depth import FAR_M, NEAR_M, H, W, film


def wrong(depth: np.ndarray, now: np.ndarray) -> float:
    """The share of measured pixels that are off."""
    return float((depth[depth > 0] != now[depth > 0]).mean())


@pytest.mark.parametrize(
    ("px", "roll_deg", "late"), [(30, 0, 1), (-40, 0, 0.5), (36, 0, -1), (20, 4, 1), (45, -2, 0.5)]
)
def test_depth_that_is_late_or_early_is_moved_onto_colour(px, roll_deg, late):
    lag = DepthLag()
    for frame, now in film(px, roll_deg, late):
        depth = lag.moved(frame)
        if frame.index:
            assert depth is not None and wrong(depth, now) < 0.25 * wrong(frame.depth_m, now)
            assert (depth > 0).mean() > 0.85
    assert lag.off_px == pytest.approx(abs(late) * np.hypot(px, px / 3), rel=0.2)


@pytest.mark.parametrize(("px", "roll_deg", "late"), [(0, 0, 0), (30, 0, 0), (60, 4, 0), (3, 0, 1), (30, 0, 0.25)])
def test_depth_of_the_same_moment_or_off_by_little_stays(px, roll_deg, late):
    lag = DepthLag()
    assert [lag.moved(frame) for frame, _ in film(px, roll_deg, late)] == [None] * 6 and not lag.off_px


def test_of_a_camera_that_takes_them_apart_small_offsets_are_undone_too():
    slow, lag = film(8, 0, 1), DepthLag()
    assert [lag.moved(frame) for frame, _ in slow] == [None] * 6
    for frame, _ in film(30, 0, 1):
        lag.moved(frame)
    for k, (frame, now) in enumerate(slow):
        depth = lag.moved(frame)
        if k:
            assert depth is not None and wrong(depth, now) < 0.3 * wrong(frame.depth_m, now)


def test_what_fits_hardly_better_elsewhere_stays():
    lag = DepthLag()
    lag.off_px = 20.0  # known to take them apart
    assert [lag.moved(frame) for frame, _ in film(16, 0, 0.07)] == [None] * 6


def test_of_a_camera_that_stands_still_no_motion_is_asked():
    lag = DepthLag()
    lag._flow = None
    assert [lag.moved(frame) for frame, _ in film(0, 0, 0)] == [None] * 6


def test_what_tells_nothing_moves_nothing():
    lag, (first, second, *_) = DepthLag(), (frame for frame, _ in film(30, 0, 1))
    assert lag.moved(first) is None
    assert lag.moved(replace(second, depth_m=np.ones_like(second.depth_m))) is None, "no step of depth"
    for strip in (np.s_[:20], np.s_[:, :20]):
        parts = [Frame(f.index, f.time_s, f.rgb[strip].copy(), f.depth_m[strip].copy()) for f in (first, second)]
        assert [lag.moved(part) for part in parts] == [None, None], "too narrow"
    half = Frame(2, 0.1, first.rgb[::2].copy(), first.depth_m[::2].copy())
    assert lag.moved(half) is None, "of another size than the one before"
    for frame, _ in film(40, 0, 1):
        assert lag.moved(replace(frame, depth_m=frame.depth_m[::-1].copy())) is None, "steps are on no edges"


def test_what_moves_before_a_camera_is_not_its_motion():
    """Three bands of the image move differently; the largest, with late depth, is not most of it."""
    lag, bands, rows = DepthLag(), (film(30, 0, 1), film(0, 0, 0), film(-30, 0, 0)), np.split(np.arange(H), [200, 340])
    for k in range(6):
        rgb = np.concatenate([band[k][0].rgb[at] for band, at in zip(bands, rows, strict=True)])
        depth = np.where(np.arange(H)[:, None] < 200, bands[0][k][0].depth_m, np.float32(FAR_M))
        assert lag.moved(Frame(k, k / 30, rgb, depth)) is None


def test_every_frame_is_looked_at_and_the_first_offset_is_warned_of():
    guard = FrameGuard(lag=DepthLag())
    frames = film(30, 0, 1)
    guard(frames[0][0])
    with pytest.warns(
        Doubt, match="depth and colour: of different moments while the camera moves, 3. px apart"
    ) as told:
        used = [guard(frame) for frame, _ in frames[1:]]
    assert len(told) == 1
    for frame, (given, now) in zip(used, frames[1:], strict=True):
        assert wrong(frame.depth_m, now) < 0.25 * wrong(given.depth_m, now)
        assert not frame.remark and guard(used[-1]) is used[-1]


def test_it_is_a_mechanism():
    camera, frames = Camera(525.0, 525.0, 319.5, 239.5, W, H), film(30, 0, 1)
    for spec, kept in (("all but lag", True), ("lag", False)):
        before = compose(camera, preset().with_values({"method.mechanisms": spec})).before
        before(frames[0][0])
        if kept:
            assert before(frames[1][0]) is frames[1][0]
        else:
            with pytest.warns(Doubt, match="different moments"):
                assert before(frames[1][0]) is not frames[1][0]


class Film:
    """The sequence of a run whose camera is a frame late with its depth."""

    camera = Camera(525.0, 525.0, (W - 1) / 2, (H - 1) / 2, W, H)
    frames, now = zip(*film(30, 0, 1), strict=True)

    def frame(self, i: int) -> Frame:
        """As the camera took it."""
        return self.frames[i]


SAID = (), (Doubt("depth and colour", kind=DEPTH_MOVED),)


@pytest.mark.parametrize("of", [Finished, lambda run, film: Playback(run, film, {})], ids=["offline", "drawn"])
def test_what_is_made_or_drawn_of_a_run_takes_depth_as_the_run_did(of):
    for doubts, moved in zip(SAID, (False, True), strict=True):
        of_all = {"": SimpleNamespace(frame_index=np.arange(6))}
        made = of(SimpleNamespace(doubts=doubts, objects=of_all), Film())
        for i, (frame, now) in enumerate(zip(Film.frames, Film.now, strict=True)):
            if moved and i:
                assert wrong(made.frame(i).depth_m, now) < 0.25 * wrong(frame.depth_m, now)
            else:
                assert made.frame(i) is frame


def test_a_run_is_judged_by_depth_as_it_took_it(tmp_path):
    """The cards before the wall, at their true places, are an object's surface."""
    uv = np.argwhere(Film.now[3] == NEAR_M)[:, ::-1]
    corners = Film.camera.unproject(
        (uv[:, None] + [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]).reshape(-1, 2),
        np.full(4 * len(uv), NEAR_M),
    )
    faces = (4 * np.arange(len(uv))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "cards.ply")
    seen = PoseEstimate("cards", 3, 0.1, Status.TRACKED, np.eye(4), 1.0)
    cards = ObjectRun.of("cards", [seen], SimpleNamespace(truth={}), [None])
    depths = (depth_as_taken(Film(), said, 1) for said in SAID)
    late, moved = (surface_in_view(cards, Film(), tmp_path / "cards.ply", None, 1, of).on_surface[0] for of in depths)
    assert late < 0.75 and moved > 0.9
