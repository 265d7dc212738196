"""Plots of texture, tracks and poses say what the measures say."""

from dataclasses import replace

import numpy as np
import pytest
from pandas import DataFrame, concat

from p2p_lib.core.backends import make_tracker
from p2p_lib.core.config import preset
from p2p_lib.datasets.runs import load_run
from p2p_lib.figures import overlay
from p2p_lib.figures.scenes import Scene
from p2p_lib.run import run
from studies import texture
from studies.texture import RecordedTracker

FRAMES = 14


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """The printed tin for a moment: its scene and its study."""
    video = texture.fading_label(1.0, FRAMES)
    record = RecordedTracker(make_tracker("builtin", preset().tracking))
    result = run(video, tmp_path_factory.mktemp("run") / "run", tracker=record, progress=False)
    scene = Scene(video, load_run(result.path), result.evaluation)
    return scene, texture.study(video, result.evaluation, record)["tin"]


def test_dots_lie_on_the_tracks_in_the_colour_of_their_error(told):
    scene, study = told
    region = (100, 60, 500, 420)
    plain = scene.draw(10, region, 800, axes=False, trail=0)
    drawn = texture.draw_tracks(scene, study, 10, region, 800)
    sure = study.tracks[(study.tracks.frame == 10) & (study.tracks.error_px < 1)]
    u, v = np.rint((sure[["u_px", "v_px"]].to_numpy() + 0.5 - region[:2]) * 2 - 0.5).astype(int).T
    wanted = overlay.value_colours(sure.error_px, 0, texture.FAR_PX)
    assert len(u) > 10 and np.abs(drawn[v, u].astype(int) - wanted).max(1).mean() < 12
    assert (np.abs(plain[v, u].astype(int) - wanted).max(1) > 30).mean() > 0.8
    assert (drawn != plain).any(2).mean() < 0.1, "only dots are added"


def test_the_story_has_a_image_and_a_point_per_label(told):
    scene, study = told
    image = texture.draw_tracks(scene, study, 10, (100, 60, 500, 420), 200)
    whole, halves = DataFrame([study.measure()]), study.windows(7)
    measures = {"1": whole, "0.3": halves}
    figure = texture.texture_story({"1": image, "0.3": image}, measures, "synthetic")
    top, bottom = figure.subfigs
    assert [a.get_title(loc="left") for a in top.axes] == ["1", "0.3"]
    points = [c.get_offsets() for c in bottom.axes[0].collections]
    np.testing.assert_allclose(points[0], whole[["texture", "track_px"]])
    assert [len(p) for p in points] == [1, 2]


def test_the_least_and_the_most_textured_stand_side_by_side(told):
    scene, study = told
    faint = replace(study, object="faint", frames=study.frames.assign(texture=0.2 * study.frames.texture))
    middle = replace(study, object="middle", frames=study.frames.assign(texture=0.5 * study.frames.texture))
    studies = {"full": study, "faint": faint, "middle": middle}
    top, bottom = texture.extremes_story(dict.fromkeys(studies, scene), studies, 7).subfigs
    titles = [axis.get_title(loc="left") for axis in top.axes]
    assert [title.partition(":")[0] for title in titles] == ["faint", "full"]
    assert f"{study.measure()['texture']:.1f} levels/px" in titles[1]
    assert [len(points.get_offsets()) for points in bottom.axes[0].collections] == [2, 2, 2]


def test_windows_are_joined_across_labels_by_their_frames(told):
    study = told[1]
    windows = {"1": study.windows(7), "0.3": study.windows(7)[:1]}
    figure = texture.same_frames(windows)
    lines = figure.axes[1].get_lines()
    assert [line.get_label() for line in lines] == ["frames 0 to 6", "frames 7 to 13"]
    first, last = study.windows(7).add_auc
    np.testing.assert_allclose(lines[0].get_ydata(), [first] * 2)
    np.testing.assert_allclose(lines[1].get_ydata(), [last, np.nan])
    found = texture.RankCorrelation(-0.5, -0.8, 0.1, 3, 3)
    titled = texture.windows_against_texture(windows, [found, found])
    assert titled.axes[0].get_title(loc="left") == "Spearman -0.50, 95 % [-0.80, +0.10], n = 3"


def test_shares_of_tracks_end_at_all_of_them(told):
    figure = texture.track_errors({"1": told[1]})
    (line,) = figure.axes[0].get_lines()
    assert line.get_ydata()[-1] == 1 and line.get_xdata()[-1] == told[1].tracks.error_px.max()


def test_what_was_not_run_is_a_dash_with_its_reason(told):
    table = texture.measure_table({"tin": told[1].measure(), "mustard": "not there"}, "sequence")
    assert table["sequence"].tolist() == ["tin", "mustard"] and table["why not"].tolist() == ["", "not there"]
    assert np.isnan(table["ADD AUC [%]"][1]) and table["scored frames"][0] == FRAMES
    assert "why not" not in texture.measure_table({"tin": told[1].measure()})


def test_correlations_need_three_sequences(told):
    windows = told[1].windows(2)
    every = concat([windows, *(windows.assign(sequence=f"other {k}") for k in range(2))])
    table = texture.correlation_table({"one": windows, "three": every, "none": windows[:0]})
    assert table["sequences or objects"].tolist() == [1, 3, 0] and table["windows"].tolist() == [7, 21, 0]
    assert table["texture and ADD AUC"].isna().tolist() == [True, False, True]
    rho = texture.correlate(every)[1].rho
    assert table["texture and ADD AUC"][1].startswith(f"{rho:+.2f} [")


def test_real_windows_stand_before_the_synthetic_ones(told):
    windows = told[1].windows(7)
    figure = texture.windows_against_texture({"mustard": windows[:1]}, synthetic=concat([windows, windows]))
    assert [len(c.get_offsets()) for c in figure.axes[0].collections] == [4, 1]
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["synthetic", "mustard"]
