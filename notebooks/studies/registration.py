"""Notebook 03: the mug of the paper's text, what registration gets to see when a glossy mug has turned.

Between two images a real 2D tracker follows what it sees. Much of that is the room's mirror image on the body, which
stays where it is. Poses of the keyframes before are the true ones, so that registration alone is on trial.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame

from p2p_lib.core import se3
from p2p_lib.core.backends import make_detector, make_tracker
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config, preset
from p2p_lib.core.depth import depth_noise_m, lift
from p2p_lib.core.image import in_mask
from p2p_lib.core.types import Frame
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import logarithmic, panels
from p2p_lib.method.observation import sample_cloud
from p2p_lib.method.refinement import Keypoints, refine, surface_distances
from p2p_lib.method.registration import Hypothesis, register
from p2p_lib.method.sampling import choose, usable_region
from p2p_lib.method.selection import select
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.synthetic.ablations import mug
from p2p_lib.synthetic.generate import photograph
from p2p_lib.synthetic.noise import Sensor
from p2p_lib.synthetic.render import render
from p2p_lib.synthetic.scene import FPS, Scenario
from p2p_lib.synthetic.shapes import Mesh

#: The newest keyframe that the surface holds is this many frames old; keyframes are ten frames, or degrees, apart.
_KEYFRAME_AGO, _KEYFRAME_EVERY, _POINTS = 6, 10, 90
#: Between the image in which points are sampled and the one in which they are registered.
_FRAMES = 16
#: Tracks that follow the object (dots) and tracks that do not (crosses).
_FOLLOWS, _STRAYS = "#F2F2F2", style.STATUS["lost"][0]
#: Hypotheses by their order; light enough to be seen on a dark object.
_HYPOTHESES = tuple(style.METHODS[k] for k in (4, 2, 6, 5))


@dataclass(frozen=True, eq=False)
class Moment:
    """Correspondences (p_obj, p_cam) in one image, and what else is known then.

    frame, mask      the later image, and the mug's pixels in it
    uv_before_px     (N, 2) where the points were sampled, some frames ago; uv_px (N, 2) where the tracker has them
    p_obj, p_cam     (N, 3) in the map and as seen now; NaN where the tracker lost them or depth is missing
    off_m            (N,) how far each is from where it would be if it were on the mug
    right            (N,) bool: within three standard deviations of the depth noise of there
    cloud            (M, 3) dense masked depth points, camera frame
    surface          the volume fused from the keyframes before
    T_cam_obj        (4, 4) the truth now; T_before that of the image in which the points were sampled
    mesh             the true model, for drawing
    """

    camera: Camera
    frame: Frame
    mask: np.ndarray
    uv_before_px: np.ndarray
    uv_px: np.ndarray
    p_obj: np.ndarray
    p_cam: np.ndarray
    off_m: np.ndarray
    right: np.ndarray
    cloud: np.ndarray
    surface: TsdfVolume
    T_cam_obj: np.ndarray
    T_before: np.ndarray
    mesh: Mesh

    @property
    def turned_deg(self) -> float:
        """How far the mug turned between the two images."""
        return float(self.error(self.T_before)[0])

    def error(self, T_cam_obj: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Degrees and millimetres between poses (..., 4, 4) and the truth."""
        return se3.error_deg_mm(T_cam_obj, self.T_cam_obj)


@lru_cache(maxsize=1)  # the trials begin with the mug that the notebook shows
def mug_moment(config: Config, seed: int = 0) -> Moment:
    """Points sampled on ``synthetic/mug`` and tracked while the handle comes into view."""
    scenario, rng = mug(seed, marks=2), np.random.default_rng([seed, 7])
    body, camera = scenario.bodies[0], scenario.camera
    poses = se3.inverse(scenario.T_world_cam) @ body.T_world_model
    now = _handle_in_view(poses)
    before = now - _FRAMES
    keyframes = range(now - _KEYFRAME_AGO, max(now - 100, 0), -_KEYFRAME_EVERY)
    shots = _shots(scenario, seed, {*keyframes, *range(before, now + 1)})
    surface = TsdfVolume(config.tsdf)
    for t in keyframes:
        frame, mask = shots[t]
        surface.integrate(frame.depth_m, frame.rgb, mask, camera, poses[t])
    (first, first_mask), (frame, mask) = shots[before], shots[now]
    region = usable_region(first, first_mask, config.depth.edge_m)
    found = make_detector("corners", config.sampling, rng).detect(first, region)
    uv_before = found.uv_px[choose(found, np.zeros((0, 2)), _POINTS, config.sampling)]
    uv = _tracked([shots[t][0] for t in range(before, now + 1)], uv_before, config, rng)
    uv[~in_mask(uv, mask)] = np.nan
    p_obj = se3.transform(se3.inverse(poses[before]), lift(first, uv_before, camera, config.depth))
    p_cam = lift(frame, uv, camera, config.depth)
    off_m = np.linalg.norm(se3.transform(poses[now], p_obj) - p_cam, axis=1)
    right = off_m < 3 * depth_noise_m(p_cam[:, 2], config.depth)
    cloud = sample_cloud(frame.depth_m, mask, camera, config.refinement.max_points)
    seen = camera, frame, mask, uv_before, uv, p_obj, p_cam, off_m, right, cloud
    return Moment(*seen, surface, poses[now], poses[before], body.mesh)


