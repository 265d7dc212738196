"""Tables of methods against each other: ablations, trackers, returns after occlusion, rates, plain lists of runs."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from p2p_lib.benchmark.outcome import Outcome
from p2p_lib.benchmark.plan import Method
from p2p_lib.benchmark.rows import POOLED, shown_name
from p2p_lib.datasets.paper_reported import paper_reported
from p2p_lib.evaluation import metrics
from p2p_lib.figures.tables import Cell, Table, emboldened, number
from p2p_lib.studies.benchmark_numbers import Numbers

_AREAS = {"adds_auc": ("ADD-S AUC", "ADD-S (%)"), "add_auc": ("ADD AUC", "ADD (%)")}
_NOT_IN_PAPER = "not in the paper"


def by_method(numbers: Numbers) -> Table:
    """A row per method, with the spread over sequences: the paper's ablations, and the comparison of trackers."""
    heads, groups = ["Method"], [("", 1), ("Ours", 4)]
    heads += [head for _, area in _AREAS.values() for head in (area, "std over sequences")]
    lines = [[Cell(_with_detector(numbers, method)), *_areas(numbers, method)] for method in numbers.methods]
    bold = [1, 3] if numbers.judges else []
    if numbers.plan.tracks:
        names = ("AJ", "delta_avg", "OA", "found again")
        heads, groups = [*heads, *names], [*groups, ("2D tracks, shares", len(names))]
        for line, method in zip(lines, numbers.methods, strict=True):
            line += [_track_score(numbers, method, name) for name in names]
    if numbers.plan.paper:
        bold += [len(heads), len(heads) + 1]
        heads, groups = [*heads, *(area for _, area in _AREAS.values())], [*groups, ("reported", len(_AREAS))]
        for line, method in zip(lines, numbers.methods, strict=True):
            line += _reported(numbers, method)
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
        said = {s.key: s.value for s in paper.text if s.of == method.paper}
        if "recovered_events" in said:
            line.append(Cell(f"{said['recovered_events']:g}/{events:g}"))
            line += [number(said[f"mustard_{metric}"]) for metric in _AREAS]
        else:
            line += [Cell(note=_NOT_IN_PAPER)] * 3
        lines.append(line)
    within = f"recovered within {paper.statement('recovered_within').value:g} frames"
    heads = ["Method", *[within, *(area for _, area in _AREAS.values())] * 2]
    groups = [("", 1), ("Ours", 3), ("reported, YCBMultiTrack-Real", 3)]
    said = "Returns are counted over all sequences and seeds"
    return Table(numbers.plan.title, heads, lines, groups, notes=[*numbers.notes(), said])


def by_rate(numbers: Numbers) -> Table:
    """Frames per second and milliseconds a stage, by number of tracks, of objects, and resolution."""
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    for row in numbers.times:
        found[row["method"], row["metric"]].append(row["value"])
    stages = dict.fromkeys(metric for _, metric in found if metric.startswith("stage "))
    heads = {"rate": "rate (Hz)", "95th percentile": "95 % within (ms)"}
    heads |= {stage: stage.removeprefix("stage ") + " (ms)" for stage in stages}
    heads |= {"processor time, files included": "processor, files included (ms)"}
    lines = []
    for method in numbers.methods:
        cells = [number(_mean(found.get((method.name, metric))), digits=1) for metric in heads]
        lines.append([Cell(method.name), *cells])
    reported = paper_reported().statement("rate").value
    notes = [f"The paper reports {reported[0]:g} to {reported[1]:g} Hz, on its machine", numbers.what_ran()]
    notes += ["Wall-clock on this machine under the load that it had; processor time does not depend on the load"]
    return Table(numbers.plan.title, ["Setting", *heads.values()], lines, notes=notes)


def by_run(numbers: Numbers) -> Table:
    """A row per method and sequence, means over objects: both alignments, range over seeds, frames lost, rate."""
    done: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for job, outcome in numbers.benchmark.results:
        found = done[job.method.name, shown_name(job)]
        found += [outcome] if outcome.objects else []
    hz: dict[tuple[str, str], list[float]] = defaultdict(list)
    for row in numbers.times:
        hz[row["method"], row["sequence"]] += [row["value"]] if row["metric"] == "rate" else []
    lines = []
    for at, outcomes in done.items():
        words = [Cell(at[0]), Cell(at[1])]
        cells = _run_cells(outcomes) if outcomes else [numbers.missing(*at)] * 5
        rate = [number(_mean(hz.get(at)), digits=1)] if numbers.judges else []
        lines.append([*words, *cells, *rate])
    heads = ["Method", "Sequence", *["ADD-S (%)", "ADD (%)"] * 2, "frames lost", *["rate (Hz)"] * numbers.judges]
    groups = [("", 2), ("aligned at the first frame", 2), ("one constant over all", 2), ("", 1 + numbers.judges)]
    said = f"Mean over objects and seeds {', '.join(map(str, numbers.seeds))}"
    said += ", in brackets the lowest and the highest" * (len(numbers.seeds) > 1)
    how = "Exact area under the curve, frames without a pose count as 0"
    how += "; the rate is this machine's, under its load" * numbers.judges
    return Table(numbers.plan.title, heads, lines, groups, words=2, notes=[said, how, numbers.what_ran()])


def _with_detector(numbers: Numbers, method: Method) -> str:
    """A method's name, with the detector that ran where the plan leaves a choice."""
    ran = {job.method.name: job.method.detector for job, _ in numbers.benchmark.results}
    return method.name if isinstance(method.detector, str) else f"{method.name} ({ran[method.name]})"


def _areas(numbers: Numbers, method: Method) -> list[Cell]:
    """Both areas with their standard deviations over sequences."""
    cells = []
    for metric, _ in _AREAS.values():
        values = numbers.of_objects(method.name, metric)
        spread = number(float(np.std(values, ddof=1))) if len(values) > 1 else Cell(note="of fewer than two sequences")
        cells += [numbers.mean(method, metric), spread]
    return cells


def _reported(numbers: Numbers, method: Method) -> list[Cell]:
    printed = {(r.method, r.metric): r.mean for r in paper_reported().table(numbers.plan.paper).rows}
    values = [printed.get((method.paper, metric)) for metric in _AREAS]
    return [number(value, note="" if value else _NOT_IN_PAPER) for value in values]


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
    """The areas under the curve and the frames lost of one method on one sequence with several seeds."""
    cells = []
    for align in ("first", "all"):
        for key in ("adds_m", "add_m"):
            areas = [[metrics.auc_exact(obj.errors_m(align)[key]) for obj in o.objects.values()] for o in outcomes]
            cells.append(_range([float(np.mean(area)) for area in areas]))
    lost = [sum(obj.lost for obj in o.objects.values()) for o in outcomes]
    frames = sum(len(obj.first["add_m"]) for obj in outcomes[0].objects.values())
    return [*cells, Cell(f"{min(lost)}{f' to {max(lost)}' * (max(lost) > min(lost))} of {frames}")]


def _range(values: list[float]) -> Cell:
    mean = f"{np.mean(values):.1f}"
    return Cell(mean if len(values) == 1 else f"{mean} ({min(values):.1f} to {max(values):.1f})")


def _mean(values: list[float] | None) -> float | None:
    return float(np.mean(values)) if values else None
