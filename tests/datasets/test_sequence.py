"""Opening sequences: recognition, names, times, masks, truth, in every layout."""

import json
import re
import subprocess
import sys
import warnings
from dataclasses import asdict
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt, MissingData
from p2p_lib.core.types import PoseEstimate, Status
from p2p_lib.datasets.image_sequence import ImageSequence
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import FORMATS, open_sequence, reopen
from p2p_lib.datasets.truth import ObjectTruth
from p2p_lib.evaluation.protocol import scored_frames
from p2p_lib.run import run

W, H, N = 48, 32, 4
K = np.array([[40.0, 0, 23.5], [0, 41.0, 15.5], [0, 0, 1]])
LABELS = (("is_mask_visible", "is_mask_visible.npy"), ("is_obj_in_image_labels", "is_obj_in_image.npy"))
POSES = se3.exp(np.c_[np.linspace(0, 0.3, N), np.zeros((N, 4)), np.full(N, 0.5)])


def write_pictures(folder, stems=None, depth_mm=700):
    """Colour with red 200, green 100, blue 10 + 40 i; depth depth_mm + i."""
    stems = stems or [f"{i:04d}" for i in range(N)]
    for sub in ("rgb", "depth"):
        (folder / sub).mkdir(parents=True)
    for i, stem in enumerate(stems):
        bgr = np.full((H, W, 3), (10 + 40 * i, 100, 200), np.uint8)
        cv2.imwrite(str(folder / "rgb" / f"{stem}.png"), bgr)
        cv2.imwrite(str(folder / "depth" / f"{stem}.png"), np.full((H, W), depth_mm + i, np.uint16))
    np.savetxt(folder / "cam_K.txt", K)
    return folder


