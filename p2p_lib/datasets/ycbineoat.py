"""YCBInEOAT: one object moved by a robot's hand, seen by a fixed camera.

``rgb/``, ``depth/`` (uint16 millimetres), ``cam_K.txt``, ``gt_mask/`` (masks from the arm's kinematics),
``annotated_poses/*.txt`` (4x4 T_cam_model, metres, OpenCV axes; the i-th belongs to the i-th image).
``masks/``, a separate download or the first image's mask alone, serves where ``gt_mask/`` is not there. Models lie in
``models/object/``, or by their YCB name in ``models/`` of the dataset, one folder above: the sequence's name begins
with the object's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from p2p_lib.core.paths import full
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, image_files
from p2p_lib.datasets.truth import ObjectTruth

OBJECT = "object"
YCB_NAMES = {
    "mustard": "006_mustard_bottle",
    "cracker_box": "003_cracker_box",
    "sugar_box": "004_sugar_box",
    "bleach": "021_bleach_cleanser",
    "tomato_soup_can": "005_tomato_soup_can",
}


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    places, whole = [folder / "gt_mask", folder / "masks"], (folder / "gt_mask").is_dir()
    files = image_files(folder).with_masks(masks, places, (OBJECT,), some_frames=not whole)
    at = full(folder)
    known = [at.parent / "models" / ycb for begins, ycb in YCB_NAMES.items() if at.name.startswith(begins)]

    def read_truth() -> dict[str, ObjectTruth]:
        if not (folder / "annotated_poses").is_dir():
            return {}
        poses = images.read_poses(folder / "annotated_poses", files.rgb)
        return {OBJECT: ObjectTruth(poses, np.ones(len(poses), bool))}

    return replace(files, read_truth=read_truth, model_places={OBJECT: (folder / "models" / OBJECT, *known)})
