"""The cut: against a dense solver, and that edges hold it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.segmenters.builtin import random_walk


def dense(target, strength, weights):
    """The minimiser by a full linear solve."""
    h, w = target.shape
    across, down = weights
    index = np.arange(h * w).reshape(h, w)
    A = np.diag(strength.ravel().astype(float))
    for a, b, t in ((index[:, :-1], index[:, 1:], across), (index[:-1], index[1:], down)):
        for i, j, weight in zip(a.ravel(), b.ravel(), t.ravel().astype(float)):
            A[[i, j], [i, j]] += weight
            A[[i, j], [j, i]] -= weight
    return np.linalg.solve(A, (strength * target).ravel()).reshape(h, w)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 9), st.integers(2, 9))
def test_agrees_with_a_dense_solve(seed, h, w):
    rng = np.random.default_rng(seed)
    target = (rng.random((h, w)) < 0.5).astype(np.float32)
    strength = rng.uniform(0.02, 1, (h, w)).astype(np.float32)
    colour = rng.uniform(0, 255, (h, w, 3)).astype(np.float32)
    depth_m = np.where(rng.random((h, w)) < 0.2, 0, rng.uniform(0.4, 0.6, (h, w))).astype(np.float32)
    weights = random_walk.edge_weights(colour, depth_m, np.full((h, w), 0.01, np.float32))
    assert weights[0].shape == (h, w - 1) and weights[1].shape == (h - 1, w)
    assert all((t > 0).all() and (t <= 1).all() for t in weights)
    x = random_walk.walk(target, strength, weights, np.full((h, w), 0.5, np.float32), 300)
    np.testing.assert_allclose(x, dense(target, strength, weights), atol=0.02)


def test_symmetric_in_object_and_background():
    rng = np.random.default_rng(1)
    target, strength = (rng.random((20, 30)) < 0.5).astype(np.float32), rng.random((20, 30)).astype(np.float32)
    weights = random_walk.edge_weights(rng.random((20, 30, 3)), np.ones((20, 30)), np.ones((20, 30)))
    one = random_walk.walk(target, strength, weights, np.full((20, 30), 0.5, np.float32), 100)
    other = random_walk.walk(1 - target, strength, weights, np.full((20, 30), 0.5, np.float32), 100)
    np.testing.assert_allclose(one, 1 - other, atol=0.01)


@pytest.mark.parametrize("edge", ["colour", "depth", "measured"])
def test_two_seeds_share_the_picture_along_its_edge(edge):
    """One seed each; the edge runs far from the middle between them."""
    h, w, at = 24, 40, 31
    colour, depth = np.full((h, w, 3), 80.0, np.float32), np.ones((h, w), np.float32)
    colour += np.random.default_rng(0).normal(0, 2, colour.shape).astype(np.float32)
    if edge == "colour":
        colour[:, at:] += 60
    else:
        depth[:, at:] = 0.9 if edge == "depth" else 0.0
    weights = random_walk.edge_weights(colour, depth, np.full((h, w), 0.01, np.float32))
    target, strength = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)
    target[:, 4], strength[:, 4], strength[:, 36] = 1, 1, 1
    x = random_walk.walk(target, strength, weights, np.full((h, w), 0.5, np.float32), 500)
    assert (x[:, :at] > 0.5).all() and (x[:, at:] < 0.5).all()
