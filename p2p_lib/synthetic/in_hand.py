"""In a hand: it takes a thing from a table, turns it over, shakes it, puts it down on another side, and again.

Each time is drawn as a whole: how the hand holds the thing, where it carries it, and how the thing lies afterwards.
A draw counts if at every stop no part of the arm is in the table, the wrist can bend so, the thing is in the image, and
at most about half of it is covered. Between stops it moves as hands do, in as many frames as its top speed asks for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic import gripping, shapes, solids
from p2p_lib.synthetic.environment import living_room
from p2p_lib.synthetic.gripping import OPEN
from p2p_lib.synthetic.motion import carried, look_at, minimum_jerk, spun
from p2p_lib.synthetic.render import Light
from p2p_lib.synthetic.resting import resting
from p2p_lib.synthetic.scene import FPS, VGA, Body, Scenario, check, room
from p2p_lib.synthetic.shapes import Mesh

#: The largest turn and shift from frame to frame.
FASTEST_DEG, FASTEST_PX = 34.0, 58.0
#: How long the shutter is open.
_SHUTTER_S = 1 / 50
#: What it may cover of the thing, and has to when it takes it; how far the wrist bends.
_MOST_COVER, _LEAST_COVER, _WRIST_DEG = 0.5, 0.08, 75.0
_MODELS = ("006_mustard_bottle", "004_sugar_box", "010_potted_meat_can", "002_master_chef_can")
_THINGS = {
    "mug": lambda rng: solids.speckled_mug(rng, *np.array([0.041, 0.105]) * rng.uniform(0.95, 1.05, 2)),
    "carton": lambda rng: shapes.box(rng, tuple(np.array([0.085, 0.05, 0.125]) * rng.uniform(0.93, 1.07, 3))),
    "tin": lambda rng: shapes.can(rng, *np.array([0.036, 0.105]) * rng.uniform(0.95, 1.05, 2)),
}
_GRASPS, _WAYS = 400, 30


def in_hand(seed: int, thing: str = "", fps: float = FPS, turns: int = 4, models: str = "") -> Scenario:
    """A hand turns a thing over, shakes it and puts it down, up to 35 degrees and 60 pixels a frame, with motion blur.

    thing   mug, carton, tin, with ``models`` the name of a YCB model; by default the seed chooses
    fps     frames a second: at 10 the hand is slower, so that it is as fast per frame, and rests less
    turns   how often it takes the thing
    models  a folder of YCB models (``<name>/textured.obj``)
    """
    check("in_hand", fps=(fps, 5, 60), turns=(turns, 1, 50))
    rng = np.random.default_rng([seed, 1])
    choice = _MODELS if models else tuple(_THINGS)
    name = thing or choice[seed % len(choice)]
    if not models and name not in _THINGS:
        raise BadInput("in_hand thing", repr(name), "one of " + ", ".join(_THINGS))
    mesh = shapes.load_ycb(models, name) if models else _THINGS[name](rng)
    film = _Film(rng, mesh, fps / FPS)
    for k in rng.permutation(turns):
        film.take(int(k % 3))
    film.wait(5)
    return film.scenario(name, fps, "YCB models" if models else "procedural")


def in_hand_10fps(seed: int, thing: str = "", turns: int = 4, models: str = "") -> Scenario:
    """As ``in_hand`` by a camera of 10 frames a second and a calmer hand: as fast per frame, less blurred."""
    return in_hand(seed, thing, 10.0, turns, models)


@dataclass(frozen=True, eq=False)
class _Carry:
    """One time that the hand takes the thing: T_thing_hand, the joints' angles, stops (T_world_thing, whether fast)."""

    T_thing_hand: np.ndarray
    angles: np.ndarray
    stops: list[tuple[np.ndarray, bool]]


