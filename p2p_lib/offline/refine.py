"""``p2p refine``: the whole video counts for every frame of a finished run.

For each object: what the whole video shows of it, and the poses that fit all of it best (``evidence.py``). A surface is
fused at these poses, and each frame is refined on it from its tied and its adjusted pose and, where that fits badly,
from its neighbours' poses, back and forth; the best is kept (``surface.py``, ``surface_check.py``). A frame
without a pose gets one that fits as well as the others do. Causal poses at which the surface fits the masks better are
kept. The surface is fused anew with half the voxel size.

The confidence of a frame stays the causal one, which judges the causal pose; where the fit gives more, from 1 at no
cost to 0.5 at the limit, it is that. A new pose more than three sigmas from the causal one is doubted where depth does
not lie on its surface: neither says that it is right. The rule of causal poses, on the covariance and the points of
this pass, tells right poses from wrong ones less well: what a pass over all frames has wrong, all frames agree with.

Written to ``RUN/offline``, a run's folder of its own that says ``"offline": true``: causal results stay as they are.
``<object>/causal`` in its ``poses.npz``, (n,) bool, says in which frames the pose is the causal one that was kept.
It has no ``maps/``: keypoints and keyframes, by which an object is found again, stay those of ``RUN/maps``.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from p2p_lib.core import se3
from p2p_lib.core.config import Config, from_toml
from p2p_lib.core.errors import MissingData, listed
from p2p_lib.core.files import load_arrays, replace_text, save_arrays, writing_alone
from p2p_lib.core.mesh import save
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.types import DOUBTED, WITH_POSE, Status, evenly
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.provenance import code_digest
from p2p_lib.datasets.run_paths import written_path
from p2p_lib.datasets.runs import COLUMNS, NO_POSE, OFFLINE, ObjectRun, read_info, tum_line
from p2p_lib.evaluation.suspicions import ON_SURFACE
from p2p_lib.offline import OFFLINE_COMMENT
from p2p_lib.offline.evidence import VideoEvidence, VideoPoses, gather
from p2p_lib.offline.finished import Finished
from p2p_lib.offline.surface import SurfacePoses, finer_m, fused
from p2p_lib.offline.surface_check import SurfaceCheck

_PARTS = ".offline.partial"
#: Views fused while refining and at the end.
FUSED, FUSED_LAST = 80, 150
#: Old and new poses are compared in one frame in so many, by the mean over so many of those.
_JUDGED_EVERY, _JUDGED = 3, 7
#: A causal pose that costs more than this times the limit was wrong in that frame, and is not kept.
_GROSS = 2.0
#: The column of ``poses.npz`` that causal runs do not have.
CAUSAL = "causal"
#: Of a squared Mahalanobis distance with six degrees of freedom: three standard deviations (99.73 %).
_CHI2_6 = 20.06
#: Poses nearer to each other than this, m at the object's keypoints and degrees, are both good enough: it is not told.
_NEAR_M, _NEAR_DEG = 0.003, 2.0
#: Stretches of frames that are told.
_TOLD = 5


def refine_run(folder: str | Path, progress: bool = False, force: bool = False) -> list[str]:
    """Refine the run in ``folder`` into ``folder/offline``; a line on each object, and where it disagrees.

    force  repeat what was made of the same poses by the same code, which is left as it is otherwise

    Objects that an interrupted call has finished are not repeated. Raises :class:`MissingData` and :class:`BadInput`
    where images, masks or tracks are missing.
    """
    folder = Path(folder).resolve()  # it may lead through the result that is replaced
    made = Finished.of(folder)
    if made.run.info.get("offline"):
        raise MissingData(str(folder), "an offline result already", "Refine the run that it is of.")
    if not load_keypoints(folder):
        raise MissingData(str(folder / "keypoints.npz"), "no tracks were kept", "Was it stopped early? Run it anew.")
    config, stamp = from_toml(folder / "config.toml"), _stamp(folder)
    if not force and stamp.items() <= (read_info(folder / OFFLINE) or {}).items():
        return ["It was refined from these poses by this code already, and is left as it is; --force does it anew."]
    parts, of = folder / _PARTS, json.dumps(stamp)
    with writing_alone(folder):
        if (parts / "of").is_file() and (parts / "of").read_text() != of:
            shutil.rmtree(parts)
        parts.mkdir(exist_ok=True)
        replace_text(parts / "of", of)
        todo = [name for name in made.tracked if not (parts / f"{name}.npz").is_file()]
        passes = 1 + 2 * len(todo) if todo else 0  # over the frames: one for all objects, then two for each
        title = f"refine, {passes} passes over {len(made.frames)} frames"
        with progress_bar(title, passes * len(made.frames), shown=progress) as bar:
            evidence = gather(made, todo, config, parts, bar) if todo else {}
            for name in todo:
                _part(made, name, config, evidence.pop(name), parts, bar)
        summary = _write(made, parts, stamp)
        shutil.rmtree(parts)
    return summary


def _stamp(folder: Path) -> dict[str, str]:
    """From which causal poses, and by which code: what the result says of itself."""
    code = hashlib.sha256(code_digest().encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        code.update(path.read_bytes())
    return {"refined_from": _digest_of_poses(folder), "refined_by": code.hexdigest()[:12]}


def _digest_of_poses(folder: Path) -> str:
    return hashlib.sha256((folder / "poses.npz").read_bytes()).hexdigest()


def outdated(folder: Path) -> bool:
    """Whether this is an offline result beside a run that has other poses than those which it was made of."""
    run, info = folder.resolve().parent, read_info(folder) or {}
    return bool(info.get("offline")) and (run / "poses.npz").is_file() and info["refined_from"] != _digest_of_poses(run)


# --- one object ----------------------------------------------------------------------------------


def _part(made: Finished, name: str, config: Config, evidence: VideoEvidence, parts: Path, bar: Any) -> None:
    """Refine an object, and keep its poses and its surface in the folder ``parts``."""
    obj, voxel_m = made.run.objects[name], config.tsdf.voxel_m
    video = VideoPoses(made, obj, config, evidence)
    start, strong = video.tied()
    T, points, seen = video.adjusted(start, video.sightings(strong))
    posed = np.isfinite(T[:, 0, 0])
    confident = np.flatnonzero(posed & (obj.confidence > DOUBTED))
    confident = confident if len(confident) else np.flatnonzero(posed)
    volume = fused(made, name, T, evenly(confident, FUSED), config, voxel_m)
    poses = SurfacePoses(T, points, seen, evidence, volume, made.sequence.camera, config)
    poses.refine(start, confident, bar)
    check = SurfaceCheck(made, name, config, volume, poses.T, confident) if len(volume.mesh().faces) else None
    poses.ask_neighbours(check)
    columns, fits = _columns(obj, poses, evidence, check)
    last = evenly(np.flatnonzero(fits & evidence.shown), FUSED_LAST)
    if len((mesh := fused(made, name, columns["T_cam_obj"], last, config, finer_m(volume)).mesh()).faces):
        save(mesh, parts / "meshes" / f"{name}.ply")
    bar.update(len(T))
    save_arrays(parts / f"{name}.npz", columns)


def _columns(
    obj: ObjectRun, poses: SurfacePoses, evidence: VideoEvidence, check: SurfaceCheck | None
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of a run, in the causal object frame, and (n,) bool which poses fit; better causal poses are kept.

    :data:`CAUSAL` says which.
    """
    fits, T, covariance = poses.cost <= poses.limit, poses.T.copy(), poses.covariance.copy()
    lost = ~obj.has_pose & ~fits
    T[lost], covariance[lost] = NO_POSE, np.nan
    has = np.isfinite(T[:, 0, 0])
    confidence = np.where(fits, np.maximum(obj.confidence, 1 - 0.5 * poses.cost / poses.limit), obj.confidence)
    both = has & obj.has_pose & (obj.confidence > DOUBTED)
    T_new_old = se3.median(se3.inverse(T[both]) @ obj.T_cam_obj[both]) if both.any() else np.eye(4)
    causal = obj.T_cam_obj @ se3.inverse(T_new_old)
    stays = _stays(T, causal, evidence, check)
    for k in np.flatnonzero(stays):
        stays[k] = poses.cost_at(int(k), causal[k]) <= _GROSS * poses.limit
    A = se3.adjoint(se3.inverse(T_new_old))
    on_volume = T
    T, covariance = T @ T_new_old, A @ covariance @ A.T
    T[stays], covariance[stays] = obj.T_cam_obj[stays], obj.covariance[stays]
    confidence = np.where(stays, obj.confidence, confidence)
    confidence = np.where(has, np.minimum(confidence, 1), 0.0)
    if check is not None:
        for k in np.flatnonzero(disagreement(obj, T) > _CHI2_6):
            if check.on_surface(int(k), on_volume[k]) < ON_SURFACE:
                confidence[k] = min(confidence[k], DOUBTED)
    return {"T_cam_obj": T, "covariance": covariance, "confidence": confidence, CAUSAL: stays}, has & fits


