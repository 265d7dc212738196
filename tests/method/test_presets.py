"""The two presets are compositions: every key in which they differ changes a run, and means what it says."""

import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from p2p_lib.core.config import diff, preset
from p2p_lib.core.errors import BadInput
from p2p_lib.extended.default import Point2Pose
from p2p_lib.method import pipeline
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from tests.method.test_pipeline import CAMERA, HIDDEN, film

#: Without priors of any kind, which make up for samples.
STILL = "all but motion_prior, motion_weight, motion_over_gaps, scene, shape_search"
#: Where the film has no occasion for a key: other values of it, and settings that give it one.
OCCASIONS = {
    "depth.max_m": ((2.0, 0.6), {}),
    "keypoint_map.max_points": ((0, 10), {}),
    "registration.max_uncertainty": ((0.3, 0.0), {}),
    "tsdf.max_voxels": ((20_000_000, 1000), {}),
    "keypoint_map.cooldown": ((0, 8), {"keypoint_map.keyframe_min_points": 200}),
    "factor_graph.max_keyframes": ((0, 3), {"keypoint_map.keyframe_angle_deg": 1.5}),
    "factor_graph.iterations": ((20, 1), {"keypoint_map.keyframe_angle_deg": 3.0}),
    "sampling.max_visible": ((50, 60), {"sampling.points": 60}),
    "registration.iterations": ((100, 1), {"method.mechanisms": STILL}),
    "registration.sample_size": ((4, 3), {"method.mechanisms": STILL, "registration.iterations": 1}),
    "refinement.huber_m": ((0.01, 0.0005), {}),
}


#: What is left of the mask where a key has an occasion on narrow parts alone: bars of three pixels.
BARS = {"depth.narrow": np.arange(CAMERA.width) % 8 < 3}


class Lying(BuiltinTracker):
    """From frame 3 on, four of five points are reported pixels off, in three groups that move alike."""

    def __init__(self):
        super().__init__(preset().tracking)

    def track(self, frame, search=None, urgent=False):
        tracks = super().track(frame, search, urgent)
        offset = np.array([[0, 0], [6, 0], [6, 0], [0, 7], [-5, 5]])[tracks.ids % 5] * (frame.index >= 3)
        return replace(tracks, uv_px=tracks.uv_px + offset)

    def suggest(self, ids, uv_px):
        return None


def tracker_for(key: str):
    """One that gives the key an occasion."""
    contradictory = ("method.mechanisms", "selection.", "registration.", "refinement.", "factor_graph.iterations")
    return Lying() if key.startswith(contradictory) else "builtin"


def run(key: str, value, settings: dict) -> list[np.ndarray]:
    """Poses and keypoints of one carton that a board hides, by the default but for one key."""
    config = preset("default", 0).with_values({**settings, key: value})
    method = Point2Pose(CAMERA, config, tracker_for(key))
    method.add_object("left")
    poses = []
    for frame, masks in film(board=True)[: HIDDEN.stop + 3]:
        estimate = method.step(frame, {"left": masks["left"] & BARS.get(key, True)})["left"]
        poses.append(np.full((4, 4), np.nan) if estimate.T_cam_obj is None else estimate.T_cam_obj)
    model = method.objects["left"].model
    return [np.stack(poses), model.map.p_obj, model.surface.weights()]


@pytest.mark.parametrize("key", sorted(diff().keys() - {"tracking.tapir_resolutions"}))  # which TAPIR alone asks
def test_every_key_in_which_the_presets_differ_changes_a_run(key):
    values, settings = OCCASIONS.get(key, (diff()[key], {}))
    one, other = (run(key, value, settings) for value in values)
    assert any(a.shape != b.shape or not np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other))


def test_the_paper_rejects_no_track():
    """What contradicts a pose, or lies beside the mask of an object that is away, is the tracker's to judge there."""

    class Rejected(Lying):
        def reject(self, ids):
            told.append(ids)

    told: list[np.ndarray] = []
    for name, rejects in (("paper", False), ("default", True)):
        method = Point2Pose(CAMERA, preset(name), Rejected())
        method.add_object("left")
        for frame, masks in film(board=True)[: HIDDEN.stop + 3]:
            method.step(frame, {"left": masks["left"]})
        assert bool(told) == rejects


@pytest.mark.parametrize("key", ["range_sigma_m", "between_sigma_rad", "between_sigma_m", "bearing_sigma_rad"])
def test_constant_noise_reaches_the_graph(key):
    """Ten times the noise of one kind of measurement moves what the graph of ``paper`` finds."""
    key, found = f"factor_graph.{key}", []
    for factor in (1, 10):
        config = preset("paper")
        stage, name = key.split(".")
        value = factor * getattr(getattr(config, stage), name)
        method = Point2Pose(CAMERA, config.with_values({key: value, "keypoint_map.keyframe_angle_deg": 3.0}))
        method.add_object("left")
        for frame, masks in film()[:10]:
            method.step(frame, {"left": masks["left"]})
        found.append(method.objects["left"].map.p_obj)
    assert not np.array_equal(*found)


def functions_called(name: str, given: bool) -> set[str]:
    """Files of the library whose functions a preset calls while it tracks an object that a board hides."""
    files: set[str] = set()

    def heard(frame, event, _):
        if event == "call":
            files.add(frame.f_code.co_filename)

    with Point2Pose(CAMERA, preset(name)) as method:
        frames = film(board=True)[: HIDDEN.stop + 3]
        method.add_object("left", mask=None if given else frames[0][1]["left"])
        threading.setprofile(heard)  # of the threads that it starts
        sys.setprofile(heard)
        try:
            for frame, masks in frames:
                method.step(frame, {"left": masks["left"]} if given else None)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return {Path(file).parent.name for file in files if "p2p_lib" in file}


@pytest.mark.parametrize("given", [True, False], ids=["masks", "one mask"])
def test_nothing_of_ours_is_called_under_paper(given):
    assert {"method", "core"} <= (called := functions_called("paper", given)) and "extended" not in called
    assert "extended" in functions_called("default", given)


@pytest.mark.parametrize("name", ["paper", "default"])
def test_the_paper_composed_is_the_paper_alone(name):
    """p2p_lib.Point2Pose under ``paper`` gives what p2p_lib.method.pipeline gives; for ``default`` it refuses."""
    if name == "default":
        with pytest.raises(BadInput, match=r"method\.mechanisms: got 'all', expected none"):
            pipeline.Point2Pose(CAMERA, preset(name))
        return
    poses = []
    for make in (Point2Pose, pipeline.Point2Pose):
        with make(CAMERA, preset(name)) as method:
            method.add_object("left")
            poses.append([method.step(f, {"left": m["left"]})["left"].T_cam_obj for f, m in film()[:8]])
    np.testing.assert_array_equal(*poses)


@pytest.mark.parametrize("name", ["paper", "default"])
def test_the_threads_end_with_the_method(name):
    before = set(threading.enumerate())
    with Point2Pose(CAMERA, preset(name)) as method:
        method.add_object("left")
        for frame, masks in film()[:2]:
            method.step(frame, {"left": masks["left"]})
        assert set(threading.enumerate()) - before, "it has threads"
    assert not {thread for thread in threading.enumerate() if thread not in before and thread.name.startswith("p2p")}
