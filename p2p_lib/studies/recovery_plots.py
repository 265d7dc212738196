"""The moment of return: pictures frame by frame, what happens around it, methods side by side, what confidence says.

Methods (the long-range tracker, the one that forgets, ...) come by label, each with its scene: a run on its video.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.datasets.runs import Run
from p2p_lib.evaluation.confidence import MAX_DEG, MAX_M, Judged, reliability, right_poses
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.evaluation.recovery import MAX_ADDS_M, WITHIN_FRAMES, RecoveryEvent, recovered_within, recovery_events
from p2p_lib.figures import overlay, style
from p2p_lib.figures.overlay import Box
from p2p_lib.figures.plots import draw_strip, panels
from p2p_lib.figures.scenes import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_WIDTH_IN = 8.0


def moments(event: RecoveryEvent, after: Sequence[int] = (0, 1, 3, 10)) -> dict[str, int]:
    """Frames that tell a return, by what to call them: before, hidden, and so many frames after the return."""
    middle = (event.hidden_frame + event.return_frame) // 2
    told = {"last in sight": event.hidden_frame - 2, "hidden": middle}
    return told | {f"return + {k}" if k else "return": event.return_frame + k for k in after}


def return_strip(
    scenes: Mapping[str, Scene], name: str, event: RecoveryEvent, after: Sequence[int] = (0, 1, 10)
) -> Figure:
    """A row of pictures per method: the object before, while and after it is hidden; cut to where it truly is.

    Its status is below each picture.
    """
    from matplotlib.figure import Figure

    told = moments(event, after)
    first = next(iter(scenes.values()))
    regions = around(first, name, list(told.values()))
    (left, top, right, bottom), *_ = regions
    with style.applied():
        high = _WIDTH_IN / len(told) * (bottom - top) / (right - left)
        figure = Figure((_WIDTH_IN, (0.96 * high + 0.1) * len(scenes) + 0.7), layout="constrained")
        axes = figure.subplots(len(scenes), len(told), squeeze=False)
        for row, (label, scene) in zip(axes, scenes.items()):
            for axis, index, region_px in zip(row, told.values(), regions):
                at = scene.row(index)
                axis.imshow(scene.draw(at, region_px, 300, axes=False, trail=0, words=False))
                axis.set(xticks=[], yticks=[])
                axis.set_xlabel(scene.run.objects[name].status[at], fontsize=10)
                axis.spines[:].set_visible(False)
            row[0].set_ylabel(label, fontweight="bold")
        for axis, (what, index) in zip(axes[0], told.items()):
            axis.set_title(f"{what}\n(frame {index})", fontsize=9)
        figure.suptitle(f"{first.sequence.name}: {name}", x=0.01, ha="left", fontsize=10)
    return figure


def film(scenes: Mapping[str, Scene], indices: Sequence[int], width_px: int = 400) -> Iterator[np.ndarray]:
    """The methods side by side, one picture for each frame."""
    region_px = next(iter(scenes.values())).region()
    for index in indices:
        pictures = [scene.draw(scene.row(index), region_px, width_px) for scene in scenes.values()]
        yield overlay.montage([_named(p, label) for p, label in zip(pictures, scenes)], len(scenes))


def around_return(
    scenes: Mapping[str, Scene], evaluations: Mapping[str, Evaluation], name: str, event: RecoveryEvent, span: int = 40
) -> Figure:
    """Frames about a return: pixels in sight; keypoints that agree on the pose; ADD-S; confidence."""
    shown = range(event.hidden_frame - 10, event.return_frame + span)
    with style.applied():
        figure, axes = panels(4, (_WIDTH_IN, 6.2), [1, 1.6, 1.6, 1.2])
        obj = next(iter(scenes.values())).run.objects[name]
        at = np.isin(obj.frame_index, shown)
        axes[0].fill_between(obj.frame_index[at] - event.return_frame, obj.visible_px[at], color=style.NEUTRAL[1])
        for (label, scene), colour in zip(scenes.items(), style.METHODS):
            obj, score = scene.run.objects[name], evaluations[label].objects[name]
            at = np.isin(obj.frame_index, shown)
            since = obj.frame_index[at] - event.return_frame
            adds_m = dict(zip(score.frame_index.tolist(), score.adds_m.tolist()))
            adds_mm = 1e3 * np.array([adds_m.get(i, np.nan) for i in obj.frame_index[at].tolist()])
            line = {"color": colour, "marker": ".", "ms": 4, "label": label}
            axes[1].plot(since, np.where(obj.has_pose[at], obj.inliers[at], 0), **line)
            axes[2].plot(since, np.where(np.isfinite(adds_mm), adds_mm, np.nan), **line)
            failed = since[np.isinf(adds_mm)]
            axes[2].plot(failed, np.full(len(failed), 0.96), "x", color=colour, transform=_edge(axes[2]), ms=4)
            axes[3].plot(since, np.where(obj.has_pose[at], obj.confidence[at], 0), **line)
        axes[2].axhline(1e3 * MAX_ADDS_M, color="#333333", lw=0.8, ls=":")
        axes[2].set_yscale("log")
        axes[2].yaxis.set_major_formatter("{x:g}")
        names = (f"{name} in\nsight [px]", "agreeing\nkeypoints", "ADD-S [mm]", "confidence")
        for axis, words in zip(axes, names):
            axis.set_ylabel(words)
            axis.axvline(0, color="#333333", lw=0.8)
        axes[3].set(ylim=(-0.03, 1.05), xlabel="frames since the return")
        axes[2].set_ylim(top=4e3 * MAX_ADDS_M)
        axes[1].legend(loc="center")
        axes[0].set_title(f"{next(iter(scenes.values())).sequence.name}: {name} around its return")
        figure.align_ylabels(axes)
    return figure


def status_strips(scenes: Mapping[str, Scene]) -> Figure:
    """What each method's estimates were worth at every moment, one block of lines per method."""
    with style.applied():
        lines = sum(len(scene.run.objects) for scene in scenes.values())
        figure, axes = panels(len(scenes), (_WIDTH_IN, 1.1 + 0.5 * len(scenes) + 0.25 * lines), [1] * len(scenes))
        occurring = {str(s) for scene in scenes.values() for obj in scene.run.objects.values() for s in obj.status}
        for axis, (label, scene) in zip(axes, scenes.items()):
            draw_strip(axis, scene.run, occurring if axis is axes[-1] else ())
            axis.set_title(f"{label}, {scene.sequence.name}")
            axis.set_xlabel("time [s]" if axis is axes[-1] else "", loc="left")
    return figure


