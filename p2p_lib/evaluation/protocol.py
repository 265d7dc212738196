"""Scoring a run: which frames count, how the object frame meets the model frame, and the summary.

One rule everywhere. An object's frame is *scored* when its truth is valid there, the dataset's visibility
labels hold and its visible mask has at least ``min_visible_px`` pixels. A scored frame without a pose is a
failure: its error is infinite and counts as 0 in every area under a curve. Frames in which the object is
hidden are not scored.

The tracker's object frame is its own choice, so one rigid constant T_obj_model is free, see
:mod:`p2p_lib.evaluation.alignment`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import se3, tables
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.models import given_models, load_points
from p2p_lib.datasets.runs import NO_MASKS, ObjectRun, Run
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.alignment import ALIGNMENTS, align_first
from p2p_lib.evaluation.recovery import RecoveryEvent, recovery_events, returns_of

if TYPE_CHECKING:
    from pandas import DataFrame

MIN_VISIBLE_PX = 300
#: Areas under the curve, and what tables call them.
HEADS = {
    "adds_auc": "ADD-S AUC [%]",
    "add_auc": "ADD AUC [%]",
    "adds_auc_voc": "ADD-S AUC, VOC [%]",
    "add_auc_voc": "ADD AUC, VOC [%]",
}
#: Sources of masks that do not tell when an object is back.
NOT_TOLD = ("clicks", "first", None)
#: What a score says of the run.
WHAT_RAN = ("tracker", "masks", "segmenter", "preset", "seed")


def ran_with(info: Mapping[str, Any]) -> dict[str, Any]:
    """What a score says of the run that ``info`` is of; of one without any click, its masks are of memories.

    With ``changed``, parameters that are not as in the preset, where any was changed.
    """
    asked = info.get("options") or {}
    changed = [f"{key}={value}" for key, value in sorted((asked.get("settings") or {}).items())]
    changed += [f"by {Path(asked['config_file']).name}"] if asked.get("config_file") else []
    ran = {key: info.get(key) for key in WHAT_RAN} | ({"changed": ", ".join(changed)} if changed else {})
    from_memory = asked.get("memory") and info.get("masks") == "clicks" and not info.get("prompts")
    return ran | ({"masks": "memory"} if from_memory else {})


@dataclass(frozen=True, eq=False)
class ObjectScore:
    """One object's errors over its m scored frames, and their summary in percent.

    frame_index    (m,) of the scored frames
    add_m, adds_m  (m,) metres; infinite where there was no pose
    T_obj_model    (4, 4) the constant that the alignment fixed; NaN where there was never a pose
    lost           scored frames without a pose
    """

    frame_index: np.ndarray
    add_m: np.ndarray
    adds_m: np.ndarray
    T_obj_model: np.ndarray
    lost: int

    @property
    def returns(self) -> tuple[RecoveryEvent, ...]:
        """Each return after an absence, see :mod:`p2p_lib.evaluation.recovery`."""
        return recovery_events(self.frame_index, self.adds_m)

    def as_dict(self) -> dict[str, Any]:
        """The four areas under the curve, frames scored, frames lost, and the frames to recovery of each return."""
        return {
            "add_auc": metrics.auc_exact(self.add_m),
            "adds_auc": metrics.auc_exact(self.adds_m),
            "add_auc_voc": metrics.auc_voc(self.add_m),
            "adds_auc_voc": metrics.auc_voc(self.adds_m),
            "frames": len(self.add_m),
            "lost": self.lost,
            "frames_to_recovery": [event.frames_to_recovery for event in self.returns],
        }


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The scores of a run, and what ran. ``left_out`` gives the reason for each object without a score."""

    objects: dict[str, ObjectScore]
    left_out: dict[str, str]
    hz: float | None
    p95_ms: float | None
    align: str
    info: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``p2p eval --json`` prints them: areas in percent, the mean is over objects."""
        objects = {name: score.as_dict() for name, score in self.objects.items()}
        mean = {key: float(np.mean([o[key] for o in objects.values()])) for key in HEADS}
        what_ran = ran_with(self.info)
        return {"objects": objects, "mean": mean, "hz": self.hz, "p95_ms": self.p95_ms, **what_ran, "align": self.align}

    def as_frame(self) -> DataFrame:
        """A row per object and their mean: areas under the curve in percent, frames scored, frames lost among them."""
        from pandas import DataFrame

        plain = self.as_dict()
        rows = [{"object": name, **scores} for name, scores in plain["objects"].items()]
        total = {key: sum(row[key] for row in rows) for key in ("frames", "lost")}
        rows += [{"object": "mean", **plain["mean"], **total}] if len(rows) > 1 else []
        return DataFrame(rows)[["object", *HEADS, "frames", "lost"]].round(2).rename(columns=HEADS)

    def as_table(self) -> str:
        """The same for people, with the reason for what is not there."""
        lines = [tables.as_text(self.as_frame())]
        returns = [f"{name}: {returns_of(score.returns)}" for name, score in self.objects.items() if score.returns]
        if returns and self.info.get("masks") not in NOT_TOLD:
            returns.append("The masks that were given tell when an object is back: see it from --masks clicks.")
        lines += returns
        lines += [f"{name}: not scored, {reason}" for name, reason in self.left_out.items()]
        if self.hz is not None:
            lines.append(f"{self.hz:.1f} Hz, 95 % of the frames within {self.p95_ms:.1f} ms")
        # Of imported poses no more is known than whose they are.
        ran = ", ".join(f"{key} {value}" for key, value in ran_with(self.info).items() if value is not None)
        return "\n".join(["AUC over 0 to 0.1 m, exact and in the VOC form", *lines, f"{ran}, aligned by {self.align}"])


def evaluate(
    run: Run,
    models: Mapping[str, str | Path] | None = None,
    align: str = "first",
    min_visible_px: int = MIN_VISIBLE_PX,
) -> Evaluation:
    """Score every object of a run that has truth and a model.

    models  object to model file, over those that the run was made with

    Raises :class:`BadInput` for an unknown alignment or object, :class:`MissingData` where nothing can be scored.
    """
    if align not in ALIGNMENTS:
        raise BadInput("align", repr(align), "one of " + ", ".join(ALIGNMENTS))
    given = given_models(models or {}, run.objects)
    points = run.points | {name: load_points(path) for name, path in given.items()}
    scores, left_out = {}, {}
    for name, obj in run.objects.items():
        at = scored_frames(obj, min_visible_px)
        if not obj.has_truth.any():
            left_out[name] = "the sequence has no truth for it"
        elif name not in points:
            left_out[name] = f"no model for ADD (give --models {name}=PATH){_apart(obj, at & obj.has_pose)}"
        elif not at.any():
            left_out[name] = f"in no frame it has truth and {min_visible_px} visible pixels"
        else:
            scores[name] = score(obj, at, points[name], align)
    if not scores:
        raise MissingData(str(run.path), "nothing to score: " + "; ".join(f"{k}: {v}" for k, v in left_out.items()))
    return Evaluation(scores, left_out, *rate(run.timings), align, run.info)


def scored_frames(obj: ObjectRun, min_visible_px: int = MIN_VISIBLE_PX) -> np.ndarray:
    """(n,) bool: the rule. Where the dataset has no masks at all, truth and labels alone decide."""
    seen = (obj.visible_px >= min_visible_px) | (obj.visible_px == NO_MASKS)
    return obj.has_truth & obj.labelled & seen


def score(obj: ObjectRun, scored: np.ndarray, points: np.ndarray, align: str) -> ObjectScore:
    """One object's errors over its scored frames (n,) bool, after alignment."""
    T_cam_obj, T_cam_model = obj.T_cam_obj[scored], obj.T_cam_model[scored]
    has_pose = obj.has_pose[scored]
    T_obj_model = np.full((4, 4), np.nan)
    if has_pose.any():
        T_obj_model = ALIGNMENTS[align](T_cam_obj[has_pose], T_cam_model[has_pose], points)
    T_pred = T_cam_obj @ T_obj_model
    return ObjectScore(
        frame_index=obj.frame_index[scored],
        add_m=metrics.add_m(T_pred, T_cam_model, points),
        adds_m=metrics.adds_m(T_pred, T_cam_model, points),
        T_obj_model=T_obj_model,
        lost=int((~has_pose).sum()),
    )