def write_image(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def disc(i, value=255, at=10):
    mask = np.zeros((H, W), np.uint8)
    mask[5 : 9 + i, at : at + 6] = value
    return mask


def write_poses(folder, poses=POSES):
    folder.mkdir(parents=True)
    for i, T in enumerate(poses):
        np.savetxt(folder / f"{i:07d}.txt", T)


@pytest.fixture
def ycbineoat(tmp_path):
    folder = write_pictures(tmp_path / "mustard", [str(1581120424100262102 + i * 33_000_000) for i in range(N)])
    write_poses(folder / "annotated_poses")
    for i in range(N):
        write_image(folder / "gt_mask" / f"{i:04d}.png", disc(i))
        write_image(folder / "masks_other" / f"{i:04d}.png", disc(i, at=30))
    return folder


@pytest.fixture
def ycbmultitrack(tmp_path):
    folder = write_pictures(tmp_path / "table")
    for k, obj in enumerate(("can", "box")):
        write_poses(folder / "annotated_poses" / obj)
        for i in range(N):
            write_image(folder / "masks" / obj / f"{i:04d}.png", disc(i, at=5 + 20 * k))
        for kind, file, hidden in (
            ("is_mask_visible", "is_mask_visible", 1),
            ("is_obj_in_image_labels", "is_obj_in_image", 3),
        ):
            (folder / kind / obj).mkdir(parents=True)
            np.save(folder / kind / obj / f"{file}.npy", np.arange(N) != hidden + k * 10)
    return folder


def test_ycbineoat(ycbineoat):
    s = open_sequence(ycbineoat)
    assert (s.name, s.format, s.path, s.objects, len(s)) == ("mustard", "ycbineoat", ycbineoat, ("object",), N)
    np.testing.assert_array_equal(s.camera.K, K)
    assert (s.camera.width, s.camera.height) == (W, H)
    frame = s.frame(2)
    assert frame.index == 2 and frame.rgb.dtype == np.uint8 and frame.depth_m.dtype == np.float32
    np.testing.assert_array_equal(frame.rgb[3, 4], [200, 100, 90])  # red first
    np.testing.assert_allclose(frame.depth_m, 0.702, rtol=1e-6)
    np.testing.assert_array_equal(s.masks(2)["object"], disc(2) > 0)
    assert s.masks(2)["object"].dtype == bool and s.visible_px(2) == {"object": 36}
    truth = s.truth["object"]
    np.testing.assert_allclose(truth.T_cam_model, POSES, atol=1e-12)
    assert truth.labelled.all()


def test_nanosecond_names_give_seconds(ycbineoat):
    s = open_sequence(ycbineoat)
    assert s.frame(0).time_s == pytest.approx(1581120424.100262102, abs=1e-6)
    assert s.frame(3).time_s - s.frame(0).time_s == pytest.approx(0.099, abs=1e-6)


def test_ycbmultitrack(ycbmultitrack):
    s = open_sequence(ycbmultitrack)
    assert (s.format, s.objects) == ("ycbmultitrack", ("box", "can"))
    masks = s.masks(1)
    np.testing.assert_array_equal(masks["can"], disc(1, at=5) > 0)
    np.testing.assert_array_equal(masks["box"], disc(1, at=25) > 0)
    # Both labels must hold; "box" is labelled visible throughout.
    np.testing.assert_array_equal(s.truth["can"].labelled, [True, False, True, False])
    assert s.truth["box"].labelled.all()
    assert s.frame(3).time_s == pytest.approx(3 / 30)


def test_ycbmultitrack_sentinel_depth_is_invalid_there_only(ycbmultitrack, ycbineoat):
    for folder, expected in ((ycbmultitrack, 0), (ycbineoat, 65.535)):
        path = sorted((folder / "depth").iterdir())[1]
        depth = np.full((H, W), 500, np.uint16)
        depth[4, 5], depth[6, 7] = 65535, 0
        write_image(path, depth)
        depth_m = open_sequence(folder).frame(1).depth_m
        assert depth_m[4, 5] == pytest.approx(expected) and depth_m[6, 7] == 0 and depth_m[0, 0] == pytest.approx(0.5)


def test_missing_labels_hold(ycbmultitrack):
    for kind, file in LABELS:
        (ycbmultitrack / kind / "can" / file).unlink()
    assert open_sequence(ycbmultitrack).truth["can"].labelled.all()


def test_own_folder_without_masks(tmp_path):
    s = open_sequence(write_pictures(tmp_path / "mine"))
    assert (s.format, s.objects, s.truth) == ("folder", ("object",), {})
    assert s.masks(0) is None and s.visible_px(0) is None


def test_own_folder_with_label_images(tmp_path):
    folder = write_pictures(tmp_path / "mine")
    for i in range(N):  # the second object, label 3, enters at frame 2
        write_image(folder / "masks" / f"{i:04d}.png", disc(i, 1, 5) + (disc(i, 3, 30) if i >= 2 else 0))
    s = open_sequence(folder)
    assert s.objects == ("object_1", "object_3")
    np.testing.assert_array_equal(s.masks(3)["object_3"], disc(3, at=30) > 0)
    np.testing.assert_array_equal(s.masks(3)["object_1"], disc(3, at=5) > 0)
    assert s.visible_px(0) == {"object_1": 24, "object_3": 0}


def test_own_folder_with_one_label_is_one_unnamed_object(tmp_path):
    folder = write_pictures(tmp_path / "mine")
    for i in range(N):
        write_image(folder / "masks" / f"{i:04d}.png", disc(i, 255))
    s = open_sequence(folder)
    assert s.objects == ("object",) and s.visible_px(1) == {"object": 30}


def test_own_folder_with_a_folder_per_object(tmp_path):
    folder = write_pictures(tmp_path / "mine")
    for i in range(N):
        write_image(folder / "masks" / "cup" / f"{i:04d}.png", disc(i))
        write_image(folder / "masks" / "plate" / f"{i:04d}.png", disc(i, 1, 30))
    s = open_sequence(folder)
    assert s.objects == ("cup", "plate")
    np.testing.assert_array_equal(s.masks(1)["plate"], disc(1, at=30) > 0)


def test_own_folder_with_the_first_mask_alone(tmp_path):
    folder = write_pictures(tmp_path / "mine")
    write_image(folder / "masks" / "0000.png", disc(0))
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.masks(0)["object"], disc(0) > 0)
    assert s.masks(1) is None


