"""A surface laid into the image: found where it is, in its colours, and nowhere else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.types import Frame
from p2p_lib.extended.gates import SIGHTED
from p2p_lib.extended.image_search import ImageSearch, SurfaceSample, centred_at_points
from p2p_lib.method.observation import sample_cloud
from tests.method import analytic_scene

CAMERA = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)
RADIUS_M = 0.05
BLUE, GREY = (90, 100, 150), (150, 150, 150)
PLACE = se3.from_rt(np.eye(3), np.array([0.02, -0.01, 0.6]))
WALL_M = 1.0


def ball_in_front_of_a_wall(colour=BLUE, centre=PLACE[:3, 3], gain: float = 1.0) -> Frame:
    """Exact image of a ball and a wall behind it."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = CAMERA.unproject(np.stack([u, v], -1), np.ones(u.shape))
    a, b, c = (ray**2).sum(-1), ray @ centre, centre @ centre - RADIUS_M**2
    hit = b**2 - a * c >= 0
    z = np.where(hit, (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a, WALL_M)
    rgb = np.where(hit[..., None], colour, GREY) * gain
    return Frame(0, 0.0, rgb.clip(0, 255).astype(np.uint8), z.astype(np.float32))


def sample_of_the_ball(colour=BLUE) -> SurfaceSample:
    """Points spread evenly over the ball."""
    k = np.arange(300) + 0.5
    z, turn = 1 - 2 * k / 300, np.pi * (1 + 5**0.5) * k
    n = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    lab = cv2.cvtColor(np.uint8([[colour]]), cv2.COLOR_RGB2LAB)[0].astype(np.float32)
    return SurfaceSample(RADIUS_M * n, n, np.repeat(lab, 300, 0))


def moved(*by_m: float) -> np.ndarray:
    T = PLACE.copy()
    T[:3, 3] += by_m
    return T


def search(frame: Frame) -> ImageSearch:
    return ImageSearch(frame, CAMERA, preset().depth)


@pytest.mark.parametrize("by_m", [(0, 0, 0), (0.05, 0, 0), (-0.03, 0.04, 0.04), (0.06, 0.06, -0.05)])
def test_it_is_found_near_where_it_is_expected(by_m):
    found = search(ball_in_front_of_a_wall()).about(moved(*by_m), sample_of_the_ball())
    assert found.share > 0.9
    assert np.linalg.norm((found.T_cam_obj - PLACE)[:3, 3]) < 0.004
    on_it = np.linalg.norm(found.uv_px - CAMERA.project(PLACE[:3, 3]), axis=1)
    assert len(found.uv_px) > 95 and on_it.max() <= 1.05 * CAMERA.fx * RADIUS_M / 0.55


def test_what_is_alike_all_along_stays_where_it_is_expected():
    """A spotted rail goes on beyond the image: moved along itself, it shows about as much."""
    rail, end_m = ball_in_front_of_a_wall(centre=np.array([0.0, 0, -9.0])), 0.1
    end, half = round(CAMERA.project(np.array([end_m, 0, 0.6]))[0]), round(CAMERA.fy * 0.02 / 0.6)
    rail.depth_m[120 - half : 120 + half, :end], rail.rgb[120 - half : 120 + half, :end] = 0.6, BLUE
    rail.rgb[np.random.default_rng(0).random((240, 320)) < 0.2] = (150, 100, 90)
    along, across = np.linspace(-0.6, 0.02, 75), np.linspace(-0.018, 0.018, 4)
    p_obj = np.stack(np.meshgrid(along, across, [0.0]), -1).reshape(-1, 3)
    sample = replace(sample_of_the_ball(), p_obj=p_obj, n_obj=np.tile([0.0, 0, -1], (300, 1)))
    found = search(rail).about(moved(0, 0.01, 0), sample)
    assert found.share > 0.7 and abs((found.T_cam_obj - PLACE)[0, 3]) < 0.01


def test_exposure_may_have_changed_colour_not():
    sample = sample_of_the_ball()
    assert search(ball_in_front_of_a_wall(gain=0.5)).at(PLACE, sample).share > 0.9
    assert search(ball_in_front_of_a_wall((150, 100, 90))).at(PLACE, sample).share < 0.1


def test_black_is_not_a_white_of_another_exposure():
    """Where something black was lifted off a white table, the table has its shape and no colour, either."""
    assert search(ball_in_front_of_a_wall((20, 20, 20))).at(PLACE, sample_of_the_ball((40, 40, 40))).share > 0.9
    assert search(ball_in_front_of_a_wall((200, 200, 200))).at(PLACE, sample_of_the_ball((30, 30, 30))).share <= 0


def test_what_is_seen_through_is_not_there():
    """Free space contradicts a pose, which counts against it."""
    empty = ball_in_front_of_a_wall(centre=np.array([0.5, 0.0, 0.3]))
    assert search(empty).at(PLACE, sample_of_the_ball()).share < -0.5
    best = search(empty).about(PLACE, sample_of_the_ball())
    assert best is None or best.share < SIGHTED


def test_what_hides_it_says_little():
    """Half behind a board it is found by the other half; behind all of it there is nothing to say."""
    frame, sample = ball_in_front_of_a_wall(), sample_of_the_ball()
    depth = frame.depth_m.copy()
    depth[:, : round(CAMERA.project(PLACE[:3, 3])[0])] = 0.4
    assert SIGHTED < search(replace(frame, depth_m=depth)).at(PLACE, sample).share < 0.9
    assert search(replace(frame, depth_m=np.full_like(depth, 0.4))).at(PLACE, sample) is None


def card(thickness_m: float = 0.0) -> tuple[Frame, SurfaceSample]:
    """A card at 60 cm that faces the camera, and points on its front, and on its back if it has a thickness."""
    frame, half = ball_in_front_of_a_wall(centre=np.array([0.0, 0, -9.0])), round(CAMERA.fx * RADIUS_M / 0.6)
    on = np.s_[120 - half : 121 + half, 160 - half : 161 + half]
    frame.rgb[on], frame.depth_m[on] = BLUE, 0.6
    side = np.linspace(-RADIUS_M, RADIUS_M, 12)
    front, normal = np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3), np.tile([0.0, 0, -1], (144, 1))
    back = front + np.array([0, 0, thickness_m])
    p_obj, n_obj = np.concatenate([front, back]), np.concatenate([normal, -normal])
    faces = slice(None) if thickness_m else slice(144)
    return frame, SurfaceSample(p_obj[faces], n_obj[faces], sample_of_the_ball().lab[:288][faces])


