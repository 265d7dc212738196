"""The committed figures are those of their notes and of the tables they show, and the index is current."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from p2p_lib.apps import cli
from p2p_lib.benchmark import load_benchmark, plan_names, read_plan
from p2p_lib.core.paths import PROJECT
from p2p_lib.datasets.download import sha256
from p2p_lib.datasets.paper_reported import paper_reported
from p2p_lib.datasets.provenance import code_digest
from p2p_lib.figures import provenance
from p2p_lib.figures.provenance import save_figure
from studies import anew, paper_figures
from studies.final_figures import rate_figure
from studies.paper_figures import ITEMS, PLAN, draw_all, index, picked, plan_for

FIGURES = PROJECT / "figures"


def outdated(folder: Path) -> list[str]:
    """What is wrong with figures and tables that are kept: no note, another content, older than the table it shows."""
    found = []
    for note in sorted([*folder.glob("*.json"), *(folder / "tables").glob("*.json")]):
        said = json.loads(note.read_text(encoding="utf-8"))
        for name, digest in said["sha256"].items():
            if not (note.parent / name).is_file() or sha256(note.parent / name) != digest:
                found.append(f"{name}: not what its note says")
        for source in said["sources"]:
            table = folder / "tables" / source.get("file", "")
            if "file" in source and table.is_file() and sha256(table) != source["sha256"]:
                found.append(f"{note.stem}: {source['file']} is newer than what was drawn from it")
    shown = [path for path in (*folder.glob("*.png"), *folder.glob("tables/*.md")) if path.name != "README.md"]
    found += [f"{path.name}: no note" for path in shown if not path.with_suffix(".json").is_file()]
    return found


def test_no_committed_figure_is_older_than_the_numbers_it_shows():
    assert outdated(FIGURES) == []


def untold(folder: Path) -> list[str]:
    """What was made by earlier code and does not say so, and what says so and was not."""
    found = []
    for file in ITEMS.file:
        note, page = (folder / file).with_suffix(".json"), (folder / file).with_suffix(".md")
        if note.is_file():
            said = json.loads(note.read_text(encoding="utf-8"))
            was = anew.of_earlier_code(folder, said)
            told = {said.get("earlier", False)} | (
                {f"\n{anew.LINE}, commit " in page.read_text()} if page.is_file() else set()
            )
            found += [file] if told != {was} else []
    return found


def test_whatever_earlier_code_made_says_so():
    assert untold(FIGURES) == [], "Run: p2p benchmark --stale --mark"


def test_a_table_of_earlier_code_says_so_until_it_is_made_anew(tmp_path, monkeypatch):
    (tmp_path / "tables").mkdir()
    plan = {"benchmark": "readme", "profile": "full", "plan": provenance._plan_digest(read_plan("readme"), "full")}
    runs = {**plan, "runs": ["a"], "cpu_min": 7.0}
    note = {"parameters": {"commit": "c" * 40}, "sources": [runs], "code": code_digest(), "sha256": {}}
    (tmp_path / "tables/readme.json").write_text(json.dumps(note))
    (tmp_path / "tables/readme.md").write_text("| 1 |\n")
    anew.say_so(tmp_path)
    assert untold(tmp_path) == [] and (tmp_path / "tables/readme.md").read_text() == "| 1 |\n"
    monkeypatch.setattr(provenance, "code_digest", lambda: "another")
    assert untold(tmp_path) == ["tables/readme.md"]
    for _ in range(2):
        anew.say_so(tmp_path)
        assert untold(tmp_path) == [] and outdated(tmp_path) == []
        assert (tmp_path / "tables/readme.md").read_text().count("commit ccccccc; `p2p benchmark readme") == 1
        assert "*earlier code*" in (tmp_path / "README.md").read_text()
    row, *others = anew.stale(tmp_path).to_dict("records")
    assert {other["commit"] for other in others} == {"not made"} and len(others) == len(ITEMS) - 1
    assert (row["file"], row["commit"], row["CPU min"]) == ("tables/readme.md", "ccccccc", "7")
    assert anew.stale(tmp_path, ["faults"]).file.tolist() == ["tables/faults.md"]
    monkeypatch.setattr(provenance, "code_digest", lambda: note["code"])
    anew.say_so(tmp_path)
    assert (tmp_path / "tables/readme.md").read_text() == "| 1 |\n"
    monkeypatch.setattr(provenance, "_plan_digest", lambda plan, profile: "another")
    assert untold(tmp_path) == ["tables/readme.md"], "its plan asks for something else by now"
    (tmp_path / "tables/readme.json").write_text(json.dumps(note | {"sources": [runs | {"runs": []}]}))
    assert untold(tmp_path) == ["tables/readme.md"], "a table of dashes has rows of its plan, too"
    monkeypatch.setenv("P2P_FIGURES", str(tmp_path))
    assert cli.main(["benchmark", "--stale"]) == 0 and untold(tmp_path) == ["tables/readme.md"], "a question"
    assert cli.main(["benchmark", "--stale", "--mark"]) == 0 and untold(tmp_path) == []


def test_what_is_stale_is_made_anew_where_it_lies_each_command_once(tmp_path, monkeypatch):
    ran = []

    def run(command, check):
        ran.append(command[3:])
        return SimpleNamespace(returncode=3 if len(ran) == 1 else 0)

    monkeypatch.setattr(anew.subprocess, "run", run)
    figures, out = tmp_path / "my figures", tmp_path / "my runs"
    figures.mkdir()
    only = ["runtime", "faults", *(Path(file).stem for file in ITEMS.file if file.endswith(".png"))]
    assert anew.make_anew(figures, out, only, lambda line: None) == 3
    tables = ["--out", str(out), "--tables", str(figures / "tables")]
    assert sorted(ran)[:3] == [*(["benchmark", name, *tables] for name in ("faults", "runtime")), ["figures"]]
    assert all(command[0] == "notebooks" for command in sorted(ran)[3:])


def test_the_index_is_current():
    text = (FIGURES / "README.md").read_text()
    days = dict(re.findall(r"\| ([0-9a-f]{7}) (\d{4}-\d\d-\d\d)", text))
    assert index(FIGURES, lambda commit: days.get(commit[:7], "")) == text, "Run: p2p benchmark --stale --mark"


def test_committed_figures_are_small():
    listed = subprocess.run(["git", "ls-files", "figures"], cwd=PROJECT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    kept = [PROJECT / line for line in listed.stdout.split()]
    assert FIGURES / "README.md" in kept and FIGURES / "tables/ablation_trackers.md" in kept
    assert {FIGURES / file for file in ITEMS.file if (FIGURES / file).is_file()} <= set(kept)
    for path in kept:
        assert path.stat().st_size < 1 << 20, path.name


def test_every_table_of_the_paper_is_in_the_index():
    listed = {file.removeprefix("tables/").removesuffix(".md") for file in ITEMS.file}
    assert listed >= {name for name in plan_names() if read_plan(name).paper}
    assert ITEMS.paper.str.startswith("Figure").sum() == 5
    assert ITEMS.paper.str.startswith("Table").sum() == len(paper_reported().tables)


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """A figure of a table, both with their notes."""
    monkeypatch.setenv("P2P_FIGURES", str(tmp_path))
    (tmp_path / "tables").mkdir()
    table = tmp_path / "tables" / "runtime.csv"
    rows = ["1 object, 640x480", "2 objects", "15 tracks", "320x240", "tracker lk"]
    lines = [f'"{name}",{10 * (k + 1)}' for k, name in enumerate(rows)]
    table.write_text("\n".join(['Setting,"processor, files included (ms)"', *lines]))
    (tmp_path / "tables/runtime.json").write_text(json.dumps({"sha256": {}, "sources": []}))
    save_figure(rate_figure(table), "runtime", sources=[table])
    return tmp_path


def test_a_table_that_changed_leaves_its_figure_behind(drawn):
    note = json.loads((drawn / "runtime.json").read_text())
    assert outdated(drawn) == [] and not anew.of_earlier_code(drawn, note)
    table = drawn / "tables" / "runtime.csv"
    table.write_text(table.read_text().replace("10", "11"))
    assert outdated(drawn) == ["runtime: runtime.csv is newer than what was drawn from it"]
    assert anew.of_earlier_code(drawn, note), "p2p benchmark --stale lists it"


def test_a_picture_without_its_note_or_with_another_content_is_named(drawn):
    shutil.copy(drawn / "runtime.png", drawn / "copy.png")
    (drawn / "runtime.png").write_bytes(b"another")
    assert outdated(drawn) == ["runtime.png: not what its note says", "copy.png: no note"]


def test_the_rate_figure_shows_every_number_of_its_table(drawn):
    axes = rate_figure(drawn / "tables" / "runtime.csv").axes
    assert [list(axis.lines[0].get_xydata().round(3).ravel()) for axis in axes[:2]] == [
        [1, 10, 2, 20],
        [15, 30, 60, 10],
    ]
    assert sorted(bar.get_height() for bar in axes[3].patches) == [10, 50]


def test_figures_that_are_asked_for_are_drawn_where_they_are_asked_for(tmp_path, monkeypatch):
    assert picked(["runtime"]) == ["runtime"] and len(picked()) == 5
    assert [s.name for s in plan_for(["fig3_synthetic", "runtime"]).full.sequence] == ["synthetic/ycb_airplane_can"]
    assert plan_for(picked()) == read_plan(PLAN)
    monkeypatch.setenv("P2P_FIGURES", str(tmp_path / "as_they_were"))
    monkeypatch.setattr(paper_figures, "framework", lambda runs: np.zeros((4, 4, 3), np.uint8))
    saved = draw_all(load_benchmark(PLAN, tmp_path), tmp_path / "mine", ["fig2_framework", "runtime"])
    assert [one.path for one in saved] == [tmp_path / "mine" / f"{name}.png" for name in ("fig2_framework", "runtime")]
    assert {path.suffix for path in (tmp_path / "mine").iterdir()} == {".png", ".pdf", ".json", ".md"}
    assert not (tmp_path / "as_they_were").exists()


def test_a_figure_beside_a_competitor_says_whose_poses_it_shows(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_figures, "return_beside", lambda runs, poses: np.zeros((4, 4, 3), np.uint8))
    poses = tmp_path / "theirs.txt"
    poses.write_text("0 0 0 1 0 0 0 1\n")
    runs = load_benchmark(PLAN, tmp_path)
    for given in ([], [{"file": "theirs.txt", "sha256": sha256(poses)}]):
        draw_all(runs, tmp_path / "mine", ["fig5_return"], poses if given else None)
        sources = json.loads((tmp_path / "mine/fig5_return.json").read_text())["sources"]
        assert [source for source in sources if "benchmark" not in source] == given


def test_a_quick_form_never_takes_the_place_of_a_full_one(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_FIGURES", str(tmp_path))
    figure = Figure()
    full = save_figure(figure, "f", parameters={"PROFILE": "full"}).path.read_bytes()
    figure.text(0.5, 0.5, "quick")
    quick = save_figure(figure, "f", parameters={"PROFILE": "quick"})
    assert quick.path == tmp_path / "quick/f.png" and (tmp_path / "f.png").read_bytes() == full
    assert save_figure(figure, "f", parameters={"PROFILE": "full"}).path == tmp_path / "f.png"
    assert save_figure(figure, "g", parameters={"PROFILE": "quick"}).path == tmp_path / "g.png", "nothing lay there"
