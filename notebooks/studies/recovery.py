"""Notebook 07: the moment of return, image by image, methods side by side, and what the confidence is worth.

Methods (the long-range tracker, the one that forgets, ...) come by label, each with its scene: a run on its video.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from shutil import rmtree
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame, Series

from p2p_lib.core import se3
from p2p_lib.core.types import Status
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.datasets.sequence import Sequence as Video
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.confidence import MAX_DEG, MAX_M, Judged, reliability, right_poses
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.evaluation.recovery import MAX_ADDS_M, RecoveryEvent, recovered_within
from p2p_lib.figures import overlay, style
from p2p_lib.figures.overlay import OrientedBox
from p2p_lib.figures.plots import WIDTH_IN, logarithmic, panels
from p2p_lib.figures.scenes import Scene
from p2p_lib.synthetic.generate import write_scenario
from p2p_lib.synthetic.noise import Sensor
from p2p_lib.synthetic.scenarios import SCENARIOS
from p2p_lib.synthetic.scene import Scenario
from studies.run_plots import draw_strip

#: Of fewer poses a share of right ones is no more than a hint.
_ENOUGH = 20
_RIGHT = f"{100 * MAX_M:.0f} cm and {MAX_DEG:.0f}°"


def return_strip(scenes: Mapping[str, Scene], name: str, event: RecoveryEvent) -> Figure:
    """A row of images per method: the object before, while and after it is hidden, with its status below each."""
    shown = {"last in sight": event.hidden_frame - 2, "hidden": (event.hidden_frame + event.return_frame) // 2}
    shown |= {f"return + {k}" if k else "return": event.return_frame + k for k in (0, 1, 10)}
    return strip(scenes, name, shown)


@lru_cache(1)
def _scenario(name: str, seed: int) -> Scenario:
    """A hand that holds a thing takes seconds to close."""
    return SCENARIOS[name](seed)


def excerpt(name: str, frames: range, seed: int, folder: Path) -> Video:
    """These frames of ``synthetic/NAME``, rendered into ``folder``, whose earlier content goes: no others are."""
    whole = _scenario(name, seed)
    bodies = tuple(replace(body, T_world_model=body.T_world_model[frames]) for body in whole.bodies)
    rmtree(folder, ignore_errors=True)
    write_scenario(folder, replace(whole, T_world_cam=whole.T_world_cam[frames], bodies=bodies), Sensor(), seed, name)
    video: Any = open_sequence(folder, "ycbmultitrack")
    return replace(video, name=f"synthetic/{name}", times_s=frames.step * video.times_s)


def fastest(name: str, seed: int, before: int = 20, after: int = 12) -> tuple[range, np.ndarray]:
    """Frames of ``synthetic/NAME`` about its first body's largest turn, and the turn after each (degrees)."""
    T_world_model = _scenario(name, seed).bodies[0].T_world_model
    turn_deg = np.degrees(se3.angle_rad(se3.inverse(T_world_model[:-1]) @ T_world_model[1:]))
    worst = int(turn_deg.argmax())
    frames = range(max(0, worst - before), min(worst + after, len(turn_deg)))
    return frames, turn_deg[frames]