def test_a_third_of_what_would_show_is_the_least():
    """Something flat faces the camera with all its points: a fourth of them is many, and little of it."""
    frame, sample = card()
    T_cam_obj = se3.from_rt(np.eye(3), np.array([0, 0, 0.6]))
    for hidden, known in ((0.6, True), (0.75, False)):
        depth_m = frame.depth_m.copy()
        depth_m[:, : round(160 + (2 * hidden - 1) * CAMERA.fx * RADIUS_M / 0.6)] = 0.4
        assert (search(replace(frame, depth_m=depth_m)).at(T_cam_obj, sample) is not None) == known


def test_what_faces_away_is_not_laid_on_what_is_seen():
    """The back of something thin is as near to what is measured as its front."""
    frame, sample = card(thickness_m=0.012)
    for off_m in (-0.006, 0.0, 0.006):
        found = search(frame).about(se3.from_rt(np.eye(3), np.array([0, 0, 0.6 + off_m])), sample)
        assert abs(found.T_cam_obj[2, 3] - 0.6) < 0.001


def test_outside_the_image_nothing_is_known():
    assert search(ball_in_front_of_a_wall()).about(moved(2.0, 0, 0), sample_of_the_ball()) is None


def plate() -> SurfaceSample:
    """A plain plate that faces the camera."""
    side = np.linspace(-RADIUS_M, RADIUS_M, 18)
    p = np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3)
    return replace(sample_of_the_ball(), p_obj=p[:300], n_obj=np.tile([0.0, 0, -1], (300, 1)))


