"""Datasets made of a run: read back by the loaders, and compared with the truth that the run was made of."""

import csv
import json
import re
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from p2p_lib.apps import cli
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.mesh import save
from p2p_lib.datasets.exchange import FORMATS
from p2p_lib.datasets.models import MESHES, find_models, load_points
from p2p_lib.offline.dataset import BESIDE, agreement, doubtful, visible
from p2p_lib.offline.finished import Finished, Silhouette
from p2p_lib.offline.products import write_product
from tests.fixtures.made_run import T_OBJ_MODEL


def test_labels_are_the_poses_and_the_masks_are_the_true_ones(made, scene):
    numbers = [int(name) for name in scene.frame_names]
    for k, name in enumerate(made.sequence.objects, 1):
        truth, labels = made.sequence.truth[name].T_cam_model[numbers], scene.truth[f"obj_{k:06d}"].T_cam_model
        right = [i not in made.wrong or name != "box" for i in numbers] & np.isfinite(labels).all((1, 2))
        np.testing.assert_allclose(labels[right] @ T_OBJ_MODEL, truth[right], atol=1e-6)
        shared = total = 0
        for at in np.flatnonzero(right):
            mine, own = scene.masks(int(at))[f"obj_{k:06d}"], made.sequence.masks(numbers[at])[name]
            shared, total = shared + np.count_nonzero(mine & own), total + np.count_nonzero(mine | own)
        assert right.sum() > 20 and shared / total > 0.97
    np.testing.assert_array_equal(scene.frame(3).rgb, made.sequence.frame(numbers[3]).rgb)


def test_what_is_left_out_and_what_is_doubtful_is_counted(made, finished, tmp_path):
    arrays = dict(np.load(finished / "poses.npz"))
    arrays["box/confidence"] = np.where(np.arange(len(made.sequence)) < 3, 0.4, arrays["box/confidence"])
    np.savez(finished / "poses.npz", **arrays)
    for least, look_at in ((0.5, 0), (0.3, 3)):
        said = write_product(finished, "bop-dataset", out := tmp_path / f"set{least}", least)
        rows = list(csv.DictReader((out / "labels.csv").open()))
        frames, n = {row["image"] for row in rows}, len(made.sequence)
        assert said.startswith(f"{len(rows)} labels in {len(frames)} of {n} images; {n - len(frames)} left out")
        assert f"; {look_at} of the labels doubtful" in said


def test_depth_makes_a_label_doubtful_that_fills_its_mask(finished, tmp_path):
    arrays = dict(np.load(finished / "poses.npz"))
    t = arrays["box/T_cam_obj"][10:13, :3, 3]
    t *= 1 - 0.02 / np.linalg.norm(t, axis=1, keepdims=True)  # 2 cm nearer, along its ray
    np.savez(finished / "poses.npz", **arrays)
    write_product(finished, "bop-dataset", out := tmp_path / "set")
    rows = {int(row["image"]): row for row in csv.DictReader((out / "labels.csv").open()) if row["object"] == "box"}
    assert {i for i in range(9, 14) if rows[i]["doubtful"] == "True"} == {10, 11, 12}
    for i in (10, 11, 12):
        assert float(rows[i]["visib_iou"]) > 0.8 and float(rows[i]["depth_on_surface"]) < 0.6
    assert "depth" in json.loads((out / "labels.json").read_text())["doubtful"]


def test_a_model_that_holds_more_than_its_object_makes_its_labels_doubtful(finished, tmp_path):
    """A strip of the table beside it: depth lies on it, and masks and what shows overlap well enough."""
    surface = trimesh.load(finished / "meshes/box.ply")
    low, high = surface.bounds
    strip = trimesh.creation.box(bounds=[[high[0], low[1], low[2]], [high[0] + 0.12 * (high - low)[0], *high[1:]]])
    strip.visual.vertex_colors = np.full((len(strip.vertices), 3), 128, np.uint8)
    save(trimesh.util.concatenate([surface, strip]), finished / "meshes/box.ply")
    said = write_product(finished, "bop-dataset", out := tmp_path / "set")
    rows = list(csv.DictReader((out / "labels.csv").open()))
    share = {name: np.median([float(r["beside_mask"]) for r in rows if r["object"] == name]) for name in ("box", "can")}
    assert share["can"] < 0.01 and share["box"] > BESIDE
    assert all((row["doubtful"] == "True") == (row["object"] == "box") for row in rows)
    told = f"beside the masks lies {100 * share['box']:.1f} % of box, {100 * share['can']:.1f} % of can"
    assert f"{told}: the model of box holds more than the object" in said
    assert json.loads((out / "labels.json").read_text())["beside_masks"] == pytest.approx(share, abs=1e-4)


