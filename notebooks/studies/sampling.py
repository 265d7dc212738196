"""Notebook 02: the sampling objective as maps, what a choice of points is worth, and the life of a map's points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from pandas import DataFrame, concat

from p2p_lib.core import se3
from p2p_lib.core.backends import make_detector, make_tracker
from p2p_lib.core.config import Config, SamplingConfig, preset
from p2p_lib.core.depth import depth_noise_m, lift
from p2p_lib.core.image import nearest_px
from p2p_lib.core.interfaces import Candidates, PointTracker
from p2p_lib.core.types import Status
from p2p_lib.datasets.sequence import Sequence as Video
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.extended.default import Point2Pose
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import WIDTH_IN, panels
from p2p_lib.method.registration import Hypothesis, covariance
from p2p_lib.method.sampling import Terms, choose, distance_px, terms, usable_region

_SCORE_ALONE = {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0}
#: Ways to choose: detector and settings. The last three leave out the objective or one of its terms.
CHOICES: dict[str, tuple[str, dict[str, Any]]] = {
    "J": ("corners", {}),
    "J without spread": ("corners", {"sampling.score_weight": 1.0}),
    "J without score": ("corners", {"sampling.score_weight": 0.0}),
    "score alone": ("corners", _SCORE_ALONE),
    "uniform": ("uniform", _SCORE_ALONE),
    "farthest": ("farthest", _SCORE_ALONE),
}
_DENSE = 400  # points of the visible surface that a pose's error is felt at
_NOTHING = np.zeros((0, 2))
_TERMS = (r"$\lambda\, s$", r"$(1-\lambda)\min(d/r_{ideal}, 1)$", r"$-\beta\,\rho(d)$", r"$J$")
_TERM_COLOURS = ("#0072B2", "#56B4E9", "#D55E00")
_RIM = [withStroke(linewidth=2.4, foreground="black")]
# A point whose measured depth is off by more lies on a side that cannot be seen.
_IN_SIGHT_M = 0.01


def mask_of(video: Video, name: str, index: int) -> np.ndarray:
    """(H, W) bool of an object in a frame that has masks."""
    masks = video.masks(index)
    assert masks is not None, "the sequences of this notebook have masks"
    return masks[name]


class Situation:
    """One object in one frame, before any point is chosen; with the default parameters and ``settings``.

    mask    (H, W) bool; usable, those pixels of it where a point can be lifted
    """

    def __init__(self, video: Video, name: str, index: int, settings: Mapping[str, Any] | None = None):
        self.video, self.name, self.config = video, name, preset().with_values(dict(settings or {}))
        self.frame, self.mask = video.frame(index), mask_of(video, name, index)
        self.usable = usable_region(self.frame, self.mask, self.config.depth.edge_m)

    def candidates(self, detector: str = "corners", seed: int = 0) -> Candidates:
        """What a detector offers here, as far as it can be lifted."""
        found = make_detector(detector, self.config.sampling, np.random.default_rng(seed))
        offered = found.detect(self.frame, self.usable)
        return offered.select(np.isfinite(self.lift(offered.uv_px)[:, 0]))

    def lift(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 3) in the camera frame, NaN where depth is missing."""
        return lift(self.frame, uv_px, self.video.camera, self.config.depth)

    def surface(self) -> np.ndarray:
        """(M, 3) some points of the visible surface, camera frame."""
        v, u = np.nonzero(self.usable)
        some = slice(None, None, max(len(u) // _DENSE, 1))
        return self.video.camera.unproject(np.stack([u, v], 1)[some].astype(float), self.frame.depth_m[v, u][some])


def greedy_terms(candidates: Candidates, chosen: np.ndarray, config: SamplingConfig) -> Terms:
    """The terms (K,) of each choice at the moment it was taken."""
    uv_px = candidates.uv_px[chosen]
    d = [distance_px(uv_px[[k]], uv_px[:k])[0] for k in range(len(chosen))]
    return terms(candidates.score[chosen], np.array(d), config)


def coverage(mask: np.ndarray, uv_px: np.ndarray, within_px: float) -> float:
    """Share of a mask's pixels that have a chosen point within so many pixels."""
    pixels = np.argwhere(mask)[:, ::-1].astype(float)
    return float((distance_px(pixels, uv_px) <= within_px).mean())


def conditioning(p_cam: np.ndarray, surface_cam: np.ndarray, config: Config) -> tuple[float, float]:
    """How firmly points p_cam (N, 3) hold a pose, by the covariance that the pipeline states of a registration.

    Returns the standard deviation about the least certain axis in degrees, and the error in metres (root mean
    square) that the covariance implies at the points of the visible surface (M, 3).
    """
    T_cam_obj = se3.from_rt(np.eye(3), surface_cam.mean(0))
    p_obj, at = (se3.transform(se3.inverse(T_cam_obj), p) for p in (p_cam, surface_cam))
    hypothesis = Hypothesis(T_cam_obj, np.ones(len(p_cam), bool), np.zeros(len(p_cam)), "truth")
    sigma = covariance(hypothesis, p_obj, p_cam, depth_noise_m(p_cam[:, 2], config.depth))
    moved = np.concatenate([-se3.hat(at), np.broadcast_to(np.eye(3), (len(at), 3, 3))], -1)
    error_m = np.sqrt(np.einsum("nki,ij,nkj->n", moved, sigma, moved).mean())
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(sigma[:3, :3]).max()))), float(error_m)


