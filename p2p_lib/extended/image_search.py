"""Search by shape and colour: an object's surface, projected into the image under many poses (not in the paper).

Where tracked points do not suffice, a pose from elsewhere is judged by what it predicts: a point of the surface should
be measured at its depth, in its colour. Depth behind it contradicts the pose; depth before it means that it is hidden,
which counts less.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import compiled
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.image import in_image, nearest_px
from p2p_lib.core.types import Frame, Rows

if TYPE_CHECKING:
    import trimesh

#: Points of the surface that are compared, and the fewest that have to be in the image.
_POINTS, _FEWEST = 300, 40
#: A point faces the camera if the cosine of its normal and its ray is less.
_FACING = -0.25
#: A measured point this near to the surface is on it, m: while searching, and at the end.
_ROUGH_M, _FINE_M = 0.02, 0.01
#: A colour agrees within this distance in CIELAB's a and b (8 bit), and this log-lightness ratio off the mean one; a
#: mean one beyond this is no other exposure: eight times as much light changes it by as much.
_CHROMA, _LIGHTNESS, _EXPOSED = 20.0, 0.45, 0.75
#: A measured point is on the surface up to so many standard deviations of its depth, too.
_SIGMAS = 2.0
#: A hidden point counts this much against a pose; at least this share of those facing the camera must not be hidden.
_HIDDEN, _SHOWN = 0.5, 0.3
#: Steps of the search about a proposed pose, m, and their number to each side.
_STEP_M, _STEPS = 0.03, 2
#: A pose's share is reduced by this per metre from the proposal, so that of equal ones the nearest is taken.
_STAY_PER_M = 2.0
#: And by what its light is more than this off what it was, a logarithm: a light table beside a dark thing has its
#: colours in more light.
_IN_ITS_LIGHT = 0.25
#: The search compares one in so many points, and so many of its best poses are aligned.
_COARSE, _TRIED = 3, 3
#: So many turns are aligned, this far apart, rad, shifted by this step about the depth points, m.
_TRIED_TURNS, _APART_RAD, _NEAR_M = 6, np.radians(20), 0.015
#: Pixels between the places of a search anywhere; places of the right colour that are kept; width of a CIELAB bin.
_LATTICE_PX, _PLACES, _BIN = 8, 200, 8
#: Directions from a place, in which background this much farther, m, is looked for at so many half lengths.
_AROUND = np.stack([np.cos(np.pi * np.arange(8) / 4), np.sin(np.pi * np.arange(8) / 4)], -1)
_BEYOND, _BEHIND_M = 1.15, 0.03
#: Of many poses so many are ranked, so many distinct ones aligned, and so many of these polished.
_RANKED, _TRIED_PLACES, _POLISHED = 200, 8, 4
#: A place is no evidence if the surface, moved along itself by its own size, still shows more than this share.
_ANYWHERE = 0.7
#: From this share on a pose is polished: by random small motions (rad, m), then by smaller ones about the best.
_PROMISING, _POLISH_SCALES = 0.3, (1.0, 0.4)
_NEARBY = np.random.default_rng(0).normal(size=(150, 6)) * np.repeat([0.06, 0.015], 3)
_NEARBY[0] = 0
#: Iterations of the alignment, and its regularisation: a prior of these standard deviations, rad and m.
_ITERATIONS, _FREE = 6, np.diag(np.repeat([0.1, 0.03], 3) ** -2.0)


@dataclass(frozen=True, eq=False)
class SurfaceSample(Rows):
    """Points of a surface: p_obj (M, 3), outward normals n_obj (M, 3), and lab (M, 3), CIELAB in 8 bit."""

    p_obj: np.ndarray
    n_obj: np.ndarray
    lab: np.ndarray

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> SurfaceSample:
        """A random sample of a mesh's vertices, always the same."""
        at = np.sort(np.random.default_rng(0).permutation(len(mesh.vertices))[:_POINTS])
        visual: Any = mesh.visual  # Trimesh's types know of textures besides
        rgb = np.asarray(visual.vertex_colors)[at, :3] if len(at) else np.zeros((0, 3), np.uint8)
        lab = cv2.cvtColor(np.ascontiguousarray(rgb)[None], cv2.COLOR_RGB2LAB)[0] if len(at) else rgb
        return cls(np.asarray(mesh.vertices)[at], np.asarray(mesh.vertex_normals)[at], lab.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Sighting:
    """A pose and its evidence.

    T_cam_obj  (4, 4)
    share      points of the surface that show less those contradicted, over those that should show
    uv_px      (K, 2) where points were found on the surface in their colour
    light      how much lighter these are than they were, as a logarithm
    """

    T_cam_obj: np.ndarray
    share: float
    uv_px: np.ndarray
    light: float = 0.0

    @property
    def rank(self) -> float:
        """What poses of one frame are compared by."""
        return self.share - max(abs(self.light) - _IN_ITS_LIGHT, 0.0)


def most_shown(found: Iterable[Sighting | None]) -> Sighting | None:
    """The sighting in which most of the surface shows; None without any."""
    return max((s for s in found if s is not None), key=lambda s: s.share, default=None)


class ImageSearch:
    """One frame, made ready for comparison."""

    def __init__(self, frame: Frame, camera: Camera, config: DepthConfig):
        self._depth_m, self._lab, self._camera = frame.depth_m, frame.lab, camera
        self._lens, self._noise = (camera.fx, camera.fy, camera.cx, camera.cy), (config.noise_m, config.noise_per_m2)

    def about(self, T_cam_obj: np.ndarray, sample: SurfaceSample) -> Sighting | None:
        """The best pose near a proposed one; None where none is promising."""
        uv_px = self._camera.project(se3.transform(T_cam_obj, sample.p_obj))
        if len(uv_px) < _FEWEST or not in_image(uv_px, self._depth_m.shape).any():
            return None
        poses = _shifted(T_cam_obj, _STEP_M, _STEPS)
        share = self._roughly(poses, sample) - _strayed(poses, T_cam_obj, sample)
        return self._best(
            self._all_aligned(poses[np.argsort(-share, kind="stable")[:_TRIED]], sample), sample, T_cam_obj
        )

    def turned(self, turns: np.ndarray, cloud: np.ndarray, sample: SurfaceSample) -> Sighting | None:
        """The best pose near the turns of T_cam_obj (V, 4, 4), for an object with these depth points (M, 3)."""
        return self._best(self._turns(turns, cloud, sample), sample)

    def otherwise(
        self, T_cam_obj: np.ndarray, turns: np.ndarray, cloud: np.ndarray, sample: SurfaceSample
    ) -> Sighting | None:
        """As :meth:`turned`, the best of those that are turned otherwise than a pose."""
        found = self._turns(turns, cloud, sample)
        return most_shown(s for s in found if se3.angle_rad(se3.inverse(T_cam_obj) @ s.T_cam_obj) > _APART_RAD)

    def places(self, free: np.ndarray, sample: SurfaceSample, rng: np.random.Generator) -> np.ndarray:
        """(P, 3) some measured points of ``free`` pixels (H, W) bool where the surface may be.

        They have one of its colours, and stand out from the background: nothing ends amid a wall.
        """
        known = np.zeros((256 // _BIN,) * 2, np.uint8)
        known[tuple((sample.lab[:, 1:] // _BIN).astype(int).T)] = 1
        known = cv2.dilate(known, np.ones((3, 3), np.uint8)).astype(np.uint8)
        top, left = rng.integers(0, _LATTICE_PX, 2)
        every = np.s_[top::_LATTICE_PX, left::_LATTICE_PX]
        a, b = np.moveaxis(self._lab[every][..., 1:] // _BIN, -1, 0).astype(int)
        v, u = np.nonzero(free[every] & (self._depth_m[every] > 0) & (known[a, b] > 0))
        px = np.stack([u * _LATTICE_PX + left, v * _LATTICE_PX + top], -1)
        px = px[self._stands_out(px, np.ptp(sample.p_obj, 0).max())]
        px = px[rng.permutation(len(px))[:_PLACES]]
        return self._camera.unproject(px, self._depth_m[px[:, 1], px[:, 0]].astype(float))

    def _stands_out(self, px: np.ndarray, length_m: float) -> np.ndarray:
        """(P,) bool: pixels (P, 2) around which, beyond an object of this length, most depth is farther away."""
        z = self._depth_m[px[:, 1], px[:, 0]]
        radius_px = _BEYOND * length_m / 2 * self._camera.fx / np.maximum(z, 1e-3)
        around = px[:, None] + radius_px[:, None, None] * _AROUND
        u, v = nearest_px(around, self._depth_m.shape)
        behind = (self._depth_m[v, u] > z[:, None] + _BEHIND_M) & in_image(around, self._depth_m.shape)
        return behind.sum(1) >= len(_AROUND) / 2

    def among(self, poses: np.ndarray, sample: SurfaceSample) -> list[Sighting]:
        """The best distinct ones of many poses (H, 4, 4), aligned and polished."""
        if len(sample) < _FEWEST or not len(poses):
            return []
        share = self._roughly(poses, sample)
        best: list[int] = []
        for k in np.argsort(-share, kind="stable")[:_RANKED]:
            apart_m = np.linalg.norm(poses[best, :3, 3] - poses[k, :3, 3], axis=1)
            turned = se3.angle_rad(se3.inverse(poses[best]) @ poses[k])
            if np.isfinite(share[k]) and ((apart_m > _STEP_M) | (turned > _APART_RAD)).all():
                best.append(k)
            if len(best) == _TRIED_PLACES:
                break
        aligned = sorted(self._all_aligned(poses[best], sample), key=lambda s: -s.share)
        found = [self._best([sighting], sample) for sighting in aligned[:_POLISHED]]
        return [sighting for sighting in found if sighting is not None]

    def _turns(self, turns: np.ndarray, cloud: np.ndarray, sample: SurfaceSample) -> list[Sighting]:
        """The best poses near distinct turns, aligned."""
        if len(sample.p_obj) < _FEWEST or not len(cloud) or not len(turns):
            return []
        poses = np.concatenate([_shifted(T, _NEAR_M, 1) for T in centred_on_cloud(turns, cloud, sample)])
        share, distinct = self._roughly(poses, sample), []
        turn_of, free = np.arange(len(poses)) // (len(poses) // len(turns)), np.ones(len(turns), bool)
        for k in np.argsort(-share, kind="stable"):
            if np.isfinite(share[k]) and free[turn_of[k]]:
                distinct.append(k)
                free &= se3.angle_rad(se3.inverse(turns) @ poses[k]) > _APART_RAD
            if len(distinct) == _TRIED_TURNS:
                break
        return self._all_aligned(poses[distinct], sample)

    def _all_aligned(self, poses: np.ndarray, sample: SurfaceSample) -> list[Sighting]:
        found = [self.at(self._aligned(T, sample), sample) for T in poses]
        return [sighting for sighting in found if sighting is not None]

    def _roughly(self, poses: np.ndarray, sample: SurfaceSample) -> np.ndarray:
        """(H,) shares by some of the points, -inf where unknown."""
        return self._ranked(poses, sample.select(np.arange(0, len(sample), _COARSE)), _ROUGH_M)

    def _best(
        self, found: list[Sighting], sample: SurfaceSample, proposed: np.ndarray | None = None
    ) -> Sighting | None:
        """The best of some, polished, near the ``proposed`` pose (4, 4) if any; None where none is good enough."""
        best = max(found, key=lambda s: s.rank - _strayed(s.T_cam_obj, proposed, sample), default=None)
        if best is None or best.share < _PROMISING or not self._distinct(best, sample):
            return None
        return self.at(self._polished(best, sample, proposed), sample)

    def _distinct(self, found: Sighting, sample: SurfaceSample) -> bool:
        """Whether the surface fits worse beside its place: what fits a table anywhere proves nothing."""
        centred = sample.p_obj - sample.p_obj.mean(0)
        axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
        along = axes * np.ptp(centred @ axes.T, axis=0)[:, None]
        poses = np.repeat(found.T_cam_obj[None], 4, 0)
        poses[:, :3, 3] += np.concatenate([along, -along]) @ found.T_cam_obj[:3, :3].T
        share = self._ranked(poses, sample, _FINE_M, found.light)
        return (share > _ANYWHERE * found.share).sum() < 2

    def _polished(self, found: Sighting, sample: SurfaceSample, proposed: np.ndarray | None) -> np.ndarray:
        """The nearby pose that shows most: colours decide where the shape does not, as on a flat cover."""
        T_cam_obj, centre = found.T_cam_obj, sample.p_obj.mean(0)
        about, back = se3.from_rt(np.eye(3), centre), se3.from_rt(np.eye(3), -centre)
        for scale in _POLISH_SCALES:
            poses = T_cam_obj @ about @ se3.exp(scale * _NEARBY) @ back
            share = self._ranked(poses, sample, _FINE_M)
            T_cam_obj = poses[(share - _strayed(poses, proposed, sample)).argmax()]
        return se3.orthonormalised(T_cam_obj)

    def at(self, T_cam_obj: np.ndarray, sample: SurfaceSample) -> Sighting | None:
        """The evidence of one pose; None where too little of the surface would show."""
        (share,), (found,), (uv_px,), (light,) = self._compare(T_cam_obj[None], sample, _FINE_M)
        if not np.isfinite(share):
            return None
        return Sighting(T_cam_obj, float(share), uv_px[found], float(light))

    def _aligned(self, T_cam_obj: np.ndarray, sample: SurfaceSample) -> np.ndarray:
        """The pose after robust point-to-plane alignment with the points measured at its pixels."""
        for _ in range(_ITERATIONS):
            arrays = np.ascontiguousarray(T_cam_obj), sample.p_obj, sample.n_obj, self._depth_m
            A, b, centre = _normal_equations(*arrays, self._lens)
            step = np.linalg.solve(A + _FREE, b)
            R = cv2.Rodrigues(step[:3])[0]
            T_cam_obj = se3.from_rt(R, centre - R @ centre + step[3:]) @ T_cam_obj
        return T_cam_obj

    def _ranked(self, T_cam_obj: np.ndarray, sample: SurfaceSample, near_m: float, light: float = 0.0) -> np.ndarray:
        """(H,) shares of poses, less where they need another ``light``; -inf where unknown."""
        share, *_, lights = self._compare(T_cam_obj, sample, near_m)
        return share - np.maximum(np.abs(lights - light) - _IN_ITS_LIGHT, 0)

    def _compare(
        self, T_cam_obj: np.ndarray, sample: SurfaceSample, near_m: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Shares (H,), -inf where unknown; found (H, M) bool; their pixels (H, M, 2); in which light (H,)."""
        arrays = np.ascontiguousarray(T_cam_obj), sample.p_obj, sample.n_obj, sample.lab, self._depth_m, self._lab
        return _compare(*arrays, self._lens, self._noise, near_m, _FEWEST * len(sample) / _POINTS)


@compiled("f8[:,::1], f8[:,::1], f8[:,::1], f4[:,::1], UniTuple(f8, 4)")
def _normal_equations(T, p_obj, n_obj, depth_m, lens):
    """A (6, 6), b (6,) of a point-to-plane alignment with the depth at the points' pixels, and its centre (3,)."""
    (height, width), (fx, fy, cx, cy) = depth_m.shape, lens
    R_obj_cam = np.ascontiguousarray(T[:3, :3].T)
    p_cam, normal = p_obj @ R_obj_cam + T[:3, 3], n_obj @ R_obj_cam
    centre, used, off_m = np.zeros(3), 0, np.zeros(len(p_cam))
    for m in range(len(p_cam)):  # those that are used come to the front
        (x, y, z), (a, b, c) = p_cam[m], normal[m]
        if z <= 0 or a * x + b * y + c * z >= _FACING * np.sqrt(x * x + y * y + z * z):
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if 0 <= u <= width - 1 and 0 <= v <= height - 1:
            measured = depth_m[int(np.rint(v)), int(np.rint(u))]
            if measured > 0 and abs(measured - z) < 2 * _ROUGH_M:
                off_m[used] = (measured - z) / z * (a * x + b * y + c * z)  # along the ray
                for i in range(3):
                    p_cam[used, i], normal[used, i] = p_cam[m, i], normal[m, i]
                    centre[i] += p_cam[used, i]
                used += 1
    centre /= max(used, 1)
    J, weighted = np.zeros((used, 6)), np.zeros((used, 6))
    for m in range(used):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            J[m, i] = (p_cam[m, j] - centre[j]) * normal[m, k] - (p_cam[m, k] - centre[k]) * normal[m, j]
            J[m, 3 + i] = normal[m, i]
        for i in range(6):
            weighted[m, i] = J[m, i] / (_FINE_M**2 + off_m[m] * off_m[m])
    return weighted.T @ J, weighted.T @ off_m[:used], centre


@compiled(
    "f8[:,:,::1], f8[:,::1], f8[:,::1], f4[:,::1], f4[:,::1], u1[:,:,::1], UniTuple(f8, 4), UniTuple(f8, 2), f8, f8"
)
def _compare(T_cam_obj, p_obj, n_obj, lab, depth_m, seen, lens, noise, near_m, fewest):
    poses, points = len(T_cam_obj), len(p_obj)
    (height, width), (fx, fy, cx, cy) = depth_m.shape, lens
    share, found = np.full(poses, -np.inf), np.zeros((poses, points), np.bool_)
    uv_px, lighter = np.full((poses, points, 2), np.nan), np.zeros(points)  # how much lighter, by its logarithm
    light = np.zeros(poses)
    for h in range(poses):
        T = T_cam_obj[h]
        facing, shown, hidden, behind, on, exposure = 0, 0, 0, 0, 0, 0.0
        for m in range(points):
            a, b, c = p_obj[m]
            x, y = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3], T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
            z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
            if z <= 0:
                continue
            a, b, c = n_obj[m]
            across = (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c) * x + (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c) * y
            across += (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c) * z
            u, v = fx * x / z + cx, fy * y / z + cy
            uv_px[h, m, 0], uv_px[h, m, 1] = u, v
            if across >= _FACING * np.sqrt(x * x + y * y + z * z):
                continue
            facing += 1
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            column, row = int(np.rint(u)), int(np.rint(v))
            measured = depth_m[row, column]
            if measured <= 0:
                continue
            off = measured - z
            near = max(near_m, _SIGMAS * (noise[0] + noise[1] * measured**2))
            hidden += off < -near
            behind += off > 2 * near
            shown += off >= -near
            if abs(off) < near:
                lighter[m] = np.log((seen[row, column, 0] + 8.0) / (lab[m, 0] + 8.0))
                found[h, m], on, exposure = True, on + 1, exposure + lighter[m]
        agree = 0
        if on > 0:
            light[h] = exposure / on
        for m in range(points):
            if found[h, m]:
                # Lightness is compared with the mean change: the exposure may have changed.
                column, row = int(np.rint(uv_px[h, m, 0])), int(np.rint(uv_px[h, m, 1]))
                a, b = float(seen[row, column, 1]) - lab[m, 1], float(seen[row, column, 2]) - lab[m, 2]
                same = np.sqrt(a * a + b * b) < _CHROMA and abs(lighter[m] - light[h]) < _LIGHTNESS
                found[h, m] = same
                agree += same
        if abs(light[h]) > _EXPOSED:
            agree = 0
            found[h] = False
        if shown >= fewest and shown >= _SHOWN * facing:
            share[h] = (agree - behind) / max(shown + _HIDDEN * hidden, 1.0)
    return share, found, uv_px, light


def _strayed(T_cam_obj: np.ndarray, proposed: np.ndarray | None, sample: SurfaceSample) -> np.ndarray:
    """(...,) penalty of poses (..., 4, 4) for their distance from the one ``proposed``; 0 without one.

    Something repetitive, as a keyboard, shows as much a few centimetres farther on.
    """
    if proposed is None:
        return np.zeros(T_cam_obj.shape[:-2])
    centre = sample.p_obj.mean(0, keepdims=True)
    away = se3.transform(T_cam_obj, centre) - se3.transform(proposed, centre)
    return _STAY_PER_M * np.linalg.norm(away, axis=-1)[..., 0]


def centred_on_cloud(turns: np.ndarray, cloud: np.ndarray, sample: SurfaceSample) -> np.ndarray:
    """(V, 4, 4) poses of these turns with their camera-facing points centred on the cloud (M, 3)."""
    centre, poses = cloud.mean(0), turns.copy()
    for T in poses:
        facing = sample.n_obj @ T[:3, :3].T @ centre < 0
        T[:3, 3] = centre - T[:3, :3] @ sample.p_obj[facing if facing.any() else slice(None)].mean(0)
    return poses


def centred_at_points(turns: np.ndarray, p_cam: np.ndarray, sample: SurfaceSample) -> np.ndarray:
    """(V * P, 4, 4) poses of turns (V, 4, 4) with what faced the camera then centred on points (P, 3)."""
    poses = np.repeat(turns, len(p_cam), 0)
    for k, T in enumerate(turns):
        facing = ((sample.n_obj @ T[:3, :3].T) * se3.transform(T, sample.p_obj)).sum(1) < 0
        centre = sample.p_obj[facing if facing.any() else slice(None)].mean(0)
        poses[k * len(p_cam) : (k + 1) * len(p_cam), :3, 3] = p_cam - T[:3, :3] @ centre
    return poses


def _shifted(T_cam_obj: np.ndarray, step_m: float, count: int) -> np.ndarray:
    """(H, 4, 4) a pose moved by up to ``count`` steps to each side along the camera's axes."""
    steps = step_m * np.arange(-count, count + 1)
    poses = np.repeat(T_cam_obj[None], len(steps) ** 3, 0)
    poses[:, :3, 3] += np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    return poses
