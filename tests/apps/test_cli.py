"""The command line: what a user types, what comes back, and one line for everything that can go wrong."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import p2p_lib
from p2p_lib.apps import cli
from p2p_lib.apps.click import Clicker
from p2p_lib.core.errors import MissingData, P2PError
from p2p_lib.core.options import RunOptions
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.prompts import save_prompts
from p2p_lib.datasets.runs import load_run, read_info
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.extended.default import Point2Pose
from p2p_lib.run import summary
from tests.fixtures.sliding_board import DEPTH_M, H, K, W, write_sequence
from tests.fixtures.terminal import left_on_it, shown_on_a_terminal

FRAMES = 8
#: Points alone: the rest of the method is tested elsewhere, and torch takes seconds to import.
#: What a run waits for before its first frame, as it says.
WAITS = ["Loading libraries", "Reading the sequence", "Loading compiled loops", "First masks"]
POINTS_ALONE = ["--set", "method.surface=false", "--set", "method.graph=false", "--quiet"]


@pytest.fixture(scope="module")
def pristine(tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("cli") / "slide")


@pytest.fixture
def sequence(pristine, tmp_path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(pristine, tmp_path / "slide"))


@pytest.fixture(scope="module")
def done(pristine, tmp_path_factory) -> Path:
    """A finished run, of seed 7; nobody writes to it."""
    out = tmp_path_factory.mktemp("done") / "run"
    assert cli.main(["run", str(pristine), "--out", str(out), "--seed", "7", *POINTS_ALONE]) == 0
    return out


def run(sequence: Path, out: Path, *more: str) -> int:
    return cli.main(["run", str(sequence), "--out", str(out), *POINTS_ALONE, *more])


# --- what works --------------------------------------------------------------------------------


def test_a_run_leaves_what_was_promised(done):
    files = {"config.toml", "run.json", "poses", "poses.npz", "timings.csv", "first_masks.png", "masks.npz"}
    assert {p.name for p in done.iterdir()} >= files
    rows = np.loadtxt(done / "poses" / "object.txt")
    assert rows.shape == (FRAMES, 8)
    np.testing.assert_allclose(rows[:, 0], np.arange(FRAMES) / 30, atol=1e-6)
    moved = rows[:, 1:4] - rows[0, 1:4]
    np.testing.assert_allclose(moved, np.arange(FRAMES)[:, None] * [2 / 200 * DEPTH_M, 1 / 200 * DEPTH_M, 0], atol=5e-4)


def test_a_run_says_its_score_and_what_to_do_next(sequence, tmp_path, capsys):
    assert run(sequence, tmp_path / "out") == 0
    out, err = capsys.readouterr()
    assert "ADD-S" in out and "object" in out
    results = f"Results in {tmp_path / 'out'}, first masks in {tmp_path / 'out/first_masks.png'}."
    assert out.splitlines()[-1] == f"{results} Next: p2p view {tmp_path / 'out'}"
    assert err == ""


SCORES = {"add_auc", "adds_auc", "add_auc_voc", "adds_auc_voc"}


def test_eval_prints_exactly_one_json_object(done, capsys):
    assert cli.main(["eval", str(done), "--json"]) == 0
    out, err = capsys.readouterr()
    got = json.loads(out)  # anything beside one object would be "Extra data"
    assert err == "" and "NaN" not in out and "Infinity" not in out
    ran = {"tracker", "masks", "segmenter", "preset", "changed", "seed", "align"}
    assert set(got) == {"objects", "mean", "hz", "p95_ms"} | ran
    assert set(got["objects"]) == {"object"}
    assert set(got["objects"]["object"]) == SCORES | {"frames", "lost", "frames_to_recovery"}
    assert set(got["mean"]) == SCORES
    assert got["objects"]["object"]["frames"] == FRAMES and got["objects"]["object"]["lost"] == 0
    assert 98 < got["mean"]["add_auc"] <= got["mean"]["adds_auc"] <= 100
    assert got["hz"] > 0 and got["p95_ms"] > 0
    assert (got["masks"], got["preset"], got["seed"], got["align"]) == ("dataset", "default", 7, "first")
    assert isinstance(got["tracker"], str) and got["tracker"]


def test_eval_options_reach_the_evaluation(done, pristine, capsys):
    models = f"object={pristine / 'models/object/points.xyz'}"
    assert cli.main(["eval", str(done), "--json", "--align", "all", "--models", models]) == 0
    assert json.loads(capsys.readouterr().out)["align"] == "all"
    assert cli.main(["eval", str(done), "--min-visible-px", "3601"]) == 2
    assert "3601 visible pixels" in capsys.readouterr().err


def test_eval_prints_a_table_for_people(done, capsys):
    assert cli.main(["eval", str(done)]) == 0
    out = capsys.readouterr().out
    assert not out.startswith("{") and "ADD-S" in out and "Hz" in out and "seed 7" in out


def test_eval_compares_runs_of_one_video(done, tmp_path, capsys):
    other = shutil.copytree(done, tmp_path / "other")
    info = json.loads((other / "run.json").read_text())
    info["options"] = (info.get("options") or {}) | {"stop": 3}
    (other / "run.json").write_text(json.dumps(info))
    assert cli.main(["eval", str(done), str(other)]) == 0
    out = capsys.readouterr().out
    assert out.count("ADD-S AUC [%]") == 2 and f"{other}: --stop 3, where {done} has" in out
    assert f"object: 0.0° and 0.0 mm apart (medians of {FRAMES} frames" in out
    with pytest.raises(SystemExit):
        cli.main(["eval", str(done), str(other), "--json"])
    assert "--json and --rows are of one DIR" in capsys.readouterr().err


def test_eval_of_an_offline_run_says_that_it_is_one(done, tmp_path, capsys):
    refined = shutil.copytree(done, tmp_path / "refined")
    info = json.loads((refined / "run.json").read_text())
    (refined / "run.json").write_text(json.dumps(info | {"offline": True}))
    for folder, marked in ((done, False), (refined, True)):
        said = {}
        for how in ((), ("--json",), ("--rows",)):
            assert cli.main(["eval", str(folder), *how]) == 0
            said[how] = capsys.readouterr().out
        assert ("offline" in said[()].splitlines()[-1]) == marked
        assert json.loads(said["--json",]).get("offline", False) is marked
        plans = {row.partition(",")[0] for row in said["--rows",].splitlines()[1:]}
        assert plans == {"offline run" if marked else "run"}


def test_eval_without_truth_says_of_an_offline_run_that_it_is_one(sequence, tmp_path, capsys):
    shutil.rmtree(sequence / "annotated_poses")
    assert run(sequence, tmp_path / "run") == 0
    info = json.loads((tmp_path / "run/run.json").read_text())
    (tmp_path / "run/run.json").write_text(json.dumps(info | {"offline": True}))
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "run"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["offline"] is True
    offline = shutil.copytree(tmp_path / "run", tmp_path / "run/offline", ignore=shutil.ignore_patterns("keypoints*"))
    (offline / "run.json").write_text(json.dumps(info | {"masks_in": ".."}))
    assert cli.main(["eval", str(offline), "--json"]) == 0
    of_both = [told["objects"]["object"]["reprojection_px"] for told in (said, json.loads(capsys.readouterr().out))]
    assert of_both[0] == of_both[1] < 2, "its keypoints are the run's"


def test_options_reach_the_run(sequence, tmp_path, capsys):
    shutil.copytree(sequence / "gt_mask", sequence / "drawn")
    (tmp_path / "mine.toml").write_text("[sampling]\npoints = 17\n[keypoint_map]\nstreak = 2\n")
    code = run(
        *(sequence, tmp_path / "out", "--preset", "paper", "--config", str(tmp_path / "mine.toml")),
        *("--set", "sampling.points=18", "--seed", "3", "--start", "2", "--stop", "6"),
        *("--masks", "dataset:drawn", "--objects", "object", "--format", "ycbineoat", "--depth-scale", "0.001"),
    )
    assert code == 0
    loaded = load_run(tmp_path / "out")
    assert loaded.objects["object"].frame_index.tolist() == [2, 3, 4, 5]
    assert (loaded.info["preset"], loaded.info["seed"], loaded.info["masks"]) == ("paper", 3, "drawn")
    asked = RunOptions(**loaded.info["options"])
    assert (asked.start, asked.stop, asked.objects, asked.settings["sampling.points"]) == (2, 6, ["object"], "18")
    written = (tmp_path / "out" / "config.toml").read_text()
    assert "points = 18\n" in written and "streak = 2\n" in written and 'preset = "paper"' in written
    # What was written reproduces the configuration.
    again = run(sequence, tmp_path / "again", "--config", str(tmp_path / "out" / "config.toml"), "--stop", "2")
    assert again == 0 and (tmp_path / "again" / "config.toml").read_text() == written


def test_progress_goes_where_it_does_not_disturb(sequence, tmp_path, capsys):
    loud = [word for word in POINTS_ALONE if word != "--quiet"]
    assert cli.main(["run", str(sequence), "--out", str(tmp_path / "out"), *loud]) == 0
    out, err = capsys.readouterr()
    assert f"{FRAMES}/{FRAMES}" in err and "object tracked" in err
    assert "frame/s" not in out and "\r" not in out
    *waits, first, _ = err.splitlines()  # a terminal's bar would fill a log file
    assert waits == [f"{what} ..." for what in WAITS]
    assert first == f"First masks of object in frame 0: {tmp_path / 'out' / 'first_masks.png'}" and "\r" not in err


def test_on_a_terminal_what_is_waited_for_is_one_line_that_goes_away(sequence, tmp_path):
    loud = [word for word in POINTS_ALONE if word != "--quiet"]
    words = ["-m", "p2p_lib.apps.cli", "run", str(sequence), "--stop", "3", "--out"]
    shown = shown_on_a_terminal(*words, str(tmp_path / "out"), *loud)
    assert sorted(WAITS, key=shown.index) == WAITS and shown.startswith("\rLoading libraries ...")
    masks, bar, end = left_on_it(shown)
    assert masks.startswith("First masks of object") and "3/3" in bar and end == ""
    assert shown_on_a_terminal(*words, str(tmp_path / "quiet"), *POINTS_ALONE) == ""


def test_replacing_a_run_is_said(sequence, tmp_path, capsys):
    assert run(sequence, tmp_path / "out", "--seed", "4", "--stop", "3000") == 0
    err = capsys.readouterr().err
    assert "replaces" not in err and f"stop 3000: slide has {FRAMES} frames alone" in err
    assert run(sequence, tmp_path / "out", "--stop", "3", "--force") == 0
    err = capsys.readouterr().err
    assert re.search(rf"out held a run of slide \({FRAMES} frames, tracker \S+, seed 4\), which this one replaces", err)
    assert len(load_run(tmp_path / "out").objects["object"]) == 3


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_results_beside_the_data_leave_it_alone(sequence, tmp_path, capsys):
    """``p2p run DATA --out DATA`` had deleted the masks, the poses and the meshes of DATA."""
    shutil.move(sequence / "gt_mask", sequence / "masks" / "object")
    (sequence / "meshes").mkdir()
    (sequence / "meshes" / "mine.ply").write_text("mine")
    before = contents(sequence)
    for more in ([], ["--force"], ["--resume"]):
        for out, got in ((sequence, "that holds the sequence"), (sequence / "masks", "with object, and no run")):
            assert run(sequence, out, *more, "--format", "folder") == 2
            assert f"{out}: got a folder {got}" in one_line(capsys)
    assert contents(sequence) == before
    assert run(sequence, sequence / "out", "--format", "folder") == 0  # a folder of its own may be anywhere
    assert contents(sequence).items() > before.items()
    assert run(sequence, tmp_path / "a", "--save-masks") == 0
    assert run(sequence, tmp_path / "a", "--masks", str(tmp_path / "a" / "masks"), "--force") == 2
    assert "a: got a folder that holds the masks" in capsys.readouterr().err and (tmp_path / "a" / "masks").is_dir()


def test_a_folder_that_is_taken_is_said_before_anything_is_doubted(done, sequence, capsys, monkeypatch):
    monkeypatch.setattr("p2p_lib.run.moving_scale", lambda pairs: "all depth changes")
    assert run(sequence, done) == 2 and "go on with it (--resume" in one_line(capsys)


NEVER_STARTS = {
    "unknown word": lambda s: ["--tracker", "nope"],
    "bad value": lambda s: ["--set", "sampling.points=0"],
    "unreadable first image": lambda s: cut(s / "rgb/0000.png") or [],
    "unreadable truth": lambda s: spoil(s / "annotated_poses/0005.txt", b"1 2") or [],
    "no masks": lambda s: shutil.rmtree(s / "gt_mask") or [],
}


@pytest.mark.parametrize("case", NEVER_STARTS)
def test_a_run_that_never_starts_leaves_the_earlier_one(case, done, sequence, tmp_path, capsys):
    out = Path(shutil.copytree(done, tmp_path / "out"))
    before = contents(out)
    assert run(sequence, out, "--force", *NEVER_STARTS[case](sequence)) == 2
    assert contents(out) == before


def test_a_full_disk_is_an_error_and_no_finished_run(sequence, tmp_path, capsys):
    """No file may grow beyond 7.5 kB: the arrays of the run's last frames do."""
    import resource

    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (7_500, limit[1]))
    try:
        assert run(sequence, tmp_path / "out") == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert "File too large" in one_line(capsys)
    loaded = load_run(tmp_path / "out")
    assert not loaded.info["finished"] and 0 < len(loaded.objects["object"]) <= FRAMES
    assert not list((tmp_path / "out").rglob(".*"))


