"""What a confidence is worth: does it say how often the pose is right, and does it tell right poses from wrong ones?

A pose is right when it is within 2 cm and 5 degrees of the truth. The expected calibration error is that of
Naeini et al. (AAAI 2015), with bins of equal width; AUROC is the chance that a right pose has the higher
confidence of the two when one right and one wrong pose are drawn.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.types import Rows, joined
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.evaluation.protocol import Evaluation, ObjectScore

if TYPE_CHECKING:
    from pandas import DataFrame

MAX_M, MAX_DEG = 0.02, 5.0


@dataclass(frozen=True, eq=False)
class Judged(Rows):
    """Poses of scored frames: confidence (m,) in [0, 1], and whether each is right (m,) bool."""

    confidence: np.ndarray
    right: np.ndarray

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean gap between confidence and share of right poses, by how many there are."""
        bins = reliability(self)
        return float(np.average(np.abs(bins.right - bins.confidence), weights=bins.poses)) if len(self) else np.nan

    @property
    def auroc(self) -> float:
        """Area under the ROC curve; ties count half; NaN where all are right or all are wrong."""
        from scipy.stats import mannwhitneyu

        right, wrong = self.confidence[self.right], self.confidence[~self.right]
        if not len(right) or not len(wrong):
            return float("nan")
        return float(mannwhitneyu(right, wrong).statistic / (len(right) * len(wrong)))


def pose_error(obj: ObjectRun, score: ObjectScore) -> tuple[np.ndarray, np.ndarray]:
    """Rotation error (n,) in degrees and translation error (n,) in mm of the model's frame; NaN without a pose."""
    return se3.error_deg_mm(obj.T_cam_obj @ score.T_obj_model, obj.T_cam_model)


def right_poses(obj: ObjectRun, score: ObjectScore) -> np.ndarray:
    """(n,) bool: frames with a pose within 2 cm and 5 degrees of the truth."""
    deg, mm = pose_error(obj, score)
    return (deg <= MAX_DEG) & (mm <= 1e3 * MAX_M)


def judge(run: Run, evaluation: Evaluation) -> dict[str, Judged]:
    """Every scored object's poses in the frames that are scored; frames without a pose claim nothing."""
    judged = {}
    for name, score in evaluation.objects.items():
        obj = run.objects[name]
        at = np.isin(obj.frame_index, score.frame_index) & obj.has_pose
        judged[name] = Judged(obj.confidence[at], right_poses(obj, score)[at])
    return judged


def pooled(many: Iterable[Judged]) -> Judged:
    """All of them together."""
    return joined([Judged(np.zeros(0), np.zeros(0, bool)), *many])


def reliability(judged: Judged, bins: int = 10) -> DataFrame:
    """A row per bin of equal width with any: mean ``confidence``, share that is ``right``, number of ``poses``."""
    from pandas import DataFrame

    at = np.minimum((judged.confidence * bins).astype(int), bins - 1)
    groups = DataFrame({"confidence": judged.confidence, "right": judged.right}).groupby(at)
    return groups.mean().assign(poses=groups.size())
