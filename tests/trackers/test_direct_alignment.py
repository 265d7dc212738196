"""Direct alignment: the motion of a surface by all of its colours and its depth, on a ball that is drawn exactly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin.direct_alignment import Patch, Surface, overruling
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from tests.trackers.made_up import CAMERA, SHAPE

RADIUS_M, START = 0.05, se3.from_rt(np.eye(3), [0.01, -0.02, 0.5])
CFG = TrackingConfig()
SHINE = np.array([[-0.35, -0.45], [0.15, 0.2], [0.4, -0.15], [-0.2, 0.35]])  # places on the ball as the camera sees it


def ball(T_cam_ball: np.ndarray, shine: float = 0.0, colour: float = 60.0, grey: float = 0.0, seed: int = 0) -> Frame:
    """A textured ball over a grey ground. ``shine``: white spots that stay where they are while it turns."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    centre = T_cam_ball[:3, 3]
    a, b = (rays**2).sum(-1), rays @ centre
    under_root = b**2 - a * (centre @ centre - RADIUS_M**2)
    hit = under_root > 0
    z = np.where(hit, (b - np.sqrt(np.maximum(under_root, 0))) / a, 0.8)
    seen = (rays * z[..., None] - centre) / RADIUS_M
    of_ball = seen @ T_cam_ball[:3, :3]
    waves, phases = rng.normal(0, 4, (3, 3, 6)), rng.uniform(0, 6, (3, 6))
    own = np.stack([np.sin(of_ball @ waves[c] + phases[c]).sum(-1) for c in range(3)], -1) * colour / 3 + 100
    own += grey * np.sin(of_ball @ rng.normal(0, 12, 3))[..., None]
    spots = sum(np.exp(-((seen[..., :2] - at) ** 2).sum(-1) / (2 * 0.07**2)) for at in SHINE)
    rgb = np.where(hit[..., None], own + shine * spots[..., None], 70)
    rgb += rng.normal(0, 1, rgb.shape)
    depth_m = np.where(hit, z + rng.normal(0, 0.0005, z.shape), 0).astype(np.float32)
    return Frame(0, 0.0, np.clip(rgb, 0, 255).astype(np.uint8), depth_m)


def turned(degrees: float, about=(0.3, 1.0, 0.2), moved_m=(0, 0, 0)) -> np.ndarray:
    """The ball's pose after a turn about its own centre, and its motion in the camera's frame."""
    axis = np.asarray(about) / np.linalg.norm(about)
    R = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    T = se3.from_rt(R @ START[:3, :3], START[:3, 3] + moved_m)
    return T, T @ se3.inverse(START)


def patch(frame: Frame) -> Patch:
    return Patch.of(Image.of(frame, CAMERA), np.array([0, 0]), np.array([160, 120]))


def surface(frame: Frame) -> Surface:
    there = patch(frame)
    return there.surface(there.depth_m > 0)


def apart_deg(T_a: np.ndarray, T_b: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(T_a[:3, :3] @ T_b[:3, :3].T).magnitude()))


def test_points_and_normals_are_those_of_the_ball():
    shown = surface(ball(START))
    from_centre = shown.p_cam - START[:3, 3]
    inner = np.linalg.norm(from_centre[:, :2], axis=1) < 0.7 * RADIUS_M
    assert inner.sum() > 150
    assert np.abs(np.linalg.norm(from_centre, axis=1) - RADIUS_M)[inner].max() < 0.002
    cosine = (shown.normals * from_centre / RADIUS_M).sum(1)[inner]
    assert (
        np.median(cosine) > 0.985
        and (shown.normals[inner] * from_centre[inner]).sum() > 0.998 * np.linalg.norm(from_centre[inner], axis=1).sum()
    )


def plane(step_m: float = 0.0) -> Frame:
    """All of one colour, at half a metre; its right half nearer by a step."""
    depth_m = np.full(SHAPE, 0.5, np.float32)
    depth_m[:, 160:] -= step_m
    return Frame(0, 0.0, np.full((*SHAPE, 3), [150, 90, 60], np.uint8), depth_m)


def test_normals_beside_a_step_are_of_its_own_side():
    shown = surface(plane(step_m=0.05))
    np.testing.assert_allclose(shown.normals, np.tile([0, 0, -1.0], (len(shown.normals), 1)), atol=1e-3)


def test_what_nothing_tells_does_not_move():
    there = se3.from_rt(np.eye(3), [0, 0, 0.002])
    found = patch(plane()).aligned(surface(plane()), there)
    assert np.abs(found - np.eye(4)).max() < 2e-4, "back onto the plane, and neither along it nor about its normal"


