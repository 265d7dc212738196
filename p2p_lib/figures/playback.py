"""A run as a viewer wants it: everything on disk, put together frame by frame, with the sequence where it is there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from p2p_lib.core import se3
from p2p_lib.core.errors import MissingData, P2PError
from p2p_lib.core.raycasting import ray_scene
from p2p_lib.core.types import Frame, Status
from p2p_lib.datasets.keypoint_log import ObjectKeypoints, load_keypoints
from p2p_lib.datasets.models import read_mesh
from p2p_lib.datasets.runs import ObjectRun, Run, load_run
from p2p_lib.datasets.sequence import LIVE, Sequence, reopen, reopen_if_there
from p2p_lib.evaluation.evidence import drawn_m
from p2p_lib.evaluation.protocol import Evaluation, evaluate
from p2p_lib.extended.depth_lag import as_the_run_took
from p2p_lib.figures import style

if TYPE_CHECKING:
    import trimesh

#: Farther points are walls, which nobody needs to see; those so near to a surface that is drawn would cover it.
CLOUD_MAX_M, COVERING_M = 2.5, 0.015
_SAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class Playback:
    """One run over its frames; rows i are those of the run, whatever frame of the sequence they are.

    run       as :func:`load_run` gives it, in one map of each object; ``objects`` have the poses of all maps
    sequence  None where its folder is gone: then there are no images, points and masks
    """

    run: Run
    sequence: Sequence | None
    keypoints: dict[str, ObjectKeypoints]

    @classmethod
    def of(cls, run: Run | str | Path, sequence: Sequence | None = None) -> Playback:
        """Of a run's folder; the sequence is opened as the run says unless it is given."""
        run = run if isinstance(run, Run) else load_run(run)
        if sequence is None:
            sequence, _ = reopen_if_there(run.info)  # why there are none is said where they are needed
        return cls(run, sequence, load_keypoints(run.path))

    @property
    def images(self) -> Sequence:
        """The sequence; :class:`MissingData` where it is gone."""
        if self.sequence is None:
            if self.run.info["format"] == LIVE:
                reopen(self.run.info)  # says why there are none
            where = self.run.info["path"] or self.run.info["sequence"]
            raise MissingData(str(where), "no such folder, so there are no images to draw on", "Put it back there.")
        return self.sequence

    def __len__(self) -> int:
        return len(self.frame_index)

    @cached_property
    def objects(self) -> dict[str, ObjectRun]:
        """What is drawn: poses as they were said, in maps that were given up since as well."""
        objects = load_run(self.run.path, every_map=True).objects
        return {name: obj.in_joined_maps() for name, obj in objects.items()}

    def of_kept_map(self, name: str) -> np.ndarray:
        """(n,) bool: rows whose pose is in the frame of the surface and the keypoints in the folder."""
        return self.objects[name].map_id == self.objects[name].kept_map

    @cached_property
    def frame_index(self) -> np.ndarray:
        """(n,) frames of the sequence."""
        return next(iter(self.run.objects.values())).frame_index

    @cached_property
    def times_s(self) -> np.ndarray:
        """(n,) seconds since the first of them."""
        times_s = next(iter(self.run.objects.values())).time_s
        return times_s - times_s[0]

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return float((len(self) - 1) / self.times_s[-1]) if len(self) > 1 else 30.0

    @cached_property
    def colours(self) -> dict[str, str]:
        """Object to ``#RRGGBB``."""
        return style.object_colours(self.run.objects)

    @cached_property
    def meshes(self) -> dict[str, trimesh.Trimesh]:
        """Object to its reconstructed surface, in its frame; those that have one."""
        files = {name: self.run.path / "meshes" / f"{name}.ply" for name in self.run.objects}
        return {name: read_mesh(path) for name, path in files.items() if path.is_file()}

    @cached_property
    def evaluation(self) -> Evaluation | None:
        """Its score, where there is truth to score it by."""
        try:
            return evaluate(self.run)
        except P2PError:
            return None

    def path(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(k, 3) positions of the object at rows with a pose, and (k, 3) uint8 colours of its status then."""
        obj = self.objects[name]
        has = obj.has_pose
        fills = [style.rgb(style.STATUS[Status(status)][0]) for status in obj.status[has]]
        return obj.T_cam_obj[has, :3, 3], np.array(fills, np.uint8).reshape(-1, 3)

    def keyframes(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Rows (K,) that added a keyframe to the map that is kept, and its T_obj_cam (K, 4, 4) as estimated then."""
        obj = self.objects[name]
        rows = np.flatnonzero(obj.keyframe & obj.has_pose & self.of_kept_map(name))
        return rows, se3.inverse(obj.T_cam_obj[rows])

    def frame(self, i: int) -> Frame | None:
        """The image of row i, where it can still be had."""
        if self.sequence is None:
            return None
        return as_the_run_took(self.sequence, int(self.frame_index[i]), self.run.doubts)

    def cloud(self, i: int, frame: Frame, points: int) -> tuple[np.ndarray, np.ndarray]:
        """About so many points (M, 3) of the frame of row i in camera coordinates, on a grid, and their colours (M, 3).

        Those on a surface that stands there are left out.
        """
        h, w = frame.shape
        step = max(1, round(np.sqrt(h * w / points)))
        v, u = (a.ravel() for a in np.mgrid[step // 2 : h : step, step // 2 : w : step])
        near = (frame.depth_m[v, u] > 0) & (frame.depth_m[v, u] < CLOUD_MAX_M)
        u, v = u[near], v[near]
        p_cam = self.images.camera.unproject(np.stack([u, v], -1), frame.depth_m[v, u])
        for name, tree in self._surfaces.items():
            obj = self.objects[name]
            if obj.has_pose[i] and self.of_kept_map(name)[i]:
                p_obj = se3.transform(se3.inverse(obj.T_cam_obj[i]), p_cam)
                bare = tree.query(p_obj, distance_upper_bound=COVERING_M)[0] >= COVERING_M
                p_cam, u, v = p_cam[bare], u[bare], v[bare]
        return p_cam, frame.rgb[v, u]

    @cached_property
    def _surfaces(self) -> dict[str, cKDTree]:
        """Points all over each surface."""
        from trimesh.sample import sample_surface

        return {name: cKDTree(sample_surface(mesh, _SAMPLES, seed=0)[0]) for name, mesh in self.meshes.items()}

    def silhouettes(self, i: int) -> dict[str, np.ndarray]:
        """Where (H, W) bool each reconstructed surface is in the image at its pose of row i, whatever hides it."""
        posed = [name for name in self.meshes if self.objects[name].has_pose[i] and self.of_kept_map(name)[i]]
        poses = {name: self.objects[name].T_cam_obj[i] for name in posed}
        return {name: drawn_m(self._ray_scenes[name], self.images.camera, T) > 0 for name, T in poses.items()}

    @cached_property
    def _ray_scenes(self) -> dict[str, Any]:
        return {name: ray_scene(mesh.vertices, mesh.faces) for name, mesh in self.meshes.items()}

    def masks(self, i: int) -> dict[str, np.ndarray]:
        """The masks (H, W) bool of row i, as the run gives them; none without a sequence."""
        return {} if self.sequence is None else self.run.masks(self.sequence, int(self.frame_index[i]))
