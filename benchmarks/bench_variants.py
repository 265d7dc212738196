"""Real sequences as nobody has filmed them: mirrored, turned, with fewer images a second, backwards; from three clicks.

    python benchmarks/bench_variants.py OUT --data DIR [--seeds N] [--only NAME ...]

Writes ``benchmarks/variants.md``; runs go below OUT, where what was cut short goes on. What works on a known video by
chance, or by what was chosen while looking at it, breaks here. DIR holds the sequences of ``VIDEOS`` and the clicks,
``prompts/NAME.json``, of those that have no masks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import options, seeds_said, tracked, write_page

from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame
from p2p_lib.datasets.prompts import load_prompts
from p2p_lib.datasets.sequence import ObjectTruth, Sequence, open_sequence
from p2p_lib.evaluation.protocol import ObjectScore, evaluate

VIDEOS = ("desk_fast", "redkitchen_table")
#: Objects of fewer pixels in the first frame are not clicked on.
_LEAST_PX = 600
PAGE = """# Known videos as nobody has filmed them

Written by `python benchmarks/bench_variants.py`; do not edit. {machine}

Real video, three clicks an object; where the dataset has masks they are drawn inside that of the first frame. Mean over
objects and seeds {seeds}, in brackets the lowest and highest seed; *lost*: frames in which an object is to be seen and
has no pose; *found again*: within ten frames, of all returns after complete occlusion or out of view. With one image of
three everything moves three times as far.

