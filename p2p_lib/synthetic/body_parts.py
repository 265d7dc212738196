"""A hand with its forearm: what hides things in front of real cameras."""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic import labels
from p2p_lib.synthetic.crockery import revolved
from p2p_lib.synthetic.shapes import Mesh


def hand(rng: np.random.Generator) -> Mesh:
    """A right hand held flat, fingers together and up (+z), palm towards -y, its middle at the origin; plain skin."""
    size = rng.uniform(0.95, 1.08)
    skin = _skin(rng)
    fingers = [(-0.0285, 0.066), (-0.0095, 0.078), (0.0095, 0.073), (0.0285, 0.058)]
    parts = [
        _limb(skin, 0.030, 0.30, (0, 0, -0.20), (1.0, 0.8, 1.0)),
        _limb(skin, 0.046, 0.112, (0, 0, -0.035), (1.0, 0.35, 1.0)),
        _limb(skin, 0.011, 0.075, (-0.050, 0, -0.025), (1.0, 1.0, 1.0), lean_rad=-0.5),
        *(_limb(skin, 0.0105, 2 * tall, (x, 0, 0.016), (1.0, 1.0, 1.0)) for x, tall in fingers),
    ]
    first = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Mesh(
        size * np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + k for p, k in zip(parts, first, strict=False)]),
        np.concatenate([p.uv for p in parts]),
        skin,
        np.concatenate([p.normals for p in parts]),
    )


def _limb(
    texture: np.ndarray, radius_m: float, length_m: float, at: tuple, squash: tuple, lean_rad: float = 0.0
) -> Mesh:
    """A capsule along z, squashed along its axes, leant sideways, moved."""
    angle = np.linspace(0, np.pi / 2, 6)
    cap = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    profile = np.concatenate([cap - [0, length_m / 2], [1, -1] * cap[::-1] + [0, length_m / 2]])
    mesh = revolved(profile, texture, segments=20)
    T = se3.exp(np.array([0, lean_rad, 0, 0, 0, 0.0]))
    normals = mesh.normals / np.array(squash)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True) @ T[:3, :3].T
    return Mesh(se3.transform(T, mesh.vertices * squash) + at, mesh.faces, mesh.uv, texture, normals)


def _skin(rng: np.random.Generator) -> np.ndarray:
    tone = np.float32([205, 160, 132]) * np.float32(rng.uniform(0.55, 1.05))
    blotches = labels.smooth_noise(rng, 256, 512, (3, 6), 5)[..., None]
    return np.clip(tone * (1 + 0.08 * blotches), 0, 255).astype(np.uint8)
