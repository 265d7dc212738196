"""Tidy rows: one number each, with everything that one has to know to compare it with another."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome
from p2p_lib.benchmark.plan import Plan
from p2p_lib.evaluation import numbers
from p2p_lib.evaluation.numbers import Number
from p2p_lib.evaluation.protocol import ALIGNMENTS
from p2p_lib.evaluation.recovery import WITHIN_FRAMES

#: What the ``sequence`` of a row says where it is about several.
MEAN, POOLED = "mean over sequences", "pooled over frames"
#: What MEAN is called where all of it is of one sequence (:func:`p2p_lib.benchmark.scoring.run_rows`).
MEAN_OF_ONE = "mean over objects"
NOT_RUN = "not run"

#: The columns, in order. ``column`` is the paper's; ``key`` names the run's record; ``reason`` why there is no value.
COLUMNS = (
    "plan profile method sequence object column seed metric form failures align value unit frames lost sequences "
    "objects tracker detector masks preset commit modified library key reason"
).split()
TIME_COLUMNS = (
    "plan profile method sequence seed metric value unit objects width_px tracker preset commit modified library key"
).split()
SUMMARY_COLUMNS = [c for c in COLUMNS if c not in ("seed", "value", "frames", "lost", "key")]
SUMMARY_COLUMNS[SUMMARY_COLUMNS.index("unit") : SUMMARY_COLUMNS.index("unit")] = "seeds value low high std".split()

Row = dict[str, Any]
Results = Sequence[tuple[Job, Outcome]]


def result_rows(plan: Plan, profile: str, results: Results) -> list[Row]:
    """Every number of a benchmark but those of time: each run's, then their mean and pool by method and seed."""
    rows: list[Row] = []
    for job, outcome in results:
        head = _head(plan, profile, job, outcome)
        if outcome.status != "done":
            column = {"object": ", ".join(job.sequence.objects), "column": job.sequence.column}
            rows.append(head | column | {"metric": outcome.status, "reason": outcome.reason})
        for metric, value in outcome.tracks.items():
            rows.append(head | _plain(Number(f"2D {metric}", "-", "-", "-", "share", value)))
        for name, obj in outcome.objects.items():
            about = _about(job, name, obj)
            rows += [head | about | _plain(number) for number in _numbers(obj)]
            if obj.no_chamfer:
                rows.append(head | about | {"metric": "Chamfer distance", "unit": "cm", "reason": obj.no_chamfer})
        for name, reason in outcome.left_out.items():
            rows.append(head | {"object": name, "metric": "not scored", "reason": reason})
    groups = defaultdict(list)
    for job, outcome in results:
        if job.measure == "poses":
            groups[job.method.name, job.seed].append((job, outcome))
    for group in groups.values():
        rows += _over_sequences(plan, profile, group)
    return rows


def summary_rows(rows: Iterable[Row]) -> list[Row]:
    """The same over seeds: mean, lowest, highest and standard deviation (of the sample) of each number."""
    groups: dict[tuple, list[Row]] = defaultdict(list)
    same = [c for c in SUMMARY_COLUMNS if c not in ("seeds", "value", "low", "high", "std", "commit", "modified")]
    for row in rows:
        groups[tuple(str(row.get(column, "")) for column in same)].append(row)
    summary = []
    for group in groups.values():
        values = np.array([row["value"] for row in group if row.get("value") not in ("", None)], float)
        values = values[np.isfinite(values)]
        said = {"seeds": " ".join(str(row["seed"]) for row in group)}
        if len(values):
            said |= {"value": float(values.mean()), "low": float(values.min()), "high": float(values.max())}
            said |= {"std": float(values.std(ddof=1))} if len(values) > 1 else {}
        commits = {str(row.get("commit", "")) for row in group}
        said |= {"commit": " ".join(sorted(commits)), "modified": any(row.get("modified") is True for row in group)}
        summary.append({key: group[0].get(key, "") for key in same} | said)
    return summary


