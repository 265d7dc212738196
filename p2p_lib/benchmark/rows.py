"""Tidy rows: one number each, with everything that one has to know to compare it with another.

A number says its form, how failures count, the alignment and the unit.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome
from p2p_lib.benchmark.plan import Plan
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.alignment import ALIGNMENTS
from p2p_lib.evaluation.protocol import ran_with
from p2p_lib.evaluation.recovery import recovered_within

#: The errors of a frame, by what their area under the curve is called.
AREAS = {"ADD-S AUC": "adds_m", "ADD AUC": "add_m"}
#: The exact integral, and the right-hand sum of the field's tables.
FORMS = {"exact": metrics.auc_exact, "VOC": metrics.auc_voc}
#: A frame without a pose (in a mean also a run that failed) counts as 0, or is left out.
FAILURES = ("zero", "left out")
#: What the ``sequence`` of a row says where it is about several.
MEAN, POOLED = "mean over sequences", "pooled over frames"
#: What MEAN is called where all of it is of one sequence (:func:`p2p_lib.benchmark.scoring.run_rows`).
MEAN_OF_ONE = "mean over objects"

#: The columns, in order. ``column`` is the paper's, ``changed`` what is not as in the preset; ``key`` names the run's
#: record; ``reason`` why there is no value.
COLUMNS = (
    "plan profile method sequence object column seed metric form failures align value unit frames lost sequences "
    "objects tracker detector masks preset changed commit modified library key reason"
).split()
TIME_COLUMNS = (
    "plan profile method sequence seed metric value unit objects width_px tracker preset changed commit modified "
    "library key"
).split()
#: What the rows of one number over seeds have in common.
_SAME = [c for c in COLUMNS if c not in ("seed", "value", "frames", "lost", "key", "commit", "modified")]
SUMMARY_COLUMNS = (
    "plan profile method sequence object column metric form failures align seeds value low high std unit sequences "
    "objects tracker detector masks preset changed commit modified library reason"
).split()

Row = dict[str, Any]
Results = Sequence[tuple[Job, Outcome]]


class Number(NamedTuple):
    """One number.

    metric    such as ``ADD AUC``; form, which of its definitions
    failures  how frames without a pose count: one of :data:`FAILURES`, or a dash
    align     how the object frame met the model frame (``first``, ``all``), or a dash
    value     NaN where it does not exist (no frame left, no mesh)
    """

    metric: str
    form: str
    failures: str
    align: str
    unit: str
    value: float


def areas(errors_m: Mapping[str, np.ndarray], align: str) -> list[Number]:
    """Both areas under the curve in both forms, failures as 0 and left out.

    errors_m  ``adds_m`` and ``add_m``, (m,) each, infinite where there was no pose
    """
    numbers = []
    for (metric, key), (form, area), failures in product(AREAS.items(), FORMS.items(), FAILURES):
        kept = errors_m[key] if failures == "zero" else errors_m[key][np.isfinite(errors_m[key])]
        numbers.append(Number(metric, form, failures, align, "%", area(kept)))
    return numbers


def returns(frames_to_recovery: Sequence[int | None]) -> list[Number]:
    """How often an object returned from complete occlusion, and how often it was recovered within so many frames."""
    recovered = recovered_within(frames_to_recovery)
    counts = {"all": len(frames_to_recovery)} | {f"recovered within {n} frames": k for n, k in recovered.items()}
    return [Number("returns", form, "-", "first", "events", count) for form, count in counts.items()]


def mean(numbers: Iterable[Number], failed: int = 0) -> list[Number]:
    """The mean of every kind of number, each object or sequence with equal weight.

    ``failed`` more of them gave nothing: they count as 0 where failures do, and are left out elsewhere. Of Chamfer
    distances and returns, which have no worst value, they are always left out.
    """
    by_kind: dict[Number, list[float]] = defaultdict(list)  # each kind as a number without its value
    for number in numbers:
        by_kind[number._replace(value=0.0)] += [number.value] if np.isfinite(number.value) else []
    for kind, values in by_kind.items():
        values += [0.0] * failed if "zero" in kind else []
    return [kind._replace(value=float(np.mean(v)) if v else np.nan) for kind, v in by_kind.items()]


def result_rows(plan: Plan, profile: str, results: Results) -> list[Row]:
    """Every number of a benchmark but those of time: each run's, then their mean and pool by method and seed."""
    rows: list[Row] = []
    groups = defaultdict(list)
    for job, outcome in results:
        head = _head(plan, profile, job, outcome)
        if job.measure == "poses":
            groups[job.method.name, job.seed].append((job, outcome))
        if outcome.status != "done":
            whole = {"object": ", ".join(job.sequence.objects), "column": job.sequence.column}
            rows.append(head | whole | {"metric": outcome.status, "reason": outcome.reason})
        for metric, value in outcome.tracks.items():
            rows.append(head | Number(f"2D {metric}", "-", "-", "-", "share", value)._asdict())
        for name, obj in outcome.objects.items():
            about: Row = {"object": name, "column": job.sequence.column_of(name)}
            about |= {"frames": len(obj.first["add_m"]), "lost": obj.lost}
            rows += [head | about | number._asdict() for number in _numbers(obj)]
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
    """What a row calls a job's sequence: its name, the frames where these are not all, and its fault."""
    start, stop = job.sequence.start, job.sequence.stop
    frames = f"[{start}:{'' if stop is None else stop}]" if start or stop is not None else ""
    return job.sequence.name + frames + (f" with {job.sequence.fault.shown}" if job.sequence.fault else "")


