"""A sequence of image files, which every layout of this kind becomes: the layouts differ in values only."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, P2PError, advised, listed
from p2p_lib.core.types import Frame
from p2p_lib.datasets import images
from p2p_lib.datasets.masks import MaskFiles, find_masks
from p2p_lib.datasets.schema import read_json
from p2p_lib.datasets.truth import ObjectTruth

#: Of a SHA-256, enough to tell images from others.
_DIGITS = 16
#: What to do without a camera matrix.
WRITE_K = (
    "Write fx 0 cx 0 fy cy 0 0 1 into cam_K.txt, in pixels at the size of the images, as the camera's driver gives "
    "them; without it camera_intrinsic.json of Open3D's recorder is read."
)
#: Files in which somebody may have put it instead, and those that hold something else.
_TEXTS, _NO_K = (".txt", ".json", ".yaml", ".yml", ".csv"), ("times.txt", "depth_scale.txt")
#: What the name of such a file has where its numbers cannot be told from others.
_LIKELY = "intrin|calib|cam|^k[.]"
#: What Open3D's recorders call theirs.
INTRINSICS = ("camera_intrinsic.json", "intrinsic.json")


class _Intrinsic(BaseModel):
    intrinsic_matrix: Annotated[list[float], Field(min_length=9, max_length=9)]
    width: int | None = None
    height: int | None = None


def paired_images(folder: Path, colour: str = "rgb") -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """The files of ``rgb/`` (or as the layout calls it) and ``depth/``, one of each a frame."""
    rgb = images.list_files(folder / colour, images.COLOUR, "colour images")
    return rgb, images.paired_depth(images.list_files(folder / "depth", images.DEPTH, "depth images"), rgb)


def camera_for(rgb: Sequence[Path], K: np.ndarray, name: str) -> Camera:
    """The camera with this matrix for images as large as the first of the files; ``name`` is for messages."""
    height, width = images.first_readable(rgb, images.read_rgb).shape[:2]
    return Camera.from_K(K, width, height, name=name)


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A :class:`~p2p_lib.datasets.sequence.Sequence` of image files, one ``rgb`` and one ``depth`` a frame, in order.

    times_s        (N,) seconds, increasing
    depth_invalid  raw depth value that means "no measurement" besides 0
    read_depth     reads a depth file: (H, W) in the file's unit, of which depth_scale is metres
    mask_files     what :meth:`masks` gives; ``own_masks`` the dataset's own, which scoring counts
    read_truth     called once, when truth is first asked for
    scene_seed     of a synthetic scene; None of anything else
    """

    path: Path
    rgb: tuple[Path, ...]
    depth: tuple[Path, ...]
    camera: Camera
    times_s: np.ndarray
    name: str = ""
    format: str = ""
    objects: tuple[str, ...] = ("object",)
    depth_scale: float = images.DEPTH_SCALE
    depth_invalid: int = 0
    read_depth: Callable[[Path], np.ndarray] = images.read_raw_depth
    mask_files: MaskFiles | None = None
    own_masks: MaskFiles | None = None
    read_truth: Callable[[], dict[str, ObjectTruth]] = dict
    model_places: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)
    scene_seed: int | None = None

    def __post_init__(self) -> None:
        for what, files in (("rgb", self.rgb), ("depth", self.depth)):
            each = files if isinstance(files, tuple | list) else [files]
            odd = next((file for file in each if not isinstance(file, Path)), None)
            if odd is not None:
                fix = "tuple(sorted(folder.glob(PATTERN))) is one."
                raise BadInput(f"{self.path}: {what}", type(odd).__name__, "a tuple of Paths, one a frame", fix)
        if not len(self.rgb) == len(self.depth) == len(self.times_s) > 0:
            got = f"{len(self.rgb)} colour images, {len(self.depth)} depth images and {len(self.times_s)} times"
            fix = "Look at the patterns by which the loader finds its files."
            raise BadInput(str(self.path), got, "one of each a frame, and a frame at least", fix)

    def __len__(self) -> int:
        return len(self.rgb)

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        return f"{type(self).__name__}({self.name!r}, {len(self)} frames, {size}, objects: {', '.join(self.objects)})"

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.camera.height, self.camera.width

    @cached_property
    def truth(self) -> dict[str, ObjectTruth]:
        """Object to its truth, read when first asked for."""
        return self.read_truth()

    @property
    def frame_names(self) -> tuple[str, ...]:
        """What each frame's image is called, without its ending."""
        return tuple(path.stem for path in self.rgb)

    def frame(self, i: int) -> Frame:
        """The i-th frame."""
        self._check_index(i)
        rgb = images.read_rgb(self.rgb[i])
        images.check_size(self.rgb[i], rgb, self.shape, "the first image")
        raw = self.read_depth(self.depth[i])
        images.check_size(self.depth[i], raw, self.shape, fix=_made_to_fit(raw.shape, self.shape))
        depth_m = raw.astype(np.float32) * np.float32(self.depth_scale)
        depth_m[raw == self.depth_invalid] = 0
        return Frame(i, float(self.times_s[i]), rgb, depth_m)

    def digest(self, i: int) -> str | None:
        """What tells the two images at frame i from others, by the bytes of their files; None where one is missing."""
        files = self.rgb[i], self.depth[i]
        if not all(path.is_file() for path in files):
            return None
        return sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:_DIGITS]

    def masks(self, i: int) -> dict[str, np.ndarray] | None:
        """The chosen masks at frame i."""
        self._check_index(i)
        return self.mask_files.read(i) if self.mask_files else None

    def visible_px(self, i: int) -> dict[str, int] | None:
        """The sizes of the dataset's own masks at frame i."""
        self._check_index(i)
        return self.own_masks.count(i) if self.own_masks else None

    def check_camera(self) -> None:
        """:class:`BadInput` where the camera is not as large as the first image that can be read."""
        height, width = images.first_readable(self.rgb, images.read_rgb).shape[:2]
        if self.shape != (height, width):
            swapped = self.shape == (width, height)
            fix = "Width and height are swapped: width comes first, in an array's shape height does." if swapped else ""
            got = f"{self.camera.width}x{self.camera.height} pixels"
            raise BadInput(f"{self.path}: camera", got, f"{width}x{height}, as large as the colour images", fix)

    def _check_index(self, i: int) -> None:
        if not 0 <= i < len(self):
            raise BadInput(f"{self.name}: frame", i, f"a number from 0 to {len(self) - 1}")

    def with_masks(
        self,
        asked: str | Path | None,
        places: Iterable[Path] = (),
        objects: tuple[str, ...] = (),
        some_frames: bool = False,
    ) -> ImageSequence:
        """The same with masks and their objects; the dataset's own are in the first of ``places`` that there is.

        asked  another folder to use, with masks of some frames or of all: a name inside the sequence, or a path. Other
               arguments as of ``find_masks``.
        """

        def find(where: Path) -> MaskFiles:
            self.check_camera()  # otherwise the masks would be blamed
            return find_masks(where, self.rgb, self.shape, objects, some_frames or where == given)

        given = None if asked is None else self.path / asked
        if asked is not None and given is not None and not given.is_dir():
            given = Path(asked).expanduser()
        own = next((find(where) for where in places if where.is_dir()), self.own_masks)
        chosen = find(given) if given else own
        objects = objects or (tuple(chosen.files) if chosen else self.objects)
        return replace(self, objects=objects, mask_files=chosen, own_masks=own or chosen)

    def without_truth(self, masks: str | Path | None) -> ImageSequence:
        """The same with the objects of its masks, which lie in ``masks/`` where no others are asked for."""
        made = self.with_masks(masks, [] if masks else [self.path / "masks"], some_frames=True)
        return replace(made, model_places={obj: (self.path / "models" / obj,) for obj in made.objects})