def time_rows(plan: Plan, profile: str, results: Results) -> list[Row]:
    """How long it took: of this machine, under the load it had. Apart, so that the results themselves never differ."""
    rows = []
    for job, outcome in results:
        head = _head(plan, profile, job, outcome) | {"objects": len(outcome.objects) or ""}
        head["width_px"] = int(outcome.times["width_px"]) if "width_px" in outcome.times else ""
        for said, value in outcome.times.items():
            if said != "width_px":
                metric, _, unit = said.removesuffix("]").partition(" [")
                rows.append(head | {"metric": metric, "value": value, "unit": unit})
    return rows


def as_csv(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """Rows as CSV: numbers in full, empty where there is none."""
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: "" if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()})
    return file.getvalue()


def _over_sequences(plan: Plan, profile: str, group: Results) -> list[Row]:
    """Mean over sequences (each object of each counts the same) and pool over frames of one method and seed."""
    done = [(job, outcome) for job, outcome in group if outcome.status == "done"]
    objects = [obj for _, outcome in done for obj in outcome.objects.values()]
    fallen = [job for job, outcome in group if outcome.status == "failed"]
    failed = sum(_expected_objects(job) for job in fallen)
    if not objects and not failed:
        return []
    totals = {"frames": sum(len(o.first["add_m"]) for o in objects), "lost": sum(o.lost for o in objects)}
    counted = [job for job, outcome in done if outcome.objects] + fallen
    totals |= {"sequences": len(counted), "objects": len(objects) + failed}
    totals |= {"object": "", "column": "", "key": ""}
    head = _head(plan, profile, *(done or group)[0]) | totals
    rows = [head | {"sequence": MEAN} | _plain(n) for n in numbers.mean([_numbers(o) for o in objects], failed)]
    if objects:
        for align in ALIGNMENTS:
            errors = [o.errors_m(align) for o in objects]
            pool = {key: np.concatenate([e[key] for e in errors]) for key in errors[0]}
            rows += [head | {"sequence": POOLED} | _plain(n) for n in numbers.areas(pool, align)]
        events = [f for o in objects for f in o.returns]
        rows += [head | {"sequence": POOLED} | _plain(n) for n in numbers.returns(events, WITHIN_FRAMES, "first")]
        if failed:  # how many frames they had nobody knows
            for row in rows:
                row["reason"] = f"{failed} failed: not in the pool" if row["sequence"] == POOLED else ""
    return rows


def _numbers(obj: ObjectOutcome) -> list[Number]:
    said = [number for align in ALIGNMENTS for number in numbers.areas(obj.errors_m(align), align)]
    return [*said, *numbers.chamfer(obj.chamfer_cm, "first"), *numbers.returns(obj.returns, WITHIN_FRAMES, "first")]


def _head(plan: Plan, profile: str, job: Job, outcome: Outcome) -> Row:
    ran, method = outcome.ran, job.method
    head = {"plan": plan.name, "profile": profile, "method": method.name, "sequence": shown_name(job)}
    head |= {
        "seed": job.seed,
        "tracker": ran.get("tracker", method.tracker),
        "preset": ran.get("preset", method.preset),
    }
    head |= {"detector": ran.get("detector", method.detector), "masks": ran.get("masks", method.masks)}
    head |= {key: "" if ran.get(key) is None else ran[key] for key in ("commit", "modified", "library")}
    return head | {"key": job.key}


def _about(job: Job, name: str, obj: ObjectOutcome) -> Row:
    column = job.sequence.column_of(name)
    return {"object": name, "column": column, "frames": len(obj.first["add_m"]), "lost": obj.lost}


def shown_name(job: Job) -> str:
    """What a row calls a job's sequence: its name, and the frames where these are not all."""
    planned = job.sequence
    if not planned.start and planned.stop is None:
        return planned.name
    return f"{planned.name}[{planned.start}:{'' if planned.stop is None else planned.stop}]"


def _plain(number: Number) -> Row:
    return {key: getattr(number, key) for key in ("metric", "form", "failures", "align", "value", "unit")}


def _expected_objects(job: Job) -> int:
    return len(job.sequence.objects or job.sequence.columns or job.sequence.clicks) or 1