def compare_choices(
    situations: Sequence[Situation],
    choices: Mapping[str, tuple[str, Mapping[str, Any]]] = CHOICES,
    tracker: str = "builtin",
    frames_on: int = 20,
    seed: int = 0,
) -> DataFrame:
    """Every way to choose in every situation of one video: the points (``uv_px``) and what they are worth.

    ``frames_on`` is how long the points are then tracked, 0 for not.
    """
    scene = TrueScene.of(situations[0].video) if frames_on else None
    rows = []
    for at in situations:
        later = range(at.frame.index + 1, at.frame.index + frames_on + 1)
        frames = [(at.video.frame(i), (at.video.masks(i) or {}).get(at.name)) for i in later]
        for label, (detector, settings) in choices.items():
            sampling, candidates = at.config.with_values(dict(settings)).sampling, at.candidates(detector, seed)
            uv_px = candidates.uv_px[choose(candidates, _NOTHING, sampling.points, sampling)]
            turn_deg, error_m = conditioning(at.lift(uv_px), at.surface(), at.config)
            follower = make_tracker(tracker, at.config.tracking, np.random.default_rng(seed))
            kept = _still_tracked(at, uv_px, scene, frames, follower) if scene else np.nan
            row = {
                "choice": label,
                "uv_px": uv_px,
                "covered [%]": 100 * coverage(at.mask, uv_px, at.config.sampling.r_ideal_px),
                "worst turn [°]": turn_deg,
                "pose error [mm]": 1e3 * error_m,
                "still tracked [%]": 100 * kept,
            }
            rows.append(row)
    return DataFrame(rows)


def _still_tracked(
    at: Situation, uv_px: np.ndarray, scene: TrueScene, frames: Sequence[tuple], follower: PointTracker
) -> float:
    """Share of the points truly in sight in the last frame that the tracker has within 2 px; NaN if none is."""
    points = scene.lift(at.frame, np.full(len(uv_px), scene.objects.index(at.name)), uv_px)
    follower.start(at.frame)
    follower.add(uv_px)
    for frame, mask in frames:
        tracks = follower.track(frame, mask)
    sight = scene.see(frame, points)
    near = tracks.visible & (np.linalg.norm(tracks.uv_px - sight.uv_px, axis=1) < 2)
    return near[sight.visible].mean() if sight.visible.any() else np.nan


