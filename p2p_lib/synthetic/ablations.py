"""Scenarios that are hard without one thing each: multiple hypotheses, the surface, the graph, or texture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2p_lib.synthetic import shapes, solids
from p2p_lib.synthetic.environment import living_room
from p2p_lib.synthetic.motion import standing, turned, wander
from p2p_lib.synthetic.render import Light
from p2p_lib.synthetic.scene import VGA, Body, Scenario, check, room

_CENTRE = np.array([0.0, 0.0, 0.11])


def mug(seed: int, frames: int = 240, reflectance: float = 0.05, windows: int = 2, marks: int = 8) -> Scenario:
    """A glazed mug turned to and fro about its own axis, in a room that its body mirrors.

    Windows and lamps lie on the body as bright, sharp corners that stay where they are while the mug turns:
    many 2D points say that it did not. The speckled handle and a few printed marks say that it did. Which is
    right, only the surface can tell. ``reflectance`` is the glaze's at normal incidence (0 = matt);
    more ``windows`` (0 to 4) and fewer ``marks`` make it harder.
    """
    limits = {"reflectance": (reflectance, 0, 1), "windows": (windows, 0, 4), "marks": (marks, 0, np.inf)}
    check("mug", frames=(frames, 2, np.inf), **limits)
    rng = np.random.default_rng([seed, 1])
    mesh = solids.mug(rng, 0.044 * rng.uniform(0.95, 1.05), 0.105 * rng.uniform(0.95, 1.05), reflectance, marks)
    # The handle swings by 2 x 70 degrees: from before the body, on one side of it, to just behind the outline.
    swing = np.radians(70) * np.sin(2 * np.pi * (np.arange(frames) / 230 + rng.choice([0, 0.5])))
    yaw = np.radians(-90 + rng.choice([-45, 45]) + rng.uniform(-8, 8)) + swing
    T = turned(wander(rng, frames, 0.02, 2.0, 150), yaw, _CENTRE)
    light = Light(environment=living_room(rng, windows))
    return _on_the_table(rng, Body("mug", mesh, T), (0.0, -0.44, 0.20), light)


def weak_texture(seed: int, frames: int = 240, contrast: float = 0.05) -> Scenario:
    """A leaning block with seven flat faces whose print is almost as pale as its ground.

    Few points, and poor ones; but no two directions of the shape are alike. ``contrast`` is that of the print.
    """
    check("weak_texture", frames=(frames, 2, np.inf), contrast=(contrast, 0, 1))
    rng = np.random.default_rng([seed, 1])
    mesh = shapes.block(rng, 0.055, 0.10, contrast)
    # Seen from above: the slanted top and two or three sides.
    yaw = np.radians(75) * np.sin(2 * np.pi * np.arange(frames) / 260 + rng.uniform(0, 2 * np.pi))
    T = turned(wander(rng, frames, 0.04, 15.0, 180), yaw, _CENTRE)
    return _on_the_table(rng, Body("block", mesh, T), (0.0, -0.36, 0.42))


def plain(seed: int, frames: int = 240) -> Scenario:
    """Three shapes in one colour each, without print: a leaning block, a mug (round but for its handle), a round tin.

    How far the tin has turned about its own axis, nothing tells.
    """
    check("plain", frames=(frames, 2, np.inf))
    rng = np.random.default_rng([seed, 1])
    meshes = {
        "block": shapes.block(rng, 0.05 * rng.uniform(0.95, 1.05), 0.10),
        "mug": solids.mug(rng, 0.042 * rng.uniform(0.95, 1.05), 0.095, reflectance=0.0, marks=0),
        "tin": shapes.can(rng, 0.038 * rng.uniform(0.95, 1.05), 0.105),
    }
    bodies = []
    for k, (name, mesh) in enumerate(meshes.items()):
        paint = np.broadcast_to(rng.integers(90, 230, 3).astype(np.uint8), mesh.texture.shape)
        # The handle stays to the side, in view.
        yaw = rng.choice([0, np.pi]) + np.radians(40) * np.sin(2 * np.pi * np.arange(frames) / 170 + rng.uniform(0, 6))
        T = turned(wander(rng, frames, 0.02, 10.0, 150), yaw, np.array([0.17 * (k - 1), 0.0, 0.11]))
        bodies.append(Body(name, replace(mesh, texture=np.ascontiguousarray(paint)), T))
    return Scenario(VGA, standing(np.array([0.0, -0.52, 0.36]), _CENTRE, frames), tuple(bodies), room(rng))


def fading_label(seed: int, frames: int = 180, contrast: float = 1.0) -> Scenario:
    """A tin turned to and fro about its own axis, which only its print tells; ``contrast`` fades that print.

    Sequences of one seed differ in nothing but the contrast: shape, path and the noise of the sensor are the same.
    """
    check("fading_label", frames=(frames, 2, np.inf), contrast=(contrast, 0, 1))
    rng = np.random.default_rng([seed, 1])
    mesh = shapes.can(rng, 0.045 * rng.uniform(0.95, 1.05), 0.12 * rng.uniform(0.95, 1.05), contrast)
    yaw = np.radians(65) * np.sin(2 * np.pi * np.arange(frames) / 180 + rng.uniform(0, 2 * np.pi))
    T = turned(wander(rng, frames, 0.03, 15.0, 150), yaw, _CENTRE)
    return _on_the_table(rng, Body("tin", mesh, T), (0.0, -0.40, 0.34))


def long_turning(seed: int, frames: int = 660) -> Scenario:
    """A tin that turns three times around while it sways: its axis changes, and views come back again and again.

    Only the print tells how far it has turned. Errors add up from keyframe to keyframe unless the views that come
    back are tied to those before. At least 300 frames: it turns by about two degrees a frame.
    """
    check("long_turning", frames=(frames, 300, np.inf))
    rng = np.random.default_rng([seed, 1])
    mesh = shapes.can(rng, 0.045 * rng.uniform(0.94, 1.06), 0.12 * rng.uniform(0.94, 1.06))
    yaw = np.radians(1.65) * np.arange(frames) * rng.choice([-1, 1]) + rng.uniform(0, 2 * np.pi)
    T = turned(wander(rng, frames, 0.03, 28.0, 260), yaw, _CENTRE)
    return _on_the_table(rng, Body("tin", mesh, T), (0.0, -0.85, 0.50))


def eight_objects(seed: int, frames: int = 90) -> Scenario:
    """Eight small cartons, tins and blocks in two rows, each swaying in its place; nothing is ever hidden."""
    check("eight_objects", frames=(frames, 2, np.inf))
    rng = np.random.default_rng([seed, 1])
    kinds = [lambda: shapes.box(rng, (0.07, 0.04, 0.09)), lambda: shapes.can(rng, 0.03, 0.08)]
    kinds.append(lambda: shapes.block(rng, 0.035, 0.08))
    bodies = []
    for k in range(8):
        place = np.array([-0.21 + 0.14 * (k % 4), 0.04 * (k // 4), 0.07 + 0.14 * (k // 4)])
        yaw = np.radians(40) * np.sin(2 * np.pi * np.arange(frames) / 120 + rng.uniform(0, 2 * np.pi))
        T = turned(wander(rng, frames, 0.01, 10.0, 120), yaw + rng.uniform(0, 2 * np.pi), place)
        bodies.append(Body(f"object_{k + 1}", kinds[k % 3](), T))
    T_world_cam = standing(np.array([0.0, -0.62, 0.34]), np.array([0.0, 0.02, 0.14]), frames)
    return Scenario(VGA, T_world_cam, tuple(bodies), room(rng))


def _on_the_table(
    rng: np.random.Generator, body: Body, eye: tuple[float, float, float], light: Light | None = None
) -> Scenario:
    """One body before a camera that stands still."""
    T_world_cam = standing(np.array(eye), _CENTRE, len(body.T_world_model))
    return Scenario(VGA, T_world_cam, (body,), room(rng), light or Light())
