"""What one run gave, and where it is kept: ``records/KEY.json`` beside the run itself in ``runs/KEY/``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replace_text


class _Record(BaseModel):
    # Of the nested ones too: each model writes its own numbers, and infinity would be written as null.
    model_config = ConfigDict(ser_json_inf_nan="constants")


class ObjectOutcome(_Record):
    """One object's errors over its scored frames.

    first, all  ``add_m`` and ``adds_m`` in metres by either alignment, infinite where there was no pose
    returns     frames from each return after complete occlusion to a good pose; None where it never came
    chamfer_cm  by form; empty with the reason where there is none. ``reference`` says against which surface
    fault       what a fault did (:mod:`p2p_lib.evaluation.faults`); empty where the plan has none
    """

    lost: int
    first: dict[str, list[float]]
    all: dict[str, list[float]]
    returns: list[int | None]
    chamfer_cm: dict[str, float] = {}
    reference: str = ""
    no_chamfer: str = ""
    fault: dict[str, float] = {}

    def errors_m(self, align: str) -> dict[str, np.ndarray]:
        """The errors by the alignment ``first`` or ``all``."""
        return {name: np.array(values) for name, values in getattr(self, align).items()}


class Outcome(_Record):
    """What became of a job.

    status    "not run" where data or a backend is missing: tried again the next time
    ran       tracker, detector, masks, preset, commit, versions as the run itself says
    left_out  objects without a score, with the reason
    tracks    scores of the 2D tracker by itself
    times     milliseconds and rates; they are the machine's, not the method's
    """

    key: str
    status: Literal["done", "failed", "not run"]
    reason: str = ""
    ran: dict[str, Any] = {}
    objects: dict[str, ObjectOutcome] = {}
    left_out: dict[str, str] = {}
    tracks: dict[str, float] = {}
    times: dict[str, float] = {}


def run_path(out: Path, key: str) -> Path:
    """Where the run of a key lies (see :mod:`p2p_lib.datasets.runs`)."""
    return out / "runs" / key


def load_outcome(out: Path, key: str) -> Outcome | None:
    """The record of a key; None where there is none."""
    path = out / "records" / f"{key}.json"
    try:
        return Outcome.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as error:
        fix = "Delete it and run the benchmark again."
        raise BadInput(str(path), f"a damaged record ({type(error).__name__})", "JSON", fix) from None


def save_outcome(out: Path, outcome: Outcome) -> None:
    """Keep a record, so that a kill leaves either all of it or nothing."""
    replace_text(out / "records" / f"{outcome.key}.json", outcome.model_dump_json() + "\n")
