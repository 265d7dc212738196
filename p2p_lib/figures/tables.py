"""Scores as tables that say their units, and tables for papers: cells with a number, its spread and its reason."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.datasets.runs import Run
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.evaluation.recovery import recovery_events

if TYPE_CHECKING:
    from pandas import DataFrame


def score_table(evaluation: Evaluation) -> DataFrame:
    """A row per object and their mean: areas under the curve in percent, frames scored, frames lost among them."""
    return evaluation.as_frame()


def recovery_table(run: Run, evaluation: Evaluation) -> DataFrame:
    """A row per return after complete occlusion: when, how far the object had moved unseen, how soon it had a pose.

    A good pose is one with an ADD-S of at most 2 cm; a dash where there was none before the object was hidden again.
    """
    from pandas import DataFrame

    rows = []
    for name, score in evaluation.objects.items():
        obj = run.objects[name]
        for event in recovery_events(obj, score):
            gone, back = np.searchsorted(obj.frame_index, [event.hidden_frame, event.return_frame])
            T_before, T_after = obj.T_cam_model[gone - 1], obj.T_cam_model[back]
            row = {
                "object": name,
                "hidden at [s]": obj.time_s[gone].round(2),
                "back at [s]": obj.time_s[back].round(2),
                "moved unseen [cm]": (100 * np.linalg.norm(T_after[:3, 3] - T_before[:3, 3])).round(1),
                "turned unseen [°]": np.degrees(se3.angle_rad(se3.inverse(T_before) @ T_after)).round(1),
                "frames to a good pose": event.frames_to_recovery,
            }
            rows.append(row)
    return DataFrame(rows)


def _moved(T_cam_before: np.ndarray, T_cam_after: np.ndarray) -> tuple[float, float]:
    moved_m = np.linalg.norm(T_cam_after[:3, 3] - T_cam_before[:3, 3])
    return float(moved_m), float(se3.angle_rad(se3.inverse(T_cam_before) @ T_cam_after))
