"""What we add to an object's graph: it stays bounded, can take in another graph, and keeps stray points out.

:func:`merge_keyframes` bounds the number of keyframes, and so the cost of a solve, without dropping observations: of
two keyframes with nearly the same view, one takes over the observations of the other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig
from p2p_lib.method.factor_graph import GraphResult, Keyframe, Link, ObjectGraph, about

# An observation moved to another keyframe has this many times its noise: that of the relative pose adds to it.
# Measured: without this, the covariance after much merging is too sure by half.
_MOVED_SIGMA = 1.25
#: A stray observation is off by more standard deviations than this; small errors of poses are allowed for.
_STRAY_SIGMAS = 8.0
# Noise of a landmark that a memory places, m.
_REMEMBERED_M = 0.002
# Noise of the relative pose that ties a graph to the one it joins (rad, m): so large that the points decide.
_JOINED_SIGMAS = np.repeat([0.05, 0.01], 3)


class BoundedGraph(ObjectGraph):
    """A graph of no more than ``config.max_keyframes`` keyframes, which can take in another one."""

    def __init__(self, config: FactorGraphConfig):
        super().__init__(config)
        self._joined: set[int] = set()  # keyframes of graphs that it has taken in

    def optimise(self) -> GraphResult:
        """Solve, then merge the keyframes that are too many: the result still lists them."""
        result = super().optimise()
        if result.ok:
            merge_keyframes(self._keyframes, self.config.max_keyframes)
        return result

    def remember(self, point_ids: np.ndarray, p_obj: np.ndarray) -> None:
        """Add points (N, 3) of a memory, as observed by the first keyframe, which stands for it, with a map's noise."""
        first = self._keyframes[min(self._keyframes)]
        p_cam = se3.transform(se3.inverse(first.T_obj_cam), p_obj)
        sigma_rad = _REMEMBERED_M / np.linalg.norm(p_cam, axis=1)
        sigma = np.stack([sigma_rad, np.full(len(p_obj), _REMEMBERED_M)], -1)
        seen = first.ids, first.p_cam, first.sigma
        more = (point_ids, p_cam, sigma)
        first.replace_observations(*(np.concatenate(both) for both in zip(seen, more, strict=True)))
        self._points |= dict(zip(point_ids.tolist(), p_obj, strict=True))

    def join(self, other: BoundedGraph, T_obj_other: np.ndarray, point_shift: int) -> None:
        """Take in another graph of the same object, whose frame maps to this one's by T_obj_other (4, 4).

        Ids of its points are raised by ``point_shift``. A loose relative pose ties its first keyframe to the newest one
        here; later keyframes that see points of both tie them well.
        """
        shift, p_obj = self.next_key, se3.transform(T_obj_other, np.array([*other._points.values()]).reshape(-1, 3))
        for key, k in other._keyframes.items():
            T_obj_cam, link = T_obj_other @ k.T_obj_cam, k.link
            if link is None:
                link = self._link(T_obj_cam, p_obj, about(p_obj, _JOINED_SIGMAS))
            else:
                link = replace(link, previous=link.previous + shift)
            self._keyframes[key + shift] = Keyframe(T_obj_cam, k.ids + point_shift, k.p_cam, k.sigma, link)
        self._points |= {i + point_shift: p for i, p in zip(other._points, p_obj, strict=True)}
        self._joined |= {key + shift for key in other._keyframes}
        self.next_key += other.next_key

    def _newest(self) -> int:
        # A new pose is relative to this graph's own keyframes: those just taken in are tied loosely.
        return max(self._keyframes.keys() - self._joined)


