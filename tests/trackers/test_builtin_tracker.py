"""The long-range tracker on a printed card whose motion is known exactly, hidden and back elsewhere."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.builtin import features
from p2p_lib.trackers.builtin.image_only import ImageOnlyTracker
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from p2p_lib.trackers.lk import LkTracker
from tests.trackers import made_up

SHAPE, HIDDEN, LENGTH = (300, 400), range(20, 55), 75
CARD = (110, 140)


def printed(seed: int, shape: tuple[int, int]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    colour = [
        sum(
            cv2.resize(rng.normal(0, 1, (shape[0] // s, shape[1] // s)), shape[::-1], interpolation=cv2.INTER_CUBIC)
            for s in (5, 11, 30)
        )
        for _ in range(3)
    ]
    return np.clip(128 + 32 * np.stack(colour, -1), 0, 255).astype(np.uint8)


def motion(t: int) -> np.ndarray:
    """(2, 3) of the card at frame t: it drifts and turns; while hidden it jumps, turns by 30 degrees, comes nearer."""
    if t < HIDDEN.stop:
        turn, scale, place = 0.6 * t, 1.0, np.array([110 + 1.5 * t, 130 + 0.5 * t])
    else:
        turn, scale, place = 42 - 0.5 * t, 1.2, np.array([290 - 0.5 * t, 180 - 0.5 * t])
    M = cv2.getRotationMatrix2D((CARD[1] / 2, CARD[0] / 2), turn, scale)
    M[:, 2] += place - np.array(CARD[::-1]) / 2
    return M


@cache
def film(hide: bool = True) -> list[Frame]:
    card, wall = printed(1, CARD), printed(2, SHAPE) // 2 + 60
    rng, frames = np.random.default_rng(3), []
    for t in range(LENGTH):
        rgb, depth = wall.copy(), np.full(SHAPE, 0.9, np.float32)
        if not (hide and t in HIDDEN):
            here = cv2.warpAffine(np.ones(CARD, np.uint8), motion(t), SHAPE[::-1]) > 0
            rgb[here] = cv2.warpAffine(card, motion(t), SHAPE[::-1])[here]
            depth[here] = 0.5 / np.sqrt(np.linalg.det(motion(t)[:, :2]))  # larger because nearer
        noisy = np.clip(rgb + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)
        frames.append(Frame(t, t / 30, noisy, depth))
    return frames


def on_card() -> np.ndarray:
    y, x = np.mgrid[18 : CARD[0] - 18 : 12, 18 : CARD[1] - 18 : 12]
    return np.stack([x.ravel(), y.ravel()], -1).astype(float)


def truth(t: int) -> np.ndarray:
    return on_card() @ motion(t)[:, :2].T + motion(t)[:, 2]


def follow(tracker, frames: list[Frame]) -> list[Tracks]:
    tracker.start(frames[0])
    tracker.add(truth(0))
    return [tracker.track(frame) for frame in frames[1:]]


@cache
def followed() -> list[Tracks]:
    return follow(BuiltinTracker(TrackingConfig()), film())


def error_px(tracks: Tracks, t: int) -> np.ndarray:
    return np.linalg.norm(tracks.uv_px - truth(t), axis=1)


def test_follows_without_drift():
    tracks = followed()[HIDDEN.start - 2]
    error = error_px(tracks, HIDDEN.start - 1)[tracks.visible]
    assert tracks.visible.mean() > 0.9 and np.median(error) < 0.3 and (error < 2).mean() > 0.97


def test_hidden_points_are_invisible():
    shown = [followed()[t - 1].visible.mean() for t in HIDDEN]
    assert max(shown[1:]) < 0.1 and np.mean(shown[3:]) < 0.05


@cache
def film_with_its_double() -> list[Frame]:
    """The card's double sways at the lower left all the time, and is there when the card is hidden."""
    card, frames = printed(1, CARD), []
    for t, frame in enumerate(film()):
        M = np.array([[1.0, 0, 4 + 8 * np.sin(t / 6)], [0, 1, SHAPE[0] - CARD[0] - 2]])
        here = cv2.warpAffine(np.ones(CARD, np.uint8), M, SHAPE[::-1]) > 0
        here &= frame.depth_m > 0.8  # behind the card, before the wall
        rgb, depth = frame.rgb.copy(), frame.depth_m.copy()
        rgb[here] = cv2.warpAffine(card, M, SHAPE[::-1])[here]
        depth[here] = 0.7
        frames.append(Frame(t, t / 30, rgb, depth))
    return frames


