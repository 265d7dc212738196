"""The fused volume: against exact distances, against the library named in the paper, and against bad input."""

import cv2
import numpy as np
import pytest
import trimesh

from p2p_lib.core import mesh as meshes
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.method.tsdf import BLOCK, TsdfVolume
from tests.method.analytic_scene import CAMERA, LUMP, around, ball, box, look_from, render

CONFIG = TsdfConfig(voxel_m=0.004)
WHITE = np.full((CAMERA.height, CAMERA.width, 3), 255, np.uint8)


def fused(sdf, poses, config=CONFIG, rgb=WHITE, background_m=0.0, **kwargs):
    volume = TsdfVolume(config, **kwargs)
    for key, T in enumerate(poses):
        depth, mask = render(sdf, T)
        depth = np.where(mask, depth, np.float32(background_m))
        assert volume.integrate(depth, rgb, mask, CAMERA, T, key=key) > 0
    return volume


@pytest.fixture(scope="module")
def lump():
    poses = [*around(8), *around(8, height=-0.7), look_from((0.1, 0, 1)), look_from((0.1, 0, -1))]
    return fused(LUMP, poses, background_m=1.0)


def same_state(a, b, atol=1e-5):
    assert a.shape == b.shape and (a.lo == b.lo).all()
    np.testing.assert_allclose(a.weights(), b.weights(), atol=atol)
    np.testing.assert_allclose(a.values(), b.values(), atol=atol)
    np.testing.assert_allclose(a.colours(), b.colours(), atol=0.02)


# -- the update rule ---------------------------------------------------------------------------------


def test_one_picture_of_a_wall_gives_the_appendix_formula_voxel_by_voxel():
    depth = np.full((CAMERA.height, CAMERA.width), 0.4, np.float32)
    mask = np.zeros_like(depth, bool)
    mask[60:120, 80:160] = True
    config = TsdfConfig(voxel_m=0.005, truncation_voxels=4.0, carve=False)
    origin_m = np.array([-0.0507, -0.0511, 0.3003])  # off the half-pixel ties
    volume = TsdfVolume(config, origin_m=origin_m, shape=(21, 21, 40))
    volume.integrate(depth, WHITE, mask, CAMERA, np.eye(4))

    index = np.stack(np.meshgrid(*map(np.arange, volume.shape), indexing="ij"), -1)
    centre = origin_m + 0.005 * index
    uv = np.rint(CAMERA.project(centre)).astype(int)
    d = 0.4 - centre[..., 2]
    seen = (uv[..., 0] >= 80) & (uv[..., 0] < 160) & (uv[..., 1] >= 60) & (uv[..., 1] < 120) & (d >= -0.02)
    tie = np.abs(CAMERA.project(centre) % 1 - 0.5).min(-1) < 1e-3
    boundary = tie | (np.abs(d + 0.02) < 1e-6)
    assert 0.2 < seen.mean() < 0.9
    np.testing.assert_array_equal((volume.weights() == 1)[~boundary], seen[~boundary])
    inside = seen & ~boundary
    np.testing.assert_allclose(volume.values()[inside], np.minimum(1, d / 0.02)[inside], atol=2e-6)
    assert np.isnan(volume.values()[~seen & ~boundary]).all()


def test_mean_of_four_pictures():
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    volume = TsdfVolume(CONFIG, origin_m=(0, 0, 0.3), shape=(4, 4, 60))
    for depth_m in (0.400, 0.408, 0.408, 0.408):
        volume.integrate(np.full(mask.shape, depth_m, np.float32), WHITE, mask, CAMERA, np.eye(4))
    value, valid = volume.query(np.array([[0.004, 0.004, 0.4]]))
    assert valid.all()
    assert value[0] == pytest.approx(0.006, abs=1e-6)
    assert volume.weights().max() == 4