def open_views(video: Video, count: int, frames_on: int) -> list[Situation]:
    """``count`` situations per object, spread over the frames in which it is well in sight for ``frames_on`` more."""
    looked = range(0, len(video) - frames_on, 5)
    sizes = {i: {name: int(mask.sum()) for name, mask in (video.masks(i) or {}).items()} for i in looked}
    found = []
    for name in video.truth:
        clear = [i for i in looked if sizes[i].get(name, 0) >= 2000 and sizes.get(i + frames_on, sizes[i])[name] > 0]
        rows = np.linspace(0, len(clear) - 1, min(count, len(clear))).astype(int)
        found += [Situation(video, name, clear[row]) for row in rows]
    return found


@dataclass(frozen=True, eq=False)
class MapHistory:
    """One object's map over the first T frames, which are counted from the first.

    points              a row by id: the frames in which it was ``born``, ``promoted`` to a keypoint and ``gone``, T
                        where it never was; ``born_error_m`` and ``promoted_error_m``, how far it lay then from the
                        true surface point behind its first pixel, NaN where that is unknown
    p_born, p_promoted  (N, 3) its place in the object frame then; NaN where it never was
    keyframe            (T,) bool; T_cam_obj (T, 4, 4), NaN without a pose
    """

    name: str
    points: DataFrame
    p_born: np.ndarray
    p_promoted: np.ndarray
    keyframe: np.ndarray
    T_cam_obj: np.ndarray

    @property
    def late(self) -> DataFrame:
        """The points that were promoted, without those of the first frame, which are keypoints at once."""
        return self.points[(self.points.born > 0) & (self.points.promoted < len(self.keyframe))]


def follow_map(sequence: Video, name: str, frames: int, tracker: str = "builtin", seed: int = 0) -> MapHistory:
    """Run the pipeline on one object of a sequence with truth and write down what becomes of its points."""
    method = Point2Pose(sequence.camera, preset(seed=seed), tracker=tracker)
    method.add_object(name, mask=mask_of(sequence, name, 0))
    keyframe, poses, maps = np.zeros(frames, bool), np.full((frames, 4, 4), np.nan), []
    for t in range(frames):
        masks = sequence.masks(t) or {}
        # A mask that is left out: hidden.
        estimate = method.step(sequence.frame(t), {name: masks[name]} if name in masks else {})[name]
        keyframe[t], points = estimate.keyframe, method.objects[name].map
        if estimate.T_cam_obj is not None:
            poses[t] = estimate.T_cam_obj
        maps.append(DataFrame(points.p_obj.copy(), points.ids).assign(frame=t, promoted=points.promoted.copy()))
    held = concat(maps)  # by id: place (columns 0, 1, 2), frame, promoted
    born, gone = held.groupby(level=0).first(), held.groupby(level=0)["frame"].last() + 1
    promoted = held[held["promoted"]].groupby(level=0).first().reindex(born.index)
    p_born, p_promoted = (table[[0, 1, 2]].to_numpy(float) for table in (born, promoted))
    scene, T_obj_model = TrueScene.of(sequence), se3.inverse(poses[0]) @ sequence.truth[name].T_cam_model[0]
    p_true = np.full_like(p_born, np.nan)
    for t in born["frame"].unique():
        rows = np.flatnonzero(born["frame"] == t)
        uv_px = sequence.camera.project(se3.transform(poses[t], p_born[rows]))
        object = np.full(len(rows), tuple(sequence.truth).index(name))
        p_true[rows] = se3.transform(T_obj_model, scene.lift(sequence.frame(t), object, uv_px).p_model)
    points = DataFrame({"born": born["frame"], "promoted": promoted["frame"].fillna(frames).astype(int), "gone": gone})
    points["born_error_m"] = np.linalg.norm(p_born - p_true, axis=1)
    points["promoted_error_m"] = np.linalg.norm(p_promoted - p_true, axis=1)
    return MapHistory(name, points, p_born, p_promoted, keyframe, poses)


