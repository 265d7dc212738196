"""Lifting: exact on surfaces that are planes, one surface at a time, and NaN where there is nothing to trust."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import _RIDGE, depth_noise_m, lift, off_edges
from p2p_lib.core.types import Frame

CAMERA = Camera(300.0, 310.0, 81.3, 58.7, 160, 120)
RANGE_M, EDGE_M = (0.1, 2.5), 0.01
DEPTH = DepthConfig(min_m=RANGE_M[0], max_m=RANGE_M[1], edge_m=EDGE_M)
EVERYWHERE = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), -1).reshape(-1, 2)


def frame_of(depth: np.ndarray) -> Frame:
    return Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32))


def lifted(depth: np.ndarray, uv, edge_m: float = EDGE_M, camera: Camera = CAMERA) -> np.ndarray:
    return lift(frame_of(depth), np.atleast_2d(np.asarray(uv, float)), camera, replace(DEPTH, edge_m=edge_m))


def plane(tilt_deg: float, camera: Camera = CAMERA, turn_deg: float = 30.0) -> tuple[np.ndarray, float]:
    """Normal n and offset c with n . p = c of a plane 0.6 m away, tilted about an oblique axis."""
    tilt, turn = np.radians(tilt_deg), np.radians(turn_deg)
    n = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    return n, float(n[2] * 0.6)


def plane_depth(uv: np.ndarray, tilt_deg: float, camera: Camera = CAMERA, turn_deg: float = 30.0) -> np.ndarray:
    n, c = plane(tilt_deg, camera, turn_deg)
    return c / (camera.unproject(uv, np.ones(uv.shape[:-1])) @ n)


def picture(tilt_deg: float, camera: Camera = CAMERA, turn_deg: float = 30.0) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    return plane_depth(np.stack([u, v], -1), tilt_deg, camera, turn_deg)


# --- exact geometry ----------------------------------------------------------------------------


def test_pixel_centres_of_a_plane_are_lifted_onto_it():
    n, c = plane(50)
    inner = EVERYWHERE[((EVERYWHERE > 0) & (EVERYWHERE < [159, 119])).all(1)]
    p_cam = lifted(picture(50), inner)
    np.testing.assert_allclose(CAMERA.project(p_cam), inner, atol=1e-9)
    np.testing.assert_allclose(p_cam @ n, c, atol=2e-5)  # depth is linear in 1/z only; nine readings see the curve


@given(st.floats(0, 159), st.floats(0, 119), st.floats(0.2, 2.4))
def test_a_wall_in_front_is_exact_everywhere(u, v, z):
    p_cam = lifted(np.full((120, 160), z), [u, v])[0]
    np.testing.assert_allclose(p_cam, CAMERA.unproject(np.array([u, v]), float(np.float32(z))), rtol=1e-12)


@pytest.mark.parametrize("tilt_deg", [20, 45, 60])
@pytest.mark.parametrize("turn_deg", [0, 30, 90, 200])
def test_between_pixels_the_slope_counts(tilt_deg, turn_deg):
    """A slanted surface's depth changes within a pixel: that is recovered but for the share the ridge withholds."""
    uv = np.random.default_rng(0).uniform([40, 30], [120, 90], (2000, 2))
    depth = picture(tilt_deg, turn_deg=turn_deg)
    exact, nearest = plane_depth(uv, tilt_deg, turn_deg=turn_deg), depth[tuple(np.rint(uv).astype(int).T[::-1])]
    error = lifted(depth, uv)[:, 2] - exact
    withheld = _RIDGE / (6 + _RIDGE)
    assert np.abs(error).max() <= (withheld + 0.01) * np.abs(nearest - exact).max() + 2e-5


@pytest.mark.parametrize("edge", ["left", "top", "right", "bottom", "corner"])
def test_the_pictures_border_bends_nothing(edge):
    rng = np.random.default_rng(1)
    uv = {
        "left": np.c_[rng.uniform(0, 0.5, 50), rng.uniform(5, 100, 50)],
        "top": np.c_[rng.uniform(5, 100, 50), rng.uniform(0, 0.5, 50)],
        "right": np.c_[rng.uniform(158.5, 159, 50), rng.uniform(5, 100, 50)],
        "bottom": np.c_[rng.uniform(5, 100, 50), rng.uniform(118.5, 119, 50)],
        "corner": np.array([[0, 0], [159, 0], [0, 119], [159, 119], [0.4, 0.4]]),
    }[edge]
    p_cam = lifted(picture(45), uv)
    n, c = plane(45)
    per_px = np.abs(np.diff(picture(45), axis=1)).max()
    assert np.abs(p_cam @ n - c).max() < 0.3 * per_px


