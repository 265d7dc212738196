"""Poses out and in again: every form keeps every pose, and a lost frame stays lost; faults name the line."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.apps.cli import main
from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt, MissingData
from p2p_lib.core.types import PoseEstimate, Status
from p2p_lib.datasets.bop import write_models, write_scene
from p2p_lib.datasets.exchange import FORMATS, export, read_poses
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.protocol import evaluate, model_frames
from p2p_lib.offline import PRODUCTS
from p2p_lib.run import export_run, import_poses

W, H, N = 40, 30, 12
STEMS = [str(1581120424100262102 + i * 33_000_000) for i in range(N)]  # nanoseconds, as YCBInEOAT names pictures
LOST = {"can": {0, 5, 6}, "box": {11}}
K = "50 0 20\n0 50 15\n0 0 1\n"


def truth_of(k):
    rng = np.random.default_rng(k)
    start = se3.from_rt(se3.exp(np.r_[rng.normal(size=3), 0, 0, 0])[:3, :3], [0, 0, 0.7])
    return start @ se3.exp(np.arange(N)[:, None] * rng.normal(0, 0.03, 6))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A YCBMultiTrack sequence of two objects with models, whose pictures are named by their time."""
    folder = tmp_path_factory.mktemp("exchange") / "table"
    for sub in ("rgb", "depth"):
        (folder / sub).mkdir(parents=True)
    (folder / "cam_K.txt").write_text(K)
    for k, obj in enumerate(("box", "can")):
        for sub in ("masks", "annotated_poses", "models"):
            (folder / sub / obj).mkdir(parents=True)
        np.savetxt(folder / f"models/{obj}/points.xyz", np.random.default_rng(9 + k).normal(0, 0.03, (60, 3)))
        for stem, T in zip(STEMS, truth_of(k)):
            np.savetxt(folder / f"annotated_poses/{obj}/{stem}.txt", T)
            cv2.imwrite(str(folder / f"masks/{obj}/{stem}.png"), np.full((H, W), 255, np.uint8))
    for stem in STEMS:
        cv2.imwrite(str(folder / f"rgb/{stem}.png"), np.zeros((H, W, 3), np.uint8))
        cv2.imwrite(str(folder / f"depth/{stem}.png"), np.full((H, W), 700, np.uint16))
    return folder


@pytest.fixture(scope="module")
def scene(table, tmp_path_factory):
    """The same as a BOP scene, with its models and pictures numbered with gaps."""
    root = tmp_path_factory.mktemp("bop") / "set"
    numbers = write_scene(root / "test" / "000007", open_sequence(table))
    write_models(root / "models", {n: table / f"models/{name}/points.xyz" for name, n in numbers.items()})
    return root / "test" / "000007"


def run_on(folder, out):
    """A run with noise of 2 mm and 0.6 degrees in an object frame of its own, and lost frames."""
    sequence = open_sequence(folder)
    names = dict(zip(sequence.objects, ("box", "can")))
    models = {obj: places[-1] for obj, places in sequence.model_places.items()}
    models = {obj: next(p for p in (place, place / "points.xyz") if p.is_file()) for obj, place in find(sequence)}
    rng = np.random.default_rng(1)
    with RunWriter(out, sequence, preset("default"), "lk", "dataset", models=models) as writer:
        for i in range(N):
            estimates = {}
            for obj, truth in sequence.truth.items():
                T = truth.T_cam_model[i] @ se3.exp(np.r_[rng.normal(0, 0.01, 3), rng.normal(0, 0.002, 3)])
                T = T @ se3.exp(np.array([0.3, -1.2, 0.5, 0.1, 0.2, -0.05]))
                if i in LOST[names[obj]]:
                    estimates[obj] = PoseEstimate(obj, i, sequence.times_s[i], Status.LOST, reason="test")
                else:
                    estimates[obj] = PoseEstimate(obj, i, sequence.times_s[i], Status.TRACKED, T, 0.8)
            writer.add(sequence.frame(i), estimates, 20.0 + i)
    return load_run(out)


def find(sequence):
    for obj, places in sequence.model_places.items():
        yield obj, next(p for p in places if p.is_file() or (p / "points.xyz").is_file())


