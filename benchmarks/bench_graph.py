"""Cost and worth of the keyframe graph, beside the full batch Levenberg-Marquardt and GTSAM's incremental smoothers.

An object turns on the spot, ten degrees a keyframe, 45 of its 300 points seen in each; every new keyframe is
registered to the map as it stands and the graph solved, covariance included. All ways take each keyframe in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from common import Section, Times, compared
from matplotlib.figure import Figure
from pandas import DataFrame

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig, preset
from p2p_lib.core.robust import fit_rigid
from p2p_lib.figures import style
from p2p_lib.figures.plots import WIDTH_IN, logarithmic, panels
from p2p_lib.method.factor_graph import ObjectGraph

PEER = "batch: whole graph, 20 steps"
#: Numbers of keyframes at which they are compared, each over the last ten.
SIZES, LAST = (10, 25, 50, 100), 10
SEEDS = (0, 1)
SIGMA_RAD, SIGMA_M = 0.0015, 0.003


@dataclass
class World:
    """True points p_obj (N, 3); of each keyframe its true T_cam_obj, the ids of what it saw, and where (M, 3)."""

    p_obj: np.ndarray
    keyframes: list[tuple[np.ndarray, np.ndarray, np.ndarray]]


def turntable(keyframes: int, seed: int, points: int = 300, per_view: int = 45) -> World:
    """Bearings and ranges with the noise that the default configuration assumes."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(points, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    world = World(normal * [0.05, 0.08, 0.05] * rng.uniform(0.85, 1, (points, 1)), [])
    for m in range(keyframes):
        tilt, turn = 0.35 * np.sin(0.15 * m), np.radians(10) * m
        T = se3.exp(np.array([tilt, 0, 0, 0, 0, 0])) @ se3.exp(np.array([0, turn, 0, 0, 0, 0]))
        T[:3, 3] = [0.03 * np.sin(0.2 * m), 0, 0.6]
        p_cam = se3.transform(T, world.p_obj)
        range_m = np.linalg.norm(p_cam, axis=1, keepdims=True)
        facing = np.flatnonzero(-np.sum(normal @ T[:3, :3].T * p_cam / range_m, 1) > 0.4)
        ids = np.sort(rng.permutation(facing)[:per_view])
        bearing = p_cam[ids] / range_m[ids] + SIGMA_RAD * rng.normal(size=(len(ids), 3))
        bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
        world.keyframes.append((T, ids, bearing * (range_m[ids] + SIGMA_M * rng.normal(size=(len(ids), 1)))))
    return world


class Ours:
    """The project's graph."""

    def __init__(self, config: FactorGraphConfig):
        self.graph = ObjectGraph(config)

    def add(self, T_cam_obj: np.ndarray, ids: np.ndarray, p_cam: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray]:
        """Known points, newest pose, its covariance."""
        self.graph.add_keyframe(T_cam_obj, ids, p_cam, p_obj_init=se3.transform(se3.inverse(T_cam_obj), p_cam))
        result = self.graph.optimise()
        if not result.ok:
            raise SystemExit(result.reason)
        points = dict(zip(result.point_ids.tolist(), result.p_obj, strict=True))
        return points, result.T_cam_obj[-1], result.covariance


class Smoother:
    """ISAM2, or with a lag IncrementalFixedLagSmoother; the same factors, without relative poses.

    A point that comes back after the lag starts anew, held near its old place.
    """

    def __init__(self, config: FactorGraphConfig, lag: int = 0):
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(1e-3)
        params.relinearizeSkip = 1
        self.lag, self.keyframes = lag, 0
        self.solver = gtsam.IncrementalFixedLagSmoother(float(lag), params) if lag else gtsam.ISAM2(params)
        huber = gtsam.noiseModel.mEstimator.Huber.Create(config.huber)
        sigmas = np.array([config.bearing_sigma_rad, config.bearing_sigma_rad, config.range_sigma_m])
        self.noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
        self.last_seen, self.points = {}, {}

    def add(self, T_cam_obj: np.ndarray, ids: np.ndarray, p_cam: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray]:
        """Known points, newest pose, its covariance."""
        m, key = self.keyframes, gtsam.symbol("x", self.keyframes)
        X, graph, values, stamps = se3.inverse(T_cam_obj), gtsam.NonlinearFactorGraph(), gtsam.Values(), {key: float(m)}
        values.insert(key, gtsam.Pose3(X))
        if m == 0:
            graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(X), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
        for i, z in zip(ids.tolist(), p_cam, strict=True):
            point = gtsam.symbol("p", i)
            stamps[point] = float(m)
            if i not in self.last_seen or (self.lag and self.last_seen[i] < m - self.lag):
                start = self.points.get(i, se3.transform(X, z[None])[0])
                values.insert(point, start)
                if i in self.points:
                    graph.add(gtsam.PriorFactorPoint3(point, start, gtsam.noiseModel.Isotropic.Sigma(3, 0.003)))
            self.last_seen[i] = m
            graph.add(gtsam.BearingRangeFactor3D(key, point, gtsam.Unit3(z), float(np.linalg.norm(z)), self.noise))
        self.solver.update(graph, values, *([stamps] if self.lag else []))
        solved = self.solver.calculateEstimate()
        inside = [i for i in self.last_seen if solved.exists(gtsam.symbol("p", i))]
        self.points |= {i: solved.atPoint3(gtsam.symbol("p", i)) for i in inside}
        self.keyframes += 1
        X = solved.atPose3(key).matrix()
        A = se3.adjoint(X)
        covariance = None if self.lag else A @ self.solver.marginalCovariance(key) @ A.T
        return dict(self.points), se3.inverse(X), covariance