@style.styled
def term_maps(situation: Situation, candidates: Candidates, after: Sequence[int]) -> Figure:
    """The terms of J and their sum once so many points are chosen, one row each.

    The score exists where the detector offers a candidate: dots. The other terms exist everywhere on the object.
    Rings are what is chosen already, the cross is what is taken next.
    """
    config = situation.config.sampling
    left, top, right, bottom = overlay.region_around(situation.mask, situation.video.camera)
    chosen = choose(candidates, _NOTHING, config.points, config)
    pixels = np.stack(np.meshgrid(np.arange(left, right), np.arange(top, bottom)), -1).astype(float)
    outside = ~situation.mask[top:bottom, left:right]
    grey = cv2.cvtColor(situation.frame.rgb[top:bottom, left:right], cv2.COLOR_RGB2GRAY)
    extent = (left - 0.5, right - 0.5, bottom - 0.5, top - 0.5)
    height = 1.75 * (bottom - top) / (right - left)
    limits = [(0, config.score_weight), (0, 1 - config.score_weight), (-config.cluster_weight, 0), (-0.5, 1)]
    figure = Figure((WIDTH_IN, 0.9 + len(after) * (height + 0.25)), layout="constrained")
    axes = figure.subplots(len(after), 4, squeeze=False)
    for row, k in zip(axes, after, strict=True):
        taken, following = candidates.uv_px[chosen[:k]], candidates.uv_px[chosen[k : k + 1]]
        d_px = distance_px(pixels.reshape(-1, 2), taken).reshape(outside.shape)
        dense = terms(np.zeros(outside.shape), d_px, config)
        dots = terms(candidates.score, distance_px(candidates.uv_px, taken), config)
        columns = (dots.trackability, dense.spread, dense.crowding, dots.total)
        for n, (axis, values, (low, high)) in enumerate(zip(row, columns, limits, strict=True)):
            colours = {"cmap": "cividis", "vmin": low, "vmax": high}
            axis.imshow(grey, "gray", vmin=-150, vmax=300, extent=extent)
            if values.ndim == 2:
                shown = axis.imshow(np.ma.masked_array(values, outside), extent=extent, **colours)
            else:
                order = np.argsort(values)
                shown = axis.scatter(*candidates.uv_px[order].T, 7, values[order], linewidths=0, **colours)
            if n != 2:  # a ring would hide the few pixels that crowding is about
                axis.plot(*taken.T, "o", color="white", markersize=5, mew=0.9, mfc="none", path_effects=_RIM)
            axis.plot(*following.T, "x", color=style.AXES[0], markersize=7, mew=1.6, path_effects=_RIM)
            axis.set(xticks=[], yticks=[], xlim=(left, right), ylim=(bottom, top))
            axis.spines[:].set_visible(False)
            if k == after[-1]:
                figure.colorbar(shown, ax=axes[:, n], location="bottom", shrink=0.85, aspect=18, pad=0.02)
        row[0].set_ylabel(f"after {k}")
    for axis, title in zip(axes[0], _TERMS, strict=True):
        axis.set_title(title, fontsize=9, loc="center")
    figure.suptitle(f"{situation.video.name}, {situation.name}, frame {situation.frame.index}", x=0.01, ha="left")
    return figure


