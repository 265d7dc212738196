"""Poses to and from other tools; any method's poses are scored by the same rules as a run of ours.

``tum``    ``<object>.txt``: time_s tx ty tz qx qy qz qw, as evo and the TUM tools read it
``poses``  ``annotated_poses/<object>/<frame>.txt``, 4x4 in metres, as the datasets keep their truth and BundleSDF its
           results (``ob_in_cam``); a sequence of one unnamed object has ``annotated_poses/<frame>.txt``
``bop``    one CSV of the BOP challenge: scene_id,im_id,obj_id,score,R,t,time with millimetres and seconds

:func:`export` writes frames by the names of the sequence's images and leaves out those without a pose.
:func:`read_poses` takes all three: of a BOP file the best-scored estimate of an object in an image, a TUM file alone
or in a folder, times matched to the sequence's, and folders of matrices named as the images or by frame number from 0.
A frame for which there is nothing, or a matrix of zeros or NaN, is lost, and lost it is scored.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData, did_you_mean, doubt, listed
from p2p_lib.core.files import check_new, read_text, replace_text
from p2p_lib.core.types import PoseEstimate, Status
from p2p_lib.datasets import images
from p2p_lib.datasets.models import load_points
from p2p_lib.datasets.runs import NO_POSE, ObjectRun, Run, tum_line
from p2p_lib.datasets.sequence import Sequence

FORMATS = ("tum", "poses", "bop")
#: What the tracker of poses is called that others have made.
IMPORTED = "imported"
BOP_HEADER = "scene_id,im_id,obj_id,score,R,t,time"
MATRIX_FOLDERS = ("ob_in_cam", "annotated_poses")
#: Poses so many times as far apart as frames may have been given the times of another rate.
_SLOWER = 1.5
#: Files of no object that are named.
_NAMED = 3


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
    sequence     names the frames and BOP's scene, and numbers its objects; without it frames are named by number, and
                 objects that it does not know are numbered 1, 2, ... in the run's order

    Raises :class:`BadInput` for an unknown format, and where something lies already what would be written over.
    """
    if format not in FORMATS:
        raise BadInput("format", repr(format), "one of " + ", ".join(FORMATS))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    frames = dict.fromkeys(run.objects, np.eye(4)) if T_obj_frame is None else T_obj_frame
    poses = {name: run.objects[name].T_cam_obj @ T for name, T in frames.items()}
    if format == "bop":
        return _write_bop(out, run, poses, sequence)
    written = []
    for name, T in poses.items():
        obj = run.objects[name]
        has_pose = np.flatnonzero(obj.has_pose)
        if format == "tum":
            written.append(_new(out / f"{name}.txt"))
            replace_text(written[-1], "".join(tum_line(obj.time_s[i], T[i]) for i in has_pose))
        else:
            written.append(_new(out / "annotated_poses" / ("" if tuple(poses) == ("object",) else name)))
            written[-1].mkdir(parents=True, exist_ok=True)
            for i in has_pose:
                index = int(obj.frame_index[i])
                stem = f"{index:07d}" if sequence is None else sequence.frame_names[index]
                np.savetxt(written[-1] / f"{stem}.txt", T[i], fmt="%.12g")
    return written


def _new(path: Path) -> Path:
    """The path, where nothing lies yet: a dataset's own truth has the same names."""
    check_new(path)
    return path


