"""What is said of a run's errors: failures as 0 or left out, both forms, means and failures in them."""

import numpy as np
import pytest

from p2p_lib.benchmark import rows as numbers
from p2p_lib.benchmark.outcome import ObjectOutcome
from p2p_lib.benchmark.rows import Number
from p2p_lib.evaluation import metrics

ERRORS = {"add_m": np.array([0.0, 0.02, np.inf, 0.05]), "adds_m": np.array([0.0, 0.01, np.inf, 0.02])}


def value(found: list[Number], **wanted) -> float:
    (one,) = [n.value for n in found if all(getattr(n, key) == v for key, v in wanted.items())]
    return one


def test_failures_count_as_zero_or_are_left_out():
    found = numbers.areas(ERRORS, "first")
    assert len(found) == 8 and {n.unit for n in found} == {"%"} and {n.align for n in found} == {"first"}
    assert value(found, metric="ADD AUC", form="exact", failures="zero") == pytest.approx((100 + 80 + 0 + 50) / 4)
    assert value(found, metric="ADD AUC", form="exact", failures="left out") == pytest.approx((100 + 80 + 50) / 3)
    assert value(found, metric="ADD-S AUC", form="exact", failures="left out") == pytest.approx((100 + 90 + 80) / 3)
    voc = value(found, metric="ADD AUC", form="VOC", failures="left out")
    assert voc == pytest.approx(metrics.auc_voc(np.array([0.0, 0.02, 0.05])))


def test_an_object_never_found_scores_zero_and_nothing():
    never = numbers.areas({"add_m": np.full(3, np.inf), "adds_m": np.full(3, np.inf)}, "all")
    assert value(never, metric="ADD AUC", form="exact", failures="zero") == 0
    assert np.isnan(value(never, metric="ADD AUC", form="exact", failures="left out"))


def test_a_mean_counts_failed_runs_where_failures_count():
    perfect = numbers.areas({"add_m": np.zeros(2), "adds_m": np.zeros(2)}, "first")
    means = numbers.mean([*perfect, *numbers.areas(ERRORS, "first")], failed=2)
    assert value(means, metric="ADD AUC", form="exact", failures="zero") == pytest.approx((100 + 57.5) / 4)
    left_out = value(means, metric="ADD AUC", form="exact", failures="left out")
    assert left_out == pytest.approx((100 + 230 / 3) / 2)


def test_distances_have_no_worst_value():
    found = []
    for cm in ({"BundleSDF": 0.5, "release": 0.4}, {"BundleSDF": 0.7, "release": 0.6}):
        found += numbers._numbers(ObjectOutcome(lost=0, first=ERRORS, all=ERRORS, returns=[], chamfer_cm=cm))
    means = [n for n in numbers.mean(found, failed=3) if n.metric == "Chamfer distance"]
    assert value(means, form="BundleSDF") == pytest.approx(0.6) and {n.unit for n in means} == {"cm"}


def test_returns_are_counted():
    found = numbers.returns([0, 5, 6, 30, 31, None])
    assert value(found, form="all") == 6
    assert value(found, form="recovered within 5 frames") == 2
    assert value(found, form="recovered within 30 frames") == 4
