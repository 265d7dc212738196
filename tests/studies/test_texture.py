"""Visible texture, errors of recorded tracks, and what goes with what: against closed forms and independent counts."""

from dataclasses import replace

import numpy as np
import pytest
from pandas import DataFrame, Series
from scipy import stats

from p2p_lib import Point2Pose, preset
from p2p_lib.core.backends import make_tracker
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.run import run
from studies import texture
from studies.texture import RecordedTracker

FRAMES = 14


@pytest.fixture(scope="module")
def video():
    return texture.fading_label(1.0, FRAMES)


def followed(video, tracker, frames=FRAMES):
    """Estimates of the tin, with its masks."""
    method = Point2Pose(video.camera, preset("default"), tracker)
    method.add_object("tin")
    told = [method.step(video.frame(t), video.masks(t))["tin"] for t in range(frames)]
    return method, np.stack([e.T_cam_obj for e in told])


# Visible texture


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 200])
def test_the_sobel_magnitude_of_a_ramp_is_its_slope_whatever_its_direction(angle_deg):
    y, x = np.mgrid[:60, :80].astype(float)
    along = x * np.cos(np.radians(angle_deg)) + y * np.sin(np.radians(angle_deg))
    gray = np.clip(128 + 1.2 * (along - along.mean()), 0, 255)
    found = texture.sobel_magnitude(np.repeat(np.rint(gray)[..., None], 3, 2).astype(np.uint8))[2:-2, 2:-2]
    assert found.mean() == pytest.approx(1.2, rel=0.03)  # rounded to whole grey levels


def test_the_outline_of_an_object_is_no_texture():
    rgb, mask = np.zeros((40, 40, 3), np.uint8), np.zeros((40, 40), bool)
    rgb[10:30, 10:30], mask[10:30, 10:30] = 200, True
    assert texture.visible_texture(rgb, mask) == 0
    assert texture.visible_texture(rgb, np.ones_like(mask)) > 1
    rgb[10:30, 20:30] = 210  # a step of 10, seen by two columns at 5 grey levels per pixel
    inner = 20 - 2 * texture.MARGIN_PX
    assert texture.visible_texture(rgb, mask) == pytest.approx(2 * 5 / inner, rel=0.02)


def test_a_mask_that_is_all_rim_has_no_texture_to_speak_of():
    mask = np.zeros((30, 30), bool)
    mask[10:14, 5:25] = True
    assert np.isnan(texture.visible_texture(np.zeros((30, 30, 3), np.uint8), mask))


def test_texture_grows_with_the_contrast_of_the_print(video):
    shown = []
    for contrast in (0.0, 0.1, 1.0):
        faded = texture.fading_label(contrast, FRAMES)
        shown.append(texture.visible_texture(faded.frame(5).rgb, faded.masks(5)["tin"]))
        np.testing.assert_array_equal(faded.masks(5)["tin"], video.masks(5)["tin"])
    assert shown[0] < shown[1] < shown[2] and shown[2] > 3 * shown[0]


# Recorded tracks


def test_a_recorded_tracker_changes_nothing(video):
    plain, recorded = (make_tracker("builtin", preset().tracking) for _ in range(2))
    _, T = followed(video, plain)
    record = RecordedTracker(recorded)
    method, T_recorded = followed(video, record)
    np.testing.assert_array_equal(T, T_recorded)
    assert record.name == method.tracker.name == "builtin" and method.tracker._answers is record._answers


def test_tracks_with_known_noise_have_the_error_of_that_noise(video):
    config, scene = preset("default").with_values({"oracle.noise_px": 0.8}).oracle, TrueScene.of(video)
    record = RecordedTracker(OracleTracker(scene, config))
    followed(video, record)
    tracks = record.keypoints(scene)["tin"]
    assert len(tracks.frame) > 200 and set(np.unique(tracks.frame)) == set(range(1, FRAMES))
    # The distance of a Gaussian in the plane is Rayleigh's; noise at the rim now and then falls off the image's tin.
    assert np.median(tracks.error_px) == pytest.approx(0.8 * np.sqrt(2 * np.log(2)), rel=0.1)


class _Late:
    """The truth, two frames late."""

    name, latency_frames = "late", 2

    def __init__(self, scene):
        self._truth, self._seen = OracleTracker(scene, replace(preset().oracle, noise_px=0.0)), []

    def start(self, frame: Frame, camera=None) -> None:
        self._seen = [frame]

    def track(self, frame, search=None, urgent=False) -> Tracks:
        self._seen.append(frame)
        k = len(self._seen) - 3
        if k < 1:
            self._truth.start(self._seen[0])
            return Tracks(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))
        return self._truth.track(self._seen[k])

    def __getattr__(self, name):
        return getattr(self._truth, name)


