"""A run drawn on its video: what is estimated is in colour, what is hidden is not made up."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import PoseEstimate, Status
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import NOT_FOLLOWED
from p2p_lib.extended.default import Point2Pose
from p2p_lib.figures import overlay, style
from p2p_lib.figures.overlay import OrientedBox
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.plots import gaps
from p2p_lib.figures.scenes import Scene, draw_live, side_by_side
from p2p_lib.figures.viewer import scene_page
from tests.figures.test_viewer import told, unpacked


@pytest.fixture(scope="module")
def scene(made):
    return Scene(made.sequence, made.run, made.evaluation)


def in_colour(image, colour, uv_px):
    """Share of pixels (at most one beside uv_px) that have a colour, lines being antialiased."""
    at = np.rint(uv_px).astype(int)[:, None] + np.array([[u, v] for u in (-1, 0, 1) for v in (-1, 0, 1)])
    off = np.abs(image[at[..., 1], at[..., 0]].astype(int) - style.rgb(colour)).max(2).min(1)
    return (off < 40).mean()


def box_edges(made, name, row):
    """Pixels along the front edges of the model's box at the truth."""
    obj, box = made.run.objects[name], OrientedBox.around(made.run.points[name])
    T = obj.T_cam_model[row] @ box.T_obj_box
    ends = OrientedBox(np.eye(4), box.size_m).corners(np.eye(4))[overlay.EDGES[overlay._front_edges(T, box.size_m)]]
    along = ends[:, 0, None] + np.linspace(0.1, 0.9, 9)[:, None] * (ends[:, 1] - ends[:, 0])[:, None]
    return made.sequence.camera.project(se3.transform(T, along.reshape(-1, 3)))


def test_boxes_lie_on_the_objects(made, scene):
    for row in (0, len(scene) - 1):
        image = scene.draw(row, axes=False, trail=0)
        for name, colour in scene.colours.items():
            assert in_colour(image, colour, box_edges(made, name, row)) > 0.8, (name, row)
            assert in_colour(made.sequence.frame(row).rgb, colour, box_edges(made, name, row)) < 0.3


def test_a_hidden_object_has_only_its_true_box(made, scene):
    for name, obj in made.run.objects.items():
        start, stop = gaps(obj)[0]
        row = (start + stop) // 2
        uv = box_edges(made, name, row)
        image = scene.draw(row, axes=False, trail=0)
        assert in_colour(image, scene.colours[name], uv) < 0.1
        assert 0.3 < in_colour(image, style.TRUTH, uv) <= 1  # dashes
        plain = Scene(made.sequence, made.run, made.evaluation, truth=False).draw(row, axes=False, trail=0)
        assert in_colour(plain, style.TRUTH, uv) < 0.1


def test_the_label_of_what_left_the_image_does_not_say_occluded(made, scene):
    obj = made.run.objects["box"]
    row = gaps(obj)[0][0]
    gone, words = {"status": np.full(len(obj), "occluded")}, []
    for reason in ("0 mask pixels", "out of view: 0 mask pixels"):
        gone["reason"] = np.full(len(obj), reason)
        words.append(scene._label(made.sequence.camera, "box", replace(obj, **gone), row).text)
    assert words == ["box: occluded", "box: out of view"]


def test_the_label_of_a_doubted_pose_says_so(made, scene):
    obj, words = made.run.objects["box"], []
    row = int(np.flatnonzero(obj.has_pose)[0])
    for confidence in (0.5, 0.51):
        said = replace(obj, confidence=np.full(len(obj), confidence))
        words.append(scene._label(made.sequence.camera, "box", said, row).text)
    assert words == [f"box: {obj.status[row]}, doubted", f"box: {obj.status[row]}"]


def test_an_object_that_is_not_followed_any_more_has_no_label(made, scene):
    obj = made.run.objects["box"]
    row = int(np.flatnonzero(obj.has_pose)[-1])
    words = {"status": np.full(len(obj), "initialising"), "reason": np.full(len(obj), NOT_FOLLOWED)}
    gone = replace(obj, T_cam_obj=np.full_like(obj.T_cam_obj, np.nan), **words)
    assert scene._label(made.sequence.camera, "box", gone, row) is None


