"""``p2p benchmark`` and notebook 09: a benchmark's tables in the paper's arrangements.

Ours are exact areas under the curve over 0 to 0.1 m, aligned at the first scored frame, frames without a pose counted
as 0, mean over seeds ± their standard deviation; every other form is in the benchmark's ``results.csv``. Bold is the
best among methods without a CAD model, of those that ran on the whole of what the paper ran on: no re-creation did.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pandas import DataFrame
from scipy import stats

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.outcome import Outcome
from p2p_lib.benchmark.plan import Method
from p2p_lib.benchmark.rows import AREAS, MEAN, POOLED, Row, shown_name
from p2p_lib.core.files import replace_text
from p2p_lib.datasets import manifests
from p2p_lib.datasets.paper_reported import FAIL, paper_reported
from p2p_lib.datasets.paper_reported import Table as Reported
from p2p_lib.datasets.sequence import SYNTHETIC
from p2p_lib.evaluation import metrics
from p2p_lib.figures.tables import Cell, Table, emboldened, number

#: The paper's metrics: what the benchmark calls them, their head, and whether more is better.
METRICS = {
    "adds_auc": ("ADD-S AUC", "ADD-S (%)", True),
    "add_auc": ("ADD AUC", "ADD (%)", True),
    "chamfer_cm": ("Chamfer distance", "CD (cm)", False),
}
_AREAS = ("adds_auc", "add_auc")
_AREA_HEADS = [METRICS[key][1] for key in _AREAS]
_HOW = "Ours: exact area under the curve, aligned at the first scored frame, frames without a pose count as 0"
_REPORTED = "(reported): as the paper prints it, on its own files, masks and machine"
_NOT_IN_PAPER = Cell(note="not in the paper")


def paper_table(benchmark: Benchmark) -> Table:
    """The table of a benchmark, arranged as its plan's ``kind`` says."""
    return KINDS[benchmark.plan.kind](Numbers(benchmark))


def write_table(benchmark: Benchmark) -> str:
    """``table.md``, ``table.tex`` and ``table.csv`` into the benchmark's folder; gives the first."""
    table = paper_table(benchmark)
    files = table.files()
    for suffix, text in files.items():
        replace_text(benchmark.folder / f"table{suffix}", text)
    return files[".md"]


class Numbers:
    """The summary of a benchmark, looked up by what a cell is of: failures count as 0, aligned at the first frame."""

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
        return self.missing(method, sequence) if row is None else number(row["value"], row.get("std"))

    def mean(self, method: Method, metric: str) -> Cell:
        """The mean over sequences, and how many these are of; where nothing ran, the reason that the first gave."""
        of = [(j, o) for j, o in self.benchmark.results if j.method.name == method.name and j.measure == "poses"]
        planned = {shown_name(job) for job, _ in of}
        ran = {shown_name(job) for job, outcome in of if outcome.status != "not run"}
        if self.row(method.name, metric, MEAN) is None:
            return self.missing(method.name, shown_name(of[0][0]))
        note = f"{len(ran)} of {len(planned)} sequences" if len(ran) < len(planned) else ""
        return replace(self.cell(method.name, metric, MEAN), note=note)

    def missing(self, method: str, sequence: str) -> Cell:
        """A dash, or ``fail``, with the reason that the run gave."""
        for job, outcome in self.benchmark.results:
            if job.method.name == method and shown_name(job) == sequence and outcome.status != "done":
                return Cell(FAIL if outcome.status == "failed" else "-", note=outcome.reason.rstrip("."))
        return self.not_planned()

    def not_planned(self) -> Cell:
        """A dash for what no run of the plan could give."""
        return Cell(note="no run of the plan is of this" if self.judges else "the quick form runs bundled data alone")

    def notes(self) -> list[str]:
        """What is to be said of every number of ours, and of those that the paper reports."""
        seeds = ", ".join(map(str, self.seeds))
        spread = f"mean ± standard deviation over seeds {seeds}" if len(self.seeds) > 1 else f"seed {seeds} alone"
        scored = f"frames with less than {self.plan.min_mask_px} pixels of an object's mask are not scored"
        reported = [_REPORTED] if self.plan.paper else []
        return [f"{_HOW}; {scored}; {spread}", *self.of_the_plan(), self.what_ran(), *reported]

    def of_the_plan(self) -> list[str]:
        """What the plan itself has to say below its table."""
        return [self.plan.note] if self.plan.note else []

    def what_ran(self) -> str:
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
    rows, rules = [], []
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
    rows, rules, last = [], [], ""
    for column, (sequence, object) in labels.items():
        if sequence != last and rows:
            rules.append(len(rows))
        about = [Cell(sequence if sequence != last else ""), Cell(object)]
        rows.append(about + [line.cells[column] for line in lines])
        last = sequence
    groups = [("", 2), *((METRICS[metric][1], len(group)) for metric, group in found.items())]
    heads = ["Category", "Object", *(line.name + ", CAD" * (line.setting == "CAD") for line in lines)]
    return Table(numbers.plan.title, heads, rows, groups, words=2, rules=rules, notes=numbers.notes())


