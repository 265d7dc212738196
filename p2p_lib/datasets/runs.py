"""A run on disk: written frame by frame, readable whenever it stops, read back by :func:`load_run`.

::

    config.toml           every parameter
    run.json              what ran on what: sequence, objects, tracker, masks, preset, seed, versions, commit
    poses/<object>.txt    TUM: time_s tx ty tz qx qy qz qw of T_cam_obj; frames without a pose are left out
    poses.npz             everything of every frame, and the truth where the sequence has it
    meshes/<object>.ply   the reconstructed surface in the object frame, vertex colours (written at the end)
    keypoints.npz         2D tracks and keypoint maps (:mod:`p2p_lib.datasets.keypoint_log`; written at the end)
    models.npz            the models' points, so that a run can be scored by itself
    timings.csv           milliseconds of every frame and stage
    masks/<object>/*.png  the masks that were used, 255 on the object (where asked for); named by frame index
"""

from __future__ import annotations

import csv
import json
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets.keypoint_log import FILE as KEYPOINTS
from p2p_lib.datasets.models import load_points
from p2p_lib.datasets.provenance import provenance
from p2p_lib.datasets.sequence import SYNTHETIC, ObjectTruth, Sequence

#: One object at one frame, as stored in ``poses.npz`` (see :class:`ObjectRun`).
ROW = np.dtype(
    [
        ("frame_index", "i8"),
        ("time_s", "f8"),
        ("status", "U12"),
        ("T_cam_obj", "f8", (4, 4)),
        ("confidence", "f8"),
        ("covariance", "f8", (6, 6)),
        ("visible_points", "i8"),
        ("inliers", "i8"),
        ("keyframe", "?"),
        ("T_cam_model", "f8", (4, 4)),
        ("labelled", "?"),
        ("visible_px", "i8"),
    ]
)
NO_MASKS = -1  # visible_px of sequences that come without masks


# --- reading ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ObjectRun:
    """One object over the n frames of a run.

    frame_index, time_s  (n,) of the sequence
    status               (n,) str, a :class:`~p2p_lib.core.types.Status`
    T_cam_obj            (n, 4, 4), NaN where there is no pose
    confidence           (n,) in [0, 1]; covariance (n, 6, 6), NaN where there is none
    visible_points, inliers, keyframe, reason  (n,) as of the estimates
    T_cam_model          (n, 4, 4) truth, NaN where there is none
    labelled             (n,) bool: the dataset's visibility labels hold
    visible_px           (n,) pixels of the dataset's own mask, -1 where it has no masks
    """

    frame_index: np.ndarray
    time_s: np.ndarray
    status: np.ndarray
    T_cam_obj: np.ndarray
    confidence: np.ndarray
    covariance: np.ndarray
    visible_points: np.ndarray
    inliers: np.ndarray
    keyframe: np.ndarray
    T_cam_model: np.ndarray
    labelled: np.ndarray
    visible_px: np.ndarray
    reason: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.frame_index)
        for name in ROW.names:
            got = getattr(self, name).shape
            if got != (n, *ROW[name].shape):
                raise BadInput(f"run: {name}", f"shape {got}", f"{(n, *ROW[name].shape)}")

    def __len__(self) -> int:
        return len(self.frame_index)

    @property
    def has_pose(self) -> np.ndarray:
        """(n,) bool."""
        return np.isfinite(self.T_cam_obj).all((1, 2))

    @property
    def has_truth(self) -> np.ndarray:
        """(n,) bool."""
        return np.isfinite(self.T_cam_model).all((1, 2))


@dataclass(frozen=True, eq=False)
class Run:
    """A run as read from disk.

    info     what ``run.json`` says
    objects  name to :class:`ObjectRun`
    points   name to the (V, 3) points of its model, for the objects that have one
    timings  column to (n,) array: frame_index, time_s, total_ms, keyframe, and ``<stage>_ms`` (NaN: did not run)
    """

    path: Path
    info: dict[str, Any]
    objects: dict[str, ObjectRun]
    points: dict[str, np.ndarray]
    timings: dict[str, np.ndarray]


