"""Files of a sequence: listing, pairing, reading, checking; each fault is one line that names the file."""

from __future__ import annotations

import os
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData, P2PError, advised, listed, wrong_size
from p2p_lib.core.files import LARGEST_IMAGE_PX, UNREADABLE, read_array, read_bytes, read_text, replacing
from p2p_lib.datasets.numbering import VIDEOS, frames_of, numbered_apart, out_of_step

COLOUR = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
LOSSLESS = (".png", ".bmp", ".tif", ".tiff")
DEPTH = (*LOSSLESS, ".npy")
DEPTH_SCALE = 0.001  # metres per raw unit: all layouts here store millimetres
DEFAULT_HZ = 30.0
_UNDECODED: tuple[type[Exception], ...] = (*UNREADABLE, cv2.error)
#: What to do about a frame that cannot be read, where nobody can mend it.
SKIP_BAD = "p2p run --skip-bad goes on without such frames (with --resume where a run was begun)."
#: What looks at a whole folder; left out where it has just done so.
SEE_CHECK = "p2p check FOLDER says what else is missing."
#: What layouts call the folder of colour images.
COLOUR_FOLDERS = ("rgb", "color")
#: What recorders call a folder of images.
_IMAGES = "([-_]?(images?|maps?|frames?|png|raw|mm|aligned|registered))?"
_LIKELY = {
    "rgb": f"(rgb|colou?rs?|images?|frames?){_IMAGES}",
    "depth": f"((aligned|registered)[-_]?)?depths?{_IMAGES}",
}
#: The last bytes of a whole image, and within how many bytes of its end they are: some cameras fill up what follows.
_END_MARKS = {".png": (b"IEND", 12), ".jpg": (b"\xff\xd9", 1024), ".jpeg": (b"\xff\xd9", 1024)}
# YCBInEOAT's rotations are orthonormal to 0.3 % only: nearer than this they are made rigid, beyond refused.
NOT_RIGID = 0.01


_gaps = ContextVar("gaps", default=False)


@contextmanager
def gaps_allowed(allowed: bool = True) -> Iterator[None]:
    """Depth images may be missing of a sequence that is opened inside: reading such a frame fails, opening does not."""
    before = _gaps.set(allowed)
    try:
        yield
    finally:
        _gaps.reset(before)


def paired_depth(files: tuple[Path, ...], rgb: tuple[Path, ...]) -> tuple[Path, ...]:
    """The depth image of each colour image, by their names where some are missing and :func:`gaps_allowed` says so."""
    by_name, names = {path.stem: path for path in files}, {path.stem for path in rgb}
    if _gaps.get() and len(files) < len(rgb) and by_name.keys() <= names:
        return tuple(by_name.get(path.stem, files[0].with_stem(path.stem)) for path in rgb)
    hint = "" if len(files) >= len(rgb) else SKIP_BAD
    if hint and (other := next((path.name for path in files if path.stem not in names), "")):
        hint = f"Which belong together, names do not say: {other} is that of no colour image, as {rgb[0].name}."
    return check_paired(files, rgb, hint)


def first_readable(files: Sequence[Path], read: Callable[[Path], np.ndarray]) -> np.ndarray:
    """The first image, by which the others are read; where :func:`gaps_allowed` says so, the first that can be read."""
    for path in files:
        try:
            return read(path)
        except P2PError as error:
            if not _gaps.get():
                raise advised(error, SKIP_BAD) from None
    raise BadInput(str(files[0].parent), f"{len(files)} files that cannot be read", "one image that can at least")


def list_files(folder: Path, suffixes: tuple[str, ...], what: str) -> tuple[Path, ...]:
    """The files of a folder in natural order (2 before 10); at least one, or an error that names the folder."""
    if not folder.is_dir():
        fix = f"{called_otherwise(folder)} {SEE_CHECK}".strip()
        raise MissingData(str(folder), f"no such folder, expected {what} there", fix)
    there = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    files = [p for p in there if p.suffix.lower() in suffixes]
    if not files:
        held = listed([f"{n} of kind {kind or '(none)'}" for kind, n in Counter(p.suffix for p in there).items()], 3)
        lossy = any(p.suffix.lower() in COLOUR for p in there)
        meant = "are colour and depth images swapped?" if folder.name == "depth" else "save them as PNG."
        fix = f"JPEG keeps no exact values: {meant}" if lossy else _video_instead(folder)
        got = f"no files that fit, but {held}" if there else "no files"
        raise BadInput(str(folder), got, f"{what} ({' '.join(suffixes)})", fix)
    return tuple(sorted(files, key=_natural))


