"""The folder of a run: its own, whole at every moment, taken away only when asked, gone on with where it was cut."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets import run_writer
from p2p_lib.datasets.run_writer import RunWriter, _prompts_alone
from p2p_lib.datasets.runs import COLUMNS, load_run
from p2p_lib.datasets.sequence import open_sequence

W, H, N = 32, 24, 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of somebody's own, with masks of two objects."""
    folder = tmp_path_factory.mktemp("data") / "own"
    for name in ("rgb", "depth", "masks/box", "masks/can"):
        (folder / name).mkdir(parents=True)
        channels = (H, W, 3) if name == "rgb" else (H, W)
        kind = np.uint16 if name == "depth" else np.uint8
        for i in range(N):
            cv2.imwrite(str(folder / name / f"{i:06d}.png"), np.full(channels, 100, kind))
    np.savetxt(folder / "cam_K.txt", [[50.0, 0, 16], [0, 50, 12], [0, 0, 1]])
    return folder


def writer(out, folder, if_exists="refuse", seed=0, objects=None):
    return RunWriter(out, open_sequence(folder), preset(seed=seed), "lk", "dataset", objects, if_exists=if_exists)


def estimates(i, seed=0, objects=("box", "can")):
    T = [se3.exp(np.random.default_rng([seed, i, k]).normal(0, 0.4, 6)) for k in range(len(objects))]
    return {name: PoseEstimate(name, i, i / 30, Status.TRACKED, T[k], 0.5) for k, name in enumerate(objects)}


def add(made, n, start=0, seed=0, objects=("box", "can")):
    for i in range(start, n):
        frame = Frame(i, i / 30, np.zeros((H, W, 3), np.uint8), np.zeros((H, W), np.float32))
        made.add(frame, estimates(i, seed, objects), 10.0, {"tracking": 1.0} | ({"graph": 2.0} if i > 4 else {}))
        made.add_masks(frame, {"box": np.ones((H, W), bool)})


def write(out, folder, n=N, cut_short=False, **how):
    with writer(out, folder, **how) as made:
        made.info["options"] = {"save_masks": True}
        add(made, n, seed=how.get("seed", 0))
        made.info["stopped_by"] = "KeyboardInterrupt" if cut_short else None
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# --- whose folder it is ------------------------------------------------------------------------


@pytest.mark.parametrize("if_exists", ["refuse", "replace", "resume"])
def test_a_folder_that_no_run_made_is_never_touched(folder, tmp_path, if_exists):
    mine = Path(shutil.copytree(folder, tmp_path / "mine"))
    before = contents(mine)
    with pytest.raises(BadInput, match=r"mine: got a folder with cam_K\.txt, depth, masks, \.\.\., and no run"):
        writer(mine, folder, if_exists).__enter__()
    (mine / "run.json").write_text('{"objects": ["box"]}')  # somebody else's run
    with pytest.raises(BadInput, match=r"run\.json: got sequence: missing"):
        writer(mine, folder, if_exists).__enter__()
    (mine / "run.json").unlink()
    assert contents(mine) == before


def test_an_earlier_run_stays_unless_it_is_to_be_replaced(folder, tmp_path):
    before = contents(write(tmp_path / "run", folder, 5))
    with pytest.raises(
        BadInput, match=r"got a run of own \(5 frames, tracker lk, seed 0\).*--force.*'replace'.*--resume.*'resume'"
    ):
        writer(tmp_path / "run", folder).__enter__()
    with writer(tmp_path / "run", folder, "replace"):
        pass  # it never came to a frame
    assert contents(tmp_path / "run") == before
    write(tmp_path / "run", folder, 2, if_exists="replace", seed=3)
    assert len(load_run(tmp_path / "run").objects["box"]) == 2