def test_agrees_with_the_library_named_in_the_paper(shared_data):
    folder = shared_data / "ycbineoat" / "mustard0_first400"
    golden = np.load(shared_data / "golden" / "tsdf_mustard0.npz")
    files = {name: sorted((folder / name).iterdir()) for name in ("rgb", "depth", "gt_mask", "annotated_poses")}
    camera = Camera.from_K(np.loadtxt(folder / "cam_K.txt"), 640, 480)
    voxel_m = float(golden["voxel_m"])
    config = TsdfConfig(voxel_m=voxel_m, truncation_voxels=float(golden["trunc_m"]) / voxel_m, carve=False)
    volume = TsdfVolume(config, origin_m=golden["origin_m"], shape=golden["tsdf"].shape)
    centres = golden["origin_m"] + voxel_m * np.stack(np.meshgrid(*map(np.arange, volume.shape), indexing="ij"), -1)
    to_tie = np.full(volume.shape, np.inf)
    for frame in golden["frames"]:
        depth = cv2.imread(str(files["depth"][frame]), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
        rgb = cv2.imread(str(files["rgb"][frame]))[..., ::-1]
        mask = cv2.imread(str(files["gt_mask"][frame]), cv2.IMREAD_UNCHANGED) > 0
        T = np.loadtxt(files["annotated_poses"][frame])
        volume.integrate(depth, rgb, mask, camera, T)
        uv = camera.project(centres @ T[:3, :3].T + T[:3, 3])
        to_tie = np.minimum(to_tie, np.abs(uv - np.floor(uv) - 0.5).min(-1))

    weight, value = volume.weights(), volume.values()
    both = (weight > 0) & (golden["weight"] > 0) & (np.abs(golden["tsdf"].astype(float)) < 1)
    compared = both & (to_tie > 1e-4)
    assert both.sum() > 20_000
    assert compared.sum() / both.sum() >= 0.95
    assert np.abs(value - golden["tsdf"].astype(float))[compared].max() <= 0.02
    assert (weight != golden["weight"])[to_tie > 1e-4].mean() < 1e-3


# -- against exact geometry --------------------------------------------------------------------------


def test_surface_lies_where_the_shape_is(lump):
    error = np.abs(LUMP(lump.mesh().vertices))
    assert error.mean() < CONFIG.voxel_m / 3
    assert np.percentile(error, 95) < CONFIG.voxel_m


def test_query_crosses_zero_on_the_surface_and_exceeds_the_distance_off_it():
    centre = np.array([0.01, 0, 0.01])
    volume = fused(ball(centre, 0.05), [*around(8), *around(8, height=-0.7)], background_m=1.0)
    u = np.random.default_rng(0).normal(size=(2000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    on, valid = volume.query(centre + 0.05 * u)
    assert valid.mean() > 0.99
    assert np.median(np.abs(on)) < CONFIG.voxel_m / 4
    for distance_m in (-0.006, 0.006):
        value, valid = volume.query(centre + (0.05 + distance_m) * u)
        # Along a ray the surface is never nearer than along its normal.
        assert (value[valid] * np.sign(distance_m) > 0.8 * 0.006).mean() > 0.99
        assert np.abs(value).max() <= volume.tau_m * (1 + 1e-6)


def test_query_interpolates_trilinearly_between_voxels(lump):
    volume = lump
    values = volume.values()
    known = np.isfinite(values)
    cell = known[:-1, :-1, :-1] & known[1:, 1:, 1:] & known[1:, :-1, :-1] & known[:-1, 1:, :-1]
    cell &= known[:-1, :-1, 1:] & known[1:, 1:, :-1] & known[1:, :-1, 1:] & known[:-1, 1:, 1:]
    at = np.argwhere(cell)[::37]
    f = np.random.default_rng(1).uniform(0.01, 0.99, at.shape)
    expected = np.zeros(len(at))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, f, 1 - f), 1)
        expected += share * values[tuple((at + corner).T)]
    got, valid = volume.query(volume.origin_m + volume.voxel_m * (at + f))
    assert valid.all()
    np.testing.assert_allclose(got, expected * volume.tau_m, atol=2e-6)


def test_gradient_is_the_derivative_of_the_value(lump):
    volume = lump
    p = volume.mesh().vertices[::29]
    value, gradient, valid = volume.query_with_gradient(p)
    assert valid.mean() > 0.8
    h = 0.5 * volume.voxel_m
    for axis, e in enumerate(np.eye(3)):
        forward, backward = volume.query(p + h * e)[0], volume.query(p - h * e)[0]
        np.testing.assert_allclose(gradient[valid, axis], ((forward - backward) / (2 * h))[valid], atol=1e-4)
    np.testing.assert_allclose(value[valid], volume.query(p)[0][valid], atol=1e-9)
    outward = np.einsum("ij,ij->i", gradient, lump.mesh().vertex_normals[::29])
    assert (outward[valid] > 0).mean() > 0.95


def test_points_off_the_observed_space_are_invalid_and_zero(lump):
    p = np.array([[0.01, 0, 0.02], [9, 9, 9], [np.nan, 0, 0], [np.inf, 0, 0]])
    value, valid = lump.query(p)
    assert not valid.any() and (value == 0).all()
    value, gradient, valid = lump.query_with_gradient(p)
    assert not valid.any() and (value == 0).all() and (gradient == 0).all()


# -- mesh --------------------------------------------------------------------------------------------


def test_mesh_of_an_off_centre_shape_is_where_and_how_it_is():
    half = np.array([0.04, 0.02, 0.03])
    centre = np.array([0.03, -0.02, 0.015])
    poses = [*around(6, 0.5), *around(6, 0.5, -0.6), look_from((0.1, 0, 1), 0.5), look_from((0.1, 0, -1), 0.5)]
    mesh = fused(box(centre, half), poses, TsdfConfig(voxel_m=0.003), background_m=1.0).mesh()
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(8 * half.prod(), rel=0.08)  # a mirrored or inverted mesh is negative
    np.testing.assert_allclose(mesh.center_mass, centre, atol=0.001)
    # Edges come out thicker: beside them, voxels are only ever seen behind the face in front.
    np.testing.assert_allclose(mesh.bounds, [centre - half, centre + half], atol=2 * 0.003)


def test_mesh_carries_the_colours_of_the_pictures():
    rgb = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    rgb[:, :120], rgb[:, 120:] = (250, 10, 20), (5, 240, 30)
    T = look_from((1, 0, 0))
    mesh = fused(ball((0, 0, 0), 0.05), [T], rgb=rgb).mesh()
    colour = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)
    left = se3.transform(T, mesh.vertices)[:, 0]
    assert np.abs(colour[left < -0.006] - (250, 10, 20)).max() <= 1
    assert np.abs(colour[left > 0.006] - (5, 240, 30)).max() <= 1


