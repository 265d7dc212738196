"""The click page on a camera's newest image: ``p2p live --click``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from p2p_lib.apps.click import Clicker
from p2p_lib.apps.live_words import Words
from p2p_lib.core.earlier import has_moved, with_mask
from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.cameras import LiveCamera, Stream
from p2p_lib.datasets.prompts import parse_prompts


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

    def __init__(self, camera: LiveCamera, words: Words):
        self._words = words
        self._newest: tuple[Frame | None, dict[str, np.ndarray]] = (None, {})
        self._shown: Frame | None = None
        self._masks: dict[str, np.ndarray] = {}
        self._names: tuple[str, ...] = ()
        super().__init__(_Shown(camera.name, camera.camera), "")

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
        prompts, then = self.checked(content, self._names), self._shown
        made, _ = self.made([prompt for prompt in prompts if prompt.mask is None], self._masks)
        made = {name: mask for name, mask in made.items() if name not in self._names}
        prompts = tuple(with_mask(prompt, made) for prompt in prompts)
        now = self._newest[0]  # making masks takes a while
        if then is None or now is None:
            return ""  # checked above
        moved = [prompt for prompt in prompts if has_moved(prompt, then, now)]
        self._words.add((prompt for prompt in prompts if prompt not in moved), then)
        return f"The image has moved on at {', '.join(prompt.name for prompt in moved)}: click again." if moved else ""
