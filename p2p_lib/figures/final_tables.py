"""``p2p benchmark`` and notebook 09: a benchmark's tables in the paper's arrangements.

Ours are exact areas under the curve over 0 to 0.1 m, aligned at the first scored frame, frames without a pose counted
as 0, mean over seeds ± their standard deviation; every other form is in the benchmark's ``results.csv``. Bold is the
best among methods without a CAD model, of those that ran on the whole of what the paper ran on: no re-creation did.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pandas import DataFrame

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.plan import Method
from p2p_lib.benchmark.rows import MEAN, POOLED, shown_name
from p2p_lib.core.files import replace_text
from p2p_lib.datasets import manifests
from p2p_lib.datasets.paper_reported import FAIL, ReportedTable, Row, paper_reported
from p2p_lib.datasets.sequence import SYNTHETIC
from p2p_lib.figures.numbers import AREA_HEADS, AREA_KEYS, METRICS, Numbers, is_whole_dataset
from p2p_lib.figures.run_tables import by_fault, by_grid, by_pair, by_run
from p2p_lib.figures.tables import Cell, Table, emboldened, number

_QUICK = "quick profile: a few frames of bundled data, which show that it runs and are no result"
_NOT_IN_PAPER = Cell(note="not in the paper")


def paper_table(benchmark: Benchmark) -> Table:
    """The table of a benchmark, arranged as its plan's ``kind`` says; the title of a quick one says what it is."""
    table = KINDS[benchmark.plan.kind](Numbers(benchmark))
    return replace(table, title=f"{table.title} ({_QUICK})") if benchmark.profile == "quick" else table


def write_table(benchmark: Benchmark) -> str:
    """``table.md``, ``table.tex`` and ``table.csv`` into the benchmark's folder; gives the first."""
    table = paper_table(benchmark)
    files = table.files()
    for suffix, text in files.items():
        replace_text(benchmark.folder / f"table{suffix}", text)
    return files[".md"]


# --- the paper's two arrangements of its datasets, with its columns and ours -----------------------


@dataclass
class _Line:
    """One method's numbers of one metric.

    cells       by column, with what stands in all others
    comparable  columns in which it ran on what the paper ran on, without a CAD model
    """

    setting: str
    name: str
    cells: defaultdict[str, Cell]
    comparable: set[str]


def by_sequence(numbers: Numbers) -> Table:
    """A column per sequence, metrics and methods below each other: the paper's tables on HO3D and YCBInEOAT."""
    paper = paper_reported().table(numbers.plan.paper)
    columns = [*_columns(paper), "Mean", *_own_columns(numbers, paper)]
    rows: list[list[Cell]] = []
    rules: list[int] = []
    for metric in _metrics(numbers, paper):
        rules.append(len(rows))
        for line in _lines(numbers, paper, metric):
            about = [Cell(METRICS[metric][1]), Cell(line.setting), Cell(line.name)]
            rows.append(about + [line.cells[column] for column in columns])
    heads = ["Metric", "Setting", "Method", *columns]
    return Table(numbers.plan.title, heads, rows, words=3, rules=rules[1:], notes=numbers.notes())


def by_object(numbers: Numbers) -> Table:
    """A row per object, methods beside each other: the paper's tables on YCBMultiTrack."""
    paper = paper_reported().table(numbers.plan.paper)
    found = {metric: _lines(numbers, paper, metric) for metric in _metrics(numbers, paper)}
    lines = [line for group in found.values() for line in group]
    labels = _columns(paper) | _own_columns(numbers, paper) | {"Mean": ("Mean", "")}
    rows: list[list[Cell]] = []
    rules: list[int] = []
    last = ""
    for column, (sequence, object) in labels.items():
        if sequence != last and rows:
            rules.append(len(rows))
        about = [Cell(sequence if sequence != last else ""), Cell(object)]
        rows.append(about + [line.cells[column] for line in lines])
        last = sequence
    groups = [("", 2), *((METRICS[metric][1], len(group)) for metric, group in found.items())]
    heads = ["Category", "Object", *(line.name + ", CAD" * (line.setting == "CAD") for line in lines)]
    return Table(numbers.plan.title, heads, rows, groups, words=2, rules=rules, notes=numbers.notes())