def ways_to_decide(moment: Moment, config: Config, seed: int = 0) -> dict[str, np.ndarray]:
    """T_cam_obj (4, 4) of each way to decide on the same correspondences; NaN where it finds none.

    One hypothesis by SVD or by RANSAC; the least score of those that the paper's registration finds, with one noise for
    all points (preset ``paper``); the least score after each was refined, and the configured selection among the
    refined. Last, the hypothesis nearest to the truth.
    """
    cfg, choice, rng = config.registration, config.selection, np.random.default_rng([seed, 8])
    sigma_m = depth_noise_m(moment.p_cam[:, 2], config.depth)
    points = moment.p_obj, moment.p_cam
    hypotheses = register(*points, cfg, rng, sigma_m=sigma_m)
    single = register(*points, replace(cfg, method="svd"), rng, sigma_m=sigma_m)
    T = np.stack([h.T_cam_obj for h in hypotheses])
    inliers = [Keypoints(*(values[h.inliers] for values in (*points, sigma_m))) for h in hypotheses]
    volume = moment.cloud, moment.surface, config.refinement
    pairs = zip(T, inliers, strict=True)
    T_refined = np.stack([refine(start, *volume, keypoints=k).T_cam_obj for start, k in pairs])
    refined_m = surface_distances(moment.surface, moment.cloud, T_refined)
    none, text = np.full((4, 4), np.nan), preset("paper")
    by_text = register(*points, text.registration, np.random.default_rng([seed, 8]))
    off_m = surface_distances(moment.surface, moment.cloud, np.array([h.T_cam_obj for h in by_text]).reshape(-1, 4, 4))
    row, _ = select(by_text, off_m, text.selection)
    return {
        "SVD, outliers out, SVD": single[0].T_cam_obj if single else none,
        "RANSAC: most inliers": T[select(hypotheses, None, choice)[0]],
        "least score": none if row is None else by_text[row].T_cam_obj,
        "refine all, least score": T_refined[refined_m.mean(1).argmin()],
        "configured selection": T_refined[select(hypotheses, refined_m, choice)[0]],
        "best hypothesis": T[moment.error(T)[0].argmin()],
    }


def mug_trials(config: Config, seeds: Iterable[int]) -> DataFrame:
    """A row per mug: how far it turned, the share of right tracks, and the rotation error of each way in degrees."""
    rows = []
    for seed in seeds:
        one = mug_moment(config, seed)
        right = 100 * one.right[np.isfinite(one.off_m)].mean()
        errors = {f"{way} [°]": one.error(T)[0] for way, T in ways_to_decide(one, config, seed).items()}
        rows.append({"mug": seed, "turned [°]": one.turned_deg, "right tracks [%]": right, **errors})
    return DataFrame(rows)


def _handle_in_view(poses: np.ndarray) -> int:
    """The frame, of those a whole history lies before, that ends the largest turn with the handle towards the camera.

    poses (T, 4, 4) T_cam_obj; the handle points along the mug's x axis
    """
    ends = np.arange(100, len(poses))
    turned = se3.angle_rad(se3.inverse(poses[ends - _FRAMES]) @ poses[ends])
    towards = -poses[:, 2, 0]
    shown = np.minimum(towards[ends], towards[ends - _FRAMES]) > 0.2
    return int(ends[np.argmax(np.where(shown, turned, -1))])


def _shots(scenario: Scenario, seed: int, times: Iterable[int]) -> dict[int, tuple[Frame, np.ndarray]]:
    """Frame and mask at each time, with the sensor's noise."""
    room = scenario.empty(0)
    taken = {t: photograph(scenario, Sensor(), seed, t, room) for t in times}
    return {t: (Frame(t, t / FPS, rgb, depth_m), exact.label == 1) for t, (rgb, depth_m, exact) in taken.items()}


def _tracked(frames: Sequence[Frame], uv_px: np.ndarray, config: Config, rng: np.random.Generator) -> np.ndarray:
    """Where Lucas-Kanade has the points (N, 2) of the first frame in the last one; NaN where lost."""
    tracker = make_tracker("lk", config.tracking, rng)
    tracker.start(frames[0])
    ids = tracker.add(uv_px)
    for frame in frames[1:]:
        tracks = tracker.track(frame).select(ids)
    return np.where(tracks.visible[:, None], tracks.uv_px, np.nan)


