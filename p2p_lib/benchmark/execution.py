"""One run of a benchmark from beginning to end, and where runs happen: processes here, or workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import platform
import shutil
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.connection import wait
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from p2p_lib.benchmark.jobs import Job, library_version, open_planned
from p2p_lib.benchmark.outcome import Outcome, run_path
from p2p_lib.benchmark.scoring import chamfer, fault_done, scored
from p2p_lib.core import packages
from p2p_lib.core.compiled import warm_up
from p2p_lib.core.errors import BadInput, Doubt, MissingBackend, MissingData, P2PError
from p2p_lib.core.files import replace_text
from p2p_lib.datasets.runs import Run, load_run
from p2p_lib.evaluation.protocol import rate
from p2p_lib.run import evaluate_tracker, run

# Loaded once, in the process from which those of the runs are forked.
_PRELOADED = ["p2p_lib.benchmark.execution", "p2p_lib.method.factor_graph", "torch", "scipy.spatial", "scipy.optimize"]
_PRELOADED += ["trimesh", "skimage.measure"]
#: What is done of a job, which has a key, in a folder of results.
Work = Callable[[Any, Path], Outcome]
# How long a scheduler may take to answer.
_CONNECT_S = 20


def perform(work: Work, job: Any, out: Path, library: str) -> Outcome:
    """Do a job. Nothing that goes wrong in it is raised: the outcome says so, and the others go on.

    library  of whoever gave the job: results of another source would not be what its key says
    """
    try:
        if library != library_version():
            fix = "Install the same version of p2p-lib, numpy, scipy, opencv and gtsam on every worker."
            raise BadInput("benchmark worker", f"source {library_version()}", library, fix)
        with warnings.catch_warnings():
            warnings.showwarning = partial(_show_others, warnings.showwarning)
            return work(job, out)
    except (MissingData, MissingBackend) as error:
        return Outcome(key=job.key, status="not run", reason=str(error))
    except Exception as error:  # noqa: BLE001 one failing run must not end the others
        replace_text(out / "failures" / f"{job.key}.txt", traceback.format_exc())
        kind = "" if isinstance(error, P2PError) else f"{type(error).__name__}: "
        return Outcome(key=job.key, status="failed", reason=_cut(f"{kind}{' '.join(str(error).split())}"))


def _cut(text: str) -> str:
    """At most 500 letters, of long lists in the middle fewer: what to do stands last."""
    return text if len(text) <= 500 else f"{text[:298]} ... {text[-197:]}"


def _show_others(shown: Callable, message: Any, category: type, *where: Any) -> None:
    """What a run doubts it keeps itself, in its ``run.json``."""
    if not issubclass(category, Doubt):
        shown(message, category, *where)


def measured(job: Job, out: Path) -> Outcome:
    """Run a job of a benchmark, and score it."""
    return _poses(job, out) if job.measure == "poses" else _tracks(job)


def _poses(job: Job, out: Path) -> Outcome:
    sequence = open_planned(job)
    unfinished = run_path(out, f".{job.key}.{platform.node()}.{os.getpid()}")
    warm_up()  # compiling is no frame's time
    started_s = time.process_time()
    try:
        result = run(sequence, unfinished, job.options(sequence.objects), progress=False)
        cpu_s = time.process_time() - started_s
        if result.interrupted:
            raise KeyboardInterrupt
        done = load_run(unfinished)
        judge: Callable[..., Any] | None = fault_done if job.sequence.fault else chamfer if job.chamfer else None
        judge = judge and partial(judge, done, sequence, job.models)
        outcome = scored(done, job.models, judge, job.key, job.min_visible_px)
        times = _times(done, cpu_s) | {"width_px": sequence.camera.width}
        outcome = outcome.model_copy(update={"times": times, "ran": outcome.ran | {"library": library_version()}})
        shutil.rmtree(run_path(out, job.key), ignore_errors=True)
        os.rename(unfinished, run_path(out, job.key))
        return outcome
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _times(done: Run, cpu_s: float) -> dict[str, float]:
    hz, p95_ms = rate(done.timings)
    stages = {k.removesuffix("_ms"): v for k, v in done.timings.items() if k.endswith("_ms") and k != "total_ms"}
    times = {f"stage {name} [ms]": float(np.nan_to_num(ms).mean()) for name, ms in stages.items()}
    times |= {"rate [Hz]": hz or float("nan"), "95th percentile [ms]": p95_ms or float("nan")}
    return times | {"processor time, files included [ms]": 1e3 * cpu_s / done.info["frames"]}


def _tracks(job: Job) -> Outcome:
    """The 2D tracker by itself, on true tracks (see :mod:`p2p_lib.evaluation.tracker_score`)."""
    plain = evaluate_tracker(open_planned(job), job.options(), preset=None).as_dict()
    found = plain["redetection"]["found"]
    scores = {"AJ": plain["aj"], "delta_avg": plain["delta_avg"], "OA": plain["oa"]}
    scores["found again"] = float("nan") if found is None else found
    ran = {"tracker": plain["tracker"], "frames": plain["frames"], "preset": "default", "library": library_version()}
    times = {"tracker's processor time [ms]": plain["cpu_ms"]["mean"]}
    return Outcome(key=job.key, status="done", ran=ran, tracks=scores, times=times)


def execute(
    jobs: Sequence[Any], out: Path, at_a_time: int, scheduler: str | None, work: Work = measured
) -> Generator[tuple[Any, Outcome], None, None]:
    """The outcomes of jobs as they come, of each what ``work`` makes of it; closing it ends what is still running.

    scheduler  address of a Dask scheduler, whose workers see ``out`` under the same path; None: this machine. By
               ``tcp`` whoever reaches its port or a worker's runs what he likes there: a private network, or ``tls``
    """
    if scheduler is None:
        return _on_this_machine(jobs, out, at_a_time, work)
    return _on_cluster(jobs, out, scheduler, work)


def _on_this_machine(
    jobs: Iterable[Any], out: Path, at_a_time: int, work: Work
) -> Generator[tuple[Any, Outcome], None, None]:
    """A process for each run, so many at a time. One that dies, of a lack of memory say, takes no other with it."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # runs share the cores: more threads would wait for each other
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    for folder in (out / "runs").glob(f".*.{platform.node()}.*"):  # left unfinished by processes that are no more
        if not Path("/proc", folder.name.rpartition(".")[2]).exists():
            shutil.rmtree(folder, ignore_errors=True)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    not_ours = set(multiprocessing.active_children())
    pool = ThreadPoolExecutor(at_a_time)
    try:
        waiting = {pool.submit(_in_a_process, context, job, out, work): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - not_ours:
            process.kill()
        pool.shutdown(wait=True)


def _in_a_process(context: BaseContext, job: Any, out: Path, work: Work) -> Outcome:
    try:
        with ProcessPoolExecutor(1, context, _end_with_parent) as process:
            return process.submit(perform, work, job, out, library_version()).result()
    except BrokenProcessPool:
        return Outcome(key=job.key, status="failed", reason="its process was ended from outside: out of memory?")


def _end_with_parent() -> None:
    """The process of a run ends with its parent, which alone hears Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system, which is left when the process is killed
    if (parent := multiprocessing.parent_process()) is not None:
        threading.Thread(target=lambda: wait([parent.sentinel]) and os._exit(1), daemon=True).start()


def _on_cluster(
    jobs: Sequence[Any], out: Path, scheduler: str, work: Work
) -> Generator[tuple[Any, Outcome], None, None]:
    """Dask distributes the runs; a worker that dies fails its run alone."""
    distributed = packages.load("distributed", "--scheduler", "distributed")
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        got = f"{scheduler} ({type(error).__name__})"
        raise BadInput("scheduler", got, "a Dask scheduler that answers", "Start one with: dask scheduler") from None
    with client:
        futures = [client.submit(perform, work, job, out, library_version(), pure=False) for job in jobs]
        by_key = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for future in distributed.as_completed(futures):
            job, lost = by_key[future.key], future.exception()
            reason = f"its worker was lost ({type(lost).__name__})"
            yield job, Outcome(key=job.key, status="failed", reason=reason) if lost else future.result()
