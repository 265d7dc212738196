"""What a scene is made of: bodies that move, a room that stands still, light, a camera on its path."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic import labels, shapes
from p2p_lib.synthetic.render import Light, Rendering, render
from p2p_lib.synthetic.shapes import Mesh

FPS = 30.0
#: About a RealSense D435's colour camera.
VGA = Camera(615.0, 615.0, 319.5, 239.5, 640, 480)


@dataclass(frozen=True, eq=False)
class Body:
    """A moving mesh. ``T_world_model`` (T, 4, 4), one per frame. Only labelled bodies have masks, poses and tracks."""

    name: str
    mesh: Mesh
    T_world_model: np.ndarray
    labelled: bool = True


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scene in time. World: z up, the table top is z = 0.

    T_world_cam  (T, 4, 4)
    objects      what they are
    fps          frames a second
    shutter_s    for how long the shutter is open in this light; 0 = too short for motion to show
    """

    camera: Camera
    T_world_cam: np.ndarray
    bodies: tuple[Body, ...]
    room: tuple[Mesh, ...]
    light: Light = field(default_factory=Light)
    objects: str = "procedural"
    fps: float = FPS
    shutter_s: float = 0.0

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.T_world_cam)

    def rendered(self, t: float, room: Rendering | None = None) -> Rendering:
        """The scene at a frame, or between two; ``room`` is :meth:`empty` there, where the caller has it already."""
        return render(self.placed(t), self.camera, at_time(self.T_world_cam, t), self.light, room or self.empty(t))

    def placed(self, t: float) -> list[tuple[Mesh, np.ndarray]]:
        """Each body's mesh and T_world_model."""
        return [(body.mesh, at_time(body.T_world_model, t)) for body in self.bodies]

    def empty(self, t: float) -> Rendering:
        """The scene without its bodies; nothing in it carries a label."""
        walls = [(mesh, se3.IDENTITY) for mesh in self.room]
        return render(walls, self.camera, at_time(self.T_world_cam, t), self.light)


def at_time(T: np.ndarray, t: float) -> np.ndarray:
    """The pose at a fractional frame."""
    k = int(t)
    return T[k] if t == k else se3.interpolate(T[k], T[k + 1], t - k)


def check(scenario: str, **limits: tuple[float, float, float]) -> None:
    """Raises :class:`BadInput` where a parameter of a scenario, (value, least, most), is beyond its limits."""
    if not all(low <= value <= high for value, low, high in limits.values()):
        got = ", ".join(f"{name} {value}" for name, (value, _, _) in limits.items())
        expected = ", ".join(f"{name} from {low} to {high}" for name, (_, low, high) in limits.items())
        raise BadInput(scenario, got, expected)


def room(rng: np.random.Generator) -> tuple[Mesh, ...]:
    """A table top and the wall behind it."""
    table = [[-0.9, -0.6, 0], [0.9, -0.6, 0], [0.9, 0.45, 0], [-0.9, 0.45, 0]]
    wall = [[-1.6, 0.9, -0.6], [1.6, 0.9, -0.6], [1.6, 0.9, 1.2], [-1.6, 0.9, 1.2]]
    return shapes.plane(labels.wood(rng, 1536, 1024), table), shapes.plane(labels.plaster(rng, 1024, 512), wall)