def _columns(paper: ReportedTable) -> dict[str, tuple[str, str]]:
    """Column to the sequence and the object that it is of."""
    return {f"{c.sequence} {c.object}".strip(): (c.sequence, c.object) for c in paper.columns}


def _metrics(numbers: Numbers, paper: ReportedTable) -> list[str]:
    printed = {row.metric for row in paper.rows}
    return [metric for metric in METRICS if metric in printed and (metric in AREA_KEYS or numbers.plan.chamfer)]


def _places(numbers: Numbers, method: str = "") -> dict[str, tuple[Job, str]]:
    """Column to the first job (of a method) and object that fill it; one that did not run fills those of its plan.

    Which columns a dataset fills that is not there, nobody knows: it has none, and is the reason of every dash.
    """
    places: dict[str, tuple[Job, str]] = {}
    for job, outcome in numbers.benchmark.results:
        if method not in ("", job.method.name) or is_whole_dataset(job):
            continue
        names = list(outcome.objects) or list(job.sequence.columns) or job.sequence.objects or [""]
        for name in names:
            own = shown_name(job) + (f" {name}" if len(names) > 1 else "")
            column = job.sequence.column_of(name) or own
            # One that has run knows its objects, one that has not may not.
            if column not in places or (name and not places[column][1]):
                places[column] = job, name
    return places


def _own_columns(numbers: Numbers, paper: ReportedTable) -> dict[str, tuple[str, str]]:
    """The same of ours that the paper does not have."""
    known, places = _columns(paper), _places(numbers).items()
    return {column: (shown_name(job), name) for column, (job, name) in places if column not in known}


def _lines(numbers: Numbers, paper: ReportedTable, metric: str) -> list[_Line]:
    """All methods of a metric, the reported ones first, with the best in bold."""
    lines = [_reported_line(paper, row) for row in paper.rows if row.metric == metric]
    for method in numbers.methods:
        for form in ("exact",) if metric in AREA_KEYS else ("BundleSDF", "release"):
            lines.append(_our_line(numbers, paper, metric, form, method))
    for column in (*_columns(paper), "Mean"):
        compared = [line for line in lines if column in line.comparable]
        best = emboldened([line.cells[column] for line in compared], METRICS[metric][2])
        for line, cell in zip(compared, best, strict=True):
            line.cells[column] = cell
    return lines


def _reported_line(paper: ReportedTable, row: Row) -> _Line:
    columns = _columns(paper)
    printed = [Cell(FAIL) if value == FAIL else number(float(value)) for value in row.values]
    name = "Point2Pose" if row.method == "Ours" else row.method
    comparable = set() if row.cad else {*columns, "Mean"}
    cells = defaultdict(lambda: _NOT_IN_PAPER, zip(columns, printed, strict=True), Mean=number(row.mean))
    return _Line("CAD" if row.cad else "CAD-free", f"{name} (reported)", cells, comparable)


