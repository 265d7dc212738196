"""``keypoints.npz`` of a run: where the 2D tracker saw each object's points, and the map that they made.

Written once, at the end of a run, for the viewers (``p2p view``). About 10 bytes a point and frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from p2p_lib.core.files import check_arrays, load_by_object, save_arrays

FILE = "keypoints.npz"


@dataclass(frozen=True, eq=False)
class ObjectKeypoints:
    """One object's keypoints.

    ids, p_obj, promoted  (N,), (N, 3) metres in the object frame, (N,) bool: its map as it was at the end
    frame_index           (M,) of every visible observation, in order; with whose it was, track_id (M,), and where,
    uv_px                 (M, 2). Points that were dropped from the map before the end are among them
    """

    ids: np.ndarray
    p_obj: np.ndarray
    promoted: np.ndarray
    frame_index: np.ndarray
    track_id: np.ndarray
    uv_px: np.ndarray

    def __post_init__(self) -> None:
        n, m = len(self.ids), len(self.frame_index)
        check_arrays("keypoints", self, "whole numbers", ids=(n,), frame_index=(m,), track_id=(m,))
        check_arrays("keypoints", self, "numbers", p_obj=(n, 3), uv_px=(m, 2), finite=False)
        check_arrays("keypoints", self, "yes or no", promoted=(n,))

    def at(self, frame: int) -> slice:
        """The rows of observations of one frame."""
        return slice(*np.searchsorted(self.frame_index, [frame, frame + 1]))


class KeypointLog:
    """Collects observations frame by frame; :meth:`save` writes them with the final maps."""

    def __init__(self) -> None:
        self._seen: dict[str, list[tuple[int, np.ndarray, np.ndarray]]] = defaultdict(list)

    def add(self, frame_index: int, name: str, ids: np.ndarray, uv_px: np.ndarray) -> None:
        """What was visible of one object in a frame: ids (K,) and uv_px (K, 2)."""
        self._seen[name].append((frame_index, ids.astype(np.int32), uv_px.astype(np.float32)))

    def save(self, folder: Path, maps: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
        """Write the file; ``maps`` is object to ids, p_obj and promoted."""
        arrays: dict[str, np.ndarray] = {}
        for name, (ids, p_obj, promoted) in maps.items():
            seen = self._seen[name]
            frames = np.repeat([f for f, _, _ in seen], [len(i) for _, i, _ in seen]).astype(np.int32)
            track_id = np.concatenate([np.zeros(0, np.int32), *(i for _, i, _ in seen)])
            uv_px = np.concatenate([np.zeros((0, 2), np.float32), *(uv for _, _, uv in seen)])
            values = ids.astype(np.int32), p_obj.astype(np.float32), promoted, frames, track_id, uv_px
            arrays |= {f"{name}/{f.name}": value for f, value in zip(fields(ObjectKeypoints), values, strict=True)}
        save_arrays(folder / FILE, arrays, compressed=True)


def load_keypoints(folder: str | Path) -> dict[str, ObjectKeypoints]:
    """Object to its keypoints; empty for a run that was killed before it could write them."""
    return load_by_object(Path(folder) / FILE, ObjectKeypoints)