def test_a_wrong_pose_is_drawn_where_it_is(made, scene):
    """The truth in white beside the estimate: 2 cm are about 20 pixels here."""
    image = scene.draw(6, axes=False, trail=0)
    uv = box_edges(made, "box", 6)
    assert in_colour(image, style.TRUTH, uv) > 0.3
    assert in_colour(image, scene.colours["box"], uv) < 0.5


def test_without_evaluation_there_are_axes_and_the_boxes_given(made):
    bare = Scene(made.sequence, made.run, truth=False)
    uv = box_edges(made, "can", 0)
    assert in_colour(bare.draw(0), bare.colours["can"], uv) < 0.2
    assert (bare.draw(0) != made.sequence.frame(0).rgb).any()
    given = OrientedBox.around(made.run.points["can"], made.evaluation.objects["can"].T_obj_model)
    boxed = Scene(made.sequence, made.run, truth=False, boxes={"can": given})
    assert in_colour(boxed.draw(0, axes=False), boxed.colours["can"], uv) > 0.8


def test_moments_tell_of_every_gap(made, scene):
    rows = scene.moments(6)
    assert len(rows) == 6 and rows[0] == 0 and rows == sorted(set(rows)) and rows[-1] < len(scene)
    for obj in made.run.objects.values():
        for start, stop in gaps(obj):
            assert any(start <= row < stop for row in rows) and any(stop <= row <= stop + 2 for row in rows)
    assert scene.moments(10_000) == list(range(len(scene)))


def test_region_holds_the_objects(made, scene):
    left, top, right, bottom = scene.region(margin=0.0)
    assert 0 <= left < right <= 640 and 0 <= top < bottom <= 480 and (right - left) * (bottom - top) < 640 * 480
    for i in range(0, len(scene), 5):
        for mask in made.sequence.masks(i).values():
            v, u = np.nonzero(mask)
            assert not len(u) or (left <= u.min() + 1 and u.max() <= right and top <= v.min() + 1 and v.max() <= bottom)


def test_stories_and_images_have_their_sizes(scene):
    left, top, right, bottom = scene.region()
    height = round(240 * (bottom - top) / (right - left))
    assert scene.story(count=4, columns=2, width_px=240).shape == (2 * height + 4, 2 * 240 + 4, 3)
    assert scene.draw(2, width_px=320).shape == (240, 320, 3)


def test_methods_stand_beside_each_other_at_the_same_frames(scene):
    """A line each, or two by two; each image is the scene's own, with its method's name in the corner."""
    scenes, shown = {name: Scene(scene.sequence, scene.run) for name in "abcd"}, [2, 5]
    lines, pairs = (side_by_side(scenes, shown, 200, across=across) for across in (1, 2))
    high, gap = (lines.shape[0] + 4) // 4 - 4, 4
    assert lines.shape[:2] == (4 * high + 3 * gap, 2 * 200 + gap)
    assert pairs.shape[:2] == (2 * high + gap, 4 * 200 + 3 * gap)
    third = scenes["c"].draw(scene.row(5), scenes["a"].region(), 200, axes=False, trail=0, note="c")
    np.testing.assert_array_equal(pairs[high + gap :, 200 + gap : 400 + gap], third)
    assert side_by_side(scenes, 3, 200).shape[1] == 3 * 200 + 2 * gap, "or moments of the first"


def test_a_run_on_other_data_is_refused(made):
    obj = made.run.objects["can"]
    moved = replace(obj, T_cam_model=obj.T_cam_model + [[0, 0, 0, 0.01]] * 4)
    with pytest.raises(BadInput, match="Run it again"):
        Scene(made.sequence, replace(made.run, objects={**made.run.objects, "can": moved}))
    with pytest.raises(BadInput, match="mustard0"):
        Scene(made.sequence, replace(made.run, info={**made.run.info, "sequence": "mustard0"}))


