"""Track a whole sequence and keep the results: what ``p2p run`` and the notebooks call."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core import config as configuration
from p2p_lib.core.backends import DEFAULT_DETECTOR, DEFAULT_SEGMENTER, DEFAULT_TRACKER, SEGMENTERS, make_tracker
from p2p_lib.core.camera import Camera
from p2p_lib.core.clicks import check_apart, check_clicks
from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.types import Frame, PoseEstimate
from p2p_lib.datasets import sequence as sequences
from p2p_lib.datasets.export import export
from p2p_lib.datasets.imported import as_run, read_poses
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.datasets.models import find_models, given_models
from p2p_lib.datasets.prompts import Prompt, load_prompts
from p2p_lib.datasets.runs import Run, RunWriter, load_run
from p2p_lib.evaluation.mask_score import MaskEvaluation, evaluate_masks
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.evaluation.protocol import Evaluation, evaluate, model_frames, rate
from p2p_lib.evaluation.tracker_score import TrackerScore, TrackTask
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.method.mesh import save as save_mesh
from p2p_lib.method.pipeline import Point2Pose


@dataclass(frozen=True)
class RunResult:
    """Where the results are, and what to say of them.

    evaluation   where the sequence has truth and models; else ``not_scored`` says why there is none
    summary      a line on the frames done, then one per object: frames with a pose, and what kept it from the others
    interrupted  whether Ctrl-C ended the run
    advice       what to do about objects that never had a pose, a line; "" where all had one
    tracked      whether any object ever had a pose
    """

    path: Path
    evaluation: Evaluation | None
    not_scored: str
    summary: tuple[str, ...]
    interrupted: bool
    advice: str = ""
    tracked: bool = True


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
    tracker: str | PointTracker | None = None,
    detector: str | None = None,
    masks: str | None = None,
    prompts: str | Path | Iterable[Prompt] | None = None,
    save_masks: bool = False,
    format: str | None = None,
    depth_scale: float | None = None,
    objects: Iterable[str] | None = None,
    start: int = 0,
    stop: int | None = None,
    models: Mapping[str, str | Path] | None = None,
    progress: bool = True,
    say: Callable[[str], object] = lambda line: None,
) -> RunResult:
    """Track the objects of a sequence and write a run folder (see :mod:`p2p_lib.datasets.runs`).

    ``masks`` says where masks come from: ``dataset``, ``dataset:FOLDER``, or a segmenter by name, which
    starts from ``prompts`` (a file, or values). The default is the dataset's, or with prompts the
    embedded segmenter. With the dataset's, each object is started by its first mask that is large enough.

    Arguments are those of ``p2p run``; ``sequence`` may also be an open one. An earlier run in ``out`` is replaced, of
    which ``say`` is told before anything is tracked. Raises :class:`P2PError` with a
    one-line message for anything that does not fit; Ctrl-C ends the run early and is reported in the result.
    """
    config = make_config(preset, config_file, settings, seed)
    source = " ".join(map(str, (sequence, *(("--prompts", prompts) if isinstance(prompts, str | Path) else ()))))
    prompts = load_prompts(prompts) if isinstance(prompts, str | Path) else tuple(prompts or ())
    masks = _mask_source(masks, prompts)
    segmenter = masks if masks in SEGMENTERS else None
    if isinstance(sequence, str | Path):
        folder = None if segmenter else masks.partition(":")[2] or None
        sequence = sequences.open_sequence(sequence, format, depth_scale, config.seed, masks=folder)
    frames = _frames(len(sequence), start, stop)
    chosen = _chosen([p.name for p in prompts] if segmenter else sequence.objects, objects)
    clicked = _by_frame([p for p in prompts if p.name in chosen], frames, sequence.camera)
    if not segmenter and all(sequence.masks(i) is None for i in frames):
        fix = "Click on the objects (p2p click SEQ --out prompts.json) and add --prompts prompts.json."
        expected = "masks of the first picture at least, or clicks"
        raise BadInput("masks", f"none in frames {frames[0]} to {frames[-1]} of {sequence.name}", expected, fix)
    method = Point2Pose(
        sequence.camera,
        config,
        _tracker(tracker, sequence, config, models),
        detector or DEFAULT_DETECTOR,
        segmenter or DEFAULT_SEGMENTER,
    )
    for name in () if segmenter else chosen:
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
    if writer.replaced:
        say(f"{out} held {writer.replaced}, which this one replaces.")
    writer.info["detector"] = method.detector.name
    writer.info["prompts"] = [{"name": p.name, "frame": p.frame, "points": p.points_px.tolist()} for p in prompts]
    interrupted, keypoints = False, KeypointLog()
    with writer, progress_bar(sequence.name, len(frames), shown=progress) as bar:
        try:
            for frame, estimates in _estimates(method, sequence, frames, None if segmenter is None else clicked):
                if save_masks:
                    writer.add_masks(frame, method.masks)
                _log_keypoints(keypoints, frame, method)
                times = method.stopwatch.last_ms
                writer.add(frame, estimates, times["total"], {k: v for k, v in times.items() if k != "total"})
                bar.set_postfix_str(_postfix(times["total"], estimates), refresh=False)
                bar.update()
        except KeyboardInterrupt:
            interrupted = True
            writer.info["stopped_by"] = "KeyboardInterrupt"
    if not writer.info["frames"]:
        return RunResult(Path(out), None, "no frame was finished", (f"0 of {len(frames)} frames",), interrupted)
    _save_meshes(method, Path(out))
    maps = {name: obj.map for name, obj in method.objects.items()}
    keypoints.save(Path(out), {name: (m.ids, m.p_obj, m.promoted) for name, m in maps.items()})
    done = load_run(out)
    try:
        evaluation, not_scored = evaluate(done), ""
    except MissingData as error:
        evaluation, not_scored = None, str(error)
    if not any(obj.has_truth.any() for obj in done.objects.values()):
        not_scored = "the sequence has no truth"
    tracked = any(obj.has_pose.any() for obj in done.objects.values())
    advice = "" if interrupted else _advice(done, source, bool(segmenter))
    return RunResult(Path(out), evaluation, not_scored, _summary(done, len(frames)), interrupted, advice, tracked)


def _estimates(
    method: Point2Pose,
    sequence: sequences.Sequence,
    frames: range,
    clicked: Mapping[int, Mapping[str, np.ndarray]] | None,
) -> Iterator[tuple[Frame, dict[str, PoseEstimate]]]:
    """Every frame with its estimates, which a late 2D tracker gives some frames later.

    clicked  frame to the clicks that start objects there; None: the sequence's masks do
    """
    waiting: deque[Frame] = deque()
    for i in frames:
        frame, seen = sequence.frame(i), sequence.masks(i) if clicked is None else None
        for name, clicks in (clicked or {}).get(i, {}).items():
            method.add_object(name, clicks=clicks)
        waiting.append(frame)
        known = None if seen is None else {name: seen[name] for name in method.objects if name in seen}
        estimates = method.step(frame, known)
        if len(waiting) > method.tracker.latency_frames:
            yield waiting.popleft(), estimates
    for estimates in method.finish():
        yield waiting.popleft(), estimates


def evaluate_run(
    out: str | Path, models: Mapping[str, str | Path] | None = None, align: str = "first", min_visible_px: int = 300
) -> Evaluation:
    """Score a run folder; what ``p2p eval`` prints."""
    return evaluate(load_run(out), models, align, min_visible_px)


def evaluate_poses(
    poses: str | Path,
    sequence: str | Path | sequences.Sequence,
    models: Mapping[str, str | Path] | None = None,
    align: str = "first",
    min_visible_px: int = 300,
    format: str | None = None,
    start: int = 0,
    stop: int | None = None,
) -> Evaluation:
    """Score any method's poses (:mod:`p2p_lib.datasets.imported`) by the rules of a run of ours over these frames."""
    if isinstance(sequence, str | Path):
        sequence = sequences.open_sequence(sequence, format)
    known = find_models(sequence) | given_models(models or {}, sequence.objects)
    frames = _frames(len(sequence), start, stop)
    run = as_run(read_poses(poses, sequence), sequence, known, path=Path(poses), frames=frames)
    return evaluate(run, None, align, min_visible_px)


