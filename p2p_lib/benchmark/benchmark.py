"""Running a plan: what is on disk is kept, the rest is run, and all of it becomes tables.

::

    DIR/records/KEY.json   one run's errors, times and provenance (see p2p_lib/benchmark/outcome.py)
    DIR/runs/KEY/          the run itself: poses, meshes, timings (see p2p_lib/datasets/runs.py)
    DIR/failures/KEY.txt   the traceback of a run that failed
    DIR/PLAN-PROFILE/      results.csv, summary.csv (over seeds), timings.csv

Several plans may share a DIR: a run that two of them ask for happens once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

from p2p_lib.benchmark import rows
from p2p_lib.benchmark.execution import execute
from p2p_lib.benchmark.jobs import Job, jobs_of, open_planned
from p2p_lib.benchmark.outcome import Outcome, load_outcome, run_path, save_outcome
from p2p_lib.benchmark.plan import Plan, read_plan
from p2p_lib.benchmark.rows import Row
from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replace_text
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.runs import Run, load_run
from p2p_lib.datasets.sequence import Sequence


@dataclass(frozen=True, eq=False)
class Benchmark:
    """The results of a plan, complete or as far as they came.

    results      every job in the plan's order, with what became of it
    interrupted  whether Ctrl-C ended it: the same call goes on where it stood
    """

    plan: Plan
    profile: str
    out: Path
    results: tuple[tuple[Job, Outcome], ...]
    interrupted: bool = False

    @property
    def folder(self) -> Path:
        """Where its tables are."""
        return self.out / f"{self.plan.name}-{self.profile}"

    @property
    def methods(self) -> tuple[str, ...]:
        """The names of its methods, in the plan's order."""
        return tuple(method.name for method in self.plan.methods(self.profile))

    @property
    def rows(self) -> list[Row]:
        """One number each (see :mod:`p2p_lib.benchmark.rows`)."""
        return rows.result_rows(self.plan, self.profile, self.results)

    @property
    def summary(self) -> list[Row]:
        """The rows over seeds."""
        return rows.summary_rows(self.rows)

    @property
    def times(self) -> list[Row]:
        """How long it took."""
        return rows.time_rows(self.plan, self.profile, self.results)

    def counts(self) -> dict[str, int]:
        """Runs by what became of them."""
        statuses = [outcome.status for _, outcome in self.results]
        return {status: statuses.count(status) for status in ("done", "failed", "not run")}

    @property
    def cpu_min(self) -> float:
        """Minutes of processor time that its finished runs took."""
        done = [outcome for _, outcome in self.results if outcome.status == "done"]
        ms = [o.ran.get("frames", 0) * sum(t for name, t in o.times.items() if "processor time" in name) for o in done]
        return sum(ms) / 6e4

    def run(self, method: str, sequence: str = "") -> Run:
        """The poses of a method's first finished run (on a sequence)."""
        return load_run(run_path(self.out, self._finished(method, sequence)[0].key))

    def video(self, method: str, sequence: str = "") -> Sequence:
        """The sequence of that run."""
        return open_planned(self._finished(method, sequence)[0])

    def chamfer_cm(self, method: str, sequence: str, object: str) -> float | None:
        """The Chamfer distance of an object in that run, BundleSDF's form; None where it was not measured."""
        return self._finished(method, sequence)[1].objects[object].chamfer_cm.get("BundleSDF")

    def write_tables(self) -> None:
        """``results.csv``, ``summary.csv`` and ``timings.csv`` in :attr:`folder`."""
        for name, content, columns in (
            ("results", self.rows, rows.COLUMNS),
            ("summary", self.summary, rows.SUMMARY_COLUMNS),
            ("timings", self.times, rows.TIME_COLUMNS),
        ):
            replace_text(self.folder / f"{name}.csv", rows.as_csv(content, columns))

    def _finished(self, method: str, sequence: str) -> tuple[Job, Outcome]:
        done = [(j, o) for j, o in self.results if o.status == "done" and j.measure == "poses"]
        for job, outcome in done:
            if job.method.name == method and sequence in ("", job.sequence.name):
                return job, outcome
        known = ", ".join(sorted({job.method.name for job, _ in done})) or "none"
        raise BadInput("benchmark run", f"{method} {sequence}".strip(), f"a method that ran: {known}")


