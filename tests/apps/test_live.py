"""Live: a few frames wait, what is dropped is counted, and a line of JSON says what was seen."""

import io
import json
import logging
import queue
import re
import shutil
import socket
import sys
import threading
import time
import warnings
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import av
import cv2
import numpy as np
import pytest
import trimesh

from p2p_lib.apps import cli
from p2p_lib.apps.live import LiveOptions, _filmed, _warm_up, json_line, text_line, track_live
from p2p_lib.apps.live_click import LiveClicker
from p2p_lib.apps.live_words import KEPT, Words, outlet
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import warm_up
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt, MissingData
from p2p_lib.core.memory import load_memory
from p2p_lib.core.options import RunOptions
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import WITH_POSE, Frame, PoseEstimate, Status
from p2p_lib.datasets import cameras, run_writer
from p2p_lib.datasets.cameras import FolderCamera, Newest, open_camera
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.prompts import run_lengths, save_prompts
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.consistency import consistency
from p2p_lib.evaluation.known_size import Watch
from p2p_lib.extended.default import Point2Pose
from p2p_lib.figures.film import write_film
from p2p_lib.keeper import Keeper
from p2p_lib.run import run
from p2p_lib.trackers.lk import LkTracker
from tests.apps.test_cli import POINTS_ALONE
from tests.apps.test_click import visit
from tests.fixtures.sliding_board import H, K, W, write_sequence

FRAMES = 20  # then the board jumps back
SETTINGS = {"method.surface": "false", "method.graph": "false"}
PROMPTS = (Prompt("board", 0, [[60, 50]]),)


@pytest.fixture(scope="module", autouse=True)
def ready():
    """Nothing that is said comes of what is compiled, wherever these tests are run first."""
    warm_up()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_sequence(tmp_path_factory.mktemp("live") / "slide", FRAMES)


class Scripted:
    """A camera that gives what is put into its hand."""

    def __init__(self, camera: Camera):
        self.name, self.camera, self.hand, self.closed = "scripted", camera, queue.Queue(), False

    def read(self):
        given = None if self.closed else self.hand.get(timeout=120)
        if isinstance(given, Exception):
            raise given
        return given

    def close(self):
        self.closed = True
        self.hand.put(None)


def picture(index: int) -> Frame:
    return Frame(index, index / 30, np.zeros((H, W, 3), np.uint8), np.ones((H, W), np.float32))


@pytest.fixture
def scripted():
    return Scripted(Camera.from_K(K, W, H))


def taken_by_thread(camera: Scripted) -> None:
    """Until the reading thread holds all that was given."""
    while camera.hand.qsize():
        time.sleep(0.001)
    time.sleep(0.02)


def test_the_newest_frame_wins(scripted):
    with Newest(scripted) as newest:
        scripted.hand.put(picture(0))
        assert newest.take().index == 0
        for k in range(1, 6):
            scripted.hand.put(picture(k))
        taken_by_thread(scripted)
        assert newest.take().index == 5, "1 to 4 came while nobody looked"
        scripted.hand.put(picture(6))
        assert newest.take().index == 6, "it waits for what is to come"
        scripted.hand.put(None)
        assert newest.take() is None and newest.take() is None


def test_a_few_frames_wait_their_turn(scripted):
    with Newest(scripted, keep={1}, backlog=2) as newest:
        for k in range(8):
            scripted.hand.put(picture(k))
        scripted.hand.put(None)
        taken_by_thread(scripted)
        assert [f.index for f in iter(newest.take, None)] == [1, 5, 6, 7], "three wait besides the one that is kept"


def test_a_backlog_below_none_is_refused(folder):
    with pytest.raises(BadInput, match=r"backlog.*-1"):
        track_live(FolderCamera(open_sequence(folder), 20), PROMPTS, print, live=LiveOptions(backlog=-1))


def test_frames_that_must_not_be_dropped_wait(scripted):
    with Newest(scripted, keep={1, 3}) as newest:
        for k in range(6):
            scripted.hand.put(picture(k))
        scripted.hand.put(None)
        taken_by_thread(scripted)
        assert [f.index for f in iter(newest.take, None)] == [1, 3, 5]


def test_what_ends_the_camera_reaches_the_one_who_waits(scripted):
    with Newest(scripted) as newest:
        scripted.hand.put(MissingData("camera", "unplugged"))
        with pytest.raises(MissingData, match="unplugged"):
            newest.take()


def test_leaving_ends_the_thread(scripted):
    before = threading.active_count()
    with Newest(scripted):
        assert threading.active_count() == before + 1
    assert scripted.closed and threading.active_count() == before


class Careless(Scripted):
    """A camera whose close() does nothing: it goes on for ever, or waits for ever where ``waits``."""

    def __init__(self, camera: Camera, waits: bool):
        super().__init__(camera)
        self.waits, self.reads, self.woken = waits, 0, threading.Event()

    def read(self):
        self.reads += 1
        self.woken.wait(3600 if self.waits and self.reads == 3 else 0.001)
        return picture(self.reads)

    def close(self):
        pass


@pytest.mark.parametrize("waits", [False, True])
def test_a_camera_that_does_not_close_keeps_nobody(scripted, waits, monkeypatch):
    monkeypatch.setattr(cameras, "_PATIENCE_S", 0.3)
    careless = Careless(scripted.camera, waits)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with pytest.raises(RuntimeError, match="the user's own"), Newest(careless) as newest:
            newest.take()
            while careless.reads < 3:
                time.sleep(0.001)
            raise RuntimeError("the user's own")
    left = [thread.daemon for thread in threading.enumerate() if thread.name == "p2p camera"]
    careless.woken.set()
    assert left == [True] * waits, "what is left of it keeps no process"
    found = [str(doubt.message) for doubt in said if doubt.category is Doubt]
    assert len(found) == waits and all(
        "camera scripted: still in read(), 0.3 s after close()" in text for text in found
    )
    reads = careless.reads
    time.sleep(0.05)
    assert careless.reads == reads


def test_a_folder_plays_at_its_rate(folder):
    camera = FolderCamera(open_sequence(folder), 50)
    start = time.monotonic()
    indices = [frame.index for frame in iter(camera.read, None)]
    assert indices == list(range(FRAMES)) and time.monotonic() - start >= (FRAMES - 1) / 50


def test_a_folder_that_is_closed_stops_waiting(folder):
    camera = FolderCamera(open_sequence(folder), 0.01)
    camera.read()
    threading.Timer(0.05, camera.close).start()
    start = time.monotonic()
    assert camera.read() is None and time.monotonic() - start < 10


def test_a_folder_waits_for_whoever_clicks_on_its_first_image(folder):
    camera = FolderCamera(open_sequence(folder), 20)
    camera.read()
    time.sleep(0.5)  # the user clicks
    start = time.monotonic()
    indices = [camera.read().index for _ in range(5)]
    assert indices == [1, 2, 3, 4, 5] and time.monotonic() - start >= 5 / 20, "none is overdue"


