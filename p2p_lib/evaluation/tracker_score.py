"""Measuring a 2D tracker on a sequence with truth: what ``p2p eval-tracks`` and the notebooks call."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core.backends import make_tracker
from p2p_lib.core.config import Config
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.evaluation.point_tracks import after_query, redetection_shares, redetections, tapvid
from p2p_lib.evaluation.true_tracks import Queries, TrueScene, TrueTracks, draw_queries, true_tracks

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, eq=False)
class TrackRun:
    """What a tracker said of the queries: uv_px (T, N, 2), visible and uncertainty (T, N), cpu_ms per image.

    Before its query a point is invisible and NaN. cpu_ms is the processor time of all threads in a frame,
    new queries included; NaN in frames before the first query.
    """

    uv_px: np.ndarray
    visible: np.ndarray
    uncertainty: np.ndarray
    cpu_ms: np.ndarray


@dataclass(frozen=True, eq=False)
class TrackerScore:
    """A tracker's scores on one sequence, with what they were measured on."""

    tapvid: dict[str, Any]
    redetections: DataFrame
    truth: TrueTracks
    run: TrackRun
    queries: Queries
    info: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``p2p eval-tracks --json`` prints them; shares in [0, 1], None of nothing; milliseconds."""
        cost = self.run.cpu_ms[np.isfinite(self.run.cpu_ms)]
        cpu_ms = {"mean": float(cost.mean()), "p95": float(np.percentile(cost, 95))} if len(cost) else {}
        again = {k: v if np.isfinite(v) else None for k, v in redetection_shares(self.redetections).items()}
        return {**self.info, **self.tapvid, "redetection": again, "cpu_ms": cpu_ms}

    def as_table(self) -> str:
        """The same for people."""
        plain = self.as_dict()
        again, cost = plain["redetection"], plain["cpu_ms"]
        returns = "found again: no point returns after it was hidden"
        if again["returns"]:
            returns = f"found again after {again['returns']} returns: {again['found']:.3f}"
            same = again["returns_same_view"]
            share = f"{again['found_same_view']:.3f}" if same else "none"
            returns += f"; of the {same} within 40 degrees of a view seen: {share}"
        lines = (
            f"{plain['tracker']} on {plain['sequence']}: {plain['queries']} queries, seed {plain['seed']}",
            f"AJ {plain['aj']:.3f}   delta_avg {plain['delta_avg']:.3f}   OA {plain['oa']:.3f}",
            returns,
            f"CPU per frame: mean {cost['mean']:.1f} ms, p95 {cost['p95']:.1f} ms",
            f"truth from {plain['truth']}",
        )
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class TrackTask:
    """What trackers are asked on a sequence, and the true answers."""

    sequence: Sequence
    scene: TrueScene
    queries: Queries
    truth: TrueTracks
    seed: int

    @classmethod
    def of(
        cls, sequence: Sequence, seed: int = 0, models: Mapping[str, str | Path] | None = None, count: int = 256
    ) -> TrackTask:
        """Draw queries by the seed and find their true tracks.

        models  object to mesh, besides those in the sequence's ``models/``; the others go by measured depth
        """
        scene = TrueScene.of(sequence, models)
        queries = draw_queries(scene, np.random.default_rng(seed), count)
        return cls(sequence, scene, queries, true_tracks(scene, queries.points), seed)

    def tracker(self, name: str | PointTracker, config: Config) -> PointTracker:
        """The tracker of this name: ``oracle``, which knows the truth, or a known one; or the one given."""
        known = OracleTracker(self.scene, config.oracle, self.seed) if name == OracleTracker.name else name
        return make_tracker(known, config.tracking, np.random.default_rng(self.seed))

    def score(self, tracker: PointTracker, search: bool = False) -> TrackerScore:
        """Run a tracker over the queries; ``search`` tells it where the objects' masks are, as the pipeline does."""
        sequence, scene, queries, truth = self.sequence, self.scene, self.queries, self.truth
        run = run_tracker(tracker, sequence, queries, search)
        scored = after_query(queries.frame, len(sequence)) & truth.known
        shape = sequence.camera.height, sequence.camera.width
        info = {
            "sequence": sequence.name,
            "tracker": tracker.name,
            "seed": self.seed,
            "queries": len(queries),
            "frames": len(sequence),
            "search": "masks" if search else "whole image",
            "truth": ", ".join(f"{name}: {'mesh' if name in scene.surfaces else 'depth'}" for name in scene.objects),
        }
        return TrackerScore(
            tapvid(truth.uv_px, truth.visible, run.uv_px, run.visible, scored, shape),
            redetections(truth.uv_px, truth.visible, truth.known, truth.view, run.uv_px, run.visible, queries.frame),
            truth,
            run,
            queries,
            info,
        )


def run_tracker(tracker: PointTracker, sequence: Sequence, queries: Queries, search: bool = False) -> TrackRun:
    """Stream the sequence through the tracker in one pass, each query added at its frame.

    What a tracker says late is scored in the frame that it is of; for the last ones the last image is repeated.
    """
    total, n, late = len(sequence), len(queries), tracker.latency_frames
    uv, visible = np.full((total, n, 2), np.nan), np.zeros((total, n), bool)
    uncertainty, cpu_ms = np.ones((total, n)), np.full(total + late, np.nan)
    ids, first = np.full(n, -1), int(queries.frame.min())
    for i in range(first, total + late):
        frame, answered = sequence.frame(min(i, total - 1)), i - late
        masks = sequence.masks(frame.index) or {}
        where = np.logical_or.reduce([np.zeros(frame.shape, bool), *masks.values()])
        start, tracks = time.process_time(), None
        if i == first:
            tracker.start(frame, sequence.camera)
        else:
            tracks = tracker.track(frame, where if search else None)
        new = np.flatnonzero(queries.frame == answered)
        if len(new):
            ids[new] = tracker.add(queries.uv_px[new])
        cpu_ms[i] = 1e3 * (time.process_time() - start)
        if tracks is not None and answered >= first:
            rows = np.flatnonzero(np.isin(ids, tracks.ids))
            answer = tracks.select(ids[rows])
            uv[answered, rows], visible[answered, rows] = answer.uv_px, answer.visible
            uncertainty[answered, rows] = answer.uncertainty
    return TrackRun(uv, visible, uncertainty, cpu_ms)