def test_a_mesh_that_cannot_be_written_is_an_error_and_no_finished_run(sequence, tmp_path, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("p2p_lib.datasets.keypoint_log.save_arrays", lambda *_, **__: full())
    assert run(sequence, tmp_path / "out") == 2
    assert "No space left" in one_line(capsys)
    info = load_run(tmp_path / "out").info
    assert not info["finished"] and info["stopped_by"] == "OSError" and info["frames"] == FRAMES


def test_a_run_that_was_cut_short_goes_on(sequence, done, tmp_path, capsys, monkeypatch):
    """What it comes to is what it would have come to, maps included; in the end there is nothing left to do."""
    step, out, words = Point2Pose.step, tmp_path / "out", ["--seed", "7", "--resume"]

    def interrupted(self, frame, masks=None):
        if frame.index == 5:
            raise KeyboardInterrupt
        return step(self, frame, masks)

    with monkeypatch.context() as patch:
        patch.setattr(Point2Pose, "step", interrupted)
        assert run(sequence, out, *words) == 130
    assert f"{out} holds no run to go on with: one begins anew." in capsys.readouterr().err
    assert run(sequence, out, *words) == 0
    assert "(5 frames" in (err := capsys.readouterr().err) and "before it goes on" in err
    now, whole = load_run(out), load_run(done)
    np.testing.assert_array_equal(now.objects["object"].T_cam_obj, whole.objects["object"].T_cam_obj)
    with np.load(out / "keypoints.npz") as mine, np.load(done / "keypoints.npz") as theirs:
        assert mine.files == theirs.files and all((mine[key] == theirs[key]).all() for key in mine.files)
    assert now.info["finished"] and (out / "poses/object.txt").read_text() == (done / "poses/object.txt").read_text()
    before = contents(out)
    assert run(sequence, out, *words) == 0
    assert "which is finished" in (err := capsys.readouterr().err) and contents(out) == before and "left out" not in err
    assert cli.main(["run", str(sequence), "--out", str(out), "--resume", "--quiet"]) == 0 and contents(out) == before
    assert cli.main(["run", "--out", str(out), "--resume", "--quiet"]) == 0 and contents(out) == before
    taken = f"left out, and taken from the run in {out}: --set method.surface=false --set method.graph=false --seed 7"
    assert taken in capsys.readouterr().err.replace("'", "")
    assert cli.main(["run", "--out", str(tmp_path / "none"), "--resume", "--quiet"]) == 2
    assert "none: no run there to go on with. Name its folder, or what to run" in one_line(capsys)
    assert run(sequence, out, "--seed", "8", "--resume") == 2
    got = "out: the run to go on with: got --seed 8, expected --seed 7, as it began. Ask for the same, or run it anew"
    assert got in one_line(capsys)
    assert run(sequence, out, *words, "--stop", "4", "--objects", "object", "--set", "sampling.points=9") == 2
    got = "got --set sampling.points=9 --objects object --stop 4, expected no --set no --objects no --stop, as it began"
    assert f"{got}. " in one_line(capsys), "and not what follows of it"
    moved = shutil.copytree(sequence, tmp_path / "moved")
    assert run(moved, out, *words) == 2
    assert f"got {moved}, expected {sequence}, as it began" in one_line(capsys)
    (out / "config.toml").write_text((out / "config.toml").read_text() + "\n")
    assert run(sequence, out, *words) == 2
    assert "config.toml: got other parameters" in one_line(capsys)
    before["config.toml"] += b"\n"
    assert contents(out) == before


def test_a_run_is_of_its_own_video_from_wherever_it_is_read(sequence, tmp_path, capsys, monkeypatch):
    """Not of another one that is called alike there; paths that an earlier version wrote are as seen from here."""
    there, here = tmp_path / "there", tmp_path / "here"
    shutil.rmtree(sequence / "annotated_poses")  # of what has truth only the run itself is scored
    shutil.move(sequence, there / "slide")
    shutil.copytree(there / "slide", here / "slide")
    image = next((here / "slide/rgb").glob("*0.png"))
    cv2.imwrite(str(image), cv2.imread(str(image))[::-1])
    models = "object=slide/models/object/points.xyz"
    clicks(there, ("object", 0, [[60, 50]]))
    words = ["--prompts", "prompts.json", "--models", models, "--stop", "3"]
    monkeypatch.chdir(there)
    assert run(Path("slide"), Path("out"), *words) == 0
    kept = json.loads(Path("out/run.json").read_text())
    assert kept["path"] == str(there / "slide") and kept["options"]["prompts"] == str(there / "prompts.json")
    assert kept["models"] == {"object": "models/object/points.xyz"}
    monkeypatch.chdir(here)
    assert cli.main(["run", "--out", "../there/out", "--resume", "--quiet"]) == 0
    assert cli.main(["film", "../there/out", "--out", "film.gif"]) == 0
    old = kept | {"path": "slide", "options": kept["options"] | {"prompts": "prompts.json"}}
    Path("../there/out/run.json").write_text(json.dumps(old))
    capsys.readouterr()
    for command in (
        ["film", "--out", "other.gif"],
        ["eval"],
        ["export", "--format", "tum", "--out", "tum"],
        ["refine"],
    ):
        assert cli.main([command[0], "../there/out", *command[1:]]) == 2, command
        got = "slide: images of frame 0: got others (0"
        assert (
            got in (line := one_line(capsys, command[0])) and "those that the run of slide was made on (sha256 " in line
        )
    monkeypatch.chdir(there)
    assert run(Path("slide"), Path("out"), *words, "--resume") == 0 and "which is finished" in capsys.readouterr().err
    shutil.copy(here / "slide/rgb" / image.name, there / "slide/rgb")
    assert run(Path("slide"), Path("out"), *words, "--resume") == 2 and "images of frame 0" in one_line(capsys)


def test_a_run_of_a_bundled_scene_goes_on_from_any_folder(tmp_path, capsys, monkeypatch):
    """Its models are where it is rendered to, which is no business of the current folder; one's own are whole."""
    step, out, words = Point2Pose.step, tmp_path / "out", ["--stop", "4"]
    model = find_models(open_sequence("synthetic/crossing"))["can"]
    own = shutil.copy(model, tmp_path / "own.xyz")

    def interrupted(self, frame, masks=None):
        if frame.index == 2:
            raise KeyboardInterrupt
        return step(self, frame, masks)

    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Point2Pose, "step", interrupted)
        assert run("synthetic/crossing", out, "--models", "can=own.xyz", *words) == 130
    for there in ("here", "elsewhere"):
        (tmp_path / there).mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert cli.main(["run", "--resume", "--out", "../out", "--quiet"]) == 0
    info = read_info(out)
    assert info["models"] == {"box": "models/box/points.xyz", "can": str(own)} and info["frames"] == 4
    monkeypatch.chdir(tmp_path / "here")
    assert cli.main(["run", "--resume", "--from", "3", "--out", "../out", "--quiet"]) == 0
    assert read_info(out) == info and "which is finished" not in capsys.readouterr().err


