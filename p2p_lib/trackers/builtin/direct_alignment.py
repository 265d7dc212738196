"""Direct alignment: how a rigid motion segment moved, by the colours and the depth of all that shows of it.

Points that slide over an object while it turns agree with each other, most of all those on its reflections, which stand
still. Here a motion is judged by all of the surface: in the newest frame it has the colours and the depth that it had.
Reflections are of the light's colour, about white, and add as much to each channel: without the least of the three what
is left is the surface's own (specular-free image; Tan and Ikeuchi, PAMI 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from p2p_lib.core.compiled import compiled
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.rigid_motion import pose_distance_m

#: Standard deviations of the blur of what is compared, px of half the resolution: coarse, fine.
_BLUR_PX = 2.5, 1.2
#: A point does not agree whose colours (channels without their least, brightness) differ by more, or its depth, m, and
#: by so many times its noise.
_COLOUR, _BRIGHTNESS, _DEPTH_M, _DEPTH_SIGMAS = 12.0, 100.0, 0.006, 3.0
#: Errors of colours as a share of those, neighbours having the same; of a point's place where nothing tells it, px.
_NOISE, _UNKNOWN_PX = 0.7, 8.0
#: What is measured nearer than a point by more than this hides it, m; seen more obliquely (cosine), it does not count.
_HIDDEN_M, _OBLIQUE = 0.02, 0.25
#: Motions under which less of the surface shows are not judged.
_LEAST_SHOWN = 0.35
#: Points of a surface, the most and the least of them.
_MOST_POINTS, _FEWEST_POINTS = 400, 60
#: Its rotations that are tried: so far apart, up to so far. So many of the best are aligned, so many of those finely.
_STEP_DEG, _MOST_DEG, _COARSE, _FINE = 12.0, 36.0, 6, 3
#: Steps of an alignment at most.
_STEPS = 8
#: Costs: beyond the share that is asked for, one is better by so much; so low it must be; below this one is good.
_BETTER_BY, _BELIEVED, _POOR = 0.02, 0.9, 0.15
#: Points 5 cm apart tell motions from each other that differ by more.
_APART_M = 0.002


@dataclass(frozen=True, eq=False)
class Surface:
    """What shows of a segment in a frame: points p_cam (N, 3), normals (N, 3), colours (2, N, 4), coarse and fine.

    cov_px2  (N, 2, 2) how well the colours around a point tell where it is: little along an edge, nothing where all is
             of one colour
    depth_m  (N,) depth that is off by more does not agree
    """

    p_cam: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    cov_px2: np.ndarray
    depth_m: np.ndarray

    def select(self, rows: np.ndarray) -> Surface:
        """Some of the points."""
        return Surface(
            self.p_cam[rows],
            self.normals[rows],
            np.ascontiguousarray(self.colours[:, rows]),
            self.cov_px2[rows],
            self.depth_m[rows],
        )

    @property
    def centre(self) -> np.ndarray:
        """(3,) about the middle of the object: what shows is its front."""
        return self.p_cam.mean(0) + np.array([0, 0, 0.8 * np.sqrt(self.p_cam.var(0).sum())])


@dataclass(frozen=True, eq=False)
class Patch:
    """Part of a frame at half the resolution: colours, coarse and fine (H, W, 4), depth_m (H, W), fx, fy, cx, cy."""

    colours: tuple[np.ndarray, np.ndarray]
    depth_m: np.ndarray
    intrinsics: tuple[float, float, float, float]

    @classmethod
    def of(cls, image: Image, corner: np.ndarray, opposite: np.ndarray) -> Patch:
        """Between two corners (u, v), px of half the resolution, as far as they are in the image."""
        h, w = image.half.shape[:2]
        (u0, v0), (u1, v1) = np.clip(corner, 0, [w - 1, h - 1]), np.clip(opposite, 1, [w, h])
        part = np.s_[v0:v1, u0:u1]
        rgb, c = np.ascontiguousarray(image.half[part]), image.camera
        channels = cv2.split(rgb)
        least = cv2.min(cv2.min(*channels[:2]), channels[2])
        own = cv2.merge([cv2.subtract(channel, least) for channel in channels])
        colours = np.empty((*least.shape, 4), np.float32)
        colours[..., :3] = own / np.float32(_COLOUR)
        colours[..., 3] = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) / np.float32(_BRIGHTNESS)
        coarse, fine = (cv2.GaussianBlur(colours, (0, 0), sigma_px) for sigma_px in _BLUR_PX)
        depth_m = np.ascontiguousarray(image.depth_m[::2, ::2][part], np.float32)
        return cls((coarse, fine), depth_m, (c.fx / 2, c.fy / 2, c.cx / 2 - u0, c.cy / 2 - v0))

    def surface(self, own: np.ndarray) -> Surface:
        """Points evenly over a region ``own`` (H, W) of it, where the surface is smooth enough to have a normal."""
        v, u = np.nonzero(own)
        every = max(1, len(v) // (2 * _MOST_POINTS))
        v, u = np.ascontiguousarray(v[::every]), np.ascontiguousarray(u[::every])
        p_cam, normals, smooth = _points(self.depth_m, u, v, *self.intrinsics)
        rows = np.flatnonzero(smooth)
        rows = rows[np.linspace(0, len(rows) - 1, min(_MOST_POINTS, len(rows))).astype(int)]
        u, v, fine = u[rows], v[rows], self.colours[1]
        slopes = np.stack([fine[v, u + 1] - fine[v, u - 1], fine[v + 1, u] - fine[v - 1, u]], 1) / 2  # (N, 2, 4)
        cov_px2 = np.linalg.inv(slopes @ slopes.transpose(0, 2, 1) / (4 * _NOISE**2) + np.eye(2) / _UNKNOWN_PX**2)
        colours, depth_m = np.stack([of[v, u] for of in self.colours]), _DEPTH_SIGMAS * depth_noise_m(p_cam[rows, 2])
        return Surface(p_cam[rows], normals[rows], colours, cov_px2, np.maximum(_DEPTH_M, depth_m))

    def costs(self, surface: Surface, motions: np.ndarray, level: int = 1) -> np.ndarray:
        """(K,) of motions (K, 4, 4) in the camera's frame: 0 where everything agrees, 2 where nothing does."""
        return _costs(np.ascontiguousarray(motions, float), *self._compared(surface, level))

    def aligned(self, surface: Surface, motion: np.ndarray, level: int = 1) -> np.ndarray:
        """The motion (4, 4) of least cost near this one."""
        return _aligned(np.ascontiguousarray(motion, float), *self._compared(surface, level))

    def _compared(self, surface: Surface, level: int) -> tuple[Any, ...]:
        own = surface.p_cam, surface.normals, surface.depth_m, surface.colours[level]
        return *own, self.colours[level], self.depth_m, *self.intrinsics

    def searched(self, surface: Surface, starts: np.ndarray) -> np.ndarray:
        """The motion (4, 4) of least cost near these (S, 4, 4), each after turns about the middle of the surface."""
        few, motions = surface.select(np.arange(0, len(surface.p_cam), 2)), starts[:, None] @ _turns(surface.centre)
        motions = motions.reshape(-1, 4, 4)
        best = motions[np.argsort(self.costs(few, motions, 0), kind="stable")[:_COARSE]]
        near = np.stack([self.aligned(few, T, 0) for T in [*best, *starts]])
        near = near[np.argsort(self.costs(surface, near, 0), kind="stable")[:_FINE]]
        near = np.stack([self.aligned(surface, T) for T in near])
        return near[np.argmin(self.costs(surface, near))]


