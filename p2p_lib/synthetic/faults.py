"""What goes wrong when one records one's own data, put into a good folder on purpose.

For the tests of ``p2p check`` and for the notebook on own data: each fault of :data:`FAULTS` changes a folder as
:func:`p2p_lib.datasets.folder.write` makes it, in place. What fails for a while is in :mod:`p2p_lib.datasets.faulty`.
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


def _images(pattern: str, change: Callable[[np.ndarray, list[np.ndarray]], np.ndarray]) -> Callable[[Path], None]:
    """Rewrites the images that fit a pattern, each as a function of itself and of its frame's masks."""

    def spoil(folder: Path) -> None:
        for path in folder.glob(pattern):
            masks = [_read(mask) for mask in (folder / "masks").glob(f"*/{path.name}")]
            cv2.imwrite(str(path), change(_read(path), masks))

    return spoil


def _numbers(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Rewrites a text file of numbers as a function of them."""
    return lambda folder: np.savetxt(folder / name, change(np.loadtxt(folder / name)), fmt="%.6f")


def _read(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def _scaled(depth: np.ndarray, _: list[np.ndarray]) -> np.ndarray:
    factor = np.random.default_rng(int(depth.sum())).uniform(0.85, 1.15)  # another one in every image
    return np.rint(depth * factor).astype(depth.dtype)


def _repeated(folder: Path) -> None:
    for kind in ("rgb", "depth"):
        files = sorted((folder / kind).iterdir())
        for a, b in zip(files[::2], files[1::2]):
            b.write_bytes(a.read_bytes())


def _wider(depth: np.ndarray, _: list[np.ndarray]) -> np.ndarray:
    h, w = depth.shape
    seen = np.array([[0.75, 0, 0.125 * w + 12], [0, 0.75, 0.125 * h]])
    return cv2.warpAffine(depth, seen, (w, h), flags=cv2.INTER_NEAREST)


def _plain(image: np.ndarray, masks: list[np.ndarray]) -> np.ndarray:
    rng = np.random.default_rng(int(image.sum()))  # noise that differs from frame to frame
    for mask in filter(np.any, masks):
        wide = cv2.dilate(mask, np.ones((9, 9))) > 0
        colour = np.median(image[mask > 0], 0) + rng.normal(0, 2.5, (int(wide.sum()), 3))
        image[wide] = np.clip(colour, 0, 255)
    return image


def _hidden(depth: np.ndarray, masks: list[np.ndarray]) -> np.ndarray:
    return np.where(np.any(masks, axis=0), 0, depth).astype(depth.dtype)


#: Fault to what puts it into a folder.
FAULTS: dict[str, Callable[[Path], None]] = {
    # Depth in millimetres that is taken for metres.
    "depth unit": lambda folder: (folder / "depth_scale.txt").write_text("1\n"),
    # Depth that is right up to a factor, another one in every image: that of a network for single images.
    "a moving scale": _images("depth/*", _scaled),
    # Depth in tenths of a millimetre that is taken for millimetres.
    "ten times as far": _images("depth/*", lambda depth, _: depth * np.uint16(10)),
    # Depth as a D435's depth camera sees it: a wider view, and 15 mm beside the colour camera.
    "depth not registered": _images("depth/*", _wider),
    # Depth and colour of one size and view, 18 px apart.
    "depth shifted": _images("depth/*", lambda depth, _: np.roll(depth, 18, axis=1)),
    # The camera matrix of images twice as large.
    "K of another resolution": _numbers("cam_K.txt", lambda K: K * [[2], [2], [1]]),
    # The camera matrix of 1280x720, where the images are narrower.
    "K of another aspect": _numbers("cam_K.txt", lambda K: [[K[0, 0], 0, 639.5], [0, K[1, 1], 359.5], K[2]]),
    "times in milliseconds": _numbers("times.txt", lambda s: s * 1000),
    # As those of two recordings put together.
    "times jump back": _numbers("times.txt", lambda s: np.r_[s[: len(s) // 2], s[len(s) // 2 :] - s[len(s) // 2]]),
    # Three seconds in which nothing was recorded.
    "a gap": _numbers("times.txt", lambda s: s + 3 * (np.arange(len(s)) >= len(s) // 2)),
    # Every frame twice: a recorder that was faster than its camera.
    "pictures twice": _repeated,
    # Objects of one plain colour, with the noise of a camera.
    "no texture": _images("rgb/*", _plain),
    # Masks drawn 6 px too wide.
    "wide masks": _images(
        "masks/*/*.png", lambda mask, _: cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13)))
    ),
    # Objects that the depth camera does not see: dark, shiny, transparent.
    "no depth on the objects": _images("depth/*", _hidden),
}
