"""Every number of one run: what ``p2p eval --rows`` prints is what a benchmark keeps."""

import csv
import io
import json
import shutil

import pytest

from p2p_lib.apps import cli
from p2p_lib.benchmark.rows import MEAN_OF_ONE, POOLED
from p2p_lib.datasets.runs import load_run
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.run import export_run


@pytest.fixture
def printed(capsys):
    def rows(*arguments: str) -> list[dict[str, str]]:
        assert cli.main(["eval", *arguments, "--rows"]) == 0
        return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))

    return rows


def test_the_rows_of_a_run_are_those_of_the_benchmark(whole, printed):
    key = next(outcome.key for job, outcome in whole.results if job.method.name == "Ours")
    mine = [row for row in printed(str(whole.out / "runs" / key)) if row["object"] == "object" and row["value"]]
    theirs = [row for row in whole.rows if row["key"] == key and row["object"] == "object"]
    same = "metric form failures align unit frames lost tracker detector masks preset changed".split()
    assert {row["changed"] for row in mine} == {"method.graph=False, method.surface=False"}
    assert [[r[c] for c in same] for r in mine] == [[str(r[c]) for c in same] for r in theirs]
    assert [float(r["value"]) for r in mine] == [r["value"] for r in theirs]
    assert {(r["form"], r["failures"], r["align"]) for r in mine if r["metric"] == "ADD AUC"} == {
        (form, failures, align)
        for form in ("exact", "VOC")
        for failures in ("zero", "left out")
        for align in ("first", "all")
    }


def test_exported_poses_have_the_rows_of_their_run(whole, tmp_path, printed):
    folder = whole.out / "runs" / next(outcome.key for job, outcome in whole.results if job.method.name == "Ours")
    export_run(folder, "poses", tmp_path / "out")
    sequence = json.loads((folder / "run.json").read_text())["path"]
    ours, theirs = printed(str(folder)), printed("--poses", str(tmp_path / "out"), "--sequence", sequence)
    kept = ("object", "metric", "form", "failures", "align", "frames", "lost")
    numbers = [{tuple(r[c] for c in kept): r["value"] for r in rows if "AUC" in r["metric"]} for rows in (ours, theirs)]
    assert len(numbers[0]) == len(numbers[1]) > 16
    for key, value in numbers[0].items():
        assert float(numbers[1][key]) == pytest.approx(float(value), abs=1e-3)
    assert {(r["tracker"], r["seed"], r["masks"]) for r in theirs} == {("imported", "", "")}
    assert {(r["method"], r["sequence"]) for r in theirs if r["object"]} == {("out", sequence)}, "as they were typed"
    named = printed("--poses", str(tmp_path / "out"), "--sequence", sequence, "--name", "theirs", "--stop", "5")
    assert {(r["method"], r["sequence"]) for r in named if r["object"]} == {("theirs", f"{sequence}[0:5]")}
    for words in ([str(folder)], ["--poses", str(tmp_path / "out"), "--sequence", sequence]):
        assert cli.main(["eval", *words, "--rows", "--min-visible-px", "1000000"]) == 2, "no frame is scored"


def test_a_surface_is_scored_against_what_was_seen(slides, tmp_path, printed, capsys):
    """The board is flat and its model 49 points on it: 2.5 cm apart, so that is what all forms mostly see."""
    assert cli.main(["run", str(slides[0]), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    capsys.readouterr()
    rows = printed(str(tmp_path / "run"))
    found = {row["form"]: float(row["value"]) for row in rows if row["metric"] == "Chamfer distance" and row["object"]}
    assert set(found) == {"BundleSDF", "release", "as aligned"} and all(0.2 < cm < 1.0 for cm in found.values())
    assert {row["sequence"] for row in rows} == {slides[0].name, MEAN_OF_ONE, POOLED}
    assert {(row["sequences"], row["objects"]) for row in rows if row["sequence"] == MEAN_OF_ONE} == {("1", "1")}
    exact = {**dict.fromkeys(("form", "failures", "align")), "form": "exact", "failures": "zero", "align": "all"}
    (row,) = (r for r in rows if r["sequence"] == POOLED and r["metric"] == "ADD AUC" and exact.items() <= r.items())
    assert float(row["value"]) == pytest.approx(
        evaluate(load_run(tmp_path / "run"), align="all").as_dict()["mean"]["add_auc"]
    )


def test_without_the_sequence_all_but_the_surface_is_scored(slides, tmp_path, printed, capsys):
    moved = shutil.copytree(slides[0], tmp_path / "moved")
    assert cli.main(["run", str(moved), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    capsys.readouterr()
    shutil.rmtree(moved)
    rows = printed(str(tmp_path / "run"))
    (row,) = (row for row in rows if row["metric"] == "Chamfer distance")
    assert row["value"] == "" and "no such folder" in row["reason"]
    assert sum(row["metric"] == "ADD AUC" and row["object"] == "object" for row in rows) == 8
