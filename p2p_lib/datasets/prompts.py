"""Clicks on objects, on disk: ``{"objects": [{"name": "mug", "frame": 0, "points": [[x, y], ...]}]}`` in pixels."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.clicks import check_apart, check_clicks
from p2p_lib.core.errors import BadInput, MissingData

_FORM = '{"objects": [{"name": "mug", "frame": 0, "points": [[x, y], ...]}]}'


@dataclass(frozen=True, eq=False)
class Prompt:
    """The clicks on one object: points_px (N, 2) float64 in the frame of this index."""

    name: str
    frame: int
    points_px: np.ndarray

    def __post_init__(self) -> None:
        who = f"prompt of {self.name!r}"
        if not isinstance(self.name, str) or not self.name:
            raise BadInput("prompt", f"the name {self.name!r}", "a word")
        if isinstance(self.frame, bool) or not isinstance(self.frame, int) or self.frame < 0:
            raise BadInput(who, f"frame {self.frame!r}", "a whole number from 0")
        try:
            points = np.array(self.points_px, float)
        except (TypeError, ValueError):
            points = np.zeros(0)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
            raise BadInput(who, f"points {str(self.points_px)[:60]}", "at least one [x, y] in pixels")
        object.__setattr__(self, "points_px", points)


def load_prompts(path: str | Path) -> tuple[Prompt, ...]:
    """The prompts of a file, one per object.

    Raises :class:`MissingData` where there is no file, :class:`BadInput` where it does not fit.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingData(str(path), "no such file of prompts", f"Make one: p2p click SEQ --out {path}") from None
    except (ValueError, OSError) as error:
        raise BadInput(str(path), f"unreadable JSON ({error})", _FORM) from None
    try:
        return parse_prompts(content)
    except BadInput as error:
        raise BadInput(f"{path}: {error.name}", error.got, error.expected, error.fix) from None


def parse_prompts(content: object) -> tuple[Prompt, ...]:
    """The prompts in the plain values of a JSON file; :class:`BadInput` where they do not fit."""
    objects = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(objects, list) or not objects:
        raise BadInput("prompts", str(content)[:60], _FORM)
    prompts = []
    for given in objects:
        if not isinstance(given, dict) or not {"name", "points"} <= given.keys() <= {"name", "frame", "points"}:
            raise BadInput("prompts", f"the object {str(given)[:60]}", _FORM)
        prompts.append(Prompt(given["name"], given.get("frame", 0), given["points"]))
    names = [p.name for p in prompts]
    if twice := [name for name in names if names.count(name) > 1]:
        raise BadInput("prompts", f"{twice[0]!r} twice", "one entry per object, with all its points")
    return tuple(prompts)


def clicks_by_frame(prompts: Iterable[Prompt], frames: range, camera: Camera) -> dict[int, dict[str, np.ndarray]]:
    """Frame to the clicks (N, 2) in it by object.

    Raises :class:`BadInput` for a click in no frame, outside the image, or on two objects.
    """
    clicked: dict[int, dict[str, np.ndarray]] = {}
    for prompt in prompts:
        if prompt.frame not in frames:
            expected = f"a frame from {frames[0]} to {frames[-1]}"
            raise BadInput(f"prompt of {prompt.name!r}", f"frame {prompt.frame}", expected)
        clicks = check_clicks(prompt.name, prompt.points_px, camera)
        check_apart(prompt.name, clicks, clicked.setdefault(prompt.frame, {}))
        clicked[prompt.frame][prompt.name] = clicks
    return clicked


def prompts_in(masks: Mapping[str, np.ndarray], frame: int = 0) -> tuple[Prompt, ...]:
    """One click in each mask (H, W) that is not empty, where it is farthest from the rim: where one would click."""
    depths = {name: cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, 5) for name, m in masks.items() if m.any()}
    places = {name: np.unravel_index(int(depth.argmax()), depth.shape)[::-1] for name, depth in depths.items()}
    return tuple(Prompt(name, frame, np.array([place], float)) for name, place in places.items())


def save_prompts(path: str | Path, prompts: Iterable[Prompt]) -> Path:
    """Write prompts as :func:`load_prompts` reads them."""
    path = Path(path)
    objects = [{"name": p.name, "frame": p.frame, "points": p.points_px.tolist()} for p in prompts]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"objects": objects}, indent=1) + "\n", encoding="utf-8")
    return path
