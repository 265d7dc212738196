"""The scenarios that are hard without one component: each has, for every seed, what makes it so."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic import SCENARIOS, generate
from p2p_lib.synthetic.noise import Sensor
from p2p_lib.synthetic.render import render

SEEDS = (1, 2, 3)


def turn_deg(R_a, R_b):
    return np.degrees(np.arccos(np.clip((np.einsum("...ij,...ij->...", R_a, R_b) - 1) / 2, -1, 1)))


@cache
def made(name, seed, **parameters):
    return SCENARIOS[name](seed, **parameters)


def T_cam_model(scenario):
    (body,) = scenario.bodies
    return se3.inverse(scenario.T_world_cam) @ body.T_world_model


def photographs(scenario, seed, frames):
    room = render([], scenario.camera, scenario.T_world_cam[0])  # only the object matters here
    return [generate.photograph(scenario, Sensor(), seed, t, room) for t in frames]


def in_view(scenario):
    """Largest distance of any vertex outside the picture, in pixels; negative = all inside by so much."""
    uv = scenario.camera.project(se3.transform(T_cam_model(scenario)[::5], scenario.bodies[0].mesh.vertices))
    return np.max([-uv, uv - [scenario.camera.width - 1, scenario.camera.height - 1]])


@pytest.mark.parametrize("name", ["mug", "weak_texture", "fading_label", "long_turning"])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_object_stays_in_view_and_moves_like_a_hand(name, seed):
    scenario = made(name, seed)
    T = T_cam_model(scenario)
    assert in_view(scenario) < 0
    assert T[:, 2, 3].min() > 0.3  # nearer than a D435 measures
    assert turn_deg(T[1:, :3, :3], T[:-1, :3, :3]).max() < 3
    assert np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).max() < 0.008
    other = T_cam_model(made(name, seed + 10))
    assert turn_deg(T[:, :3, :3], other[:, :3, :3]).max() > 10  # a seed is another path


def corners(gray, mask, n=30):
    """The n strongest SIFT points at least 8 px apart."""
    kept = []
    for k in sorted(cv2.SIFT_create(600, contrastThreshold=0.02).detect(gray, mask), key=lambda k: -k.response):
        if len(kept) < n and all(np.hypot(k.pt[0] - u, k.pt[1] - v) > 8 for u, v in kept):
            kept.append(k.pt)
    return np.array(kept, np.float32)


def claims(seed, t, k=5, **overrides):
    """Of the mug's strong points after k frames: how many stayed where the body is, how many turned with it."""
    scenario = made("mug", seed, **overrides)
    shots = photographs(scenario, seed, range(t, t + k + 1))
    gray = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb, _, _ in shots]
    exact = shots[0][2]
    start = corners(gray[0], cv2.erode((exact.label > 0).astype(np.uint8), np.ones((5, 5))))
    at = start
    for before, after in pairwise(gray):
        at, _, _ = cv2.calcOpticalFlowPyrLK(before, after, at, None, winSize=(11, 11), maxLevel=3)
    u, v = start.round().astype(int).T
    T = T_cam_model(scenario)
    p_model = se3.transform(se3.inverse(T[t]), scenario.camera.unproject(start, exact.depth_m[v, u]))
    moved = se3.inverse(T[t]) @ T[t + k]
    unturned = se3.exp(np.array([0, 0, np.arctan2(moved[0, 1], moved[0, 0]), 0, 0, 0]))
    turned, stayed = (scenario.camera.project(se3.transform(M, p_model)) for M in (T[t + k], T[t + k] @ unturned))
    tells = np.linalg.norm(turned - stayed, axis=1) > 3
    with_it, without = (np.linalg.norm(at - x, axis=1) for x in (turned, stayed))
    return np.sum(tells & (without < np.minimum(with_it, 2))), np.sum(tells & (with_it < np.minimum(without, 2)))


