"""What is known of one object: its keypoint map, surface and graph, the views of its keyframes, and its newest pose."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Generic, Self, TypeVar

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.native import load_mesh_libraries
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import WITH_POSE, Status
from p2p_lib.method.factor_graph import GraphResult, ObjectGraph
from p2p_lib.method.keyframe_views import KeyframeViews
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.observation import Observation, Observer

if TYPE_CHECKING:
    from p2p_lib.method.tsdf import TsdfVolume

NO_IDS = np.zeros(0, np.int64)
#: A frame with a larger move or turn verifies no point (appendix, "Point Promotion Strategy").
_STABLE_M, _STABLE_DEG = 0.01, 2.0
#: A return is marked as recovered for the first number of frames; for the second where few points agree at first.
CONFIRM_FRAMES, CONFIRM_LONGER = 5, 15


@dataclass(frozen=True, eq=False)
class Requests:
    """What an object asks of the shared tracker, applied after the steps of all objects.

    reject  (K,) ids of tracks that contradict the object's motion
    drop    (L,) ids of points that the map has given up
    add_px  (M, 2) pixels of new points in this frame
    keys    (M,) their keys in the map
    """

    reject: np.ndarray = field(default_factory=lambda: NO_IDS)
    drop: np.ndarray = field(default_factory=lambda: NO_IDS)
    add_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    keys: np.ndarray = field(default_factory=lambda: NO_IDS)


class ObjectModel:
    """Keypoints, surface and graph of one object; rows of observations are rows of ``map``.

    Mapping, the graph's solution and the fusion of views, runs in the background by ``executor``; reading
    surface or graph waits for it. :meth:`adopt` waits, too, and takes the solution into the map in the next frame:
    results do not depend on threads or timing.
    """

    make_graph, make_views = ObjectGraph, KeyframeViews

    def __init__(self, config: Config, observer: Observer, stopwatch: Stopwatch, executor: Executor):
        self.config = config
        self.map = KeypointMap(config.keypoint_map)
        self._surface = _volume(config) if config.method.surface else None
        self._graph = self.make_graph(config.factor_graph) if config.method.graph else None
        self.views = self.make_views()
        self.covariance = np.zeros((6, 6))  # of the newest keyframe, by the graph
        self._observer, self._stopwatch, self._executor = observer, stopwatch, executor
        self._mapping: Future | None = None  # the newest background job; each waits for the one before
        self._solved: Future[GraphResult | None] | None = None  # the graph's newest solution, to be adopted
        self._corrected: dict[int, np.ndarray] = {}  # keyframe poses that the surface has yet to follow
        self._since_keyframe, self._next_key = 0, 0

    @property
    def empty(self) -> bool:
        """Whether there has been no keyframe yet."""
        return not len(self.views)

    @property
    def surface(self) -> TsdfVolume | None:
        """The surface, with every view fused; None where the configuration wants none."""
        self._settle()
        return self._surface

    @property
    def graph(self) -> ObjectGraph | None:
        """The graph, with every keyframe solved; None where the configuration wants none."""
        self._settle()
        return self._graph

    def _submit(self, work: Callable[..., object], *args: object) -> Future:
        """Run ``work`` in the background, after all earlier jobs: mapping is sequential."""
        before = self._mapping

        def after() -> object:
            if before is not None:
                before.result()
            return work(*args)

        self._mapping = self._executor.submit(after)
        return self._mapping

    def _settle(self) -> None:
        """Wait for the background jobs."""
        if self._mapping is not None:
            with self._stopwatch("fusion"):
                self._mapping.result()
            self._mapping = None

    def adopt(self) -> np.ndarray | None:
        """Take the graph's new solution into the map; the newest keyframe's T_cam_obj (4, 4), None if there is none."""
        if self._solved is None:
            return None
        with self._stopwatch("graph"):
            result, self._solved = self._solved.result(), None
        if result is None or not result.ok:
            return None
        self.map.move(result.point_ids, result.p_obj)
        if result.covariance is not None:
            self.covariance = result.covariance
        self._corrected = dict(zip(result.keys.tolist(), result.T_cam_obj, strict=True))
        return result.T_cam_obj[-1]

    @property
    def seen_surface(self) -> TsdfVolume | None:
        """The surface, for depth to be compared with; None while nothing of it has been seen."""
        return None if self.surface is None or self.surface.empty else self.surface

    def noise_m(self, p_cam: np.ndarray) -> np.ndarray | None:
        """(N,) standard deviation of measured points by the sensor's model; None where one noise is assumed for all."""
        return self._observer.noise_m(p_cam) if self.config.method.noise == "sensor" else None

    def observe(
        self,
        obs: Observation,
        T_cam_obj: np.ndarray,
        agrees: np.ndarray,
        moved: tuple[float, float] | None,
        in_camera: bool = False,
    ) -> None:
        """Take an accepted frame into the map: count the keypoints that agree (N,), verify the pending ones.

        moved      metres and degrees since the frame before, None after a gap: "Pose Stability" of the appendix
        in_camera  whether points must move with the object: see :meth:`KeypointMap.observe`
        """
        stable = moved is not None and moved[0] < _STABLE_M and moved[1] < _STABLE_DEG
        self.map.count(obs.seen & self.map.promoted, agrees)
        p_obj = se3.transform(se3.inverse(T_cam_obj), obs.p_cam)
        self.map.observe(p_obj, obs.tracks.uncertainty, stable, obs.p_cam if in_camera else None)
        self._since_keyframe += 1

    def keyframe_due(self, obs: Observation, T_cam_obj: np.ndarray, agrees: np.ndarray) -> bool:
        """The appendix's "Sampling Criteria": a new view of the object, or too few points left."""
        cfg = self.config.keypoint_map
        visible = int((obs.seen & (agrees | ~self.map.promoted)).sum())
        starved = visible < cfg.keyframe_min_points and self._since_keyframe > cfg.cooldown
        turned = np.degrees(self.views.turned_rad(T_cam_obj)) > cfg.keyframe_angle_deg
        return obs.mask is not None and bool(turned or starved)

    def insert_keyframe(
        self,
        obs: Observation,
        T_cam_obj: np.ndarray,
        uv_px: np.ndarray,
        p_cam: np.ndarray,
        agrees: np.ndarray,
        covariance: np.ndarray | None = None,
        confidence: float = 1.0,
    ) -> Requests:
        """Add new points to the map, a vertex to the graph, a view to the surface.

        uv_px, p_cam  (M, 2) and (M, 3) of points to be added
        agrees        (N,) bool: points of the map whose observation the pose agrees with
        covariance    (6, 6) of the pose relative to the map; None at the first keyframe
        confidence    of the pose

        Returns what the tracker has to follow and to drop.
        """
        p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
        keys = self._next_key + np.arange(len(p_cam))
        self._next_key += len(p_cam)
        seen = np.concatenate([self.map.keys[agrees], keys]), np.concatenate([obs.p_cam[agrees], p_cam])
        self.map.add(keys, p_obj, self.empty, confidence, p_cam)
        self.views.add(T_cam_obj)
        self._since_keyframe = 0
        gone, drop = self.map.retire()
        self._solved = self._submit(self._map_keyframe, obs, T_cam_obj, *seen, covariance, gone)
        return Requests(drop=drop, add_px=uv_px, keys=keys)

    def _map_keyframe(
        self,
        obs: Observation,
        T_cam_obj: np.ndarray,
        keys: np.ndarray,
        p_cam: np.ndarray,
        covariance: np.ndarray | None,
        gone: np.ndarray,
    ) -> GraphResult | None:
        """Add a vertex, solve the graph, and fuse the keyframe's view at the solved pose.

        keys (N,) and p_cam (N, 3)  the points seen; gone (M,)  keys of points that the map has retired

        Views of keyframes that the graph has merged away cannot be moved any more: their images are let go.
        """
        vertex, result = None, None
        if self._graph is not None:
            sigma_m = self.noise_m(p_cam)
            vertex = self._graph.add_keyframe(
                T_cam_obj,
                keys,
                p_cam,
                p_obj_init=se3.transform(se3.inverse(T_cam_obj), p_cam),
                covariance=None if sigma_m is None else covariance,
                sigma_m=sigma_m,
            )
            result = self._graph.optimise()
            self._graph.forget(gone)
            T_cam_obj = result.T_cam_obj[-1] if result.ok else T_cam_obj
        if self._surface is not None:
            if result is not None:
                self._surface.keep_only(result.keys)
            image = obs.frame.depth_m, obs.frame.rgb, self._observer.measured(obs), self._observer.camera
            self._surface.integrate(*image, T_cam_obj, key=vertex)
        return result

    def settle_surface(self) -> None:
        """Re-integrate the keyframe that the graph has moved farthest: one a frame, so that no frame waits long."""
        if self._surface is not None and self._corrected:
            self._submit(self._follow_graph)

    def _follow_graph(self) -> None:
        if self._surface is not None and not self._surface.move(self._corrected, limit=1):
            self._corrected = {}


