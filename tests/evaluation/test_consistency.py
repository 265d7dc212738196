"""What is said of a run without truth, against a run whose every error is known: it must not know them to see them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.errors import DEPTH_MOVED, Doubt
from p2p_lib.core.image import in_mask
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.datasets.mask_log import MaskLog, load_masks
from p2p_lib.datasets.models import MESHES, find_models, load_mesh, load_points
from p2p_lib.datasets.runs import COLUMNS, NOT_FOLLOWED, load_run
from p2p_lib.evaluation.consistency import HEADS, Consistency, consistency
from p2p_lib.evaluation.evidence import on_surface
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
            seen = np.flatnonzero(in_mask(uv_px, made.sequence.masks(i)[name]))
            log.add(i, name, seen, uv_px[seen] + np.array([OFF_PX, 0]))
    log.save(run.path, maps)
    masks = MaskLog(camera)
    for i in range(len(made.sequence)):
        for name, mask in made.sequence.masks(i).items():
            masks.add(made.sequence.frame(i), name, mask)
    masks.save(run.path)
    for file in ("run.json", "poses.npz"):
        (run.path / file).write_bytes((made.run.path / file).read_bytes())
    return run


@pytest.fixture(scope="module")
def good(made, run):
    return consistency(run, made.sequence).objects


def test_a_good_run_is_called_good_and_one_put_off_is_not(made, run):
    """Of the box, four frames are wrong on purpose: too few of 40 to look at."""
    found = consistency(run, made.sequence)
    assert {found.verdict(name) for name in run.objects} == {"good"} and not found.look_at()
    off = consistency(put_off(run, (0, np.radians(10), 0, 0.02, 0, 0)), made.sequence)
    for name in run.objects:
        assert off.verdict(name) == "look"
        assert any("above 3 px" in line for line in off.look_at() if line.startswith(f"look at {name}"))
        told = off.as_dict()["objects"][name]
        assert told["verdict"] == "look" and all(found["text"] and found["frames"] for found in told["look_at"])
    assert all(line in off.as_table() for line in off.look_at())


def test_what_was_doubted_when_it_was_made_is_to_be_looked_at(made, run):
    of_box, of_all = Doubt("the can's box: flat", "box"), Doubt("depth: all of it changes by 9 %")
    doubts = [of.as_dict() for of in (of_box, of_all, Doubt("depth and colour: 14 px apart", kind=DEPTH_MOVED))]
    found = consistency(replace(run, info=run.info | {"doubts": doubts}), made.sequence)
    told = {name: [s.text for s in of] for name, of in found.suspicions.items()}
    assert told == {"box": [str(of_box), str(of_all)], "can": [str(of_all)]}


def test_doubts_of_earlier_versions_are_of_all_that_was_read(made, run):
    told = consistency(replace(run, info=run.info | {"doubts": ["flat"]}), made.sequence).suspicions
    assert [[s.text for s in told[name]] for name in ("box", "can")] == [["flat"], ["flat"]]
    moved = "depth and colour: of different moments while the camera moves, 14 px apart in frame 76. Depth is moved."
    earlier = replace(run, info=run.info | {"doubts": [moved]})
    assert [doubt.kind for doubt in earlier.doubts] == [DEPTH_MOVED], "and depth is taken as it was then"


def test_a_removed_object_is_no_lost_one(made, run, tmp_path):
    """What it was before it was removed counts, and what was before it was added does not."""

    def followed(obj, rows):
        status, reason = np.where(rows, obj.status, "initialising"), np.where(rows, obj.reason, NOT_FOLLOWED)
        T_cam_obj = np.where(rows[:, None, None], obj.T_cam_obj, np.nan)
        return replace(obj, status=status, reason=reason, T_cam_obj=T_cam_obj, confidence=obj.confidence * rows)

    rows = np.arange(40)
    box = followed(made.run.objects["box"], (rows > 8) & (rows < 16))
    arrays = dict(np.load(run.path / "poses.npz")) | {f"box/{column}": getattr(box, column) for column in COLUMNS}
    np.savez(tmp_path / "poses.npz", **arrays)
    for file in ("run.json", "keypoints.npz", "masks.npz"):
        (tmp_path / file).write_bytes((run.path / file).read_bytes())
    short = load_run(tmp_path)
    found = consistency(short, made.sequence)
    assert found.verdict("box") == "good" and found.objects["box"]["pose_where_seen"] == 100


def test_a_known_size_that_does_not_fit_is_to_be_looked_at(made, run):
    length_m = float(np.nanmax(load_masks(run.path)["box"].size_m))
    assert consistency(run, made.sequence, known_m={"box": length_m}).verdict("box") == "good"
    found = consistency(run, made.sequence, known_m={"box": 3 * length_m})
    assert (found.verdict("box"), found.verdict("can")) == ("look", "good")
    assert "focal length or depth scale is wrong" in found.as_table()


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
    for file in ("run.json", "poses.npz"):
        (tmp_path / file).write_bytes((made.run.path / file).read_bytes())
    said = consistency(replace(run, path=tmp_path), made.sequence)
    for name, numbers in said.objects.items():
        assert {key for key, value in numbers.items() if np.isfinite(value)} == {"pose", "doubted"}
        assert said.as_dict()["objects"][name]["mask_iou"] is None
    assert said.as_dict()["truth"] is None and said.as_dict()["not_scored"] is None
    assert {said.verdict(name) for name in run.objects} == {"unknown"}, "where nothing was compared nothing is good"
    assert "unknown, box: no pose was compared" in said.as_table() and "keypoints were kept" in said.as_table()
    unscored = replace(said, not_scored="no model of 'box'")
    assert unscored.as_dict()["truth"] is None and unscored.as_dict()["not_scored"] == "no model of 'box'"
    assert all(head in said.as_table() for head, _ in HEADS.values())
    for key, (_, says) in HEADS.items():
        assert says in consistency(run, made.sequence).as_table()
        assert not says or (says in said.as_table()) == (key == "doubted"), "of what has a number alone"


def test_a_table_of_numbers_that_need_no_words_has_no_empty_line():
    numbers = dict.fromkeys(HEADS, float("nan")) | {"pose": 0.0}
    assert "" not in Consistency({"box": numbers}, {"box": ()}).as_table().splitlines()


def test_far_depth_is_as_near_to_the_surface_as_a_camera_measures_it():
    """8 mm are off at arm's length and noise at 2 m, where right poses of a depth camera would be called off."""
    for range_m, share in ((0.6, 0.0), (2.0, 1.0)):
        surface_m = np.full((4, 4), range_m)
        assert on_surface(surface_m, surface_m + 0.008) == on_surface(surface_m, surface_m - 0.008) == share