def test_slow_processing_drops_frames_and_counts_them(folder):
    got = []

    def slow(estimate):
        got.append(estimate)
        time.sleep(0.05)

    count = track_live(FolderCamera(open_sequence(folder), 100), PROMPTS, slow, RunOptions(settings=SETTINGS))
    assert count.frames == len(got) and count.dropped > 0 and count.frames + count.dropped <= FRAMES
    assert [e.frame_index for e in got] == sorted({e.frame_index for e in got}) and got[0].frame_index == 0
    assert count.dropped == got[-1].frame_index + 1 - len(got), "what lies between two that were tracked"
    assert f"{count.frames} frames in " in str(count) and f"{count.dropped} dropped" in str(count)


def test_a_tracker_that_is_made_already_is_taken(folder):
    got: list[PoseEstimate] = []
    options = RunOptions(settings=SETTINGS, tracker=LkTracker(preset().tracking, np.random.default_rng(0)), stop=4)
    track_live(FolderCamera(open_sequence(folder), 20), PROMPTS, got.append, options, LiveOptions(backlog=1000))
    assert [estimate.frame_index for estimate in got] == [0, 1, 2, 3]


def test_live_estimates_are_those_of_a_run(folder, tmp_path):
    """A camera that waits for the tracker gives what p2p run gives: there is one algorithm."""
    sequence = open_sequence(folder)
    camera, got = Scripted(sequence.camera), []

    def next_please(estimate):
        got.append(estimate)
        camera.hand.put(sequence.frame(estimate.frame_index + 1) if estimate.frame_index + 1 < FRAMES else None)

    camera.hand.put(sequence.frame(0))
    count = track_live(camera, PROMPTS, next_please, RunOptions(settings=SETTINGS))
    assert (count.frames, count.dropped) == (FRAMES, 0)
    run(sequence, tmp_path / "run", settings=SETTINGS, prompts=PROMPTS, progress=False)
    wanted = np.load(tmp_path / "run" / "poses.npz")
    np.testing.assert_allclose([e.T_cam_obj for e in got], wanted["board/T_cam_obj"], atol=1e-12)
    assert [str(e.status) for e in got] == wanted["board/status"].tolist()


def test_a_camera_without_an_end_is_stopped_before_an_image(folder):
    got = []
    track_live(FolderCamera(open_sequence(folder), 20), PROMPTS, got.append, RunOptions(settings=SETTINGS, stop=4))
    assert 0 <= got[-1].frame_index < 4 and got[0].frame_index == 0


def test_a_prompt_starts_its_object_in_its_frame(folder):
    sequence, got = open_sequence(folder), []
    count = track_live(
        FolderCamera(sequence, 200),
        [Prompt("late", 9, [[60 + 18, 50 + 9]])],
        lambda e: (got.append(e), time.sleep(0.03)),
        RunOptions(settings=SETTINGS),
    )
    assert got[0].frame_index == 9 and got[0].status is Status.TRACKED and count.frames < FRAMES


def test_a_prompt_of_a_frame_that_never_comes_is_refused(folder):
    camera = FolderCamera(open_sequence(folder), 500)
    with pytest.raises(BadInput, match="prompt of 'mug': got frame 99, which never came"):
        track_live(camera, [Prompt("mug", 99, [[1, 1]])], print, RunOptions(settings=SETTINGS))


def test_a_camera_that_gives_no_image_is_told_from_a_wrong_frame():
    class Dark:
        camera, name = Camera.from_K(K, W, H), "dark"

        def read(self):
            return None

        def close(self):
            pass

    with pytest.raises(MissingData, match="camera dark: it gave no image"):
        track_live(Dark(), [Prompt("mug", 0, [[1, 1]])], print, RunOptions(settings=SETTINGS))


def test_a_run_is_kept_and_filmed(folder, tmp_path):
    """What is kept is what was said, and it can be looked at; the film has an image a frame."""
    sequence, got = open_sequence(folder), []
    live = LiveOptions(out=tmp_path / "run", overlay=tmp_path / "film.mp4")
    count = track_live(FolderCamera(sequence, 20), PROMPTS, got.append, RunOptions(settings=SETTINGS), live)
    kept = load_run(live.out)
    board = kept.objects["board"]
    np.testing.assert_allclose(board.T_cam_obj, [e.T_cam_obj for e in got])
    assert board.frame_index.tolist() == [e.frame_index for e in got] and len(got) == count.frames
    assert kept.info["finished"] and kept.info["segmenter"] == "builtin" and kept.info["path"] == str(folder)
    assert len(load_keypoints(live.out)["board"].ids) > 10
    write_film(live.out, tmp_path / "again.mp4")
    for film in ("film.mp4", "again.mp4"):
        with av.open(str(tmp_path / film)) as container:
            assert sum(1 for _ in container.decode(video=0)) == count.frames


def test_each_object_keeps_its_colour_in_the_film():
    """Whichever were removed before, and also once it is added again."""
    masks = {name: np.zeros((H, W), bool) for name in ("mug", "tin")}
    masks["mug"][40:60, 10:30] = masks["tin"][40:60, 50:70] = True
    method, film = SimpleNamespace(objects=masks, masks=masks), []
    listen = _filmed(SimpleNamespace(add=lambda image, time_s: film.append(image)), "camera", method, None)
    for k, followed in enumerate((["mug", "tin"], ["tin"], ["tin", "mug"])):
        method.objects = method.masks = {name: masks[name] for name in followed}
        listen(picture(k), {})
    both, alone, again = film
    assert (alone[masks["tin"]] == both[masks["tin"]]).all() and (again[40:] == both[40:]).all()
    assert (alone[masks["mug"]] == 0).all() and (both[50, 20] != both[50, 60]).any()


def test_a_correction_that_is_refused_corrects_no_mask(folder, tmp_path):
    """No depth was measured there: the object keeps the mask that it had."""
    sequence, said = open_sequence(folder), list(PROMPTS)
    method, drawn = Point2Pose(sequence.camera, preset("default").with_values(SETTINGS)), []
    method.tell(PROMPTS[0])
    with RunWriter(tmp_path / "run", sequence, method.config, "builtin", "clicks") as writer:
        keeper = Keeper(writer, method, prompts=said)
        for k in range(3):
            frame = sequence.frame(k)
            if k == 2:
                frame = replace(frame, depth_m=np.zeros_like(frame.depth_m))
                said.append(replace(PROMPTS[0], frame=k))
                method.tell(said[-1])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                estimates = method.step(frame)
            drawn.append(keeper.add(frame, estimates))
    assert method.refused and method.masks["board"].any()
    assert drawn == [(["board"], []), ([], []), ([], [])]