def overruling(
    surface: Surface, now: Patch, known: Sequence[np.ndarray], predicted: np.ndarray, share: float, far: bool
) -> np.ndarray | None:
    """The motion (4, 4) of a surface that agrees clearly better with the newest frame than those that are known of it.

    known      motions (4, 4) by its points, its corners
    predicted  where none is, the motion that is searched near
    share      clearly better costs less than this much of the least of theirs
    far        not only near what is known
    None where no other motion is clearly better.
    """
    if not share or len(surface.p_cam) < _FEWEST_POINTS:
        return None
    starts = np.stack(known or [predicted])
    costs = now.costs(surface, starts)
    least = costs.min() if len(known) else np.inf
    limit = min(share * least - _BETTER_BY, _BELIEVED)
    if limit <= 0:
        return None
    motion = now.aligned(surface, starts[costs.argmin()])
    cost = now.costs(surface, motion[None])[0]
    if cost < limit or (far and cost > _POOR):
        found = now.searched(surface, starts)
        # Not for a little less: of what looks much the same from everywhere, the nearer motion is the likelier.
        if (there := now.costs(surface, found[None])[0]) < share * cost:
            motion, cost = found, there
    alike = len(known) and pose_distance_m(motion, starts[costs.argmin()], surface.p_cam.mean(0)) < _APART_M
    return None if cost >= limit or alike else motion


@cache
def _rotations() -> np.ndarray:
    """(K, 3, 3) evenly among those up to the most."""
    steps = np.arange(-_MOST_DEG, _MOST_DEG + 1, _STEP_DEG)
    about = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    about = about[np.linalg.norm(about, axis=1) < _MOST_DEG + 1e-6]
    return Rotation.from_rotvec(np.radians(about)).as_matrix()


