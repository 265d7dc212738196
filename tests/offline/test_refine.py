"""The offline pass: bundle adjustment against simulated truth, ties that depth contradicts, and a whole run mended."""

import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.apps import cli
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import from_toml, preset
from p2p_lib.core.types import Frame
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.datasets.mask_log import MaskLog
from p2p_lib.datasets.models import MESHES, find_models, load_mesh, read_mesh
from p2p_lib.datasets.runs import load_run
from p2p_lib.method.refinement import Keypoints
from p2p_lib.offline import adjustment, evidence, loops, surface
from p2p_lib.offline import refine as offline
from p2p_lib.offline.adjustment import PointObservations, adjust, information, locate, placed
from p2p_lib.offline.compared import compared
from p2p_lib.offline.finished import Finished
from p2p_lib.offline.surface import SurfacePoses, finer_m, fused
from p2p_lib.offline.surface_check import FittedPose, SurfaceCheck
from tests.fixtures.made_run import T_OBJ_MODEL

CAMERA = Camera(500, 500, 159.5, 119.5, 320, 240)


@pytest.fixture
def scene():
    """20 poses of an object half a metre away, 40 points of it, each seen in every frame; 2 mm of noise."""
    rng = np.random.default_rng(3)
    T = se3.from_rt(np.eye(3), np.array([0, 0, 0.5])) @ se3.exp(rng.normal(size=(20, 6)) * ([0.4] * 3 + [0.02] * 3))
    p = rng.normal(scale=0.05, size=(40, 3))
    pose, point = (x.ravel() for x in np.meshgrid(np.arange(20), np.arange(40), indexing="ij"))
    p_cam = se3.transform(T[pose], p[point][:, None])[:, 0] + rng.normal(scale=0.002, size=(800, 3))
    noise_m = np.full(800, 0.002)
    return T, p, PointObservations(pose, point, p_cam, information(p_cam, noise_m, noise_m)), rng


def off(T, T_true):
    """Errors (n, 6) with the object frame that fits best."""
    each = se3.inverse(T) @ T_true
    mean = each[0]
    for _ in range(20):
        mean = mean @ se3.exp(se3.log(se3.inverse(mean) @ each).mean(0))
    return se3.log(se3.inverse(mean) @ each)


def test_adjustment_is_as_good_as_its_points_allow(scene):
    T, p, seen, rng = scene
    start = T @ se3.exp(rng.normal(size=(20, 6)) * ([0.05] * 3 + [0.005] * 3))
    best, points = adjust(start, placed(start, seen, 40), seen)
    error = off(best, T)
    assert np.abs(error[:, 3:]).mean() < 0.0004  # 2 mm by the root of 40 points
    H = np.concatenate([-se3.hat(p), np.broadcast_to(np.eye(3), (40, 3, 3))], 2).reshape(120, 6) / 0.002
    assert 4 < np.einsum("ni,ij,nj->n", error, H.T @ H, error).mean() < 9  # six degrees of freedom
    assert np.abs(se3.transform(best[seen.pose], points[seen.point][:, None])[:, 0] - seen.p_cam).mean() < 0.002


def test_tracks_that_slid_away_count_for_nothing(scene):
    T, p, seen, rng = scene
    wrong = rng.random(800) < 0.3
    seen.p_cam[wrong] += [0.03, 0, 0.02]
    best, _ = adjust(T, placed(T, seen, 40), seen)
    assert np.abs(off(best, T)[:, 3:]).mean() < 0.001
    alone = locate(T @ se3.exp(np.full(6, 0.01)), p, seen)
    assert np.abs(se3.log(se3.inverse(alone) @ T)[:, 3:]).mean() < 0.002


def test_poses_are_located_some_at_a_time(scene, monkeypatch):
    T, p, seen, _ = scene
    start = T @ se3.exp(np.full(6, 0.01))
    at_once = locate(start, p, seen)
    held, located = [], adjustment._located
    monkeypatch.setattr(adjustment, "_AT_ONCE", 8)
    monkeypatch.setattr(adjustment, "_located", lambda T, *of: held.append(len(T)) or located(T, *of))
    np.testing.assert_allclose(locate(start, p, seen), at_once, atol=1e-4)
    assert held == [8, 8, 4]


def test_of_too_many_points_those_that_most_poses_see_decide_and_each_pose_has_some(scene, monkeypatch):
    """Ten poses see points 0 to 19, the other ten half of the other points each: those are seen less often."""
    T, _, seen, rng = scene
    apart = (seen.point < 20) == (seen.pose < 10)
    alike = seen.select(apart & ((seen.pose < 10) | ((seen.point + seen.pose) % 2 == 0)))
    monkeypatch.setattr(adjustment, "MOST_POINTS", 20)
    used = adjustment.best_seen(alike, 20, 40)
    assert used.sum() == 20 and used[:20].sum() >= 17
    assert (np.bincount(alike.pose[used[alike.point]], minlength=20) >= 1).all()
    assert adjustment.best_seen(alike, 20, 20).all()
    sizes = []
    solve = adjustment._adjusted
    monkeypatch.setattr(
        adjustment, "_adjusted", lambda T, p, seen: sizes.append((len(p), seen.point.max())) or solve(T, p, seen)
    )
    start = T @ se3.exp(rng.normal(size=(20, 6)) * ([0.05] * 3 + [0.005] * 3))
    best, points = adjust(start, placed(start, seen, 40) + rng.normal(scale=0.01, size=(40, 3)), seen)
    assert sizes == [(20, 19)]
    assert np.abs(off(best, T)[:, 3:]).mean() < 0.0006  # of half as many points
    assert np.abs(se3.transform(best[seen.pose], points[seen.point][:, None])[:, 0] - seen.p_cam).mean() < 0.002