def test_an_object_that_is_added_again_before_the_next_frame_is_a_new_one(folder, tmp_path, caplog):
    """And no correction of the one that had its name."""
    caplog.set_level("INFO", "p2p_lib")
    sequence, said = open_sequence(folder), list(PROMPTS)
    method = Point2Pose(sequence.camera, preset("default").with_values(SETTINGS))
    with RunWriter(tmp_path / "run", sequence, method.config, "builtin", "clicks") as writer:
        keeper, drawn = Keeper(writer, method, prompts=said), []
        for k in range(4):
            if k == 2:
                method.remove_object("board")
            if k in (0, 2, 3):
                said.append(replace(PROMPTS[0], frame=k))
                method.tell(said[-1])
            drawn.append(keeper.add(sequence.frame(k), method.step(sequence.frame(k))))
    assert drawn == [(["board"], []), ([], []), (["board"], []), ([], ["board"])]
    turns = [text for text in caplog.messages if re.search("begins|removed|corrected", text)]
    first, second = ("frame 0: board begins, is tracked", "frame 2: board begins, is tracked")
    assert turns == [first, "board is removed", second, "frame 3: board is corrected"]


def test_stopping_a_camera_ends_its_run_well(scripted, folder, tmp_path):
    """One without a sequence, too."""
    sequence = open_sequence(folder)
    for k in range(3):
        scripted.hand.put(sequence.frame(k))

    def stop(estimate):
        if estimate.frame_index == 2:
            raise KeyboardInterrupt
        scripted.hand.put(sequence.frame(estimate.frame_index + 1))

    with pytest.raises(KeyboardInterrupt):
        track_live(scripted, PROMPTS, stop, RunOptions(settings=SETTINGS), LiveOptions(out=tmp_path / "run"))
    kept = load_run(tmp_path / "run")
    assert kept.info["finished"] and len(kept.objects["board"]) == 2 and kept.info["path"] is None
    assert load_keypoints(tmp_path / "run")


def test_stopping_a_camera_while_a_frame_is_written_keeps_the_frames_before_it(scripted, folder, tmp_path, monkeypatch):
    sequence, write_one, written = open_sequence(folder), run_writer.append, []

    def interrupted(path, line):
        written.append(Path(path).name)
        if written.count("timings.csv") == 2:
            raise KeyboardInterrupt
        write_one(path, line)

    def go_on(estimate):
        scripted.hand.put(sequence.frame(estimate.frame_index + 1))

    monkeypatch.setattr(run_writer, "append", interrupted)
    for k in range(3):
        scripted.hand.put(sequence.frame(k))
    with pytest.raises(KeyboardInterrupt):
        track_live(scripted, PROMPTS, go_on, RunOptions(settings=SETTINGS), LiveOptions(out=tmp_path / "run"))
    kept = load_run(tmp_path / "run")
    assert kept.info["finished"] and len(kept.objects["board"]) == len(kept.timings["total_ms"]) == kept.info["frames"]


# --- the command -------------------------------------------------------------------------------


WORDS = [word for word in POINTS_ALONE if word != "--quiet"]


def test_live_prints_a_line_per_object_and_frame(folder, tmp_path, capsys):
    prompts = save_prompts(tmp_path / "p.json", PROMPTS)
    code = cli.main(["live", "--camera", f"folder:{folder}", "--rate", "40", "--prompts", str(prompts), *WORDS])
    out, err = capsys.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    told = re.fullmatch(r"(\d+) frames in .* s \(.* Hz\), (\d+) dropped", err.splitlines()[-1])
    frames, dropped = map(int, told.groups())
    assert len(lines) == frames and frames + dropped <= FRAMES
    keys = {
        "time_s",
        "frame",
        "object",
        "status",
        "confidence",
        "T_cam_obj",
        "map_id",
        "covariance",
        "reason",
        "T_world_obj",
    }
    assert all(set(line) == keys and line["object"] == "board" for line in lines)
    last = lines[-1]
    assert last["time_s"] == pytest.approx(last["frame"] / 30, abs=1e-6) and last["status"] in WITH_POSE
    moved = np.array(last["T_cam_obj"])[:3, 3] - np.array(lines[0]["T_cam_obj"])[:3, 3]
    np.testing.assert_allclose(moved, last["frame"] * np.array([2, 1, 0]) / 200 * 0.5, atol=1e-3)
    assert np.shape(last["covariance"]) == (6, 6)


def test_on_a_terminal_a_run_that_is_kept_is_told_in_short_lines(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    prompts = save_prompts(tmp_path / "p.json", PROMPTS)
    live = ["live", "--camera", f"folder:{folder}", "--rate", "40", "--prompts", str(prompts), *WORDS]
    assert cli.main([*live, "--out", str(tmp_path / "run")]) == 0
    *_, last = capsys.readouterr().out.splitlines()
    obj = load_run(tmp_path / "run").objects["board"]
    x, y, z = obj.T_cam_obj[-1, :3, 3]
    status = f"board: {obj.status[-1]}"  # on a busy machine many frames are dropped before it
    assert last == f"{obj.time_s[-1]:.2f} s  {status}  {x:.3f} {y:.3f} {z:.3f} m  confidence {obj.confidence[-1]:.2f}"
    assert cli.main(live) == 0 and capsys.readouterr().out.startswith("{"), "nothing else keeps it"


def test_a_line_for_people_says_why_there_is_no_pose():
    gone = PoseEstimate("mug", 3, 0.1, Status.OCCLUDED, reason="out of view: 0 mask pixels")
    assert text_line(gone) == "0.10 s  mug: out of view: 0 mask pixels"


def test_no_pose_is_null_and_the_line_is_strict_json():
    line = json_line(PoseEstimate("mug", 3, 0.1, Status.LOST, reason='says "no"'))
    assert json.loads(line) | {"reason": ""} == {
        "time_s": 0.1,
        "frame": 3,
        "object": "mug",
        "status": "lost",
        "confidence": 0.0,
        "T_cam_obj": None,
        "map_id": 0,
        "covariance": None,
        "reason": "",
        "T_world_obj": None,
    }
    assert "\n" not in line and "NaN" not in line


def test_a_pose_of_too_little_confidence_is_null_and_says_so(folder, tmp_path, capsys, monkeypatch):
    """The line comes all the same, with all that is known but where the object is."""
    pose = {"T_cam_obj": np.eye(4), "covariance": np.eye(6), "T_world_obj": np.eye(4)}
    doubted = PoseEstimate("mug", 3, 0.1, Status.TRACKED, confidence=0.5, reason="blurred", **pose)
    whole, least = json.loads(json_line(doubted)), json.loads(json_line(doubted, 0.5))
    assert all(whole[key] is not None and least[key] is None for key in pose)
    said = "its pose is not told: confidence 0.50, not above 0.5; blurred"
    assert least["reason"] == said and text_line(doubted, 0.5) == f"0.10 s  mug: tracked: {said}"
    assert {key for key in whole if whole[key] != least[key]} == {*pose, "reason"}
    assert json_line(doubted, 0.4) == json_line(doubted) and text_line(doubted, 0.4) == text_line(doubted)
    prompts = save_prompts(tmp_path / "p.json", PROMPTS)
    live = ["live", "--camera", f"folder:{folder}", "--rate", "40", "--prompts", str(prompts), *WORDS]
    monkeypatch.setattr("p2p_lib.apps.live.json_line", lambda estimate, least: f"{least}")
    assert cli.main([*live, "--stop", "3", "--min-confidence", "0.7"]) == 0
    assert set(capsys.readouterr().out.splitlines()) == {"0.7"}
    assert cli.main([*live, "--min-confidence", "1"]) == 2
    assert "min_confidence: got 1, expected at least 0 and below 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("cm", "said"), [(12, "board: .* 12 cm given: fits"), (3, "size of 'board': .* longer|hold more")]
)
def test_known_sizes_are_compared_with_what_a_camera_sees(cm, said, folder, tmp_path):
    camera, heard = AtOnce(open_sequence(folder).camera, map(open_sequence(folder).frame, range(6))), []
    options = RunOptions(settings=SETTINGS, sizes={"board": cm})
    live = LiveOptions(say=heard.append, backlog=10, out=tmp_path / "run")
    track_live(camera, PROMPTS, lambda estimate: None, options, live)
    assert re.search(said, heard[-1]), heard
    doubted = any("known to be" in text for text in load_run(tmp_path / "run").info["look_at"]["board"])
    assert doubted == (cm == 3)
    with pytest.raises(BadInput, match="size: got the name 'board'"):
        track_live(camera, (Prompt("mug", 0, [[60, 50]]),), lambda estimate: None, options)