def _over_sequences(plan: Plan, profile: str, group: Results) -> list[Row]:
    """Mean over sequences (each object of each counts the same) and pool over frames of one method and seed."""
    done = [(job, outcome) for job, outcome in group if outcome.status == "done"]
    objects = [obj for _, outcome in done for obj in outcome.objects.values()]
    fallen = [job for job, outcome in group if outcome.status == "failed"]
    failed = sum(len(job.options().objects or job.sequence.columns) or 1 for job in fallen)
    if not objects and not failed:
        return []
    head = _head(plan, profile, *(done or group)[0]) | {"object": "", "column": "", "key": ""}
    head |= {"frames": sum(len(o.first["add_m"]) for o in objects), "lost": sum(o.lost for o in objects)}
    head |= {"sequences": sum(bool(o.objects) for _, o in done) + len(fallen), "objects": len(objects) + failed}
    over, pool = head | {"sequence": MEAN}, head | {"sequence": POOLED}
    if failed and objects:  # how many frames they had nobody knows
        pool["reason"] = f"{failed} failed: not in the pool"
    rows = [over | number._asdict() for number in mean([n for o in objects for n in _numbers(o)], failed)]
    if objects:
        for align in ALIGNMENTS:
            errors = [o.errors_m(align) for o in objects]
            pooled = {key: np.concatenate([e[key] for e in errors]) for key in errors[0]}
            rows += [pool | number._asdict() for number in areas(pooled, align)]
        rows += [pool | number._asdict() for number in returns([frames for o in objects for frames in o.returns])]
    return rows


def _numbers(obj: ObjectOutcome) -> list[Number]:
    found = [number for align in ALIGNMENTS for number in areas(obj.errors_m(align), align)]
    found += [Number("Chamfer distance", form, "-", "first", "cm", cm) for form, cm in obj.chamfer_cm.items()]
    found += returns(obj.returns)
    for form, value in obj.fault.items():
        unit = "share" if form == "mesh_off" else "frames"
        found.append(Number("fault", form, "-", "first", unit, value))
    return found


def _head(plan: Plan, profile: str, job: Job, outcome: Outcome) -> Row:
    """What ran, as the run itself says, else as it was planned."""
    head = {"plan": plan.name, "profile": profile, "method": job.method.name, "sequence": shown_name(job)}
    asked = {key: getattr(job.method, key) for key in ("tracker", "detector", "masks", "preset")}
    asked["changed"] = ran_with({"options": job.method.model_dump(include={"settings"})}).get("changed", "")
    known = {"commit": "", "modified": "", "library": ""} | asked | outcome.ran
    shown = (*asked, "commit", "modified", "library")
    return head | {"seed": job.seed, "key": job.key} | {k: "" if known[k] is None else known[k] for k in shown}