def _our_line(numbers: Numbers, paper: ReportedTable, metric: str, form: str, method: Method) -> _Line:
    absent = numbers.not_planned(method.name)
    columns, cells, whole, same = _columns(paper), defaultdict(lambda: absent), set(), set()
    frames = {shown_name(j): o.ran.get("frames") for j, o in numbers.benchmark.results if j.method.name == method.name}
    for column, (job, name) in _places(numbers, method.name).items():
        cells[column] = numbers.cell(method.name, METRICS[metric][0], shown_name(job), name, form)
        if column in columns:
            part = _part(job, frames.get(shown_name(job)), paper.dataset)
            ran, recreated = cells[column].text != "-", job.sequence.name.startswith(SYNTHETIC)
            whole |= {column} if ran and not part else set()
            same |= {column} if ran and not part and not recreated else set()
            note = part or ("re-created, not the paper's files" if recreated and ran else "")
            cells[column] = replace(cells[column], note=cells[column].note or note)
    besides = {column for column, cell in cells.items() if column not in columns and cell.text != "-"}
    cells["Mean"] = numbers.cell(method.name, METRICS[metric][0], MEAN, "", form)
    if len(whole) < len(columns):
        texts = [cells[column].text for column in whole | besides]
        values = [float(text.partition(" ")[0]) for text in texts if text != FAIL]
        count = f"{len(whole)} of the table's {len(columns)} columns"
        some = f"of {count}, which were run in whole" if whole else f"{count} were run in whole"
        some += f"; {len(besides)} more that no column is named for are in the mean" if besides else ""
        cells["Mean"] = replace(number(float(np.mean(values)) if values else None), note=some)
    name = method.name if metric in AREA_KEYS else f"{method.name}, {form}'s form"
    comparable = {*same, "Mean"} if len(same) == len(columns) else same
    return _Line("CAD-free", name, cells, comparable)


def _part(job: Job, frames: int | None, dataset: str) -> str:
    """What a run leaves out of the sequence that the paper's number is of, "" where nothing."""
    if job.sequence.start or job.sequence.stop is not None:
        return f"frames {job.sequence.start} to {job.sequence.stop} alone"
    known = {entry.name: entry.frames for entry in manifests.manifest(dataset).sequences}
    whole = known.get(job.sequence.name.rpartition("/")[2])
    return f"{frames} of {whole} frames" if whole and frames and frames < whole else ""


# --- methods against each other --------------------------------------------------------------------


def by_method(numbers: Numbers) -> Table:
    """A row per method, with the spread over sequences: the paper's ablations, and the comparison of trackers."""
    lines = [[Cell(method.name), *_areas(numbers, method)] for method in numbers.methods]
    heads, groups = ["Method"], [("", 1), ("Ours" if numbers.plan.paper else "measured", 4)]
    heads += [head for area in AREA_HEADS for head in (area, "std over sequences")]
    bold = [1, 3] if numbers.judges else []
    if numbers.plan.tracks:
        names = ("AJ", "delta_avg", "OA", "found again")
        heads, groups = [*heads, *names], [*groups, ("2D tracks, fractions", len(names))]
        for line, method in zip(lines, numbers.methods, strict=True):
            line += [_track_score(numbers, method, name) for name in names]
    if numbers.plan.paper:
        bold += [len(heads), len(heads) + 1]
        heads, groups = [*heads, *AREA_HEADS], [*groups, ("reported", len(AREA_KEYS))]
        printed: dict[tuple[str, str], float] = {
            (r.method, r.metric): r.mean for r in paper_reported().table(numbers.plan.paper).rows
        }
        for line, method in zip(lines, numbers.methods, strict=True):
            values = [printed.get((method.paper, metric)) for metric in AREA_KEYS]
            line += [number(value) if value else _NOT_IN_PAPER for value in values]
    for column in bold:
        for line, cell in zip(lines, emboldened([line[column] for line in lines], True), strict=True):
            line[column] = cell
    return Table(numbers.plan.title, heads, lines, groups, notes=numbers.notes())


def by_return(numbers: Numbers) -> Table:
    """Long-range against short-horizon tracking: returns after complete occlusion, and what they do to the areas."""
    paper, lines = paper_reported(), []
    events = paper.statement("occlusion_events").value
    for method in numbers.methods:
        line = [Cell(method.name), _returns(numbers, method), *_areas(numbers, method)[::2]]
        values: dict[str, Any] = {s.key: s.value for s in paper.text if s.of == method.paper}
        if "recovered_events" in values:
            line.append(Cell(f"{values['recovered_events']:g}/{events:g}"))
            line += [number(values[f"mustard_{metric}"]) for metric in AREA_KEYS]
        else:
            line += [_NOT_IN_PAPER] * 3
        lines.append(line)
    within = f"recovered within {paper.statement('recovered_within').value:g} frames"
    groups = [("", 1), ("Ours", 3), ("reported, YCBMultiTrack-Real", 3)]
    notes = [*numbers.notes(), "Returns are counted over all sequences and seeds"]
    return Table(numbers.plan.title, ["Method", *[within, *AREA_HEADS] * 2], lines, groups, notes=notes)


