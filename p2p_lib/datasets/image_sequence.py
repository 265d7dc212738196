"""A sequence of image files, which every layout of this kind becomes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame
from p2p_lib.datasets import images
from p2p_lib.datasets.masks import MaskFiles
from p2p_lib.datasets.sequence import ObjectTruth


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A :class:`~p2p_lib.datasets.sequence.Sequence` of image files; the layouts differ in where these lie.

    depth_invalid  raw depth value that means "no measurement" besides 0
    read_depth     reads a depth file: path, (height, width), depth_scale, depth_invalid to (H, W) metres
    mask_files     what :meth:`masks` gives; ``own_masks`` the dataset's own, which scoring counts
    read_truth     called once, when truth is first asked for
    model_places   object to the files and folders where its model may lie, best first
    """

    name: str
    format: str
    path: Path
    camera: Camera
    objects: tuple[str, ...]
    rgb_files: tuple[Path, ...]
    depth_files: tuple[Path, ...]
    times_s: np.ndarray
    depth_scale: float = images.DEPTH_SCALE
    depth_invalid: int | None = None
    read_depth: Callable[[Path, tuple[int, int], float, int | None], np.ndarray] = images.read_depth_m
    mask_files: MaskFiles | None = None
    own_masks: MaskFiles | None = None
    read_truth: Callable[[], dict[str, ObjectTruth]] = dict
    model_places: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rgb_files)

    @cached_property
    def truth(self) -> dict[str, ObjectTruth]:
        """Object to its truth, read when first asked for."""
        return self.read_truth()

    @property
    def frame_names(self) -> tuple[str, ...]:
        """What each frame's picture is called, without its ending."""
        return tuple(path.stem for path in self.rgb_files)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.camera.height, self.camera.width

    def frame(self, i: int) -> Frame:
        """The i-th picture."""
        self._check_index(i)
        rgb = images.read_rgb(self.rgb_files[i])
        if rgb.shape[:2] != self.shape:
            got, want = (f"{w}x{h}" for h, w in (rgb.shape[:2], self.shape))
            raise BadInput(str(self.rgb_files[i]), f"{got} pixels", f"{want} as the first picture")
        depth_m = self.read_depth(self.depth_files[i], self.shape, self.depth_scale, self.depth_invalid)
        return Frame(i, float(self.times_s[i]), rgb, depth_m)

    def masks(self, i: int) -> dict[str, np.ndarray] | None:
        """The chosen masks at frame i."""
        self._check_index(i)
        return self.mask_files.read(i) if self.mask_files else None

    def visible_px(self, i: int) -> dict[str, int] | None:
        """The sizes of the dataset's own masks at frame i."""
        self._check_index(i)
        return self.own_masks.count(i) if self.own_masks else None

    def _check_index(self, i: int) -> None:
        if not 0 <= i < len(self):
            raise BadInput(f"{self.name}: frame", i, f"a number from 0 to {len(self) - 1}")


def pictures(folder: Path) -> tuple[tuple[Path, ...], tuple[Path, ...], Camera, np.ndarray]:
    """What every layout has: ``rgb/``, ``depth/``, ``cam_K.txt`` and times, paired and checked."""
    rgb_files = images.list_files(folder / "rgb", images.COLOUR, "colour pictures")
    depth_files = images.check_paired(images.list_files(folder / "depth", images.LOSSLESS, "depth images"), rgb_files)
    camera = images.read_camera(folder / "cam_K.txt", rgb_files[0])
    return rgb_files, depth_files, camera, images.frame_times(folder, rgb_files)
