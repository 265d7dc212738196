"""Cost and worth of the keyframe graph: ``python benchmarks/bench_graph.py [keyframes]``.

An object turns on the spot, ten degrees a keyframe, 45 of its 300 points seen in each; every new
keyframe is registered to the map as it stands and the graph solved. Compared: the paper's way (the
whole graph, 20 steps), ours without and with a bound on the keyframes, and GTSAM's incremental
smoothers. Prints CPU milliseconds per keyframe (covariance included) over the last ten keyframes, their ratio to
the paper's way, the map's error after alignment, and the newest pose's normalised squared error.
The bar is 60 ms at 100 keyframes.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig, preset
from p2p_lib.core.robust import fit_rigid
from p2p_lib.method.factor_graph import ObjectGraph

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


def run(world: World, graph: Ours | Smoother) -> tuple[np.ndarray, float, float]:
    """CPU ms of each keyframe, root mean square error of the map (m), normalised squared error of the last pose."""
    known, times = {}, []
    for truth, ids, p_cam in world.keyframes:
        shared = [k for k, i in enumerate(ids.tolist()) if i in known]
        T = fit_rigid(np.array([known[ids[k]] for k in shared]), p_cam[shared]) if known else truth
        start = time.process_time()
        known, T_last, covariance = graph.add(T, ids, p_cam)
        times.append(1e3 * (time.process_time() - start))
    rows = np.array(sorted(known))
    estimate, truth = np.array([known[i] for i in rows]), world.p_obj[rows]
    error = se3.transform(fit_rigid(truth, estimate), truth) - estimate
    off = se3.log(se3.inverse(T_last) @ world.keyframes[-1][0])
    nees = np.nan if covariance is None else off @ np.linalg.solve(covariance, off)
    return np.array(times), float(np.sqrt(np.mean(np.sum(error**2, 1)))), float(nees)


def main() -> None:
    """One line for each way to keep the graph solved."""
    keyframes, seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 100, (0, 1)
    default, paper = preset("default").factor_graph, preset("paper").factor_graph
    physical = replace(paper, bearing_sigma_rad=SIGMA_RAD, range_sigma_m=SIGMA_M)
    bounds = sorted({20, default.max_keyframes, 60})
    ways = {
        "paper: whole graph, 20 steps": lambda: Ours(paper),
        "the same, physical noise": lambda: Ours(physical),
        "whole graph, 5 warm steps": lambda: Ours(replace(default, max_keyframes=0)),
        **{f"merged to {k} keyframes": lambda k=k: Ours(replace(default, max_keyframes=k)) for k in bounds},
        "ISAM2": lambda: Smoother(default),
        "fixed lag of 15": lambda: Smoother(default, 15),
        "fixed lag of 40": lambda: Smoother(default, 40),
    }
    worlds = [turntable(keyframes, seed) for seed in seeds]
    print(f"{keyframes} keyframes; default merges to {default.max_keyframes}")
    print(f"{'':30} {'last ten':>10} {'worst':>10} {'ratio':>6} {'map':>8} {'error^2/6':>9}")
    reference = None
    for name, make in ways.items():
        times, error_m, nees = zip(*(run(world, make()) for world in worlds), strict=True)
        late = float(np.median([t[-10:] for t in times]))
        reference = reference or late
        print(
            f"{name:30} {late:7.1f} ms {np.max(times):7.1f} ms {late / reference:6.2f}"
            f" {1e3 * np.mean(error_m):5.2f} mm {np.mean(nees) / 6:9.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
