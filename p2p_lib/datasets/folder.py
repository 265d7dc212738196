"""A plain folder of one's own: ``rgb/``, ``depth/`` and ``cam_K.txt``; no truth.

``masks/`` is optional: one folder per object (named by it), or one label image per picture (0 = background,
k = object k). A single mask is taken as the first picture's. ``times.txt`` (seconds, one a line) is optional;
pictures whose names are nanoseconds need none. ``depth_scale.txt`` is optional: metres per unit of the depth images,
which are in millimetres otherwise.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, pictures
from p2p_lib.datasets.masks import find_masks, masks_folder
from p2p_lib.datasets.sequence import Sequence


def recognises(folder: Path) -> bool:
    """Whether a folder has ``rgb/``."""
    return (folder / "rgb").is_dir()


def load(folder: Path, name: str, depth_scale: float | None, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; arguments as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    rgb_files, depth_files, camera, times_s = pictures(folder)
    where = masks_folder(folder, masks) if masks else folder / "masks"
    found = None
    if masks or where.is_dir():
        found = find_masks(where, rgb_files, (camera.height, camera.width), first_frame_alone=True)
    return ImageSequence(
        name=name,
        format="folder",
        path=folder,
        camera=camera,
        objects=found.objects if found else ("object",),
        rgb_files=rgb_files,
        depth_files=depth_files,
        times_s=times_s,
        depth_scale=depth_scale or _depth_scale(folder / "depth_scale.txt"),
        mask_files=found,
        own_masks=found,
        model_places={name: (folder / "models" / name,) for name in (found.objects if found else ("object",))},
    )


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

    Raises :class:`BadInput` where the folder is not empty, unless ``overwrite`` lets its pictures and masks go.
    """
    out = Path(out)
    for old in ("rgb", "depth", "masks") if overwrite else ():
        shutil.rmtree(out / old, ignore_errors=True)
    if not overwrite and out.is_dir() and any(out.iterdir()):
        raise BadInput(str(out), "a folder that is not empty", "a new one for the pictures")
    frames = list(range(len(sequence)) if frames is None else frames)
    wanted = set(range(len(frames)) if masks is None else masks)
    for number, i in enumerate(frames):
        frame = sequence.frame(i)
        depth = np.rint(frame.depth_m / images.DEPTH_SCALE).astype(np.uint16)
        _save(out / "rgb" / f"{number:06d}.png", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
        _save(out / "depth" / f"{number:06d}.png", depth)
        for name, mask in (sequence.masks(i) or {}).items() if number in wanted else ():
            _save(out / "masks" / name / f"{number:06d}.png", mask.astype(np.uint8) * np.uint8(255))
    np.savetxt(out / "cam_K.txt", sequence.camera.K, fmt="%.9g")
    (out / "times.txt").write_text(
        "".join(f"{t:.6f}\n" for t in sequence.times_s[frames] - sequence.times_s[frames[0]])
    )
    return out


def _save(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def _depth_scale(path: Path) -> float:
    """Metres per unit, as the file says; millimetres where there is none."""
    if not path.is_file():
        return images.DEPTH_SCALE
    scale = images.read_numbers(path, "metres per unit of the depth images, one number")
    if scale.shape != (1, 1) or not 0 < scale[0, 0] <= 1:
        got = " ".join(path.read_text().split())[:40]
        raise BadInput(str(path), got, "one number above 0, at most 1: metres per unit")
    return float(scale[0, 0])
