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
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.files import load_arrays, replace_text, replacing
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.keypoint_log import FILE as KEYPOINTS
from p2p_lib.datasets.models import load_points
from p2p_lib.datasets.provenance import provenance
from p2p_lib.datasets.sequence import SYNTHETIC, Sequence

NO_MASKS = -1  # visible_px of sequences that come without masks
NO_POSE = np.full((4, 4), np.nan)
NO_COVARIANCE = np.full((6, 6), np.nan)


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
        of_a_frame = {"T_cam_obj": (4, 4), "covariance": (6, 6), "T_cam_model": (4, 4)}
        for column in COLUMNS:
            got, expected = getattr(self, column).shape, (len(self), *of_a_frame.get(column, ()))
            if got != expected:
                raise BadInput(f"run: {column}", f"shape {got}", f"{expected}")

    @classmethod
    def of(cls, name: str, estimates: list[PoseEstimate], sequence: Sequence, visible_px: list) -> ObjectRun:
        """An object's estimates, one a frame, beside its truth and the sequence's ``visible_px`` of these frames."""
        truth = sequence.truth.get(name)
        same = ("frame_index", "time_s", "confidence", "visible_points", "inliers", "keyframe", "reason")
        columns = {key: np.array([getattr(e, key) for e in estimates]) for key in same}
        at = columns["frame_index"]
        return cls(
            **columns,
            status=np.array([str(e.status) for e in estimates]),
            T_cam_obj=np.array([NO_POSE if e.T_cam_obj is None else e.T_cam_obj for e in estimates]),
            covariance=np.array([NO_COVARIANCE if e.covariance is None else e.covariance for e in estimates]),
            T_cam_model=truth.T_cam_model[at] if truth else np.tile(NO_POSE, (len(at), 1, 1)),
            labelled=truth.labelled[at] if truth else np.zeros(len(at), bool),
            visible_px=np.array([NO_MASKS if seen is None else seen.get(name, 0) for seen in visible_px]),
        )

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


#: What ``poses.npz`` holds of an object.
COLUMNS = tuple(column.name for column in fields(ObjectRun))


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
    arrays = load_arrays(folder / "poses.npz")
    objects = {
        name: ObjectRun(**{column: arrays[f"{name}/{column}"] for column in COLUMNS})
        for name in info["objects"]
        if f"{name}/frame_index" in arrays
    }
    if not objects:
        raise MissingData(str(folder), "a run without frames", "It was stopped at once: run it again.")
    points = {key.removesuffix("/points"): p for key, p in load_arrays(folder / "models.npz").items()}
    return Run(folder, info, objects, points, _load_timings(folder / "timings.csv"))