{rows}"""


@dataclass(frozen=True, eq=False)
class Varied:
    """A :class:`~p2p_lib.datasets.sequence.Sequence` of some frames of another, ``at`` (N,), mirrored or turned.

    quarters  of a turn of the image, clockwise
    """

    # ruff: noqa: D102  # what they are is said there

    original: Sequence
    name: str
    at: np.ndarray
    mirrored: bool = False
    quarters: int = 0
    path: Path | None = None

    def __len__(self) -> int:
        return len(self.at)

    @property
    def format(self) -> str:
        return self.original.format

    @property
    def objects(self) -> tuple[str, ...]:
        return self.original.objects

    @property
    def model_places(self) -> Mapping[str, tuple[Path, ...]]:
        return self.original.model_places

    @property
    def frame_names(self) -> tuple[str, ...]:
        return tuple(self.original.frame_names[i] for i in self.at)

    @property
    def times_s(self) -> np.ndarray:
        times_s = self.original.times_s[self.at]
        return np.abs(times_s - times_s[0])

    @property
    def camera(self) -> Camera:
        of = self.original.camera
        size, centre = np.array([of.width, of.height]), self.px(np.array([[of.cx, of.cy]]))[0]
        (fx, fy), (width, height) = (np.roll(pair, self.quarters) for pair in ([of.fx, of.fy], size))
        return Camera(float(fx), float(fy), float(centre[0]), float(centre[1]), int(width), int(height))

    def px(self, uv_px: np.ndarray) -> np.ndarray:
        """Where pixels (K, 2) of the original are."""
        u, v = np.asarray(uv_px, float).T
        last = np.array([self.original.camera.width, self.original.camera.height]) - 1
        u = last[0] - u if self.mirrored else u
        for _ in range(self.quarters):
            u, v, last = last[1] - v, u, last[::-1]
        return np.stack([u, v], -1)

    def image(self, pixels: np.ndarray) -> np.ndarray:
        """An image (H, W, ...) of the original."""
        return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if self.mirrored else pixels, -self.quarters))

    @property
    def truth(self) -> dict[str, ObjectTruth]:
        """A mirrored object is another one: its truth is mirrored on both sides, which keeps it a rotation."""
        mirror, turn = np.diag([-1.0 if self.mirrored else 1.0, 1, 1, 1]), np.eye(4)
        turn[:2, :2] = np.linalg.matrix_power([[0, -1], [1, 0]], self.quarters)
        every = self.original.truth.items()
        return {
            name: ObjectTruth(turn @ mirror @ of.T_cam_model[self.at] @ mirror, of.labelled[self.at])
            for name, of in every
        }

    def frame(self, i: int) -> Frame:
        of = self.original.frame(int(self.at[i]))
        return Frame(i, float(self.times_s[i]), self.image(of.rgb), self.image(of.depth_m))

    def masks(self, i: int) -> dict[str, np.ndarray] | None:
        masks = self.original.masks(int(self.at[i]))
        return None if masks is None else {name: self.image(mask) for name, mask in masks.items()}

    def visible_px(self, i: int) -> dict[str, int] | None:
        return self.original.visible_px(int(self.at[i]))


def variants(video: Sequence) -> list[Varied]:
    """As it is, and otherwise."""
    every = np.arange(len(video))
    return [
        Varied(video, "as it is", every),
        Varied(video, "mirrored", every, mirrored=True),
        Varied(video, "turned by 90 degrees", every, quarters=1),
        Varied(video, "upside down", every, quarters=2),
        Varied(video, "one image of two", every[::2]),
        Varied(video, "one image of three", every[::3]),
        Varied(video, "backwards", every[::-1]),
    ]


def starts(of: Varied, clicks: Path) -> dict[str, object] | None:
    """How a run of it starts; None where nobody has clicked on its first frame."""
    if first := of.masks(0):
        large = [name for name, mask in first.items() if mask.sum() >= _LEAST_PX]
        return {"masks": "clicks", "objects": large}
    if of.at[0] or not clicks.is_file():
        return None
    return {"prompts": [replace(prompt, points_px=of.px(prompt.points_px)) for prompt in load_prompts(clicks)]}


def main() -> None:
    """See the module."""
    parser = options(seeds=2)
    parser.add_argument("--only", nargs="+", choices=VIDEOS, default=VIDEOS)
    asked = parser.parse_args()
    rows = []
    for name in asked.only:
        video = open_sequence(next(asked.data.glob(f"**/{name}")))
        for of in variants(video):
            how = starts(of, next(asked.data.glob(f"**/prompts/{name}.json"), Path()))
            if how is not None:
                runs = [asked.out / f"{name}_{of.name.replace(' ', '_')}_{seed}" for seed in range(asked.seeds)]
                scores = [list(of_seed.values()) for of_seed in scored(of, [how] * asked.seeds, runs)]
                rows.append({"video": name, "": of.name, **columns(scores)})
    write_page("variants", PAGE, seeds=seeds_said(asked.seeds), rows=rows)


def scored(of: Varied, starts: list[dict], runs: list[Path]) -> list[dict[str, ObjectScore]]:
    """An object's score by its name, of each seed: how it starts, and the folder that it is tracked into."""
    scores = []
    for seed, (how, out) in enumerate(zip(starts, runs, strict=True)):
        scores.append(evaluate(tracked(of, out, seed=seed, **how)).objects)
    return scores


def columns(scores: list[list[ObjectScore]]) -> dict[str, object]:
    """What is said of some objects, whose scores are given by seed."""
    every = [score for seed in scores for score in seed]
    returns = [event.frames_to_recovery for score in every for event in score.returns]
    late = sum(frames is None or frames > 10 for frames in returns)
    aucs = {
        f"{head} [%]": [np.mean([score.as_dict()[key] for score in seed]) for seed in scores]
        for head, key in (("ADD-S", "adds_auc"), ("ADD", "add_auc"))
    }
    said = {head: f"{np.mean(by):.1f} ({min(by):.1f} to {max(by):.1f})" for head, by in aucs.items()}
    frames = sum(len(score.frame_index) for score in every)
    lost = f"{sum(score.lost for score in every)} of {frames}"
    return {**said, "lost": lost, "found again": f"{len(returns) - late} of {len(returns)}" if returns else "none"}


if __name__ == "__main__":
    main()
