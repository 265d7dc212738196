"""Writing a run as it happens, into a folder of its own (see :mod:`p2p_lib.datasets.runs` for what it holds)."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from p2p_lib.core.config import Config
from p2p_lib.core.errors import BadInput, listed
from p2p_lib.core.files import append, file_name, read_text, replace_text, save_arrays, writing_alone
from p2p_lib.core.options import differing
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets.first_masks import FILE as FIRST_MASKS
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.keypoint_log import FILE as KEYPOINTS
from p2p_lib.datasets.mask_log import FILE as MASK_LOG
from p2p_lib.datasets.models import load_points
from p2p_lib.datasets.provenance import provenance
from p2p_lib.datasets.run_paths import written_paths
from p2p_lib.datasets.runs import COLUMNS, NO_POSE, NOT_FOLLOWED, OFFLINE, ObjectRun, Run, load_run, read_info, tum_line
from p2p_lib.datasets.sequence import Sequence, check_images, first_image

IfExists = Literal["refuse", "replace", "resume"]
_ANEW = "--force, in Python if_exists='replace'"
#: What of ``run.json`` may be otherwise when a run is resumed: how far it came, and what made it, which poses tell.
_MAY_DIFFER = {"left_out", "frames", "finished", "stopped_by", "versions", "commit", "modified"}
_MAY_DIFFER |= {"first_image", "path_from_run"}  # which are there to find and to know the images again
#: So many things of a kind are named, the others counted.
_FEW = 3


class RunWriter:
    """Writes a run as it happens; a context manager, which keeps other runs out of its folder.

    Nothing is written, nor taken away, before the first frame is done. Then poses and timings are appended every
    frame; ``poses.npz`` is replaced as a whole, ever more rarely (after 1, 2, 4, ... 64, then every 50 or more frames)
    and when the run ends: by itself, by an error or by Ctrl-C. Whoever catches the interruption inside says so in
    ``info["stopped_by"]``.

    objects    those that are tracked (default: all of the sequence); others may appear among the estimates later
    models     object to model file; their points are kept with the run
    if_exists  what becomes of a run that the folder holds already: ``refuse`` with :class:`BadInput`, ``replace`` it,
               or ``resume`` it: its frames are compared as they are added again, and nothing is written before they
               are all there. What was not written by a run is never touched
    redo_from  of a run that is resumed only the frames before this one are kept; what was said of objects may be other
               words from there on
    earlier    what run was in the folder before, in words; empty where there was none
    resumed    the run in the folder, where it goes on
    complete   whether a run that is resumed had finished, so that nothing is left to do
    begun      whether anything has been written
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
        if_exists: IfExists = "refuse",
        redo_from: int | None = None,
    ):
        self.redo_from = redo_from
        self.path, self._sequence, self._config, self._if_exists = Path(out), sequence, config, if_exists
        _ = sequence.truth  # what is wrong with it is said before anything is written
        names = sequence.objects if objects is None else objects
        # Of each object one estimate for every frame so far.
        self._estimates: dict[str, list[PoseEstimate]] = {file_name("object name", name): [] for name in names}
        self._map_ids: dict[str, set[int]] = defaultdict(set)
        self._pose_files: dict[str, Path] = {}  # those that have been written
        self._frames: list[tuple[int, float]] = []  # index and time of every frame so far
        self._visible_px: list[Mapping[str, int] | None] = []
        self._timing_columns = ["frame_index", "time_s", "total_ms", "keyframe"]
        self._timings: list[dict[str, str]] = []
        self._flush_at = 1
        models = models or {}
        self._points = {f"{name}/points": load_points(path) for name, path in models.items()}
        self.earlier, self.complete, self.begun = "", False, False
        self.resumed: Run | None = None
        self._held = ExitStack()
        paths = written_paths(out, sequence, models)
        self.info: dict[str, Any] = {
            "sequence": sequence.name,
            **paths,
            "first_image": first_image(sequence, start) if paths["path"] else None,
            "format": sequence.format,
            "camera": asdict(sequence.camera),
            "objects": list(self._estimates),
            "start": start,
            "stop": len(sequence) if stop is None else min(stop, len(sequence)),
            "tracker": tracker,
            "masks": masks,
            "preset": config.preset,
            "seed": config.seed,
            "scene_seed": getattr(sequence, "scene_seed", None),
            "frames": 0,
            "finished": False,
            "stopped_by": None,
            **provenance(),
        }

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
                past = [_not_yet(name, index, time_s) for index, time_s in self._frames]
                self._estimates[file_name("object name", name)] = past
        for name, kept in self._estimates.items():
            kept.append(estimates.get(name) or _not_yet(name, frame.index, frame.time_s))
            self._map_ids[name].add(kept[-1].map_id)
        self._visible_px.append(self._sequence.visible_px(frame.index))
        self._frames.append((frame.index, frame.time_s))
        row = {"frame_index": str(frame.index), "time_s": f"{frame.time_s:.9f}", "total_ms": f"{total_ms:.4f}"}
        row["keyframe"] = str(int(any(e.keyframe for e in estimates.values())))
        self._timings.append(row | {f"{k}_ms": f"{v:.4f}" for k, v in (stages_ms or {}).items()})
        n = len(self._frames)
        if self.resumed is not None and n <= len(next(iter(self.resumed.objects.values()))):
            self._compare(self.resumed, n - 1)
        elif not self.begun:
            self.begin()
        else:
            self._append_last()
            if n >= self._flush_at:
                self.flush()

    def begin(self) -> None:
        """Write all so far in the place of an earlier run; what :meth:`add` does at the first frame that is new."""
        for folder in ("poses", "meshes", "maps", "masks"):
            if (self.path / folder).is_symlink():
                raise BadInput(str(self.path / folder), "a link", "a folder of the run's own", "Take it away.")
        if self.resumed is None:
            if (earlier := read_info(self.path)) is not None:
                _clear(self.path, earlier)
            self._write_info()  # by which the folder is known to be a run's: before anything else
        elif self.redo_from is not None:
            self._clear_redone(self.resumed.objects, self.redo_from)
        replace_text(self.path / "config.toml", self._config.to_toml())
        if self._points:
            save_arrays(self.path / "models.npz", self._points)
        for name in self._estimates:
            self._write_poses(name)
        self._write_timings()
        self.begun = True
        self.flush()

    def _clear_redone(self, objects: Iterable[str], start: int) -> None:
        """Take away what the run that is resumed said from frame ``start`` on, and all of objects that are no more."""
        patterns = [KEYPOINTS, MASK_LOG, *_maps(objects)]
        for name in objects:
            gone = name not in self._estimates
            patterns += [f"poses/{name}.txt"] if gone else []
            if (self.info.get("options") or {}).get("save_masks"):
                frames = range(self.info["start"] if gone else start, self.info["stop"])
                patterns += [f"masks/{name}/{frame:06d}.png" for frame in frames]
        _unlink(self.path, patterns)
        _clear_refined(self.path)

    def kept_map(self, name: str) -> int:
        """The map of an object that the run keeps to: that of the most poses so far."""
        return ObjectRun.of(name, self._estimates[name], self._sequence, self._visible_px).kept_map

    def add_masks(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> None:
        """Keep the masks (H, W) bool that served at the frame last added; all False where nothing is known."""
        for name in self._estimates:
            path = self.path / "masks" / name / f"{frame.index:06d}.png"
            if self.begun or not path.exists():
                mask = masks.get(name)
                save_png(path, np.zeros(frame.shape, bool) if mask is None else mask)

    def keep_whole_frames(self) -> None:
        """After an interrupt, perhaps while a frame was written: the frames before it are kept, whole."""
        kept: list[list] = [*self._estimates.values(), self._visible_px, self._frames, self._timings]
        whole = min(map(len, kept))
        for rows in kept:
            del rows[whole:]
        if self.begun:
            for name in self._estimates:
                self._write_poses(name)
            self._write_timings()

    def flush(self) -> None:
        """Make everything so far readable on disk."""
        n = len(self._frames)
        self._flush_at = 2 * n if n <= 32 else n + max(50, n // 10)
        if self._frames:
            arrays: dict[str, np.ndarray] = {}
            for name, estimates in self._estimates.items():
                run = ObjectRun.of(name, estimates, self._sequence, self._visible_px)
                arrays |= {f"{name}/{column}": getattr(run, column) for column in COLUMNS}
                if self._several_maps(name):
                    self._write_poses(name)
            save_arrays(self.path / "poses.npz", arrays)
        self.info |= {"frames": n, "objects": list(self._estimates)}
        self._write_info()

    def __enter__(self) -> RunWriter:
        if not self.path.exists():  # and nothing written by the end: then it goes again
            self._held.callback(self._leave_nothing)
        with self._held:
            self._held.enter_context(writing_alone(self.path))
            info = look_into(self.path, self._if_exists)
            self.earlier = _in_words(info) if info else ""
            if info and self._if_exists == "resume":
                self.resumed, self.complete = load_run(self.path, every_map=True), info["finished"]
                if self.redo_from is not None:
                    self.resumed, self.complete = self.resumed.until(self.redo_from), False
                self._check_same(info)
            elif self.redo_from is not None:
                raise BadInput(str(self.path), "no run", f"one to go on with from frame {self.redo_from}")
            self._held = self._held.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        with self._held:
            if kind is not None:
                self.info["stopped_by"] = kind.__name__
                self.keep_whole_frames()
            if self.begun:
                self.info["finished"] = self.info["stopped_by"] is None
                self.flush()

    def _leave_nothing(self) -> None:
        with suppress(OSError):
            self.path.rmdir()

    def _check_same(self, earlier: Mapping[str, Any]) -> None:
        """That what is to be resumed was asked for in the same words."""
        mine, fix = json.loads(json.dumps(self.info)), f"Ask for the same, or run it anew: {_ANEW}."
        parameters = read_text(self.path / "config.toml", "the parameters of the run") == self._config.to_toml()
        theirs: dict[str, Any] = {key: earlier.get(key) for key in mine}
        theirs["objects"] = theirs["objects"][: len(mine["objects"])]  # others may have come later
        for info in (mine, theirs):  # what was read before the first bad image is the same
            info["options"] = {**(info.get("options") or {}), "skip_bad": None}
        if (start := self.redo_from) is not None:
            for info in (mine, theirs):
                info["prompts"] = [prompt for prompt in info.get("prompts") or [] if prompt["frame"] < start]
                info["options"] = {**(info.get("options") or {}), "prompts": None}
            theirs["objects"] = mine["objects"]  # their poses tell
        differ = [key for key in mine if theirs[key] != mine[key] and key not in _MAY_DIFFER]
        if not differ and parameters:
            check_images(earlier, self._sequence)
            return
        was, now = differing(theirs.get("options") or {}, mine.get("options") or {})
        if "sequence" in differ or "path" in differ:
            was, now = f"{_place(theirs)} {was}".strip(), f"{_place(mine)} {now}".strip()
        if start is None and (first := self._first_change(mine, theirs, differ)) is not None:
            fix = (
                f"Ask for the same, keep the frames before the first change (--from {first}), or run it anew: {_ANEW}."
            )
        if now:  # what somebody typed; all else follows of it
            raise BadInput(f"{self.path}: the run to go on with", now, f"{was}, as it began", fix)
        if not differ:
            raise BadInput(str(self.path / "config.toml"), "other parameters", "those that it began with", fix)
        if "prompts" in differ and start is not None:
            fix = f"Keep what is said before frame {start} as it was, or say --from FRAME of the first change."
        got, expected = (
            ", ".join(_prompts_alone(*both) if key == "prompts" else str(both[0][key])[:80] for key in differ)
            for both in ((mine, theirs), (theirs, mine))
        )
        raise BadInput(f"{self.path}: {', '.join(differ)}", got, f"{expected}, as it began", fix)

    def _first_change(self, mine: Mapping[str, Any], theirs: Mapping[str, Any], differ: Iterable[str]) -> int | None:
        """The frame from which on another run may be gone on with, where that was told other prompts and no more."""
        asked, before = ({**(info.get("options") or {}), "prompts": None} for info in (mine, theirs))
        if self.resumed is None or asked != before or set(differ) - {"options", "prompts", "objects"}:
            return None
        told = [info.get("prompts") or [] for info in (mine, theirs)]
        changed = [prompt["frame"] for prompt in told[0] + told[1] if not all(prompt in of for of in told)]
        reached = next(iter(self.resumed.objects.values())).frame_index
        first = min([*changed, int(reached[-1])]) if changed else int(reached[0])
        return first if first > reached[0] else None

    def _compare(self, earlier: Run, k: int) -> None:
        """That the k-th frame came out as it did before."""
        for name, obj in earlier.objects.items():
            now = self._estimates[name][k] if name in self._estimates else _not_yet(name, *self._frames[k])
            pose = NO_POSE if now.T_cam_obj is None else now.T_cam_obj
            same = (obj.frame_index[k], obj.status[k]) == (now.frame_index, now.status)
            if not same or not np.array_equal(pose, obj.T_cam_obj[k], equal_nan=True):
                fix = f"Was it made with another version, or has the data changed? Run it anew: {_ANEW}."
                got = f"{now.status} with another pose of {name!r} in frame {now.frame_index}"
                raise BadInput(str(self.path), got, f"what it came to before, {obj.status[k]}", fix)

    def _append_last(self) -> None:
        for name, estimates in self._estimates.items():
            T_cam_obj = estimates[-1].T_cam_obj
            if name not in self._pose_files:
                self._write_poses(name)  # of an object that nobody announced
            elif T_cam_obj is not None and not self._several_maps(name):
                append(self._pose_files[name], tum_line(estimates[-1].time_s, T_cam_obj))
        row = self._timings[-1]
        if row.keys() - set(self._timing_columns):
            self._write_timings()  # with a stage that had not run before
        else:
            append(self.path / "timings.csv", self._csv_line(row))

    def _several_maps(self, name: str) -> bool:
        """Whether poses of an object are in several maps: which has the most is seen when all are written."""
        return len(self._map_ids[name]) > 1

    def _csv_line(self, row: Mapping[str, str]) -> str:
        return ",".join(row.get(key, "") for key in self._timing_columns) + "\n"

    def _write_timings(self) -> None:
        self._timing_columns = list(dict.fromkeys([*self._timing_columns, *(k for row in self._timings for k in row)]))
        header = ",".join(self._timing_columns) + "\n"
        replace_text(self.path / "timings.csv", header + "".join(map(self._csv_line, self._timings)))

    def _write_info(self) -> None:
        replace_text(self.path / "run.json", json.dumps(self.info, indent=1, ensure_ascii=False) + "\n")

    def _write_poses(self, name: str) -> None:
        self._pose_files[name] = self.path / "poses" / f"{name}.txt"
        run = ObjectRun.of(name, self._estimates[name], self._sequence, self._visible_px).of_one_map()
        lines = map(tum_line, run.time_s[run.has_pose].tolist(), run.T_cam_obj[run.has_pose])
        replace_text(self._pose_files[name], "".join(lines))


def look_into(out: Path, if_exists: IfExists, resumable: bool = True) -> dict[str, Any] | None:
    """What ``run.json`` says of the run that a folder holds, None where nothing would be lost.

    Raises :class:`BadInput` where the folder is not free: it holds anything else, or a run that is to stay.
    """
    info = read_info(out)
    if info is None:
        held = sorted(path.name for path in out.iterdir() if not path.name.startswith(".")) if out.is_dir() else []
        if held:
            got = f"a folder with {', '.join(held[:3])}{', ...' * (len(held) > 3)}, and no run"
            raise BadInput(str(out), got, "a new or empty folder, or that of a run", "Name another one.")
        return None
    if info["frames"] and if_exists == "refuse":
        fix = f"Name another folder, or replace it ({_ANEW})."
        if resumable:
            fix = f"{fix[:-1]}, or go on with it (--resume, in Python if_exists='resume')."
        raise BadInput(str(out), _in_words(info), "a new or empty folder", fix)
    return info if info["frames"] else None


def _in_words(info: Mapping[str, Any]) -> str:
    return f"a run of {info['sequence']} ({info['frames']} frames, tracker {info['tracker']}, seed {info['seed']})"


def _place(info: Mapping[str, Any]) -> str:
    return info["path"] or info["sequence"]


def _prompts_alone(info: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """The prompts of one run that another does not have, in words: of each what is not in the other's."""
    theirs, said = other["prompts"] or [], list[str]()
    for prompt in (prompt for prompt in info["prompts"] or [] if prompt not in theirs):
        where = {"name": prompt["name"], "frame": prompt["frame"]}
        like: Mapping[str, Any] = next((of for of in theirs if where.items() <= of.items()), where)
        keys = [key for key in (prompt | like) if prompt.get(key) != like.get(key)]
        what = "; ".join(_items_alone(key, prompt.get(key), like.get(key)) for key in keys)
        said.append(f"{prompt['name']!r} in frame {prompt['frame']}: {what}")
    return listed(said, _FEW) or "nothing"


def _items_alone(key: str, mine: Any, theirs: Any) -> str:
    """Of clicks those that the other does not have, or how many; of all else what it is."""
    if key not in ("points", "negative") or mine is None:
        return f"no {key}" if mine is None else f"{key} {mine}"
    alone = [f"({x:g}, {y:g})" for x, y in (at for at in mine if at not in (theirs or []))]
    return f"{key} {listed(alone, _FEW)}" if alone else f"{len(mine)} {key}"


def _not_yet(name: str, frame_index: int, time_s: float) -> PoseEstimate:
    return PoseEstimate(name, frame_index, time_s, Status.INITIALISING, reason=NOT_FOLLOWED)


def _clear(out: Path, info: Mapping[str, Any]) -> None:
    """Take away what the run that ``info`` tells of has written, and nothing else; ``run.json`` is replaced later."""
    kept_masks = (info.get("options") or {}).get("save_masks")
    masks = [f"masks/{name}/{'[0-9]' * 6}.png" for name in info["objects"]] if kept_masks else []
    poses = [f"poses/{name}.txt" for name in info["objects"]]
    # First the one without which there is no run: two are never mixed, whenever a kill comes.
    others = ("config.toml", "models.npz", "timings.csv", KEYPOINTS, MASK_LOG, FIRST_MASKS)
    _unlink(out, ("poses.npz", *poses, *_maps(info["objects"]), *masks, *others))
    _clear_refined(out)


def _maps(objects: Iterable[str]) -> list[str]:
    """What a run writes of its objects' surfaces at its end."""
    return [path for name in objects for path in (f"meshes/{name}.ply", f"maps/{name}.npz")]


def _unlink(out: Path, patterns: Iterable[str]) -> None:
    for pattern in patterns:
        for path in out.glob(pattern):
            if not path.parent.is_symlink():
                path.unlink()


def refined_info(folder: Path) -> dict[str, Any] | None:
    """What ``run.json`` says of what ``p2p refine`` made, not of what a link leads to; else None."""
    info = None if folder.is_symlink() else read_info(folder)
    return info if info is not None and info.get("offline") else None


def _clear_refined(out: Path) -> None:
    """Take away what was refined of a run."""
    refined = out / OFFLINE  # of poses that are gone: it would pass for one of the new run
    if (info := refined_info(refined)) is not None:
        _clear(refined, info)
        (refined / "run.json").unlink()
        for folder in (refined / "poses", refined / "meshes", refined):
            with suppress(OSError):  # something else is in it
                folder.rmdir()