def _load_timings(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    rows = [row for row in rows if len(row) == len(header)]  # a crash can cut the last line
    values = np.array([[float(x or "nan") for x in row] for row in rows]).reshape(-1, len(header))
    return dict(zip(header, values.T, strict=True))


# --- writing ---------------------------------------------------------------------------------------


class RunWriter:
    """Writes a run as it happens; a context manager.

    Poses and timings are appended every frame. ``poses.npz`` is replaced as a whole, ever more rarely (after 1, 2, 4,
    ... 64, then every 50 or more frames) and when the run ends: by itself, by an error or by Ctrl-C. Whoever catches
    the interruption inside says so in ``info["stopped_by"]``.

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
        _ = sequence.truth  # what is wrong with it is said before anything is written
        self._estimates: dict[str, list[PoseEstimate]] = {}  # of each object, one for every frame so far
        self._frames: list[tuple[int, float]] = []  # index and time of every frame so far
        self._visible_px: list[Mapping[str, int] | None] = []
        self._timing_columns = ["frame_index", "time_s", "total_ms", "keyframe"]
        self._timings: list[dict[str, str]] = []
        self._flush_at = 1
        models = models or {}
        points = {f"{name}/points": load_points(path) for name, path in models.items()}
        self.replaced = _earlier(self.path)
        _clear(self.path)
        for name in sequence.objects if objects is None else objects:
            self._add_object(name)
        (self.path / "config.toml").write_text(config.to_toml())
        if points:
            _save_arrays(self.path / "models.npz", points)
        self._write_timings()
        synthetic = sequence.name.startswith(SYNTHETIC)
        self.info: dict[str, Any] = {
            "sequence": sequence.name,
            "path": None if synthetic or sequence.path is None else str(sequence.path),
            "format": sequence.format,
            "objects": list(self._estimates),
            "start": start,
            "stop": len(sequence) if stop is None else min(stop, len(sequence)),
            "tracker": tracker,
            "masks": masks,
            "preset": config.preset,
            "seed": config.seed,
            "models": {name: str(_from(sequence.path, path)) for name, path in models.items()},
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
            if name not in self._estimates:
                self._add_object(name)
        self._visible_px.append(self._sequence.visible_px(frame.index))
        for name, kept in self._estimates.items():
            kept.append(estimates.get(name) or _not_yet(name, frame.index, frame.time_s))
            if kept[-1].T_cam_obj is not None:
                _append(self._pose_file(name), tum_line(frame.time_s, kept[-1].T_cam_obj))
        self._frames.append((frame.index, frame.time_s))
        self._add_timing(frame, total_ms, any(e.keyframe for e in estimates.values()), stages_ms or {})
        n = len(self._frames)
        if n >= self._flush_at:
            self.flush()
            self._flush_at = 2 * n if n <= 32 else n + max(50, n // 10)

    def add_masks(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> None:
        """Keep the masks (H, W) bool that served at a frame; all False for an object of which nothing is known."""
        for name in self._estimates:
            mask = masks.get(name)
            mask = np.zeros(frame.shape, bool) if mask is None else mask
            save_png(self.path / "masks" / name / f"{frame.index:06d}.png", mask)

    def flush(self) -> None:
        """Make everything so far readable on disk."""
        if self._frames:
            arrays = {}
            for name, estimates in self._estimates.items():
                run = ObjectRun.of(name, estimates, self._sequence, self._visible_px)
                arrays |= {f"{name}/{column}": getattr(run, column) for column in COLUMNS}
            _save_arrays(self.path / "poses.npz", arrays)
        self.info |= {"frames": len(self._frames), "objects": list(self._estimates)}
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
        self._estimates[name] = [_not_yet(name, index, time_s) for index, time_s in self._frames]
        self._pose_file(name).write_text("")

    def _add_timing(self, frame: Frame, total_ms: float, keyframe: bool, stages_ms: Mapping[str, float]) -> None:
        row = {"frame_index": str(frame.index), "time_s": f"{frame.time_s:.9f}", "total_ms": f"{total_ms:.4f}"}
        row |= {"keyframe": str(int(keyframe)), **{f"{k}_ms": f"{v:.4f}" for k, v in stages_ms.items()}}
        self._timings.append(row)
        if new := [key for key in row if key not in self._timing_columns]:
            self._timing_columns += new  # a stage that had not run before
            self._write_timings()
        else:
            _append(self.path / "timings.csv", self._csv_line(row))

    def _csv_line(self, row: Mapping[str, str]) -> str:
        return ",".join(row.get(key, "") for key in self._timing_columns) + "\n"

    def _write_timings(self) -> None:
        header = ",".join(self._timing_columns) + "\n"
        replace_text(self.path / "timings.csv", header + "".join(map(self._csv_line, self._timings)))

    def _write_info(self) -> None:
        replace_text(self.path / "run.json", json.dumps(self.info, indent=1, ensure_ascii=False) + "\n")

    def _pose_file(self, name: str) -> Path:
        return self.path / "poses" / f"{name}.txt"


def quaternion_xyzw(T: np.ndarray) -> np.ndarray:
    """The unit quaternions (..., 4), scalar last and not negative, of transformations (4, 4) or (N, 4, 4)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)


def tum_line(time_s: float, T_cam_obj: np.ndarray) -> str:
    """One line of a TUM trajectory: time_s tx ty tz qx qy qz qw, metres, with its line end."""
    numbers = np.concatenate([T_cam_obj[:3, 3], quaternion_xyzw(T_cam_obj)])
    return f"{time_s:.9f} " + " ".join(f"{x:.9f}" for x in numbers) + "\n"


def _not_yet(name: str, frame_index: int, time_s: float) -> PoseEstimate:
    return PoseEstimate(name, frame_index, time_s, Status.INITIALISING, reason="not added yet")


def _from(folder: Path | None, path: Path) -> Path:
    """The path as seen from the folder where it lies in there."""
    return path.relative_to(folder) if folder is not None and path.is_relative_to(folder) else path


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
    files = ("run.json", "config.toml", "poses.npz", "models.npz", "timings.csv", KEYPOINTS)
    for pattern in (*files, "poses/*.txt", "meshes/*.ply", "masks/*/*.png"):
        for path in out.glob(pattern):
            path.unlink()


def _append(path: Path, line: str) -> None:
    with path.open("a") as file:
        file.write(line)


def _save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    with replacing(path) as file:
        np.savez(file, allow_pickle=False, **arrays)
