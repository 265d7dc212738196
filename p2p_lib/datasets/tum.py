"""TUM RGB-D, as that benchmark and many recorders write it: ``rgb.txt`` and ``depth.txt`` list images with their times.

Each line is ``time_s path``; a colour image goes with the depth image nearest in time, at most 20 ms away, and one
without is left out, as the benchmark's own ``associate.py`` does. Depth has 5000 units a metre. The camera matrix is
``cam_K.txt`` where there is one, else the benchmark's of the Kinect that the folder's name tells (``freiburg1``).
Masks are those of a plain folder; there is no truth, since ``groundtruth.txt`` is the camera's.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.paths import full
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, camera_for, read_K

DEPTH_SCALE = 1 / 5000
APART_S = 0.02
#: fx, fy, cx, cy of the benchmark's three Kinects, from its page on file formats.
KINECTS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    (rgb_s, rgb), (depth_s, depth) = (_listed(folder / f"{kind}.txt") for kind in ("rgb", "depth"))
    nearest = np.abs(depth_s - rgb_s[:, None]).argmin(1)
    pairs = np.flatnonzero(np.abs(depth_s[nearest] - rgb_s) <= APART_S)
    if not len(pairs):
        got = f"colour from {rgb_s[0]:.3f} s, depth from {depth_s[0]:.3f} s"
        raise BadInput(str(folder), got, f"images at most {1000 * APART_S:g} ms apart", "Are both of one clock?")
    files = ImageSequence(
        folder,
        tuple(rgb[i] for i in pairs),
        tuple(depth[i] for i in nearest[pairs]),
        camera_for(rgb, *_K(folder)),
        rgb_s[pairs],
        depth_scale=DEPTH_SCALE,
    )
    return files.without_truth(masks)


def _listed(path: Path) -> tuple[np.ndarray, list[Path]]:
    """Times in seconds (N,), which increase, and images of a list."""
    form = "lines of a time in seconds and an image, such as 1305031453.35 rgb/1305031453.35.png"
    lines = [line.split() for line in images.read_lines(path, form)]
    try:
        times_s, files = np.array([float(time) for time, _ in lines]), [path.parent / name for _, name in lines]
    except ValueError:
        raise BadInput(str(path), "another kind of line", form) from None
    if not len(files) or not (np.diff(times_s) > 0).all():
        got = "no line" if not len(files) else f"times that run backwards at {times_s[1:][~(np.diff(times_s) > 0)][0]}"
        raise BadInput(str(path), got, form)
    return times_s, files


def _K(folder: Path) -> tuple[np.ndarray, str]:
    """The camera matrix and where it is from."""
    path = folder / "cam_K.txt"
    known = re.search("|".join(KINECTS), full(folder).name)
    if path.is_file() or known is None:
        return read_K(folder)[:2]
    fx, fy, cx, cy = KINECTS[known[0]]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), f"the camera of {known[0]}"
