"""Scores as tables: pandas DataFrames that say their units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.datasets.runs import Run
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.evaluation.recovery import recovery_events

if TYPE_CHECKING:
    from pandas import DataFrame


def of_rows(rows: Iterable[Mapping[str, Any]]) -> DataFrame:
    """A table of one row per mapping; the keys are its heads, units included."""
    from pandas import DataFrame

    return DataFrame(list(rows))


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
            moved_m, turned_rad = _moved(obj.T_cam_model[gone - 1], obj.T_cam_model[back])
            times_s = round(float(obj.time_s[gone]), 2), round(float(obj.time_s[back]), 2)
            rows.append((name, *times_s, round(100 * moved_m, 1), round(float(np.degrees(turned_rad)), 1)))
            rows[-1] += (event.frames_to_recovery,)
    heads = (
        "object",
        "hidden at [s]",
        "back at [s]",
        "moved unseen [cm]",
        "turned unseen [°]",
        "frames to a good pose",
    )
    return DataFrame(rows, columns=heads)


def _moved(T_cam_before: np.ndarray, T_cam_after: np.ndarray) -> tuple[float, float]:
    moved_m = np.linalg.norm(T_cam_after[:3, 3] - T_cam_before[:3, 3])
    return float(moved_m), float(se3.angle_rad(se3.inverse(T_cam_before) @ T_cam_after))
