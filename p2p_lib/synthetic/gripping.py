"""A hand of capsules that closes around a thing: palm, jointed fingers, a forearm in a sleeve.

Hand frame: its origin is the middle of the palm, +z points along the fingers, the palm looks towards -y, and the thumb
is at -x (a right hand). A digit bends about one axis at each of its three joints, all the angles of a hand are (5, 3)
radians, thumb first.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic import labels
from p2p_lib.synthetic.shapes import Mesh, Patch, assembled
from p2p_lib.synthetic.solids import limb

#: Where each digit begins, the axis that it bends about (right-handed), and where it points when straight.
_BASES = np.array(
    [[-0.030, -0.010, -0.018], [-0.030, 0, 0.046], [-0.010, 0, 0.050], [0.010, 0, 0.047], [0.029, 0, 0.04]]
)
_THUMB = np.array([-0.80, -0.15, 0.58]), np.array([0.25, -0.90, 0.35])
_LENGTHS = np.array(
    [[0.042, 0.034, 0.026], [0.044, 0.026, 0.020], [0.048, 0.030, 0.021], [0.045, 0.028, 0.020], [0.035, 0.021, 0.018]]
)
_RADII = np.array([[0.0125, 0.0110, 0.0100], *[[0.0098, 0.0088, 0.0080]] * 3, [0.0085, 0.0076, 0.0070]])
#: Half the width and thickness of the palm, half its length between the ends' middles.
_PALM = np.array([0.043, 0.015]), 0.012
_WRIST = np.array([0, 0.002, -0.058])
_FOREARM_M, _FOREARM_RADIUS, _SLEEVE_FROM, _SLEEVE_RADIUS = 0.36, 0.027, 0.075, 0.043
#: Angles of a hand that is open, and how far each joint bends.
OPEN = np.radians([[0, 5, 5], [4, 8, 5], [2, 8, 5], [4, 8, 5], [8, 10, 6]])
_FURTHEST = np.radians([[75, 55, 70], *[[85, 100, 70]] * 4])
#: How many balls fill a phalanx.
_BALLS = 3


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


_STRAIGHT = np.array([_unit(_THUMB[0]), *_unit(np.array([[-0.06, 0, 1], [0, 0, 1], [0.05, 0, 1], [0.12, 0, 1.0]]))])
_AXES = np.array([_unit(np.cross(*_THUMB)), *_unit(np.cross(_STRAIGHT[1:], [0, -1.0, 0]))])


@dataclass(frozen=True, eq=False)
class Hand:
    """The look of a hand: meshes by part, the size that scales all of it, and which hand it is (1 right, -1 left)."""

    parts: dict[str, Mesh]
    size: float
    side: float

    def joints(self, angles: np.ndarray) -> np.ndarray:
        """Ends of all phalanges (..., 5, 4, 3) in the hand frame at joint angles (..., 5, 3)."""
        bent = np.cumsum(angles, -1)[..., None]
        steps = _LENGTHS[..., None] * (
            np.cos(bent) * _STRAIGHT[:, None] + np.sin(bent) * np.cross(_AXES, _STRAIGHT)[:, None]
        )
        start = np.broadcast_to(_BASES[:, None], (*angles.shape[:-2], 5, 1, 3))
        ends = np.concatenate([start, start + np.cumsum(steps, -2)], -2)
        return self.size * ends * [self.side, 1, 1]

    def spheres(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middles (..., S, 3) in the hand frame and radii (S,) of balls that fill palm and fingers."""
        ends = self.joints(angles)
        share = np.linspace(0, 1, _BALLS)[:, None]
        along = ends[..., :-1, None, :] + share * (ends[..., 1:, None, :] - ends[..., :-1, None, :])
        digits = along.reshape(*angles.shape[:-2], -1, 3)
        radii = np.repeat(_RADII.ravel(), _BALLS)
        x, z = np.meshgrid(np.linspace(-0.028, 0.028, 4), np.linspace(-0.044, 0.034, 5))
        palm = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], 1)
        palm = np.broadcast_to(self.size * palm, (*angles.shape[:-2], len(palm), 3))
        return np.concatenate([digits, palm], -2), self.size * np.r_[radii, np.full(palm.shape[-2], _PALM[0][1])]

    def wrist(self, T_world_hand: np.ndarray) -> np.ndarray:
        """(..., 3) in the world."""
        return se3.transform(T_world_hand, self.size * _WRIST[None])[..., 0, :]

    def poses(self, T_world_hand: np.ndarray, angles: np.ndarray, elbow: np.ndarray) -> dict[str, np.ndarray]:
        """T_world_part (T, 4, 4) of every part, the hand at (T, 4, 4), its joints at (T, 5, 3), the elbow at (T, 3)."""
        ends = se3.transform(T_world_hand[:, None], self.joints(angles))
        across = np.einsum("tij,kj->tki", T_world_hand[:, :3, :3], _AXES * [1, self.side, self.side])
        found = {"palm": T_world_hand}
        for k in range(5):
            for j in range(3):
                found[f"digit_{k}{j}"] = _along(ends[:, k, j], ends[:, k, j + 1], across[:, k])
        wrist = self.wrist(T_world_hand)
        forearm = _along(wrist, elbow, T_world_hand[:, :3, 0])
        forearm[:, :3, 3] = wrist
        return found | {"forearm": forearm, "sleeve": forearm}


