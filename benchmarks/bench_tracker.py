"""Cost of the built-in tracker per frame: ``python benchmarks/bench_tracker.py [SEQUENCE] [--frames N]``.

256 points on the objects, 640x480, new queries and searches for lost segments included. In every frame
plain Lucas-Kanade follows the same points first: how long that takes says how busy the machine is. CPU
milliseconds of all threads; the bars are 20 ms in the mean and 40 ms at the 95th percentile.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from p2p_lib.core.config import preset
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.true_tracks import Queries, TrueScene, draw_queries
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from p2p_lib.trackers.lk import LkTracker


def step_ms(tracker: PointTracker, frame, camera, queries: Queries) -> float:
    """CPU milliseconds of one frame, its new queries included."""
    start = time.process_time()
    tracker.track(frame) if frame.index else tracker.start(frame, camera)
    new = queries.uv_px[queries.frame == frame.index]
    if len(new):
        tracker.add(new)
    return 1e3 * (time.process_time() - start)


def main() -> None:
    """Both trackers in turn, frame by frame."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sequence", nargs="?", default="synthetic/crossing")
    parser.add_argument("--frames", type=int, default=0, help="only the first N; 0 = all")
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    sequence = open_sequence(asked.sequence)
    queries = draw_queries(TrueScene.of(sequence), np.random.default_rng(0))
    trackers = LkTracker(preset().tracking), BuiltinTracker(preset().tracking)
    frames = range(asked.frames or len(sequence))
    cost = np.array([[step_ms(t, sequence.frame(i), sequence.camera, queries) for t in trackers] for i in frames])
    for tracker, ms in zip(trackers, cost.T, strict=True):
        middle, late = np.percentile(ms, [50, 95])
        print(f"{tracker.name:9} mean {ms.mean():5.1f} ms   median {middle:5.1f}   p95 {late:5.1f}")
    lk_ms, builtin_ms = cost.mean(0)
    print(f"ratio of the means {builtin_ms / lk_ms:.1f}; {len(queries)} points, {len(frames)} frames")


if __name__ == "__main__":
    main()