def by_rate(numbers: Numbers) -> Table:
    """Frames per second and milliseconds a stage, by number of tracks, of objects, and resolution."""
    times = DataFrame(numbers.benchmark.times, columns=["method", "metric", "value"])
    found = times.groupby(["method", "metric"], sort=False).value.mean()
    stages = [metric for metric in times.metric.unique() if metric.startswith("stage ")]
    heads = {"rate": "rate (Hz)", "95th percentile": "95 % within (ms)"}
    heads |= {stage: stage.removeprefix("stage ") + " (ms)" for stage in stages}
    heads |= {"processor time, files included": "processor, files included (ms)"}
    lines = []
    for method in numbers.methods:
        absent = Cell(note="its runs have no such time") if method.name in found else numbers.nothing_ran(method)
        values = [found.get((method.name, metric), np.nan) for metric in heads]
        lines.append([Cell(method.name), *(absent if np.isnan(value) else number(value, digits=1) for value in values)])
    reported: Any = paper_reported().statement("rate").value  # from and to
    notes = [f"The paper reports {reported[0]:g} to {reported[1]:g} Hz, on its machine", *numbers.about()]
    notes += [
        "Rate: frames by the time that the tracker took for them, without the first two, in which loops are compiled; "
        "of these frames 95 % took no longer than the next column says; a stage: mean over all frames, those two "
        "included, so stages can add up to more than a frame; all: means over seeds",
        "Mapping (the graph's solution, the fusion) runs in two threads beside the stages; graph and fusion are what a "
        "frame waited for it, and its work is in the processor time",
    ]
    notes += ["Wall-clock on this machine under the load that it had; processor time does not depend on the load"]
    return Table(numbers.plan.title, ["Setting", *heads.values()], lines, notes=notes)


#: Arrangements by the ``kind`` of a plan.
KINDS: dict[str, Callable[[Numbers], Table]] = {
    "sequences": by_sequence,
    "objects": by_object,
    "methods": by_method,
    "returns": by_return,
    "rates": by_rate,
    "runs": by_run,
    "grid": by_grid,
    "pairs": by_pair,
    "faults": by_fault,
}


def _areas(numbers: Numbers, method: Method) -> list[Cell]:
    """Both areas with their standard deviations over sequences."""
    cells = []
    for name in ("ADD-S AUC", "ADD AUC"):
        about = [method.name, name, "exact"]
        values = [row["value"] for (*of, _, object), row in numbers.by_cell.items() if of == about and object]
        spread = number(float(np.std(values, ddof=1))) if len(values) > 1 else Cell(note="of fewer than two sequences")
        cells += [numbers.mean(method, name), spread]
    return cells


def _track_score(numbers: Numbers, method: Method, score: str) -> Cell:
    results = numbers.benchmark.results
    of = [o for job, o in results if job.method.name == method.name and job.measure == "tracks"]
    values = [outcome.tracks[score] for outcome in of if outcome.tracks]
    if values:
        return number(float(np.mean(values)), digits=3)
    return Cell(note=of[0].reason.rstrip(".") if of else "scored in the full form alone")


def _returns(numbers: Numbers, method: Method) -> Cell:
    """Recovered of all returns, summed over seeds."""
    forms = ("recovered within 30 frames", "all")
    found = [numbers.row(method.name, "returns", POOLED, form=form) for form in forms]
    rows = [row for row in found if row is not None]
    if len(rows) < len(found):
        return numbers.mean(method, "ADD AUC")
    return Cell("/".join(str(round(row["value"] * len(row["seeds"].split()))) for row in rows))
