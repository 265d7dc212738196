"""``p2p run`` keeps what it learnt of each object, and ``--memory`` looks for it in another video."""

import json
from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.apps.cli import main
from p2p_lib.core.memory import load_memory, save_memory
from p2p_lib.datasets.runs import load_run

CROSSING = ["run", "synthetic/crossing", "--quiet"]


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """A run's folder, and its memories."""
    out = tmp_path_factory.mktemp("learnt") / "run"
    assert main([*CROSSING, "--stop", "40", "--out", str(out)]) == 0
    return out


def test_each_object_is_kept_and_all_are_found_without_masks(learnt, tmp_path, capsys):
    box, can = (learnt / "maps" / f"{name}.npz" for name in ("box", "can"))
    assert (
        load_memory(box).made_of["sequence"] == "synthetic/crossing" and box.stat().st_size + can.stat().st_size < 4e6
    )
    again = [*CROSSING, "--start", "44", "--stop", "50", "--memory", str(box), "--memory", str(can), "--frozen"]
    assert main([*again, "--out", str(tmp_path / "again")]) == 0
    run, before = load_run(tmp_path / "again"), load_run(learnt)
    for name, obj in run.objects.items():
        assert obj.has_pose[3:].all() and not obj.keyframe.any()  # one is looked for in a frame, and twice
        T_obj_model = np.linalg.inv(before.objects[name].T_cam_obj[0]) @ before.objects[name].T_cam_model[0]
        off_m = (obj.T_cam_obj[3:] @ T_obj_model - obj.T_cam_model[3:])[:, :3, 3]
        assert np.linalg.norm(off_m, axis=1).max() < 0.01
    assert main(["eval", str(tmp_path / "again"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["masks"] == "memory"
    assert main(["eval", str(tmp_path / "again")]) == 0 and "masks memory" in capsys.readouterr().out
    assert run.info["masks"] == "clicks", "which are all that an earlier version could resume"


def test_before_a_camera_it_is_found_without_a_click(learnt, tmp_path, capsys):
    words = [
        "--memory",
        str(learnt / "maps/box.npz"),
        "--backlog",
        "20",
        "--stop",
        "6",
        "--out",
        str(tmp_path / "live"),
    ]
    assert main(["live", "--camera", "folder:synthetic/crossing", "--rate", "5", *words]) == 0
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {one["object"] for one in told} == {"box"}
    assert told[0]["T_cam_obj"] is None and told[0]["reason"] == "known from memory, not found yet"
    before = load_run(learnt).objects["box"]
    off_m = [np.array(one["T_cam_obj"])[:3, 3] - before.T_cam_obj[one["frame"], :3, 3] for one in told[2:]]
    assert len(off_m) >= 3 and np.linalg.norm(off_m, axis=1).max() < 0.006, "in the frame of the map"
    assert load_memory(tmp_path / "live/maps/box.npz").made_of["sequence"]


def test_what_too_little_was_learnt_of_is_said_at_the_end(tmp_path, capsys):
    words = ["--stop", "2", "--set", "method.surface=false", "--objects", "box", "--out", str(tmp_path / "out")]
    assert main([*CROSSING, *words]) == 0
    line = "box: no map was kept, by which --memory would find it: no surface"
    assert line in capsys.readouterr().out.splitlines()
    assert main([*CROSSING, "--memory", str(tmp_path / "out"), "--out", str(tmp_path / "again")]) == 2
    assert "No object was learnt well enough" in capsys.readouterr().err


def test_so_it_is_before_a_camera(tmp_path, capsys):
    clicks = {"objects": [{"name": "box", "frame": 0, "points": [[170, 245], [190, 220], [150, 270]]}]}
    (tmp_path / "clicks.json").write_text(json.dumps(clicks))
    words = ["--prompts", str(tmp_path / "clicks.json"), "--stop", "2", "--set", "method.surface=false"]
    camera = ["live", "--camera", "folder:synthetic/crossing", "--rate", "5", "--backlog", "20"]
    assert main([*camera, *words, "--out", str(tmp_path / "out")]) == 0
    line = "box: no map was kept, by which --memory would find it: no surface"
    assert line in capsys.readouterr().err.splitlines()


def test_one_that_is_not_there_is_no_fault_of_the_data(learnt, tmp_path, capsys):
    """Everything is behind the board. That the sequence has truth, of others, is said as well."""
    save_memory(tmp_path / "cup.npz", replace(load_memory(learnt / "maps/box.npz"), name="cup"))
    words = ["--start", "170", "--stop", "174", "--memory", str(tmp_path / "cup.npz"), "--out", str(tmp_path / "out")]
    assert main([*CROSSING, *words]) == 2
    out, err = capsys.readouterr()
    assert "cup never had a pose" in err
    assert "show a side that was learnt, or click on it, or it is not in this video. Next" in err
    assert "not scored, the sequence has no truth of cup, only of box, can." in out


@pytest.mark.parametrize(
    "words, said",
    [
        (
            ["--memory", "{box}", "--memory", "{box}"],
            "two of 'box': {box} and {box}, expected one an object. Give one of",
        ),
        (["--memory", "{box}", "--memory", "{box}"], "under another name: --memory NAME={box}."),
        (["--memory", "carton="], "'carton='"),
        (["--memory", "a/b={box}"], "'a/b'"),
        (["--memory", "carton={maps}"], "a folder of 2, expected one for one name"),
        (["--memory", "{half}"], "half.npz"),
        (["--memory", "{none}"], "no such file"),
        (["--memory", "{box}", "--objects", "cup"], "'cup'"),
    ],
)
def test_what_does_not_fit_is_said_before_anything_is_written(learnt, tmp_path, capsys, words, said):
    box, half = learnt / "maps/box.npz", tmp_path / "half.npz"
    half.write_bytes(box.read_bytes()[:5000])
    files = {"box": box, "half": half, "none": tmp_path / "none.npz", "maps": box.parent}
    assert main([*CROSSING, *(word.format(**files) for word in words), "--out", str(tmp_path / "out")]) == 2
    assert said.format(**files) in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_one_is_looked_for_under_another_name_and_a_coarser_camera_is_told_of(learnt, tmp_path, monkeypatch, capsys):
    box, can = learnt / "maps/box.npz", learnt / "maps/can.npz"
    assert load_memory(box).made_of["camera"]["width"] == 640
    words = ["--memory", f"carton={box}", "--memory", str(can), "--start", "44", "--stop", "50"]
    assert main([*CROSSING, *words, "--out", str(tmp_path / "out")]) == 0
    run = load_run(tmp_path / "out")
    assert all(run.objects[name].has_pose.any() for name in ("carton", "can"))
    assert {path.stem for path in (tmp_path / "out/maps").iterdir()} == {"carton", "can"}
    assert run.info["doubts"] == [] == capsys.readouterr().err.splitlines()
    finer = replace(load_memory(box), made_of={"camera": {"fx": 2000.0, "width": 1920, "height": 1080}})
    save_memory(tmp_path / "a=b.npz", finer)  # a path all the same
    monkeypatch.chdir(tmp_path)
    assert main([*CROSSING, "--memory", "a=b.npz", "--start", "44", "--stop", "46", "--out", "other"]) in (0, 2)
    (told,) = [line for line in capsys.readouterr().err.splitlines() if "focal" in line]
    assert told.startswith("p2p run: memory of 'box': learnt with a focal length of 2000 px, looked for with 615 px.")
    assert [str(of) for of in load_run(tmp_path / "other").doubts] == [told.removeprefix("p2p run: ")]