def test_only_what_the_earlier_run_wrote_is_replaced(folder, tmp_path):
    out = write(tmp_path / "run", folder)
    mine = {"notes.md", "poses/mine.txt", "meshes/mine.ply", "masks/mine/000000.png", "masks/box/mine.png", "view.html"}
    for name in mine:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    with writer(out, folder, "replace", objects=("can",)) as made:
        add(made, 1, objects=("can",))
    kept = {"run.json", "config.toml", "poses.npz", "poses/can.txt", "timings.csv", "masks/can/000000.png"}
    assert set(contents(out)) == mine | kept
    assert all((out / name).read_text() == "mine" for name in mine)


def test_what_was_refined_from_the_earlier_run_goes_with_it(folder, tmp_path):
    out = write(tmp_path / "run", folder)
    for name in ("offline", "mine"):
        shutil.copytree(out, tmp_path / name)
    info = json.loads((out / "run.json").read_text())
    (tmp_path / "offline/run.json").write_text(json.dumps(info | {"offline": True}))
    (tmp_path / "offline").rename(out / "offline")
    (out / "offline/notes.md").write_text("mine")
    write(out, folder, if_exists="replace")
    assert set(contents(out / "offline")) == {"notes.md"}
    shutil.rmtree(out / "offline")
    (tmp_path / "mine").rename(out / "offline")  # not refined from it, whatever its name
    write(out, folder, if_exists="replace")
    assert "poses.npz" in contents(out / "offline")


def test_a_link_leads_nowhere(folder, tmp_path):
    """In a run that came from somewhere else its folders may be links to one's own files."""
    mine, out = tmp_path / "mine", write(tmp_path / "run", folder)
    mine.mkdir()
    shutil.rmtree(out / "masks" / "box")
    (mine / "000000.png").write_text("mine")
    (out / "masks" / "box").symlink_to(mine)
    (out / "poses" / "box.txt").unlink()
    (mine / "box.txt").write_text("mine")
    (out / "poses" / "box.txt").symlink_to(mine / "box.txt")
    with writer(out, folder, "replace") as made:
        add_one = Frame(0, 0.0, np.zeros((H, W, 3), np.uint8), np.zeros((H, W), np.float32))
        made.add(add_one, estimates(0), 1.0)
    assert (mine / "000000.png").read_text() == (mine / "box.txt").read_text() == "mine"
    shutil.rmtree(out / "poses")
    (out / "poses").symlink_to(mine)
    with pytest.raises(BadInput, match="poses: got a link"), writer(out, folder, "replace") as made:
        add(made, 1)
    assert sorted(p.name for p in mine.iterdir()) == ["000000.png", "box.txt"]


NAMES = ["../outside", "/outside", "a/b", "..", "", "x" * 300, "a\nb", 3]


@pytest.mark.parametrize("name", NAMES)
def test_names_in_a_foreign_run_are_checked(folder, tmp_path, name):
    out = write(tmp_path / "a" / "run", folder, 2)
    info = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(info | {"objects": ["box", name]}))
    before = contents(tmp_path)
    with pytest.raises(BadInput, match=r"run\.json: got objects\.1: "):
        load_run(out)
    with pytest.raises(BadInput, match=r"run\.json: got objects\.1: "), writer(out, folder, "replace") as made:
        add(made, 1)
    assert contents(tmp_path) == before


def test_two_runs_do_not_share_a_folder(folder, tmp_path):
    out, program = tmp_path / "run", "import sys, pathlib; from p2p_lib.core.files import writing_alone\n"
    program += "with writing_alone(pathlib.Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program, str(out)]
    other = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(BadInput, match="run: got a folder that another run is writing to"):
            write(out, folder)
    finally:
        other.kill()
        other.communicate()
    with writer(out, folder) as made:  # a killed process holds nothing
        add(made, 1)
        with pytest.raises(BadInput, match="another run is writing to"):
            writer(out, folder, "replace").__enter__()
    write(out, folder, if_exists="replace")


def test_nothing_is_left_of_a_run_that_never_began(folder, tmp_path):
    with pytest.raises(ValueError), writer(tmp_path / "run", folder):
        raise ValueError
    assert not (tmp_path / "run").exists()
    (tmp_path / "empty").mkdir()
    with writer(tmp_path / "empty", folder):
        pass
    assert (tmp_path / "empty").is_dir()


