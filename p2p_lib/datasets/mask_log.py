"""``masks.npz`` of a run: the mask of each object in each frame, coarsely, and how large in metres what it holds is.

Written at the end of a run beside ``keypoints.npz``, so that ``p2p eval`` can judge a run whose masks were not kept as
images. Every :data:`CELL_PX`-th pixel of every such row is kept, as bits: about 100 bytes an object and frame.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.files import check_arrays, load_by_object, save_arrays
from p2p_lib.core.mask_length import CELL_PX, CELLS, length_and_middle, measured_in
from p2p_lib.core.types import Frame

FILE = "masks.npz"


@dataclass(frozen=True, eq=False)
class ObjectMasks:
    """One object's masks over the n frames in which one was known, an empty one included.

    frame_index  (n,)
    px           (n,) pixels of the whole mask
    box          (n, 4) top, left, rows and columns of the cells that it covers
    bits         (b,) uint8: the cells in these boxes, row by row, each frame's from a new byte on
    size_m       (n,) length of what the mask holds along its longest axis, by depth; NaN where nothing was measured
    centre_m     (n, 3) median of its points in the camera frame
    """

    frame_index: np.ndarray
    px: np.ndarray
    box: np.ndarray
    bits: np.ndarray
    size_m: np.ndarray
    centre_m: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.frame_index)
        check_arrays("masks", self, "whole numbers", frame_index=(n,), px=(n,), box=(n, 4))
        check_arrays("masks", self, "numbers", size_m=(n,), centre_m=(n, 3), finite=False)
        check_arrays("masks", self, "bytes", bits=(int(self._ends[-1]),))

    @property
    def _ends(self) -> np.ndarray:
        """(n + 1,) where in ``bits`` the frames begin and end."""
        return np.concatenate([[0], np.cumsum(-(-self.box[:, 2:].astype(int).prod(1) // 8))])

    def at_the_border(self, camera: Camera) -> np.ndarray:
        """(n,) bool: the mask ends at the image's border, or a cell before, for more may be beyond."""
        low, high = self.box[:, :2], self.box[:, :2] + self.box[:, 2:]
        ends = -(-np.array([camera.height, camera.width]) // CELL_PX)
        return ((low <= 1) | (high >= ends - 1)).any(1) & (self.px > 0)

    def row(self, frame: int) -> int | None:
        """Which of the n a frame is; None where no mask was known."""
        at = int(np.searchsorted(self.frame_index, frame))
        return at if at < len(self.frame_index) and self.frame_index[at] == frame else None

    def cells(self, row: int, shape: tuple[int, int]) -> np.ndarray:
        """(h, w) bool: the mask of one of the n frames at the pixels :data:`CELLS` of an image of this shape."""
        mask = np.zeros(shape, bool)[CELLS].copy()
        top, left, rows, columns = self.box[row].tolist()
        bits = np.unpackbits(self.bits[slice(*self._ends[row : row + 2])], count=rows * columns)
        mask[top : top + rows, left : left + columns] = bits.reshape(rows, columns)
        return mask


class _Row(NamedTuple):
    frame_index: int
    px: int
    box: tuple[int, int, int, int]
    bits: np.ndarray
    size_m: float
    centre_m: np.ndarray


class MaskLog:
    """Collects masks frame by frame; :meth:`save` writes them."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._rows: dict[str, list[_Row]] = defaultdict(list)

    def add(self, frame: Frame, name: str, mask: np.ndarray) -> None:
        """The mask (H, W) bool of an object that served in a frame."""
        cells = mask[CELLS]
        at = np.argwhere(cells)
        low, high = (at.min(0), at.max(0) + 1) if len(at) else (np.zeros(2, int), np.zeros(2, int))
        bits = np.packbits(cells[low[0] : high[0], low[1] : high[1]])
        p_cam = measured_in(frame, mask, self._camera)
        box = (*low.tolist(), *(high - low).tolist())
        self._rows[name].append(_Row(frame.index, int(np.count_nonzero(mask)), box, bits, *length_and_middle(p_cam)))

    def save(self, folder: Path) -> None:
        """Write the file."""
        arrays = {}
        for name, rows in self._rows.items():
            columns = dict(zip(_Row._fields, zip(*rows, strict=True), strict=True))
            arrays[f"{name}/bits"] = np.concatenate([np.zeros(0, np.uint8), *columns.pop("bits")])
            kinds = {"frame_index": np.int32, "px": np.int32, "box": np.int16}
            arrays |= {f"{name}/{key}": np.array(v, kinds.get(key, np.float32)) for key, v in columns.items()}
        save_arrays(folder / FILE, arrays, compressed=True)


def load_masks(folder: str | Path) -> dict[str, ObjectMasks]:
    """Object to its masks; empty for a run that was killed before it could write them, and for older ones."""
    return load_by_object(Path(folder) / FILE, ObjectMasks)
