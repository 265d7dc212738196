"""The sequence synthetic/crossing: what its folder holds is true, and the scenario has the events it promises."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, P2PError
from p2p_lib.synthetic import SCENARIOS, generate, scenario_dir
from p2p_lib.synthetic.noise import PERFECT, Sensor
from p2p_lib.synthetic.render import render
from tests.synthetic.surface_points import see, watch

OBJECTS = ("box", "can")
FRAMES = 300


@pytest.fixture(scope="module")
def folder():
    """The real thing, from the cache that notebooks and users share."""
    return scenario_dir("crossing", seed=0)


@pytest.fixture(scope="module")
def camera(folder):
    return Camera.from_K(np.loadtxt(folder / "cam_K.txt"), 640, 480)


@pytest.fixture(scope="module")
def poses(folder):
    return {
        o: np.stack([np.loadtxt(folder / f"annotated_poses/{o}/{t:06d}.txt") for t in range(FRAMES)]) for o in OBJECTS
    }


@pytest.fixture(scope="module")
def points():
    """Object to points and normals on its true surface."""
    return {b.name: b.mesh.sample(256, np.random.default_rng(1)) for b in SCENARIOS["crossing"](0).bodies}


def image(folder, kind, t):
    found = cv2.imread(str(folder / kind / f"{t:06d}.{'jpg' if kind == 'rgb' else 'png'}"), cv2.IMREAD_UNCHANGED)
    assert found is not None, (kind, t)
    return found


def turn_deg(R_a, R_b):
    return np.degrees(np.arccos(np.clip((np.einsum("...ij,...ij->...", R_a, R_b) - 1) / 2, -1, 1)))


def test_layout_is_complete(folder):
    names = {f"{t:06d}" for t in range(FRAMES)}
    for kind, ending in (("rgb", "jpg"), ("depth", "png"), *((f"masks/{o}", "png") for o in OBJECTS)):
        assert {f.name for f in (folder / kind).iterdir()} == {f"{n}.{ending}" for n in names}
    assert image(folder, "rgb", 7).shape == (480, 640, 3)
    depth = image(folder, "depth", 7)
    assert depth.dtype == np.uint16 and 500 < np.median(depth[depth > 0]) < 2000
    np.testing.assert_allclose(np.diff(np.loadtxt(folder / "times.txt")), 1 / 30, atol=2e-6)
    for o in OBJECTS:
        assert {f.stem for f in (folder / f"annotated_poses/{o}").iterdir()} == names
        area = np.array([np.count_nonzero(image(folder, f"masks/{o}", t)) for t in range(0, FRAMES, 10)])
        np.testing.assert_array_equal(np.load(folder / f"is_mask_visible/{o}/is_mask_visible.npy")[::10], area > 0)
        assert np.load(folder / f"is_obj_in_image_labels/{o}/is_obj_in_image.npy").tolist() == [True] * FRAMES
        assert set(np.unique(image(folder, f"masks/{o}", 0))) == {0, 255}


def test_models_are_the_objects(folder):
    import trimesh

    for o in OBJECTS:
        points = np.loadtxt(folder / f"models/{o}/points.xyz")
        mesh = trimesh.load(folder / f"models/{o}/textured.obj", process=False, force="mesh")
        assert mesh.visual.material.image.size[0] > 256
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx(np.ptp(points, axis=0), abs=1e-3)
        assert 0.08 < np.ptp(points, axis=0).max() < 0.2
        merged = trimesh.Trimesh(mesh.vertices, mesh.faces)
        assert merged.is_watertight and merged.volume > 0
        # Each face's texture is where the renderer takes it from: read back, the meshes' print is not constant.
        assert np.asarray(mesh.visual.material.image).std() > 20


def test_masks_are_where_the_poses_put_the_objects(folder, camera, poses):
    import trimesh

    for o in OBJECTS:
        vertices = trimesh.load(folder / f"models/{o}/textured.obj", process=False, force="mesh").vertices
        for t in range(0, FRAMES, 23):
            uv = camera.project(se3.transform(poses[o][t], vertices))
            hull = np.zeros((480, 640), np.uint8)
            outline = cv2.convexHull(uv.astype(np.float32)).round().astype(np.int32)
            cv2.fillConvexPoly(hull, outline, 255)
            mask = image(folder, f"masks/{o}", t)
            assert not (mask & ~cv2.dilate(hull, np.ones((3, 3)))).any(), (o, t)
            if t == 0:
                assert np.count_nonzero(mask & hull) > 0.97 * np.count_nonzero(hull)
    assert not any((image(folder, "masks/box", t) & image(folder, "masks/can", t)).any() for t in range(0, FRAMES, 5))


def shown(folder, camera, poses, points, o, t):
    """Pixels (P, 2) and visibility (P,) of the points in the written image, whose depth is that of a noisy sensor."""
    return see(
        camera, poses[o][t], points[o], image(folder, "depth", t) / 1000, image(folder, f"masks/{o}", t) > 0, 0.008
    )


def test_the_surface_is_where_depth_was_measured(folder, camera, poses, points):
    in_front = []
    for t in range(0, FRAMES, 17):
        depth = image(folder, "depth", t) / 1000
        for o in OBJECTS:
            z = se3.transform(poses[o][t], points[o][0])[:, 2]
            uv, visible = shown(folder, camera, poses, points, o, t)
            u, v = uv.round().astype(int).T
            error = depth[v, u][visible] - z[visible]
            if len(error) > 20:
                assert abs(np.median(error)) < 1e-3 and np.quantile(np.abs(error), 0.9) < 0.006, (o, t)
            # Away from the outline, a point that does not show has something measured in front of it.
            mask = image(folder, f"masks/{o}", t)
            inner, outer = cv2.erode(mask, np.ones((5, 5))), cv2.dilate(mask, np.ones((5, 5)))
            hidden = ~visible & (depth[v, u] > 0) & ((inner[v, u] > 0) | (outer[v, u] == 0))
            in_front += (depth[v, u][hidden] < z[hidden] + 0.008).tolist()
    assert len(in_front) > 3000 and np.mean(in_front) > 0.995


def test_images_move_as_the_poses_say(folder, camera, poses, points):
    # Lucas-Kanade on the written images is the oracle: what shows on the surface moves with the truth.
    errors = []
    for t in (5, 60, 100, 215, 250, 290):
        before, after = (cv2.cvtColor(image(folder, "rgb", s), cv2.COLOR_BGR2GRAY) for s in (t, t + 1))
        at = [[shown(folder, camera, poses, points, o, s) for s in (t, t + 1)] for o in OBJECTS]
        both = np.concatenate([a[1] & b[1] for a, b in at])
        start, truth = (np.concatenate([pair[k][0] for pair in at])[both].astype(np.float32) for k in range(2))
        found, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, None, winSize=(15, 15), maxLevel=2)
        back, _, _ = cv2.calcOpticalFlowPyrLK(after, before, found, None, winSize=(15, 15), maxLevel=2)
        u, v = start.round().astype(int).T
        corner = cv2.cornerMinEigenVal(before, 15)[v, u]
        sure = (ok[:, 0] > 0) & (np.linalg.norm(back - start, axis=1) < 0.2) & (corner > np.median(corner))
        assert sure.sum() > 60
        errors.append((found - truth)[sure])
        assert np.median(np.linalg.norm(truth - start, axis=1)) > 0.5  # something does move
    errors = np.concatenate(errors)
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.12
    assert np.abs(np.median(errors, axis=0)).max() < 0.03


def test_labels_have_texture_to_track(folder):
    sift = cv2.SIFT_create(600, contrastThreshold=0.02)
    for t in (0, 110, 165 + 45, 290):
        gray = cv2.cvtColor(image(folder, "rgb", t), cv2.COLOR_BGR2GRAY)
        for o in OBJECTS:
            mask = image(folder, f"masks/{o}", t)
            found = len(sift.detect(gray, mask))
            # Printed goods, not noise: tens of features per object, and most pixels without one.
            assert 60 < found < np.count_nonzero(mask) / 20, (o, t, found)


def events(visible_px):
    """(first hidden frame, first frame after) of each complete occlusion of at least 11 frames."""
    hidden = np.r_[False, visible_px == 0, False].astype(int)
    starts, stops = np.flatnonzero(np.diff(hidden) == 1), np.flatnonzero(np.diff(hidden) == -1)
    return [(a, b) for a, b in zip(starts, stops) if b - a > 10]


def check_promises(o, T_cam_model, visible_px, visible_points, full_px):
    """The bars of the scenario for one object."""
    assert turn_deg(T_cam_model[0, :3, :3], T_cam_model[:, :3, :3]).max() > 90, o
    assert turn_deg(T_cam_model[1:, :3, :3], T_cam_model[:-1, :3, :3]).max() < 4, o
    assert np.linalg.norm(np.diff(T_cam_model[:, :3, 3], axis=0), axis=1).max() < 0.015, o
    hidden = events(visible_px)
    assert len(hidden) == 1, (o, hidden)
    a, b = hidden[0]
    assert 30 <= b - a <= 60
    assert np.linalg.norm(T_cam_model[b - 1, :3, 3] - T_cam_model[a, :3, 3]) > 0.10, o
    assert turn_deg(T_cam_model[a, :3, :3], T_cam_model[b - 1, :3, :3]) > 30, o
    back = visible_points[b + 3]
    assert back.sum() > 20
    assert (visible_points[:a].any(0) & back).sum() > 0.4 * back.sum(), o
    assert visible_px[b + 3] > 0.8 * visible_px[b + 12], o  # uncovered at once
    assert visible_px[b + 3 : b + 10].min() > 0.02 * full_px


@pytest.mark.parametrize("o", OBJECTS)
def test_hidden_and_back_on_the_written_sequence(folder, camera, poses, points, o):
    px = np.array([np.count_nonzero(image(folder, f"masks/{o}", t)) for t in range(FRAMES)])
    visible = np.array([shown(folder, camera, poses, points, o, t)[1] for t in range(FRAMES)])
    check_promises(o, poses[o], px, visible, 640 * 480 * 0.5)


@pytest.mark.parametrize("seed", [1, 2])
def test_every_seed_keeps_the_promises(seed):
    small = Camera(615 / 4, 615 / 4, 79.5, 59.5, 160, 120)
    scenario = replace(SCENARIOS["crossing"](seed), camera=small)
    seen = watch(scenario, range(FRAMES))
    px = [seen[o][0] for o in OBJECTS]
    for body in scenario.bodies[:2]:
        T_cam_model = se3.inverse(scenario.T_world_cam) @ body.T_world_model
        check_promises(body.name, T_cam_model, *seen[body.name], 160 * 120 * 0.5)
    # They pass in front of each other, the box first: each is hidden in part by the other, never all.
    for k, frames in ((1, range(40, 110, 4)), (0, range(215, FRAMES, 4))):
        shares = []
        for t in frames:
            one = scenario.bodies[k]
            alone = render([(one.mesh, one.T_world_model[t])], small, scenario.T_world_cam[t])
            shares.append(px[k][t] / np.count_nonzero(alone.label))
        assert 0.2 < min(shares) < 0.85 and max(shares) > 0.95, (one.name, shares)


def tree(folder):
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


@pytest.fixture(scope="module")
def two_frames(tmp_path_factory):
    """A cache that holds the first two frames of seed 0; nobody writes to it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("P2P_CACHE", str(tmp_path_factory.mktemp("two_frames")))
        return scenario_dir("crossing", frames=2).parents[1]


