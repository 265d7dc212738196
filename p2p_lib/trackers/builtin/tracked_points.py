"""What the embedded tracker knows of its points: rows of arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from p2p_lib.trackers.builtin.appearance import Patches

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
    verified: np.ndarray  # (N,) bool: an appearance, or Lucas-Kanade for a while, says so, not its body alone
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
    body: np.ndarray  # (N,) which rigid body it belongs to, -1 for none
    loose: np.ndarray  # (N,) bool: left its body together with others in the newest frame, not far yet
    p_body: np.ndarray  # (N, 3) place on it, metres
    map_cov: np.ndarray  # (N, 3, 3) its covariance
    tangent: np.ndarray  # (N, 3, 2) offset on the body per pixel of offset in the first appearance

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def new(cls, ids: np.ndarray, uv: np.ndarray, appearances: int) -> Points:
        """Points without an appearance yet."""
        n, k = len(ids), appearances
        zero, warp = np.zeros(n, np.int64), np.tile(_EYE, (n, 1, 1))
        return cls(
            ids=ids,
            uv=uv.astype(np.float32),
            warp=warp,
            visible=np.ones(n, bool),
            verified=np.ones(n, bool),
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
            body=np.full(n, -1),
            loose=np.zeros(n, bool),
            p_body=np.zeros((n, 3)),
            map_cov=np.zeros((n, 3, 3)),
            tangent=np.zeros((n, 3, 2)),
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
