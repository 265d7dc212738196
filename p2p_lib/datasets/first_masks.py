"""``first_masks.png`` of a run: each object's first mask, to be looked at before its poses are believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.image import bounds
from p2p_lib.core.types import Frame

FILE = "first_masks.png"
#: Rows and columns of an object's tile, of which the upper rows hold its name, and room around its mask in its size.
_TILE_PX, _NAME_PX, _ROOM = 320, 24, 0.4
_OUTLINE_RGB, _TEXT_RGB = (255, 40, 40), (255, 255, 255)


@dataclass(frozen=True, eq=False)
class FirstMasks:
    """The tiles of the objects that have shown so far."""

    tiles: dict[str, np.ndarray] = field(default_factory=dict)

    def add(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> bool:
        """Draw the objects that show for the first time; whether any did."""
        new = {name: mask for name, mask in masks.items() if name not in self.tiles and mask is not None and mask.any()}
        self.tiles.update({name: _tile(f"{name}, frame {frame.index}", frame, mask) for name, mask in new.items()})
        return bool(new)

    def save(self, folder: Path) -> None:
        """Write all tiles beside each other."""
        cv2.imwrite(str(folder / FILE), cv2.cvtColor(np.hstack(list(self.tiles.values())), cv2.COLOR_RGB2BGR))


def _tile(title: str, frame: Frame, mask: np.ndarray) -> np.ndarray:
    """(_TILE_PX + _NAME_PX, _TILE_PX, 3) uint8: a mask's outline on what surrounds it."""
    rows, columns = bounds(mask)
    margin = int(_ROOM * max(rows.stop - rows.start, columns.stop - columns.start)) + 2
    part = bounds(mask, margin)
    rgb, inside = frame.rgb[part].copy(), mask[part].astype(np.uint8)
    scale = _TILE_PX / max(inside.shape)
    size = tuple(max(1, round(scale * n)) for n in inside.shape[::-1])
    rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    inside = cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(inside, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(rgb, outlines, -1, _OUTLINE_RGB, 2)
    tile = np.zeros((_TILE_PX + _NAME_PX, _TILE_PX, 3), np.uint8)
    tile[_NAME_PX : _NAME_PX + size[1], : size[0]] = rgb
    cv2.putText(tile, title, (4, _NAME_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT_RGB, 1, cv2.LINE_AA)
    return tile
