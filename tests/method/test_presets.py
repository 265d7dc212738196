"""The two presets are compositions: every key in which they differ changes a run, and means what it says."""

import numpy as np
import pytest

from p2p_lib.core.config import diff, preset
from p2p_lib.method.pipeline import Point2Pose
from tests.method.test_pipeline import CAMERA, HIDDEN, Shy, film

#: Where the film has no occasion for a key: other values of it, and settings that give it one.
OCCASIONS = {
    "keypoint_map.cooldown": ((0, 8), {"keypoint_map.keyframe_min_points": 200}),
    "factor_graph.max_keyframes": ((0, 3), {"keypoint_map.keyframe_angle_deg": 3.0}),
    "sampling.max_visible": ((50, 60), {"sampling.points": 60}),
    "method.gates": (("none", "all"), {"method.redetection": False}),
}
#: A tracker that finds so few points again tells these.
FEW_POINTS = {"method.redetection": 5, "method.gates": 6}


def run(key: str, value, settings: dict) -> list[np.ndarray]:
    """Poses and keypoints of one carton that a board hides, by the default but for one key."""
    config = preset("default", 0).with_values({**settings, key: value})
    method = Point2Pose(CAMERA, config, Shy(FEW_POINTS[key]) if key in FEW_POINTS else "builtin")
    method.add_object("left")
    poses = []
    for frame, masks in film(board=True)[: HIDDEN.stop + 3]:
        estimate = method.step(frame, {"left": masks["left"]})["left"]
        poses.append(np.full((4, 4), np.nan) if estimate.T_cam_obj is None else estimate.T_cam_obj)
    model = method.objects["left"].model
    return [np.stack(poses), model.map.p_obj, model.surface.weights()]


@pytest.mark.parametrize("key", diff())
def test_every_key_in_which_the_presets_differ_changes_a_run(key):
    values, settings = OCCASIONS.get(key, (diff()[key], {}))
    one, other = (run(key, value, settings) for value in values)
    assert any(a.shape != b.shape or not np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other))


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