def test_small_components_are_removed_and_large_ones_kept():
    scene = [ball((0, 0, 0), 0.04), ball((0.0, 0.07, 0), 0.006), ball((0, -0.075, 0.0), 0.03)]
    volume = TsdfVolume(TsdfConfig(voxel_m=0.003))
    T = look_from((1, 0, 0))
    depth, mask = render(lambda p: np.min([part(p) for part in scene], 0), T)
    volume.integrate(depth, WHITE, mask, CAMERA, T)
    everything, kept = volume.mesh(min_component=0), volume.mesh(min_component=0.1)
    assert np.abs(everything.vertices[:, 1] - 0.07).min() < 0.01
    assert len(kept.split(only_watertight=False)) == 2
    assert np.abs(kept.vertices[:, 1] - 0.07).min() > 0.02


def test_ply_and_glb_are_read_back_as_the_same_mesh(lump, tmp_path):
    mesh = lump.mesh()
    for name in ("lump.ply", "deep/lump.glb"):
        back = trimesh.load(meshes.save(mesh, tmp_path / name), force="mesh")
        assert len(back.faces) == len(mesh.faces)
        np.testing.assert_allclose(back.bounds, mesh.bounds, atol=1e-6)
        assert back.visual.kind == "vertex"
    with pytest.raises(BadInput, match=r"lump\.stl"):
        meshes.save(mesh, tmp_path / "lump.stl")
    with pytest.raises(BadInput, match="no faces"):
        meshes.save(TsdfVolume(CONFIG).mesh(), tmp_path / "none.ply")