def test_a_run_that_was_moved_with_its_video_still_finds_it(sequence, tmp_path, monkeypatch, capsys):
    (tmp_path / "project").mkdir()
    shutil.move(sequence, tmp_path / "project/slide")
    monkeypatch.chdir(tmp_path)
    assert run(Path("project/slide"), Path("project/runs/out"), "--stop", "3") == 0
    assert cli.main(["refine", "project/runs/out", "--quiet"]) == 0
    shutil.move("project", "elsewhere")
    for of in ("out", "out/offline"):
        assert cli.main(["film", f"elsewhere/runs/{of}", "--out", f"{Path(of).name}.gif"]) == 0
    shutil.move("elsewhere/slide", "gone")
    capsys.readouterr()
    assert cli.main(["film", "elsewhere/runs/out", "--out", "again.gif"]) == 2
    assert str(tmp_path / "project/slide") in one_line(capsys, "film")


def test_a_batch_in_other_words_is_refused_and_its_table_stays(sequence, tmp_path, capsys, here):
    here()
    (shelf := tmp_path / "shelf").mkdir()
    shutil.move(sequence, shelf / "one")
    words = ["run", "--batch", str(shelf), "--out", str(tmp_path / "out"), "--jobs", "1", *POINTS_ALONE]
    assert cli.main([*words, *clicks(tmp_path, ("object", 0, [[60, 50]])), "--stop", "2"]) == 0
    capsys.readouterr()
    table = (tmp_path / "out/batch.csv").read_bytes()
    assert cli.main([*words, "--stop", "2"]) == 2
    assert "out/one: the run to go on with: got no --prompts, expected --prompts" in (line := one_line(capsys))
    assert "Nothing was run, and the table is as it was." in line and not (tmp_path / "out/failures").exists()
    assert (tmp_path / "out/batch.csv").read_bytes() == table
    assert cli.main([*words, *clicks(tmp_path, ("object", 0, [[60, 50]])), "--stop", "2", "--skip-bad"]) == 0


def test_a_run_goes_on_from_a_frame_with_other_prompts(sequence, tmp_path, capsys, monkeypatch):
    """As a run that had them from the start; what is said of earlier frames has to stay, and nothing else does."""

    def prompts(*more: Prompt) -> list[str]:
        first = Prompt("object", 0, mask=mask)
        return ["--prompts", str(save_prompts(tmp_path / "p.json", [first, *more]))]

    mask = open_sequence(sequence).masks(0)["object"]
    hidden, gone = Prompt("object", 5, mask=np.zeros_like(mask)), Prompt("gone", 6, mask=mask[::-1, ::-1])
    out, anew, step = tmp_path / "out", tmp_path / "anew", Point2Pose.step
    assert run(sequence, out, *prompts(gone), "--save-masks") == 0
    refined = shutil.copytree(out, tmp_path / "refined")
    (refined / "run.json").write_text(json.dumps(json.loads((out / "run.json").read_text()) | {"offline": True}))
    refined.rename(out / "offline")
    (out / "meshes").mkdir()
    (out / "meshes/object.ply").write_text("of all frames")
    before = contents(out)
    assert {"poses/gone.txt", "masks/gone/000000.png", "offline/poses.npz"} <= before.keys()
    more = [*prompts(hidden), "--save-masks"]
    other = shutil.copy(tmp_path / "p.json", tmp_path / "corrected.json")
    for words, said in (
        (["--resume"], "out: prompts: got"),
        (["--resume"], "Ask for the same, keep the frames before the first change (--from 5), or run it anew"),
        (["--prompts", str(other), "--resume"], f"expected --prompts {tmp_path / 'p.json'}, as it began. Ask for"),
        (["--prompts", str(other), "--resume"], "the first change (--from 5)"),
        (["--prompts", str(other), "--resume", "--seed", "9"], "as it began. Ask for the same, or run it anew"),
        (["--resume", "--from", "6"], "or say --from FRAME of the first change"),
        (["--resume", "--from", "0"], f"from: got frame 0, expected one from 1 to {FRAMES - 1}"),
        (["--resume", "--from", "5", "--seed", "9"], "got --seed 9, expected no --seed, as it began. Ask for the same"),
    ):
        capsys.readouterr()
        assert run(sequence, out, *more, *words) == 2 and said in one_line(capsys)
    assert run(sequence, out, *prompts(), "--save-masks", "--resume", "--from", "7") == 2
    lacks = "prompts: got nothing, expected 'gone' in frame 6: mask_px "
    assert lacks in one_line(capsys)
    assert contents(out) == before
    prompts(hidden)

    def interrupted(self, frame, masks=None):
        if frame.index == 6:
            raise MissingData("frame 6", "a disk that is gone")
        return step(self, frame, masks)

    with monkeypatch.context() as patch:
        patch.setattr(Point2Pose, "step", interrupted)
        assert run(sequence, out, *more, "--resume", "--from", "5") == 2
    assert [path.name for path in sorted((out / "masks").rglob("*.png"))] == [f"{k:06d}.png" for k in range(6)]
    assert not {"keypoints.npz", "masks.npz", "offline/run.json"} & contents(out).keys()
    assert "its frames before 5 are tracked again" in (err := capsys.readouterr().err)
    assert "What p2p refine made of it goes: make it anew afterwards." in err
    assert run(sequence, out, *more, "--resume") == run(sequence, anew, *more) == 0
    capsys.readouterr()
    assert contents(out).keys() == contents(anew).keys()
    mine, theirs = load_run(out), load_run(anew)
    for column in ("status", "T_cam_obj", "reason"):
        np.testing.assert_array_equal(*(getattr(r.objects["object"], column) for r in (mine, theirs)))
    assert mine.objects["object"].status[5] == "occluded" and mine.info["prompts"] == theirs.info["prompts"]
    images = [name for name in contents(anew) if name.startswith("masks/")]
    assert len(images) == FRAMES and all(contents(out)[name] == contents(anew)[name] for name in images)
    assert run(sequence, tmp_path / "none", *more, "--resume", "--from", "5") == 2 and "no run" in one_line(capsys)


def test_without_truth_there_is_no_score_and_no_fuss(sequence, tmp_path, capsys):
    shutil.rmtree(sequence / "annotated_poses")
    assert run(sequence, tmp_path / "out") == 0
    out, err = capsys.readouterr()
    assert "ADD" not in out and err == ""
    assert cli.main(["eval", str(tmp_path / "out"), "--json"]) == 0
    out, err = capsys.readouterr()
    said = json.loads(out)
    assert err == "" and said["truth"] is None and said["objects"]["object"]["reprojection_px"] < 2, "what can be said"


def test_with_truth_and_no_model_both_are_said(sequence, tmp_path, capsys):
    """How far the poses are off, and how well they agree with what the camera saw."""
    shutil.rmtree(sequence / "models")
    assert run(sequence, tmp_path / "out") == 0
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert "reprojection [px]" in out and "object: no model for ADD" in out and "off the truth" in out and err == ""
    assert "Without a model: " in out
    with pytest.raises(SystemExit):
        cli.main(["eval", str(tmp_path / "out"), "--sequence", str(sequence)])
    assert "DIR and --sequence do not go together: --poses" in capsys.readouterr().err


def test_objects_without_truth_are_judged_beside_those_that_are_scored(sequence, tmp_path, capsys):
    masks = open_sequence(sequence).masks(0)
    other = np.roll(next(iter(masks.values())), 20, 1)
    prompts = tmp_path / "prompts.json"
    save_prompts(prompts, [Prompt("object", 0, mask=masks["object"] & ~other), Prompt("other", 0, mask=other)])
    assert run(sequence, tmp_path / "out", "--prompts", str(prompts)) == 0
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "out")]) == 0
    scored, judged = capsys.readouterr().out.split("Without truth: ")
    assert "ADD AUC" in scored and re.search("^object ", scored, re.M) and not re.search("^other ", scored, re.M)
    assert re.search("^other ", judged, re.M) and len(re.findall("^object ", judged, re.M)) == 1, "a heading"
    assert cli.main(["eval", str(tmp_path / "out"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["objects"].keys() == {"object"} and said["others"]["objects"].keys() == {"other"}
    assert said["others"]["objects"]["other"]["verdict"] in ("good", "look", "unknown")


def test_models_that_cannot_be_used_are_said(sequence, tmp_path, capsys):
    shutil.rmtree(sequence / "annotated_poses")
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(SystemExit):
        cli.main(["run", str(sequence), "--out", str(tmp_path / "out"), "--frames", "10"])
    assert "no option --frames" in (said := capsys.readouterr().err) and "--force" not in said
    assert run(sequence, tmp_path / "out", "--models", f"nobody={mesh}") == 2
    assert run(sequence, tmp_path / "out") == 0
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "out"), "--models", f"nobody={mesh}"]) == 2
    assert "expected one of the objects: object" in capsys.readouterr().err
    assert cli.main(["eval", str(tmp_path / "out"), "--models", f"object={mesh}"]) == 0
    assert "--models is not used" in capsys.readouterr().err


def test_depth_whose_scale_moves_is_doubted_before_anything_is_tracked(sequence, tmp_path, capsys):
    for k, path in enumerate(sorted((sequence / "depth").iterdir())):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.rint(depth * (1 + 0.06 * (k % 2))).astype(np.uint16))
    run(sequence, tmp_path / "out", "--stop", "4")
    first = capsys.readouterr().err.splitlines()[0]
    said = r"depth: all depth changes by [67] % from frame \d to \d\. .* See p2p check"
    assert re.match(f"p2p run: {said}", first)
    assert re.match(said, json.loads((tmp_path / "out/run.json").read_text())["doubts"][0]["text"])