def test_palette_masks_give_their_indices(tmp_path):
    Image = pytest.importorskip("PIL.Image", reason="Pillow writes the palette images of this test")
    folder = write_pictures(tmp_path / "mine")
    (folder / "masks").mkdir()
    for i in range(N):
        image = Image.fromarray(disc(i, 1, 5) + disc(i, 2, 30)).convert("L")
        image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0] + [0] * 759)
        image.save(folder / "masks" / f"{i:04d}.png")
    s = open_sequence(folder)
    assert s.objects == ("object_1", "object_2")
    np.testing.assert_array_equal(s.masks(1)["object_2"], disc(1, at=30) > 0)


def test_opacity_of_a_mask_is_not_mask(tmp_path):
    folder = write_pictures(tmp_path / "mine")
    for i in range(N):
        rgba = np.dstack([disc(i)] * 3 + [np.full((H, W), 255, np.uint8)])
        write_image(folder / "masks" / f"{i:04d}.png", rgba)
    assert open_sequence(folder).visible_px(1) == {"object": 30}


def test_other_masks_by_name_and_by_path(ycbineoat, tmp_path):
    for masks in ("masks_other", ycbineoat / "masks_other"):
        s = open_sequence(ycbineoat, masks=masks)
        np.testing.assert_array_equal(s.masks(1)["object"], disc(1, at=30) > 0)


def test_scoring_counts_the_datasets_own_masks_whatever_masks_are_used(ycbineoat):
    for i in range(N):
        write_image(ycbineoat / "masks_other" / f"{i:04d}.png", np.zeros((H, W), np.uint8))
    s = open_sequence(ycbineoat, masks="masks_other")
    assert not s.masks(1)["object"].any() and s.visible_px(1) == {"object": 30}
    assert s.visible_px(2) == {"object": 36}  # without reading the masks first


def test_other_masks_as_label_images_of_known_objects(ycbmultitrack):
    for i in range(N):
        write_image(ycbmultitrack / "labels" / f"{i:04d}.png", disc(i, 1, 5) + disc(i, 2, 30))
    s = open_sequence(ycbmultitrack, masks="labels")
    np.testing.assert_array_equal(s.masks(2)["box"], disc(2, at=5) > 0)  # objects are in order of their names
    np.testing.assert_array_equal(s.masks(2)["can"], disc(2, at=30) > 0)


def test_format_and_depth_scale_override(ycbineoat):
    s = open_sequence(ycbineoat, format="folder", depth_scale=0.0002)
    assert (s.format, s.truth) == ("folder", {})
    np.testing.assert_allclose(s.frame(0).depth_m, 0.14, rtol=1e-6)


def test_times_file(tmp_path):
    folder = write_pictures(tmp_path / "mine")
    (folder / "times.txt").write_text("0.5\n0.6\n0.75\n0.8\n")
    s = open_sequence(folder)
    assert [s.frame(i).time_s for i in range(N)] == [0.5, 0.6, 0.75, 0.8]


def test_unpadded_numbers_are_in_natural_order(tmp_path):
    folder = write_pictures(tmp_path / "mine", ["8", "9", "10", "11"])
    s = open_sequence(folder)
    np.testing.assert_allclose([s.frame(i).depth_m[0, 0] for i in range(N)], [0.7, 0.701, 0.702, 0.703], rtol=1e-6)
    assert [int(s.frame(i).rgb[0, 0, 2]) for i in range(N)] == [10, 50, 90, 130]


def test_nearly_rigid_poses_are_made_rigid(ycbineoat):
    path = ycbineoat / "annotated_poses" / "0000001.txt"
    T = POSES[1].copy()
    T[:3, :3] *= 1.001  # as the real files are
    np.savetxt(path, T)
    R = open_sequence(ycbineoat).truth["object"].T_cam_model[1, :3, :3]
    np.testing.assert_allclose(R, POSES[1, :3, :3], atol=1e-9)


