"""Runs on disk: what is written is read back, also from a run that was cut short; nothing is pickled."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import textwrap

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.config import from_toml, preset
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import COLUMNS, load_run
from p2p_lib.datasets.sequence import open_sequence

W, H, N = 32, 24, 150


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """N frames of two objects; "can" has a model, is labelled away in frame 3 and small in frame 4."""
    folder = tmp_path_factory.mktemp("data") / "table"
    poses = se3.exp(np.random.default_rng(5).normal(0, 0.4, (N, 6)))
    for sub in ("rgb", "depth", "masks/box", "masks/can", "annotated_poses/box", "annotated_poses/can", "models/can"):
        (folder / sub).mkdir(parents=True)
    for i in range(N):
        cv2.imwrite(str(folder / f"rgb/{i:04d}.png"), np.zeros((H, W, 3), np.uint8))
        cv2.imwrite(str(folder / f"depth/{i:04d}.png"), np.full((H, W), 700, np.uint16))
        for obj in ("box", "can"):
            mask = np.zeros((H, W), np.uint8)
            mask[: 2 if i == 4 else 15, :20] = 255
            cv2.imwrite(str(folder / f"masks/{obj}/{i:04d}.png"), mask)
            np.savetxt(folder / f"annotated_poses/{obj}/{i:04d}.txt", poses[i])
    (folder / "is_mask_visible/can").mkdir(parents=True)
    np.save(folder / "is_mask_visible/can/is_mask_visible.npy", np.arange(N) != 3)
    np.savetxt(folder / "models/can/points.xyz", np.random.default_rng(6).normal(0, 0.03, (50, 3)))
    np.savetxt(folder / "cam_K.txt", [[50.0, 0, 16], [0, 50, 12], [0, 0, 1]])
    return folder


def estimates_at(i, sequence):
    rng = np.random.default_rng(i)
    A = rng.normal(0, 1, (6, 6))
    pose = se3.exp(rng.normal(0, 0.5, 6))
    box = PoseEstimate(
        "box", i, i / 30, Status.DEGRADED, pose, 0.25, A @ A.T, "few points: 5", 9, 5, keyframe=bool(i % 10 == 0)
    )
    if i < 2:
        return {"box": box}  # the can is not being tracked yet
    if i % 3 == 0:
        return {"box": box, "can": PoseEstimate("can", i, i / 30, Status.OCCLUDED, reason="no mask")}
    return {"box": box, "can": PoseEstimate("can", i, i / 30, Status.TRACKED, se3.inverse(pose), 1.0)}


def frame_at(i):
    return Frame(i, i / 30, np.zeros((H, W, 3), np.uint8), np.zeros((H, W), np.float32))


def write(out, folder, n=20, start=0, **options):
    sequence = open_sequence(folder)
    models = {"can": folder / "models/can/points.xyz"}
    with RunWriter(
        out, sequence, preset("default", seed=3), "lk", "dataset", models=models, start=start, **options
    ) as w:
        for i in range(start, start + n):
            stages = {"tracking": 2.5} | ({"graph": 7.25} if i % 10 == 0 and i else {})
            w.add(frame_at(i), estimates_at(i, sequence), 10 + i, stages)
    return sequence


def test_everything_comes_back(table, tmp_path):
    sequence = write(tmp_path / "run", table)
    run = load_run(tmp_path / "run")
    assert list(run.objects) == ["box", "can"]
    for name, obj in run.objects.items():
        assert len(obj) == 20
        given = [estimates_at(i, sequence).get(name) for i in range(20)]
        np.testing.assert_array_equal(obj.frame_index, np.arange(20))
        np.testing.assert_array_equal(obj.time_s, np.arange(20) / 30)
        np.testing.assert_array_equal(obj.status, [e.status if e else "initialising" for e in given])
        np.testing.assert_array_equal(obj.reason, [e.reason if e else "not followed" for e in given])
        np.testing.assert_array_equal(obj.has_pose, [bool(e and e.T_cam_obj is not None) for e in given])
        for i, e in enumerate(given):
            if e and e.T_cam_obj is not None:
                np.testing.assert_array_equal(obj.T_cam_obj[i], e.T_cam_obj)
            if e and e.covariance is not None:
                np.testing.assert_array_equal(obj.covariance[i], e.covariance)
            else:
                assert np.isnan(obj.covariance[i]).all()
        for key in ("confidence", "visible_points", "inliers", "keyframe"):
            np.testing.assert_array_equal(getattr(obj, key), [getattr(e, key) if e else 0 for e in given])
        np.testing.assert_array_equal(obj.T_cam_model, sequence.truth[name].T_cam_model[:20])
    np.testing.assert_array_equal(run.objects["can"].labelled, np.arange(20) != 3)
    np.testing.assert_array_equal(run.objects["can"].visible_px, np.where(np.arange(20) == 4, 40, 300))
    np.testing.assert_array_equal(run.points["can"], np.loadtxt(table / "models/can/points.xyz"))
    assert "box" not in run.points


def test_what_ran_is_said(table, tmp_path):
    write(tmp_path / "run", table, stop=20)
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    expected = {
        "sequence": "table", "path": str(table), "format": "ycbmultitrack", "objects": ["box", "can"], "start": 0,
        "stop": 20, "tracker": "lk", "masks": "dataset", "preset": "default", "seed": 3, "frames": 20,
        "models": {"can": "models/can/points.xyz"}, "finished": True, "stopped_by": None,
    }  # fmt: skip
    assert {key: info[key] for key in expected} == expected
    assert info["versions"]["numpy"] == np.__version__ and info["versions"]["p2p_lib"]
    assert info["commit"] is None or len(info["commit"]) == 40
    assert from_toml(tmp_path / "run" / "config.toml") == preset("default", seed=3)


def test_tum_trajectories(table, tmp_path):
    sequence = write(tmp_path / "run", table)
    rows = np.loadtxt(tmp_path / "run" / "poses" / "can.txt")
    posed = [i for i in range(20) if i >= 2 and i % 3]
    assert rows.shape == (len(posed), 8)
    np.testing.assert_allclose(rows[:, 0], np.array(posed) / 30, atol=1e-9)
    T = se3.from_rt(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4])
    truth = np.stack([estimates_at(i, sequence)["can"].T_cam_obj for i in posed])
    np.testing.assert_allclose(T, truth, atol=1e-8)


def test_poses_are_of_the_map_with_the_most_unless_all_are_asked_for(table, tmp_path):
    with RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset") as w:
        for i, map_id in enumerate([0, 0, 0, 1, 1, 1]):
            status = Status.LOST if i == 2 else Status.TRACKED
            pose = {} if i == 2 else {"T_cam_obj": se3.exp(np.full(6, 0.1 * i)), "confidence": 0.9}
            w.add(frame_at(i), {"box": PoseEstimate("box", i, i / 30, status, map_id=map_id, **pose)}, 5)
            w.flush()
            rows = np.loadtxt(tmp_path / "run/poses/box.txt", ndmin=2)
            np.testing.assert_allclose(rows[:, 0] * 30, [[0], *[[0, 1]] * 4, [3, 4, 5]][i], atol=1e-6)
    assert w.kept_map("box") == 1
    last, every = (load_run(tmp_path / "run", every_map=every).objects["box"] for every in (False, True))
    np.testing.assert_array_equal(every.map_id, [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(every.has_pose, [True, True, False, True, True, True])
    np.testing.assert_array_equal(last.has_pose, [False, False, False, True, True, True])
    np.testing.assert_array_equal(last.confidence, [0, 0, 0, 0.9, 0.9, 0.9])
    np.testing.assert_array_equal(last.T_cam_obj[3:], every.T_cam_obj[3:])


def test_poses_in_a_map_that_became_part_of_the_last_are_in_its_frame_and_kept_as_they_were(table, tmp_path):
    T_in_first = se3.exp(np.random.default_rng(3).normal(0, 0.3, (7, 6)))
    T_first_second = se3.exp(np.array([0.3, -0.2, 1.0, 0.1, 0.2, -0.1]))
    covariance = np.diag([4e-4, 1e-4, 9e-4, 1e-6, 4e-6, 1e-6])
    with RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset") as w:
        for i, map_id in enumerate([0, 0, 1, 1, 1, 0, 0]):
            T = T_in_first[i] @ T_first_second if map_id else T_in_first[i]
            joined = (1, T_first_second) if i == 5 else None
            told = PoseEstimate("box", i, i / 30, Status.TRACKED, T, 0.9, covariance, map_id=map_id, joined=joined)
            w.add(frame_at(i), {"box": told}, 5)
    rows = np.loadtxt(tmp_path / "run/poses/box.txt")
    np.testing.assert_allclose(rows[:, 1:4], T_in_first[:, :3, 3], atol=1e-8)
    last, every = (load_run(tmp_path / "run", every_map=every).objects["box"] for every in (False, True))
    np.testing.assert_allclose(last.T_cam_obj, T_in_first, atol=1e-9)
    np.testing.assert_allclose(every.T_cam_obj[2:5], T_in_first[2:5] @ T_first_second, atol=1e-12)
    np.testing.assert_array_equal(every.joined_map, [-1, -1, -1, -1, -1, 1, -1])
    # The same noise, told in the other frame: by finite samples.
    noise = np.random.default_rng(4).multivariate_normal(np.zeros(6), covariance, 20000)
    moved = se3.inverse(T_in_first[3]) @ (every.T_cam_obj[3] @ se3.exp(noise)) @ se3.inverse(T_first_second)
    np.testing.assert_allclose(np.cov(se3.log(moved).T), last.covariance[3], atol=0.05 * last.covariance[3].max())


def test_times_of_nanosecond_names_keep_their_digits(table, tmp_path):
    with RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset") as w:
        frame = Frame(0, 1581120424.100262102, frame_at(0).rgb, frame_at(0).depth_m)
        w.add(frame, {"box": PoseEstimate("box", 0, frame.time_s, Status.TRACKED, np.eye(4))}, 5)
    assert (tmp_path / "run" / "poses" / "box.txt").read_text().startswith("1581120424.100262")


def test_timings_have_a_column_per_stage(table, tmp_path):
    write(tmp_path / "run", table)
    with (tmp_path / "run" / "timings.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["frame_index", "time_s", "total_ms", "keyframe", "tracking_ms", "graph_ms"]
    assert [row["graph_ms"] for row in rows[8:12]] == ["", "", "7.2500", ""]
    timings = load_run(tmp_path / "run").timings
    np.testing.assert_allclose(timings["total_ms"], 10 + np.arange(20))
    np.testing.assert_array_equal(np.flatnonzero(timings["keyframe"]), [0, 10])
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(timings["graph_ms"])), [10])


def test_a_part_of_a_sequence_keeps_its_frame_numbers(table, tmp_path):
    write(tmp_path / "run", table, n=7, start=90)
    run = load_run(tmp_path / "run")
    np.testing.assert_array_equal(run.objects["box"].frame_index, np.arange(90, 97))
    np.testing.assert_array_equal(run.objects["box"].T_cam_model, open_sequence(table).truth["box"].T_cam_model[90:97])


def test_an_object_that_nobody_announced_gets_rows_for_the_past(table, tmp_path):
    with RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset", objects=("can",)) as w:
        w.add(frame_at(0), {}, 5)
        w.add(frame_at(1), {"lid": PoseEstimate("lid", 1, 1 / 30, Status.TRACKED, np.eye(4))}, 5)
    lid = load_run(tmp_path / "run").objects["lid"]
    assert lid.status.tolist() == ["initialising", "tracked"] and not lid.has_truth.any() and not lid.labelled.any()
    assert set(load_run(tmp_path / "run").objects) == {"can", "lid"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupted_run_is_readable(table, tmp_path, error):
    sequence = open_sequence(table)
    with pytest.raises(error), RunWriter(tmp_path / "run", sequence, preset(), "lk", "dataset") as w:
        for i in range(100):
            if i == 83:
                raise error
            w.add(frame_at(i), estimates_at(i, sequence), 10)
    run = load_run(tmp_path / "run")
    assert all(len(obj) == 83 for obj in run.objects.values()) and len(run.timings["total_ms"]) == 83
    assert run.info["finished"] is False and run.info["stopped_by"] == error.__name__ and run.info["frames"] == 83
    assert len(np.loadtxt(tmp_path / "run" / "poses" / "box.txt")) == 83


def test_an_interruption_that_was_caught_inside_is_not_forgotten(table, tmp_path):
    with RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset") as w:
        w.add(frame_at(0), {}, 5)
        w.info["stopped_by"] = "KeyboardInterrupt"
    info = load_run(tmp_path / "run").info
    assert info["finished"] is False and info["stopped_by"] == "KeyboardInterrupt"


def test_a_killed_run_is_readable(table, tmp_path):
    program = f"""
        import os, signal, numpy as np
        from p2p_lib.core.config import preset
        from p2p_lib.core.types import Frame, PoseEstimate, Status
        from p2p_lib.datasets.run_writer import RunWriter
        from p2p_lib.datasets.sequence import open_sequence
        sequence = open_sequence({str(table)!r})
        with RunWriter({str(tmp_path / "run")!r}, sequence, preset(), "lk", "dataset") as w:
            for i in range({N}):
                if i == 140:
                    os.kill(os.getpid(), signal.SIGKILL)
                w.add(sequence.frame(i), {{"box": PoseEstimate("box", i, i / 30, Status.TRACKED, np.eye(4))}}, 10)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == -signal.SIGKILL
    run = load_run(tmp_path / "run")
    assert 80 < len(run.objects["box"]) <= 140 and not run.info["finished"]  # poses.npz lags by 50 frames or so
    assert len(run.timings["total_ms"]) == 140
    assert len(np.loadtxt(tmp_path / "run" / "poses" / "box.txt")) == 140


