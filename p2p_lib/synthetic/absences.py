"""Absence and return: hidden by a hand or a board, out of the image, look-alikes, a late object, a moving camera.

An object that is away moves by more than 10 cm and turns by more than 30 degrees, and comes back showing a side that
was seen before; what :func:`other_side`, :func:`look_away` and :func:`half_hidden_start` do, they say. Times are
frames of 30 a second.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic import shapes
from p2p_lib.synthetic.motion import eased, look_at, path, standing, through, turned, varied, wander
from p2p_lib.synthetic.scene import VGA, Body, Scenario, check, room
from p2p_lib.synthetic.shapes import Mesh
from p2p_lib.synthetic.solids import hand

_EYE, _TARGET = np.array([0.0, -0.62, 0.42]), np.array([0.0, 0.03, 0.12])
_LOW_EYE = np.array([0.0, -0.60, 0.22])
_FRAMES = 300
#: How far along the line from the camera to what it hides: there a hand covers 20 cm, a board more.
_HAND_SHARE, _BOARD_SHARE = 0.42, 0.62
#: Where an object stands on the table, x and y in metres.
Place = tuple[float, float]
#: A body, and from which frame to which a hand hides it, if ever.
Placed = tuple[Body, tuple[int, int] | None]

#: Of ``crossing``: frame, x, y, z (metres, model centre in the world), yaw, pitch, roll (degrees).
_CROSSING_CARTON = [
    (0, -0.17, -0.01, 0.130, -30, 4, -3),
    (45, -0.08, -0.09, 0.135, 32, -6, 5),
    (85, 0.07, -0.07, 0.130, 85, 5, 4),
    (120, 0.17, 0.00, 0.150, 126, 8, -6),
    (160, 0.20, 0.06, 0.165, 138, -4, -8),
    (205, 0.05, 0.01, 0.135, 184, -6, 6),
    (262, -0.06, 0.06, 0.140, 248, 4, 4),
    (299, -0.16, 0.02, 0.130, 300, -4, -4),
]
_CROSSING_TIN = [
    (0, 0.16, 0.04, 0.120, 0, -8, 6),
    (45, 0.09, 0.09, 0.150, 56, 6, -8),
    (85, -0.06, 0.08, 0.135, 112, 10, 4),
    (116, -0.16, 0.05, 0.130, 150, -6, 8),
    (156, -0.02, -0.03, 0.120, 106, 4, -4),
    (200, -0.12, -0.06, 0.115, 60, -8, 6),
    (250, -0.03, -0.12, 0.120, -10, 6, 8),
    (299, 0.15, -0.05, 0.130, -80, -6, -6),
]
_EXIT = [
    (0, 0.05, 0.0, 0.16, -40, 4, -3),
    (50, -0.05, 0.03, 0.18, 40, -4, 4),
    (105, -0.14, 0.06, 0.22, -12, 3, -3),
    (135, -0.66, 0.06, 0.22, -14, 0, 0),
    (165, -0.66, -0.06, 0.09, 30, 0, 0),
    (195, -0.12, -0.06, 0.09, 28, 3, 3),
    (245, 0.05, 0.0, 0.14, -25, -4, -3),
    (299, -0.02, 0.03, 0.16, 35, 4, 4),
]
#: Of ``other_side``: front and right side, hidden, back and left side, then around in view to the front again.
_OTHER_SIDE = [
    (0, -0.10, 0.00, 0.19, 10, 0, 0),
    (40, -0.10, 0.01, 0.20, 34, 2, -2),
    (81, -0.10, 0.00, 0.19, 12, -2, 2),
    (99, -0.10, 0.00, 0.19, 12, -2, 2),
    (131, 0.03, 0.03, 0.20, 191, 1, -1),
    (150, 0.03, 0.03, 0.19, 192, 1, -1),
    (190, 0.04, 0.02, 0.20, 214, -2, 2),
    (225, 0.03, 0.00, 0.19, 196, 2, 2),
    (325, -0.02, 0.00, 0.19, 378, -2, -2),
    (359, -0.02, 0.00, 0.20, 390, 0, 2),
]
#: Of ``look_away``: the camera's distance (m), height, place about the table before and after, and pan away (degrees).
_AWAY_M, _AWAY_HEIGHT, _AWAY_PLACES, _AWAY_PAN = 0.68, 33.0, (-20.0, 30.0), 78.0


def crossing(seed: int, frames: int = _FRAMES, contrast: float = 1.0) -> Scenario:
    """A carton and a tin that pass in front of each other twice and are hidden once each.

    In between, a board sweeps over first the tin, then the carton, and hides each completely while it
    moves by at least 10 cm and turns by at least 30 degrees: the tin back to where it was seen before, the
    carton on. Both turn by more than 90 degrees in all. ``frames`` stretches time, ``contrast`` fades the labels.
    """
    check("crossing", frames=(frames, 2, np.inf), contrast=(contrast, 0, 1))
    rng = np.random.default_rng([seed, 1])
    carton = shapes.box(rng, tuple(np.array([0.10, 0.055, 0.15]) * rng.uniform(0.94, 1.06, 3)), contrast)
    tin = shapes.can(rng, 0.04 * rng.uniform(0.95, 1.05), 0.115 * rng.uniform(0.95, 1.05), contrast)
    board = shapes.slab(rng, (0.16, 0.012, 0.20))
    mirrored = -1.0 if rng.uniform() < 0.5 else 1.0
    # The carton's wide panel is what shows before and after it is hidden.
    yaw_carton, yaw_tin = rng.choice([20, 200]) + rng.uniform(-20, 20), rng.uniform(-180, 180)
    T_carton = path(varied(rng, _CROSSING_CARTON, yaw_carton, mirrored), frames)
    T_tin = path(varied(rng, _CROSSING_TIN, yaw_tin, mirrored), frames)
    T_board = _board_path(frames, [(T_tin, 119, 153), (T_carton, 162, 200)], mirrored)
    bodies = (Body("box", carton, T_carton), Body("can", tin, T_tin), Body("board", board, T_board, labelled=False))
    return Scenario(VGA, standing(_EYE, _TARGET, frames), bodies, room(rng))


def occlusion(seed: int) -> Scenario:
    """A carton that a hand hides completely for about a second and a half; a tin beside it stays in view."""
    rng = np.random.default_rng([seed, 1])
    return _scene(rng, _carton_and_tin(rng))


def exit_reentry(seed: int) -> Scenario:
    """A carton that leaves the image at one side and comes back 15 cm lower and nearer, turned."""
    rng = np.random.default_rng([seed, 1])
    keys = varied(rng, _EXIT, mirrored=rng.choice([-1.0, 1.0]))
    return _scene(rng, [(Body("box", _carton(rng), path(keys, _FRAMES)), None)])


def look_alikes(seed: int) -> Scenario:
    """Two cartons with one label; only the mark on their fronts differs. A hand hides one, then the other."""
    rng = np.random.default_rng([seed, 1])
    mesh = _carton(rng)
    red, blue = _marked(mesh, (200, 40, 40), round_mark=True), _marked(mesh, (30, 60, 190), round_mark=False)
    left = _placed(rng, "left", red, (-0.20, 0.0), (-0.08, 0.05), (90, 130))
    right = _placed(rng, "right", blue, (0.12, 0.03), (0.23, 0.0), (185, 225))
    return _scene(rng, [left, right])


def late_object(seed: int) -> Scenario:
    """A carton is there from the start; a tin comes in at frame 60, and is hidden later on."""
    rng = np.random.default_rng([seed, 1])
    carton = _placed(rng, "box", _carton(rng), (-0.20, 0.02))
    T = _stay(rng, (0.08, 0.0), (0.22, 0.05), (190, 230))
    T[:, 0, 3] += eased(0.62 * (1 - np.clip((np.arange(_FRAMES) - 60) / 35, 0, 1)), 4)
    return _scene(rng, [carton, (Body("can", _tin(rng), T), (190, 230))])


def three_objects(seed: int) -> Scenario:
    """A carton, a tin and a block, hidden by a hand one after the other."""
    rng = np.random.default_rng([seed, 1])
    carton = _placed(rng, "box", _carton(rng), (-0.27, 0.02), (-0.18, 0.10), (95, 127))
    tin = _placed(rng, "can", _tin(rng), (-0.03, -0.02), (0.05, 0.07), (157, 189))
    block = _placed(rng, "block", shapes.block(rng, 0.05, 0.11), (0.27, 0.02), (0.18, 0.10), (219, 251))
    return _scene(rng, [carton, tin, block])


def moving_camera(seed: int) -> Scenario:
    """As ``occlusion``, seen by a camera that a hand carries about."""
    rng = np.random.default_rng([seed, 1])
    placed = _carton_and_tin(rng)
    time = np.arange(_FRAMES)[:, None] / rng.uniform(170, 230, 3) + rng.uniform(0, 1, 3)
    eyes = _EYE + np.array([0.16, 0.05, 0.06]) * np.sin(2 * np.pi * time)
    return _scene(rng, placed, np.stack([look_at(eye, _TARGET) for eye in eyes]))


def other_side(seed: int) -> Scenario:
    """A flat carton returns from behind a hand with a side never seen; later it turns to the one that was."""
    rng = np.random.default_rng([seed, 1])
    mesh = shapes.box(rng, tuple(np.array([0.105, 0.035, 0.14]) * rng.uniform(0.95, 1.05, 3)))
    T = path(varied(rng, _OTHER_SIDE, mirrored=rng.choice([-1.0, 1.0])), 360)
    return _scene(rng, [(Body("box", mesh, T), (97, 133))], standing(_LOW_EYE, _TARGET, 360))


def look_away(seed: int) -> Scenario:
    """A carried camera looks away from four objects on a table and returns from another side; one was moved meanwhile.

    The others never move.
    """
    rng = np.random.default_rng([seed, 1])
    meshes = {"box": _carton(rng), "can": _tin(rng), "block": shapes.block(rng, 0.045, 0.09)}
    meshes["pack"] = shapes.box(rng, (0.09, 0.06, 0.05))
    moved, way = rng.integers(4), rng.choice([-1.0, 1.0])
    bodies = []
    for k, (name, mesh) in enumerate(meshes.items()):
        place = np.array([0.13 * k - 0.195, 0.065 * (-1) ** k, 0]) + np.r_[rng.uniform(-0.01, 0.01, 2), 0]
        T = np.repeat(_standing(mesh, place, rng.uniform(-0.4, 0.4))[None], _FRAMES, 0)
        if k == moved:
            place[1] -= 0.13 * (-1) ** k
            T[150:] = _standing(mesh, place, rng.choice([-1, 1]) * rng.uniform(0.7, 1.2))
        bodies.append(Body(name, mesh, T))
    return Scenario(VGA, _panned(rng, way), tuple(bodies), room(rng))


def _standing(mesh: Mesh, place: np.ndarray, yaw_rad: float) -> np.ndarray:
    """T_world_model of a mesh that stands on the table."""
    up = np.array([0, 0, -mesh.vertices[:, 2].min()])
    return turned(se3.IDENTITY[None], np.array([yaw_rad]), place + up)[0]


def _panned(rng: np.random.Generator, way: float) -> np.ndarray:
    """T_world_cam (300, 4, 4) in a hand: at the table, at its side, at the table again from another side."""
    frames = np.arange(_FRAMES)
    before, after = _AWAY_PLACES
    places = [before, before + 8, before, before, after, after, after - 8, after]
    place = through([0, 50, 95, 118, 178, 200, 250, 299], places, frames, 4)
    pan = through([0, 95, 132, 164, 201, 299], [0, 0, _AWAY_PAN, _AWAY_PAN, 0, 0], frames, 3)
    centre, height = np.array([0.0, 0.0, 0.04]), np.radians(_AWAY_HEIGHT)
    about = np.radians(way * place)
    level = np.stack([np.sin(about), -np.cos(about), np.zeros(_FRAMES)], 1)
    eyes = centre + _AWAY_M * (np.cos(height) * level + [0, 0, np.sin(height)])
    T = np.stack([look_at(eye, centre) for eye in eyes])
    T[:, :3, :3] = se3.exp(np.radians(way * pan)[:, None] * np.array([0, 0, 1.0, 0, 0, 0]))[:, :3, :3] @ T[:, :3, :3]
    return T @ wander(rng, _FRAMES, 0.008, 1.5, 45)


def half_hidden_start(seed: int, models: str = "") -> Scenario:
    """Two objects that circle each other; at first the near one hides all but 10 to 40 % of the far one.

    ``models`` is a folder of YCB models with the banana and the foam brick; without it a flat tin and a carton.
    """
    rng = np.random.default_rng([seed, 1])
    share = rng.uniform(0.12, 0.38)
    if models:
        names = "011_banana", "061_foam_brick"
        meshes = [shapes.load_ycb(models, name) for name in names]
    else:
        names, meshes = ("tin", "box"), [shapes.box(rng, (0.10, 0.058, 0.035)), _carton(rng)]
    time, way = np.arange(_FRAMES) / _FRAMES, rng.choice([-1.0, 1.0])
    bodies = []
    for name, mesh, ahead in zip(names, meshes, (np.pi / 2, -np.pi / 2), strict=True):
        centre = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
        end_on = np.pi / 2 * (np.ptp(mesh.vertices, 0)[:2].argmax() == 0)
        yaw = end_on * (ahead > 0) + rng.uniform(-0.4, 0.4) - way * 2 * np.pi * time
        own = turned(wander(rng, _FRAMES, 0.006, 8.0, 200), yaw, np.zeros(3)) @ se3.from_rt(np.eye(3), -centre)
        bodies.append((name, mesh, ahead, own))

    def scenario(start_rad: float) -> Scenario:
        placed = []
        for name, mesh, ahead, own in bodies:
            angle = ahead + way * (start_rad + 4 * np.pi * time)
            at = np.stack([0.11 * np.cos(angle), 0.11 * np.sin(angle), np.full(_FRAMES, 0.14)], 1)
            placed.append(Body(name, mesh, se3.from_rt(np.eye(3), at) @ own))
        kind = "YCB models" if models else "procedural"
        return Scenario(VGA, standing(_LOW_EYE, _TARGET, _FRAMES), tuple(placed), walls, objects=kind)

    walls, (low, high) = room(rng), (0.0, np.pi / 3)
    for _ in range(6):
        midpoint = (low + high) / 2
        low, high = (low, midpoint) if _first_share(scenario(midpoint)) > share else (midpoint, high)
    return scenario(high)


def _first_share(scenario: Scenario) -> float:
    """Share of the first body's pixels that show at the first frame."""
    alone = replace(scenario, bodies=scenario.bodies[:1]).rendered(0).label
    shown = np.count_nonzero(scenario.rendered(0).label == 1)
    return int(shown) / max(int(np.count_nonzero(alone)), 1)