def _along(start: np.ndarray, end: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) in the middle between two points, z from the one to the other, x as near ``across`` as can be."""
    z = _unit(end - start)
    x = _unit(across - np.sum(across * z, -1, keepdims=True) * z)
    return se3.from_rt(np.stack([x, np.cross(z, x), z], -1), (start + end) / 2)


def make_hand(rng: np.random.Generator) -> Hand:
    """A hand of some size and skin, in a sleeve of some cloth; left or right."""
    size, side = rng.uniform(0.95, 1.08), rng.choice([-1.0, 1.0])
    skin, sleeve = _skin(rng), cloth(rng)
    parts = {}
    half, flat = _PALM[0], _PALM[0][1] / _PALM[0][0]
    slabs = [limb(skin, half[0], 2 * (half[0] + _PALM[1]), (0, 0, -0.004), (1.0, flat, 1.0))]
    thumb = np.array([-0.016 * side, -0.006, -0.034]), _BASES[0] * [side, 1, 1]
    lean = np.arctan2(thumb[1][0] - thumb[0][0], thumb[1][2] - thumb[0][2])
    slabs.append(limb(skin, 0.0165, 0.062, tuple((thumb[0] + thumb[1]) / 2), lean_rad=lean))
    slabs.append(limb(skin, 0.024, 0.06, (0, 0.001, -0.055), (1.1, 0.8, 1.0)))
    parts["palm"] = _joined(slabs, skin, size)
    for k in range(5):
        for j in range(3):
            page = _finger(rng, skin, nail=j == 2)
            whole = _LENGTHS[k, j] + 2 * _RADII[k, j]
            parts[f"digit_{k}{j}"] = _joined([limb(page, _RADII[k, j], whole, (0, 0, 0))], page, size)
    arm = limb(skin, _FOREARM_RADIUS, 0.20, (0, 0, 0.075), (1.1, 0.85, 1.0))
    parts["forearm"] = _joined([arm], skin, size)
    folds = _FOREARM_M + _SLEEVE_RADIUS
    cuff = limb(sleeve, _SLEEVE_RADIUS, folds, (0, 0, _SLEEVE_FROM + folds / 2 - 0.03), (1.0, 0.85, 1.0))
    parts["sleeve"] = _joined([cuff], sleeve, size)
    return Hand(parts, size, side)


def closed(hand: Hand, thing: Mesh, T_thing_hand: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles (5, 3) at which each digit first touches a thing, joint by joint from the palm; which do (5,)."""
    angles, touches = OPEN.copy(), np.zeros(5, bool)
    for j in range(3):
        sweep = np.linspace(OPEN[:, j], _FURTHEST[:, j], 20)  # (20, 5)
        tried = np.repeat(angles[None], len(sweep), 0)
        tried[..., j] = sweep
        gap = _gaps(hand, thing, T_thing_hand, tried, from_joint=j)  # (20, 5)
        free = np.logical_and.accumulate(gap > 0.0005, 0)
        last = np.maximum(free.sum(0) - 1, 0)
        angles[:, j] = sweep[last, np.arange(5)]
        touches |= ~free.all(0)
    return angles, touches