def seen_from(keyframe: Keyframe, T_obj_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A keyframe's observations as another camera would have made them: p_cam (N, 3) and sigma (N, 2).

    Noise along and across the old ray is resolved along and across the new one.
    """
    T = se3.inverse(T_obj_cam) @ keyframe.T_obj_cam
    p_cam, old_ray = se3.transform(T, keyframe.p_cam), keyframe.p_cam @ T[:3, :3].T
    old_m, new_m = np.linalg.norm(old_ray, axis=1), np.maximum(np.linalg.norm(p_cam, axis=1), 1e-6)
    along = np.minimum((np.einsum("ni,ni->n", old_ray, p_cam) / (old_m * new_m)) ** 2, 1)
    across_var, range_var = (keyframe.sigma[:, 0] * old_m) ** 2, keyframe.sigma[:, 1] ** 2
    new_range = along * range_var + (1 - along) * across_var
    new_across = along * across_var + (1 - along) * np.maximum(range_var, across_var)
    return p_cam, np.sqrt(np.stack([new_across / new_m**2, new_range], -1))


def misfit(expected: np.ndarray, seen: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(N,) distance of points (N, 3) in bearing and range, in standard deviations (N, 2) of both."""
    across = np.linalg.norm(np.cross(expected, seen), axis=1)
    angle = np.arctan2(across, np.einsum("ni,ni->n", expected, seen))
    range_m = np.linalg.norm(expected, axis=1) - np.linalg.norm(seen, axis=1)
    return np.hypot(angle / sigma[:, 0], range_m / sigma[:, 1])


def merge_keyframes(keyframes: dict[int, Keyframe], most: int) -> None:
    """Merges keyframes, in place, until ``most`` remain (0: no bound), those with the most similar views first.

    The first keyframe, which holds the gauge, and the newest are never given up.
    """
    while most and max(most, 2) < len(keyframes):
        keys = sorted(keyframes)
        R = np.array([keyframes[key].T_obj_cam[:3, :3] for key in keys])
        # tr(R_kept^T R_gone) grows as the angle between the two falls.
        similarity = np.einsum("kij,gij->kg", R, R[1:-1])
        own = np.arange(similarity.shape[1])
        similarity[own + 1, own] = -np.inf
        kept, gone = np.unravel_index(np.argmax(similarity), similarity.shape)
        _merge(keyframes[keys[kept]], keyframes[keys[gone + 1]])
        remove(keyframes, keys[gone + 1])


def remove(keyframes: dict[int, Keyframe], key: int) -> None:
    """Takes a keyframe out, in place, and joins the relative poses on its two sides to one."""
    before = keyframes.pop(key).link
    for keyframe in keyframes.values():
        after = keyframe.link
        if after is None or after.previous != key:
            continue
        if before is None:
            keyframe.link = None
            continue
        A = se3.adjoint(se3.inverse(after.T_previous_this))
        T_previous_this = before.T_previous_this @ after.T_previous_this
        keyframe.link = Link(before.previous, T_previous_this, A @ before.covariance @ A.T + after.covariance)


def _merge(kept: Keyframe, gone: Keyframe) -> None:
    """Adds the observations of ``gone`` to ``kept``; where both saw a point, their weighted mean remains."""
    moved, moved_sigma = seen_from(gone, kept.T_obj_cam)
    moved_sigma *= _MOVED_SIGMA
    ids = np.concatenate([kept.ids, gone.ids])
    p_cam, sigma = np.concatenate([kept.p_cam, moved]), np.concatenate([kept.sigma, moved_sigma])
    merged, row = np.unique(ids, return_inverse=True)
    information = sigma**-2
    total = _sums(row, information)
    mean = _sums(row, p_cam * information[:, 1:]) / total[:, 1:]
    kept.replace_observations(merged, mean, total**-0.5)


def _sums(row: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(rows, k) sums of the values (n, k) of each row."""
    return np.stack([np.bincount(row, column) for column in values.T], -1)


def explained(p_obj: np.ndarray, p_cam: np.ndarray, T_cam_obj: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(N,) bool: map points p_obj (N, 3) that are measured where a pose has them, within the noise.

    sigma  (N, 2) noise of bearing (rad) and range (m) of the measured p_cam (N, 3)

    Others would bend the graph, whose Huber loss never rejects them: a reflection slides over an object, a little from
    keyframe to keyframe, and takes poses and keypoints along.
    """
    return misfit(se3.transform(T_cam_obj, p_obj), p_cam, sigma) <= _STRAY_SIGMAS