def _carton(rng: np.random.Generator) -> Mesh:
    return shapes.box(rng, tuple(np.array([0.10, 0.055, 0.14]) * rng.uniform(0.95, 1.05, 3)))


def _tin(rng: np.random.Generator) -> Mesh:
    return shapes.can(rng, 0.038 * rng.uniform(0.95, 1.05), 0.11 * rng.uniform(0.95, 1.05))


def _marked(mesh: Mesh, ink: tuple[int, int, int], round_mark: bool) -> Mesh:
    """A carton with one mark on its front, whose print is the texture's upper left (see ``shapes.box``)."""
    texture = mesh.texture.copy()
    size = int(0.02 * shapes.TEXELS_PER_M)
    x, y = int(0.72 * int(0.10 * shapes.TEXELS_PER_M)), int(0.40 * 0.14 * shapes.TEXELS_PER_M)
    cv2.circle(texture, (x, y), int(1.3 * size), (245, 245, 240), -1, cv2.LINE_AA)
    if round_mark:
        cv2.circle(texture, (x, y), size, ink, -1, cv2.LINE_AA)
    else:
        cv2.rectangle(texture, (x - size, y - size // 3), (x + size, y + size // 3), ink, -1)
    return replace(mesh, texture=texture)


def _carton_and_tin(rng: np.random.Generator) -> list[Placed]:
    carton = _placed(rng, "box", _carton(rng), (-0.12, 0.0), (0.06, 0.05), (120, 165))
    return [carton, _placed(rng, "can", _tin(rng), (0.24, 0.05))]


def _placed(
    rng: np.random.Generator,
    name: str,
    mesh: Mesh,
    here: Place,
    there: Place | None = None,
    hidden: tuple[int, int] | None = None,
) -> Placed:
    """A body about one place, and, after a hand has hidden it for the frames ``hidden``, about another."""
    return Body(name, mesh, _stay(rng, here, there or here, hidden or (120, 160))), hidden


def _stay(rng: np.random.Generator, here: Place, there: Place, away: tuple[int, int]) -> np.ndarray:
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
    varying = varied(rng, keys)
    varying[3, 1:] = varying[2, 1:] + rng.uniform(-0.002, 0.002, 6)
    return path(varying, _FRAMES)


def _scene(rng: np.random.Generator, placed: list[Placed], T_world_cam: np.ndarray | None = None) -> Scenario:
    """The bodies in a room, and a hand that rises from below to hide each in its time; the camera stands still."""
    T_world_cam = standing(_EYE, _TARGET, _FRAMES) if T_world_cam is None else T_world_cam
    bodies = [body for body, _ in placed]
    hidden = [(body.T_world_model, *frames) for body, frames in placed if frames]
    if hidden:
        T_world_hand = T_world_cam @ _hand_path(T_world_cam, hidden)
        bodies.append(Body("hand", hand(rng), T_world_hand, labelled=False))
    return Scenario(VGA, T_world_cam, tuple(bodies), room(rng))


def _hand_path(T_world_cam: np.ndarray, hidden: list[tuple[np.ndarray, int, int]]) -> np.ndarray:
    """T_cam_hand (T, 4, 4): fingers up, flat to the camera, on the line of sight while it hides something."""
    frames, below = len(T_world_cam), np.array([0.0, 0.42, 0.0])
    keys, points = [], []
    for T_world_model, start, stop in hidden:
        p_cam = (se3.inverse(T_world_cam) @ T_world_model)[:, :3, 3]
        at = np.linspace(start, stop, 12).round().astype(int)
        keys += [start - 14, *at, stop + 14]
        over = _HAND_SHARE * p_cam[at]
        points += [over[0] + below, *over, over[-1] + below]
    keys, points = [-1.0, *keys, float(frames)], [points[0], *points, points[-1]]
    at = through(keys, np.array(points), np.arange(frames), 1.5)
    return se3.from_rt(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), at)


def _board_path(frames: int, hidden: list[tuple[np.ndarray, int, int]], mirrored: float) -> np.ndarray:
    """T_world_board (T, 4, 4): in from the side, on the line of sight to one object after the other, and out.

    ``hidden`` are (T_world_model, from, to) with frames counted in 300.
    """
    scale = (frames - 1) / 299
    side = np.array([-mirrored * 0.42, -0.2, 0.25])
    keys, points = [0.0, hidden[0][1] - 10], [side, side]
    for T_world_model, start, stop in hidden:
        at = np.linspace(start, stop, 6)
        keys += [*at]
        points += [_EYE + _BOARD_SHARE * (T_world_model[round(t * scale), :3, 3] - _EYE) for t in at]
    keys += [keys[-1] + 10, 299.0]
    points += [side * [-1, 1, 1]] * 2
    at = through(keys, np.array(points), np.linspace(0, 299, frames), scale)
    return se3.from_rt(se3.exp(np.array([-0.4, 0, 0, 0, 0, 0.0]))[:3, :3], at)
