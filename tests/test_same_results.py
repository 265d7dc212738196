"""Whether two codes track alike, and what becomes of tables where they do."""

import json

import numpy as np
import pytest


@pytest.fixture
def same(tool):
    return tool("same_results")


def test_one_bit_makes_a_difference(same, tmp_path):
    for side, value in (("a", 1.0), ("b", 1.0), ("c", np.nextafter(1.0, 2.0))):
        (tmp_path / side).mkdir()
        np.savez(tmp_path / side / "poses.npz", **{"box/T": np.array([value, np.nan]), "box/status": np.array(["x"])})
    assert same.differences(tmp_path / "a", tmp_path / "b") == []
    assert same.differences(tmp_path / "a", tmp_path / "c") == ["poses.npz: box/T"]
    for side in "ab":
        np.savez(
            tmp_path / side / "poses.npz", **{"box/T": np.zeros(1), "box/reason": np.array([f"as {side} says it"])}
        )
    assert same.differences(tmp_path / "a", tmp_path / "b") == [], "words are in no table"
    np.savez(tmp_path / "b" / "masks.npz", box=np.zeros(2))
    assert same.differences(tmp_path / "a", tmp_path / "b") == ["masks.npz: box"], "one of them alone has it"


def test_tables_of_the_same_code_get_its_digest_and_say_what_was_compared(same, tmp_path):
    (tmp_path / "tables").mkdir()
    for name, code in (("old", "x"), ("mine", "a")):
        (tmp_path / f"tables/{name}.json").write_text(json.dumps({"code": code, "commit": "c"}))
    assert same.restamp(tmp_path, "a", "b", 12) == ["mine.json"]
    assert json.loads((tmp_path / "tables/old.json").read_text()) == {"code": "x", "commit": "c"}
    note = json.loads((tmp_path / "tables/mine.json").read_text())
    assert note == {"code": "b", "commit": "c", "same_as": [{"code": "a", "runs compared": 12}]}


@pytest.fixture
def notes(tmp_path):
    """Notes of tables and figures of some plans, and of one that is of no plan."""
    sources = {
        "readme": {"benchmark": "readme"},
        "trackers": {"benchmark": "trackers"},
        "faults": {"benchmark": "faults"},
        "rates": {"file": "runtime.csv"},
        "of_readme": {"file": "readme.csv"},
        "films": {"benchmark": "presets"},
        "drawn": {"run": "2e4bd481b74b"},
    }
    for name, source in sources.items():
        (tmp_path / f"{name}.json").write_text(json.dumps({"code": "a", "sources": [source]}))
    return tmp_path


def test_where_runs_from_clicks_differ_tables_without_them_stand(same, notes):
    stand = same.restamp(notes, "a", "b", 12, clicks=False)
    assert stand == ["drawn.json", "faults.json", "films.json", "rates.json", "trackers.json"]


def test_tables_of_another_film_and_of_faults_that_were_not_compared_do_not_stand(same, notes):
    stand = same.restamp(notes, "a", "b", 12, films={"synthetic/in_hand"}, faults=False)
    assert stand == ["drawn.json", "of_readme.json", "rates.json", "readme.json", "trackers.json"]
