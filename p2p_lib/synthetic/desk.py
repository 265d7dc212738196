"""A cluttered desk: things that touch each other, looked over by a camera that is turned fast and shakes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.synthetic import labels, shapes, solids
from p2p_lib.synthetic.motion import look_at, through, turned, wander
from p2p_lib.synthetic.render import Light
from p2p_lib.synthetic.scene import Body, Scenario, check
from p2p_lib.synthetic.shadows import darkness
from p2p_lib.synthetic.shapes import Mesh, Patch, assembled

#: About a Kinect's.
KINECT = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
_EYE, _TARGET = np.array([0.02, -0.52, 0.43]), np.array([0.05, 0.04, 0.02])
#: How far the camera looks away: to a side, up (yaw and pitch: the things leave the image), rolled.
_AWAY_DEG = (38, 52), (30, 42), (30, 60)
#: Cell of the map of the desk that tells what is taken, and its half sides in cells.
_CELL_M, _HALF = 0.002, (450, 300)
#: Where the desk top lies.
_DESK_X, _DESK_Y = (-0.9, 0.9), (-0.36, 0.64)


def cluttered_desk(seed: int, frames: int = 210, fastest_deg: float = 5.0) -> Scenario:
    """Twelve things on a desk that touch, three of them labelled; a camera turned fast, by which they leave and return.

    ``fastest_deg`` is about the largest turn from frame to frame, besides what the shaking adds.
    """
    check("cluttered_desk", frames=(frames, 2, np.inf), fastest_deg=(fastest_deg, 0.1, 12))
    rng = np.random.default_rng([seed, 1])
    arranged = _arranged(rng)
    bodies = [Body(name, mesh, np.broadcast_to(T, (frames, 4, 4)), labelled) for name, mesh, T, labelled in arranged]
    light = Light(tuple(rng.uniform([-0.7, -0.6, 0.8], [0.7, 0.4, 1.2])), ambient=0.6, shadow=rng.uniform(0.25, 0.45))
    top = _desk_top(rng, [(mesh, T) for _, mesh, T, _ in arranged], light)
    T_world_cam = _carried(rng, frames, fastest_deg)
    return Scenario(KINECT, T_world_cam, tuple(bodies), (_office(rng, top),), light, shutter_s=1 / 70)


def _things(rng: np.random.Generator) -> list[tuple[str, Mesh, bool]]:
    """Name, mesh, whether it is labelled; the keyboard first."""

    def box(*size: float, contrast: float = 1.0) -> Mesh:
        return shapes.box(rng, tuple(np.array(size) * rng.uniform(0.94, 1.06, 3)), contrast)

    return [
        ("keyboard", keyboard(rng), True),
        ("carton", box(0.085, 0.05, 0.13), True),
        ("mug", solids.speckled_mug(rng), True),
        ("book", box(0.15, 0.21, 0.03), False),
        ("tin", shapes.can(rng, 0.034, 0.10), False),
        ("pack", box(0.07, 0.10, 0.045), False),
        ("cup", solids.speckled_mug(rng, 0.038, 0.09), False),
        ("jar", shapes.can(rng, 0.04, 0.075), False),
        ("stump", shapes.block(rng, 0.04, 0.07), False),
        ("remote", _plain(box(0.05, 0.16, 0.02), rng.uniform(25, 70, 3)), False),
        ("tea", box(0.11, 0.065, 0.075), False),
        ("notebook", box(0.14, 0.19, 0.012, contrast=0.4), False),
    ]


def _arranged(rng: np.random.Generator) -> list[tuple[str, Mesh, np.ndarray, bool]]:
    """The things with T_world_model: the keyboard in front, the others pushed towards it until they touch something."""
    taken = np.zeros((2 * _HALF[1], 2 * _HALF[0]), np.uint8)
    placed = []
    for k, (name, mesh, labelled) in enumerate(_things(rng)):
        yaw = rng.normal(0, 0.12) if k == 0 else rng.uniform(-np.pi, np.pi)
        T = turned(se3.IDENTITY[None], np.array([yaw]), np.array([0, 0, -mesh.vertices[:, 2].min()]))[0]
        outline = cv2.convexHull((se3.transform(T, mesh.vertices)[:, :2] / _CELL_M).astype(np.float32))[:, 0]
        if k == 0:
            way, reach = np.array([0.05, -0.1]), np.array([1.0])
        else:
            about = np.pi / 2 + rng.uniform(-1.35, 1.35)
            way, reach = np.array([np.cos(about), np.sin(about)]), np.arange(0.02, 0.6, _CELL_M)
        from_xy = np.array([0.05, -0.02]) + rng.uniform(-0.06, 0.06, 2) if k else np.zeros(2)
        apart = int(rng.integers(0, 3))  # touching, or a gap of up to 4 mm
        for r in reach:
            at = from_xy + r * way
            here = np.zeros_like(taken)
            cells = np.round(outline + at / _CELL_M + _HALF).astype(np.int32)
            cv2.fillConvexPoly(here, cells, 1)
            grown: np.ndarray = cv2.dilate(here, np.ones((2 * apart + 1,) * 2, np.uint8))
            if not (grown & taken).any():
                break
        taken |= here
        T[:2, 3] = at
        placed.append((name, mesh, T, labelled))
    return placed + _pens(rng, placed)


def _pens(rng: np.random.Generator, placed: list) -> list[tuple[str, Mesh, np.ndarray, bool]]:
    """Three pens: one on the book, two on the desk."""
    found = []
    where = {name: T for name, _, T, _ in placed}
    for k in range(3):
        tint = rng.integers(20, 230, 3).astype(np.uint8)
        mesh = assembled([solids.limb(np.full((8, 8, 3), tint, np.uint8), 0.0045, 0.145, (0, 0, 0))])
        turn = se3.exp(np.array([np.pi / 2, 0, 0, 0, 0, 0.0]))
        at = np.r_[rng.uniform([-0.35, -0.2], [0.4, -0.12]), 0.0045]
        if k == 0:
            at = np.r_[where["book"][:2, 3], 2 * where["book"][2, 3] + 0.0045]
        found.append((f"pen_{k}", mesh, turned(se3.IDENTITY[None], rng.uniform(-3, 3, 1), at)[0] @ turn, False))
    return found


def keyboard(rng: np.random.Generator) -> Mesh:
    """A flat slab with rows of keys: one little square much like the next."""
    size = np.array([0.40, 0.135, 0.022])
    mesh = shapes.slab(rng, tuple(size))
    w, h = (round(s * shapes.TEXELS_PER_M / 3) for s in size[:2])
    shade = rng.uniform(0.25, 1)
    page = np.full((h, w, 3), int(175 * shade), np.uint8)
    pitch = 0.019 * shapes.TEXELS_PER_M / 3
    for row in range(6):
        left = 0.4 * pitch + (row % 3) * 0.25 * pitch
        for column in range(int((w - left) / pitch)):
            x, y = left + column * pitch, 0.4 * pitch + row * pitch * 1.03
            tint = shade * (225 if 3 < column < 14 else 150)
            cv2.rectangle(page, (int(x), int(y)), (int(x + 0.82 * pitch), int(y + 0.82 * pitch)), (tint,) * 3, -1)
            glyph = chr(int(rng.integers(65, 91)))
            ink = (40.0,) * 3 if shade > 0.5 else (215.0,) * 3
            cv2.putText(page, glyph, (int(x + 0.2 * pitch), int(y + 0.55 * pitch)), 0, 0.26, ink, 1, cv2.LINE_AA)
    texture = np.full_like(mesh.texture, int(150 * shade))
    texture[-h:, :w] = page  # the top panel is the atlas's lower left, see ``shapes.slab``
    return replace(mesh, texture=texture)


def _plain(mesh: Mesh, tint: np.ndarray) -> Mesh:
    """The mesh in one colour but for a faint rest of its print."""
    grey = mesh.texture.astype(np.float32).mean(-1, keepdims=True)
    return replace(mesh, texture=np.clip(tint + 0.12 * (grey - 128), 0, 255).astype(np.uint8))


def _carried(rng: np.random.Generator, frames: int, fastest_deg: float) -> np.ndarray:
    """T_world_cam (frames, 4, 4): away from the desk and back, again and again, by yaw, pitch and roll in turn."""
    keys, values = [0.0], [np.zeros(6)]  # yaw, pitch, roll in degrees, a shift in metres
    axes = rng.permutation([0, 1, 2, 0, 1, 2])
    for k in range(2 * frames):
        to, away = np.r_[rng.uniform(-8, 8, 3), rng.uniform(-0.07, 0.07, 3)], k % 2 == 0
        if away:
            axis = axes[k // 2 % len(axes)]
            to[axis] = rng.uniform(*_AWAY_DEG[axis]) * (1 if axis == 1 else rng.choice([-1, 1]))
        turn = np.linalg.norm(to[:3] - values[-1][:3])
        # A monotone cubic between two stops is at most 1.5 times as fast as on average.
        keys.append(keys[-1] + max(8.0, float(1.5 * turn / (fastest_deg * rng.uniform(0.55, 1.0)))))
        keys.append(keys[-1] + rng.uniform(3, 12 if away else 7))
        values += [to, to + np.r_[rng.uniform(-3, 3, 3), rng.uniform(-0.02, 0.02, 3)]]
        if keys[-1] > frames:
            break
    at = through(np.array(keys), np.array(values), np.arange(frames), 1.2)
    T = np.repeat(look_at(_EYE + rng.uniform(-0.04, 0.04, 3), _TARGET)[None], frames, 0)
    T[:, :3, 3] += at[:, 3:]
    for axis, deg in zip(np.eye(3)[[1, 0, 2]], at.T[:3], strict=True):
        T = T @ se3.exp(np.radians(deg)[:, None] * np.r_[axis, 0, 0, 0])
    return T @ wander(rng, frames, 0.003, 0.5, 16)


def _desk_top(rng: np.random.Generator, things: list[tuple[Mesh, np.ndarray]], light: Light) -> np.ndarray:
    """A pale desk top (1000, 1800, 3) with papers, and the shadows of what stands on it, which never moves."""
    page = labels.wood(rng, 1800, 1000).astype(np.float32)
    page = np.clip(205 + 0.25 * (page - page.mean((0, 1))) + rng.uniform(-20, 20), 0, 255).astype(np.uint8)
    _papers(rng, page)
    x, y = np.meshgrid(np.linspace(*_DESK_X, 360), np.linspace(*_DESK_Y[::-1], 200))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    dark = cv2.resize(darkness(points, things, light).reshape(x.shape), page.shape[1::-1])
    return np.clip(page * (1 - cv2.GaussianBlur(dark, (0, 0), 4.0)[..., None]), 0, 255).astype(np.uint8)


def _office(rng: np.random.Generator, top: np.ndarray) -> Mesh:
    """A desk with this top, floor, walls and a dark screen, in one mesh."""
    walls = [_wall(rng) for _ in range(3)]
    screen = np.clip(24 + 10 * labels.smooth_noise(rng, 600, 380, (2, 2), 3)[..., None] * [1, 1, 1.2], 0, 255).astype(
        np.uint8
    )
    cv2.rectangle(screen, (4, 4), (595, 375), (60, 60, 62), 6)
    x, y = rng.uniform(0.15, 0.35), rng.uniform(0.36, 0.42)
    turn = rng.uniform(-0.2, 0.2)
    across, up = np.array([np.cos(turn), np.sin(turn), 0]) * 0.26, np.array([0, 0.03, 0.34])
    foot = np.array([x, y, 0.09])
    corners = [foot - across, foot + across, foot + across + up, foot - across + up]
    stand = np.array([x, y + 0.02, 0.0])
    side = across / 5
    post = [stand - side, stand + side, stand + side + [0, 0, 0.1], stand - side + [0, 0, 0.1]]
    floor = labels.wood(rng, 900, 900)
    flat = [
        (top, [[x, y, 0] for x, y in zip([*_DESK_X, *_DESK_X[::-1]], np.repeat(_DESK_Y, 2), strict=True)]),
        (screen, corners),
        (np.full((32, 64, 3), 40, np.uint8), post),
        (floor, [[-2.5, -2.5, -0.72], [2.5, -2.5, -0.72], [2.5, 2.5, -0.72], [-2.5, 2.5, -0.72]]),
        (walls[0], [[-2.5, 2.5, -0.72], [2.5, 2.5, -0.72], [2.5, 2.5, 2.3], [-2.5, 2.5, 2.3]]),
        (walls[1], [[-2.5, -2.5, -0.72], [-2.5, 2.5, -0.72], [-2.5, 2.5, 2.3], [-2.5, -2.5, 2.3]]),
        (walls[2], [[2.5, 2.5, -0.72], [2.5, -2.5, -0.72], [2.5, -2.5, 2.3], [2.5, 2.5, 2.3]]),
        (np.full((32, 32, 3), 225, np.uint8), [[-2.5, 2.5, 2.3], [2.5, 2.5, 2.3], [2.5, -2.5, 2.3], [-2.5, -2.5, 2.3]]),
    ]
    faces, uv = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    patches = []
    for image, quad in flat:
        p = np.asarray(quad, float)[faces]
        normal = np.cross(p[0, 1] - p[0, 0], p[0, 2] - p[0, 0])
        normals = np.broadcast_to(normal / np.linalg.norm(normal), p.shape)
        patches.append(Patch(p, uv[faces], normals, image))
    return assembled(patches, [[0, 1, 2], [3, 4], [5, 6, 7]])


def _papers(rng: np.random.Generator, page: np.ndarray) -> None:
    """Sheets with lines of print on a desk top."""
    for _ in range(6):
        at = rng.uniform([300, 250], [1500, 900])
        sheet = np.full((297, 210, 3), rng.uniform(225, 250), np.uint8)
        if rng.uniform() < 0.3:
            sheet[:] = rng.uniform([170, 120, 60], [225, 190, 140])
        else:
            for row in range(24, 270, 9):
                cv2.line(sheet, (20, row), (int(rng.uniform(90, 190)), row), (120, 120, 125), 2)
        M: np.ndarray = cv2.getRotationMatrix2D((105, 148), rng.uniform(0, 360), 1.0)
        M[:, 2] += at - [105, 148]
        on = cv2.warpAffine(np.full(sheet.shape[:2], 255, np.uint8), M, page.shape[1::-1]) > 127
        page[on] = cv2.warpAffine(sheet, M, page.shape[1::-1])[on]


def _wall(rng: np.random.Generator) -> np.ndarray:
    """A wall with shelves, posters, a door."""
    page = labels.plaster(rng, 1000, 600)
    for _ in range(5):
        x, y = int(rng.uniform(0, 850)), int(rng.uniform(40, 330))
        w, h = int(rng.uniform(90, 220)), int(rng.uniform(90, 200))
        if rng.uniform() < 0.5:
            for top in range(y, y + h - 30, 42):
                cv2.rectangle(page, (x, top), (x + w, top + 42), (70, 62, 55), -1)
                left = x + 3
                while left < x + w - 6:
                    thick, tall = int(rng.integers(4, 12)), int(rng.integers(24, 38))
                    cv2.rectangle(
                        page,
                        (left, top + 40 - tall),
                        (left + thick, top + 40),
                        tuple(int(c) for c in rng.uniform(20, 230, 3)),
                        -1,
                    )
                    left += thick
        else:
            poster = labels.label(rng, w, h, front=bool(rng.uniform() < 0.5))
            page[y : y + h, x : min(x + w, 1000)] = poster[: 600 - y, : 1000 - x]
    door = int(rng.uniform(50, 800))
    cv2.rectangle(page, (door, 150), (door + 180, 600), (176, 128, 74), -1)
    cv2.rectangle(page, (door, 150), (door + 180, 600), (90, 66, 40), 4)
    return page