# -- taking out, moving, growing ---------------------------------------------------------------------


def test_taking_a_picture_out_again_restores_the_volume():
    poses = around(4)
    reference = fused(LUMP, poses[:3], origin_m=(-0.08, -0.08, -0.08), shape=(40, 40, 45))
    volume = fused(LUMP, poses, origin_m=(-0.08, -0.08, -0.08), shape=(40, 40, 45))
    assert np.abs(volume.weights() - reference.weights()).max() == 1
    assert volume.remove(3)
    same_state(volume, reference)


def test_taking_everything_out_leaves_nothing_behind():
    volume = fused(LUMP, around(3))
    for key in [*volume.views]:
        assert volume.remove(key)
    assert volume.empty and not volume.remove(0)
    assert (volume.weights() == 0).all() and np.isnan(volume.values()).all()
    assert np.abs(volume.colours()).max() < 1e-3
    assert len(volume.mesh().faces) == 0


def test_moved_keyframes_give_the_volume_fused_at_the_new_poses():
    poses = around(5)
    wrong = [T @ se3.exp([0.02, -0.03, 0.01, 0.004, -0.006, 0.003]) if i in (1, 3) else T for i, T in enumerate(poses)]
    grid = {"origin_m": (-0.1, -0.1, -0.1), "shape": (52, 52, 56)}
    volume = TsdfVolume(CONFIG, **grid)
    for key, (T, T_wrong) in enumerate(zip(poses, wrong, strict=True)):
        depth, mask = render(LUMP, T)
        volume.integrate(depth, WHITE, mask, CAMERA, T_wrong, key=key)
    assert sorted(volume.move(dict(enumerate(poses)), limit=9)) == [1, 3]
    same_state(volume, fused(LUMP, poses, **grid), atol=2e-5)
    assert volume.move(dict(enumerate(poses))) == []


def test_pictures_that_are_let_go_stay_fused_and_stay_where_they_are():
    poses = around(4)
    volume = fused(LUMP, poses)
    before = volume.values()
    volume.keep_only(np.array([1, 3, 99]))
    assert [*volume.views] == [1, 3]
    np.testing.assert_array_equal(volume.values(), before)
    shifted = {key: T @ se3.exp([0, 0, 0, 0.01, 0, 0]) for key, T in enumerate(poses)}
    assert sorted(volume.move(shifted)) == [1, 3]


def test_small_moves_and_unknown_keyframes_are_left_alone_and_the_limit_takes_the_farthest():
    poses = around(3)
    volume = fused(LUMP, poses)
    before = volume.values()
    tiny = se3.exp([0.002, 0, 0, 0.0005, 0, 0])
    assert volume.move({0: poses[0] @ tiny, 77: np.eye(4), 1: np.full((4, 4), np.nan)}) == []
    np.testing.assert_array_equal(volume.values(), before)
    shift = [se3.exp([0, 0, 0, 0, 0, s]) for s in (0.004, 0.009, 0.006)]
    targets = {key: T @ step for key, T, step in zip(range(3), poses, shift, strict=True)}
    assert volume.move(targets, limit=2) == [1, 2]
    assert volume.move(targets, limit=2) == [0]


