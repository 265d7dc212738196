"""Frames out of folders of images: reading, pairing and checking files, each fault named in one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame
from p2p_lib.data.sequence import ObjectTruth

COLOUR = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
LOSSLESS = (".png", ".bmp", ".tif", ".tiff")
DEPTH_SCALE = 0.001  # metres per raw unit: all layouts here store millimetres
DEFAULT_HZ = 30.0
# YCBInEOAT's rotations are orthonormal to 0.3 % only: nearer than this they are made rigid, beyond refused.
NOT_RIGID = 0.01


# --- files and their order -------------------------------------------------------------------------


def list_files(folder: Path, suffixes: tuple[str, ...], what: str) -> tuple[Path, ...]:
    """The files of a folder in natural order (2 before 10); at least one, or an error that names the folder."""
    if not folder.is_dir():
        raise MissingData(str(folder), f"no such folder, expected {what} there")
    files = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    if not files:
        raise BadInput(str(folder), "no files", f"{what} ({' '.join(suffixes)})")
    return tuple(sorted(files, key=_natural))


def _natural(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts] + [(0, path.name)]


def check_paired(files: tuple[Path, ...], reference: tuple[Path, ...]) -> tuple[Path, ...]:
    """``files``, if there is one for each of ``reference``: the i-th belongs to the i-th in sorted order."""
    if len(files) == len(reference):
        return files
    stems, wanted = {p.stem for p in files}, {p.stem for p in reference}
    odd = sorted(wanted - stems) if len(files) < len(reference) else sorted(stems - wanted)
    hint = ""
    if odd and stems & wanted:
        hint = f"{odd[0]}{files[0].suffix} is " + ("missing." if len(files) < len(reference) else "too many.")
    raise BadInput(
        str(files[0].parent), f"{len(files)} files", f"{len(reference)}, one for each in {reference[0].parent}", hint
    )


def frame_times(folder: Path, rgb_files: tuple[Path, ...]) -> np.ndarray:
    """(N,) seconds: from file names that are nanoseconds, else from ``times.txt``, else at 30 Hz."""
    stems = [p.stem for p in rgb_files]
    source = folder / "times.txt"
    if all(s.isdigit() and len(s) >= 16 for s in stems):
        times_s = np.array([int(s) for s in stems]) * 1e-9
        source = rgb_files[0].parent
    elif source.is_file():
        times_s = read_numbers(source, "one time in seconds a line").ravel()
        if len(times_s) != len(rgb_files):
            want = f"{len(rgb_files)}, one for each in {rgb_files[0].parent}"
            raise BadInput(str(source), f"{len(times_s)} times", want)
    else:
        return np.arange(len(rgb_files)) / DEFAULT_HZ
    if not np.isfinite(times_s).all() or (np.diff(times_s) <= 0).any():
        at = int(np.argmax(~(np.diff(times_s) > 0))) + 1
        raise BadInput(str(source), f"{times_s[at]:.6f} s at frame {at}", "times in seconds that increase")
    return times_s


# --- numbers ---------------------------------------------------------------------------------------


def read_numbers(path: Path, expected: str) -> np.ndarray:
    """(rows, columns) float64 of a text file of numbers; ``expected`` says what the file should hold."""
    rows = [line.split() for line in _read(path, expected).decode("utf-8", "replace").splitlines() if line.strip()]
    try:
        return np.array([[float(x) for x in row] for row in rows])
    except ValueError:
        bad = next((f"{' '.join(r)[:40]!r}" for r in rows if not _are_numbers(r)), "rows of unequal length")
        raise BadInput(str(path), bad, expected) from None


def _are_numbers(row: list[str]) -> bool:
    try:
        return bool([float(x) for x in row])
    except ValueError:
        return False


def read_camera(path: Path, picture: Path) -> Camera:
    """The camera of ``cam_K.txt`` (three rows of three) for pictures as large as this one."""
    K = read_numbers(path, "a 3x3 camera matrix in pixels")
    height, width = read_rgb(picture).shape[:2]
    return Camera.from_K(K, width, height, name=str(path))


def read_pose(path: Path) -> np.ndarray:
    """One (4, 4) transformation, rigid to within :data:`NOT_RIGID`, as written."""
    return se3.check(str(path), read_numbers(path, "a 4x4 transformation in metres"), NOT_RIGID)


def read_poses(files: tuple[Path, ...]) -> np.ndarray:
    """(N, 4, 4), one file each, each the rigid transformation nearest to what is written."""
    return se3.orthonormalised(np.stack([read_pose(p) for p in files]))


# --- pictures --------------------------------------------------------------------------------------


def _read(path: Path, expected: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise MissingData(str(path), f"no such file, expected {expected}") from None
    except OSError as error:
        raise MissingData(str(path), f"cannot be read ({error.strerror}), expected {expected}") from None


def read_image(path: Path, flags: int, expected: str) -> np.ndarray:
    """A decoded picture, or an error that names the file and what it should have been."""
    data = _read(path, expected)
    # A PNG that was cut off lacks its end mark; the decoder would complain on stderr before it gives up.
    whole = data and (not data.startswith(b"\x89PNG") or b"IEND" in data[-16:])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if whole else None
    if image is None:
        raise BadInput(str(path), f"an unreadable file of {len(data)} bytes", expected)
    return image


def read_rgb(path: Path) -> np.ndarray:
    """(H, W, 3) uint8, red first."""
    # A rotation in a picture's EXIF would turn it away from its depth image.
    bgr = read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, "a colour picture")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_depth_m(path: Path, shape: tuple[int, int], scale: float, invalid: int | None = None) -> np.ndarray:
    """(H, W) float32 metres; 0 where there is no measurement or the raw value is ``invalid``."""
    raw = read_image(path, cv2.IMREAD_UNCHANGED, "a 16-bit depth image")
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32):
        raise BadInput(str(path), f"{'x'.join(map(str, raw.shape))} {raw.dtype}", "one channel, uint16 or float32")
    _check_size(path, raw, shape, "Register the depth to the colour camera first.")
    depth_m = raw.astype(np.float32) * np.float32(scale)
    if invalid is not None:
        depth_m[raw == invalid] = 0
    return depth_m


def read_labels(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) integer labels of a mask image; 0 is background. Palette images give their indices."""
    labels = read_image(path, cv2.IMREAD_UNCHANGED, "a mask image")
    if labels.ndim == 3:
        colours = labels[..., :3]  # a fourth channel is opacity
        labels = colours[..., 0]
        if (colours != labels[..., None]).any():
            labels = _palette_indices(path)
    _check_size(path, labels, shape, "")
    return labels


