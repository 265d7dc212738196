"""What is known of one object: its keypoint map, its surface, its graph, and the views of its keyframes."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Status
from p2p_lib.method.factor_graph import ObjectGraph
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


@dataclass(frozen=True, eq=False)
class NewPoints:
    """Points to be added at a keyframe: uv_px (M, 2) and p_cam (M, 3)."""

    uv_px: np.ndarray
    p_cam: np.ndarray

    def __len__(self) -> int:
        return len(self.uv_px)


class ObjectModel:
    """Keypoints, surface and graph of one object; rows of observations are rows of ``map``.

    Views are fused ``beside`` whatever comes next, until the surface is asked for.
    """

    def __init__(self, config: Config, observer: Observer, stopwatch: Stopwatch, beside: Executor):
        self.config = config
        self.map = KeypointMap(config.keypoint_map)
        self._surface = _volume(config) if config.method.surface else None
        self.graph = ObjectGraph(config.factor_graph) if config.method.graph else None
        self.views = KeyframeViews()
        self.covariance = np.zeros((6, 6))  # of the newest keyframe, by the graph
        self.seen_m2 = 0.0  # the most that a keyframe showed
        self._observer, self._stopwatch, self._beside = observer, stopwatch, beside
        self._fusing: Future | None = None
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
        if self._fusing is not None:
            with self._stopwatch("fusion"):
                self._fusing.result()
            self._fusing = None
        return self._surface

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
            self._fusing = self._beside.submit(self.surface.join, other.surface, T_obj_other, vertices)
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
        new: NewPoints,
        agrees: np.ndarray,
        covariance: np.ndarray | None = None,
        confidence: float = 1.0,
    ) -> tuple[np.ndarray, Requests]:
        """New points, a vertex of the graph, a view of the surface.

        agrees      (N,) bool: points of the map whose observation the pose agrees with
        covariance  (6, 6) of the pose relative to the map; None at the first keyframe
        confidence  of the pose

        Returns the pose as the graph corrects it, and what the tracker has to follow and to drop.
        """
        p_obj = se3.transform(se3.inverse(T_cam_obj), new.p_cam)
        old_keys = self.map.keys[agrees]
        keys = self._next_key + np.arange(len(new))
        self._next_key += len(new)
        self.map.add(keys, p_obj, self.empty, confidence, new.p_cam)
        vertex, registered = None, T_cam_obj
        if self.graph is not None:
            with self._stopwatch("graph"):
                p_cam = np.concatenate([obs.p_cam[agrees], new.p_cam])
                vertex, T_cam_obj = self._optimise(T_cam_obj, np.concatenate([old_keys, keys]), p_cam, covariance)
        self.views.add(registered)
        self.seen_m2 = max(self.seen_m2, self._observer.area_m2(obs))
        self._since_keyframe = 0
        self._sample = None
        if self.surface is not None:
            image = obs.frame.depth_m, obs.frame.rgb, self._observer.measured(obs), self._observer.camera
            self._fusing = self._beside.submit(self.surface.integrate, *image, T_cam_obj, key=vertex)
        gone, drop = self.map.retire()
        if self.graph is not None:
            self.graph.forget(gone)
        return T_cam_obj, Requests(drop=drop, add_px=new.uv_px, keys=keys)

    def settle_surface(self) -> None:
        """Re-integrate the keyframe that the graph has moved farthest: one a frame, so that no frame waits long."""
        if self.surface is not None and self._corrected:
            self._fusing = self._beside.submit(self._follow_graph, self.surface, self._corrected)

    def _follow_graph(self, surface: TsdfVolume, corrected: dict[int, np.ndarray]) -> None:
        if not surface.move(corrected, limit=1):
            self._corrected = {}

    def _optimise(
        self, T_cam_obj: np.ndarray, keys: np.ndarray, p_cam: np.ndarray, covariance: np.ndarray | None
    ) -> tuple[int, np.ndarray]:
        """Add a vertex to the graph, solve, and carry the result into map and surface; its key and its pose.

        Only what the graph still holds can be moved later: images of keyframes that it has merged are let go.
        """
        sigma_m = self.noise_m(p_cam)
        vertex = self.graph.add_keyframe(
            T_cam_obj,
            keys,
            p_cam,
            p_obj_init=se3.transform(se3.inverse(T_cam_obj), p_cam),
            covariance=None if sigma_m is None else covariance,
            sigma_m=sigma_m,
        )
        result = self.graph.optimise()
        if self.surface is not None:
            self.surface.keep_only(result.keys)
        if not result.ok:
            return vertex, T_cam_obj
        self.map.move(result.point_ids, result.p_obj)
        if result.covariance is not None:
            self.covariance = result.covariance
        self._corrected = dict(zip(result.keys.tolist(), result.T_cam_obj, strict=True))
        return vertex, result.T_cam_obj[-1]


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

    def lost(self) -> Known:
        """The same after a frame in which the object was not found by it."""
        return replace(self, life=self.life.without_pose(Status.LOST))


def _volume(config: Config) -> TsdfVolume:
    """An empty surface. What makes meshes takes seconds to import: when there is to be one, not at an absence."""
    import skimage.measure  # noqa: F401
    import trimesh  # noqa: F401

    from p2p_lib.method.tsdf import TsdfVolume

    return TsdfVolume(config.tsdf, device=config.device)