class _Film:
    """What was taken so far: T_world_thing, T_world_hand, joints' angles and elbow in each frame."""

    def __init__(self, rng: np.random.Generator, mesh: Mesh, pace: float) -> None:
        """``pace``: what takes a second takes so many times 30 frames."""
        self.rng, self.mesh, self.pace = rng, mesh, pace
        self.frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.hand = gripping.make_hand(rng)
        self.eye = np.array([0, -0.40, 0.33]) + rng.uniform(-0.04, 0.04, 3)
        self.T_world_cam = look_at(self.eye, np.array([0.0, 0.02, 0.06]))
        self.rests, self.pivot = resting(mesh), mesh.ball[0]
        self.points = mesh.sample(160, rng)
        # The arm comes from the left, the right, or over the viewer's shoulder.
        about = np.radians(rng.choice([-1, 1]) * rng.uniform(25, 105) - 90)
        self.elbow = np.array([0.48 * np.cos(about), 0.48 * np.sin(about), rng.uniform(0.22, 0.36)])
        self.thing, self.away = self._laid(0.03), self._apart()

    def scenario(self, name: str, fps: float, kind: str) -> Scenario:
        """The film as a scenario, on a table with a cloth."""
        T_world_thing, T_world_hand, angles = (np.array(a) for a in zip(*self.frames, strict=True))
        elbow = self.elbow + 0.15 * (self.hand.wrist(T_world_hand) - self.elbow)
        poses = self.hand.poses(T_world_hand, angles, elbow)
        arm = [Body(part, self.hand.parts[part], T, labelled=False) for part, T in poses.items()]
        towards = tuple(self.rng.uniform([-0.6, -0.9, 0.6], [0.6, -0.5, 1.0]))
        light = Light(towards, environment=living_room(self.rng), shadow=self.rng.uniform(0.3, 0.55))
        bodies = (Body(name, self.mesh, T_world_thing), *arm)
        T_world_cam = np.broadcast_to(self.T_world_cam, T_world_thing.shape)
        return Scenario(VGA, T_world_cam, bodies, _table(self.rng), light, kind, fps, _SHUTTER_S)

    def wait(self, frames: float) -> None:
        """Nothing moves for so many frames of 30 a second."""
        self.frames += [(self.thing, self.away, OPEN)] * max(1, round(frames * self.pace))

    def take(self, kind: int) -> None:
        """The hand comes, grasps, lifts, turns or shakes, puts down on another side, lets go and withdraws.

        kind  0: calmly; 1: turned over as fast as can be; 2: shaken as fast as can be, and turned over
        """
        rng = self.rng
        deg = [rng.uniform(8, 16), rng.uniform(0.93, 1) * FASTEST_DEG, rng.uniform(18, 28)][kind]
        px = [rng.uniform(25, 40), FASTEST_PX, rng.uniform(0.93, 1) * FASTEST_PX][kind]
        carry = self._drawn(turn_deg=[(20, 120), (105, 178), (60, 178)][kind], shake=kind == 2)
        held, angles = carry.T_thing_hand, carry.angles
        # Open fingers do not touch the thing where the palm is a few centimetres off.
        near = held @ se3.from_rt(np.eye(3), np.array([0, rng.uniform(0.04, 0.07), rng.uniform(-0.04, 0.0)]))
        if self.frames or rng.uniform() < 0.5:
            self.wait(rng.uniform(1, 6))
            self._reach([self.away, self.thing @ near], [OPEN, OPEN], rng.uniform(7, 11))
            self._reach([self.thing @ near, self.thing @ held], [OPEN, OPEN], rng.uniform(3, 5))
            self._reach([self.thing @ held] * 2, [OPEN, angles], 4)
        else:  # the film begins with the thing in the hand
            self.frames.append((self.thing, self.thing @ held, angles))
        for pose, fast in carry.stops:
            limit = (deg, px) if fast else (rng.uniform(5, 13), rng.uniform(12, 28))
            path = carried(self.thing, pose, self._count(pose, *limit), self.pivot)
            self.frames += [(thing, thing @ held, angles) for thing in path]
            self.thing = pose
        self._reach([self.thing @ held] * 2, [angles, OPEN], 4)
        self._reach([self.thing @ held, self.thing @ near], [OPEN, OPEN], rng.uniform(3, 5))
        self.away = self._apart()
        self._reach([self.thing @ near, self.away], [OPEN, OPEN], rng.uniform(6, 9))

    def _reach(self, hands: list[np.ndarray], angles: list[np.ndarray], frames: float) -> None:
        """The hand moves alone, from one pose to another and from one set of angles to another."""
        count = max(3, round(frames * self.pace))
        bent = angles[0] + minimum_jerk(count)[1:, None, None] * (angles[1] - angles[0])
        path = carried(hands[0], hands[1], count, np.zeros(3))
        self.frames += [(self.thing, hand, a) for hand, a in zip(path, bent, strict=True)]

    def _count(self, pose: np.ndarray, deg: float, px: float) -> int:
        """Into how many frames the way to a pose goes so that no two of them differ by more."""
        turn = np.degrees(se3.angle_rad(self.thing[:3, :3].T @ pose[:3, :3]))
        ends = np.array([T[:3, :3] @ self.pivot + T[:3, 3] for T in (self.thing, pose)])
        shift = np.linalg.norm(np.subtract(*VGA.project(se3.transform(se3.inverse(self.T_world_cam), ends))))
        count = 3
        while max(turn / deg, shift / px) * np.diff(minimum_jerk(count)).max() > 1:
            count += 1
        return count

    def _apart(self) -> np.ndarray:
        """T_world_hand out of the way, towards its elbow."""
        forward = np.array([0, 0.02, 0.10]) - self.elbow
        at = self.elbow + forward * self.rng.uniform(0.12, 0.3) + self.rng.uniform(-0.02, 0.02, 3)
        return se3.from_rt(_facing(forward, np.array([0, 0, -1.0])), at)

    def _laid(self, reach_m: float) -> np.ndarray:
        """T_world_thing of the thing on the table, on some side of it, somewhere about the middle."""
        rest = self.rests[self.rng.integers(len(self.rests))]
        return _yawed(rest, self.rng.uniform(0, 2 * np.pi), self.rng.uniform(-reach_m, reach_m, 2))

    def _drawn(self, turn_deg: tuple[float, float], shake: bool) -> _Carry:
        """Grasps and ways are drawn until nothing is wrong with one, or the best of many is taken."""
        best, least = None, np.inf
        for _ in range(_GRASPS):
            held = self._grasp()
            if held is None or self._faults(self.thing, held, OPEN) > 1.5:
                continue
            angles, touch = gripping.closed(self.hand, self.mesh, held)
            if touch.sum() < 3 or self._faults(self.thing, held, angles, _LEAST_COVER) > 0.3:
                continue
            for _ in range(_WAYS):
                stops, worst = self._stops(turn_deg, shake), -np.inf
                for pose, _ in stops[::-1]:
                    worst = max(worst, self._faults(pose, held, angles))
                    if worst >= least:
                        break
                else:
                    best, least = _Carry(held, angles, stops), worst
                if best is not None and least <= 0:
                    return best
        if best is None:
            raise BadInput(
                "in_hand thing", f"of {np.ptp(self.mesh.vertices, 0).round(2)} m", "one that a hand can hold"
            )
        return best

    def _grasp(self) -> np.ndarray | None:
        """T_thing_hand of an open hand whose palm is at the thing or a little off, from where the arm is."""
        rng = self.rng
        centre = self.thing[:3, :3] @ self.pivot + self.thing[:3, 3]
        forward = (centre + rng.uniform(-0.02, 0.02, 3) - self.elbow) * [1, 1, rng.uniform(0.2, 1)]
        forward = se3.exp(np.r_[0, 0, rng.uniform(-0.7, 0.7), 0, 0, 0])[:3, :3] @ forward
        R = _facing(forward, rng.normal((0, 0, -1.2)))
        aim = centre - R[:, 2] * rng.uniform(0.015, 0.055) + R[:, 0] * rng.uniform(-0.025, 0.025)
        back = np.linspace(0.16, 0.0, 33)
        T = np.repeat(se3.from_rt(R, aim)[None], len(back), 0)
        T[:, :3, 3] += back[:, None] * R[:, 1]
        balls, radii = self.hand.spheres(OPEN)
        p_thing = se3.transform(se3.inverse(self.thing) @ T, balls)
        gap = self.mesh.distance(p_thing.reshape(-1, 3)).reshape(len(back), -1) - radii
        free = np.logical_and.accumulate(gap.min(1) > 0.001)
        if not free[0] or free.all():
            return None
        return se3.inverse(self.thing) @ T[max(free.sum() - 1 - rng.integers(0, 5), 0)]

    def _stops(self, turn_deg: tuple[float, float], shake: bool) -> list[tuple[np.ndarray, bool]]:
        """Lifted, perhaps to and fro, turned about in the air, turned over above where it goes, and there."""
        rng = self.rng
        lifted = self.thing.copy()
        lifted[:3, 3] += [*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.05, 0.11)]
        stops = [(self._tilted(lifted, 5, 25, 0), False)]
        if shake:
            aside = lifted.copy()
            aside[:2, 3] += rng.choice([-1, 1]) * rng.uniform(0.14, 0.18), rng.uniform(-0.03, 0.03)
            stops += [(self._tilted(aside, 10, 40, 0), True), (self._tilted(lifted, 10, 40, 0), True)]
        stops += [(self._tilted(lifted, 15, 50, 0.03), False) for _ in range(rng.integers(1, 4))]
        for _ in range(60):
            down = self._laid(0.06)
            if turn_deg[0] < np.degrees(se3.angle_rad(stops[-1][0][:3, :3].T @ down[:3, :3])) < turn_deg[1]:
                break
        above = down.copy()
        above[:3, 3] += [*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.04, 0.10)]
        return [*stops, (above, True), (down, False)]

    def _tilted(self, T: np.ndarray, low_deg: float, high_deg: float, reach_m: float) -> np.ndarray:
        """A pose turned by some angle about some axis, and shifted."""
        T = spun(T, self.rng.uniform(low_deg, high_deg), self.rng.normal(size=3), self.pivot)
        T[:3, 3] += self.rng.uniform(-reach_m, reach_m, 3)
        return T

    def _faults(self, thing: np.ndarray, held: np.ndarray, angles: np.ndarray, least_cover: float = -1.0) -> float:
        """How bad it would be there, 0 or less where nothing is: table, wrist, cover, the picture's edge."""
        T = thing @ held
        balls, radii = self.hand.spheres(angles)
        balls, wrist = se3.transform(T, balls), self.hand.wrist(T)
        arm = self.elbow - wrist
        bend_deg = np.degrees(np.arccos(-T[:3, 2] @ arm / np.linalg.norm(arm)))
        along = wrist + np.linspace(0, 1, 12)[:, None] * arm
        sunk_m = -min((balls[:, 2] - radii).min(), along[:, 2].min() - 0.03)
        covered = self._covered(thing, np.concatenate([balls, along]), np.r_[radii, np.full(12, 0.038)])
        uv = VGA.project(se3.transform(se3.inverse(self.T_world_cam) @ thing, self.points[0]))
        outside = np.mean(~VGA.inside(uv + np.sign(uv - [VGA.cx, VGA.cy]) * 12))
        too_much, too_little = (covered - _MOST_COVER) / 0.1, (least_cover - covered) / 0.1
        return max(sunk_m / 0.01, (bend_deg - _WRIST_DEG) / 20, too_much, too_little, 20 * outside)

    def _covered(self, thing: np.ndarray, balls: np.ndarray, radii: np.ndarray) -> float:
        """Which share of the thing's front balls (S, 3) hide from the camera."""
        p, normals = self.points
        sight = se3.transform(thing, p) - self.eye
        sight = sight[np.einsum("nc,nc->n", normals @ thing[:3, :3].T, sight) < 0]
        # Where on each line of sight it is nearest to a ball's middle, as a share of its length.
        towards = balls - self.eye
        share = towards @ sight.T / (sight**2).sum(1)
        off = (towards**2).sum(1)[:, None] - share**2 * (sight**2).sum(1)
        return float(((off < radii[:, None] ** 2) & (share < 0.99)).any(0).mean())


