"""`make bench`: what is compared is timed in turn, the page has all of it, and the plain tracker is a fair peer."""

import importlib
import itertools
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import mahalanobis

from p2p_lib import open_sequence
from p2p_lib.core import se3
from p2p_lib.core.options import RunOptions
from p2p_lib.extended.default import MECHANISMS, chosen
from p2p_lib.extended.gates import DOUBTS, GATES

PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture
def load(monkeypatch):
    """Imports a file of ``benchmarks/`` as its scripts do."""
    monkeypatch.syspath_prepend(str(PROJECT / "benchmarks"))
    return importlib.import_module


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """The page of a quick run."""
    out = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "benchmarks/scale.py", "--quick", "--out", str(out)]
    ran = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-2000:]
    return out / "README.md"


def test_the_page_has_every_part_and_says_what_ran(page):
    text = page.read_text()
    sections = ["By frames", "By objects", "By keypoints an object", "By resolution", "Factor graph by keyframes"]
    sections += ["Registration by points", "Surface", "2D tracker alone"]
    assert re.findall(r"(?m)^## (.*)$", text) == sections
    for said in ("processor: ", "load in the minute before: ", "gtsam ", "open3d ", "commit: "):
        assert f"{said}" in text
    plots = re.findall(r"\]\((plots/.*?)\)", text)
    assert len(plots) == 5
    assert all(1000 < (page.parent / plot).stat().st_size < 60_000 for plot in plots)


def test_ratios_are_those_of_the_times_beside_them(page):
    rows = [line.strip("| ").split(" | ") for line in page.read_text().splitlines() if line.startswith("| ")]
    head, checked = [], 0
    for row in rows:
        if "median / peer" in row:
            head = row
        elif "peer, median (ms)" in head and len(row) == len(head) and not row[0].startswith("-"):
            cell = dict(zip(head, row, strict=True))
            for what in ("median", "p95"):
                ratio = float(cell[f"ours, {what} (ms)"]) / float(cell[f"peer, {what} (ms)"])
                assert float(cell[f"{what} / peer"]) == pytest.approx(ratio, rel=0.02)
                checked += 1
    assert checked >= 18


def test_an_unknown_part_is_refused():
    command = [sys.executable, "benchmarks/scale.py", "--quick", "--only", "teleport"]
    ran = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True)
    assert ran.returncode == 2 and "teleport" in ran.stderr and "tracking" in ran.stderr


def test_jobs_take_turns_and_warm_up_does_not_count(load, monkeypatch):
    common, order, now = load("common"), [], [0.0]
    monkeypatch.setattr(common.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(common.time, "process_time", lambda: 2 * now[0])
    ms = {"ours": itertools.chain([900, 900], range(1, 101)), "peer": itertools.chain([900, 900], [4] * 100)}

    def job(name):
        order.append(name)
        now[0] += next(ms[name]) / 1e3

    times = common.in_turn({name: lambda name=name: job(name) for name in ms}, rounds=100, warm_up=2)
    assert order == ["ours", "peer"] * 102
    table = common.compared(times, "peer").set_index("")
    ours = table.loc["ours"]
    assert ours["median (ms)"] == 50.5 and ours["p95 (ms)"] == pytest.approx(95, abs=0.1)
    assert ours["median / peer"] == pytest.approx(50.5 / 4, rel=0.01)
    assert ours["processor / peer"] == pytest.approx(50.5 / 4, rel=0.01)
    assert (table.loc["peer", ["median / peer", "p95 / peer", "processor / peer"]] == 1).all()


def test_the_peer_follows_two_objects_and_finds_them_again(load):
    sequence = open_sequence("synthetic/crossing")
    peer, hidden, first = load("peer").Peer(sequence.camera, sequence.objects), range(8, 12), {}
    for t in range(18):
        masks = sequence.masks(t)
        if t in hidden:
            masks = {name: np.zeros_like(mask) for name, mask in masks.items()}
        poses = peer.step(sequence.frame(t), masks)
        assert list(poses) == list(sequence.objects)
        for name, T in poses.items():
            assert (T is None) == (t in hidden)
            if T is not None:
                truth = sequence.truth[name].T_cam_model[t]
                deg, mm = se3.error_deg_mm(T @ first.setdefault(name, se3.inverse(T) @ truth), truth)
                assert deg < (2 if t < 8 else 5) and mm < 8, (t, name)
    assert peer.stopwatch.last_ms["total"] >= peer.stopwatch.last_ms["flow"] > 0


def test_a_tracker_that_is_wrong_is_not_right(load):
    bench, stopwatch = load("bench_tracking"), load("p2p_lib.core.stopwatch").Stopwatch()
    sequence = open_sequence("synthetic/crossing")
    truth = sequence.truth["box"].T_cam_model
    said = iter([None, None, truth[2], truth[3], None, truth[5] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]))])

    class Told:
        def __init__(self):
            self.stopwatch = stopwatch

        def step(self, frame, masks):
            with stopwatch.frame():
                return {"box": next(said)}

    images = [(sequence.frame(t), sequence.masks(t)) for t in range(6)]
    setting, told = bench.Compared(None, images, sequence), bench.Followed()
    bench.follow(Told(), setting, ("box",), told)
    assert told.right == [True, True, False, False], "the third has no pose, the fourth is 3 cm off"
    assert len(told.frames.wall_ms) == len(told.stages_ms) == 4, "not the first two"


