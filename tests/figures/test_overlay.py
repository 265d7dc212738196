"""Drawn things lie where the camera sees them, and pictures that are drawn on stay as they were."""

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.figures import overlay, style
from p2p_lib.figures.overlay import EDGES, Label, OrientedBox

CAMERA = Camera(615.0, 590.0, 321.3, 236.8, 640, 480)
SIZE = np.array([0.10, 0.06, 0.15])
BOX = OrientedBox(np.eye(4), SIZE)


def picture(value=90):
    return np.full((480, 640, 3), value, np.uint8)


def random_pose(seed):
    rng = np.random.default_rng(seed)
    T = se3.exp(np.r_[rng.uniform(-2, 2, 3), np.zeros(3)])
    T[:3, 3] = rng.uniform([-0.15, -0.1, 0.6], [0.15, 0.1, 1.2])
    return T


def hidden_by_itself(T_cam_box, p_box):
    """Whether the sight line to a point of the box's surface passes through the box before it gets there."""
    eye = se3.inverse(T_cam_box)[:3, 3]
    on_the_way = eye + np.linspace(0, 1 - 1e-3, 4000)[:, None] * (p_box - eye)
    return bool((np.abs(on_the_way) < SIZE / 2 - 1e-5).all(1).any())


def test_edges_are_those_of_a_box():
    corners = BOX.corners(np.eye(4))
    lengths = np.linalg.norm(corners[EDGES[:, 0]] - corners[EDGES[:, 1]], axis=1)
    assert np.allclose(np.sort(lengths), np.sort(np.repeat(SIZE, 4)))
    assert np.allclose(corners.max(0) - corners.min(0), SIZE) and len(np.unique(corners, axis=0)) == 8


@pytest.mark.parametrize("seed", range(12))
def test_box_lies_where_the_camera_projects_it(seed):
    T = random_pose(seed)
    image = overlay.draw_box(picture(), CAMERA, T, BOX, "#FFFFFF")
    corners = BOX.corners(np.eye(4))
    share = np.linspace(0.05, 0.95, 19)[:, None]
    for a, b in EDGES:
        along = corners[a] + share * (corners[b] - corners[a])
        uv = np.rint(CAMERA.project(se3.transform(T, along))).astype(int)
        change = np.abs(image[uv[:, 1], uv[:, 0]].astype(int).mean(1) - 90)
        if hidden_by_itself(T, along[9]):  # thin, half transparent, and perhaps between two pixels
            around = (uv[:, None] + [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]).reshape(-1, 2)
            change = np.abs(image[around[:, 1], around[:, 0]].astype(int).mean(1) - 90).reshape(-1, 5).max(1)
        assert (change > (30 if hidden_by_itself(T, along[9]) else 150)).mean() > 0.9
    drawn = np.argwhere(image.astype(int).mean(2) > 240)[:, ::-1]
    ends = CAMERA.project(se3.transform(T, corners))[EDGES]
    direction = ends[:, 1] - ends[:, 0]
    t = np.einsum("pei,ei->pe", drawn[:, None] - ends[:, 0], direction) / (direction**2).sum(1)
    off = np.linalg.norm(drawn[:, None] - ends[:, 0] - np.clip(t, 0, 1)[..., None] * direction, axis=-1).min(1)
    assert off.max() < 2.0


@pytest.mark.parametrize("seed", range(40))
def test_front_edges_are_those_not_hidden_by_the_box(seed):
    T = random_pose(seed)
    corners = BOX.corners(np.eye(4))
    middles = corners[EDGES].mean(1)
    expected = [not hidden_by_itself(T, p) for p in middles]
    assert overlay._front_edges(T, SIZE).tolist() == expected


def test_lines_are_cut_off_in_front_of_the_camera():
    line = np.array([[[0.1, 0.05, 0.5], [0.3, 0.2, -1.0]]])
    (a, b), near = overlay._segments(CAMERA, line)[0], overlay._NEAR_M
    share = (0.5 - near) / 1.5
    assert np.allclose(a, CAMERA.project(line[0, 0]))
    assert np.allclose(b, CAMERA.project(line[0, 0] + share * (line[0, 1] - line[0, 0])))
    assert len(overlay._segments(CAMERA, line - [0, 0, 2.0])) == 0
    around_the_camera = overlay.draw_box(picture(), CAMERA, np.eye(4), OrientedBox(np.eye(4), np.ones(3)), "#FFFFFF")
    assert around_the_camera.shape == (480, 640, 3)


