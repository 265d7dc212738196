"""What a cell of a benchmark's table says: the number over seeds, or a dash with the reason, and the notes below."""

from __future__ import annotations

from dataclasses import replace

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.plan import Method
from p2p_lib.benchmark.rows import MEAN, Row, shown_name
from p2p_lib.datasets.paper_reported import FAIL
from p2p_lib.figures.tables import Cell, number

#: The paper's metrics: what the benchmark calls them, their head, and whether more is better.
METRICS = {
    "adds_auc": ("ADD-S AUC", "ADD-S (%)", True),
    "add_auc": ("ADD AUC", "ADD (%)", True),
    "chamfer_cm": ("Chamfer distance", "CD (cm)", False),
}
#: Those of them that are areas under the curve, and the heads of these.
AREA_KEYS = ("adds_auc", "add_auc")
AREA_HEADS = [METRICS[key][1] for key in AREA_KEYS]
_REPORTED = "(reported): as the paper prints it, on its own files, masks and machine"


def is_whole_dataset(job: Job) -> bool:
    """Whether a job stands for all of ``DATASET/*``: so it does where none of its sequences is there."""
    return job.sequence.name.endswith("/*")


class Numbers:
    """The summary of a benchmark, looked up by what a cell is of: failures count as 0, aligned at the first frame."""

    HOW = "exact area under the curve, aligned at the first scored frame, frames without a pose count as 0"

    def __init__(self, benchmark: Benchmark):
        self.benchmark, self.plan = benchmark, benchmark.plan
        self.methods = benchmark.plan.methods(benchmark.profile)
        self.seeds = benchmark.plan.scope(benchmark.profile).seeds
        #: A few dozen frames are too few to call a method the best or the fastest.
        self.judges = benchmark.profile != "quick"
        self.by_cell = {
            (row["method"], row["metric"], row["form"], row["sequence"], row["object"]): row
            for row in benchmark.summary
            if row["failures"] in ("zero", "-") and row["align"] in ("first", "-") and row.get("value") is not None
        }

    def row(self, method: str, metric: str, sequence: str, object: str = "", form: str = "exact") -> Row | None:
        """The number over seeds; None where there is none."""
        return self.by_cell.get((method, metric, form, sequence, object))

    def cell(self, method: str, metric: str, sequence: str, object: str = "", form: str = "exact") -> Cell:
        """The number over seeds as a cell; where there is none it says why."""
        row = self.row(method, metric, sequence, object, form)
        if row is None:
            return self.missing(method, sequence)
        return replace(number(row["value"], row.get("std")), note=self.of_fewer(len(row["seeds"].split())))

    def of_fewer(self, seeds: int) -> str:
        """What to say of a number behind which are fewer seeds than planned, for a run of theirs has no score."""
        return f"of {seeds} of {len(self.seeds)} seeds" if seeds < len(self.seeds) else ""

    def mean(self, method: Method, metric: str) -> Cell:
        """The mean over sequences, and how many these are of; where nothing ran, the reason that the first gave."""
        of = [(j, o) for j, o in self.benchmark.results if j.method.name == method.name and j.measure == "poses"]
        planned = {shown_name(job) for job, _ in of}
        ran = {shown_name(job) for job, outcome in of if outcome.status != "not run"}
        if self.row(method.name, metric, MEAN) is None:
            return self.nothing_ran(method)
        note = f"{len(ran)} of {len(planned)} sequences" if len(ran) < len(planned) else ""
        cell = self.cell(method.name, metric, MEAN)
        return replace(cell, note="; ".join(filter(None, [note, cell.note])))

    def nothing_ran(self, method: Method) -> Cell:
        """A dash, or ``fail``, for a method of which nothing ran, with the reason that its first run gave."""
        first = next(job for job, _ in self.benchmark.results if job.method.name == method.name)
        return self.missing(method.name, shown_name(first))

    def missing(self, method: str, sequence: str) -> Cell:
        """A dash, or ``fail``, with the reason that the run gave."""
        for job, outcome in self.benchmark.results:
            if job.method.name == method and shown_name(job) == sequence and outcome.status != "done":
                return Cell(FAIL if outcome.status == "failed" else "-", note=outcome.reason.rstrip("."))
        return self.not_planned(method)

    def not_planned(self, method: str) -> Cell:
        """A dash for what no run of a method is of; a dataset that is not there might have had it."""
        for job, outcome in self.benchmark.results:
            if job.method.name == method and is_whole_dataset(job):
                return Cell(note=outcome.reason.rstrip("."))
        return Cell(note="no run of the plan is of this" if self.judges else "the quick form runs bundled data alone")

    def notes(self) -> list[str]:
        """What is to be said of every number of ours, and of those that the paper reports."""
        seeds = ", ".join(map(str, self.seeds))
        spread = f"mean ± standard deviation over seeds {seeds}" if len(self.seeds) > 1 else f"seed {seeds} alone"
        reported = [_REPORTED] if self.plan.paper else []
        how = f"Ours: {self.HOW}" if reported else self.HOW.capitalize()
        return [f"{how}; {self.scored()}; {spread}", *self.about(), *reported]

    def scored(self) -> str:
        """Which frames count."""
        return f"frames with less than {self.plan.min_visible_px} pixels of an object's mask are not scored"

    def about(self) -> list[str]:
        """What the plan itself has to say below its table, and what ran."""
        return [*filter(None, [self.plan.note]), self._what_ran()]

    def _what_ran(self) -> str:
        """Trackers, detectors, masks, sequences, commit."""
        done = [(job, o) for job, o in self.benchmark.results if o.status == "done" and job.measure == "poses"]
        if not done:
            return "Nothing was run"
        ran = {
            key: [str(o.ran.get(key)) for _, o in done]
            for key in ("tracker", "detector", "masks", "segmenter")
            if done[0][1].ran.get(key)
        }
        ran["sequences"] = [shown_name(job).partition(" with ")[0] for job, _ in done]
        ran["commit"] = [str(o.ran.get("commit") or "unknown")[:7] for _, o in done]
        return "Ran: " + "; ".join(f"{key} {', '.join(dict.fromkeys(values))}" for key, values in ran.items())