# --- whole at every moment ---------------------------------------------------------------------


@pytest.mark.parametrize("if_exists", ["refuse", "replace", "resume"])
def test_a_kill_at_any_moment_leaves_a_readable_run(folder, tmp_path, monkeypatch, if_exists):
    """The folder as it is before each change of a file: a run, the one before or the new one, never a mixture."""
    out, moments = tmp_path / "run", []
    if if_exists == "replace":
        write(out, folder, 7, seed=1)
    if if_exists == "resume":
        write(out, folder, 7, cut_short=True)

    def noting(change):
        def noted(*arguments, **more):
            if out.exists():
                moments.append(Path(shutil.copytree(out, tmp_path / f"moment{len(moments)}", symlinks=True)))
            return change(*arguments, **more)

        return noted

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", noting(os.replace))
        patch.setattr(Path, "unlink", noting(Path.unlink))
        patch.setattr(run_writer, "append", noting(run_writer.append))
        write(out, folder, if_exists=if_exists)
    assert len(moments) >= 20
    frames = []
    for moment in [*moments, out]:
        try:
            run = load_run(moment)
        except MissingData as error:
            assert "no run there" in str(error) or "a run without frames" in str(error)
            frames.append(0)
            continue
        seed, n = run.info["seed"], len(run.objects["box"])
        frames.append(n if seed == 0 else -n)
        for name in ("box", "can"):
            expected = [estimates(i, seed)[name].T_cam_obj for i in range(n)]
            np.testing.assert_array_equal(run.objects[name].T_cam_obj, expected)
            rows = np.loadtxt(moment / "poses" / f"{name}.txt", ndmin=2)
            assert len(rows) >= n or seed == 1  # of a run that is being taken away
    assert frames[-1] == N and load_run(out).info["finished"]
    if if_exists == "resume":
        assert min(frames) == 7
    with writer(moments[-1], folder, "replace") as made:  # litter of a kill is cleared away or hidden
        add(made, 1)


@pytest.mark.parametrize(("at", "frames"), [("_not_yet", 3), ("append", 4)])
def test_an_interrupt_while_a_frame_is_written_leaves_whole_frames(folder, tmp_path, monkeypatch, at, frames):
    """Before all of it is known, or after its pose and before its time is on disk."""
    write_one = run_writer.append

    def interrupt(path, *rest):
        if at == "append" and Path(path).name != "timings.csv":
            return write_one(path, *rest)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), writer(tmp_path / "run", folder) as made:
        add(made, 3)
        monkeypatch.setattr(run_writer, at, interrupt)
        add(made, 4, start=3, objects=("box", "can") if at == "append" else ("box",))
    monkeypatch.undo()
    run, lines = load_run(tmp_path / "run"), (tmp_path / "run/poses/box.txt").read_text().splitlines()
    assert [len(run.objects[name]) for name in ("box", "can")] == [frames] * 2
    assert len(run.timings["total_ms"]) == len(lines) == frames and run.info["frames"] == frames


