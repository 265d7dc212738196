"""Scenarios: what stands where at which frame. Making one draws labels and paths from its seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.data.synthetic import labels, shapes
from p2p_lib.data.synthetic.render import Light
from p2p_lib.data.synthetic.shapes import Mesh

FPS = 30.0


@dataclass(frozen=True, eq=False)
class Body:
    """A moving mesh. ``T_world_model`` (T, 4, 4), one per frame. Only labelled bodies have masks, poses and tracks."""

    name: str
    mesh: Mesh
    T_world_model: np.ndarray
    labelled: bool = True


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scene in time. World: z up, the table top is z = 0. ``T_world_cam`` (T, 4, 4)."""

    camera: Camera
    T_world_cam: np.ndarray
    bodies: tuple[Body, ...]
    room: tuple[Mesh, ...]
    light: Light = field(default_factory=Light)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.T_world_cam)


def crossing(seed: int, frames: int = 300, contrast: float = 1.0) -> Scenario:
    """A carton and a tin that pass in front of each other twice and are hidden once each.

    In between, a board sweeps over first the tin, then the carton, and hides each completely while it
    moves by at least 10 cm and turns by at least 30 degrees: the tin back to where it was seen before, the
    carton on. Both turn by more than 90 degrees in all. ``frames`` stretches time, ``contrast`` fades the labels.
    """
    if frames < 2 or not 0 <= contrast <= 1:
        raise BadInput("crossing", f"frames {frames}, contrast {contrast}", "at least 2 frames, contrast from 0 to 1")
    rng = np.random.default_rng([seed, 1])
    camera = Camera(615.0, 615.0, 319.5, 239.5, 640, 480)
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
    T_carton = _path(_varied(rng, path_carton, yaw_carton, mirrored), frames)
    T_tin = _path(_varied(rng, path_tin, yaw_tin, mirrored), frames)
    T_board = _sweep(eye, frames, (T_tin, 119, 153), (T_carton, 162, 200), mirrored)
    T_world_cam = np.broadcast_to(_look_at(eye, np.array([0, 0.03, 0.12])), (frames, 4, 4))
    bodies = (Body("box", carton, T_carton), Body("can", tin, T_tin), Body("board", board, T_board, labelled=False))
    return Scenario(camera, T_world_cam, bodies, _room(rng))


#: Every scenario by name; each takes the seed first and its own keyword parameters.
SCENARIOS: dict[str, Callable[..., Scenario]] = {"crossing": crossing}


def _room(rng: np.random.Generator) -> tuple[Mesh, ...]:
    """A table top and the wall behind it."""
    table = shapes.plane(
        labels.wood(rng, 1536, 1024), [[-0.9, -0.6, 0], [0.9, -0.6, 0], [0.9, 0.45, 0], [-0.9, 0.45, 0]]
    )
    wall = shapes.plane(
        labels.plaster(rng, 1024, 512), [[-1.6, 0.9, -0.6], [1.6, 0.9, -0.6], [1.6, 0.9, 1.2], [-1.6, 0.9, 1.2]]
    )
    return table, wall


def _varied(rng: np.random.Generator, keys: list[tuple], yaw_deg: float, mirrored: float) -> np.ndarray:
    """Keys (K, 7) moved by about a centimetre and a few degrees, turned by a yaw, perhaps mirrored left to right."""
    keys = np.array(keys, float)
    keys[:, 1:4] += rng.uniform(-0.008, 0.008, (len(keys), 3))
    keys[:, 4:] += rng.uniform(-3, 3, (len(keys), 3))
    keys[:, 4] += yaw_deg
    keys[:, [1, 4, 6]] *= mirrored
    return keys


def _path(keys: np.ndarray, frames: int) -> np.ndarray:
    """Smooth poses (frames, 4, 4) through keys of frame, x, y, z, yaw, pitch, roll (degrees)."""
    from scipy.interpolate import PchipInterpolator

    time = np.linspace(keys[0, 0], keys[-1, 0], frames)
    at = PchipInterpolator(keys[:, 0], keys[:, 1:])(time)
    # Monotone cubics have kinks in velocity at the keys; a hand has not.
    at = _eased(at, max(1, round(6 * frames / 300)))
    x, y, z = np.eye(3)
    angles = np.radians(at[:, 3:])
    yaw, pitch, roll = (_turn(axis, angles[:, k]) for k, axis in enumerate((z, x, y)))
    T = yaw @ pitch @ roll
    T[:, :3, 3] = at[:, :3]
    return T


def _eased(values: np.ndarray, sigma: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, sigma, axis=0, mode="nearest")


def _turn(axis: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Rotations (T, 4, 4) about one axis."""
    return se3.exp(np.concatenate([angle_rad[:, None] * axis, np.zeros((len(angle_rad), 3))], 1))


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_world_cam of an upright camera (x right, y down, z forward)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return se3.from_rt(np.stack([right, np.cross(forward, right), forward], 1), eye)


def _sweep(eye: np.ndarray, frames: int, first: tuple, second: tuple, mirrored: float) -> np.ndarray:
    """A board that comes in from the side, stays in the line of sight to one object, then to another, and leaves.

    ``first`` and ``second`` are (T_world_model, from, to) with frames counted in 300.
    """
    scale = (frames - 1) / 299
    side = np.array([-mirrored * 0.42, -0.2, 0.25])
    keys, points = [0.0], [side]
    for T, start, stop in (first, second):
        for t in np.linspace(start, stop, 6):
            keys.append(t)
            points.append(eye + 0.62 * (T[round(t * scale), :3, 3] - eye))
    keys += [keys[-1] + 10, 299.0]
    points += [side * [-1, 1, 1]] * 2
    keys.insert(1, first[1] - 10)
    points.insert(1, side)
    from scipy.interpolate import PchipInterpolator

    at = _eased(PchipInterpolator(keys, np.array(points))(np.linspace(0, 299, frames)), scale)
    T = np.broadcast_to(se3.exp(np.array([-0.4, 0, 0, 0, 0, 0.0])), (frames, 4, 4)).copy()
    T[:, :3, 3] = at
    return T
