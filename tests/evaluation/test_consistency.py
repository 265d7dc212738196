"""What is said of a run without truth, against a run whose every error is known: it must not know them to see them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.datasets.models import MESHES, find_models, load_mesh, load_points
from p2p_lib.evaluation.consistency import HEADS, consistency, verdict
from tests.fixtures.made_run import T_OBJ_MODEL

OFF_PX = 2.0


@pytest.fixture(scope="module")
def run(made, tmp_path_factory):
    """The made run with true surfaces, true masks, and keypoints that were seen 2 px to the right of the truth."""
    run = replace(made.run, path=tmp_path_factory.mktemp("kept"))
    log, maps, camera = KeypointLog(), {}, made.sequence.camera
    (run.path / "meshes").mkdir()
    for name, path in find_models(made.sequence, MESHES).items():
        vertices, faces = load_mesh(path)
        body = trimesh.Trimesh(se3.transform(T_OBJ_MODEL, vertices), faces, process=False)
        body.export(run.path / "meshes" / f"{name}.ply")
        points = load_points(path)[:20]
        maps[name] = np.arange(20), se3.transform(T_OBJ_MODEL, points), np.arange(20) < 15
        for i in range(len(made.sequence)):
            uv_px = camera.project(se3.transform(made.sequence.truth[name].T_cam_model[i], points))
            log.add(i, name, np.arange(20), uv_px + np.array([OFF_PX, 0]))
    log.save(run.path, maps)
    for i in range(len(made.sequence)):
        for name, mask in made.sequence.masks(i).items():
            save_png(run.path / "masks" / name / f"{i:06d}.png", mask)
    return run


@pytest.fixture(scope="module")
def good(made, run):
    return consistency(run, made.sequence).objects


def put_off(run, xi):
    T = se3.exp(np.array(xi, float))
    return replace(run, objects={k: replace(obj, T_cam_obj=obj.T_cam_obj @ T) for k, obj in run.objects.items()})


def test_a_good_run_agrees_with_what_was_seen(run, good):
    for name, obj in run.objects.items():
        numbers = good[name]
        assert numbers["pose"] == pytest.approx(100 * obj.has_pose.mean())
        assert numbers["depth_on_surface"] > 90 and numbers["mask_iou"] > 90, name
        assert numbers["reprojection_px"] == pytest.approx(OFF_PX, abs=0.05), "of points that the truth moves"
        seen = obj.visible_px >= 300
        assert numbers["pose_where_seen"] == pytest.approx(100 * obj.has_pose[seen].mean())


@pytest.mark.parametrize("xi", [(0, np.radians(10), 0, 0, 0, 0), (0, 0, 0, 0.02, 0, 0)], ids=["turned", "shifted"])
def test_poses_put_off_on_purpose_are_told_by_every_number(made, run, good, xi):
    bad = consistency(put_off(run, xi), made.sequence).objects
    for name in run.objects:
        assert bad[name]["pose"] == good[name]["pose"]
        assert bad[name]["depth_on_surface"] < good[name]["depth_on_surface"] - 10
        assert bad[name]["mask_iou"] < good[name]["mask_iou"] - 3
        assert bad[name]["reprojection_px"] > good[name]["reprojection_px"] + 1


def test_how_many_of_the_poses_are_doubted(made, run):
    for name, obj in run.objects.items():
        confidence = np.full(len(obj), 0.9)
        confidence[np.flatnonzero(obj.has_pose)[:3]] = 0.5
        halved = replace(run, objects={name: replace(obj, confidence=confidence)})
        said = consistency(halved, made.sequence).objects[name]["doubted"]
        assert said == pytest.approx(300 / obj.has_pose.sum())


def test_what_cannot_be_said_is_not(made, run, tmp_path):
    """Neither surfaces nor keypoints nor masks were kept: only how often there was a pose, and a doubted one."""
    bare = replace(run, path=tmp_path, info=run.info | {"masks": "clicks"})
    said = consistency(bare, made.sequence)
    for name, numbers in said.objects.items():
        assert {key for key, value in numbers.items() if np.isfinite(value)} == {"pose", "doubted"}
        assert said.as_dict()["objects"][name]["mask_iou"] is None
    assert said.as_dict()["truth"] is None and said.as_dict()["not_scored"] is None
    unscored = replace(said, not_scored="no model of 'box'")
    assert unscored.as_dict()["truth"] is None and unscored.as_dict()["not_scored"] == "no model of 'box'"
    for head, says in HEADS.values():
        assert head in said.as_table() and says in said.as_table()


@pytest.mark.parametrize(
    ("worse", "word"),
    [
        ({}, "good"),
        ({"reprojection_px": 4.5}, "look"),
        ({"doubted": 60.0}, "look"),
        ({"pose_where_seen": 50.0}, "look"),
        ({"pose": 40.0}, "look"),
        ({"pose": 40.0, "pose_where_seen": 100.0}, "good"),
    ],
)
def test_a_verdict_in_a_word(worse, word):
    """Numbers of a real run, those with poses 1 cm off, and NaN for what was not kept."""
    numbers = dict.fromkeys(HEADS, float("nan")) | {"pose": 90.0, "doubted": 5.0, "reprojection_px": 0.6}
    assert verdict(numbers | worse) == word
    assert verdict(numbers | {"pose": 0.0}) == "look"
