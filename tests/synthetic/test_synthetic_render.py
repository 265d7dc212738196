"""The renderer against exact geometry: rays against boxes, planes and spheres worked out independently."""

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.render import Light, render

CAMERA = Camera(300.0, 310.0, 158.3, 121.7, 320, 240)
SIZE = np.array([0.12, 0.07, 0.16])
EVEN = Light(ambient=1.0)


def pose(rng, distance=0.5):
    xi = np.r_[rng.uniform(-2, 2, 3), 0, 0, 0]
    T = se3.exp(xi)
    T[:3, 3] = *rng.uniform(-0.05, 0.05, 2), distance
    return T


def ray_box(T_cam_model, size, camera):
    """Depth (H, W) of a box, inf where missed, and the index 0..5 of the face hit, by the slab method."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    R, t = T_cam_model[:3, :3], T_cam_model[:3, 3]
    origin, direction = -R.T @ t, rays @ R
    t0, t1 = (-size / 2 - origin) / direction, (size / 2 - origin) / direction
    near, far = np.minimum(t0, t1), np.maximum(t0, t1)
    hit = near.max(-1) <= far.min(-1)
    axis = near.argmax(-1)
    face = 2 * axis + (np.take_along_axis(direction, axis[..., None], -1)[..., 0] < 0)
    return np.where(hit, near.max(-1), np.inf), face


@pytest.mark.parametrize("seed", range(4))
def test_box_depth_and_outline_are_exact(seed):
    rng = np.random.default_rng(seed)
    T = pose(rng)
    picture = render([(shapes.box(rng, tuple(SIZE)), T)], CAMERA, se3.IDENTITY)
    expected, _ = ray_box(T, SIZE, CAMERA)
    assert (picture.label == np.isfinite(expected)).all()
    hit = np.isfinite(expected)
    assert hit.sum() > 3000
    np.testing.assert_allclose(picture.depth_m[hit], expected[hit], rtol=1e-9)
    assert (picture.depth_m[~hit] == 0).all()


def test_nearer_body_wins_and_background_stays_unlabelled():
    rng = np.random.default_rng(5)
    mesh = shapes.box(rng, tuple(SIZE))
    T1, T2 = pose(rng, 0.5), pose(rng, 0.52)
    wall = shapes.plane(np.full((4, 4, 3), 90, np.uint8), [[-1, 1, 0.9], [1, 1, 0.9], [1, -1, 0.9], [-1, -1, 0.9]])
    room = render([(wall, se3.IDENTITY)], CAMERA, se3.IDENTITY, EVEN)
    picture = render([(mesh, T1), (mesh, T2)], CAMERA, se3.IDENTITY, background=room)
    depths = np.stack([np.full(picture.label.shape, 0.9), ray_box(T1, SIZE, CAMERA)[0], ray_box(T2, SIZE, CAMERA)[0]])
    assert (picture.label == depths.argmin(0)).all()
    assert set(np.unique(picture.label)) == {0, 1, 2}
    np.testing.assert_allclose(picture.depth_m, depths.min(0), rtol=1e-9)
    np.testing.assert_allclose(picture.rgb[picture.label == 0], 90, atol=1e-3)


def test_camera_pose_moves_the_picture_as_the_inverse_of_the_body():
    rng = np.random.default_rng(6)
    mesh, T_world_model, T_world_cam = shapes.box(rng, tuple(SIZE)), pose(rng), se3.exp(rng.uniform(-0.1, 0.1, 6))
    moved = render([(mesh, T_world_model)], CAMERA, T_world_cam)
    expected, _ = ray_box(se3.inverse(T_world_cam) @ T_world_model, SIZE, CAMERA)
    np.testing.assert_allclose(moved.depth_m, np.where(np.isfinite(expected), expected, 0), rtol=1e-9)


def test_plane_that_passes_behind_the_camera():
    # A floor 0.3 m below the camera that reaches behind it: the faces cannot be projected, only intersected.
    floor = shapes.plane(
        np.full((8, 8, 3), 200, np.uint8), [[-50, 0.3, -50], [50, 0.3, -50], [50, 0.3, 50], [-50, 0.3, 50]]
    )
    picture = render([(floor, se3.IDENTITY)], CAMERA, se3.IDENTITY, EVEN)
    slope = (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
    expected = np.divide(0.3, slope, out=np.zeros(len(slope)), where=slope > 0.3 / 50)
    np.testing.assert_allclose(picture.depth_m, np.repeat(expected[:, None], CAMERA.width, 1), rtol=1e-9)


def test_texture_is_perspective_correct():
    T = pose(np.random.default_rng(7), 0.35)
    grid = np.linspace(0, 255, 256).round().astype(np.uint8)
    texture = np.dstack([np.tile(grid, (256, 1)), np.tile(grid[::-1, None], (1, 256)), np.zeros((256, 256), np.uint8)])
    half = 0.1
    T[:3, :3] = se3.exp(np.array([0.3, 0.9, 0.2, 0, 0, 0]))[:3, :3]
    mesh = shapes.plane(texture, [[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    picture = render([(mesh, T)], CAMERA, se3.IDENTITY, EVEN)
    v, u = np.nonzero(picture.label)
    p_cam = CAMERA.unproject(np.stack([u, v], -1), picture.depth_m[v, u])
    p_model = se3.transform(se3.inverse(T), p_cam)
    np.testing.assert_allclose(p_model[:, 2], 0, atol=1e-9)
    # Texel centres lie half a texel inside; the outermost texels are clamped.
    expected = np.clip((p_model[:, :2] * [1, -1] / (2 * half) + 0.5) * 256 - 0.5, 0, 255)
    inner = ((expected > 3) & (expected < 252)).all(1)
    assert inner.sum() > 2000
    assert np.ptp(picture.depth_m[v, u]) > 0.1
    np.testing.assert_allclose(picture.rgb[v, u][inner, :2], expected[inner], atol=0.15)


def test_lambert_shading():
    rng = np.random.default_rng(8)
    white = shapes.box(rng, tuple(SIZE))
    white = shapes.Mesh(white.vertices, white.faces, white.uv, np.full_like(white.texture, 255), white.normals)
    T, light = pose(rng), Light((0.2, -0.6, -1.0), 0.3)
    picture = render([(white, T)], CAMERA, se3.IDENTITY, light)
    _, face = ray_box(T, SIZE, CAMERA)
    hit = picture.label > 0
    normals = np.repeat(np.eye(3), 2, 0) * np.array([-1, 1] * 3)[:, None]
    towards = np.array(light.towards) / np.linalg.norm(light.towards)
    brightness = 0.3 + 0.7 * np.maximum(0, normals @ T[:3, :3].T @ towards)
    assert len(np.unique(face[hit])) >= 2
    np.testing.assert_allclose(picture.rgb[hit], 255 * np.repeat(brightness[face[hit]][:, None], 3, 1), atol=0.05)


@pytest.mark.parametrize(("distance", "step"), [(3.0, 0.0), (2.0, 0.9)])
def test_a_far_fine_checkerboard_fades_to_its_mean(distance, step):
    texels = 2048
    board = ((np.add.outer(np.arange(texels), np.arange(texels)) % 2) * 255).astype(np.uint8)
    mesh = shapes.plane(np.dstack([board] * 3), np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * 0.5)
    T = se3.exp(np.array([0, step, 0, 0, 0, 0.0]))
    T[2, 3] = distance
    picture = render([(mesh, T)], CAMERA, se3.IDENTITY, EVEN)
    inside = cv2.erode(picture.label, np.ones((5, 5))) > 0
    assert inside.sum() > 1000
    assert np.abs(picture.rgb[inside] - 127.5).max() < 2
    # Seen so near that a texel covers many pixels, the same board is black and white.
    T[2, 3] = 0.01 + 0.5 * np.sin(step)
    near = render([(mesh, se3.from_rt(np.eye(3), [0, 0, 0.02]))], CAMERA, se3.IDENTITY, EVEN).rgb
    assert np.ptp(near) > 240


def test_fine_mesh_is_watertight_and_round():
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    mesh = shapes.Mesh(ball.vertices, ball.faces, np.zeros((len(ball.faces), 3, 2)), np.full((1, 1, 3), 200, np.uint8))
    centre = np.array([0.02, -0.03, 0.5])
    picture = render([(mesh, se3.from_rt(np.eye(3), centre))], CAMERA, se3.IDENTITY)
    rays = CAMERA.rays.astype(float)
    b, rr = rays @ centre, (rays**2).sum(-1)
    root = b**2 - rr * (centre @ centre - 0.1**2)
    deep = root > 0.003  # away from the limb, where facets and sphere part
    exact = (b - np.sqrt(np.maximum(root, 0))) / rr
    assert deep.sum() > 5000
    assert (picture.label[deep] == 1).all()
    assert (picture.label[root < 0] == 0).all()
    assert np.abs(picture.depth_m - exact)[deep].max() < 4e-4  # sagitta of the facets, slanted
    outline, _ = cv2.findContours(picture.label, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    assert len(outline) == 1  # no holes between faces


def test_label_panels_do_not_leak_into_each_other():
    # Colour each panel of the atlas through the public picture: front (-y), right (+x) and top (+z) are distinct.
    mesh = shapes.box(np.random.default_rng(1), tuple(SIZE))
    rows, cols = mesh.texture.shape[:2]
    for normal in np.vstack([np.eye(3), -np.eye(3)]):
        on = np.flatnonzero(mesh.face_normals @ normal > 0.99)
        uv = mesh.uv[on].reshape(-1, 2) * [cols, rows]
        low, high = uv.min(0), uv.max(0)
        others = np.setdiff1d(np.arange(len(mesh.faces)), on)
        centre = mesh.uv[others].mean(1) * [cols, rows]
        assert not ((centre > low) & (centre < high)).all(1).any()


@pytest.mark.parametrize("make", [lambda r: shapes.box(r, tuple(SIZE)), lambda r: shapes.can(r, 0.04, 0.11)])
def test_procedural_shapes_are_closed_outward_and_of_the_asked_size(make):
    import trimesh

    mesh = make(np.random.default_rng(2))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0
    size = SIZE if len(mesh.faces) > 1000 and abs(solid.extents[1] - 0.07) < 1e-6 else np.array([0.08, 0.08, 0.11])
    np.testing.assert_allclose(solid.extents, size, rtol=1e-3)
    assert ((mesh.uv >= 0) & (mesh.uv <= 1)).all()
    agreement = np.einsum("fkc,fc->fk", mesh.normals, mesh.face_normals)
    assert agreement.min() > 0.99


def test_surface_samples_lie_on_the_surface_and_are_even():
    import trimesh

    mesh = shapes.box(np.random.default_rng(3), tuple(SIZE))
    points, normals = mesh.sample(4000, np.random.default_rng(4))
    on = np.abs(np.abs(points) - SIZE / 2) < 1e-9
    assert on.any(1).all()
    assert (np.abs(normals)[on & (on.sum(1, keepdims=True) == 1)] > 0.999).all()
    areas = np.array([SIZE[1] * SIZE[2], SIZE[0] * SIZE[2], SIZE[0] * SIZE[1]])
    share = np.array([(np.abs(normals[:, k]) > 0.5).mean() for k in range(3)])
    np.testing.assert_allclose(share, areas / areas.sum(), atol=0.01)
    np.testing.assert_allclose(points.mean(0), trimesh.Trimesh(mesh.vertices, mesh.faces).centroid, atol=2e-3)


def test_ycb_mesh_renders_with_its_texture(shared_data):
    mesh = shapes.load_mesh(shared_data / "ycb_models/004_sugar_box/textured.obj")
    T = se3.exp(np.array([1.2, 0.4, 0.2, 0, 0, 0]))
    T[:3, 3] = -T[:3, :3] @ mesh.vertices.mean(0) + [0, 0, 0.45]
    picture = render([(mesh, T)], CAMERA, se3.IDENTITY, EVEN)
    mask = picture.label > 0
    assert mask.sum() > 4000
    assert picture.rgb[mask].std(0).min() > 20
    # Oracle: Moeller-Trumbore rays through 200 pixels against all 16,384 faces.
    v, u = (a[:: len(a) // 200] for a in np.nonzero(mask))
    rays = CAMERA.unproject(np.stack([u, v], -1), np.ones(len(u)))
    a, b, c = np.moveaxis(se3.transform(T, mesh.vertices)[mesh.faces], 1, 0)
    e1, e2 = b - a, c - a
    h = np.cross(rays[:, None], e2)
    det = np.einsum("fc,rfc->rf", e1, h)
    det = np.where(np.abs(det) > 1e-18, det, np.inf)
    s = -np.einsum("fc,rfc->rf", a, h) / det
    q = np.cross(-a, e1)
    t = np.einsum("rc,fc->rf", rays, q) / det
    z = np.einsum("fc,fc->f", e2, q) / det
    hits = np.where((s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9) & (z > 0), z, np.inf)
    np.testing.assert_allclose(picture.depth_m[v, u], hits.min(1), rtol=1e-7)


def test_bad_meshes_are_refused(tmp_path):
    with pytest.raises(MissingData, match="no such file"):
        shapes.load_mesh(tmp_path / "none.obj")
    (tmp_path / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(BadInput, match=r"bare.obj.*no texture"):
        shapes.load_mesh(tmp_path / "bare.obj")
    tri = np.array([[0, 1, 2]])
    with pytest.raises(BadInput, match="texture"):
        shapes.Mesh(np.eye(3), tri, np.zeros((1, 3, 2)), np.zeros((2, 2, 3)))