def _columns(paper: Reported) -> dict[str, tuple[str, str]]:
    """Column to the sequence and the object that it is of."""
    return {f"{c.sequence} {c.object}".strip(): (c.sequence, c.object) for c in paper.columns}


def _metrics(numbers: Numbers, paper: Reported) -> list[str]:
    printed = {row.metric for row in paper.rows}
    return [metric for metric in METRICS if metric in printed and (metric in _AREAS or numbers.plan.chamfer)]


def _places(numbers: Numbers, method: str = "") -> dict[str, tuple[Job, str]]:
    """Column to the first job (of a method) and object that fill it; one that did not run fills those of its plan."""
    places: dict[str, tuple[Job, str]] = {}
    for job, outcome in (at for at in numbers.benchmark.results if method in ("", at[0].method.name)):
        names = list(outcome.objects) or list(job.sequence.columns) or job.sequence.objects or [""]
        for name in names:
            own = shown_name(job) + (f" {name}" if len(names) > 1 else "")
            column = job.sequence.column_of(name) or own
            # One that has run knows its objects, one that has not may not.
            if column not in places or (name and not places[column][1]):
                places[column] = job, name
    return places


def _own_columns(numbers: Numbers, paper: Reported) -> dict[str, tuple[str, str]]:
    """The same of ours that the paper does not have."""
    known, places = _columns(paper), _places(numbers).items()
    return {column: (shown_name(job), name) for column, (job, name) in places if column not in known}


def _lines(numbers: Numbers, paper: Reported, metric: str) -> list[_Line]:
    """All methods of a metric, the reported ones first, with the best in bold."""
    lines = [_reported_line(paper, row) for row in paper.rows if row.metric == metric]
    for method in numbers.methods:
        for form in ("exact",) if metric in _AREAS else ("BundleSDF", "release"):
            lines.append(_our_line(numbers, paper, metric, form, method))
    for column in (*_columns(paper), "Mean"):
        compared = [line for line in lines if column in line.comparable]
        best = emboldened([line.cells[column] for line in compared], METRICS[metric][2])
        for line, cell in zip(compared, best, strict=True):
            line.cells[column] = cell
    return lines


def _reported_line(paper: Reported, row: object) -> _Line:
    columns = _columns(paper)
    cells = [Cell(FAIL) if value == FAIL else number(float(value)) for value in row.values]
    name = "Point2Pose" if row.method == "Ours" else row.method
    comparable = set() if row.cad else {*columns, "Mean"}
    cells = defaultdict(lambda: _NOT_IN_PAPER, zip(columns, cells, strict=True), Mean=number(row.mean))
    return _Line("CAD" if row.cad else "CAD-free", f"{name} (reported)", cells, comparable)


