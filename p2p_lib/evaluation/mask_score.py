"""Measuring masks: how well a segmenter's masks agree with the dataset's own; what ``p2p eval-masks`` prints.

An object's frame is *visible* when its true mask has at least ``min_visible_px`` pixels, and *absent* when it has
none. Visible frames are scored by intersection over union, absent ones by the pixels that were labelled all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import tables
from p2p_lib.core.errors import MissingData
from p2p_lib.datasets.masks import read_labels
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import reopen
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, eq=False)
class MaskEvaluation:
    """How every mask of a run agrees with the true one, and which masks they are.

    frames  a row per object and frame: ``object``, ``frame``, ``iou`` (NaN unless visible), ``false_positive_px``
            (NaN unless absent)
    """

    frames: DataFrame
    info: dict[str, Any]

    def as_frame(self) -> DataFrame:
        """A row per object: means over its visible and over its absent frames, NaN where there are none."""
        by_object = self.frames.groupby("object", sort=False)
        iou, extra = by_object["iou"], by_object["false_positive_px"]
        scores = {
            "mean_iou": iou.mean(),
            "visible_frames": iou.count(),
            "missed_frames": iou.agg(lambda values: (values == 0).sum()).astype(int),
            "absent_frames": extra.count(),
            "false_positive_px": extra.mean(),
        }
        return iou.first().to_frame().assign(**scores)[list(scores)]

    @property
    def mean_iou(self) -> float:
        """The mean over the objects of their mean over visible frames; NaN where nothing was visible."""
        return float(self.as_frame()["mean_iou"].mean())

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``p2p eval-masks --json`` prints them; None where there is nothing to measure."""
        table = self.as_frame().astype(object)
        objects = table.where(table.notna(), None).to_dict("index")
        return {**self.info, "objects": objects, "mean_iou": self.mean_iou}

    def as_table(self) -> str:
        """The same for people."""
        heads = ["mean IoU", "visible", "missed", "absent", "px labelled while absent"]
        table = self.as_frame().set_axis(heads, axis=1).round({"mean IoU": 3, heads[-1]: 1}).reset_index()
        return f"{tables.as_text(table)}\nmasks {self.info['masks']} on {self.info['sequence']}"


def agreement(found: np.ndarray, truth: np.ndarray, min_visible_px: int = MIN_VISIBLE_PX) -> tuple[float, float]:
    """(iou, false_positive_px) of one mask (H, W) bool: NaN for what does not apply."""
    true_px = int(truth.sum())
    if not true_px:
        return np.nan, float(found.sum())
    return float((found & truth).sum() / (found | truth).sum()) if true_px >= min_visible_px else np.nan, np.nan


def evaluate_masks(run: Run, min_visible_px: int = MIN_VISIBLE_PX) -> MaskEvaluation:
    """Score the masks that a run kept (``p2p run --save-masks``) against the dataset's own.

    The sequence is opened anew, as the run says. An object without a true mask in a frame is
    absent there; frames without any are left out. Raises :class:`MissingData` where either side has no masks.
    """
    from pandas import DataFrame

    info = run.info
    sequence = reopen(info)
    kept = {path for name in run.objects for path in (run.path / "masks" / name).glob("*.png")}
    if not kept:
        raise MissingData(str(run.path / "masks"), "the run kept no masks", "Run it again with --save-masks.")
    known = [name for name in run.objects if name in sequence.objects]
    shape = sequence.camera.height, sequence.camera.width
    rows = []
    for i in sorted({int(path.stem) for path in kept}):
        if (truth := sequence.masks(i)) is None:
            continue
        for name in known:
            found = read_labels(run.path / "masks" / name / f"{i:06d}.png", shape) > 0
            rows.append((name, i, *agreement(found, truth.get(name, np.zeros(shape, bool)), min_visible_px)))
    if not rows:
        raise MissingData(sequence.name, f"no masks of {', '.join(run.objects)}", "Only a dataset's masks can tell.")
    frames = DataFrame(rows, columns=["object", "frame", "iou", "false_positive_px"])
    return MaskEvaluation(frames, {key: info[key] for key in ("sequence", "masks")})