@pytest.mark.parametrize(("tilt_deg", "at_most"), [(0, 1.11), (30, 1.0), (45, 0.85), (60, 0.65)])
def test_on_a_noisy_plane_beside_the_mean_of_nine(tilt_deg, at_most):
    """RMS error relative to the plain 3x3 mean, white noise of 0.8 mm at 0.6 m: little lost in front, much won aslant.

    In front the slope is nothing but noise; its variance adds 2/12 * 6/6.5^2 to 1/9, which makes 10 %.
    """
    camera = Camera(615, 615, 319.5, 239.5, 640, 480)
    rng = np.random.default_rng(2)
    noisy = picture(tilt_deg, camera) + rng.normal(0, 0.0008, (480, 640))
    uv = rng.uniform([200, 150], [440, 330], (20_000, 2))
    exact = plane_depth(uv, tilt_deg, camera)
    px = np.rint(uv).astype(int)
    nine = [noisy[px[:, 1] + j, px[:, 0] + i] for j in (-1, 0, 1) for i in (-1, 0, 1)]
    mean_of_nine = np.mean(nine, 0) - exact
    error = lifted(noisy, uv, camera=camera)[:, 2] - exact
    assert np.sqrt(np.mean(error**2)) <= at_most * np.sqrt(np.mean(mean_of_nine**2))
    assert abs(error.mean()) < 3e-5


def slowly(depth: np.ndarray, uv: np.ndarray, edge_m: float) -> float:
    """One point's depth by a generic least-squares solver, NaN where there is none."""
    if not (0 <= uv[0] <= 159 and 0 <= uv[1] <= 119):
        return np.nan
    u, v = (int(np.rint(x)) for x in uv)
    near = [(i, j) for j in range(v - 1, v + 2) for i in range(u - 1, u + 2) if 0 <= i < 160 and 0 <= j < 120]
    z0 = float(depth[v, u])
    if not RANGE_M[0] <= z0 <= RANGE_M[1]:
        return np.nan
    used = [(i, j, float(depth[j, i])) for i, j in near]
    used = np.array([r for r in used if RANGE_M[0] <= r[2] <= RANGE_M[1] and abs(r[2] - z0) <= edge_m])
    middle = used.mean(0)
    A = np.vstack([used[:, :2] - middle[:2], np.sqrt(_RIDGE) * np.eye(2)])
    slope = np.linalg.lstsq(A, np.r_[used[:, 2] - middle[2], 0, 0], rcond=None)[0]
    return float(middle[2] + slope @ (uv - middle[:2]))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), holes=st.sampled_from([0.0, 0.3, 0.8]), edge_m=st.sampled_from([0.002, 0.01]))
def test_it_is_least_squares_over_the_same_surface(seed, holes, edge_m):
    rng = np.random.default_rng(seed)
    depth = (picture(40) + rng.normal(0, 0.003, (120, 160))).astype(np.float32)
    depth[rng.random(depth.shape) < holes] = 0
    depth[:, 90:] += 0.05
    uv = rng.uniform([-2, -2], [161, 121], (60, 2))
    uv[:5] = np.rint(uv[:5])
    np.testing.assert_allclose(lifted(depth, uv, edge_m)[:, 2], [slowly(depth, p, edge_m) for p in uv], atol=1e-12)


# --- one surface at a time ---------------------------------------------------------------------


@pytest.mark.parametrize("step_m", [0.011, 0.05, 1.0])
def test_two_surfaces_are_never_mixed(step_m):
    depth = np.full((120, 160), 0.5, np.float32)
    depth[:, 80:] += np.float32(step_m)
    uv = np.c_[np.linspace(70, 90, 201), np.full(201, 50.3)]
    z = lifted(depth, uv)[:, 2]
    expected = np.where(np.rint(uv[:, 0]) < 80, depth[0, 0], depth[0, 159]).astype(float)
    np.testing.assert_allclose(z, expected, atol=1e-12)