def _our_line(numbers: Numbers, paper: Reported, metric: str, form: str, method: Method) -> _Line:
    columns, cells, whole, same = _columns(paper), defaultdict(numbers.not_planned), set(), set()
    frames = {shown_name(j): o.ran.get("frames") for j, o in numbers.benchmark.results if j.method.name == method.name}
    for column, (job, name) in _places(numbers, method.name).items():
        cells[column] = numbers.cell(method.name, METRICS[metric][0], shown_name(job), name, form)
        if column in columns:
            part = _part(job, frames.get(shown_name(job)), paper.dataset)
            ran, recreated = cells[column].text != "-", job.sequence.name.startswith(SYNTHETIC)
            whole |= {column} if ran and not part else set()
            same |= {column} if ran and not part and not recreated else set()
            said = part or ("re-created, not the paper's files" if recreated and ran else "")
            cells[column] = replace(cells[column], note=cells[column].note or said)
    cells["Mean"] = numbers.cell(method.name, METRICS[metric][0], MEAN, "", form)
    if len(whole) < len(columns):
        values = [float(cells[column].text.partition(" ")[0]) for column in whole if cells[column].text != FAIL]
        count = f"{len(whole)} of the table's {len(columns)} columns"
        some = f"of {count}, which were run in whole" if whole else f"{count} were run in whole"
        cells["Mean"] = replace(number(float(np.mean(values)) if values else None), note=some)
    name = method.name if metric in _AREAS else f"{method.name}, {form}'s form"
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
    heads, groups = ["Method"], [("", 1), ("Ours", 4)]
    heads += [head for area in _AREA_HEADS for head in (area, "std over sequences")]
    bold = [1, 3] if numbers.judges else []
    if numbers.plan.tracks:
        names = ("AJ", "delta_avg", "OA", "found again")
        heads, groups = [*heads, *names], [*groups, ("2D tracks, fractions", len(names))]
        for line, method in zip(lines, numbers.methods, strict=True):
            line += [_track_score(numbers, method, name) for name in names]
    if numbers.plan.paper:
        bold += [len(heads), len(heads) + 1]
        heads, groups = [*heads, *_AREA_HEADS], [*groups, ("reported", len(_AREAS))]
        printed = {(r.method, r.metric): r.mean for r in paper_reported().table(numbers.plan.paper).rows}
        for line, method in zip(lines, numbers.methods, strict=True):
            values = [printed.get((method.paper, metric)) for metric in _AREAS]
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
        values = {s.key: s.value for s in paper.text if s.of == method.paper}
        if "recovered_events" in values:
            line.append(Cell(f"{values['recovered_events']:g}/{events:g}"))
            line += [number(values[f"mustard_{metric}"]) for metric in _AREAS]
        else:
            line += [_NOT_IN_PAPER] * 3
        lines.append(line)
    within = f"recovered within {paper.statement('recovered_within').value:g} frames"
    groups = [("", 1), ("Ours", 3), ("reported, YCBMultiTrack-Real", 3)]
    notes = [*numbers.notes(), "Returns are counted over all sequences and seeds"]
    return Table(numbers.plan.title, ["Method", *[within, *_AREA_HEADS] * 2], lines, groups, notes=notes)


def by_rate(numbers: Numbers) -> Table:
    """Frames per second and milliseconds a stage, by number of tracks, of objects, and resolution."""
    times = DataFrame(numbers.benchmark.times, columns=["method", "metric", "value"])
    found = times.groupby(["method", "metric"], sort=False).value.mean()
    stages = [metric for metric in times.metric.unique() if metric.startswith("stage ")]
    heads = {"rate": "rate (Hz)", "95th percentile": "95 % within (ms)"}
    heads |= {stage: stage.removeprefix("stage ") + " (ms)" for stage in stages}
    heads |= {"processor time, files included": "processor, files included (ms)"}
    lines = [
        [Cell(method.name), *(number(found.get((method.name, metric)), digits=1) for metric in heads)]
        for method in numbers.methods
    ]
    reported = paper_reported().statement("rate").value
    notes = [f"The paper reports {reported[0]:g} to {reported[1]:g} Hz, on its machine", numbers.what_ran()]
    notes += ["Wall-clock on this machine under the load that it had; processor time does not depend on the load"]
    return Table(numbers.plan.title, ["Setting", *heads.values()], lines, notes=notes)


def by_run(numbers: Numbers) -> Table:
    """A row per method and sequence, means over objects: both alignments, frames lost, returns, rate."""
    done: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for job, outcome in numbers.benchmark.results:
        done[job.method.name, shown_name(job)] += [outcome] if outcome.objects else []
    times = DataFrame(numbers.benchmark.times, columns=["method", "sequence", "metric", "value"])
    hz = times[times.metric == "rate"].groupby(["method", "sequence"]).value.mean()
    lines = []
    for at, outcomes in done.items():
        cells = _run_cells(outcomes) if outcomes else [numbers.missing(*at)] * 6
        rate = [number(hz[at], digits=1) if at in hz else numbers.missing(*at)] * numbers.judges
        lines.append([Cell(at[0]), Cell(at[1]), *cells, *rate])
    heads = [
        "Method",
        "Sequence",
        *_AREA_HEADS,
        *_AREA_HEADS,
        "frames lost",
        "returns",
        *["rate (Hz)"] * numbers.judges,
    ]
    groups = [("", 2), ("aligned at the first frame", 2), ("one constant over all", 2), ("", 2 + numbers.judges)]
    over = f"Mean over objects and seeds {', '.join(map(str, numbers.seeds))}"
    over += ", in brackets the lowest and the highest" * (len(numbers.seeds) > 1)
    how = (
        "Exact area under the curve, frames without a pose count as 0; returns after complete occlusion or out of view"
    )
    how += ", of all seeds: how many were found again, and after how many scored frames"
    how += "; the rate is this machine's, under its load" * numbers.judges
    return Table(
        numbers.plan.title, heads, lines, groups, words=2, notes=[over, how, *numbers.of_the_plan(), numbers.what_ran()]
    )