@pytest.mark.parametrize("seed", SEEDS[:1])
def test_the_mugs_body_denies_that_it_turns_and_its_handle_tells(seed):
    yaw = np.unwrap(np.arctan2(*made("mug", seed).bodies[0].T_world_model[:, 1::-1, 0].T))
    fastest = [int(t) for t in np.argsort(-np.abs(yaw[5:] - yaw[:-5]))[:100:20]]
    denied, told = np.sum([claims(seed, t) for t in fastest], 0)
    assert denied >= 3 * len(fastest) and told >= 5 * len(fastest), (denied, told)
    # It is the reflection that denies it: a matt mug's points turn.
    matt = np.sum([claims(seed, t, reflectance=0.0) for t in fastest[:2]], 0)
    assert matt[0] / matt.sum() < min(0.2, 0.6 * denied / (denied + told)), (matt, denied, told)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_handle_shows_in_every_frame_and_the_mug_turns(seed):
    scenario = made("mug", seed)
    R = T_cam_model(scenario)[:, :3, :3]
    assert max(turn_deg(R[0], R).max(), turn_deg(R[60], R).max()) > 90
    # The handle is along +x of the mug: never away from the camera by more than sideways and a little.
    assert R[:, 2, 0].max() < 0.55


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_weak_texture_has_few_points_and_a_shape_that_tells_all(seed):
    scenario, full = made("weak_texture", seed), made("weak_texture", seed, contrast=1.0)
    for t in range(0, scenario.frames, 60):
        found = []
        for s in (scenario, full):
            ((rgb, _, exact),) = photographs(s, seed, [t])
            mask = cv2.erode((exact.label > 0).astype(np.uint8), np.ones((9, 9)))
            found.append(len(corners(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), mask, 200)))
        assert found[0] < 0.5 * found[1]
    # Visible normals and the moments of the visible points hold all six directions.
    p, n = scenario.bodies[0].mesh.sample(2000, np.random.default_rng(0))
    held = []
    for T in T_cam_model(scenario)[::5]:
        p_cam, n_cam = se3.transform(T, p), n @ T[:3, :3].T
        seen = np.einsum("nc,nc->n", p_cam, n_cam) < 0
        lever = np.cross(p_cam[seen] - p_cam[seen].mean(0), n_cam[seen]) / 0.05
        J = np.concatenate([lever, n_cam[seen]], 1)
        held.append(np.linalg.eigvalsh(J.T @ J / seen.sum())[0])
    assert np.mean(np.array(held) > 0.003) > 0.95, np.round(held, 4)


@pytest.mark.parametrize("seed", SEEDS[:1])
def test_fading_labels_differ_in_their_print_alone(seed):
    full, faint, blank = (made("fading_label", seed, contrast=c) for c in (1.0, 0.1, 0.0))
    bodies = [s.bodies[0] for s in (full, faint, blank)]
    for body in bodies[1:]:
        np.testing.assert_array_equal(body.T_world_model, bodies[0].T_world_model)
        np.testing.assert_array_equal(body.mesh.vertices, bodies[0].mesh.vertices)
        np.testing.assert_array_equal(body.mesh.uv, bodies[0].mesh.uv)
    shots = [photographs(s, seed, [7])[0] for s in (full, faint, blank)]
    for rgb, depth_m, exact in shots[1:]:
        np.testing.assert_array_equal(depth_m, shots[0][1])  # the noise, too
        np.testing.assert_array_equal(exact.label, shots[0][2].label)
        assert (rgb != shots[0][0]).any()
    # What is printed fades in proportion, towards one ground per panel and lid: four panels around, two lids.
    printed = [body.mesh.texture.astype(float) for body in bodies]
    off = np.abs(printed[1] - printed[2] - 0.1 * (printed[0] - printed[2]))
    assert np.mean(off > 2) < 1e-4  # rounding, and where smooth edges are drawn over each other
    assert len(np.unique(bodies[2].mesh.texture.reshape(-1, 3), axis=0)) <= 6


