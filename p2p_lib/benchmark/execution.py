"""Where the runs of a benchmark happen: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import platform
import shutil
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from pathlib import Path

from p2p_lib.benchmark.jobs import Job, library_version
from p2p_lib.benchmark.outcome import Outcome
from p2p_lib.benchmark.worker import perform
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.core.packages import PIP, command

# Loaded once, in the process from which those of the runs are forked.
_PRELOADED = ["p2p_lib.benchmark.worker", "p2p_lib.method.factor_graph", "torch", "scipy.spatial", "scipy.optimize"]
_PRELOADED += ["trimesh", "skimage.measure"]
# How long a scheduler may take to answer.
_CONNECT_S = 20


def execute(jobs: Sequence[Job], out: Path, at_a_time: int, scheduler: str | None) -> Iterator[tuple[Job, Outcome]]:
    """The outcomes of jobs as they come; closing it ends what is still running.

    scheduler  address of a Dask scheduler, whose workers see ``out`` under the same path; None: this machine
    """
    if scheduler is not None:
        return _on_cluster(jobs, out, scheduler)
    return _on_this_machine(jobs, out, at_a_time)


def _on_this_machine(jobs: Iterable[Job], out: Path, at_a_time: int) -> Iterator[tuple[Job, Outcome]]:
    """A process for each run, so many at a time. One that dies, of a lack of memory say, takes no other with it."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # runs share the cores: more threads would wait for each other
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    _sweep(out)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    running: set[BaseProcess] = set()
    pool = ThreadPoolExecutor(at_a_time)
    try:
        waiting = {pool.submit(_in_a_process, context, job, out, running): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in tuple(running):
            process.kill()
        pool.shutdown(wait=True)


def _sweep(out: Path) -> None:
    """Remove what processes of this machine left unfinished that are no more."""
    for folder in (out / "runs").glob(f".*.{platform.node()}.*"):
        if not Path("/proc", folder.name.rpartition(".")[2]).exists():
            shutil.rmtree(folder, ignore_errors=True)


def _in_a_process(context: BaseContext, job: Job, out: Path, running: set[BaseProcess]) -> Outcome:
    here, there = context.Pipe()
    process = context.Process(target=_report, args=(there, job, out, library_version()))
    process.start()
    running.add(process)
    there.close()  # so that its end is seen here
    try:
        outcome = here.recv()
        process.join()
    except EOFError:
        process.join()
        ended = f"by signal {-process.exitcode}" if process.exitcode < 0 else f"with exit code {process.exitcode}"
        outcome = Outcome(key=job.key, status="failed", reason=f"its process was ended {ended}: out of memory?")
    finally:
        running.discard(process)
        here.close()  # not before its end, which that would hasten
    return outcome


def _report(parent: Connection, job: Job, out: Path, library: str) -> None:
    """What the process of a run does; it ends with its parent, which alone hears Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    parent.send(perform(job, out, library))


def _end_with(parent: Connection) -> None:
    try:
        parent.recv()  # nothing is ever sent: it returns when the parent is gone
    except (EOFError, OSError):
        os._exit(1)


def _on_cluster(jobs: Sequence[Job], out: Path, scheduler: str) -> Iterator[tuple[Job, Outcome]]:
    """Dask distributes the runs; a worker that dies fails its run alone."""
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError:
        fix = f"Run: {command(PIP + 'distributed')}"
        raise MissingBackend("--scheduler", "the package distributed is not installed", fix) from None
    try:
        client = Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        fix = "Start one with: dask scheduler"
        raise BadInput(
            "scheduler", f"{scheduler} ({type(error).__name__})", "a Dask scheduler that answers", fix
        ) from None
    with client:
        futures = [client.submit(perform, job, out, library_version(), pure=False) for job in jobs]
        by_key = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for future in completed(futures):
            job = by_key[future.key]
            error = future.exception()
            if error is None:
                yield job, future.result()
            else:
                reason = f"its worker was lost ({type(error).__name__})"
                yield job, Outcome(key=job.key, status="failed", reason=reason)