def _made_to_fit(depth: tuple[int, ...], colour: tuple[int, int]) -> str:
    """What to do with depth images of another (height, width) than the colour images."""
    register = "Register the depth to the colour camera first."
    if abs(depth[0] * colour[1] - depth[1] * colour[0]) > max(colour):  # within a pixel
        return register
    height, width = colour
    how = f"cv2.resize(depth, ({width}, {height}), interpolation=cv2.INTER_NEAREST)"
    return (
        "Does it show just what the colour image shows, as phones deliver it? Then bring each to its size without "
        f"interpolation, which would make up depth between near and far: {how}. If it does not: {register}"
    )


def image_files(folder: Path) -> ImageSequence:
    """The sequence in a folder with ``rgb/``, ``depth/``, ``cam_K.txt`` and times, paired and checked."""
    rgb, depth = paired_images(folder)
    return ImageSequence(folder, rgb, depth, camera_of(folder, rgb), images.frame_times(folder, rgb))


def camera_of(folder: Path, rgb: Sequence[Path]) -> Camera:
    """The camera of a folder's images, for whose size its file may be."""
    K, name, size = read_K(folder)
    camera = camera_for(rgb, K, name)
    if size not in (None, (camera.width, camera.height)):
        got, expected = "the camera of images of {}x{}".format(*size), f"that of these, {camera.width}x{camera.height}"
        raise BadInput(name, got, expected, WRITE_K)
    return camera


