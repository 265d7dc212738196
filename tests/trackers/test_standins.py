"""What the adapters do themselves, with tiny models of the documented call signatures in place of the real ones.

Coordinates, memory of points that come and go, and lateness; the real classes are in test_official.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.image import in_image
from p2p_lib.core.raster import from_raster, to_raster
from p2p_lib.core.types import Frame
from p2p_lib.trackers import rollouts, tapir, tapnextpp
from p2p_lib.trackers.cotracker import tracker as cotracker
from p2p_lib.trackers.rollouts import RolloutTracker
from p2p_lib.trackers.tapir import TapirTracker

torch = pytest.importorskip("torch")
SHAPE = (96, 128)


def ramps(t=0, dx=0, dy=0) -> Frame:
    """Red grows with x, green with y: a colour is a place. The whole slides by dx, dy pixels."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    rgb = np.stack([30 + 1.5 * (u - dx), 30 + 2 * (v - dy), np.full(SHAPE, 90.0)], -1)
    return Frame(t, t / 30, np.clip(rgb.round(), 0, 255).astype(np.uint8), np.ones(SHAPE, np.float32))


# --- rasters -------------------------------------------------------------------------------------


@given(st.floats(-0.5, 639.5), st.floats(-0.5, 479.5), st.sampled_from([256, 480]))
def test_rasters_keep_edges_and_come_back(u, v, size):
    uv = np.array([[u, v]])
    assert from_raster(to_raster(uv, (480, 640), size), (480, 640), size) == pytest.approx(uv, abs=1e-9)
    corners = np.array([[-0.5, -0.5], [639.5, 479.5], [319.5, 239.5]])
    np.testing.assert_allclose(to_raster(corners, (480, 640), size), [[0, 0], [size, size], [size / 2, size / 2]])


def test_the_picture_ends_half_a_pixel_beyond_its_centres():
    uv = np.array([[-0.5, 0], [-0.6, 0], [639.5, 479.5], [639.6, 0], [0, 479.6], [np.nan, 0]])
    assert in_image(uv, (480, 640), -0.5).tolist() == [True, False, True, False, False, False]


# --- TAPIR ---------------------------------------------------------------------------------------


class Features(NamedTuple):
    lowres: tuple
    hires: tuple
    resolutions: tuple


