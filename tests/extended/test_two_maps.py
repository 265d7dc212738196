"""Two maps of one object that become one, part by part: against one that was made in one frame from the start."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.extended.gates import Judgement
from p2p_lib.extended.graph import BoundedGraph
from p2p_lib.extended.lifecycle import Lifecycle
from p2p_lib.extended.policy import Proposal
from p2p_lib.extended.two_maps import Relation, TwoMaps
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.registration import Hypothesis
from tests.method.analytic_scene import LUMP, around
from tests.method.test_factor_graph import ALL, Turntable
from tests.method.test_tsdf import fused

T_FIRST_SECOND = se3.exp(np.array([0.4, -1.1, 2.0, 0.02, -0.03, 0.01]))


def test_a_relation_needs_frames_that_say_it_alike_and_begins_anew_where_they_do_not():
    rng = np.random.default_rng(0)
    p = rng.normal([0.2, 0, 0], 0.03, (40, 3))
    noisy = T_FIRST_SECOND @ se3.exp(rng.normal(0, 1, (5, 6)) * np.repeat([0.01, 0.001], 3))
    relation = Relation()
    for T in noisy:
        assert not relation.certain
        relation = relation.with_frame(T, p)
    assert relation.certain
    deg, mm = se3.error_deg_mm(relation.mean, T_FIRST_SECOND)
    each_deg, each_mm = se3.error_deg_mm(noisy, T_FIRST_SECOND)
    assert deg < each_deg.max() and mm < each_mm.max()
    for off in ([0, np.radians(8), 0, 0, 0, 0], [0, 0, 0, 0.015, 0, 0]):
        other = T_FIRST_SECOND @ se3.exp(np.array(off))
        assert not relation.with_frame(other, p).certain
        np.testing.assert_allclose(relation.with_frame(other, p).mean, other, atol=1e-12)


def test_joined_surfaces_are_that_of_all_views_in_one_frame():
    poses = around(6)
    first, second = fused(LUMP, poses[:3], background_m=1.0), fused(LUMP, poses[3:], background_m=1.0)
    whole = fused(LUMP, poses, background_m=1.0)
    # The second volume is given its own frame by calling its poses others: the first frame times T_FIRST_SECOND.
    apart = fused(LUMP, [], background_m=1.0)
    for key, view in second.views.items():
        apart._put(key, view, view.T_cam_obj @ T_FIRST_SECOND)
    first.join(apart, T_FIRST_SECOND, shift=3)
    assert set(first.views) == set(whole.views)
    at = np.random.default_rng(0).uniform(-0.06, 0.06, (4000, 3))
    (a, valid_a), (b, valid_b) = first.query(at), whole.query(at)
    assert (valid_a == valid_b).mean() > 0.98 and valid_b.mean() > 0.5
    np.testing.assert_allclose(a[valid_a & valid_b], b[valid_a & valid_b], atol=1e-3)
    assert first.move({4: whole.views[4].T_cam_obj @ se3.exp(np.array([0, 0, 0.1, 0, 0, 0]))}) == [4]


def test_joined_graphs_know_both_and_go_on_as_one():
    table = Turntable.made(2, 12, noise=0.0)

    def grown(first: int, stop: int, T_obj: np.ndarray) -> BoundedGraph:
        graph = BoundedGraph(ALL)
        for k in range(first, stop):
            T = table.T_cam_obj[k] @ T_obj
            seen = table.seen[k]
            p_obj = se3.transform(se3.inverse(T), table.p_cam[k])
            graph.add_keyframe(T, seen + (1000 if first else 0), table.p_cam[k], p_obj_init=p_obj)
            assert graph.optimise().ok
        return graph

    first, second = grown(0, 5, np.eye(4)), grown(6, 11, T_FIRST_SECOND)
    off = se3.exp(np.array([0.02, -0.01, 0.02, 0.001, 0.002, -0.001]))  # registered so badly
    first.join(second, T_FIRST_SECOND @ off, point_shift=2000)
    assert first.keys == tuple(range(10))
    # What sees points of both, by their names in either, ties them.
    k = 5
    both = np.concatenate([table.seen[k], table.seen[k] + 3000])
    p_cam = np.concatenate([table.p_cam[k]] * 2)
    p_obj = se3.transform(se3.inverse(table.T_cam_obj[k]), p_cam)
    first.add_keyframe(table.T_cam_obj[k], both, p_cam, p_obj_init=p_obj)
    result = first.optimise()
    assert result.ok
    truth = np.concatenate([table.T_cam_obj[:5], table.T_cam_obj[6:11], table.T_cam_obj[5:6]])
    deg, mm = se3.error_deg_mm(result.T_cam_obj, truth)
    assert deg.max() < 0.25 and mm.max() < 0.25, (deg, mm)  # joined 1.7 degrees and 2.4 mm off


def test_joined_keypoints_keep_what_they_have_been_through():
    config = preset().keypoint_map
    first, second, rng = KeypointMap(config), KeypointMap(config), np.random.default_rng(0)
    first.add(np.arange(5), rng.normal(size=(5, 3)), promoted=True)
    p = rng.normal(size=(4, 3))
    second.add(np.arange(4), p, promoted=False, p_cam=p)
    second.assign(np.arange(4), np.arange(10, 14))
    first.join(second, T_FIRST_SECOND, shift=5)
    np.testing.assert_array_equal(first.keys, np.arange(9))
    np.testing.assert_array_equal(first.ids, [-1] * 5 + [10, 11, 12, 13])
    np.testing.assert_allclose(first.p_obj[5:], se3.transform(T_FIRST_SECOND, p))
    # Pending ones become keypoints by frames before and after: where they are in the first map's frame.
    for _ in range(config.streak):
        moved = np.concatenate([first.p_obj[:5], se3.transform(T_FIRST_SECOND, p)])
        promoted = first.observe(moved, np.zeros(9), stable=True)
    np.testing.assert_array_equal(promoted, [5, 6, 7, 8])
    np.testing.assert_allclose(first.p_obj[5:], se3.transform(T_FIRST_SECOND, p), atol=1e-12)


def proposed(inliers: int) -> Proposal:
    """A pose with which so many of thirty keypoints agree."""
    agree = np.arange(30) < inliers
    hypothesis = Hypothesis(np.eye(4), agree, np.where(agree, 0.0, np.inf), "ransac 1")
    return Proposal(hypothesis, SimpleNamespace(refined=False, T_cam_obj=np.eye(4)))  # no surface has been asked


@pytest.mark.parametrize("doubted", [True, False])
def test_a_doubted_pose_says_nothing_of_where_maps_lie_to_each_other(doubted):
    other = SimpleNamespace(known=None, map=SimpleNamespace(p_obj=np.zeros((1, 3))))
    met = proposed(20), Judgement(True, "tracked")
    both = SimpleNamespace(other=other, _relation=Relation(), _known_again=lambda *of: met)
    seen = SimpleNamespace(other=SimpleNamespace())
    assert TwoMaps._by_other(both, seen, proposed(20), Judgement(True, "tracked", doubted=doubted)) is None
    assert len(both._relation.T_obj_other) == (not doubted)


@pytest.mark.parametrize(("inliers", "known"), [(12, False), (20, True)])
def test_a_map_that_most_of_its_points_contradict_does_not_know_the_object_again(inliers, known):
    """What is alike in some places has points enough for a pose, and more that are elsewhere."""
    policy = SimpleNamespace(
        propose=lambda *of: [proposed(inliers).hypothesis],
        choose=lambda obs, other, found: (proposed(inliers), ""),
        judge_other=lambda *of: Judgement(True, "tracked"),
    )
    both = SimpleNamespace(config=preset(), policy=policy)
    other = SimpleNamespace(keypoints=lambda obs: np.ones(30, bool))
    assert (TwoMaps._known_again(both, None, other) is not None) == known


def test_a_life_told_in_another_frame_is_the_same():
    T = se3.exp(np.random.default_rng(0).normal(0, 0.3, (2, 6)))
    life = Lifecycle("tracked", T[0], 0.0).placed(np.eye(4)).with_verdict(T[1], 0.03, Judgement(True, "tracked"))
    life = replace(life, contour=np.random.default_rng(1).normal(0, 0.1, (30, 3)))
    T_other = T @ T_FIRST_SECOND
    other = (
        Lifecycle("tracked", T_other[0], 0.0)
        .placed(np.eye(4))
        .with_verdict(T_other[1], 0.03, Judgement(True, "tracked"))
    )
    moved = life.in_frame(T_FIRST_SECOND)
    for name in ("T_cam_obj", "T_previous", "T_world_obj"):
        np.testing.assert_allclose(getattr(moved, name), getattr(other, name), atol=1e-12)
    np.testing.assert_allclose(moved.moved(0.9).motion.T_cam_obj, other.T_cam_obj, atol=1e-12)
    np.testing.assert_allclose(life.moved(0.9).in_frame(T_FIRST_SECOND).motion.T_cam_obj, other.T_cam_obj, atol=1e-12)
    in_camera = [se3.transform(told.T_cam_obj, told.contour) for told in (life, moved)]
    np.testing.assert_allclose(*in_camera, atol=1e-12)
    assert moved.T_left is None and pytest.approx(moved.seen_s) == other.seen_s