@pytest.mark.parametrize("exact", [True, False])
def test_a_fringe_is_no_part_that_lies_beside(exact):
    """Nor what coarse masks lack; a strip is."""
    shown, mask = np.zeros((2, 200, 200), bool)
    shown[50:150, 40:160], mask[50:150, 50:150] = True, True
    made = SimpleNamespace(exact_masks=exact)
    assert Finished.beside(made, shown, mask) == pytest.approx((2 * 4 * 100 if exact else 0) / 12000)
    assert Finished.beside(made, shown[:, :147], mask[:, :147]) == pytest.approx((4 * 100 if exact else 0) / 10700)
    assert np.isnan(Finished.beside(made, shown & False, mask))


def test_holes_and_hands_make_no_label_doubtful():
    depth_m = np.full((40, 60), 0.5, np.float32)
    label = Silhouette((0, 0), depth_m.copy(), np.zeros(depth_m.shape, int))
    depth_m[:, :20], depth_m[:, 20:40] = 0, 0.4  # not measured, and hidden
    iou, on, off_mm = agreement(label, visible(label, depth_m), depth_m, None)
    assert np.isnan(iou) and on == 1 and off_mm == 0 and not doubtful(1.0, iou, on)
    depth_m[:, 40:55] = 0.9  # seen through
    on = agreement(label, visible(label, depth_m), depth_m, None)[1]
    assert on == 0.25 and doubtful(1.0, np.nan, on)


def test_models_are_metric_whatever_the_file_says(made, scene):
    for k, (_, path) in enumerate(sorted(find_models(made.sequence, MESHES).items()), 1):
        found = load_points(find_models(scene)[f"obj_{k:06d}"])
        np.testing.assert_allclose(found, se3.transform(T_OBJ_MODEL, load_points(path)), atol=1e-6)


def test_frames_with_an_object_in_plain_view_without_a_trusted_pose_are_left_out(made, scene):
    left_out = set(range(len(made.sequence))) - {int(name) for name in scene.frame_names}
    for i in range(len(made.sequence)):
        few = [name for name, px in made.sequence.visible_px(i).items() if 0 < px < 300]  # hidden for the run
        assert (i in left_out) == (i == 8 or bool(few)), i


def test_masks_and_counts_are_those_of_bop(scene):
    folder = scene.path
    infos = json.loads((folder / "scene_gt_info.json").read_text())
    fractions = []
    for i, info in infos.items():
        for k, counts in enumerate(info):
            whole, shown = (
                cv2.imread(str(folder / kind / f"{int(i):06d}_{k:06d}.png"), -1) > 0 for kind in ("mask", "mask_visib")
            )
            assert not (shown & ~whole).any() and counts["px_count_visib"] == shown.sum()
            assert counts["px_count_all"] >= whole.sum() >= counts["px_count_valid"]
            assert counts["visib_fract"] == pytest.approx(shown.sum() / counts["px_count_all"])
            fractions.append(counts["visib_fract"])
    assert min(fractions) < 0.5 and np.median(fractions) > 0.9  # the two cross


