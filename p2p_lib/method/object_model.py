"""What is known of one object: its keypoint map, its surface, its graph, and the views of its keyframes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Status
from p2p_lib.method.factor_graph import GraphResult, ObjectGraph
from p2p_lib.method.keyframe_views import KeyframeViews
from p2p_lib.method.keyframes import misfit
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.lifecycle import Lifecycle
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.recovery.search import SurfaceSample

if TYPE_CHECKING:
    from p2p_lib.method.tsdf import TsdfVolume

NO_IDS = np.zeros(0, np.int64)
#: A frame with a larger move or turn verifies no point (appendix, "Point Promotion Strategy").
_STABLE_M, _STABLE_DEG = 0.01, 2.0
#: No noise explains an observation that is off by more standard deviations, poses a little off included.
_STRAY_SIGMAS = 8.0


@dataclass(frozen=True, eq=False)
class Requests:
    """What an object asks of the tracker that all objects share, applied when every object has been looked at.

    reject  (K,) ids of tracks that contradict the object's motion
    drop    (L,) ids of points that the map has given up
    add_px  (M, 2) pixels of new points in this frame, and keys (M,) of them in the map
    """

    reject: np.ndarray = field(default_factory=lambda: NO_IDS)
    drop: np.ndarray = field(default_factory=lambda: NO_IDS)
    add_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    keys: np.ndarray = field(default_factory=lambda: NO_IDS)


class ObjectModel:
    """Keypoints, surface and graph of one object; rows of observations are rows of ``map``.

    Mapping runs ``beside`` whatever comes next: the graph is solved and views are fused until surface or graph are
    asked for. What the graph finds is taken into the map by :meth:`adopt`, at the start of the next frame, however
    long it took: what comes out is the same whatever the number of threads.
    """

    def __init__(self, config: Config, observer: Observer, stopwatch: Stopwatch, beside: Executor):
        self.config = config
        self.map = KeypointMap(config.keypoint_map)
        self._surface = _volume(config) if config.method.surface else None
        self._graph = ObjectGraph(config.factor_graph) if config.method.graph else None
        self.views = KeyframeViews()
        self.covariance = np.zeros((6, 6))  # of the newest keyframe, by the graph
        self.seen_m2 = 0.0  # the most that a keyframe showed
        self._observer, self._stopwatch, self._beside = observer, stopwatch, beside
        self._mapping: Future | None = None  # the newest of what runs beside, one after the other
        self._solved: Future[GraphResult | None] | None = None  # by the graph, to be adopted
        self._corrected: dict[int, np.ndarray] = {}  # keyframe poses that the surface has yet to follow
        self._since_keyframe, self._next_key = 0, 0
        self._sample: SurfaceSample | None = None  # of the surface as it is

    @property
    def empty(self) -> bool:
        """Whether there has been no keyframe yet."""
        return not len(self.views)

    @property
    def surface(self) -> TsdfVolume | None:
        """With all that was given to it; None where the configuration wants none."""
        self._settle()
        return self._surface

    @property
    def graph(self) -> ObjectGraph | None:
        """With all keyframes; None where the configuration wants none."""
        self._settle()
        return self._graph

    def _beside_after(self, work: Callable[..., object], *args: object) -> Future:
        """Do this beside what comes next, after all that was begun so; mapping is one thing after the other."""
        before = self._mapping

        def after() -> object:
            if before is not None:
                before.result()
            return work(*args)

        self._mapping = self._beside.submit(after)
        return self._mapping

    def _settle(self) -> None:
        """Wait for what runs beside."""
        if self._mapping is not None:
            with self._stopwatch("fusion"):
                self._mapping.result()
            self._mapping = None

    def adopt(self) -> np.ndarray | None:
        """Take into the map what the graph found since the frame before; (4, 4) where it has that frame's pose."""
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
    def has_surface(self) -> bool:
        """Whether depth can be compared with a surface."""
        return self.surface is not None and not self.surface.empty

    @property
    def sample(self) -> SurfaceSample:
        """Points of the surface, for the search by shape and colour."""
        if self._sample is None:
            self._sample = SurfaceSample.of(self.surface.mesh())
        return self._sample

    def noise_m(self, p_cam: np.ndarray) -> np.ndarray | None:
        """(N,) standard deviation of measured points by the sensor's model; None where one noise is assumed for all."""
        return self._observer.noise_m(p_cam) if self.config.method.noise == "sensor" else None

    def join(self, other: ObjectModel, T_obj_other: np.ndarray) -> None:
        """Take in what another model knows of the same object; T_obj_other (4, 4) maps its frame to this one's.

        Its points come behind the map's own.
        """
        self.map.join(other.map, T_obj_other, self._next_key)
        vertices = 0 if self.graph is None else self.graph.next_key
        if self.graph is not None:
            self.graph.join(other.graph, T_obj_other, self._next_key)
        if self.surface is not None:
            self._beside_after(self._surface.join, other.surface, T_obj_other, vertices)
        for T_cam_obj in other.views.T_cam_obj @ se3.inverse(T_obj_other):
            self.views.add(T_cam_obj)
        self.seen_m2 = max(self.seen_m2, other.seen_m2)
        self._next_key += other._next_key
        self._sample = None

    def observe(
        self, obs: Observation, T_cam_obj: np.ndarray, agrees: np.ndarray, moved: tuple[float, float] | None
    ) -> None:
        """Take an accepted frame into the map: count the keypoints that agree (N,), verify the pending ones.

        moved  metres and degrees since the frame before, None after a gap: "Pose Stability" of the appendix
        """
        stable = moved is not None and moved[0] < _STABLE_M and moved[1] < _STABLE_DEG
        self.map.count(obs.seen & self.map.promoted, agrees)
        p_obj = se3.transform(se3.inverse(T_cam_obj), obs.p_cam)
        p_cam = obs.p_cam if self.config.method.motion else None
        self.map.observe(p_obj, obs.tracks.uncertainty, stable, p_cam)
        self._since_keyframe += 1

    def explained(self, obs: Observation, T_cam_obj: np.ndarray) -> np.ndarray:
        """(N,) bool: points of the map that are seen where a pose has them, as far as noise can say.

        Others would bend the graph, whose robust loss never lets go of them: what is mirrored in an object slides over
        it, a little from keyframe to keyframe, and takes poses and keypoints along.
        """
        sigma_m = self._observer.noise_m(obs.p_cam)
        sigma = np.stack([np.full_like(sigma_m, self.config.factor_graph.bearing_sigma_rad), sigma_m], -1)
        return misfit(se3.transform(T_cam_obj, self.map.p_obj), obs.p_cam, sigma) <= _STRAY_SIGMAS

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
        """New points, a vertex of the graph, a view of the surface.

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
        self.seen_m2 = max(self.seen_m2, self._observer.area_m2(obs))
        self._since_keyframe = 0
        self._sample = None
        gone, drop = self.map.retire()
        self._solved = self._beside_after(self._map_keyframe, obs, T_cam_obj, *seen, covariance, gone)
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
        """Solve the graph with a new vertex, and fuse its view where the graph has it.

        keys (N,) and p_cam (N, 3)  what is seen; gone (M,) points that the map has given up since

        Only what the graph still holds can be moved later: images of keyframes that it has merged are let go.
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
            self._beside_after(self._follow_graph)

    def _follow_graph(self) -> None:
        if not self._surface.move(self._corrected, limit=1):
            self._corrected = {}


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of an object in one object frame: a model, and what it has been through since that was begun."""

    model: ObjectModel
    life: Lifecycle = field(default_factory=Lifecycle)
    map_id: int = 0

    @property
    def map(self) -> KeypointMap:
        """The keypoint map."""
        return self.model.map

    def keypoints(self, obs: Observation) -> np.ndarray:
        """(N,) bool: the promoted points that are seen."""
        return obs.seen & self.map.promoted

    def carried(self, time_s: float) -> bool:
        """Whether its motion so far still says where the object is at this time."""
        life = self.life
        return self.model.config.method.motion and life.motion is not None and life.motion.holds(time_s)

    @property
    def first_view_alone(self) -> bool:
        """Whether it is known from the view that it began with, and never was sure of another pose."""
        return self.life.motion is None and len(self.model.views) == 1

    def lost(self) -> Known:
        """The same after a frame in which the object was not found by it."""
        return replace(self, life=self.life.without_pose(Status.LOST))


def _volume(config: Config) -> TsdfVolume:
    """An empty surface. What makes meshes takes seconds to import: when there is to be one, not at an absence."""
    import skimage.measure  # noqa: F401
    import trimesh  # noqa: F401

    from p2p_lib.method.tsdf import TsdfVolume

    return TsdfVolume(config.tsdf, device=config.device)
