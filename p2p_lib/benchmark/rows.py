"""Tidy rows: one number each, with everything that one has to know to compare it with another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome
from p2p_lib.benchmark.plan import Plan
from p2p_lib.evaluation import numbers
from p2p_lib.evaluation.alignment import ALIGNMENTS
from p2p_lib.evaluation.numbers import Number
from p2p_lib.evaluation.recovery import WITHIN_FRAMES

#: What the ``sequence`` of a row says where it is about several.
MEAN, POOLED = "mean over sequences", "pooled over frames"
#: What MEAN is called where all of it is of one sequence (:func:`p2p_lib.benchmark.scoring.run_rows`).
MEAN_OF_ONE = "mean over objects"

#: The columns, in order. ``column`` is the paper's; ``key`` names the run's record; ``reason`` why there is no value.
COLUMNS = (
    "plan profile method sequence object column seed metric form failures align value unit frames lost sequences "
    "objects tracker detector masks preset commit modified library key reason"
).split()
TIME_COLUMNS = (
    "plan profile method sequence seed metric value unit objects width_px tracker preset commit modified library key"
).split()
#: What the rows of one number over seeds have in common.
_SAME = [c for c in COLUMNS if c not in ("seed", "value", "frames", "lost", "key", "commit", "modified")]
SUMMARY_COLUMNS = (
    "plan profile method sequence object column metric form failures align seeds value low high std unit sequences "
    "objects tracker detector masks preset commit modified library reason"
).split()

Row = dict[str, Any]
Results = Sequence[tuple[Job, Outcome]]


def result_rows(plan: Plan, profile: str, results: Results) -> list[Row]:
    """Every number of a benchmark but those of time: each run's, then their mean and pool by method and seed."""
    rows: list[Row] = []
    groups = defaultdict(list)
    for job, outcome in results:
        head = _head(plan, profile, job, outcome)
        if job.measure == "poses":
            groups[job.method.name, job.seed].append((job, outcome))
        if outcome.status != "done":
            about = {"object": ", ".join(job.sequence.objects), "column": job.sequence.column}
            rows.append(head | about | {"metric": outcome.status, "reason": outcome.reason})
        for metric, value in outcome.tracks.items():
            rows.append(head | asdict(Number(f"2D {metric}", "-", "-", "-", "share", value)))
        for name, obj in outcome.objects.items():
            about = {"object": name, "column": job.sequence.column_of(name)}
            about |= {"frames": len(obj.first["add_m"]), "lost": obj.lost}
            rows += [head | about | asdict(number) for number in _numbers(obj)]
            if obj.no_chamfer:
                rows.append(head | about | {"metric": "Chamfer distance", "unit": "cm", "reason": obj.no_chamfer})
        for name, reason in outcome.left_out.items():
            rows.append(head | {"object": name, "metric": "not scored", "reason": reason})
    return rows + [row for group in groups.values() for row in _over_sequences(plan, profile, group)]


def summary_rows(rows: Iterable[Row]) -> list[Row]:
    """The same over seeds: mean, lowest, highest and standard deviation (of the sample) of each number."""
    import pandas as pd

    table = pd.DataFrame(rows, columns=COLUMNS, dtype=object)
    for column in (*_SAME, "commit"):
        table[column] = table[column].where(table[column].notna(), "")
    table["value"] = pd.to_numeric(table["value"]).replace([np.inf, -np.inf], np.nan)
    table["modified"] = table["modified"].eq(True)
    summary = table.groupby(_SAME, sort=False).agg(
        seeds=("seed", lambda seeds: " ".join(map(str, seeds))),
        value=("value", "mean"),
        low=("value", "min"),
        high=("value", "max"),
        std=("value", "std"),
        commit=("commit", lambda commits: " ".join(sorted(set(commits)))),
        modified=("modified", "any"),
    )
    # What does not exist (the spread of one seed) is not in its row.
    return [{key: x for key, x in row.items() if x == x} for row in summary.reset_index().to_dict("records")]


