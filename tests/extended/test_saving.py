"""A saved tracker is loaded with what was asked for; what is kept of an object says where it comes from."""

import copy
import json
import pickle
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib import Camera, Point2Pose, __version__, preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.memory import load_memory, read_memories
from p2p_lib.core.types import Frame
from p2p_lib.extended import saving
from p2p_lib.method import pipeline
from p2p_lib.segmenters import anchored, sam2
from p2p_lib.trackers.lk import LkTracker
from tests.fixtures.made_memory import made_memory

CAMERA = Camera(300, 300, 159.5, 119.5, 320, 240)


class Mine(LkTracker):
    """Somebody's own, of another name than its place."""

    name = "mine"

    def __init__(self, config=None, rng=None):
        super().__init__(config or preset().tracking)


@pytest.fixture
def saved(tmp_path):
    """A tracker with one object, saved, and what is loaded of it."""

    def save_and_load(config=None, given=(), **parts) -> Point2Pose:
        with Point2Pose(CAMERA, config, **parts) as method:
            method.add_object("ball", memory=made_memory())
            method.save(tmp_path / "tracker.npz")
        return Point2Pose.load(tmp_path / "tracker.npz", **dict(given))

    return save_and_load


@pytest.mark.parametrize("forget_after", [0, 10])
def test_a_tracker_without_long_memory_is_loaded_again(saved, forget_after):
    """Its own name says how much it forgets, and is not the one that it was asked for by."""
    config = preset().with_values({"tracking.forget_after": forget_after})
    with saved(config) as loaded:
        assert loaded.tracker.name == ("builtin-sh(10)" if forget_after else "builtin")
        assert loaded.config == config and list(loaded.objects) == ["ball"]


def test_a_segmenter_that_names_itself_by_what_is_installed_is_loaded_again(saved, monkeypatch):
    """With the image part of SAM 2 the built-in segmenter is called builtin+sam2."""
    monkeypatch.setattr(anchored, "_available", lambda: True)
    monkeypatch.setattr(sam2, "shared_network", lambda *how: None)
    with saved() as loaded:
        assert loaded.segmenter.name == "builtin+sam2"


def test_parts_that_were_named_by_their_place_are_loaded_again(saved):
    with saved(tracker="tests.extended.test_saving:Mine", detector="uniform") as loaded:
        assert loaded.tracker.name == Mine.name and loaded.detector.name == "uniform"


def test_a_part_that_was_an_instance_is_asked_for(saved, tmp_path):
    with pytest.raises(
        BadInput, match=r"tracker: got none, and Mine, which was given as an instance, .* tracker=\.\.\."
    ):
        saved(tracker=Mine())
    with Point2Pose.load(tmp_path / "tracker.npz", tracker=Mine()) as loaded:
        assert loaded.tracker.name == "mine" and list(loaded.objects) == ["ball"]
    with saved(given={"tracker": "lk"}) as loaded:
        assert loaded.tracker.name == "lk", "in place of the saved one"


def test_what_is_to_start_an_object_is_kept(tmp_path):
    """A tracker that is saved before its first frame; no correction of a mask, and nothing said of an earlier frame."""
    mask = np.zeros((240, 320), bool)
    mask[40:90, 50:120] = True
    with Point2Pose(CAMERA) as method:
        method.add_object("cup", clicks=[[100, 90], [110, 95]], negative=[[20, 20]])
        method.add_object("can", box=[200, 50, 260, 120])
        method.add_object("tin", mask=mask)
        method.add_object("later")
        image = Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32))
        method.add_object("seen", clicks=[[220, 200]], frame=image)
        method.add_object("ball", memory=made_memory())
        method.correct("ball", clicks=[[300, 200]])
        method.save(tmp_path / "tracker.npz")
    with Point2Pose.load(tmp_path / "tracker.npz") as loaded:
        kept = loaded._prompts
        assert [*loaded.objects] == ["cup", "can", "tin", "later", "seen", "ball"] and {*kept} == {"cup", "can", "tin"}
        assert kept["cup"].points_px.tolist() == [[100, 90], [110, 95]]
        assert kept["cup"].negative_px.tolist() == [[20, 20]] and kept["can"].box_px.tolist() == [200, 50, 260, 120]
        np.testing.assert_array_equal(kept["tin"].mask, mask)


def test_what_is_no_tracker_is_refused_as_such(tmp_path):
    (tmp_path / "junk.npz").write_text("junk")
    with pytest.raises(BadInput, match=r"junk\.npz: got .*, expected a tracker as tracker\.save\(path\) writes it"):
        Point2Pose.load(tmp_path / "junk.npz")


def test_the_paper_has_nothing_to_be_saved(tmp_path):
    method = Point2Pose(CAMERA, preset("paper"))
    method.save(tmp_path / "empty.npz")
    assert not Point2Pose.load(tmp_path / "empty.npz").objects
    method.add_object("ball")
    with pytest.raises(BadInput, match=r"save: got 'ball' with mechanisms none, expected preset default"):
        method.save(tmp_path / "tracker.npz")
    assert not (tmp_path / "tracker.npz").exists()


@pytest.mark.parametrize("call", ["save", "memory"])
def test_one_thread_at_a_time(tmp_path, call):
    """What is saved while another thread tracks would be half of one frame and half of the next."""
    method, said = Point2Pose(CAMERA), []
    if call == "memory":
        method.add_object("ball", memory=made_memory())

    def other() -> None:
        with pytest.raises(BadInput, match="a call from a second thread"):
            method.save(tmp_path / "tracker.npz") if call == "save" else method.memory("ball")
        said.append(True)

    with method.alone():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert said and not list(tmp_path.iterdir())
    method.close()
    with pytest.raises(BadInput, match="after close"):
        method.save(tmp_path / "tracker.npz")