@pytest.mark.parametrize("layout", ["ycbmultitrack", "bop"])
@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("frame", ["object", "model"])
def test_every_form_keeps_every_pose_and_every_loss(table, scene, tmp_path, layout, format, frame):
    folder = table if layout == "ycbmultitrack" else scene
    run = run_on(folder, tmp_path / "run")
    export_run(tmp_path / "run", format, tmp_path / "out", frame)
    read = read_poses(tmp_path / "out", open_sequence(folder))
    assert read.keys() == run.objects.keys()
    for name, obj in run.objects.items():
        lost = np.isnan(read[name]).all((1, 2))
        np.testing.assert_array_equal(lost, ~obj.has_pose)
        first = np.flatnonzero(obj.has_pose)[0]
        T_obj_frame = np.eye(4) if frame == "object" else se3.inverse(obj.T_cam_obj[first]) @ obj.T_cam_model[first]
        np.testing.assert_allclose(read[name][~lost], (obj.T_cam_obj @ T_obj_frame)[~lost], atol=3e-8)
    # The same poses get the same scores, whichever way they come.
    ours = evaluate(load_run(tmp_path / "run")).as_dict()
    theirs = evaluate(import_poses(tmp_path / "out", folder)).as_dict()
    assert 60 < ours["mean"]["add_auc"] < 99 and ours["objects"].keys() == theirs["objects"].keys()
    for name, score in ours["objects"].items():
        got = theirs["objects"][name]
        assert got.pop("frames_to_recovery") == score.pop("frames_to_recovery")
        assert got == pytest.approx(score, abs=1e-4) and score["lost"] > 0


