"""What goes wrong when one records one's own data, put into a good folder on purpose.

For the tests of ``p2p check`` and for the notebook on own data: each fault of :data:`FAULTS` changes a folder as
:func:`p2p_lib.datasets.folder.write` makes it, in place.
"""

from __future__ import annotations

from collections.abc import Callable
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


def _depth_unit(folder: Path) -> None:
    """Depth in millimetres that is taken for metres."""
    (folder / "depth_scale.txt").write_text("1\n")


def _depth_in_metres(folder: Path) -> None:
    """Depth stored as metres where millimetres are expected."""
    for path in (folder / "depth").iterdir():
        metres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
        cv2.imwrite(str(path.with_suffix(".tif")), metres)
        path.unlink()


def _not_registered(folder: Path) -> None:
    """Depth as a D435's depth camera sees it: a wider view, and 15 mm beside the colour camera."""
    for path in (folder / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        h, w = depth.shape
        seen = np.array([[0.75, 0, 0.125 * w + 12], [0, 0.75, 0.125 * h]])
        cv2.imwrite(str(path), cv2.warpAffine(depth, seen, (w, h), flags=cv2.INTER_NEAREST))


def _shifted(folder: Path) -> None:
    """Depth and colour of one size and view, 18 px apart."""
    for path in (folder / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.roll(depth, 18, axis=1))


def _other_resolution(folder: Path) -> None:
    """The camera matrix of pictures twice as large."""
    K = np.loadtxt(folder / "cam_K.txt")
    K[:2] *= 2
    np.savetxt(folder / "cam_K.txt", K)


def _other_aspect(folder: Path) -> None:
    """The camera matrix of 1280x720, where the pictures are narrower."""
    K = np.loadtxt(folder / "cam_K.txt")
    K[0, 2], K[1, 2] = 639.5, 359.5
    np.savetxt(folder / "cam_K.txt", K)


def _milliseconds(folder: Path) -> None:
    """Times in milliseconds."""
    np.savetxt(folder / "times.txt", np.loadtxt(folder / "times.txt") * 1000, fmt="%.3f")


def _backwards(folder: Path) -> None:
    """Times that jump back half-way, as those of two recordings put together."""
    times_s = np.loadtxt(folder / "times.txt")
    times_s[len(times_s) // 2 :] -= times_s[len(times_s) // 2]
    np.savetxt(folder / "times.txt", times_s, fmt="%.6f")


def _gap(folder: Path) -> None:
    """Three seconds in which nothing was recorded."""
    times_s = np.loadtxt(folder / "times.txt")
    times_s[len(times_s) // 2 :] += 3
    np.savetxt(folder / "times.txt", times_s, fmt="%.6f")


def _repeated(folder: Path) -> None:
    """Every picture twice: a recorder that was faster than its camera."""
    for kind in ("rgb", "depth"):
        files = sorted((folder / kind).iterdir())
        for a, b in zip(files[::2], files[1::2]):
            b.write_bytes(a.read_bytes())


def _bare(folder: Path) -> None:
    """Objects of one plain colour, with the noise of a camera."""
    rng = np.random.default_rng(0)
    for path in (folder / "rgb").iterdir():
        image = cv2.imread(str(path))
        for mask_file in (folder / "masks").glob(f"*/{path.name}"):
            mask = cv2.imread(str(mask_file), cv2.IMREAD_UNCHANGED)
            wide = cv2.dilate(mask, np.ones((9, 9))) > 0
            if mask.any():
                plain = np.median(image[mask > 0], 0) + rng.normal(0, 2.5, (int(wide.sum()), 3))
                image[wide] = np.clip(plain, 0, 255)
        cv2.imwrite(str(path), image)


def _wide_masks(folder: Path) -> None:
    """Masks drawn 6 px too wide."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13))
    for path in (folder / "masks").glob("*/*.png"):
        cv2.imwrite(str(path), cv2.dilate(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), disc))


def _far(folder: Path) -> None:
    """Depth in tenths of a millimetre that is taken for millimetres: everything ten times as far away."""
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * np.uint16(10))


def _no_depth(folder: Path) -> None:
    """Objects that the depth camera does not see: dark, shiny, transparent."""
    for path in (folder / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        for mask_file in (folder / "masks").glob(f"*/{path.name}"):
            depth[cv2.imread(str(mask_file), cv2.IMREAD_UNCHANGED) > 0] = 0
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
