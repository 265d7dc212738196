"""What a whole video shows of an object, and the poses that fit all of it best.

One pass over the video gathers it for all objects. Keyframes that show the same features are tied (``loops.py``), poses
follow the strongest ties, then a bundle adjustment (``adjustment.py``) takes tracks and matched features together.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.depth import depth_noise_m, in_range, lift, off_edges
from p2p_lib.core.types import evenly
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.runs import ObjectRun
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX
from p2p_lib.offline import loops
from p2p_lib.offline.adjustment import PointObservations, adjust, information, locate, placed
from p2p_lib.offline.finished import Finished

#: Keyframes that are compared with each other, and poses that are adjusted together.
KEYFRAMES, TOGETHER = 60, 200
#: The least strength of a tie that counts (see :class:`~p2p_lib.offline.loops.Tie`), and of one by tracks.
_STRONG, _LEAST = 5.0, 1e-3
#: Pixels at larger steps of depth are left out of clouds and surfaces, m.
STEP_M = 0.02


class StoredClouds:
    """Clouds (P, 3) float32 by number, in a file of a folder that has no name and goes with the object.

    In memory the clouds of an hour of video would take a gigabyte for each object.
    """

    def __init__(self, folder: Path):
        self._file, self._ends = TemporaryFile(dir=folder), [0]

    def append(self, cloud: np.ndarray) -> None:
        """One more."""
        self._file.seek(self._ends[-1])
        self._ends.append(self._ends[-1] + self._file.write(cloud.astype(np.float32).tobytes()))

    def __getitem__(self, k: int) -> np.ndarray:
        self._file.seek(self._ends[k])
        return np.frombuffer(self._file.read(self._ends[k + 1] - self._ends[k]), np.float32).reshape(-1, 3)


@dataclass(eq=False)
class VideoEvidence:
    """What the n frames of a run show of an object.

    clouds   (n,) each (P, 3) float32, points of its surface in the camera frame
    mask_px  (n,) pixels of its mask
    tracks   (n,) each the ids (M,) of its tracks and their measured points (M, 3) in the camera frame
    key      (K,) rows of keyframes
    views    (K,) their features
    """

    clouds: list[np.ndarray] | StoredClouds = field(default_factory=list)
    mask_px: list[int] = field(default_factory=list)
    tracks: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    key: list[int] = field(default_factory=list)
    views: list[loops.Features] = field(default_factory=list)

    @property
    def shown(self) -> np.ndarray:
        """(n,) bool: frames whose mask is large enough to be looked at."""
        return np.array(self.mask_px) >= MIN_VISIBLE_PX


def gather(made: Finished, names: list[str], config: Config, folder: Path, bar: Any) -> dict[str, VideoEvidence]:
    """Object to what the video shows of it; clouds are kept in ``folder``."""
    logs, frames, camera = load_keypoints(made.run.path), made.frames, made.sequence.camera
    found = {name: VideoEvidence(StoredClouds(folder)) for name in names}
    wanted = evenly(np.arange(len(frames)), KEYFRAMES)
    for k, i in enumerate(frames.tolist()):
        frame, masks = made.frame(i), made.masks(i)
        good = off_edges(frame.depth_m, STEP_M) & in_range(frame.depth_m, config.depth)
        for name, of in found.items():
            mask = masks.get(name, np.zeros(frame.shape, bool))
            vu = evenly(np.argwhere(mask & good), config.refinement.max_points)
            of.clouds.append(camera.unproject(vu[:, ::-1], frame.depth_m[tuple(vu.T)]))
            of.mask_px.append(int(np.count_nonzero(mask)))
            log, at = logs[name], logs[name].at(i)
            p_cam = lift(frame, log.uv_px[at].astype(float), camera, config.depth)
            measured = np.isfinite(p_cam[:, 0])
            of.tracks.append((log.track_id[at][measured], p_cam[measured]))
            if k in wanted and of.shown[-1]:
                of.key.append(k)
                of.views.append(loops.features(frame, mask, camera, config.depth))
        bar.update()
    return found


class VideoPoses:
    """An object's poses by all its tracks and features."""

    def __init__(self, made: Finished, obj: ObjectRun, config: Config, evidence: VideoEvidence):
        self.obj, self.camera, self.config, self.seed = obj, made.sequence.camera, config, made.run.info["seed"]
        self.key, self.views, self.tracks = np.array(evidence.key, int), evidence.views, evidence.tracks

    def tied(self) -> tuple[np.ndarray, list[loops.Tie]]:
        """Poses (n, 4, 4), NaN where nothing tells, keyframes by their strongest ties, and the ties that count."""
        T, key = self.obj.T_cam_obj.copy(), self.key
        if len(key) < 2:
            return T, []
        found = loops.ties(self.views, self.camera, np.random.default_rng(self.seed))
        strong = [tie for tie in found if tie.strength >= _STRONG]
        pairs = [(tie.a, tie.b, tie.T_a_b, tie.strength) for tie in strong]
        pairs += [pair for a in range(len(key) - 1) if (pair := self._tracked(a, a + 1))]
        T_key = loops.along_ties(T[key], pairs)
        T[key] = np.where(np.isfinite(T_key), T_key, T[key])
        return T, strong

    def _tracked(self, a: int, b: int) -> tuple[int, int, np.ndarray, float] | None:
        """The tie of two keyframes by the causal poses, with as much strength as tracks agree; None without poses."""
        T = self.obj.T_cam_obj[self.key[[a, b]]]
        if not np.isfinite(T).all():
            return None
        T_a_b, ((ids_a, p_a), (ids_b, p_b)) = T[0] @ se3.inverse(T[1]), (self.tracks[k] for k in self.key[[a, b]])
        _, of_a, of_b = np.intersect1d(ids_a, ids_b, return_indices=True)
        agree = int(loops.agreeing(T_a_b, p_a[of_a], p_b[of_b]).sum())
        strength = loops.rated(T_a_b, max(agree, 1), self.views[a], self.views[b], self.camera)
        return a, b, T_a_b, max(strength, _LEAST)

    def sightings(self, strong: list[loops.Tie]) -> PointObservations:
        """The sightings of tracks and of features matched by ties; ``pose`` is the frame's row."""
        ids, points = (np.concatenate(part) for part in zip(*self.tracks))
        pose = np.repeat(np.arange(len(self.tracks)), [len(of) for of, _ in self.tracks])
        known, point = np.unique(ids, return_inverse=True)
        if strong:
            start = np.concatenate([[0], np.cumsum([len(view.p_cam) for view in self.views])])
            a = np.concatenate([start[tie.a] + tie.rows_a for tie in strong])
            b = np.concatenate([start[tie.b] + tie.rows_b for tie in strong])
            _, label = connected_components(coo_array((np.ones(len(a)), (a, b)), (start[-1],) * 2), directed=False)
            used = np.unique(np.concatenate([a, b]))
            pose = np.concatenate([pose, self.key[np.searchsorted(start, used, side="right") - 1]])
            point = np.concatenate([point, len(known) + label[used]])
            points = np.concatenate([points, np.concatenate([view.p_cam for view in self.views])[used]])
        z = points[:, 2]
        weights = information(points, z / self.camera.fx, depth_noise_m(z, self.config.depth))
        return PointObservations(pose, point, points, weights)

    def adjusted(self, T: np.ndarray, found: PointObservations) -> tuple[np.ndarray, np.ndarray, PointObservations]:
        """Adjusted poses, points (N, 3) and their sightings, in the order of frames.

        Keyframes and some others are adjusted together; the other frames are located by the points of these.
        """
        posed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
        some = evenly(np.setdiff1d(posed, self.key), TOGETHER - len(self.key))
        together = np.union1d(np.intersect1d(self.key, posed), some)
        seen = found.select(np.isin(found.pose, posed))
        for _ in range(2):  # a pose needs points, and a point needs poses
            count = np.bincount(seen.point[np.isin(seen.pose, together)], minlength=seen.point.max(initial=-1) + 1)
            seen = seen.select(count[seen.point] >= 2)
            together = together[np.isin(together, seen.pose)]
        if len(together) < 2:
            return T, np.zeros((0, 3)), seen.select(np.zeros(len(seen.pose), bool))
        known, point = np.unique(seen.point, return_inverse=True)
        seen = replace(seen, point=point)
        first = seen.select(np.isin(seen.pose, together))
        first = replace(first, pose=np.searchsorted(together, first.pose))
        best, points = adjust(T[together], placed(T[together], first, len(known)), first)
        T, (rest, pose) = T.copy(), np.unique(seen.pose, return_inverse=True)
        T[rest] = locate(T[rest], points, replace(seen, pose=pose))
        T[together] = best
        # Frames without a pose see these points, too: by them the poses of neighbours can be judged there.
        found = found.select(np.isin(found.point, known))
        found = replace(found, point=np.searchsorted(known, found.point))
        return T, points, found.select(np.argsort(found.pose, kind="stable"))
