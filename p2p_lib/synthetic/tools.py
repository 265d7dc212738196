"""Thin tools: a spatula, a wrench or scissors that circle a tin and turn, so that they are seen edge-on too."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic import labels, shapes, solids
from p2p_lib.synthetic.motion import eased, standing, wander
from p2p_lib.synthetic.paper_subset import CAMERA
from p2p_lib.synthetic.scene import Body, Scenario, check, room
from p2p_lib.synthetic.shapes import Mesh

#: The YCB model of each tool, and the can that it circles.
YCB_NAMES = {"spatula": "033_spatula", "wrench": "042_adjustable_wrench", "scissors": "037_scissors"}
_CAN = "002_master_chef_can"
_EYE, _TARGET = np.array([0.0, -0.52, 0.34]), np.array([0.0, 0.02, 0.14])


def thin_tools(seed: int, tool: str = "", frames: int = 300, models: str = "") -> Scenario:
    """A spatula, a wrench or scissors (the seed chooses, or ``tool``) circle a can and show both sides and both edges.

    ``models`` is a folder of YCB models (``<name>/textured.obj``, metres); without it solids of about their size.
    """
    check("thin_tools", frames=(frames, 2, np.inf))
    tool = tool or list(YCB_NAMES)[seed % 3]
    if tool not in YCB_NAMES:
        raise BadInput("thin_tools tool", repr(tool), "one of " + ", ".join(YCB_NAMES))
    rng = np.random.default_rng([seed, 1])
    meshes = {tool: MAKE[tool](rng), "can": shapes.can(rng, 0.045, 0.125)}
    if models:
        names = YCB_NAMES[tool], _CAN
        meshes = {name: shapes.load_ycb(models, name) for name in names}
    (name, mesh), (other, can) = meshes.items()
    way, start = rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
    share = np.arange(frames) / frames
    aside = np.stack([0.03 * np.sin(2 * np.pi * (2 * share + rng.uniform())), 0.02 + 0 * share, 0.13 + 0 * share], 1)
    T_can = _turning(rng.uniform(0, 6) + np.radians(200) * share) @ wander(rng, frames, 0.006, 8.0, 200) @ _centred(can)
    T_can[:, :3, 3] += aside
    spin = _turning(rng.uniform(-0.5, 0.5) + way * 2 * np.pi * share)
    T = spin @ wander(rng, frames, 0.008, 10.0, 180) @ _broadside(mesh, rng)
    # Twice around while it turns once: it passes before and behind the can with different sides.
    angle = start + way * 4 * np.pi * share
    around = np.stack([np.cos(angle), 0.8 * np.sin(angle), 0 * angle], 1)
    T[:, :3, 3] += [0, 0.02, 0.17] + _clear_of(can, T_can, mesh, T, around)[:, None] * around
    kind = "YCB models" if models else "procedural"
    bodies = (Body(name, mesh, T), Body(other, can, T_can))
    return Scenario(CAMERA, standing(_EYE, _TARGET, frames), bodies, room(rng), objects=kind)


def _turning(angle_rad: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) about the vertical."""
    return se3.exp(angle_rad[:, None] * np.array([0, 0, 1.0, 0, 0, 0]))


