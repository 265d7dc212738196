"""Track a whole sequence and keep the results: what ``p2p run`` and the notebooks call."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from p2p_lib.core import config as configuration
from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import PoseEstimate
from p2p_lib.data import sequence as sequences
from p2p_lib.data.models import find_models, given_models
from p2p_lib.data.runs import RunWriter, load_run
from p2p_lib.evaluation.protocol import Evaluation, evaluate
from p2p_lib.pipeline import Point2Pose
from p2p_lib.stages.tracking import DEFAULT_TRACKER


@dataclass(frozen=True)
class RunResult:
    """Where the results are; the evaluation where the sequence has truth and models; whether Ctrl-C ended it."""

    path: Path
    evaluation: Evaluation | None
    interrupted: bool


def make_config(
    preset: str | None = None,
    config_file: Path | None = None,
    settings: Mapping[str, Any] | None = None,
    seed: int | None = None,
) -> Config:
    """The configuration of a run: preset, then file, then single settings, then seed."""
    config = configuration.preset(preset or "default")
    if config_file is not None:
        config = configuration.from_toml(config_file, config if preset else None)
    config = config.with_values(dict(settings or {}), source="--set")
    return config if seed is None else config.with_values({"seed": seed})


def run(
    sequence: str | Path | sequences.Sequence,
    out: str | Path,
    *,
    preset: str | None = None,
    config_file: Path | None = None,
    settings: Mapping[str, Any] | None = None,
    seed: int | None = None,
    tracker: str | None = None,
    masks: str = "dataset",
    format: str | None = None,
    depth_scale: float | None = None,
    objects: Iterable[str] | None = None,
    start: int = 0,
    stop: int | None = None,
    models: Mapping[str, str | Path] | None = None,
    progress: bool = True,
) -> RunResult:
    """Track the objects of a sequence and write a run folder (see :mod:`p2p_lib.data.runs`).

    Each object is started by its first mask that is large enough. Arguments are those of ``p2p run``;
    ``sequence`` may also be an open one. Raises :class:`P2PError` with a one-line message for anything
    that does not fit; Ctrl-C ends the run early and is reported in the result.
    """
    config = make_config(preset, config_file, settings, seed)
    if isinstance(sequence, str | Path):
        folder = _mask_folder(masks)
        sequence = sequences.open_sequence(sequence, format, depth_scale, config.seed, masks=folder)
    chosen = _chosen(sequence, objects)
    frames = _frames(len(sequence), start, stop)
    method = Point2Pose(sequence.camera, config, tracker or DEFAULT_TRACKER)
    for name in chosen:
        method.add_object(name)
    known = find_models(sequence) | given_models(models or {}, sequence.objects)
    writer = RunWriter(
        out,
        sequence,
        config,
        method.tracker.name,
        masks,
        chosen,
        frames.start,
        frames.stop,
        {name: path for name, path in known.items() if name in chosen},
    )
    interrupted = False
    with writer, tqdm(total=len(frames), unit="frame", disable=not progress, desc=sequence.name) as bar:
        try:
            for i in frames:
                frame, seen = sequence.frame(i), sequence.masks(i)
                estimates = method.step(frame, None if seen is None else {n: seen[n] for n in chosen if n in seen})
                times = method.stopwatch.last_ms
                writer.add(frame, estimates, times["total"], {k: v for k, v in times.items() if k != "total"})
                bar.set_postfix_str(_postfix(times["total"], estimates), refresh=False)
                bar.update()
        except KeyboardInterrupt:
            interrupted = True
            writer.info["stopped_by"] = "KeyboardInterrupt"
    return RunResult(Path(out), _evaluation(out), interrupted)


def evaluate_run(
    out: str | Path, models: Mapping[str, str | Path] | None = None, align: str = "first", min_visible_px: int = 300
) -> Evaluation:
    """Score a run folder; what ``p2p eval`` prints."""
    return evaluate(load_run(out), models, align, min_visible_px)


def _evaluation(out: str | Path) -> Evaluation | None:
    try:
        return evaluate_run(out)
    except MissingData:  # no truth or no models: nothing to say
        return None


def _mask_folder(masks: str) -> str | None:
    kind, _, folder = masks.partition(":")
    if kind != "dataset" or (":" in masks and not folder):
        raise BadInput("masks", repr(masks), "dataset, or dataset:FOLDER")
    return folder or None


def _chosen(sequence: sequences.Sequence, objects: Iterable[str] | None) -> tuple[str, ...]:
    chosen = sequence.objects if objects is None else tuple(objects)
    for name in chosen:
        if name not in sequence.objects:
            raise BadInput("objects", repr(name), "some of " + ", ".join(sequence.objects))
    if not chosen:
        raise BadInput(sequence.name, "no objects", "masks that show at least one", "Add masks/ to the folder.")
    return chosen


def _frames(count: int, start: int, stop: int | None) -> range:
    end = count if stop is None else min(stop, count)
    if not 0 <= start < end:
        raise BadInput("frames", f"start {start}, stop {stop}", f"0 <= start < stop within {count} frames")
    return range(start, end)


def _postfix(total_ms: float, estimates: Mapping[str, PoseEstimate]) -> str:
    return f"{1e3 / max(total_ms, 1e-3):.0f} Hz, " + ", ".join(f"{name} {e.status}" for name, e in estimates.items())