@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_what_fits_anywhere_proves_nothing(gain):
    """A plain plate on a plain wall of its colour fits everywhere along it, in another light, too."""
    colour = (gain * np.array(BLUE)).astype(np.uint8)
    flat = Frame(0, 0.0, np.tile(colour, (240, 320, 1)), np.full((240, 320), 0.6, np.float32))
    assert search(flat).at(PLACE, plate()).share > 0.9
    assert search(flat).about(PLACE, plate()) is None


@pytest.mark.parametrize("alike", [(), ("right",), ("left",), ("right", "left")], ids=" and ".join)
def test_beside_it_is_where_nothing_of_it_is(alike):
    """Moved by half its length half of it lies on itself, and the rest on what is like it here and there.

    Something like it on one side is a neighbour; on both it may be anywhere along them.
    """
    half = round(CAMERA.fx * RADIUS_M / 0.6)
    spots = np.random.default_rng(0).random((240, 320, 1)) < 0.55
    rgb = np.where(spots, BLUE, (150, 100, 90)).astype(np.uint8)
    u, v = CAMERA.project(PLACE[:3, 3]).round().astype(int)
    from_px, to_px = u - half * (1 + 2 * ("left" in alike)), u + half * (1 + 2 * ("right" in alike))
    rgb[v - half : v + half + 1, from_px : to_px + 1] = BLUE
    spotted = Frame(0, 0.0, rgb, np.full((240, 320), 0.6, np.float32))
    found = search(spotted).about(PLACE, plate())
    assert (found is None) == (len(alike) == 2)
    assert alike or np.linalg.norm((found.T_cam_obj - PLACE)[:3, 3]) < 0.01


def sample_of(sdf) -> SurfaceSample:
    """Points of a black shape: of a cloud about it, the nearest on its surface, where its gradient is the normal."""
    p, h = np.random.default_rng(0).uniform(-0.07, 0.09, (3000, 3)), 1e-5
    for _ in range(30):
        gradient = np.stack([(sdf(p + h * e) - sdf(p - h * e)) / (2 * h) for e in np.eye(3)], -1)
        p = p - sdf(p)[:, None] * gradient
    on = np.abs(sdf(p)) < 1e-4
    return SurfaceSample(p[on][:300], gradient[on][:300], np.tile(np.float32([0, 128, 128]), (300, 1)))


def image_of(sdf, T_cam_obj) -> tuple[ImageSearch, np.ndarray]:
    """A shape's exact image in front of a wall, and its depth points."""
    depth_m, mask = analytic_scene.render(sdf, T_cam_obj)
    frame = Frame(0, 0.0, np.zeros((*depth_m.shape, 3), np.uint8), np.where(mask, depth_m, np.float32(WALL_M)))
    cloud = sample_cloud(frame.depth_m, mask, analytic_scene.CAMERA, 500)
    return ImageSearch(frame, analytic_scene.CAMERA, preset().depth), cloud


def test_a_view_known_before_is_found_wherever_it_is():
    """Nothing is known but the turns."""
    turns, shift = analytic_scene.around(8), se3.from_rt(np.eye(3), [0.03, -0.04, 0.05])
    for k in (1, 4):
        truth = shift @ turns[k] @ se3.exp(np.array([0.05, -0.08, np.radians(12), 0, 0, 0]))
        seen, cloud = image_of(analytic_scene.LUMP, truth)
        found = seen.turned(np.stack(turns), cloud, sample_of(analytic_scene.LUMP))
        error = se3.inverse(truth) @ found.T_cam_obj
        assert found.share > SIGHTED and np.degrees(se3.angle_rad(error)) < 8  # it started 13 off
        assert np.linalg.norm(error[:3, 3]) < 0.006


