"""One run of a benchmark from beginning to end, in a process of its own or on another machine."""

from __future__ import annotations

import os
import shutil
import time
import traceback
from pathlib import Path

import numpy as np

from p2p_lib.benchmark.jobs import Job, library_version, models_of, objects_of, open_planned, prompts_of
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome, replace_text, run_path
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from p2p_lib.data.models import MESHES, find_models, given_models
from p2p_lib.data.runs import Run, load_run
from p2p_lib.data.sequence import Sequence
from p2p_lib.evaluation import reconstruction
from p2p_lib.evaluation.protocol import ObjectScore, evaluate
from p2p_lib.evaluation.recovery import recovery_events
from p2p_lib.run import evaluate_tracker, run

_RAN = ("tracker", "detector", "masks", "preset", "frames", "commit", "modified", "versions")


def perform(job: Job, out: Path, library: str) -> Outcome:
    """Run a job and score it. Nothing that goes wrong in it is raised: the outcome says so, and the others go on.

    library  of whoever gave the job: results of another source would not be what its key says
    """
    try:
        if library != library_version():
            fix = "Install the same version of p2p-lib, numpy, scipy, opencv and gtsam on every worker."
            raise BadInput("benchmark worker", f"source {library_version()}", library, fix)
        return _poses(job, out) if job.measure == "poses" else _tracks(job)
    except (MissingData, MissingBackend) as error:
        return Outcome(key=job.key, status="not run", reason=str(error))
    except Exception as error:  # noqa: BLE001 one failing run must not end the others
        replace_text(out / "failures" / f"{job.key}.txt", traceback.format_exc())
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Outcome(key=job.key, status="failed", reason=reason[:500])


def _poses(job: Job, out: Path) -> Outcome:
    sequence, method = open_planned(job), job.method
    unfinished = run_path(out, f".{job.key}.{os.getpid()}")
    started_s = time.process_time()
    try:
        result = run(
            sequence,
            unfinished,
            preset=method.preset,
            settings=method.settings,
            seed=job.seed,
            tracker=method.tracker,
            detector=method.detector,
            masks=method.masks,
            prompts=prompts_of(job),
            objects=objects_of(job, sequence),
            start=job.sequence.start,
            stop=job.sequence.stop,
            models=models_of(job),
            progress=False,
        )
        cpu_s = time.process_time() - started_s
        if result.interrupted:
            raise KeyboardInterrupt
        done = load_run(unfinished)
        outcome = _scored(job, done, sequence, cpu_s)
        shutil.rmtree(run_path(out, job.key), ignore_errors=True)
        os.rename(unfinished, run_path(out, job.key))
        return outcome
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _scored(job: Job, done: Run, sequence: Sequence, cpu_s: float) -> Outcome:
    first, over_all = evaluate(done, align="first"), evaluate(done, align="all")
    objects = {}
    for name, score in first.objects.items():
        events = recovery_events(done.objects[name], score)
        objects[name] = ObjectOutcome(
            lost=score.lost,
            first=_errors(score),
            all=_errors(over_all.objects[name]),
            returns=[event.frames_to_recovery for event in events],
            **(_chamfer(job, done, sequence, name, score) if job.chamfer else {}),
        )
    return Outcome(
        key=job.key,
        status="done",
        ran={key: done.info[key] for key in _RAN} | {"library": library_version()},
        objects=objects,
        left_out=first.left_out,
        times=_times(done, first.hz, first.p95_ms, cpu_s) | {"width_px": sequence.camera.width},
    )


def _errors(score: ObjectScore) -> dict[str, list[float]]:
    return {"adds_m": score.adds_m.tolist(), "add_m": score.add_m.tolist()}


def _times(done: Run, hz: float | None, p95_ms: float | None, cpu_s: float) -> dict[str, float]:
    frames = done.info["frames"]
    stages = {k: v for k, v in done.timings.items() if k.endswith("_ms") and k != "total_ms"}
    times = {f"stage {k.removesuffix('_ms')} [ms]": float(np.nan_to_num(v).mean()) for k, v in stages.items()}
    times |= {"rate [Hz]": hz or float("nan"), "95th percentile [ms]": p95_ms or float("nan")}
    return times | {"processor time, files included [ms]": 1e3 * cpu_s / frames}


def _chamfer(job: Job, done: Run, sequence: Sequence, name: str, score: ObjectScore) -> dict:
    """The fields of an outcome on the reconstruction."""
    import trimesh

    mesh = done.path / "meshes" / f"{name}.ply"
    if not mesh.is_file():
        return {"no_chamfer": "no surface was reconstructed"}
    if not np.isfinite(score.T_obj_model).all():
        return {"no_chamfer": "no pose, so no model frame"}
    models = find_models(sequence, MESHES) | given_models(models_of(job), sequence.objects, MESHES)
    model = models[name] if name in models and models[name].suffix != ".xyz" else done.points[name]
    truth, reference = reconstruction.seen_surface(sequence, name, model, score.frame_index, job.seed)
    surface = trimesh.load(mesh, process=False)
    chamfer_cm = reconstruction.chamfer_cm(surface, se3.inverse(score.T_obj_model), truth, job.seed)
    return {"chamfer_cm": chamfer_cm, "reference": reference, "no_chamfer": "" if chamfer_cm else "nothing near it"}


def _tracks(job: Job) -> Outcome:
    """The 2D tracker by itself, on true tracks (see :mod:`p2p_lib.evaluation.tracker_score`)."""
    method, sequence = job.method, open_planned(job)
    plain = evaluate_tracker(
        sequence, method.tracker, seed=job.seed, models=models_of(job), settings=method.settings
    ).as_dict()
    again = plain["redetection"]
    scores = {"AJ": plain["aj"], "delta_avg": plain["delta_avg"], "OA": plain["oa"], "found again": again["found"]}
    ran = {"tracker": plain["tracker"], "frames": plain["frames"], "preset": "default", "library": library_version()}
    times = {"tracker's processor time [ms]": plain["cpu_ms"]["mean"]}
    return Outcome(key=job.key, status="done", ran=ran, tracks=scores, times=times)
