"""What Open3D's recorders write: ``color/``, ``depth/`` and ``camera_intrinsic.json`` or ``intrinsic.json``.

Depth is registered to colour, in millimetres; images are numbered, at 30 a second where there is no ``times.txt``.
``cam_K.txt`` may stand for the JSON. Masks are those of a plain folder; there is no truth.
"""

from __future__ import annotations

from pathlib import Path

from p2p_lib.core.errors import MissingData
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import INTRINSICS, ImageSequence, camera_of, intrinsics_advice, paired_images


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    if not any((folder / name).is_file() for name in (*INTRINSICS, "cam_K.txt")):
        fix = (
            "If it is of another layout, name that with --format; if it is a folder of your own, rename color/ to rgb/ "
            f"and write cam_K.txt. {intrinsics_advice(folder)}"
        )
        raise MissingData(str(folder), f"no {' or '.join(INTRINSICS)}, as Open3D's layout (color/) has", fix)
    rgb, depth = paired_images(folder, "color")
    files = ImageSequence(folder, rgb, depth, camera_of(folder, rgb), images.frame_times(folder, rgb))
    return files.without_truth(masks)