def _turns(centre: np.ndarray) -> np.ndarray:
    """(K, 4, 4): the rotations, about a point (3,)."""
    R = _rotations()
    turns = np.tile(np.eye(4), (len(R), 1, 1))
    turns[:, :3, :3], turns[:, :3, 3] = R, centre - R @ centre
    return turns


@compiled("f4[:,::1], i8[::1], i8[::1], f8, f8, f8, f8")
def _points(depth_m, us, vs, fx, fy, cx, cy):
    """Points and normals (N, 3) at pixels, by least squares through the 5 x 5 readings around each on its surface."""
    h, w = depth_m.shape
    count = len(us)
    p_cam, normals, smooth = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_)
    for n in range(count):
        u, v = us[n], vs[n]
        z0 = depth_m[v, u]
        if z0 <= 0 or u < 2 or v < 2 or u > w - 3 or v > h - 3:
            continue
        m, su, sv, sz, suu, suv, svv, suz, svz = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(-2, 3):
            for i in range(-2, 3):
                z = depth_m[v + j, u + i]
                if z > 0 and abs(z - z0) < 0.015:
                    d = z - z0
                    m += 1
                    su += i
                    sv += j
                    sz += d
                    suu += i * i
                    suv += i * j
                    svv += j * j
                    suz += i * d
                    svz += j * d
        if m < 12:
            continue
        a, b, c = suu - su * su / m + 0.1, suv - su * sv / m, svv - sv * sv / m + 0.1
        e, f = suz - su * sz / m, svz - sv * sz / m
        det = a * c - b * b
        gu, gv = (c * e - b * f) / det, (a * f - b * e) / det  # of depth, m per pixel
        z = z0 + sz / m - gu * su / m - gv * sv / m
        x, y = (u - cx) / fx, (v - cy) / fy
        ax, ay, az = z / fx + x * gu, y * gu, gu  # to the next pixel of the row, and of the column
        bx, by, bz = x * gv, z / fy + y * gv, gv
        nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        p_cam[n, 0], p_cam[n, 1], p_cam[n, 2] = x * z, y * z, z
        normals[n, 0], normals[n, 1], normals[n, 2] = nx / length, ny / length, nz / length
        smooth[n] = True
    return p_cam, normals, smooth


@compiled()
def _shows(p, n, depth_m, fx, fy, cx, cy):
    """Where a point with its normal shows (u, v), and how far behind it is measured, m; u is -1 where it does not."""
    h, w = depth_m.shape
    x, y, z = p[0], p[1], p[2]
    if z < 0.05 or n[0] * x + n[1] * y + n[2] * z > -_OBLIQUE * np.sqrt(x * x + y * y + z * z):
        return -1.0, -1.0, 0.0
    u, v = fx * x / z + cx, fy * y / z + cy
    if u < 2 or v < 2 or u > w - 4 or v > h - 4:
        return -1.0, -1.0, 0.0
    measured = depth_m[int(v + 0.5), int(u + 0.5)]
    if measured <= 0 or measured - z < -_HIDDEN_M:
        return -1.0, -1.0, 0.0
    return u, v, measured - z


@compiled()
def _read(image, u, v, out):
    """The image (H, W, 4) at a pixel, bilinear, into out (4,)."""
    x, y = int(u), int(v)
    a, b = u - x, v - y
    for c in range(4):
        upper = image[y, x, c] * (1 - a) + image[y, x + 1, c] * a
        lower = image[y + 1, x, c] * (1 - a) + image[y + 1, x + 1, c] * a
        out[c] = upper * (1 - b) + lower * b


@compiled()
def _moved(T, point, by, out):
    """A point (``by`` 1) or a direction (0), moved, into out (3,)."""
    for i in range(3):
        out[i] = T[i, 0] * point[0] + T[i, 1] * point[1] + T[i, 2] * point[2] + by * T[i, 3]


@compiled("f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f4[:,::1], f4[:,:,::1], f4[:,::1], f8, f8, f8, f8")
def _costs(motions, p_cam, normals, off_m, colours, image, depth_m, fx, fy, cx, cy):
    count, here, p, m = len(p_cam), np.zeros(4), np.zeros(3), np.zeros(3)
    costs = np.full(len(motions), 2.0)
    for k in range(len(motions)):
        shown, total = 0, 0.0
        for n in range(count):
            _moved(motions[k], p_cam[n], 1.0, p)
            _moved(motions[k], normals[n], 0.0, m)
            u, v, off = _shows(p, m, depth_m, fx, fy, cx, cy)
            if u < 0:
                continue
            _read(image, u, v, here)
            off_colour = 0.0
            for c in range(4):
                off_colour += (here[c] - colours[n, c]) ** 2
            shown += 1
            total += min(off_colour, 1.0) + min((off / off_m[n]) ** 2, 1.0)
        if shown > _LEAST_SHOWN * count:
            costs[k] = total / shown
    return costs