def test_squared_errors_are_mahalanobis_distances_of_the_blocks(load):
    rng = np.random.default_rng(0)
    A, off = rng.normal(size=(9, 6, 6)), rng.normal(size=(9, 6))
    C = A @ A.transpose(0, 2, 1) + np.eye(6)
    told = load("common").squared_errors(off, C)
    for k, s in enumerate((slice(0, 3), slice(3, 6))):
        right = [mahalanobis(e[s], np.zeros(3), np.linalg.inv(c[s, s])) ** 2 for e, c in zip(off, C, strict=True)]
        np.testing.assert_allclose(told[:, k], right)


def test_the_stream_goes_there_and_back_without_a_cut(load):
    memory, sequence = load("bench_memory"), open_sequence("synthetic/crossing")
    frame = sequence.frame(0)
    images = [(replace(frame, index=k), np.full((1, 1), k)) for k in range(4)]
    stream = [pair for n in range(2) for pair in memory.there_and_back(images, n)]
    assert [int(masks["box"][0, 0]) for _, masks in stream] == [0, 1, 2, 3, 2, 1] * 2
    assert [frame.index for frame, _ in stream] == list(range(12))
    assert np.allclose(np.diff([frame.time_s for frame, _ in stream]), 1 / 30)


def test_a_mechanism_is_worth_what_the_method_loses_without_it(load):
    bench = load("bench_mechanisms")
    judged = "        if best is None:\n            nothing"
    blind = {"name": "any pose", "file": "p2p_lib/method/object_tracker.py", "find": judged}
    blind["replace"] = judged.replace("best is None", "True")
    runs = [bench.run_once(mechanism, "synthetic/crossing", stop=5) for mechanism in (None, blind)]
    assert runs[0]["add"] > 95 and runs[0]["lost"] == runs[0]["confidently_wrong"] == 0
    assert runs[1]["lost"] == runs[1]["frames"] - 2, "the first pose of each object is right by definition"
    names = bench.UNCHANGED, blind["name"]
    table = bench.compare(bench.pd.DataFrame([{"mechanism": m, "sequence": "s"} | run for m, run in zip(names, runs)]))
    assert table.loc["any pose", "ADD"] == pytest.approx(runs[0]["add"] - runs[1]["add"])
    assert table.loc["any pose", "lost"] == runs[1]["lost"]


def test_what_runs_without_truth_are_asked_for_is_known(load):
    bench = load("bench_verdicts")
    for _, options, _, _ in (bench.TUNED | bench.KEPT_ASIDE).values():
        chosen(RunOptions(**options).config())  # BadInput for a setting, a preset or a mechanism that is not known
    without = chosen(RunOptions(**bench.NO_GATES).config())
    assert without == MECHANISMS.keys() - GATES.keys() - DOUBTS.keys() and without


def test_truth_is_where_a_varied_video_shows_its_objects(load, opening):
    """Mirrored, turned, thinned and backwards: the middle of each object at its depth in its mask."""
    bench, video = load("bench_variants"), opening("crossing", 6)
    assert [len(of) for of in bench.variants(video)] == [6, 6, 6, 6, 3, 2, 6]
    for of in bench.variants(video):
        assert of.frame(0).rgb.shape[:2] == (of.camera.height, of.camera.width) and of.times_s[0] == 0
        for name, truth in of.truth.items():
            for i, T in enumerate(truth.T_cam_model):
                frame, mask = of.frame(i), of.masks(i)[name]
                np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
                assert np.linalg.det(T[:3, :3]) > 0, f"{of.name}: no rotation"
                u, v = of.camera.project(T[None, :3, 3])[0].round().astype(int)
                assert mask[v, u], f"{of.name}: {name}"
                assert 0 < T[2, 3] - frame.depth_m[v, u] < 0.1, f"{of.name}: {name}"


def test_other_objects_of_a_still_scene_move_as_the_one_that_the_dataset_knows(load, opening):
    """One is outlined as if nobody knew where it is."""
    bench, video = load("bench_other_objects"), opening("cluttered_desk", 5)
    known, other, *_ = video.objects
    v, u = np.nonzero(video.masks(1)[other])
    outline = [[u.min(), v.min()], [u.max(), v.min()], [u.max(), v.max()], [u.min(), v.max()]]
    made_of = {"it": {"points": [[u.mean(), v.mean()]], "outline": outline}}
    others = bench.Others(video, "others", np.arange(1, 5), made_of=made_of, first=1, of=known)
    assert others.objects == ("it",) and others.truth["it"].labelled.all() and others.masks(0) is None
    T_other_it = np.linalg.inv(video.truth[other].T_cam_model[1:]) @ others.truth["it"].T_cam_model
    np.testing.assert_allclose(T_other_it, np.repeat(T_other_it[:1], 4, 0), atol=1e-4)
    assert np.linalg.norm(T_other_it[0, :3, 3]) < 0.15