def test_what_is_rejected_on_a_double_is_looked_for_elsewhere():
    """The caller knows by its mask that the double is not the card; both are tracked."""
    tracker, frames, shown = BuiltinTracker(TrackingConfig()), film_with_its_double(), []
    tracker.start(frames[0])
    ids = tracker.add(truth(0))
    double = tracker.add(on_card() + np.array([4, SHAPE[0] - CARD[0] - 2]))
    for t, frame in enumerate(frames[1:], 1):
        tracks = tracker.track(frame, urgent=t >= HIDDEN.stop)
        mine = tracks.select(ids)
        astray = mine.visible & ((error_px(mine, t) > 20) | (t in HIDDEN))
        shown.append((astray.mean(), (mine.visible & ~astray).mean(), tracks.select(double).visible.mean()))
        if t >= HIDDEN.start + 2:
            tracker.reject(ids[astray])
    astray, home, double_seen = np.array(shown).T
    while_hidden = slice(HIDDEN.start + 2, HIDDEN.stop - 1)
    assert (astray[while_hidden] > 0.1).mean() < 0.25, "after a rejection it is not found there at once again"
    assert home[HIDDEN.stop + 2 :].min() > 0.7 and double_seen[5:].mean() > 0.6


def test_a_part_that_slides_off_slowly_is_not_held_back():
    """One card at first; then its right part goes its own way at a pixel a frame, on which the majority is silent."""
    card, wall = printed(1, CARD), printed(2, SHAPE) // 2 + 60
    cut, start, rng = 88, 10, np.random.default_rng(4)
    right, frames = on_card()[:, 0] > cut, []
    for t in range(45):
        rgb, depth, off = wall.copy(), np.full(SHAPE, 0.9, np.float32), max(t - start, 0)
        rgb[100:210, 100 : 100 + cut], depth[100:210, 100 : 100 + cut] = card[:, :cut], 0.5
        moved = np.s_[100:210, 100 + cut + off : 240 + off]
        rgb[moved], depth[moved] = card[:, cut:], 0.5
        frames.append(Frame(t, t / 30, np.clip(rgb + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8), depth))
    tracker = BuiltinTracker(TrackingConfig())
    tracker.start(frames[0])
    ids, wrong = tracker.add(on_card() + 100), []
    for t, frame in enumerate(frames[1:], 1):
        told = tracker.track(frame).select(ids)
        at = on_card() + 100 + np.outer(right, [max(t - start, 0), 0])
        wrong.append((np.linalg.norm(told.uv_px - at, axis=1) > 1.5) | ~told.visible)
    seam = np.abs(on_card()[:, 0] - cut) < 12  # its surroundings are of both parts
    wrong, right, left = np.array(wrong), right & ~seam, ~right & ~seam
    assert wrong[:, right].mean() < 0.1 and wrong[:, left].mean() < 0.05
    assert wrong[start : start + 12, right].mean() < 0.15, "before they are far enough to be another body"


def test_points_come_back_elsewhere_turned_and_scaled():
    back = HIDDEN.stop + 5
    tracks = followed()[back - 1]
    right = tracks.visible & (error_px(tracks, back) < 2)
    assert right.mean() > 0.7 and (error_px(tracks, back)[tracks.visible] < 4).mean() > 0.95
    plain = follow(LkTracker(TrackingConfig()), film())[back - 1]
    assert (plain.visible & (error_px(plain, back) < 4)).mean() < 0.05


def test_what_comes_into_view_is_remembered():
    """A camera that goes past a printed wall sees points that it follows from other sides."""
    tracker, uv_px = BuiltinTracker(TrackingConfig()), made_up.grid((40, 140), (60, 180), 12)
    tracker.start(_seen_past(0), made_up.CAMERA)
    tracker.add(uv_px)
    (segment,) = tracker._segments.segments
    for dx in range(8, 160, 8):
        tracker.track(_seen_past(dx))
    assert len(segment.landmarks.views) >= 2