def test_every_format_recognises_its_own(ycbineoat, ycbmultitrack, tmp_path):
    mine = write_pictures(tmp_path / "mine")
    found = {open_sequence(folder).format for folder in (ycbineoat, ycbmultitrack, mine)}
    assert found == {"ycbineoat", "ycbmultitrack", "folder"} <= set(FORMATS)


def test_a_folder_of_a_sequence_names_the_one_that_it_is_in(tmp_path):
    mine = write_pictures(tmp_path / "mine")
    with pytest.raises(BadInput, match=f"Give the folder that it is in: {mine}$"):
        open_sequence(mine / "rgb")


def test_synthetic_sequences_open_by_name_with_their_seed(ycbmultitrack, monkeypatch):
    asked = []
    import p2p_lib.synthetic as synthetic

    monkeypatch.setattr(
        synthetic, "scenario_dir", lambda name, seed, **_: asked.append((name, seed)) or ycbmultitrack, raising=False
    )
    s = open_sequence("synthetic/crossing", seed=7)
    assert (s.name, s.format, asked) == ("synthetic/crossing", "ycbmultitrack", [("crossing", 7)])
    named = open_sequence("synthetic/crossing@3", seed=7)
    assert (named.name, asked[1:]) == ("synthetic/crossing@3", [("crossing", 3)])
    again = {"path": None, "format": "ycbmultitrack", "seed": 5}
    for sequence, scene_seed in (("synthetic/crossing", 0), ("synthetic/crossing@3", 3), ("synthetic/crossing", None)):
        reopen(again | {"sequence": sequence, "scene_seed": scene_seed})
    assert asked[2:] == [("crossing", 0), ("crossing", 3), ("crossing", 5)], "of older runs the run's"
    with pytest.raises(BadInput, match=r"synthetic/crossing@x: got the seed 'x', expected synthetic/crossing@SEED"):
        open_sequence("synthetic/crossing@x")