def _stays(T: np.ndarray, causal: np.ndarray, evidence: VideoEvidence, check: SurfaceCheck | None) -> np.ndarray:
    """(n,) bool: where the surface at the causal pose (n, 4, 4) fits the mask better than at the new one T.

    The new poses fit the surface anyway, which was fused at them; masks are independent. One mask says little: the mean
    over neighbouring frames decides.
    """
    has = np.isfinite(T[:, 0, 0]) & np.isfinite(causal[:, 0, 0])
    rows = np.flatnonzero(has & evidence.shown)[::_JUDGED_EVERY]
    if not len(rows) or check is None:
        return np.zeros(len(T), bool)
    better = [check.overlap(k, causal[k]) - check.overlap(k, T[k]) for k in rows.tolist()]
    mean = uniform_filter1d(np.array(better), min(_JUDGED, len(rows)), mode="nearest")
    nearest = np.searchsorted((rows[1:] + rows[:-1]) / 2, np.arange(len(T)))
    return has & (mean[nearest] > 0)


# --- files ---------------------------------------------------------------------------------------


def _merged(obj: ObjectRun, part: dict[str, np.ndarray]) -> ObjectRun:
    """An object's run with the offline poses, its columns in ``part``."""
    has, n = np.isfinite(part["T_cam_obj"]).all((1, 2)), len(obj)
    status = np.where(has & ~obj.has_pose, str(Status.RECOVERED), obj.status)
    reason = np.where(has & ~obj.has_pose, "found by the offline pass", obj.reason)
    # A causal pose in a map that was given up has no pose in this one.
    gone = ~has & np.isin(obj.status, list(WITH_POSE))
    status, reason = np.where(gone, str(Status.LOST), status), np.where(gone, "no pose fits", reason)
    one_map = {"map_id": np.zeros(n, int), "joined_map": np.full(n, -1), "T_obj_joined": np.tile(NO_POSE, (n, 1, 1))}
    return replace(obj, **part, **one_map, status=status.astype(str), reason=reason.astype(str))