def test_a_frame_that_cannot_be_read_ends_a_run_or_is_left_out_and_counted(sequence, tmp_path, capsys, monkeypatch):
    (sequence / "depth/0002.png").unlink()
    assert run(sequence, tmp_path / "run") == 2
    assert "0002.png is missing. p2p run --skip-bad goes on" in capsys.readouterr().err
    loud = [word for word in POINTS_ALONE if word != "--quiet"]
    words = [str(sequence), "--out", str(tmp_path / "run"), *loud, "--skip-bad", "--save-masks"]
    assert cli.main(["run", *words]) == 0
    said = capsys.readouterr()
    assert re.search(r"7 of 8 frames.*; 1 left out, which cannot be read, the first: .*0002\.png", said.out)
    assert re.search(r", 1 left out: 100%.* 8/8 ", said.err)
    kept = load_run(tmp_path / "run")
    assert (
        kept.objects["object"].frame_index.tolist() == [0, 1, 3, 4, 5, 6, 7] and kept.objects["object"].has_pose.all()
    )
    assert list(kept.info["left_out"]) == ["2"] and "0002.png" in kept.info["left_out"]["2"]
    assert cli.main(["eval", str(tmp_path / "run")]) == 0
    assert cli.main(["film", str(tmp_path / "run"), "--out", str(tmp_path / "film.webp")]) == 0
    assert cli.main(["export", str(tmp_path / "run"), "--format", "tum", "--out", str(tmp_path / "tum")]) == 0
    assert len(np.loadtxt(tmp_path / "tum/object.txt")) == 7
    monkeypatch.setattr("p2p_lib.apps.click.wait_for_clicks", lambda page, *_: page.prompts)
    click = ["click", str(sequence), "--out", str(tmp_path / "prompts.json")]
    assert cli.main([*click, "--run", str(tmp_path / "run")]) == 0, "what the run left out, it can be corrected without"
    assert cli.main(click) == 0, "and others are clicked on"
    assert run(sequence, tmp_path / "run", "--skip-bad", "--save-masks", "--resume") == 0


def test_a_run_that_a_bad_image_ended_goes_on_without_it(sequence, tmp_path, capsys):
    (sequence / "depth/0005.png").write_bytes(b"no image")
    assert run(sequence, tmp_path / "run") == 2 and "--skip-bad" in capsys.readouterr().err
    assert run(sequence, tmp_path / "run", "--skip-bad", "--resume") == 0
    assert load_run(tmp_path / "run").objects["object"].frame_index.tolist() == [0, 1, 2, 3, 4, 6, 7]


def test_the_first_image_may_be_the_bad_one(sequence, tmp_path, capsys):
    """By it the size of all is known, and of floats their unit."""
    for path in (sequence / "depth").iterdir():
        np.save(path.with_suffix(".npy"), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / np.float32(1000))
        path.unlink()
    shutil.copytree(sequence / "gt_mask", sequence / "masks")
    for bad in ("rgb/0000.png", "depth/0000.npy"):
        (sequence / bad).write_bytes(b"no image")
        assert run(sequence, tmp_path / "run", "--format", "folder") == 2
        assert bad in (err := capsys.readouterr().err) and "p2p run --skip-bad goes on without such frames" in err
        assert run(sequence, tmp_path / "run", "--format", "folder", "--skip-bad", "--force") == 0
        (obj,) = load_run(tmp_path / "run").objects.values()
        assert obj.frame_index.tolist() == list(range(1, FRAMES)) and obj.has_pose.all()
        shutil.rmtree(tmp_path / "run")
        shutil.copy(sequence / "rgb/0001.png", sequence / "rgb/0000.png")
    for path in (sequence / "rgb").iterdir():
        path.write_bytes(b"no image")
    assert run(sequence, tmp_path / "run", "--format", "folder", "--skip-bad") == 2
    assert "rgb: got 8 files that cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    "masks, kept, told", [("first", False, True), ("first", True, False), ("dataset", False, False)]
)
def test_a_film_says_where_it_has_no_masks_to_draw(sequence, tmp_path, capsys, masks, kept, told):
    """An offline run's are in the folder above, and the dataset's own need not be kept."""
    words = ["--stop", "3", "--masks", masks, *["--save-masks"] * kept]
    assert run(sequence, tmp_path / "run", *words) == 0
    shutil.copytree(tmp_path / "run", tmp_path / "run/offline", ignore=shutil.ignore_patterns("masks"))
    info = json.loads((tmp_path / "run/offline/run.json").read_text())
    (tmp_path / "run/offline/run.json").write_text(json.dumps(info | {"masks_in": ".."}))
    for of in ("run", "run/offline"):
        capsys.readouterr()
        assert cli.main(["film", str(tmp_path / of), "--out", str(tmp_path / "film.webp")]) == 0
        assert ("no masks were kept" in capsys.readouterr().err) == told


def test_a_torn_frame_is_left_out_too_but_not_one_that_a_prompt_is_made_on(sequence, tmp_path, capsys):
    for k in (0, 3):
        (sequence / f"depth/000{k}.png").write_bytes(b"torn")
    (tmp_path / "prompts.json").write_text('{"objects": [{"name": "board", "frame": 1, "points": [[60, 50]]}]}')
    clicks = ["--prompts", str(tmp_path / "prompts.json"), "--skip-bad"]
    assert run(sequence, tmp_path / "run", *clicks) == 0
    assert re.search("6 of 8 frames.*; 2 left out", capsys.readouterr().out)
    (sequence / "depth/0001.png").write_bytes(b"torn")
    assert run(sequence, tmp_path / "other", *clicks) == 2
    assert "0001.png" in (err := capsys.readouterr().err) and "A prompt needs this frame." in err
    assert "Click in another one (p2p click), or give a mask of one." in err and "--skip-bad" not in err


def test_a_known_size_that_does_not_fit_is_to_be_looked_at(sequence, tmp_path, capsys):
    """The board is 60 px wide half a metre away: 15 cm."""
    run(sequence, tmp_path / "run", "--size", "object=15")
    fits = re.compile(
        r"^object: measured 1\d\.\d cm in its masks, 15 cm given: fits, as \d+ to \d+ cm would$", re.MULTILINE
    )
    assert "known to be" not in (out := capsys.readouterr().out) and fits.search(out)
    run(sequence, tmp_path / "other", "--size", "object=7")
    assert re.search(
        r"object: known to be 7 cm long, measured 1\d\.\d cm in its masks, 2\.\d+ times", capsys.readouterr().out
    )
    assert cli.main(["eval", str(tmp_path / "other")]) == 0
    assert "known to be 7 cm long" in capsys.readouterr().err, "as the run was told"
    assert cli.main(["eval", str(tmp_path / "other"), "--size", "object=15"]) == 0
    assert "known to be" not in (said := capsys.readouterr()).err and fits.search(said.out)
    assert cli.main(["eval", str(tmp_path / "run"), "--json"]) == 0
    assert "fits" not in capsys.readouterr().out
    assert cli.main(["eval", str(tmp_path / "run"), "--size", "object=40"]) == 0
    assert "its length was never in view, or focal length" in capsys.readouterr().err
    third = ["run", str(sequence), "--out", str(tmp_path / "third")]
    for words in (["eval", str(tmp_path / "run")], third, ["check", str(sequence)]):
        assert cli.main([*words, "--size", "mug=9"]) == 2
        said = capsys.readouterr().err
        assert "size: got the name 'mug', expected one of the objects: object" in said
        assert ("--prompts FILE" in said) == (words[0] == "check"), "which reads names there where it is given"
    assert cli.main(["eval", str(tmp_path / "run"), "--size", "object=long"]) == 2
    assert "its longest side in centimetres" in capsys.readouterr().err
    shutil.rmtree(sequence / "annotated_poses")
    run(sequence, tmp_path / "bare", "--size", "object=7")
    assert capsys.readouterr() and cli.main(["eval", str(tmp_path / "bare")]) == 0
    assert (said := capsys.readouterr()).out.count("known to be") == 1 and "known to be" not in said.err, "said once"


def test_a_surface_that_is_exactly_flat_is_measured_and_drawn(pristine, tmp_path, capsys):
    """The board's side is 14.4 cm of surface: no 20, as along its diagonal."""
    out, words = str(tmp_path / "run"), ["--stop", "4", "--quiet", "--size", "object=15"]
    assert cli.main(["run", str(pristine), "--out", out, *words]) == 0
    assert np.ptp(trimesh.load_mesh(tmp_path / "run/meshes/object.ply").vertices[:, 2]) == 0
    assert cli.main(["eval", out, "--size", "object=15"]) == 0
    said = capsys.readouterr()
    assert "known to be" not in said.out + said.err
    assert cli.main(["eval", out, "--size", "object=7"]) == 0
    assert re.search(r"1[45]\.\d cm of its surface", capsys.readouterr().err)
    assert cli.main(["film", out, "--out", str(tmp_path / "film.webp")]) == 0


def test_why_a_run_is_not_scored_is_said_once(sequence, tmp_path, capsys):
    """Behind what says already which run it is."""
    shutil.rmtree(sequence / "models")
    assert run(sequence, tmp_path / "run") == 0
    assert "first_masks.png; not scored, object: no model for ADD" in capsys.readouterr().out
    assert cli.main(["eval", str(tmp_path / "run")]) == 0
    assert "Not scored: object: no model for ADD" in capsys.readouterr().out


