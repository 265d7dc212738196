"""Notebook 05: an object that turns before the camera, as keyframes of noisy points for the factor graph.

Simulated, so that the truth is known and hundreds of trials cost seconds. Noise and registration are those of
the pipeline; so is the covariance, where no surface refines the pose.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame
from scipy.stats import chi2

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.extended.graph import BoundedGraph
from p2p_lib.figures import style
from p2p_lib.figures.plots import panels
from p2p_lib.method.factor_graph import GraphResult
from p2p_lib.method.registration import covariance, register


@dataclass(frozen=True, eq=False)
class Turn:
    """Keyframes of a turning object.

    T_cam_obj  (M, 4, 4) the truth
    p_obj      (N, 3) the keypoints, and with them the object's true shape
    seen       (M, N) bool: which keyframe sees which (paper: Omega)
    p_cam      (M, N, 3) where it sees them: noisy, some of them wrong; NaN where it does not
    """

    T_cam_obj: np.ndarray
    p_obj: np.ndarray
    seen: np.ndarray
    p_cam: np.ndarray


@dataclass(frozen=True, eq=False)
class Solved:
    """Keyframe poses and map by one way.

    T_cam_obj   (M, 4, 4), NaN for keyframes that were left out or merged into another
    p_obj       (N, 3), NaN where never seen
    covariance  (6, 6) of the newest keyframe, None where the graph does not determine it; of registration alone
                (M, 6, 6), each relative to the map, NaN for the first
    """

    T_cam_obj: np.ndarray
    p_obj: np.ndarray
    covariance: np.ndarray | None

    @classmethod
    def of(cls, turn: Turn, result: GraphResult) -> Solved:
        """What the graph found."""
        T, p_obj = np.full_like(turn.T_cam_obj, np.nan), np.full_like(turn.p_obj, np.nan)
        T[result.keys], p_obj[result.point_ids] = result.T_cam_obj, result.p_obj
        return cls(T, p_obj, result.covariance)

    def errors(self, turn: Turn) -> np.ndarray:
        """(2, M) rotation in degrees and translation in millimetres against the truth."""
        return np.stack(se3.error_deg_mm(self.T_cam_obj, turn.T_cam_obj))


def simulate_turn(
    rng: np.random.Generator,
    config: Config,
    keyframes: int = 42,
    step_deg: float = 10.0,
    points: int = 160,
    outliers: float = 0.0,
    hidden: tuple[int, int] = (0, 0),
) -> Turn:
    """A printed tin turns by ``step_deg`` a keyframe and sways; a keyframe sees the side that faces it.

    outliers  share of the observations that are of something else, 3 to 6 cm away
    hidden    keyframes [start, stop) that see two points only
    """
    around, height = rng.uniform(0, 2 * np.pi, points), rng.uniform(-0.07, 0.07, points)
    normal = np.stack([np.cos(around), np.zeros(points), np.sin(around)], -1)
    p_obj = 0.045 * normal + height[:, None] * [0, 1.0, 0]
    m = np.arange(keyframes)
    turned = se3.exp(np.radians(step_deg) * m[:, None] * [0, 1.0, 0, 0, 0, 0])
    sway = se3.exp(np.radians(15) * np.stack([np.sin(m / 5), 0 * m, np.sin(m / 7)] + [0 * m] * 3, -1))
    T_cam_obj = se3.from_rt(np.eye(3), np.array([0.0, 0.0, 0.55])) @ sway @ turned
    exact = se3.transform(T_cam_obj, p_obj)
    range_m = np.linalg.norm(exact, axis=-1, keepdims=True)
    facing = -np.einsum("mij,nj,mni->mn", T_cam_obj[:, :3, :3], normal, exact / range_m)
    # A tracker has not all of what faces it.
    seen = (facing > 0.35) & (rng.random(facing.shape) < 0.6)
    seen[slice(*hidden)] &= np.cumsum(seen[slice(*hidden)], 1) <= 2
    bearing = exact / range_m + config.factor_graph.bearing_sigma_rad * rng.normal(size=exact.shape)
    bearing /= np.linalg.norm(bearing, axis=-1, keepdims=True)
    sigma_m = depth_noise_m(exact[..., 2:], config.depth)
    p_cam = bearing * (range_m + sigma_m * rng.normal(size=range_m.shape))
    wrong = rng.random(seen.shape) < outliers
    away = rng.normal(size=exact.shape)
    away *= rng.uniform(0.03, 0.06, seen.shape)[..., None] / np.linalg.norm(away, axis=-1, keepdims=True)
    p_cam = np.where(seen[..., None], p_cam + wrong[..., None] * away, np.nan)
    return Turn(T_cam_obj, p_obj, seen, p_cam)


def register_turn(turn: Turn, config: Config, seed: int = 0) -> Solved:
    """Frame-to-map registration alone: every keyframe registered to the map, new points put where its pose says.

    A keyframe that cannot be registered repeats the last motion, with 3 degrees and 1 cm of standard deviation.
    """
    rng = np.random.default_rng(seed)
    T, p_obj, covariances = [turn.T_cam_obj[0]], np.full_like(turn.p_obj, np.nan), [np.full((6, 6), np.nan)]
    for m, p_cam in enumerate(turn.p_cam):
        sigma_m = depth_noise_m(p_cam[:, 2], config.depth)
        found = register(p_obj, p_cam, config.registration, rng, sigma_m=sigma_m)
        if found:
            T.append(found[0].T_cam_obj)
            covariances.append(covariance(found[0], p_obj, p_cam, sigma_m))
        elif m:
            T.append(T[-1] @ se3.inverse(T[-2:][0]) @ T[-1])
            covariances.append(np.diag(np.repeat([np.radians(3), 0.01], 3) ** 2))
        new = turn.seen[m] & np.isnan(p_obj[:, 0])
        p_obj[new] = se3.transform(se3.inverse(T[m]), p_cam[new])
    return Solved(np.stack(T), p_obj, np.stack(covariances))


def optimise(turn: Turn, registered: Solved, config: Config) -> Solved:
    """The graph over all keyframes, started from registration and solved once."""
    *_, graph = _growing_graph(turn, registered, config)
    return Solved.of(turn, graph.optimise())


def optimise_online(turn: Turn, registered: Solved, config: Config) -> list[Solved]:
    """The same, solved at every keyframe as in the pipeline: what was known when."""
    return [Solved.of(turn, graph.optimise()) for graph in _growing_graph(turn, registered, config)]


def _growing_graph(turn: Turn, registered: Solved, config: Config) -> Iterator[BoundedGraph]:
    """The graph after each keyframe was added, as the pipeline adds it."""
    graph, constant = BoundedGraph(config.factor_graph), config.method.noise == "constant"
    assert registered.covariance is not None, "registration always has one"
    for m, ids in enumerate(map(np.flatnonzero, turn.seen)):
        graph.add_keyframe(
            registered.T_cam_obj[m],
            ids,
            turn.p_cam[m, ids],
            p_obj_init=registered.p_obj[ids],
            covariance=None if constant else registered.covariance[m],
            sigma_m=None if constant else depth_noise_m(turn.p_cam[m, ids, 2], config.depth),
        )
        yield graph


def with_outliers(config: Config, share_percent: float, turn_deg: float = 10.0, seed: int = 0) -> Figure:
    """Registration, and the graph with either loss, on a turn with so many outliers: for sliders."""
    turn = simulate_turn(np.random.default_rng(seed), config, step_deg=turn_deg, outliers=share_percent / 100)
    registered, squares = register_turn(turn, config), config.with_values({"factor_graph.huber": 1e6})
    ways = {"registration alone": registered, "all three, Huber": optimise(turn, registered, config)}
    return errors_by_way(turn, {**ways, "all three, squares": optimise(turn, registered, squares)})


def outlier_trials(seeds: Iterable[int], config: Config, outliers: float) -> DataFrame:
    """A row per turn: mean rotation error in degrees of each way, without outliers and with that share of them."""
    squares, rows = config.with_values({"factor_graph.huber": 1e6}), []
    for seed in seeds:
        clean, spoilt = (simulate_turn(np.random.default_rng(seed), config, outliers=s) for s in (0.0, outliers))
        start, spoilt_start = register_turn(clean, config), register_turn(spoilt, config)
        errors = {
            "registration alone, clean": start.errors(clean),
            "registration alone, outliers": spoilt_start.errors(spoilt),
            "graph, clean": optimise(clean, start, config).errors(clean),
            "graph with Huber, outliers": optimise(spoilt, spoilt_start, config).errors(spoilt),
            "graph with squares, outliers": optimise(spoilt, spoilt_start, squares).errors(spoilt),
        }
        rows.append({"turn": seed, **{f"{way} [°]": np.nanmean(off[0]) for way, off in errors.items()}})
    return DataFrame(rows)


def consistency(trials: int, config: Config, told: Sequence[Config], seed: int = 0, **turn: Any) -> list[np.ndarray]:
    """(trials, 2) normalised squared errors of the newest keyframe, rotation and translation, by its covariance.

    told  what the graph is configured by, with an answer for each; ``config`` simulates and registers the turns

    Each is e^T Sigma^-1 e of three numbers, distributed as chi square of 3 if the covariance is honest: median 2.37.
    """
    rows: list[list] = [[] for _ in told]
    for trial in range(trials):
        one = simulate_turn(np.random.default_rng([seed, trial]), config, **turn)
        registered = register_turn(one, config, trial)
        for graph, found in zip(told, rows, strict=True):
            solved = optimise(one, registered, graph)
            if solved.covariance is not None:
                e, C = se3.log(se3.inverse(solved.T_cam_obj[-1]) @ one.T_cam_obj[-1]), solved.covariance
                found.append([e[k] @ np.linalg.solve(C[k, k], e[k]) for k in (slice(0, 3), slice(3, 6))])
    return [np.array(found) for found in rows]


#: The line of each way, the same in every plot; told apart without colour too.
_LINES = {
    "registration alone": (style.NEUTRAL[0], "-"),
    "without prior": (style.METHODS[1], "--"),
    "without observations": (style.METHODS[4], "-."),
    "without registration": (style.METHODS[3], ":"),
    "all three, squares": (style.METHODS[5], "--"),
    "constant noise": (style.METHODS[2], "-."),
}
#: That of the graph as it is, whatever it is compared with.
_GRAPH = (style.METHODS[0], "-")
_UNITS = ("rotation [°]", "translation [mm]")


@style.styled
def turn_from_above(turn: Turn, solved: Mapping[str, Solved]) -> Figure:
    """A panel per way, along the object's axis: true cameras X_m in black, estimated ones and the map in colour."""
    true_xz = 100 * se3.inverse(turn.T_cam_obj)[:, [0, 2], 3]
    figure, axes = panels(len(solved), (4.0 * len(solved), 4.4), side_by_side=True)
    for axis, (name, one) in zip(axes, solved.items(), strict=True):
        colour, _ = _LINES.get(name, _GRAPH)
        xz = 100 * se3.inverse(one.T_cam_obj)[:, [0, 2], 3]
        axis.plot(*np.stack([true_xz, xz]).transpose(2, 0, 1), color=colour, linewidth=1)
        axis.plot(*true_xz.T, ".", color="#222222", markersize=4, label="true $X_m$")
        axis.plot(*xz.T, "o", color=colour, markersize=4.5, markerfacecolor="none", label="estimated $X_m$")
        axis.plot(*(100 * turn.p_obj[:, [0, 2]].T), ".", color="#BBBBBB", markersize=2)
        axis.plot(*(100 * one.p_obj[:, [0, 2]].T), ".", color=colour, markersize=2.5, label="$p_n$")
        axis.set_title(f"{name}: {np.nanmean(one.errors(turn)[0]):.1f}° on average")
        axis.set(aspect="equal", xlabel="x in the object frame [cm] (simulated)")
    axes[0].set_ylabel("z in the object frame [cm]")
    axes[0].legend(loc="center", fontsize=8, bbox_to_anchor=(0.5, 0.27))
    return figure