@style.styled
def strip(scenes: Mapping[str, Scene], name: str, shown: Mapping[str, int], said: ObjectRun | None = None) -> Figure:
    """A row of images per method, one for each title and frame in ``shown``, with the object's status below each.

    said  the object in every map (``load_run(..., every_map=True)``): then its map and the reason stand there, too
    """
    first = next(iter(scenes.values()))
    regions = around(first, name, list(shown.values()))
    (left, top, right, bottom), *_ = regions
    high = WIDTH_IN / len(shown) * (bottom - top) / (right - left)
    words_in = 0.1 if said is None else 0.5
    figure = Figure((WIDTH_IN, (0.96 * high + words_in) * len(scenes) + 0.7), layout="constrained")
    axes = figure.subplots(len(scenes), len(shown), squeeze=False)
    for row, (label, scene) in zip(axes, scenes.items()):
        for axis, index, region_px in zip(row, shown.values(), regions):
            at = scene.row(index)
            axis.imshow(scene.draw(at, region_px, 300, axes=False, trail=0, words=False))
            axis.set(xticks=[], yticks=[])
            axis.set_xlabel(scene.run.objects[name].status[at], fontsize=10)
            if said is not None:
                why = fill(said.reason[at], 126 // len(shown))
                axis.set_xlabel(f"{said.status[at]}, map {said.map_id[at]}\n{why}", fontsize=7.5, va="top")
            axis.spines[:].set_visible(False)
        row[0].set_ylabel(label, fontweight="bold")
    for axis, (title, index) in zip(axes[0], shown.items()):
        axis.set_title(f"{title}\n(frame {index})", fontsize=9)
    figure.suptitle(f"{first.sequence.name}: {name}", x=0.01, ha="left", fontsize=10)
    return figure


def film(scenes: Mapping[str, Scene], indices: Sequence[int], width_px: int = 400) -> Iterator[np.ndarray]:
    """The methods side by side under their names, one image for each frame."""
    region_px = next(iter(scenes.values())).region()
    for index in indices:
        images = [scene.draw(scene.row(index), region_px, width_px) for scene in scenes.values()]
        head = np.full((24, *images[0].shape[1:]), 255, np.uint8)
        named = [np.concatenate([overlay.draw_caption(head, k), image]) for k, image in zip(scenes, images)]
        yield overlay.montage(named, len(scenes))


@style.styled
def around_return(
    scenes: Mapping[str, Scene], evaluations: Mapping[str, Evaluation], name: str, event: RecoveryEvent, span: int = 40
) -> Figure:
    """Frames about a return: pixels in sight; keypoints that agree on the pose; ADD-S; confidence."""
    figure, axes = panels(4, (WIDTH_IN, 6.2), [1, 1.6, 1.6, 1.2])
    sight, agreeing, adds, confidence = axes
    first = next(iter(scenes.values()))
    at = np.isin(first.run.objects[name].frame_index, range(event.hidden_frame - 10, event.return_frame + span))
    index = first.run.objects[name].frame_index[at]
    since = index - event.return_frame
    sight.fill_between(since, first.run.objects[name].visible_px[at], color=style.NEUTRAL[1])
    for (label, scene), colour in zip(scenes.items(), style.METHODS):
        obj, score = scene.run.objects[name], evaluations[label].objects[name]
        adds_mm = 1e3 * Series(score.adds_m, score.frame_index).reindex(index).to_numpy()
        line = {"color": colour, "marker": ".", "ms": 4, "label": label}
        agreeing.plot(since, np.where(obj.has_pose, obj.inliers, 0)[at], **line)
        adds.plot(since, np.where(np.isfinite(adds_mm), adds_mm, np.nan), **line)
        failed = since[np.isinf(adds_mm)]
        edge = adds.get_xaxis_transform()  # data along, a fraction of the height up
        adds.plot(failed, np.full(len(failed), 0.96), "x", color=colour, transform=edge, ms=4)
        confidence.plot(since, np.where(obj.has_pose, obj.confidence, np.nan)[at], **line)
    adds.axhline(1e3 * MAX_ADDS_M, color="#333333", lw=0.8, ls=":")
    logarithmic(adds.yaxis)
    adds.set_ylim(top=4e3 * MAX_ADDS_M)
    for axis, title in zip(axes, (f"{name} in\nsight [px]", "agreeing\nkeypoints", "ADD-S [mm]", "confidence")):
        axis.set_ylabel(title)
        axis.axvline(0, color="#333333", lw=0.8)
    confidence.set(ylim=(-0.03, 1.05), xlabel="frames since the return")
    figure.legend(*agreeing.get_legend_handles_labels(), loc="outside lower right", ncols=len(scenes))
    sight.set_title(f"{first.sequence.name}: {name} around its return")
    figure.align_ylabels(axes)
    return figure


@style.styled
def status_strips(scenes: Mapping[str, Scene]) -> Figure:
    """The status of each method's estimates at every moment, one block of lines per method."""
    lines = sum(len(scene.run.objects) for scene in scenes.values())
    figure, axes = panels(len(scenes), (WIDTH_IN, 1.1 + 0.5 * len(scenes) + 0.25 * lines))
    occurring = {str(s) for scene in scenes.values() for obj in scene.run.objects.values() for s in obj.status}
    for axis, (label, scene) in zip(axes, scenes.items()):
        draw_strip(axis, scene.run, occurring if axis is axes[-1] else ())
        axis.set_title(f"{label}, {scene.sequence.name}")
        axis.set_xlabel("time [s]" if axis is axes[-1] else "", loc="left")
    return figure


@style.styled
def confidence_over_time(run: Run, evaluation: Evaluation) -> Figure:
    """Each object's confidence; dots where the pose is right (2 cm, 5 degrees), crosses where it is wrong."""
    names = list(evaluation.objects)
    figure, axes = panels(len(names), (WIDTH_IN, 0.9 + 1.25 * len(names)))
    for axis, name in zip(axes, names):
        obj, colour = run.objects[name], style.object_colours(run.objects)[name]
        right = right_poses(obj, evaluation.objects[name])
        wrong = ~right & obj.has_pose
        axis.plot(obj.time_s, np.where(obj.has_pose, obj.confidence, np.nan), color=colour, lw=0.8)
        axis.plot(obj.time_s[right], obj.confidence[right], ".", color=colour, ms=4)
        axis.plot(obj.time_s[wrong], obj.confidence[wrong], "x", color=style.STATUS[Status.LOST][0], ms=4)
        axis.set(ylim=(-0.03, 1.05), ylabel=name)
    axes[0].set_title(f"Confidence, {run.info['sequence']}; crosses: the pose is not within {_RIGHT}")
    axes[-1].set_xlabel("time [s]")
    return figure


@style.styled
def reliability_plot(judged: Mapping[str, Judged]) -> Figure:
    """The fraction of right poses by stated confidence, and how many there are; the diagonal would be calibrated.

    Shares of a few poses are hollow and are not joined: they jump by chance.
    """
    figure, axes = panels(2, (WIDTH_IN, 3.2), [1.2, 1], side_by_side=True)
    axes[0].plot([0, 1], [0, 100], ":", color="#333333", lw=0.8)
    width = 0.8 / 10 / len(judged)
    for k, ((label, one), colour) in enumerate(zip(judged.items(), style.METHODS)):
        bins = reliability(one)
        label = f"{label}: ECE {one.calibration_error:.2f}, AUROC {one.auroc:.2f}".replace("nan", "-")
        many = bins.poses >= _ENOUGH
        axes[0].plot(bins.confidence, (100 * bins.right).where(many), "o-", ms=4, color=colour, label=label)
        axes[0].plot(bins.confidence[~many], 100 * bins.right[~many], "o", ms=4, color=colour, mfc="none")
        left = np.floor(np.minimum(bins.confidence, 0.999) * 10) / 10 + 0.01 + k * width
        axes[1].bar(left, bins.poses, width, align="edge", color=colour)
    axes[0].set(xlim=(0, 1.02), ylim=(0, 103), xlabel="stated confidence", ylabel=f"within {_RIGHT} [%]")
    axes[1].set(xlim=(0, 1.02), xlabel="stated confidence", ylabel="poses")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2, fontsize=8)
    return figure


