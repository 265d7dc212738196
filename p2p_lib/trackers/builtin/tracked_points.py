"""What the tracker knows of its points: arrays with one row per point."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core.types import SHARED, Rows
from p2p_lib.trackers.builtin.appearance import Templates

_EYE = np.eye(2, dtype=np.float32)


@dataclass(eq=False)
class Points(Rows):
    """N points with K templates each. Offsets and warps are in pixels of the template's image.

    A warp takes offsets in a point's first template to offsets in the newest image, template_warp[k] to
    those in template k: warp template_unwarp[k] is how template k appears now.
    """

    uv: np.ndarray  # (N, 2) newest known position
    warp: np.ndarray  # (N, 2, 2)
    cov: np.ndarray  # (N, 2, 2) covariance of uv, px^2
    visible: np.ndarray  # (N,) bool: what the caller is told
    verified: np.ndarray  # (N,) bool: a template, or Lucas-Kanade for a while, says so, not the segment alone
    hidden_for: np.ndarray  # (N,) frames
    ncc: np.ndarray  # (N,) correlation with the template last recognised
    coasting: np.ndarray  # (N,) frames since a template was last recognised
    chained: np.ndarray  # (N,) frames in which matched corners alone carried it since it was placed or recognised
    template_warp: np.ndarray  # (N, K, 2, 2)
    template_unwarp: np.ndarray  # (N, K, 2, 2) its inverse
    template_cov: np.ndarray  # (N, K, 2, 2) of the point's position in the template
    template: np.ndarray  # (N, K) their rows in ``templates``, -1 for none
    chroma: np.ndarray  # (N, K, 2) around the point
    segment: np.ndarray  # (N,) which rigid motion segment it belongs to, -1 for none
    leaving: np.ndarray  # (N,) bool: disagrees with its segment together with others, but is not far from it yet
    p_seg: np.ndarray  # (N, 3) position on the segment, metres
    map_cov: np.ndarray  # (N, 3, 3) its covariance
    tangent: np.ndarray  # (N, 3, 2) offset on the segment per pixel of offset in the first template
    templates: Templates = field(metadata=SHARED)  # of all points

    @classmethod
    def new(cls, uv_px: np.ndarray, templates: int) -> Points:
        """Visible points at uv_px (N, 2) without a template yet, with room for so many."""
        n, k = len(uv_px), templates
        return cls(
            uv=uv_px.astype(np.float32),
            warp=np.tile(_EYE, (n, 1, 1)),
            cov=np.zeros((n, 2, 2), np.float32),
            visible=np.ones(n, bool),
            verified=np.ones(n, bool),
            hidden_for=np.zeros(n, np.int64),
            ncc=np.ones(n, np.float32),
            coasting=np.zeros(n, np.int64),
            chained=np.zeros(n, np.int64),
            template_warp=np.tile(_EYE, (n, k, 1, 1)),
            template_unwarp=np.tile(_EYE, (n, k, 1, 1)),
            template_cov=np.zeros((n, k, 2, 2), np.float32),
            template=np.full((n, k), -1),
            chroma=np.zeros((n, k, 2), np.float32),
            segment=np.full(n, -1),
            leaving=np.zeros(n, bool),
            p_seg=np.zeros((n, 3)),
            map_cov=np.zeros((n, 3, 3)),
            tangent=np.zeros((n, 3, 2)),
            templates=Templates(),
        )

    @property
    def contrast(self) -> np.ndarray:
        """(N,) standard deviation of the grey values in the first template."""
        return self.templates.fine.contrast[self.template[:, 0]]