@style.styled
def errors_by_way(turn: Turn, solved: Mapping[str, Solved]) -> Figure:
    """Rotation and translation error of every keyframe, one line per way; means are over keyframes that all have."""
    errors = {name: one.errors(turn) for name, one in solved.items()}
    common = np.isfinite(sum(errors.values())).all(0)
    over = "mean" if common.all() else f"mean of the {common.sum()} that all have"
    shaded = np.flatnonzero(turn.seen.sum(1) <= 2)
    figure, axes = panels(2, (8.0, 4.6))
    for k, (axis, unit) in enumerate(zip(axes, _UNITS, strict=True)):
        for name, error in errors.items():
            colour, line = _LINES.get(name, _GRAPH)
            label = f"{name} ({error[k, common].mean():.1f})"
            axis.plot(error[k], line, color=colour, marker=".", markersize=4, label=label)
        if len(shaded):
            axis.axvspan(shaded[0] - 0.5, shaded[-1] + 0.5, color="#D9D9D9", lw=0)
        axis.set(ylabel=unit, ylim=(0, None))
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, title=over, alignment="left")
    axes[1].set_xlabel("keyframe m (simulated)")
    return figure


@style.styled
def known_when(turn: Turn, online: Sequence[Solved]) -> Figure:
    """Error of the newest keyframe when it was new, beside one and two standard deviations by its covariance."""
    errors = np.stack([one.errors(turn)[:, m] for m, one in enumerate(online)], 1)
    variance = np.array([np.full(6, np.nan) if one.covariance is None else np.diag(one.covariance) for one in online])
    # The root of the trace is the expected length of the error.
    sigma = np.sqrt(variance.reshape(-1, 2, 3).sum(-1)).T * [[np.degrees(1)], [1e3]]
    figure, axes = panels(2, (8.0, 4.2))
    for axis, error, width, unit in zip(axes, errors, sigma, _UNITS, strict=True):
        axis.fill_between(range(len(online)), 0, 2 * width, color="#DCEAF5", lw=0, label="two of them")
        axis.fill_between(range(len(online)), 0, width, color="#A9CCE8", lw=0, label="one standard deviation")
        axis.plot(error, color="#222222", marker=".", markersize=4, label="error of the newest keyframe")
        axis.set(ylabel=unit, ylim=(0, None))
    axes[0].legend(loc="upper left", fontsize=8, ncols=3)
    axes[0].set_ylim(top=1.35 * np.nanmax([errors[0], 2 * sigma[0]]))
    axes[1].set_xlabel("keyframe m (simulated)")
    return figure


