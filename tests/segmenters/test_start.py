"""What starts an object: one mask, whoever asks for it, and the evidence that it is cut by."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from p2p_lib import Point2Pose
from p2p_lib.apps.click import clicked_masks
from p2p_lib.core.backends import make_segmenter
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.segmenters.builtin import random_walk
from p2p_lib.segmenters.builtin.depth_offset import depth_offset_px, with_depth_moved
from p2p_lib.segmenters.builtin.patch import Box, Patch, plane_heights, support_plane
from p2p_lib.segmenters.builtin.start_evidence import Clicked, Height, by_connection, filled, tolerant, unlike

H, W = 60, 80
EVERYWHERE = np.ones((H, W), bool)
CAMERA = Camera(300.0, 300.0, (W - 1) / 2, (H - 1) / 2, W, H)


@pytest.fixture(scope="module")
def scene():
    """Two printed things on a table, with three clicks on each."""
    sequence = open_sequence("synthetic/crossing")
    rng, prompts = np.random.default_rng(5), []
    for name, mask in sorted(sequence.masks(0).items()):
        at = np.argwhere(mask & (sequence.frame(0).depth_m > 0))
        prompts.append(Prompt(name, 0, at[rng.integers(0, len(at), 3)][:, ::-1].astype(float)))
    return sequence, prompts


def first_masks(camera: Camera, frame: Frame, prompts: list[Prompt]) -> dict[str, np.ndarray]:
    segmenter = make_segmenter("builtin", camera, preset().segmentation)
    labels = segmenter.segment(frame, prompts)
    return {name: labels == label for label, name in enumerate(segmenter.names, 1)}


def test_one_mask_whoever_asks(scene):
    """``p2p click`` and ``p2p check`` show what a run uses, whatever its seed and the order of objects."""
    sequence, prompts = scene
    shown = {name: mask for name, (_, mask) in clicked_masks(sequence, prompts).items()}
    for seed in range(3):
        method = Point2Pose(sequence.camera, replace(preset(), seed=seed))
        for prompt in prompts[:: -1 if seed else 1]:
            method.add_object(prompt.name, clicks=prompt.points_px)
        method.step(sequence.frame(0))
        cut = first_masks(sequence.camera, sequence.frame(0), prompts[:: 1 if seed else -1])
        for name, mask in shown.items():
            np.testing.assert_array_equal(method.masks[name], mask)
            np.testing.assert_array_equal(cut[name], mask)


def test_one_mask_in_a_cropped_image(scene):
    """The camera's centre moves with the crop; nothing else that the cut goes by does."""
    sequence, prompts = scene
    frame, camera = sequence.frame(0), sequence.camera
    whole = first_masks(camera, frame, prompts[:1])[prompts[0].name]
    reach = 0.35 * camera.fx / np.median(frame.depth_m[whole & (frame.depth_m > 0)])
    centre, (height, width) = prompts[0].points_px.mean(0), frame.shape
    left, top = np.maximum(centre - reach, 0).astype(int)
    right, bottom = np.minimum(centre + reach, [width, height]).astype(int)
    part = Frame(0, 0.0, frame.rgb[top:bottom, left:right].copy(), frame.depth_m[top:bottom, left:right].copy())
    moved = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=right - left, height=bottom - top)
    prompt = replace(prompts[0], points_px=prompts[0].points_px - [left, top])
    cropped = first_masks(moved, part, [prompt])[prompt.name]
    np.testing.assert_array_equal(cropped, whole[top:bottom, left:right])


def test_depth_beside_colour_is_moved_onto_it():
    rng = np.random.default_rng(0)
    rgb, depth = np.full((240, 320, 3), 90.0), np.ones((240, 320), np.float32)
    rgb[80:160, 100:220], depth[85:165, 93:213] = (200, 120, 60), 0.7
    rgb = np.clip(rgb + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)
    frame, box = Frame(0, 0.0, rgb, depth), Box(60, 40, 280, 200)
    assert depth_offset_px(frame, box) == (7, -5)
    moved = with_depth_moved(frame, (7, -5))
    np.testing.assert_array_equal(moved.depth_m[80:160, 100:220], np.float32(0.7))
    assert depth_offset_px(moved, box) == (0, 0) and with_depth_moved(frame, (0, 0)) is frame
    assert depth_offset_px(replace(frame, depth_m=np.ones_like(depth)), box) == (0, 0)  # no edge tells anything


