"""``p2p refine``: the whole video counts for every frame of a finished run.

For each object: keyframes from the whole video, those without a pose included, are tied to each other wherever they
show the same (``loops.py``); poses follow the strongest ties, then a bundle adjustment of all that was tracked
(``adjustment.py``). On the surface that these poses fuse each frame is refined, from where it was tracked, where it was
adjusted, and, from the end backwards and then forwards, from its neighbours; the best stands. A frame that had no pose
gets one where it fits as well as the others do. Where the surface fills the masks better at the causal poses, they
stay. The surface is fused anew at half the voxel.

Written to ``RUN/offline``, a run's folder of its own that says ``"offline": true``: causal results stay as they are.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from p2p_lib.core import se3
from p2p_lib.core.config import Config, from_toml
from p2p_lib.core.depth import depth_noise_m, in_range, lift, off_edges
from p2p_lib.core.errors import MissingData
from p2p_lib.core.files import load_arrays, replace_text, replacing, writing_alone
from p2p_lib.core.mesh import save
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.types import DOUBTED, Frame, Status
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.runs import COLUMNS, NO_COVARIANCE, NO_POSE, OFFLINE, ObjectRun, tum_line
from p2p_lib.method.refinement import Keypoints, refine
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.offline import loops
from p2p_lib.offline.adjustment import Sightings, adjust, information, locate, placed
from p2p_lib.offline.dataset import agreement, visible
from p2p_lib.offline.finished import Finished, Renderer

FOLDER, _PARTS = OFFLINE, ".offline.partial"
#: Keyframes that are compared with each other; poses adjusted together; views fused while refining and at the end.
KEYFRAMES, TOGETHER, FUSED, FUSED_LAST = 60, 200, 80, 150
#: A tie stronger than this counts (see :class:`~p2p_lib.offline.loops.Tie`).
_STRONG = 5.0
#: A smaller mask is not looked at, px (the protocol's).
_MIN_PX = 300
#: Pixels of depth's steps are left out of clouds, m.
_STEP_M = 0.02
#: A point is taken as a keypoint of a pose within this, m; a distance beyond the first counts as that.
_NEAR_M, _FAR_M = 0.02, 0.01
#: Where no mask tells of the object: so much of its surface may be seen through, and colours may be so many times as
#: far off as usual, and correlate so many times as well at least. This many frames tell what is usual.
_BEHIND, _OTHER_COLOURS, _LESS_ALIKE, _CALIBRATED = 0.15, 1.4, 0.6, 12
#: Old and new poses are judged in every so many-th frame, by the mean over so many of them.
_JUDGED_EVERY, _JUDGED = 3, 7
#: A causal pose that costs so many times what a good one may was wrong in that frame alone, and does not stay.
_GROSS = 2.0
#: Of a squared Mahalanobis distance with six degrees of freedom: three standard deviations (99.73 %).
_CHI2_6 = 20.06


@dataclass(eq=False)
class _Evidence:
    """What one pass over the video finds of an object: n frames, K keyframes, M sightings.

    clouds (n,) points (P, 3) float32 of its surface each; mask_px (n,); rows of tracked points ``pose`` (M,) in frames,
    ``track`` (M,) and ``p_cam`` (M, 3); key (K,) rows of frames, views (K,) what can be recognised there.
    """

    clouds: list[np.ndarray] = field(default_factory=list)
    mask_px: list[int] = field(default_factory=list)
    p_cam: list[np.ndarray] = field(default_factory=list)
    key: list[int] = field(default_factory=list)
    views: list[loops.Features] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Refined:
    """An object's poses over the whole video, (n, 4, 4), NaN where there is none; covariance (n, 6, 6), cost (n,)."""

    T_cam_obj: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray


def refine_run(folder: str | Path, progress: bool = False) -> list[str]:
    """Refine the run in ``folder`` into ``folder/offline``; a line on each object, and where it disagrees.

    What an interrupted call has finished, object by object, the next one takes up. Raises :class:`MissingData` and
    :class:`BadInput` where images, masks or tracks are gone.
    """
    folder = Path(folder)
    made = Finished.of(folder)
    if made.run.info.get("offline"):
        raise MissingData(str(folder), "an offline result already", "Refine the run that it is of.")
    if not load_keypoints(folder):
        raise MissingData(str(folder / "keypoints.npz"), "no tracks were kept", "Was it stopped early? Run it anew.")
    config, stamp = from_toml(folder / "config.toml"), _stamp(folder)
    parts = folder / _PARTS
    with writing_alone(folder):
        if (parts / "of").is_file() and (parts / "of").read_text() != stamp:
            shutil.rmtree(parts)
        parts.mkdir(exist_ok=True)
        replace_text(parts / "of", stamp)
        todo = [name for name in made.tracked if not (parts / f"{name}.npz").is_file()]
        total = len(made.frames) * (1 + 2 * len(todo)) if todo else 0
        with progress_bar("refine", total, shown=progress) as bar:
            evidence = _gather(made, todo, config, bar) if todo else {}
            for name in todo:
                _part(_Refinement(made, name, config, evidence.pop(name), bar), parts)
        told = _write(made, parts, stamp)
        shutil.rmtree(parts)
    return told


def _stamp(folder: Path) -> str:
    return hashlib.sha256((folder / "poses.npz").read_bytes()).hexdigest()


def _gather(made: Finished, names: list[str], config: Config, bar: Any) -> dict[str, _Evidence]:
    tracks, frames = load_keypoints(made.run.path), made.frames
    found = {name: _Evidence() for name in names}
    wanted = np.unique(np.linspace(0, len(frames) - 1, min(KEYFRAMES, len(frames))).astype(int))
    for k, i in enumerate(frames):
        frame, masks = made.sequence.frame(int(i)), made.masks(int(i))
        good = off_edges(frame.depth_m, _STEP_M) & in_range(frame.depth_m, config.depth)
        for name, of in found.items():
            mask = masks.get(name, np.zeros(frame.shape, bool))
            v, u = np.nonzero(mask & good)
            some = np.linspace(0, len(v) - 1, min(len(v), config.refinement.max_points)).astype(int)
            cloud = made.sequence.camera.unproject(np.stack([u[some], v[some]], -1), frame.depth_m[v[some], u[some]])
            of.clouds.append(cloud.astype(np.float32))
            of.mask_px.append(int(np.count_nonzero(mask)))
            uv_px = tracks[name].uv_px[tracks[name].at(int(i))].astype(float)
            of.p_cam.append(lift(frame, uv_px, made.sequence.camera, config.depth))
            if k in wanted and of.mask_px[-1] >= _MIN_PX:
                of.key.append(k)
                of.views.append(loops.features(frame, mask, made.sequence.camera, config.depth))
        bar.update()
    return found