def _clear_of(can: Mesh, T_can: np.ndarray, mesh: Mesh, T: np.ndarray, around: np.ndarray) -> np.ndarray:
    """How far out (T,) along ``around`` a tool at T keeps clear of the can, smooth over time."""
    from scipy.ndimage import maximum_filter1d

    axis = se3.transform(T_can, np.zeros((1, 3)) + can.vertices.mean(0))[:, 0]
    wide = np.ptp(can.vertices[:, 0]) / 2 + 0.03
    points, _ = mesh.sample(300, np.random.default_rng(0))
    flat = se3.transform(T, points)[..., :2] + [0, 0.02] - axis[:, None, :2]
    way = around[:, None, :2]
    # The least r with |flat + r way| >= wide, for every point: the larger root of a quadratic.
    a, b, c = (way**2).sum(-1), (flat * way).sum(-1), (flat**2).sum(-1) - wide**2
    root = (-b + np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    needed = np.where(b**2 > a * c, root, 0).max(1).clip(0.12, 0.30)
    return eased(maximum_filter1d(np.r_[needed, needed, needed], 65), 8)[len(needed) : 2 * len(needed)]


def _alone(seed: int, frames: int = 300, models: str = "", *, tool: str) -> Scenario:
    return thin_tools(seed, tool, frames, models)


#: One scenario for each tool.
SCENARIOS = {f"thin_{tool}": partial(_alone, tool=tool) for tool in YCB_NAMES}


def _centred(mesh: Mesh) -> np.ndarray:
    """T that moves the middle of a mesh to the origin."""
    return se3.from_rt(np.eye(3), -(mesh.vertices.max(0) + mesh.vertices.min(0)) / 2)


def _broadside(mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    """T that shows the broad side to the camera at -y and above, the long axis at some slant."""
    long, _, thin = np.linalg.svd(mesh.vertices[::7] - mesh.vertices[::7].mean(0), full_matrices=False)[2]
    out = np.array([0, -1.0, 0.35]) / np.hypot(1, 0.35)
    slant = rng.uniform(-1.2, 1.2)
    along = np.cos(slant) * np.array([1.0, 0, 0]) + np.sin(slant) * np.cross(out, [1.0, 0, 0])
    source = np.stack([long, thin, np.cross(long, thin)], 1)
    target = np.stack([along, out * rng.choice([-1, 1]), np.zeros(3)], 1)
    target[:, 2] = np.cross(target[:, 0], target[:, 1])
    return se3.from_rt(target @ source.T, np.zeros(3)) @ _centred(mesh)


def spatula(rng: np.random.Generator) -> Mesh:
    """A blade 1.6 mm thin that leans on a wire shaft with a dull handle, 30 cm long."""
    dark, steel = _paint(rng, rng.uniform(25, 70, 3)), _steel(rng)
    blade = shapes.six_sided((0.078, 0.0016, 0.095), [_paint(rng, rng.uniform(30, 60, 3))] * 6)
    lean = se3.exp(np.array([-0.3, 0, 0, 0, 0, 0]))
    lean[:3, 3] = 0, 0.012, 0.175
    shaft = solids.capsule(steel, 0.0035, 0.14)
    handle = solids.capsule(dark, 0.011, 0.13, (1.0, 0.7, 1.0))
    ring = solids.capsule(_paint(rng, rng.uniform(120, 220, 3)), 0.0112, 0.026, (1.0, 0.75, 1.0))
    return shapes.joined([(blade, lean), (shaft, _up(0.075)), (handle, _up(-0.045)), (ring, _up(0.012))])


def wrench(rng: np.random.Generator) -> Mesh:
    """An open-ended spanner of steel, 12 mm thick at its head, 18 cm long, with a stamped name."""
    steel = _steel(rng, "CHROME VANADIUM")
    bar = solids.capsule(steel, 0.012, 0.15, (1.0, 0.33, 1.0))
    head = solids.capsule(steel, 0.021, 0.044, (1.0, 0.28, 0.9))
    jaw = shapes.six_sided((0.011, 0.011, 0.03), [_steel(rng)] * 6)
    screw = solids.capsule(_paint(rng, np.array([60.0, 60, 62])), 0.006, 0.022)
    side = se3.exp(np.array([0, np.pi / 2, 0, 0, 0, 0]))
    side[:3, 3] = 0.004, 0, 0.06
    tilted = se3.exp(np.array([0, 0.3, 0, 0, 0, 0]))
    left, right = tilted.copy(), tilted.copy()
    left[:3, 3], right[:3, 3] = (-0.011, 0, 0.093), (0.018, 0, 0.086)
    return shapes.joined([(bar, _up(-0.01)), (head, _up(0.07)), (jaw, left), (jaw, right), (screw, side)])


def scissors(rng: np.random.Generator) -> Mesh:
    """Two blades 2 mm thin that cross, on two rings of a bright grip, 20 cm long."""
    grip, parts = _paint(rng, rng.uniform(20, 230, 3)), []
    for side in (-1.0, 1.0):
        blade = shapes.six_sided((0.015, 0.0022, 0.11), [_steel(rng)] * 6)
        narrow = 1 - 0.75 * np.clip(blade.vertices[:, 2] / 0.055, 0, 1)
        blade = replace(
            blade,
            vertices=blade.vertices * np.stack([narrow, np.ones_like(narrow), np.ones_like(narrow)], 1),
            normals=None,
        )
        T = se3.exp(np.array([0, 0.09 * side, 0, 0, 0, 0]))
        T[:3, 3] = 0.004 * side, 0.0012 * side, 0.055
        parts.append((blade, T))
        turn = np.linspace(0, 2 * np.pi, 33)
        wide, tall = 0.017, 0.026 + 0.004 * side
        loop = np.stack([wide * np.sin(turn), 0 * turn, tall * np.cos(turn)], 1)
        ring = shapes.assembled([solids.tube(loop, 0.0048, grip)])
        bar = solids.capsule(grip, 0.006, 0.05, (1.0, 0.7, 1.0))
        arm = se3.exp(np.array([0, 0.25 * side, 0, 0, 0, 0]))
        arm[:3, 3] = -0.006 * side, 0, -0.012
        parts += [(ring, _up(-0.062, -0.022 * side)), (bar, arm)]
    rivet = solids.capsule(_steel(rng), 0.005, 0.0101, (1.0, 1.0, 0.6))
    return shapes.joined([*parts, (rivet, se3.exp(np.array([np.pi / 2, 0, 0, 0, 0, 0])))])


MAKE = {"spatula": spatula, "wrench": wrench, "scissors": scissors}


def _up(z: float, x: float = 0.0) -> np.ndarray:
    return se3.from_rt(np.eye(3), np.array([x, 0, z]))


def _paint(rng: np.random.Generator, tint: np.ndarray) -> np.ndarray:
    """A worn coat of paint (256, 128, 3): one colour, scratches."""
    page = np.asarray(tint, np.float32) * (1 + 0.08 * labels.smooth_noise(rng, 128, 256, (3, 6), 4))[..., None]
    return np.clip(_scratched(rng, page, 25), 0, 255).astype(np.uint8)


def _steel(rng: np.random.Generator, stamped: str = "") -> np.ndarray:
    """Brushed steel (256, 128, 3), spots on it, perhaps a word along it."""
    brushed = cv2.GaussianBlur(rng.standard_normal((256, 128), np.float32), (0, 0), sigmaX=0.6, sigmaY=9.0) * 3
    page = (
        np.array([150, 152, 156], np.float32)
        * (1 + 0.05 * brushed + 0.16 * labels.smooth_noise(rng, 128, 256, (3, 8), 4))[..., None]
    )
    page = np.clip(_scratched(rng, page, 40), 0, 255).astype(np.uint8)
    if stamped:
        turned = np.ascontiguousarray(np.rot90(page))
        for row in (38, 102):
            cv2.putText(turned, stamped, (40, row), cv2.FONT_HERSHEY_DUPLEX, 0.62, (70, 70, 72), 1, cv2.LINE_AA)
        page = np.ascontiguousarray(np.rot90(turned, -1))
    return page


def _scratched(rng: np.random.Generator, page: np.ndarray, count: int) -> np.ndarray:
    for _ in range(count):
        a = rng.uniform([0, 0], page.shape[1::-1])
        b = a + rng.normal(0, 14, 2)
        shade = float(rng.choice([0.7, 1.25]))
        ink = tuple(float(c) for c in np.clip(page.mean((0, 1)) * shade, 0, 255))
        cv2.line(page, tuple(a.astype(int).tolist()), tuple(b.astype(int).tolist()), ink, 1, cv2.LINE_AA)
    return page
