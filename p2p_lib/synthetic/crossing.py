"""``crossing``: two objects that pass in front of each other and are hidden once each."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.motion import look_at, path, sweep, varied
from p2p_lib.synthetic.scene import VGA, Body, Scenario, room


def crossing(seed: int, frames: int = 300, contrast: float = 1.0) -> Scenario:
    """A carton and a tin that pass in front of each other twice and are hidden once each.

    In between, a board sweeps over first the tin, then the carton, and hides each completely while it
    moves by at least 10 cm and turns by at least 30 degrees: the tin back to where it was seen before, the
    carton on. Both turn by more than 90 degrees in all. ``frames`` stretches time, ``contrast`` fades the labels.
    """
    if frames < 2 or not 0 <= contrast <= 1:
        raise BadInput("crossing", f"frames {frames}, contrast {contrast}", "at least 2 frames, contrast from 0 to 1")
    rng = np.random.default_rng([seed, 1])
    eye = np.array([0.0, -0.62, 0.42])
    carton = shapes.box(rng, tuple(np.array([0.10, 0.055, 0.15]) * rng.uniform(0.94, 1.06, 3)), contrast)
    tin = shapes.can(rng, 0.04 * rng.uniform(0.95, 1.05), 0.115 * rng.uniform(0.95, 1.05), contrast)
    board = shapes.slab(rng, (0.16, 0.012, 0.20))
    # frame   x      y      z     yaw  pitch  roll (degrees); metres, model centre in the world
    path_carton = [
        (0, -0.17, -0.01, 0.130, -30, 4, -3),
        (45, -0.08, -0.09, 0.135, 32, -6, 5),
        (85, 0.07, -0.07, 0.130, 85, 5, 4),
        (120, 0.17, 0.00, 0.150, 126, 8, -6),
        (160, 0.20, 0.06, 0.165, 138, -4, -8),
        (205, 0.05, 0.01, 0.135, 184, -6, 6),
        (262, -0.06, 0.06, 0.140, 248, 4, 4),
        (299, -0.16, 0.02, 0.130, 300, -4, -4),
    ]
    path_tin = [
        (0, 0.16, 0.04, 0.120, 0, -8, 6),
        (45, 0.09, 0.09, 0.150, 56, 6, -8),
        (85, -0.06, 0.08, 0.135, 112, 10, 4),
        (116, -0.16, 0.05, 0.130, 150, -6, 8),
        (156, -0.02, -0.03, 0.120, 106, 4, -4),
        (200, -0.12, -0.06, 0.115, 60, -8, 6),
        (250, -0.03, -0.12, 0.120, -10, 6, 8),
        (299, 0.15, -0.05, 0.130, -80, -6, -6),
    ]
    mirrored = -1.0 if rng.uniform() < 0.5 else 1.0
    # The carton's wide panel is what shows before and after it is hidden.
    yaw_carton, yaw_tin = rng.choice([20, 200]) + rng.uniform(-20, 20), rng.uniform(-180, 180)
    T_carton = path(varied(rng, path_carton, yaw_carton, mirrored), frames)
    T_tin = path(varied(rng, path_tin, yaw_tin, mirrored), frames)
    T_board = sweep(eye, frames, (T_tin, 119, 153), (T_carton, 162, 200), mirrored)
    T_world_cam = np.broadcast_to(look_at(eye, np.array([0, 0.03, 0.12])), (frames, 4, 4))
    bodies = (Body("box", carton, T_carton), Body("can", tin, T_tin), Body("board", board, T_board, labelled=False))
    return Scenario(VGA, T_world_cam, bodies, room(rng))