def test_that_masks_are_too_long_is_said_soon_and_once():
    camera, said = Camera.from_K(K, W, H), []
    watch, mask = Watch({"mug": 0.05, "can": 0.3}, said.append), np.zeros((H, W), bool)
    mask[40:60, 40:120] = True
    for k in range(30):
        assert not said
        watch.add(picture(k), {"mug": mask, "can": mask, "lid": mask}, camera)
    assert len(said) == 1 and said[0].startswith("size of 'mug': known to be 5 cm long"), "the can may show more yet"
    for k in range(30, 60):
        watch.add(picture(k), {"mug": mask, "can": None}, camera)
    assert len(said) == 1
    watch.end()
    assert len(said) == 2 and said[1].startswith("can: ") and "fits" in said[1]


def test_without_prompts_the_first_picture_is_clicked_on(folder, capsys, monkeypatch):
    from p2p_lib.apps import click

    def press(url: str) -> None:
        content = {"objects": [{"name": "board", "frame": 0, "points": [[60, 50]]}], "finish": True}
        urlopen(Request(f"{url}prompts", json.dumps(content).encode(), {"Content-Type": "application/json"})).close()

    wait = click.Clicker.wait
    monkeypatch.setattr(click.Clicker, "wait", lambda self: (press(self.url), wait(self, 10)))
    assert cli.main(["live", "--camera", f"folder:{folder}", "--rate", "40", "--no-browser", *WORDS]) == 0
    out, err = capsys.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    assert lines[0]["frame"] == 0 and {line["object"] for line in lines} == {"board"}
    assert err.startswith("Click in your browser at http://127.0.0.1:") and "dropped" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--camera", "webcam"],
            "camera: got 'webcam', expected realsense, realsense:RECORDING, folder:PATH or your own",
        ),
        (["--camera", "{folder}"], "Did you mean folder:"),
        (["--camera", "folder:{folder}", "--prompts", "{prompts}", "--stop", "0"], "stop: got 0, expected"),
        (["--camera", "folder:"], "camera: got 'folder:'"),
        (["--camera", "folder:{folder}", "--rate", "0"], "rate: got 0.0, expected frames per second, above 0"),
        (["--camera", "folder:{folder}x"], "slidex: no such folder"),
        (["--camera", "realsense:{folder}/no.bag"], "no.bag: no such recording"),
        (["--camera", "folder:{folder}", "--overlay", "x.avi"], "film: got x.avi, expected a name that ends in .mp4"),
        (
            ["--camera", "folder:{folder}", "--listen", "--to", "http://localhost:1"],
            "to: got 'http://localhost:1', expected",
        ),
        (["--camera", "folder:{folder}", "--listen", "--to", "tcp://localhost"], "expected tcp://HOST:PORT or udp://"),
        (["--camera", "folder:{folder}", "--listen", "--to", "tcp://localhost:1"], "nobody listens there"),
        (["--camera", "no_such_module:Camera"], "no_such_module cannot be imported"),
        (["--camera", "realsense", "--rate", "15"], "rate: got 15 with realsense"),
        (["--camera", "folder:{folder}", "--prompts", "{folder}/none.json"], "none.json: no such file"),
        (["--camera", "folder:{folder}", "--prompts", "{prompts}", "--masks", "sam9"], "sam9"),
    ],
)
def test_refusals_are_one_line(words, message, folder, tmp_path, capsys):
    prompts = save_prompts(tmp_path / "p.json", PROMPTS)
    assert cli.main(["live", *(word.format(folder=folder, prompts=prompts) for word in words)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and message in err and err.startswith("p2p live: ") and err.count("\n") == 1


def test_a_spoilt_picture_ends_it_with_its_name(folder, tmp_path, capsys):
    spoilt = shutil.copytree(folder, tmp_path / "spoilt")
    cv2.imwrite(str(spoilt / "depth" / "0019.png"), np.ones((H, W), np.uint8))
    prompts = save_prompts(tmp_path / "p.json", PROMPTS)
    assert cli.main(["live", "--camera", f"folder:{spoilt}", "--rate", "100", "--prompts", str(prompts), *WORDS]) == 2
    assert "0019.png" in capsys.readouterr().err


def test_realsense_is_named_by_open_camera(monkeypatch):
    """Where the library is missing, the one line says how to get it."""
    import sys

    from p2p_lib.core.errors import MissingBackend

    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingBackend, match=r"pyrealsense2 cannot be loaded .*pip install .p2p_lib"):
        open_camera("realsense")


def test_masks_that_no_camera_has_are_refused_before_anybody_clicks(folder, capsys, monkeypatch):
    monkeypatch.setattr("p2p_lib.apps.live.click_first", lambda *_: pytest.fail("clicks are asked for"))
    assert cli.main(["live", "--camera", f"folder:{folder}", "--masks", "dataset", "--no-browser"]) == 2
    assert capsys.readouterr().err.startswith("p2p live: masks: got 'dataset', expected the name of a segmenter")


def test_who_follows_nothing_is_told_so(folder):
    with pytest.raises(BadInput, match="prompts: got none, expected what to follow"):
        track_live(FolderCamera(open_sequence(folder), 500), (), print)


def test_what_is_tracked_before_the_camera_starts_uses_all_that_its_frames_will(caplog):
    method = Point2Pose(Camera(300, 300, 159.5, 119.5, 320, 240))
    with caplog.at_level("INFO", "p2p_lib"):
        _warm_up(method)
    assert not caplog.records and not logging.getLogger("p2p_lib").disabled
    assert method.objects["made up"].life.has_pose and method.masks["made up"].any()
    used = {"tracking", "segmentation", "observation", "registration", "refinement", "selection", "map"}
    assert used <= set(method.stopwatch.last_ms)


# --- while it runs -----------------------------------------------------------------------------


class Lines:
    """What somebody types, when they do."""

    def __init__(self):
        self.typed = queue.Queue()

    def __iter__(self):
        while (line := self.typed.get()) is not None:
            yield line
            self.typed.task_done()


def followed_in_step(folder: Path, before, settings=SETTINGS, **how) -> list[PoseEstimate]:
    """The estimates of a live run that is given each frame when it asks for it, after ``before(index)``."""
    sequence, got, asked = open_sequence(folder), [], queue.Queue()

    class InStep(Scripted):
        next = 0

        def read(self):
            asked.get(timeout=120)
            k, self.next = self.next, self.next + 1
            before(k)
            return sequence.frame(k) if k < 14 else None

    class Asking(Newest):
        def take(self):
            asked.put(True)  # all of the frame before is done: it has been tracked, told of and shown
            return super().take()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("p2p_lib.apps.live.Newest", Asking)
        patch.setattr("p2p_lib.apps.live._warm_up", lambda method: None)
        camera = InStep(sequence.camera)
        track_live(camera, (), got.append, RunOptions(settings=settings), LiveOptions(backlog=20, **how))
    return got


def typed_for(script: dict[int, str], lines: Lines):
    """Types each line before its frame."""

    def type_for(k):
        if k in script:
            lines.typed.put(script[k])
            lines.typed.join()  # it has been heard

    return type_for


def test_objects_are_added_corrected_and_removed_while_it_runs(folder, tmp_path):
    lines, errors = Lines(), []
    words = Words(lines, errors.append)
    #: Before which frame what is typed.
    script = {
        2: '{"name": "board", "points": [[64, 52]]}',
        5: '{"objects": [{"name": "board", "points": [[70, 55]], "negative": [[5, 5]]}]}',
        8: '{"remove": "board"}',
        10: '{"name": "again", "box": [30, 20, 130, 110]}',
    }

    got = followed_in_step(folder, typed_for(script, lines), words=words, out=tmp_path / "run")
    seen = {name: [e.frame_index for e in got if e.object == name] for name in ("board", "again")}
    assert seen == {"board": list(range(2, 8)), "again": list(range(10, 14))} and not errors
    assert all(e.T_cam_obj is not None for e in got)
    info = load_run(tmp_path / "run").info
    assert [(p["name"], p["frame"]) for p in info["prompts"]] == [("board", 2), ("board", 5), ("again", 10)]


def test_what_was_learnt_of_an_object_is_kept_when_it_is_removed(folder, tmp_path):
    """As it was then; a removed object is no lost one, and one of the same name after it is another."""
    lines, start = Lines(), '{"name": "board", "points": [[%d, 52]]}'
    script = {0: start % 60, 2: '{"remove": "board"}', 7: start % 75, 12: '{"remove": "board"}'}
    words = Words(lines, print)
    got = followed_in_step(folder, typed_for(script, lines), {}, words=words, out=tmp_path / "run")
    assert [(e.frame_index, e.map_id) for e in got] == [(0, 0), (1, 0), *((k, 1) for k in range(7, 12))]
    kept = load_run(tmp_path / "run")
    board = kept.objects["board"]
    assert board.has_pose.sum() == 5, "the map with the most poses"
    assert board.followed.tolist() == [True] * 2 + [False] * 5 + [True] * 5 + [False] * 2
    memory = load_memory(tmp_path / "run" / "maps" / "board.npz")
    assert memory.made_of["map_id"] == 1 and len(trimesh.load(tmp_path / "run" / "meshes" / "board.ply").faces)
    assert len(load_keypoints(tmp_path / "run")["board"].ids) > 10
    found = consistency(kept)
    assert not [text for text in found.look_at() if "found again" in text or "no mask and no pose" in text]


def test_objects_are_clicked_on_while_it_runs(tmp_path):
    """The page shows the frame that was tracked last; what is sent from there is of that, as long as nothing moves."""
    folder, errors = write_sequence(tmp_path / "slide", FRAMES), []
    for kind in ("rgb", "depth"):
        shutil.copy(folder / kind / "0001.png", folder / kind / "0002.png")
    sequence = open_sequence(folder)
    words = Words(None, errors.append)
    answers = {}

    def ask(where, content=None):
        data = None if content is None else json.dumps(content).encode()
        try:
            with urlopen(Request(page.url + where, data, {"Content-Type": "application/json"}), timeout=120) as answer:
                return answer.status, answer.read()
        except HTTPError as error:
            return error.code, error.read()

    def clicked(name, frame, **what):
        return {"objects": [{"name": name, "frame": frame, **what}], "finish": False}

    def click_for(k):
        session = json.loads(ask("session")[1])
        if k == 0:
            assert ask("frame/0")[0] == 500 and session["first"] == 0, "there is none yet"
            assert b"none has come" in ask("prompts", clicked("board", 0, points=[[64, 52]]))[1]
            return
        assert (session["first"], session["live"]) == (k - 1, True)
        answers[k] = session["names"]
        if k in (2, 3):
            image = cv2.imdecode(np.frombuffer(ask(f"frame/{k - 1}")[1], np.uint8), cv2.IMREAD_COLOR)
            np.testing.assert_array_equal(image[..., ::-1], sequence.frame(k - 1).rgb)
        if k == 2:
            start = clicked("board", 1, points=[[64, 52]])
            assert "board" in json.loads(ask("masks", start | {"frame": 1})[1])["masks"], "shown before it is sent"
            status, why = ask("prompts", clicked("board", 1, points=[[W, 5]]))
            assert status == 400 and b"expected pixels within" in why
            assert ask("prompts", clicked("board", 1, negative=[[64, 52]]))[0] == 400, "nothing is there to correct"
            for stale in (0, 9):
                status, why = ask("prompts", clicked("board", stale, points=[[64, 52]]))
                assert status == 400 and f"got frame {stale}, expected frame 1, the one that is shown" in why.decode()
            assert ask("prompts", start)[0] == 200
        if k == 5:
            (counts,) = json.loads(ask("masks", {"objects": [], "frame": 4})[1])["masks"].values()
            assert sum(counts[1::2]) > 500, "what is tracked is shown"
            assert ask("prompts", clicked("board", 4, negative=[[5, 5]]))[0] == 200
        if k == 8:
            assert ask("prompts", {"remove": "board"})[0] == 200

    with LiveClicker(Scripted(sequence.camera), words) as page:
        got = followed_in_step(folder, click_for, words=words, page=page, out=tmp_path / "run")
    assert [e.frame_index for e in got] == list(range(2, 8)) and not errors
    assert answers == {k: ["board"] if 3 <= k <= 8 else [] for k in range(1, 15)}
    prompts = load_run(tmp_path / "run").info["prompts"]
    assert [(p["frame"], p.get("negative")) for p in prompts] == [(2, None), (5, [[5, 5]])]


class Told(list):
    """In the place of a tracker: the prompts that it is told, and the frames that they are of."""

    objects = ("mug",)

    def __init__(self):
        self.of = []

    def tell(self, prompt, frame):
        self.append(prompt)
        self.of.append(frame)


def test_a_word_on_an_object_that_is_called_nearly_as_another_is_doubted():
    words, told = Words((), print), Told()
    words.hear('{"name": "Mug", "points": [[60, 50]]}')
    with pytest.warns(Doubt, match="object 'Mug': another one than 'mug', which is known"):
        words.tell(told, picture(0))
    assert [prompt.name for prompt in told] == ["Mug"]


def test_a_prompt_of_an_object_that_is_called_nearly_as_another_is_doubted(scripted, folder):
    sequence = open_sequence(folder)
    for k in range(2):
        scripted.hand.put(sequence.frame(k))
    scripted.hand.put(None)
    corrects = Prompt("Board", 1, [[64, 52]])
    with pytest.warns(Doubt, match="object 'Board': another one than 'board', which is known"):
        track_live(scripted, [*PROMPTS, corrects], lambda estimate: None, RunOptions(settings=SETTINGS))


def test_clicks_are_of_the_image_that_is_shown(folder):
    """Seconds later: the mask that was shown starts the object where nothing moved, and nothing where something has."""
    sequence, told = open_sequence(folder), Told()
    words = Words(None, print)
    first, same, later = (sequence.frame(k) for k in (0, 0, 6))
    same = Frame(3, 0.1, same.rgb, same.depth_m)
    with LiveClicker(Scripted(sequence.camera), words) as page:
        page.see(first, {})
        page.session()
        click = {"objects": [{"name": "board", "frame": 0, "points": [[64, 52], [50, 60]]}]}
        shown = page.masks(click | {"frame": 0})["masks"]["board"]
        page.see(same, {})
        assert page.save(click) == ""
        assert [prompt.frame for prompt in words.tell(told, picture(4))] == [4]
        assert run_lengths(told[0].mask)["counts"] == shown and told.of == [first], "it is looked at once more"
        page.see(later, {})
        assert page.save(click) == "The image has moved on at board: click again."
        page.session()
        with pytest.raises(BadInput, match="frame 6, the one that is shown"):
            page.save(click)
        assert page.save({"objects": [{"name": "board", "frame": 6, "points": [[76, 58]]}]}) == ""
        assert len(words.tell(told, picture(7))) == 1


def test_a_correction_is_of_the_image_that_is_shown(folder):
    """Of each object by itself: what stands is told as it was clicked, what has moved is not."""
    sequence, told = open_sequence(folder), Told()
    first, later = sequence.frame(0), sequence.frame(6)
    words, known = Words(None, print), {"board": None, "wall": None}
    with LiveClicker(Scripted(sequence.camera), words) as page:
        page.see(first, known)
        page.session()
        page.see(Frame(9, 0.3, later.rgb, later.depth_m), known)
        said = [
            {"name": "board", "frame": 0, "negative": [[64, 52]]},
            {"name": "wall", "frame": 0, "negative": [[5, 5]]},
        ]
        assert page.save({"objects": said}) == "The image has moved on at board: click again."
        words.tell(told, picture(10))
        assert [(prompt.name, prompt.negative_px.tolist()) for prompt in told] == [("wall", [[5, 5]])]
        page.session()
        box = {"name": "board", "frame": 9, "box": [30, 20, 130, 110]}
        assert page.save({"objects": [box]}) == "" and words.tell(told, picture(11))[0].box_px is not None


def test_clicks_that_select_nothing_are_refused_on_the_page(folder, monkeypatch):
    with LiveClicker(Scripted(open_sequence(folder).camera), Words(None, print)) as page:
        page.see(open_sequence(folder).frame(0), {})
        page.session()
        nothing = {"board": np.zeros((H, W), bool)}
        monkeypatch.setattr(page, "made", lambda prompts, kept: (nothing, []))
        with pytest.raises(BadInput, match="nothing found there"):
            page.save({"objects": [{"name": "board", "frame": 0, "points": [[64, 52]]}]})


def test_the_live_page_sends_clicks_and_forgets_them(scripted):
    page = LiveClicker(scripted, Words(None, print))
    with page:
        page.see(picture(7), {"board": np.eye(H, W, dtype=bool)})
        session = page.session()
    seen = visit(session, ["add", "cup"], ["press", 50, 20], ["wait"], ["save"])
    assert seen["sent"] == {"objects": [{"name": "cup", "frame": 7, "points": [[50, 20]]}], "finish": False}
    assert (seen["message"], seen["rows"]) == ("Sent.", ["board", "cup: frame 7"]), "it stood meanwhile"
    seen = visit(session, ["add", "cup"], ["press", 50, 20], ["save"], ["wait"], again="Click again.")
    assert (seen["message"], seen["rows"]) == ("Click again.", ["board"]), "the newest image, without what was clicked"
    seen = visit(session, ["add", "cup"], ["press", 50, 20], ["save"], ["wait"], ["wait"], ["remove", 0])
    assert (seen["sent"], seen["rows"]) == ({"remove": "board"}, ["board"]), "what is tracked"


def test_whoever_is_to_say_something_is_told_when_and_how(folder, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    words = ["live", "--camera", f"folder:{folder}", "--rate", "200", *WORDS]
    assert cli.main([*words, "--listen"]) == 0
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("slide runs; objects are told on standard input, a line each: ") and "dropped" in last
    shown = first.partition(": ")[2].partition(" or ")
    said = Words(None, print)
    said.hear(shown[0].replace("[x, y], ...", "[60, 50]"))
    said.hear(shown[2])
    assert [(name, prompt is None) for name, prompt, _ in said._pending] == [("mug", False), ("mug", True)]
    assert cli.main([*words, "--click", "--no-browser"]) == 0
    assert "standard input" not in capsys.readouterr().err


def test_words_that_do_not_fit_are_said_and_change_nothing():
    lines, errors = Lines(), []
    words = Words(lines, errors.append)
    with Point2Pose(Camera.from_K(K, W, H)) as method:
        for line in (
            "hello",
            '{"remove": "mug"}',
            '{"name": "mug", "points": [[900, 10]]}',
            '{"name": "mug"}',
            '{"mug": [[320, 240]]}',
            '{"name": "mug", "point": [[320, 240]]}',
            '{"name": "mug", "clicks": [[320, 240]]}',
            '{"name": "mug", "mask": "mug.png"}',
            "[]",
            " ",
        ):
            lines.typed.put(line)
        lines.typed.put(None)
        while lines.typed.qsize() or len(errors) < 3:
            time.sleep(0.001)
        assert words.tell(method, picture(3)) == [] and not method.objects
    said = "\n".join(errors)
    for part in (
        "line: got hello",
        "remove_object: got 'mug', expected one of no objects",
        "clicks on 'mug'",
        '"points": [[x, y], ...]} or {"remove": "mug"}. Say where it is: box, mask, negative, points.',
        "Did you mean points?",
        "'clicks' is not known. Say where it is: box,",
        "mask of 'mug': got 'mug.png', expected run lengths",
        'line: got {"mug": [[320, 240]]}, expected {"name"',
        "line: got []",
    ):
        assert part in said
    assert len(errors) == 9


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_lines_go_to_a_socket(kind, folder, tmp_path, capsys):
    got = []
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(30)
        if kind == "tcp":
            server.listen()

        def read():
            if kind == "tcp":
                with server.accept()[0].makefile() as lines:
                    got.extend(lines)
            else:
                while json.loads(line := server.recv(65536).decode())["frame"] < 5:
                    got.append(line)

        reader = threading.Thread(target=read)
        reader.start()
        prompts = save_prompts(tmp_path / "p.json", PROMPTS)
        words = ["live", "--camera", f"folder:{folder}", "--rate", "40", "--prompts", str(prompts), *WORDS]
        assert cli.main([*words, "--to", f"{kind}://127.0.0.1:{server.getsockname()[1]}"]) == 0
        reader.join()
    assert capsys.readouterr().out == "" and {json.loads(line)["object"] for line in got} == {"board"}


def test_what_a_folder_holds_cannot_be_gone_on_with(folder, tmp_path, capsys):
    """As ``p2p run`` could: a camera's images are gone."""
    prompts, out = save_prompts(tmp_path / "p.json", PROMPTS), tmp_path / "run"
    words = [
        "live",
        "--camera",
        f"folder:{folder}",
        "--rate",
        "100",
        "--prompts",
        str(prompts),
        "--out",
        str(out),
        *WORDS,
    ]
    assert cli.main([*words, "--stop", "3"]) == 0 and cli.main(words) == 2
    assert "--force" in (err := capsys.readouterr().err) and "--resume" not in err


def test_a_reader_that_goes_away_ends_nothing(capsys):
    said = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        with outlet(f"tcp://127.0.0.1:{server.getsockname()[1]}", said.append) as send:
            server.accept()[0].close()
            for _ in range(20):
                send("x" * 10_000)
                time.sleep(0.01)
            assert len(said) == 1 and "tracking goes on" in said[0]
            server.settimeout(20)
            another = server.accept()[0]
            while len(said) < 2:
                time.sleep(0.001)
            send("again")
            assert another.recv(100) == b"again\n" and said[1].endswith("takes lines again.")


def test_a_camera_of_somebody_elses(folder, tmp_path, capsys, monkeypatch):
    (tmp_path / "their_camera.py").write_text(
        "import numpy as np\n"
        "from p2p_lib import Camera, Frame\n"
        "from p2p_lib.datasets.sequence import open_sequence\n"
        "class Theirs:\n"
        "    name = 'theirs'\n"
        "    def __init__(self):\n"
        f"        self.sequence, self.k = open_sequence({str(folder)!r}), -1\n"
        "        self.camera = self.sequence.camera\n"
        "    def read(self):\n"
        "        self.k += 1\n"
        "        f = self.sequence.frame(self.k)\n"
        "        return Frame(self.k, f.time_s, f.rgb, f.depth_m, np.eye(4)) if self.k < 6 else None\n"
        "    def close(self):\n"
        "        pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    prompts = save_prompts(tmp_path / "p.json", PROMPTS)
    assert cli.main(["live", "--camera", "their_camera:Theirs", "--prompts", str(prompts), *WORDS]) == 0
    line = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert line["T_world_obj"] == line["T_cam_obj"] is not None
    assert cli.main(["live", "--camera", "their_camera:Frame", "--prompts", str(prompts)]) == 2
    assert re.search(r"their_camera:Frame: got Frame\(index.* expected Frame\(\), see", capsys.readouterr().err)


def test_a_camera_of_somebody_elses_is_closed_once_and_what_it_gives_is_checked(folder, tmp_path, capsys, monkeypatch):
    (tmp_path / "odd_cameras.py").write_text(
        "import numpy as np\n"
        "from p2p_lib import Camera, Frame\n"
        "closed = []\n"
        "class Ends:\n"
        f"    name, camera = 'ends', Camera.from_K({np.asarray(K).tolist()!r}, {W}, {H})\n"
        "    def read(self): return None\n"
        "    def close(self): closed.append(self.name)\n"
        "class Pair(Ends):\n"
        "    def read(self): return ('rgb', 'depth')\n"
        "class Breaks(Ends):\n"
        "    def read(self): raise OSError('unplugged')\n"
        "class Endless(Ends):\n"
        "    read = property()\n"
        "class Nameless(Ends):\n"
        "    name = None\n"
        "class Matrix(Ends):\n"
        "    camera = [[1]]\n"
        "class Unnumbered(Ends):\n"
        "    index, left = None, 8\n"
        "    def read(self):\n"
        "        self.left -= 1\n"
        f"        image, depth_m = np.zeros(({H}, {W}, 3), np.uint8), np.ones(({H}, {W}))\n"
        "        return Frame(self.index, 0.0, image, depth_m) if self.left else None\n"
        "class Stuck(Unnumbered):\n"
        "    index = 0\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert cli.main(["live", "--camera", "odd_cameras:Ends", "--listen", *WORDS]) == 0
    assert sys.modules["odd_cameras"].closed == ["ends"]
    capsys.readouterr()
    assert cli.main(["live", "--camera", "odd_cameras:Ends", "--click", "--no-browser", *WORDS]) == 0
    assert re.search(r"Click in your browser at http://127\.0\.0\.1:\d+/", capsys.readouterr().err)
    for name, said in (
        ("Pair", "camera odd_cameras:Pair: read(): got tuple, expected a p2p_lib.Frame, or None at the end"),
        ("Breaks", "camera odd_cameras:Breaks: Breaks.read raised OSError: unplugged ("),
        ("Endless", "camera odd_cameras:Endless: got Endless without read, expected a camera"),
        ("Nameless", "camera odd_cameras:Nameless: name: got None"),
        ("Matrix", "camera odd_cameras:Matrix: camera: got list, expected a p2p_lib.Camera"),
        ("Unnumbered", "frame index: got None, expected a whole number from 0"),
        ("Stuck", "camera odd_cameras:Stuck: read(): got index 0 after 0, expected an index that increases"),
    ):
        capsys.readouterr()
        assert cli.main(["live", "--camera", f"odd_cameras:{name}", "--listen", *WORDS]) == 2
        assert said in capsys.readouterr().err


def odd(scripted, sizes):
    """A camera of somebody else's that gives images of these heights."""
    for k, h in enumerate(sizes):
        whole = picture(k)
        scripted.hand.put(Frame(k, k / 30, whole.rgb[:h], whole.depth_m[:h]))
    scripted.hand.put(None)
    return cameras.OwnCamera("mine:Camera", scripted)


def test_images_of_another_size_are_left_out_and_said(scripted, recwarn):
    """All of them, however many others come between; not before one of the right size shows that it is no rule."""
    camera = odd(scripted, [9, H, 9, 9, H, 9])
    assert [frame.index for frame in iter(camera.read, None)] == [1, 4]
    first = f"camera mine:Camera: image 0: {W}x9, not {W}x{H} (width x height) as its camera. It is left out."
    assert len(recwarn) == 4 and str(recwarn[0].message) == first


@pytest.mark.parametrize(("sizes", "count"), [([9] * 3, 3), ([9] * 40, 30), ([H, *[9] * 40], 30)])
def test_a_camera_whose_images_all_have_another_size_ends_it(scripted, sizes, count, recwarn):
    camera = odd(scripted, sizes)
    with pytest.raises(BadInput, match=f"got {W}x9, expected {W}x{H} .* {count} in a row were: make its camera"):
        deque(iter(camera.read, None), 0)
    assert not len(recwarn), "of what ends it, it is not said that it is left out"


def test_a_live_run_says_that_its_images_are_gone(scripted, folder, tmp_path, capsys):
    for given in (*(open_sequence(folder).frame(k) for k in range(3)), None):
        scripted.hand.put(given)
    track_live(
        scripted, PROMPTS, lambda estimate: None, RunOptions(settings=SETTINGS), LiveOptions(out=tmp_path / "run")
    )
    for command in (["refine"], ["film", "--out", str(tmp_path / "f.webp")]):
        assert cli.main([command[0], str(tmp_path / "run"), *command[1:]]) == 2
        assert "it was a live camera's, of which none are kept. To have them" in capsys.readouterr().err


def test_frames_up_to_the_stop_are_all_counted(folder):
    """The camera itself has dropped those before the stop, and gives one after it."""
    sequence = open_sequence(folder)
    camera = Scripted(sequence.camera)
    for k in (0, 1, 2, 14):
        camera.hand.put(sequence.frame(k))
    said = []
    options = RunOptions(settings=SETTINGS, stop=12)
    count = track_live(camera, PROMPTS, lambda estimate: None, options, LiveOptions(say=said.append))
    assert (count.frames, count.dropped) == (3, 9) and not [line for line in said if "first masks" in line]


def test_no_image_is_waited_for_after_the_last_one_before_the_stop(scripted):
    for k in range(6):
        scripted.hand.put(picture(k))
    with Newest(scripted, backlog=9, stop=6) as newest:
        assert [newest.take().index for _ in range(6)] == list(range(6))
        newest._thread.join(10)  # the camera has no seventh
        assert newest.take() is None and newest.stopped


def test_what_was_dropped_while_the_first_masks_were_made_is_said(folder):
    sequence, said = open_sequence(folder), []
    camera = Scripted(sequence.camera)
    for k in (0, 5, 7):
        camera.hand.put(sequence.frame(k))
    camera.hand.put(None)
    options = RunOptions(settings=SETTINGS)
    count = track_live(camera, PROMPTS, lambda estimate: None, options, LiveOptions(say=said.append))
    assert (count.frames, count.dropped) == (3, 5)
    assert said[-1] == "4 images came while the first frame was worked on, and were dropped"


class AtOnce(Scripted):
    """Gives all that it has as fast as it is read; every frame waits until the first was taken from it."""

    def __init__(self, camera, frames):
        super().__init__(camera)
        for frame in (*frames, None):
            self.hand.put(frame)


@pytest.mark.parametrize(("backlog", "kept"), [(4, [0, 3, 4, 5, 6, 7]), (0, [0, 7]), (8, list(range(8)))])
def test_images_after_the_stop_push_none_out(folder, backlog, kept, monkeypatch):
    sequence, got = open_sequence(folder), []
    camera = AtOnce(sequence.camera, map(sequence.frame, range(FRAMES)))
    taken = Newest.take

    def take(newest):  # as a tracker that is slower than any camera
        newest._thread.join()
        return taken(newest)

    monkeypatch.setattr(Newest, "take", take)
    options = RunOptions(settings=SETTINGS, stop=8)
    count = track_live(camera, PROMPTS, got.append, options, LiveOptions(backlog=backlog))
    assert [estimate.frame_index for estimate in got] == kept
    assert (count.frames, count.dropped) == (len(kept), 8 - len(kept))


def test_a_line_may_name_the_frame_that_it_is_of():
    """One that was tracked a while ago: it is kept. One that was not, or long ago, is refused."""
    errors, told, line = [], Told(), '{"name": "mug", "frame": %d, "points": [[60, 50]]}'
    words, frames = Words((), errors.append), [picture(2 * k) for k in range(KEPT + 1)]
    for said, frame in zip(("", line % 0, line % 0, line % 1, line.replace(' "frame": %d,', "")), frames):
        words.hear(said)
        words.tell(told, frame)
    assert [(prompt.frame, of) for prompt, of in zip(told, told.of)] == [(2, frames[0]), (4, frames[0]), (8, None)]
    for frame in frames[5:]:
        words.tell(told, frame)
    words.hear('{"objects": [%s]}' % (line % 0))
    words.hear(line % 2)
    words.tell(told, picture(999))
    assert told.of[3:] == [frames[1]]
    for k, error in zip((1, 0), errors, strict=True):
        why = f"got frame {k}, expected one of the last {KEPT} that were tracked. Click on a newer image"
        assert error.startswith(f"prompt of 'mug': {why}")


def test_a_run_of_a_folder_with_models_can_be_scored(folder, tmp_path, capsys):
    prompts = save_prompts(tmp_path / "p.json", [Prompt("object", 0, [[60, 50]])])
    words = ["live", "--camera", f"folder:{folder}", "--prompts", str(prompts), "--stop", "6", *WORDS]
    assert cli.main([*words, "--out", str(tmp_path / "run")]) == 0
    assert cli.main(["eval", str(tmp_path / "run")]) == 0
    assert "ADD-S AUC [%]" in capsys.readouterr().out
