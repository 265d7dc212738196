"""One run of a benchmark from beginning to end, in a process of its own or on another machine."""

from __future__ import annotations

import os
import platform
import shutil
import time
import traceback
from pathlib import Path

import numpy as np

from p2p_lib.benchmark.jobs import Job, library_version, models_of, objects_of, open_planned, prompts_of
from p2p_lib.benchmark.outcome import Outcome, replace_text, run_path
from p2p_lib.benchmark.scoring import scored
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from p2p_lib.datasets.runs import Run, load_run
from p2p_lib.evaluation.protocol import rate
from p2p_lib.run import evaluate_tracker, run


def perform(job: Job, out: Path, library: str) -> Outcome:
    """Run a job and score it. Nothing that goes wrong in it is raised: the outcome says so, and the others go on.

    library  of whoever gave the job: results of another source would not be what its key says
    """
    try:
        if library != library_version():
            fix = "Install the same version of p2p-lib, numpy, scipy, opencv and gtsam on every worker."
            raise BadInput("benchmark worker", f"source {library_version()}", library, fix)
        return _poses(job, out, library) if job.measure == "poses" else _tracks(job)
    except (MissingData, MissingBackend) as error:
        return Outcome(key=job.key, status="not run", reason=str(error))
    except Exception as error:  # noqa: BLE001 one failing run must not end the others
        replace_text(out / "failures" / f"{job.key}.txt", traceback.format_exc())
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Outcome(key=job.key, status="failed", reason=reason[:500])


def _poses(job: Job, out: Path, library: str) -> Outcome:
    sequence, method = open_planned(job), job.method
    unfinished = run_path(out, f".{job.key}.{platform.node()}.{os.getpid()}")
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
        outcome = scored(done, sequence if job.chamfer else None, models_of(job), job.key)
        times = _times(done, cpu_s) | {"width_px": sequence.camera.width}
        outcome = outcome.model_copy(update={"times": times, "ran": outcome.ran | {"library": library}})
        shutil.rmtree(run_path(out, job.key), ignore_errors=True)
        os.rename(unfinished, run_path(out, job.key))
        return outcome
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _times(done: Run, cpu_s: float) -> dict[str, float]:
    frames, (hz, p95_ms) = done.info["frames"], rate(done.timings)
    stages = {k: v for k, v in done.timings.items() if k.endswith("_ms") and k != "total_ms"}
    times = {f"stage {k.removesuffix('_ms')} [ms]": float(np.nan_to_num(v).mean()) for k, v in stages.items()}
    times |= {"rate [Hz]": hz or float("nan"), "95th percentile [ms]": p95_ms or float("nan")}
    return times | {"processor time, files included [ms]": 1e3 * cpu_s / frames}


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