def test_moving_after_growth_leaves_no_negative_weights():
    poses = around(4)
    small, large = ball((0, 0, 0), 0.03), ball((0, 0, 0.0), 0.07)
    volume = TsdfVolume(CONFIG)
    for key, (T, shape) in enumerate(zip(poses, (small, small, large, large), strict=True)):
        depth, mask = render(shape, T)
        volume.integrate(depth, WHITE, mask, CAMERA, T, key=key)
    for key in (0, 1):
        volume.remove(key)
    assert volume.weights().min() >= 0
    assert volume.weights().max() == 2
    # Each view leaves the box it was fused into, which was smaller for the first ones.
    for key in (2, 3):
        volume.remove(key)
    assert (volume.weights() == 0).all() and np.isnan(volume.values()).all()


def test_growth_keeps_what_was_fused():
    T = look_from((1, 0, 0))
    volume = fused(ball((0, 0, 0), 0.03), [T])
    before, lo, shape = volume.values(), volume.lo.copy(), volume.shape
    depth, mask = render(ball((0, 0.1, 0), 0.03), T)
    volume.integrate(depth, WHITE, mask, CAMERA, T)
    assert np.prod(volume.shape) > np.prod(shape)
    assert all(n % BLOCK == 0 for n in volume.shape)
    old = tuple(slice(a, a + n) for a, n in zip(lo - volume.lo, shape, strict=True))
    np.testing.assert_array_equal(volume.values()[old][np.isfinite(before)], before[np.isfinite(before)])
    assert volume.query(np.array([[0.03, 0, 0], [0.03, 0.1, 0]]))[1].all()


def test_wild_pixels_do_not_make_the_grid_grow():
    T = look_from((1, 0, 0))
    depth, mask = render(ball((0, 0, 0), 0.04), T)
    clean = TsdfVolume(CONFIG)
    clean.integrate(depth, WHITE, mask, CAMERA, T)
    wild = depth.copy()
    v, u = np.argwhere(mask)[::150].T
    wild[v, u] = np.linspace(0.05, 60.0, len(v))
    dirty = TsdfVolume(CONFIG)
    dirty.integrate(wild, WHITE, mask, CAMERA, T)
    assert np.prod(dirty.shape) <= 1.5 * np.prod(clean.shape)


def test_the_cap_holds_whatever_is_asked_for():
    config = TsdfConfig(voxel_m=0.004, max_voxels=60_000)
    volume = TsdfVolume(config)
    rng = np.random.default_rng(0)
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    volume.integrate(np.full(mask.shape, 0.4, np.float32), WHITE, mask, CAMERA, np.eye(4))
    assert 0 < np.prod(volume.shape) <= 60_000
    for _ in range(4):
        volume.integrate(rng.uniform(0.1, 50, mask.shape).astype(np.float32), WHITE, mask, CAMERA, np.eye(4))
        assert np.prod(volume.shape) <= 60_000
    assert volume.query(np.array([[0.0, 0.0, 0.39]]))[1].all()


# -- carving, bad input ------------------------------------------------------------------------


def test_carving_clears_what_the_background_is_seen_through():
    T = look_from((1, 0, 0))
    depth, mask = render(ball((0, 0, 0), 0.04), T)
    behind = np.where(mask, depth, 0.8).astype(np.float32)
    ghost = ball((0.0, 0.06, 0), 0.012)
    for carve in (False, True):
        volume = TsdfVolume(TsdfConfig(voxel_m=0.004, carve=carve))
        g_depth, g_mask = render(ghost, T)
        volume.integrate(depth, WHITE, mask, CAMERA, T)
        volume.integrate(g_depth, WHITE, g_mask, CAMERA, T)
        for _ in range(20):
            volume.integrate(behind, WHITE, mask, CAMERA, T)
        value, valid = volume.query(np.array([[0.008, 0.06, 0.0]]))
        assert valid.all()
        assert (value[0] > 0.5 * volume.tau_m) == carve
        kept, ok = volume.query(np.array([[0.04, 0.0, 0.0]]))
        assert ok.all() and abs(kept[0]) < 0.002