def test_every_map_is_drawn_and_the_surface_only_where_it_is_of_that_map(made, tmp_path, monkeypatch):
    """Two maps of the box: most poses are in the second, and so is the surface."""
    T_map_model = se3.exp(np.array([[0.3, -0.2, 0.5, 0.02, -0.01, 0.03], [1.5, 0.4, 0.0, 0.0, 0.0, 0.1]]))
    truth, points = made.sequence.truth["box"].T_cam_model, made.run.points["box"]
    map_id = np.repeat([0, 1], [16, 24])
    with RunWriter(tmp_path / "run", made.sequence, preset(), "lk", "dataset", objects=("box",)) as writer:
        for i, k in enumerate(map_id.tolist()):
            T, frame = truth[i] @ se3.inverse(T_map_model[k]), made.sequence.frame(i)
            estimate = PoseEstimate("box", i, frame.time_s, Status.TRACKED, T, 0.9, keyframe=i % 8 == 0, map_id=k)
            writer.add(frame, {"box": estimate}, 5)
    box = OrientedBox.around(points, T_map_model[1])
    surface = trimesh.creation.box(box.size_m, box.T_obj_box)
    surface.visual.vertex_colors = np.tile([200, 40, 40, 255], (len(surface.vertices), 1))
    (tmp_path / "run/meshes").mkdir()
    surface.export(tmp_path / "run/meshes/box.ply")

    monkeypatch.setattr(Playback, "masks", lambda *_: {})  # whose outlines are where boxes may be
    playback = Playback.of(tmp_path / "run", made.sequence)
    scene = Scene.of(playback)
    assert in_colour(scene.draw(30, axes=False), scene.colours["box"], box_edges(made, "box", 30)) > 0.8
    assert in_colour(scene.draw(10, axes=False), scene.colours["box"], box_edges(made, "box", 10)) < 0.3
    T_cam_obj = truth[10] @ se3.inverse(T_map_model[0])
    for k, colour in enumerate(style.AXES):
        along = np.linspace(0.4, 0.9, 8)[:, None] * 0.05 * np.eye(3)[k]
        uv_px = made.sequence.camera.project(se3.transform(T_cam_obj, along))
        assert in_colour(scene.draw(10, trail=0, words=False), colour, uv_px) > 0.8
    assert playback.keyframes("box")[0].tolist() == [16, 24, 32]

    scored = Scene.scored(replace(playback, run=replace(playback.run, points={"box": points})))
    for row in (10, 30):  # by the model, the box is known in either map
        assert in_colour(scored.draw(row, axes=False), scored.colours["box"], box_edges(made, "box", row)) > 0.8

    messages = unpacked(scene_page(playback, points=100))
    shown = told(messages, "SetSceneNodeVisibilityMessage", "/objects/box/map")
    assert [(round(30 * t), m["visible"]) for t, m in shown][-2:] == [(0, False), (16, True)]
    moves = [m["position"] for _, m in told(messages, "SetPositionMessage", "/objects/box")][-40:]
    np.testing.assert_allclose(moves, (truth @ se3.inverse(T_map_model[map_id]))[:, :3, 3], atol=1e-6)


def test_live_view_shows_the_keypoints(made):
    method = Point2Pose(made.sequence.camera)
    frame, masks = made.sequence.frame(0), made.sequence.masks(0)
    for name in made.sequence.objects:
        method.add_object(name, masks[name])
    estimates = method.step(frame)
    image = draw_live(method, frame, estimates, title=made.sequence.name)
    colours = style.object_colours(made.sequence.objects)
    for name, obj in method.objects.items():
        uv = method.camera.project(se3.transform(estimates[name].T_cam_obj, obj.map.p_obj))
        assert in_colour(image, colours[name], uv) > 0.8
    assert (frame.rgb == made.sequence.frame(0).rgb).all()
