"""The 3D page of a run, taken apart again: what moves where, when; and what a browser makes of it."""

import base64
import html
import re
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from p2p_lib.apps import cli
from p2p_lib.core import se3
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.datasets.models import find_models, load_points
from p2p_lib.datasets.runs import load_run
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.viewer import _legend, _thinned, scene_page, show_run, write_page

FRAMES = 40


@pytest.fixture(scope="module")
def folder(made, tmp_path_factory):
    """The run of known errors, with a surface and keypoints of the box: 30 of its corners, every third seen."""
    folder = shutil.copytree(made.run.path, tmp_path_factory.mktemp("view") / "run")
    p_obj = se3.transform(
        made.evaluation.objects["box"].T_obj_model, load_points(find_models(made.sequence)["box"])[:30]
    )
    log, nobody = KeypointLog(), (np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, bool))
    for i in range(FRAMES):
        log.add(i, "box", np.arange(0, 30, 3), np.tile([100.0 + i, 50], (10, 1)))
    log.save(folder, {"box": (np.arange(30), p_obj, np.ones(30, bool)), "can": nobody})
    (folder / "meshes").mkdir(exist_ok=True)
    body = trimesh.creation.box((0.16, 0.2, 0.06))
    body.visual.vertex_colors = np.tile([200, 40, 40, 255], (len(body.vertices), 1))
    body.export(folder / "meshes" / "box.ply")
    return folder


@pytest.fixture(scope="module")
def page(folder, made):
    return scene_page(Playback.of(folder, made.sequence), points=500)


@pytest.fixture(scope="module")
def messages(page):
    """(seconds, message) of the recording inside the page, as the viewer's own client unpacks it."""
    return unpacked(page)


def unpacked(page):
    import msgspec
    import zstandard

    packed = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)[1])
    data = zstandard.ZstdDecompressor().decompress(packed[8:], struct.unpack("<Q", packed[:8])[0])
    (length,) = struct.unpack("<Q", data[:8])
    return msgspec.msgpack.decode(data[8 : 8 + length])


def told(messages, kind, name):
    return [(t, m) for t, m in messages["messages"] if m["type"] == kind and m.get("name") == name]


def test_the_page_lasts_as_long_as_the_run(messages, made):
    times_s = made.run.objects["box"].time_s
    assert messages["durationSeconds"] == pytest.approx(times_s[-1] - times_s[0] + 1 / 30)


@pytest.mark.parametrize("name", ["box", "can"])
def test_objects_move_as_they_were_estimated_to(messages, made, name):
    obj = made.run.objects[name]
    rows = np.flatnonzero(obj.has_pose)
    moves = [(t, m["position"]) for t, m in told(messages, "SetPositionMessage", f"/objects/{name}")][-len(rows) :]
    turns = [m["wxyz"] for _, m in told(messages, "SetOrientationMessage", f"/objects/{name}")][-len(rows) :]
    np.testing.assert_allclose([t for t, _ in moves], obj.time_s[rows] - obj.time_s[0], atol=1e-6)
    np.testing.assert_allclose([p for _, p in moves], obj.T_cam_obj[rows, :3, 3], atol=1e-6)
    np.testing.assert_allclose(np.array(turns)[:, [1, 2, 3, 0]], se3.quaternion_xyzw(obj.T_cam_obj[rows]), atol=1e-6)


def test_an_object_without_a_pose_is_not_drawn(messages, made):
    """The box has none in frame 8: it goes then and comes back in frame 9."""
    obj = made.run.objects["box"]
    shown = {
        round(t * 30): m["visible"] for t, m in told(messages, "SetSceneNodeVisibilityMessage", "/objects/box") if t
    }
    assert shown[8] is False and shown[9] is True and obj.status[8] == "lost"


def test_everything_has_its_place(messages):
    names = {m["name"] for _, m in messages["messages"] if "name" in m}
    assert {"/camera", "/points", "/objects/box/map/surface", "/objects/box/map/keypoints", "/paths/can"} <= names
    assert "/objects/can/map/surface" not in names and "/objects/can/map/keypoints" not in names


def test_points_and_objects_are_of_the_same_frames(folder, made):
    """Where the run is longer than the page may be large, both leave out the same, and the page says so."""
    page = scene_page(Playback.of(folder, made.sequence), moments=5, points=500)
    messages, rows = unpacked(page), [0, 9, 19, 29, 39]
    clouds = told(messages, "PointCloudMessage", "/points")
    assert [round(t * 30) for t, _ in clouds] == rows
    obj = made.run.objects["can"]
    moves = {round(t * 30): m["position"] for t, m in told(messages, "SetPositionMessage", "/objects/can")}
    assert set(moves) == {row for row in rows if obj.has_pose[row]}
    for row, position in moves.items():
        np.testing.assert_allclose(position, obj.T_cam_obj[row, :3, 3], atol=1e-6)
    assert f"5 of {FRAMES} frames are shown, about 500 points of each, up to 2.5 m away" in page
    assert messages["durationSeconds"] == pytest.approx(obj.time_s[-1] - obj.time_s[0] + 1 / 30)