def test_a_timing_line_that_was_cut_is_left_out(table, tmp_path):
    write(tmp_path / "run", table)
    path = tmp_path / "run" / "timings.csv"
    path.write_text(path.read_text()[:-20])
    assert len(load_run(tmp_path / "run").timings["total_ms"]) == 19


def test_nothing_of_an_earlier_run_stays(table, tmp_path):
    write(tmp_path / "run", table)
    (tmp_path / "run" / "notes.md").write_text("mine")
    again = {"objects": ("can",), "if_exists": "replace"}
    with RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset", **again) as w:
        w.add(frame_at(0), {}, 5)
    run = load_run(tmp_path / "run")
    assert list(run.objects) == ["can"] and run.points == {} and len(run.objects["can"]) == 1
    assert [p.name for p in (tmp_path / "run" / "poses").iterdir()] == ["can.txt"]
    assert (tmp_path / "run" / "notes.md").read_text() == "mine"
    assert not [p for p in (tmp_path / "run").iterdir() if "partial" in p.name]


def test_no_archive_holds_a_pickle(table, tmp_path):
    write(tmp_path / "run", table)
    for name in ("poses.npz", "models.npz"):
        with np.load(tmp_path / "run" / name, allow_pickle=False) as file:
            assert all(file[key].dtype != object for key in file.files)
    with np.load(tmp_path / "run" / "poses.npz", allow_pickle=False) as file:
        assert {key.split("/")[1] for key in file.files} == set(COLUMNS)


