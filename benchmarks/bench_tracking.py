"""Whole frames, stage by stage, beside the plain tracker of ``peer.py``: by objects, points, resolution, 2D tracker.

The settings and the sequence are those of the plan ``runtime``. Both get the same frames and masks, read beforehand;
passes over the sequence alternate, each from the start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from common import Section, Times, beside, rounded
from pandas import DataFrame
from peer import Peer

from p2p_lib.benchmark.jobs import Job, jobs_of, open_planned
from p2p_lib.benchmark.plan import read_plan
from p2p_lib.core import se3
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.confidence import MAX_DEG, MAX_M
from p2p_lib.extended.default import Point2Pose
from p2p_lib.figures import style
from p2p_lib.figures.plots import WIDTH_IN, panels

PASSES = 3
#: Loops are compiled in the first two frames, which count in no rate.
FIRST = 2
#: The stages that a plot tells apart; the others are one.
SHOWN = 6

Images = list[tuple[Frame, dict[str, np.ndarray]]]


@dataclass
class Followed:
    """What passes of one tracker took, in whole and by stages (ms of every frame), and how often a pose was right."""

    frames: Times = field(default_factory=Times)
    stages_ms: list[dict[str, float]] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)

    def stages(self) -> DataFrame:
        """A row a frame, a column a stage, those that take most first; a stage that did not run took no time."""
        stages = DataFrame(self.stages_ms).drop(columns="total").fillna(0.0)
        return stages[stages.sum().sort_values(ascending=False).index]


@dataclass
class Compared:
    """Ours and the peer on one setting."""

    job: Job
    images: Images
    sequence: Sequence
    ours: Followed = field(default_factory=Followed)
    peer: Followed = field(default_factory=Followed)

    @property
    def points(self) -> int:
        """The most keypoints of an object that are followed at once."""
        return self.job.options().config().sampling.max_visible

    def both_pass(self) -> None:
        """Ours from the first frame to the last, then the peer."""
        objects = self.job.options(self.sequence.objects).objects or self.sequence.objects
        config, method = self.job.options().config(), self.job.method
        ours = Point2Pose(self.sequence.camera, config, tracker=method.tracker, detector=method.detector)
        for name in objects:
            ours.add_object(name)
        follow(ours, self, objects, self.ours)
        follow(Peer(self.sequence.camera, objects, self.points), self, objects, self.peer)


def follow(tracker: Point2Pose | Peer, what: Compared, objects: tuple[str, ...], told: Followed) -> None:
    """A pass over all frames."""
    first = {}
    for t, (frame, all_masks) in enumerate(what.images):
        masks = {name: all_masks[name] for name in objects}
        spent = told.frames if t >= FIRST else Times()
        estimates = spent.run(lambda: tracker.step(frame, masks))  # noqa: B023
        if t < FIRST:
            continue
        told.stages_ms.append(tracker.stopwatch.last_ms)
        for name, estimate in estimates.items():
            T, truth = getattr(estimate, "T_cam_obj", estimate), what.sequence.truth[name].T_cam_model[t]
            if T is not None:
                T_obj_model = first.setdefault(name, se3.inverse(T) @ truth)
                deg, mm = se3.error_deg_mm(T @ T_obj_model, truth)
            told.right.append(T is not None and bool(deg <= MAX_DEG and mm <= 1e3 * MAX_M))


def measured(quick: bool) -> list[Compared]:
    """Every setting of the plan that needs neither a GPU nor weights, on its first seed."""
    profile = "quick" if quick else "full"
    plan = read_plan("runtime")
    jobs = [job for job in jobs_of(plan, profile) if job.seed == plan.scope(profile).seeds[0] and not job.reason]
    settings, read = [], {}
    for job in jobs:
        sequence, scale = open_planned(job), job.method.scale
        frames = range(12 if quick else len(sequence))
        if scale not in read:
            read[scale] = [(sequence.frame(t), sequence.masks(t)) for t in frames]
        settings.append(Compared(job, read[scale], sequence))
    for _ in range(1 if quick else PASSES):
        for setting in settings:
            setting.both_pass()
    return settings


def sections(quick: bool) -> Iterator[Section]:
    """One by number of objects, by keypoints, by resolution and by 2D tracker."""
    settings = measured(quick)
    base = settings[0].job.method
    like = {
        "objects": ("count", "objects", lambda s: s.job.method.count),
        "points": ("settings", "keypoints an object", lambda s: s.points),
        "resolution": ("scale", "resolution", lambda s: f"{s.sequence.camera.width}x{s.sequence.camera.height}"),
        "trackers": ("tracker", "2D tracker", lambda s: s.job.method.tracker),
    }
    for name, (key, label, value) in like.items():
        # Those that differ from the first setting in nothing else.
        same = {other: getattr(base, other) for other in (key, "name")}
        alike = [s for s in settings if s.job.method.model_copy(update=same) == base]
        if len(alike) > 1:
            by_value = dict(sorted({value(s): s for s in alike}.items()))
            yield section(name, label, by_value)


def section(name: str, label: str, settings: Mapping[object, Compared]) -> Section:
    one = next(iter(settings.values()))
    objects, frames = one.job.method.count, len(one.ours.frames.wall_ms)
    words = (
        f"`{one.sequence.name}`, {frames} frames of each setting, masks given; the peer is the plain tracker, which "
        f"gets the same frames, masks and number of keypoints. A pose is right within {100 * MAX_M:g} cm and "
        f"{MAX_DEG:g} degrees of the truth, aligned at the first one."
    )
    if name != "objects":
        words += f" {objects} object."
    whole = DataFrame([row(label, value, setting) for value, setting in settings.items()])
    tables = {"Whole frames": whole, "Stages in medians of the peer's frame, median / p95": by_stages(label, settings)}
    return Section(name, f"By {label}", words, tables, plot(label, settings))


def row(label: str, value: object, setting: Compared) -> dict[str, object]:
    ours, peer = setting.ours, setting.peer
    right = {"right (%)": rounded(100 * np.mean(ours.right)), "peer, right (%)": rounded(100 * np.mean(peer.right))}
    return {label: value, **beside(ours.frames, peer.frames), **right}


def by_stages(label: str, settings: Mapping[object, Compared]) -> DataFrame:
    """A row a stage, those of the peer last."""
    table = {}
    for who in ("ours", "peer"):
        for value, setting in settings.items():
            for stage, ms in getattr(setting, who).stages().items():
                middle, late = ms.quantile([0.5, 0.95]) / setting.peer.frames.median_ms
                table.setdefault(f"{who}: {stage}", {})[value] = f"{middle:.2f} / {late:.2f}"
    whole = DataFrame.from_dict(table, orient="index").fillna("-")
    return whole.rename(columns=str).rename_axis(f"stage, by {label}").reset_index()


@style.styled
def plot(label: str, settings: Mapping[object, Compared]):
    """Milliseconds of whole frames, and where ours go in units of the peer's frame."""
    figure, (left, right) = panels(2, (WIDTH_IN, 2.8), side_by_side=True)
    names = [str(value) for value in settings]
    for colour, who in zip(style.METHODS, ("ours", "peer"), strict=False):
        times = [getattr(setting, who).frames for setting in settings.values()]
        left.plot(names, [t.median_ms for t in times], "o-", color=colour, label=f"{who}, median")
        left.plot(names, [t.p95_ms for t in times], "o:", color=colour, label=f"{who}, 95th percentile")
    left.set(xlabel=label, ylabel="a frame [ms]", ylim=(0, None))
    left.legend(fontsize=7)
    shares = DataFrame([s.ours.stages().mean() / np.mean(s.peer.frames.wall_ms) for s in settings.values()]).fillna(0)
    most = [*shares][:SHOWN]
    shares["others"] = shares.drop(columns=most).sum(axis=1)
    floor = np.zeros(len(shares))
    for colour, stage in zip(style.OBJECTS, [*most, "others"], strict=False):
        right.bar(names, shares[stage], 0.6, floor, color=colour, label=stage)
        floor += shares[stage].to_numpy()
    right.axhline(1, color=style.NEUTRAL[0], linewidth=0.8)
    right.set(xlabel=label, ylabel="ours, means in frames of the peer")
    figure.legend(*right.get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    return figure