def test_points_do_not_cover_a_surface(folder, made, monkeypatch):
    """Those on the box are left out where it stands; in frame 8 it has no pose, and they are all there."""
    shown, bare = Playback.of(folder, made.sequence), Playback.of(made.run.path, made.sequence)
    half_m, frame = shown.meshes["box"].extents / 2, shown.frame(20)

    def away_m(playback: Playback) -> np.ndarray:
        T_cam_obj = shown.objects["box"].T_cam_obj[20]
        beyond_m = np.abs(se3.transform(se3.inverse(T_cam_obj), playback.cloud(20, frame, 3000)[0])) - half_m
        outside = (beyond_m > 0).any(1)
        return np.where(outside, np.linalg.norm(np.maximum(beyond_m, 0), axis=1), -beyond_m.max(1))

    assert away_m(bare).min() < 0.002 and away_m(shown).min() > 0.01
    assert (away_m(bare) > 0.015).sum() == len(away_m(shown))
    assert len(shown.cloud(8, shown.frame(8), 3000)[0]) == len(bare.cloud(8, bare.frame(8), 3000)[0])
    monkeypatch.setattr(Playback, "of_kept_map", lambda self, name: np.zeros(len(self.frame_index), bool))
    assert len(away_m(shown)) == len(away_m(bare)), "of another map it is not drawn"


def test_the_page_needs_nothing_from_outside(page):
    assert len(page) < 3e6
    for kind in ("script", "link", "img", "iframe"):
        assert not re.search(rf"<{kind}[^>]+(src|href)=[\"']?(https?:)?//", page), kind


def test_the_legend_names_objects_and_statuses(page):
    assert "synthetic" in page or "crossing" in page
    for word in (">box</b>", ">can</b>", "tracked", "degraded", "lost"):
        assert word in page, word


def test_the_page_of_an_offline_run_says_so(made):
    refined = replace(made.run, info=made.run.info | {"offline": True})
    said = [_legend(Playback.of(run, made.sequence), 1, 1) for run in (made.run, refined)]
    assert ["offline" in legend for legend in said] == [False, True]


def test_a_browser_draws_it(page, browser, tmp_path):
    (tmp_path / "view.html").write_text(page)
    image = browser.screenshot(tmp_path / "view.html", tmp_path / "shot.png", (700, 490), wait_ms=1000)
    middle = image[70:420, 140:560]
    red = (middle[..., 0] > 120) & (middle[..., 1] < 90) & (middle[..., 2] < 90)
    assert red.sum() > 200, "the box's surface, which is red"
    assert (np.ptp(middle, axis=-1) > 40).mean() > 0.01


def test_inside_a_notebook_it_is_the_same_page(folder, made):
    shown, _ = show_run(folder, made.sequence).shown
    inside = html.unescape(re.search(r'srcdoc="([^"]*)"', shown["text/html"])[1])
    assert inside == (folder / "view.html").read_text() and shown["text/plain"] == "<view.html>"


def test_a_run_whose_sequence_is_gone_is_shown_without_pictures(folder, made, tmp_path):
    moved = shutil.copytree(folder, tmp_path / "moved")
    text = (moved / "run.json").read_text()
    (moved / "run.json").write_text(re.sub(r'"path": [^,]+,', f'"path": "{tmp_path}/nowhere",', text))
    playback = Playback.of(moved)
    assert playback.sequence is None and playback.frame(0) is None and playback.masks(0) == {}
    assert write_page(moved) == moved / "view.html" and "__VISER_EMBED_DATA__" in (moved / "view.html").read_text()


def test_thinning_keeps_the_shape():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    ball.visual.vertex_colors = np.tile([10, 20, 30, 255], (len(ball.vertices), 1))
    thin = _thinned(ball)
    assert len(ball.faces) > 20_000 >= len(thin.faces) > 1000
    np.testing.assert_allclose(np.linalg.norm(thin.vertices, axis=1), 0.1, atol=1e-3)
    assert (thin.visual.vertex_colors == [10, 20, 30, 255]).all(), "colours stay"
    assert thin.area == pytest.approx(ball.area, rel=0.02)


# --- what both viewers show ------------------------------------------------------------------------


def test_masks_are_the_datasets_or_those_that_were_kept(made, folder, tmp_path):
    import cv2

    playback = Playback.of(folder, made.sequence)
    np.testing.assert_array_equal(playback.masks(3)["box"], made.sequence.masks(3)["box"])
    kept = shutil.copytree(folder, tmp_path / "kept")
    (kept / "masks" / "box").mkdir(parents=True)
    mask = np.zeros((480, 640), np.uint8)
    mask[10:20, 30:60] = 255
    cv2.imwrite(str(kept / "masks" / "box" / "000003.png"), mask)
    masks = Playback.of(kept, made.sequence).masks(3)
    assert masks.keys() == {"box"} and masks["box"].sum() == 300


# --- the command -----------------------------------------------------------------------------------


def test_view_writes_the_page(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert cli.main(["view", str(folder), "--out", str(tmp_path / "a" / "page.html")]) == 0
    assert capsys.readouterr() == (f"Written to {tmp_path / 'a' / 'page.html'}. Open it in a browser.\n", "")
    assert "__VISER_EMBED_DATA__" in (tmp_path / "a" / "page.html").read_text()
    assert load_run(folder), "the run is as it was"


def test_view_of_no_run_is_one_line(tmp_path, capsys):
    assert cli.main(["view", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "no run there" in err and err.count("\n") == 1