def _apart(obj: ObjectRun, at: np.ndarray) -> str:
    """What can be said without a model: how far the poses of frames (n,) bool are from the truth; "" without any."""
    if not at.any():
        return ""
    T_cam_obj, T_cam_model = obj.T_cam_obj[at], obj.T_cam_model[at]
    deg, mm = se3.error_deg_mm(T_cam_obj @ align_first(T_cam_obj, T_cam_model), T_cam_model)
    off = f"{np.median(deg):.1f}° and {np.median(mm):.1f} mm"
    return f"; its poses are {off} off the truth (medians of {len(deg)} frames, aligned at the first)"


def model_frames(run: Run) -> dict[str, np.ndarray]:
    """Object to T_obj_model (4, 4) by :func:`align_first`, for those with a pose in a scored frame.

    Raises :class:`MissingData` where there is none of these.
    """
    frames = {}
    for name, obj in run.objects.items():
        at = scored_frames(obj) & obj.has_pose
        if at.any():
            frames[name] = align_first(obj.T_cam_obj[at], obj.T_cam_model[at])
    if not frames:
        fix = "Take the tracker's own object frame: --frame object."
        raise MissingData(str(run.path), "no scored frame with truth and a pose, so no model frame", fix)
    return frames


def rate(timings: Mapping[str, np.ndarray]) -> tuple[float | None, float | None]:
    """Frames per second of processing, keyframes included, and the 95th percentile in ms.

    The first two frames are left out: compiled loops are loaded then, and in a new place compiled.
    """
    total_ms = timings.get("total_ms", np.empty(0))
    if not len(total_ms) or not total_ms.sum() > 0:
        return None, None
    after = total_ms[2:] if total_ms[2:].sum() > 0 else total_ms
    return float(1000 * len(after) / after.sum()), float(np.percentile(after, 95))