@style.styled
def greedy_plot(situation: Situation, candidates: Candidates) -> tuple[Figure, Terms]:
    """What every choice was worth when taken, and the terms; the dotted line is K, after which the pipeline stops."""
    config = situation.config.sampling
    chosen = choose(candidates, _NOTHING, len(candidates.score), config)
    parts = greedy_terms(candidates, chosen, config)
    k, zero = np.arange(1, len(chosen) + 1), np.zeros(len(chosen))
    layers = ((zero, parts.trackability), (parts.trackability, parts.trackability + parts.spread))
    figure, (axis,) = panels(1, (WIDTH_IN, 3.0))
    for (low, high), colour, label in zip((*layers, (parts.crowding, zero)), _TERM_COLOURS, _TERMS[:3], strict=True):
        axis.fill_between(k, low, high, step="mid", color=colour, lw=0, label=label)
    axis.plot(k, parts.total, color="black", lw=1.2, label=_TERMS[3])
    axis.axvline(config.points + 0.5, color="black", lw=0.9, ls=":")
    axis.text(config.points + 2, 0.97, f"K = {config.points}", va="top", transform=axis.get_xaxis_transform())
    axis.set(xlabel=f"choice, of {len(candidates.score)} candidates", ylabel="worth", xlim=(0.5, len(k) + 0.5))
    axis.set_title(f"What each choice was worth when it was taken, {situation.video.name}, {situation.name}")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower right", ncols=4, fontsize=8)
    return figure, parts


def choice_sheet(situation: Situation, scores: DataFrame) -> np.ndarray:
    """What each way chose in a situation, side by side."""
    images = [_draw_choice(situation, uv, label) for uv, label in zip(scores["uv_px"], scores["choice"], strict=True)]
    return overlay.montage(images, 3)


def draw_weights(situation: Situation, candidates: Candidates, score_weight: float, r_ideal_px: float) -> np.ndarray:
    """What J chooses with another weight of the score and another ideal distance, and what the choice is worth."""
    config = replace(situation.config.sampling, score_weight=score_weight, r_ideal_px=r_ideal_px)
    uv_px = candidates.uv_px[choose(candidates, _NOTHING, config.points, config)]
    covered = coverage(situation.mask, uv_px, situation.config.sampling.r_ideal_px)
    _, error_m = conditioning(situation.lift(uv_px), situation.surface(), situation.config)
    return _draw_choice(situation, uv_px, f"covered {100 * covered:.0f} %, pose error {1e3 * error_m:.2f} mm", 460)


def _draw_choice(situation: Situation, uv_px: np.ndarray, words: str, width_px: int = 300) -> np.ndarray:
    """An object with the points that were chosen on it."""
    camera, colour = situation.video.camera, style.object_colours(situation.video.objects)[situation.name]
    box = overlay.region_around(situation.mask, camera)
    image, seen_by = overlay.zoomed(situation.frame.rgb, camera, box, width_px)
    image = overlay.draw_points(image, overlay.zoomed_px(uv_px, camera, seen_by), colour, 4)
    return overlay.draw_caption(image, words, 0.5)


@style.styled
def choice_plot(table: DataFrame) -> Figure:
    """Means by ``choice`` as dots: more is better left and right, less in the middle."""
    senses = {"covered [%]": "more", "pose error [mm]": "less", "still tracked [%]": "more"}
    colours = [_TERM_COLOURS[0] if label == "J" else style.NEUTRAL[0] for label in table["choice"]]
    figure, axes = panels(3, (WIDTH_IN, 2.6), side_by_side=True)
    for axis, (column, sense) in zip(axes, senses.items(), strict=True):
        axis.scatter(table[column], table.index, 40, colours, zorder=3)
        axis.axvline(table[column][0], color=_TERM_COLOURS[0], lw=0.8, ls=":")
        axis.set_yticks(table.index, table["choice"] if axis is axes[0] else [""] * len(table))
        axis.invert_yaxis()
        axis.set_xlabel(column)
        axis.set_title(f"{sense} is better", fontsize=8)
        axis.margins(x=0.15)
    return figure


