"""Wide-baseline matching: a segment that short steps lose is found by the corners of the frame before."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin import features, motion_segments, recognition, segment_view, wide_baseline
from p2p_lib.trackers.builtin.landmarks import corners
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from tests.trackers.made_up import CAMERA, DEPTH_M, SHAPE, grid, image, started, texture

UV = grid((110, 211), (80, 161), 20)
CFG = TrackingConfig()


def moved(turn_deg: float, shift_px: tuple[float, float] = (0, 0)) -> np.ndarray:
    """(2, 3) of a plane that turns before the camera and moves sideways."""
    M = cv2.getRotationMatrix2D((160, 120), turn_deg, 1.0)
    M[:, 2] += shift_px
    return M


def seen(M: np.ndarray, blur_px: int = 0, seed: int = 0) -> np.ndarray:
    """(H, W, 3) uint8 of the textured plane, moved, with noise and with motion blur along the rows."""
    rgb = cv2.warpAffine(texture(seed), M, SHAPE[::-1], borderMode=cv2.BORDER_REFLECT).astype(float)
    if blur_px:
        rgb = cv2.blur(rgb, (blur_px, 1))
    rgb += np.random.default_rng(7).normal(0, 2, rgb.shape)
    return np.clip(rgb, 0, 255).astype(np.uint8)


def frame(index: int, rgb: np.ndarray) -> Frame:
    return Frame(index, index / 30, rgb, np.full(SHAPE, DEPTH_M, np.float32))


def places(M: np.ndarray) -> np.ndarray:
    return UV @ M[:, :2].T + M[:, 2]


@pytest.mark.parametrize(
    ("turn_deg", "shift_px", "blur_px"), [(33, (0, 0), 0), (0, (68, 20), 0), (25, (40, 0), 9), (0, (60, 0), 7)]
)
def test_a_step_that_is_too_large_for_short_steps_is_followed(turn_deg, shift_px, blur_px):
    tracker, M = BuiltinTracker(replace(CFG, redetect_every=1000)), moved(turn_deg, shift_px)  # by no landmarks
    tracker.start(frame(0, seen(moved(0))), CAMERA)
    tracker.add(UV)
    tracker.track(frame(1, seen(moved(0))))
    tracks = tracker.track(frame(2, seen(M, blur_px)))
    assert tracks.visible.mean() > 0.8
    error_px = np.linalg.norm(tracks.uv_px - places(M), axis=1)[tracks.visible]
    assert np.median(error_px) < 1.5 and error_px.max() < 4


def test_what_is_followed_is_not_matched(monkeypatch):
    """Matching costs as much as all the rest of a frame."""
    monkeypatch.setattr(motion_segments, "matched", lambda *_: pytest.fail("matched"))
    tracker = BuiltinTracker(CFG)
    tracker.start(frame(0, seen(moved(0))), CAMERA)
    tracker.add(UV)
    for k in range(1, 6):
        assert tracker.track(frame(k, seen(moved(k, (3 * k, 0))))).visible.all()


def test_corners_of_an_outline_do_not_count():
    """They stand still while a round object turns."""
    now, search = image(), np.zeros(SHAPE, bool)
    search[60:180, 90:230] = True
    p, segments = started(UV, now)
    segments.remember(p, now, search)
    (then,) = (segment.last_view for segment in segments.segments)
    found, _ = wide_baseline.corners_of([then], now, search)
    for at in (found.uv_px, then.corners.uv_px):
        assert len(at) and (np.abs(at - [159.5, 119.5]) < [67, 57]).all()


def test_corners_that_a_search_has_found_are_not_looked_for_again(monkeypatch):
    p, segments = started(UV, image())
    segments.remember(p, image(), None)
    (then,) = (segment.last_view for segment in segments.segments)
    known = then.corners.select(np.arange(0, len(then.corners.uv_px), 2))
    monkeypatch.setattr(segment_view, "corners", lambda *_: pytest.fail("looked for again"))
    again = segment_view.SegmentView(then.image, then.uv_px, then.T_cam_seg, found=known)
    np.testing.assert_array_equal(again.corners.uv_px, known.uv_px)


def test_a_segment_whose_points_have_no_depth_has_no_corners():
    p, segments = started(UV, image())
    segments.remember(p, image(), None)
    (then,) = (segment.last_view for segment in segments.segments)
    depth = np.full(SHAPE, DEPTH_M, np.float32)
    for u, v in np.rint(then.uv_px[1:]).astype(int):  # of one point alone it is measured
        depth[max(v - 6, 0) : v + 7, max(u - 6, 0) : u + 7] = 0
    here = segment_view.SegmentView(image(depth_m=depth), then.uv_px, then.T_cam_seg, found=then.corners)
    assert len(then.corners.uv_px) and not len(here.corners.uv_px)


def test_what_is_before_it_is_not_of_it():
    """A hand inside the hull of the points, 4 cm nearer."""
    depth = np.full(SHAPE, DEPTH_M, np.float32)
    p, segments = started(UV, image())
    p.visible[(np.abs(p.uv - [160, 120]) < 25).all(1)] = False
    depth[95:145, 135:185] -= 0.04
    segments.remember(p, image(depth_m=depth), None)
    (then,) = (segment.last_view for segment in segments.segments)
    for at in (then.corners.p_cam, then.surface.p_cam):
        assert len(at) > 20 and at[:, 2].min() > DEPTH_M - 0.01


def test_the_border_of_what_is_searched_is_not_of_the_surface():
    p, segments = started(UV, image())
    search = np.zeros(SHAPE, bool)
    search[90:150, 120:200] = True  # inside of the hull of its points
    segments.remember(p, image(), search)
    (then,) = (segment.last_view for segment in segments.segments)
    u, v = CAMERA.project(then.surface.p_cam).T
    assert len(u) > 200 and u.min() > 121 and u.max() < 197 and v.min() > 91 and v.max() < 147


def test_what_is_hidden_is_not_carried_along():
    p, segments = started(UV, image())
    segments.remember(p, image(), None)
    (then,) = (segment.last_view for segment in segments.segments)
    depth = np.full(SHAPE, DEPTH_M, np.float32)
    depth[:, 160:] -= 0.04
    pairs = then.carried(np.eye(4), image(depth_m=depth))
    assert len(pairs) > 100 and pairs.uv_px[:, 0].max() < 161
    np.testing.assert_allclose(CAMERA.project(pairs.p_seg), pairs.uv_px, atol=0.01)


def test_it_is_searched_for_where_depth_and_colour_fit():
    p, segments = started(UV, image())
    segments.remember(p, image(), None)
    (then,) = (segment.last_view for segment in segments.segments)
    red, depth = texture().copy(), np.full(SHAPE, DEPTH_M, np.float32)
    red[:, :120, 1] //= 3
    depth[:, 200:] += 0.2
    region = then.region(image(red, depth))
    assert region[100:140, 130:190].all()
    assert region[:, 80:100].mean() < 0.2 and not region[:, 200:].any()


def test_another_texture_is_no_match():
    p, segments = started(UV, image())
    segments.remember(p, image(), None)
    (segment,) = segments.segments
    here = corners(image(texture(5)), None, wide_baseline.CORNERS)
    assert wide_baseline.matched(segment.last_view, here, CFG, np.random.default_rng(0)) is None


def test_what_stands_still_does_not_hold_back_what_moves_slowly():
    """Two fifths of the corners are of shine and shadow, which stay where they are while the rest moves by 1 cm."""
    p, segments = started(UV, image())
    segments.remember(p, image(), None)
    (segment,) = segments.segments
    own, moved_m = segment.last_view.corners, np.array([0.008, 0.006, 0])
    moves = np.arange(len(own.uv_px)) % 5 > 1
    found = replace(own, p_cam=own.p_cam + moves[:, None] * moved_m)
    match = wide_baseline.matched(segment.last_view, found, CFG, np.random.default_rng(0))
    assert np.abs((match.T_cam_seg - segment.last_view.T_cam_seg)[:3, 3] - moved_m).max() < 0.001


def test_what_matches_alone_carry_is_soon_not_seen():
    """From match to match errors add up: an image that shows the points in no way they are known by carries them on."""
    tracker = BuiltinTracker(replace(CFG, return_ncc=1.0, min_ncc=1.0, coast_frames=0, textureless_contrast=1e3))
    tracker.start(frame(0, seen(moved(0))), CAMERA)
    tracker.add(UV)
    shares, sigmas = [], []
    for k in range(1, CFG.linger_frames + 3):
        tracks = tracker.track(frame(k, seen(moved(12 * k))))
        shares.append(tracks.visible.mean())
        sigmas.append(tracks.uncertainty.mean())
    assert min(shares[: CFG.linger_frames]) > 0.8
    assert shares[-1] == 0
    assert (np.diff(sigmas[: CFG.linger_frames]) > 0).all()


def test_a_template_taken_in_blur_is_replaced_at_the_first_sharp_sight():
    sharp, blurred = image(), image(cv2.GaussianBlur(texture(), (0, 0), 4))
    p, _ = started(UV, blurred)
    before = p.templates.fine.contrast[p.template[:, 0]].copy()
    recognition.sharpen_templates(p, np.arange(len(p)), sharp)
    assert (p.templates.fine.contrast[p.template[:, 0]] > 1.4 * before).mean() > 0.8
    p.verified[:] = False
    eye = np.tile(np.eye(2, dtype=np.float32), (len(p), 1, 1))
    recognition.find(p, np.arange(len(p)), p.uv.copy(), eye, np.ones(len(p)), sharp, CFG)
    assert p.verified.mean() > 0.8


def test_a_template_as_sharp_as_the_image_stays():
    p, _ = started(UV, image())
    pixels = p.templates.fine.pixels.copy()
    recognition.sharpen_templates(p, np.arange(len(p)), image(cv2.GaussianBlur(texture(), (0, 0), 1)))
    np.testing.assert_array_equal(p.templates.fine.pixels, pixels)


def test_matches_are_each_others_nearest():
    rng = np.random.default_rng(0)
    wanted = rng.normal(size=(20, features.SIZE)).astype(np.float32)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    order = rng.permutation(20)
    which, found = features.mutual_match(wanted, wanted[order], 0.9)
    np.testing.assert_array_equal(order[found], which)
    assert len(which) == 20
    near = wanted[:1] + 0.05 * wanted[1:2]  # the nearest of this one is the first, which has a nearer one
    near /= np.linalg.norm(near)
    which, _ = features.mutual_match(np.vstack([wanted, near]), wanted, 0.9)
    assert 20 not in which
