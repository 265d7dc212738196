"""Does a mask become better when somebody clicks where it is wrong? Measured with masks of every frame.

    python benchmarks/bench_corrections.py --data DIR

Writes ``benchmarks/corrections.md``. DIR holds below it anywhere ``mug_in_hand`` (its masks in ``reference_masks/``)
and ``redkitchen_table``; the other sequences are bundled. Five minutes on a quiet machine.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from common import in_a_line
from pandas import DataFrame

from p2p_lib.core.config import preset
from p2p_lib.core.errors import Doubt
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.tables import as_markdown
from p2p_lib.core.types import Frame
from p2p_lib.datasets.prompts import first_prompts
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.extended.default import Point2Pose
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter

#: Clicks that start an object, and how many rounds of clicks in a frame are looked at.
CLICKS, ROUNDS = 3, (1, 3)
#: A mask that overlaps less with the true one is corrected; what is missing, or too much, is clicked on from this
#: share of the mask on. An object of fewer pixels is left alone, and a mask is worse from this loss on.
POOR, WRONG, LEAST_PX, WORSE = 0.75, 0.15, 150, 0.02
PAGE = """# Masks that clicks correct

Written by `python benchmarks/bench_corrections.py`; do not edit. {machine}

Objects start from {clicks} drawn clicks. In every few frames somebody looks at the masks as they would be, and corrects
each that overlaps with the true one by less than {poor:.0f} %: one click on the largest part that is missing, a
negative one on the largest that is too much, each of {wrong:.0f} % of the mask at least. In *three rounds* the mask
that this makes is looked at and clicked on again, twice. The run goes on with what is corrected, so other masks come.
*Before* and *after* are means over the corrected masks (intersection over union, %); *worse* are those that lose more
than {worse:.0f} %. The method was made on the first rows; the others were kept aside and looked at once it was fixed.
The true masks of the mug are SAM 2's, those of the table are boxes in the room that cut objects off.

{rows}"""


@dataclass(frozen=True)
class Case:
    """Frames of a sequence in which somebody looks at the masks: every so many from the first to the last."""

    sequence: str
    seed: int
    first: int
    every: int
    stop: int
    aside: bool = False

    @property
    def name(self) -> str:
        """As a table shows it."""
        return f"{self.sequence.removeprefix('synthetic/')}, clicks {self.seed}, frames {self.first} to {self.stop}"


CASES = (
    Case("mug_in_hand", 0, 8, 8, 129),
    Case("mug_in_hand", 1, 5, 8, 129),
    Case("mug_in_hand", 2, 3, 8, 129),
    Case("redkitchen_table", 0, 5, 5, 100),
    Case("synthetic/in_hand", 1, 5, 5, 100),
    Case("synthetic/thin_tools", 0, 5, 5, 100),
    Case("synthetic/cluttered_desk", 0, 5, 5, 100),
    Case("mug_in_hand", 3, 4, 7, 129, aside=True),
    Case("mug_in_hand", 4, 6, 9, 129, aside=True),
    Case("redkitchen_table", 1, 105, 5, 200, aside=True),
    Case("synthetic/in_hand", 2, 5, 5, 100, aside=True),
    Case("synthetic/half_hidden_start", 1, 5, 5, 100, aside=True),
)


class Corrected(BuiltinSegmenter):
    """The built-in segmenter with somebody who looks at its masks: ``seen`` has their overlap before and after."""

    def __init__(self, sequence: Sequence, case: Case, rounds: int):
        super().__init__(sequence.camera, preset().segmentation)
        self._sequence, self._looks, self._rounds = sequence, range(case.first, case.stop, case.every), rounds
        self.seen: list[tuple[float, float]] = []

    def segment(
        self, frame: Frame, prompts: Iterable[Prompt] = (), hints: Mapping[str, Hint] | None = None
    ) -> np.ndarray:
        """As it is where nobody looks or is content, else once more with clicks on what is wrong."""
        prompts, state = list(prompts), vars(self) | {"_targets": dict(self._targets)}
        labels = super().segment(frame, prompts, hints)
        if prompts or frame.index not in self._looks:
            return labels
        true = self._sequence.masks(frame.index) or {}
        true = {name: true[name] for name in self.names if name in true and true[name].sum() >= LEAST_PX}
        before = {name: overlap(self._mask(labels, name), mask) for name, mask in true.items()}
        on: dict[str, list[np.ndarray]] = {name: [] for name, value in before.items() if value < POOR}
        beside: dict[str, list[np.ndarray]] = {name: [] for name in on}
        corrections: list[Prompt] = []
        for _ in range(self._rounds):
            for name in on:
                mask = self._mask(labels, name)
                missing, extra = true[name] & ~mask, mask & ~true[name]
                on[name] += [deepest(missing, frame)] * bool(missing.sum() > WRONG * true[name].sum())
                beside[name] += [deepest(extra, frame)] * bool(extra.sum() > WRONG * mask.sum())
            corrections = [
                Prompt(name, frame.index, np.array(on[name]), np.array(beside[name]))
                for name in on
                if on[name] or beside[name]
            ]
            if corrections:
                vars(self).update(state | {"_targets": dict(state["_targets"])})
                labels = super().segment(frame, corrections, hints)
        self.seen += [(before[p.name], overlap(self._mask(labels, p.name), true[p.name])) for p in corrections]
        return labels

    def _mask(self, labels: np.ndarray, name: str) -> np.ndarray:
        return labels == self.names.index(name) + 1


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks (H, W) bool."""
    return float((one & other).sum() / max((one | other).sum(), 1))