def patch_of(depth_m: np.ndarray) -> Patch:
    rgb = np.full((H, W, 3), 90, np.uint8)
    return Patch(Box(0, 0, W, H), 1, CAMERA, rgb, depth_m, np.full((H, W), 0.002, np.float32))


def block(height_m: float) -> tuple[Patch, Clicked]:
    """A block before a wall one metre away that faces the camera, clicked thrice."""
    depth = np.ones((H, W), np.float32)
    depth[20:40, 30:50] -= height_m
    patch = patch_of(depth)
    return patch, Clicked.of(patch, np.array([[35.0, 25], [45, 28], [38, 35]]), 1.0)


def test_height_tells_what_stands_on_a_plane_from_the_plane():
    patch, clicked = block(0.05)
    height = Height.of(patch, clicked, EVERYWHERE)
    assert not height.flat and (height.log_odds[22:38, 32:48] > 0).all() and (height.log_odds[:18] < -1).all()
    connected = by_connection(patch, clicked, height, unlike(patch, height.plane))
    assert (connected[22:38, 32:48] > 0).all() and (connected[:18] < 0).all()


def test_beside_a_low_camera_the_table_is_found_before_all_that_is_far_behind():
    """A block on a table that fills an eighth of what is measured; behind it there is no plane."""
    v, u = np.mgrid[:H, :W].astype(float)
    slope = (v - CAMERA.cy) / CAMERA.fy
    depth = 1.5 + 0.5 * np.sin(u * v / 7)
    table = v >= 53
    depth[table] = 0.042 / slope[table]  # 4.2 cm below the camera
    depth[30:56, 30:50] = 0.042 / slope[56, 0]
    patch = patch_of(depth.astype(np.float32))
    clicked = Clicked.of(patch, np.array([[33.0, 34], [46, 36], [38, 44]]), float(depth[40, 40]))
    near = np.abs(depth - depth[40, 40]) < 0.3
    assert Height.of(patch, clicked, EVERYWHERE).flat, "else nothing is shown"
    height = Height.of(patch, clicked, near)
    assert height.plane is not None and abs(height.plane[1]) > 0.98 and not height.flat
    assert (height.log_odds[32:44, 32:48] > 0).all() and (height.log_odds[57:, :25] < 0).mean() > 0.9


def test_what_lies_beyond_a_hole_of_depth_is_another_thing_but_within_a_box():
    patch, clicked = block(0.05)
    depth = patch.depth_m.copy()
    depth[20:40, 54:70], depth[16:20, 30:70] = 0.93, 0  # nothing is measured along both of their upper edges
    patch = patch_of(depth)
    patch.rgb[16:40, 30:70] = 200
    height = Height.of(patch, clicked, EVERYWHERE)
    beside = [by_connection(patch, clicked, height, unlike(patch, height.plane), holes) for holes in (False, True)]
    assert (beside[0][22:38, 56:68] < 0).all() and (beside[1][22:38, 56:68] > 0).all()


def test_what_lies_on_a_table_and_looks_unlike_it_is_one_thing():
    """The grey head of something flat is clicked, its handle is blue; the table is lit from one side."""
    rng = np.random.default_rng(0)
    rgb = np.tile(np.linspace(60, 230, W)[None, :, None], (H, 1, 3)) * [1.0, 0.8, 0.6]
    rgb[26:34, 20:28], rgb[28:32, 28:60] = (150, 150, 150), (40, 60, 140)
    rgb[34:37, 20:60] *= 0.85  # its shade
    patch = patch_of(np.ones((H, W), np.float32))
    patch = replace(patch, rgb=np.clip(rgb + rng.normal(0, 2, rgb.shape), 0, 255).astype(np.uint8))
    clicked = Clicked.of(patch, np.array([[22.0, 28], [24, 30], [22, 31]]), 1.0)
    height = Height.of(patch, clicked, EVERYWHERE)
    connected = by_connection(patch, clicked, height, unlike(patch, height.plane))
    assert (connected[29:31, 21:58] > 0).all()
    assert not (connected[:24] > 0).any() and not (connected[38:] > 0).any() and (connected[35] > 0).mean() < 0.1


