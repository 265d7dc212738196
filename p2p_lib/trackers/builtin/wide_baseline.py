"""Wide-baseline matching: how a segment moved where short steps fail, by its corners.

A fast turn, a fast camera or blur leaves nothing for Lucas-Kanade, whose steps are short, and little for templates.
Corners described on the surface are still the same: those of the segment in the frame where it was seen last are
matched with those of the newest frame, both ways, and the rigid motion that most pairs agree on in 3D is the segment's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2p_lib.core import robust, se3
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.trackers.builtin.features import mutual_match
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.landmarks import Corners, corners
from p2p_lib.trackers.builtin.segment_view import CORNERS, Matched, SegmentView, inner

#: Corners that are described where segments may be: what a search costs at most.
_MOST = 900
#: Samples of the search for the rigid motion, and pairs that have to agree on it.
_SAMPLES, _AGREEING = 300, 8
#: They agree within this and so many times the noise of depth, m; what is off by little more is of it, too.
_AGREE_M, _AGREE_SIGMAS = 0.003, 2.0


def corners_of(views: Sequence[SegmentView], now: Image, search: np.ndarray | None) -> tuple[Corners, list[np.ndarray]]:
    """The corners of a later frame wherever segments can be, and the region (H, W) of each.

    They are as dense as on the segments, as far as the bound allows. ``search`` (H, W) says where objects are.
    """
    regions = [then.region(now) for then in views]
    if search is not None:
        inside = inner(search)
        regions = [region & inside for region in regions]
    anywhere = np.logical_or.reduce(regions)
    segment_px = float(np.mean([np.count_nonzero(then.own) for then in views]))
    limit = CORNERS * int(np.count_nonzero(anywhere)) / max(segment_px, 1)
    return corners(now, anywhere, int(np.clip(limit, CORNERS, _MOST))), regions


def matched(then: SegmentView, found: Corners, cfg: TrackingConfig, rng: np.random.Generator) -> Matched | None:
    """The segment's pose among the corners ``found`` in a later frame; None where too few of its own agree on one."""
    own = then.corners
    if min(len(own.uv_px), len(found.uv_px)) < _AGREEING:
        return None
    scales = (np.moveaxis(of.descriptors, 1, 0) for of in (own, found))
    pairs = [mutual_match(a, b, cfg.match_ratio) for a, b in zip(*scales, strict=True)]
    which, corner = np.unique(np.concatenate(pairs, 1), axis=1)
    p_then, p_cam = own.p_cam[which], found.p_cam[corner]
    # Tight: what stands still while a round object turns slowly is off by millimetres alone.
    limit_m = np.maximum(_AGREE_M, _AGREE_SIGMAS * depth_noise_m(p_cam[:, 2]))
    T = robust.ransac(p_then, p_cam, limit_m, 3, _SAMPLES, rng) if len(p_cam) >= _AGREEING else None
    if T is None:
        return None
    everything = np.ones(len(p_cam), bool)
    fit = robust.refit(T, p_then, p_cam, limit_m, np.ones(len(p_cam)), _AGREEING, everything)
    if fit is None:
        return None
    agree = fit.residual_m <= np.maximum(cfg.segment_inlier_m, limit_m)
    p_seg = se3.transform(se3.inverse(then.T_cam_seg), p_then[agree])
    return Matched(fit.T_a_b @ then.T_cam_seg, p_seg, found.uv_px[corner[agree]], p_cam[agree, 2], found)
