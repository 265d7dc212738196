"""Pictures of registration: tracks that disagree, hypotheses and what the surface says of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.evaluation.point_tracks import Outcome
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import panels
from p2p_lib.studies.mug_moment import Decisions, Moment

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

#: Tracks that follow the object (dots), tracks that do not (crosses), and the object's true outline.
FOLLOWS, STRAYS, OUTLINE = "#F2F2F2", style.OUTCOMES[Outcome.WRONG], style.TRUTH
#: Hypotheses by their order; light enough to be seen on a dark object.
HYPOTHESES = (style.METHODS[4], style.METHODS[2], style.METHODS[6], style.METHODS[5])


def draw_tracks(moment: Moment, width_px: int = 420) -> np.ndarray:
    """Where each point was sampled and where the tracker has it now: a line to a dot (follows the mug) or a cross."""
    image, camera, region = _cut(moment, width_px)
    image = _outline(image, camera, moment, moment.T_cam_obj)
    for rows, colour in ((~moment.right, STRAYS), (moment.right, FOLLOWS)):
        rows = rows & np.isfinite(moment.p_cam).all(1)
        now, before = (_scaled(uv[rows], region, width_px) for uv in (moment.uv_px, moment.uv_before_px))
        for pair in np.stack([before, now], 1):
            image = overlay.draw_trail(image, pair, colour, 2)
        if colour == STRAYS:
            image = overlay.draw_crosses(image, now, colour, 4)
        else:
            image = overlay.draw_points(image, now, colour, 3)
    return overlay.draw_caption(image, f"synthetic: mug turned by {moment.turned_deg:.0f} degrees")


def draw_hypotheses(moment: Moment, decided: Decisions, width_px: int = 420) -> np.ndarray:
    """A picture per hypothesis: where it puts the mug (outline in its colour) and the points that speak for it."""
    pictures = []
    for k, (hypothesis, score) in enumerate(zip(decided.hypotheses, decided.scores_m, strict=True)):
        image, camera, region = _cut(moment, width_px)
        colour = HYPOTHESES[k % len(HYPOTHESES)]
        image = _outline(image, camera, moment, hypothesis.T_cam_obj, colour)
        at = _scaled(moment.uv_px[hypothesis.inliers], region, width_px)
        image = overlay.draw_points(image, at, colour, 3)
        caption = f"h = {k + 1}: {hypothesis.support} inliers, score {1e3 * score:.2f} mm"
        pictures.append(overlay.draw_caption(image, caption))
    return overlay.montage(pictures, columns=min(len(pictures), 3))


def support_and_score(moment: Moment, decided: Decisions) -> Figure:
    """Every hypothesis by its inliers and by its distance to the surface, as it came and refined."""
    count = len(decided.hypotheses)
    with style.applied():
        figure, axes = panels(2, (7.6, 1.2 + 0.5 * count), [1, 1.3], side_by_side=True)
        at = np.arange(count)
        colours = [HYPOTHESES[k % len(HYPOTHESES)] for k in at]
        errors = [moment.error(h.T_cam_obj)[0] for h in decided.hypotheses]
        bars = axes[0].barh(at, [h.support for h in decided.hypotheses], 0.62, color=colours)
        axes[0].bar_label(bars, fmt="%d", padding=2, fontsize=8)
        axes[0].set(xlabel="inliers (more is better)")
        axes[0].set_yticks(at, [f"h = {k + 1}, {error:.1f}° off" for k, error in zip(at, errors, strict=True)])
        for shift, scores_m, alpha, label in (
            (-0.2, decided.scores_m, 0.45, "as registered"),
            (0.2, decided.refined_scores_m, 1.0, "after SDF refinement"),
        ):
            bars = axes[1].barh(at + shift, 1e3 * scores_m, 0.38, color=colours, alpha=alpha)
            axes[1].bar_label(bars, [f"{1e3 * m:.2f}  {label}" for m in scores_m], padding=2, fontsize=7)
        axes[1].set(xlabel="score: mean |TSDF| of the depth points [mm] (less is better)")
        axes[1].set_yticks(at, [])
        for axis, room in zip(axes, (0.14, 0.45), strict=True):
            axis.margins(x=room)
            axis.invert_yaxis()
            axis.grid(axis="y", visible=False)
    return figure


def method_errors(table: DataFrame, bar_deg: float) -> Figure:
    """Rotation error of each way to decide (columns) over several mugs (rows), on a logarithmic axis."""
    methods = [c for c in table.columns if c.endswith("[°]") and c not in ("turned [°]", "best hypothesis [°]")]
    with style.applied():
        figure, (axis,) = panels(1, (7.0, 0.9 + 0.36 * len(methods)), [1])
        for k, method in enumerate(methods):
            errors = table[method].to_numpy(float)
            spread = k + np.linspace(-0.18, 0.18, len(errors))
            colour = style.METHODS[0] if k == len(methods) - 1 else style.NEUTRAL[0]
            axis.plot(errors, spread, "o", color=colour, markersize=4.5, alpha=0.85)
            none = spread[np.isnan(errors)]
            # x in shares of the axis, y in data.
            edge = {"transform": axis.get_yaxis_transform(), "clip_on": False}
            axis.plot(np.full(len(none), 1.0), none, "x", color=colour, markersize=5, **edge)
        axis.axvline(bar_deg, color=style.STATUS["lost"][0], linewidth=1, linestyle="--")
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("")
        axis.set_yticks(range(len(methods)), [m.removesuffix(" [°]") for m in methods])
        axis.invert_yaxis()
        axis.set(xlabel=f"rotation error [°], one dot per synthetic mug; dashed: {bar_deg:g}°; cross: no pose")
    return figure


def _cut(moment: Moment, width_px: int):
    """The picture around the mug, its camera, and the region."""
    v, u = np.nonzero(moment.mask)
    height, width = moment.mask.shape
    left, right = max(u.min() - 75, 0), min(u.max() + 76, width)
    top, bottom = max(v.min() - 30, 0), min(v.max() + 31, height)
    region = int(left), int(top), int(right), int(bottom)
    return *overlay.zoomed(moment.frame.rgb, moment.camera, region, width_px), region


def _scaled(uv_px: np.ndarray, region: tuple[int, ...], width_px: int) -> np.ndarray:
    """Pixels of the whole picture in the region's own."""
    return width_px / (region[2] - region[0]) * (uv_px - np.array(region[:2]) + 0.5) - 0.5


def _outline(image: np.ndarray, camera, moment: Moment, T_cam_obj: np.ndarray, colour: str = OUTLINE) -> np.ndarray:
    """The silhouette of the true model at a pose."""
    uv = camera.project(se3.transform(T_cam_obj, moment.vertices))[moment.faces]
    mask = np.zeros(image.shape[:2], np.uint8)
    for triangle in np.rint(uv * 16).astype(np.int32):
        cv2.fillConvexPoly(mask, triangle, 1, shift=4)
    return overlay.draw_mask(image, mask > 0, colour)
