"""Tables of a benchmark's runs themselves, seed by seed, and not of their summary: runs, a grid, pairs, faults."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
from pandas import DataFrame
from scipy import stats

from p2p_lib.benchmark.outcome import Outcome
from p2p_lib.benchmark.rows import AREAS, shown_name
from p2p_lib.datasets.sequence import SYNTHETIC
from p2p_lib.evaluation import metrics
from p2p_lib.figures.numbers import AREA_HEADS, Numbers
from p2p_lib.figures.tables import Cell, Table, number


def by_run(numbers: Numbers) -> Table:
    """A row per method and sequence, means over objects: both alignments, frames lost, returns, rate."""
    times = DataFrame(numbers.benchmark.times, columns=["method", "sequence", "metric", "value"])
    hz = times[times.metric == "rate"].groupby(["method", "sequence"]).value.mean()
    lines = []
    for at, outcomes in _scored(numbers).items():
        cells = _run_cells(outcomes) if outcomes else [numbers.missing(*at)] * 6
        if outcomes:
            cells[0] = replace(cells[0], note=numbers.of_fewer(len(outcomes)))
        rate = [number(hz[at], digits=1) if at in hz else numbers.missing(*at)] * numbers.judges
        lines.append([Cell(at[0]), Cell(at[1]), *cells, *rate])
    heads = ["Method", "Sequence", *2 * AREA_HEADS, "frames lost", "returns", *["rate (Hz)"] * numbers.judges]
    groups = [("", 2), ("aligned at the first frame", 2), ("one constant over all", 2), ("", 2 + numbers.judges)]
    over = f"Mean over objects and seeds {', '.join(map(str, numbers.seeds))}"
    over += ", in brackets the lowest and the highest" * (len(numbers.seeds) > 1)
    how = f"Exact area under the curve, frames without a pose count as 0; {numbers.scored()}; returns after complete "
    how += "occlusion or out of view, of all seeds: how many were found again, and after how many scored frames"
    how += "; the rate is this machine's, under its load" * numbers.judges
    return Table(numbers.plan.title, heads, lines, groups, words=2, notes=[over, how, *numbers.about()])


def _run_cells(outcomes: list[Outcome]) -> list[Cell]:
    """The areas under the curve, frames lost and returns of one method on one sequence with several seeds."""
    cells = []
    for areas in np.concatenate([np.transpose([_areas(o, align) for o in outcomes]) for align in ("first", "all")]):
        spread = f" ({min(areas):.1f} to {max(areas):.1f})" if len(areas) > 1 else ""
        cells.append(Cell(f"{np.mean(areas):.1f}{spread}"))
    frames = sum(len(obj.first["add_m"]) for obj in outcomes[0].objects.values())
    cells.append(Cell(f"{_range([_lost(o) for o in outcomes])} of {frames}"))
    after = [frames for o in outcomes for obj in o.objects.values() for frames in obj.returns]
    found = [frames for frames in after if frames is not None]
    again = f"{len(found)} of {len(after)}" if after else "none"
    return [*cells, Cell(f"{again} after {_range(found)} frames" if found else again)]


def _range(values: list[int]) -> str:
    return f"{min(values)}{f' to {max(values)}' * (max(values) > min(values))}"


def by_grid(numbers: Numbers) -> Table:
    """A row per sequence, a column per method: both areas and the frames lost, means over objects and seeds."""
    done, methods = _scored(numbers), [method.name for method in numbers.methods]
    scenes = list(dict.fromkeys(scene for _, scene in done))
    found = {at: np.mean([[*_areas(o), _lost(o)] for o in outcomes], 0) for at, outcomes in done.items() if outcomes}
    lines = []
    for scene in scenes:
        cells = [found.get((method, scene)) for method in methods]
        shown = [numbers.missing(method, scene) if c is None else _three(c) for c, method in zip(cells, methods)]
        lines.append([Cell(scene.removeprefix(SYNTHETIC)), *shown])
    rules = []
    if whole := [scene for scene in scenes if all((method, scene) in found for method in methods)]:
        rules = [len(lines)]
        means = [np.mean([found[method, scene] for scene in whole], 0) for method in methods]
        lines.append([Cell(f"mean of {len(whole)}"), *map(_three, means)])
    presets, _, trackers = zip(*(name.partition(", ") for name in methods))
    groups = [("", 1), *((preset, presets.count(preset)) for preset in dict.fromkeys(presets))]
    how = "ADD-S / ADD area under the curve (%), in brackets frames lost of all objects; the mean is over sequences on "
    how += "which every method ran"
    over = f"mean over seeds {', '.join(map(str, numbers.seeds))}" if len(numbers.seeds) > 1 else "one seed"
    notes = [how, f"{numbers.HOW.capitalize()}; {numbers.scored()}; {over}", *numbers.about()]
    heads = ["Sequence", *(tracker or "built-in" for tracker in trackers)]
    return Table(numbers.plan.title, heads, lines, groups, rules=rules, notes=notes)


def _three(values: np.ndarray) -> Cell:
    return Cell("{:.1f} / {:.1f} ({:.0f})".format(*values))


def by_pair(numbers: Numbers) -> Table:
    """What each component is worth to whom: the areas with it less those without, run against run."""
    areas: dict[str, dict[tuple[str, int], np.ndarray]] = defaultdict(dict)
    for job, outcome in numbers.benchmark.results:
        if outcome.objects:
            areas[job.method.name][shown_name(job), job.seed] = _areas(outcome)
    scenes = list(dict.fromkeys(scene for runs in areas.values() for scene, _ in runs))
    lines: list[list[Cell]] = []
    rules: list[int] = []
    for method in numbers.methods:
        own, base = areas[method.name], areas[method.against or method.name]
        if not method.against:
            rules += [len(lines)] if lines else []
            levels = [[own[at] for at in own if scene in ("", at[0])] for scene in ("", *scenes)]
            means = [np.mean(level, axis=0) if level else [None, None] for level in levels]
            cells = [number(v, digits=1) for v in means[0]] + [number(mean[1], digits=1) for mean in means[1:]]
            absent = numbers.nothing_ran(method)
            cells = [absent if cell.text == Cell().text else cell for cell in cells]
            lines.append([Cell(method.name), Cell("with all"), Cell(str(len(own))), *cells])
            continue
        worth = {at: base[at] - own[at] for at in own if at in base}
        cells = [_interval([w[k] for w in worth.values()], numbers.judges) for k in range(2)]
        cells += [_interval([w[1] for at, w in worth.items() if at[0] == scene], numbers.judges) for scene in scenes]
        name = method.name.removeprefix(method.against).lstrip(", ")
        lines.append([Cell(""), Cell(name), Cell(str(len(worth))), *cells])
    heads = ["Method", "component", "runs", *AREA_HEADS, *(scene.removeprefix(SYNTHETIC) for scene in scenes)]
    groups = [("", 3), ("over all runs", 2), ("ADD (%) by scene", len(scenes))]
    how = "First line of a method: its areas under the curve. Below: with the component less without it, in points, "
    how += "and the 95 % interval of the mean by bootstrap over runs; bold where that leaves out 0"
    notes = [how, numbers.scored().capitalize(), *numbers.about()]
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
    notes += ["Mesh off: vertices more than 1 cm off the true surface at the end of the run", *numbers.about()]
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


def _scored(numbers: Numbers) -> dict[tuple[str, str], list[Outcome]]:
    """Method and sequence to the runs of all seeds that have a score, in the plan's order; an empty list for none."""
    scored: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for job, outcome in numbers.benchmark.results:
        scored[job.method.name, shown_name(job)] += [outcome] if outcome.objects else []
    return scored


def _areas(outcome: Outcome, align: str = "first") -> np.ndarray:
    """(2,) areas under the curve of ADD-S and ADD of one run, means over objects."""
    errors = [obj.errors_m(align) for obj in outcome.objects.values()]
    return np.array([np.mean([metrics.auc_exact(of[key]) for of in errors]) for key in AREAS.values()])


def _lost(outcome: Outcome) -> int:
    """Frames without a pose of one run, of all its objects."""
    return sum(obj.lost for obj in outcome.objects.values())