def _facing(forward: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """R of a hand whose fingers point ``forward`` and whose palm looks as near along ``palm`` as can be."""
    z = forward / np.linalg.norm(forward)
    y = (palm @ z) * z - palm
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], 1)


def _yawed(T: np.ndarray, yaw_rad: float, xy_m: np.ndarray) -> np.ndarray:
    """A pose turned about the world's vertical and moved along the table."""
    T = se3.exp(np.array([0, 0, yaw_rad, 0, 0, 0])) @ T
    T[:2, 3] += xy_m
    return T


def _table(rng: np.random.Generator) -> tuple[Mesh, ...]:
    """A room with a cloth on the table and two things at the back."""
    page = 0.35 * gripping.cloth(rng).astype(np.float32) + 40
    page = np.clip(page + 5 * rng.standard_normal(page.shape), 0, 255).astype(np.uint8)
    corners = np.array([[-0.24, -0.17, 0], [0.24, -0.17, 0], [0.24, 0.17, 0], [-0.24, 0.17, 0]])
    corners[:, :2] += rng.uniform(-0.012, 0.012, (4, 2))
    lies = _yawed(se3.from_rt(np.eye(3), np.array([0, 0, 0.0004])), rng.uniform(-0.5, 0.5), np.zeros(2))
    parts = [shapes.plane(page, se3.transform(lies, corners))]
    behind = [shapes.box(rng, tuple(rng.uniform([0.08, 0.05, 0.1], [0.2, 0.1, 0.22]))), shapes.can(rng, 0.04, 0.13)]
    for k, mesh in enumerate(behind):
        at = np.array([(k - 0.5) * rng.uniform(0.4, 0.7), rng.uniform(0.28, 0.38)])
        stands = se3.from_rt(np.eye(3), np.array([0, 0, -mesh.vertices[:, 2].min()]))
        parts.append(shapes.moved(mesh, _yawed(stands, rng.uniform(0, 6), at)))
    return (*room(rng), *parts)