def _gaps(hand: Hand, thing: Mesh, T_thing_hand: np.ndarray, angles: np.ndarray, from_joint: int) -> np.ndarray:
    """How far digits (N, 5) are from a thing, of their phalanges from one joint on; negative inside."""
    middles, radii = hand.spheres(angles)
    middles = middles[:, : 15 * _BALLS].reshape(-1, 5, 3, _BALLS, 3)[:, :, from_joint:]
    radii = radii[: 15 * _BALLS].reshape(5, 3, _BALLS)[:, from_joint:]
    away = thing.distance(se3.transform(T_thing_hand, middles.reshape(-1, 3))).reshape(middles.shape[:-1])
    return (away - radii).min((-2, -1))


def _joined(limbs: list[Patch], image: np.ndarray, size: float) -> Mesh:
    corners, uv, normals = (np.concatenate([getattr(p, a) for p in limbs]) for a in ("corners", "uv", "normals"))
    return assembled([Patch(size * corners, uv, normals, image)])


def _skin(rng: np.random.Generator) -> np.ndarray:
    """Skin (512, 512, 3) uint8: a tone, redder and paler blotches, pores."""
    light = rng.uniform(0.45, 1.05)
    tone = (
        np.array([208, 158, 132], np.float32)
        * np.float32(light)
        * np.array([1, rng.uniform(0.94, 1.02), rng.uniform(0.9, 1.0)], np.float32)
    )
    blotches = labels.smooth_noise(rng, 512, 512, (4, 5), 5)[..., None] * np.array([0.05, 0.10, 0.11], np.float32)
    shade = labels.smooth_noise(rng, 512, 512, (2, 2), 3)[..., None] * 0.07
    pores = cv2.GaussianBlur(rng.standard_normal((512, 512), np.float32), (0, 0), 1.2)[..., None] * 0.05
    return np.clip(tone * (1 + blotches + shade + pores), 0, 255).astype(np.uint8)


def _finger(rng: np.random.Generator, skin: np.ndarray, nail: bool) -> np.ndarray:
    """A phalanx (128, 128, 3): a piece of skin with the creases of its joints, redder at the tip, perhaps a nail."""
    u, v = rng.integers(0, 384, 2)
    page: np.ndarray = skin[v : v + 128, u : u + 128].astype(np.float32)
    page = cv2.resize(page, (128, 128))
    for row in (18, 22, 27, 104, 110):
        depth = rng.uniform(0.78, 0.92)
        wave = (row + 1.5 * np.sin(np.linspace(0, 6, 128) + rng.uniform(0, 6))).round().astype(int)
        page[np.clip(wave, 0, 127), np.arange(128)] *= depth
    if nail:  # the image's top is the end, and the back of the hand (+y) a quarter around
        page[:40] *= np.array([1.03, 0.93, 0.92], np.float32)
        cv2.ellipse(
            page,
            (32, 34),
            (13, 22),
            0,
            0,
            360,
            tuple(float(c) for c in page.mean((0, 1)) * [1.12, 1.06, 1.08]),
            -1,
            cv2.LINE_AA,
        )
    return np.clip(page, 0, 255).astype(np.uint8)


def cloth(rng: np.random.Generator) -> np.ndarray:
    """A sleeve (512, 512, 3): one colour, a weave, folds across."""
    hsv = np.array([[[rng.integers(0, 180), rng.integers(10, 120), rng.integers(50, 200)]]], np.uint8)
    tone = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float32)
    folds = 0.22 * labels.smooth_noise(rng, 512, 512, (3, 12), 3)
    weave = 0.05 * np.sign(np.sin(np.arange(512) * 1.3))[None] * np.sign(np.sin(np.arange(512) * 1.3))[:, None]
    return np.clip(tone * (1 + folds + weave)[..., None], 0, 255).astype(np.uint8)