def test_axes_end_where_the_camera_projects_them():
    T = se3.from_rt(np.eye(3), [0, 0, 0.8]) @ se3.exp(np.array([0.5, 0.7, 0.2, 0, 0, 0]))
    image = overlay.draw_axes(picture(), CAMERA, T, 0.1)
    for k, colour in enumerate(style.AXES):
        u, v = np.rint(CAMERA.project(se3.transform(T, np.eye(3)[[k]] * 0.09)))[0].astype(int)
        assert np.abs(image[v, u].astype(int) - style.rgb(colour)).max() < 40


def test_nothing_touches_the_picture_it_is_given():
    image = picture()
    image.setflags(write=False)
    mask = np.zeros((480, 640), bool)
    mask[100:200, 150:300] = True
    T, uv = random_pose(3), np.array([[10.0, 20.0], [np.nan, 3.0], [300.5, 200.25]])
    drawn = {
        "box": overlay.draw_box(image, CAMERA, T, BOX, "#0072B2"),
        "dashed": overlay.draw_box(image, CAMERA, T, BOX, "#FFFFFF", dashed=True),
        "axes": overlay.draw_axes(image, CAMERA, T, 0.1),
        "mask": overlay.draw_mask(image, mask, "#0072B2", fill=0.3),
        "points": overlay.draw_points(image, uv, "#0072B2"),
        "rings": overlay.draw_points(image, uv, overlay.value_colours(uv[:, 0], 0, 300), filled=False),
        "crosses": overlay.draw_crosses(image, uv, "#D55E00"),
        "trail": overlay.draw_trail(image, np.array([[0.0, 0], [5, 5], [np.nan, 0], [9, 9], [20, 9]]), "#0072B2"),
        "labels": overlay.draw_labels(image, [Label("box", "#0072B2", (100, 100, 200, 200))]),
        "caption": overlay.draw_caption(image, "synthetic"),
    }
    for name, result in drawn.items():
        assert result.dtype == np.uint8 and result.shape == image.shape, name
        assert (result != image).any(), name
    assert (image == 90).all()


def test_nothing_to_draw_gives_a_copy():
    image = picture()
    for result in (
        overlay.draw_points(image, np.zeros((0, 2)), "#FFFFFF"),
        overlay.draw_trail(image, np.zeros((1, 2)), "#FFFFFF"),
        overlay.draw_crosses(image, np.full((2, 2), np.nan), "#FFFFFF"),
        overlay.draw_mask(image, np.zeros((480, 640), bool), "#FFFFFF"),
        overlay.draw_labels(image, []),
    ):
        assert (result == image).all() and result is not image


def test_dots_are_centred_to_a_fraction_of_a_pixel():
    at = np.array([[100.25, 50.75], [200.5, 300.0]])
    image = overlay.draw_points(np.zeros((400, 400, 3), np.uint8), at, "#FFFFFF", 4)
    for u, v in at:
        window = image[int(v) - 9 : int(v) + 10, int(u) - 9 : int(u) + 10, 0].astype(float) ** 2
        y, x = np.mgrid[int(v) - 9 : int(v) + 10, int(u) - 9 : int(u) + 10]
        centre = [(x * window).sum() / window.sum(), (y * window).sum() / window.sum()]
        assert np.allclose(centre, [u, v], atol=0.15)


def test_mask_is_tinted_inside_and_untouched_outside():
    mask = np.zeros((480, 640), bool)
    mask[100:200, 150:300] = True
    image = overlay.draw_mask(picture(100), mask, "#C80000", fill=0.5)
    assert (image[120:180, 170:280] == [150, 50, 50]).all()
    far = cv2.dilate(mask.astype(np.uint8), np.ones((13, 13))) == 0
    assert (image[far] == 100).all()
    with pytest.raises(BadInput, match=r"mask.*\(480, 640\)"):
        overlay.draw_mask(picture(), mask[:-1], "#C80000")


def test_values_go_from_dark_to_light():
    colours = overlay.value_colours(np.array([-5, 0, 0.5, 1, 7, np.nan]), 0, 1)
    assert (colours[0] == colours[1]).all() and (colours[3] == colours[4]).all() and (colours[5] == 255).all()
    light = overlay.value_colours(np.linspace(0, 1, 50), 0, 1) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) > -0.8).all() and light[-1] - light[0] > 150