def _write_bop(out: Path, run: Run, poses: Mapping[str, np.ndarray], sequence: Sequence | None) -> list[Path]:
    known = () if sequence is None else sequence.objects
    numbers = _obj_ids(known if set(poses) <= set(known) else tuple(run.objects))  # without masks it knows no names
    total_ms = run.timings.get("total_ms", np.empty(0))
    lines = [BOP_HEADER]
    for name, T in poses.items():
        obj = run.objects[name]
        images = _image_ids(sequence, obj.frame_index)
        # BOP wants one time for all estimates of an image, -1 where it is unknown.
        times_s = total_ms / 1000 if len(total_ms) == len(obj) else np.full(len(obj), -1.0)
        for i in np.flatnonzero(obj.has_pose):
            R, t_mm = (" ".join(f"{x:.12g}" for x in v) for v in (T[i, :3, :3].ravel(), T[i, :3, 3] * 1000))
            head = f"{_scene_id(sequence)},{images[i]},{numbers[name]},{obj.confidence[i]:.6f}"
            lines.append(f"{head},{R},{t_mm},{times_s[i]:.6f}")
    # METHOD_DATASET-SPLIT.csv, as the BOP toolkit takes names apart.
    dataset = re.sub(r"[^A-Za-z0-9]+", "", str(run.info.get("sequence", "run"))) or "run"
    path = _new(out / f"p2p_{dataset}-test.csv")
    ids = path.with_name(f"{path.stem}_obj_ids.json")
    replace_text(path, "\n".join(lines) + "\n")
    replace_text(ids, json.dumps({name: numbers[name] for name in poses}, indent=1) + "\n")
    return [path, ids]


def pose_files(path: str | Path, sequence: Sequence) -> dict[str, Path]:
    """Object to what holds its poses: a ``.csv`` of all, a ``.txt`` of its own, else its folder of matrices.

    Raises :class:`MissingData` where nothing is there, :class:`BadInput` where it is not clear whose poses they are.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return dict.fromkeys(sequence.objects, path)
    if path.is_file():
        return {_only_object(path, sequence): path}
    if not path.is_dir():
        raise MissingData(str(path), "no such file or folder, expected poses (BOP .csv, TUM .txt, or 4x4 matrices)")
    if found := sorted(path.glob("*.csv")):
        if len(found) > 1:
            raise BadInput(str(path), f"{len(found)} .csv files", "one", "Name the one that is meant.")
        return dict.fromkeys(sequence.objects, found[0])
    folder = next((path / name for name in MATRIX_FOLDERS if (path / name).is_dir()), path)
    there = {
        name: next((place for place in (folder / name, folder / f"{name}.txt") if place.exists()), None)
        for name in sequence.objects
    }
    return {name: place for name, place in there.items() if place} or {_only_object(folder, sequence): folder}


def read_poses(path: str | Path, sequence: Sequence) -> dict[str, np.ndarray]:
    """Object to T_cam_obj (N, 4, 4) over the sequence's frames, NaN where lost; only objects that were found.

    Warns of objects that were not. Raises as :func:`pose_files`, and :class:`BadInput` where something fits no form or
    no frame.
    """
    files = pose_files(path, sequence)
    if tables := {file for file in files.values() if file.suffix.lower() == ".csv"}:
        poses = _read_bop(tables.pop(), sequence)
    else:
        poses = {
            name: _read_matrices(place, sequence) if place.is_dir() else _read_tum(place, sequence)
            for name, place in files.items()
        }
    if missing := [name for name in sequence.objects if name not in poses]:
        doubt(str(path), f"no poses of {', '.join(missing)}", _what_else(files, missing))
    return poses


def _what_else(files: Mapping[str, Path], missing: list[str]) -> str:
    """What to do about objects without poses: what lies beside the others' may be theirs under another name."""
    beside = {place for file in files.values() if file.suffix.lower() != ".csv" for place in file.parent.iterdir()}
    other = sorted(p for p in beside - set(files.values()) if p.suffix == ".txt" or (p.is_dir() and p.name[0] != "."))
    said = [f"{p.name} is of no object. {did_you_mean(p.stem, missing)}" for p in other[:_NAMED]]
    return " ".join(["What has none is lost throughout.", *said])