def test_a_run_of_before_there_were_several_maps_is_of_one(table, tmp_path):
    write(tmp_path / "run", table)
    now, path = load_run(tmp_path / "run").objects["can"], tmp_path / "run" / "poses.npz"
    with np.load(path) as file:
        older = {key: file[key] for key in file.files if not key.endswith(("map_id", "joined_map", "T_obj_joined"))}
    np.savez(path, **older)
    then = load_run(tmp_path / "run").objects["can"]
    np.testing.assert_array_equal(then.T_cam_obj, now.T_cam_obj)
    assert (then.map_id == 0).all() and (then.joined_map == -1).all() and np.isnan(then.T_obj_joined).all()
    del older["can/status"]
    np.savez(path, **older)
    with pytest.raises(BadInput, match="no can/status, expected what p2p run wrote"):
        load_run(tmp_path / "run")


def test_faults_of_runs(table, tmp_path):
    with pytest.raises(MissingData, match=r"nowhere: no run there.*p2p run SEQ --out"):
        load_run(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"file: got a file, expected a folder"):
        RunWriter(tmp_path / "file", open_sequence(table), preset(), "lk", "dataset").__enter__()
    for name in ("../escape", "a/b", "", ".hidden"):
        with pytest.raises(BadInput, match="object name: got"):
            RunWriter(tmp_path / "run", open_sequence(table), preset(), "lk", "dataset", objects=(name,))
    write(tmp_path / "run", table)
    (tmp_path / "run" / "poses.npz").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(BadInput, match=r"poses\.npz: got an unreadable archive"):
        load_run(tmp_path / "run")
    (tmp_path / "run" / "run.json").write_text("{")
    with pytest.raises(BadInput, match=r"run\.json: got unreadable JSON"):
        load_run(tmp_path / "run")


def test_a_nan_pose_file_is_named_before_anything_runs(table, tmp_path):
    sequence = open_sequence(table)
    path = table / "annotated_poses/can/0002.txt"
    kept = path.read_text()
    try:
        np.savetxt(path, np.full((4, 4), np.nan))
        with pytest.raises(BadInput, match=r"annotated_poses/can/0002\.txt: got NaN"):
            RunWriter(tmp_path / "run", sequence, preset(), "lk", "dataset")
    finally:
        path.write_text(kept)
    assert not (tmp_path / "run").exists()


def test_sequences_and_runs_print_as_a_line(table, tmp_path):
    sequence = write(tmp_path / "run", table)
    assert repr(sequence) == f"ImageSequence({sequence.name!r}, {N} frames, {W}x{H}, objects: box, can)"
    assert re.fullmatch(
        r"Run\('.*run', frames with a pose: box \d+ of 20, can \d+ of 20\)", repr(load_run(tmp_path / "run"))
    )