@pytest.fixture
def cache(two_frames, tmp_path, monkeypatch):
    """A copy of it to write to, as the cache."""
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "cache"))
    return shutil.copytree(two_frames, tmp_path / "cache")


def test_same_seed_same_bytes_other_seed_other_images(cache, tmp_path, monkeypatch):
    once = tree(scenario_dir("crossing", frames=2))
    other = tree(scenario_dir("crossing", frames=2, seed=5))
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "again"))
    assert tree(scenario_dir("crossing", frames=2)) == once
    for name in ("rgb/000001.jpg", "depth/000001.png", "annotated_poses/box/000001.txt", "models/can/texture_map.png"):
        assert once[name] != other[name], name


def test_parameters_make_their_own_folders(cache):
    plain = scenario_dir("crossing", frames=2)
    faded = scenario_dir("crossing", frames=2, contrast=0.2)
    clean = scenario_dir("crossing", frames=2, **{k: getattr(PERFECT, k) for k in ("axial_per_m", "baseline_m")})
    assert len({plain, faded, clean}) == 3
    assert scenario_dir("crossing", frames=2, contrast=1.0) == plain
    settings = json.loads((faded / "scenario.json").read_text())
    assert settings["contrast"] == 0.2 and settings["seed"] == 0 and settings["sensor"]["axial_per_m"] > 0
    sift, mask = cv2.SIFT_create(), image(plain, "masks/box", 0)
    found = [len(sift.detect(cv2.cvtColor(image(f, "rgb", 0), cv2.COLOR_BGR2GRAY), mask)) for f in (plain, faded)]
    assert found[1] < 0.6 * found[0]