def deepest(region: np.ndarray, frame: Frame) -> np.ndarray:
    """(2,) the measured pixel of a region (H, W) bool that is farthest from its rim: where one would click."""
    inner = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1] * (frame.depth_m > 0)
    v, u = np.unravel_index(int(inner.argmax()), inner.shape)
    return np.array([u, v], float)


def corrected(case: Case, data: Path, rounds: int) -> list[tuple[float, float]]:
    """The overlap of each mask that was corrected, before and after."""
    found = sorted(data.rglob(case.sequence)) if not case.sequence.startswith("synthetic/") else [case.sequence]
    if not found:
        raise SystemExit(f"{data}: no {case.sequence} below it")
    at = found[0]
    own = isinstance(at, Path) and (at / "reference_masks").is_dir()
    sequence = open_sequence(at, masks="reference_masks") if own else open_sequence(at)
    rng = np.random.default_rng([case.seed, 7])
    prompts = first_prompts(sequence, range(case.first), sequence.objects, LEAST_PX, CLICKS, rng)
    segmenter = Corrected(sequence, case, rounds)
    method = Point2Pose(sequence.camera, preset(seed=case.seed), segmenter=segmenter)
    for index in range(case.stop):
        for prompt in prompts:
            if prompt.frame == index:
                method.tell(prompt)
        method.step(sequence.frame(index))
    return segmenter.seen


def row(case: Case, data: Path) -> dict[str, object]:
    """One row of the table."""
    cells: dict[str, object] = {"Sequence": case.name + (", kept aside" if case.aside else "")}
    for rounds in ROUNDS:
        seen = np.array(corrected(case, data, rounds)).reshape(-1, 2)
        what = "one round" if rounds == 1 else "three rounds"
        before, after = (f"{100 * value:.0f}" for value in seen.mean(0)) if len(seen) else ("-", "-")
        worse = int((seen[:, 1] < seen[:, 0] - WORSE).sum())
        cells |= {f"{what}: masks": len(seen), f"{what}: before": before, f"{what}: after": after}
        cells |= {f"{what}: worse": worse}
    return cells


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="where the real sequences are")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("corrections.md"), metavar="FILE")
    args = parser.parse_args()
    warnings.simplefilter("ignore", Doubt)
    rows = []
    for case in CASES:
        rows.append(row(case, args.data))
        print(rows[-1], flush=True)
    shares = {"poor": 100 * POOR, "wrong": 100 * WRONG, "worse": 100 * WORSE}
    args.out.write_text(PAGE.format(machine=in_a_line(), clicks=CLICKS, rows=as_markdown(DataFrame(rows)), **shares))


if __name__ == "__main__":
    main()
