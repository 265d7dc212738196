"""A run's poses in the forms that other tools read. A frame without a pose is left out of all of them.

``tum``    ``<object>.txt``: time_s tx ty tz qx qy qz qw, as evo and the TUM tools read it
``poses``  ``annotated_poses/<object>/<frame>.txt``, 4x4 in metres, as the datasets keep their truth and BundleSDF its
           results (``ob_in_cam``); a sequence of one unnamed object has ``annotated_poses/<frame>.txt``
``bop``    one CSV of the BOP challenge: scene_id,im_id,obj_id,score,R,t,time with millimetres and seconds

Frames are named as the sequence's images are. :mod:`p2p_lib.datasets.imported` reads all three back.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.runs import Run, tum_line
from p2p_lib.datasets.sequence import Sequence

FORMATS = ("tum", "poses", "bop")
BOP_HEADER = "scene_id,im_id,obj_id,score,R,t,time"


def export(
    run: Run,
    out: str | Path,
    format: str,
    T_obj_frame: Mapping[str, np.ndarray] | None = None,
    sequence: Sequence | None = None,
) -> list[Path]:
    """Write a run's poses below the folder ``out``; returns the files, or the folders of files.

    T_obj_frame  object to the constant (4, 4) from the frame wanted to the tracker's own, such as T_obj_model: what is
                 written is T_cam_frame, of these objects alone. By default T_cam_obj of all
    sequence     names the frames and BOP's scene and objects; without it frames are named by number

    Raises :class:`BadInput` for an unknown format.
    """
    if format not in FORMATS:
        raise BadInput("format", repr(format), "one of " + ", ".join(FORMATS))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    frames = dict.fromkeys(run.objects, np.eye(4)) if T_obj_frame is None else T_obj_frame
    poses = {name: run.objects[name].T_cam_obj @ T for name, T in frames.items()}
    if format == "bop":
        return [_write_bop(out, run, poses, sequence)]
    written = []
    for name, T in poses.items():
        obj = run.objects[name]
        has_pose = np.flatnonzero(obj.has_pose)
        if format == "tum":
            written.append(out / f"{name}.txt")
            written[-1].write_text("".join(tum_line(obj.time_s[i], T[i]) for i in has_pose))
        else:
            written.append(out / "annotated_poses" / ("" if tuple(poses) == ("object",) else name))
            written[-1].mkdir(parents=True, exist_ok=True)
            for i in has_pose:
                index = int(obj.frame_index[i])
                stem = f"{index:07d}" if sequence is None else sequence.frame_names[index]
                np.savetxt(written[-1] / f"{stem}.txt", T[i], fmt="%.12g")
    return written


def scene_id(sequence: Sequence | None) -> int:
    """BOP's number of a scene: its folder's name where that is a number, else 1."""
    name = sequence.path.name if sequence is not None and sequence.path is not None else ""
    return int(name) if name.isdigit() else 1


def obj_ids(objects: tuple[str, ...]) -> dict[str, int]:
    """BOP's number of each object: that of ``obj_000005``, else 1, 2, ... in the sequence's order."""
    named = {name: re.fullmatch(r"obj_(\d{6})(_\d+)?", name) for name in objects}
    return {name: int(found[1]) if found else k for k, (name, found) in enumerate(named.items(), 1)}


def image_ids(sequence: Sequence | None, frame_index: np.ndarray) -> np.ndarray:
    """BOP's number of each frame: the image's in a BOP scene, else the frame's own."""
    if sequence is None or sequence.format != "bop":
        return frame_index
    return np.array([int(sequence.frame_names[i]) for i in frame_index], int)


def _write_bop(out: Path, run: Run, poses: Mapping[str, np.ndarray], sequence: Sequence | None) -> Path:
    numbers = obj_ids(tuple(poses) if sequence is None else sequence.objects)
    total_ms = run.timings.get("total_ms", np.empty(0))
    lines = [BOP_HEADER]
    for name, T in poses.items():
        obj = run.objects[name]
        images = image_ids(sequence, obj.frame_index)
        # BOP wants one time for all estimates of an image, -1 where it is unknown.
        times_s = total_ms / 1000 if len(total_ms) == len(obj) else np.full(len(obj), -1.0)
        for i in np.flatnonzero(obj.has_pose):
            R, t_mm = (" ".join(f"{x:.12g}" for x in v) for v in (T[i, :3, :3].ravel(), T[i, :3, 3] * 1000))
            head = f"{scene_id(sequence)},{images[i]},{numbers[name]},{obj.confidence[i]:.6f}"
            lines.append(f"{head},{R},{t_mm},{times_s[i]:.6f}")
    # METHOD_DATASET-SPLIT.csv, as the BOP toolkit takes names apart.
    dataset = re.sub(r"[^A-Za-z0-9]+", "", str(run.info.get("sequence", "run"))) or "run"
    path = out / f"p2p_{dataset}-test.csv"
    path.write_text("\n".join(lines) + "\n")
    return path
