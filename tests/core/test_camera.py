"""The pinhole camera: inverse maps, where pixels have their centres, what lies in the picture, refusals."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput

CAMERA = Camera(615.2, 613.9, 318.4, 243.1, 640, 480)
cameras = st.builds(
    Camera,
    fx=st.floats(820, 3000),
    fy=st.floats(820, 3000),
    cx=st.floats(-100, 4000),
    cy=st.floats(-100, 4000),
    width=st.integers(1, 4000),
    height=st.integers(1, 4000),
)


def test_a_focal_length_in_letters_is_refused():
    with pytest.raises(BadInput, match="expected finite numbers"):
        Camera("600", 600, 320, 240, 640, 480)


def test_shares_of_the_width_are_no_pixels():
    with pytest.raises(BadInput, match=r"camera: got fx = 0\.96 for 640 columns, expected focal lengths in pixels"):
        Camera(0.96, 1.28, 0.5, 0.5, 640, 480)


def test_a_principal_point_that_no_part_of_an_image_has_is_refused():
    """A part of a larger image may have it far outside; one of nine focal lengths away nobody has."""
    far = r"got cx = 5000 for 640 columns, of which one is 83 degrees off the axis, expected 79 degrees at most"
    with pytest.raises(BadInput, match=f"camera: {far}"):
        Camera(600, 600, 5000, 240, 640, 480)
    with pytest.raises(BadInput, match=f"cam_K.txt: {far}"):
        Camera.from_K(np.array([[600, 0, 5000], [0, 600, 240], [0, 0, 1]]), 640, 480, "cam_K.txt")
    with pytest.raises(BadInput, match="got cy = -4000 for 480 rows"):
        Camera(600, 600, 320, -4000, 640, 480)
    assert Camera(600, 600, -1300, 900, 64, 48).resized(640, 480).cx == -12995.5


@given(cameras, st.tuples(*[st.floats(0, 1)] * 4), st.integers(1, 2000))
def test_every_part_of_an_image_at_every_size_has_a_camera(camera, at, width):
    left, right = sorted(round(x * (camera.width - 1)) for x in at[:2])
    top, bottom = sorted(round(y * (camera.height - 1)) for y in at[2:])
    size = right + 1 - left, bottom + 1 - top
    Camera(camera.fx, camera.fy, camera.cx - left, camera.cy - top, *size).resized(width, 480)


def test_nine_numbers_are_a_matrix_row_by_row():
    assert Camera.from_K(CAMERA.K.ravel(), 640, 480) == CAMERA


# --- projecting and back -----------------------------------------------------------------------


@given(cameras, st.lists(st.tuples(st.floats(-500, 4500), st.floats(-500, 4500), st.floats(0.05, 20)), min_size=1))
def test_project_undoes_unproject(camera, pixels):
    uvz = np.array(pixels)
    p_cam = camera.unproject(uvz[:, :2], uvz[:, 2])
    np.testing.assert_array_equal(p_cam[:, 2], uvz[:, 2])
    np.testing.assert_allclose(camera.project(p_cam), uvz[:, :2], rtol=1e-12, atol=1e-9)


@given(cameras, st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.05, 20)))
def test_unproject_undoes_project(camera, p):
    p = np.array(p)
    np.testing.assert_allclose(camera.unproject(camera.project(p), p[2]), p, rtol=1e-9, atol=1e-12)


def test_project_is_opencvs_and_the_matrix():
    p = np.random.default_rng(0).uniform([-1, -1, 0.2], [1, 1, 3], (50, 3))
    expected = cv2.projectPoints(p, np.zeros(3), np.zeros(3), CAMERA.K, None)[0][:, 0]
    np.testing.assert_allclose(CAMERA.project(p), expected, rtol=0, atol=1e-9)
    homogeneous = p @ CAMERA.K.T
    np.testing.assert_allclose(CAMERA.project(p), homogeneous[:, :2] / homogeneous[:, 2:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)], ids=str)
def test_batches(batch):
    p = np.random.default_rng(0).uniform(0.1, 1, (*batch, 3))
    uv = CAMERA.project(p)
    assert uv.shape == (*batch, 2)
    np.testing.assert_allclose(CAMERA.unproject(uv, p[..., 2]), p, atol=1e-12)
    assert CAMERA.inside(uv).shape == batch


@pytest.mark.parametrize("z", [0.0, -0.0, -1.0, 1e-12, np.nan])
def test_what_is_not_in_front_has_no_pixel(z):
    uv = CAMERA.project(np.array([[0.1, 0.1, z], [0, 0, 1]]))
    assert np.isnan(uv[0]).all()
    np.testing.assert_array_equal(uv[1], [CAMERA.cx, CAMERA.cy])


# --- pixel centres -----------------------------------------------------------------------------


def test_the_optical_axis_is_the_principal_point():
    np.testing.assert_array_equal(CAMERA.unproject(np.array([CAMERA.cx, CAMERA.cy]), 0.7), [0, 0, 0.7])


def test_x_goes_right_and_y_down_by_focal_length_over_depth():
    centre = CAMERA.project(np.array([0, 0, 2.0]))
    np.testing.assert_allclose(CAMERA.project(np.array([0.2, 0, 2.0])) - centre, [61.52, 0])
    np.testing.assert_allclose(CAMERA.project(np.array([0, 0.2, 2.0])) - centre, [0, 61.39])


def test_an_integer_pixel_is_a_pixel_centre():
    # A symmetric camera: its middle lies between the middle pixels' centres, at (width - 1) / 2.
    camera = Camera(500, 500, (640 - 1) / 2, (480 - 1) / 2, 640, 480)
    np.testing.assert_allclose(camera.rays[0, 0], -camera.rays[-1, -1] * [1, 1, -1], atol=1e-7)
    np.testing.assert_allclose(camera.rays[:, ::-1, 0], -camera.rays[:, :, 0], atol=1e-7)


def test_rays_lie_behind_their_pixels():
    rays = CAMERA.rays
    assert rays.shape == (480, 640, 3) and rays.dtype == np.float32 and rays is CAMERA.rays
    assert (rays[..., 2] == 1).all()
    uv = CAMERA.project(rays)
    v, u = np.mgrid[:480, :640]
    np.testing.assert_allclose(uv, np.stack([u, v], -1), atol=1e-4)
    np.testing.assert_allclose(rays[100, 200] * 0.8, CAMERA.unproject(np.array([200, 100]), 0.8), rtol=1e-6)


# --- what lies in the picture ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uv", "margin", "expected"),
    [
        ((0, 0), 0, True),
        ((639, 479), 0, True),
        ((639.01, 100), 0, False),
        ((-0.01, 100), 0, False),
        ((100, 479.01), 0, False),
        ((100, -0.01), 0, False),
        ((5, 5), 5, True),
        ((4.99, 5), 5, False),
        ((634, 474), 5, True),
        ((634.01, 474), 5, False),
        ((np.nan, 100), 0, False),
        ((100, np.nan), 0, False),
        ((np.nan, np.nan), 0, False),
        ((np.inf, 0), 0, False),
        ((-np.inf, 0), 0, False),
    ],
)
def test_inside(uv, margin, expected):
    assert CAMERA.inside(np.array(uv, float), margin) == expected
    assert CAMERA.inside(np.array([uv, uv], float), margin).tolist() == [expected] * 2


# --- refusals ----------------------------------------------------------------------------------


def test_from_k_and_back():
    camera = Camera.from_K(CAMERA.K.tolist(), 640, 480)
    assert camera == CAMERA
    assert isinstance(camera.fx, float) and isinstance(camera.width, int)
    np.testing.assert_array_equal(camera.K, CAMERA.K)


def K_with(at: tuple[int, int], value: float) -> np.ndarray:
    K = CAMERA.K
    K[at] = value
    return K


@pytest.mark.parametrize(
    ("K", "words"),
    [
        (np.eye(2), r"shape \(2, 2\)"),
        (np.zeros((3, 4)), r"shape \(3, 4\)"),
        (np.zeros(8), r"shape \(8,\)"),
        (K_with((0, 0), np.nan), "nan"),
        (K_with((1, 2), np.inf), "inf"),
        (K_with((0, 0), 0.0), "fx 0 cx"),
        (K_with((1, 1), -600.0), "-600"),
        (K_with((2, 2), 2.0), "0 0 2"),
        (CAMERA.K.T, "fx 0 cx 0 fy cy 0 0 1.* Is it transposed?"),
        (K_with((0, 1), 3.0), "fx 0 cx"),
        (K_with((2, 0), 1.0), "fx 0 cx"),
        (np.array([[0.94, 0, 0.5], [0, 1.25, 0.5], [0, 0, 1]]), "fx = 0.94 for 640 columns, expected .* in pixels"),
    ],
    ids=[
        "2x2",
        "3x4",
        "flat",
        "nan",
        "inf",
        "zero-f",
        "negative-f",
        "scale",
        "transposed",
        "skew",
        "last-row",
        "normalised",
    ],
)
def test_a_bad_matrix_is_refused_and_its_file_named(K, words):
    with pytest.raises(BadInput, match=words) as caught:
        Camera.from_K(K, 640, 480, "seq/cam_K.txt")
    assert str(caught.value).startswith("seq/cam_K.txt: got ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", [{"fx": 0.0}, {"fy": -1.0}, {"cx": np.nan}, {"cy": np.inf}])
def test_bad_numbers_are_refused(change):
    values = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0} | change
    with pytest.raises(BadInput, match=r"camera: got fx, fy, cx, cy = .*focal lengths above 0"):
        Camera(**values, width=640, height=480)


@pytest.mark.parametrize("size", [(0, 480), (640, 0), (-1, -1)])
def test_a_picture_has_pixels(size):
    with pytest.raises(BadInput, match=f"camera: got {size[0]}x{size[1]}, expected an image size"):
        Camera(600, 600, 320, 240, *size)
