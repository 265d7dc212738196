"""The paper's two arrangements of its datasets, with its columns and ours.

Bold is the best among methods without a CAD model, of those that ran on the whole of what the paper ran on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.plan import Method
from p2p_lib.benchmark.rows import MEAN, shown_name
from p2p_lib.datasets import manifests
from p2p_lib.datasets.paper_reported import Table as Reported
from p2p_lib.datasets.paper_reported import paper_reported
from p2p_lib.figures.tables import Cell, Table, emboldened, number
from p2p_lib.studies.benchmark_numbers import FAIL, Numbers

#: The paper's metrics: what the benchmark calls them, their head, and whether more is better.
METRICS = {
    "adds_auc": ("ADD-S AUC", "ADD-S (%)", True),
    "add_auc": ("ADD AUC", "ADD (%)", True),
    "chamfer_cm": ("Chamfer distance", "CD (cm)", False),
}
_NAMES = {"Ours": "Point2Pose"}
_NOT_IN_PAPER = Cell(note="not in the paper")


@dataclass
class _Line:
    """One method's numbers of one metric.

    cells       by column; others hold ``empty``
    comparable  columns in which it ran on what the paper ran on, without a CAD model
    """

    setting: str
    name: str
    cells: dict[str, Cell]
    mean: Cell
    comparable: set[str]
    empty: Cell

    def cell(self, column: str) -> Cell:
        return self.cells.get(column, self.empty)


def by_sequence(numbers: Numbers) -> Table:
    """A column per sequence, metrics and methods below each other: the paper's tables on HO3D and YCBInEOAT."""
    paper = paper_reported().table(numbers.plan.paper)
    columns = [*_columns(paper), "Mean", *_own_columns(numbers, paper)]
    rows, rules = [], []
    for metric in _metrics(numbers, paper):
        rules.append(len(rows))
        for line in _lines(numbers, paper, metric):
            cells = [line.mean if column == "Mean" else line.cell(column) for column in columns]
            rows.append([Cell(METRICS[metric][1]), Cell(line.setting), Cell(line.name), *cells])
    heads = ["Metric", "Setting", "Method", *columns]
    return Table(numbers.plan.title, heads, rows, words=3, rules=rules[1:], notes=numbers.notes())


def by_object(numbers: Numbers) -> Table:
    """A row per object, methods beside each other: the paper's tables on YCBMultiTrack."""
    paper = paper_reported().table(numbers.plan.paper)
    found = {metric: _lines(numbers, paper, metric) for metric in _metrics(numbers, paper)}
    labels = dict(zip(_columns(paper), ((c.sequence, c.object) for c in paper.columns), strict=True))
    labels |= {column: (shown_name(job), name) for column, (job, name) in _own_columns(numbers, paper).items()}
    rows, rules, last = [], [], ""
    for column, (sequence, object) in labels.items():
        if sequence != last and rows:
            rules.append(len(rows))
        words = [Cell(sequence if sequence != last else ""), Cell(object)]
        rows.append([*words, *(line.cell(column) for lines in found.values() for line in lines)])
        last = sequence
    rules.append(len(rows))
    rows.append([Cell("Mean"), Cell(""), *(line.mean for lines in found.values() for line in lines)])
    heads = [line.name + ", CAD" * (line.setting == "CAD") for lines in found.values() for line in lines]
    groups = [("", 2), *((METRICS[metric][1], len(lines)) for metric, lines in found.items())]
    heads = ["Category", "Object", *heads]
    return Table(numbers.plan.title, heads, rows, groups, words=2, rules=rules, notes=numbers.notes())


def _columns(paper: Reported) -> list[str]:
    return [f"{column.sequence} {column.object}".strip() for column in paper.columns]


def _metrics(numbers: Numbers, paper: Reported) -> list[str]:
    printed = {row.metric for row in paper.rows}
    return [metric for metric in METRICS if metric in printed and (metric != "chamfer_cm" or numbers.plan.chamfer)]


