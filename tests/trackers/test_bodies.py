"""Which bodies are looked for anywhere in the picture."""

import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.trackers.builtin import motion_segments as bodies
from p2p_lib.trackers.builtin.landmarks import Corners
from p2p_lib.trackers.builtin.rigid_motion import Fit


@pytest.mark.parametrize(
    ("hidden_for", "kept", "searched"), [(0, True, False), (3, True, True), (3, False, True), (0, False, True)]
)
def test_bodies_that_are_lost_or_given_up_are_searched_for(monkeypatch, hidden_for, kept, searched):
    """One that was given up is lost, although the few points that it was taken for are followed on."""
    looked = []
    nothing = Corners(np.zeros((0, 2)), np.zeros((0, 3)), {})
    monkeypatch.setattr(bodies, "corners", lambda *asked: looked.append(asked) or nothing)
    body = bodies.Body(Fit(np.eye(4), np.eye(6), np.zeros(3), np.ones(0, bool)), np.eye(4), hidden_for, kept)
    body.landmarks.p_body = np.zeros((5, 3))
    all_of_them = bodies.Bodies(TrackingConfig())
    all_of_them._bodies = [body]
    all_of_them.search(None, None, 0)
    assert bool(looked) == searched