def test_a_step_within_the_limit_is_one_surface():
    depth = np.full((120, 160), 0.5, np.float32)
    depth[:, 80:] += np.float32(0.009)
    z = lifted(depth, [[79.0, 50], [80, 50], [79.5, 50], [70, 50]])[:, 2]
    assert 0.5 < z[0] < z[1] < 0.509 and z[3] == 0.5


def test_a_lonely_reading_is_taken_as_it_is():
    depth = np.zeros((120, 160), np.float32)
    depth[50, 60] = 0.7
    np.testing.assert_allclose(lifted(depth, [60.4, 49.6])[0, 2], np.float32(0.7), rtol=1e-12)


@pytest.mark.parametrize("neighbours", [[(1, 0)], [(1, 0), (-1, 0)], [(1, 1), (-1, -1)], [(0, 1), (1, 0)]])
def test_few_readings_never_throw_a_point_far(neighbours):
    """With one or two neighbours, on one line, the depth stays within what they read and a little more."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        depth = np.zeros((120, 160), np.float32)
        for i, j in [(0, 0), *neighbours]:
            depth[50 + j, 60 + i] = 0.7 + rng.uniform(-0.005, 0.005)
        read = depth[depth > 0]
        z = lifted(depth, rng.uniform([59.5, 49.5], [60.5, 50.5]))[0, 2]
        span = read.max() - read.min()
        assert read.min() - span / 2 <= z <= read.max() + span / 2


# --- nothing to trust --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "uv", [(-0.01, 5), (5, -0.01), (159.01, 5), (5, 119.01), (np.nan, 5), (5, np.nan), (np.inf, 5), (1e9, -1e9)]
)
def test_outside_the_picture_there_is_nothing(uv):
    p_cam = lifted(np.full((120, 160), 0.5), [uv, (5, 5)])
    assert np.isnan(p_cam[0]).all() and np.isfinite(p_cam[1]).all()


@pytest.mark.parametrize("z", [0.0, np.nan, np.inf, -0.5, 0.0999, 2.501])
def test_invalid_depth_is_no_point_and_no_neighbour(z):
    depth = np.full((120, 160), 0.5, np.float32)
    depth[50, 60] = z
    assert np.isnan(lifted(depth, [60.4, 49.6])).all()
    np.testing.assert_allclose(lifted(depth, [[61, 50], [59.5, 51.4]])[:, 2], 0.5, rtol=1e-12)


@pytest.mark.parametrize("z", [0.1001, 0.5, 2.4999])
def test_depth_in_range_is_a_point(z):
    assert np.isfinite(lifted(np.full((120, 160), z), [60, 50])).all()


def test_no_points_no_rows():
    assert lift(frame_of(np.ones((120, 160))), np.zeros((0, 2)), CAMERA, DEPTH).shape == (0, 3)
    nowhere = np.full((7, 2), np.nan)
    assert np.isnan(lift(frame_of(np.ones((120, 160))), nowhere, CAMERA, DEPTH)).all()


def test_rows_belong_to_their_pixels():
    depth = picture(45)
    depth[40:60] = 0
    uv = np.random.default_rng(3).uniform([-20, -20], [180, 140], (300, 2))
    together = lifted(depth, uv)
    np.testing.assert_array_equal(together, np.concatenate([lifted(depth, p) for p in uv]))


def test_noise_grows_with_the_range_squared():
    sensor = DepthConfig(noise_m=0.002, noise_per_m2=0.003)
    np.testing.assert_allclose(depth_noise_m(np.array([0.0, 1, 2]), sensor), [0.002, 0.005, 0.014])


def test_off_edges_pixel_by_pixel():
    depth = np.full((6, 8), 0.5, np.float32)
    depth[1, 1] = 0
    depth[:, 5:] = 0.52
    expected = np.zeros(depth.shape, bool)
    for v, u in np.ndindex(depth.shape):
        near = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        expected[v, u] = near.min() > 0 and near.max() - near.min() <= 0.01
    assert expected.any() and not expected.all()
    np.testing.assert_array_equal(off_edges(depth, 0.01), expected)