@pytest.mark.parametrize("key", ["camera", "config", "objects", "tracker"])
def test_a_file_that_lacks_something_is_refused(saved, tmp_path, key):
    with saved():
        pass
    with np.load(tmp_path / "tracker.npz") as file:
        arrays = dict(file)
    for value in (None, 3):
        head = json.loads(arrays["about"].tobytes())
        head["about"] = {k: v for k, v in head["about"].items() if k != key} | ({} if value is None else {key: value})
        np.savez(tmp_path / "less.npz", **arrays | {"about": np.frombuffer(json.dumps(head).encode(), np.uint8)})
        with pytest.raises(BadInput, match=r"less\.npz") as error:
            Point2Pose.load(tmp_path / "less.npz")
        assert "object has no" not in str(error.value) and "argument" not in str(error.value)


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, pickle.dumps])
@pytest.mark.parametrize("make", [Point2Pose, pipeline.Point2Pose], ids=["ours", "the paper's"])
def test_a_copy_is_refused_by_what_to_do_instead(make, how):
    with make(CAMERA) as method, pytest.raises(TypeError, match=r"save\(path\) .* Point2Pose\.load\(path\)"):
        how(method)


# -- where a memory comes from ------------------------------------------------------------------------


def learnt(model_of=None, **made_of):
    """A memory that a made-up object gives which began with ``made_memory`` and has had a keyframe since."""
    method = Point2Pose(CAMERA, preset().with_values({"seed": 7}))
    method.add_object("ball", memory=model_of or made_memory())
    obj = method.objects["ball"]
    obj.model.revision += 1
    return saving.memory_in(obj, obj.known.map_id, **made_of)


def test_what_is_kept_again_says_what_it_began_with():
    once = learnt(sequence="second")
    assert once.made_of["before"] == [{"sequence": "nowhere"}]
    again = learnt(once, sequence="third")
    assert [origin["sequence"] for origin in again.made_of["before"]] == ["nowhere", "second"]
    assert again.made_of["sequence"] == "third" and "before" not in again.made_of["before"][1]


def test_it_says_what_it_was_made_with():
    made_of = learnt(sequence="second").made_of
    assert made_of["version"] == __version__ and made_of["seed"] == 7
    assert made_of["camera"] == {"fx": CAMERA.fx, "width": CAMERA.width, "height": CAMERA.height}
    assert len(made_of["date"]) == len("2025-01-31") and made_of["date"][4] == "-"
    json.dumps(made_of)


def test_however_often_it_is_kept_again_its_origins_are_bounded_and_have_the_first():
    made = {"sequence": 1000, "before": [{"sequence": k} for k in range(500)]}
    kept = learnt(replace(made_memory(), made_of=made)).made_of["before"]
    assert len(kept) == 100 and kept[0] == {"sequence": 0} and kept[-1] == {"sequence": 1000}


def test_a_run_in_which_it_was_never_found_leaves_the_memory_as_it_was(tmp_path):
    before = made_memory("tennis")
    with Point2Pose(CAMERA) as method:
        method.add_object("ball", memory=before)
        method.step(Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32)))
        obj = method.objects["ball"]
        saving.keep_memory(tmp_path / "ball.npz", obj, 0, {"sequence": "other", "start": 0})
        method.save(tmp_path / "tracker.npz")
    kept = load_memory(tmp_path / "ball.npz")
    assert kept.name == "ball" and kept.made_of == before.made_of
    assert read_memories(tmp_path / "tracker.npz", *(saving._SAVED, ""))[1]["ball"].made_of == before.made_of
    for key in ("p_obj", "descriptors", "T_cam_obj"):
        np.testing.assert_array_equal(getattr(kept, key), getattr(before, key))


def test_of_what_is_kept_of_a_run_nothing_says_where_its_files_are(tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "memory_in", lambda obj, number, **made_of: replace(made_memory(), made_of=made_of))
    info = {"sequence": "mug", "path": "where/it/is", "commit": "c" * 40, "modified": True, "models": {"mug": "a/b"}}
    saving.keep_memory(tmp_path / "ball.npz", SimpleNamespace(name="ball"), 2, info)
    assert load_memory(tmp_path / "ball.npz").made_of == {
        "sequence": "mug",
        "commit": "c" * 40,
        "modified": True,
        "map_id": 2,
    }


def test_a_run_says_of_which_object_too_little_was_learnt(tmp_path):
    method = Point2Pose(CAMERA, preset().with_values({"method.surface": False}))
    method.add_object("ball", memory=made_memory())
    method.objects["ball"].model.revision += 1
    info = {}
    saving.keep_memory(tmp_path / "ball.npz", method.objects["ball"], 0, info)
    assert info == {"without_map": {"ball": "no surface"}} and not list(tmp_path.iterdir())
    method.add_object("never seen")
    saving.keep_memory(tmp_path / "never.npz", method.objects["never seen"], 0, info)
    assert list(info["without_map"]) == ["ball"], "of that one it is said that it never had a pose"


def test_what_it_cannot_be_loaded_or_written_with_is_refused(saved, tmp_path):
    with pytest.raises(BadInput, match=r"load: got 'config', expected camera, .*\. Parameters are those"):
        saved(given={"config": "paper"})
    with pytest.raises(BadInput, match="camera: got ndarray"):
        saved(given={"camera": np.eye(3)})
    with saved() as method:
        with pytest.raises(BadInput, match="got a folder, expected a file"):
            method.save(tmp_path)
        with pytest.raises(BadInput, match=r"memory: made_of: got .*ndarray.*, expected plain values"):
            method.memory("ball", where=np.zeros(3))