def recovery_counts(cases: Mapping[tuple[str, str], tuple[Run, Evaluation]]) -> DataFrame:
    """A row per (sequence, method): returns, those recovered within 5, 15, 30 frames, poses made up while hidden."""
    rows = []
    for (sequence, label), (run, evaluation) in cases.items():
        objects = {name: (run.objects[name], score) for name, score in evaluation.objects.items()}
        events = [event for _, score in objects.values() for event in score.returns]
        row = {"sequence": sequence, "method": label, "returns": len(events)}
        within = recovered_within(event.frames_to_recovery for event in events)
        row |= {f"within {n} frames": count for n, count in within.items()}
        made_up = [(obj.has_pose & (obj.visible_px == 0)).sum() for obj, _ in objects.values()]
        rows.append(row | {"poses while hidden": int(sum(made_up))})
    return DataFrame(rows)


def around(scene: Scene, name: str, indices: Sequence[int]) -> list[tuple[int, int, int, int]]:
    """The rectangles (left, top, right, bottom), all of one size, of where an object truly is in each frame."""
    obj, camera = scene.run.objects[name], scene.sequence.camera
    box = OrientedBox.around(scene.run.points[name])
    uv = camera.project(box.corners(obj.T_cam_model[[scene.row(i) for i in indices]]))
    low, high = uv.min(1), uv.max(1)
    size = np.minimum(1.6 * (high - low).max(0), [camera.width, camera.height]).astype(int)
    corner = np.clip((low + high - size) / 2, 0, np.array([camera.width, camera.height]) - size).astype(int)
    return [(int(x), int(y), int(x + size[0]), int(y + size[1])) for x, y in corner]
