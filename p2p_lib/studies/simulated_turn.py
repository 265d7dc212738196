"""An object that turns before the camera, as keyframes and noisy points: what the factor graph is for, in numbers.

Simulated rather than rendered, so that the noise is exactly what the graph is told, the truth is known, and
hundreds of trials cost seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig
from p2p_lib.core.robust import fit_rigid
from p2p_lib.method.factor_graph import GraphResult, ObjectGraph

_FEWEST = 4  # points that the front end registers with; with fewer it keeps the last motion


@dataclass(frozen=True, eq=False)
class Turn:
    """Keyframes of a turning object.

    T_cam_obj  (M, 4, 4) the truth
    p_obj      (N, 3) the keypoints, and with them the object's true shape
    seen       (M, N) bool: which keyframe sees which (paper: Omega)
    p_cam      (M, N, 3) where it sees them: noisy, some of them wrong; NaN where it does not
    sigma_rad, sigma_m  noise of bearings and ranges
    """

    T_cam_obj: np.ndarray
    p_obj: np.ndarray
    seen: np.ndarray
    p_cam: np.ndarray
    sigma_rad: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Solved:
    """Keyframe poses by one way, and how far they are off.

    T_cam_obj   (M, 4, 4), NaN for keyframes that were left out; p_obj (N, 3) the map, NaN where never seen
    covariance  (6, 6) of the newest keyframe, None where the graph does not determine it
    reason      why keyframes were left out, or why there is no covariance
    """

    T_cam_obj: np.ndarray
    p_obj: np.ndarray
    covariance: np.ndarray | None
    reason: str

    def errors(self, turn: Turn) -> tuple[np.ndarray, np.ndarray]:
        """Rotation in degrees and translation in millimetres (M,) against the truth."""
        apart = se3.inverse(turn.T_cam_obj) @ self.T_cam_obj
        known = np.isfinite(apart).all((1, 2))
        degrees = np.full(len(apart), np.nan)
        degrees[known] = np.degrees(se3.angle_rad(apart[known]))
        return degrees, 1e3 * np.linalg.norm(apart[:, :3, 3], axis=1)


def simulate_turn(
    rng: np.random.Generator,
    keyframes: int = 42,
    step_deg: float = 10.0,
    points: int = 160,
    config: FactorGraphConfig | None = None,
    outliers: float = 0.0,
    hidden: tuple[int, int] = (0, 0),
) -> Turn:
    """A printed tin turns by ``step_deg`` a keyframe and sways; a keyframe sees the side that faces it.

    outliers  share of the observations that are of something else, 3 to 6 cm away
    hidden    keyframes [start, stop) that see two points only
    """
    config = config or FactorGraphConfig()
    around, height = rng.uniform(0, 2 * np.pi, points), rng.uniform(-0.07, 0.07, points)
    normal = np.stack([np.cos(around), np.zeros(points), np.sin(around)], -1)
    p_obj = 0.045 * normal + height[:, None] * [0, 1.0, 0]
    m = np.arange(keyframes)
    turned = se3.exp(np.radians(step_deg) * m[:, None] * [0, 1.0, 0, 0, 0, 0])
    sway = se3.exp(np.radians(15) * np.stack([np.sin(m / 5), 0 * m, np.sin(m / 7)] + [0 * m] * 3, -1))
    T_cam_obj = se3.from_rt(np.eye(3), [0.0, 0.0, 0.55]) @ sway @ turned
    exact = se3.transform(T_cam_obj, p_obj)
    facing = -np.einsum(
        "mij,nj,mni->mn", T_cam_obj[:, :3, :3], normal, exact / np.linalg.norm(exact, axis=-1)[..., None]
    )
    # A tracker has not all of what faces it.
    seen = (facing > 0.35) & (rng.random(facing.shape) < 0.6)
    seen[slice(*hidden)] &= np.cumsum(seen[slice(*hidden)], 1) <= 2
    p_cam = _observed(exact, config, rng)
    wrong = rng.random(seen.shape) < outliers
    away = rng.normal(size=exact.shape)
    away *= rng.uniform(0.03, 0.06, seen.shape)[..., None] / np.linalg.norm(away, axis=-1, keepdims=True)
    p_cam = np.where(seen[..., None], p_cam + wrong[..., None] * away, np.nan)
    return Turn(T_cam_obj, p_obj, seen, p_cam, config.bearing_sigma_rad, config.range_sigma_m)


def _observed(p_cam: np.ndarray, config: FactorGraphConfig, rng: np.random.Generator) -> np.ndarray:
    """Points (..., 3) with Gaussian noise of bearing and range."""
    range_m = np.linalg.norm(p_cam, axis=-1, keepdims=True)
    bearing = p_cam / range_m + config.bearing_sigma_rad * rng.normal(size=p_cam.shape)
    bearing /= np.linalg.norm(bearing, axis=-1, keepdims=True)
    return bearing * (range_m + config.range_sigma_m * rng.normal(size=range_m.shape))


def register(turn: Turn) -> Solved:
    """The front end alone: each keyframe registered to the map, new points put where its pose says."""
    M, N = turn.seen.shape
    T, p_obj = np.full((M, 4, 4), np.nan), np.full((N, 3), np.nan)
    T[0] = turn.T_cam_obj[0]
    for m in range(M):
        known = turn.seen[m] & np.isfinite(p_obj[:, 0])
        if m and known.sum() >= _FEWEST:
            T[m] = _robust_fit(p_obj[known], turn.p_cam[m, known])
        elif m:
            T[m] = T[m - 1] @ (se3.inverse(T[m - 2]) @ T[m - 1] if m > 1 else se3.IDENTITY)
        new = turn.seen[m] & ~np.isfinite(p_obj[:, 0])
        p_obj[new] = se3.transform(se3.inverse(T[m]), turn.p_cam[m, new])
    return Solved(T, p_obj, None, "")


def _robust_fit(p_obj: np.ndarray, p_cam: np.ndarray) -> np.ndarray:
    """Reweighted least squares; enough for a few outliers."""
    weight = np.ones(len(p_obj))
    for _ in range(5):
        T = fit_rigid(p_obj, p_cam, weight)
        off_m = np.linalg.norm(se3.transform(T, p_obj) - p_cam, axis=1)
        weight = 1 / (1 + (off_m / 0.006) ** 4)
    return T


def optimise(turn: Turn, front_end: Solved, config: FactorGraphConfig) -> Solved:
    """The graph over all keyframes, started from the front end and solved once."""
    graph = ObjectGraph(config)
    for m in range(len(turn.seen)):
        _add(graph, turn, front_end, m)
    return _solved(turn, graph.optimise())


def optimise_online(turn: Turn, front_end: Solved, config: FactorGraphConfig) -> list[Solved]:
    """The same, solved at every keyframe as in the pipeline: what was known when."""
    graph, known = ObjectGraph(config), []
    for m in range(len(turn.seen)):
        _add(graph, turn, front_end, m)
        known.append(_solved(turn, graph.optimise()))
    return known


def outlier_trials(seeds: Iterable[int], config: FactorGraphConfig, outliers: float) -> list[dict[str, float]]:
    """A row per turn: mean rotation error in degrees of each way, without outliers and with that share of them."""
    rows = []
    for seed in seeds:
        clean, spoiled = (
            simulate_turn(np.random.default_rng(seed), config=config, outliers=share) for share in (0.0, outliers)
        )
        start, spoiled_start = register(clean), register(spoiled)
        ways = {
            "registration alone, clean": start.errors(clean),
            "registration alone, outliers": spoiled_start.errors(spoiled),
            "graph, clean": optimise(clean, start, config).errors(clean),
            "graph with Huber, outliers": optimise(spoiled, spoiled_start, config).errors(spoiled),
            "graph with squares, outliers": optimise(spoiled, spoiled_start, replace(config, huber=1e6)).errors(
                spoiled
            ),
        }
        rows.append({"turn": seed, **{f"{way} [°]": float(np.nanmean(off[0])) for way, off in ways.items()}})
    return rows


def _add(graph: ObjectGraph, turn: Turn, front_end: Solved, m: int) -> None:
    ids = np.flatnonzero(turn.seen[m])
    start = front_end.p_obj[ids]
    graph.add_keyframe(
        front_end.T_cam_obj[m],
        ids,
        turn.p_cam[m, ids],
        p_obj_init=start,
        sigma_rad=turn.sigma_rad,
        sigma_m=turn.sigma_m,
    )


def _solved(turn: Turn, result: GraphResult) -> Solved:
    T, p_obj = np.full_like(turn.T_cam_obj, np.nan), np.full_like(turn.p_obj, np.nan)
    T[result.keys] = result.T_cam_obj
    p_obj[result.point_ids] = result.p_obj
    return Solved(T, p_obj, result.covariance, result.reason)


def consistency(trials: int, config: FactorGraphConfig, seed: int = 0, **turn: object) -> np.ndarray:
    """(trials, 2) normalised squared errors of the newest keyframe, rotation and translation, by its covariance.

    Each is e^T Sigma^-1 e of three numbers: 3 on average, and distributed as chi square, if the covariance is honest.
    """
    rows = []
    for trial in range(trials):
        one = simulate_turn(np.random.default_rng([seed, trial]), config=config, **turn)
        solved = optimise(one, register(one), config)
        if solved.covariance is None:
            continue
        e = se3.log(se3.inverse(solved.T_cam_obj[-1]) @ one.T_cam_obj[-1])
        C = solved.covariance
        rows.append([e[k] @ np.linalg.solve(C[k, k], e[k]) for k in (slice(0, 3), slice(3, 6))])
    return np.array(rows)
