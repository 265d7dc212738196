"""Absence and return: hidden by a hand, out of the picture, look-alikes, a late object, a camera that moves.

In each, an object that is away moves by more than 10 cm and turns by more than 30 degrees, and comes back showing
a side that was seen before. Times are frames of 30 a second.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.body_parts import hand
from p2p_lib.synthetic.motion import eased, look_at, path, varied
from p2p_lib.synthetic.scene import VGA, Body, Scenario, room
from p2p_lib.synthetic.shapes import Mesh

_EYE, _TARGET = np.array([0.0, -0.62, 0.42]), np.array([0.0, 0.03, 0.12])
_HAND_SHARE = 0.42  # of the way from the camera to what it hides: there a hand covers 20 cm


def occlusion(seed: int) -> Scenario:
    """A carton that a hand hides completely for about a second and a half; a tin beside it stays in view."""
    rng = np.random.default_rng([seed, 1])
    carton = Body("box", _carton(rng), _stay(rng, (-0.12, 0.0), (0.06, 0.05), (120, 165)))
    tin = Body("can", _tin(rng), _stay(rng, (0.24, 0.05), (0.24, 0.05)))
    return _scene(rng, (carton, tin), _standing(300), [(carton, 120, 165)])


def exit_reentry(seed: int) -> Scenario:
    """A carton that leaves the picture at one side and comes back 15 cm lower and nearer, turned."""
    rng = np.random.default_rng([seed, 1])
    side = rng.choice([-1.0, 1.0])
    keys = [
        (0, 0.05, 0.0, 0.16, -40, 4, -3),
        (50, -0.05, 0.03, 0.18, 40, -4, 4),
        (105, -0.14, 0.06, 0.22, -12, 3, -3),
        (135, -0.66, 0.06, 0.22, -14, 0, 0),
        (165, -0.66, -0.06, 0.09, 30, 0, 0),
        (195, -0.12, -0.06, 0.09, 28, 3, 3),
        (245, 0.05, 0.0, 0.14, -25, -4, -3),
        (299, -0.02, 0.03, 0.16, 35, 4, 4),
    ]
    keys = varied(rng, keys, 0.0, side)
    return _scene(rng, (Body("box", _carton(rng), path(keys, 300)),), _standing(300), [])


def look_alikes(seed: int) -> Scenario:
    """Two cartons with one label; only the mark on their fronts differs. A hand hides one, then the other."""
    rng = np.random.default_rng([seed, 1])
    mesh = _carton(rng)
    left = Body(
        "left", _marked(mesh, (200, 40, 40), round_mark=True), _stay(rng, (-0.20, 0.0), (-0.08, 0.05), (90, 130))
    )
    right = Body(
        "right", _marked(mesh, (30, 60, 190), round_mark=False), _stay(rng, (0.12, 0.03), (0.23, 0.0), (185, 225))
    )
    return _scene(rng, (left, right), _standing(300), [(left, 90, 130), (right, 185, 225)])


def late_object(seed: int) -> Scenario:
    """A carton is there from the start; a tin comes in at frame 60, and is hidden later on."""
    rng = np.random.default_rng([seed, 1])
    carton = Body("box", _carton(rng), _stay(rng, (-0.20, 0.02), (-0.20, 0.02)))
    T = _stay(rng, (0.08, 0.0), (0.22, 0.05), (190, 230))
    coming = np.clip((np.arange(300) - 60) / 35, 0, 1)
    T[:, 0, 3] += eased(0.62 * (1 - coming), 4)
    tin = Body("can", _tin(rng), T)
    return _scene(rng, (carton, tin), _standing(300), [(tin, 190, 230)])


def three_objects(seed: int) -> Scenario:
    """A carton, a tin and a block, hidden by a hand one after the other."""
    rng = np.random.default_rng([seed, 1])
    carton = Body("box", _carton(rng), _stay(rng, (-0.27, 0.02), (-0.18, 0.10), (95, 127)))
    tin = Body("can", _tin(rng), _stay(rng, (-0.03, -0.02), (0.05, 0.07), (157, 189)))
    block = Body("block", shapes.block(rng, 0.05, 0.11), _stay(rng, (0.27, 0.02), (0.18, 0.10), (219, 251)))
    hidden = [(carton, 95, 127), (tin, 157, 189), (block, 219, 251)]
    return _scene(rng, (carton, tin, block), _standing(300), hidden)


def moving_camera(seed: int) -> Scenario:
    """As ``occlusion``, seen by a camera that a hand carries about."""
    rng = np.random.default_rng([seed, 1])
    carton = Body("box", _carton(rng), _stay(rng, (-0.12, 0.0), (0.06, 0.05), (120, 165)))
    tin = Body("can", _tin(rng), _stay(rng, (0.24, 0.05), (0.24, 0.05)))
    time = np.arange(300)[:, None] / rng.uniform(170, 230, 3) + rng.uniform(0, 1, 3)
    eyes = _EYE + np.array([0.16, 0.05, 0.06]) * np.sin(2 * np.pi * time)
    return _scene(rng, (carton, tin), np.stack([look_at(eye, _TARGET) for eye in eyes]), [(carton, 120, 165)])


def _carton(rng: np.random.Generator) -> Mesh:
    return shapes.box(rng, tuple(np.array([0.10, 0.055, 0.14]) * rng.uniform(0.95, 1.05, 3)))


def _tin(rng: np.random.Generator) -> Mesh:
    return shapes.can(rng, 0.038 * rng.uniform(0.95, 1.05), 0.11 * rng.uniform(0.95, 1.05))


def _marked(mesh: Mesh, ink: tuple[int, int, int], round_mark: bool) -> Mesh:
    """A carton with one mark on its front, whose print is the texture's upper left (see ``shapes.box``)."""
    texture = mesh.texture.copy()
    across, size = int(0.10 * shapes.TEXELS_PER_M), int(0.02 * shapes.TEXELS_PER_M)
    at = int(0.72 * across), int(0.40 * 0.14 * shapes.TEXELS_PER_M)
    cv2.circle(texture, at, int(1.3 * size), (245, 245, 240), -1, cv2.LINE_AA)
    if round_mark:
        cv2.circle(texture, at, size, ink, -1, cv2.LINE_AA)
    else:
        cv2.rectangle(texture, (at[0] - size, at[1] - size // 3), (at[0] + size, at[1] + size // 3), ink, -1)
    return replace(mesh, texture=texture)


def _standing(frames: int) -> np.ndarray:
    return np.broadcast_to(look_at(_EYE, _TARGET), (frames, 4, 4))


def _stay(
    rng: np.random.Generator, here: tuple[float, float], there: tuple[float, float], away: tuple[int, int] = (120, 160)
) -> np.ndarray:
    """Poses (300, 4, 4) about ``here``, and about ``there`` from the frames ``away`` on.

    It shows its front and sways by 40 degrees to both sides before it goes: it returns within what was seen.
    """
    (x, y), (u, v), (a, b) = here, there, away
    keys = [
        (0, x, y, 0.13, -42, 4, -3),
        (a * 0.35, x, y, 0.15, 42, -4, 4),
        (a - 14, x, y, 0.13, -18, 3, -3),
        (a + 4, x, y, 0.13, -18, 3, -3),
        (b - 6, u, v, 0.15, 30, -3, 3),
        (b + 14, u, v, 0.15, 28, 3, 3),
        ((b + 299) / 2 + 5, u, v, 0.13, -28, -4, -3),
        (299, u, v, 0.14, 32, 4, 4),
    ]
    varying = varied(rng, keys, 0.0, 1.0)
    varying[3, 1:] = varying[2, 1:] + rng.uniform(-0.002, 0.002, 6)
    return path(varying, 300)


def _scene(rng: np.random.Generator, bodies: tuple, T_world_cam: np.ndarray, hidden: list[tuple]) -> Scenario:
    """The bodies in a room, and a hand that rises from below to hide each (body, from frame, to frame) in turn."""
    if hidden:
        T_cam_hand = _hand_path(T_world_cam, hidden)
        bodies = (*bodies, Body("hand", hand(rng), T_world_cam @ T_cam_hand, labelled=False))
    return Scenario(VGA, T_world_cam, bodies, room(rng))


def _hand_path(T_world_cam: np.ndarray, hidden: list[tuple]) -> np.ndarray:
    """T_cam_hand (T, 4, 4): fingers up, flat to the camera, on the line of sight while it hides something."""
    from scipy.interpolate import PchipInterpolator

    frames, below = len(T_world_cam), np.array([0.0, 0.42, 0.0])
    keys, points = [], []
    for body, start, stop in hidden:
        p_cam = se3.transform(se3.inverse(T_world_cam), body.T_world_model[:, :3, 3][:, None])[:, 0]
        at = np.linspace(start, stop, 12).round().astype(int)
        keys += [start - 14, *at, stop + 14]
        over = _HAND_SHARE * p_cam[at]
        points += [over[0] + below, *over, over[-1] + below]
    keys, points = [-1.0, *keys, float(frames)], [points[0], *points, points[-1]]
    T = np.tile(se3.from_rt(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3)), (frames, 1, 1))
    T[:, :3, 3] = eased(PchipInterpolator(keys, np.array(points))(np.arange(frames)), 1.5)
    return T
