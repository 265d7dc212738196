"""What the embedded tracker knows of its points: rows of arrays, and what neighbours say of one another."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from p2p_lib.stages import features
from p2p_lib.stages.appearance import Patches

#: Corners remembered around an appearance, and neighbouring points.
ANCHORS, NEIGHBOURS = 4, 8
_EYE = np.eye(2, dtype=np.float32)


@dataclass(eq=False)
class Points:
    """N points with K appearances each, row by row. Offsets and warps are in pixels of the appearance's frame.

    A warp C takes offsets in a point's first appearance to offsets in the newest frame, view[k] to
    those in the frame of appearance k: C inv(view[k]) is how appearance k looks now.
    """

    ids: np.ndarray  # (N,) int64, increasing
    uv: np.ndarray  # (N, 2) newest known place
    warp: np.ndarray  # (N, 2, 2) C
    visible: np.ndarray  # (N,) bool
    cov: np.ndarray  # (N, 2, 2) covariance of uv, px^2
    depth_m: np.ndarray  # (N,) where it was last visible; 0 where not measured
    hidden_for: np.ndarray  # (N,) frames
    ncc: np.ndarray  # (N,) correlation with the appearance last seen
    coasting: np.ndarray  # (N,) frames since an appearance was last seen
    count: np.ndarray  # (N,) appearances in use
    view: np.ndarray  # (N, K, 2, 2)
    view_cov: np.ndarray  # (N, K, 2, 2) of the point's place in the appearance
    fine: Patches  # (N, K) at full resolution
    coarse: Patches  # (N, K) at half resolution
    colour: np.ndarray  # (N, K, 2) chroma around the point
    anchor: np.ndarray  # (N, K, J, SIZE) descriptors of corners around the point; zero where there is none
    anchor_frame: np.ndarray  # (N, K, J, 2, 2) their axes
    anchor_offset: np.ndarray  # (N, K, J, 2) from corner to point
    neighbour: np.ndarray  # (N, K, M) ids of points visible around it, -1 where none
    neighbour_offset: np.ndarray  # (N, K, M, 2) from point to neighbour

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def new(cls, ids: np.ndarray, uv: np.ndarray, appearances: int) -> Points:
        """Points without an appearance yet."""
        n, k = len(ids), appearances
        zero, warp = np.zeros(n, np.int64), np.tile(_EYE, (n, 1, 1))
        anchors, near = (n, k, ANCHORS), (n, k, NEIGHBOURS)
        return cls(
            ids=ids,
            uv=uv.astype(np.float32),
            warp=warp,
            visible=np.ones(n, bool),
            cov=np.zeros((n, 2, 2), np.float32),
            depth_m=np.zeros(n, np.float32),
            hidden_for=zero,
            ncc=np.ones(n, np.float32),
            coasting=zero.copy(),
            count=zero.copy(),
            view=np.tile(_EYE, (n, k, 1, 1)),
            view_cov=np.zeros((n, k, 2, 2), np.float32),
            fine=Patches.empty((n, k)),
            coarse=Patches.empty((n, k)),
            colour=np.zeros((n, k, 2), np.float32),
            anchor=np.zeros((*anchors, features.SIZE), np.float32),
            anchor_frame=np.tile(_EYE, (*anchors, 1, 1)),
            anchor_offset=np.zeros((*anchors, 2), np.float32),
            neighbour=np.full(near, -1, np.int64),
            neighbour_offset=np.zeros((*near, 2), np.float32),
        )

    @property
    def sigma_px(self) -> np.ndarray:
        """(N,) standard deviation of uv."""
        return np.sqrt(np.trace(self.cov, axis1=1, axis2=2))

    def select(self, rows: np.ndarray) -> Points:
        """The points at these rows or under this mask."""
        return Points(*(getattr(self, f.name)[rows] for f in fields(self)))

    def joined(self, other: Points) -> Points:
        """These points, then the others."""
        mine, theirs = ([getattr(p, f.name) for f in fields(self)] for p in (self, other))
        return Points(*(_concatenate(a, b) for a, b in zip(mine, theirs, strict=True)))

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Row of each id, any shape; -1 where it is not held."""
        if not len(self):
            return np.full(np.shape(ids), -1)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self) - 1)
        return np.where(self.ids[at] == ids, at, -1)


def _concatenate(a: np.ndarray | Patches, b: np.ndarray | Patches) -> np.ndarray | Patches:
    if isinstance(a, Patches):
        return Patches(*(np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(Patches)))
    return np.concatenate([a, b])


def carried(
    offset: np.ndarray, now: np.ndarray, use: np.ndarray, noise_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where points are and how they are warped, by an affine motion of the points around them.

    offset    (N, M, 2) from the point to each neighbour when its appearance was taken
    now       (N, M, 2) where the neighbours are, used where ``use`` (N, M)
    noise_px  (N, M) standard deviation of that

    Returns uv_px (N, 2), A (N, 2, 2), sigma_px (N,) and whether the neighbours agree on it (N,). The affine
    part is held to a similarity where the neighbours are too few or too much in line to tell.
    """
    now = np.where(use[..., None], now, 0)
    prior = use / (1 + (offset**2).sum(-1) / 30**2) / (1 + noise_px**2)
    weight = prior
    for _ in range(3):  # reweighted: a neighbour that went elsewhere does not count
        total = np.maximum(weight.sum(1), 1e-6)[:, None]
        centre, there = (weight[..., None] * offset).sum(1) / total, (weight[..., None] * now).sum(1) / total
        x, y = offset - centre[:, None], now - there[:, None]
        S = (weight[..., None] * y).transpose(0, 2, 1) @ x
        V = (weight[..., None] * x).transpose(0, 2, 1) @ x
        size = np.maximum(np.trace(V, axis1=1, axis2=2), 1e-6)
        a, b = (S[:, 0, 0] + S[:, 1, 1]) / size, (S[:, 1, 0] - S[:, 0, 1]) / size
        similar = np.stack([np.stack([a, -b], -1), np.stack([b, a], -1)], -2)
        ridge = (0.02 * size + 5 * total[:, 0])[:, None, None] * _EYE
        A = (S + similar @ ridge) @ np.linalg.inv(V + ridge)
        off = np.linalg.norm(y - x @ A.transpose(0, 2, 1), axis=-1)
        typical = np.maximum(np.sqrt((weight * off**2).sum(1) / total[:, 0]), 0.3)
        weight = prior / (1 + (off / typical[:, None]) ** 2)
    agree = (use & (off < 3)).sum(1)
    stretch = np.linalg.det(A)
    # The motion is affine only nearby: what the neighbours say is worth less the farther they are.
    sigma_px = np.hypot(typical / np.sqrt(np.maximum(agree, 1)), 0.05 * np.linalg.norm(centre, axis=1))
    uv = there - (A @ centre[..., None])[..., 0]
    ok = (agree >= 3) & (stretch > 0.1) & (stretch < 10)
    return uv.astype(np.float32), A.astype(np.float32), sigma_px.astype(np.float32), ok