@pytest.mark.parametrize("height_m", [0.0, 0.002])
def test_what_is_flat_is_not_told_by_height(height_m):
    patch, clicked = block(height_m)
    height = Height.of(patch, clicked, EVERYWHERE)
    assert (
        height.flat
        and not height.log_odds.any()
        and not by_connection(patch, clicked, height, unlike(patch, height.plane)).any()
    )


def test_where_depth_ends_within_some_pixels_says_nothing():
    log_odds = np.full((20, 20), -2, np.float32)
    log_odds[5:15, 5:15] = 1
    loose = tolerant(log_odds, 2.0)
    assert (loose[8:12, 8:12] == 1).all() and (loose[:2] == -2).all() and not loose[4:6, 8:12].any()
    np.testing.assert_array_equal(tolerant(log_odds, 0.0), log_odds)


def test_what_is_not_measured_is_like_the_nearest_that_is():
    log_odds, measured = np.zeros((10, 10), np.float32), np.zeros((10, 10), bool)
    log_odds[:, :2], log_odds[:, 8:] = 2, -1
    measured[:, :2] = measured[:, 8:] = True
    full = filled(log_odds, measured)
    assert (full[:, 2:4] > 0).all() and (full[:, 6:8] < 0).all() and (np.abs(full) <= np.abs(log_odds).max()).all()
    assert filled(log_odds, np.zeros_like(measured)) is log_odds


def test_the_plane_is_the_one_that_weighs_most():
    """Two walls of equal size: the one near to the clicks is meant."""
    depth = np.ones((H, W), np.float32)
    depth[:, W // 2 :] = 0.8
    weight = np.ones((H, W))
    for near, z_m in ((np.s_[:, : W // 2], 1.0), (np.s_[:, W // 2 :], 0.8)):
        patch, heavy = patch_of(depth), weight.copy()
        heavy[near] = 5
        plane = support_plane(patch, depth > 0, heavy)
        assert np.abs(plane_heights(patch, plane)[depth == np.float32(z_m)]).max() < 1e-5


def minimum_cut(log_odds: np.ndarray, weights: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(n, n) bool, the object's side of the minimum cut, by scipy's maximum flow."""
    n = len(log_odds)
    at = np.arange(n * n).reshape(n, n)
    one = np.concatenate([at[:, :-1].ravel(), at[:-1].ravel()])
    two = np.concatenate([at[:, 1:].ravel(), at[1:].ravel()])
    tie, f = np.concatenate([w.ravel() for w in weights]), log_odds.ravel()
    source, sink, on = n * n, n * n + 1, log_odds.ravel() > 0
    rows = np.concatenate([one, two, np.full(on.sum(), source), np.flatnonzero(~on)])
    columns = np.concatenate([two, one, np.flatnonzero(on), np.full((~on).sum(), sink)])
    capacity = np.concatenate([tie, tie, f[on], -f[~on]]) * 1e4
    graph = coo_array((capacity.astype(np.int32), (rows, columns)), shape=(n * n + 2,) * 2).tocsr()
    left = graph - maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    return np.isin(at, breadth_first_order(left, source, return_predecessors=False))


def test_a_sharp_outline_is_nearer_to_a_minimum_cut_than_a_walk():
    wrong = {random_walk.walk: 0, random_walk.sharpen: 0}
    for seed in range(10):
        rng, n = np.random.default_rng(seed), 16
        log_odds = rng.normal(0, 1, (n, n)) + np.where(np.hypot(*(np.mgrid[:n, :n] - 7.5)) < 5, 0.8, -0.8)
        weights = rng.uniform(0.1, 1, (n, n - 1)), rng.uniform(0.1, 1, (n - 1, n))
        best = minimum_cut(log_odds, weights)
        target, strength = (log_odds > 0).astype(np.float32), np.abs(log_odds).astype(np.float32)
        for cut in wrong:
            wrong[cut] += int(((cut(target, strength, weights, 0.25 + 0.5 * target) > 0.5) != best).sum())
    assert wrong[random_walk.sharpen] < 0.6 * wrong[random_walk.walk]
