"""BOP scenes: the format read from files written here by hand, and our own scenes read back identically."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame
from p2p_lib.datasets.bop import write_models, write_scene
from p2p_lib.datasets.models import find_models, load_points
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.datasets.truth import ObjectTruth

W, H = 40, 30
NUMBERS = (1, 36, 37)  # keyframes with gaps
K = [50.0, 0, 20, 0, 52, 15, 0, 0, 1]


def pose(seed):
    return se3.exp(np.random.default_rng(seed).normal(size=6))


def entry(obj_id, T):
    t_mm = (T[:3, 3] * 1000).tolist()
    return {"obj_id": obj_id, "cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": t_mm}


#: Object 5 is twice in the first picture and leaves after the second; object 2 comes late.
POSES = {1: [(5, pose(0)), (5, pose(1))], 36: [(5, pose(2))], 37: [(2, pose(3))]}


@pytest.fixture
def scene(tmp_path):
    folder = tmp_path / "set" / "test" / "000048"
    for sub in ("rgb", "depth", "mask_visib"):
        (folder / sub).mkdir(parents=True)
    for k, i in enumerate(NUMBERS):
        cv2.imwrite(str(folder / f"rgb/{i:06d}.png"), np.full((H, W, 3), (10, 20, 30 + k), np.uint8))
        cv2.imwrite(str(folder / f"depth/{i:06d}.png"), np.full((H, W), 7000 + k, np.uint16))
        for j in range(len(POSES[i])):
            mask = np.zeros((H, W), np.uint8)
            mask[: 1 + k, : 10 * (j + 1)] = 255
            cv2.imwrite(str(folder / f"mask_visib/{i:06d}_{j:06d}.png"), mask)
    write(folder, "scene_camera", {i: {"cam_K": K, "depth_scale": 0.1} for i in NUMBERS})
    write(folder, "scene_gt", {i: [entry(*found) for found in POSES[i]] for i in NUMBERS})
    info = {i: [{"px_count_visib": 10, "visib_fract": 1.0} for _ in POSES[i]] for i in NUMBERS}
    info[36][0] = {"px_count_visib": 0, "visib_fract": 0.0}
    write(folder, "scene_gt_info", info)
    return folder


def write(folder, name, scene):
    (folder / f"{name}.json").write_text(json.dumps({str(i): found for i, found in scene.items()}))


def test_scene_as_written_by_hand(scene):
    read = open_sequence(scene)
    assert read.format == "bop" and read.objects == ("obj_000002", "obj_000005", "obj_000005_2")
    assert read.camera == Camera(50, 52, 20, 15, W, H)
    np.testing.assert_allclose(read.times_s, [0, 35 / 30, 36 / 30])
    np.testing.assert_allclose(read.frame(1).depth_m, 0.7001, rtol=1e-6)
    assert read.frame(2).rgb[0, 0].tolist() == [32, 20, 10]
    np.testing.assert_allclose(read.truth["obj_000005"].T_cam_model[:2], [pose(0), pose(2)], atol=1e-9)
    np.testing.assert_allclose(read.truth["obj_000005_2"].T_cam_model[0], pose(1), atol=1e-9)
    np.testing.assert_allclose(read.truth["obj_000002"].T_cam_model[2], pose(3), atol=1e-9)
    absent = {"obj_000002": [0, 1], "obj_000005": [2], "obj_000005_2": [1, 2]}
    for obj, at in absent.items():
        assert np.isnan(read.truth[obj].T_cam_model[at]).all() and not read.truth[obj].labelled[at].any()
    assert read.truth["obj_000005"].labelled.tolist() == [True, False, False]  # hidden in the second picture
    assert read.visible_px(0) == {"obj_000002": 0, "obj_000005": 10, "obj_000005_2": 20}
    assert {name: int(mask.sum()) for name, mask in read.masks(2).items()} == {
        "obj_000002": 30,
        "obj_000005": 0,
        "obj_000005_2": 0,
    }


def test_models_in_millimetres(scene):
    assert find_models(open_sequence(scene)) == {}
    box = trimesh.creation.box((60, 80, 120))
    for folder in ("models", "models_eval"):
        where = scene.parents[1] / folder
        where.mkdir()
        (where / "models_info.json").write_text("{}")
        (where / "obj_000005.ply").write_bytes(box.export(file_type="ply"))
        found = find_models(open_sequence(scene))
        assert found == dict.fromkeys(("obj_000005", "obj_000005_2"), where / "obj_000005.ply")  # models_eval wins
    np.testing.assert_allclose(np.ptp(load_points(found["obj_000005"]), axis=0), [0.06, 0.08, 0.12])


def test_without_truth_the_objects_are_those_of_the_masks_asked_for(scene):
    (scene / "scene_gt.json").unlink()
    for name, columns in (("mug", 5), ("tin", 7)):
        (scene / "own" / name).mkdir(parents=True)
        for i in NUMBERS:
            mask = np.zeros((H, W), np.uint8)
            mask[:, :columns] = 255
            cv2.imwrite(str(scene / f"own/{name}/{i:06d}.png"), mask)
    sequence = open_sequence(scene, masks="own")
    assert sequence.objects == ("mug", "tin") and not sequence.truth
    assert {name: mask.sum() for name, mask in sequence.masks(0).items()} == {"mug": 5 * H, "tin": 7 * H}


def test_without_truth_and_masks(scene):
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (scene / name).unlink()
    read = open_sequence(scene)
    assert read.truth == {} and read.objects == ("object",) and read.masks(0) is None


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("scene_camera", "{", r"scene_camera\.json: got unreadable JSON"),
        ("scene_camera", "[1]", r"scene_camera\.json: got the file: "),
        ("scene_camera", '{"1": {"cam_K": [1], "depth_scale": 1}}', r"scene_camera\.json: got 1\.cam_K: .*at least 9"),
        ("scene_camera", json.dumps({"1": {"cam_K": K, "depth_scale": 1}}), r"scene_camera\.json: got no image 36"),
        ("scene_gt", '{"1": [{"cam_R_m2c": [1]}]}', r"scene_gt\.json: got 1\.0\.obj_id: missing"),
        ("scene_gt", '{"1": [{"obj_id": 1}]}', r"scene_gt\.json: got 1\.0\.cam_R_m2c: missing"),
        (
            "scene_gt",
            json.dumps({"1": [{"obj_id": 1, "cam_R_m2c": [2] * 9, "cam_t_m2c": [0, 0, 1]}]}),
            r"image 1, obj_000001: got a matrix that is not a rotation",
        ),
    ],
)
def test_faults_name_the_file(scene, name, content, expected):
    (scene / f"{name}.json").write_text(content)
    with pytest.raises(BadInput, match=expected):
        assert open_sequence(scene).truth


def test_changing_cameras_are_refused(scene):
    K2 = [60.0, *K[1:]]
    write(scene, "scene_camera", {i: {"cam_K": K2 if i == 36 else K, "depth_scale": 0.1} for i in NUMBERS})
    with pytest.raises(BadInput, match=r"scene_camera\.json: got 2 cameras, expected one camera"):
        open_sequence(scene)


def test_a_picture_without_a_number_is_refused(scene):
    for part in ("rgb", "depth"):
        (scene / part / "000001.png").rename(scene / part / "first.png")
    with pytest.raises(BadInput, match=r"first\.png: got the name"):
        open_sequence(scene)
    (scene / "rgb").rename(scene / "gray")
    with pytest.raises(MissingData, match="rgb: no such folder"):
        open_sequence(scene)


class Video:
    """A sequence in memory: two objects with millimetre depth, one of them hidden and later without truth."""

    name, format, path, objects = "video", "memory", None, ("can", "box")
    camera = Camera(50, 50, 20, 15, W, H)

    def __init__(self):
        T = np.stack([pose(k) for k in range(8)]).reshape(2, 4, 4, 4)
        T[1, 3] = np.nan
        self.truth = {name: ObjectTruth(T[k], np.ones(4, bool)) for k, name in enumerate(self.objects)}
        rng = np.random.default_rng(4)
        self.rgb = rng.integers(0, 256, (4, H, W, 3), dtype=np.uint8)
        self.depth_mm = rng.integers(0, 5000, (4, H, W))
        self.seen = rng.random((4, 2, H, W)) < 0.3
        self.seen[2, 1] = False

    def __len__(self):
        return 4

    def frame(self, i):
        return Frame(i, i / 30, self.rgb[i], self.depth_mm[i].astype(np.float32) * np.float32(0.001))

    def masks(self, i):
        return dict(zip(self.objects, self.seen[i]))


def test_written_scenes_are_read_back_identically(tmp_path):
    video = Video()
    numbers = write_scene(tmp_path / "set/test/000001", video)
    assert numbers == {"can": 1, "box": 2}
    read = open_sequence(tmp_path / "set/test/000001")
    assert read.camera == video.camera and len(read) == 4
    np.testing.assert_array_equal(read.times_s, np.arange(4) / 30)
    for k, name in enumerate(video.objects):
        obj = f"obj_{numbers[name]:06d}"
        np.testing.assert_allclose(read.truth[obj].T_cam_model, video.truth[name].T_cam_model, atol=1e-12)
        for i in range(4):
            assert np.array_equal(read.masks(i)[obj], video.seen[i, k] & ~(i == 3 and k == 1))
    for i in range(4):
        np.testing.assert_array_equal(read.frame(i).rgb, video.rgb[i])
        np.testing.assert_array_equal(read.frame(i).depth_m, video.frame(i).depth_m)
    assert read.truth["obj_000002"].labelled.tolist() == [True, True, False, False]
    info = json.loads((tmp_path / "set/test/000001/scene_gt_info.json").read_text())["0"][0]
    v, u = np.nonzero(video.seen[0, 0])
    assert info["px_count_visib"] == len(v)
    assert info["bbox_visib"] == [u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1]


def test_depth_that_does_not_fit_is_refused(tmp_path):
    video = Video()
    video.depth_mm = video.depth_mm + 65_000
    with pytest.raises(BadInput, match=r"frame 0 depth: got .* expected at most 65\.53 m"):
        write_scene(tmp_path / "a/b/c", video)


def test_written_models_are_read_back(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    mesh.apply_translation([0.01, -0.02, 0.3])
    colours = np.random.default_rng(0).integers(0, 255, (len(mesh.vertices), 4), np.uint8)
    colours[:, 3] = 255
    mesh.visual.vertex_colors = colours
    (tmp_path / "ball.obj").write_text(mesh.export(file_type="obj"))
    (tmp_path / "points.xyz").write_text("\n".join(f"{x} {y} {z}" for x, y, z in mesh.vertices))
    write_models(tmp_path / "models", {1: tmp_path / "ball.obj", 7: tmp_path / "points.xyz"})
    for number, source in ((1, "ball.obj"), (7, "points.xyz")):
        read = load_points(tmp_path / "models" / f"obj_{number:06d}.ply")
        np.testing.assert_allclose(read, load_points(tmp_path / source), atol=1e-7)
    info = json.loads((tmp_path / "models/models_info.json").read_text())["1"]
    assert info["diameter"] == pytest.approx(100, rel=1e-3)
    assert info["min_x"] == pytest.approx(-40, rel=1e-3) and info["size_z"] == pytest.approx(100, rel=1e-3)
    again = trimesh.load(tmp_path / "models/obj_000001.ply", process=False)
    assert len(again.faces) == len(mesh.faces)
    np.testing.assert_allclose(again.visual.vertex_colors, colours, atol=1)