def _filled(numbers: Numbers) -> Iterator[tuple[str, Job, str]]:
    """Column, job and object of every run; one that did not run fills the columns that its plan gives it."""
    for job, outcome in numbers.benchmark.results:
        names = list(outcome.objects) or list(job.sequence.columns) or job.sequence.objects or [""]
        for name in names:
            own = shown_name(job) + (f" {name}" if len(names) > 1 else "")
            yield job.sequence.column_of(name) or own, job, name


def _places(numbers: Numbers) -> dict[str, tuple[Job, str]]:
    """Column to the job and the object that fill it; one that has run knows its objects."""
    places = {}
    for column, job, name in _filled(numbers):
        if name or column not in places:
            places.setdefault(column, (job, name))
            places[column] = places[column] if places[column][1] else (job, name)
    return places


def _own_columns(numbers: Numbers, paper: Reported) -> dict[str, tuple[Job, str]]:
    """Columns of ours that the paper does not have."""
    return {column: at for column, at in _places(numbers).items() if column not in _columns(paper)}


def _lines(numbers: Numbers, paper: Reported, metric: str) -> list[_Line]:
    """All methods of a metric, the reported ones first, with the best in bold."""
    columns, more_is_better = _columns(paper), METRICS[metric][2]
    lines = []
    for row in (row for row in paper.rows if row.metric == metric):
        cells = dict(zip(columns, [Cell(FAIL) if v == FAIL else number(float(v)) for v in row.values], strict=True))
        name = f"{_NAMES.get(row.method, row.method)} (reported)"
        comparable = set() if row.cad else set(columns)
        setting = "CAD" if row.cad else "CAD-free"
        lines.append(_Line(setting, name, cells, number(row.mean), comparable, _NOT_IN_PAPER))
    for method in numbers.methods:
        for form in ("BundleSDF", "release") if metric == "chamfer_cm" else ("exact",):
            lines.append(_our_line(numbers, paper, metric, form, method))
    for column in columns:
        compared = [line for line in lines if column in line.comparable]
        best = emboldened([line.cell(column) for line in compared], more_is_better)
        for line, cell in zip(compared, best, strict=True):
            line.cells[column] = cell
    compared = [line for line in lines if line.setting != "CAD"]
    for line, cell in zip(compared, emboldened([line.mean for line in compared], more_is_better), strict=True):
        line.mean = cell
    return lines


def _our_line(numbers: Numbers, paper: Reported, metric: str, form: str, method: Method) -> _Line:
    columns, cells, comparable = _columns(paper), {}, set()
    frames = {shown_name(j): o.ran.get("frames") for j, o in numbers.benchmark.results if j.method.name == method.name}
    for column, (job, name) in _places(numbers).items():
        cell = numbers.cell(method.name, METRICS[metric][0], shown_name(job), name, form)
        if column in columns:
            part = _part(job, frames.get(shown_name(job)), paper.dataset)
            cell = replace(cell, note=cell.note or part)
            comparable |= {column} if not part and cell.text != "-" else set()
        cells[column] = cell
    mean = numbers.cell(method.name, METRICS[metric][0], MEAN, "", form)
    if len(comparable) < len(columns):
        mean = Cell(note=f"{len(comparable)} of the table's {len(columns)} columns were run in whole")
    name = method.name + (f", {form}'s form" if metric == "chamfer_cm" else "")
    return _Line("CAD-free", name, cells, mean, comparable, numbers.not_planned())


def _part(job: Job, frames: int | None, dataset: str) -> str:
    """What a run leaves out of the sequence that the paper's number is of, "" where nothing."""
    if job.sequence.start or job.sequence.stop is not None:
        return f"frames {job.sequence.start} to {job.sequence.stop} alone"
    known = {entry.name: entry.frames for entry in manifests.manifest(dataset).sequences}
    whole = known.get(job.sequence.name.rpartition("/")[2])
    return f"{frames} of {whole} frames" if whole and frames and frames < whole else ""