@style.styled
def consistency_plot(nees: np.ndarray) -> Figure:
    """Normalised squared errors (trials, 2) beside the chi square distribution that an honest covariance gives them."""
    at, bins = np.linspace(0, 14, 200), np.linspace(0, 14, 22)
    figure, axes = panels(2, (8.0, 2.8), side_by_side=True)
    for axis, values, name in zip(axes, nees.T, ("rotation", "translation"), strict=True):
        weights = np.full(len(values), 1 / (len(values) * (bins[1] - bins[0])))
        axis.hist(np.minimum(values, 13.99), bins, weights=weights, color="#A9CCE8", edgecolor="white")
        axis.plot(at, chi2(3).pdf(at), color="#222222", label=r"$\chi^2$ of 3")
        axis.axvline(np.median(values), color=style.METHODS[0], linestyle="--", label=f"median {np.median(values):.2f}")
        last = f"last bar: all {(values >= bins[-2]).sum()} beyond {bins[-2]:.0f}"
        axis.text(0.99, 0.35, last, transform=axis.transAxes, ha="right", fontsize=8)
        axis.set(xlabel=r"$e^\top \Sigma^{-1} e$", ylabel="density", title=f"{name}, {len(values)} simulated turns")
        axis.legend(loc="upper right")
    return figure
