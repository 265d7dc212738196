"""A re-creation of the paper's synthetic subset: five sequences, 2,705 frames, circular and linear motion.

Not the paper's files: the same objects, camera and kinds of motion, drawn anew.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.motion import standing, turned, wander
from p2p_lib.synthetic.scene import Body, Scenario, check, room
from p2p_lib.synthetic.shapes import Mesh

FRAMES = 541  # five times this is 2,705
CAMERA = Camera(380.0, 380.0, 320.0, 240.0, 640, 480)

#: Where no YCB model is given: a printed solid of about its size.
STAND_INS: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "002_master_chef_can": partial(shapes.can, radius_m=0.051, height_m=0.139),
    "004_sugar_box": partial(shapes.box, size_m=(0.089, 0.038, 0.175)),
    "005_tomato_soup_can": partial(shapes.can, radius_m=0.034, height_m=0.101),
    "010_potted_meat_can": partial(shapes.box, size_m=(0.097, 0.050, 0.082)),
    "019_pitcher_base": partial(shapes.can, radius_m=0.062, height_m=0.240),
    "037_scissors": partial(shapes.box, size_m=(0.088, 0.016, 0.200)),
    "072-a_toy_airplane": partial(shapes.block, radius_m=0.07, height_m=0.14),
}

#: Objects of each sequence and how they move: ``circular`` (around the middle) or ``linear`` (to and fro).
SEQUENCES = {
    "ycb_sugar_box": {"004_sugar_box": "linear"},
    "ycb_pitcher": {"019_pitcher_base": "circular"},
    "ycb_meat_sugar": {"010_potted_meat_can": "circular", "004_sugar_box": "linear"},
    "ycb_scissors_can": {"037_scissors": "circular", "002_master_chef_can": "linear"},
    "ycb_airplane_can": {"072-a_toy_airplane": "circular", "005_tomato_soup_can": "linear"},
}


def paper_sequence(seed: int, frames: int = FRAMES, models: str = "", *, parts: dict[str, str]) -> Scenario:
    """One of :data:`SEQUENCES`. The circling object passes before and behind the other one.

    ``models`` is a folder of YCB models (``<name>/textured.obj``, metres); without it printed stand-ins are used, and
    the scenario's ``objects`` say so.
    """
    check("frames", frames=(frames, 2, np.inf))
    rng = np.random.default_rng([seed, 1])
    # Two objects keep clear of each other: one stays within 4 cm of the middle, the other goes around it.
    reach = {"circular": 0.21, "linear": 0.04} if len(parts) > 1 else {"circular": 0.10, "linear": 0.08}
    bodies = []
    for model, motion in parts.items():
        mesh = shapes.load_ycb(models, model) if models else STAND_INS[model](rng)
        T = {"circular": _circular, "linear": _linear}[motion](rng, frames, reach[motion])
        centre = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
        bodies.append(Body(model, mesh, T @ se3.from_rt(np.eye(3), -centre)))
    T_world_cam = standing(np.array([0.0, -0.52, 0.34]), np.array([0.0, 0.02, 0.14]), frames)
    kind = "YCB models" if models else "procedural stand-ins of about the YCB models' sizes"
    return Scenario(CAMERA, T_world_cam, tuple(bodies), room(rng), objects=kind)


def _circular(rng: np.random.Generator, frames: int, radius_m: float) -> np.ndarray:
    """Twice around a circle that lies flat, turning by a full turn on the way."""
    share = np.arange(frames) / (frames - 1)
    angle = 2 * np.pi * (2 * share + rng.uniform()) * rng.choice([-1, 1])
    centre = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(frames, 0.16)], 1)
    sway = wander(rng, frames, 0.01, 8.0, 200)
    return turned(sway, 2 * np.pi * (share + rng.uniform()), centre)


def _linear(rng: np.random.Generator, frames: int, reach_m: float) -> np.ndarray:
    """To and fro along a line, turning by 200 degrees on the way."""
    share = np.arange(frames) / (frames - 1)
    yaw = np.radians(200) * share * rng.choice([-1, 1]) + rng.uniform(0, 2 * np.pi)
    sway = wander(rng, frames, 0.01, 8.0, 200)
    aside = reach_m * np.sin(2 * np.pi * (2 * share + rng.uniform()))
    return turned(sway, yaw, np.stack([aside, np.full(frames, 0.02), np.full(frames, 0.14)], 1))