class _Refinement:
    """One object."""

    def __init__(self, made: Finished, name: str, config: Config, evidence: _Evidence, bar: Any):
        self.made, self.name, self.config, self.evidence, self.bar = made, name, config, evidence, bar
        self.obj, self.camera = made.run.objects[name], made.sequence.camera
        log = load_keypoints(made.run.path)[name]
        self.p_cam = np.concatenate(evidence.p_cam) if evidence.p_cam else np.zeros((0, 3))
        rows = np.concatenate([np.arange(len(log.frame_index))[log.at(int(i))] for i in made.frames])
        self.of_frame = np.searchsorted(made.frames, log.frame_index[rows])
        self.tracks, self.point = np.unique(log.track_id[rows], return_inverse=True)
        self.measured = np.isfinite(self.p_cam[:, 0])

    # -- poses from what ties keyframes ----------------------------------------------------------

    def tied(self) -> tuple[np.ndarray, list[loops.Tie]]:
        """Poses (n, 4, 4) that follow the strongest ties, NaN where nothing tells, and the ties that count."""
        key, views = np.array(self.evidence.key, int), self.evidence.views
        T = self.obj.T_cam_obj.copy()
        if len(key) < 2:
            return T, []
        found = loops.ties(views, self.camera, np.random.default_rng(self.made.run.info["seed"]))
        strong = [tie for tie in found if tie.strength >= _STRONG]
        pairs = [(tie.a, tie.b, tie.T_a_b, tie.strength) for tie in strong]
        pairs += [pair for a in range(len(key) - 1) if (pair := self._tracked(a, a + 1, key, views))]
        T_key = loops.along_ties(T[key], pairs)
        has = np.isfinite(T[key][:, 0, 0]) & np.isfinite(T_key[:, 0, 0])
        for k in np.flatnonzero(self.obj.has_pose) if has.any() else ():
            nearest = np.flatnonzero(has)[np.abs(key[has] - k).argmin()]
            T[k] = self.obj.T_cam_obj[k] @ se3.inverse(self.obj.T_cam_obj[key[nearest]]) @ T_key[nearest]
        T[key] = np.where(np.isfinite(T_key), T_key, T[key])
        return T, strong

    def _tracked(self, a: int, b: int, key: np.ndarray, views: list[loops.Features]):
        """Two keyframes as the tracker ties them: by tracks that agree with its poses."""
        T = self.obj.T_cam_obj[key[[a, b]]]
        if not np.isfinite(T).all():
            return None
        T_a_b, shared = T[0] @ se3.inverse(T[1]), [self._seen_at(k) for k in key[[a, b]]]
        _, of_a, of_b = np.intersect1d(self.point[shared[0]], self.point[shared[1]], return_indices=True)
        p_a, p_b = self.p_cam[shared[0][of_a]], self.p_cam[shared[1][of_b]]
        off_m = np.linalg.norm(se3.transform(T_a_b, p_b) - p_a, axis=1)
        agree = int((off_m < np.maximum(3 * depth_noise_m(p_a[:, 2]), 0.004)).sum())
        strength = loops.rated(T_a_b, max(agree, 1), views[a], views[b], self.camera)
        return a, b, T_a_b, max(strength, 1e-3)

    def _seen_at(self, k: int) -> np.ndarray:
        lo, hi = np.searchsorted(self.of_frame, [k, k + 1])
        return np.arange(lo, hi)[self.measured[lo:hi]]

    # -- bundle adjustment -----------------------------------------------------------------------

    def sightings(self, strong: list[loops.Tie]) -> Sightings:
        """Of tracks, and of features that ties match: ``pose`` is the frame's row."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        z = self.p_cam[self.measured, 2]
        pose, point, p_cam = self.of_frame[self.measured], self.point[self.measured], self.p_cam[self.measured]
        if strong:
            start = np.concatenate([[0], np.cumsum([len(view.p_cam) for view in self.evidence.views])])
            a = np.concatenate([start[tie.a] + tie.rows_a for tie in strong])
            b = np.concatenate([start[tie.b] + tie.rows_b for tie in strong])
            _, label = connected_components(coo_array((np.ones(len(a)), (a, b)), (start[-1],) * 2), directed=False)
            used = np.unique(np.concatenate([a, b]))
            view = np.searchsorted(start, used, side="right") - 1
            pose = np.concatenate([pose, np.array(self.evidence.key)[view]])
            point = np.concatenate([point, len(self.tracks) + label[used]])
            p_cam = np.concatenate([p_cam, np.concatenate([v.p_cam for v in self.evidence.views])[used]])
            z = p_cam[:, 2]
        return Sightings(
            pose, point, p_cam, information(p_cam, z / self.camera.fx, depth_noise_m(z, self.config.depth))
        )

    def adjusted(self, T: np.ndarray, seen: Sightings) -> tuple[np.ndarray, np.ndarray, Sightings]:
        """Poses, points (N, 3) and what is seen of them."""
        found, posed = seen, np.flatnonzero(np.isfinite(T[:, 0, 0]))
        others = np.setdiff1d(posed, self.evidence.key)
        some = (
            others[
                np.unique(
                    np.linspace(0, len(others) - 1, max(min(TOGETHER - len(self.evidence.key), len(others)), 0)).astype(
                        int
                    )
                )
            ]
            if len(others)
            else others
        )
        together = np.union1d(np.intersect1d(self.evidence.key, posed), some).astype(int)
        for _ in range(2):  # a pose needs points, and a point needs poses
            seen = seen.select(np.isin(seen.pose, posed))
            count = np.bincount(seen.point[np.isin(seen.pose, together)], minlength=seen.point.max(initial=-1) + 1)
            seen = seen.select(count[seen.point] >= 2)
            together = together[np.isin(together, seen.pose)]
        if len(together) < 2:
            return T, np.zeros((0, 3)), seen.select(np.zeros(len(seen.pose), bool))
        known, point = np.unique(seen.point, return_inverse=True)
        seen = replace(seen, point=point)
        mine = np.isin(seen.pose, together)
        first = replace(seen.select(mine), pose=np.searchsorted(together, seen.pose[mine]))
        best = adjust(T[together], placed(T[together], first, point.max() + 1), first)
        T = T.copy()
        rest = posed[np.isin(posed, seen.pose)]
        alone = replace(
            seen.select(np.isin(seen.pose, rest)), pose=np.searchsorted(rest, seen.pose[np.isin(seen.pose, rest)])
        )
        T[rest] = locate(T[rest], best.p_obj, alone).T_cam_obj
        T[together] = best.T_cam_obj
        # Frames without a pose see these points too: they tell what their neighbours' poses are worth there.
        found = found.select(np.isin(found.point, known))
        return T, best.p_obj, replace(found, point=np.searchsorted(known, found.point))

    # -- on the surface --------------------------------------------------------------------------

    def fused(self, T: np.ndarray, rows: np.ndarray, count: int, voxel_m: float) -> TsdfVolume:
        """The surface of at most ``count`` of the frames ``rows``, evenly over them."""
        volume = TsdfVolume(replace(self.config.tsdf, voxel_m=voxel_m))
        for k in rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int))]:
            frame: Frame = self.made.sequence.frame(int(self.made.frames[k]))
            mask = self.made.masks(int(self.made.frames[k])).get(self.name)
            if mask is not None:
                use = mask & off_edges(frame.depth_m, _STEP_M) & in_range(frame.depth_m, self.config.depth)
                volume.integrate(frame.depth_m, frame.rgb, use, self.camera, se3.orthonormalised(T[k]))
        return volume

    def best_of(self, k: int, candidates: list[np.ndarray], volume: TsdfVolume, points: np.ndarray, seen: Sightings):
        """The pose of the k-th frame that fits surface and points best, its covariance and its cost."""
        p_obj, p_cam, sigma_m = self._points_in(k, points, seen)
        cloud = self.evidence.clouds[k].astype(float)
        best = NO_POSE, NO_COVARIANCE, np.inf
        for T in candidates:
            near = np.linalg.norm(se3.transform(se3.inverse(T), p_cam) - p_obj, axis=1) < _NEAR_M
            keypoints = Keypoints(p_obj[near], p_cam[near], sigma_m[near]) if near.any() else None
            found = refine(T, cloud, volume, self.config.refinement, keypoints=keypoints)
            cost = self._cost(found.T_cam_obj, cloud, volume, p_obj, p_cam, sigma_m)
            if cost < best[2]:
                best = found.T_cam_obj, NO_COVARIANCE if found.covariance is None else found.covariance, cost
        return best

    def _points_in(self, k: int, points: np.ndarray, seen: Sightings):
        """What is seen in the k-th frame: points of the object (M, 3), where (M, 3), and how well known (M,)."""
        lo, hi = np.searchsorted(seen.pose, [k, k + 1])
        p_cam = seen.p_cam[lo:hi]
        sigma_m = np.hypot(depth_noise_m(p_cam[:, 2], self.config.depth), p_cam[:, 2] / self.camera.fx)
        return points[seen.point[lo:hi]], p_cam, sigma_m

    def _cost(self, T, cloud, volume, p_obj, p_cam, sigma_m) -> float:
        """How far off, 0 to 2: the cloud from the surface, and the points from where they are seen."""
        T_obj_cam = se3.inverse(T)
        distance_m, valid = volume.query(se3.transform(T_obj_cam, cloud))
        off = np.where(valid, np.minimum(np.abs(distance_m), _FAR_M), _FAR_M) / _FAR_M
        apart = np.linalg.norm(se3.transform(T_obj_cam, p_cam) - p_obj, axis=1) / (5 * sigma_m)
        parts = [float(part.mean()) for part in (off, np.minimum(apart, 1)) if len(part)]
        return 2 * sum(parts) / len(parts) if parts else 2.0

    def result(self) -> tuple[Refined, TsdfVolume]:
        """Everything in turn."""
        T, strong = self.tied()
        T, points, seen = self.adjusted(start := T, self.sightings(strong))
        order = np.argsort(seen.pose, kind="stable")
        seen = seen.select(order)
        posed = np.isfinite(T[:, 0, 0])
        sure = np.flatnonzero(posed & (self.obj.confidence > DOUBTED))
        sure = sure if len(sure) else np.flatnonzero(posed)
        volume = self.fused(T, sure, FUSED, self.config.tsdf.voxel_m)
        shown = np.array(self.evidence.mask_px) >= _MIN_PX
        covariance, cost = np.tile(NO_COVARIANCE, (len(T), 1, 1)), np.full(len(T), np.inf)
        for k in range(len(T)):
            if posed[k]:
                T[k], covariance[k], cost[k] = self.best_of(k, [T[k], start[k]], volume, points, seen)
            self.bar.update()
        limit = np.median(cost[sure]) + 3 * 1.4826 * np.median(np.abs(cost[sure] - np.median(cost[sure]))) + 0.02
        sight = Sight(self, volume, T, sure)
        for step in (-1, 1):  # from the end backwards, then from the start forwards
            for k in range(len(T))[::step]:
                if cost[k] <= limit or not 0 <= k - step < len(T) or cost[k - step] > limit:
                    continue
                before = T[k - 2 * step] if 0 <= k - 2 * step < len(T) and cost[k - 2 * step] <= limit else T[k - step]
                on = T[k - step] @ se3.inverse(before) @ T[k - step]  # goes on as it moved, else stays
                if shown[k]:
                    found = self.best_of(k, [T[k - step], on], volume, points, seen)
                elif (found := sight.found(k, [on, T[k - step]], k - step, T[k - step])) is None:
                    continue
                if found[2] < cost[k]:
                    T[k], covariance[k], cost[k] = found
        lost = ~self.obj.has_pose & (cost > limit)
        T[lost], covariance[lost] = NO_POSE, NO_COVARIANCE
        has, fit = np.isfinite(T[:, 0, 0]), cost <= limit
        confidence = np.where(fit, np.maximum(self.obj.confidence, 1 - 0.5 * cost / limit), self.obj.confidence)
        T_new_old = self.causal_frame(T)
        causal = self.obj.T_cam_obj @ se3.inverse(T_new_old)
        stays = self.stays(T, causal, sight)
        for k in np.flatnonzero(stays):
            cloud = self.evidence.clouds[k].astype(float)
            stays[k] = self._cost(causal[k], cloud, volume, *self._points_in(k, points, seen)) <= _GROSS * limit
        A = se3.adjoint(se3.inverse(T_new_old))
        T, covariance = T @ T_new_old, A @ covariance @ A.T
        T[stays], covariance[stays] = self.obj.T_cam_obj[stays], self.obj.covariance[stays]
        confidence = np.where(stays, self.obj.confidence, confidence)
        last = self.fused(T, np.flatnonzero(has & fit & shown), FUSED_LAST, self.config.tsdf.voxel_m / 2)
        self.bar.update(len(T))
        return Refined(T, covariance, np.where(has, np.minimum(confidence, 1), 0.0)), last

    def stays(self, T: np.ndarray, causal: np.ndarray, sight: Sight) -> np.ndarray:
        """(n,) bool: where the surface at the causal pose (n, 4, 4) fills the mask better than at the new one T.

        The new poses fit the surface, which was fused with them; the masks are not of their making. Of one frame a mask
        says little: the mean over its neighbours decides.
        """
        has = np.isfinite(T[:, 0, 0]) & np.isfinite(causal[:, 0, 0])
        rows = np.flatnonzero(has & (np.array(self.evidence.mask_px) >= _MIN_PX))[::_JUDGED_EVERY]
        if not len(rows) or not sight:
            return np.zeros(len(T), bool)
        better = [sight.overlap(k, causal[k]) - sight.overlap(k, T[k]) for k in rows.tolist()]
        mean = uniform_filter1d(np.array(better), min(_JUDGED, len(rows)), mode="nearest")
        nearest = np.abs(np.arange(len(T))[:, None] - rows).argmin(1)
        return has & (mean[nearest] > 0)

    def causal_frame(self, T: np.ndarray) -> np.ndarray:
        """T_new_old (4, 4) to the object frame that most of the causal poses are in."""
        both = np.isfinite(T[:, 0, 0]) & self.obj.has_pose & (self.obj.confidence > DOUBTED)
        if not both.any():
            return np.eye(4)
        each = se3.inverse(T[both]) @ self.obj.T_cam_obj[both]
        T_new_old = each[len(each) // 2]
        for _ in range(20):
            T_new_old = T_new_old @ se3.exp(np.median(se3.log(se3.inverse(T_new_old) @ each), axis=0))
        return T_new_old


class Sight:
    """Looks for the object in frames without a mask of it: where its surface should be, is it there, in its colours?"""

    def __init__(self, work: _Refinement, volume: TsdfVolume, T: np.ndarray, sure: np.ndarray):
        self._work, self._volume = work, volume
        self._light: dict[int, tuple[float, float]] = {}
        mesh = volume.mesh()
        self._colours, self._faces = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(float), np.asarray(mesh.faces)
        self._render = Renderer(mesh.vertices, mesh.faces, work.camera) if len(mesh.faces) else None
        some = sure[np.unique(np.linspace(0, len(sure) - 1, min(len(sure), _CALIBRATED)).astype(int))]
        usual = [seen[2] for k in some if self._render and (seen := self._seen(self._frame(k), T[k]))]
        self._usual = float(np.median(usual)) if usual else 0.0

    def __bool__(self) -> bool:
        return self._render is not None

    def _frame(self, k: int) -> Frame:
        return self._work.made.sequence.frame(int(self._work.made.frames[k]))

    def found(self, k: int, candidates: list[np.ndarray], beside: int, T_beside: np.ndarray):
        """The pose of the k-th frame, its covariance and cost; None where the surface is not seen from any of these.

        beside  a frame next to it with its pose, in the same light
        """
        frame, best = self._frame(k), None
        if beside not in self._light:  # what was found so passes on what it was found by: errors do not add up
            known = self._seen(self._frame(beside), T_beside) if self._render else None
            self._light[beside] = (max(self._usual, known[2]), known[3]) if known else (self._usual, 1.0)
        self._light[k] = usual, alike = self._light[beside]
        for T in candidates if self._render else ():
            covariance = None
            for _ in range(3):
                if (seen := self._seen(frame, T, wide=True)) is None:
                    break
                refined = refine(T, seen[0], self._volume, self._work.config.refinement)
                T, covariance = refined.T_cam_obj, refined.covariance
            seen = None if covariance is None else self._seen(frame, T)
            if seen is None or seen[1] > _BEHIND or seen[2] > _OTHER_COLOURS * usual or seen[3] < _LESS_ALIKE * alike:
                continue
            distance_m, valid = self._volume.query(se3.transform(se3.inverse(T), seen[0]))
            cost = float(np.where(valid, np.minimum(np.abs(distance_m), _FAR_M), _FAR_M).mean() / _FAR_M)
            if best is None or cost < best[2]:
                best = T, covariance, cost
        return best

    def overlap(self, k: int, T: np.ndarray) -> float:
        """IoU of what shows of the surface at a pose with the mask of the k-th frame."""
        frame, silhouette = self._frame(k), self._render(se3.orthonormalised(T))
        mask = self._work.made.masks(frame.index)[self._work.name]
        return agreement(silhouette, visible(silhouette, frame.depth_m), frame.depth_m, mask)[0]

    def _seen(self, frame: Frame, T: np.ndarray, wide: bool = False) -> tuple[np.ndarray, float, float, float] | None:
        """Points (N, 3) measured on the surface, the share measured behind, how far colours are off and correlate."""
        silhouette = self._render(se3.orthonormalised(T))
        image, own = silhouette.inside(frame.depth_m)
        depth_m, z, hit = frame.depth_m[image], silhouette.depth_m[own], silhouette.hit[own]
        use = hit & (depth_m > 0)
        off = np.where(use, depth_m - np.where(hit, z, 0), 0)
        within = _NEAR_M if wide else np.maximum(0.006, 3 * depth_noise_m(depth_m, self._work.config.depth))
        on, behind = use & (np.abs(off) < within), use & (off > within)
        if on.sum() < _MIN_PX:
            return None
        v, u = np.nonzero(on)
        colour = self._colours[self._faces[silhouette.face[own][on]]].mean(1)
        true = frame.rgb[image][on].astype(float)
        gain = np.median(true, axis=0) / np.maximum(np.median(colour, axis=0), 1)
        wrong = float(np.abs(np.clip(colour * np.clip(gain, 0.7, 1.4), 0, 255) - true).mean())
        some = np.linspace(0, len(v) - 1, min(len(v), self._work.config.refinement.max_points)).astype(int)
        uv = np.stack([u[some] + image[1].start, v[some] + image[0].start], -1)
        cloud = self._work.camera.unproject(uv, depth_m[v[some], u[some]])
        spread = colour - colour.mean(0), true - true.mean(0)
        alike = (spread[0] * spread[1]).sum() / max(np.sqrt((spread[0] ** 2).sum() * (spread[1] ** 2).sum()), 1e-9)
        return cloud, float(behind.sum() / (on.sum() + behind.sum())), wrong, float(alike)


# --- files ---------------------------------------------------------------------------------------


def _part(work: _Refinement, parts: Path) -> None:
    found, volume = work.result()
    if len((mesh := volume.mesh()).faces):
        save(mesh, parts / "meshes" / f"{work.name}.ply")
    with replacing(parts / f"{work.name}.npz") as file:
        np.savez(file, T_cam_obj=found.T_cam_obj, covariance=found.covariance, confidence=found.confidence)


def _merged(obj: ObjectRun, part: dict[str, np.ndarray]) -> ObjectRun:
    """An object's run with the offline poses."""
    has, n = np.isfinite(part["T_cam_obj"]).all((1, 2)), len(obj)
    status = np.where(has & ~obj.has_pose, str(Status.RECOVERED), obj.status)
    reason = np.where(has & ~obj.has_pose, "found by the offline pass", obj.reason)
    # A causal pose in a map that was given up has no pose in this one.
    status, reason = (
        np.where(has | ~np.isin(obj.status, _WITH), x, y) for x, y in ((status, "lost"), (reason, "no pose fits"))
    )
    one_map = {"map_id": np.zeros(n, int), "joined_map": np.full(n, -1), "T_obj_joined": np.tile(NO_POSE, (n, 1, 1))}
    return replace(obj, **part, **one_map, status=status.astype(str), reason=reason.astype(str))


