"""Choosing points: the greedy objective against the paper's equation spelt out, where points may lie, the detector."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from p2p_lib.core.backends import make_detector
from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Frame
from p2p_lib.method.sampling import choose, terms, usable_region

DEFAULT = SamplingConfig()
EDGE_M = 0.01


# --- the objective -----------------------------------------------------------------------------


def papers_j(s: float, d: float, cfg: SamplingConfig) -> float:
    """J_k of one candidate, term by term as printed."""
    rho = max(0.0, (cfg.r_min_px - d) / cfg.r_min_px)
    return cfg.score_weight * s + (1 - cfg.score_weight) * min(d / cfg.r_ideal_px, 1) - cfg.cluster_weight * rho


@given(
    s=st.floats(0, 1),
    d=st.one_of(st.floats(0, 200), st.just(math.inf)),
    lam=st.floats(0, 1),
    beta=st.floats(0, 3),
    r_ideal=st.floats(1, 100),
    r_min=st.floats(0.1, 20),
)
def test_objective_is_the_papers(s, d, lam, beta, r_ideal, r_min):
    cfg = SamplingConfig(score_weight=lam, cluster_weight=beta, r_ideal_px=r_ideal, r_min_px=r_min)
    assert terms(np.array([s]), np.array([d]), cfg).total[0] == pytest.approx(papers_j(s, d, cfg), abs=1e-12)


def test_objective_at_its_landmarks():
    d = np.array([0, 2.5, 5, 10, 20, 40, np.inf])
    np.testing.assert_allclose(terms(np.zeros(7), d, DEFAULT).total, [-0.5, 0.0875 - 0.25, 0.175, 0.35, 0.7, 0.7, 0.7])
    np.testing.assert_allclose(terms(np.ones(7), d, DEFAULT).total - terms(np.zeros(7), d, DEFAULT).total, 0.3)


def test_without_a_least_distance_there_is_no_crowding():
    cfg = replace(DEFAULT, r_min_px=0.0)
    np.testing.assert_allclose(terms(np.array([1.0, 1.0]), np.array([0.0, 20.0]), cfg).total, [0.3, 1.0])


# --- the greedy choice -------------------------------------------------------------------------


def distance_to_nearest(p, others) -> float:
    return min((math.dist(p, q) for q in others), default=math.inf)


def assert_greedy(candidates: Candidates, stored: np.ndarray, count: int, cfg: SamplingConfig, chosen: np.ndarray):
    """Each choice has the largest J of those left, and more than nothing; it ends only when none has."""
    taken = [tuple(p) for p in stored]
    free = set(range(len(candidates.score)))
    slack = 1e-9  # distances computed another way differ in their last digits
    for k in [int(c) for c in chosen] + [None] * (count > len(chosen)):
        d = {i: distance_to_nearest(candidates.uv_px[i], taken) for i in free}
        j = {i: papers_j(candidates.score[i], d[i], cfg) for i in free}
        if k is None:
            assert max(j.values(), default=0.0) <= slack, "stopped while candidates were worth their costs"
            break
        assert k in free and j[k] > -slack
        assert j[k] >= max(j.values()) - slack
        free.remove(k)
        taken.append(tuple(candidates.uv_px[k]))


configs = st.builds(
    SamplingConfig,
    score_weight=st.sampled_from([0.0, 0.3, 0.7, 1.0]),
    cluster_weight=st.sampled_from([0.0, 0.5, 5.0]),
    r_ideal_px=st.sampled_from([1.0, 20.0, 60.0]),
    r_min_px=st.sampled_from([0.5, 5.0, 25.0]),
)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 60),
    m=st.integers(0, 20),
    count=st.integers(0, 40),
    side_px=st.sampled_from([30, 150, 600]),
    whole_pixels=st.booleans(),
    cfg=configs,
)
@example(seed=0, n=0, m=3, count=5, side_px=30, whole_pixels=False, cfg=DEFAULT)
@example(seed=0, n=1, m=0, count=5, side_px=30, whole_pixels=False, cfg=DEFAULT)
def test_choice_is_greedy_in_the_papers_objective(seed, n, m, count, side_px, whole_pixels, cfg):
    rng = np.random.default_rng(seed)
    uv, stored = rng.uniform(0, side_px, (n, 2)), rng.uniform(0, side_px, (m, 2))
    if whole_pixels:  # many equal distances, candidates on top of each other
        uv, stored = np.rint(uv), np.rint(stored)
    candidates = Candidates(uv, rng.uniform(0, 1, n))
    chosen = choose(candidates, stored, count, cfg)
    assert chosen.dtype.kind == "i" and len(set(chosen.tolist())) == len(chosen) <= min(count, n)
    assert_greedy(candidates, stored, count, cfg, chosen)
    np.testing.assert_array_equal(choose(candidates, stored, count, cfg), chosen)


def line(*x: float, score: float = 0.5) -> Candidates:
    return Candidates(np.array([[v, 0.0] for v in x]), np.full(len(x), score))


def test_no_candidates_no_choice():
    for stored in (np.zeros((0, 2)), np.array([[1.0, 2.0]])):
        assert choose(line(), stored, 5, DEFAULT).tolist() == []


def test_one_candidate():
    assert choose(line(100), np.zeros((0, 2)), 5, DEFAULT).tolist() == [0]
    # 0.3 * 0.5 + 0.7 d / 20 = 0.5 (5 - d) / 5 at d = 2.59 px: nearer than that crowding costs more than it is worth.
    assert choose(line(100), np.array([[102.5, 0]]), 5, DEFAULT).tolist() == []
    assert choose(line(100), np.array([[102.7, 0]]), 5, DEFAULT).tolist() == [0]
    assert choose(line(100), np.zeros((0, 2)), 0, DEFAULT).tolist() == []


def test_the_best_score_comes_first_then_the_far_ones():
    candidates = Candidates(np.array([[0, 0], [6, 0], [12, 0], [60, 0.0]]), np.array([0.9, 1.0, 0.8, 0.1]))
    # 1 has the best score; then 3 although its score is the worst: it is far; 0 and 2 are equally far, 0 scores higher.
    assert choose(candidates, np.zeros((0, 2)), 4, DEFAULT).tolist() == [1, 3, 0, 2]


def test_stored_points_repel_like_chosen_ones():
    candidates = line(0, 30, 60)
    assert choose(candidates, np.array([[0.0, 2.0], [61.0, 0.0]]), 3, DEFAULT).tolist() == [1]
    # All are far enough; the one farthest from what is stored is first, in spite of its lower score.
    candidates = Candidates(candidates.uv_px, np.array([0.9, 0.8, 0.7]))
    assert choose(candidates, np.array([[8.0, 0.0], [38.0, 0.0]]), 3, DEFAULT).tolist() == [2, 0, 1]


def test_spread_beats_score_and_the_weight_says_how_much():
    rng = np.random.default_rng(0)
    candidates = Candidates(rng.uniform(0, 200, (400, 2)), rng.uniform(0, 1, 400))
    cfg = replace(DEFAULT, r_ideal_px=100.0)  # farther than 30 points can be: more distance always pays

    def nearest_px(lam: float) -> float:
        uv = candidates.uv_px[choose(candidates, np.zeros((0, 2)), 30, replace(cfg, score_weight=lam))]
        d = np.linalg.norm(uv[:, None] - uv[None], axis=-1) + 1e9 * np.eye(len(uv))
        return float(d.min(1).mean())

    assert nearest_px(0.0) > nearest_px(0.8) > nearest_px(1.0) > 0


def test_the_cost_of_crowding_keeps_points_apart_as_much_as_it_weighs():
    """lambda = 1 leaves score and crowding alone: what is taken at distance d < r_min scores more than its cost."""
    rng = np.random.default_rng(1)
    candidates = Candidates(rng.uniform(0, 60, (400, 2)), rng.uniform(0, 1, 400))
    cfg, last = replace(DEFAULT, score_weight=1.0, r_min_px=8.0), 0.0

    for beta in (0.0, 0.5, 2.0, 1e6):
        uv = candidates.uv_px[choose(candidates, np.zeros((0, 2)), 30, replace(cfg, cluster_weight=beta))]
        d = np.linalg.norm(uv[:, None] - uv[None], axis=-1) + 1e9 * np.eye(len(uv))
        assert d.min() > last, f"beta {beta}"
        last = d.min()
    assert last > 8 - 1e-4, "no score outweighs an enormous cost"


def test_the_best_score_is_taken_where_nothing_else_counts():
    rng = np.random.default_rng(0)
    candidates = Candidates(rng.uniform(0, 200, (400, 2)), rng.uniform(0, 1, 400))
    best = choose(candidates, np.zeros((0, 2)), 400, replace(DEFAULT, score_weight=1.0, r_min_px=0.0))
    np.testing.assert_array_equal(best, np.argsort(-candidates.score))


def test_candidates_are_selected_by_index_and_by_mask():
    candidates = Candidates(np.arange(6.0).reshape(3, 2), np.array([0.1, 0.2, 0.3]))
    for keep in (np.array([2, 0]), np.array([True, False, True])):
        picked = candidates.select(keep)
        np.testing.assert_array_equal(picked.uv_px, candidates.uv_px[keep])
        np.testing.assert_array_equal(picked.score, candidates.score[keep])


# --- where points may lie ----------------------------------------------------------------------


H, W = 48, 64


def frame_of(depth: np.ndarray, rgb: np.ndarray | None = None) -> Frame:
    return Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8) if rgb is None else rgb, depth)


def slowly_usable(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Pixel by pixel: the mask's border is edge_margin away, the 3x3 neighbours have depth without a step."""
    margin, out = 2, np.zeros_like(mask)
    for v in range(H):
        for u in range(W):
            around = [(v + j, u + i) for j in range(-margin, margin + 1) for i in range(-margin, margin + 1)]
            inner = all(0 <= y < H and 0 <= x < W and mask[y, x] for y, x in around)
            near = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
            out[v, u] = inner and depth[v, u] > 0 and near.max() - near.min() <= EDGE_M
    return out