def by_grid(numbers: Numbers) -> Table:
    """A row per sequence, a column per method: both areas and the frames lost, means over objects and seeds."""
    done: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for job, outcome in numbers.benchmark.results:
        done[shown_name(job), job.method.name] += [outcome] if outcome.objects else []
    scenes, methods = list(dict.fromkeys(s for s, _ in done)), [method.name for method in numbers.methods]
    found = {at: np.mean([_areas_and_lost(o) for o in outcomes], 0) for at, outcomes in done.items() if outcomes}
    whole = [scene for scene in scenes if all((scene, method) in found for method in methods)]
    lines = []
    for scene in scenes:
        cells = [found.get((scene, method)) for method in methods]
        shown = [numbers.missing(method, scene) if c is None else _three(c) for c, method in zip(cells, methods)]
        lines.append([Cell(scene.removeprefix(SYNTHETIC)), *shown])
    if whole:
        means = [np.mean([found[scene, method] for scene in whole], 0) for method in methods]
        lines.append([Cell(f"mean of {len(whole)}"), *map(_three, means)])
    presets = [method.name.partition(", ")[0] for method in numbers.methods]
    groups = [("", 1), *((preset, presets.count(preset)) for preset in dict.fromkeys(presets))]
    heads = ["Sequence", *(name.partition(", ")[2] for name in methods)]
    notes = ["ADD-S / ADD area under the curve (%), in brackets frames lost of all objects; the mean is over sequences"]
    notes[0] += " on which every method ran"
    rules = [len(scenes)] if whole else []
    return Table(numbers.plan.title, heads, lines, groups, rules=rules, notes=[*notes, *numbers.notes()])


def _areas_and_lost(outcome: Outcome) -> list[float]:
    """Of one run: ADD-S and ADD areas, means over objects, and how many frames had no pose."""
    errors = [obj.errors_m("first") for obj in outcome.objects.values()]
    areas = [float(np.mean([metrics.auc_exact(e[key]) for e in errors])) for key in ("adds_m", "add_m")]
    return [*areas, sum(obj.lost for obj in outcome.objects.values())]


def _three(values: np.ndarray) -> Cell:
    return Cell("{:.1f} / {:.1f} ({:.0f})".format(*values))


def by_pair(numbers: Numbers) -> Table:
    """What each component is worth to whom: the areas with it less those without, run against run."""
    areas: dict[str, dict[tuple[str, int], np.ndarray]] = defaultdict(dict)
    for job, outcome in numbers.benchmark.results:
        if outcome.objects:
            errors = [obj.errors_m("first") for obj in outcome.objects.values()]
            both = [np.mean([metrics.auc_exact(of[key]) for of in errors]) for key in AREAS.values()]
            areas[job.method.name][shown_name(job), job.seed] = np.array(both)
    scenes = list(dict.fromkeys(scene for runs in areas.values() for scene, _ in runs))
    lines, rules = [], []
    for method in numbers.methods:
        own, base = areas[method.name], areas[method.against or method.name]
        if not method.against:
            rules += [len(lines)] if lines else []
            levels = [[own[at] for at in own if scene in ("", at[0])] for scene in ("", *scenes)]
            means = [np.mean(level, axis=0) if level else [None, None] for level in levels]
            cells = [number(v, digits=1) for v in means[0]] + [number(mean[1], digits=1) for mean in means[1:]]
            lines.append([Cell(method.name), Cell("with all"), Cell(str(len(own))), *cells])
            continue
        worth = {at: base[at] - own[at] for at in own if at in base}
        cells = [_interval([w[k] for w in worth.values()], numbers.judges) for k in range(2)]
        cells += [_interval([w[1] for at, w in worth.items() if at[0] == scene], numbers.judges) for scene in scenes]
        name = method.name.removeprefix(method.against).lstrip(", ")
        lines.append([Cell(""), Cell(name), Cell(str(len(worth))), *cells])
    heads = ["2D tracker", "component", "runs", *_AREA_HEADS, *(scene.removeprefix(SYNTHETIC) for scene in scenes)]
    groups = [("", 3), ("over all runs", 2), ("ADD (%) by scene", len(scenes))]
    how = "First line of a tracker: its areas under the curve. Below: with the component less without it, in points, "
    how += "and the 95 % interval of the mean by bootstrap over runs; bold where that leaves out 0"
    notes = [how, numbers.what_ran()]
    return Table(numbers.plan.title, heads, lines, groups, words=2, rules=rules, notes=notes)