def _seen_past(dx: int) -> Frame:
    rgb = np.roll(made_up.texture(), dx, 1)
    return Frame(dx // 8, dx / 240, rgb, np.full(made_up.SHAPE, made_up.DEPTH_M, np.float32))


def test_uncertainty_grows_with_the_error():
    error, sigma = [], []
    for t, tracks in enumerate(followed(), 1):
        if t not in HIDDEN:
            error.append(error_px(tracks, t)[tracks.visible])
            sigma.append(tracks.uncertainty[tracks.visible])
    error, sigma = np.concatenate(error), np.concatenate(sigma)
    assert (0 <= sigma).all() and (sigma <= 1).all()
    low, high = np.quantile(sigma, [0.3, 0.8])
    assert np.mean(np.minimum(error[sigma > high], 8)) > 1.5 * np.mean(np.minimum(error[sigma < low], 8))


def test_causal_bit_for_bit():
    short = follow(BuiltinTracker(TrackingConfig()), film()[:30])
    for mine, whole in zip(short, followed()):
        for name in ("ids", "uv_px", "visible", "uncertainty"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(whole, name))


def test_rejected_points_are_looked_for_anew_and_dropped_ones_are_gone():
    tracker = BuiltinTracker(TrackingConfig())
    tracker.start(film()[0])
    ids = tracker.add(truth(0))
    tracker.track(film()[1])
    tracker.drop(ids[::2])
    assert (tracker.add(truth(1)[:3]) == len(ids) + np.arange(3)).all()
    tracker.reject(ids[1::4])
    for t in range(2, 7):
        tracks = tracker.track(film()[t])
    assert set(tracks.ids) == set(ids[1::2]) | {len(ids), len(ids) + 1, len(ids) + 2}
    back = tracks.visible[np.isin(tracks.ids, ids[1::4])]
    assert back.mean() > 0.8


def test_suggested_places_are_verified():
    frames = film()
    tracker = BuiltinTracker(TrackingConfig(redetect_every=1000))
    tracker.start(frames[0])
    ids = tracker.add(truth(0))
    tracker.track(frames[1])
    tracker.track(frames[HIDDEN.stop])  # far off: lost
    lost = ~tracker.track(frames[HIDDEN.stop]).visible
    assert lost.mean() > 0.8
    tracker.suggest(ids, truth(HIDDEN.stop) + np.array([60.0, 0]))  # wrong
    assert tracker.track(frames[HIDDEN.stop]).visible.mean() < 0.2
    tracker.suggest(ids, truth(HIDDEN.stop) + 0.8)
    tracks = tracker.track(frames[HIDDEN.stop])
    assert tracks.visible.mean() > 0.7
    assert np.median(error_px(tracks, HIDDEN.stop)[tracks.visible]) < 0.5


def test_a_third_of_the_points_is_no_proof_of_a_suggestion():
    """Something like it shows a part of its points where a caller expects it."""
    frames, t = film(), HIDDEN.stop
    tracker = BuiltinTracker(TrackingConfig(redetect_every=1000))
    tracker.start(frames[0])
    ids = tracker.add(truth(0))
    tracker.track(frames[1])
    other = np.zeros(CARD, np.uint8)
    other[:, : round(0.6 * CARD[1])] = 1
    there = cv2.warpAffine(other, motion(t), SHAPE[::-1]) > 0
    rgb = np.where(there[..., None], cv2.warpAffine(printed(7, CARD), motion(t), SHAPE[::-1]), frames[t].rgb)
    like = replace(frames[t], rgb=rgb)
    for _ in range(2):
        tracker.track(like)
    for _ in range(2):
        tracker.suggest(ids, truth(t) + 0.8)
        assert tracker.track(like).visible.mean() < 0.1


def test_what_of_it_is_2d_alone_sees_no_depth_and_still_finds_points_again():
    """At corners of the card, as the sampler takes them: each is found by its own appearance."""
    frames, back = film(), HIDDEN.stop + 8
    inner = cv2.erode(cv2.warpAffine(np.ones(CARD, np.uint8), motion(0), SHAPE[::-1]), np.ones((25, 25))) > 0
    uv = features.detect(cv2.cvtColor(frames[0].rgb, cv2.COLOR_RGB2GRAY), inner, 60).astype(float)
    on_it = (uv - motion(0)[:, 2]) @ np.linalg.inv(motion(0)[:, :2]).T
    told = {}
    for depth in ("measured", "made up"):
        tracker = ImageOnlyTracker(TrackingConfig())
        tracker.start(frames[0])
        tracker.add(uv)
        for t in range(1, back + 1):
            depth_m = frames[t].depth_m if depth == "measured" else np.full(SHAPE, 3.0 - t / 30, np.float32)
            told[depth, t] = tracker.track(replace(frames[t], depth_m=depth_m))
    for t in range(1, back + 1):
        np.testing.assert_array_equal(told["measured", t].uv_px, told["made up", t].uv_px)
    assert max(told["measured", t].visible.mean() for t in list(HIDDEN)[6:]) < 0.15
    there = on_it @ motion(back)[:, :2].T + motion(back)[:, 2]
    off_px = np.linalg.norm(told["measured", back].uv_px - there, axis=1)
    visible = told["measured", back].visible
    assert (visible & (off_px < 2)).mean() > 0.5 and (off_px[visible] < 4).mean() > 0.8
    assert tracker.suggest(np.arange(3), there[:3]) is None


def test_dropped_points_of_it_take_their_description_along():
    tracker = ImageOnlyTracker(TrackingConfig())
    tracker.start(film()[0])
    ids = tracker.add(truth(0))
    kept = tracker._described[1::2].copy()
    tracker.drop(ids[::2])
    np.testing.assert_array_equal(tracker._described, kept)
    tracker.start(film()[0])
    assert len(tracker._described) == 0 and len(tracker.track(film()[1])) == 0


@pytest.mark.parametrize("call", ["add", "track"])
def test_nothing_before_start(call):
    tracker = BuiltinTracker(TrackingConfig())
    with pytest.raises(BadInput, match="start"):
        tracker.add(np.zeros((1, 2))) if call == "add" else tracker.track(film()[0])


def test_blank_pictures_and_no_points():
    blank = [Frame(t, t / 30, np.full((*SHAPE, 3), 80, np.uint8), np.ones(SHAPE, np.float32)) for t in range(4)]
    tracker = BuiltinTracker(TrackingConfig())
    tracker.start(blank[0])
    assert len(tracker.track(blank[1])) == 0
    tracker.add(np.array([[5.0, 5.0], [200.0, 150.0]]))
    tracks = tracker.track(blank[2], urgent=True)
    assert len(tracks) == 2 and np.isfinite(tracks.uncertainty).all() and tracks.uncertainty.max() <= 1