def test_a_sequence_whose_camera_is_another_one_since_its_run_is_doubted(ycbmultitrack):
    camera = asdict(open_sequence(ycbmultitrack).camera)
    info = {"sequence": "own", "path": str(ycbmultitrack), "format": "ycbmultitrack", "seed": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("error", Doubt)
        reopen(info | {"camera": camera})
        reopen(info)  # of an older version
    with pytest.warns(Doubt, match="fx = .* when the run was made. Its poses and meshes are of the camera that it had"):
        reopen(info | {"camera": camera | {"fx": camera["fx"] / 2}})


def test_the_seed_of_a_run_is_no_seed_of_its_scene(ycbmultitrack, monkeypatch, tmp_path):
    asked = []
    import p2p_lib.synthetic as synthetic

    monkeypatch.setattr(synthetic, "scenario_dir", lambda name, seed, **_: asked.append(seed) or ycbmultitrack)
    options = {"settings": {"method.surface": False, "method.graph": False}, "stop": 1, "progress": False}
    for sequence, name in (("synthetic/crossing", "0"), ("synthetic/crossing@3", "3")):
        info = load_run(run(sequence, tmp_path / name, seed=5, **options).path).info
        assert (info["seed"], info["scene_seed"], info["sequence"]) == (5, int(name), sequence)
    assert set(asked[:1]) == {0} and asked[-1] == 3 and 5 not in asked


OWN = {
    "as it should be": {},
    "lists": {"rgb": list, "depth": list},
    "fewer depth images": {
        "depth": lambda files: files[:3],
        "said": "own: got 4 colour images, 3 depth images and 4 times, expected one of each a.*Look at the patterns",
    },
    "more depth images": {"depth": lambda files: files * 2, "said": "own: got 4 colour images, 8 depth images and 4"},
    "fewer times": {"times": lambda s: s[1:], "said": "own: got 4 colour images, 4 depth images and 3 times"},
    "nothing matches": {
        **dict.fromkeys(("rgb", "depth", "times"), lambda of: of[:0]),
        "said": "own: got 0 colour images, 0 depth images and 0 times, expected one of each a frame, and a frame",
    },
    "an iterator": {"rgb": iter, "said": r"own: rgb: got tuple_iterator, expected a tuple of Paths.*tuple\(sorted\("},
    "texts": {"depth": lambda files: tuple(map(str, files)), "said": "own: depth: got str, expected a tuple of Paths"},
    "swapped": {
        "size": (H, W),
        "said": "own: camera: got 32x48 pixels, expected 48x32, as .* images. Width and height",
    },
    "another size": {"size": (96, 64), "said": "own: camera: got 96x64 pixels, expected 48x32, as large as the colour"},
}


@pytest.mark.parametrize("masks", [True, False], ids=["with masks", "without"])
@pytest.mark.parametrize("case", OWN)
def test_what_a_loader_of_somebody_elses_puts_together_is_checked(tmp_path, monkeypatch, case, masks):
    """Whether it has masks or not: a mistake in the camera is not blamed on them."""
    write_pictures(tmp_path / "own")
    write_image(tmp_path / "own/masks/0000.png", disc(0))
    how = {"rgb": tuple, "depth": tuple, "times": np.array, "size": (W, H), "said": ""} | OWN[case]

    def load(folder, asked):
        rgb, depth = (how[part](tuple(sorted((folder / part).iterdir()))) for part in ("rgb", "depth"))
        made = ImageSequence(folder, rgb, depth, Camera.from_K(K, *how["size"]), how["times"](np.arange(N) / 30))
        return made.with_masks(asked, [folder / "masks"], some_frames=True) if masks else made

    monkeypatch.setitem(sys.modules, "their_layout", SimpleNamespace(load=load))
    if not how["said"]:
        sequence = open_sequence(tmp_path / "own", format="their_layout:load")
        assert sequence.frame(3).rgb[0, 0, 2] == 130 and (sequence.masks(0) is not None) == masks
        return
    with pytest.raises(BadInput, match=how["said"]):
        open_sequence(tmp_path / "own", format="their_layout:load")


def own_layout(monkeypatch, folder, read_truth, **more):
    """A sequence of a layout of somebody else's with this truth."""

    def load(folder, masks):
        rgb, depth = (tuple(sorted((folder / part).iterdir())) for part in ("rgb", "depth"))
        return ImageSequence(
            folder, rgb, depth, Camera.from_K(K, W, H), np.arange(N) / 30, read_truth=read_truth, **more
        )

    monkeypatch.setitem(sys.modules, "their_layout", SimpleNamespace(load=load))
    return open_sequence(folder, format="their_layout:load")


def scaled(by, at_m=0.5):
    T = se3.from_rt(se3.exp(np.c_[np.linspace(0, 0.3, N), np.zeros((N, 5))])[:, :3, :3], [0, 0, at_m])
    T[:, :3, :3] *= by
    return T


def first_wrong(T):
    T = T.copy()
    T[0], T[2, :3, :3] = np.nan, 1.3 * T[2, :3, :3]
    return T


EACH = np.ones(N, bool)
OF = r"^truth of 'mug' \(format their_layout:load\)"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (lambda: {"mug": ObjectTruth(first_wrong(POSES), EACH)}, OF + r", row 2: .* it scales by 1\.3\), .* NaN"),
        (lambda: {"mug": ObjectTruth(POSES * [1, 1, -1, 1], EACH)}, OF + ", row 0: .*right-handed"),
        (lambda: {"mug": ObjectTruth(POSES[:3], EACH[:3])}, OF + r": got 3 poses, expected 4, one for each image\."),
        (lambda: {"mug": POSES}, OF + r": got a value of type ndarray, expected an ObjectTruth"),
        (lambda: {"mug": ObjectTruth(POSES.tolist(), EACH)}, r"truth: got list and ndarray, expected arrays"),
        (lambda: POSES, r"^truth \(format their_layout:load\): got a value of type ndarray, expected a dict"),
        (lambda: {"mug": {}["poses"]}, r"^format their_layout:load: got KeyError: 'poses' in .*, expected a loader"),
    ],
)
def test_truth_of_somebody_elses_that_cannot_be_names_loader_object_and_row(tmp_path, monkeypatch, given, said):
    sequence = own_layout(monkeypatch, write_pictures(tmp_path / "own"), given)
    with pytest.raises(BadInput, match=said):
        _ = sequence.truth