def test_finished_folders_are_used_and_unfinished_ones_never(cache):
    folder = scenario_dir("crossing", frames=2)
    stamp = (folder / "rgb/000000.jpg").stat().st_mtime_ns
    assert scenario_dir("crossing", frames=2) == folder
    assert (folder / "rgb/000000.jpg").stat().st_mtime_ns == stamp
    (folder / "scenario.json").unlink()
    (folder / "rgb/000000.jpg").write_bytes(b"half")
    assert scenario_dir("crossing", frames=2) == folder
    assert image(folder, "rgb", 0).shape == (480, 640, 3)


def test_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_CACHE", str(tmp_path))

    def full(*_):
        raise OSError("no space left")

    with monkeypatch.context() as broken:
        broken.setattr(generate, "_save", full)
        with pytest.raises(OSError, match="no space left"):
            scenario_dir("crossing", frames=2)
    assert [f for f in (tmp_path / "synthetic").iterdir() if f.is_dir()] == []
    assert (scenario_dir("crossing", frames=2) / "scenario.json").is_file()


def test_two_processes_at_once(tmp_path):
    code = "from p2p_lib.synthetic import scenario_dir; print(scenario_dir('crossing', frames=3))"
    env = {"P2P_CACHE": str(tmp_path), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"}
    running = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, env=env, text=True) for _ in "ab"]
    answers = [p.communicate(timeout=300)[0].strip() for p in running]
    assert [p.returncode for p in running] == [0, 0]
    assert answers[0] == answers[1]
    assert [f.name for f in (tmp_path / "synthetic").iterdir() if f.is_dir()] == [answers[0].rsplit("/", 1)[1]]


