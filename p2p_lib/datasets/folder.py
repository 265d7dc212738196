"""A plain folder of one's own: ``rgb/``, ``depth/`` and ``cam_K.txt``; no truth.

``masks/`` is optional: one folder per object (named by it), or one label image per image (0 = background,
k = object k): of all images, or of some, named as these; a single one is the first image's, whatever its name.
``times.txt`` (seconds, one a line) is optional; images whose names are nanoseconds need none. ``depth_scale.txt`` is
optional: metres per unit of the depth images; otherwise they are in millimetres, and floats (``.tif``, ``.npy``) in
metres where the first image's median is below 20.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import check_new
from p2p_lib.core.types import Frame
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, image_files
from p2p_lib.datasets.sequence import Sequence

#: Depth cameras see no farther; and nearer than 20 mm none does.
_FARTHEST_M = 20.0


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    files = image_files(folder)
    scale = _depth_scale(folder / "depth_scale.txt", files.depth)
    return replace(files, depth_scale=scale).without_truth(masks)


def write(
    sequence: Sequence,
    out: str | Path,
    frames: Iterable[int] | None = None,
    masks: Iterable[int] | None = None,
    overwrite: bool = False,
) -> Path:
    """Some frames of any sequence as such a folder, as if one had recorded it: no truth, depth in millimetres.

    frames  which (default: all); they are numbered anew
    masks   of which of these, by their new numbers: all by default, ``()`` for none, ``(0,)`` for the first alone

    Raises :class:`BadInput` where the folder is not empty, unless ``overwrite`` lets its images and masks go.
    """
    out = Path(out)
    for old in ("rgb", "depth", "masks") if overwrite else ():
        shutil.rmtree(out / old, ignore_errors=True)
    if not overwrite:
        check_new(out)
    frames = list(range(len(sequence)) if frames is None else frames)
    wanted = set(range(len(frames)) if masks is None else masks)
    write_images(out, (sequence.frame(i) for i in frames))
    for number, i in enumerate(frames):
        for name, mask in (sequence.masks(i) or {}).items() if number in wanted else ():
            images.save_png(out / "masks" / name / f"{number:06d}.png", mask)
    write_about(out, sequence.camera, sequence.times_s[frames] - sequence.times_s[frames[0]])
    return out


def write_images(out: str | Path, frames: Iterable[Frame], unit_m: float = images.DEPTH_SCALE) -> list[float]:
    """``rgb/`` and ``depth/``, numbered, depth in units of ``unit_m``; the frames' times in seconds."""
    times_s: list[float] = []
    for frame in frames:
        raw = np.rint(frame.depth_m / unit_m)
        raw[raw > np.iinfo(np.uint16).max] = 0  # too far to be told: no measurement
        name = f"{len(times_s):06d}.png"
        images.save_png(Path(out) / "rgb" / name, frame.rgb)
        images.save_png(Path(out) / "depth" / name, raw.astype(np.uint16))
        times_s.append(frame.time_s)
    return times_s


def write_about(out: str | Path, camera: Camera, times_s: Iterable[float], unit_m: float = images.DEPTH_SCALE) -> None:
    """``cam_K.txt``, ``times.txt`` and, where depth is not in millimetres, ``depth_scale.txt``."""
    np.savetxt(Path(out) / "cam_K.txt", camera.K, fmt="%.9g")
    np.savetxt(Path(out) / "times.txt", np.asarray(times_s), fmt="%.6f")
    if unit_m != images.DEPTH_SCALE:
        np.savetxt(Path(out) / "depth_scale.txt", [unit_m], fmt="%.9g")


def _depth_scale(path: Path, depth: tuple[Path, ...]) -> float:
    """Metres per unit, as the file says; where there is none millimetres, or what the floats of the first image are."""
    if not path.is_file():
        floats = depth[0].suffix.lower() in (".npy", ".tif", ".tiff")
        raw = images.first_readable(depth, images.read_raw_depth) if floats else np.zeros(0, np.uint16)
        known = raw[raw > 0]
        in_metres = raw.dtype.kind == "f" and len(known) and np.median(known) < _FARTHEST_M
        return 1.0 if in_metres else images.DEPTH_SCALE
    scale = images.read_numbers(path, "metres per unit of the depth images, one number")
    if scale.shape != (1, 1) or not 0 < scale[0, 0] <= 1:
        got = " ".join(map(str, scale.ravel()[:4]))
        raise BadInput(str(path), got, "one number above 0, at most 1: metres per unit")
    return float(scale[0, 0])