class ColourTapir(torch.nn.Module):
    """Finds a query's colour anew in every picture. Its memory counts the pictures a query has seen."""

    num_pips_iter = 4
    coarse_px = 0.0  # the answer at the coarse resolution is this far off

    def get_feature_grids(self, video, is_training):
        assert video.shape[:2] == (1, 1) and video.shape[2] == video.shape[3] and video.min() >= -1 and video.max() <= 1
        return Features((video,) * 3, (video,) * 3, (video.shape[2:4],) * 3)

    def get_query_features(self, video, is_training, query_points, feature_grids):
        t, y, x = query_points[0].T
        assert (t == 0).all()
        colour = video[0, 0, y.long(), x.long()][None]  # the raster's pixel that holds the point
        return Features((colour,) * 3, (colour.clone(),) * 3, feature_grids.resolutions)

    def construct_initial_causal_state(self, num_points, num_resolutions):
        assert num_resolutions == 2
        return [{"seen": torch.zeros(1, num_points, 2)}] * num_resolutions * 4

    def estimate_trajectories(
        self, video_size, is_training, feature_grids, query_features, query_points_in_video,
        query_chunk_size, causal_context, get_causal_context,
    ):  # fmt: skip
        assert query_points_in_video is None and get_causal_context
        picture = feature_grids.lowres[0][0, 0]
        assert tuple(picture.shape[:2]) == tuple(video_size)
        away = torch.cdist(query_features.lowres[-1][0], picture.reshape(-1, 3))
        best = away.argmin(1)
        xy = torch.stack([best % picture.shape[1] + 0.5, best // picture.shape[1] + 0.5], -1)[None, :, None].float()
        seen = causal_context[-1]["seen"][..., 0] + 1
        assert len(causal_context) == 8 and (query_features.hires[-1] == query_features.lowres[-1]).all()
        lost = (away.min(1).values > 0.05)[None].float() * 20 - 10
        # Only the last iteration at each resolution counts: entries 4 and 8.
        wrong, far = torch.full_like(xy, -1e6), -2.0 - seen[..., None]
        return {
            "tracks": [xy + self.coarse_px * (k == 4) if k in (4, 8) else wrong for k in range(9)],
            "occlusion": [lost[..., None]] * 9,
            "expected_dist": [far] * 9,
            "causal_context": [{"seen": seen[..., None].repeat(1, 1, 2)}] * 8,
        }


UV = np.array([[20.0, 70], [100, 15], [64.5, 48.25]])


def seen_count(tracks):
    """How many pictures each point's memory has seen, read from the uncertainty."""
    return np.round(-2 - np.log(tracks.uncertainty / (1 - tracks.uncertainty))).tolist()


def test_tapir_places():
    tracker = TapirTracker(ColourTapir(), size_px=480)
    tracker.start(ramps())
    ids = tracker.add(UV)
    for dx, dy in ((0, 0), (5, 3), (-12, 8)):
        tracks = tracker.track(ramps(1, dx, dy))
        assert tracks.ids.tolist() == ids.tolist() and tracks.visible.all()
        off_px = tracks.uv_px - UV - np.array([dx, dy])
        assert np.abs(off_px).max() < 0.7 and abs(off_px.mean()) < 0.4  # no half pixel lost
    gone = tracker.track(ramps(1, 100, 0))
    assert not gone.visible[1]  # its colour left the picture


@pytest.mark.parametrize(("resolutions", "off_px"), [("mean", 6), ("last", 0)])
def test_tapir_takes_the_mean_over_resolutions_or_the_last(resolutions, off_px):
    model = ColourTapir()
    model.coarse_px = 12.0
    tracker = TapirTracker(model, size_px=96, resolutions=resolutions)
    tracker.start(ramps())
    tracker.add(UV[:1])
    of = ramps(1)
    raster_px = np.array([of.shape[1], of.shape[0]]) / 96
    np.testing.assert_allclose(tracker.track(of).uv_px, UV[:1] + off_px * raster_px, atol=1)


def test_tapir_asks_the_configuration_for_its_resolutions(monkeypatch):
    monkeypatch.setattr(tapir.checkpoints, "load_weights", lambda name: {})
    monkeypatch.setattr(tapir.checkpoints, "fill", lambda *of: None)
    monkeypatch.setattr(tapir, "new_model", ColourTapir)
    asked = []
    monkeypatch.setattr(tapir, "TapirTracker", lambda *of, resolutions: asked.append(resolutions))
    for name in ("paper", "default"):
        tapir.load(preset(name).tracking)
    assert asked == ["last", "mean"]


def test_tapir_memory_follows_its_point():
    tracker = TapirTracker(ColourTapir(), size_px=96)
    tracker.start(ramps())
    tracker.add(UV)
    tracker.track(ramps(1)), tracker.track(ramps(2))
    assert tracker.add(UV[:1]).tolist() == [3]
    assert seen_count(tracker.track(ramps(3))) == [3, 3, 3, 1]
    tracker.drop(np.array([0, 2]))
    tracks = tracker.track(ramps(4))
    assert tracks.ids.tolist() == [1, 3] and seen_count(tracks) == [4, 2]
    np.testing.assert_allclose(tracks.uv_px, UV[[1, 0]], atol=1)
    tracker.drop(np.array([1, 3]))
    assert len(tracker.track(ramps(5))) == 0
    assert tracker.add(UV[:2]).tolist() == [4, 5] and seen_count(tracker.track(ramps(6))) == [1, 1]
    tracker.start(ramps(0))
    assert tracker.add(UV[:1]).tolist() == [0]


# --- rollouts ------------------------------------------------------------------------------------


class Echo:
    """A rollout that answers where its queries were, moved by the newest picture's value."""

    def __init__(self, log, pictures, uv_px):
        self.uv, self.log = uv_px, log
        log.append(("begin", [int(p[0, 0, 0]) for p in pictures], len(uv_px)))

    def step(self, rgb):
        return self.uv + float(rgb[0, 0, 0]), np.ones(len(self.uv), bool), np.full(len(self.uv), 0.25)


def echo(late=0):
    """A tracker of such rollouts, and its log."""
    log = []
    return RolloutTracker("echo", partial(Echo, log), late), log


def value(t):
    return Frame(t, t / 30, np.full((*SHAPE, 3), t, np.uint8), np.ones(SHAPE, np.float32))


def test_points_of_one_frame_share_a_rollout():
    tracker, log = echo()
    with pytest.raises(BadInput, match="start"):
        tracker.add(UV)
    tracker.start(value(0))
    tracker.add(UV[:2]), tracker.add(UV[2:])
    tracker.track(value(1))
    tracker.add(np.zeros((0, 2)))
    tracker.track(value(2))
    tracker.add(UV[:1])
    tracks = tracker.track(value(3))
    assert log == [("begin", [0], 3), ("begin", [2], 1)]
    assert tracks.ids.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(tracks.uv_px, UV[[0, 1, 2, 0]] + 3)


def test_a_late_model_gets_the_pictures_since_the_queries():
    tracker, log = echo(late=3)
    tracker.start(value(0))
    for t in range(1, 6):
        tracker.track(value(t))
    tracker.add(UV)
    tracker.track(value(6))
    assert log == [("begin", [2, 3, 4, 5], 3)]


def test_dropped_points_are_gone_and_empty_rollouts_with_them():
    tracker, _ = echo()
    tracker.start(value(0))
    tracker.add(UV)
    tracker.drop(np.array([1]))  # before its rollout has seen a picture
    tracker.track(value(1))
    tracker.add(UV[:2])
    tracker.drop(np.array([0, 4]))
    tracks = tracker.track(value(2))
    assert tracks.ids.tolist() == [2, 3] and len(tracker._queries) == 2
    np.testing.assert_allclose(tracks.uv_px, UV[[2, 0]] + 2)
    tracker.drop(np.array([2]))
    assert len(tracker._queries) == 1


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_coming_and_going_keeps_rows_and_points_together(seed):
    rng = np.random.default_rng(seed)
    tracker, here = echo()[0], {}
    tracker.start(value(0))
    for t in range(1, 12):
        for _ in range(rng.integers(0, 3)):
            uv = rng.uniform(0, 50, (rng.integers(0, 4), 2))
            here |= dict(zip(tracker.add(uv).tolist(), uv, strict=True))
        gone = [k for k in here if rng.random() < 0.2]
        tracker.drop(np.array(gone, int))
        here = {k: uv for k, uv in here.items() if k not in gone}
        tracks = tracker.track(value(t))
        assert tracks.ids.tolist() == sorted(here)
        if here:
            np.testing.assert_allclose(tracks.uv_px, np.array([here[k] for k in sorted(here)]) + t)


class Sight:
    """A rollout that knows a point by the number painted where it was asked for, and sees it where that is painted."""

    def __init__(self, passes, late, pictures, uv_px):
        assert len(pictures) == late + 1
        self.passes = passes
        passes[-1] += 1
        self.numbers = pictures[0][tuple(np.round(uv_px).astype(int).T[::-1])].astype(int) @ [1, 256, 65536]
        self.waiting = pictures[1:]

    def step(self, rgb):
        self.passes[-1] += 1
        self.waiting.append(rgb)
        painted = self.waiting.pop(0).astype(int) @ [1, 256, 65536]
        uv = np.full((len(self.numbers), 2), np.nan)
        for row, number in enumerate(self.numbers):
            for v, u in np.argwhere(painted == number)[:1] if number else ():
                uv[row] = u, v
        return uv, np.isfinite(uv[:, 0]), np.full(len(uv), 0.1)


def painted(t, numbers):
    """A black picture with numbers at places: number to (u, v)."""
    rgb = np.zeros((*SHAPE, 3), np.uint8)
    for number, (u, v) in numbers.items():
        rgb[v, u] = number % 256, number // 256 % 256, number // 65536
    return Frame(t, t / 30, rgb, np.ones(SHAPE, np.float32))


@pytest.mark.parametrize("late", [0, 3])
def test_an_object_hidden_for_300_frames_keeps_its_points(late):
    """Meanwhile another one turns and asks for new points every fifth frame, more often than rollouts can run."""
    away, back, last = 10, 310, 330 + late
    ids, passes, returned = None, [], None  # passes of the network in each frame: a beginning rollout makes two
    tracker = RolloutTracker("sight", partial(Sight, passes, late), late)

    def shown(t):
        hidden = {} if away <= t < back else {k: (10 + 3 * k + (40 if t >= back else 0), 20) for k in range(1, 13)}
        # The other object's points: each is in sight for 200 frames.
        return hidden | {
            1000 + k: (5 + (k * 7) % 110, 50 + (k * 13) % 40) for k in range(t // 5 - 40, t // 5 + 1) if k >= 0
        }

    tracker.start(painted(0, shown(0)))
    for t in range(1, last):
        passes.append(0)
        tracks = tracker.track(painted(t, shown(t)), urgent=t >= away)
        answered = t - late
        if answered < 0:
            continue
        if ids is None and answered >= 0:
            ids = tracker.add(np.array([shown(answered)[k] for k in range(1, 13)], float))
        elif answered % 5 == 0:
            tracker.add(np.array([shown(answered)[1000 + answered // 5]], float))
        mine = tracks.select(ids[np.isin(ids, tracks.ids)])
        if away <= answered < back:
            assert not mine.visible.any()
        elif answered >= back and returned is None and len(mine) and mine.visible.all():
            returned = answered - back
            np.testing.assert_allclose(mine.uv_px, [(10 + 3 * k + 40, 20) for k in range(1, 13)])
    running = [q for q in tracker._queries if q.run is not None]
    assert returned is not None and returned <= 6, "all of them, and soon"
    assert len(running) <= rollouts.MAX_ROLLOUTS and max(passes) <= 24
    assert len(tracker._queries) - len(running) <= rollouts.MAX_KEPT


class Forgetful:
    """Knows a point by its number (red) and its look (green), which it follows as that changes slowly.

    A point that it has not seen for ``forgets`` pictures it never sees again.
    """

    tells, forgets = 10, 20

    def __init__(self, pictures, uv_px):
        u, v = np.round(uv_px).astype(int).T
        self.number, self.look = pictures[0][v, u, 0].astype(int), pictures[0][v, u, 1].astype(int)
        self.unseen = np.zeros(len(uv_px), int)

    def step(self, rgb):
        uv = np.full((len(self.number), 2), np.nan)
        self.unseen += 1
        for row in np.flatnonzero(self.unseen <= self.forgets):
            for v, u in np.argwhere(rgb[..., 0] == self.number[row])[:1]:
                if abs(int(rgb[v, u, 1]) - self.look[row]) <= self.tells:
                    uv[row], self.look[row], self.unseen[row] = (u, v), int(rgb[v, u, 1]), 0
        return uv, np.isfinite(uv[:, 0]), np.full(len(uv), 0.1)


def looks(t, look, numbers=range(1, 9), dx=0):
    """A black picture with points of these numbers in a row, all of one look."""
    rgb = np.zeros((*SHAPE, 3), np.uint8)
    for number in numbers:
        rgb[20, 10 * number + dx, :2] = number, look
    return Frame(t, t / 30, rgb, np.ones(SHAPE, np.float32))


ROW = np.array([[10.0 * number, 20] for number in range(1, 9)])


@pytest.mark.parametrize("back_as", [100, 2])
def test_what_was_hidden_is_asked_again_as_it_left_and_as_it_was_made(back_as):
    """It turns slowly, is hidden for longer than the model remembers, and comes back elsewhere."""
    tracker = RolloutTracker("forgetful", Forgetful, 0)
    tracker.start(looks(0, 0))
    tracker.add(ROW)
    for t in range(1, 101):
        assert tracker.track(looks(t, t)).visible.all()
    for t in range(101, 200):
        assert not tracker.track(looks(t, 0, numbers=())).visible.any()
    for t in range(200, 203):
        tracks = tracker.track(looks(t, back_as, dx=5))
    assert tracks.visible.all()
    np.testing.assert_allclose(tracks.uv_px - ROW, np.tile([5, 0], (8, 1)))
    assert len(tracker._queries) == 1


def test_a_point_that_the_view_did_not_show_comes_back_with_the_view_that_does():
    tracker = RolloutTracker("forgetful", Forgetful, 0)
    tracker.start(looks(0, 0))
    ids = tracker.add(ROW)
    for t in range(1, 101):
        tracker.track(looks(t, t, numbers=range(1, 9) if t < 60 else range(1, 8)))
    for t in range(101, 200):
        tracker.track(looks(t, 0, numbers=()))
    for t in range(200, 203):
        seen = tracker.track(looks(t, 100)).visible
    assert seen[:7].all() and not seen[7], "it is asked from a view without it"
    for t in range(203, 203 + 100 + rollouts.PATIENCE):
        tracks = tracker.track(looks(t, max(0, 302 - t)))
    assert tracks.visible.all() and tracks.ids.tolist() == ids.tolist()


def test_a_view_in_which_points_are_wrong_is_none_to_ask_them_from():
    tracker = RolloutTracker("forgetful", Forgetful, 0)
    tracker.start(looks(0, 0))
    ids = tracker.add(ROW)
    for t in range(1, 101):
        tracker.track(looks(t, t))
        tracker.reject(ids[6:] if t < 100 else ids[2:])  # at last too many for a view
    tracker.track(looks(101, 0, numbers=()))
    (queries,) = tracker._queries
    assert queries.best.rgb[20, 10, 1] == 99, "not the picture in which most are wrong"
    assert np.isfinite(queries.best.uv_px[:, 0]).tolist() == [True] * 6 + [False] * 2


def test_kept_queries_are_bounded(monkeypatch):
    monkeypatch.setattr(rollouts, "MAX_ROLLOUTS", 3)
    monkeypatch.setattr(rollouts, "MAX_KEPT", 2)
    tracker, _ = echo()
    tracker.start(value(0))
    for t in range(1, 9):
        # The second comes with a single point, the others with two.
        tracker.add(UV[:1] if t == 2 else UV[:2])
        tracks = tracker.track(value(t))
    assert len(tracker._queries) == 5 and len(tracks) == 15
    assert not any(2 in queries.ids for queries in tracker._queries), "the fewest go first"


# --- TAPNext++ -----------------------------------------------------------------------------------


class ColourTapNext(torch.nn.Module):
    """Looks for each point's colour, takes the first place that has it, and moves all points as most of them moved."""

    def forward(self, video, query_points=None, state=None):
        picture = video[0, 0]
        if state is None:
            assert (query_points[..., 0] == 0).all() and query_points[..., 1:].min() >= 0
            at = query_points[0, :, 1:]
            assert at.max() < picture.shape[0]
            state = at, picture[at[:, 0].long(), at[:, 1].long()]
        start, colour = state
        best = torch.cdist(colour, picture.reshape(-1, 3)).argmin(1)
        found = torch.stack([best // picture.shape[1], best % picture.shape[1]], -1) + 0.5
        yx = start + (found - (start.floor() + 0.5)).median(0).values
        bins = torch.arange(picture.shape[1]) + 0.5
        logits = torch.cat([-(bins - yx[:, k : k + 1]).abs() for k in range(2)], 1)
        return yx[None, None], logits[None, None], torch.ones(1, 1, len(yx), 1), state


def test_a_point_without_texture_of_its_own_is_followed_by_its_surroundings():
    """Its colour is seen first elsewhere in the picture; what is around it tells where it went."""
    tracker, uv = tapnextpp.tracker(ColourTapNext()), np.array([[90.0, 60]])
    pictures = []
    for t, moved in enumerate((0, 2, 5)):
        rgb = ramps(t, moved, moved).rgb.copy()
        rgb[59 + moved : 62 + moved, 89 + moved : 92 + moved] = rgb[2:5, 2:5] = 0
        pictures.append(Frame(t, t / 30, rgb, np.ones(SHAPE, np.float32)))
    tracker.start(pictures[0])
    ids = tracker.add(uv)
    for picture, moved in zip(pictures[1:], (2, 5), strict=True):
        tracks = tracker.track(picture)
        assert tracks.ids.tolist() == ids.tolist() and tracks.visible.all()
        np.testing.assert_allclose(tracks.uv_px, uv + moved, atol=0.6)
        assert tracks.uncertainty[0] < 0.01


def test_support_points_lie_around_their_query_and_within_the_picture():
    around = tapnextpp.support_points(np.array([[128.0, 100], [3, 255]])).reshape(2, 64, 2)
    np.testing.assert_allclose(around[0].mean(0), [128, 100])
    assert np.abs(around[0] - [128, 100]).max() == 14 and len(np.unique(around[0], axis=0)) == 64
    assert around[1].min() == 0.5 and around[1].max() == 255.5


# --- CoTracker3 ----------------------------------------------------------------------------------


class ValueCoTracker(torch.nn.Module):
    """Says of each frame the value that its picture had, so that an answer tells of which frame it is."""

    window_len = 16

    def init_video_online_processing(self):
        self.online_ind, self.online_seen = 0, torch.zeros(0)

    def forward(self, video, queries, iters, is_online):
        assert video.shape[1] == 16 and is_online and iters == 6 and (queries[..., 0] == 0).all()
        values = video[0, :, 0, 0, 0]
        self.online_seen = torch.cat([self.online_seen, values if not len(self.online_seen) else values[8:]])
        self.online_ind += 8
        tracks = queries[:, None, :, 1:].repeat(1, len(self.online_seen), 1, 1) + self.online_seen[None, :, None, None]
        sure = torch.ones(tracks.shape[:3])
        return tracks, sure * 0.9, sure * 0.7, None


class Predictor(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.model, self.interp_shape, self.step = ValueCoTracker(), (48, 64), 8


def test_cotracker_answers_for_the_frame_seven_ago_and_keeps_rollouts_apart():
    tracker = cotracker(Predictor())
    tracker.start(value(0))
    tracker.add(UV)
    scale = np.array([127 / 63, 95 / 47])  # what is 1 px for the model, in the picture's
    for t in range(1, 40):
        tracks = tracker.track(value(t))
        if t == 12:
            late = tracker.add(UV[:1] + 1)  # in frame 5
        if t < 7:
            assert not tracks.visible.any() and np.isnan(tracks.uv_px).all()
            continue
        np.testing.assert_allclose(tracks.uv_px[:3], UV + (t - 7) * scale, atol=1e-4)
        np.testing.assert_allclose(tracks.uncertainty, 0.3, atol=1e-6)
        if t > 12:
            np.testing.assert_allclose(tracks.select(late).uv_px, UV[:1] + 1 + (t - 7) * scale, atol=1e-4)
    # 0.9 x 0.7 counts as visible, wherever the point is still in the picture.
    np.testing.assert_array_equal(tracks.visible, in_image(tracks.uv_px, SHAPE, -0.5))