def as_run(
    poses: Mapping[str, np.ndarray],
    sequence: Sequence,
    models: Mapping[str, Path],
    path: Path,
    frames: range,
) -> Run:
    """Such poses over some frames of a sequence as a run that is ready to be evaluated.

    models  object to model file; every object of the sequence is in the run: one without poses is lost throughout
    path    of the poses
    """
    visible_px = [sequence.visible_px(i) for i in frames]
    objects = {}
    for name in sequence.objects:
        T_cam_obj = poses.get(name, np.tile(NO_POSE, (len(sequence), 1, 1)))
        estimates = [
            PoseEstimate(name, i, sequence.times_s[i], Status.TRACKED, T_cam_obj[i], 1.0)
            if np.isfinite(T_cam_obj[i]).all()
            else PoseEstimate(name, i, sequence.times_s[i], Status.LOST, reason="no pose given")
            for i in frames
        ]
        objects[name] = ObjectRun.of(name, estimates, sequence, visible_px)
    info = {
        "sequence": sequence.name,
        "path": None if sequence.path is None else str(sequence.path),
        "format": sequence.format,
        "scene_seed": getattr(sequence, "scene_seed", None),
        "objects": list(sequence.objects),
        "tracker": IMPORTED,
        "masks": None,
        "seed": None,
    }
    return Run(path, info, objects, {name: load_points(file) for name, file in models.items()}, {})


def _only_object(path: Path, sequence: Sequence) -> str:
    if len(sequence.objects) != 1:
        wanted = ", ".join(sequence.objects)
        raise BadInput(str(path), "poses of one object", f"a folder or file for each of {wanted}", "Name them so.")
    return sequence.objects[0]


def _read_matrices(folder: Path, sequence: Sequence) -> np.ndarray:
    files = images.list_files(folder, (".txt",), "4x4 matrices, one file a frame")
    frames = _frames(folder, [path.stem for path in files], sequence)
    poses = np.full((len(sequence), 4, 4), np.nan)
    for path, frame in zip(files, frames):
        T = images.read_numbers(path, "a 4x4 transformation in metres")
        if T.shape == (4, 4) and (np.isnan(T).any() or not T[:3].any()):
            continue
        poses[frame] = se3.orthonormalised(se3.check(str(path), T, images.NOT_RIGID))
    return poses


def _frames(folder: Path, stems: list[str], sequence: Sequence) -> list[int]:
    """The frame of each file: by the image's name, else by number."""
    of_name = {name: i for i, name in enumerate(sequence.frame_names)}
    if set(stems) <= set(of_name):
        return [of_name[stem] for stem in stems]
    if all(stem.isdigit() and int(stem) < len(sequence) for stem in stems):
        return [int(stem) for stem in stems]
    odd = next(stem for stem in stems if stem not in of_name)
    want = f"the name of an image such as {sequence.frame_names[0]}, or a frame number below {len(sequence)}"
    raise BadInput(str(folder / f"{odd}.txt"), f"the name {odd}", want)


def _read_tum(path: Path, sequence: Sequence) -> np.ndarray:
    form = "time_s tx ty tz qx qy qz qw in a line, with a unit quaternion"
    poses, rows = np.full((len(sequence), 4, 4), np.nan), images.read_numbers(path, form)
    if not rows.size:
        return poses  # lost throughout
    if rows.shape[1] != 8:
        raise BadInput(str(path), f"{rows.shape[1]} numbers in each line", form)
    fits = np.isfinite(rows).all(1) & (np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) < 0.1)
    if not fits.all():
        worst = int(np.argmin(fits))
        fix = "" if np.isfinite(rows[worst]).all() else "Leave the line out: a frame without a pose is lost."
        raise BadInput(f"{path}: pose {worst + 1}", " ".join(f"{x:g}" for x in rows[worst]), form, fix)
    times_s, given_s = np.asarray(sequence.times_s), rows[:, 0]
    nearest = np.abs(times_s - given_s[:, None]).argmin(1)
    # Half the time between frames: further off it belongs to none of them.
    far = np.abs(times_s[nearest] - given_s) > 0.5 * (np.median(np.diff(times_s)) if len(times_s) > 1 else 1.0)
    if far.any():
        want = f"times of the sequence's frames, {times_s[0]:.6f} to {times_s[-1]:.6f} s"
        fix = "open_sequence(SEQ).times_s has them in Python; 4x4 files by frame number from 0, and BOP's, need none."
        raise BadInput(str(path), f"the time {given_s[np.argmax(far)]:.6f} s", want, fix)
    if len(rows) > 2 and (slower := np.median(np.diff(given_s)) / np.median(np.diff(times_s))) > _SLOWER:
        got = f"poses {slower:.1f} times as far apart in time as the frames are"
        doubt(str(path), got, "Frames without a pose count as lost: is the rate right that the times were made with?")
    poses[nearest] = se3.from_rt(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4])
    return poses


