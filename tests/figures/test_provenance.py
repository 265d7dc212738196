"""The same work gives the same bytes, and a note that says what it was, without telling of the machine."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.outcome import Outcome
from p2p_lib.benchmark.plan import read_plan
from p2p_lib.core.errors import BadInput
from p2p_lib.figures import provenance
from p2p_lib.figures.provenance import save_figure, save_table, save_video
from studies import run_plots


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Changes where everything goes; returns the function that does."""

    def use(name):
        monkeypatch.setenv("P2P_FIGURES", str(tmp_path / name / "figures"))
        monkeypatch.setenv("P2P_TABLES", str(tmp_path / name / "tables"))
        return tmp_path / name

    return use


def image():
    return np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)


def save_all(made):
    sources = [made.run, made.evaluation, made.sequence]
    parameters = {"PROFILE": "quick", "SEED": np.int64(3), "values": np.arange(3)}
    save_figure(run_plots.error_over_time(made.run, made.evaluation), "plot", sources=sources, parameters=parameters)
    save_figure(image(), "picture", sources=sources, parameters=parameters)
    save_video([image()] * 4, "film", fps=10, sources=sources)
    save_table(made.evaluation.as_frame(), "scores", sources=sources, parameters=parameters)


@pytest.mark.filterwarnings("error::UserWarning")  # a layout that does not fit
def test_saved_again_is_the_same_to_the_byte(made, folders):
    contents = []
    for name in ("first", "second"):
        folder = folders(name)
        save_all(made)
        contents.append({p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()})
    assert contents[0] == contents[1]
    assert {str(p) for p in contents[0]} == {
        *(f"figures/{name}" for name in ("plot.png", "plot.json", "picture.png", "picture.json")),
        *("figures/film.mp4", "figures/film.json", "tables/scores.csv", "tables/scores.md", "tables/scores.json"),
    }


def test_note_says_what_was_made_from_what(made, folders):
    folder = folders("out")
    save_all(made)
    note = json.loads((folder / "figures" / "plot.json").read_text())
    assert note["parameters"] == {"PROFILE": "quick", "SEED": 3, "values": [0, 1, 2]}
    run, evaluation, sequence = note["sources"]
    assert (run["sequence"], run["tracker"], run["seed"]) == (made.sequence.name, "lk", 0)
    assert re.fullmatch("[0-9a-f]{12}", run["run"]) and re.fullmatch("[0-9a-f]{64}", run["poses_sha256"])
    assert evaluation["align"] == "first" and sequence["frames"] == len(made.sequence)
    assert set(sequence["sha256"]) == {"cam_K.txt", "scenario.json", "first frame"}
    assert {"p2p_lib", "python", "numpy", "matplotlib"} <= set(note["versions"]) and "commit" in note
    assert "code" not in note, "of a quick profile"
    import hashlib

    assert note["sha256"]["plot.png"] == hashlib.sha256((folder / "figures" / "plot.png").read_bytes()).hexdigest()


def test_a_note_says_of_an_offline_run_that_it_is_one(made):
    refined = {"offline": True}
    run = replace(made.run, info=made.run.info | refined)
    for causal, offline in ((made.run, run), (made.evaluation, replace(made.evaluation, info=run.info))):
        before, after = provenance.describe(causal), provenance.describe(offline)
        ran = after if "run" in after else after["evaluation"]
        assert "offline" not in json.dumps(before) and ran["offline"] is True
    assert provenance.describe(made.run)["run"] != provenance.describe(run)["run"]


def test_a_folder_is_told_by_all_that_it_holds(tmp_path):
    (tmp_path / "theirs/can").mkdir(parents=True)
    file = tmp_path / "theirs/can/0000.txt"
    said = []
    for text, name in (("1", "0000"), ("2", "0000"), ("2", "0001")):
        file = file.rename(file.with_stem(name)) if file.exists() else file
        file.write_text(text)
        said.append(provenance.describe(tmp_path / "theirs"))
    assert said[0].keys() == {"folder", "files", "sha256"} and (said[0]["folder"], said[0]["files"]) == ("theirs", 1)
    assert len({one["sha256"] for one in said}) == 3