def test_clouds_are_kept_in_a_file_and_read_back_as_they_were(tmp_path):
    rng, clouds = np.random.default_rng(0), evidence.StoredClouds(tmp_path)
    given = [rng.normal(size=(n, 3)).astype(np.float32) for n in (5, 0, 7, 1)]
    for k, cloud in enumerate(given):
        clouds.append(cloud)
        np.testing.assert_array_equal(clouds[k // 2], given[k // 2])  # read between
    for k in (3, 0, 1, 2):
        np.testing.assert_array_equal(clouds[k], given[k])
    assert not list(tmp_path.iterdir()), "nothing is left behind, however it ends"


def view(T_cam_obj, stands_still):
    """A plate with a knob beside its middle, and features: the knob's, and more that do not move with the plate."""
    rays = CAMERA.rays.reshape(-1, 3).astype(float)
    T = se3.inverse(T_cam_obj)
    depth = -T[2, 3] / (rays @ T[2, :3])  # of the plane z = 0 of the object
    p = se3.transform(T, rays * depth[:, None])
    inside = (np.linalg.norm(p[:, :2], axis=1) < 0.06).reshape(240, 320)
    knob = (np.linalg.norm(p[:, :2] - [0.03, 0], axis=1) < 0.02).reshape(240, 320)
    depth_m = np.where(inside, depth.reshape(240, 320) - 0.03 * knob, 1.0).astype(np.float32)
    rows = np.flatnonzero(inside)[::7]
    cloud = rays[rows] * depth_m.ravel()[rows, None]
    moving = se3.transform(T_cam_obj, np.random.default_rng(0).normal(scale=0.02, size=(12, 3)))
    rng = np.random.default_rng(1)
    descriptors = rng.random((12 + len(stands_still), 128))
    descriptors *= 512 / np.linalg.norm(descriptors, axis=1, keepdims=True)
    return loops.Features(np.concatenate([moving, stands_still]), descriptors, cloud, depth_m)


def test_what_shines_and_stands_still_ties_nothing():
    T = se3.from_rt(np.eye(3), np.array([0, 0, 0.5]))
    turned = T @ se3.exp(np.array([0, 0, np.radians(40), 0, 0, 0]))
    shine = T[:3, 3] + np.random.default_rng(2).normal(scale=0.02, size=(25, 3))
    views = [view(T, shine), view(turned, shine)]
    (tie,) = loops.ties(views, CAMERA, np.random.default_rng(0))
    assert np.degrees(se3.angle_rad(tie.T_a_b)) < 1  # most matches stand still
    assert tie.strength < 5 < loops.rated(T @ se3.inverse(turned), 12, *views, CAMERA)


def disc(radius_m: float) -> loops.Features:
    """A disc half a metre away before a wall, seen from in front."""
    p = CAMERA.rays.reshape(-1, 3) * 0.5
    on = np.linalg.norm(p[:, :2], axis=1) < radius_m
    depth_m = np.where(on, 0.5, 1.0).reshape(240, 320).astype(np.float32)
    return loops.Features(np.zeros((0, 3)), np.zeros((0, 128)), p[on][::7], depth_m)


def test_depth_contradicts_a_tie_whichever_of_its_views_shows_more():
    """Points of the larger disc would float before the wall beside the smaller one; not the other way round."""
    small, large = disc(0.03), disc(0.06)
    for pair in ((small, large), (large, small)):
        assert loops.rated(np.eye(4), 100, *pair, CAMERA) < 1
    assert loops.rated(np.eye(4), 100, small, small, CAMERA) == 100


def test_features_match_that_are_each_others_nearest_and_like_no_other():
    rng = np.random.default_rng(0)
    own = rng.random((4, 128))
    one, other = np.abs(own + rng.normal(0, 0.02, (2, *own.shape)))
    a, b = np.stack([own[0], own[1], one[1], own[2]]), np.stack([one[0], other[0], own[1], own[3], own[2]])
    views = [
        loops.Features(np.zeros((len(d), 3)), 512 * d / np.linalg.norm(d, axis=1, keepdims=True), *[None] * 2)
        for d in (a, b)
    ]
    np.testing.assert_array_equal(loops.matched(*views), [[1, 3], [2, 4]])


def test_matches_that_do_not_move_rigidly_are_no_tie():
    turned, rng = se3.from_rt(np.eye(3), np.array([0, 0, 0.5])), np.random.default_rng(0)
    one, other = (view(turned @ se3.exp(rng.normal(0, 0.1, 6)), np.zeros((0, 3))) for _ in range(2))
    assert len(loops.ties([one, other], CAMERA, rng)) == 1
    crossed = replace(other, p_cam=rng.permutation(other.p_cam))
    assert not loops.ties([one, crossed], CAMERA, rng)


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_ties_of_a_pair_the_stronger_counts_and_no_pose_is_needed_where_they_are(order):
    T = se3.exp(np.random.default_rng(5).normal(size=(3, 6)))
    known = T.copy()
    known[1] = np.nan
    pairs = [(0, 1, T[0] @ se3.inverse(T[1]), 30.0), (0, 1, np.eye(4), 2.0), (1, 2, T[1] @ se3.inverse(T[2]), 20.0)]
    np.testing.assert_allclose(loops.along_ties(known, pairs[::order]), T, atol=1e-9)


def test_poses_follow_the_strongest_ties():
    T = se3.exp(np.random.default_rng(5).normal(size=(5, 6)))
    slipped = T.copy()
    slipped[3:] = slipped[3:] @ se3.exp(np.array([0, 0.5, 0, 0, 0, 0]))
    pairs = [(k, k + 1, slipped[k] @ se3.inverse(slipped[k + 1]), 2.0 if k == 2 else 30.0) for k in range(4)]
    pairs.append((0, 4, T[0] @ se3.inverse(T[4]), 12.0))
    found = loops.along_ties(slipped, pairs)
    for k in range(1, 5):
        np.testing.assert_allclose(found[0] @ se3.inverse(found[k]), T[0] @ se3.inverse(T[k]), atol=1e-9)


def with_tracks(made, finished):
    """The finished run with points of each model wherever the depth shows them, good to a third of a pixel."""
    rng, log, maps = np.random.default_rng(0), KeypointLog(), {}
    for number, (name, path) in enumerate(sorted(find_models(made.sequence, MESHES).items())):
        vertices = load_mesh(path)[0]
        points = vertices[rng.choice(len(vertices), 120)]
        ids = np.arange(120) + 1000 * number
        for i in range(len(made.sequence)):
            p_cam = se3.transform(made.sequence.truth[name].T_cam_model[i], points)
            uv_px, frame = made.sequence.camera.project(p_cam), made.sequence.frame(i)
            u, v = np.clip(uv_px, 0, (639, 479)).round().astype(int).T
            seen = made.sequence.camera.inside(uv_px) & (np.abs(frame.depth_m[v, u] - p_cam[:, 2]) < 0.005)
            log.add(i, name, ids[seen], uv_px[seen] + rng.normal(scale=0.3, size=(seen.sum(), 2)))
        maps[name] = ids, se3.transform(T_OBJ_MODEL, points), np.ones(120, bool)
    log.save(finished, maps)
    return finished


@pytest.fixture
def tracked(made, finished):
    return with_tracks(made, finished)


@pytest.fixture(scope="module")
def refined(made, another):
    """A run whose poses of the box say how good they are, what was told of refining it, and its files before."""
    folder = with_tracks(made, another())
    with_covariances(folder, "box")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evidence, "KEYFRAMES", 9)  # frames 4 and 9, and none between: only neighbours tell of frame 8
        return folder, offline.refine_run(folder), before


def errors(made, folder, name):
    obj = load_run(folder).objects[name]
    T = made.sequence.truth[name].T_cam_model[obj.frame_index]
    deg, mm = se3.error_deg_mm(obj.T_cam_obj @ T_OBJ_MODEL, T)
    return deg, mm


def test_wrong_poses_are_mended_and_the_lost_one_is_found(made, refined):
    tracked, told, before = refined
    assert "(1 more, 0 fewer than causally)" in told[0]
    assert {path: path.read_bytes() for path in before} == before
    mesh = read_mesh(tracked / "offline/meshes/box.ply")
    assert np.median(mesh.edges_unique_length) < 0.6 * from_toml(tracked / "config.toml").tsdf.voxel_m
    deg, mm = errors(made, tracked / "offline", "box")
    assert np.nanmax(deg[[5, 6, 7, 8]]) < 1.5 and np.nanmax(mm[[5, 6, 7, 8]]) < 4
    assert np.nanmedian(deg) < 0.8 and np.nanmedian(mm) < 2
    info = json.loads((tracked / "offline/run.json").read_text())
    assert info["offline"] is True and "offline" not in json.loads((tracked / "run.json").read_text())


def test_a_surface_is_as_fine_as_all_of_the_object_fits(made):
    """What has no room for half the voxels was cut off at the volume's end."""
    of, T, config = Finished(made.run, made.sequence), made.run.objects["can"].T_cam_obj, preset()
    rows = np.flatnonzero(np.isfinite(T[:, 0, 0]))[::4]
    coarse = fused(of, "can", T, rows, config, config.tsdf.voxel_m)
    assert finer_m(coarse) == config.tsdf.voxel_m / 2
    few = replace(config, tsdf=replace(config.tsdf, max_voxels=2 * int(np.prod(coarse.shape))))
    coarse = fused(of, "can", T, rows, few, config.tsdf.voxel_m)
    fine_m = finer_m(coarse)
    assert config.tsdf.voxel_m / 2 < fine_m < config.tsdf.voxel_m
    whole = fused(of, "can", T, rows, config, fine_m).mesh().extents
    np.testing.assert_array_equal(fused(of, "can", T, rows, few, fine_m).mesh().extents, whole)
    assert (fused(of, "can", T, rows, few, config.tsdf.voxel_m / 2).mesh().extents < 0.9 * whole).any()


def test_poses_that_fill_the_masks_better_stay(made, tracked, monkeypatch):
    """Whatever the offline pass makes of them: here every pose of its comes out up to a centimetre beside."""
    best_of, rng = SurfacePoses._best_of, np.random.default_rng(0)

    def beside(*args):
        T, covariance, cost = best_of(*args)
        return FittedPose(se3.exp(np.array([0, 0, 0, *rng.uniform(-0.01, 0.01, 2), 0])) @ T, covariance, cost)

    monkeypatch.setattr(SurfacePoses, "_best_of", beside)
    told = offline.refine_run(tracked)
    causal, refined = (load_run(folder).objects["can"] for folder in (tracked, tracked / "offline"))
    np.testing.assert_array_equal(refined.T_cam_obj[causal.has_pose], causal.T_cam_obj[causal.has_pose])
    kept = {name: np.load(tracked / "offline/poses.npz")[f"{name}/causal"] for name in ("box", "can")}
    np.testing.assert_array_equal(kept["can"], causal.has_pose)
    assert f", {causal.has_pose.sum()} of them the causal one, " in told[1]
    before, after = (load_run(folder).objects["box"].T_cam_obj for folder in (tracked, tracked / "offline"))
    np.testing.assert_array_equal(kept["box"], (before == after).all((1, 2)))
    assert not kept["box"][[6, 8]].any()  # of the first the pose was grossly wrong, the second had none
    _, mm = errors(made, tracked / "offline", "box")
    assert np.nanmedian(mm) < 0.1 and mm[6] < 18  # of 20 that the causal pose is off in that frame alone


def test_an_interrupted_pass_goes_on(tracked, monkeypatch):
    did = []

    def part(made, name, config, evidence, parts, bar):
        did.append(name)
        if did == ["box", "can"]:
            raise KeyboardInterrupt
        moved = made.run.objects[name].T_cam_obj @ se3.exp(np.full(6, 0.001 * len(did)))
        np.savez(parts / f"{name}.npz", T_cam_obj=moved, causal=np.zeros(len(moved), bool))

    monkeypatch.setattr(offline, "_part", part)
    monkeypatch.setattr(offline, "gather", lambda made, names, *_: dict.fromkeys(names))
    with pytest.raises(KeyboardInterrupt):
        offline.refine_run(tracked)
    assert not (tracked / "offline").exists()
    offline.refine_run(tracked)
    assert did == ["box", "can", "can"] and (tracked / "offline/run.json").is_file()
    assert not (tracked / offline._PARTS).exists()
    before, after = load_run(tracked).objects, load_run(tracked / "offline").objects
    for name, times in {"box": 1, "can": 3}.items():
        moved = before[name].T_cam_obj @ se3.exp(np.full(6, 0.001 * times))
        np.testing.assert_allclose(after[name].T_cam_obj, moved, equal_nan=True)


@pytest.fixture
def as_they_were(monkeypatch):
    """A pass that leaves every pose as it was; in which objects it has been, in turn."""
    did = []

    def part(made, name, config, evidence, parts, bar):
        did.append(name)
        T = made.run.objects[name].T_cam_obj
        np.savez(parts / f"{name}.npz", T_cam_obj=T, causal=np.zeros(len(T), bool))

    monkeypatch.setattr(offline, "_part", part)
    monkeypatch.setattr(offline, "gather", lambda made, names, *_: dict.fromkeys(names))
    return did


def test_what_was_refined_already_is_left_as_it_is(tracked, as_they_were, monkeypatch, capsys):
    words, written = ["refine", str(tracked), "--quiet"], tracked / "offline/run.json"
    assert cli.main(words) == cli.main([*words, "--force"]) == 0 and as_they_were == 2 * ["box", "can"]
    before, _ = written.stat().st_ino, capsys.readouterr()
    assert cli.main(words) == 0 and len(as_they_were) == 4 and written.stat().st_ino == before
    assert "left as it is; --force does it anew" in capsys.readouterr().out.splitlines()[0]
    with_covariances(tracked, "box")
    said = f"it was made of earlier poses of its run. Make it anew: p2p refine {tracked}"
    for at_last in (True, False):
        assert cli.main(["film", str(tracked / "offline"), "--out", str(tracked / "film.gif")]) == 0
        assert (said in capsys.readouterr().err) == at_last
        assert cli.main(words) == 0 and len(as_they_were) == 6, "other poses"
    monkeypatch.setattr(offline, "code_digest", lambda: "another")
    assert cli.main(words) == 0 and len(as_they_were) == 8, "other code"


def test_which_poses_fit_better_is_said(made, tracked, as_they_were, capsys):
    """Those are to be kept that keypoints and masks are for; one of the two alone tells nothing."""
    log = MaskLog(made.sequence.camera)
    for i in range(len(made.sequence)):
        for name, mask in made.sequence.masks(i).items():
            log.add(made.sequence.frame(i), name, mask)
    log.save(tracked)
    assert cli.main(["refine", str(tracked), "--quiet"]) == 0
    title, *_ = said = capsys.readouterr().out.splitlines()[2:-1]
    assert title.startswith("Causal -> offline, by some of the images") and len(said) == 3
    shutil.copytree(tracked / "meshes", tracked / "offline/meshes")
    (box, can), path = compared(tracked), tracked / "offline/poses.npz"
    same = r": depth on surface (\d+) -> \1 %, mask IoU (\d+) -> \2 %, reprojection 0\.\d+ -> 0\.\d+ px"
    assert re.fullmatch("box" + same, box) and re.fullmatch("can" + same, can)
    arrays = dict(np.load(path))
    aside = se3.exp(np.array([0, 0, 0, 0.015, 0, 0]))
    arrays["can/T_cam_obj"][::2] = arrays["can/T_cam_obj"][::2] @ aside
    np.savez(path, **arrays)
    again, worse = compared(tracked)
    assert again == box
    assert re.search(
        r"px; keep the causal one: keypoints more than 3 px off in 0 -> (4[5-9]|5[0-5]) % of the fr", worse
    )
    (tracked / "masks.npz").unlink()
    assert all("keep" not in line and "IoU" not in line for line in compared(tracked))


def test_a_path_may_lead_through_the_result_that_is_replaced(tracked, as_they_were, monkeypatch):
    offline.refine_run(tracked)
    (tracked / "offline/mine.txt").write_text("of the first pass")
    offline.refine_run(tracked / "offline/..", force=True)
    assert (tracked / "offline/run.json").is_file() and not (tracked / "offline/mine.txt").exists()
    (tracked / "offline/mine.txt").write_text("of the second")
    rename = type(tracked).rename

    def not_written(path, to):
        if path.name == "whole":
            raise OSError("no space is left")
        return rename(path, to)

    monkeypatch.setattr(type(tracked), "rename", not_written)
    with pytest.raises(OSError, match="no space"):
        offline.refine_run(tracked, force=True)
    assert (tracked / offline._PARTS / "before/mine.txt").is_file(), "not deleted before the new one is in its place"


def with_covariances(folder, name):
    """The run in a folder says of each pose of an object that it is good to half a degree and 3 mm."""
    arrays = dict(np.load(folder / "poses.npz"))
    has = np.isfinite(arrays[f"{name}/T_cam_obj"]).all((1, 2))
    arrays[f"{name}/covariance"][has] = np.diag([np.radians(0.5) ** 2] * 3 + [0.003**2] * 3)
    np.savez(folder / "poses.npz", **arrays)


def test_covariances_are_new_and_where_both_disagree_is_told(refined):
    tracked, told, _ = refined
    causal, refined = (load_run(folder).objects["box"] for folder in (tracked, tracked / "offline"))
    kept = np.load(tracked / "offline/poses.npz")["box/causal"]
    new = refined.has_pose & ~kept
    assert new.sum() > 5
    assert (np.linalg.eigvalsh(refined.covariance[new]) > 0).all()
    before, after = (np.diagonal(obj.covariance, axis1=1, axis2=2)[new & causal.has_pose] for obj in (causal, refined))
    assert (np.abs(after / before - 1).max(1) > 0.01).all()
    np.testing.assert_array_equal(refined.covariance[kept], causal.covariance[kept])
    wrong = json.loads((tracked / "offline/run.json").read_text())["disagrees_above_3_sigma"]
    assert {5, 6, 7} <= set(wrong["box"]) and len(wrong["box"]) < 10 and wrong["can"] == []
    off = f"{len(wrong['box'])} more than three sigmas from it and 3 mm or 2 degrees"
    assert f"{off}{offline.in_ranges(wrong['box'])}" in told[0]
    assert told[1].endswith("0 more than three sigmas from it")


def test_covariances_turn_with_the_object_frame(made):
    """By definition: of poses drawn around the new one, the spread as it is in the causal frame."""
    obj, moved = made.run.objects["can"], se3.exp(np.array([0.9, -0.4, 0.3, 0.2, 0.1, -0.3]))
    has, n, rng = obj.has_pose, len(obj), np.random.default_rng(0)
    root = np.diag([0.01, 0.002, 0.004, 0.003, 0.001, 0.002])
    poses = SimpleNamespace(
        T=np.where(has[:, None, None], obj.T_cam_obj, np.eye(4)) @ moved,
        covariance=np.tile(root @ root, (n, 1, 1)),
        cost=np.full(n, 0.2),
        limit=0.5,
    )
    columns, _ = offline._columns(obj, poses, evidence.VideoEvidence(mask_px=[0] * n), None)
    k = int(np.flatnonzero(has)[3])
    drawn = poses.T[k] @ se3.exp(rng.normal(size=(20_000, 6)) @ root) @ se3.inverse(moved)
    spread = np.cov(se3.log(se3.inverse(columns["T_cam_obj"][k]) @ drawn).T)
    scale = np.sqrt(np.outer(*[np.diag(spread)] * 2))
    np.testing.assert_allclose(columns["covariance"][k] / scale, spread / scale, atol=0.05)


@pytest.mark.parametrize("findable", [True, False])
def test_a_map_that_never_met_the_other_gets_poses_in_it_or_none(made, tracked, monkeypatch, findable):
    """The last frames of the can are said in a map of its own, whose frame has nothing to do with the first one's."""
    arrays, apart = dict(np.load(tracked / "poses.npz")), np.arange(len(made.sequence)) >= 30
    arrays["can/map_id"] = apart.astype(int)
    arrays["can/T_cam_obj"] = np.where(
        apart[:, None, None], arrays["can/T_cam_obj"] @ se3.exp(np.full(6, 0.3)), arrays["can/T_cam_obj"]
    )
    arrays["box/T_cam_obj"][:] = np.nan  # nothing is asked of it, and refining it takes as long
    np.savez(tracked / "poses.npz", **arrays)
    other = apart & np.isfinite(arrays["can/T_cam_obj"]).all((1, 2))
    assert other.sum() > 5
    if not findable:
        monkeypatch.setattr(loops, "ties", lambda *of: [])
        monkeypatch.setattr(SurfacePoses, "ask_neighbours", lambda *of: None)
    told = offline.refine_run(tracked)
    refined = load_run(tracked / "offline", every_map=True).objects["can"]
    found, lost = other & refined.has_pose, other & ~refined.has_pose
    assert (refined.map_id == 0).all() and found.any() == findable
    deg, mm = errors(made, tracked / "offline", "can")
    assert (deg[found] < 2).all() and (mm[found] < 5).all(), "in the frame of the map that is kept"
    assert set(refined.status[found]) <= {"recovered"}
    assert set(refined.status[lost]) == {"lost"} and set(refined.reason[lost]) == {"no pose fits"}
    assert f"none in {lost.sum()} frames of a map that never met this one)" in told[1]
    lines = (tracked / "offline/poses/can.txt").read_text().splitlines()
    assert lines[0] == "# offline" and len(lines) == 1 + refined.has_pose.sum()


def test_disagreement_is_measured_by_the_causal_covariance(made):
    obj = made.run.objects["can"]
    covariance = np.tile(np.diag([1e-4] * 3 + [1e-6] * 3), (len(obj), 1, 1))
    causal = replace(obj, covariance=covariance)
    squared = offline.disagreement(causal, obj.T_cam_obj @ se3.exp(np.array([0, 0, 0, 0.005, 0, 0])))
    np.testing.assert_allclose(squared[obj.has_pose], 25, rtol=1e-6)  # 5 mm of 1 mm
    assert np.isnan(squared[~obj.has_pose]).all()
    assert offline.in_ranges([3, 4, 5, 9]) == ": frames 3 to 5, 9"
    assert offline.in_ranges([0, 2, 4, 6, 8, 9, 11]) == ": frames 8 to 9, 0, 2, 4, 6 and 1 more"


def test_poses_that_are_both_good_do_not_disagree(made):
    """At the object's keypoints, wherever its frame has its origin; however small the covariance."""
    obj, p_obj = made.run.objects["can"], np.array([[0.0, 0, 0.8]])
    about = np.eye(4)
    about[:3, 3] = p_obj[0]
    for turn, step_m, far in ((0.03, 0.002, False), (0, 0.004, True), (0.04, 0, True)):
        move = [0, turn, 0, step_m, 0, 0]
        moved = obj.T_cam_obj @ about @ se3.exp(np.array(move)) @ se3.inverse(about)
        assert (offline.far_apart(obj, moved, p_obj)[obj.has_pose] == far).all()


def test_what_cannot_be_refined_is_a_sentence(tracked, capsys):
    (tracked / "keypoints.npz").unlink()
    assert cli.main(["refine", str(tracked), "--quiet"]) == 2
    assert "no tracks were kept" in capsys.readouterr().err
    assert not (tracked / "offline").exists() and not (tracked / offline._PARTS).exists()
    shutil.copy(tracked / "run.json", tracked / "before.json")
    (tracked / "run.json").write_text(json.dumps(json.loads((tracked / "before.json").read_text()) | {"offline": True}))
    assert cli.main(["refine", str(tracked), "--quiet"]) == 2
    assert "an offline result already" in capsys.readouterr().err


def test_frames_keep_the_causal_object_frame_and_what_does_not_fit_has_no_pose(made):
    obj, moved = made.run.objects["box"], se3.exp(np.array([0.3, -0.2, 0.1, 0.02, 0.01, -0.03]))
    has, n = obj.has_pose, len(obj)
    T = np.where(has[:, None, None], obj.T_cam_obj, np.eye(4)) @ moved
    cost = np.where(has, 0.2, 0.9)
    poses = SimpleNamespace(T=T, covariance=np.tile(np.eye(6), (n, 1, 1)), cost=cost, limit=0.5)
    columns, fits = offline._columns(obj, poses, evidence.VideoEvidence(mask_px=[0] * n), None)
    np.testing.assert_allclose(columns["T_cam_obj"][has], obj.T_cam_obj[has], atol=1e-9)
    assert np.isnan(columns["T_cam_obj"][~has]).all() and (columns["confidence"][~has] == 0).all()
    assert (fits == has).all()
    columns["T_cam_obj"][3], columns["T_cam_obj"][~has] = np.nan, np.eye(4)
    columns.pop(offline.CAUSAL)
    refined = offline._merged(obj, columns)
    assert refined.status[3] == "lost" and set(refined.status[~has]) == {"recovered"}
    assert (refined.status[4:8] == obj.status[4:8]).all()


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_a_pose_moved_far_is_doubted_where_depth_does_not_lie_on_its_surface(made, share):
    obj = made.run.objects["box"]
    obj = replace(obj, covariance=np.tile(1e-6 * np.eye(6), (len(obj), 1, 1)))
    far = np.flatnonzero(obj.has_pose & (obj.confidence > 0.6))[-3:]
    T = obj.T_cam_obj.copy()
    T[far] = T[far] @ se3.exp(np.array([0, 0, 0, 0.03, 0, 0]))
    poses = SimpleNamespace(T=T, covariance=obj.covariance, cost=np.full(len(obj), 0.5), limit=0.5)
    check = SimpleNamespace(overlap=lambda k, T: 1.0, on_surface=lambda k, T: share)
    columns, _ = offline._columns(obj, poses, evidence.VideoEvidence(mask_px=[900] * len(obj)), check)
    before = np.where(obj.has_pose, np.maximum(obj.confidence, 0.5), 0)
    doubted = np.isin(np.arange(len(obj)), far) & (share < 0.6)
    np.testing.assert_allclose(columns["confidence"], np.where(doubted, 0.5, before))


@pytest.mark.parametrize("what", ["as it is", "darker", "behind", "colours", "pattern"])
def test_an_object_is_found_without_a_mask_where_it_looks_as_it_did(made, what, monkeypatch):
    of, T, config = Finished(made.run, made.sequence), made.run.objects["can"].T_cam_obj, preset()
    rows = np.arange(0, 12)
    check = SurfaceCheck(of, "can", config, fused(of, "can", T, rows, config, 0.004), T, rows)
    frame, k = made.sequence.frame(6), 6
    mask = made.sequence.masks(6)["can"]
    depth_m, rgb = frame.depth_m.copy(), frame.rgb.astype(float)
    middle = rgb[mask].mean(0)
    if what == "darker":  # by another exposure than in the frame before
        rgb *= 0.6
    if what == "behind":  # through half of it one sees what stands behind
        v, u = np.nonzero(mask)
        depth_m[v[u > np.median(u)], u[u > np.median(u)]] += 0.05
    if what == "colours":  # as it was, but three times as strong
        rgb = middle + 3 * (rgb - middle)
    if what == "pattern":  # the same colours elsewhere, beside a frame in whose light they are far off as well
        look = check._look

        def in_that_light(frame, *how, **more):
            found = look(frame, *how, **more)
            return found._replace(off=3 * check._usual, alike=0.9) if frame.index == k - 1 else found

        monkeypatch.setattr(check, "_look", in_that_light)
        v, u = np.nonzero(mask)
        rgb[v, u] = rgb[v, u][np.random.default_rng(0).permutation(len(v))]
    seen = replace(frame, depth_m=depth_m, rgb=np.clip(rgb, 0, 255).astype(np.uint8))
    check._frame = lambda row: seen if row == k else made.sequence.frame(row)
    found = check.found(k, [T[k] @ se3.exp(np.array([0, 0, 0, 0.002, 0.001, 0]))], k - 1, T[k - 1])
    assert (found is not None) == (what in ("as it is", "darker"))
    assert found is None or np.linalg.norm((found.T_cam_obj - T[k])[:3, 3]) < 0.003


def printed(rgb: np.ndarray, mask: np.ndarray) -> loops.Features:
    """What is recognised of what a mask holds, half a metre away."""
    frame = Frame(0, 0.0, rgb, np.full(mask.shape, 0.5, np.float32))
    return loops.features(frame, mask, CAMERA, preset().depth)


def test_of_a_small_object_enough_is_recognised():
    """A fine print of 50 px has about as many features as one of 160 px; as it is, a twentieth of them."""
    grains = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    count = []
    for px in (50, 160):
        rgb, mask = np.full((240, 320, 3), 128, np.uint8), np.zeros((240, 320), bool)
        rgb[40 : 40 + px, 60 : 60 + px] = cv2.resize(grains, (px, px), interpolation=cv2.INTER_CUBIC)
        mask[40 : 40 + px, 60 : 60 + px] = True
        count.append(len(printed(rgb, mask).p_cam))
    assert count[0] > 0.5 * count[1] > 50, count


def test_what_ties_matched_is_adjusted_as_one_point():
    rng, T = np.random.default_rng(0), np.tile(se3.from_rt(np.eye(3), np.array([0, 0, 0.5])), (2, 1, 1))
    away = np.array([0, 0, 0.5])
    views = [loops.Features(away + rng.normal(0, 0.02, (n, 3)), np.zeros((n, 128)), *[None] * 2) for n in (6, 5)]
    tracks = [(np.array([7, 8]), views[0].p_cam[:2]), (np.array([8, 9]), views[1].p_cam[:2])]
    told = evidence.VideoEvidence(tracks=tracks, key=[0, 1], views=views)
    made = SimpleNamespace(sequence=SimpleNamespace(camera=CAMERA), run=SimpleNamespace(info={"seed": 0}))
    video = evidence.VideoPoses(made, SimpleNamespace(T_cam_obj=T), preset(), told)
    tie = loops.Tie(0, 1, np.eye(4), np.array([5, 1, 0]), np.array([2, 4, 3]), 9.0)
    for strong, shared in (([], 1), ([tie], 4)):  # track 8, and three matches
        found = video.sightings(strong)
        assert len(np.intersect1d(found.point[found.pose == 0], found.point[found.pose == 1])) == shared
        assert len(found.p_cam) == 4 + 6 * bool(strong)


def test_ties_that_depth_contradicts_do_not_count():
    T = se3.from_rt(np.eye(3), np.array([0, 0, 0.5]))
    T = np.stack([T, T @ se3.exp(np.array([0, 0, np.radians(40), 0, 0, 0]))])
    shine = T[0, :3, 3] + np.random.default_rng(2).normal(scale=0.02, size=(25, 3))
    nothing = np.zeros(0, int), np.zeros((0, 3))
    made = SimpleNamespace(sequence=SimpleNamespace(camera=CAMERA), run=SimpleNamespace(info={"seed": 0}))
    for still, count in ((shine, 0), (np.zeros((0, 3)), 1)):
        told = evidence.VideoEvidence(tracks=[nothing] * 2, key=[0, 1], views=[view(T_k, still) for T_k in T])
        poses, strong = evidence.VideoPoses(made, SimpleNamespace(T_cam_obj=T), preset(), told).tied()
        assert len(strong) == count
        assert np.degrees(se3.angle_rad(se3.inverse(poses[0]) @ poses[1])) == pytest.approx(40, abs=0.5)


def test_a_point_that_one_frame_alone_shows_is_not_adjusted():
    rng, T = np.random.default_rng(0), np.tile(se3.from_rt(np.eye(3), np.array([0, 0, 0.5])), (3, 1, 1))
    p_cam = np.array([0, 0, 0.5]) + rng.normal(0, 0.02, (9, 3))
    tracks = [(np.arange(8), p_cam[:8]), (np.arange(8), p_cam[:8]), (np.arange(1, 9), p_cam[1:])]
    told = evidence.VideoEvidence(tracks=tracks)
    made = SimpleNamespace(sequence=SimpleNamespace(camera=CAMERA), run=SimpleNamespace(info={"seed": 0}))
    video = evidence.VideoPoses(made, SimpleNamespace(T_cam_obj=T), preset(), told)
    _, points, seen = video.adjusted(T, video.sightings([]))
    assert len(points) == 8 and len(seen.pose) == 23


def test_a_neighbour_helps_where_it_fits_better_with_a_mask_or_by_sight():
    """Frame 1 has no mask, frame 3 has one, in which nothing fits better than what is there."""
    better, worse = (FittedPose(np.full((4, 4), k), np.eye(6), cost) for k, cost in ((5.0, 0.2), (6.0, 0.95)))
    poses = SimpleNamespace(
        T=np.tile(np.eye(4), (5, 1, 1)),
        covariance=np.tile(np.eye(6), (5, 1, 1)),
        cost=np.array([0.1, 0.9, 0.1, 0.9, 0.1]),
        limit=0.5,
        _evidence=SimpleNamespace(shown=np.array([True, False, True, True, True])),
        _best_of=lambda k, candidates: worse,
    )
    SurfacePoses.ask_neighbours(poses, SimpleNamespace(found=lambda *of: better))
    assert (poses.T[1] == 5).all() and poses.cost[1] == 0.2
    assert (poses.T[3] == np.eye(4)).all() and poses.cost[3] == 0.9


def test_points_that_slid_away_hold_no_pose(monkeypatch):
    p_obj = np.random.default_rng(0).normal(0, 0.02, (5, 3))
    p_cam, told = p_obj + np.array([0, 0, 0.5]), []
    p_cam[2, 0] += 0.03
    T_cam_obj = se3.from_rt(np.eye(3), np.array([0, 0, 0.5]))
    poses = SimpleNamespace(
        _points_in=lambda k: Keypoints(p_obj, p_cam, np.full(5, 0.002)),
        _evidence=SimpleNamespace(clouds=[p_cam]),
        _volume=None,
        _config=preset(),
        cost_at=lambda *of: 0.1,
    )
    refined = SimpleNamespace(T_cam_obj=T_cam_obj, covariance=None)
    monkeypatch.setattr(surface, "refine", lambda *of, keypoints: told.append(keypoints) or refined)
    SurfacePoses._best_of(poses, 0, [T_cam_obj])
    np.testing.assert_array_equal(told[0].p_obj, np.delete(p_obj, 2, axis=0))


@pytest.mark.parametrize("step", [1, -1])
def test_a_frame_that_does_not_fit_is_tried_where_its_neighbours_motion_leads(step):
    even = np.stack([se3.exp(np.array([0, 0, 0.1 * k, 0.02 * k, 0, 0])) for k in range(4)])[::step]
    lost = 3 if step == 1 else 0
    tried = []
    poses = SimpleNamespace(
        T=even.copy(),
        covariance=np.tile(np.eye(6), (4, 1, 1)),
        cost=np.where(np.arange(4) == lost, 0.9, 0.1),
        limit=0.5,
        _evidence=SimpleNamespace(shown=np.ones(4, bool)),
        _best_of=lambda k, candidates: tried.extend(candidates) or FittedPose(candidates[0], np.eye(6), 1.0),
    )
    SurfacePoses.ask_neighbours(poses, None)
    assert any(np.allclose(T, even[lost], atol=1e-9) for T in tried)


def test_features_keep_away_from_the_border_of_the_mask():
    """What shows there, or through a handle, may be of something else, which does not move with the object."""
    rgb = cv2.resize(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8), (320, 240))
    mask = np.zeros((240, 320), bool)
    mask[100:150, 140:200] = True
    found = printed(rgb, mask)
    u, v = CAMERA.project(found.p_cam).T
    assert len(u) > 40 and ((u > 141) & (u < 198) & (v > 101) & (v < 148)).all()


def test_features_keep_away_from_steps_of_depth():
    """There one sees what is behind a handle, or through it."""
    rgb = cv2.resize(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8), (320, 240))
    mask, depth_m = np.zeros((240, 320), bool), np.full((240, 320), 0.5, np.float32)
    mask[60:190, 60:260], depth_m[:, ::20] = True, 0.55
    found = loops.features(Frame(0, 0.0, rgb, depth_m), mask, CAMERA, preset().depth)
    column = np.rint(CAMERA.project(found.p_cam)[:, 0]) % 20
    assert len(column) > 100 and ((column > 1) & (column < 19)).all()