def time_rows(plan: Plan, profile: str, results: Results) -> list[Row]:
    """How long it took: of this machine, under the load it had. Apart, so that the results themselves never differ."""
    rows = []
    for job, outcome in results:
        head = _head(plan, profile, job, outcome) | {"objects": len(outcome.objects) or ""}
        times = dict(outcome.times)
        head["width_px"] = int(times.pop("width_px")) if "width_px" in times else ""
        for name, value in times.items():
            metric, _, unit = name.removesuffix("]").partition(" [")
            rows.append(head | {"metric": metric, "value": value, "unit": unit})
    return rows


def as_csv(rows: Iterable[Row], columns: Sequence[str]) -> str:
    """Rows as CSV: numbers in full, empty where there is none."""
    import pandas as pd

    table = pd.DataFrame(rows, columns=list(columns), dtype=object).replace([np.inf, -np.inf], np.nan)
    return table.to_csv(index=False, lineterminator="\n")


def shown_name(job: Job) -> str:
    """What a row calls a job's sequence: its name, and the frames where these are not all."""
    start, stop = job.sequence.start, job.sequence.stop
    frames = f"[{start}:{'' if stop is None else stop}]" if start or stop is not None else ""
    return job.sequence.name + frames


def _over_sequences(plan: Plan, profile: str, group: Results) -> list[Row]:
    """Mean over sequences (each object of each counts the same) and pool over frames of one method and seed."""
    done = [(job, outcome) for job, outcome in group if outcome.status == "done"]
    objects = [obj for _, outcome in done for obj in outcome.objects.values()]
    fallen = [job for job, outcome in group if outcome.status == "failed"]
    failed = sum(len(job.sequence.objects or job.sequence.columns or job.sequence.clicks) or 1 for job in fallen)
    if not objects and not failed:
        return []
    head = _head(plan, profile, *(done or group)[0]) | {"object": "", "column": "", "key": ""}
    head |= {"frames": sum(len(o.first["add_m"]) for o in objects), "lost": sum(o.lost for o in objects)}
    head |= {"sequences": sum(bool(o.objects) for _, o in done) + len(fallen), "objects": len(objects) + failed}
    mean, pool = head | {"sequence": MEAN}, head | {"sequence": POOLED}
    if failed and objects:  # how many frames they had nobody knows
        pool["reason"] = f"{failed} failed: not in the pool"
    rows = [mean | asdict(number) for number in numbers.mean([_numbers(o) for o in objects], failed)]
    if objects:
        for align in ALIGNMENTS:
            errors = [o.errors_m(align) for o in objects]
            pooled = {key: np.concatenate([e[key] for e in errors]) for key in errors[0]}
            rows += [pool | asdict(number) for number in numbers.areas(pooled, align)]
        events = [frames for o in objects for frames in o.returns]
        rows += [pool | asdict(number) for number in numbers.returns(events, WITHIN_FRAMES, "first")]
    return rows


def _numbers(obj: ObjectOutcome) -> list[Number]:
    found = [number for align in ALIGNMENTS for number in numbers.areas(obj.errors_m(align), align)]
    return [*found, *numbers.chamfer(obj.chamfer_cm, "first"), *numbers.returns(obj.returns, WITHIN_FRAMES, "first")]


def _head(plan: Plan, profile: str, job: Job, outcome: Outcome) -> Row:
    """What ran, as the run itself says, else as it was planned."""
    head = {"plan": plan.name, "profile": profile, "method": job.method.name, "sequence": shown_name(job)}
    asked = {key: getattr(job.method, key) for key in ("tracker", "detector", "masks", "preset")}
    known = {"commit": "", "modified": "", "library": ""} | asked | outcome.ran
    shown = (*asked, "commit", "modified", "library")
    return head | {"seed": job.seed, "key": job.key} | {k: "" if known[k] is None else known[k] for k in shown}