def called_otherwise(folder: Path) -> str:
    """What to do where a folder is there under a name that other recorders give it, or as a video; empty if not."""
    likely = _LIKELY.get(folder.name, re.escape(folder.name))
    others = (path for path in sorted(folder.parent.glob("*/")) if path != folder)
    near = [path for path in others if re.fullmatch(likely, path.name.lower())]
    return f"Rename {near[0].name}/ to {folder.name}/." if near else _video_instead(folder)


def _video_instead(folder: Path) -> str:
    """How colour images are made of a video in their folder, or beside it; empty where there is none."""
    beside = [path for path in sorted(folder.parent.glob("*")) if "depth" not in path.stem.lower()]
    videos = [path for path in (*sorted(folder.glob("*")), *beside) if path.suffix.lower() in VIDEOS]
    if folder.name not in COLOUR_FOLDERS or not videos:
        return ""
    depth = (path for path in folder.parent.glob("depth/*") if path.suffix.lower() in DEPTH)
    return frames_of(videos[0], folder, sorted(depth, key=_natural))


def _natural(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts] + [(0, path.name)]


def _check_in_step(files: tuple[Path, ...], reference: tuple[Path, ...]) -> None:
    """Refuse pairs whose numbers, the last ones in their names, count images or time alike but for a jump."""
    if (k := out_of_step(files, reference)) is not None:
        got = f"{files[k].name} with {reference[k].name}, and next {files[k + 1].name} with {reference[k + 1].name}"
        expected = f"one for each in {reference[0].parent}, with numbers that keep their distance"
        raise BadInput(str(files[0].parent), got, expected, "Take out what has no counterpart.")


def check_paired(files: tuple[Path, ...], reference: tuple[Path, ...], hint: str = "") -> tuple[Path, ...]:
    """``files``, if there is one for each of ``reference``: the i-th belongs to the i-th in sorted order.

    Where most are called alike, all have to be, and where none is, the numbers in their names have to keep their
    distance: else one is missing here and one there, and those between are shifted. Names that are alike only because
    one folder counts from 0 and the other from 1 are to be mended first: by them each would be paired with the next.
    """
    stems, wanted = {p.stem for p in files}, {p.stem for p in reference}
    if len(files) == len(reference):
        if not stems & wanted:
            _check_in_step(files, reference)
        if not len(reference) > len(stems & wanted) >= len(reference) / 2:
            return files
        got = f"no {min(wanted - stems)}{files[0].suffix}, and {min(stems - wanted)}{files[0].suffix} instead"
        expected = f"one for each in {reference[0].parent}, called alike"
        apart = numbered_apart(files, reference)
        fix = f"Both are counted apart: {apart}" if apart else "Take out what has no counterpart."
        raise BadInput(str(files[0].parent), got, expected, fix)
    odd, fault = (wanted - stems, "missing") if len(files) < len(reference) else (stems - wanted, "too many")
    if odd and stems & wanted:
        hint = f"{min(odd)}{files[0].suffix} is {fault}. {hint}".strip()
        if apart := numbered_apart(files, reference):
            hint = f"{hint} Or it is not, and both are counted apart: {apart}"
    expected = f"{len(reference)}, one for each in {reference[0].parent}"
    raise BadInput(str(files[0].parent), f"{len(files)} files", expected, hint)


def frame_times(folder: Path, rgb_files: tuple[Path, ...]) -> np.ndarray:
    """(N,) seconds: from file names that are nanoseconds, else from ``times.txt``, else at 30 Hz."""
    stems = [p.stem for p in rgb_files]
    source = folder / "times.txt"
    if all(s.isdigit() and len(s) >= 16 for s in stems):
        times_s = np.array([int(s) for s in stems], float) * 1e-9
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


def read_lines(path: Path, expected: str) -> list[str]:
    """The lines of a text file that are neither empty nor a comment (#); ``expected`` says what they are."""
    lines = read_text(path, expected).splitlines()
    return [line for line in lines if line.partition("#")[0].strip()]


