"""``cluttered_desk`` and ``thin_tools``: what touches, what leaves and returns, what is seen edge-on; shadows."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.synthetic import SCENARIOS, generate, shapes
from p2p_lib.synthetic.noise import PERFECT
from p2p_lib.synthetic.render import Light
from p2p_lib.synthetic.shadows import darkness

SMALL = Camera(525 / 8, 525 / 8, 39.5, 29.5, 80, 60)


@pytest.mark.parametrize("seed", range(2))
def test_things_touch_and_do_not_overlap(seed):
    from scipy.spatial import Delaunay, cKDTree

    scenario = SCENARIOS["cluttered_desk"](seed)
    things = [b for b in scenario.bodies if not b.name.startswith("pen")]
    assert len(things) == 12 and sum(b.labelled for b in scenario.bodies) == 3
    points = [se3.transform(b.T_world_model[0], b.mesh.sample(6000, np.random.default_rng(0))[0]) for b in things]
    for p in points:
        assert p[:, 2].min() == pytest.approx(0, abs=0.002)
    gap = np.full((12, 12), np.inf)
    for i, j in zip(*np.triu_indices(12, 1), strict=True):
        gap[i, j] = gap[j, i] = cKDTree(points[i]).query(points[j])[0].min()
    assert np.sum(gap.min(1) < 0.008) >= 9
    for i, j in zip(*np.triu_indices(12, 1), strict=True):
        inside = [p[(p[:, 2] > 0.003) & (p[:, 2] < 0.01), :2] for p in (points[i], points[j])]
        hull = inside[0][:: max(1, len(inside[0]) // 200)]
        assert (Delaunay(hull).find_simplex(inside[1]) >= 0).mean() < 0.02 or "mug" in (things[i].name + things[j].name)


@pytest.mark.parametrize("seed", range(2))
def test_the_camera_is_fast_and_things_leave_and_return(seed):
    scenario = replace(SCENARIOS["cluttered_desk"](seed), camera=SMALL)
    T = scenario.T_world_cam
    deg = np.degrees(se3.angle_rad(se3.inverse(T[:-1]) @ T[1:]))
    assert 1.5 < np.median(deg) < 3.5 and 3.5 < np.percentile(deg, 95) < 6 and deg.max() < 7.5
    labelled = [k for k, b in enumerate(scenario.bodies, 1) if b.labelled]
    seen = [[np.count_nonzero(scenario.rendered(t).label == k) for k in labelled] for t in range(0, scenario.frames, 3)]
    there = np.array(seen) > 4  # 256 pixels of the whole image
    assert there[0].all()
    returns = (~there[:-1] & there[1:]).sum()
    assert returns >= 3 and 0.5 < there.mean() < 0.97


def test_labels_say_when_a_thing_is_in_the_image(tmp_path):
    whole = SCENARIOS["cluttered_desk"](0)
    some = np.arange(0, 210, 15)
    bodies = tuple(replace(b, T_world_model=b.T_world_model[some]) for b in whole.bodies)
    scenario = replace(whole, camera=SMALL, T_world_cam=whole.T_world_cam[some], bodies=bodies)
    generate.write_scenario(tmp_path / "s", scenario, PERFECT, 0)
    sequence = open_sequence(tmp_path / "s")
    for name, k in (("keyboard", 1), ("carton", 2), ("mug", 3)):
        px = np.array([np.count_nonzero(scenario.rendered(i).label == k) for i in range(len(some))])
        np.testing.assert_array_equal([sequence.masks(i)[name].sum() for i in range(len(some))], px)
        np.testing.assert_array_equal(sequence.truth[name].labelled, px > 0)
        T = se3.inverse(scenario.T_world_cam) @ scenario.bodies[k - 1].T_world_model
        np.testing.assert_allclose(sequence.truth[name].T_cam_model, T, atol=1e-6)


@pytest.mark.parametrize("tool", ["spatula", "wrench", "scissors"])
@pytest.mark.parametrize("seed", range(3))
def test_tools_show_both_sides_and_edges_and_keep_clear(tool, seed):
    scenario = SCENARIOS[f"thin_{tool}"](seed)
    thing, can = scenario.bodies
    spread = thing.mesh.vertices - thing.mesh.vertices.mean(0)
    thin = np.linalg.svd(spread, full_matrices=False)[2][2]
    normal = thing.T_world_model[:, :3, :3] @ thin
    middle = se3.transform(thing.T_world_model, thing.mesh.ball[0][None])[:, 0]
    sight = middle - scenario.T_world_cam[:, :3, 3]
    cosine = np.einsum("tc,tc->t", normal, sight) / np.linalg.norm(sight, axis=1)
    assert cosine.max() > 0.6 and cosine.min() < -0.6 and np.abs(cosine[0]) > 0.6
    assert (np.abs(cosine) < 0.15).sum() >= 6
    surface = thing.mesh.vertices[::5]
    for t in range(0, scenario.frames, 6):
        p = se3.transform(se3.inverse(can.T_world_model[t]) @ thing.T_world_model[t], surface)
        radius = np.hypot(*(p - can.mesh.ball[0])[:, :2].T)
        tall = np.ptp(can.mesh.vertices[:, 2]) / 2
        assert not ((radius < 0.045) & (np.abs((p - can.mesh.ball[0])[:, 2]) < tall)).any()


def test_ycb_tools(shared_data):
    models = str(shared_data / "ycb_models")
    scenario = SCENARIOS["thin_tools"](1, frames=20, models=models)
    assert [b.name for b in scenario.bodies] == ["042_adjustable_wrench", "002_master_chef_can"]
    with pytest.raises(BadInput, match=r"thin_tools tool.*spatula"):
        SCENARIOS["thin_tools"](0, tool="spoon")


def test_shadows_lie_where_the_lamp_is_covered():
    slab = shapes.slab(np.random.default_rng(0), (0.2, 0.2, 0.01))
    T = se3.from_rt(np.eye(3), np.array([0, 0, 0.1]))
    light = Light(towards=(0.5, 0, 1.0), shadow=0.6)
    x = np.array([-0.3, -0.05, 0.0, 0.09, 0.3])
    points = np.stack([x, 0 * x, 0 * x], 1)
    dark = darkness(points, [(slab, T)], light)
    # A ray from x meets the slab at x + 0.05, up to 0.014 further for the lamp's disc.
    np.testing.assert_allclose(dark[[0, 4]], 0)
    np.testing.assert_allclose(dark[[1, 2]], 0.6)
    assert 0 <= dark[3] < 0.6
    np.testing.assert_allclose(darkness(points, [], light), 0)


def test_joined_meshes_keep_their_surfaces_and_pictures():
    rng = np.random.default_rng(1)
    a, b = shapes.box(rng, (0.05, 0.06, 0.07)), shapes.can(rng, 0.03, 0.08)
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0, 0.05]))
    both = shapes.joined([(a, np.eye(4)), (b, T)])
    np.testing.assert_allclose(both.vertices[both.faces[len(a.faces) :]], se3.transform(T, b.vertices)[b.faces])
    H, W = both.texture.shape[:2]
    for mesh, faces in ((a, slice(0, len(a.faces))), (b, slice(len(a.faces), None))):
        h, w = mesh.texture.shape[:2]
        for face in (0, 7, -3):
            x, y = (both.uv[faces][face] * [W, H]).mean(0)
            u, v = (mesh.uv[face] * [w, h]).mean(0)
            np.testing.assert_array_equal(both.texture[int(H - y), int(x)], mesh.texture[int(h - v), int(u)])
