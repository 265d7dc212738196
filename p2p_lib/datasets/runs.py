"""A run on disk: written frame by frame, readable whenever it stops, read back by :func:`load_run`.

It is written into a folder of its own, by one process at a time: nothing is deleted that an earlier run did not make.

::

    config.toml           every parameter
    run.json              what ran on what: sequence, objects, tracker, masks, preset, seed, versions, commit; what was
                          doubted meanwhile and, at the end, what to look at before it is believed
    first_masks.png       what objects were started with, and corrections (:mod:`p2p_lib.datasets.first_masks`)
    poses/<object>.txt    TUM: time_s tx ty tz qx qy qz qw of T_cam_obj; frames without a pose are left out,
                          and so are poses in maps that were given up since (``map_id`` in ``poses.npz``); poses in a
                          map that became part of the last one since are in its frame
    poses.npz             everything of every frame as it was said then, and the truth where the sequence has it
    meshes/<object>.ply   the reconstructed surface in the object frame, vertex colours (written at the end)
    keypoints.npz         2D tracks and keypoint maps (:mod:`p2p_lib.datasets.keypoint_log`; written at the end)
    masks.npz             every mask, coarsely (:mod:`p2p_lib.datasets.mask_log`; written at the end)
    models.npz            the models' points, so that a run can be scored by itself
    timings.csv           milliseconds of every frame and stage
    masks/<object>/*.png  the masks that were used, 255 on the object (where asked for); named by frame index
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from p2p_lib.core import se3
from p2p_lib.core.errors import DEPTH_MOVED, BadInput, Doubt, MissingData
from p2p_lib.core.files import file_name, load_arrays, read_text
from p2p_lib.core.types import DOUBTED, PoseEstimate, Status
from p2p_lib.datasets.masks import read_labels
from p2p_lib.datasets.run_paths import read_paths
from p2p_lib.datasets.schema import read_json
from p2p_lib.datasets.sequence import Sequence

NO_MASKS = -1  # visible_px of sequences that come without masks
#: Where in a run's folder ``p2p refine`` puts what it makes of it.
OFFLINE = "offline"
#: The reason of frames before an object was added and after it was removed.
NOT_FOLLOWED = "not followed"
NO_POSE = np.full((4, 4), np.nan)
NO_COVARIANCE = np.full((6, 6), np.nan)


@dataclass(frozen=True, eq=False)
class ObjectRun:
    """One object over the n frames of a run.

    frame_index, time_s  (n,) of the sequence
    status               (n,) str, a :class:`~p2p_lib.core.types.Status`
    T_cam_obj            (n, 4, 4), NaN where there is no pose (see :func:`load_run` on poses of several maps)
    confidence           (n,) in [0, 1]; covariance (n, 6, 6), NaN where there is none
    visible_points, inliers, keyframe, reason  (n,) as of the estimates
    map_id               (n,) int: poses of one map are in one object frame, those of another map in another
    joined_map           (n,) int, the map that became part of this one at this frame; -1: none
    T_obj_joined         (n, 4, 4) from that map's frame to this one's, NaN where none
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
    map_id: np.ndarray
    joined_map: np.ndarray
    T_obj_joined: np.ndarray
    T_cam_model: np.ndarray
    labelled: np.ndarray
    visible_px: np.ndarray
    reason: np.ndarray

    def __post_init__(self) -> None:
        of_a_frame = {"T_cam_obj": (4, 4), "covariance": (6, 6), "T_cam_model": (4, 4), "T_obj_joined": (4, 4)}
        for column in COLUMNS:
            got, expected = getattr(self, column).shape, (self.frame_index.size, *of_a_frame.get(column, ()))
            if got != expected:
                raise BadInput(f"run: {column}", f"shape {got}", f"{expected}")
            if (kind := getattr(self, column).dtype.kind) not in _KINDS.get(column, "f"):
                raise BadInput(f"run: {column}", f"values of kind {kind!r}", f"of kind {_KINDS.get(column, 'f')!r}")

    @classmethod
    def of(cls, name: str, estimates: list[PoseEstimate], sequence: Sequence, visible_px: list) -> ObjectRun:
        """An object's estimates, one a frame, beside its truth and the sequence's ``visible_px`` of these frames."""
        truth = sequence.truth.get(name)
        same = ("frame_index", "time_s", "confidence", "visible_points", "inliers", "keyframe", "map_id", "reason")
        columns = {key: np.array([getattr(e, key) for e in estimates]) for key in same}
        at = columns["frame_index"]
        return cls(
            **columns,
            status=np.array([str(e.status) for e in estimates]),
            T_cam_obj=np.array([NO_POSE if e.T_cam_obj is None else e.T_cam_obj for e in estimates]),
            covariance=np.array([NO_COVARIANCE if e.covariance is None else e.covariance for e in estimates]),
            joined_map=np.array([-1 if e.joined is None else e.joined[0] for e in estimates]),
            T_obj_joined=np.array([NO_POSE if e.joined is None else e.joined[1] for e in estimates]),
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
    def doubted(self) -> np.ndarray:
        """(n,) bool: a pose, of confidence :data:`~p2p_lib.core.types.DOUBTED` at most."""
        return self.has_pose & (self.confidence <= DOUBTED)

    @property
    def followed(self) -> np.ndarray:
        """(n,) bool: it had been added, and was not removed."""
        return (self.status != str(Status.INITIALISING)) | (self.reason != NOT_FOLLOWED)

    def select(self, rows: np.ndarray) -> ObjectRun:
        """The same at these rows or under this mask."""
        return ObjectRun(*(getattr(self, column)[rows] for column in COLUMNS))

    def of_confidence(self, least: float) -> ObjectRun:
        """The same without the poses of less confidence."""
        return replace(self, T_cam_obj=np.where((self.confidence >= least)[:, None, None], self.T_cam_obj, np.nan))

    def in_joined_maps(self) -> ObjectRun:
        """The same with what was said in maps that became part of another since in the frame of that one."""
        map_id, T_cam_obj, covariance = self.map_id.copy(), self.T_cam_obj.copy(), self.covariance.copy()
        for k in np.flatnonzero(self.joined_map >= 0):
            rows, T, A = map_id == self.joined_map[k], self.T_obj_joined[k], se3.adjoint(self.T_obj_joined[k])
            map_id[rows], T_cam_obj[rows] = self.map_id[k], T_cam_obj[rows] @ se3.inverse(T)
            covariance[rows] = A @ covariance[rows] @ A.T
        return replace(self, map_id=map_id, T_cam_obj=T_cam_obj, covariance=covariance)

    @property
    def kept_map(self) -> int:
        """The map with the most poses, once joined: the one that files, scores and the surface are of."""
        joined = self.in_joined_maps()
        return int(np.bincount(joined.map_id[joined.has_pose], minlength=1).argmax())

    def of_one_map(self) -> ObjectRun:
        """The same in the frame of :attr:`kept_map`: without the poses of maps that are no part of it."""
        joined = self.in_joined_maps()
        kept = joined.map_id == self.kept_map
        return replace(
            joined,
            T_cam_obj=np.where(kept[:, None, None], joined.T_cam_obj, np.nan),
            covariance=np.where(kept[:, None, None], joined.covariance, np.nan),
            confidence=np.where(kept, self.confidence, 0),
        )

    @property
    def has_truth(self) -> np.ndarray:
        """(n,) bool."""
        return np.isfinite(self.T_cam_model).all((1, 2))


#: What ``poses.npz`` holds of an object.
COLUMNS = tuple(column.name for column in fields(ObjectRun))
#: NumPy's kinds of value, where they are not floating point.
_KINDS = dict.fromkeys(("frame_index", "visible_points", "inliers", "map_id", "joined_map", "visible_px"), "iu")
_KINDS |= {"keyframe": "b", "labelled": "b", "status": "U", "reason": "U"}


class _Options(BaseModel):
    """Of what was asked for, that which has paths."""

    model_config = ConfigDict(extra="allow", strict=True)
    config_file: str | None = None
    prompts: str | None = None
    masks: str | None = None
    models: dict[str, str] | None = None
    memory: list[str] | None = None


class _Info(BaseModel):
    """What ``run.json`` says at least, by which a folder is known to be a run's."""

    model_config = ConfigDict(extra="allow", strict=True)
    sequence: str
    path: str | None
    path_from_run: str | None = None
    options: _Options | None = None
    format: str
    objects: list[Annotated[str, AfterValidator(lambda name: file_name("object name", name))]]
    tracker: str
    masks: str | None
    seed: Annotated[int, Field(ge=0)]
    models: dict[str, str]
    frames: Annotated[int, Field(ge=0)]
    finished: bool


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

    def __repr__(self) -> str:
        poses = ", ".join(f"{name} {obj.has_pose.sum()} of {len(obj)}" for name, obj in self.objects.items())
        return f"{type(self).__name__}({str(self.path)!r}, frames with a pose: {poses})"

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What was doubted while it was made; earlier versions wrote the text alone."""
        said = self.info.get("doubts") or ()
        return tuple(_earlier_doubt(of) if isinstance(of, str) else Doubt(**of) for of in said)

    def until(self, frame: int) -> Run:
        """The run as it was before a frame; :class:`BadInput` for one that has none before it, or was not reached."""
        at = next(iter(self.objects.values())).frame_index
        if not at[0] < frame <= at[-1]:
            fix = "Frames before it are kept."
            raise BadInput(f"{self.path}: from", f"frame {frame}", f"one from {at[0] + 1} to {at[-1]}", fix)
        kept = at < frame
        objects = {name: obj.select(kept) for name, obj in self.objects.items()}
        return replace(self, objects=objects, timings={key: rows[: kept.sum()] for key, rows in self.timings.items()})

    @property
    def mask_folder(self) -> Path:
        """Where the masks that served are, one folder an object, if they were kept."""
        return self.path / self.info.get("masks_in", "") / "masks"

    def masks(self, sequence: Sequence, frame: int) -> dict[str, np.ndarray]:
        """Object to (H, W) bool at a frame of the sequence: the masks that were kept, else those of its that served."""
        kept = {name: self.mask_folder / name / f"{frame:06d}.png" for name in self.objects}
        if any(path.is_file() for path in kept.values()):
            shape = sequence.camera.height, sequence.camera.width
            return {name: read_labels(path, shape) > 0 for name, path in kept.items() if path.is_file()}
        masks = (sequence.masks(frame) if self.info["masks"] == "dataset" else None) or {}
        return {name: masks[name] for name in self.objects if name in masks}


def _earlier_doubt(text: str) -> Doubt:
    """A doubt of a run of an earlier version: of its kinds the one that says how depth was taken is known by words."""
    return Doubt(text, kind=DEPTH_MOVED if "of different moments while the camera moves" in text else "")


def load_run(folder: str | Path, every_map: bool = False) -> Run:
    """Read what :class:`~p2p_lib.datasets.run_writer.RunWriter` wrote, finished or not.

    Poses are those in the object frame of the map that holds at the end: what was said in maps that became part of it
    since is in its frame too, what was said in a map that has been given up is no pose. ``every_map``: as they were.

    Raises :class:`MissingData` where there is no run, :class:`BadInput` where a file of it is damaged.
    """
    folder = Path(folder)
    info = read_info(folder)
    if info is None:
        raise MissingData(str(folder), "no run there (no run.json)", "Make one: p2p run SEQ --out DIR")
    arrays, objects = load_arrays(folder / "poses.npz"), {}
    for name in info["objects"] if info["frames"] else ():
        if f"{name}/frame_index" in arrays:
            n = arrays[f"{name}/frame_index"].size
            of_older_runs = {"map_id": np.zeros(n, int), "joined_map": np.full(n, -1)}
            of_older_runs["T_obj_joined"] = np.tile(NO_POSE, (n, 1, 1))
            found = {column: arrays.get(f"{name}/{column}", of_older_runs.get(column)) for column in COLUMNS}
            columns = {column: values for column, values in found.items() if values is not None}
            if lacking := [column for column in COLUMNS if column not in columns]:
                raise BadInput(str(folder / "poses.npz"), f"no {name}/{lacking[0]}", "what p2p run wrote")
            obj = ObjectRun(**columns)
            objects[name] = obj if every_map else obj.of_one_map()
    if not any(map(len, objects.values())):
        raise MissingData(str(folder), "a run without frames", "It was stopped at once: run it again.")
    if len({len(obj) for obj in objects.values()}) > 1:
        raise BadInput(str(folder / "poses.npz"), "objects over different frames", "what p2p run wrote")
    points = {key.removesuffix("/points"): p for key, p in load_arrays(folder / "models.npz").items()}
    for name, p in points.items():
        if p.ndim != 2 or p.shape[1] != 3 or p.dtype.kind != "f":
            raise BadInput(f"{folder / 'models.npz'}: {name}", f"{p.shape} {p.dtype}", "points (V, 3)")
    return Run(folder, info, objects, points, _load_timings(folder / "timings.csv"))


def read_info(folder: Path) -> dict[str, Any] | None:
    """What ``run.json`` says; None where there is none, :class:`BadInput` where it is not a run's."""
    path = folder / "run.json"
    if not path.exists():
        return None
    info = read_json(path, _Info, "what p2p run wrote").model_dump(exclude_unset=True)
    return info | read_paths(folder, info)


def _load_timings(path: Path) -> dict[str, np.ndarray]:
    if not path.exists():
        return {}
    expected = "milliseconds as p2p run wrote them"
    try:
        header, *rows = csv.reader(read_text(path, expected).splitlines()) or [[]]
        rows = [row for row in rows if len(row) == len(header)]  # a crash can cut the last line
        values = np.array([[float(x or "nan") for x in row] for row in rows]).reshape(-1, len(header))
    except (ValueError, csv.Error) as error:
        fix = "Delete it to go without."
        raise BadInput(str(path), f"unreadable numbers ({error})", expected, fix) from None
    return dict(zip(header, values.T, strict=True))


def tum_line(time_s: float, T_cam_obj: np.ndarray) -> str:
    """One line of a TUM trajectory: time_s tx ty tz qx qy qz qw, metres, with its line end."""
    numbers = np.concatenate([T_cam_obj[:3, 3], se3.quaternion_xyzw(T_cam_obj)])
    return f"{time_s:.9f} " + " ".join(f"{x:.9f}" for x in numbers) + "\n"
