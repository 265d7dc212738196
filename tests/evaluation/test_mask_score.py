"""Agreement of masks by hand, and its summary."""

import numpy as np
import pandas as pd
import pytest

from p2p_lib.evaluation.mask_score import MaskEvaluation, agreement


def mask(*cells: int) -> np.ndarray:
    flat = np.zeros(12, bool)
    flat[list(cells)] = True
    return flat.reshape(3, 4)


def test_agreement_by_hand():
    assert agreement(mask(1, 2, 3), mask(2, 3, 4), 3) == (pytest.approx(2 / 4), pytest.approx(np.nan, nan_ok=True))
    assert np.isnan(agreement(mask(1), mask(2, 3), 3)).all(), "too small to count as visible, too large for absent"
    iou, false_px = agreement(mask(1, 5), mask(), 3)
    assert np.isnan(iou) and false_px == 2


def test_means_are_over_visible_and_over_absent_frames():
    rows = [("a", 0, 0.5, np.nan), ("a", 1, 0.0, np.nan), ("b", 0, np.nan, 12.0), ("b", 1, np.nan, 0.0)]
    frames = pd.DataFrame(rows, columns=["object", "frame", "iou", "false_positive_px"])
    evaluation = MaskEvaluation(frames, {"masks": "builtin", "sequence": "s"})
    seen = {"mean_iou": 0.25, "visible_frames": 2, "missed_frames": 1, "absent_frames": 0, "false_positive_px": None}
    gone = {"mean_iou": None, "visible_frames": 0, "missed_frames": 0, "absent_frames": 2, "false_positive_px": 6.0}
    assert evaluation.as_dict()["objects"] == {"a": seen, "b": gone}
    assert evaluation.mean_iou == 0.25 and "masks builtin on s" in evaluation.as_table()