def draw_tracks(moment: Moment, width_px: int = 720) -> np.ndarray:
    """Where each point was sampled and where the tracker has it now: a line to a dot (follows the mug) or a cross."""
    image, camera = _outlined(moment, moment.T_cam_obj, style.TRUTH, width_px)
    now, before = (overlay.zoomed_px(uv, moment.camera, camera) for uv in (moment.uv_px, moment.uv_before_px))
    known = np.isfinite(moment.p_cam).all(1)
    for rows, colour in ((known & ~moment.right, _STRAYS), (known & moment.right, _FOLLOWS)):
        image = overlay.draw_trail(image, np.stack([before, now], 1)[rows], colour, 2)
    image = overlay.draw_crosses(image, now[known & ~moment.right], _STRAYS)
    image = overlay.draw_points(image, now[known & moment.right], _FOLLOWS, 3)
    return overlay.draw_caption(image, f"synthetic: mug turned by {moment.turned_deg:.0f} degrees")


def draw_hypotheses(moment: Moment, hypotheses: Sequence[Hypothesis], scores_m: np.ndarray) -> np.ndarray:
    """An image per hypothesis: where it puts the mug (outline in its colour) and the points that speak for it."""
    images = []
    for k, (hypothesis, score) in enumerate(zip(hypotheses, scores_m, strict=True)):
        colour = _HYPOTHESES[k % len(_HYPOTHESES)]
        image, camera = _outlined(moment, hypothesis.T_cam_obj, colour, 420)
        inliers_px = overlay.zoomed_px(moment.uv_px[hypothesis.inliers], moment.camera, camera)
        image = overlay.draw_points(image, inliers_px, colour, 3)
        caption = f"h = {k + 1}: {hypothesis.support} inliers, score {1e3 * score:.2f} mm"
        images.append(overlay.draw_caption(image, caption))
    return overlay.montage(images, columns=min(len(images), 3))


@style.styled
def support_and_score(moment: Moment, hypotheses: Sequence[Hypothesis], scores_m: Mapping[str, np.ndarray]) -> Figure:
    """Every hypothesis by its inliers and by its two scores: as registered (pale) and refined."""
    count = len(hypotheses)
    at, colours = np.arange(count), [_HYPOTHESES[k % len(_HYPOTHESES)] for k in range(count)]
    figure, axes = panels(2, (7.6, 1.2 + 0.5 * count), [1, 1.3], side_by_side=True)
    bars = axes[0].barh(at, [h.support for h in hypotheses], 0.62, color=colours)
    axes[0].bar_label(bars, fmt="%d", padding=2, fontsize=8)
    axes[0].set(xlabel="inliers (more is better)")
    axes[0].set_yticks(at, [f"h = {k + 1}, {moment.error(h.T_cam_obj)[0]:.1f}° off" for k, h in enumerate(hypotheses)])
    for shift, alpha, (label, scores) in zip((-0.2, 0.2), (0.45, 1.0), scores_m.items(), strict=True):
        bars = axes[1].barh(at + shift, 1e3 * scores, 0.38, color=colours, alpha=alpha)
        axes[1].bar_label(bars, [f"{1e3 * m:.2f}  {label}" for m in scores], padding=2, fontsize=7)
    axes[1].set(xlabel="score: mean |TSDF| of the depth [mm]\n(less is better)")
    axes[1].set_yticks(at, [])
    for axis, room in zip(axes, (0.14, 0.45), strict=True):
        axis.margins(x=room)
        axis.invert_yaxis()
        axis.grid(axis="y", visible=False)
    return figure


@style.styled
def method_errors(table: DataFrame, bar_deg: float) -> Figure:
    """Rotation error of each way to decide (columns) over several mugs (rows), on a logarithmic axis."""
    methods = [c for c in table.columns if c.endswith("[°]") and c not in ("turned [°]", "best hypothesis [°]")]
    figure, (axis,) = panels(1, (7.0, 0.9 + 0.36 * len(methods)))
    for k, method in enumerate(methods):
        errors = table[method].to_numpy(float)
        at = k + np.linspace(-0.18, 0.18, len(errors))
        colour = style.METHODS[0] if k == len(methods) - 1 else style.NEUTRAL[0]
        axis.plot(errors, at, "o", color=colour, markersize=4.5, alpha=0.85)
        # x in shares of the axis, y in data.
        edge = {"transform": axis.get_yaxis_transform(), "clip_on": False}
        none = at[np.isnan(errors)]
        axis.plot(np.ones(len(none)), none, "x", color=colour, markersize=5, **edge)
    axis.axvline(bar_deg, color=style.STATUS["lost"][0], linewidth=1, linestyle="--")
    logarithmic(axis.xaxis)
    axis.set_yticks(range(len(methods)), [m.removesuffix(" [°]") for m in methods])
    axis.invert_yaxis()
    axis.set(xlabel=f"rotation error [°], one dot per synthetic mug; dashed: {bar_deg:g}°; cross: no pose")
    return figure


def _outlined(moment: Moment, T_cam_obj: np.ndarray, colour: str, width_px: int) -> tuple[np.ndarray, Camera]:
    """The image around the mug with the silhouette of the true model at a pose, and the camera that sees it so."""
    region_px = overlay.region_around(moment.mask, moment.camera, (75, 30))
    image, camera = overlay.zoomed(moment.frame.rgb, moment.camera, region_px, width_px)
    mask = render([(moment.mesh, se3.IDENTITY)], camera, se3.inverse(T_cam_obj)).label > 0
    return overlay.draw_mask(image, mask, colour), camera
