"""A real mug that a hand turns, which has no truth: what can be said of the tracker on it, from three clicks.

    python benchmarks/bench_hand.py OUT --data DIR [--seeds N]

Writes ``benchmarks/hand.md``; runs go below OUT. DIR holds ``mug_in_hand`` (``rgb``, ``depth``, ``cam_K.txt``, and
masks of another segmenter in ``reference_masks/mug``) and the clicks, ``prompts/mug_in_hand.json``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import options, tracked, write_page
from pandas import DataFrame

from p2p_lib.datasets.masks import read_labels
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.consistency import HEADS, consistency
from p2p_lib.evaluation.mask_score import agreement

PAGE = """# A mug that a hand turns

Written by `python benchmarks/bench_hand.py`; do not edit. {machine}

Real video, {frames} frames, up to 33 degrees from one to the next, a fast and blurred hand; three clicks. It has no
truth: what `p2p eval` says without one, and the overlap of the masks with those that SAM 2 drew of every frame.

{rows}"""


def overlap(folder: Path, reference: Path, shape: tuple[int, int]) -> float:
    """Mean IoU in percent of a run's masks with another segmenter's; a frame without one of ours counts 0."""
    found = []
    for path in sorted(reference.glob("*.png")):
        truth, ours = read_labels(path, shape) > 0, folder / "masks" / "mug" / path.name
        mask = read_labels(ours, shape) > 0 if ours.is_file() else np.zeros(shape, bool)
        found.append(agreement(mask, truth)[0])
    return 100 * float(np.nanmean(found))


def main() -> None:
    """See the module."""
    asked = options(seeds=5).parse_args()
    video = next(asked.data.glob("**/mug_in_hand"))
    prompts = next(asked.data.glob("**/prompts/mug_in_hand.json"))
    camera = open_sequence(video).camera
    rows, frames = [], 0
    for seed in range(asked.seeds):
        out = asked.out / f"mug_{seed}"
        done = tracked(video, out, prompts=prompts, seed=seed, save_masks=True)
        said, frames = consistency(done), len(done.objects["mug"])
        numbers = {head: said.objects["mug"][key] for key, (head, _) in HEADS.items()}
        iou = overlap(out, video / "reference_masks" / "mug", (camera.height, camera.width))
        rows.append({"seed": seed, **numbers, "masks with SAM 2's [%]": iou, "verdict": said.verdict("mug")})
    write_page("hand", PAGE, frames=frames, rows=DataFrame(rows).round(1))


if __name__ == "__main__":
    main()
