"""Many recordings at once: one table, a row that says why where one cannot be run, and nothing run twice."""

import shutil

import pandas as pd
import pytest

from p2p_lib.apps import cli
from p2p_lib.benchmark.batch import recordings, run_batch, tracked
from p2p_lib.benchmark.execution import perform
from p2p_lib.core.errors import BadInput
from p2p_lib.core.options import RunOptions
from tests.fixtures.sliding_board import write_sequence

OPTIONS = RunOptions(settings={"method.surface": False, "method.graph": False})


@pytest.fixture
def shelf(tmp_path):
    folder = tmp_path / "shelf"
    write_sequence(folder / "one")
    shutil.copytree(folder / "one", folder / "two")
    shutil.copytree(folder / "one", folder / "broken")
    next((folder / "broken/depth").iterdir()).unlink()
    (folder / "notes").mkdir()
    return folder


def test_every_recording_has_a_row_and_is_run_once(shelf, tmp_path, here):
    table = run_batch(shelf, tmp_path / "out", OPTIONS, jobs=1)
    assert table["recording"].tolist() == ["broken", "one", "two"]
    assert table["pose [%]"].tolist()[1:] == [100, 100]
    assert "files, expected" in table["note"][0] and pd.isna(table["object"][0])
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "out/batch.csv"), table, check_dtype=False)
    written = (tmp_path / "out/one/poses.npz").stat().st_mtime_ns
    here()
    run_batch(shelf, tmp_path / "out", OPTIONS, jobs=1)
    assert (tmp_path / "out/one/poses.npz").stat().st_mtime_ns == written


def test_a_recording_that_cannot_be_run_is_a_failure_and_the_table_is_there(shelf, tmp_path, capsys, here):
    here()
    words = ["run", "--batch", str(shelf), "--out", str(tmp_path / "out"), "--jobs", "1", "--quiet"]
    words += ["--set", "method.surface=false", "--set", "method.graph=false"]
    assert cli.main(words) == 2
    assert "1 of 3 recordings could not be run; the table says why." in capsys.readouterr().err
    rows = (tmp_path / "out/batch.csv").read_text().splitlines()
    assert [row.split(",")[2] for row in rows] == ["frames", "", "8", "8"]
    assert rows[0].endswith(",note"), "the longest one pads no other column"
    shutil.rmtree(shelf / "broken")
    assert cli.main(words) == 0


def test_failures_of_what_runs_now_or_is_gone_do_not_stay_and_other_folders_are_named(shelf, tmp_path, here):
    here()
    (shelf / "two/prompts.json").write_text("{}")
    shutil.copytree(shelf / "two", shelf / "three")
    out, failures, said = tmp_path / "out", tmp_path / "out/failures", []
    run_batch(shelf, out, OPTIONS, jobs=1, say=said.append)
    assert {path.name for path in failures.iterdir()} == {"broken.txt", "two.txt", "three.txt"}
    assert said == ["No recording, and passed over: notes"]
    (shelf / "two/prompts.json").unlink()
    shutil.rmtree(shelf / "three")
    run_batch(shelf, out, OPTIONS, jobs=1)
    assert {path.name for path in failures.iterdir()} == {"broken.txt"}


def test_a_memory_that_is_none_is_said_before_anything_starts(shelf, tmp_path, capsys):
    (tmp_path / "broken.npz").write_bytes(b"")
    words = ["run", "--batch", str(shelf), "--memory", str(tmp_path / "broken.npz"), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--quiet"]) == 2
    assert "broken.npz" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_what_is_no_shelf_is_a_sentence(shelf, tmp_path, capsys):
    with pytest.raises(BadInput, match="no recording in it"):
        recordings(shelf / "notes", OPTIONS)
    with pytest.raises(BadInput, match="a folder among the recordings"):
        run_batch(shelf, shelf / "out", OPTIONS)
    with pytest.raises(SystemExit):
        cli.main(["run", "--out", str(tmp_path / "x")])
    assert "needs either SEQ or --batch FOLDER" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--batch", "{shelf}", "--force"], "--force does not go with --batch"),
        (["--batch", "{shelf}", "--overlay", "film.mp4"], "--overlay does not go with --batch"),
        (["{shelf}/one", "--jobs", "2"], "--jobs and --scheduler go with --batch"),
        (["{shelf}/one", "--scheduler", "tcp://here:1"], "--jobs and --scheduler go with --batch"),
    ],
)
def test_words_that_would_be_passed_over_are_refused(shelf, tmp_path, capsys, words, says):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["run", *(word.format(shelf=shelf) for word in words), "--out", str(tmp_path / "out"), "--quiet"])
    assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_prompts_of_its_own_are_a_recordings_options(shelf):
    (shelf / "two/prompts.json").write_text("{}")
    found = {one.key: one.options for one in recordings(shelf, OPTIONS)}
    assert found["one"] == OPTIONS and found["two"].prompts == shelf / "two/prompts.json"


def test_a_worker_of_another_source_runs_nothing(shelf, tmp_path):
    (job, *_) = recordings(shelf, OPTIONS)
    outcome = perform(tracked, job, tmp_path / "out", "another library")
    assert outcome.status == "failed" and "expected another library" in outcome.reason
    assert not (tmp_path / "out" / job.key).exists()
