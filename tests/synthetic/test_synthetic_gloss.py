"""What glossy surfaces mirror: against reflections worked out by hand, and what a turning mug shows."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.synthetic import shapes, solids
from p2p_lib.synthetic.environment import fresnel, living_room
from p2p_lib.synthetic.render import Light, render
from p2p_lib.synthetic.texture import mipmap

CAMERA = Camera(300.0, 310.0, 158.3, 121.7, 320, 240)


def smooth_room():
    """A room whose radiance is a plain function of direction: what is mirrored can be worked out."""
    azimuth = (np.arange(1024) + 0.5) / 1024 * 2 * np.pi - np.pi
    elevation = np.pi / 2 - (np.arange(512) + 0.5) / 512 * np.pi
    x, y = (np.outer(np.cos(elevation), f(azimuth)) for f in (np.cos, np.sin))
    z = np.repeat(np.sin(elevation)[:, None], 1024, 1)
    return mipmap(100 + 90 * np.stack([x, y, z], -1))


def ball(reflectance, radius_m=0.06):
    """A black ball; its rings are fine enough for flat faces to lie within 0.1 mm of the sphere."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 73)
    profile = radius_m * np.stack([np.cos(angle).clip(0), np.sin(angle)], 1)
    mesh = shapes.assembled([solids.revolved(profile, np.zeros((8, 8, 3), np.uint8), segments=144)])
    return replace(mesh, reflectance=np.full(len(mesh.faces), reflectance))


def test_schlick_at_both_ends():
    assert fresnel(0.05, np.array([1.0, 0.0])) == pytest.approx([0.05, 1.0])
    at = fresnel(0.05, np.linspace(0, 1, 50))
    assert (np.diff(at) < 0).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_silver_ball_mirrors_the_room(seed):
    rng = np.random.default_rng(seed)
    T_world_cam = se3.exp(rng.uniform(-1, 1, 6))
    T_cam_ball = se3.exp(np.r_[rng.uniform(-2, 2, 3), 0, 0, 0])
    T_cam_ball[:3, 3] = 0.03, -0.02, 0.5
    light = Light(environment=smooth_room(), roughness_rad=0.0)
    picture = render([(ball(1.0), T_world_cam @ T_cam_ball)], CAMERA, T_world_cam, light)
    # The sphere, by its equation: |s ray - centre| = radius.
    ray = CAMERA.rays.reshape(-1, 3).astype(float)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = ray @ T_cam_ball[:3, 3]
    under = along**2 - (T_cam_ball[:3, 3] @ T_cam_ball[:3, 3] - 0.06**2)
    hit = under > 0.2 * 0.06**2  # away from the outline, where faces and sphere part
    normal = (ray[hit] * (along[hit] - np.sqrt(under[hit]))[:, None] - T_cam_ball[:3, 3]) / 0.06
    away = ray[hit] - 2 * np.einsum("nc,nc->n", ray[hit], normal)[:, None] * normal
    away = away @ T_world_cam[:3, :3].T
    # Beside the map's poles and its seam a pixel's footprint is cut off: by a degree or two.
    fair = (np.abs(away[:, 2]) < 0.95) & ~((away[:, 0] < 0) & (np.abs(away[:, 1]) < 0.06))
    assert fair.sum() > 2500
    assert np.abs(picture.rgb.reshape(-1, 3)[hit] - (100 + 90 * away))[fair].max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-9)


def test_nothing_is_mirrored_without_a_room_or_by_matt_surfaces():
    T = se3.from_rt(np.eye(3), [0, 0, 0.5])
    for light, reflectance in ((Light(), 1.0), (Light(environment=smooth_room()), 0.0)):
        assert render([(ball(reflectance), T)], CAMERA, se3.IDENTITY, light).rgb.max() == 0


@pytest.fixture(scope="module")
def mug():
    return solids.mug(np.random.default_rng(3), 0.044, 0.105, reflectance=0.05, marks=5)


def test_mug_is_closed_and_wound_outwards(mug):
    import trimesh

    parts = trimesh.Trimesh(mug.vertices, mug.faces, process=False).split(only_watertight=False)
    body, handle = sorted(parts, key=lambda p: -p.area)
    assert body.is_watertight and 0 < body.volume < 0.25 * np.pi * 0.044**2 * 0.105  # hollow
    assert handle.is_winding_consistent
    assert np.einsum("fc,fkc->fk", mug.face_normals, mug.normals).min() > 0.8
    # The handle's open ends are inside the wall: no boundary edge lies outside the body.
    edges = handle.edges_sorted[trimesh.grouping.group_rows(handle.edges_sorted, require_count=1)]
    ends = np.linalg.norm(handle.vertices[np.unique(edges)][:, :2], axis=1)
    assert ends.max() < 0.044 * 1.01


def test_the_body_hides_that_it_turns_and_the_handle_does_not(mug):
    bare = solids.mug(np.random.default_rng(3), 0.044, 0.105, reflectance=0.05, marks=0)
    light = Light(environment=living_room(np.random.default_rng(1), windows=4))
    upright = se3.exp(np.array([-np.pi / 2, 0, 0, 0, 0, 0]))  # z of the world is up in the picture
    eye = upright @ se3.from_rt(np.eye(3), [0, 0, -0.4])

    def seen(mesh, yaw_deg):
        return render([(mesh, se3.exp(np.radians([0, 0, yaw_deg, 0, 0, 0])))], CAMERA, eye, light)

    # 72 segments: turned by whole segments the body is the same surface.
    a, b = seen(bare, -90), seen(bare, -50)
    both = cv2_eroded(a.label > 0) & cv2_eroded(b.label > 0)
    body = both & (np.abs(a.depth_m - b.depth_m) < 1e-6)
    assert body.sum() > 0.6 * (a.label > 0).sum()
    difference = np.abs(a.rgb - b.rgb).max(-1)[body]
    assert np.quantile(difference, 0.95) < 0.5
    assert np.clip(a.rgb, 0, 255)[body].std() > 30  # and yet it is full of structure
    assert (a.label > 0).sum() - body.sum() > 500  # the handle moved
    # The same surface with marks does tell.
    marked = np.abs(seen(mug, -90).rgb - seen(mug, -50).rgb).max(-1)[body]
    assert (marked > 30).sum() > 100


def cv2_eroded(mask):
    import cv2

    return cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0


def test_brightness_follows_the_reflectance():
    light, straight = Light(environment=smooth_room(), roughness_rad=0.0), Camera(300.0, 310.0, 158.0, 121.0, 320, 240)
    upright = se3.exp(np.array([-np.pi / 2, 0, 0, 0, 0, 0]))
    T = upright @ se3.from_rt(np.eye(3), [0, 0, 0.5])
    middle = [render([(ball(r), T)], straight, upright, light).rgb[121, 158] for r in (0.1, 0.2, 0.8)]
    np.testing.assert_allclose(middle[1], 2 * middle[0], rtol=0.01)
    np.testing.assert_allclose(middle[2], 8 * middle[0], rtol=0.01)
    # The camera looks along +y: the ball's middle mirrors what is behind it, in direction -y.
    np.testing.assert_allclose(middle[2] / 0.8, [100, 10, 100], atol=0.5)
