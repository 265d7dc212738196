"""Running a plan: what is on disk is kept, the rest is run, and all of it becomes tables.

::

    DIR/records/KEY.json   one run's errors, times and provenance (see p2p_lib/benchmark/outcome.py)
    DIR/runs/KEY/          the run itself: poses, meshes, timings (see p2p_lib/data/runs.py)
    DIR/failures/KEY.txt   the traceback of a run that failed
    DIR/PLAN-PROFILE/      results.csv, summary.csv (over seeds), timings.csv

Several plans may share a DIR: a run that two of them ask for happens once.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from p2p_lib.benchmark import rows
from p2p_lib.benchmark.execution import execute
from p2p_lib.benchmark.jobs import Job, jobs_of
from p2p_lib.benchmark.outcome import Outcome, load_outcome, replace_text, run_path, save_outcome
from p2p_lib.benchmark.plan import Plan, read_plan
from p2p_lib.benchmark.rows import Row
from p2p_lib.core.errors import BadInput
from p2p_lib.data.runs import Run, load_run


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

    def run(self, method: str, sequence: str = "", seed: int | None = None) -> Run:
        """The poses of a method's first finished run (on a sequence, with a seed)."""
        for job, outcome in self.results:
            wanted = job.method.name == method and sequence in ("", job.sequence.name) and seed in (None, job.seed)
            if wanted and job.measure == "poses" and outcome.status == "done":
                return load_run(run_path(self.out, job.key))
        known = ", ".join(sorted({job.method.name for job, o in self.results if o.status == "done"})) or "none"
        raise BadInput("benchmark run", f"{method} {sequence}".strip(), f"a method that ran: {known}")


def run_benchmark(
    plan: str | Path | Plan,
    out: str | Path,
    profile: str = "full",
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry: bool = False,
    progress: bool = True,
) -> Benchmark:
    """Run what is not on disk yet, keep it, and write the tables of the whole plan; what ``p2p benchmark`` does.

    plan       a TOML file, the name of a plan of this package, or a plan
    profile    ``full``, or ``quick``: a few frames of embedded data
    jobs       runs at a time on this machine; default: one a core
    scheduler  address of a Dask scheduler, ``tcp://HOST:PORT``, whose workers see ``out`` under the same path
    retry      whether runs that failed before are tried again

    A kill loses the runs in progress alone. A run that fails is a row that says why. Raises :class:`BadInput` and
    :class:`MissingData` for a plan that cannot be read, and for a scheduler that does not answer.
    """
    plan, out = plan if isinstance(plan, Plan) else read_plan(plan), Path(out).absolute()
    if jobs is not None and jobs < 1:
        raise BadInput("jobs", jobs, "at least 1")
    asked = jobs_of(plan, profile)
    wanted = {job.key: job for job in asked if job.key}
    known = {key: outcome for key in wanted if (outcome := load_outcome(out, key))}
    known = {key: outcome for key, outcome in known.items() if not (retry and outcome.status == "failed")}
    todo = [job for key, job in wanted.items() if key not in known]
    at_a_time = jobs or (1 if plan.scope(profile).alone else len(os.sched_getaffinity(0)))
    found, interrupted = _run(todo, out, at_a_time, scheduler, progress, plan.name)
    benchmark = Benchmark(plan, profile, out, _in_order(asked, known | found), interrupted)
    for name, content, columns in (
        ("results", benchmark.rows, rows.COLUMNS),
        ("summary", benchmark.summary, rows.SUMMARY_COLUMNS),
        ("timings", benchmark.times, rows.TIME_COLUMNS),
    ):
        replace_text(benchmark.folder / f"{name}.csv", rows.as_csv(content, columns))
    return benchmark


def _run(
    todo: list[Job], out: Path, at_a_time: int, scheduler: str | None, progress: bool, title: str
) -> tuple[dict[str, Outcome], bool]:
    """Run jobs and keep each outcome as it comes; whether Ctrl-C ended it."""
    found: dict[str, Outcome] = {}
    if not todo:
        return found, False
    outcomes = execute(todo, out, min(at_a_time, len(todo)), scheduler)
    with tqdm(total=len(todo), unit="run", desc=title, disable=not progress) as bar:
        try:
            for job, outcome in outcomes:
                found[job.key] = outcome
                if outcome.status != "not run":
                    save_outcome(out, outcome)
                failed = sum(o.status == "failed" for o in found.values())
                bar.set_postfix_str(f"{job.method.name} on {job.sequence.name}" + f", {failed} failed" * bool(failed))
                bar.update()
        except KeyboardInterrupt:
            return found, True
        finally:
            outcomes.close()
    return found, False


def _in_order(asked: list[Job], outcomes: Mapping[str, Outcome]) -> tuple[tuple[Job, Outcome], ...]:
    return tuple((job, outcomes.get(job.key) or _not_run(job)) for job in asked)


def _not_run(job: Job) -> Outcome:
    return Outcome(key=job.key, status="not run", reason=job.reason or "interrupted before it ran")