@style.styled
def life_lines(history: MapHistory, video: Video) -> Figure:
    """Every point of a map as a line of time: hollow while pending, filled as a keypoint, ended when retired."""
    colour, lost = style.object_colours(video.objects)[history.name], style.STATUS[Status.LOST][0]
    points, total = history.points.sort_values(["born", "promoted"], kind="stable"), len(history.keyframe)
    born, promoted, gone = points[["born", "promoted", "gone"]].to_numpy().T
    keypoint, rows = np.minimum(promoted, gone), np.arange(len(points))
    pending = {"facecolor": style.STATUS[Status.INITIALISING][0], "edgecolor": "#333333", "linewidth": 0.3}
    figure, (axis,) = panels(1, (WIDTH_IN, 4.2))
    axis.barh(rows, keypoint - born, 1.0, born, **pending)
    axis.barh(rows, gone - keypoint, 1.0, keypoint, color=colour)
    axis.plot(gone[gone < total], rows[gone < total], "x", color=lost, markersize=3)
    for t in np.flatnonzero(history.keyframe):
        axis.axvline(t, color=style.NEUTRAL[1], lw=0.7, zorder=0)
    axis.set(xlabel="frame", ylabel="points by birth", xlim=(0, total), ylim=(len(points), -1))
    axis.grid(visible=False)
    axis.set_title(f"Life of the map of {history.name}, {video.name}: {len(points)} points")
    handles = [
        Patch(**pending, label="pending"),
        Patch(facecolor=colour, label="keypoint"),
        Line2D([], [], marker="x", ls="", color=lost, markersize=4, label="retired"),
        Line2D([], [], color=style.NEUTRAL[1], lw=0.7, label="keyframe"),
    ]
    figure.legend(handles=handles, loc="outside lower right", ncols=4, fontsize=8)
    return figure


def promotion_moments(history: MapHistory) -> list[int]:
    """Frames from the keyframe that brought most points which were promoted, until nine in ten of them were."""
    late = history.late
    start = int(late.born.mode()[0])
    end = int(late.promoted[late.born == start].quantile(0.9))
    return np.unique(np.linspace(start, max(end, start + 3), 4).astype(int)).tolist()


def promotion_sheet(video: Video, history: MapHistory, frames: Sequence[int]) -> np.ndarray:
    """The part of the map in sight at a few frames of the video: pending points are rings, keypoints dots."""
    colour, points = style.object_colours(video.objects)[history.name], history.points
    box = overlay.region_around(np.any([mask_of(video, history.name, t) for t in frames], axis=0), video.camera)
    images = []
    for t in frames:
        frame, promoted = video.frame(t), (points.promoted <= t).to_numpy()
        image, seen_by = overlay.zoomed(frame.rgb, video.camera, box, 300)
        p_obj = np.where(promoted[:, None], history.p_promoted, history.p_born)
        p_cam = se3.transform(history.T_cam_obj[t], p_obj)
        u, v = nearest_px(video.camera.project(p_cam), frame.shape)
        alive = points.eval("born <= @t < gone").to_numpy() & (np.abs(frame.depth_m[v, u] - p_cam[:, 2]) < _IN_SIGHT_M)
        uv_px = seen_by.project(p_cam)
        image = overlay.draw_points(image, uv_px[alive & promoted], colour, 3)
        image = overlay.draw_points(image, uv_px[alive & ~promoted], style.TRUTH, 4, filled=False)
        words = f"{t}: {(alive & promoted).sum()} keypoints, {(alive & ~promoted).sum()} pending"
        images.append(overlay.draw_caption(image, words, 0.4))
    return overlay.montage(images, len(frames))


@style.styled
def error_plot(history: MapHistory) -> Figure:
    """How far points lay from the true surface point when they were born, and when they were promoted."""
    errors_m = history.late[["born_error_m", "promoted_error_m"]].dropna()
    figure, (axis,) = panels(1, (WIDTH_IN, 2.8))
    for when, line in (("born", "--"), ("promoted", "-")):
        label = f"{history.name}, when {when}"
        axis.ecdf(1e3 * errors_m[f"{when}_error_m"], linestyle=line, color=style.OBJECTS[0], label=label)
    axis.set(xlabel="distance from the true point [mm]", ylabel="share of points below", xlim=(0, None))
    axis.legend(loc="lower right", fontsize=8)
    axis.set_title("Points that were promoted")
    return figure