@compiled("f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f4[:,::1], f4[:,:,::1], f4[:,::1], f8, f8, f8, f8")
def _aligned(motion, p_cam, normals, off_m, colours, image, depth_m, fx, fy, cx, cy):
    """Iteratively reweighted Gauss-Newton (Geman-McClure) on colours and on distances to the measured surface."""
    count, T, p, m, middle = len(p_cam), motion.copy(), np.zeros(3), np.zeros(3), np.zeros(3)
    here, right, left, below, above = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    J, r, H, g, mean = np.zeros((5, 6)), np.zeros(5), np.zeros((6, 6)), np.zeros(6), np.zeros(3)
    for n in range(count):
        for i in range(3):
            mean[i] += p_cam[n, i] / count
    for _ in range(_STEPS):
        for i in range(6):
            g[i] = 0.0
            for j in range(6):
                H[i, j] = 0.0
            # Kept where it is, by little: what nothing shows does not move.
            H[i, i] = (0.01 if i < 3 else 1.0) * count
        shown = 0
        _moved(T, mean, 1.0, middle)
        for n in range(count):
            _moved(T, p_cam[n], 1.0, p)
            _moved(T, normals[n], 0.0, m)
            u, v, off = _shows(p, m, depth_m, fx, fy, cx, cy)
            if u < 0:
                continue
            shown += 1
            _read(image, u, v, here)
            _read(image, u + 1, v, right)
            _read(image, u - 1, v, left)
            _read(image, u, v + 1, below)
            _read(image, u, v - 1, above)
            z, off_colour = p[2], 0.0
            for c in range(4):
                r[c] = here[c] - colours[n, c]
                off_colour += r[c] ** 2
                dx, dy = (right[c] - left[c]) / 2 * fx / z, (below[c] - above[c]) / 2 * fy / z
                J[c, 3], J[c, 4], J[c, 5] = dx, dy, -(dx * p[0] + dy * p[1]) / z
            # Distance from the measured point, on the same ray, to the tangent plane.
            r[4] = (m[0] * p[0] + m[1] * p[1] + m[2] * z) / z * off / off_m[n]
            J[4, 3], J[4, 4], J[4, 5] = -m[0] / off_m[n], -m[1] / off_m[n], -m[2] / off_m[n]
            ax, ay, az = p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]
            for c in range(5):
                dx, dy, dz = J[c, 3], J[c, 4], J[c, 5]
                J[c, 0], J[c, 1], J[c, 2] = dz * ay - dy * az, dx * az - dz * ax, dy * ax - dx * ay
                weight = 1 / (1 + (off_colour if c < 4 else (off / off_m[n]) ** 2)) ** 2
                for i in range(6):
                    g[i] -= weight * J[c, i] * r[c]
                    for j in range(6):
                        H[i, j] += weight * J[c, i] * J[c, j]
        if shown < 20:
            break
        step = np.linalg.solve(H, g)
        angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        scale = min(1.0, 0.2 / max(angle, 1e-12))
        farthest = max(abs(step[3]), abs(step[4]), abs(step[5]))
        for i in range(6):
            step[i] *= scale
        _turn(T, step, middle)
        if angle < 5e-4 and farthest < 1e-4:
            break
    return T


@compiled()
def _turn(T, step, middle):
    """Turn T (4, 4), in place, about ``middle`` by the first three of ``step`` (rad), and move it by the others."""
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    a = np.sin(angle) / angle if angle > 1e-9 else 1.0
    b = 2 * (np.sin(angle / 2) / angle) ** 2 if angle > 1e-9 else 0.5
    for k in range(4):
        x, y, z = T[0, k], T[1, k], T[2, k]
        if k == 3:
            x, y, z = x - middle[0], y - middle[1], z - middle[2]
        # Rodrigues: v + a w x v + b w x (w x v)
        cx, cy, cz = step[1] * z - step[2] * y, step[2] * x - step[0] * z, step[0] * y - step[1] * x
        dx, dy, dz = step[1] * cz - step[2] * cy, step[2] * cx - step[0] * cz, step[0] * cy - step[1] * cx
        T[0, k], T[1, k], T[2, k] = x + a * cx + b * dx, y + a * cy + b * dy, z + a * cz + b * dz
        if k == 3:
            for i in range(3):
                T[i, k] += middle[i] + step[3 + i]
