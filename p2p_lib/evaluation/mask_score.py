"""Measuring masks: how well a segmenter's masks agree with the dataset's own; what ``p2p eval-masks`` prints.

An object's frame is *visible* when its true mask has at least ``min_visible_px`` pixels, and *absent* when it has
none. Visible frames are scored by intersection over union, absent ones by the pixels that were labelled all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from p2p_lib.core.errors import MissingData
from p2p_lib.datasets.masks import read_labels
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX


@dataclass(frozen=True, eq=False)
class MaskScore:
    """One object's masks over n frames.

    frame_index        (n,)
    iou                (n,) intersection over union in visible frames, NaN in the others
    false_positive_px  (n,) labelled pixels in absent frames, NaN in the others
    """

    frame_index: np.ndarray
    iou: np.ndarray
    false_positive_px: np.ndarray

    def as_dict(self) -> dict[str, float | int | None]:
        """Means over the visible and over the absent frames, None where there are none."""
        seen, absent = self.iou[np.isfinite(self.iou)], self.false_positive_px[np.isfinite(self.false_positive_px)]
        return {
            "mean_iou": float(seen.mean()) if len(seen) else None,
            "visible_frames": len(seen),
            "missed_frames": int((seen == 0).sum()),
            "absent_frames": len(absent),
            "false_positive_px": float(absent.mean()) if len(absent) else None,
        }


@dataclass(frozen=True, eq=False)
class MaskEvaluation:
    """The scores of every object, and which masks they are of."""

    objects: dict[str, MaskScore]
    info: dict[str, Any]

    @property
    def mean_iou(self) -> float:
        """The mean over the objects of their mean over visible frames; NaN where nothing was visible."""
        means = [s.as_dict()["mean_iou"] for s in self.objects.values()]
        return float(np.mean([m for m in means if m is not None] or [np.nan]))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``p2p eval-masks --json`` prints them."""
        scores = {name: score.as_dict() for name, score in self.objects.items()}
        return {**self.info, "objects": scores, "mean_iou": self.mean_iou}

    def as_table(self) -> str:
        """The same for people."""
        width = max(len(name) for name in (*self.objects, "object"))
        lines = [f"{'object':{width}}  mean IoU  visible  missed  absent  px labelled while absent"]
        for name, score in self.objects.items():
            s = score.as_dict()
            iou, extra = (f"{s[k]:.3f}" if s[k] is not None else "-" for k in ("mean_iou", "false_positive_px"))
            counts = f"{s['visible_frames']:7}  {s['missed_frames']:6}  {s['absent_frames']:6}"
            lines.append(f"{name:{width}}  {iou:>8}  {counts}  {extra:>24}")
        return "\n".join([*lines, f"masks {self.info['masks']} on {self.info['sequence']}"])


def agreement(found: np.ndarray, truth: np.ndarray, min_visible_px: int = MIN_VISIBLE_PX) -> tuple[float, float]:
    """(iou, false_positive_px) of one mask (H, W) bool: NaN for what does not apply, see :class:`MaskScore`."""
    true_px = int(truth.sum())
    if not true_px:
        return np.nan, float(found.sum())
    return float((found & truth).sum() / (found | truth).sum()) if true_px >= min_visible_px else np.nan, np.nan


def evaluate_masks(run: Run, sequence: Sequence | None = None, min_visible_px: int = MIN_VISIBLE_PX) -> MaskEvaluation:
    """Score the masks that a run kept (``p2p run --save-masks``) against the dataset's own.

    The sequence is opened anew, as the run says, unless it is given. An object without a true mask in a frame is
    absent there; frames without any are left out. Raises :class:`MissingData` where either side has no masks.
    """
    info = run.info
    sequence = sequence or open_sequence(info["path"] or info["sequence"], info["format"], seed=info["seed"])
    kept = {path for name in run.objects for path in (run.path / "masks" / name).glob("*.png")}
    if not kept:
        raise MissingData(str(run.path / "masks"), "the run kept no masks", "Run it again with --save-masks.")
    known = [name for name in run.objects if name in sequence.objects]
    shape = sequence.camera.height, sequence.camera.width
    rows: dict[str, list[tuple[int, float, float]]] = {name: [] for name in known}
    for i in sorted({int(path.stem) for path in kept}):
        truth = sequence.masks(i)
        for name in known if truth is not None else ():
            found = read_labels(run.path / "masks" / name / f"{i:06d}.png", shape) > 0
            rows[name].append((i, *agreement(found, truth.get(name, np.zeros(shape, bool)), min_visible_px)))
    if not any(rows.values()):
        raise MissingData(sequence.name, f"no masks of {', '.join(run.objects)}", "Only a dataset's masks can tell.")
    scores = {name: MaskScore(*(np.array(column) for column in zip(*r, strict=True))) for name, r in rows.items()}
    return MaskEvaluation(scores, {key: info[key] for key in ("sequence", "masks")})
