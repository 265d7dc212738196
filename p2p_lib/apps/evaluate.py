"""Poses across the border: those of any method scored as ours are, and ours in the forms of other tools."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.exchange import as_run, export, read_poses
from p2p_lib.datasets.models import find_models, given_models
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation.protocol import Evaluation, evaluate, model_frames
from p2p_lib.run import frame_range


def evaluate_poses(
    poses: str | Path,
    sequence: str | Path | Sequence,
    models: Mapping[str, str | Path] | None = None,
    align: str = "first",
    min_visible_px: int = 300,
    format: str | None = None,
    start: int = 0,
    stop: int | None = None,
) -> Evaluation:
    """Score any method's poses (:mod:`p2p_lib.datasets.exchange`) by the rules of a run of ours over these frames."""
    if isinstance(sequence, str | Path):
        sequence = open_sequence(sequence, format)
    known = find_models(sequence) | given_models(models or {}, sequence.objects)
    frames = frame_range(len(sequence), start, stop)
    run = as_run(read_poses(poses, sequence), sequence, known, path=Path(poses), frames=frames)
    return evaluate(run, None, align, min_visible_px)


def export_run(folder: str | Path, format: str, out: str | Path, frame: str | None = None) -> list[Path]:
    """Write a run's poses in another tool's form; what ``p2p export`` does.

    frame  "object": T_cam_obj, the tracker's own frame; "model": T_cam_model, by the truth of the first scored frame
           as scoring fixes it. By default the model's for ``bop``, which knows no other, else the object's
    """
    if frame not in (None, "object", "model"):
        raise BadInput("frame", repr(frame), "object or model")
    run = load_run(folder)
    in_model = (frame or ("model" if format == "bop" else "object")) == "model"
    path = run.info.get("path")
    sequence = open_sequence(path, run.info["format"]) if path and Path(path).is_dir() else None
    return export(run, out, format, model_frames(run) if in_model else None, sequence)
