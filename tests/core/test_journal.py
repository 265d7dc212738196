"""What the logger is told of objects: each turn of a life once, a frame's state where somebody asks for it."""

import numpy as np

from p2p_lib.core.journal import Journal
from p2p_lib.core.types import WITH_POSE, PoseEstimate, Status


def said(k: int, status: Status, map_id: int = 0, **more) -> dict[str, PoseEstimate]:
    posed = {"T_cam_obj": np.eye(4), "confidence": 0.9} if status in WITH_POSE else {"reason": "why"}
    return {"mug": PoseEstimate("mug", k, k / 30, status, map_id=map_id, **posed, **more)}


def test_each_turn_of_a_life_is_told_once(caplog):
    caplog.set_level("INFO", "p2p_lib")
    journal, life = Journal(), (Status.INITIALISING, Status.TRACKED, Status.TRACKED, Status.LOST, Status.LOST)
    for k, status in enumerate((*life, Status.RECOVERED, Status.TRACKED)):
        journal.note(said(k, status), 5.0)
    journal.corrected(7, ["mug"])
    journal.note(said(7, Status.TRACKED, 1), 5.0)
    journal.note(said(8, Status.TRACKED, joined=(1, np.eye(4))), 5.0)
    journal.forget("mug")
    journal.note(said(9, Status.TRACKED, 2), 5.0)
    assert caplog.messages == [
        "frame 0: mug is initialising (why)",
        "frame 1: mug begins, is tracked",
        "frame 3: mug is lost (why)",
        "frame 5: mug is found again in map 0, is recovered",
        "frame 6: mug is tracked",
        "frame 7: mug is corrected",
        "frame 7: mug begins map 1",
        "frame 8: mug has map 1 joined to map 0",
        "mug is removed",
        "frame 9: mug begins, is tracked",
    ]


def test_each_frame_is_told_to_who_asks(caplog):
    caplog.set_level("DEBUG", "p2p_lib")
    journal = Journal()
    journal.note(said(0, Status.TRACKED, visible_points=12, inliers=9, keyframe=True), 20.4)
    journal.note(said(1, Status.OCCLUDED), 3.0)
    told = [record.getMessage() for record in caplog.records if record.levelname == "DEBUG"]
    of_pose = "mug: tracked, confidence 0.90, map 0, 9 of 12 points agree, keyframe"
    assert told == [f"frame 0 (20 ms): {of_pose}", "frame 1 (3 ms): mug: occluded, confidence 0.00, map 0"]