def test_another_turn_shows_as_much_where_a_shape_looks_alike():
    truth, back = analytic_scene.around(8)[1], analytic_scene.around(8)[5]
    for shape, alike in ((analytic_scene.box((0, 0, 0), (0.03, 0.02, 0.045)), True), (analytic_scene.LUMP, False)):
        seen, cloud = image_of(shape, truth)
        other = seen.otherwise(truth, np.stack([truth, back]), cloud, sample_of(shape))
        assert (other.share > 0.9 * seen.at(truth, sample_of(shape)).share) == alike
        assert np.degrees(se3.angle_rad(se3.inverse(truth) @ other.T_cam_obj)) > 150
    assert seen.otherwise(truth, truth[None], cloud, sample_of(shape)) is None


def test_of_one_colour_with_the_wall_only_the_ball_is_tried():
    looked, sample = search(ball_in_front_of_a_wall(GREY)), sample_of_the_ball(GREY)
    places = looked.places(np.ones((CAMERA.height, CAMERA.width), bool), sample, np.random.default_rng(0))
    assert len(places) > 10 and (places[:, 2] < 0.7).all()
    found = looked.among(centred_at_points(PLACE[None], places, sample), sample)
    assert found and all(np.linalg.norm(one.T_cam_obj[:3, 3] - PLACE[:3, 3]) < 0.005 for one in found)


def test_of_many_places_those_that_differ_are_looked_at():
    """Most of what is proposed lies on one of two balls that look alike: the other is found as well."""
    near, beside = ball_in_front_of_a_wall(), moved(0.15, 0.02, 0.05)
    other = ball_in_front_of_a_wall(centre=beside[:3, 3])
    shows = other.depth_m < WALL_M
    both = replace(
        near, rgb=np.where(shows[..., None], other.rgb, near.rgb), depth_m=np.where(shows, other.depth_m, near.depth_m)
    )
    many = [moved(*by_m) for by_m in np.random.default_rng(0).normal(scale=0.001, size=(40, 3))]
    aside = beside.copy()
    aside[:3, 3] += [0.015, 0, 0]
    found = [
        sighting.T_cam_obj[:3, 3] for sighting in search(both).among(np.stack([*many, aside]), sample_of_the_ball())
    ]
    for centre in (PLACE[:3, 3], beside[:3, 3]):
        assert np.linalg.norm(found - centre, axis=1).min() < 0.005


@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_a_dark_thing_on_a_light_table_is_found_where_it_lies(hidden):
    """In the light of a sunny day all of the table beside it would have its colour; and there nothing hides it."""
    dark, light = (66, 66, 66), (150, 150, 150)
    along, across = np.linspace(-RADIUS_M, RADIUS_M, 30), np.linspace(-RADIUS_M / 5, RADIUS_M / 5, 10)
    p_obj = np.stack(np.meshgrid(along, across, [0.0]), -1).reshape(-1, 3)
    sample = replace(sample_of_the_ball(dark), p_obj=p_obj, n_obj=np.tile([0.0, 0, -1], (300, 1)))
    rgb, depth_m = np.full((240, 320, 3), light, np.uint8), np.full((240, 320), 0.6, np.float32)
    (left, top), (right, bottom) = (
        CAMERA.project(PLACE[:3, 3] + at).round().astype(int) for at in (p_obj[0], p_obj[-1])
    )
    rgb[top : bottom + 1, left : right + 1] = dark
    covered = np.s_[top - 5 : bottom + 5, left : round(left + hidden * (right - left))]
    rgb[covered], depth_m[covered] = (150, 100, 90), 0.5
    found = search(Frame(0, 0.0, rgb, depth_m)).about(PLACE, sample)
    assert found is not None and np.linalg.norm((found.T_cam_obj - PLACE)[:3, 3]) < 0.012