def test_a_file_that_a_loader_does_not_find_is_named_with_it(tmp_path, monkeypatch):
    def read_truth():
        raise FileNotFoundError("poses_v2.npy")

    sequence = own_layout(monkeypatch, write_pictures(tmp_path / "own"), read_truth)
    with pytest.raises(
        MissingData, match=r"^format their_layout:load: .* FileNotFoundError: poses_v2\.npy in .*read_truth \("
    ):
        _ = sequence.truth
    sequence = own_layout(monkeypatch, sequence.path, dict, model_places={"mug": (tmp_path / "mug.ply",)})
    with pytest.warns(Doubt, match=r"model of 'mug' \(format their_layout:load\): no file .*mug\.ply"):
        assert find_models(sequence) == {}


@pytest.mark.parametrize(
    ("T", "said"),
    [
        (scaled(1.003), None),
        (scaled(1, 500.0), r"500 m from the camera \(median\)\. Is T_cam_model in metres"),
        (scaled(1, 0.0005), r"0\.0005 m from the camera"),
        (se3.inverse(scaled(1)), r"outside the image in 4 of 4 frames\. .* is it inverted"),
    ],
)
def test_truth_is_made_rigid_and_doubted_where_nothing_can_be_seen(tmp_path, monkeypatch, T, said):
    T[0] = np.nan if said is None else T[0]
    sequence = own_layout(monkeypatch, write_pictures(tmp_path / "own"), lambda: {"mug": ObjectTruth(T, EACH)})
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        found = sequence.truth["mug"].T_cam_model
    assert np.isnan(found[0]).all() == (said is None)
    np.testing.assert_allclose(found[1:, :3, :3] @ found[1:, :3, :3].swapaxes(1, 2), [np.eye(3)] * 3, atol=1e-12)
    assert len(doubts) == (said is not None)
    if said:
        assert doubts[0].message.object == "mug" and re.search(said, str(doubts[0].message))


def test_opening_is_light():
    code = "import sys, p2p_lib; p2p_lib.open_sequence; import json; print(json.dumps(sorted(sys.modules)))"
    loaded = set(
        json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    )
    assert not loaded & {"torch", "open3d", "scipy", "matplotlib", "trimesh", "gtsam"}


def test_truth_checks_its_shapes():
    with pytest.raises(BadInput, match=r"truth: got .*\(3, 4, 4\)"):
        ObjectTruth(np.zeros((3, 4, 4)), np.ones(4, bool))


def test_shared_sequences(shared_data):
    mustard = open_sequence(shared_data / "ycbineoat" / "mustard0_first400")
    assert (mustard.format, mustard.objects, len(mustard)) == ("ycbineoat", ("object",), 400)
    assert (mustard.camera.fx, mustard.camera.fy) == pytest.approx((319.582, 417.119), abs=1e-3)
    # The truth lies within the object's own mask: the projected origin and the depth there agree with it.
    for i in (0, 150, 399):
        frame, mask, T = mustard.frame(i), mustard.masks(i)["object"], mustard.truth["object"].T_cam_model[i]
        assert mask.sum() > 300
        assert abs(np.median(frame.depth_m[mask]) - T[2, 3]) < 0.1
        v, u = np.nonzero(mask)
        assert np.linalg.norm(mustard.camera.project(T[:3, 3]) - [u.mean(), v.mean()]) < 40
    table = open_sequence(shared_data / "real_multi" / "redkitchen_table")
    assert (table.format, table.objects, len(table)) == ("ycbmultitrack", ("books", "mug_flower", "mug_white"), 230)
    away = {}
    for name, truth in table.truth.items():
        large = np.array([table.visible_px(i)[name] >= 300 for i in range(len(table))])
        away[name] = set(np.flatnonzero(~(truth.labelled & large)))
    assert away["books"] == set(range(102, 197))
    assert away["mug_white"] >= set(range(76, 201)) and not away["mug_white"] & {75, 201}
    assert away["mug_flower"] >= set(range(145, 168)) and not away["mug_flower"] & {144, 168}