@dataclass(frozen=True, eq=False)
class Life:
    """The state of one object between two frames, as a value: each frame makes a new one.

    status      of the newest frame
    T_cam_obj   newest pose, of whatever frame; None before the first
    seen_s      its time
    confirming  frames for which a return is still marked as recovered
    """

    status: Status = Status.INITIALISING
    T_cam_obj: np.ndarray | None = None
    seen_s: float = float("nan")
    confirming: int = 0

    @property
    def has_pose(self) -> bool:
        """Whether the newest frame has a pose."""
        return self.status in WITH_POSE

    @property
    def sought(self) -> bool:
        """Whether it is absent, or back with few points."""
        return not self.has_pose or (self.confirming > 0 and self.status is Status.DEGRADED)

    @property
    def returning(self) -> bool:
        """Whether a pose in the next frame would be marked as recovered."""
        return not self.has_pose or self.confirming > 1

    def with_pose(self, T_cam_obj: np.ndarray, time_s: float, status: Status) -> Life:
        """The state after a frame with a pose."""
        longest = CONFIRM_LONGER if status is Status.DEGRADED else CONFIRM_FRAMES
        left = min(max(self.confirming - 1, 0), longest) if self.has_pose else longest
        return replace(self, status=status, T_cam_obj=T_cam_obj, seen_s=time_s, confirming=left)

    def corrected(self, T_cam_obj: np.ndarray) -> Self:
        """With the newest pose replaced by the graph's, from which the next frame starts."""
        return replace(self, T_cam_obj=T_cam_obj)

    def moved_from_last(self, T_cam_obj: np.ndarray) -> tuple[float, float] | None:
        """Metres and degrees from the pose of the frame before to another (4, 4); None after a gap."""
        if not self.has_pose or self.T_cam_obj is None:
            return None
        moved_m = np.linalg.norm(T_cam_obj[:3, 3] - self.T_cam_obj[:3, 3])
        return float(moved_m), float(np.degrees(se3.angle_rad(se3.inverse(self.T_cam_obj) @ T_cam_obj)))


ModelT = TypeVar("ModelT", bound=ObjectModel, covariant=True)
LifeT = TypeVar("LifeT", bound=Life, covariant=True)


@dataclass(frozen=True, eq=False)
class Known(Generic[ModelT, LifeT]):
    """What is known of an object in one object frame: its model, and its life since that was begun."""

    model: ModelT
    life: LifeT
    map_id: int = 0

    @property
    def map(self) -> KeypointMap:
        """The keypoint map."""
        return self.model.map

    def keypoints(self, obs: Observation) -> np.ndarray:
        """(N,) bool: the promoted points that are seen."""
        return obs.seen & self.map.promoted


def _volume(config: Config) -> TsdfVolume:
    """An empty surface. The mesh libraries take seconds to import: here, not in the middle of tracking."""
    load_mesh_libraries()

    from p2p_lib.method.tsdf import TsdfVolume

    return TsdfVolume(config.tsdf, device=config.device)
