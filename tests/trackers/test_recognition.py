"""Points by their appearance on made-up images: following, gates, coasting, templates, search near a prediction."""

import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin import recognition
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from tests.trackers.made_up import CAMERA, DEPTH_M, grid, image, noisy, shifted, started, texture

UV = grid((60, 260), (60, 180), 40)
CFG = TrackingConfig()
EYE = np.eye(2, dtype=np.float32)


def found_at(p, uv, now, sigma_px=1.0):
    """Which points are found near uv."""
    n = len(p)
    p.verified[:] = False
    recognition.find(p, np.arange(n), uv, np.tile(EYE, (n, 1, 1)), np.full(n, sigma_px), now, CFG)
    return p.verified.copy()


def test_follows_a_shift():
    p, _ = started(UV, image())
    recognition.follow(p, image(), shifted(7, -4), CFG)
    assert p.verified.all() and not p.coasting.any()
    np.testing.assert_allclose(p.uv, UV + np.array([7, -4]), atol=0.05)


def test_the_same_texture_in_another_colour_is_another_point():
    p, _ = started(UV, image())
    other = texture().astype(float)
    other[..., 0] += 40
    other[..., 1] -= 40 * 0.299 / 0.587  # brightness stays
    assert found_at(p, UV, image()).all()
    assert not found_at(p, UV, image(np.clip(other, 0, 255).astype(np.uint8))).any()


def test_the_same_texture_at_a_fraction_of_the_contrast_is_another_point():
    p, _ = started(UV, image())
    assert found_at(p, UV, image((128 + 0.6 * (texture() - 128.0)).astype(np.uint8))).all()
    assert not found_at(p, UV, image((128 + 0.25 * (texture() - 128.0)).astype(np.uint8))).any()


def test_another_texture_does_not_bring_a_point_back():
    p, _ = started(UV, image())
    assert found_at(p, UV, image(texture(5))).mean() < 0.1


@pytest.mark.parametrize(("sigma_px", "found"), [(0.3, False), (4.0, True)])
def test_a_look_alike_farther_off_than_predicted_is_refused(sigma_px, found):
    p, _ = started(UV, image())
    assert (found_at(p, UV + np.array([5, 0]), image(), sigma_px).mean() > 0.7) == found


def test_a_changed_appearance_coasts_for_a_while():
    """No alignment is good enough for this configuration: Lucas-Kanade alone carries the points."""
    cfg = TrackingConfig(min_ncc=1.0)
    p, _ = started(UV, image())
    variance = p.cov[:, 0, 0].copy()
    for t in range(cfg.coast_frames):
        recognition.follow(p, noisy(t), noisy(t + 1), cfg)
        assert p.verified.mean() > 0.9 and (p.coasting == t + 1).mean() > 0.9
    assert (p.cov[:, 0, 0] > variance).all()
    recognition.follow(p, noisy(8), noisy(9), cfg)
    assert not p.verified.any()


def test_what_does_not_come_home_does_not_coast():
    cfg = TrackingConfig(min_ncc=1.0)
    p, _ = started(UV, image())
    recognition.follow(p, image(), image(texture(5)), cfg)
    assert p.verified.mean() < 0.1


def test_a_template_is_added_where_the_scale_or_the_appearance_has_changed():
    p, _ = started(UV, image())
    recognition.update_templates(p, image(), CFG, 1)
    assert ((p.template >= 0).sum(1) == 1).all()
    p.warp[0] *= 1.5
    p.ncc[1] = 0.8
    recognition.update_templates(p, image(), CFG, 1)
    assert (p.template >= 0).sum(1).tolist() == [2, 2] + [1] * (len(p) - 2)


def test_the_template_of_the_present_scale_is_compared_and_the_first_is_never_replaced():
    p, _ = started(UV[:1], image())
    first = p.templates.fine.pixels[p.template[0, 0]].copy()
    for turn in range(12):
        p.warp[0] = (1.5 ** (1 + turn % 4)) * EYE
        recognition.store_templates(p, np.array([0]), shifted(turn), turn)
    assert (p.template[0] >= 0).sum() == CFG.templates
    np.testing.assert_array_equal(p.templates.fine.pixels[p.template[0, 0]], first)
    scales = p.template_warp[0, :, 0, 0]
    p.warp[0] = scales[3] * EYE
    assert recognition.best_template(p, np.array([0]))[0][0] == 3


def test_points_that_come_and_go_leave_no_templates():
    tracker = BuiltinTracker(CFG)
    tracker.start(Frame(0, 0.0, texture(), np.full((240, 320), DEPTH_M, np.float32)), CAMERA)
    stays = tracker.add(UV[:4])
    p = tracker._points
    looks = p.templates.fine.select(p.template[:, 0])
    for _ in range(20):
        tracker.drop(tracker.add(UV[4:]))
    p = tracker._points
    assert len(p.templates.fine) <= 4 * len(UV) and len(p) == len(stays)
    np.testing.assert_array_equal(p.templates.fine.select(p.template[:, 0]).pixels, looks.pixels)
    tracker.add(UV[4:])
    p = tracker._points
    assert len(np.unique(p.template[:, 0])) == len(p), "every point has its own"