def load_run(folder: str | Path) -> Run:
    """Read what :class:`RunWriter` wrote, finished or not.

    Raises :class:`MissingData` where there is no run, :class:`BadInput` where a file of it is damaged.
    """
    folder = Path(folder)
    try:
        info = json.loads((folder / "run.json").read_text())
    except FileNotFoundError:
        raise MissingData(str(folder), "no run there (no run.json)", f"Make one: p2p run SEQ --out {folder}") from None
    except ValueError as error:
        raise BadInput(str(folder / "run.json"), f"unreadable JSON ({error})", "what p2p run wrote") from None
    columns = _load_npz(folder / "poses.npz")
    objects = {
        name: ObjectRun(**{f.name: columns[f"{name}/{f.name}"] for f in fields(ObjectRun)})
        for name in info["objects"]
        if f"{name}/frame_index" in columns
    }
    if not objects:
        raise MissingData(str(folder), "a run without frames", "It was stopped at once: run it again.")
    points = {key.removesuffix("/points"): p for key, p in _load_npz(folder / "models.npz").items()}
    return Run(folder, info, objects, points, _load_timings(folder / "timings.csv"))


def _load_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        return {}
    except (ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise BadInput(str(path), f"an unreadable archive ({error})", "arrays as p2p run wrote them") from None


def _load_timings(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        # A crash can cut the last line.
        rows = [row for row in csv.reader(file) if row]
    rows = [row for row in rows if len(row) == len(rows[0])]
    values = np.array([[float(x) if x else np.nan for x in row] for row in rows[1:]]).reshape(-1, len(rows[0]))
    return dict(zip(rows[0], values.T))


# --- writing ---------------------------------------------------------------------------------------


class RunWriter:
    """Writes a run as it happens; a context manager.

    Poses and timings are appended every frame. ``poses.npz`` is replaced as a whole, by rename, ever more
    rarely (after 1, 2, 4, ... 64, then every 50 or more frames) and when the run ends: by itself, by an error or by
    Ctrl-C. Whoever catches the interruption inside says so in ``info["stopped_by"]``.

    objects   those that are tracked (default: all of the sequence); others may appear among the estimates later
    models    object to model file; their points are kept with the run
    replaced  what run was in the folder before, in words; empty where there was none
    """

    def __init__(
        self,
        out: str | Path,
        sequence: Sequence,
        config: Config,
        tracker: str,
        masks: str,
        objects: tuple[str, ...] | None = None,
        start: int = 0,
        stop: int | None = None,
        models: Mapping[str, Path] | None = None,
    ):
        self.path, self._sequence = Path(out), sequence
        self._truth: dict[str, ObjectTruth] = sequence.truth
        self._rows: dict[str, np.ndarray] = {}
        self._reasons: dict[str, list[str]] = {}
        self._times: list[tuple[int, float]] = []  # frame index and time of every frame so far
        self._columns = ["frame_index", "time_s", "total_ms", "keyframe"]
        self._timings: list[dict[str, str]] = []
        self._flush_at = 1
        points = {name: load_points(path) for name, path in (models or {}).items()}
        self.replaced = _earlier(self.path)
        _clear(self.path)
        for name in sequence.objects if objects is None else objects:
            self._add_object(name)
        (self.path / "config.toml").write_text(config.to_toml())
        if points:
            _save_npz(self.path / "models.npz", {f"{name}/points": p for name, p in points.items()})
        self._write_timings()
        synthetic = sequence.name.startswith(SYNTHETIC)
        self.info: dict[str, Any] = {
            "sequence": sequence.name,
            "path": None if synthetic or sequence.path is None else str(sequence.path),
            "format": sequence.format,
            "objects": list(self._rows),
            "start": start,
            "stop": len(sequence) if stop is None else min(stop, len(sequence)),
            "tracker": tracker,
            "masks": masks,
            "preset": config.preset,
            "seed": config.seed,
            "models": {name: _inside(path, sequence.path) for name, path in (models or {}).items()},
            "frames": 0,
            "finished": False,
            "stopped_by": None,
            **provenance(),
        }
        self._write_info()

    def add(
        self,
        frame: Frame,
        estimates: Mapping[str, PoseEstimate],
        total_ms: float,
        stages_ms: Mapping[str, float] | None = None,
    ) -> None:
        """One frame: its estimates (an object without one is not being tracked yet) and its processing time.

        total_ms   the whole step, without decoding images and without writing results
        stages_ms  parts of it by name; a stage may be absent from a frame
        """
        for name in estimates:
            if name not in self._rows:
                self._add_object(name)
        visible_px = self._sequence.visible_px(frame.index)
        n = len(self._times)
        for name, rows in self._rows.items():
            if n == len(rows):
                self._rows[name] = rows = np.concatenate([rows, np.zeros(max(64, n), ROW)])
            estimate = estimates.get(name) or _not_yet(name, frame.index, frame.time_s)
            rows[n] = self._row(estimate, visible_px.get(name, 0) if visible_px else NO_MASKS)
            self._reasons[name][n:] = [estimate.reason]
            if estimate.T_cam_obj is not None:
                self._append(self._pose_file(name), tum_line(frame.time_s, estimate.T_cam_obj))
        self._times.append((frame.index, frame.time_s))
        self._add_timing(frame, total_ms, any(e.keyframe for e in estimates.values()), stages_ms or {})
        if n + 1 >= self._flush_at:
            self.flush()
            self._flush_at = (n + 1) * 2 if n < 32 else n + 1 + max(50, n // 10)

    def add_masks(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> None:
        """Keep the masks (H, W) bool that served at a frame; all False for an object of which nothing is known."""
        for name in self._rows:
            mask = masks.get(name)
            picture = np.zeros(frame.shape, np.uint8) if mask is None else mask.astype(np.uint8) * np.uint8(255)
            path = self.path / "masks" / name / f"{frame.index:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())

    def flush(self) -> None:
        """Make everything so far readable on disk."""
        n = len(self._times)
        columns = {f"{name}/{key}": rows[key][:n] for name, rows in self._rows.items() for key in ROW.names}
        columns |= {f"{name}/reason": np.array(r[:n], dtype=np.str_) for name, r in self._reasons.items()}
        if n:
            _save_npz(self.path / "poses.npz", columns)
        self.info |= {"frames": n, "objects": list(self._rows)}
        self._write_info()

    def __enter__(self) -> RunWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if kind is not None:
            self.info["stopped_by"] = kind.__name__
        self.info["finished"] = self.info["stopped_by"] is None
        self.flush()

    def _add_object(self, name: str) -> None:
        if not re.fullmatch(r"[\w][\w .+-]*", name):
            raise BadInput("object name", repr(name), "letters, digits, '_', '-', '.', '+' or spaces: it names a file")
        earlier = [self._row(_not_yet(name, index, time_s), NO_MASKS) for index, time_s in self._times]
        self._rows[name] = np.array(earlier, ROW)
        self._reasons[name] = [_not_yet(name, 0, 0.0).reason] * len(earlier)
        self._pose_file(name).write_text("")

    def _row(self, e: PoseEstimate, visible_px: int) -> tuple:
        truth = self._truth.get(e.object)
        T_cam_obj = np.full((4, 4), np.nan) if e.T_cam_obj is None else e.T_cam_obj
        covariance = np.full((6, 6), np.nan) if e.covariance is None else e.covariance
        T_cam_model = truth.T_cam_model[e.frame_index] if truth else np.full((4, 4), np.nan)
        labelled = bool(truth.labelled[e.frame_index]) if truth else False
        counts = e.visible_points, e.inliers, e.keyframe
        head = e.frame_index, e.time_s, str(e.status), T_cam_obj, e.confidence, covariance
        return (*head, *counts, T_cam_model, labelled, visible_px)

    def _add_timing(self, frame: Frame, total_ms: float, keyframe: bool, stages_ms: Mapping[str, float]) -> None:
        row = {"frame_index": str(frame.index), "time_s": f"{frame.time_s:.9f}", "total_ms": f"{total_ms:.4f}"}
        row |= {"keyframe": str(int(keyframe)), **{f"{k}_ms": f"{v:.4f}" for k, v in stages_ms.items()}}
        self._timings.append(row)
        new = [key for key in row if key not in self._columns]
        if new:  # a stage that had not run before gets a column
            self._columns += new
            self._write_timings()
        else:
            self._append(self.path / "timings.csv", self._csv_line(row))

    def _csv_line(self, row: Mapping[str, str]) -> str:
        return ",".join(row.get(key, "") for key in self._columns) + "\n"

    def _write_timings(self) -> None:
        lines = [",".join(self._columns) + "\n", *map(self._csv_line, self._timings)]
        _replace(self.path / "timings.csv", "".join(lines).encode())

    def _write_info(self) -> None:
        _replace(self.path / "run.json", (json.dumps(self.info, indent=1, ensure_ascii=False) + "\n").encode())

    def _pose_file(self, name: str) -> Path:
        return self.path / "poses" / f"{name}.txt"

    @staticmethod
    def _append(path: Path, line: str) -> None:
        with path.open("a") as file:
            file.write(line)


def quaternion_xyzw(T: np.ndarray) -> np.ndarray:
    """The unit quaternions (..., 4), scalar last and not negative, of transformations (..., 4, 4)."""
    w = se3.so3_log(T[..., :3, :3])
    half = np.linalg.norm(w, axis=-1, keepdims=True) / 2
    return np.concatenate([w / 2 * np.sinc(half / np.pi), np.cos(half)], -1)


def tum_line(time_s: float, T_cam_obj: np.ndarray) -> str:
    """One line of a TUM trajectory: time_s tx ty tz qx qy qz qw, metres, with its line end."""
    numbers = np.concatenate([T_cam_obj[:3, 3], quaternion_xyzw(T_cam_obj)])
    return f"{time_s:.9f} " + " ".join(f"{x:.9f}" for x in numbers) + "\n"


def _not_yet(name: str, frame_index: int, time_s: float) -> PoseEstimate:
    return PoseEstimate(name, frame_index, time_s, Status.INITIALISING, reason="not added yet")


def _inside(path: Path, folder: Path | None) -> str:
    """A model's path as it is named in ``run.json``: relative to the sequence where it lies in there."""
    return str(path.relative_to(folder)) if folder is not None and path.is_relative_to(folder) else str(path)


def _earlier(out: Path) -> str:
    """What run a folder holds that is about to go; empty where none does."""
    try:
        info = json.loads((out / "run.json").read_text())
        return f"a run of {info['sequence']} ({info['frames']} frames, tracker {info['tracker']}, seed {info['seed']})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _clear(out: Path) -> None:
    """Make the folder, without the results of an earlier run; anything else in it stays."""
    if out.exists() and not out.is_dir():
        raise BadInput(str(out), "a file", "a folder for the results")
    (out / "poses").mkdir(parents=True, exist_ok=True)
    old = [out / name for name in ("run.json", "config.toml", "poses.npz", "models.npz", "timings.csv", KEYPOINTS)]
    for path in [
        *old,
        *(out / "poses").glob("*.txt"),
        *(out / "meshes").glob("*.ply"),
        *(out / "masks").glob("*/*.png"),
    ]:
        path.unlink(missing_ok=True)


def _replace(path: Path, data: bytes) -> None:
    """Write a file so that readers and crashes see either the old or the new one."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(data)
    os.replace(partial, path)


def _save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    os.replace(partial, path)