def disagreement(causal: ObjectRun, T_cam_obj: np.ndarray) -> np.ndarray:
    """(n,) squared Mahalanobis distances of poses (n, 4, 4) to causal ones, by their covariance; NaN without one."""
    both = causal.has_pose & np.isfinite(T_cam_obj).all((1, 2)) & np.isfinite(causal.covariance).all((1, 2))
    squared = np.full(len(causal), np.nan)
    xi = se3.log(se3.inverse(causal.T_cam_obj[both]) @ T_cam_obj[both])
    squared[both] = np.einsum("ni,nij,nj->n", xi, np.linalg.pinv(causal.covariance[both]), xi)
    return squared


def far_apart(causal: ObjectRun, T_cam_obj: np.ndarray, p_obj: np.ndarray) -> np.ndarray:
    """(n,) bool: poses (n, 4, 4) that move or turn keypoints p_obj (N, 3) far from where the causal ones do."""
    deg, _ = se3.error_deg_mm(T_cam_obj, causal.T_cam_obj)
    centre = np.median(p_obj, axis=0, keepdims=True) if len(p_obj) else np.zeros((1, 3))
    moved_m = np.linalg.norm(se3.transform(T_cam_obj, centre) - se3.transform(causal.T_cam_obj, centre), axis=-1)
    return (moved_m[:, 0] > _NEAR_M) | (deg > _NEAR_DEG)


