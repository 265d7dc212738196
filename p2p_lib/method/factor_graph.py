"""The keyframe graph of one object (paper: section "Graph Optimization" and its appendix).

Variables are the inverse keyframe poses X_m = T_obj_cam and the keypoints p_n in the object frame:
the object stands still and a virtual camera moves around it. Three losses tie them: a prior that
anchors the first keyframe, relative poses from registration, and bearing and range of each keypoint
seen. GTSAM's own factors and its Levenberg-Marquardt solve it; this is the one file that knows GTSAM.

State is kept as plain arrays, so that a solve that fails leaves nothing behind.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig
from p2p_lib.core.errors import BadInput

# gtsam's keys: a letter in the highest byte.
_X, _P = ord("x") << 56, ord("p") << 56
# A keyframe without a relative pose must share this many points with earlier ones.
_ANCHORING_POINTS = 3
# Noise of the prior on the first pose (rad, m): it defines the object frame, so there is next to none.
_PRIOR_SIGMA = 1e-4
# Levenberg-Marquardt's first lambda. (The release starts at 0.1 and makes more steps, to the same minimum.)
_LAMBDA = 1e-4
# A smaller relative decrease of the loss ends Levenberg-Marquardt.
_RELATIVE_TOLERANCE = 1e-3
# A variance above this means that nothing determines the direction: a turn, or ten metres.
_UNDETERMINED = np.repeat([(2 * np.pi) ** 2, 10.0**2], 3)


@dataclass(frozen=True, eq=False)
class Link:
    """A relative pose from registration (paper: X~ of L_reg).

    previous         key of the keyframe it starts from
    T_previous_this  (4, 4) X_previous^-1 X_this
    covariance       (6, 6), right tangent of X_this
    """

    previous: int
    T_previous_this: np.ndarray
    covariance: np.ndarray


@dataclass(eq=False)
class Keyframe:
    """One keyframe: X_m = T_obj_cam (4, 4) and the observations p_cam (N, 3) of the points ``ids`` (N,).

    sigma    (N, 2) noise of bearing (rad) and range (m)
    link     to the keyframe before; None for the first
    factors  the observations in the solver's own form, made once; None when they have changed
    """

    T_obj_cam: np.ndarray
    ids: np.ndarray
    p_cam: np.ndarray
    sigma: np.ndarray
    link: Link | None
    factors: Any = None

    def replace_observations(self, ids: np.ndarray, p_cam: np.ndarray, sigma: np.ndarray) -> None:
        """Other observations instead of those there were."""
        self.ids, self.p_cam, self.sigma, self.factors = ids, p_cam, sigma, None


#: Of a solve: the newest keyframe's covariance (6, 6), and the loss before and after.
_Fit = tuple[np.ndarray | None, float, float]


@dataclass(frozen=True, eq=False)
class GraphResult:
    """What the graph knows after a solve; after a failed one, what it knew before.

    ok, reason             whether the newest keyframe was solved for; why not, or why without covariance
    keys (M,)              as returned by ``add_keyframe``
    T_cam_obj (M, 4, 4)    poses of those keyframes
    point_ids (N,), p_obj (N, 3)  keypoints, sorted by id
    covariance             (6, 6) of the newest keyframe, right tangent of T_cam_obj in the object
                           frame, rotation first; None where the graph does not determine it
    error_before, error_after  value of the loss
    """

    ok: bool
    reason: str
    keys: np.ndarray
    T_cam_obj: np.ndarray
    point_ids: np.ndarray
    p_obj: np.ndarray
    covariance: np.ndarray | None
    error_before: float
    error_after: float


class ObjectGraph:
    """Keyframes and keypoints of one object; ``add_keyframe``, then ``optimise``."""

    def __init__(self, config: FactorGraphConfig):
        self.config = config
        self._keyframes: dict[int, Keyframe] = {}
        self._points: dict[int, np.ndarray] = {}
        self._new: list[int] = []  # added since the last solve
        self.next_key = 0  # of the keyframe to be added next
        self._fit: _Fit = None, 0.0, 0.0
        self._anchor = se3.IDENTITY
        importlib.import_module("gtsam")  # takes a second that no frame should wait for

    @property
    def keys(self) -> tuple[int, ...]:
        """The keyframes that are held, oldest first."""
        return tuple(sorted(self._keyframes))

    def add_keyframe(
        self,
        T_cam_obj: np.ndarray,
        point_ids: np.ndarray,
        p_cam: np.ndarray,
        *,
        p_obj_init: np.ndarray,
        covariance: np.ndarray | None = None,
        sigma_rad: np.ndarray | float | None = None,
        sigma_m: np.ndarray | float | None = None,
    ) -> int:
        """A new keyframe, to be solved for by the next ``optimise``; returns its key.

        T_cam_obj     (4, 4) from registration. The first keyframe's is where the prior anchors the graph
        point_ids     (N,) distinct; p_cam (N, 3) their observations. Rows that are not finite are left out
        p_obj_init    (N, 3) where points that the graph does not know yet start from
        covariance    (6, 6) of the pose relative to the keyframe before, right tangent of T_cam_obj, by other
                      evidence than these observations (the surface): what is counted twice makes the result too
                      certain, slightly so where keypoints helped to refine. None: the configured noise, about the
                      points' centre
        sigma_rad, sigma_m  noise of bearings and ranges, (N,) or one for all; configured values where None
        """
        T_obj_cam = se3.inverse(se3.check("keyframe T_cam_obj", T_cam_obj))
        ids = np.asarray(point_ids, np.int64).reshape(-1)
        p_cam, start = np.asarray(p_cam, float).reshape(-1, 3), np.asarray(p_obj_init, float).reshape(-1, 3)
        if not len(ids) == len(p_cam) == len(start) == len(np.unique(ids)):
            got = f"{len(np.unique(ids))} distinct of {len(ids)} ids, {len(p_cam)} p_cam, {len(start)} p_obj_init"
            raise BadInput("keyframe points", got, "distinct ids and a row for each")
        sigma_rad = self.config.bearing_sigma_rad if sigma_rad is None else sigma_rad
        sigma_m = self.config.range_sigma_m if sigma_m is None else sigma_m
        sigma = np.stack([np.broadcast_to(s, ids.shape) for s in (sigma_rad, sigma_m)], -1)
        usable = np.isfinite(p_cam).all(1) & np.isfinite(start).all(1) & (np.linalg.norm(p_cam, axis=1) > 1e-6)
        usable &= (np.isfinite(sigma) & (sigma > 0)).all(1)
        key, link = self.next_key, None
        if self._keyframes:
            link = self._link(T_obj_cam, start[usable], covariance)
        else:
            self._anchor = T_obj_cam
        self._keyframes[key] = Keyframe(T_obj_cam, ids[usable], p_cam[usable], sigma[usable], link)
        for i, p in zip(ids[usable].tolist(), start[usable], strict=True):
            self._points.setdefault(i, p)
        self._new.append(key)
        self.next_key += 1
        return key

    def forget(self, point_ids: np.ndarray) -> None:
        """Takes points and all their observations out of the graph (a keypoint that the map retired)."""
        gone = np.asarray(point_ids, np.int64)
        for keyframe in self._keyframes.values():
            stays = ~np.isin(keyframe.ids, gone)
            if not stays.all():
                keyframe.replace_observations(keyframe.ids[stays], keyframe.p_cam[stays], keyframe.sigma[stays])
        for i in gone.tolist():
            self._points.pop(i, None)

    def optimise(self) -> GraphResult:
        """Solves for all keyframes and keypoints. Never raises for what the data cannot determine: see ``ok``."""
        reason = self._why_not()
        if not reason:
            try:
                poses, points, fit = _solve(self._keyframes, self._points, self._anchor, self.config)
            except (RuntimeError, ValueError) as error:  # gtsam's, for an indeterminate system or impossible noise
                reason = "gtsam: " + str(error).strip().splitlines()[0]
        if reason:
            left_out = ", ".join(map(str, self._new))
            for key in self._new:
                del self._keyframes[key]
            self._new = []
            seen = {i for keyframe in self._keyframes.values() for i in keyframe.ids.tolist()}
            self._points = {i: p for i, p in self._points.items() if i in seen}
            return self._result(False, f"keyframe {left_out} left out: {reason}" if left_out else reason)
        for key, T_obj_cam in poses.items():
            self._keyframes[key].T_obj_cam = T_obj_cam
        self._points |= points
        self._new, self._fit = [], fit
        return self._result(True, "no covariance: nothing anchors the graph" if fit[0] is None else "")

    def _link(self, T_obj_cam: np.ndarray, p_obj: np.ndarray, covariance: np.ndarray | None) -> Link:
        """The relative pose to the newest keyframe, its covariance moved from T_cam_obj's right tangent to X's."""
        if not _is_covariance(covariance):
            sigmas = np.repeat([self.config.between_sigma_rad, self.config.between_sigma_m], 3)
            covariance = about(p_obj, sigmas)
        previous = self._newest()
        relative = se3.inverse(self._keyframes[previous].T_obj_cam) @ T_obj_cam
        A = se3.adjoint(se3.inverse(T_obj_cam))
        return Link(previous, relative, A @ covariance @ A.T)

    def _newest(self) -> int:
        """The keyframe that a new one is tied to."""
        return max(self._keyframes)

    def _why_not(self) -> str:
        """Why the graph cannot be solved, as far as its structure tells; empty if it may be."""
        if not self._keyframes:
            return "no keyframes"
        first = min(self._keyframes)
        for key in self._new:
            keyframe = self._keyframes[key]
            if key == first or (self.config.between and keyframe.link):
                continue
            earlier = np.concatenate([k.ids for other, k in self._keyframes.items() if other < key])
            shared = int(np.isin(keyframe.ids, earlier).sum()) if self.config.observations else 0
            if shared < _ANCHORING_POINTS:
                return f"{shared} points shared with earlier keyframes and no relative pose"
        return ""

    def _result(self, ok: bool, reason: str) -> GraphResult:
        keys = np.array(sorted(self._keyframes), np.int64)
        ids = np.array(sorted(self._points), np.int64)
        poses = [self._keyframes[k].T_obj_cam for k in keys.tolist()]
        p_obj = np.array([self._points[i] for i in ids.tolist()]).reshape(-1, 3)
        T_cam_obj = se3.inverse(np.array(poses).reshape(-1, 4, 4))
        return GraphResult(ok, reason, keys, T_cam_obj, ids, p_obj, *self._fit)


def about(p_obj: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """(6, 6) covariance of a motion with sigmas (6,), rotation first, about the mean of points p_obj (N, 3)."""
    A = se3.adjoint(se3.from_rt(np.eye(3), p_obj.mean(0) if len(p_obj) else np.zeros(3)))
    return A @ np.diag(sigmas**2) @ A.T


def _is_covariance(covariance: np.ndarray | None) -> bool:
    return covariance is not None and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance).min() > 0


def _solve(
    keyframes: dict[int, Keyframe], points: dict[int, np.ndarray], anchor: np.ndarray, config: FactorGraphConfig
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], _Fit]:
    """Levenberg-Marquardt over all variables (paper: "Solving the Optimization"): T_obj_cam and points by key."""
    import gtsam

    first, newest = min(keyframes), max(keyframes)
    graph, values, ordering = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    if config.prior:
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.full(6, _PRIOR_SIGMA))
        graph.add(gtsam.PriorFactorPose3(_X + first, gtsam.Pose3(anchor), noise))
    # Keypoints first: each is eliminated on its own, which leaves a small system of poses.
    for i in sorted(points) if config.observations else ():
        values.insert(_P + i, points[i])
        ordering.push_back(_P + i)
    for key in sorted(keyframes):
        keyframe = keyframes[key]
        values.insert(_X + key, gtsam.Pose3(keyframe.T_obj_cam))
        ordering.push_back(_X + key)
        if config.between and keyframe.link:
            graph.add(_between(key, keyframe.link, config))
        if config.observations:
            if keyframe.factors is None:
                keyframe.factors = _observations(key, keyframe, config)
            graph.push_back(keyframe.factors)
    params = gtsam.LevenbergMarquardtParams()
    params.setlambdaInitial(_LAMBDA)
    params.setMaxIterations(config.iterations)
    params.setRelativeErrorTol(_RELATIVE_TOLERANCE)
    params.setOrdering(ordering)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    error_before, solved = optimiser.error(), optimiser.optimize()
    poses = {key: solved.atPose3(_X + key).matrix() for key in keyframes}
    places = {i: solved.atPoint3(_P + i) for i in points} if config.observations else {}
    return poses, places, (_covariance(graph, solved, ordering, newest), error_before, optimiser.error())


def _robust(gaussian: Any, config: FactorGraphConfig) -> Any:
    import gtsam

    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(config.huber), gaussian)


def _between(key: int, link: Link, config: FactorGraphConfig) -> Any:
    """L_reg of one keyframe."""
    import gtsam

    noise = _robust(gtsam.noiseModel.Gaussian.Covariance(link.covariance), config)
    return gtsam.BetweenFactorPose3(_X + link.previous, _X + key, gtsam.Pose3(link.T_previous_this), noise)


def _observations(key: int, keyframe: Keyframe, config: FactorGraphConfig) -> Any:
    """L_obs of one keyframe: bearing (2) and range (1) of each point, in this order."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    range_m = np.linalg.norm(keyframe.p_cam, axis=1)
    rows = zip(keyframe.ids.tolist(), keyframe.p_cam, range_m.tolist(), keyframe.sigma.tolist(), strict=True)
    for i, p_cam, distance, (sigma_rad, sigma_m) in rows:
        noise = _robust(gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_rad, sigma_rad, sigma_m])), config)
        graph.add(gtsam.BearingRangeFactor3D(_X + key, _P + i, gtsam.Unit3(p_cam), distance, noise))
    return graph


def _covariance(graph: Any, solved: Any, ordering: Any, newest: int) -> np.ndarray | None:
    """The newest keyframe's marginal covariance, from X's right tangent to that of T_cam_obj; None: nothing anchors it.

    T_cam_obj exp(eta) is the inverse of X exp(xi) for eta = -Ad_X xi.
    """
    try:
        marginal = graph.linearize(solved).eliminateMultifrontal(ordering).marginalCovariance(_X + newest)
    except (RuntimeError, ValueError):
        return None
    A = se3.adjoint(solved.atPose3(_X + newest).matrix())
    covariance = A @ marginal @ A.T
    if not np.isfinite(covariance).all() or (np.diag(covariance) > _UNDETERMINED).any():
        return None
    return (covariance + covariance.T) / 2