def test_a_note_changes_only_with_what_it_is_of(made, folders, monkeypatch):
    """Drawn again by another commit it stays, so that nothing tracked changes where nothing did."""
    folder, earlier = folders("out"), provenance.provenance
    save_figure(image(), "picture", sources=[made.run], parameters={"SEED": 0})
    path = folder / "figures" / "picture.json"
    first = path.read_text()
    monkeypatch.setattr(provenance, "provenance", lambda: {**earlier(), "commit": "0" * 40, "modified": True})
    later = replace(made.run, info=made.run.info | {"commit": "0" * 40})
    save_figure(image(), "picture", sources=[later], parameters={"SEED": 0})
    assert path.read_text() == first
    for key in ("earlier", "later"):  # of the same job by other code
        done = (None, Outcome(key=key, status="done", ran={"frames": 600}, times={"processor time, all [ms]": 100.0}))
        save_figure(image(), "measured", sources=[Benchmark(read_plan("readme"), "full", folder, (done,))])
    (said,) = json.loads((folder / "figures" / "measured.json").read_text())["sources"]
    assert said["runs"] == ["earlier"] and said["cpu_min"] == 1.0
    save_figure(image(), "picture", sources=[later], parameters={"SEED": 1})
    assert "0" * 40 in path.read_text()
    save_figure(image()[:20], "picture", sources=[made.run], parameters={"SEED": 1})
    assert json.loads(path.read_text())["sha256"]["picture.png"] != json.loads(first)["sha256"]["picture.png"]


def test_nothing_tells_of_the_machine_or_the_hour(made, folders):
    folder = folders("out")
    save_all(made)
    for path in folder.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            assert str(folder.parent).encode() not in content and str(made.run.path).encode() not in content
            assert b"CreationDate" not in content and b"ModDate" not in content, path
    png = (folder / "figures" / "plot.png").read_bytes()
    assert b"Software" not in png and b"tIME" not in png


def test_another_configuration_is_another_run(made, tmp_path):
    import shutil
    from dataclasses import replace

    changed = shutil.copytree(made.run.path, tmp_path / "run")
    assert provenance.describe(replace(made.run, path=changed)) == provenance.describe(made.run)
    (changed / "config.toml").write_text("preset = 'paper'\n")
    assert provenance.describe(replace(made.run, path=changed))["run"] != provenance.describe(made.run)["run"]


def test_picture_is_written_as_it_is_and_shown_as_written(folders):
    from base64 import b64decode

    from PIL import Image

    folder = folders("out")
    saved = save_figure(image(), "picture")
    assert saved.path == folder / "figures" / "picture.png"
    with Image.open(saved.path) as read:
        assert (np.asarray(read) == image()).all()
    data, metadata = saved.shown
    assert b64decode(data["image/png"]) == saved.path.read_bytes() and metadata["image/png"]["width"] == 60


def test_film_is_shown_embedded(folders):
    folders("out")
    saved = save_video([image()] * 3, "film", fps=5)
    assert "base64" in saved.shown[0]["text/html"]


def test_saving_leaves_matplotlib_as_it_was(made, folders):
    import matplotlib

    folders("out")
    before = dict(matplotlib.rcParams)
    save_figure(run_plots.status_strip(made.run), "strip")
    assert dict(matplotlib.rcParams) == before


def test_table_reads_back(folders):
    import pandas

    folders("out")
    table = pandas.DataFrame({"object": ["a|b", "c"], "ADD [%]": [91.25, None], "frames": [3, 4]})
    saved = save_table(table, "scores")
    assert pandas.read_csv(saved.path).equals(table)
    lines = saved.path.with_suffix(".md").read_text().splitlines()
    assert lines == ["| object | ADD [%] | frames |", "| --- | ---: | ---: |", "| a\\|b | 91.25 | 3 |", "| c | - | 4 |"]
    assert "<table" in saved.shown[0]["text/html"]


def test_a_file_as_source_is_named_without_its_folder(tmp_path):
    path = tmp_path / "numbers.csv"
    path.write_text("1,2\n")
    told = provenance.describe(path)
    assert told["file"] == "numbers.csv" and len(told["sha256"]) == 64


def test_bad_input(folders):
    folders("out")
    for name in ("../escape", "a b", ""):
        with pytest.raises(BadInput, match="figure name"):
            save_figure(image(), name)
    with pytest.raises(BadInput, match=r"\(H, W, 3\) uint8"):
        save_figure(image().astype(float), "picture")
    with pytest.raises(BadInput, match="figure source"):
        save_figure(image(), "picture", sources=[3])


def test_a_caption_is_shown_kept_and_read_aloud(folders, monkeypatch):
    folder, shown = folders("out"), []
    monkeypatch.setattr("IPython.display.publish_display_data", lambda *data: shown.append(data[0]))
    saved = save_figure(image(), "picture", "A *box*, $T^C_O$ below.")
    saved._ipython_display_()
    assert saved.shown[1]["image/png"]["alt"] == "A box, T^C_O below."
    assert json.loads((folder / "figures" / "picture.json").read_text())["caption"] == "A *box*, $T^C_O$ below."
    assert "image/png" in shown[0] and "A *box*" in shown[1]["text/markdown"]
    assert 'aria-label="A &amp; B."' in save_video([image()] * 3, "film", "A & B.").shown[0]["text/html"]