_WITH = [str(Status.TRACKED), str(Status.DEGRADED), str(Status.RECOVERED)]


def disagreement(causal: ObjectRun, offline: ObjectRun) -> np.ndarray:
    """(n,) squared Mahalanobis distance of the two poses by the causal covariance; NaN where one is missing."""
    both = causal.has_pose & offline.has_pose & np.isfinite(causal.covariance).all((1, 2))
    squared = np.full(len(causal), np.nan)
    xi = se3.log(se3.inverse(causal.T_cam_obj[both]) @ offline.T_cam_obj[both])
    squared[both] = np.einsum("ni,nij,nj->n", xi, np.linalg.pinv(causal.covariance[both]), xi)
    return squared


def _write(made: Finished, parts: Path, stamp: str) -> list[str]:
    """Put the finished parts together in the place of an earlier offline result; a line on each object."""
    new = parts / "whole"
    shutil.rmtree(new, ignore_errors=True)
    (new / "poses").mkdir(parents=True)
    arrays, told, disagrees = {}, [], {}
    for name, obj in made.run.objects.items():
        part = load_arrays(parts / f"{name}.npz")
        offline = _merged(obj, part) if part else obj
        arrays |= {f"{name}/{column}": getattr(offline, column) for column in COLUMNS}
        has = offline.has_pose
        lines = map(tum_line, offline.time_s[has].tolist(), offline.T_cam_obj[has])
        replace_text(new / "poses" / f"{name}.txt", "".join(lines))
        off = np.flatnonzero(disagreement(obj, offline) > _CHI2_6)
        disagrees[name] = [int(obj.frame_index[k]) for k in off]
        more, less = int((has & ~obj.has_pose).sum()), int((~has & obj.has_pose).sum())
        line = f"{name}: a pose in {int(has.sum())} of {len(obj)} frames ({more} more, {less} fewer than causally)"
        told.append(
            line + f", {len(off)} of them more than three sigmas from the causal one" + in_ranges(disagrees[name])
        )
    with replacing(new / "poses.npz") as file:
        np.savez(file, allow_pickle=False, **arrays)
    for file_name in ("config.toml", "models.npz", "masks.npz"):
        if (made.run.path / file_name).is_file():
            shutil.copyfile(made.run.path / file_name, new / file_name)
    if (parts / "meshes").is_dir():
        shutil.copytree(parts / "meshes", new / "meshes")
    about = {"offline": True, "refined_from": stamp, "masks_in": "..", "disagrees_above_3_sigma": disagrees}
    replace_text(new / "run.json", json.dumps(made.run.info | about, indent=1, ensure_ascii=False) + "\n")
    shutil.rmtree(made.run.path / FOLDER, ignore_errors=True)
    new.rename(made.run.path / FOLDER)
    return told


def in_ranges(frames: list[int]) -> str:
    """``: frames 3 to 9, 12`` of numbers in order; nothing of none."""
    runs = np.split(np.array(frames, int), np.flatnonzero(np.diff(frames) > 1) + 1) if frames else []
    text = ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
    return f": frames {text}" if text else ""