def test_costs_are_those_of_their_definition():
    _, motion = turned(7)
    shown, now = surface(ball(START)), patch(ball(turned(5)[0]))
    fx, fy, cx, cy = now.intrinsics
    p, n = se3.transform(motion, shown.p_cam), shown.normals @ motion[:3, :3].T
    u, v = fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy
    off = now.depth_m[(v + 0.5).astype(int), (u + 0.5).astype(int)] - p[:, 2]
    measured = off + p[:, 2] > 0
    shows = measured & (off > -0.02) & ((n * p).sum(1) < -0.25 * np.linalg.norm(p, axis=1))
    x, y, a, b = u.astype(int), v.astype(int), (u % 1)[:, None], (v % 1)[:, None]
    image = now.colours[1].astype(float)
    here = (image[y, x] * (1 - a) + image[y, x + 1] * a) * (1 - b) + (
        image[y + 1, x] * (1 - a) + image[y + 1, x + 1] * a
    ) * b
    colour = ((here - shown.colours[1]) ** 2).sum(1)
    wanted = (np.minimum(colour, 1) + np.minimum((off / 0.006) ** 2, 1))[shows].mean()
    np.testing.assert_allclose(now.costs(shown, motion[None]), [wanted], rtol=1e-5)


def test_colours_tell_a_place_across_an_edge_alone():
    """Of stripes, where along them a point is stays unknown, as it does where all is of one colour."""
    frame = ball(START)
    u = np.arange(SHAPE[1])
    frame.rgb[:] = np.where((u // 12 % 2)[None, :, None], [200, 90, 60], [60, 90, 200])
    of_stripes = surface(frame).cov_px2
    frame.rgb[:] = [200, 90, 60]
    of_nothing = surface(frame).cov_px2
    across, along = np.sqrt(np.median(of_stripes[:, 0, 0])), np.sqrt(np.median(of_stripes[:, 1, 1]))
    assert across < 2 < 6 < along
    assert np.sqrt(of_nothing[:, [0, 1], [0, 1]]).min() > 6


def test_depth_of_far_things_may_be_off_by_more():
    near, far = (surface(replace(ball(START), depth_m=ball(START).depth_m * times)) for times in (1, 5))
    assert (near.depth_m == 0.006).all() and (far.depth_m > 0.012).all()


def test_where_little_shows_nothing_is_judged():
    _, behind = turned(120)
    shown, now = surface(ball(START)), patch(ball(START))
    assert now.costs(shown, np.eye(4)[None])[0] < 0.1 and now.costs(shown, behind[None])[0] == 2


@pytest.mark.parametrize("degrees", [2, 6, 10])
def test_a_motion_near_by_is_found_exactly(degrees):
    T, motion = turned(degrees, moved_m=(0.002, -0.001, 0.003))
    found = patch(ball(T, seed=0)).aligned(surface(ball(START)), np.eye(4))
    assert apart_deg(found, motion) < 0.8
    middle = START[:3, 3]
    assert np.linalg.norm(se3.transform(found, middle) - se3.transform(motion, middle)) < 0.001


@pytest.mark.parametrize("about", [(0, 1, 0), (1, 0, 0), (0, 0, 1), (1, 1, 1)])
def test_a_far_turn_is_searched_for(about):
    T, motion = turned(34, about)
    now, shown = patch(ball(T)), surface(ball(START))
    assert apart_deg(now.searched(shown, np.eye(4)[None]), motion) < 1.5


def test_reflections_do_not_hold_it_back():
    """They are white: without the least of the channels they are gone, brightness alone would stand still."""
    T, motion = turned(8)
    shine = {"shine": 110.0, "colour": 25.0}
    shown, now = surface(ball(START, **shine)), patch(ball(T, **shine))
    assert apart_deg(now.aligned(shown, np.eye(4)), motion) < 1
    still, true = now.costs(shown, np.stack([np.eye(4), motion]))
    assert true < 0.6 * still


def test_grey_things_are_aligned_by_their_brightness():
    T, motion = turned(5)
    grey = {"colour": 0.0, "grey": 60.0}
    assert apart_deg(patch(ball(T, **grey)).aligned(surface(ball(START, **grey)), np.eye(4)), motion) < 1.5


def test_what_is_before_it_does_not_count():
    """A hand 5 cm before it over two fifths, of another colour."""
    T, motion = turned(8)
    frame = ball(T)
    frame.depth_m[:, 160:] -= np.where(frame.depth_m[:, 160:] > 0, 0.05, 0).astype(np.float32)
    frame.rgb[:, 160:] = [200, 150, 120]
    assert patch(frame).costs(surface(ball(START)), motion[None])[0] < 0.45, "of what shows"
    assert apart_deg(patch(frame).aligned(surface(ball(START)), np.eye(4)), motion) < 1


def judged(
    T: np.ndarray, known: list, far: bool = True, share: float = CFG.overruled_below, **look
) -> np.ndarray | None:
    return overruling(surface(ball(START, **look)), patch(ball(T, **look)), known, np.eye(4), share, far)


def test_points_are_overruled_where_the_surface_says_otherwise_alone():
    T, motion = turned(9)
    assert apart_deg(judged(T, [np.eye(4)]), motion) < 0.6  # they stand still
    assert apart_deg(judged(T, [], far=True), motion) < 0.6  # there are none
    assert judged(T, [motion]) is None  # they are right
    assert judged(T, [np.eye(4), motion]) is None  # one of two is
    assert judged(T, [np.eye(4)], share=0.0) is None


def test_they_are_not_where_nothing_tells():
    T, _ = turned(9)
    assert judged(T, [np.eye(4)], colour=0.0) is None


def test_a_small_difference_is_left_to_points():
    T, _ = turned(0.6)
    assert judged(T, [np.eye(4)]) is None


def test_what_is_far_is_searched_where_it_may_be():
    T, motion = turned(34)
    assert apart_deg(judged(T, [np.eye(4)]), motion) < 1.5


def test_few_points_of_a_surface_say_nothing():
    T, _ = turned(9)
    shown = surface(ball(START))
    few = shown.select(np.arange(40))
    assert overruling(few, patch(ball(T)), [np.eye(4)], np.eye(4), 0.9, True) is None


def shifted(m: float) -> np.ndarray:
    return se3.from_rt(np.eye(3), [m, 0, 0])


class Told:
    """A patch that says at what cost a known motion, one near it and the best far one fit."""

    def __init__(self, known: float, near: float, best: float):
        self.fits, self.asked = {0.0: known, 0.01: near, 0.05: best}, False

    def costs(self, surface, motions, level=1):
        return np.array([self.fits[round(float(T[0, 3]), 3)] for T in motions])

    def aligned(self, surface, motion, level=1):
        return shifted(0.01)

    def searched(self, surface, starts):
        self.asked = True
        return shifted(0.05)


@pytest.mark.parametrize(
    ("fits", "far", "known", "taken_m"),
    [
        ((0.5, 0.5, 0.2), False, True, None),  # points were followed, and nothing near is better
        ((0.5, 0.5, 0.2), True, True, 0.05),  # few were
        ((0.5, 0.3, 0.2), False, True, 0.05),  # something near is: they are wrong, so that there may be better yet
        ((0.5, 0.3, 0.28), True, True, 0.01),  # hardly better: the nearer one is the likelier
        ((0.1, 0.085, 0.01), False, True, None),  # nine tenths, but of little
        ((0.1, 0.1, 0.01), True, True, None),  # good enough to look no farther
        ((2.0, 1.2, 1.1), True, True, None),  # better than what is all wrong
        ((2.0, 1.2, 0.95), True, False, None),  # nothing is known, and nothing is like it
        ((2.0, 1.2, 0.85), True, False, 0.05),
    ],
)
def test_what_counts_is_clearly_better_and_good(fits, far, known, taken_m):
    shown = surface(ball(START))
    motion = overruling(shown, Told(*fits), [np.eye(4)] if known else [], np.eye(4), 0.9, far)
    assert (None if motion is None else round(float(motion[0, 3]), 3)) == taken_m


@pytest.mark.parametrize(("share", "followed"), [(CFG.overruled_below, True), (0.0, False)])
def test_a_ball_whose_reflections_stand_still_is_followed_as_it_turns(share, followed):
    """Its points are on the spots; they agree with each other that nothing moves. Without the surface they win."""
    look = {"shine": 140.0, "colour": 14.0}
    cfg = replace(CFG, overruled_below=share)
    tracker = BuiltinTracker(cfg)
    tracker.start(ball(START, **look), CAMERA)
    on_spots = np.concatenate(
        [at + RADIUS_M * np.array([[0, 0], [0.06, 0], [0, 0.06], [-0.06, 0]]) / RADIUS_M for at in SHINE]
    )
    p = START[:3, 3] + RADIUS_M * np.column_stack([on_spots, -np.sqrt(1 - (on_spots**2).sum(1))])
    tracker.add(CAMERA.project(p))
    for k in range(1, 7):
        T, motion = turned(3.0 * k)
        tracker.track(ball(T, **look))
    (segment, *_) = tracker._segments.segments
    assert (apart_deg(segment.fit.T_cam_seg, motion) < 6) == followed


def test_errors_of_alignments_do_not_add_up(monkeypatch):
    """Points whose motion agrees count by their places, also where the frame before was overruled."""
    look = {"colour": 60.0}
    tracker = BuiltinTracker(CFG)
    tracker.start(ball(START, **look), CAMERA)
    uv = CAMERA.project(surface(ball(START, **look)).p_cam[::8])
    tracker.add(uv)
    drift = se3.from_rt(Rotation.from_euler("y", 3, degrees=True).as_matrix(), np.zeros(3))
    about = se3.from_rt(np.eye(3), START[:3, 3])
    wrong = about @ drift @ se3.inverse(about)
    calls = []

    def once(surface, now, known, *rest):
        calls.append(known)
        return wrong if len(calls) == 1 else overruling(surface, now, known, *rest)

    monkeypatch.setattr("p2p_lib.trackers.builtin.motion_segments.overruling", once)
    for _ in range(3):
        tracker.track(ball(START, **look))
    assert apart_deg(calls[1][-1], np.eye(4)) < 1.5  # from frame to frame they stood still
    (segment, *_) = tracker._segments.segments
    assert apart_deg(segment.fit.T_cam_seg, np.eye(4)) < 1
