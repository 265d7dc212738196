"""Pictures for own data: clicks where they are, rims in the right colour, meshes that fill their frame."""

import numpy as np
import trimesh

from p2p_lib.core.types import Frame, Status
from p2p_lib.datasets.prompts import Prompt, prompts_in
from p2p_lib.figures import style
from p2p_lib.studies import own_data_plots as own_data
from p2p_lib.studies.own_data import Finding, Level

V, U = np.mgrid[:120, :160]
DISC = np.hypot(U - 80, V - 60) <= 30
FRAME = Frame(0, 0.0, np.full((120, 160, 3), 128, np.uint8), np.where(DISC, 0.6, 1.0).astype(np.float32))


def has(image, colour, at_least=1):
    return (image == style.rgb(colour)).all(-1).sum() >= at_least


def test_clicks_are_drawn_where_they_are():
    image = own_data.clicked_picture(FRAME, [Prompt("mug", 0, [[40, 50]])], {"mug": style.OBJECTS[0]})
    v, u = np.nonzero((image == style.rgb(style.OBJECTS[0])).all(-1))
    assert abs(u.mean() - 40) < 0.5 and abs(v.mean() - 50) < 0.5


def test_a_rim_on_the_background_is_vermillion():
    lost = style.STATUS[Status.LOST][0]
    good, bad = (
        own_data.mask_picture(FRAME, DISC, "good"),
        own_data.mask_picture(FRAME, own_data.widened(DISC, 8), "bad"),
    )
    near = [np.abs(image.astype(int) - style.rgb(lost)).sum(-1).min() for image in (good, bad)]
    assert near[0] > 60 > near[1]
    sheet = own_data.masks_picture(FRAME, {"a": DISC, "b": own_data.widened(DISC, 8)}, width_px=200)
    assert sheet.shape[1] == 404


def test_a_click_is_where_one_would_click():
    (prompt,) = prompts_in({"disc": DISC, "hidden": np.zeros_like(DISC)}, frame=3)
    assert prompt.name == "disc" and prompt.frame == 3
    assert np.hypot(*(prompt.points_px[0] - [80, 60])) < 2


def test_portraits_show_the_surface_from_its_sides():
    body = trimesh.creation.box((0.05, 0.2, 0.1))
    front = np.array([200, 30, 30, 255], np.uint8)
    body.visual.vertex_colors = np.tile(front, (len(body.vertices), 1))
    portrait = own_data.mesh_portrait(body, 200, 150)
    covered = (portrait < 250).any(-1)
    assert 0.05 < covered.mean() < 0.7 and not covered[[0, -1]].any() and not covered[:, [0, -1]].any()
    assert own_data.mesh_portraits({"a": body, "b": body}, (0, 90)).shape[:2] == (524, 604)
    np.testing.assert_allclose(np.sort(own_data.tight_box(body).size_m), [0.05, 0.1, 0.2], atol=1e-6)


def test_the_table_of_findings_holds_what_is_not_fine():
    findings = [Finding("files", Level.OK, "all"), Finding("camera", Level.WRONG, "K is off", "Take another.")]
    table = own_data.findings_table({"K of another": findings, "fine": findings[:1]})
    assert table.to_numpy().tolist() == [["K of another", "camera", "WRONG", "K is off", "Take another."]]
