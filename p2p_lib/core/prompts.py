"""Prompts: what is given of an object in one frame, as positive and negative clicks, a box or a mask."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depths_at
from p2p_lib.core.errors import BadInput, doubt, wrong_size
from p2p_lib.core.files import file_name
from p2p_lib.core.image import in_mask
from p2p_lib.core.types import Frame

#: Clicks of one kind on an object in a frame.
MOST_CLICKS = 1000
#: What of a box's sides is left out on each side of its middle, as far as depth has to be looked for.
_MIDDLES = (0.35, 0.2, 0.1)
#: Of the pixels of two masks so many in both: they are of one object.
_ONE_OBJECT = 0.9


@dataclass(frozen=True, eq=False)
class Prompt:
    """What starts an object or corrects its mask.

    frame        index of the frame that it is said of
    points_px    (N, 2) pixels on the object
    negative_px  (M, 2) pixels that are not of it
    box_px       (4,) left, top, right, bottom: all of the object is inside; None where nobody says
    mask         (H, W) bool: these pixels are the object, none where it is hidden; None where nobody says

    The arrays are copied.
    """

    name: str
    frame: int = 0
    points_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    negative_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    box_px: np.ndarray | None = None
    mask: np.ndarray | None = None

    def __post_init__(self) -> None:
        file_name("object name", self.name)
        if isinstance(self.frame, bool) or not isinstance(self.frame, int | np.integer) or self.frame < 0:
            raise BadInput(f"prompt of {self.name!r}", f"frame {self.frame!r}", "a whole number from 0")
        for key, what in (("points_px", "clicks on"), ("negative_px", "negative clicks of")):
            object.__setattr__(self, key, _pixels(f"{what} {self.name!r}", getattr(self, key)))
        if self.box_px is not None:
            object.__setattr__(self, "box_px", _box(f"box around {self.name!r}", self.box_px))
        if self.mask is not None:
            object.__setattr__(self, "mask", _mask(f"mask of {self.name!r}", self.mask))
        if not len(self.points_px) and not len(self.negative_px) and self.box_px is None and self.mask is None:
            raise BadInput(f"clicks on {self.name!r}", "none", "at least one [x, y] in pixels, a box or a mask")
        if self.mask is not None and (len(self.points_px) or len(self.negative_px) or self.box_px is not None):
            raise BadInput(f"object {self.name!r}", "a mask and clicks", "one of them", "A mask needs no clicks.")

    @property
    def starts(self) -> bool:
        """Whether an object can be started by it: something has to be said of where it is."""
        return bool(len(self.points_px) or self.box_px is not None or (self.mask is not None and self.mask.any()))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as files of prompts and ``run.json`` keep them; of a mask its number of pixels."""
        plain: dict[str, Any] = {"name": self.name, "frame": int(self.frame)}
        given = {"points": self.points_px, "negative": self.negative_px, "box": self.box_px}
        plain |= {key: value.tolist() for key, value in given.items() if value is not None and len(value)}
        return plain if self.mask is None else plain | {"mask_px": int(self.mask.sum())}


def check_prompt(prompt: Prompt, camera: Camera, where: str = "") -> None:
    """Refuse what does not lie in the image; :class:`BadInput` names the object, the frame's size and what to do.

    where  says of which frame it is, if anybody knows: " in frame 3"
    """
    name, size = prompt.name, f"{camera.width}x{camera.height}"
    for what, at in (("clicks on", prompt.points_px), ("negative clicks of", prompt.negative_px)):
        outside = ~camera.inside(at, -0.5)
        if outside.any():
            raise BadInput(f"{what} {name!r}{where}", _pixel(at[outside][0]), f"pixels within {size}")
    if prompt.box_px is not None:
        left, top, right, bottom = prompt.box_px
        if right < 0 or bottom < 0 or left > camera.width - 1 or top > camera.height - 1:
            raise BadInput(f"box around {name!r}", prompt.box_px.tolist(), f"a box within {size}")
    if prompt.mask is not None:
        check_mask(name, prompt.mask, camera)
        if prompt.mask.all():
            fix = "Draw the object alone; is the mask inverted?"
            raise BadInput(f"mask of {name!r}", "the whole image", "the object's pixels", fix)
    if _meet(prompt.points_px, prompt.negative_px):
        raise BadInput(f"clicks on {name!r}", "a positive and a negative click on one pixel", "one or the other")