def _read_bop(path: Path, sequence: Sequence) -> dict[str, np.ndarray]:
    """Best-scored estimates. Of several instances of a kind only the first is filled: BOP does not tell them apart."""
    frame_of = {int(k): i for i, k in enumerate(_image_ids(sequence, np.arange(len(sequence))))}
    name_of = {number: name for name, number in reversed(_obj_ids(sequence.objects).items())}
    poses: dict[str, np.ndarray] = {}
    best: dict[tuple[str, int], float] = {}
    others: dict[int, set[int]] = {}  # the objects of each scene of which nothing is read
    for number, row in enumerate(_bop_rows(path), 2):
        where = f"{path}: line {number}"
        try:
            scene, image, obj = (int(row[key]) for key in ("scene_id", "im_id", "obj_id"))
            score = float(row["score"])
            R, t_mm = np.array(row["R"].split(), float).reshape(3, 3), np.array(row["t"].split(), float)
            T = se3.from_rt(R, t_mm * 0.001)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise BadInput(where, f"unreadable ({error})", BOP_HEADER) from None
        if scene != _scene_id(sequence) or obj not in name_of:
            others.setdefault(scene, set()).add(obj)  # another scene's, or an object that this one does not have
            continue
        if image not in frame_of:
            raise BadInput(where, f"im_id {image}", "the number of an image of the sequence")
        name, frame = name_of[obj], frame_of[image]
        if score > best.get((name, frame), -np.inf) and np.isfinite(T).all():
            best[name, frame] = score
            poses.setdefault(name, np.full((len(sequence), 4, 4), np.nan))
            poses[name][frame] = se3.orthonormalised(se3.check(where, T, images.NOT_RIGID))
    if not poses:
        there = [f"scene_id {scene} with obj_id {listed(sorted(objs), _NAMED)}" for scene, objs in others.items()]
        got = f"nothing of scene {_scene_id(sequence)}{', but ' * bool(there)}{listed(there, _NAMED)}"
        wanted = ", ".join(f"{name} is {number}" for name, number in _obj_ids(sequence.objects).items())
        fix = f"Write scene_id {_scene_id(sequence)}, and the obj_id of each object."
        raise BadInput(str(path), got, f"scene_id {_scene_id(sequence)}, obj_id of its objects: {wanted}", fix)
    return poses


def _bop_rows(path: Path) -> list[dict[str, str]]:
    reader = csv.DictReader(read_text(path, "a BOP results CSV").splitlines())
    try:
        header, rows = reader.fieldnames or [], list(reader)
    except csv.Error as error:
        raise BadInput(str(path), f"unreadable ({error})", BOP_HEADER) from None
    if header != BOP_HEADER.split(","):
        raise BadInput(str(path), f"the header {','.join(header)[:80]!r}", BOP_HEADER)
    return rows


def _scene_id(sequence: Sequence | None) -> int:
    """BOP's number of a scene: its folder's name where that is a number, else 1."""
    name = sequence.path.name if sequence is not None and sequence.path is not None else ""
    return int(name) if name.isdigit() else 1


def _obj_ids(objects: tuple[str, ...]) -> dict[str, int]:
    """BOP's number of each object: that of ``obj_000005``, else 1, 2, ... in the sequence's order."""
    named = {name: re.fullmatch(r"obj_(\d{6})(_\d+)?", name) for name in objects}
    return {name: int(found[1]) if found else k for k, (name, found) in enumerate(named.items(), 1)}


def _image_ids(sequence: Sequence | None, frame_index: np.ndarray) -> np.ndarray:
    """BOP's number of each frame: the image's in a BOP scene, else the frame's own."""
    if sequence is None or sequence.format != "bop":
        return frame_index
    return np.array([int(sequence.frame_names[i]) for i in frame_index], int)