@pytest.mark.parametrize("format", FORMATS)
def test_nothing_is_written_over(table, tmp_path, format):
    """Least of all a dataset's own truth, which has the same names."""
    run, out = run_on(table, tmp_path / "run"), tmp_path / "out"
    export(run, out, format)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(BadInput, match="got what is there already"):
        export(run, out, format, {name: np.diag([-1.0, -1, 1, 1]) for name in run.objects})
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_bop_of_own_data_numbers_the_objects_of_the_run(table, tmp_path, capsys):
    """A folder without masks knows no names; whoever asks for the model's frame is told which flag does without."""
    own = tmp_path / "own"
    for part in ("rgb", "depth"):
        shutil.copytree(table / part, own / part)
    (own / "cam_K.txt").write_text(K)
    sequence = open_sequence(own)
    with RunWriter(tmp_path / "run", sequence, preset("default"), "lk", "clicks", ("mug", "bowl")) as writer:
        for i in range(N):
            frame, T = sequence.frame(i), se3.from_rt(np.eye(3), [0.01 * i, 0, 0.7])
            of = [PoseEstimate(n, i, frame.time_s, Status.TRACKED, T, 0.8) for n in ("mug", "bowl")[: 2 - i % 2]]
            writer.add(frame, {e.object: e for e in of}, 20.0)
    words = ["export", str(tmp_path / "run"), "--format", "bop", "--out", str(tmp_path / "out")]
    assert main(words) == 2 and "--frame object" in capsys.readouterr().err
    assert main([*words, "--frame", "object"]) == 0
    path, ids = map(Path, capsys.readouterr().out.removeprefix("Written: ").strip().split(", "))
    assert json.loads(ids.read_text()) == {"mug": 1, "bowl": 2}
    rows = path.read_text().splitlines()[1:]
    numbers = [row.split(",")[2] for row in rows]
    assert (numbers.count("1"), numbers.count("2"), len(rows)) == (N, N // 2, N + N // 2)


def test_poses_of_little_confidence_are_left_out_where_that_is_asked(table, tmp_path):
    run = run_on(table, tmp_path / "run")
    confidence = run.objects["can"].confidence
    least = float(np.median(confidence[confidence > 0]))
    for asked in (0.0, least, 1.1):
        path, *_ = export_run(tmp_path / "run", "tum", tmp_path / f"{asked}", min_confidence=asked)
        kept = run.objects[path.stem]
        lines = path.read_text().splitlines()
        assert len(lines) == (kept.has_pose & (kept.confidence >= asked)).sum()


@pytest.mark.parametrize("format", [*FORMATS, *PRODUCTS])
@pytest.mark.parametrize(("least", "says"), [("7", "min_confidence: got 7"), ("nan", "got nan"), ("-1", "got -1")])
def test_a_confidence_that_none_can_have_is_refused(table, tmp_path, capsys, format, least, says):
    run_on(table, tmp_path / "run")
    words = ["export", str(tmp_path / "run"), "--format", format, "--out", str(tmp_path / "out")]
    assert main([*words, f"--min-confidence={least}"]) == 2
    assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("format", FORMATS)
def test_where_no_pose_is_that_confident_nothing_is_written(table, tmp_path, capsys, format):
    run_on(table, tmp_path / "run")
    words = ["export", str(tmp_path / "run"), "--format", format, "--out", str(tmp_path / "out")]
    assert main([*words, "--min-confidence", "0.9"]) == 2
    assert "no pose of confidence 0.9 or more" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert main([*words, "--min-confidence", "0.8"]) == 0


@pytest.mark.parametrize("format", FORMATS)
def test_poses_of_an_offline_run_say_so_and_read_back_the_same(table, tmp_path, capsys, format):
    causal, refined = tmp_path / "run", tmp_path / "refined"
    run_on(table, causal)
    shutil.copytree(causal, refined)
    (refined / "run.json").write_text(json.dumps(json.loads((causal / "run.json").read_text()) | {"offline": True}))
    read = []
    for folder in (causal, refined):
        out = folder / "out"
        assert main(["export", str(folder), "--format", format, "--out", str(out)]) == 0
        files = sorted(path for path in out.rglob("*") if path.is_file())
        told = capsys.readouterr().out.removeprefix("Written: ").strip().split(", ")
        assert all(Path(path.partition("/*.txt")[0]).exists() for path in told)
        marked = [path.name.startswith("p2p-offline_") or path.read_text().startswith("# offline\n") for path in files]
        assert files and set(marked) == {folder == refined}
        read.append(read_poses(out, open_sequence(table)))
    for name, poses in read[0].items():
        np.testing.assert_array_equal(read[1][name], poses)


def test_tum_as_scipy_reads_it(table, tmp_path):
    run = run_on(table, tmp_path / "run")
    export(run, tmp_path / "out", "tum")
    rows = np.loadtxt(tmp_path / "out" / "can.txt")
    seen = np.flatnonzero(run.objects["can"].has_pose)
    np.testing.assert_allclose(rows[:, 0], open_sequence(table).times_s[seen], atol=1e-6)
    R = Rotation.from_quat(rows[:, 4:]).as_matrix()
    np.testing.assert_allclose(se3.from_rt(R, rows[:, 1:4]), run.objects["can"].T_cam_obj[seen], atol=1e-8)


def test_times_of_another_rate_are_doubted(table, tmp_path):
    """Each lies near some frame's: half of the frames would be lost without a word."""
    run = run_on(table, tmp_path / "run")
    export(run, tmp_path / "out", "tum")
    rows, sequence = (tmp_path / "out" / "can.txt").read_text().splitlines(), open_sequence(table)
    (tmp_path / "out" / "can.txt").write_text("\n".join(rows[::2]) + "\n")
    with pytest.warns(Doubt, match="poses 2.0 times as far apart in time as the frames"):
        read_poses(tmp_path / "out", sequence)


def test_bop_csv_as_its_page_says(scene, tmp_path):
    run = run_on(scene, tmp_path / "run")
    path, _ = export_run(tmp_path / "run", "bop", tmp_path / "out")
    assert path.name == "p2p_000007-test.csv"
    lines = path.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time" and len(lines) == 1 + 2 * N - 4
    obj = run.objects["obj_000001"]
    scene_id, im_id, obj_id, score, R, t, time_s = lines[1].split(",")
    assert (scene_id, im_id, obj_id, float(score)) == ("7", "0", "1", 0.8) and float(time_s) == 0.02
    first = obj.T_cam_model[0]  # aligned there, so exact
    np.testing.assert_allclose(np.array(R.split(), float), first[:3, :3].ravel(), atol=1e-9)
    np.testing.assert_allclose(np.array(t.split(), float), first[:3, 3] * 1000, atol=1e-6)
    times = {line.split(",")[1]: set() for line in lines[1:]}
    for line in lines[1:]:
        times[line.split(",")[1]].add(line.split(",")[6])
    assert all(len(found) == 1 for found in times.values())  # one time for all estimates of a picture


@pytest.mark.parametrize("refined", [False, True])
def test_bop_csv_as_the_fields_own_toolkit_reads_it(scene, tmp_path, refined):
    inout = pytest.importorskip("bop_toolkit_lib.inout")
    done, info = run_on(scene, tmp_path / "run"), tmp_path / "run/run.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"offline": refined}))
    assert main(["export", str(tmp_path / "run"), "--format", "bop", "--out", str(tmp_path / "out")]) == 0
    (path,) = (tmp_path / "out").glob("*.csv")
    _, method, dataset, split, *_ = inout.parse_result_filename(path)
    assert (method, dataset, split) == ("p2p-offline" if refined else "p2p", "000007", "test")
    assert inout.check_bop_results(str(path))[0]
    told, frames = inout.load_bop_results(path), model_frames(done)
    for number, (name, T_obj_model) in enumerate(frames.items(), 1):
        obj = done.objects[name].select(done.objects[name].has_pose)
        t_mm = np.array([one["t"].ravel() for one in told if one["obj_id"] == number])
        np.testing.assert_allclose(t_mm / 1000, (obj.T_cam_obj @ T_obj_model)[:, :3, 3], atol=1e-6)


def test_bop_csv_takes_the_best_score_and_skips_other_scenes(scene, tmp_path):
    header = "scene_id,im_id,obj_id,score,R,t,time\n"
    one = "1 0 0 0 1 0 0 0 1"
    rows = [f"7,3,1,0.5,{one},0 0 500,-1", f"7,3,1,0.9,{one},0 0 900,-1", f"7,3,1,0.2,{one},0 0 200,-1"]
    rows += [f"8,3,1,1.0,{one},0 0 100,-1", f"7,3,55,1.0,{one},0 0 100,-1"]
    (tmp_path / "a.csv").write_text(header + "\n".join(rows))
    with pytest.warns(Doubt, match=r"no poses of obj_000002"):
        read = read_poses(tmp_path / "a.csv", open_sequence(scene))
    assert list(read) == ["obj_000001"] and np.isfinite(read["obj_000001"]).all((1, 2)).tolist() == [
        i == 3 for i in range(N)
    ]
    assert read["obj_000001"][3, 2, 3] == pytest.approx(0.9)


@pytest.fixture
def bottle(table, tmp_path):
    """One unnamed object, in the YCBInEOAT layout."""
    folder = tmp_path / "mustard"
    folder.mkdir()
    for sub in ("rgb", "depth"):
        (folder / sub).symlink_to(table / sub)
    (folder / "annotated_poses").symlink_to(table / "annotated_poses" / "can")
    (folder / "cam_K.txt").write_text(K)
    return folder


@pytest.mark.parametrize("names", [STEMS, [f"{i:04d}" for i in range(N)]], ids=["pictures", "numbers"])
@pytest.mark.parametrize("sub", ["", "ob_in_cam", "annotated_poses"])
def test_matrices_as_bundlesdf_writes_them(bottle, tmp_path, names, sub):
    poses = truth_of(1)
    (tmp_path / "theirs" / sub).mkdir(parents=True)
    for name, T in zip(names, poses):
        np.savetxt(tmp_path / "theirs" / sub / f"{name}.txt", T)
    (tmp_path / "theirs" / sub / f"{names[4]}.txt").unlink()
    np.savetxt(tmp_path / "theirs" / sub / f"{names[5]}.txt", np.zeros((4, 4)))
    np.savetxt(tmp_path / "theirs" / sub / f"{names[6]}.txt", np.full((4, 4), np.nan))
    [T] = read_poses(tmp_path / "theirs", open_sequence(bottle)).values()
    kept = np.setdiff1d(np.arange(N), [4, 5, 6])
    np.testing.assert_allclose(T[kept], poses[kept], atol=1e-9)
    assert np.isnan(T[[4, 5, 6]]).all()
    model = {"object": str(bottle.resolve().parent / "points.xyz")}
    np.savetxt(model["object"], np.random.default_rng(0).normal(0, 0.03, (50, 3)))
    [score] = evaluate(import_poses(tmp_path / "theirs", bottle, model)).as_dict()["objects"].values()
    assert (score["frames"], score["lost"]) == (N, 3)
    assert score["add_auc"] == pytest.approx(100 * (N - 3) / N)


def test_an_object_without_poses_is_lost_not_left_out(table, tmp_path):
    (tmp_path / "theirs" / "can").mkdir(parents=True)
    for stem, T in zip(STEMS, truth_of(1)):
        np.savetxt(tmp_path / "theirs" / "can" / f"{stem}.txt", T)
    with pytest.warns(Doubt, match=r"theirs: no poses of box. What has none is lost throughout\.$"):
        scores = evaluate(import_poses(tmp_path / "theirs", table)).as_dict()
    assert scores["objects"]["box"]["lost"] == N and scores["objects"]["box"]["add_auc"] == 0
    assert scores["mean"]["add_auc"] == pytest.approx(50)


def test_a_misnamed_file_is_named_beside_the_object_that_it_may_be_of(table, tmp_path):
    run = run_on(table, tmp_path / "run")
    export(run, tmp_path / "out", "tum")
    (tmp_path / "out/can.txt").rename(tmp_path / "out/carton.txt")
    (tmp_path / "out/.cache").mkdir()
    with pytest.warns(Doubt, match=r"no poses of can\. .* carton\.txt is of no object\. Did you mean can\?$"):
        assert list(read_poses(tmp_path / "out", open_sequence(table))) == ["box"]


def test_each_object_has_its_own_form(table, tmp_path):
    run = run_on(table, tmp_path / "run")
    export(run, tmp_path / "out", "tum")
    export(run, tmp_path / "out", "poses")
    (tmp_path / "out/annotated_poses/can").rename(tmp_path / "out/can")
    shutil.rmtree(tmp_path / "out/annotated_poses")
    (tmp_path / "out/can.txt").unlink()
    read = read_poses(tmp_path / "out", open_sequence(table))
    for name, obj in run.objects.items():
        np.testing.assert_allclose(read[name], obj.T_cam_obj, atol=3e-8)


@pytest.mark.parametrize("format", FORMATS)
def test_only_what_holds_quaternions_may_have_them_in_another_order(table, tmp_path, monkeypatch, format):
    run_on(table, tmp_path / "run")
    export_run(tmp_path / "run", format, tmp_path / "out")
    asked = []
    monkeypatch.setattr("p2p_lib.run.doubt_reading", lambda *args: asked.append(args))
    import_poses(tmp_path / "out", table, align="all", min_visible_px=7)
    ((run, quaternions, *how),) = asked
    assert quaternions == (set(run.objects) if format == "tum" else set()) and how == ["all", 7]


def test_only_some_frames(table, tmp_path):
    """A run over part of a sequence, and another method's poses over the same part, get the same scores."""
    run_on(table, tmp_path / "run")
    export_run(tmp_path / "run", "poses", tmp_path / "out")
    whole = evaluate(import_poses(tmp_path / "out", table))
    part = evaluate(import_poses(tmp_path / "out", table, start=3, stop=9))
    assert part.objects["can"].frame_index.tolist() == list(range(3, 9)) and part.objects["can"].lost == 2
    assert whole.objects["can"].lost == 3
    with pytest.raises(BadInput, match="0 <= start < stop within 12 frames"):
        import_poses(tmp_path / "out", table, start=9, stop=9)


IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0.5\n0 0 0 1\n"
ROW = "1 0 0 0 1 0 0 0 1,0 0 500"
FAULTS = {
    "no such folder": ({}, r"theirs: no such file or folder, expected poses"),
    "two tables": ({"a.csv": "", "b.csv": ""}, r"theirs: got 2 \.csv files"),
    "another header": ({"a.csv": "a,b\n1,2\n"}, r"a\.csv: got the header 'a,b', expected scene_id"),
    "nothing of it": (
        {"a.csv": "scene_id,im_id,obj_id,score,R,t,time\n1,0,7,1,,,1\n3,0,1,1,,,1\n".replace(",,", f",{ROW},")},
        r"a\.csv: got nothing of scene 1, but scene_id 1 with obj_id 7, scene_id 3 with obj_id 1, "
        r"expected scene_id 1, obj_id of its objects: .*can is \d.*Write scene_id 1, and the obj_id of each object",
    ),
    "nothing at all": (
        {"a.csv": "scene_id,im_id,obj_id,score,R,t,time\n"},
        r"a\.csv: got nothing of scene 1, expected",
    ),
    "a short rotation": (
        {"a.csv": "scene_id,im_id,obj_id,score,R,t,time\n1,0,1,1,1 0 0,0 0 1,1\n"},
        r"a\.csv: line 2: got unreadable",
    ),
    "no such picture": (
        {"a.csv": "scene_id,im_id,obj_id,score,R,t,time\n1,99,1,1,1 0 0 0 1 0 0 0 1,0 0 1,1\n"},
        r"a\.csv: line 2: got im_id 99",
    ),
    "a quaternion too long": (
        {"can.txt": f"{STEMS[0][:10]}.1002 0 0 1 0 0 0 2\n"},
        r"pose 1: got .*quaternion",
    ),
    "a word": ({"can.txt": "0 0 0 zero 0 0 0 1\n"}, r"can\.txt: got unreadable numbers .*'zero'"),
    "another time": (
        {"can.txt": "0.5 0 0 1 0 0 0 1\n"},
        r"can\.txt: got the time 0\.500000 s, expected times .*times_s",
    ),
    "no number": ({"can.txt": f"{STEMS[0][:10]}.1002 nan 0 1 0 0 0 1\n"}, r"pose 1: got .* nan .*Leave the line out"),
    "not rigid": ({"can/0000.txt": "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"}, r"0000\.txt: got a matrix that is not"),
    "another name": ({"can/frame.txt": IDENTITY}, r"frame\.txt: got the name frame, expected the name of an image"),
    "a number too high": ({"can/0012.txt": IDENTITY}, r"0012\.txt: got the name 0012, .*frame number below 12"),
    "three rows": ({"can/0000.txt": "1 0 0 0\n0 1 0 0\n0 0 1 0\n"}, r"0000\.txt: got shape \(3, 4\)"),
    "whose are they": ({"0000.txt": IDENTITY}, r"theirs: got poses of one object, expected .* box, can"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(table, tmp_path, fault):
    files, expected = FAULTS[fault]
    for name, text in files.items():
        (tmp_path / "theirs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "theirs" / name).write_text(text)
    with pytest.raises((BadInput, MissingData), match=expected):
        read_poses(tmp_path / "theirs", open_sequence(table))


def test_the_commands(table, tmp_path, capsys):
    run_on(table, tmp_path / "run")
    assert main(["export", str(tmp_path / "run"), "--format", "poses", "--out", str(tmp_path / "out")]) == 0
    there = [f"{tmp_path / 'out/annotated_poses' / n}/*.txt ({count})" for n, count in (("box", N - 1), ("can", N - 3))]
    assert capsys.readouterr().out.splitlines()[-1] == f"Written: {', '.join(there)}"
    assert len(list((tmp_path / "out/annotated_poses/can").iterdir())) == N - 3
    assert main(["export", str(tmp_path / "run"), "--format", "tum", "--out", str(tmp_path / "out")]) == 2
    assert "expected a new or empty folder" in capsys.readouterr().err
    words = ["eval", "--poses", str(tmp_path / "out"), "--sequence", str(table)]
    assert main(words) == 0
    assert "imported" in capsys.readouterr().out
    for wrong in (["eval"], words[:3], ["eval", str(tmp_path / "run"), *words[1:]]):
        with pytest.raises(SystemExit):
            main(wrong)
        assert "either DIR, a run's folder, or --poses with --sequence. See p2p eval --help" in capsys.readouterr().err


def test_without_truth_there_is_no_model_frame(table, tmp_path, capsys):
    folder = tmp_path / "plain"
    folder.mkdir()
    for sub in ("rgb", "depth", "masks"):
        (folder / sub).symlink_to(table / sub)
    (folder / "cam_K.txt").write_text(K)
    sequence = open_sequence(folder)
    with RunWriter(tmp_path / "run", sequence, preset("default"), "lk", "dataset") as writer:
        for i in range(N):
            pose = PoseEstimate("can", i, sequence.times_s[i], Status.TRACKED, np.eye(4), 1.0)
            writer.add(sequence.frame(i), {"can": pose}, 1.0)
    with pytest.raises(MissingData, match="no scored frame with truth and a pose, so no model frame"):
        export_run(tmp_path / "run", "bop", tmp_path / "out")
    assert export_run(tmp_path / "run", "bop", tmp_path / "out", "object")