def check_frame(frame: Frame, camera: Camera) -> None:
    """Refuse what is no frame, and one of another size than the camera's images."""
    if not isinstance(frame, Frame):
        got = f"{type(frame).__name__} {getattr(frame, 'shape', '')}".strip()
        raise BadInput("frame", got, "Frame(index, time_s, rgb, depth_m)", "Colour needs its depth and its time.")
    if frame.shape != (camera.height, camera.width):
        raise wrong_size(f"frame {frame.index}", frame.shape, (camera.height, camera.width), "the camera")


def check_mask(name: str, mask: np.ndarray | None, camera: Camera) -> None:
    """Refuse a mask of another size than the camera's images; none at all is fine."""
    if mask is not None and mask.shape != (camera.height, camera.width):
        raise wrong_size(f"mask of {name!r}", mask.shape, (camera.height, camera.width), "the camera")


def doubt_spelling(name: str, known: Collection[str]) -> None:
    """Warn of an object that is not ``known`` but called as one that is, but for capitals, blanks or underscores."""

    def plain(name: str) -> str:
        return re.sub(r"[\s_-]", "", name).casefold()

    called = {plain(other): other for other in known}
    if (like := called.get(plain(name))) and name not in known:
        got = f"another one than {like!r}, which is known"
        doubt(f"object {name!r}", got, f"To correct that one, write {like!r}.", name)


def check_apart(others: Iterable[Prompt], prompt: Prompt, where: str = "") -> None:
    """Refuse a click that is also another object's in the same frame, or on its mask, and a mask that is another's.

    ``where`` as above.
    """
    for other in others:
        check_not_on(prompt, other, where)
        if prompt.mask is not None and other.mask is not None and other.name != prompt.name:
            both, either = (prompt.mask & other.mask).sum(), (prompt.mask | other.mask).sum()
            if both > _ONE_OBJECT * either:
                got = f"{both} of its {prompt.mask.sum()} pixels are also of {other.name!r}{where}"
                raise BadInput(f"mask of {prompt.name!r}", got, "another object's pixels", "Leave one of them out.")
        if _meet(other.points_px, prompt.points_px):
            got = f"a click that is also one of {other.name!r}"
            raise BadInput(f"clicks on {prompt.name!r}", got, "a pixel that belongs to one object only")


def check_depth(prompt: Prompt, frame: Frame) -> None:
    """Refuse clicks none of which has depth, for they say where in space the object is; a box or mask without any."""
    at = prompt.points_px
    measured = np.isfinite(depths_at(at, frame)).any()
    if prompt.box_px is not None and not measured and not len(points_in_box(prompt.box_px, frame)):
        got = f"no depth inside it in frame {frame.index}"
        raise BadInput(f"box around {prompt.name!r}", got, "measured pixels", "Draw it around something with depth.")
    if prompt.box_px is None and len(at) and not measured:
        got = f"{_pixel(at[0])} has no depth in frame {frame.index}"
        fix = "Click next to the hole, or draw a box."
        raise BadInput(f"clicks on {prompt.name!r}", got, "a pixel with a depth measurement", fix)
    if prompt.mask is not None and prompt.mask.any() and not (frame.depth_m[prompt.mask] > 0).any():
        got = f"no depth inside it in frame {frame.index}"
        raise BadInput(f"mask of {prompt.name!r}", got, "measured pixels", "Give it again in a frame with depth.")


def check_not_on(prompt: Prompt, other: Prompt, where: str = "") -> None:
    """Refuse a click on what another object's mask in the same frame says is the other's; ``where`` as above."""
    if other.name != prompt.name and other.mask is not None and (on := in_mask(prompt.points_px, other.mask)).any():
        got = f"{_pixel(prompt.points_px[on][0])} on the mask of {other.name!r}{where}"
        raise BadInput(f"clicks on {prompt.name!r}", got, "pixels of this object alone")


