"""Loop closure: features of one object matched between any two keyframes, and poses along the best matches.

A causal tracker never recovers from a wrong turn; here any two keyframes may be tied, by common tracks or by matched
SIFT features, and poses follow the maximum spanning tree of the ties.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import depth_noise_m, lift, off_edges
from p2p_lib.core.image import bounds, nearest_px
from p2p_lib.core.robust import fit_rigid, residual_m
from p2p_lib.core.types import Frame, evenly

#: A match is nearer than this share of the next best, and a tie has at least so many matches that move rigidly.
_RATIO, MIN_MATCHES = 0.8, 9
#: RANSAC: samples of three pairs; the inlier threshold in standard deviations of depth, and at least this, m.
_SAMPLES, _SIGMAS, _LEAST_M = 200, 3.0, 0.004
#: Views smaller than this are enlarged twice, px; room around the mask, px; most features; most points of a cloud.
_SMALL_PX, _ROOM_PX, _MOST, _CLOUD = 220, 4, 400, 1000
#: Features lie so far inside the mask, px, and off steps in depth, m.
_BORDER_PX, _STEP_M = 2, 0.02
#: A point that a pose puts this far before the measured depth, m or standard deviations, contradicts it.
_FLOATS_M, _FLOATS_SIGMAS = 0.006, 3.0
#: The share of contradicting points that reduces a tie to 1/e.
_CONTRADICTED = 0.03


@dataclass(frozen=True, eq=False)
class Features:
    """SIFT features of an object in a frame: p_cam (N, 3) measured, descriptors (N, 128).

    cloud (M, 3) are points of its surface, depth_m (H, W) is the frame's.
    """

    p_cam: np.ndarray
    descriptors: np.ndarray
    cloud: np.ndarray
    depth_m: np.ndarray


@dataclass(frozen=True, eq=False)
class Tie:
    """Two keyframes a and b whose matched points (rows of each, (M,)) move rigidly by T_a_b (4, 4).

    strength  how many agree, less if depth contradicts it: reflections stand still while the object turns
    """

    a: int
    b: int
    T_a_b: np.ndarray
    rows_a: np.ndarray
    rows_b: np.ndarray
    strength: float


def features(frame: Frame, mask: np.ndarray, camera: Camera, config: DepthConfig) -> Features:
    """SIFT features of an object with depth."""
    smooth = off_edges(frame.depth_m, _STEP_M)
    vu = evenly(np.argwhere(mask & smooth), _CLOUD)
    cloud = camera.unproject(vu[:, ::-1], frame.depth_m[tuple(vu.T)])
    seen = cloud, frame.depth_m
    nothing = Features(np.zeros((0, 3)), np.zeros((0, 128), np.float32), *seen)
    if not mask.any():
        return nothing
    tight, cut = bounds(mask), bounds(mask, _ROOM_PX)
    # Background at the mask's border, or through a handle, stands still while the object moves, and would match.
    own = cv2.erode(mask.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2)) * smooth
    grey, inside = cv2.cvtColor(frame.rgb[cut], cv2.COLOR_RGB2GRAY), own[cut].astype(np.uint8)
    scale = 2.0 if max(span.stop - span.start for span in tight) < _SMALL_PX else 1.0
    if scale > 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        inside = cv2.resize(inside, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    found, descriptors = cv2.SIFT.create(_MOST, contrastThreshold=0.02).detectAndCompute(grey, inside)
    if descriptors is None:
        return nothing
    uv_px = (np.array([point.pt for point in found]) + 0.5) / scale - 0.5 + (cut[1].start, cut[0].start)
    p_cam = lift(frame, uv_px, camera, config)
    lifted = np.isfinite(p_cam[:, 0])
    return Features(p_cam[lifted], descriptors[lifted], *seen)


def matched(a: Features, b: Features) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a and of b that are mutual nearest neighbours and pass the ratio test."""
    if min(len(a.p_cam), len(b.p_cam)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    likeness = a.descriptors @ b.descriptors.T / 512**2  # SIFT's have length 512
    best = likeness.argmax(1)
    rows = np.arange(len(best))
    first = likeness[rows, best]
    rest = likeness.copy()
    rest[rows, best] = -1
    off, next_off = (np.sqrt(np.maximum(2 - 2 * x, 1e-9)) for x in (first, rest.max(1)))
    good = (off < _RATIO * next_off) & (likeness.argmax(0)[best] == rows)
    return rows[good], best[good]


def rigid(p_a: np.ndarray, p_b: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """T_a_b (4, 4) of most pairs of points (N, 3), by RANSAC and least squares, and which (N,) bool agree with it."""
    none = np.eye(4), np.zeros(len(p_a), bool)
    if len(p_a) < 3:
        return none
    within = _within_m(p_a, p_b)
    sample = np.argsort(rng.random((_SAMPLES, len(p_a))), axis=1, kind="stable")[:, :3]
    off = residual_m(fit_rigid(p_b[sample], p_a[sample]), p_b, p_a)
    best = np.minimum(off / within, 1).sum(1).argmin()
    agree = off[best] < within
    for _ in range(3):
        if agree.sum() < 3:
            return none
        T_best = fit_rigid(p_b[agree], p_a[agree])
        agree = agreeing(T_best, p_a, p_b)
    return T_best, agree


def agreeing(T_a_b: np.ndarray, p_a: np.ndarray, p_b: np.ndarray) -> np.ndarray:
    """(N,) bool: pairs of points (N, 3) that coincide at T_a_b within their noise."""
    return residual_m(T_a_b, p_b, p_a) < _within_m(p_a, p_b)


def _within_m(p_a: np.ndarray, p_b: np.ndarray) -> np.ndarray:
    noise = np.hypot(depth_noise_m(p_a[:, 2]), depth_noise_m(p_b[:, 2]))
    return np.maximum(_SIGMAS * noise, _LEAST_M)


def rated(T_a_b: np.ndarray, matches: int, a: Features, b: Features, camera: Camera) -> float:
    """The strength of a tie: its matches, less by the larger share of one view's points that the other contradicts."""
    share = max(_contradicted(T_a_b, a, b.cloud, camera), _contradicted(se3.inverse(T_a_b), b, a.cloud, camera))
    return float(matches * np.exp(-share / _CONTRADICTED))


def _contradicted(T_a_b: np.ndarray, a: Features, cloud_b: np.ndarray, camera: Camera) -> float:
    """Of the points cloud_b (N, 3) that project into view a, the share that would float before its depth."""
    p_a = se3.transform(T_a_b, cloud_b)
    uv_px = camera.project(p_a)
    inside = camera.inside(uv_px)
    if not inside.any():
        return 1.0
    u, v = nearest_px(uv_px, a.depth_m.shape)
    measured, z = a.depth_m[v, u], p_a[:, 2]
    off = np.maximum(_FLOATS_M, _FLOATS_SIGMAS * depth_noise_m(z))
    floats = inside & (measured > 0) & (z < measured - off)
    return float(floats.sum() / inside.sum())


def ties(views: list[Features], camera: Camera, rng: np.random.Generator) -> list[Tie]:
    """Every pair of keyframes that matched features tie."""
    found = []
    for a in range(len(views)):
        for b in range(a + 1, len(views)):
            rows_a, rows_b = matched(views[a], views[b])
            if len(rows_a) < MIN_MATCHES:
                continue
            T_a_b, agree = rigid(views[a].p_cam[rows_a], views[b].p_cam[rows_b], rng)
            if agree.sum() >= MIN_MATCHES:
                strength = rated(T_a_b, int(agree.sum()), views[a], views[b], camera)
                found.append(Tie(a, b, T_a_b, rows_a[agree], rows_b[agree], strength))
    return found


def along_ties(T_cam_obj: np.ndarray, pairs: list[tuple[int, int, np.ndarray, float]]) -> np.ndarray:
    """Poses (K, 4, 4), NaN where none, along the maximum spanning tree of pairs (a, b, T_a_b, strength).

    The keyframe with the strongest ties keeps its pose, and so do those that no tie connects with it.
    """
    K, T = len(T_cam_obj), np.array(T_cam_obj, float)
    best: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    for a, b, T_a_b, strength in pairs:
        if strength > best.get((a, b), (0.0, T_a_b))[0]:
            best[a, b] = strength, T_a_b
    if not best:
        return T
    rows, columns = np.array(list(best)).T
    strengths = np.array([strength for strength, _ in best.values()])
    tree = minimum_spanning_tree(coo_array((1 / strengths, (rows, columns)), (K, K)).tocsr())
    total = np.bincount(rows, strengths, K) + np.bincount(columns, strengths, K)
    total[~np.isfinite(T[:, 0, 0])] = -1
    order, before = breadth_first_order(tree, int(total.argmax()), directed=False)
    for k in order[1:]:
        at = before[k]
        T_k_at = best[k, at][1] if (k, at) in best else se3.inverse(best[at, k][1])
        T[k] = T_k_at @ T[at]
    return se3.orthonormalised(T) if np.isfinite(T).all() else T