def test_bad_depth_and_empty_masks_touch_nothing():
    volume = TsdfVolume(CONFIG)
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    for bad in (0.0, -1.0, np.nan, np.inf):
        assert volume.integrate(np.full(mask.shape, bad, np.float32), WHITE, mask, CAMERA, np.eye(4)) == 0
    good = np.full(mask.shape, 0.4, np.float32)
    assert volume.integrate(good, WHITE, ~mask, CAMERA, np.eye(4)) == 0
    assert volume.empty and volume.shape == (0, 0, 0)
    assert not volume.query(np.zeros((5, 3)))[1].any()
    assert len(volume.mesh().faces) == 0


def test_a_surface_that_crosses_no_observed_cell_gives_an_empty_mesh():
    config = TsdfConfig(voxel_m=0.01, carve=False)
    volume = TsdfVolume(config, origin_m=(-0.01, -0.01, 0.3), shape=(4, 2, 20))
    u = np.arange(CAMERA.width) - CAMERA.cx
    for depth_m, beside in ((0.4, u / CAMERA.fx * 0.4 < -0.005), (0.8, u / CAMERA.fx * 0.4 > 0.005)):
        mask = np.tile(beside, (CAMERA.height, 1))  # one sheet of voxels has the surface, two have free space
        volume.integrate(np.full(mask.shape, depth_m, np.float32), WHITE, mask, CAMERA, np.eye(4))
    assert (volume.values() < 0).any() and (volume.values() > 0).any()
    assert len(volume.mesh().faces) == 0


def test_invalid_pixels_leave_the_others_as_they_are():
    T = look_from((1, 0, 0))
    depth, mask = render(ball((0, 0, 0), 0.05), T)
    holes = depth.copy()
    v, u = np.argwhere(mask)[::7].T
    for value in (np.nan, np.inf, 0.0, -3.0):
        holes[v, u] = value
        a, b = TsdfVolume(CONFIG), TsdfVolume(CONFIG)
        a.integrate(holes, WHITE, mask, CAMERA, T)
        keep = mask.copy()
        keep[v, u] = False
        b.integrate(depth, WHITE, keep, CAMERA, T)
        same_state(a, b)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth_m": np.ones((4, 4), np.float32)}, "tsdf image: got depth"),
        ({"mask": np.ones((2, 2), bool)}, "tsdf image"),
        ({"rgb": np.zeros((180, 240), np.uint8)}, "tsdf image"),
        ({"T_cam_obj": np.full((4, 4), np.nan)}, "T_cam_obj: got NaN"),
        ({"T_cam_obj": np.diag([1.0, 1, -1, 1])}, "not a rotation"),
    ],
)
def test_wrong_arguments_are_named(change, words):
    depth, mask = render(ball((0, 0, 0), 0.05), look_from((1, 0, 0)))
    given = {"depth_m": depth, "rgb": WHITE, "mask": mask, "camera": CAMERA, "T_cam_obj": look_from((1, 0, 0))}
    with pytest.raises(BadInput, match=words):
        TsdfVolume(CONFIG).integrate(**given | change)


def test_a_fixed_grid_beyond_the_cap_is_refused():
    with pytest.raises(BadInput, match="at most 1000 voxels"):
        TsdfVolume(TsdfConfig(max_voxels=1000), origin_m=np.zeros(3), shape=(20, 20, 20))


def test_a_voxel_behind_the_camera_is_never_touched():
    T = se3.from_rt(np.eye(3), np.zeros(3))  # the camera sits in the grid
    volume = TsdfVolume(CONFIG, origin_m=(-0.04, -0.04, -0.2), shape=(20, 20, 120))
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    volume.integrate(np.full(mask.shape, 0.2, np.float32), WHITE, mask, CAMERA, T)
    z = volume.origin_m[2] + volume.voxel_m * np.arange(120)
    assert volume.weights()[:, :, z <= 0].max() == 0
    assert volume.weights()[:, :, z > 0].max() == 1
