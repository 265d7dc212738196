"""Soft shadows that bodies throw on what stands still: how much of a lamp's disc each point sees."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.raycasting import blocked
from p2p_lib.synthetic.render import Light, Rendering
from p2p_lib.synthetic.shapes import Mesh

#: Half the angle under which the lamp is seen, and the directions to it that are tried.
_LAMP_RAD = 0.14
_DISC = np.array([[0, 0], [1, 0], [-0.5, 0.87], [-0.5, -0.87]])
#: Every so many pixels a shadow is looked for, and how far from a body in metres.
_EVERY, _REACH_M = 4, 0.4


def shadowed(
    room: Rendering, bodies: Sequence[tuple[Mesh, np.ndarray]], camera: Camera, T_world_cam: np.ndarray, light: Light
) -> Rendering:
    """An image of the room with the shadows of bodies (mesh, T_world_model) in it; depth and labels stay."""
    v, u = (a.ravel() for a in np.mgrid[_EVERY // 2 : camera.height : _EVERY, _EVERY // 2 : camera.width : _EVERY])
    points = se3.transform(T_world_cam, camera.rays[v, u].astype(float) * room.depth_m[v, u, None])
    size = -(-camera.height // _EVERY), -(-camera.width // _EVERY)
    dark: np.ndarray = darkness(points, bodies, light).reshape(size).astype(np.float32)
    dark = cv2.resize(
        cv2.GaussianBlur(dark, (0, 0), 1.0), (camera.width, camera.height), interpolation=cv2.INTER_LINEAR
    )
    return Rendering(room.rgb * (1 - dark[..., None]), room.depth_m, room.label, room.cos_incidence)


def darkness(points: np.ndarray, bodies: Sequence[tuple[Mesh, np.ndarray]], light: Light) -> np.ndarray:
    """Share of their light (N,) that points (N, 3) in the world lose to bodies, 0 to ``light.shadow``."""
    towards = np.asarray(light.towards, float) / np.linalg.norm(light.towards)
    side = np.cross(towards, [1.0, 0, 0])
    side /= np.linalg.norm(side)
    lost = np.zeros((len(_DISC), len(points)), bool)
    for lost_k, (a, b) in zip(lost, _DISC * _LAMP_RAD, strict=True):
        way = towards + a * side + b * np.cross(towards, side)
        for mesh, T in bodies:
            centre, radius = mesh.ball
            off = se3.transform(T, centre[None]) - points
            along = off @ way / (way @ way)
            near = ~lost_k & (along > 0) & (along < _REACH_M)
            near[near] = np.linalg.norm(off[near] - along[near, None] * way, axis=1) < radius
            lost_k[near] = _blocked(mesh, se3.inverse(T), points[near], way)
    return light.shadow * lost.mean(0)


def _blocked(mesh: Mesh, T_model_world: np.ndarray, points: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Whether a mesh is in the way of points (N, 3) in a direction (3,)."""
    if not len(points):
        return np.zeros(0, bool)
    return blocked(mesh.ray_scene, se3.transform(T_model_world, points), T_model_world[:3, :3] @ way)
