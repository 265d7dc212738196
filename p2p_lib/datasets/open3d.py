"""What Open3D's recorders write: ``color/``, ``depth/`` and ``camera_intrinsic.json`` or ``intrinsic.json``.

Depth is registered to colour, in millimetres; images are numbered, at 30 a second where there is no ``times.txt``.
Masks are those of a plain folder; there is no truth.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from p2p_lib.core.errors import MissingData
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, camera_for, paired_images
from p2p_lib.datasets.schema import read_json


class _Intrinsic(BaseModel):
    intrinsic_matrix: Annotated[list[float], Field(min_length=9, max_length=9)]


INTRINSICS = ("camera_intrinsic.json", "intrinsic.json")


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    rgb, depth = paired_images(folder, "color")
    path = next((folder / name for name in INTRINSICS if (folder / name).is_file()), None)
    if path is None:
        fix = "Open3D's recorder writes it beside color/."
        fix = "Rename color/ to rgb/: cam_K.txt is read beside that." if (folder / "cam_K.txt").is_file() else fix
        fix += " If it is of another layout, name that with --format."
        raise MissingData(str(folder), f"no {' or '.join(INTRINSICS)}, as Open3D's layout (color/) has", fix)
    # It is written column by column.
    K = np.array(read_json(path, _Intrinsic, "a pinhole camera as Open3D writes it").intrinsic_matrix).reshape(3, 3).T
    files = ImageSequence(folder, rgb, depth, camera_for(rgb, K, str(path)), images.frame_times(folder, rgb))
    return files.without_truth(masks)
