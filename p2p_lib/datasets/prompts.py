"""Prompts on disk: what somebody says of objects, in pixels of frames, as ``p2p click`` writes it.

``{"objects": [{"name": "mug", "frame": 0, "points": [[x, y], ...]}]}``. An entry has ``points`` (clicks on the object),
``negative`` (clicks that are not on it), ``box`` (left, top, right, bottom) or ``mask``: an image beside the file, 0 =
not the object, or COCO's run lengths ``{"size": [height, width], "counts": [...]}``. An object's first entry starts it,
those of later frames correct its mask.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depths_at
from p2p_lib.core.errors import BadInput, did_you_mean
from p2p_lib.core.files import file_name, parse_json, read_text, replace_text
from p2p_lib.core.prompts import Prompt, check_apart, check_prompt, doubt_spelling
from p2p_lib.core.types import Frame
from p2p_lib.datasets.images import read_image, save_png
from p2p_lib.datasets.sequence import Sequence

_FORM = '{"objects": [{"name": "mug", "frame": 0, "points": [[x, y], ...]}]}'
_MOST = 2000
_MOST_PX = 100_000_000  # of a mask
#: What an entry may have.
KEYS = frozenset({"name", "frame", "points", "negative", "box", "mask"})
#: Clicks that are drawn from a mask lie within this share of its inscribed circle.
_WELL_INSIDE = 0.6
#: A mask that grows by more than this from frame to frame belongs to an object still coming into view.
_GROWTH = 1.1


def load_prompts(path: str | Path) -> tuple[Prompt, ...]:
    """The prompts of a file.

    Raises :class:`MissingData` where there is no file, :class:`BadInput` where it does not fit.
    """
    path = Path(path)
    text = read_text(path, f"prompts, {_FORM}", fix=f"Make some: p2p click SEQ --out {path}")
    content = parse_json(text, str(path), _FORM)
    try:
        return parse_prompts(content, path.parent)
    except BadInput as error:
        raise BadInput(f"{path}: {error.name}", error.got, error.expected, error.fix) from None


def parse_prompts(content: object, folder: Path | None = None) -> tuple[Prompt, ...]:
    """The prompts in the plain values of a JSON file; :class:`BadInput` where they do not fit.

    folder  where the images of masks lie; None allows none, but run lengths
    """
    objects = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(objects, list) or not objects:
        raise BadInput("prompts", str(content)[:60], _FORM)
    if len(objects) > _MOST:
        raise BadInput("prompts", f"{len(objects)} entries", f"at most {_MOST}")
    prompts = [_prompt(given, folder) for given in objects]
    (name, frame), count = Counter((p.name, p.frame) for p in prompts).most_common(1)[0]
    if count > 1:
        expected = "one entry per object and frame, with all its points"
        raise BadInput("prompts", f"{name!r} in frame {frame} twice", expected)
    return tuple(prompts)


def _prompt(given: Any, folder: Path | None) -> Prompt:
    """An entry of a file."""
    if isinstance(given, dict) and (unknown := sorted(map(str, given.keys() - KEYS))):
        expected = f"some of {', '.join(sorted(KEYS))}"
        raise BadInput(f"prompts: an object {str(given)[:60]}", unknown[0], expected, did_you_mean(unknown[0], KEYS))
    if not isinstance(given, dict) or not {"name"} < given.keys():
        raise BadInput("prompts", f"the object {str(given)[:60]}", _FORM)
    mask = None
    if isinstance(given.get("mask"), dict):
        mask = _of_runs(f"mask of {given['name']!r}", given["mask"])
    elif given.get("mask") is not None:
        if folder is None or not isinstance(given["mask"], str):
            runs = 'run lengths {"size": [height, width], "counts": [...]}'
            expected = runs if folder is None else f"an image beside the prompts, or {runs}"
            raise BadInput(f"mask of {given['name']!r}", repr(given["mask"])[:60], expected)
        mask = read_image(folder / given["mask"], cv2.IMREAD_GRAYSCALE, "a mask image") > 0
    called = {"points_px": "points", "negative_px": "negative", "box_px": "box"}
    fields: dict[str, Any] = {field: given[key] for field, key in called.items() if given.get(key) is not None}
    return Prompt(given["name"], given.get("frame", 0), **fields, mask=mask)


def run_lengths(mask: np.ndarray) -> dict[str, list[int]]:
    """A mask (H, W) as COCO's uncompressed run lengths: column by column, how many pixels are not it, are, are not, ...

    >>> run_lengths(np.array([[True, True], [True, False]]))
    {'size': [2, 2], 'counts': [0, 3, 1]}
    """
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(flat, prepend=False))
    return {"size": list(mask.shape), "counts": np.diff([0, *changes, flat.size]).tolist()}


def as_entry(prompt: Prompt) -> dict[str, Any]:
    """As :func:`parse_prompts` reads it without a folder: with the mask itself, as run lengths."""
    plain = prompt.as_dict()
    plain.pop("mask_px", None)
    return plain if prompt.mask is None else plain | {"mask": run_lengths(prompt.mask)}


def _of_runs(what: str, given: Any) -> np.ndarray:
    """The mask of run lengths."""
    try:
        height, width = map(int, given["size"])
        counts = np.array(given["counts"], int)
        total = sum(counts.tolist())  # which cannot overflow, as numpy's can
        if min(height, width, counts.min()) < 0 or not 0 < total == height * width <= _MOST_PX:
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError):
        expected = '{"size": [height, width], "counts": [...]} that add up to its pixels'
        raise BadInput(what, str(given)[:60], expected) from None
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(width, height).T


def prompts_by_frame(
    prompts: Iterable[Prompt], frames: range, camera: Camera, started: Iterable[str] = ()
) -> dict[int, tuple[Prompt, ...]]:
    """The prompts of each frame, checked; objects that are ``started`` otherwise may only be corrected.

    Raises :class:`BadInput` for one of no frame, outside the image, or on two objects, and for an object whose first
    says only what is not it.
    """
    found: dict[int, tuple[Prompt, ...]] = {}
    known = dict.fromkeys(started)
    for prompt in sorted(prompts, key=lambda p: p.frame):
        who = f"prompt of {prompt.name!r}"
        if prompt.frame not in frames:
            fix = "Click in one of these, or take the run's first frame from there."
            raise BadInput(who, f"frame {prompt.frame}", f"a frame from {frames[0]} to {frames[-1]}", fix)
        where = f" in frame {prompt.frame}"
        check_prompt(prompt, camera, where)
        check_apart(found.setdefault(prompt.frame, ()), prompt, where)
        found[prompt.frame] += (prompt,)
        if not prompt.starts and prompt.name not in known:
            fix = "Click on it in that frame or before."
            raise BadInput(who, f"nothing on it in frame {prompt.frame}", "a click, a box or a mask first", fix)
        doubt_spelling(prompt.name, known)
        known[prompt.name] = None
    return found


def prompts_in(masks: Mapping[str, np.ndarray], frame: int = 0) -> tuple[Prompt, ...]:
    """One click in each mask (H, W) that is not empty, where it is farthest from the rim: where one would click."""
    found = {name: _deepest(mask)[0] for name, mask in masks.items() if mask.any()}
    return tuple(Prompt(name, frame, np.array([at], float)) for name, at in found.items())


def first_prompts(
    sequence: Sequence, frames: range, objects: Iterable[str], min_px: int, clicks: int, rng: np.random.Generator
) -> tuple[Prompt, ...]:
    """What starts each object, of its first usable mask: one large enough, which has stopped growing.

    clicks  so many pixels of it, drawn well inside where depth is measured; 0: the mask itself
    """
    found: dict[str, Prompt] = {}
    before: dict[str, int] = {}
    wanted = set(objects)
    for i in frames:
        masks = {name: mask for name, mask in (sequence.masks(i) or {}).items() if name in wanted - found.keys()}
        for name, mask in sorted(masks.items()):
            pixels = int(mask.sum())
            if pixels >= min_px and pixels <= _GROWTH * before.get(name, pixels):
                points = _drawn(mask, sequence.frame(i), clicks, rng) if clicks else np.zeros((0, 2))
                if len(points) == clicks:
                    found[name] = Prompt(name, i, points, mask=None if clicks else mask)
            before[name] = pixels
        if wanted <= found.keys():
            break
    return tuple(found.values())


def _deepest(mask: np.ndarray) -> tuple[np.ndarray, float]:
    """The pixel (2,) of a mask that is farthest from its rim, and how far."""
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    v, u = np.unravel_index(int(depth.argmax()), depth.shape)
    return np.array([u, v]), float(depth.max())


def _drawn(mask: np.ndarray, frame: Frame, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 2) pixels with depth, the first at the mask's deepest place; fewer where there are none."""
    at, radius = _deepest(mask)
    v, u = np.nonzero(mask)
    px = np.stack([u, v], -1)
    away = np.linalg.norm(px - at, axis=1)
    near = (away <= max(_WELL_INSIDE * radius, 1)) & np.isfinite(depths_at(px, frame, 0))
    px = px[near][np.argsort(away[near], kind="stable")]
    if len(px) < count:
        return px[:0].astype(float)
    return px[[0, *(1 + rng.choice(len(px) - 1, count - 1, replace=False))]].astype(float)


def save_prompts(path: str | Path, prompts: Iterable[Prompt]) -> Path:
    """Write prompts as :func:`load_prompts` reads them; their masks as images beside the file."""
    path = Path(path)
    objects = []
    for prompt in prompts:
        plain = prompt.as_dict()
        if prompt.mask is not None:
            del plain["mask_px"]
            plain["mask"] = f"{path.stem}_{file_name('object name', prompt.name)}_{prompt.frame}.png"
            save_png(path.parent / plain["mask"], prompt.mask)
        objects.append(plain)
    replace_text(path, json.dumps({"objects": objects}, indent=1) + "\n")
    return path