def test_answers_that_come_late_are_laid_to_their_own_frame(video):
    scene = TrueScene.of(video)
    record = RecordedTracker(_Late(scene))
    method = Point2Pose(video.camera, preset("default"), record)
    method.add_object("tin")
    for t in range(FRAMES):
        method.step(video.frame(t), video.masks(t))
    list(method.finish())
    tracks = record.keypoints(scene)["tin"]
    assert tracks.frame.max() == FRAMES - 1 and tracks.error_px.max() < 1e-6


def test_a_study_joins_texture_tracks_and_pose(video, tmp_path):
    record = RecordedTracker(make_tracker("builtin", preset().tracking))
    result = run(video, tmp_path / "run", tracker=record, progress=False)
    study = texture.study(video, result.evaluation, record)["tin"]
    whole, score = Series(study.measure()), result.evaluation.objects["tin"].as_dict()
    assert (whole.frames, whole.add_auc) == (FRAMES, score["add_auc"])
    assert whole.texture == pytest.approx(np.mean([texture.visible_texture(video.frame(t).rgb, video.masks(t)["tin"])
                                                   for t in range(FRAMES)]))  # fmt: skip
    assert whole.track_px < 1 and whole.tracks > 10


# Measures and windows


def made(frame_index, error_px, add_m):
    """A study whose tracks are one per frame and error."""
    n, k = len(frame_index), len(error_px)
    uv = np.tile(np.array(error_px, float), n)
    tracks = DataFrame({"frame": np.repeat(frame_index, k), "u_px": uv, "v_px": 0 * uv, "error_px": uv})
    add_m = np.asarray(add_m, float)
    frames = DataFrame({"frame": frame_index, "texture": np.arange(float(n)), "add_m": add_m, "adds_m": add_m / 2})
    return texture.ObjectTexture("s", "o", frames, tracks)


def test_a_measure_is_of_its_own_frames():
    study = made([0, 1, 2, 5, 6, 7], [1.0, 2.0, 9.0], [0.0, 0.01, 0.02, 0.05, np.inf, 0.2])
    first, last = (Series(study.measure(*span)) for span in ((0, 3), (5,)))
    assert (first.frames, first.texture, first.track_px, first.tracks) == (3, 1.0, 2.0, 3.0)
    assert first.add_auc == pytest.approx(90) and first.adds_auc == pytest.approx(95)
    assert last.add_auc == pytest.approx(100 * 0.5 / 3), "a frame without a pose counts as zero"
    with pytest.raises(MissingData, match="no scored frame from 3 to 5"):
        study.measure(3, 5)


def test_windows_cover_the_scored_frames_and_leave_out_the_sparse():
    study = made([*range(10, 20), 21, *range(30, 38)], [1.0], np.zeros(19))
    assert [(w.start, w.stop, w.frames) for w in study.windows(10).itertuples()] == [(10, 20, 10), (30, 40, 8)]


# Rank correlation


def test_rho_is_spearmans_and_unmoved_by_any_growing_function():
    rng = np.random.default_rng(1)
    x = rng.normal(size=60)
    y = x + rng.normal(size=60)
    found = texture.rank_correlation(x, np.exp(3 * y), resamples=500)
    assert found.rho == pytest.approx(stats.spearmanr(x, y).statistic)
    assert found.low < found.rho < found.high and (found.pairs, found.groups) == (60, 60)
    # Fisher's approximation for Spearman (Bonett and Wright, 2000), an interval of another kind.
    half = 1.96 * np.sqrt((1 + found.rho**2 / 2) / 57)
    assert found.low == pytest.approx(np.tanh(np.arctanh(found.rho) - half), abs=0.08)
    assert found.high == pytest.approx(np.tanh(np.arctanh(found.rho) + half), abs=0.08)


def test_windows_of_one_sequence_do_not_pass_for_independent():
    rng = np.random.default_rng(0)
    level, group = rng.normal(size=(2, 6)), np.repeat(np.arange(6), 20)
    x, y = (value[group] + 0.1 * rng.normal(size=120) for value in level)
    alone, together = texture.rank_correlation(x, y), texture.rank_correlation(x, y, group)
    assert alone.rho == together.rho and together.groups == 6
    assert together.high - together.low > 2 * (alone.high - alone.low)


def test_pairs_without_a_value_are_left_out_and_too_few_are_refused():
    x = [1.0, 2, 3, np.nan, 5, 6]
    assert texture.rank_correlation(x, [1.0, 2, 3, 9, np.nan, 4], resamples=50).pairs == 4
    with pytest.raises(BadInput, match="2 independent groups"):
        texture.rank_correlation(x, x, [0, 0, 0, 1, 1, 1])


def test_sequences_that_are_not_there_give_their_reason(monkeypatch):
    monkeypatch.delenv("P2P_DATA", raising=False)
    assert "no such folder" in texture.present(["nothing"])["nothing"]
    assert texture.present(["nothing"], "not now") == {"nothing": "not now"}