@pytest.mark.parametrize("seed", range(3))
def test_usable_region_pixel_by_pixel(seed):
    rng = np.random.default_rng(seed)
    depth = (0.6 + 0.001 * rng.normal(size=(H, W))).astype(np.float32)
    depth[rng.random((H, W)) < 0.005] = 0  # holes
    depth[:, 40:] += 0.05  # a step
    mask = cv2.circle(np.zeros((H, W), np.uint8), (36, 24), 20, 1, -1) > 0
    mask[20:24, 20:30] = False
    got = usable_region(frame_of(depth), mask, EDGE_M)
    assert got.dtype == bool and got.any()
    np.testing.assert_array_equal(got, slowly_usable(depth, mask))


def test_the_pictures_border_is_a_border():
    got = usable_region(frame_of(np.full((H, W), 0.5, np.float32)), np.ones((H, W), bool), EDGE_M)
    expected = np.zeros((H, W), bool)
    expected[2:-2, 2:-2] = True
    np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize(("mask", "depth_m"), [(0, 0.5), (1, 0.0)])
def test_nothing_is_usable_without_mask_or_depth(mask, depth_m):
    frame = frame_of(np.full((H, W), depth_m, np.float32))
    assert not usable_region(frame, np.full((H, W), mask, bool), EDGE_M).any()


