"""The click page on a camera's newest image: ``p2p live --click``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from p2p_lib.apps.click import Clicker
from p2p_lib.apps.live_words import Words
from p2p_lib.core.depth_edges import depth_step_m
from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.cameras import LiveCamera, Stream
from p2p_lib.datasets.prompts import parse_prompts, run_lengths
from p2p_lib.segmenters.builtin.patch import dilated

#: A colour that is so much another, of 255, is no noise; what has moved differs in so large a share of its colours, or
#: of its depths. By these a mask is refused from where 0.92 of it is still right on, and always below 0.88.
_OTHER_COLOUR, _COLOURS, _DEPTHS = 25, 0.3, 0.2
#: A correction is judged by what is so near its clicks, pixels.
_NEAR_PX = 8


@dataclass(frozen=True, eq=False)
class _Shown(Stream):
    """The image that the page shows, under the number that the camera gave it."""

    def __len__(self) -> int:
        return 1 if self.kept is None else self.kept.index + 1


class LiveClicker(Clicker):
    """A page that shows what was tracked last; what is sent there is heard as a line of JSON would be.

    The image stands while somebody clicks on it. What was said of it holds for the next frame as long as nothing has
    moved there meanwhile.

    words  says it to the tracker, for its next frame
    """

    def __init__(self, camera: LiveCamera, words: Words, port: int = 0):
        self._words = words
        self._newest: tuple[Frame | None, dict[str, np.ndarray]] = (None, {})
        self._shown: Frame | None = None
        self._masks: dict[str, np.ndarray] = {}
        self._names: tuple[str, ...] = ()
        super().__init__(_Shown(camera.name, camera.camera), "", port=port)

    def see(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> None:
        """What is shown next: a frame with the masks (H, W) bool of all objects, None where unknown."""
        self._names = tuple(masks)
        self._newest = frame, {name: mask for name, mask in masks.items() if mask is not None}

    def session(self) -> dict[str, Any]:
        """The newest image is the one shown from now on: the page does not ask while somebody clicks on it."""
        self._shown, self._masks = self._newest
        self.sequence = replace(self.sequence, kept=self._shown)  # type: ignore[type-var]  # it is a _Shown
        newest = {"first": len(self.sequence) - 1, "names": list(self._names), "run": True, "live": True}
        return super().session() | newest

    def kept_masks(self, i: int) -> dict[str, np.ndarray]:
        """Those of the image that is shown."""
        return dict(self._masks)

    def checked(self, content: object, started: Iterable[str] = ()) -> tuple[Prompt, ...]:
        """The prompts that the page sends of the image that it shows; no other one is kept."""
        for prompt in parse_prompts(content):
            if self._shown is None or prompt.frame != self._shown.index:
                expected = (
                    f"frame {self._shown.index}, the one that is shown" if self._shown else "one, but none has come"
                )
                fix = "Click on the newest image. Is the page open twice?"
                raise BadInput(f"prompt of {prompt.name!r}", f"frame {prompt.frame}", expected, fix)
        return super().checked(content, started)

    def save(self, content: object) -> str:
        """Check prompts as the page sends them, or take ``{"remove": name}``, and have the tracker told.

        An object starts with the mask that its clicks make in the image that is shown. Where something has moved since,
        the tracker is told nothing of it; what is given says so.
        """
        if isinstance(content, dict) and content.keys() == {"remove"}:
            self._words.hear(json.dumps(content))
            return ""
        prompts, then, now = self.checked(content, self._names), self._shown, self._newest[0]
        if then is None or now is None:
            return ""  # checked above
        made, _ = self.made([prompt for prompt in prompts if prompt.mask is None], self._masks)
        said: list[dict[str, Any]] = []
        moved: list[dict[str, Any]] = []
        for prompt, entry in zip(prompts, content["objects"]):  # type: ignore[index]  # it has been parsed
            if prompt.mask is not None:
                mask = prompt.mask
            elif prompt.name in self._names:
                mask = _near(prompt, then.shape)
            else:
                mask = made[prompt.name]
                if not mask.any():
                    fix = "Click on another place of it."
                    raise BadInput(f"clicks on {prompt.name!r}", "nothing found there", "an object", fix)
                entry = {"name": prompt.name, "mask": run_lengths(mask)}
            (moved if now is not then and _moved(then, now, mask) else said).append(entry)
        if said:
            self._words.hear(json.dumps({"objects": said}))
        return f"The image has moved on at {', '.join(entry['name'] for entry in moved)}: click again." if moved else ""


def _near(prompt: Prompt, shape: Sequence[int]) -> np.ndarray:
    """(H, W) bool: the pixels that a prompt without a mask is about."""
    region = np.zeros(shape, np.uint8)
    for u, v in np.concatenate([prompt.points_px, prompt.negative_px]).round().astype(int).tolist():
        cv2.circle(region, (u, v), _NEAR_PX, 1, -1)
    if prompt.box_px is not None:
        left, top, right, bottom = prompt.box_px.round().astype(int).clip(0).tolist()
        region[top : bottom + 1, left : right + 1] = 1
    return region > 0


def _moved(then: Frame, now: Frame, mask: np.ndarray) -> bool:
    """Whether what is in and about a mask (H, W) bool of an earlier frame is no longer there."""
    before, after = (cv2.blur(frame.rgb, (5, 5)).astype(int) for frame in (then, now))
    other = np.abs(before - after).max(-1)[dilated(mask, 2)] > _OTHER_COLOUR
    both = mask & (then.depth_m > 0) & (now.depth_m > 0)
    off = np.abs(then.depth_m - now.depth_m)[both] > depth_step_m(then.depth_m[both])
    return bool(other.mean() > _COLOURS or (off.size and off.mean() > _DEPTHS))
