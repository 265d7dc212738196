"""Keyframes of one object's graph as plain values: what they saw, how they are linked, how two become one.

A graph over ever more keyframes costs ever more. :func:`merge_keyframes` keeps their number bounded without
throwing observations away: of two keyframes with nearly the same view, one
takes over what the other saw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from p2p_lib.core import se3

# Noise of an observation moved to another keyframe, in its own: the relative pose by which it moves
# adds to it. Measured: without, the covariance after much merging is too sure by half.
_MOVED_SIGMA = 1.25


@dataclass(frozen=True, eq=False)
class Link:
    """A relative pose from registration (paper: X~ of L_reg).

    previous         key of the keyframe it starts from
    T_previous_this  (4, 4) X_previous^-1 X_this
    covariance       (6, 6), right tangent of X_this
    """

    previous: int
    T_previous_this: np.ndarray
    covariance: np.ndarray


@dataclass(eq=False)
class Keyframe:
    """One keyframe: X_m = T_obj_cam (4, 4) and the observations p_cam (N, 3) of the points ``ids`` (N,).

    sigma    (N, 2) noise of bearing (rad) and range (m)
    link     to the keyframe before; None for the first
    factors  the observations in the solver's own form, made once; None when they have changed
    """

    T_obj_cam: np.ndarray
    ids: np.ndarray
    p_cam: np.ndarray
    sigma: np.ndarray
    link: Link | None
    factors: Any = None

    def replace_observations(self, ids: np.ndarray, p_cam: np.ndarray, sigma: np.ndarray) -> None:
        """Other observations instead of those there were."""
        self.ids, self.p_cam, self.sigma, self.factors = ids, p_cam, sigma, None

    def seen_from(self, T_obj_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its observations as another camera would have made them: p_cam (N, 3) and sigma (N, 2).

        Noise along the old ray and across it has its shares along and across the new one.
        """
        T = se3.inverse(T_obj_cam) @ self.T_obj_cam
        p_cam, old_ray = se3.transform(T, self.p_cam), self.p_cam @ T[:3, :3].T
        old_m, new_m = np.linalg.norm(old_ray, axis=1), np.maximum(np.linalg.norm(p_cam, axis=1), 1e-6)
        along = np.minimum((np.einsum("ni,ni->n", old_ray, p_cam) / (old_m * new_m)) ** 2, 1)
        across_var, range_var = (self.sigma[:, 0] * old_m) ** 2, self.sigma[:, 1] ** 2
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
        gone = np.arange(similarity.shape[1])
        similarity[gone + 1, gone] = -np.inf
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
    moved, moved_sigma = gone.seen_from(kept.T_obj_cam)
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