def test_a_step_of_just_the_limit_is_no_edge():
    depth = np.full((H, W), 0.5, np.float32)
    depth[:, 30:] = np.float32(0.5) + np.float32(1 / 128)
    inside = np.ones((H, W), bool)
    on_step = usable_region(frame_of(depth), inside, 1 / 128)[10, 28:32]
    off_step = usable_region(frame_of(depth), inside, 1 / 129)[10, 28:32]
    assert on_step.all() and off_step.tolist() == [True, False, False, True]


# --- the embedded detector ---------------------------------------------------------------------


def textured(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """A picture with structure at several scales."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.integers(0, 256, (s, s, 3)).astype(np.float32), shape[::-1]) for s in (8, 24, 70)]
    return np.clip(np.mean(layers, 0) * 1.5 - 60, 0, 255).astype(np.uint8)


def detect(rgb: np.ndarray, mask: np.ndarray, cfg: SamplingConfig = DEFAULT) -> Candidates:
    frame = frame_of(np.full(mask.shape, 0.5, np.float32), rgb)
    return make_detector("corners", cfg).detect(frame, mask)


def a_mask(*, at: tuple[int, int] = (160, 120), radius: int = 60) -> np.ndarray:
    return cv2.circle(np.zeros((240, 320), np.uint8), at, radius, 1, -1) > 0


@pytest.mark.parametrize("at", [(160, 120), (0, 0), (319, 239), (10, 200)])
def test_candidates_lie_in_the_mask_best_first(at):
    mask = a_mask(at=at)
    found = detect(textured(), mask)
    assert len(found.score) >= 20 and found.uv_px.shape == (len(found.score), 2)
    px = np.rint(found.uv_px).astype(int)
    assert mask[px[:, 1], px[:, 0]].all()
    assert (np.diff(found.score) <= 0).all() and found.score.max() <= 1 and found.score.min() >= 0


def test_the_limit_keeps_the_best():
    every, few = detect(textured(), a_mask()), detect(textured(), a_mask(), replace(DEFAULT, candidates=25))
    assert len(few.score) == 25 < len(every.score) <= DEFAULT.candidates


@pytest.mark.parametrize(
    ("rgb", "mask"),
    [
        (textured(), np.zeros((240, 320), bool)),
        (np.full((240, 320, 3), 128, np.uint8), a_mask()),
        (np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), bool)),
    ],
    ids=["empty mask", "plain surface", "black picture"],
)
def test_where_there_is_nothing_nothing_is_found(rgb, mask):
    found = detect(rgb, mask)
    assert found.uv_px.shape == (0, 2) and found.score.shape == (0,)
    assert choose(found, np.zeros((0, 2)), 30, DEFAULT).tolist() == []


def test_a_mask_of_one_pixel_is_no_trouble():
    mask = np.zeros((240, 320), bool)
    mask[239, 319] = True
    assert len(detect(textured(), mask).score) <= 1


def test_detection_is_the_same_every_time():
    first, again = (detect(textured(), a_mask()) for _ in range(2))
    np.testing.assert_array_equal(first.uv_px, again.uv_px)
    np.testing.assert_array_equal(first.score, again.score)


def test_candidates_move_with_the_picture():
    """Found again after a shift by whole pixels: positions are those of the whole picture, not of a cut-out."""
    shift = np.array([37, 22])
    rgb = textured()
    moved = np.roll(rgb, shift, (1, 0))
    before, after = detect(rgb, a_mask(at=(120, 100), radius=50)), detect(moved, a_mask(at=(157, 122), radius=50))
    gap = np.linalg.norm(before.uv_px[:, None] + shift - after.uv_px[None], axis=-1).min(1)
    assert (gap < 0.05).mean() > 0.95


def test_a_corner_is_found_where_it_is():
    """A square that starts at pixel 100 has its corner at 99.5; the detector's window of 5 px pulls it inwards."""
    rgb = np.full((240, 320, 3), 220, np.uint8)
    rgb[100:140, 100:140] = 30
    found = detect(rgb, np.ones((240, 320), bool))
    for corner in ((99.5, 99.5), (139.5, 99.5), (99.5, 139.5), (139.5, 139.5)):
        assert np.linalg.norm(found.uv_px - corner, axis=1).min() < 2.5


def test_unknown_detectors_are_refused():
    with pytest.raises(BadInput, match=r"detector: got 'cornres', expected one of corners"):
        make_detector("cornres", DEFAULT)


def test_a_narrow_part_has_a_region_of_its_own():
    mask, depth = np.zeros((60, 80), bool), np.full((60, 80), 1.5, np.float32)
    mask[20:40, 10:30], mask[29:32, 30:70] = True, True  # a blade and its handle
    depth[mask] = 0.5
    frame = Frame(0, 0.0, np.zeros((60, 80, 3), np.uint8), depth)
    region = usable_region(frame, mask, 0.01)
    assert region[29:32, 36:70].all() and region[22:38, 12:28].all()
    assert not region[20:22].any() and not region[:, 10:12].any()  # the blade keeps its border
    assert not usable_region(frame, mask, 0.01, narrow=False)[:, 30:].any()
