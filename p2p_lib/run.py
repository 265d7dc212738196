"""Track a whole sequence and keep the results: what ``p2p run`` and the notebooks call.

Scores a 2D tracker by itself and any method's poses as well, and writes a run in the forms of other tools.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core.compiled import warm_up
from p2p_lib.core.config import Config
from p2p_lib.core.depth import in_range
from p2p_lib.core.errors import BadInput, Doubts, MissingData, P2PError, advised, did_you_mean, doubt
from p2p_lib.core.memory import ObjectMemory, far_fewer_pixels, load_memories
from p2p_lib.core.options import MaskSource, RunOptions, lengths_m, located
from p2p_lib.core.progress import progress_bar, waiting_for
from p2p_lib.core.prompts import Prompt, given_masks
from p2p_lib.core.types import DOUBTED, NOT_SEEN, WITH_POSE, Frame, PoseEstimate, status_text
from p2p_lib.core.voxels import check_device
from p2p_lib.datasets import sequence as sequences
from p2p_lib.datasets.alignment import misfit, moving_scale
from p2p_lib.datasets.camera_check import odd_camera
from p2p_lib.datasets.depth_units import beyond, distance_m, hardly_counts, odd_size, uncounted
from p2p_lib.datasets.exchange import as_run, export, pose_files, read_poses
from p2p_lib.datasets.images import SKIP_BAD
from p2p_lib.datasets.mask_log import load_masks
from p2p_lib.datasets.models import find_models, given_models
from p2p_lib.datasets.prompts import first_prompts, load_prompts, prompts_by_frame
from p2p_lib.datasets.run_writer import IfExists, RunWriter, look_into, refined_info
from p2p_lib.datasets.runs import OFFLINE, Run, load_run
from p2p_lib.evaluation.known_size import in_masks_m
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX, Evaluation, evaluate, model_frames, rate
from p2p_lib.evaluation.readings import doubt_reading
from p2p_lib.evaluation.tracker_score import TrackerScore, TrackTask
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.extended.default import Point2Pose
from p2p_lib.keeper import Keeper, noted

#: So many clicks an object are drawn from its first mask.
CLICKS = 3
#: Fraction of a first mask: if less is in range, depth is most likely in another unit.
_HARDLY = 0.02
#: What to do where the frame of a prompt cannot be read.
_NEEDED = "A prompt needs this frame. Click in another one (p2p click), or give a mask of one."


@dataclass(frozen=True)
class RunResult:
    """Where the results are, and what to say of them.

    evaluation   where the sequence has truth and models; else ``not_scored`` says why there is none
    summary      a line on the frames done, then one per object: frames with a pose, and what kept it from the others
    interrupted  whether Ctrl-C ended the run
    advice       what to do about objects that never had a pose, a line; "" where all had one
    tracked      whether any object ever had a pose
    look_at      what to look at before the run is believed, a line each; none where nothing that it keeps is suspicious
    unstarted    objects that never had a mask to start from
    """

    path: Path
    evaluation: Evaluation | None
    not_scored: str
    summary: tuple[str, ...]
    interrupted: bool
    advice: str = ""
    tracked: bool = True
    look_at: tuple[str, ...] = ()
    unstarted: tuple[str, ...] = ()


def run(
    sequence: str | Path | sequences.Sequence,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    if_exists: IfExists = "refuse",
    redo_from: int | None = None,
    progress: bool = True,
    say: Callable[[str], object] = lambda line: None,
    **changes: Any,
) -> RunResult:
    """Track the objects of a sequence and write a run folder (see :mod:`p2p_lib.datasets.runs`).

    ``changes`` are fields of :class:`RunOptions` over those of ``options``: ``run("synthetic/mug", "out", seed=3)``.
    ``options.masks`` says where masks come from; the segmenter looks after every object in frames that bring none:

    - ``dataset``: the dataset's, or those in a ``FOLDER`` (the default without prompts)
    - ``first``: of each object the dataset's first usable one alone
    - ``clicks``: ``options.prompts`` (the default with them), or else three clicks an object that are drawn, by the
      seed, from the dataset's first usable mask. The name of a segmenter means the same, with that segmenter

    ``sequence`` may be an open one. ``if_exists`` says what becomes of an earlier run in ``out``: ``refuse`` with
    :class:`BadInput`, ``replace`` it, or ``resume`` it where it was cut short. Resuming tracks its frames once more,
    since what it knew went with it: that takes as long as it took, each pose is compared with the one on disk, and what
    is there stays as it is until the first new frame. With ``redo_from`` that is this frame: of a run that is there,
    finished or not, the frames before it are kept, and prompts of later ones may have changed. Of all this ``say`` is
    told before anything is tracked. Raises :class:`P2PError` for anything that does not fit; Ctrl-C ends the run early
    and is reported in the result.
    """
    options = replace(options or RunOptions(), **changes)
    doubts, if_exists = Doubts(), if_exists if redo_from is None else "resume"
    with waiting_for("Reading the sequence", progress), noted(doubts):
        job = _prepare(sequence, options, progress)
        if options.stop is not None and options.stop > len(job.sequence):
            say(f"stop {options.stop}: {job.sequence.name} has {len(job.sequence)} frames alone")
        sizes_m = lengths_m(options.sizes, job.objects)
        _check_free(job, Path(out), if_exists)
        _doubt_camera(job)
        tracker = options.tracker
        if tracker == OracleTracker.name:  # which has to know the sequence
            tracker = OracleTracker(TrueScene.of(job.sequence, options.models), job.config.oracle, job.config.seed)
        method = Point2Pose(job.sequence.camera, job.config, tracker, options.detector, job.masks.segmenter)
        recall(method, job.memories, options.frozen)
        for name in [n for n in job.objects if n not in job.memories] if job.masks.every_mask else ():
            method.add_object(name)
        writer = _writer(job, options, method, out, if_exists, redo_from)
    with writer:
        _say_what_was_there(writer, say, if_exists == "resume")
        if not writer.complete:
            prompts = [prompt for of_frame in job.prompts.values() for prompt in of_frame]
            keeper = Keeper(writer, method, options.save_masks, prompts, sizes_m, doubts=doubts)
            _track(job, keeper, options.skip_bad, progress, say)
    interrupted = writer.info["stopped_by"] is not None
    if not writer.begun and not writer.earlier:
        nothing = (f"0 of {len(job.frames)} frames",)
        return RunResult(writer.path, None, "no frame was finished", nothing, interrupted, tracked=False)
    return _result(job, writer.path, interrupted)


def recall(method: Point2Pose, memories: Mapping[str, ObjectMemory], frozen: bool) -> None:
    """Have objects looked for that are known from memories; warns of a camera by which one is seldom found."""
    for name, memory in memories.items():
        method.add_object(name, memory=memory, frozen=frozen)
        if fewer := far_fewer_pixels(memory, method.camera):
            fix = "All is metric and nothing is to be changed, but it is found near the learnt views alone."
            doubt(f"memory of {name!r}", fewer, fix, name)


def evaluate_tracker(
    sequence: str | Path | sequences.Sequence,
    options: RunOptions | None = None,
    *,
    count: int = 256,
    search: bool = False,
    **changes: Any,
) -> TrackerScore:
    """Score the 2D tracker of ``options`` by itself against ``count`` true tracks; what ``p2p eval-tracks`` prints.

    The seed given draws the queries and serves the tracker.
    """
    options = replace(options or RunOptions(), **changes)
    config = options.config()
    opened = sequences.open_sequence(sequence, options.format, options.depth_scale)
    if options.stop is not None:
        kept = slice(_frame_range(len(opened), 0, options.stop).stop)
        cut = {key: getattr(opened, key)[kept] for key in ("rgb", "depth", "times_s")}
        opened = replace(opened, **cut)  # type: ignore[type-var]  # what is opened is a dataclass
    task = TrackTask.of(opened, config.seed, options.models, count)
    return task.score(task.tracker(options.tracker, config), search)


def import_poses(
    poses: str | Path,
    sequence: str | Path | sequences.Sequence,
    models: Mapping[str, str | Path] | None = None,
    align: str = "first",
    min_visible_px: int = MIN_VISIBLE_PX,
    format: str | None = None,
    start: int = 0,
    stop: int | None = None,
) -> Run:
    """Any method's poses (:mod:`p2p_lib.datasets.exchange`) over these frames, to be scored as a run of ours is.

    Warns where they would score far better in another convention (:mod:`p2p_lib.evaluation.readings`); :func:`evaluate`
    scores them as they were given.
    """
    sequence = sequences.open_sequence(sequence, format)
    known = find_models(sequence) | given_models(models or {}, sequence.objects)
    frames = _frame_range(len(sequence), start, stop)
    run = as_run(read_poses(poses, sequence), sequence, known, path=Path(poses), frames=frames)
    written = pose_files(poses, sequence)
    quaternions = {name for name, file in written.items() if file.is_file() and file.suffix.lower() != ".csv"}
    doubt_reading(run, quaternions, align, min_visible_px)
    return run


def export_run(
    folder: str | Path, format: str, out: str | Path, frame: str | None = None, min_confidence: float = 0.0
) -> list[Path]:
    """Write a run's poses in another tool's form; what ``p2p export`` does.

    frame  "object": T_cam_obj, the tracker's own frame; "model": T_cam_model, by the truth of the first scored frame
           as scoring fixes it. By default the model's for ``bop``, which knows no other, else the object's

    Poses of less than ``min_confidence`` are left out.
    """
    if frame not in (None, "object", "model"):
        raise BadInput("frame", repr(frame), "object or model")
    run = load_run(folder)
    in_model = (frame or ("model" if format == "bop" else "object")) == "model"
    path = run.info.get("path")
    sequence = sequences.reopen(run.info) if path and Path(path).is_dir() else None
    frames = model_frames(run) if in_model else None
    confident = {name: obj.of_confidence(min_confidence) for name, obj in run.objects.items()}
    return export(replace(run, objects=confident), out, format, frames, sequence)


@dataclass(frozen=True, eq=False)
class _Job:
    """A run whose options have been checked.

    source   the sequence, and the prompts, as they would be given to the command line
    masks    where they come from; those of a folder are the sequence's then
    prompts  what starts objects and corrects their masks, by frame
    memories  objects that are known, and looked for
    """

    source: str
    config: Config
    sequence: sequences.Sequence
    frames: range
    objects: tuple[str, ...]
    masks: MaskSource
    prompts: Mapping[int, tuple[Prompt, ...]]
    memories: Mapping[str, ObjectMemory]


def _prepare(sequence: str | Path | sequences.Sequence, options: RunOptions, progress: bool) -> _Job:
    """Check the options, before anything is tracked."""
    config, prompts, source = options.config(), options.prompts, str(sequence)
    check_device(config.device)  # otherwise it shows at the first surface
    if options.depth_scale is not None:
        source += f" --depth-scale {options.depth_scale:g}"
    if isinstance(prompts, str | Path):
        source += f" --prompts {prompts}"
        prompts = load_prompts(prompts)
    prompts, memories = tuple(prompts or ()), load_memories(options.memory or ())
    masks = options.mask_source()
    how = options.format, options.depth_scale
    sequence = sequences.open_sequence(sequence, *how, masks=masks.folder, gaps=options.skip_bad, progress=progress)
    frames = _frame_range(len(sequence), options.start, options.stop)
    prompted = masks.name == "clicks" and bool(prompts or memories)  # all that is known of the objects
    objects = [p.name for p in prompts] if prompted else sequence.objects
    objects = _chosen(list(dict.fromkeys([*objects, *memories])), options.objects)
    memories = {name: memory for name, memory in memories.items() if name in objects}
    if both := [p.name for p in prompts if p.name in memories]:
        raise BadInput(f"memory of {both[0]!r}", "a prompt of it, too", "a memory or a prompt", "Leave the prompt out.")
    if not prompted and all(sequence.masks(i) is None for i in frames):
        fix = "Click on the objects (p2p click SEQ --out prompts.json) and add --prompts prompts.json."
        fix += " With --batch, each recording's prompts.json lies in its folder."
        fix = "Leave --masks out: the prompts start the objects." if prompts else fix
        expected = "masks of the first image at least, or clicks"
        raise BadInput("masks", f"none in frames {frames[0]} to {frames[-1]} of {sequence.name}", expected, fix)
    if not prompted and not masks.every_mask:
        rng, clicks = np.random.default_rng([config.seed, 2]), CLICKS if masks.name == "clicks" else 0
        unknown = tuple(name for name in objects if name not in memories)
        drawn = first_prompts(sequence, frames, unknown, config.lifecycle.min_mask_px, clicks, rng)
        if not drawn:
            got = f"no mask of {', '.join(objects)} that is large enough"
            raise BadInput("masks", got, f"one of {config.lifecycle.min_mask_px} pixels", "Click on the objects.")
        prompts += drawn
    started = objects if masks.every_mask else tuple(memories)
    by_frame = prompts_by_frame([p for p in prompts if p.name in objects], frames, sequence.camera, started)
    for i, of_frame in by_frame.items() if masks.every_mask else ():
        if both := [p.name for p in of_frame if p.name in (sequence.masks(i) or {})]:
            fix = "Leave --masks out to start from the prompts, or take the mask of that frame away."
            raise BadInput(f"prompt of {both[0]!r}", f"a mask in frame {i}, too", "a mask or a prompt", fix)
    return _Job(source, config, sequence, frames, objects, masks, by_frame, memories)


def _doubt_camera(job: _Job) -> None:
    """Warn, before anything is tracked, where K is of other images, or depth not of one scale, or not registered."""
    if wrong := odd_camera(job.sequence.camera):
        doubt("camera", *wrong)
    looked_at = np.unique(np.linspace(job.frames[0], job.frames[-1] - 1, 8).astype(int)) if len(job.frames) > 1 else ()
    try:
        pairs = [(job.sequence.frame(int(i)), job.sequence.frame(int(i) + 1)) for i in looked_at]
    except P2PError:
        return  # said when the run comes to that frame, with the poses before it kept
    if text := moving_scale(pairs):
        doubt("depth", text, f"Is each image scaled separately? See p2p check {job.source}")
        return
    firsts = [first for first, _ in pairs]
    if firsts and hardly_counts(firsts, job.config.depth, 1.0) is None and (found := misfit(firsts)) and found.doubt:
        doubt("depth", *found.doubt)  # in another unit, which is said of objects, its edges are others


def _doubt_range(job: _Job, frame: Frame, masks: Mapping[str, np.ndarray | None], known_m: Container[str]) -> set[str]:
    """Warn of objects where depth does not count; unless sizes are known, also if all are far away, and of odd sizes.

    Returns those whose mask and its depth tell, in range or not.
    A run goes on without a pose then, as where a unit is another, and would say so at its end only.
    """
    limits, least_px = job.config.depth, job.config.lifecycle.min_mask_px
    large = {name: mask for name, mask in masks.items() if mask is not None and np.count_nonzero(mask) >= least_px}
    away_m = {}
    for name, mask in large.items():
        if np.isfinite(distance_m(frame, mask)):
            counts = mask & in_range(frame.depth_m, limits)
            away_m[name] = distance_m(frame, counts if counts.sum() >= _HARDLY * mask.sum() else mask)
    scale = getattr(job.sequence, "depth_scale", 1.0)
    unknown = {name: m for name, m in away_m.items() if name not in known_m}
    out_m = {name: m for name, m in away_m.items() if uncounted({name: m}, limits)}
    told = out_m or (unknown if len(unknown) == len(away_m) else {})  # one that is far away beside others is
    if told and (wrong := beyond(told, limits, scale)):
        doubt(f"depth of {next(iter(told))!r} in frame {frame.index}", *wrong, of=next(iter(told)))
        unknown = {name: m for name, m in unknown.items() if name not in told}
    for name, m in unknown.items():
        if wrong := odd_size(large[name], m, job.sequence.camera, scale):
            doubt(f"size of {name!r} in frame {frame.index}", *wrong, of=name)
    return set(away_m)


def _frame_range(count: int, start: int, stop: int | None) -> range:
    """The frames from ``start`` to ``stop`` of a sequence of ``count``; :class:`BadInput` where there are none."""
    end = count if stop is None else min(stop, count)
    if not 0 <= start < end:
        raise BadInput("frames", f"start {start}, stop {stop}", f"0 <= start < stop within {count} frames")
    return range(start, end)


def _chosen(known: Sequence[str], wanted: Sequence[str] | None) -> tuple[str, ...]:
    chosen = tuple(known if wanted is None else wanted)
    for name in chosen:
        if name not in known:
            raise BadInput("objects", repr(name), "some of " + ", ".join(known), did_you_mean(name, known))
    if not chosen:
        raise BadInput("objects", "none", "masks or prompts that show at least one", "Add masks/ or give --prompts.")
    return chosen


def _check_free(job: _Job, out: Path, if_exists: IfExists) -> None:
    """:class:`BadInput` where the results would be among what is read, or in the place of what is to stay."""
    at, masks = job.sequence.path, job.masks.folder
    read = {"the sequence": [at] if at else [], "the masks": [Path(at or "", masks), Path(masks)] if masks else []}
    for what, places in read.items():
        if any(place.is_dir() and place.resolve().is_relative_to(out.resolve()) for place in places):
            raise BadInput(str(out), f"a folder that holds {what}", "another one for the results")
    look_into(out, if_exists)


def _writer(
    job: _Job, options: RunOptions, method: Point2Pose, out: str | Path, if_exists: IfExists, redo_from: int | None
) -> RunWriter:
    """The writer of the run, told all that ``run.json`` says of it."""
    known = find_models(job.sequence) | given_models(options.models or {}, {*job.objects, *job.sequence.truth})
    writer = RunWriter(
        out,
        job.sequence,
        job.config,
        method.tracker.name,
        job.masks.name,
        job.objects,
        job.frames.start,
        job.frames.stop,
        {name: path for name, path in known.items() if name in job.objects},
        if_exists,
        redo_from,
    )
    writer.info["left_out"] = {}
    prompts = [prompt for of_frame in job.prompts.values() for prompt in of_frame]
    writer.info |= described(method, options, prompts, job.sequence.path)
    return writer


def described(
    method: Point2Pose, options: RunOptions, prompts: Iterable[Prompt], sequence: Path | None
) -> dict[str, Any]:
    """What ``run.json`` says of the parts and words with which a run was made, on the ``sequence`` in a folder."""
    parts = {"detector": method.detector.name, "segmenter": method.segmenter.name}
    asked = located(options.as_dict(), sequence)
    return {**parts, "prompts": [prompt.as_dict() for prompt in prompts], "options": asked}


def _say_what_was_there(writer: RunWriter, say: Callable[[str], object], resuming: bool) -> None:
    if writer.complete:
        say(f"{writer.path} holds {writer.earlier}, which is finished.")
    elif writer.resumed:
        kept = "its frames" if writer.redo_from is None else f"its frames before {writer.redo_from}"
        gone = writer.redo_from is not None and refined_info(writer.path / OFFLINE) is not None
        then = " What p2p refine made of it goes: make it anew afterwards." * gone
        say(f"{writer.path} holds {writer.earlier}; {kept} are tracked again and compared before it goes on.{then}")
    elif writer.earlier:
        say(f"{writer.path} held {writer.earlier}, which this one replaces.")
    elif resuming:
        say(f"{writer.path} holds no run to go on with: one begins anew.")


def _track(job: _Job, keeper: Keeper, skip_bad: bool, progress: bool, say: Callable[[str], object]) -> None:
    """Every frame, and at the end the maps; Ctrl-C ends it early."""
    writer, method = keeper.writer, keeper.method
    with waiting_for("Loading compiled loops", progress) as line:

        def instead(compiling: str) -> None:
            line.clear()
            say(compiling)

        warm_up(instead if progress else lambda line: None)
    # SAM 2 takes seconds for the first masks.
    bar = progress_bar(job.sequence.name, len(job.frames), shown=progress, first="First masks")
    with noted(keeper.doubts), bar:
        left_out, unseen = writer.info["left_out"], set(job.objects)

        def leave_out(index: int, unreadable: P2PError) -> None:
            left_out[str(index)] = str(unreadable)
            bar.set_description_str(f"{job.sequence.name}, {len(left_out)} left out", refresh=False)
            bar.update()

        try:
            for frame, estimates in _estimates(method, job, leave_out if skip_bad else None):
                for what, drawn in zip(("First", "Corrected"), keeper.add(frame, estimates), strict=True):
                    if drawn and progress:
                        bar.clear()
                        say(f"{what} masks of {', '.join(drawn)} in frame {frame.index}: {keeper.first_masks.path}")
                masks = {name: mask for name, mask in method.masks.items() if name in unseen}
                unseen -= _doubt_range(job, frame, masks, keeper.sizes_m)
                now = ", ".join(f"{name} {estimate.status}" for name, estimate in estimates.items())
                bar.set_postfix_str(now, refresh=False)
                bar.update()
            if not writer.begun:
                writer.begin()  # all frames were on disk, the maps were not
        except KeyboardInterrupt as interrupt:
            writer.info["stopped_by"] = type(interrupt).__name__
            writer.keep_whole_frames()
    if writer.begun:
        keeper.save_maps()
        keeper.judge(job.sequence)


def _estimates(
    method: Point2Pose, job: _Job, leave_out: Callable[[int, P2PError], None] | None
) -> Iterator[tuple[Frame, dict[str, PoseEstimate]]]:
    """Every frame with its estimates, which a late 2D tracker gives some frames later.

    leave_out  is told the frames that cannot be read, with the reason; None: they end the run
    """

    def steps() -> Iterator[dict[str, PoseEstimate]]:
        for i in job.frames:
            try:
                frame, masks = job.sequence.frame(i), (job.sequence.masks(i) or {}) if job.masks.every_mask else {}
            except P2PError as unreadable:
                if leave_out is None or i in job.prompts:
                    raise advised(unreadable, _NEEDED if i in job.prompts else SKIP_BAD) from None
                leave_out(i, unreadable)
                continue
            given = {name: masks[name] for name in method.objects if name in masks}
            prompts = {prompt.name: prompt for prompt in job.prompts.get(i, ())}
            refused = given_masks(frame, given, prompts, method.objects, method.camera)[1] if prompts else {}
            for error in refused.values():  # a step would ignore it; nobody is there to say something better
                raise error
            for prompt in prompts.values():
                method.tell(prompt)
            yield method.step(frame, given)
        yield from method.finish()

    for estimates in steps():
        if method.frame is not None:
            yield method.frame, estimates


def _result(job: _Job, out: Path, interrupted: bool) -> RunResult:
    done = load_run(out)
    try:
        evaluation, not_scored = evaluate(done), ""
    except MissingData as error:
        evaluation, not_scored = None, str(error)
    if not any(obj.has_truth.any() for obj in done.objects.values()):
        of = f" of {', '.join(done.objects)}, only of {', '.join(job.sequence.truth)}" if job.sequence.truth else ""
        not_scored = f"the sequence has no truth{of or sequences.no_truth_said(job.sequence)}"
    tracked = any(obj.has_pose.any() for obj in done.objects.values())
    without = {
        name: Counter(obj.reason).most_common(1)[0][0] for name, obj in done.objects.items() if not obj.has_pose.any()
    }
    unstarted = tuple(name for name, why in without.items() if why.startswith(NOT_SEEN) and name not in job.memories)
    advice = "" if interrupted or not without else _advice(without, unstarted, job)
    look_at = [f"{name}: {text}" for name, of in (done.info.get("look_at") or {}).items() for text in of]
    lines = summary(done, len(job.frames))
    return RunResult(out, evaluation, not_scored, lines, interrupted, advice, tracked, tuple(look_at), unstarted)


#: Why an object that was followed has no pose in its frame.
_OTHER_MAP = "followed in another map, never joined with the one that is kept"


def summary(run: Run, wanted: int) -> tuple[str, ...]:
    """How far the run came; per object how many frames have a pose and what mostly kept it from the others."""
    count = len(next(iter(run.objects.values())))
    hz, _ = rate(run.timings)
    lines = [f"{count} of {wanted} frames" + (f" at {hz:.1f} Hz" if hz else "")]
    if left_out := run.info.get("left_out"):
        lines[0] += f"; {len(left_out)} left out, which cannot be read, the first: {next(iter(left_out.values()))}"
    masks = load_masks(run.path)
    for name, obj in run.objects.items():
        without = zip(obj.status[~obj.has_pose], obj.reason[~obj.has_pose])
        why = Counter(_OTHER_MAP if s in WITH_POSE else status_text(s, r).partition(" since ")[0] for s, r in without)
        others = f"in the other {sum(why.values())} " if obj.has_pose.any() else ""
        most = f"; {others}{'mostly ' if len(why) > 1 else ''}{why.most_common(1)[0][0]}" if why else ""
        doubted = int(obj.doubted.sum())
        doubts = f", {doubted} of them doubted (confidence at most {DOUBTED:g})" if doubted else ""
        length_m = in_masks_m(masks[name].size_m) if name in masks else np.nan
        long = f"; {100 * length_m:.3g} cm long by its masks" if np.isfinite(length_m) else ""
        lines.append(f"{name}: a pose in {int(obj.has_pose.sum())} of {count} frames{doubts}{most}{long}")
    return tuple(lines)


def _advice(reasons: Mapping[str, str], unstarted: Iterable[str], job: _Job) -> str:
    """What to do about objects that never had a pose, by what kept it from them."""
    if set(reasons) <= set(job.memories):
        fix = "show a side that was learnt, or click on it, or it is not in this video"
    elif any("depth" in why for name, why in reasons.items() if name not in unstarted):
        fix = "its depth is missing, out of range or in another unit (--depth-scale)"
    elif unstarted and not job.masks.every_mask:
        fix = "click on another place, near its centre"
    elif unstarted:
        fix = "its masks are empty or too small: draw them anew, or use p2p click"
    else:
        fix = "look for faults in the data"
    first = next(iter(reasons.values())).partition(": ")[0]
    return f"{', '.join(reasons)} never had a pose ({first}); {fix}. Next: p2p check {job.source}"
