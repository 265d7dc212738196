"""Memory and time per frame over a long stream: ``python benchmarks/bench_memory.py [frames] [sequence]``.

A bundled sequence is played forwards and backwards without a cut (10,000 frames of ``synthetic/crossing`` by
default: each object is hidden completely more than 60 times). Every 500 frames a line says what is held: resident
memory, the milliseconds of CPU per frame (median over the last whole round of the sequence), and per object the
keypoints, keyframes of the graph, remembered views, images kept for re-integration, and voxels.

The bars: resident memory at the end within 50 MB of that after frame 1,000, and the median time within 20 %.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from p2p_lib import Point2Pose, open_sequence, preset
from p2p_lib.core.types import WITH_POSE, Frame
from p2p_lib.datasets.sequence import Sequence

EVERY, SETTLED = 500, 1000
MOST_GROWTH_MB, MOST_SLOWER = 50.0, 0.20


def there_and_back(sequence: Sequence, frames: int) -> Iterator[tuple[Frame, dict[str, np.ndarray]]]:
    """The sequence forwards, backwards, and so on; its frames are read anew each time, as from a camera."""
    n = len(sequence)
    order = [*range(n), *range(n - 2, 0, -1)]
    for i in range(frames):
        k = order[i % len(order)]
        yield replace(sequence.frame(k), index=i, time_s=i / 30), sequence.masks(k) or {}


def resident_mb() -> float:
    """Resident memory of this process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def held(method: Point2Pose) -> str:
    """What each object keeps: points / graph keyframes / views / images / million voxels."""
    words = []
    for name, obj in method.objects.items():
        voxels = np.prod(obj.model.surface.shape) / 1e6
        counts = (len(obj.map), len(obj.model.graph.keys), len(obj.model.views), len(obj.model.surface.keys))
        words.append(f"{name} {'/'.join(map(str, counts))}/{voxels:.2f}")
    return "  ".join(words)


def main(frames: int = 10_000, name: str = "synthetic/crossing") -> None:
    """Runs the stream and says whether the bars are met."""
    sequence = open_sequence(name)
    whole_round = 2 * (len(sequence) - 1)
    method = Point2Pose(sequence.camera, preset("default"))
    for known in sequence.objects:
        method.add_object(known)
    cpu_ms, settled, with_pose = np.zeros(frames), None, 0
    print(f"{name}, {frames} frames; per object: points/graph/views/images/M voxels", flush=True)
    for i, (frame, masks) in enumerate(there_and_back(sequence, frames), 1):
        start = time.process_time()
        estimates = method.step(frame, masks)
        cpu_ms[i - 1] = 1e3 * (time.process_time() - start)
        with_pose += sum(e.status in WITH_POSE for e in estimates.values())
        if i % EVERY and i != frames:
            continue
        now = resident_mb(), float(np.median(cpu_ms[max(i - whole_round, 0) : i]))
        settled = now if i == SETTLED or settled is None else settled
        print(f"{i:6d}  {now[0]:7.1f} MB  {now[1]:5.1f} ms  {held(method)}", flush=True)
    grown_mb, slower = now[0] - settled[0], now[1] / settled[1] - 1
    share = with_pose / frames / len(method.objects)
    print(f"since frame {SETTLED}: {grown_mb:+.1f} MB (at most {MOST_GROWTH_MB:+.0f}): {grown_mb <= MOST_GROWTH_MB}")
    print(f"since frame {SETTLED}: {100 * slower:+.1f} % (at most {100 * MOST_SLOWER:+.0f}): {slower <= MOST_SLOWER}")
    print(f"a pose in {100 * share:.1f} % of the frames, hidden ones included")


if __name__ == "__main__":
    main(*[kind(given) for kind, given in zip((int, str), sys.argv[1:], strict=False)])