def by_fault(numbers: Numbers) -> Table:
    """A row per method and fault, over sequences, seeds and objects: failed runs, lies, what is left behind."""
    found: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for job, outcome in numbers.benchmark.results:
        found[job.method.name, job.sequence.fault.shown if job.sequence.fault else "-"].append(outcome)
    lines = []
    for (method, fault), outcomes in found.items():
        scores = DataFrame([obj.fault for outcome in outcomes for obj in outcome.objects.values() if obj.fault])
        runs = sum(outcome.status != "not run" for outcome in outcomes)
        about = [Cell(method)] * (len(numbers.methods) > 1) + [Cell(fault), Cell(str(runs))]
        if scores.empty:
            lines.append([*about, *[Cell(note=outcomes[0].reason.rstrip("."))] * 8])
            continue
        lies = [scores.frames.sum(), scores.lies_in.sum(), scores.lies_after.sum(), scores.longest.max()]
        off = 100 * scores.mesh_off
        cells = [sum(outcome.status == "failed" for outcome in outcomes), *map(int, lies)]
        again = [f"{x:g}" if np.isfinite(x) else "never" for x in (scores.until_good.median(), scores.until_good.max())]
        lines.append([*about, *(Cell(str(c)) for c in (*cells, *again)), number(off.mean(), digits=1)])
    heads = ["Method"] * (len(numbers.methods) > 1) + ["Fault", "runs", "failed", "frames", "lies in it", "lies after"]
    heads += ["longest", "good again", "worst", "mesh off (%)"]
    notes = ["Frames of all objects since a fault began. Lies: confidence above 0.5, ADD above 5 cm; longest stretch"]
    notes += ["Good again: frames in view after the fault's end until ADD < 2 cm, median and worst over objects"]
    notes += ["Mesh off: vertices more than 1 cm off the true surface at the end of the run", numbers.what_ran()]
    return Table(numbers.plan.title, heads, lines, words=len(heads) - 9, notes=notes)


#: Of fewer differences the bootstrap's interval is too narrow to call one proven.
_ENOUGH = 8


def _interval(values: list[float], judges: bool) -> Cell:
    """The mean of differences with its 95 % bootstrap interval; bold where that leaves out 0."""
    if not values:
        return Cell(note="not run")
    if len(values) < 3:
        return Cell(f"{np.mean(values):+.1f}")
    how = {"n_resamples": 2000, "method": "percentile", "rng": np.random.default_rng(0)}
    low, high = stats.bootstrap((np.array(values),), np.mean, **how).confidence_interval
    proven = judges and len(values) >= _ENOUGH and (low > 0 or high < 0)
    return Cell(f"{np.mean(values):+.1f} [{low:+.1f}, {high:+.1f}]", bold=bool(proven))


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
    rows = [numbers.row(method.name, "returns", POOLED, form=form) for form in forms]
    if None in rows:
        return numbers.mean(method, "ADD AUC")
    return Cell("/".join(str(round(row["value"] * len(row["seeds"].split()))) for row in rows))


def _run_cells(outcomes: list[Outcome]) -> list[Cell]:
    """The areas under the curve, frames lost and returns of one method on one sequence with several seeds."""
    cells = []
    for align in ("first", "all"):
        for key in ("adds_m", "add_m"):
            areas = [np.mean([metrics.auc_exact(x.errors_m(align)[key]) for x in o.objects.values()]) for o in outcomes]
            spread = f" ({min(areas):.1f} to {max(areas):.1f})" if len(areas) > 1 else ""
            cells.append(Cell(f"{np.mean(areas):.1f}{spread}"))
    lost = [sum(obj.lost for obj in o.objects.values()) for o in outcomes]
    frames = sum(len(obj.first["add_m"]) for obj in outcomes[0].objects.values())
    cells.append(Cell(f"{_range(lost)} of {frames}"))
    after = [frames for o in outcomes for obj in o.objects.values() for frames in obj.returns]
    found = [frames for frames in after if frames is not None]
    again = f"{len(found)} of {len(after)}" if after else "none"
    return [*cells, Cell(f"{again} after {_range(found)} frames" if found else again)]


def _range(values: list[int]) -> str:
    return f"{min(values)}{f' to {max(values)}' * (max(values) > min(values))}"