def export_run(folder: str | Path, format: str, out: str | Path, frame: str | None = None) -> list[Path]:
    """Write a run's poses in another tool's form; what ``p2p export`` does.

    frame  "object": T_cam_obj, the tracker's own frame; "model": T_cam_model, by the truth of the first scored frame
           as scoring fixes it. By default the model's for ``bop``, which knows no other, else the object's
    """
    frames = ("object", "model")
    if frame not in (None, *frames):
        raise BadInput("frame", repr(frame), " or ".join(frames))
    run = load_run(folder)
    in_model = (frame or ("model" if format == "bop" else "object")) == "model"
    T_obj_model = model_frames(run) if in_model else None
    path = run.info.get("path")
    there = path is not None and Path(path).is_dir()
    return export(run, out, format, T_obj_model, sequences.open_sequence(path, run.info["format"]) if there else None)


def evaluate_tracker(
    sequence: str | Path | sequences.Sequence,
    tracker: str | None = None,
    *,
    seed: int = 0,
    models: Mapping[str, str | Path] | None = None,
    count: int = 256,
    search: bool = False,
    format: str | None = None,
    depth_scale: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> TrackerScore:
    """Score a 2D tracker against true tracks; what ``p2p eval-tracks`` prints.

    A synthetic sequence named is always that of seed 0; ``seed`` draws the queries and serves the tracker.
    """
    config = make_config(settings=settings, seed=seed)
    named = isinstance(sequence, str | Path)
    opened = sequences.open_sequence(sequence, format, depth_scale) if named else sequence
    chosen = _tracker(tracker, opened, config, models)
    method = make_tracker(chosen, config.tracking, np.random.default_rng(config.seed))
    return TrackTask.of(opened, config.seed, models, count).score(method, search)


def _tracker(
    name: str | PointTracker | None,
    sequence: sequences.Sequence,
    config: Config,
    models: Mapping[str, str | Path] | None,
) -> str | PointTracker:
    """The name of a tracker, but the tracker itself where it must know the sequence: ``oracle``."""
    if name != OracleTracker.name:
        return name or DEFAULT_TRACKER
    return OracleTracker(TrueScene.of(sequence, models), config.oracle, config.seed)


def evaluate_run_masks(out: str | Path, min_visible_px: int = 300) -> MaskEvaluation:
    """Score the masks that a run kept; what ``p2p eval-masks`` prints."""
    return evaluate_masks(load_run(out), min_visible_px=min_visible_px)


def _log_keypoints(log: KeypointLog, frame: Frame, method: Point2Pose) -> None:
    """Keep where each object's points were seen in the frame that has just been estimated."""
    tracks = method.tracks
    for name, obj in method.objects.items():
        seen = tracks.visible & np.isin(tracks.ids, obj.map.ids)
        log.add(frame.index, name, tracks.ids[seen], tracks.uv_px[seen])


def _save_meshes(method: Point2Pose, out: Path) -> None:
    """``meshes/<object>.ply``: each object's surface in its own frame; nothing of one that was never seen."""
    for name, obj in method.objects.items():
        if obj.surface is None or obj.surface.empty:
            continue
        mesh = obj.surface.mesh()
        if len(mesh.faces):
            save_mesh(mesh, out / "meshes" / f"{name}.ply")


def _summary(run: Run, wanted: int) -> tuple[str, ...]:
    """How far the run came; per object how many frames have a pose and what mostly kept it from the others."""
    count = len(next(iter(run.objects.values())))
    hz, _ = rate(run.timings)
    lines = [f"{count} of {wanted} frames" + (f" at {hz:.1f} Hz" if hz else "")]
    for name, obj in run.objects.items():
        without = Counter(
            f"{s}: {r}" for s, r in zip(obj.status[~obj.has_pose], obj.reason[~obj.has_pose], strict=True)
        )
        most = f"; without one mostly {without.most_common(1)[0][0]}" if without else ""
        lines.append(f"{name}: a pose in {int(obj.has_pose.sum())} of {count} frames{most}")
    return tuple(lines)


def _advice(run: Run, source: str, clicks: bool) -> str:
    """What to do about objects that never had a pose, by what kept it from them; "" where there are none.

    source  the sequence, and the prompts, as they were given to the command line
    """
    reasons = {
        name: Counter(obj.reason).most_common(1)[0][0] for name, obj in run.objects.items() if not obj.has_pose.any()
    }
    if not reasons:
        return ""
    who, why = f"{', '.join(reasons)} never had a pose", " ".join(reasons.values())
    fix = "see what is wrong with the data"
    if "not seen yet" in why:
        fix = (
            "click in the middle of it, elsewhere"
            if clicks
            else "its masks are empty or too small: draw it, or use p2p click"
        )
    if "pixels with depth" in why:
        fix = "its depth is missing or out of range, or in another unit (--depth-scale)"
    return f"{who} ({next(iter(reasons.values()))}); {fix}. Next: p2p check {source}"


def _mask_source(masks: str | None, prompts: Sequence[Prompt]) -> str:
    """The checked source of masks; None means the dataset, or with prompts the segmenter that is the default."""
    source = masks or (DEFAULT_SEGMENTER if prompts else "dataset")
    kind, colon, folder = source.partition(":")
    if (kind != "dataset" or (colon and not folder)) and source not in SEGMENTERS:
        raise BadInput("masks", repr(masks), f"dataset, dataset:FOLDER, or {', '.join(SEGMENTERS)}")
    if source in SEGMENTERS and not prompts:
        fix = "Make some with p2p click SEQ --out prompts.json and give them with --prompts."
        raise BadInput("masks", f"{source!r} without prompts", "clicks for the segmenter to start from", fix)
    if source not in SEGMENTERS and prompts:
        raise BadInput("masks", f"{source!r} and prompts", "one of them", f"Segmenters: {', '.join(SEGMENTERS)}.")
    return source


def _chosen(known: Sequence[str], objects: Iterable[str] | None) -> tuple[str, ...]:
    chosen = tuple(known) if objects is None else tuple(objects)
    for name in chosen:
        if name not in known:
            raise BadInput("objects", repr(name), "some of " + ", ".join(known))
    if not chosen:
        raise BadInput("objects", "none", "masks or prompts that show at least one", "Add masks/ or give --prompts.")
    return chosen


def _by_frame(prompts: Sequence[Prompt], frames: range, camera: Camera) -> dict[int, dict[str, np.ndarray]]:
    """Frame to the clicks in it by object; whatever can be wrong with them is said before the run begins."""
    clicked: dict[int, dict[str, np.ndarray]] = {}
    for prompt in prompts:
        if prompt.frame not in frames:
            got = f"frame {prompt.frame}"
            raise BadInput(f"prompt of {prompt.name!r}", got, f"a frame of the run, {frames[0]} to {frames[-1]}")
        clicks = check_clicks(prompt.name, prompt.points_px, camera)
        check_apart(prompt.name, clicks, clicked.setdefault(prompt.frame, {}))
        clicked[prompt.frame][prompt.name] = clicks
    return clicked


def _frames(count: int, start: int, stop: int | None) -> range:
    end = count if stop is None else min(stop, count)
    if not 0 <= start < end:
        raise BadInput("frames", f"start {start}, stop {stop}", f"0 <= start < stop within {count} frames")
    return range(start, end)


def _postfix(total_ms: float, estimates: Mapping[str, PoseEstimate]) -> str:
    return f"{1e3 / max(total_ms, 1e-3):.0f} Hz, " + ", ".join(f"{name} {e.status}" for name, e in estimates.items())