def _palette_indices(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        if image.mode != "P":
            raise BadInput(
                str(path), f"a colour picture ({image.mode})", "one label per pixel", "Save it with one channel."
            )
        return np.asarray(image)


def _check_size(path: Path, image: np.ndarray, shape: tuple[int, int], fix: str) -> None:
    if image.shape[:2] != shape:
        got = f"{image.shape[1]}x{image.shape[0]} pixels"
        raise BadInput(str(path), got, f"{shape[1]}x{shape[0]} as the colour picture", fix)


# --- masks -----------------------------------------------------------------------------------------


@dataclass(eq=False)
class MaskFiles:
    """Masks on disk: for each object its files, and the label that means it (None: anything but 0).

    An object has one file a frame, or a single one for the first frame alone.
    """

    files: dict[str, tuple[Path, ...]]
    labels: dict[str, int | None]
    shape: tuple[int, int]
    _counts: dict[int, dict[str, int]] = field(default_factory=dict)

    @property
    def objects(self) -> tuple[str, ...]:
        """Names, in the order of their labels or folders."""
        return tuple(self.files)

    def read(self, i: int) -> dict[str, np.ndarray] | None:
        """Object to (H, W) bool at frame i; None where no object has a mask for it."""
        at_i = {name: files[i] for name, files in self.files.items() if i < len(files)}
        pictures = {path: read_labels(path, self.shape) for path in set(at_i.values())}
        masks = {}
        for name, path in at_i.items():
            label = self.labels[name]
            masks[name] = pictures[path] > 0 if label is None else pictures[path] == label
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
    objects: tuple[str, ...] | None = None,
    first_frame_alone: bool = False,
) -> MaskFiles:
    """The masks below a folder: one folder per object, or one label image per frame.

    ``objects`` are the names to find; None takes what is there: the folders' names, or ``object_k`` for
    label k (``object`` where there is a single one). With known names, label k is the k-th of them, and
    a single object is everything that is not 0.
    """
    if not folder.is_dir():
        raise MissingData(str(folder), "no such folder of masks", "Name a folder inside the sequence, or a path.")
    below = tuple(sorted(p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")))
    names = below if objects is None else objects

    def images(where: Path) -> tuple[Path, ...]:
        files = list_files(where, LOSSLESS, "mask images")
        return files if first_frame_alone and len(files) == 1 else check_paired(files, rgb_files)

    if below:
        return MaskFiles({name: images(folder / name) for name in names}, dict.fromkeys(names), shape)
    files = images(folder)
    labels: dict[str, int | None]
    if objects is None:
        found = _labels_in(files, shape)
        labels = {f"object_{k}": k for k in found} if len(found) > 1 else {"object": None}
    else:
        labels = {name: k + 1 for k, name in enumerate(names)} if len(names) > 1 else {names[0]: None}
    return MaskFiles(dict.fromkeys(labels, files), labels, shape)


def _labels_in(files: tuple[Path, ...], shape: tuple[int, int]) -> list[int]:
    """All labels above 0 of a set of label images: an object may enter late, so every image is looked at."""
    present = np.zeros(65536, bool)
    for path in files:
        present |= np.bincount(read_labels(path, shape).ravel(), minlength=65536) > 0
    return [int(k) for k in np.flatnonzero(present) if k > 0]


# --- the sequence ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A :class:`~p2p_lib.data.sequence.Sequence` of image files; the layouts differ in where these lie.

    depth_invalid  raw depth value that means "no measurement" besides 0
    mask_files     what :meth:`masks` gives; ``own_masks`` the dataset's own, which scoring counts
    read_truth     called once, when truth is first asked for
    """

    name: str
    format: str
    path: Path
    camera: Camera
    objects: tuple[str, ...]
    rgb_files: tuple[Path, ...]
    depth_files: tuple[Path, ...]
    times_s: np.ndarray
    depth_scale: float = DEPTH_SCALE
    depth_invalid: int | None = None
    mask_files: MaskFiles | None = None
    own_masks: MaskFiles | None = None
    read_truth: Callable[[], dict[str, ObjectTruth]] = dict

    def __len__(self) -> int:
        return len(self.rgb_files)

    @cached_property
    def truth(self) -> dict[str, ObjectTruth]:
        """Object to its truth, read when first asked for."""
        return self.read_truth()

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.camera.height, self.camera.width

    def frame(self, i: int) -> Frame:
        """The i-th picture."""
        self._check_index(i)
        rgb = read_rgb(self.rgb_files[i])
        if rgb.shape[:2] != self.shape:
            got, want = (f"{w}x{h}" for h, w in (rgb.shape[:2], self.shape))
            raise BadInput(str(self.rgb_files[i]), f"{got} pixels", f"{want} as the first picture")
        depth_m = read_depth_m(self.depth_files[i], self.shape, self.depth_scale, self.depth_invalid)
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


def masks_folder(folder: Path, masks: str | Path) -> Path:
    """The folder of masks that was asked for: a name inside the sequence, else a path."""
    inside = folder / masks
    return inside if inside.is_dir() else Path(masks).expanduser()


def pictures(folder: Path) -> tuple[tuple[Path, ...], tuple[Path, ...], Camera, np.ndarray]:
    """What every layout has: ``rgb/``, ``depth/``, ``cam_K.txt`` and times, paired and checked."""
    rgb_files = list_files(folder / "rgb", COLOUR, "colour pictures")
    depth_files = check_paired(list_files(folder / "depth", LOSSLESS, "depth images"), rgb_files)
    camera = read_camera(folder / "cam_K.txt", rgb_files[0])
    return rgb_files, depth_files, camera, frame_times(folder, rgb_files)
