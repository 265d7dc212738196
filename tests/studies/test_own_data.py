"""Clicks where they are, rims in the right colour, meshes that fill their image; the surface against measured depth."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import trimesh

from p2p_lib.apps.check import Finding, Level
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, Status
from p2p_lib.datasets.prompts import prompts_in
from p2p_lib.figures import overlay, style
from p2p_lib.synthetic.render import render
from studies import mesh_view, own_data
from studies.own_data import errors_against
from studies.surface import carton

V, U = np.mgrid[:120, :160]
DISC, WIDE = (np.hypot(U - 80, V - 60) <= radius for radius in (30, 38))
FRAME = Frame(0, 0.0, np.full((120, 160, 3), 128, np.uint8), np.where(DISC, 0.6, 1.0).astype(np.float32))


def has(image, colour, at_least=1):
    return (image == style.rgb(colour)).all(-1).sum() >= at_least


def test_clicks_are_drawn_where_they_are():
    image = overlay.draw_clicks(FRAME.rgb, [Prompt("mug", 0, [[40, 50]])], {"mug": style.OBJECTS[0]})
    v, u = np.nonzero((image == style.rgb(style.OBJECTS[0])).all(-1))
    assert abs(u.mean() - 40) < 0.5 and abs(v.mean() - 50) < 0.5


def test_a_rim_on_the_background_is_vermillion():
    lost = style.STATUS[Status.LOST][0]
    good, bad = (
        own_data.mask_image(FRAME, DISC, "good"),
        own_data.mask_image(FRAME, WIDE, "bad"),
    )
    near = [np.abs(image.astype(int) - style.rgb(lost)).sum(-1).min() for image in (good, bad)]
    assert near[0] > 60 > near[1]
    sheet = own_data.masks_image(FRAME, {"a": DISC, "b": WIDE}, width_px=200)
    assert sheet.shape[1] == 404


def test_a_click_is_where_one_would_click():
    (prompt,) = prompts_in({"disc": DISC, "hidden": np.zeros_like(DISC)}, frame=3)
    assert prompt.name == "disc" and prompt.frame == 3
    assert np.hypot(*(prompt.points_px[0] - [80, 60])) < 2


def test_clicks_are_spread_over_an_object():
    long = (np.abs(U - 80) <= 60) & (np.abs(V - 60) <= 15)
    (prompt,) = own_data.spread_clicks({"bar": long, "hidden": np.zeros_like(DISC)}, frame=3)
    u, v = prompt.points_px.astype(int).T
    assert (prompt.name, prompt.frame) == ("bar", 3) and long[v, u].all() and len(u) == 3
    assert u.min() < 40 and u.max() > 120 and (np.abs(v - 60) < 15).all()


def test_portraits_show_the_surface_from_its_sides():
    body = trimesh.creation.box((0.05, 0.2, 0.1))
    front = np.array([200, 30, 30, 255], np.uint8)
    body.visual.vertex_colors = np.tile(front, (len(body.vertices), 1))
    portrait = mesh_view.portrait(body, 200, 150)
    covered = (portrait < 250).any(-1)
    assert 0.05 < covered.mean() < 0.7 and not covered[[0, -1]].any() and not covered[:, [0, -1]].any()
    assert mesh_view.portraits({"a": body, "b": body}, (0, 90)).shape[:2] == (524, 604)
    np.testing.assert_allclose(np.sort(overlay.tight_box(body).size_m), [0.05, 0.1, 0.2], atol=1e-6)


def test_the_table_of_findings_holds_what_is_not_fine():
    findings = [Finding("files", Level.OK, "all"), Finding("camera", Level.WRONG, "K is off", "Take another.")]
    table = own_data.findings_table({"K of another": findings, "fine": findings[:1]})
    assert table.to_numpy().tolist() == [["K of another", "camera", "WRONG", "K is off", "Take another."]]


CAMERA = Camera(300, 300, 159.5, 119.5, 320, 240)
N = 4


class Estimates(SimpleNamespace):
    def __len__(self):
        return N


@pytest.fixture(scope="module")
def made():
    """A carton that moves before a wall; in the last frame a board hides its left half, in the second it is lost."""
    body = carton(0).mesh
    T = se3.exp(np.c_[np.linspace(0, 0.4, N), np.zeros(N), np.full(N, 0.5), np.zeros((N, 3))])
    T[:, :3, 3] = np.c_[np.linspace(-0.05, 0.05, N), np.zeros(N), np.full(N, 0.6)]
    frames = []
    for k in range(N):
        depth = render([(body, se3.IDENTITY)], CAMERA, se3.inverse(T[k])).depth_m
        depth = np.where(depth > 0, depth, 1.5).astype(np.float32)
        if k == N - 1:
            depth[:, : int(CAMERA.project(T[k, :3, 3])[0])] = 0.3
        frames.append(Frame(k, k / 30, np.zeros((240, 320, 3), np.uint8), depth))
    T_cam_obj = T.copy()
    T_cam_obj[1] = np.nan
    has = np.arange(N) != 1
    obj = Estimates(T_cam_obj=T_cam_obj, has_pose=has, frame_index=np.arange(N))
    sequence = SimpleNamespace(camera=CAMERA, frame=frames.__getitem__, truth={"box": SimpleNamespace(T_cam_model=T)})
    return sequence, SimpleNamespace(objects={"box": obj}), {"box": body}


def test_at_the_true_pose_all_of_it_is_on_the_surface(made):
    sequence, run, bodies = made
    fit = own_data.surface_fit(sequence, run, bodies, range(N))["box"]
    assert fit.index.tolist() == [0, 2, 3], "no pose, no say"
    assert (fit > 0.99).all(), "what hides it says nothing"


def test_no_line_crosses_a_time_without_a_pose(made):
    _, run, _ = made
    run.objects["box"].confidence = np.where(run.objects["box"].has_pose, 0.9, 0)
    playback = SimpleNamespace(times_s=np.arange(N) / 30, colours={"box": style.OBJECTS[0]}, run=run)
    run.info = {"sequence": "carton"}
    figure = own_data.fit_plot(playback, {"as estimated": {"box": pd.Series(0.9, [0, 2, 3])}})
    fit, confidence = (axis.get_lines()[0].get_ydata() for axis in figure.axes)
    np.testing.assert_allclose(fit, [90, np.nan, 90, 90])
    np.testing.assert_allclose(confidence, [0.9, np.nan, 0.9, 0.9])


def test_a_wrong_pose_shows_and_the_more_the_farther(made):
    sequence, run, bodies = made
    shares = [
        own_data.surface_fit(sequence, run, bodies, [0], se3.exp(np.radians([0, deg, 0, 0, 0, 0])))["box"][0]
        for deg in (0, 5, 10, 20)
    ]
    assert (np.diff(shares) < -0.05).all()


def test_errors_against_a_truth_that_was_not_known(made):
    sequence, run, _ = made
    T_obj_model, T = se3.exp(np.array([0.1, 0.2, 0, 0.01, 0, 0])), run.objects["box"].T_cam_obj
    drift = np.repeat(np.eye(4)[None], N, 0)
    drift[3] = se3.exp(np.radians([0, 4.0, 0, 0, 0, 0]))
    drift[2, 0, 3] = 0.007
    off = Estimates(has_pose=run.objects["box"].has_pose, frame_index=np.arange(N))
    off.T_cam_obj = T @ drift @ se3.inverse(T_obj_model)
    deg, mm = errors_against(sequence, range(N), SimpleNamespace(objects={"box": off}))["box"]
    np.testing.assert_allclose(deg[[0, 2, 3]], [0, 0, 4], atol=1e-6)
    np.testing.assert_allclose(mm[[0, 2, 3]], [0, 7, 0], atol=1e-6)
    assert np.isnan(deg[1]) and np.isnan(mm[1])


def test_faults_that_miss_their_goal_are_bold_and_beyond_it(tmp_path):
    heads = "Fault,runs,failed,frames,lies in it,lies after,longest,good again,worst,mesh off (%),notes"
    lines = ["none,9,0,1000,0,5,5,0,15,5.0,", "mask wide,9,2,1000,6,0,6,3,never,40.0,", "black,9,-,-,-,-,-,-,-,-,why"]
    (tmp_path / "faults.csv").write_text("\n".join([heads, *lines]))
    (axis, bar) = own_data.fault_picture(pd.read_csv(tmp_path / "faults.csv")).axes
    assert [t.get_text() for t in axis.get_yticklabels()] == [
        "none",
        "mask wide (failed: 2)",
        "black (failed: -)",
    ]
    said = [(t.get_text(), t.get_weight()) for t in axis.texts]
    assert [text for text, _ in said[:5]] == ["0", "5", "5", "15", "5.0"] and {w for _, w in said[:5]} == {"normal"}
    assert said[5:10] == [("6", "bold"), ("0", "normal"), ("6", "bold"), ("never", "bold"), ("40.0", "bold")]
    ratios = axis.images[0].get_array()
    np.testing.assert_allclose(ratios[:2], [[0, 1, 1, 1, 1], [1.2, 0, 1.2, 2, 2]])
    assert ratios.mask[2].all() and not ratios.mask[:2].any()
    (line,) = bar.get_lines()
    assert set(line.get_xdata()) == {1}


def test_without_the_table_of_faults_there_is_the_command_that_makes_it(tmp_path):
    assert "p2p benchmark faults" in own_data.shown_faults({}, tmp_path).data