def run_benchmarks(
    plans: Iterable[str | Path | Plan],
    out: str | Path,
    profile: str = "full",
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry: bool = False,
    progress: bool = True,
) -> list[Benchmark]:
    """Run what is not on disk yet, keep it, and write the tables of the plans; what ``p2p benchmark`` does.

    plans      TOML files, names of plans of this package, or plans
    profile    ``full``, or ``quick``: a few frames of bundled data
    jobs       runs at a time on this machine; default: one a core, or one where a plan measures times
    scheduler  address of a Dask scheduler, ``tcp://HOST:PORT``, whose workers see ``out`` under the same path
    retry      whether runs that failed before are tried again

    A kill loses the runs in progress alone. A run that fails is a row that says why. Raises :class:`BadInput` and
    :class:`MissingData` for a plan that cannot be read, and for a scheduler that does not answer.
    """
    if jobs is not None and jobs < 1:
        raise BadInput("jobs", jobs, "at least 1")
    benchmarks = [load_benchmark(plan, out, profile) for plan in plans]
    wanted = ("not run", "failed") if retry else ("not run",)
    found: dict[str, Outcome] = {}
    interrupted = False
    # What measures times runs when nothing else does; what needs a GPU, so many at a time as its memory has room for.
    for alone, gpu in ((False, False), (False, True), (True, False)):
        todo = {
            job.key: job
            for benchmark in benchmarks
            if benchmark.plan.scope(profile).alone == alone
            for job, outcome in benchmark.results
            if job.key and outcome.status in wanted and job.key not in found and (alone or job.method.gpu == gpu)
        }
        if todo and not interrupted:
            limit = min(benchmark.plan.gpu_jobs for benchmark in benchmarks) if gpu else len(todo)
            at_a_time = min(jobs or (1 if alone else len(os.sched_getaffinity(0))), limit, len(todo))
            outcomes = execute(list(todo.values()), benchmarks[0].out, at_a_time, scheduler)
            ran = _run(outcomes, len(todo), benchmarks[0].out, progress)
            interrupted, found = len(ran) < len(todo), found | ran
    finished = []
    for benchmark in benchmarks:
        results = tuple((job, found.get(job.key, outcome)) for job, outcome in benchmark.results)
        finished.append(replace(benchmark, results=results, interrupted=interrupted))
        finished[-1].write_tables()
    return finished


def load_benchmark(plan: str | Path | Plan, out: str | Path, profile: str = "full") -> Benchmark:
    """What is on disk of a plan; nothing is run. What is not there is ``not run``, with what would run it."""
    named = plan.name if isinstance(plan, Plan) else quote(str(plan))
    plan, out = plan if isinstance(plan, Plan) else read_plan(plan), Path(out).absolute()
    results = []
    for job in jobs_of(plan, profile):
        reason = job.reason or f"not run yet: p2p benchmark {named}"
        known = load_outcome(out, job.key) if job.key else None
        results.append((job, known or Outcome(key=job.key, status="not run", reason=reason)))
    return Benchmark(plan, profile, out, tuple(results))


def _run(
    outcomes: Generator[tuple[Job, Outcome], None, None], total: int, out: Path, progress: bool
) -> dict[str, Outcome]:
    """Keep each outcome as it comes; Ctrl-C ends it with those that came."""
    found: dict[str, Outcome] = {}
    with progress_bar("benchmark", total, "run", shown=progress) as bar:
        try:
            for job, outcome in outcomes:
                if outcome.status != "not run":
                    save_outcome(out, outcome)
                found[job.key] = outcome
                failed = sum(o.status == "failed" for o in found.values())
                label = f"{job.method.name} on {job.sequence.name}" + f", {failed} failed" * bool(failed)
                bar.set_postfix_str(label, refresh=False)
                bar.update()
                if not bar.disable and not sys.stderr.isatty() and len(found) < total:
                    # Into a file: such runs take hours, and somebody wants to know.
                    left_s = bar.format_dict["elapsed"] / len(found) * (total - len(found))
                    sys.stderr.write(f"{len(found)} of {total} runs, about {left_s / 60:.0f} min left: {label}\n")
        except KeyboardInterrupt:
            pass
        finally:
            outcomes.close()
    return found