def read_numbers(path: Path, expected: str) -> np.ndarray:
    """(rows, columns) float64 of a text file of numbers between spaces or commas; ``expected`` says what they are."""
    lines = [line.replace(",", " ") for line in read_lines(path, expected)]
    try:
        return np.loadtxt(lines, ndmin=2) if lines else np.empty(0)
    except ValueError as error:
        reason = str(error).partition(";")[0].removesuffix(".")
        fix = "Write the numbers alone, without brackets." if re.search(r"[][()]", "".join(lines)) else ""
        raise BadInput(str(path), f"unreadable numbers ({reason})", expected, fix) from None


def read_poses(folder: Path, rgb_files: tuple[Path, ...]) -> np.ndarray:
    """(N, 4, 4) from one text file a frame, each nearly rigid."""
    files = check_paired(list_files(folder, (".txt",), "pose files"), rgb_files)
    return np.stack([se3.check(str(p), read_numbers(p, "a 4x4 transformation in metres"), NOT_RIGID) for p in files])


def read_image(path: Path, flags: int, expected: str) -> np.ndarray:
    """A decoded PNG, JPEG, BMP or TIFF, or an error that names the file and what it should have been."""
    data = read_bytes(path, expected)
    unreadable = BadInput(str(path), f"an unreadable file of {len(data)} bytes", expected)
    # A PNG that was cut off lacks its end mark; the decoder would complain on stderr before it gives up.
    if not data or (data.startswith(b"\x89PNG") and b"IEND" not in data[-16:]):
        raise unreadable
    try:
        width, height = _size(data)
        if width * height > LARGEST_IMAGE_PX:
            raise BadInput(str(path), f"{width}x{height} pixels", f"{expected} of at most {LARGEST_IMAGE_PX} pixels")
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except BadInput:
        raise
    except _UNDECODED:
        raise unreadable from None
    if image is None:
        raise unreadable
    return image


def _size(data: bytes) -> tuple[int, int]:
    """Width and height as the header of an image says, before any memory is given to its pixels."""
    from PIL import BmpImagePlugin, JpegImagePlugin

    if data[:4] in (b"II*\0", b"MM\0*"):  # of TIFF, OpenCV reads more kinds than Pillow
        order = "<" if data[:1] == b"I" else ">"
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, at)
        tags = {}
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            tag, kind = struct.unpack_from(f"{order}HH", data, entry)
            (tags[tag],) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, entry + 8)
        return tags[256], tags[257]
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack(">II", data[16:24])
    kind = BmpImagePlugin.BmpImageFile if data[:2] == b"BM" else JpegImagePlugin.JpegImageFile
    return kind(BytesIO(data)).size


def read_rgb(path: Path) -> np.ndarray:
    """(H, W, 3) uint8, red first."""
    # A rotation in an image's EXIF would turn it away from its depth image.
    bgr = read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, "a colour image")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_raw_depth(path: Path) -> np.ndarray:
    """(H, W) uint16 or float32 in the file's own unit, of an image or of an array of NumPy's."""
    if path.suffix == ".npy":
        raw = read_array(path, "a depth image (H, W) as .npy")
        raw = raw.astype(np.float32) if raw.dtype.kind == "f" else raw
    else:
        raw = read_image(path, cv2.IMREAD_UNCHANGED, "a 16-bit depth image")
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32):
        colours = raw.dtype == np.uint8 and raw.ndim == 3
        fix = "These are colours: are colour and depth images swapped?" if colours else ""
        fix = fix or "8 bits hold no depth: save 16-bit images." * (raw.dtype == np.uint8)
        raise BadInput(str(path), f"{raw.shape} {raw.dtype}", "one channel, uint16 or float32", fix)
    return raw


def is_cut_off(path: Path) -> bool:
    """Whether a file is empty, or an image without its end, as when it was copied in part; without decoding it."""
    mark, within = _END_MARKS.get(path.suffix.lower(), (b"", 0))
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - within, 0))
        return size == 0 or mark not in file.read()


def check_size(
    path: Path, image: np.ndarray, shape: tuple[int, int], like: str = "the colour image", fix: str = ""
) -> None:
    """:class:`BadInput` naming the file where an image is not of the (height, width) that ``like`` has."""
    if image.shape[:2] != shape:
        raise wrong_size(str(path), image.shape[:2], shape, like, fix)


def save_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3), red first, or (H, W), a mask as 0 and 255, and the folders above it."""
    image = np.where(image, np.uint8(255), np.uint8(0)) if image.dtype == bool else image
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    with replacing(path, durable=False) as file:
        file.write(cv2.imencode(".png", bgr)[1].tobytes())