def test_config_explains_every_parameter_and_how_the_presets_differ(capsys):
    from p2p_lib.core.config import diff, parameters, preset

    assert cli.main(["config", "--json"]) == 0
    rows = {row["key"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["tsdf.voxel_m"]["unit"] == "m" and all(row["meaning"].endswith(".") for row in rows.values())
    assert [row["key"] for row in parameters(preset())] == list(rows)
    assert cli.main(["config", "--diff", "--json"]) == 0
    differ = {row["key"]: (row["paper"], row["value"]) for row in json.loads(capsys.readouterr().out)}
    assert differ == diff()
    assert cli.main(["config", "--diff", "registration.iterations", "--preset", "paper"]) == 0
    assert "iterations = 100 [release], preset default: 400 [ours]\n" in capsys.readouterr().out
    assert cli.main(["config", "tsdf", "--set", "tsdf.voxel_m=0.007"]) == 0
    out = capsys.readouterr().out
    assert out.startswith('# tsdf: the reconstructed surface (section "3D Reconstruction").\ntsdf.voxel_m = 0.007 m\n')
    assert "\n    A voxel has this edge. [ours]" in out and "registration." not in out
    assert cli.main(["config", "tsdff"]) == 2
    assert "Did you mean tsdf?" in capsys.readouterr().err


def test_log_says_what_becomes_of_objects(sequence, tmp_path, capsys, caplog):
    assert run(sequence, tmp_path / "out", "--stop", "3", "--log", "info") == 0
    assert any("frame 0: object begins, is tracked" in message for message in caplog.messages)


def test_where_nothing_was_tracked_it_says_what_to_do(sequence, tmp_path, capsys):
    shutil.rmtree(sequence / "annotated_poses")
    shutil.move(sequence / "gt_mask", sequence / "masks")
    for k, path in enumerate((sequence / "depth").iterdir()):
        cv2.imwrite(str(path), np.full((H, W), 9000 + k, np.uint16))
    assert run(sequence, tmp_path / "out") == 2
    out, err = capsys.readouterr()
    assert "Next: p2p view" not in out and err.count("\n") == 2  # at the first masks, and at the end
    assert "object never had a pose (only 0 mask pixels with depth)" in err and "--depth-scale" in err
    assert err.endswith(f"Next: p2p check {sequence}\n")
    assert run(sequence, tmp_path / "out", "--depth-scale", "0.001", "--force") == 2
    assert capsys.readouterr().err.endswith(f"Next: p2p check {sequence} --depth-scale 0.001\n")
    for path in (sequence / "masks").iterdir():
        cv2.imwrite(str(path), np.zeros((H, W), np.uint8))
    assert run(sequence, tmp_path / "empty") == 2
    out, err = capsys.readouterr()
    assert "its masks are empty or too small" in err
    assert (
        f" where a mask is wrong (object never started): p2p click {sequence} --run {tmp_path / 'empty'} --out" in out
    )
    shutil.rmtree(sequence / "masks")
    assert run(sequence, tmp_path / "none") == 2
    assert "p2p click" in (line := one_line(capsys)) and "--prompts" in line
    prompts = clicks(tmp_path, ("object", 0, ON_BOARD))
    assert run(sequence, tmp_path / "none", *prompts, "--masks", "dataset") == 2
    assert one_line(capsys).endswith("Leave --masks out: the prompts start the objects.\n")


def test_what_never_started_for_want_of_a_mask_is_clicked_on_anew(sequence, tmp_path, capsys):
    """However much its doubts speak of depth; what follows works, whether masks were kept or not."""
    few = ["--set", "lifecycle.min_mask_px=100000"]
    assert run(sequence, tmp_path / "out", *clicks(tmp_path, ("wall", 0, [[5, 5], [150, 110]])), *few) == 2
    out, err = capsys.readouterr()
    assert "check that depth is in metres" in err and "click on another place" in err and "--depth-scale" not in err
    again = shlex.split(out.partition("(wall never started): p2p ")[2])[:-1]
    assert "p2p view" not in out and again == ["click", str(sequence), "--run", str(tmp_path / "out"), "--out"]
    with Clicker(open_sequence(sequence), tmp_path / "new.json", run=load_run(tmp_path / "out")) as page:
        assert [prompt.name for prompt in page.prompts] == ["wall"] and page.kept_masks(0) == {}


def test_a_scenario_is_known_by_the_name_that_run_takes(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        "p2p_lib.synthetic.write_sequence",
        lambda name, out, *more, **how: made.append((name, how["progress"], how["stop"])) or out,
    )
    for more in ([], ["--quiet", "--stop", "5"]):
        assert cli.main(["synth", "synthetic/crossing", "--out", str(tmp_path), *more]) == 0
    assert made == [("crossing", True, None), ("crossing", False, 5)], "what it is, whether progress is shown, how much"


def test_the_list_of_scenarios_has_no_markup(capsys):
    assert cli.main(["synth", "--list"]) == 0
    assert "`" not in capsys.readouterr().out


def test_a_benchmark_without_its_data_says_so_first(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("P2P_DATA", raising=False)
    assert cli.main(["benchmark", "ycbineoat", "--out", str(tmp_path), "--quiet"]) == 2
    first, *_, last = capsys.readouterr().err.splitlines()
    assert "$P2P_DATA is not set" in first and "--quick" in first and "nothing ran" in last
    monkeypatch.setenv("COLUMNS", "200")  # a test's worker may have a narrow one
    assert cli.main(["benchmark", "--list"]) == 0
    first, *table = capsys.readouterr().out.splitlines()
    assert any(re.match(r"\d+ of 20 plans can run here and now in full; \d+ of \d+ methods", line) for line in table)
    assert any(re.match(r"ycbineoat +0 of 63 +YCBInEOAT, the paper's$", line) for line in table)
    assert any(re.match(r"ablation +0 of 156 .*; here: ablation_embedded$", line) for line in table)
    assert any(re.match(r"sampling_embedded +18 of 30 ", line) for line in table)
    assert max(map(len, [first, *table])) <= 100
    assert cli.main(["benchmark", "--list", "ycbineoat", "runtime"]) == 0
    listed = " ".join(capsys.readouterr().out.split())
    assert "YCBInEOAT (tab:ycb_ineoat)" in listed and "runtime Runtime" in listed
    assert (
        "0 of 9 sequences; else: ycbineoat/bleach0: not below $P2P_DATA" in listed and "p2p data fetch tapir" in listed
    )
    monkeypatch.setenv("COLUMNS", "72")
    assert cli.main(["benchmark", "--list", "ycbineoat"]) == 0
    lines = capsys.readouterr().out
    plan = lines.partition("Data and weights")[0].splitlines()
    assert max(map(len, lines.splitlines())) <= 72 and " ".join(" ".join(plan).split()) in " ".join(listed.split())


# --- what does not: one line, exit code 2 ------------------------------------------------------


def one_line(capsys, command: str = "run") -> str:
    """The only line of stderr; nothing on stdout, no traceback."""
    out, err = capsys.readouterr()
    assert out == "" and err.endswith("\n") and err.count("\n") == 1, err
    assert err.startswith(f"p2p {command}: ") and "Traceback" not in err
    return err


def spoil(path: Path, content: bytes | None) -> None:
    path.unlink() if content is None else path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def image(path: Path, array: np.ndarray) -> None:
    cv2.imwrite(str(path), array)


def no_pictures(s: Path) -> None:
    for path in [*(s / "rgb").iterdir(), *(s / "depth").iterdir()]:
        path.unlink()


BAD_FILES = {
    "missing picture": (
        lambda s: spoil(s / "rgb/0003.png", None),
        ["depth: got 8 files, expected 7", "slide/rgb", "0003.png"],
    ),
    "missing depth": (lambda s: spoil(s / "depth/0003.png", None), ["depth", "7 files", "0003.png is missing"]),
    "cut picture": (lambda s: cut(s / "rgb/0003.png"), ["rgb/0003.png", "unreadable"]),
    "empty picture": (lambda s: spoil(s / "rgb/0000.png", b""), ["rgb/0000.png", "unreadable file of 0 bytes"]),
    "cut depth": (lambda s: cut(s / "depth/0004.png"), ["depth/0004.png", "unreadable"]),
    "small depth": (
        lambda s: image(s / "depth/0002.png", np.ones((60, 80), np.uint16)),
        ["depth/0002.png", "80x60", "160x120"],
    ),
    "8-bit depth": (lambda s: image(s / "depth/0001.png", np.ones((H, W), np.uint8)), ["depth/0001.png", "uint8"]),
    "small mask": (lambda s: image(s / "gt_mask/0002.png", np.ones((6, 8), np.uint8)), ["gt_mask/0002.png", "8x6"]),
    "empty sequence": (no_pictures, ["rgb", "no files"]),
    "no depth folder": (lambda s: shutil.rmtree(s / "depth"), ["depth"]),
    "K of two rows": (lambda s: spoil(s / "cam_K.txt", b"600 0 320\n0 600 240\n"), ["cam_K.txt", "6 numbers", "3x3"]),
    "K of words": (lambda s: spoil(s / "cam_K.txt", b"fx fy cx\n"), ["cam_K.txt", "'fx'", "3x3"]),
    "K transposed": (lambda s: np.savetxt(s / "cam_K.txt", K.T), ["cam_K.txt", "fx 0 cx 0 fy cy 0 0 1"]),
    "no K": (lambda s: spoil(s / "cam_K.txt", None), ["cam_K.txt"]),
    "NaN pose": (
        lambda s: np.savetxt(s / "annotated_poses/0005.txt", np.full((4, 4), np.nan)),
        ["annotated_poses/0005.txt", "NaN", "4x4"],
    ),
    "pose of three rows": (
        lambda s: np.savetxt(s / "annotated_poses/0005.txt", np.eye(4)[:3]),
        ["annotated_poses/0005.txt", "(3, 4)"],
    ),
    "model of words": (lambda s: spoil(s / "models/object/points.xyz", b"a b c\n"), ["points.xyz", "unreadable"]),
    "times of words": (lambda s: spoil(s / "times.txt", b"now\nthen\n"), ["times.txt", "'now'"]),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_named_in_one_line(case, sequence, tmp_path, capsys):
    ruin, words = BAD_FILES[case]
    ruin(sequence)
    assert run(sequence, tmp_path / "out") == 2
    line = one_line(capsys)
    assert all(word in line for word in words), line


BAD_WORDS = {
    "no such folder": (["run", "{seq}x", "--out", "{out}"], ["slidex", "no such folder", "synthetic/crossing"]),
    "a file for a folder": (["run", "{seq}/cam_K.txt", "--out", "{out}"], ["cam_K.txt", "got a file, expected"]),
    "a folder within": (["run", "{seq}/rgb", "--out", "{out}"], ["slide/rgb", "0000.png", "folder that it is in"]),
    "nothing known": (["run", "{done}/poses", "--out", "{out}"], ["poses", "object.txt", "--format"]),
    "unknown synthetic": (["run", "synthetic/corssing", "--out", "{out}"], ["corssing", "crossing"]),
    "unknown object": (["run", "{seq}", "--out", "{out}", "--objects", "mug"], ["objects: got 'mug'", "object"]),
    "object twice": (["run", "{seq}", "--out", "{out}", "--objects", "object,object"], ["'object'"]),
    "unknown tracker": (["run", "{seq}", "--out", "{out}", "--tracker", "nope"], ["tracker: got 'nope'", "one of"]),
    "unknown preset": (
        ["run", "{seq}", "--out", "{out}", "--preset", "papr"],
        ["preset: got 'papr'", "Did you mean paper?"],
    ),
    "unknown format": (["run", "{seq}", "--out", "{out}", "--format", "bop5"], ["format: got 'bop5'", "ycbineoat"]),
    "unknown masks": (["run", "{seq}", "--out", "{out}", "--masks", "sam9"], ["sam9: no such folder of masks", "sam2"]),
    "misspelt masks": (["run", "{seq}", "--out", "{out}", "--masks", "click"], ["Did you mean clicks?"]),
    "no mask folder": (["run", "{seq}", "--out", "{out}", "--masks", "dataset:"], ["masks: got 'dataset:'"]),
    "mask folder missing": (["run", "{seq}", "--out", "{out}", "--masks", "dataset:nowhere"], ["nowhere"]),
    "unknown key": (
        ["run", "{seq}", "--out", "{out}", "--set", "sampling.pionts=3"],
        ["'sampling.pionts'", "Did you mean sampling.points"],
    ),
    "bad value": (["run", "{seq}", "--out", "{out}", "--set", "sampling.points=few"], ["sampling.points", "'few'"]),
    "value out of bounds": (["run", "{seq}", "--out", "{out}", "--set", "sampling.points=0"], ["sampling.points", "0"]),
    "no value": (["run", "{seq}", "--out", "{out}", "--set", "sampling.points"], ["--set", "stage.key=value"]),
    "no config": (["run", "{seq}", "--out", "{out}", "--config", "{seq}/no.toml"], ["no.toml", "no such"]),
    "config is no TOML": (["run", "{seq}", "--out", "{out}", "--config", "{seq}/cam_K.txt"], ["cam_K.txt", "TOML"]),
    "config is a folder": (["run", "{seq}", "--out", "{out}", "--config", "{seq}"], ["slide", "TOML"]),
    "unknown stage": (
        ["run", "{seq}", "--out", "{out}", "--set", "foo.bar=1"],
        ["'foo.bar'", "stage.key", "lifecycle, "],
    ),
    "unknown scenario": (
        ["synth", "crosing", "--out", "{out}"],
        ["got 'crosing' (Did you mean synthetic/crossing?), expected"],
    ),
    "click into a file": (["click", "{seq}", "--out", "{seq}/cam_K.txt/x"], ["cam_K.txt/x", "can be written"]),
    "click into a folder": (["click", "{seq}", "--out", "{seq}/rgb"], ["slide/rgb", "a folder"]),
    "negative seed": (["run", "{seq}", "--out", "{out}", "--seed", "-1"], ["seed", "-1"]),
    "depth scale": (["run", "{seq}", "--out", "{out}", "--depth-scale", "1000"], ["depth_scale", "1000"]),
    "start beyond the end": (["run", "{seq}", "--out", "{out}", "--start", "8"], ["start 8", "8 frames"]),
    "stop before start": (["run", "{seq}", "--out", "{out}", "--start", "4", "--stop", "4"], ["start 4", "stop 4"]),
    "negative start": (["run", "{seq}", "--out", "{out}", "--start", "-1"], ["start -1"]),
    "model without path": (["run", "{seq}", "--out", "{out}", "--models", "object"], ["--models", "NAME=PATH"]),
    "model not there": (["run", "{seq}", "--out", "{out}", "--models", "object=/no.obj"], ["/no.obj", "no such model"]),
    "model of nobody": (["run", "{seq}", "--out", "{out}", "--models", "mug={seq}"], ["'mug'", "object"]),
    "out is a file": (["run", "{seq}", "--out", "{seq}/cam_K.txt"], ["cam_K.txt", "a folder for the results"]),
    "out within a file": (["run", "{seq}", "--out", "{seq}/cam_K.txt/x"], ["cam_K.txt/x: got what cannot be written"]),
    "out is no place to write": (
        ["export", "{done}", "--format", "tum", "--out", "/proc/x"],
        ["--out /proc/x: got what cannot be written", "expected a folder that can be written. Name another one."],
    ),
    "film into a folder": (["film", "{done}", "--out", "{seq}"], ["--out", "slide: got a folder, expected a file"]),
    "a film that cannot be": (
        ["run", "{seq}", "--out", "{out}", "--overlay", "/proc/x.mp4"],
        ["--overlay /proc/x.mp4"],
    ),
    "export of too little": (
        ["export", "{done}", "--format", "tum", "--out", "{out}", "--min-confidence", "-0.1"],
        ["min_confidence", "-0.1"],
    ),
    "labels of too much": (
        ["export", "{done}", "--format", "bop-dataset", "--out", "{out}", "--min-confidence", "1"],
        ["min_confidence", "got 1", "below 1"],
    ),
    "no run": (["eval", "{seq}"], ["slide", "no run there", "p2p run SEQ --out"]),
    "eval nowhere": (["eval", "{seq}/none", "--json"], ["none", "no run there"]),
    "eval unknown model": (["eval", "{done}", "--models", "mug={seq}"], ["'mug'", "object"]),
    "eval model not there": (["eval", "{done}", "--models", "object=/no.obj"], ["/no.obj"]),
    "eval scores nothing": (["eval", "{done}", "--min-visible-px", "99999"], ["nothing to score", "99999"]),
}


@pytest.mark.parametrize("case", BAD_WORDS)
def test_bad_words_are_answered_in_one_line(case, sequence, done, tmp_path, capsys):
    words, expected = BAD_WORDS[case]
    words = [word.format(seq=sequence, out=tmp_path / "out", done=done) for word in words]
    more = POINTS_ALONE if words[0] == "run" else []
    assert cli.main([*words[:2], *more, *words[2:]]) == 2
    line = one_line(capsys, words[0])
    assert all(word in line for word in expected), line


def test_an_export_says_how_many_poses_it_leaves_out(done, tmp_path, capsys):
    shutil.copytree(done, tmp_path / "run")
    with np.load(tmp_path / "run/poses.npz") as kept:
        parts = dict(kept)
    (key,) = (key for key in parts if key.endswith("confidence"))
    parts[key][:3] = 0.2
    np.savez(tmp_path / "run/poses.npz", **parts)
    words = ["export", str(tmp_path / "run"), "--format", "tum", "--out"]
    assert cli.main([*words, str(tmp_path / "some"), "--min-confidence", "0.3"]) == 0
    left_out = f"3 of {len(parts[key])} poses left out, of a confidence below 0.3"
    assert left_out in capsys.readouterr().err
    assert cli.main([*words, str(tmp_path / "all")]) == 0 and "left out" not in capsys.readouterr().err


DAMAGE = {
    "run.json cut": (lambda out: cut(out / "run.json"), ["run.json", "unreadable"]),
    "poses.npz cut": (lambda out: cut(out / "poses.npz"), ["poses.npz", "unreadable"]),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_run_is_named(case, done, tmp_path, capsys):
    out = Path(shutil.copytree(done, tmp_path / "copy"))
    ruin, words = DAMAGE[case]
    ruin(out)
    assert cli.main(["eval", str(out), "--json"]) == 2
    line = one_line(capsys, "eval")
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "COMMAND"),
        (["fly"], "'fly'"),
        (["run", "--out", "y"], "SEQ"),
        (["run", "x"], "--out"),
        (["run", "x", "--out", "y", "--seed", "one"], "'one'"),
        (["run", "x", "--out", "y", "--start", "1.5"], "'1.5'"),
        (["run", "x", "--out", "y", "--turbo"], "--turbo"),
        (["eval"], "DIR"),
        (["rum", "x"], "Did you mean run?"),
        (["run", "x", "--ouput", "y"], "no option --ouput. Did you mean --out?"),
        (["live", "--camera", "x", "--quiet"], "no option --quiet. See p2p live --help"),
        (
            ["run", "x", "--out", "y", "--memory", "a.npz", "b.npz"],
            "b.npz. --memory takes one path: give the run's folder",
        ),
        (["check", "x", "--jsn"], "no option --jsn. Did you mean --json? See p2p check --help"),
        (["eval", "x", "--align", "best"], "'best'"),
        (["run", "x", "--out", "y", "--frozen"], "--frozen keeps the maps of --memory"),
        (["run", "--batch", "x", "--out", "y", "--frozen"], "--frozen keeps the maps of --memory"),
        (["live", "--camera", "folder:x", "--frozen"], "--frozen keeps the maps of --memory"),
    ],
)
def test_words_that_are_no_command_point_to_the_help(words, says, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(words)
    assert left.value.code == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and says in err
    assert "See p2p" in err and err.rstrip().endswith("--help")


@pytest.mark.parametrize("words", [["run", "nowhere", "--out", "x"], ["live", "--camera", "nowhere:Camera"]])
def test_a_device_that_is_not_there_is_said_before_anything_is_waited_for(words, capsys, monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert cli.main([*words, "--device", "cuda", *["--quiet"] * (words[0] == "run")]) == 2
    assert "device cuda: PyTorch finds no CUDA device here" in one_line(capsys, words[0])


def test_debug_shows_where_it_went_wrong(sequence, tmp_path, capsys):
    words = ["run", str(sequence), "--out", str(tmp_path / "out"), "--tracker", "nope", "--quiet"]
    assert cli.main([*words, "--debug"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("Traceback") and "make_tracker" in err and "tracker: got 'nope'" in err


# --- clicks ------------------------------------------------------------------------------------


def clicks(folder: Path, *objects: tuple) -> list[str]:
    """--prompts with a file of these (name, frame, points)."""
    content = {"objects": [{"name": n, "frame": k, "points": points} for n, k, points in objects]}
    (folder / "prompts.json").write_text(json.dumps(content))
    return ["--prompts", str(folder / "prompts.json")]


ON_BOARD = [[45, 40], [60, 50], [70, 70]]  # at frame 0; it moves by (2, 1) a frame


def test_clicks_replace_masks(sequence, tmp_path, capsys):
    shutil.rmtree(sequence / "gt_mask")
    out = tmp_path / "out"
    assert run(sequence, out, *clicks(tmp_path, ("object", 0, ON_BOARD)), "--save-masks") == 0
    done = load_run(out)
    assert (done.info["masks"], done.info["segmenter"]) == ("clicks", "builtin")
    assert done.info["prompts"][0]["points"] == ON_BOARD
    assert done.objects["object"].has_pose.all()
    for k in range(FRAMES):
        mask = cv2.imread(str(out / "masks" / "object" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        truth = np.zeros((H, W), bool)
        truth[20 + k : 80 + k, 30 + 2 * k : 90 + 2 * k] = True
        assert mask.shape == (H, W) and set(np.unique(mask)) == {0, 255}
        assert ((mask > 0) & truth).sum() / ((mask > 0) | truth).sum() > 0.9
    # The kept masks are a source of masks like any other, and a new run clears them away.
    again = tmp_path / "again"
    assert run(sequence, again, "--masks", f"dataset:{out / 'masks'}") == 0
    assert load_run(again).objects["object"].has_pose.all() and not (again / "masks").exists()
    assert run(sequence, out, *clicks(tmp_path, ("object", 0, ON_BOARD)), "--stop", "2", "--force") == 0
    assert not list((out / "masks").rglob("*.png"))


def masks_kept(out: Path) -> list[np.ndarray]:
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0 for path in sorted((out / "masks" / "object").iterdir())]


def truth(k: int) -> np.ndarray:
    mask = np.zeros((H, W), bool)
    mask[20 + k : 80 + k, 30 + 2 * k : 90 + 2 * k] = True
    return mask


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return (one & other).sum() / (one | other).sum()


@pytest.mark.parametrize("source", ["first", "clicks", "builtin"])
def test_a_run_starts_from_first_masks_or_from_clicks_drawn_in_them(source, sequence, tmp_path):
    """The masks of later frames are not used: here they are of something else."""
    for k in range(1, FRAMES):
        cv2.imwrite(str(sequence / "gt_mask" / f"{k:04d}.png"), np.roll(truth(k), 50, 1).astype(np.uint8))
    out = tmp_path / "out"
    assert run(sequence, out, "--masks", source, "--save-masks", "--seed", "4") == 0
    assert all(iou(mask, truth(k)) > 0.9 for k, mask in enumerate(masks_kept(out)))
    info = load_run(out).info
    assert (info["masks"], info["segmenter"]) == ("first" if source == "first" else "clicks", "builtin")
    (prompt,) = info["prompts"]
    if source == "first":
        assert prompt == {"name": "object", "frame": 0, "mask_px": 3600}
    else:  # which starts the same run again
        again = tmp_path / "again"
        (tmp_path / "p.json").write_text(json.dumps({"objects": info["prompts"]}))
        assert run(sequence, again, "--prompts", str(tmp_path / "p.json"), "--save-masks", "--seed", "4") == 0
        assert all((a == b).all() for a, b in zip(masks_kept(out), masks_kept(again), strict=True))


def test_masks_of_some_frames_count_where_they_are_and_corrections_between_them(sequence, tmp_path):
    """A wrong mask in frame 3 is used as it is; clicks in frame 5 mend what followed from it."""
    drawn, out = sequence / "drawn", tmp_path / "out"
    drawn.mkdir()
    wrong = np.roll(truth(3), 12, 0)
    for k, mask in ((0, truth(0)), (3, wrong)):
        cv2.imwrite(str(drawn / f"{k:04d}.png"), mask.astype(np.uint8))
    at = [[45 + 10, 40 + 5], [70 + 10, 70 + 5]]
    assert run(sequence, out, "--masks", "drawn", *clicks(tmp_path, ("object", 5, at)), "--save-masks") == 0
    kept = masks_kept(out)
    np.testing.assert_array_equal(kept[3], wrong)
    assert all(iou(kept[k], truth(k)) > 0.9 for k in (0, 1, 2, 5, 6, 7))
    info = load_run(out).info
    assert (info["masks"], [p["frame"] for p in info["prompts"]]) == ("drawn", [5])


def test_a_run_says_how_many_poses_it_doubts(made):
    name, obj = next(iter(made.run.objects.items()))
    sure, posed = np.ones(len(obj)), np.flatnonzero(obj.has_pose)
    doubtful = sure.copy()
    doubtful[posed[:3]] = 0.5, 0.5, 0.1
    for confidence, words in ((sure, f"{len(obj)} frames"), (doubtful, "3 of them doubted (confidence at most 0.5)")):
        doubted = replace(made.run, objects={name: replace(obj, confidence=confidence)})
        _, line = summary(doubted, len(obj))
        assert words in line and ("doubted" in line) == (confidence is doubtful)


def test_a_run_says_what_mostly_kept_an_object_from_a_pose(made):
    name, obj = next(iter(made.run.objects.items()))
    other = replace(obj, T_cam_obj=np.where(np.arange(len(obj))[:, None, None] < 3, obj.T_cam_obj, np.nan))
    lost = replace(other, status=np.full(len(obj), "lost"), reason=np.full(len(obj), "no points agree"))
    twice = replace(lost, status=np.where(np.arange(len(obj)) < len(obj) - 1, "lost", "occluded"))
    n = len(obj) - 3
    for some, words in (
        (other, f"; in the other {n} mostly followed in another map, never joined with the one that is kept"),
        (lost, f"; in the other {n} lost: no points agree"),
        (twice, f"; in the other {n} mostly lost: no points agree"),
        (replace(lost, T_cam_obj=np.full_like(obj.T_cam_obj, np.nan)), "; lost: no points agree"),
    ):
        _, line = summary(replace(made.run, objects={name: some}), len(obj))
        assert words in line


def test_a_folder_of_ones_own_may_have_masks_of_some_images(sequence, tmp_path, capsys):
    """Named as their images, in a folder per object; images without one are the segmenter's."""
    own = tmp_path / "own"
    for name in ("rgb", "depth"):
        shutil.copytree(sequence / name, own / name)
    shutil.copy(sequence / "cam_K.txt", own)
    (own / "masks" / "board").mkdir(parents=True)
    for k in (0, 4):
        cv2.imwrite(str(own / "masks" / "board" / f"{k:04d}.png"), truth(k).astype(np.uint8))
    assert run(own, tmp_path / "out") == 0
    assert re.search(r"board: a pose in 8 of 8 frames; \d+(\.\d)? cm long by its masks", capsys.readouterr().out)
    K = np.loadtxt(own / "cam_K.txt")
    np.savetxt(own / "cam_K.txt", K * [[2], [2], [1]])
    assert run(own, tmp_path / "other", "--stop", "1") == 0
    assert "p2p run: camera: K has its centre at" in capsys.readouterr().err
    np.savetxt(own / "cam_K.txt", K)
    assert run(own, tmp_path / "out", "--start", "1", "--stop", "4") == 2
    assert "none in frames 1 to 3" in capsys.readouterr().err


def test_what_is_hardly_meant_is_said_in_one_line(sequence, tmp_path, capsys):
    assert run(sequence, tmp_path / "out", *clicks(tmp_path, ("object", 0, [[140, 100]])), "--stop", "2") in (0, 2)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "clicks on 'object' in frame 0" in line]
    assert line.startswith("p2p run: ") and "a table or a wall" in line


def test_names_of_earlier_versions_go_on_working(sequence, tmp_path):
    prompts = clicks(tmp_path, ("object", 0, ON_BOARD))
    assert run(sequence, tmp_path / "out", *prompts, "--masks", "embedded", "--tracker", "embedded", "--stop", "2") == 0
    info = load_run(tmp_path / "out").info
    assert (info["masks"], info["segmenter"], info["tracker"]) == ("clicks", "builtin", "builtin")


def test_what_counts_is_the_datasets_own_visibility(sequence, tmp_path, capsys):
    """An object whose clicks come late was visible before all the same: those frames are failures."""
    assert run(sequence, tmp_path / "out", *clicks(tmp_path, ("object", 4, [[60, 50], [70, 60]]))) == 0
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "out"), "--json"]) == 0
    got = json.loads(capsys.readouterr().out)
    assert got["objects"]["object"]["frames"] == FRAMES and got["objects"]["object"]["lost"] == 4
    assert (got["masks"], got["segmenter"]) == ("clicks", "builtin")


def test_masks_are_scored(sequence, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(sequence, out, *clicks(tmp_path, ("object", 0, ON_BOARD)), "--save-masks") == 0
    capsys.readouterr()
    assert cli.main(["eval-masks", str(out), "--json"]) == 0
    got = json.loads(capsys.readouterr().out)
    assert got["mean_iou"] > 0.9 and got["objects"]["object"]["visible_frames"] == FRAMES and got["masks"] == "clicks"
    assert cli.main(["eval-masks", str(out)]) == 0
    assert "mean IoU" in capsys.readouterr().out


def test_an_object_of_ones_own_is_tracked_without_score(sequence, tmp_path, capsys):
    assert run(sequence, tmp_path / "out", *clicks(tmp_path, ("my board", 0, ON_BOARD))) == 0
    assert "my board: a pose in 8 of 8 frames" in capsys.readouterr().out
    assert cli.main(["eval", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert "my board" in out and "mask IoU" in out and err == ""
    info = json.loads((tmp_path / "out" / "run.json").read_text())
    (tmp_path / "out" / "run.json").write_text(json.dumps(info | {"finished": False}))  # as of a run that was killed
    assert cli.main(["eval", str(tmp_path / "out")]) == 0
    err = capsys.readouterr().err
    assert re.search(r"the run is not finished, 8 frames of it are there. Go on with it: .* --resume$", err.strip())
    (tmp_path / "out" / "run.json").write_text(json.dumps(info))
    (tmp_path / "out" / "masks.npz").unlink()
    assert cli.main(["eval", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and "where seen and mask IoU are empty" in err
    again = shlex.split(err.partition("Next: p2p ")[2])
    assert cli.main([*again, *POINTS_ALONE]) == 0
    capsys.readouterr()
    assert cli.main(["eval", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err == ""


def test_what_is_suspicious_is_said_at_the_end_kept_and_said_again(sequence, tmp_path, capsys):
    """Clicks on the wall: what they start is flat, and much longer than anything that is held."""
    out = tmp_path / "out"
    assert run(sequence, out, *clicks(tmp_path, ("wall", 0, [[5, 5], [150, 110]]))) in (0, 2)
    said = capsys.readouterr().out
    told = json.loads((out / "run.json").read_text())
    assert any("clicks on 'wall' in frame 0" in of["text"] and of["object"] == "wall" for of in told["doubts"])
    assert told["doubts"][0]["text"] in told["look_at"]["wall"]
    assert "What to look at before it is believed, by some of the images" in said
    assert all(f"  wall: {text}" in said for text in told["look_at"]["wall"])
    assert run(sequence, tmp_path / "fine", "--masks", "dataset") == 0
    assert "Nothing is suspicious by some of the images" in capsys.readouterr().out
    assert cli.main(["eval", str(out), "--json"]) == 0
    judged = json.loads(capsys.readouterr().out)["objects"]["wall"]
    assert judged["verdict"] == "look" and told["doubts"][0]["text"] in [found["text"] for found in judged["look_at"]]
    both = clicks(tmp_path, ("wall", 0, [[5, 5], [150, 110]]), ("board", 0, [[64, 52]]))
    out = tmp_path / "both"
    assert run(sequence, out, *both) in (0, 2)
    assert "p2p click" not in capsys.readouterr().out, "no masks were kept to be mended"
    assert run(sequence, out, *both, "--force", "--save-masks") in (0, 2)
    assert f"where a mask is wrong: p2p click {sequence} --run {out} --out" in capsys.readouterr().out


BAD_CLICKS = {
    "no file": (["--prompts", "{seq}/none.json"], ["none.json", "p2p click SEQ --out"]),
    "no JSON": (["--prompts", "{seq}/cam_K.txt"], ["cam_K.txt", "unreadable JSON"]),
    "both": ([("object", 0, ON_BOARD), "--masks", "dataset"], ["prompt of 'object': got a mask in frame 0, too"]),
    "outside": ([("object", 0, [[W, 10]])], ["clicks on 'object'", "(160, 10)", "160x120"]),
    "late and outside": ([("object", 5, [[3, -9]])], ["clicks on 'object'", "(3, -9)"]),
    "same click": ([("a", 0, ON_BOARD), ("b", 0, ON_BOARD[:1])], ["clicks on 'b'", "also one of 'a'"]),
    "same frame": ([("a", 1, ON_BOARD), ("a", 1, ON_BOARD)], ["'a' in frame 1 twice"]),
    "frame not run": ([("object", 5, ON_BOARD), "--stop", "4"], ["prompt of 'object'", "frame 5", "0 to 3"]),
    "unknown object": ([("object", 0, ON_BOARD), "--objects", "mug"], ["objects: got 'mug'", "object"]),
    "no name of a file": ([("a/b", 0, ON_BOARD)], ["object name", "'a/b'"]),
}


@pytest.mark.parametrize("case", BAD_CLICKS)
def test_bad_clicks_are_answered_in_one_line(case, sequence, tmp_path, capsys):
    given, expected = BAD_CLICKS[case]
    prompts = [x for x in given if isinstance(x, tuple)]
    words = [x.format(seq=sequence) for x in given if isinstance(x, str)]
    assert run(sequence, tmp_path / "out", *(clicks(tmp_path, *prompts) if prompts else []), *words) == 2
    line = one_line(capsys)
    assert all(word in line for word in expected), line


def test_clicks_without_depth_are_answered_in_one_line(sequence, tmp_path, capsys):
    """Clicks that start an object, and those that correct it, which are not said to be ignored first."""
    for prompts in [(("object", 2, ON_BOARD),), (("object", 0, ON_BOARD), ("object", 2, ON_BOARD))]:
        cv2.imwrite(str(sequence / "depth" / "0002.png"), np.zeros((H, W), np.uint16))
        assert run(sequence, tmp_path / f"{len(prompts)}", *clicks(tmp_path, *prompts)) == 2
        assert "clicks on 'object': got (45, 40) has no depth in frame 2, expected" in one_line(capsys)


def test_masks_that_were_not_kept_cannot_be_scored(done, capsys):
    assert cli.main(["eval-masks", str(done)]) == 2
    assert "--save-masks" in one_line(capsys, "eval-masks")


# --- interruption ------------------------------------------------------------------------------


def test_an_interruption_leaves_what_was_there(sequence, tmp_path, capsys, monkeypatch):
    step = Point2Pose.step

    def interrupted(self, frame, masks=None):
        if frame.index == 5:
            raise KeyboardInterrupt
        return step(self, frame, masks)

    monkeypatch.setattr(Point2Pose, "step", interrupted)
    assert run(sequence, tmp_path / "out") == 130
    out, err = capsys.readouterr()
    first, then = err.rstrip().split(". Go on with it: ")
    assert first == "p2p run: interrupted" and "p2p view" in out
    loaded = load_run(tmp_path / "out")
    assert loaded.objects["object"].frame_index.tolist() == list(range(5))
    assert len(loaded.timings["total_ms"]) == 5
    assert loaded.info["finished"] is False and loaded.info["stopped_by"] == "KeyboardInterrupt"
    assert len(np.loadtxt(tmp_path / "out" / "poses" / "object.txt")) == 5
    assert cli.main(["eval", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["objects"]["object"]["frames"] == 5
    monkeypatch.setattr(Point2Pose, "step", step)
    assert cli.main([*shlex.split(then)[1:], "--quiet"]) == 0 and then.endswith(" --resume")
    assert load_run(tmp_path / "out").info["finished"] and len(load_run(tmp_path / "out").objects["object"]) == FRAMES


def test_an_interrupted_offline_pass_says_how_it_goes_on(tmp_path, capsys, monkeypatch):
    def interrupted(folder, *how):
        raise KeyboardInterrupt

    monkeypatch.setattr("p2p_lib.offline.refine.refine_run", interrupted)
    assert cli.main(["refine", str(tmp_path / "a run")]) == 130
    then = f"Go on: p2p refine '{tmp_path / 'a run'}'; it keeps the objects that are finished."
    assert capsys.readouterr().err == f"p2p refine: interrupted. {then}\n"


def test_an_interruption_before_the_first_frame(sequence, tmp_path, capsys, monkeypatch):
    def interrupted(self, frame, masks=None):
        raise KeyboardInterrupt

    monkeypatch.setattr(Point2Pose, "step", interrupted)
    assert run(sequence, tmp_path / "out") == 130
    assert capsys.readouterr().err == "p2p run: interrupted\n"
    assert not (tmp_path / "out").exists()


def test_a_fault_on_the_way_leaves_what_was_there(sequence, tmp_path, capsys):
    cut(sequence / "rgb/0006.png")
    assert run(sequence, tmp_path / "out") == 2
    assert "rgb/0006.png" in one_line(capsys)
    loaded = load_run(tmp_path / "out")
    assert loaded.objects["object"].frame_index.tolist() == list(range(6))
    assert loaded.info["finished"] is False and loaded.info["stopped_by"] == "BadInput"


def p2p(*words: str, **more) -> subprocess.Popen:
    command = [sys.executable, "-m", "p2p_lib.apps.cli", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more)


@pytest.fixture(scope="module")
def long(tmp_path_factory) -> Path:
    """Nobody writes to it, and nobody comes to its end."""
    return write_sequence(tmp_path_factory.mktemp("cli") / "long", frames=600)


@pytest.mark.parametrize(("how", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_signals(how, code, long, tmp_path):
    """The real thing: a process, a signal, what is on disk, and that it goes on from there."""
    out = tmp_path / "out"
    # A shell that runs its jobs in the background has them ignore the signal, and they hand that on.
    heed = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    process = p2p("run", str(long), "--out", str(out), *POINTS_ALONE, **heed)
    deadline = time.monotonic() + 60
    timings = out / "timings.csv"
    while not (timings.is_file() and timings.read_text().count("\n") > 10):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.02)
    process.send_signal(how)
    _, err = process.communicate(timeout=300)
    assert process.returncode == code
    assert err == "" if code < 0 else err.startswith("p2p run: interrupted.") and err.endswith("--resume\n")
    loaded = load_run(out)
    frames, timed = len(loaded.objects["object"]), len(loaded.timings["total_ms"])
    assert loaded.info["finished"] is False
    assert 10 <= frames == timed < 600 if code > 0 else 1 <= frames <= timed < 600
    stopped_by = {signal.SIGINT: "KeyboardInterrupt", signal.SIGTERM: "Terminated", signal.SIGKILL: None}
    assert load_run(out).info["stopped_by"] == stopped_by[how]


def test_as_a_process(tmp_path):
    process = p2p("run", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out"))
    out, err = process.communicate(timeout=300)
    *waits, said = err.splitlines()
    assert (process.returncode, out, waits) == (2, "", [f"{what} ..." for what in WAITS[:2]])
    assert "nowhere: no such folder" in said and not (tmp_path / "out").exists()


# --- help --------------------------------------------------------------------------------------


def said(words: list[str], capsys) -> str:
    with pytest.raises(SystemExit) as left:
        cli.main(words)
    assert left.value.code == 0
    return capsys.readouterr().out


def test_help_tells_what_there_is_and_how_to_start(capsys):
    text = said(["--help"], capsys)
    for command in ("run", "eval", "notebooks", "doctor"):
        assert f"\n    {command}" in text
    assert "p2p run synthetic/crossing --out" in text


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (
            "run",
            "SEQ --out --format --objects --preset --config --set --tracker --masks --seed --start --stop --models "
            "--depth-scale --debug",
        ),
        ("eval", "DIR --json --models --align --min-visible-px --debug"),
        ("notebooks", "--profile --only --debug"),
        ("doctor", "--debug"),
    ],
)
def test_help_of_each_command_names_its_options(command, options, capsys):
    text = said([command, "--help"], capsys)
    assert all(option in text for option in options.split())


def test_version(capsys):
    assert said(["--version"], capsys).strip() == p2p_lib.__version__


def test_the_installed_command_is_this_one():
    script = Path(sys.executable).with_name("p2p")
    if not script.is_file():
        pytest.skip("p2p is not installed beside this Python")
    result = subprocess.run([script, "--version"], capture_output=True, text=True, timeout=300, env=os.environ)
    assert (result.returncode, result.stdout.strip()) == (0, p2p_lib.__version__)


def test_errors_that_can_be_mended_have_their_exit_code():
    assert P2PError.exit_code == MissingData("x", "y").exit_code == 2


def test_a_doubt_that_repeats_is_said_once_with_its_count(tmp_path, capsys):
    """A mask of the whole image in every frame."""
    folder = write_sequence(tmp_path / "slides", 6, 2)
    for mask in (folder / "gt_mask").iterdir():
        cv2.imwrite(str(mask), np.full((120, 160), 255, np.uint8))
    cli.main(["run", str(folder), "--out", str(tmp_path / "out"), "--quiet", "--set", "method.surface=false"])
    said = [line for line in capsys.readouterr().err.splitlines() if "Is it inverted?" in line]
    whole = "mask of 'object': the whole image in frame"
    assert said == [f"p2p run: {whole} 0. Is it inverted?", f"p2p run: 5 more like: {whole} N. Is it inverted?"]
    doubts = json.loads((tmp_path / "out/run.json").read_text())["doubts"]
    kept = [of["text"] for of in doubts if "inverted" in of["text"]]
    assert kept == [f"{whole} 0. Is it inverted? (5 more like it)"], "nor does it fill the run's record"
