"""Masks out of files: one folder per object, or one label image per frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput, MissingData, did_you_mean
from p2p_lib.core.options import MASK_SOURCES
from p2p_lib.datasets.images import LOSSLESS, check_paired, check_size, list_files, read_image


@dataclass(eq=False)
class MaskFiles:
    """Masks on disk: for each object its files, and the label that means it (None: anything but 0).

    An object has one file a frame (None: it is not in this image), or files of some frames alone: of the others nobody
    knows whether it is to be seen.
    """

    files: dict[str, Mapping[int, Path | None]]
    labels: dict[str, int | None]
    shape: tuple[int, int]
    _counts: dict[int, dict[str, int]] = field(default_factory=dict)

    def read(self, i: int) -> dict[str, np.ndarray] | None:
        """Object to (H, W) bool at frame i; None where no object has a mask for it."""
        at_i = {name: files[i] for name, files in self.files.items() if i in files}
        images: dict[Path | None, np.ndarray] = {None: np.zeros(self.shape, np.uint8)}
        images |= {path: read_labels(path, self.shape) for path in set(at_i.values()) if path}
        masks = {}
        for name, path in at_i.items():
            label = self.labels[name]
            masks[name] = images[path] > 0 if label is None else images[path] == label
        self._counts[i] = {name: int(np.count_nonzero(mask)) for name, mask in masks.items()}
        return masks or None

    def count(self, i: int) -> dict[str, int] | None:
        """Object to pixels at frame i; costs nothing after :meth:`read`."""
        if i not in self._counts:
            self.read(i)
        return self._counts[i] or None


def find_masks(
    folder: Path,
    rgb_files: tuple[Path, ...],
    shape: tuple[int, int],
    objects: tuple[str, ...] = (),
    some_frames: bool = False,
) -> MaskFiles:
    """The masks below a folder: one folder per object, or one label image per frame.

    ``objects`` are the names to find; none takes what is there: the folders' names, or ``object_k`` for
    label k (``object`` where there is a single one). With known names, label k is the k-th of them, and
    a single object is everything that is not 0. With ``some_frames`` there may be masks of some frames, named as their
    images, or a single one, of the first image.
    """
    if not folder.is_dir():
        fix = f"Name a folder inside the sequence, a path, or {', '.join(dict.fromkeys(MASK_SOURCES))}."
        fix = did_you_mean(folder.name, MASK_SOURCES) or fix
        raise MissingData(str(folder), "no such folder of masks", fix)
    below = tuple(sorted(p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")))
    names = objects or below

    def paired(where: Path) -> dict[int, Path | None]:
        files = list_files(where, LOSSLESS, "mask images")
        number = {path.stem: i for i, path in enumerate(rgb_files)}
        if some_frames and len(files) < len(rgb_files) and all(path.stem in number for path in files):
            return {number[path.stem]: path for path in files}
        if some_frames and len(files) == 1:
            return {0: files[0]}
        hint = "Masks of some images have their names; one alone may be called otherwise, and is the first image's."
        return dict(enumerate(check_paired(files, rgb_files, hint if some_frames else "")))

    if below:
        return MaskFiles({name: paired(folder / name) for name in names}, dict.fromkeys(names), shape)
    files = paired(folder)
    present = (path for path in files.values() if path is not None)
    found = range(1, len(objects) + 1) if objects else _labels_in(present, shape)
    names = objects or tuple(f"object_{k}" for k in found)
    labels: dict[str, int | None] = dict.fromkeys(objects or ["object"])
    if len(found) > 1:
        labels = dict(zip(names, found))
    return MaskFiles(dict.fromkeys(labels, files), labels, shape)


def _labels_in(files: Iterable[Path], shape: tuple[int, int]) -> list[int]:
    """All labels above 0 of a set of label images: an object may enter late, so every image is looked at."""
    counts = (np.bincount(read_labels(path, shape).ravel()) for path in files)
    return sorted({int(k) for count in counts for k in np.flatnonzero(count)} - {0})


def read_labels(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) integer labels of a mask image; 0 is background. Palette images give their indices."""
    labels = read_image(path, cv2.IMREAD_UNCHANGED, "a mask image")
    if labels.ndim == 3:
        colours = labels[..., :3]  # a fourth channel is opacity
        labels = colours[..., 0]
        if (colours != labels[..., None]).any():
            labels = _palette_indices(path)
    check_size(path, labels, shape)
    return labels


def _palette_indices(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:  # which has been read once, so that it is not too large
        if image.mode != "P":
            fix = "Save it with one channel."
            raise BadInput(str(path), f"a colour image ({image.mode})", "one label per pixel", fix)
        return np.asarray(image)