def test_near_is_lighter_than_far_and_unmeasured_is_white():
    depth = np.tile(np.linspace(0.4, 1.6, 64, dtype=np.float32), (8, 1))
    depth[:, 10] = 0
    image = overlay.depth_image(depth)
    light = image[0] @ [0.2126, 0.7152, 0.0722]
    assert light[0] > light[30] > light[-1] and (image[:, 10] == 255).all()
    assert (overlay.depth_image(np.zeros((4, 5))) == 255).all()


@pytest.mark.parametrize("width_px", [200, 333, 900])
def test_zoomed_camera_sees_the_zoomed_picture(width_px):
    """A blob's centre moves as the camera of the zoom says."""
    p_cam = np.array([0.03, -0.02, 0.8])
    u, v = CAMERA.project(p_cam)
    y, x = np.mgrid[:480, :640]
    blob = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2)) * 255
    image = np.repeat(np.rint(blob)[..., None], 3, 2).astype(np.uint8)
    part, camera = overlay.zoomed(image, CAMERA, (201, 101, 480, 401), width_px)
    assert part.shape[:2] == (camera.height, camera.width) and camera.width == width_px
    weight = part[..., 0].astype(float)
    y, x = np.mgrid[: camera.height, : camera.width]
    centre = [(x * weight).sum() / weight.sum(), (y * weight).sum() / weight.sum()]
    assert np.allclose(centre, camera.project(p_cam), atol=0.05 * max(1, width_px / 279))


def test_zoom_out_of_the_picture_is_refused():
    with pytest.raises(BadInput, match="640x480"):
        overlay.zoomed(picture(), CAMERA, (0, 0, 641, 480), 100)


def test_montage_puts_pictures_in_their_places():
    images = [np.full((20, 30, 3), k, np.uint8) for k in range(5)]
    sheet = overlay.montage(images, columns=2)
    assert sheet.shape == (3 * 20 + 2 * 4, 2 * 30 + 4, 3)
    for k in range(5):
        top, left = k // 2 * 24, k % 2 * 34
        assert (sheet[top : top + 20, left : left + 30] == k).all()
    assert (sheet[:, 30:34] == 255).all() and (sheet[-20:, -30:] == 255).all()
    with pytest.raises(BadInput, match="one size"):
        overlay.montage([images[0], images[1][:-1]], 2)


def test_a_label_keeps_clear_of_the_caption():
    label = Label("box: tracked", "#0072B2", (10.0, 30.0, 120.0, 200.0))  # above it is the caption
    plain, captioned = (
        overlay.draw_labels(picture(), [label], caption) for caption in ("", "synthetic/crossing 1.00 s")
    )
    count = [(image == style.rgb(label.colour)).all(2).sum() for image in (plain, captioned)]
    assert count[0] == count[1] > 500


def test_labels_do_not_cover_each_other():
    where = (300.0, 10.0, 400.0, 300.0)  # up to the caption
    labels = [Label(f"object {k}: tracked", style.OBJECTS[k], where) for k in range(len(style.OBJECTS))]
    together = overlay.draw_labels(picture(200), labels, "synthetic/eight_objects 1.00 s, a run of many objects")
    for label in labels:
        alone = overlay.draw_labels(picture(200), [label])
        count = [(image == style.rgb(label.colour)).all(2).sum() for image in (alone, together)]
        assert count[0] == count[1] > 500


@pytest.mark.parametrize("where", [(-50, -40, -5, -2), (630, 470, 700, 500), (0, 0, 640, 480)])
def test_labels_stay_in_the_picture(where):
    inside = overlay.draw_labels(picture(), [Label("can: occluded", "#E69F00", (300, 200, 350, 250))])
    image = overlay.draw_labels(picture(), [Label("can: occluded", "#E69F00", where)])
    count = [(x == style.rgb("#E69F00")).all(2).sum() for x in (inside, image)]
    assert count[0] == count[1]


def test_box_around_points():
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.1, 0, 0.2], [0.3, 0.1, 0.25], (4000, 3))
    T = random_pose(5)
    box = OrientedBox.around(points, T)
    inner = se3.transform(se3.inverse(box.T_obj_box), se3.transform(T, points))
    assert np.allclose(np.abs(inner).max(0), box.size_m / 2, atol=1e-12)
    assert np.allclose(box.size_m, [0.4, 0.1, 0.05], rtol=0.01)
    assert np.allclose(OrientedBox.around([*points, [np.nan, 0, 0]]).size_m, box.size_m), (
        "what is not finite is left out"
    )
    with pytest.raises(BadInput, match="no finite points"):
        OrientedBox.around(np.full((3, 3), np.nan))
