"""YCBMultiTrack: several objects, occluded and coming back.

``rgb/``, ``depth/`` (uint16 millimetres, 65535 = invalid), ``cam_K.txt``, and for every object
``annotated_poses/<obj>/*.txt`` (4x4 T_cam_model, metres), ``masks/<obj>/*.png`` (visible part) and two labels
a frame, ``is_mask_visible/<obj>/is_mask_visible.npy`` and ``is_obj_in_image_labels/<obj>/is_obj_in_image.npy``.
Models lie in ``models/<obj>/`` of the sequence or of the dataset, one folder above.

The recorded truth is held constant while an object is occluded: it counts only where both labels hold.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import read_array
from p2p_lib.core.paths import full
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, image_files
from p2p_lib.datasets.truth import ObjectTruth

DEPTH_INVALID = 65535
LABELS = {"is_mask_visible": "is_mask_visible.npy", "is_obj_in_image_labels": "is_obj_in_image.npy"}


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    objects = tuple(sorted(p.name for p in folder.glob("annotated_poses/*/")))
    files = image_files(folder)
    if not objects:
        raise BadInput(str(folder / "annotated_poses"), "no folders", "one folder of poses for each object")
    files = files.with_masks(masks, [folder / "masks"], objects)

    def read_truth() -> dict[str, ObjectTruth]:
        poses = {obj: images.read_poses(folder / "annotated_poses" / obj, files.rgb) for obj in objects}
        return {obj: ObjectTruth(T, read_labels(folder, obj, len(T))) for obj, T in poses.items()}

    roots = folder, full(folder).parent
    model_places = {obj: tuple(root / "models" / obj for root in roots) for obj in objects}
    return replace(files, depth_invalid=DEPTH_INVALID, read_truth=read_truth, model_places=model_places)


def write_truth(
    folder: Path, obj: str, names: Iterable[str], T_cam_model: np.ndarray, visible: np.ndarray, in_image: np.ndarray
) -> None:
    """An object's poses (N, 4, 4) and labels (N,) bool; ``names`` are those of the images, without their ending."""
    for kind in ("annotated_poses", *LABELS):
        (folder / kind / obj).mkdir(parents=True, exist_ok=True)
    for name, T in zip(names, T_cam_model, strict=True):
        np.savetxt(folder / "annotated_poses" / obj / f"{name}.txt", T, fmt="%.9f")
    for (kind, file), label in zip(LABELS.items(), (visible, in_image), strict=True):
        np.save(folder / kind / obj / file, label)


def read_labels(folder: Path, obj: str, n: int) -> np.ndarray:
    """(n,) bool: both visibility labels of an object hold; a label that is not there counts as holding."""
    holds = np.ones(n, bool)
    for kind, file in LABELS.items():
        path = folder / kind / obj / file
        if not path.is_file():
            continue
        label = read_array(path, f"{n} labels as a .npy of bool")
        if label.size != n or label.dtype.kind not in "biuf":
            raise BadInput(str(path), f"shape {label.shape} {label.dtype}", f"{n} labels, one for each image")
        holds &= label.ravel().astype(bool)
    return holds
