"""A plain folder of one's own: ``rgb/``, ``depth/`` and ``cam_K.txt``; no truth.

``masks/`` is optional: one folder per object (named by it), or one label image per image (0 = background,
k = object k): of all images, or of some, named as these; a single one is the first image's, whatever its name.
``times.txt`` (seconds, one a line) is optional; images whose names are nanoseconds need none. ``depth_scale.txt`` is
optional: metres per unit of the depth images, which are in millimetres otherwise.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, image_files
from p2p_lib.datasets.sequence import Sequence


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    files = image_files(folder)
    found, _ = files.find_masks(masks, [] if masks else [folder / "masks"], some_frames=True)
    objects = tuple(found.files) if found else ("object",)
    return ImageSequence(
        **vars(files),
        objects=objects,
        depth_scale=_depth_scale(folder / "depth_scale.txt"),
        mask_files=found,
        own_masks=found,
        model_places={obj: (folder / "models" / obj,) for obj in objects},
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

    Raises :class:`BadInput` where the folder is not empty, unless ``overwrite`` lets its images and masks go.
    """
    out = Path(out)
    for old in ("rgb", "depth", "masks") if overwrite else ():
        shutil.rmtree(out / old, ignore_errors=True)
    if not overwrite and out.is_dir() and any(out.iterdir()):
        raise BadInput(str(out), "a folder that is not empty", "a new one for the images")
    frames = list(range(len(sequence)) if frames is None else frames)
    wanted = set(range(len(frames)) if masks is None else masks)
    for number, i in enumerate(frames):
        frame = sequence.frame(i)
        depth = np.rint(frame.depth_m / images.DEPTH_SCALE).astype(np.uint16)
        images.save_png(out / "rgb" / f"{number:06d}.png", frame.rgb)
        images.save_png(out / "depth" / f"{number:06d}.png", depth)
        for name, mask in (sequence.masks(i) or {}).items() if number in wanted else ():
            images.save_png(out / "masks" / name / f"{number:06d}.png", mask)
    np.savetxt(out / "cam_K.txt", sequence.camera.K, fmt="%.9g")
    np.savetxt(out / "times.txt", sequence.times_s[frames] - sequence.times_s[frames[0]], fmt="%.6f")
    return out


def _depth_scale(path: Path) -> float:
    """Metres per unit, as the file says; millimetres where there is none."""
    if not path.is_file():
        return images.DEPTH_SCALE
    scale = images.read_numbers(path, "metres per unit of the depth images, one number")
    if scale.shape != (1, 1) or not 0 < scale[0, 0] <= 1:
        got = " ".join(path.read_text().split())[:40]
        raise BadInput(str(path), got, "one number above 0, at most 1: metres per unit")
    return float(scale[0, 0])
