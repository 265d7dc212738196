"""Truth of a recording, written as YCBMultiTrack keeps it.

Where motion capture does not see an object its last pose is repeated, as in the paper's dataset, and the labels say
that it does not count there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.recording.tracks import MAX_GAP_S, PoseTrack
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.datasets.ycbmultitrack import LABELS

MIN_VISIBLE_PX = 1


@dataclass(frozen=True, eq=False)
class RecordedObject:
    """One object: its body's track on motion capture's clock, its mesh in the body, its model's points (V, 3)."""

    track: PoseTrack
    T_body_model: np.ndarray
    points: np.ndarray


def object_poses(
    times_s: np.ndarray,
    offset_s: float,
    T_cam_world: np.ndarray,
    of: RecordedObject,
    max_gap_s: float = MAX_GAP_S,
) -> np.ndarray:
    """T_cam_model (N, 4, 4) at the camera's frame times; NaN where motion capture did not see the body.

    offset_s  mocap time minus camera time, see :mod:`p2p_lib.datasets.recording.synchronise`
    """
    return T_cam_world @ of.track.at(np.asarray(times_s) + offset_s, max_gap_s) @ of.T_body_model


def in_image(T_cam_model: np.ndarray, points: np.ndarray, camera: Camera) -> np.ndarray:
    """(N,) bool: any of the model's points lies in the picture; False where there is no pose."""
    inside = np.zeros(len(T_cam_model), bool)
    for i in np.flatnonzero(np.isfinite(T_cam_model).all((1, 2))):
        inside[i] = camera.inside(camera.project(se3.transform(T_cam_model[i], points))).any()
    return inside


def held(T: np.ndarray) -> np.ndarray:
    """(N, 4, 4) with gaps filled by the last pose before them, the first pose before any."""
    seen = np.isfinite(T).all((1, 2))
    if not seen.any():
        raise BadInput("truth", "no pose at all", "at least one frame in which motion capture sees the object")
    last = np.maximum.accumulate(np.where(seen, np.arange(len(T)), -1))
    return T[np.where(last < 0, np.flatnonzero(seen)[0], last)]


def write_truth(
    folder: str | Path,
    sequence: Sequence,
    objects: Mapping[str, RecordedObject],
    offset_s: float,
    T_cam_world: np.ndarray,
    min_visible_px: int = MIN_VISIBLE_PX,
) -> None:
    """Add the truth of a recording to its folder, which then is a YCBMultiTrack sequence.

    sequence  the recording as it is (an own-data folder): its times, picture names, camera and masks

    ``is_mask_visible`` holds where motion capture saw the object and its mask, if there are masks, has
    ``min_visible_px`` pixels; ``is_obj_in_image`` where one of the model's points falls into the picture.
    """
    folder, n = Path(folder), len(sequence)
    counts = [sequence.visible_px(i) for i in range(n)]
    for name, of in objects.items():
        T = object_poses(sequence.times_s, offset_s, T_cam_world, of)
        seen = np.isfinite(T).all((1, 2))
        large = np.array([c is None or name not in c or c[name] >= min_visible_px for c in counts])
        labels = {"is_mask_visible": seen & large, "is_obj_in_image_labels": in_image(T, of.points, sequence.camera)}
        poses = folder / "annotated_poses" / name
        poses.mkdir(parents=True, exist_ok=True)
        for frame, pose in zip(sequence.frame_names, held(T)):
            np.savetxt(poses / f"{frame}.txt", pose, fmt="%.12g")
        for kind, label in labels.items():
            (folder / kind / name).mkdir(parents=True, exist_ok=True)
            np.save(folder / kind / name / LABELS[kind], label)