def confidence_over_time(run: Run, evaluation: Evaluation) -> Figure:
    """Each object's confidence; dots where the pose is right (2 cm, 5 degrees), crosses where it is wrong."""
    names = list(evaluation.objects)
    with style.applied():
        figure, axes = panels(len(names), (_WIDTH_IN, 0.9 + 1.25 * len(names)), [1] * len(names))
        for axis, name in zip(axes, names):
            obj, colour = run.objects[name], style.object_colours(run.objects)[name]
            right = right_poses(obj, evaluation.objects[name])
            axis.plot(obj.time_s, np.where(obj.has_pose, obj.confidence, np.nan), color=colour, lw=0.8)
            for at, marker, shade in ((right, ".", colour), (~right & obj.has_pose, "x", style.OUTCOMES[4])):
                axis.plot(obj.time_s[at], obj.confidence[at], marker, color=shade, ms=4)
            axis.set(ylim=(-0.03, 1.05), ylabel=name)
        axes[0].set_title(f"Confidence, {run.info['sequence']}; crosses: the pose is not within 2 cm and 5°")
        axes[-1].set_xlabel("time [s]")
    return figure


def reliability_plot(judged: Mapping[str, Judged]) -> Figure:
    """The share of right poses by stated confidence, beside how many there are; the diagonal would be calibrated."""
    with style.applied():
        figure, axes = panels(2, (_WIDTH_IN, 3.2), [1.2, 1], side_by_side=True)
        axes[0].plot([0, 1], [0, 100], ":", color="#333333", lw=0.8)
        for k, ((label, one), colour) in enumerate(zip(judged.items(), style.METHODS)):
            bins = reliability(one)
            words = f"{label}: ECE {one.calibration_error:.2f}, AUROC {one.auroc:.2f}".replace("nan", "-")
            axes[0].plot(bins.confidence, 100 * bins.right, "o-", ms=4, color=colour, label=words)
            width = 0.8 / 10 / len(judged)
            left = np.floor(np.minimum(bins.confidence, 0.999) * 10) / 10 + 0.01 + k * width
            axes[1].bar(left, bins.count, width, align="edge", color=colour)
        axes[0].set(xlim=(0, 1.02), ylim=(0, 103), xlabel="stated confidence", ylabel=f"within {_right()} [%]")
        axes[1].set(xlim=(0, 1.02), xlabel="stated confidence", ylabel="poses")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2, fontsize=8)
    return figure


def recovery_counts(cases: Mapping[tuple[str, str], tuple[Run, Evaluation]]) -> DataFrame:
    """A row per (sequence, method): returns, those recovered within 5, 15, 30 frames, poses made up while hidden."""
    from pandas import DataFrame

    rows = []
    for (sequence, label), (run, evaluation) in cases.items():
        objects = evaluation.objects
        events = [e for name in objects for e in recovery_events(run.objects[name], objects[name])]
        within = recovered_within(events)
        made_up = sum(int((run.objects[name].has_pose & (run.objects[name].visible_px == 0)).sum()) for name in objects)
        row = {"sequence": sequence, "method": label, "returns": len(events)}
        row |= {f"within {n} frames": within[n] for n in WITHIN_FRAMES}
        rows.append(row | {"poses while hidden": made_up})
    return DataFrame(rows)


def around(scene: Scene, name: str, indices: Sequence[int], margin: float = 0.3) -> list[tuple[int, int, int, int]]:
    """Where in the picture an object truly is at each frame: left, top, right, bottom, of one size for all.

    With a margin, a share of the object's size.
    """
    obj, camera = scene.run.objects[name], scene.sequence.camera
    box = Box.around(scene.run.points[name])
    T_cam_box = obj.T_cam_model[[scene.row(i) for i in indices]] @ box.T_obj_box
    uv = camera.project(se3.transform(T_cam_box, overlay.box_corners(box.size_m)))
    low, high = uv.min(1), uv.max(1)
    size = np.minimum((1 + 2 * margin) * (high - low).max(0), [camera.width, camera.height]).astype(int)
    corner = np.clip((low + high - size) / 2, 0, np.array([camera.width, camera.height]) - size).astype(int)
    return [(int(x), int(y), int(x + size[0]), int(y + size[1])) for x, y in corner]


def _named(picture: np.ndarray, label: str) -> np.ndarray:
    """A picture with a line of its method above it."""
    head = overlay.draw_caption(np.full((24, *picture.shape[1:]), 255, np.uint8), label)
    return np.concatenate([head, picture])


def _edge(axis):
    """Data along, share of the height up."""
    return axis.get_xaxis_transform()


def _right() -> str:
    return f"{100 * MAX_M:.0f} cm and {MAX_DEG:.0f}°"
