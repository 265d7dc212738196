"""Pictures of the factor graph: virtual cameras around the object, what each loss does, and how honest it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.figures import style
from p2p_lib.figures.plots import panels
from p2p_lib.studies.simulated_turn import Solved, Turn

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The line of each way, the same in every picture; told apart without colour too.
_LINES = {
    "registration alone": (style.NEUTRAL[0], "-"),
    "factor graph": (style.METHODS[0], "-"),
    "all three": (style.METHODS[0], "-"),
    "all three, Huber": (style.METHODS[0], "-"),
    "without prior": (style.METHODS[1], "--"),
    "without obs": (style.METHODS[4], "-."),
    "without reg": (style.METHODS[3], ":"),
    "all three, squares": (style.METHODS[5], "--"),
}


def turn_from_above(turn: Turn, solved: Mapping[str, Solved]) -> Figure:
    """The object standing still and the virtual cameras X_m that moved around it, seen along its axis.

    A panel per way: true cameras in black, estimated ones in colour, tied to their own truth; the map's points
    where the way puts them.
    """
    true_xz = 100 * se3.inverse(turn.T_cam_obj)[:, [0, 2], 3]
    with style.applied():
        figure, axes = panels(len(solved), (4.0 * len(solved), 4.4), [1] * len(solved), side_by_side=True)
        for axis, (name, one) in zip(axes, solved.items(), strict=True):
            colour, _ = _LINES[name]
            xz = 100 * se3.inverse(one.T_cam_obj)[:, [0, 2], 3]
            axis.plot(*np.stack([true_xz, xz]).transpose(2, 0, 1), color=colour, linewidth=1)
            axis.plot(*true_xz.T, ".", color="#222222", markersize=4, label="true $X_m$")
            axis.plot(*xz.T, "o", color=colour, markersize=4.5, markerfacecolor="none", label="estimated $X_m$")
            axis.plot(*(100 * turn.p_obj[:, [0, 2]].T), ".", color="#BBBBBB", markersize=2)
            axis.plot(*(100 * one.p_obj[:, [0, 2]].T), ".", color=colour, markersize=2.5, label="$p_n$")
            degrees, _ = one.errors(turn)
            axis.set_title(f"{name}: {np.nanmean(degrees):.1f}° on average")
            axis.set(aspect="equal", xlabel="x in the object frame [cm] (simulated)")
        axes[0].set_ylabel("z in the object frame [cm]")
        axes[0].legend(loc="center", fontsize=8, bbox_to_anchor=(0.5, 0.27))
    return figure


def errors_by_way(turn: Turn, solved: Mapping[str, Solved]) -> Figure:
    """Rotation and translation error of every keyframe, one line per way; gaps are keyframes that were left out.

    Means are over the keyframes that every way has.
    """
    common = np.all([np.isfinite(one.errors(turn)[0]) for one in solved.values()], axis=0)
    with style.applied():
        figure, axes = panels(2, (8.0, 4.6), [1, 1])
        shaded = np.flatnonzero(turn.seen.sum(1) <= 2)
        over = "mean" if common.all() else f"mean of the {common.sum()} that all have"
        for axis, which, unit in zip(axes, (0, 1), ("rotation [°]", "translation [mm]"), strict=True):
            for name, one in solved.items():
                errors, (colour, line) = one.errors(turn)[which], _LINES[name]
                label = f"{name} ({errors[common].mean():.1f})"
                axis.plot(errors, line, color=colour, marker=".", markersize=4, label=label)
            if len(shaded):
                axis.axvspan(shaded[0] - 0.5, shaded[-1] + 0.5, color="#D9D9D9", lw=0)
            axis.set_ylabel(unit)
            axis.set_ylim(bottom=0)
            axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, title=over, alignment="left")
        axes[1].set_xlabel("keyframe m (simulated)")
    return figure


def known_when(turn: Turn, online: Sequence[Solved]) -> Figure:
    """Error of the newest keyframe when it was new, beside one and two standard deviations by its covariance."""
    count = np.arange(len(online))
    errors = np.array([[one.errors(turn)[k][m] for m, one in enumerate(online)] for k in (0, 1)])
    # The root of the trace is the expected length of the error.
    sigma = np.full((2, len(online)), np.nan)
    for m, one in enumerate(online):
        if one.covariance is not None:
            variance = np.diag(one.covariance)
            sigma[:, m] = np.degrees(np.sqrt(variance[:3].sum())), 1e3 * np.sqrt(variance[3:].sum())
    with style.applied():
        figure, axes = panels(2, (8.0, 4.2), [1, 1])
        for axis, error, width, unit in zip(axes, errors, sigma, ("rotation [°]", "translation [mm]"), strict=True):
            axis.fill_between(count, 0, 2 * width, color="#DCEAF5", lw=0, label="two of them")
            axis.fill_between(count, 0, width, color="#A9CCE8", lw=0, label="one standard deviation")
            axis.plot(count, error, color="#222222", marker=".", markersize=4, label="error of the newest keyframe")
            axis.set_ylabel(unit)
            axis.set_ylim(bottom=0)
        axes[0].legend(loc="upper left", fontsize=8, ncols=3)
        axes[0].set_ylim(top=1.35 * np.nanmax([errors[0], 2 * sigma[0]]))
        axes[1].set_xlabel("keyframe m (simulated)")
    return figure


def consistency_plot(nees: np.ndarray) -> Figure:
    """Normalised squared errors (trials, 2) beside the chi square distribution that an honest covariance gives them."""
    from scipy.stats import chi2

    at = np.linspace(0, 14, 200)
    bins = np.linspace(0, 14, 22)
    with style.applied():
        figure, axes = panels(2, (8.0, 2.8), [1, 1], side_by_side=True)
        for axis, values, name in zip(axes, nees.T, ("rotation", "translation"), strict=True):
            weights = np.full(len(values), 1 / (len(values) * (bins[1] - bins[0])))
            axis.hist(np.minimum(values, 13.99), bins, weights=weights, color="#A9CCE8", edgecolor="white")
            axis.plot(at, chi2(3).pdf(at), color="#222222", label=r"$\chi^2$ of 3")
            axis.axvline(values.mean(), color=style.METHODS[0], linestyle="--", label=f"mean {values.mean():.2f}")
            beyond = (values >= bins[-2]).sum()
            where = {"transform": axis.transAxes, "ha": "right", "fontsize": 8}
            axis.text(0.99, 0.35, f"last bar: all {beyond} beyond {bins[-2]:.0f}", **where)
            axis.set_title(f"{name}, {len(values)} simulated turns")
            axis.set(xlabel=r"$e^\top \Sigma^{-1} e$", ylabel="density")
            axis.legend(loc="upper right")
    return figure