_DEFAULT, _PAPER = preset("default").factor_graph, preset("paper").factor_graph
_PHYSICAL = replace(_PAPER, bearing_sigma_rad=SIGMA_RAD, range_sigma_m=SIGMA_M)
#: Each keeps the graph solved in its way.
WAYS: dict[str, Callable[[], Ours | Smoother]] = {
    PEER: lambda: Ours(_PAPER),
    "the same, physical noise": lambda: Ours(_PHYSICAL),
    "whole graph, 5 warm steps": lambda: Ours(replace(_DEFAULT, max_keyframes=0)),
    f"ours: merged to {_DEFAULT.max_keyframes} keyframes": lambda: Ours(_DEFAULT),
    "merged to 20 keyframes": lambda: Ours(replace(_DEFAULT, max_keyframes=20)),
    "merged to 60 keyframes": lambda: Ours(replace(_DEFAULT, max_keyframes=60)),
    "ISAM2": lambda: Smoother(_DEFAULT),
    "fixed lag of 15": lambda: Smoother(_DEFAULT, 15),
    "fixed lag of 40": lambda: Smoother(_DEFAULT, 40),
}


@dataclass
class Course:
    """One way to keep the graph solved, in one world: known points, newest pose T_cam_obj and its covariance."""

    graph: Ours | Smoother
    known: dict[int, np.ndarray] = field(default_factory=dict)
    T_last: np.ndarray | None = None
    covariance: np.ndarray | None = None

    def add(self, keyframe: tuple[np.ndarray, np.ndarray, np.ndarray], spent: Times) -> None:
        """A keyframe (truth, ids, p_cam), registered to what is known; the first one where it truly is."""
        T, ids, p_cam = keyframe
        if self.known:
            shared = [k for k, i in enumerate(ids.tolist()) if i in self.known]
            T = fit_rigid(np.array([self.known[ids[k]] for k in shared]), p_cam[shared])
        self.known, self.T_last, self.covariance = spent.run(lambda: self.graph.add(T, ids, p_cam))

    def errors(self, world: World) -> tuple[float, float]:
        """Root mean square error of the map in mm after alignment; normalised squared error of the pose over six."""
        rows = np.array(sorted(self.known))
        estimate, truth = np.array([self.known[i] for i in rows]), world.p_obj[rows]
        error = se3.transform(fit_rigid(truth, estimate), truth) - estimate
        off = se3.log(se3.inverse(self.T_last) @ world.keyframes[-1][0])
        nees = np.nan if self.covariance is None else off @ np.linalg.solve(self.covariance, off)
        return 1e3 * float(np.sqrt(np.mean(np.sum(error**2, 1)))), float(nees) / len(off)


def sections(quick: bool) -> Iterator[Section]:
    """By the number of keyframes."""
    sizes, seeds = (SIZES[:1], SEEDS[:1]) if quick else (SIZES, SEEDS)
    worlds = [turntable(sizes[-1], seed) for seed in seeds]
    spent, courses = {name: Times() for name in WAYS}, []
    for world in worlds:
        courses.append({name: Course(make()) for name, make in WAYS.items()})
        for keyframe in world.keyframes:
            for name, course in courses[-1].items():
                course.add(keyframe, spent[name])
    tables = {}
    for size in sizes:
        last = [w * sizes[-1] + k for w in range(len(worlds)) for k in range(size - LAST, size)]
        tables[f"{size} keyframes"] = compared({name: times.at(last) for name, times in spent.items()}, PEER)
    error = {n: np.mean([of[n].errors(w) for of, w in zip(courses, worlds, strict=True)], 0) for n in WAYS}
    last = tables[f"{sizes[-1]} keyframes"]
    last["map's error (mm)"], last["pose's squared error (expected 1)"] = np.round(np.array([*error.values()]).T, 2)
    words = (
        "One new keyframe, over the last ten up to that number. The peer is the full batch Levenberg-Marquardt, which "
        "is also the paper's way: all keyframes, from the last solution, 20 steps at most."
    )
    yield Section("keyframes", "Factor graph by keyframes", words, tables, plot(tables))


@style.styled
def plot(tables: dict[str, DataFrame]) -> Figure:
    """Median milliseconds against the number of keyframes."""
    figure, (axis,) = panels(1, (WIDTH_IN, 3.2))
    sizes = [int(caption.split()[0]) for caption in tables]
    for k, name in enumerate(WAYS):
        medians = [table["median (ms)"][k] for table in tables.values()]
        again, colour = divmod(k, len(style.METHODS))
        axis.plot(sizes, medians, ("o-", "o:")[again], color=style.METHODS[colour], label=name)
    logarithmic(axis.xaxis, axis.yaxis)
    axis.set_xticks(sizes)
    axis.set(xlabel="keyframes", ylabel="a new keyframe [ms]")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    return figure