def _write(made: Finished, parts: Path, stamp: dict[str, str]) -> list[str]:
    """Put the finished parts together in the place of an earlier offline result; a line on each object.

    That is moved into ``parts`` first, and is lost with them.
    """
    new = parts / "whole"
    shutil.rmtree(new, ignore_errors=True)
    (new / "poses").mkdir(parents=True)
    arrays: dict[str, np.ndarray] = {}
    summary, disagrees, keypoints = [], {}, load_keypoints(made.run.path)
    for name, obj in made.run.objects.items():
        part = load_arrays(parts / f"{name}.npz")
        kept = part.pop(CAUSAL, np.zeros(len(obj), bool))  # an object that never had a pose has no part
        offline = _merged(obj, part) if part else obj
        arrays |= {f"{name}/{column}": getattr(offline, column) for column in COLUMNS} | {f"{name}/{CAUSAL}": kept}
        has = offline.has_pose
        lines = map(tum_line, offline.time_s[has].tolist(), offline.T_cam_obj[has])
        replace_text(new / "poses" / f"{name}.txt", "".join([OFFLINE_COMMENT] * bool(has.any()) + list(lines)))
        p_obj = keypoints[name].p_obj[keypoints[name].promoted] if name in keypoints else np.zeros((0, 3))
        far = far_apart(obj, offline.T_cam_obj, p_obj)
        off = np.flatnonzero(far & (disagreement(obj, offline.T_cam_obj) > _CHI2_6))
        disagrees[name] = [int(obj.frame_index[k]) for k in off]
        told = f", {int(kept.sum())} of them the causal one, {len(off)} more than three sigmas from it"
        told += f" and {1000 * _NEAR_M:g} mm or {_NEAR_DEG:g} degrees" * bool(len(off))
        summary.append(f"{name}: {_in_words(obj, offline)}{told}{in_ranges(disagrees[name])}")
    save_arrays(new / "poses.npz", arrays)
    for file_name in ("config.toml", "models.npz", "masks.npz"):
        if (made.run.path / file_name).is_file():
            shutil.copyfile(made.run.path / file_name, new / file_name)
    if (parts / "meshes").is_dir():
        shutil.copytree(parts / "meshes", new / "meshes")
    there = made.run.path / OFFLINE
    about = {"offline": True, **stamp, "masks_in": "..", "disagrees_above_3_sigma": disagrees}
    about |= written_path(there, made.run.info["path"])
    replace_text(new / "run.json", json.dumps(made.run.info | about, indent=1, ensure_ascii=False) + "\n")
    if there.exists():
        shutil.rmtree(parts / "before", ignore_errors=True)
        there.rename(parts / "before")
    new.rename(there)
    return summary


def _in_words(causal: ObjectRun, offline: ObjectRun) -> str:
    """In how many frames there is a pose, and how many are in another map alone."""
    has, had = offline.has_pose, causal.has_pose
    more, fewer = int((has & ~had).sum()), int((~has & had).sum())
    apart = int((~has & ~had & np.isin(causal.status, list(WITH_POSE))).sum())
    in_other = f", none in {apart} frames of a map that never met this one" if apart else ""
    return f"a pose in {int(has.sum())} of {len(causal)} frames ({more} more, {fewer} fewer than causally{in_other})"


def in_ranges(frames: list[int]) -> str:
    """``: frames 3 to 9, 12`` of numbers in order, of many stretches the longest first; nothing of none."""
    runs = np.split(np.array(frames, int), np.flatnonzero(np.diff(frames) > 1) + 1) if frames else []
    runs = sorted(runs, key=len, reverse=True) if len(runs) > _TOLD else runs
    texts = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    return f": frames {listed(texts, _TOLD)}" if texts else ""
