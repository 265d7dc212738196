"""Every number that is said of a run, each with what it means: form, failures, alignment, unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.recovery import recovered_within

#: The errors of a frame, by what their area under the curve is called.
AREAS = {"ADD-S AUC": "adds_m", "ADD AUC": "add_m"}
#: The exact integral, and the right-hand sum of the field's tables.
FORMS = {"exact": metrics.auc_exact, "VOC": metrics.auc_voc}
#: A frame without a pose (in a mean also a run that failed) counts as 0, or is left out.
FAILURES = ("zero", "left out")
NOT_APPLICABLE = "-"


@dataclass(frozen=True)
class Number:
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


def chamfer(values_cm: Mapping[str, float], align: str) -> list[Number]:
    """Both forms of the Chamfer distance."""
    return [Number("Chamfer distance", form, NOT_APPLICABLE, align, "cm", cm) for form, cm in values_cm.items()]


def returns(frames_to_recovery: Sequence[int | None], within: Sequence[int], align: str) -> list[Number]:
    """How often an object returned from complete occlusion, and how often it was recovered within so many frames."""
    recovered = recovered_within(frames_to_recovery, within)
    counts = {"all": len(frames_to_recovery)} | {f"recovered within {n} frames": k for n, k in recovered.items()}
    return [Number("returns", form, NOT_APPLICABLE, align, "events", count) for form, count in counts.items()]


def mean(numbers: Sequence[Sequence[Number]], failed: int = 0) -> list[Number]:
    """The mean over several objects or sequences, each with equal weight, of every number that all of them have.

    ``failed`` more of them gave nothing: they count as 0 where failures do, and are left out elsewhere. Of Chamfer
    distances and returns, which have no worst value, they are always left out.
    """
    by_kind: dict[tuple, list[float]] = {}
    for number in (number for one in numbers for number in one):
        key = (number.metric, number.form, number.failures, number.align, number.unit)
        by_kind.setdefault(key, []).append(number.value)
    means = []
    for key, values in by_kind.items():
        known = [value for value in values if np.isfinite(value)] + [0.0] * (failed if key[2] == "zero" else 0)
        means.append(Number(*key, float(np.mean(known)) if known else float("nan")))
    return means
