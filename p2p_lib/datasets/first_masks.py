"""``first_masks.png`` of a run: what prompts made, the objects' first masks and corrected ones, drawn at that moment.

The frame with every object's outline, clicks and box, and beside it each object by itself, with its name and pixels:
whoever sees that a mask is not the object stops there and clicks again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.colours import object_colours, rgb
from p2p_lib.core.image import ends_px
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.images import save_png

FILE = "first_masks.png"
_FONT, _WHITE = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255)
#: Of objects by themselves: their height at least, px, and the room around, a share of one.
_CLOSE_PX, _ROOM = 240, 0.3
#: The outline of a larger object is thicker.
_LARGE_PX = 10_000
#: Frames with corrections that are shown, the newest ones.
_CORRECTIONS = 12


class FirstMasks:
    """Collects each object's first mask with any pixels, and those that prompts correct; draws them frame below frame.

    prompts  what is said of objects; it may grow meanwhile. Those newest in a mask's frame are drawn with it
    """

    def __init__(self, path: Path, prompts: Iterable[Prompt] = ()):
        self.path, self._prompts, self._followed = path, prompts, set[str]()
        self._started, self._panels, self._corrected = list[str](), list[np.ndarray](), list[np.ndarray]()

    def add(
        self,
        frame: Frame,
        masks: Mapping[str, np.ndarray | None],
        anew: Iterable[str] = (),
        refused: Iterable[str] = (),
    ) -> tuple[list[str], list[str]]:
        """The masks that served in a frame; which objects are new in it, and which were corrected: both are drawn.

        anew     objects that were added since the frame before, under a name that another one had, too
        refused  those whose last prompt was not used: it corrects nothing
        """
        self._followed = (self._followed & masks.keys()).difference(anew)  # what was removed may be added again
        seen = {name: mask for name, mask in masks.items() if mask is not None and mask.any()}
        said = sorted((p for p in self._prompts if p.frame <= frame.index), key=lambda p: p.frame)
        newest = {prompt.name: prompt for prompt in said}
        now = {name for name, prompt in newest.items() if prompt.frame == frame.index}
        new = {name: mask for name, mask in seen.items() if name not in self._followed}
        again = {name: mask for name, mask in seen.items() if name in (self._followed & now).difference(refused)}
        self._followed |= new.keys()
        self._started = list(dict.fromkeys([*self._started, *new]))
        colours = object_colours(dict.fromkeys([*(prompt.name for prompt in self._prompts), *self._started]))
        for title, drawn, panels in (("first", new, self._panels), ("corrected", again, self._corrected)):
            if drawn:
                prompts = [newest[name] for name in drawn if name in newest]
                title = f"{title} masks, frame {frame.index}"
                panels.append(_panel(frame, drawn, prompts, colours, title))
        del self._corrected[:-_CORRECTIONS]
        if new or again:
            sheet = [*self._panels, *self._corrected]
            width = max(panel.shape[1] for panel in sheet)
            save_png(self.path, np.concatenate([np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0))) for p in sheet]))
        return list(new), list(again)


def _panel(
    frame: Frame, masks: Mapping[str, np.ndarray], prompts: Iterable[Prompt], colours: Mapping[str, str], title: str
) -> np.ndarray:
    """A frame with outlines and prompts, and beside it each object by itself."""
    image = frame.rgb.copy()
    for name, mask in masks.items():
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        thick = 1 if np.count_nonzero(mask) < _LARGE_PX else 2
        cv2.drawContours(image, outlines, -1, rgb(colours[name]), thick)
    # Enlarged before anything thick is drawn, so that it covers none of a small object.
    side_px = {name: int(np.ceil(np.ptp(ends_px(mask), 0).max() * (1 + 2 * _ROOM))) for name, mask in masks.items()}
    least_px = max(_CLOSE_PX, *side_px.values())  # none is smaller than in the frame
    # In a square beside the frame, as high as it, so that nothing is left empty but the end of the last row.
    rows = int(np.ceil(np.sqrt(len(masks))))
    height_px = max(least_px, -(-image.shape[0] // rows))
    parts = [_close(image, masks[name], name, prompts, colours[name], side_px[name], height_px) for name in masks]
    _draw_prompts(image, prompts, colours, 1.0, np.zeros(2))
    height = rows * height_px
    image = cv2.resize(image, (round(image.shape[1] * height / image.shape[0]), height))
    _write(image, title)
    parts += [np.zeros_like(parts[0])] * (-len(parts) % rows)
    across = len(parts) // rows
    beside = np.concatenate([np.concatenate(parts[k : k + across], 1) for k in range(0, len(parts), across)])
    return np.concatenate([image, beside], 1)


def _close(
    image: np.ndarray, mask: np.ndarray, name: str, prompts: Iterable[Prompt], colour: str, side: int, height_px: int
) -> np.ndarray:
    """The square of this ``side`` around one object, enlarged to a height, with its clicks, name and pixels."""
    first, beyond = ends_px(mask)
    left, top = (first + (beyond - first - side) // 2).tolist()
    around = cv2.copyMakeBorder(image, side, side, side, side, cv2.BORDER_CONSTANT)  # an object at the image's edge
    part = around[top + side : top + 2 * side, left + side : left + 2 * side]
    scale = height_px / side
    part = cv2.resize(part, (height_px, height_px), interpolation=cv2.INTER_CUBIC)
    own = [prompt for prompt in prompts if prompt.name == name]
    _draw_prompts(part, own, {name: colour}, scale, np.array([left, top]))
    _write(part, f"{name}: {np.count_nonzero(mask)} px", colour)
    return part


def _draw_prompts(
    image: np.ndarray, prompts: Iterable[Prompt], colours: Mapping[str, str], scale: float, corner_px: np.ndarray
) -> None:
    """Clicks on an object as dots, those beside it as crosses, and boxes, in an image that begins at ``corner_px``."""

    def at(uv_px: np.ndarray) -> list[tuple[int, int]]:
        return [tuple(uv) for uv in np.rint((uv_px - corner_px + 0.5) * scale - 0.5).astype(int).tolist()]

    for prompt in prompts:
        colour = rgb(colours[prompt.name])
        for uv in at(prompt.points_px):
            cv2.circle(image, uv, 4, _WHITE, -1, cv2.LINE_AA)
            cv2.circle(image, uv, 3, colour, -1, cv2.LINE_AA)
        for uv in at(prompt.negative_px):
            cv2.drawMarker(image, uv, _WHITE, cv2.MARKER_TILTED_CROSS, 10, 4)
            cv2.drawMarker(image, uv, colour, cv2.MARKER_TILTED_CROSS, 10, 2)
        if prompt.box_px is not None:
            corner, opposite = at(prompt.box_px.reshape(2, 2))
            cv2.rectangle(image, corner, opposite, colour, 1)


def _write(image: np.ndarray, text: str, colour: str = "#101010") -> None:
    """Words in the upper left corner, as small as they have to be."""
    scale = 0.5
    (width, height), base = cv2.getTextSize(text, _FONT, scale, 1)
    scale *= min(1.0, (image.shape[1] - 8) / width)
    cv2.rectangle(image, (0, 0), (min(width + 8, image.shape[1]), height + base + 4), rgb(colour), -1)
    cv2.putText(image, text, (4, height + 2), _FONT, scale, _WHITE, 1, cv2.LINE_AA)
