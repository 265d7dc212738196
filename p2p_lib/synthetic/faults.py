"""What goes wrong when one records one's own data, put into a good folder on purpose.

For the tests of ``p2p check`` and for the notebook on own data: each fault of :data:`FAULTS` changes a folder as
:func:`p2p_lib.datasets.folder.write` makes it, in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput


def spoil(folder: str | Path, fault: str) -> Path:
    """Put a fault of :data:`FAULTS` into a folder; :class:`BadInput` for an unknown one."""
    if fault not in FAULTS:
        raise BadInput("fault", repr(fault), "one of " + ", ".join(FAULTS))
    FAULTS[fault](Path(folder))
    return Path(folder)


def _read(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def _change(files: Iterable[Path], change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Rewrites images as a function of what they were."""
    for path in files:
        cv2.imwrite(str(path), change(_read(path)))


def _change_times(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Rewrites the times, in seconds, as a function of what they were."""
    np.savetxt(folder / "times.txt", change(np.loadtxt(folder / "times.txt")), fmt="%.6f")


def _depth_unit(folder: Path) -> None:
    """Depth in millimetres that is taken for metres."""
    (folder / "depth_scale.txt").write_text("1\n")


def _depth_in_metres(folder: Path) -> None:
    """Depth stored as metres where millimetres are expected."""
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path.with_suffix(".tif")), _read(path).astype(np.float32) / 1000)
        path.unlink()


def _not_registered(folder: Path) -> None:
    """Depth as a D435's depth camera sees it: a wider view, and 15 mm beside the colour camera."""

    def wider(depth: np.ndarray) -> np.ndarray:
        h, w = depth.shape
        seen = np.array([[0.75, 0, 0.125 * w + 12], [0, 0.75, 0.125 * h]])
        return cv2.warpAffine(depth, seen, (w, h), flags=cv2.INTER_NEAREST)

    _change((folder / "depth").iterdir(), wider)


def _shifted(folder: Path) -> None:
    """Depth and colour of one size and view, 18 px apart."""
    _change((folder / "depth").iterdir(), lambda depth: np.roll(depth, 18, axis=1))


def _far(folder: Path) -> None:
    """Depth in tenths of a millimetre that is taken for millimetres: everything ten times as far away."""
    _change((folder / "depth").iterdir(), lambda depth: depth * np.uint16(10))


def _other_resolution(folder: Path) -> None:
    """The camera matrix of images twice as large."""
    K = np.loadtxt(folder / "cam_K.txt")
    K[:2] *= 2
    np.savetxt(folder / "cam_K.txt", K)


def _other_aspect(folder: Path) -> None:
    """The camera matrix of 1280x720, where the images are narrower."""
    K = np.loadtxt(folder / "cam_K.txt")
    K[0, 2], K[1, 2] = 639.5, 359.5
    np.savetxt(folder / "cam_K.txt", K)


def _milliseconds(folder: Path) -> None:
    """Times in milliseconds."""
    _change_times(folder, lambda times_s: times_s * 1000)


def _backwards(folder: Path) -> None:
    """Times that jump back half-way, as those of two recordings put together."""
    _change_times(folder, lambda s: np.where(np.arange(len(s)) < len(s) // 2, s, s - s[len(s) // 2]))


def _gap(folder: Path) -> None:
    """Three seconds in which nothing was recorded."""
    _change_times(folder, lambda s: np.where(np.arange(len(s)) < len(s) // 2, s, s + 3))


def _repeated(folder: Path) -> None:
    """Every frame twice: a recorder that was faster than its camera."""
    for kind in ("rgb", "depth"):
        files = sorted((folder / kind).iterdir())
        for a, b in zip(files[::2], files[1::2]):
            b.write_bytes(a.read_bytes())


def _bare(folder: Path) -> None:
    """Objects of one plain colour, with the noise of a camera."""
    rng = np.random.default_rng(0)
    for path in (folder / "rgb").iterdir():
        image = cv2.imread(str(path))
        for mask in map(_read, (folder / "masks").glob(f"*/{path.name}")):
            wide = cv2.dilate(mask, np.ones((9, 9))) > 0
            if mask.any():
                plain = np.median(image[mask > 0], 0) + rng.normal(0, 2.5, (int(wide.sum()), 3))
                image[wide] = np.clip(plain, 0, 255)
        cv2.imwrite(str(path), image)


def _wide_masks(folder: Path) -> None:
    """Masks drawn 6 px too wide."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13))
    _change((folder / "masks").glob("*/*.png"), lambda mask: cv2.dilate(mask, disc))


def _no_depth(folder: Path) -> None:
    """Objects that the depth camera does not see: dark, shiny, transparent."""
    for path in (folder / "depth").iterdir():
        depth = _read(path)
        for mask in map(_read, (folder / "masks").glob(f"*/{path.name}")):
            depth[mask > 0] = 0
        cv2.imwrite(str(path), depth)


#: Fault to what puts it into a folder.
FAULTS: dict[str, Callable[[Path], None]] = {
    "depth unit": _depth_unit,
    "depth in metres": _depth_in_metres,
    "ten times as far": _far,
    "depth not registered": _not_registered,
    "depth shifted": _shifted,
    "K of another resolution": _other_resolution,
    "K of another aspect": _other_aspect,
    "times in milliseconds": _milliseconds,
    "times jump back": _backwards,
    "a gap": _gap,
    "pictures twice": _repeated,
    "no texture": _bare,
    "wide masks": _wide_masks,
    "no depth on the objects": _no_depth,
}