def test_a_line_is_appended_whole_or_not(tmp_path, monkeypatch):
    """A disk that takes the first bytes of a line alone."""
    import resource

    path = tmp_path / "lines.txt"
    path.write_text("first\n")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (9, limit[1]))
    try:
        with pytest.raises(OSError):
            run_writer.append(path, "second\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert path.read_text() == "first\n"
    run_writer.append(path, "second\n")
    assert path.read_text() == "first\nsecond\n"


# --- going on ----------------------------------------------------------------------------------


def same_poses(one: Path, other: Path) -> bool:
    a, b = load_run(one).objects, load_run(other).objects
    return a.keys() == b.keys() and all(
        np.array_equal(getattr(a[name], c), getattr(b[name], c), equal_nan=getattr(a[name], c).dtype.kind == "f")
        for name in a
        for c in COLUMNS
    )


def test_a_run_goes_on_to_what_it_would_have_been(folder, tmp_path):
    whole, out = write(tmp_path / "whole", folder), write(tmp_path / "run", folder, 7, cut_short=True)
    (out / "masks" / "box" / "000003.png").unlink()
    cut = contents(out)
    with writer(out, folder, "resume") as made:
        made.info["options"] = {"save_masks": True}
        add(made, 7)
        now = contents(out)
        assert now.keys() - cut.keys() == {"masks/box/000003.png"} and all(now[name] == cut[name] for name in cut)
        assert not made.begun and made.resumed and not made.complete
        add(made, N, start=7)
    assert same_poses(out, whole)
    mine, theirs = contents(out), contents(whole)
    differ = {"run.json", "poses.npz"}  # which hold times of writing
    assert mine.keys() == theirs.keys() and all(mine[name] == theirs[name] for name in mine.keys() - differ)
    assert load_run(out).info["finished"] and load_run(out).info["stopped_by"] is None


def test_a_run_that_goes_on_still_knows_its_earlier_map(folder, tmp_path):
    maps, image = [0, 0, 0, 1, 1, 1, 1, 1], (np.zeros((H, W, 3), np.uint8), np.zeros((H, W), np.float32))
    for frames, if_exists in ((4, "refuse"), (8, "resume")):
        with writer(tmp_path / "run", folder, if_exists, objects=("box",)) as made:
            for i in range(frames):
                told = replace(estimates(i)["box"], map_id=maps[i])
                made.add(Frame(i, i / 30, *image), {"box": told}, 10.0)
            made.info["stopped_by"] = "KeyboardInterrupt" if frames < 8 else None
        rows = np.loadtxt(tmp_path / "run" / "poses" / "box.txt")
        np.testing.assert_allclose(rows[:, 0] * 30, [0, 1, 2] if frames < 8 else [3, 4, 5, 6, 7], atol=1e-6)


def test_where_it_comes_out_otherwise_nothing_is_lost(folder, tmp_path):
    out = write(tmp_path / "run", folder, 7, cut_short=True)
    before, fourth = contents(out), Frame(4, 4 / 30, np.zeros((H, W, 3), np.uint8), np.zeros((H, W), np.float32))
    with (
        pytest.raises(BadInput, match=r"another pose of 'can' in frame 4.*--force"),
        writer(out, folder, "resume") as w,
    ):
        add(w, 4)
        w.add(fourth, estimates(4) | {"can": PoseEstimate("can", 4, 4 / 30, Status.TRACKED, np.eye(4), 0.5)}, 1.0)
    assert contents(out) == before
    with pytest.raises(BadInput, match=r"run: seed: got 5, expected 0, as it began"):
        writer(out, folder, "resume", seed=5).__enter__()
    with pytest.raises(BadInput, match=r"objects: got \['can'\]"):
        writer(out, folder, "resume", objects=("can",)).__enter__()
    with pytest.raises(KeyboardInterrupt), writer(out, folder, "resume") as w:
        add(w, 3)
        raise KeyboardInterrupt
    assert contents(out) == before


def test_of_prompts_that_differ_what_the_other_lacks_is_told_to_its_end():
    """However many clicks they have in common."""
    shared = [[k, 10.0] for k in range(100, 120)]
    before = {"name": "mug", "frame": 0, "points": shared, "box": [0, 0, 9, 9]}
    after = {"name": "mug", "frame": 0, "points": [*shared, *([k, 20.5] for k in range(5))], "negative": [[7, 8]]}
    mine, theirs = {"prompts": [after]}, {"prompts": [before]}
    clicks = "points (0, 20.5), (1, 20.5), (2, 20.5) and 2 more"
    assert _prompts_alone(mine, theirs) == f"'mug' in frame 0: {clicks}; negative (7, 8); no box"
    assert _prompts_alone(theirs, mine) == "'mug' in frame 0: 20 points; box [0, 0, 9, 9]; no negative"
    assert _prompts_alone(mine, mine) == "nothing"