def read_K(folder: Path) -> tuple[np.ndarray, str, tuple[int, int] | None]:
    """The camera matrix (3, 3), its file, and the width and height that it says it is for; errors say what to write.

    That is ``cam_K.txt``, in three lines or in one, or where there is none the JSON that Open3D's recorders write.
    """
    path, expected = folder / "cam_K.txt", "a 3x3 camera matrix in pixels"
    recorded = next((folder / name for name in INTRINSICS if (folder / name).is_file()), None)
    if recorded is not None and not path.is_file():
        lens = read_json(recorded, _Intrinsic, "a pinhole camera as Open3D writes it")
        size = (lens.width, lens.height) if lens.width and lens.height else None
        return np.array(lens.intrinsic_matrix).reshape(3, 3).T, str(recorded), size  # it is written column by column
    try:
        K = images.read_numbers(path, expected)
    except P2PError as error:
        raise advised(error, WRITE_K if path.exists() else intrinsics_advice(folder)) from None
    if K.size != 9:
        decimals = "A comma parts numbers: write decimals with a point, as 913.05."
        fix = decimals if K.size == 18 else _as_K(K) or WRITE_K
        raise BadInput(str(path), f"{K.size} numbers", expected, fix)
    return K.reshape(3, 3), str(path), None


def intrinsics_advice(folder: Path) -> str:
    """What to do in a folder without a camera matrix, of which another text file there may hold the numbers."""
    others = [path for path in sorted(folder.glob("*")) if path.suffix.lower() in _TEXTS and path.name not in _NO_K]
    for path in others:
        numbers = np.empty(0)
        with suppress(P2PError):
            numbers = images.read_numbers(path, "numbers")
        if said := _as_K(numbers):
            return f"{path.name} holds four numbers. {said}"
        if numbers.size == 9:
            return f"{path.name} holds nine numbers: if they are the matrix fx 0 cx 0 fy cy 0 0 1, call it cam_K.txt."
    likely = [path.name for path in others if re.search(_LIKELY, path.name.lower())]
    may = f" {listed(likely, 3)} may hold them." if likely else ""
    return f"{WRITE_K}{may}"


def _as_K(numbers: np.ndarray) -> str:
    """What to write into ``cam_K.txt`` of four numbers, which most programs put down in one order; else empty."""
    if numbers.size != 4 or not np.isfinite(numbers).all():
        return ""
    fx, fy, cx, cy = numbers.ravel()
    return f"If these are fx fy cx cy, write {fx:.9g} 0 {cx:.9g} 0 {fy:.9g} {cy:.9g} 0 0 1 into cam_K.txt."
