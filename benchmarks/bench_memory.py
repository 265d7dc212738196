"""Memory and time per frame over a long stream, beside the plain tracker of ``peer.py``.

One object of ``synthetic/crossing`` at half resolution, the sequence played forwards and backwards without a cut: in
10,000 frames it is hidden completely more than 30 times. Ours and the peer take whole rounds in turn: what ours does
beside its frames falls into its own time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Section, Times, beside, rounded
from matplotlib.figure import Figure
from pandas import DataFrame
from peer import Peer

from p2p_lib import Point2Pose, open_sequence, preset
from p2p_lib.core.types import Frame
from p2p_lib.datasets.resized import Resized
from p2p_lib.figures import style
from p2p_lib.figures.plots import WIDTH_IN, panels

FRAMES, OBJECT, SCALE = 10_000, "box", 0.5
TIME, MEMORY = "Time per frame", "What is held at the end of each round"


def there_and_back(images: list[tuple[Frame, np.ndarray]], n: int) -> Iterator[tuple[Frame, dict[str, np.ndarray]]]:
    """Frames and masks of the n-th round of the stream, which goes forwards, then backwards."""
    order = [*range(len(images)), *range(len(images) - 2, 0, -1)]
    for i, k in enumerate(order, n * len(order)):
        frame, mask = images[k]
        yield replace(frame, index=i, time_s=i / 30), {OBJECT: mask}


def resident_mb() -> float:
    """Resident memory of this process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def held(ours: Point2Pose, peer: Peer) -> dict[str, float]:
    """Columns of a table: what both keep of the object."""
    obj, known = ours.objects[OBJECT], peer.objects[OBJECT]
    return {
        "keypoints": len(obj.map),
        "keyframes": len(obj.model.graph.keys),
        "views": len(obj.model.views),
        "images": len(obj.model.surface.views),
        "voxels (million)": rounded(np.prod(obj.model.surface.shape) / 1e6),
        "peer, keypoints": len(known.p_obj),
        "peer, map (MB)": round((known.p_obj.nbytes + known.descriptors.nbytes) / 2**20, 1),
        "both, resident (MB)": round(resident_mb(), 1),
    }


def sections(quick: bool) -> Iterator[Section]:
    """Time and memory by frames."""
    sequence = Resized(open_sequence("synthetic/crossing"), SCALE)
    count = 6 if quick else len(sequence)
    images = [(sequence.frame(k), sequence.masks(k)[OBJECT]) for k in range(count)]
    ours, peer = Point2Pose(sequence.camera, preset("default")), Peer(sequence.camera, [OBJECT])
    ours.add_object(OBJECT)
    each = 2 * (count - 1)
    rounds = 3 if quick else -(-FRAMES // each)
    times, memory, posed = [], [], [0, 0]
    for n in range(rounds):
        spent = Times(), Times()
        for frame, masks in there_and_back(images, n):
            posed[0] += spent[0].run(lambda: ours.step(frame, masks))[OBJECT].T_cam_obj is not None  # noqa: B023
        for frame, masks in there_and_back(images, n):
            posed[1] += spent[1].run(lambda: peer.step(frame, masks))[OBJECT] is not None  # noqa: B023
        frames = {"frames": (n + 1) * each}
        times.append(frames | beside(*spent))
        memory.append(frames | held(ours, peer))
    tables = {TIME: DataFrame(times), MEMORY: DataFrame(memory)}
    # The first round compiles and fills what has a bound.
    time_grown = (tables[TIME].iloc[-1] / tables[TIME].iloc[1] - 1).map("{:+.0%}".format)
    mb = tables[MEMORY].iloc[-1] - tables[MEMORY].iloc[1]
    mb_grown = mb["both, resident (MB)"] - mb["peer, map (MB)"]
    share = [f"{100 * k / (rounds * each):.0f} %" for k in posed]
    words = (
        f"`{sequence.name}`, its `{OBJECT}` alone, {sequence.camera.width}x{sequence.camera.height}, forwards and "
        f"backwards without a cut, {rounds * each} frames; a row is a round. Between the second round and the last one "
        f"the median time of ours changes by {time_grown['ours, median (ms)']}, that of the peer by "
        f"{time_grown['peer, median (ms)']}, resident memory by {mb_grown:+.1f} MB "
        f"beside the peer's map, which has no bound. A pose in {share[0]} of the frames (ours) and in {share[1]} (the "
        "peer), hidden ones included."
    )
    yield Section("frames", "By frames", words, tables, plot(tables))


@style.styled
def plot(tables: dict[str, DataFrame]) -> Figure:
    """Time and memory against the number of frames."""
    figure, (left, right) = panels(2, (WIDTH_IN, 2.6), side_by_side=True)
    frames = tables[TIME]["frames"]
    for colour, who in zip(style.METHODS, ("ours", "peer"), strict=False):
        left.plot(frames, tables[TIME][f"{who}, median (ms)"], "o-", color=colour, label=f"{who}, median")
        left.plot(frames, tables[TIME][f"{who}, p95 (ms)"], "o:", color=colour, label=f"{who}, 95th percentile")
    left.set(xlabel="frames", ylabel="a frame [ms]", ylim=(0, None))
    left.legend(fontsize=7)
    memory = tables[MEMORY]
    resident_mb = memory["both, resident (MB)"] - memory["both, resident (MB)"][0]
    right.plot(frames, resident_mb, "o-", color=style.NEUTRAL[0], label="both, resident")
    right.plot(frames, memory["peer, map (MB)"], "o-", color=style.METHODS[1], label="the peer's map")
    right.set(xlabel="frames", ylabel="since the first round [MB]")
    right.legend(fontsize=7)
    return figure