def test_the_block_is_closed_flat_and_unlike_itself():
    import trimesh

    for seed in SEEDS:
        mesh = made("weak_texture", seed).bodies[0].mesh
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert solid.is_watertight and solid.is_convex and solid.volume > 2e-4
        assert len(solid.facets) + np.isin(np.arange(12), np.concatenate(solid.facets), invert=True).sum() == 7
        assert (
            np.abs(solid.principal_inertia_components / solid.principal_inertia_components[[1, 2, 0]] - 1).min() > 0.02
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_long_turning_turns_several_times_and_comes_back(seed):
    T = T_cam_model(made("long_turning", seed))
    R = T[:, :3, :3]
    steps = se3.log(se3.inverse(T[:-1]) @ T[1:])[:, :3]
    assert np.degrees(np.linalg.norm(steps, axis=1)).sum() > 3 * 360
    spread = np.linalg.eigvalsh(np.cov((steps / np.linalg.norm(steps, axis=1, keepdims=True)).T))
    assert spread[1] > 0.02  # about no one axis: it sways by 8 degrees and more
    between = turn_deg(R[:, None], R[None])
    before = np.tril(np.ones((len(R), len(R)), bool), -150)
    back = np.where(before, between, 180)[300:].min(1)
    assert np.mean(back < 20) > 0.25  # of the second half: views of 5 s before and more
    assert between.max() > 170


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("mug", {"reflectance": 1.5}, "reflectance 1.5"),
        ("weak_texture", {"contrast": -0.1}, "contrast -0.1"),
        ("fading_label", {"contrast": 1.1}, "contrast 1.1"),
        ("long_turning", {"frames": 100}, "frames 100"),
    ],
)
def test_bad_parameters_are_named(name, overrides, message):
    with pytest.raises(BadInput, match=message):
        SCENARIOS[name](0, **overrides)


def test_plain_shapes_have_no_print_and_one_two_or_all_turns_that_fit():
    from scipy.spatial import cKDTree

    scenario = made("plain", 1)
    assert all(np.ptp(body.mesh.texture.reshape(-1, 3), axis=0).max() == 0 for body in scenario.bodies)
    off_mm = {}
    for body in scenario.bodies:
        points, _ = body.mesh.sample(20000, np.random.default_rng(0))
        turns = se3.exp(np.radians(np.arange(20, 360, 20))[:, None] * np.array([0, 0, 1.0, 0, 0, 0]))
        tree = cKDTree(points)
        distance_m = np.stack([tree.query(se3.transform(T, points))[0] for T in turns])
        off_mm[body.name] = 1e3 * distance_m.mean(1).min(), 1e3 * distance_m.max(1).min()
    mean, largest = zip(*(off_mm[name] for name in ("block", "mug", "tin")), strict=True)
    assert mean[0] > 2.5 and mean[1] < 2.5 and mean[2] < 1.2  # the points are 1 mm apart
    assert largest[1] > 20 and largest[2] < 4  # but for the handle
    T_cam_world = se3.inverse(scenario.T_world_cam[0])
    for body in scenario.bodies:
        uv = scenario.camera.project(se3.transform(T_cam_world @ body.T_world_model[::10], body.mesh.vertices))
        assert scenario.camera.inside(uv).all(), body.name


def test_of_eight_objects_none_hides_another():
    scenario = made("eight_objects", 1)
    room = render([], scenario.camera, scenario.T_world_cam[0])
    assert len(scenario.bodies) == 8
    for t in (0, 45, 89):
        together = np.bincount(scenario.rendered(t, room).label.ravel(), minlength=9)[1:]
        alone = [replace(scenario, bodies=(body,)).rendered(t, room).label.sum() for body in scenario.bodies]
        assert min(together) > 1000 and (together > 0.9 * np.array(alone)).all(), t
