"""Objects of known scenes that nobody had clicked on, whatever the images show of them; from three clicks.

    python benchmarks/bench_other_objects.py OUT --data DIR [--seeds N]

Writes ``benchmarks/other_objects.md``; runs go below OUT, where what was cut short goes on. DIR holds the videos of
``other_objects.toml``. Nothing in them moves but the camera: a dataset's truth of one object is the truth of all.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_variants import Varied, columns, scored
from common import options, seeds_said, write_page

from p2p_lib.core import se3
from p2p_lib.core.image import in_image
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.sequence import ObjectTruth, open_sequence

SCENES = Path(__file__).parent / "other_objects.toml"
#: An object's points are within this of the middle depth inside its outline, m; so many of them are scored with.
_DEEP_M, _POINTS = 0.12, 1500
#: It is to be seen where this share of its points is in the image, and of these this share not behind something that
#: is nearer by so much, m.
_INSIDE, _FREE, _NEARER_M = 0.6, 0.6, 0.08
PAGE = """# Objects that nobody had clicked on

Written by `python benchmarks/bench_other_objects.py`; do not edit. {machine}

Real video, three clicks an object (`other_objects.toml`), started in the frame that is named, backwards down to frame
0. The scenes stand still, so that the truth of an object that the dataset has is theirs, too; scored with the points
that depth has inside an outline drawn by hand. From the second seed on clicks are off by 3 pixels. Nothing was chosen
while looking at them but `depth.max_m` (books, newspaper: 2.5 m and more away). Seeds {seeds}, in brackets the lowest
and highest; *lost*: frames in which it is to be seen and has no pose; *found again*: within ten frames, of all returns.

{rows}"""


@dataclass(frozen=True, eq=False)
class Others(Varied):
    """Objects of a scene ``made_of`` clicks and outlines; ``first`` is the frame that these are of."""

    made_of: Mapping[str, Any] = field(default_factory=dict)
    first: int = 0
    of: str = ""

    @property
    def objects(self) -> tuple[str, ...]:
        """All that were clicked on."""
        return tuple(self.made_of)

    @cached_property
    def _points(self) -> dict[str, np.ndarray]:
        return {name: self._outlined(one) for name, one in self.made_of.items()}

    def _outlined(self, one: dict[str, Any]) -> np.ndarray:
        """(N, 3) points of an object in the camera frame of the first frame."""
        depth_m, inside = self.original.frame(self.first).depth_m, np.zeros(self._shape, np.uint8)
        cv2.fillPoly(inside, [np.array(one["outline"], np.int32)], 1)
        middle_m = np.median(depth_m[(inside > 0) & (depth_m > 0)])
        v, u = np.nonzero((inside > 0) & (np.abs(depth_m - middle_m) < _DEEP_M))
        every = self.camera.unproject(np.stack([u, v], -1).astype(float), depth_m[v, u])
        return every[np.random.default_rng(0).permutation(len(every))[:_POINTS]]

    @property
    def _shape(self) -> tuple[int, int]:
        return self.camera.height, self.camera.width

    @property
    def truth(self) -> dict[str, ObjectTruth]:
        """Model frames are the camera's at the first frame, about the middle of an object's points."""
        T_cam_of = self.original.truth[self.of].T_cam_model
        T_cam_first = (T_cam_of @ se3.inverse(T_cam_of[self.first]))[self.at]
        found = {}
        for name, points in self._points.items():
            T_first_model = se3.from_rt(np.eye(3), points.mean(0))
            labelled = [self._to_be_seen(int(i), T, points) for i, T in zip(self.at, T_cam_first, strict=True)]
            found[name] = ObjectTruth(T_cam_first @ T_first_model, np.array(labelled))
        return found

    def _to_be_seen(self, i: int, T_cam_first: np.ndarray, points: np.ndarray) -> bool:
        p_cam = se3.transform(T_cam_first, points)
        uv_px = self.camera.project(p_cam)
        inside = in_image(uv_px, self._shape) & (p_cam[:, 2] > 0)
        if inside.mean() < _INSIDE:
            return False
        u, v = uv_px[inside].astype(int).T
        measured_m = self.original.frame(i).depth_m[v, u]
        hidden = (measured_m > 0) & (measured_m < p_cam[inside, 2] - _NEARER_M)
        return bool(hidden.mean() <= 1 - _FREE)

    def masks(self, i: int) -> None:
        """None: nobody has any."""

    def visible_px(self, i: int) -> None:
        """None."""

    def models(self, folder: Path) -> dict[str, Path]:
        """A file of each object's points in its model frame."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, points in self._points.items():
            np.savetxt(folder / f"{name}.xyz", points - points.mean(0))
        return {name: folder / f"{name}.xyz" for name in self.objects}

    def prompts(self, seed: int) -> list[Prompt]:
        """Three clicks on each."""
        rng, off_px = np.random.default_rng(seed), 3 * bool(seed)
        clicks = {name: np.array(one["points"], float) for name, one in self.made_of.items()}
        return [Prompt(name, 0, of + off_px * rng.normal(size=of.shape)) for name, of in clicks.items()]


def main() -> None:
    """See the module."""
    asked = options(seeds=2).parse_args()
    rows = []
    for scene in tomllib.loads(SCENES.read_text())["scene"]:
        name, first = scene["video"], scene["frame"]
        video = open_sequence(next(asked.data.glob(f"**/{name}")))
        ways = {"": np.arange(first, len(video)), "one image of two": np.arange(first, len(video), 2)}
        ways |= {"backwards": np.arange(first, -1, -1)} if first else {}
        for way, at in ways.items():
            others = Others(
                video,
                f"{name}_{first}_{way.replace(' ', '_')}",
                at,
                made_of=scene["objects"],
                first=first,
                of=scene["of"],
            )
            models = others.models(asked.out / "models" / others.name)
            runs = [asked.out / f"{others.name}_{seed}" for seed in range(asked.seeds)]
            how = [{"prompts": others.prompts(seed), "models": models} for seed in range(asked.seeds)]
            scores = scored(others, how, runs)
            for one in others.objects:
                of_one = columns([[of_seed[one]] for of_seed in scores])
                rows.append({"video": f"{name} from {first}", "": way, "object": one.replace("_", " "), **of_one})
    write_page("other_objects", PAGE, seeds=seeds_said(asked.seeds), rows=rows)


if __name__ == "__main__":
    main()