def given_masks(
    frame: Frame,
    masks: Mapping[str, np.ndarray | None],
    prompts: Mapping[str, Prompt],
    objects: Iterable[str],
    camera: Camera,
) -> tuple[dict[str, np.ndarray | None], dict[str, BadInput]]:
    """Every object's mask in a frame, by ``masks`` and ``prompts``; None for one that nobody gives.

    Also why what is said of some objects does not fit this frame: it is not used. Raises :class:`BadInput` for masks of
    unknown objects.
    """
    if not isinstance(masks, Mapping):
        raise BadInput("masks", type(masks).__name__, "a dictionary: the name of each object, and its mask (H, W) bool")
    if unknown := sorted(set(masks) - set(objects), key=str):
        known = ", ".join(objects) or "none yet"
        raise BadInput("masks", f"unknown object {unknown[0]!r}", f"objects added before: {known}")
    given = {name: Prompt(name, frame.index, mask=mask) for name, mask in masks.items() if mask is not None}
    for name, prompt in given.items():
        check_mask(name, prompt.mask, camera)
    for name, prompt in given.items():
        if prompt.mask is not None and prompt.mask.all():
            doubt(f"mask of {name!r}", f"the whole image in frame {frame.index}", "Is it inverted?", name)
    refused = {}
    for name, prompt in prompts.items():
        try:
            _check_clicks(prompt, frame, given)
        except BadInput as error:
            refused[name] = error
    given = {name: p for name, p in prompts.items() if p.mask is not None and name not in refused} | given
    return {name: given[name].mask if name in given else None for name in objects}, refused


def _check_clicks(prompt: Prompt, frame: Frame, given: Mapping[str, Prompt]) -> None:
    """Refuse a prompt that depth or the masks given with its frame contradict."""
    check_depth(prompt, frame)
    for other in given.values():
        check_not_on(prompt, other, f" in frame {frame.index}")
    if prompt.name in given and prompt.mask is None:
        fix = "Leave it out of the masks, or do not click on it."
        raise BadInput(f"mask of {prompt.name!r}", f"a mask and clicks in frame {frame.index}", "one of them", fix)


def points_in_box(box_px: np.ndarray, frame: Frame) -> np.ndarray:
    """(N, 2) pixels that stand for clicks on what a box (4,) is around: in its middle, the nearer half of them.

    Where the middle has no depth, as of a screen, they are from more of it.
    """
    at = np.zeros((0, 2))
    for margin in _MIDDLES:
        share = np.linspace(margin, 1 - margin, 5)
        u, v = box_px[0] + share * (box_px[2] - box_px[0]), box_px[1] + share * (box_px[3] - box_px[1])
        at = np.clip(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2), 0, np.array(frame.shape[::-1]) - 1)
        z_m = depths_at(at, frame)
        at, z_m = at[np.isfinite(z_m)], z_m[np.isfinite(z_m)]
        if len(at):
            return at[z_m <= np.median(z_m)]
    return at


def _pixels(what: str, given: Any) -> np.ndarray:
    """Pixels as (N, 2) float64."""
    try:
        at = np.array(given, float, ndmin=1)
    except (TypeError, ValueError):
        at = np.zeros((1, 1))
    if len(at) > MOST_CLICKS:
        raise BadInput(what, f"{len(at)} of them", f"at most {MOST_CLICKS}", "Give a mask.")
    if at.size and (at.ndim != 2 or at.shape[1] != 2 or not np.isfinite(at).all()):
        raise BadInput(what, repr(given)[:60], "at least one [x, y] in pixels: [[x, y], ...]")
    return at.reshape(-1, 2)


def _mask(what: str, given: Any) -> np.ndarray:
    """A mask as bool, of any shape; a copy."""
    expected = "(H, W) bool: the object's pixels"
    try:
        mask = np.asarray(given)
        on = mask.copy() if mask.dtype == bool else mask > 0
    except (TypeError, ValueError):
        raise BadInput(what, repr(given)[:60], expected) from None
    if mask.dtype != bool and on.any() and (least := mask[on].min()) != (most := mask[on].max()):
        fix = "Of probabilities `mask > 0.5`, of a label image `labels == k`."
        raise BadInput(what, f"values from {least:g} to {most:g}", expected, fix)
    return on


def _box(what: str, given: Any) -> np.ndarray:
    try:
        box = np.array(given, float)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape != (4,) or not np.isfinite(box).all() or box[0] >= box[2] or box[1] >= box[3]:
        fix = "Of x, y, width, height give x, y, x + width, y + height." if box.shape == (4,) else ""
        raise BadInput(what, repr(given)[:60], "[left, top, right, bottom] in pixels", fix)
    return box


def _meet(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two sets of pixels (N, 2) have one in common."""
    return bool((np.abs(one[:, None] - other).max(-1) < 1).any())


def _pixel(at: np.ndarray) -> str:
    return "({:g}, {:g})".format(*at)