def test_unwritable_cache_says_what_to_do(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "file"))
    with pytest.raises(P2PError, match=r"cache folder .* P2P_CACHE"):
        scenario_dir("crossing", frames=2)


@pytest.mark.parametrize(
    ("name", "seed", "overrides", "message"),
    [
        ("crosing", 0, {}, r"'crosing' \(Did you mean synthetic/crossing\?\), expected one of"),
        ("crossing", -1, {}, "seed: got -1"),
        ("crossing", 0.5, {}, "seed: got 0.5"),
        ("crossing", 0, {"contrst": 1}, "'contrst', expected one of frames, contrast"),
        ("crossing", 0, {"contrast": 3}, "contrast 3"),
        ("crossing", 0, {"axial_per_m": -1}, "axial_per_m"),
    ],
)
def test_bad_requests_name_the_culprit(name, seed, overrides, message, tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_CACHE", str(tmp_path))
    with pytest.raises(BadInput, match=message):
        scenario_dir(name, seed=seed, **overrides)
    assert not list(tmp_path.rglob("scenario.json"))


def test_motion_blur_is_the_mean_over_the_shutter():
    small = Camera(615 / 4, 615 / 4, 79.5, 59.5, 160, 120)
    scenario = replace(SCENARIOS["crossing"](1, frames=30), camera=small)  # ten times the speed
    still = replace(PERFECT, shutter_share=0.0)
    moving = replace(PERFECT, shutter_share=1.0, blur_samples=8)
    sharp, _, exact = generate.photograph(scenario, still, 0, 5)
    blurred, depth, _ = generate.photograph(scenario, moving, 0, 5)
    start, end = (scenario.rendered(t).rgb for t in (4.5, 5.5))  # the frame's instant is in the middle
    edges = [np.abs(np.diff(p.astype(float), axis=1))[exact.label[:, 1:] > 0].mean() for p in (sharp, blurred)]
    assert edges[1] < 0.8 * edges[0]
    np.testing.assert_array_equal(depth, exact.depth_m)  # the depth of the frame's own instant
    middle = (start.astype(float) + end) / 2
    assert np.abs(blurred - middle).mean() < np.abs(sharp - middle).mean()
    assert Sensor().shutter_share == 0