def test_the_fields_own_toolkit_reads_the_same(made, scene):
    inout = pytest.importorskip("bop_toolkit_lib.inout")
    folder, root, told = scene.path, scene.path.parents[1], 0
    labels, cameras = (getattr(inout, f"load_scene_{of}")(folder / f"scene_{of}.json") for of in ("gt", "camera"))
    for k, image in enumerate(map(int, scene.frame_names)):
        np.testing.assert_allclose(cameras[image]["cam_K"], scene.camera.K)
        depth_m = inout.load_depth(folder / f"depth/{image:06d}.png") * cameras[image]["depth_scale"] / 1000
        np.testing.assert_allclose(depth_m, made.sequence.frame(image).depth_m, atol=6e-4)
        for label in labels[image]:
            T_cam_model = se3.from_rt(label["cam_R_m2c"], label["cam_t_m2c"].ravel() / 1000)
            name = f"obj_{label['obj_id']:06d}"
            np.testing.assert_allclose(T_cam_model, scene.truth[name].T_cam_model[k], atol=1e-6)
            told += 1
    assert told == sum(int(truth.labelled.sum()) for truth in scene.truth.values()) > 40
    sizes = inout.load_json(root / "models/models_info.json", keys_to_int=True)
    for name, path in find_models(scene).items():
        model = inout.load_ply(str(root / f"models/{name}.ply"))
        np.testing.assert_allclose(model["pts"] / 1000, load_points(path), atol=1e-6)
        size_mm = [sizes[int(name[4:])][f"size_{axis}"] for axis in "xyz"]
        np.testing.assert_allclose(size_mm, np.ptp(model["pts"], axis=0), atol=0.01)


def test_what_says_that_a_label_is_good_tells_the_wrong_ones(made, scene):
    with (scene.path.parents[1] / "labels.csv").open() as file:
        rows = {int(row["image"]): row for row in csv.DictReader(file) if row["object"] == "box"}
    clear = {i: row for i, row in rows.items() if float(row["visib_fract"]) > 0.9 and i not in made.wrong}
    iou, off_mm = (np.array([float(row[key]) for row in clear.values()]) for key in ("visib_iou", "depth_off_mm"))
    assert max(float(rows[i]["visib_iou"]) for i in (6, 7)) < iou.min() - 0.05  # 2 cm aside
    assert float(rows[5]["depth_off_mm"]) > off_mm.max() + 1  # turned by 5 degrees


def test_nothing_is_half_written(finished, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine").write_text("")
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(BadInput, match="what is there already"):
        write_product(finished, "bop-dataset", tmp_path / "full")
    arrays = dict(np.load(finished / "poses.npz"))
    doubted = {key: value / 2 for key, value in arrays.items() if key.endswith("/confidence")}
    np.savez(finished / "poses.npz", **arrays | doubted)
    with pytest.raises(BadInput, match="no frame to label"):
        write_product(finished, "bop-dataset", tmp_path / "set")
    write_product(finished, "bop-dataset", tmp_path / "set", min_confidence=0.4)
    shutil.rmtree(tmp_path / "set")
    np.savez(finished / "poses.npz", **arrays)
    (finished / "meshes/box.ply").unlink()
    with pytest.raises(MissingData, match="no surface of 'box' in the run"):
        write_product(finished, "bop-dataset", tmp_path / "set")
    with pytest.raises(BadInput, match="format: got 'gltf', expected one of bop-dataset"):
        write_product(finished, "gltf", tmp_path / "set")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_images_that_are_gone_and_runs_without_poses_are_a_sentence_each(finished, made, tmp_path, capsys):
    info = json.loads((finished / "run.json").read_text())
    copy = shutil.copytree(made.sequence.path, tmp_path / "copy")
    (finished / "run.json").write_text(json.dumps(info | {"path": str(copy)}))
    sorted((copy / "rgb").iterdir())[20].unlink()
    assert cli.main(["export", str(finished), "--format", "bop-dataset", "--out", str(tmp_path / "set")]) == 2
    assert re.search(r"rgb.*: got 39 files|got 40 files", capsys.readouterr().err)
    shutil.rmtree(copy)
    assert cli.main(["export", str(finished), "--format", "bop-dataset", "--out", str(tmp_path / "set")]) == 2
    assert "no such folder" in capsys.readouterr().err and not (tmp_path / "set").exists()
    arrays = dict(np.load(finished / "poses.npz"))
    arrays |= {key: np.full_like(value, np.nan) for key, value in arrays.items() if key.endswith("/T_cam_obj")}
    np.savez(finished / "poses.npz", **arrays)
    for format in ("bop-dataset", "model", "foundationpose", *FORMATS):
        assert cli.main(["export", str(finished), "--format", format, "--out", str(tmp_path / "set")]) == 2
        assert "a run without a single pose" in capsys.readouterr().err and not (tmp_path / "set").exists()