def test_unknown_names(tmp_path):
    with pytest.raises(MissingData, match=r"nowhere: no such folder.*synthetic/crossing"):
        open_sequence("nowhere")
    with pytest.raises(BadInput, match=r"format: got 'bop2', expected one of .*folder"):
        open_sequence(tmp_path, format="bop2")
    (tmp_path / "notes").mkdir()
    with pytest.raises(BadInput, match=rf"{tmp_path.name}: got a folder with notes/, expected rgb/.*--format"):
        open_sequence(tmp_path)
    for scale in (0, -1, 1000, float("nan")):
        with pytest.raises(BadInput, match=r"depth_scale: got .* expected metres per raw unit.*Millimetres are 0\.001"):
            open_sequence(tmp_path, depth_scale=scale)


def test_ycbmultitrack_truth_held_while_hidden_is_not_scored(ycbmultitrack, tmp_path):
    """The dataset repeats a hidden object's last pose: those frames must not count, whatever a tracker says there."""
    s = open_sequence(ycbmultitrack)
    with RunWriter(tmp_path / "run", s, preset("default"), "none", "dataset") as writer:
        for i in range(len(s)):
            held = se3.exp(np.array([0, 0, 0, 0.1, 0, 1.0]))
            writer.add(s.frame(i), {"can": PoseEstimate("can", i, float(i), Status.TRACKED, held, 1.0)}, 1.0)
    can = load_run(tmp_path / "run").objects["can"]
    assert can.has_truth.all() and can.has_pose.all()
    assert scored_frames(can, 0).tolist() == [True, False, True, False]


def test_ycbmultitrack_models_of_the_whole_dataset(ycbmultitrack):
    beside = ycbmultitrack.parent / "models" / "can"
    beside.mkdir(parents=True)
    (beside / "textured.obj").write_text("v 0 0 0\n")
    assert find_models(open_sequence(ycbmultitrack)) == {"can": beside / "textured.obj"}
    own = ycbmultitrack / "models" / "can"
    own.mkdir(parents=True)
    (own / "points.xyz").write_text("0 0 0\n")
    assert find_models(open_sequence(ycbmultitrack)) == {"can": own / "points.xyz"}


@pytest.mark.parametrize("name", ["mustard0_first400", "mustard_easy_00_02", "bleach_hard_00_03_chaitanya", "other"])
def test_ycbineoat_models_by_the_sequences_name(ycbineoat, name):
    folder = ycbineoat.rename(ycbineoat.parent / name)
    for ycb in ("006_mustard_bottle", "021_bleach_cleanser"):
        (ycbineoat.parent / "models" / ycb).mkdir(parents=True)
        (ycbineoat.parent / "models" / ycb / "textured_simple.obj").write_text("v 0 0 0\n")
    link = ycbineoat.parent / "elsewhere" / "link"
    link.parent.mkdir()
    link.symlink_to(folder)
    assert open_sequence(link).name == "link" and find_models(open_sequence(link)) == {}
    found = find_models(open_sequence(folder))
    expected = {"m": "006_mustard_bottle", "b": "021_bleach_cleanser"}.get(name[0])
    assert [path.parent.name for path in found.values()] == ([expected] if expected else [])


def test_folder_says_its_own_depth_scale(tmp_path):
    folder = write_pictures(tmp_path / "own", depth_mm=5000)
    (folder / "depth_scale.txt").write_text("0.0001\n")
    np.testing.assert_allclose(open_sequence(folder).frame(0).depth_m, 0.5, rtol=1e-6)
    np.testing.assert_allclose(open_sequence(folder, depth_scale=0.001).frame(0).depth_m, 5, rtol=1e-6)
    for wrong in ("0", "1000", "0.001 0.001", "mm", ""):
        (folder / "depth_scale.txt").write_text(wrong)
        with pytest.raises(BadInput, match=r"depth_scale\.txt: got"):
            open_sequence(folder)
