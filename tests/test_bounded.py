"""What an object keeps is bounded however long the stream is: by the caps of the configuration, culled by value."""

import numpy as np
import pytest

from p2p_lib import Point2Pose, open_sequence, preset
from p2p_lib.core.types import WITH_POSE

CAPS = {
    "factor_graph.max_keyframes": 5,
    "keypoint_map.max_points": 60,
    "keypoint_map.pending_ttl": 10,
    "tsdf.max_voxels": 40_000,
}
# A keyframe nearly every other frame: as many as a long stream would have.
OFTEN = {"keypoint_map.cooldown": 1, "keypoint_map.keyframe_min_points": 200, "keypoint_map.keyframe_angle_deg": 2.0}


@pytest.fixture(scope="module")
def stream():
    """The box of the crossing alone, forwards and backwards over 100 frames; what is held after each frame."""
    sequence = open_sequence("synthetic/crossing")
    method = Point2Pose(sequence.camera, preset("default").with_values({**CAPS, **OFTEN}))
    method.add_object("box")
    held, order = [], [*range(100), *range(98, 0, -1)]
    for k in order:
        estimate = method.step(sequence.frame(k), {"box": sequence.masks(k)["box"]})["box"]
        box = method.objects["box"]
        counts = {
            "keypoints": int(box.map.promoted.sum()),
            "pending": int((~box.map.promoted).sum()),
            "tracked": len(method.tracker._points),
            "mapped": len(box.map),
            "views": len(box.model.views),
            "pictures": len(box.model.surface.views),
            "graph": len(box.model.graph.keys),
            "voxels": int(np.prod(box.model.surface.shape)),
            "tracked pose": estimate.status in WITH_POSE,
            "keyframe": estimate.keyframe,
        }
        held.append(counts)
    return {key: np.array([counts[key] for counts in held]) for key in held[0]}


def test_caps_hold_at_every_frame(stream):
    assert stream["keyframe"].sum() > 50, "far more keyframes than are kept"
    assert stream["graph"].max() == CAPS["factor_graph.max_keyframes"]
    assert stream["voxels"].max() <= CAPS["tsdf.max_voxels"]
    # Between two keyframes a point more may be promoted than the cap, and pictures wait for the graph's next word.
    assert stream["pictures"].max() <= CAPS["factor_graph.max_keyframes"] + 2
    after = stream["keypoints"][stream["keyframe"]]
    assert after.max() <= CAPS["keypoint_map.max_points"]


def test_nothing_is_tracked_that_the_map_has_given_up(stream):
    assert (stream["tracked"] == stream["mapped"]).all()
    later = stream["mapped"][len(stream["mapped"]) // 3 :]
    assert later.max() <= CAPS["keypoint_map.max_points"] + 3 * preset().sampling.max_visible


def test_the_object_is_still_tracked_with_so_little(stream):
    assert stream["tracked pose"].mean() > 0.95
