"""YCBInEOAT: one object moved by a robot's hand, seen by a fixed camera.

``rgb/``, ``depth/`` (uint16 millimetres), ``cam_K.txt``, ``gt_mask/`` (masks from the arm's kinematics),
``annotated_poses/*.txt`` (4x4 T_cam_model, metres, OpenCV axes; the i-th belongs to the i-th picture).
``masks/``, a separate download, serves where ``gt_mask/`` is not there. Models lie in ``models/object/``, or by
their YCB name in ``models/`` of the dataset, one folder above: the sequence's name begins with the object's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, pictures
from p2p_lib.datasets.masks import MaskFiles, find_masks, masks_folder
from p2p_lib.datasets.sequence import ObjectTruth

OBJECT = "object"
YCB_NAMES = {
    "mustard": "006_mustard_bottle",
    "cracker_box": "003_cracker_box",
    "sugar_box": "004_sugar_box",
    "bleach": "021_bleach_cleanser",
    "tomato_soup_can": "005_tomato_soup_can",
}


def recognises(folder: Path) -> bool:
    """Whether a folder has ``gt_mask/`` or ``annotated_poses/*.txt``."""
    return (folder / "gt_mask").is_dir() or any((folder / "annotated_poses").glob("*.txt"))


def load(folder: Path, name: str, depth_scale: float | None, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; arguments as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    rgb_files, depth_files, camera, times_s = pictures(folder)
    shape = camera.height, camera.width

    def find(where: Path) -> MaskFiles:
        return find_masks(where, rgb_files, shape, (OBJECT,))

    own = next((find(folder / m) for m in ("gt_mask", "masks") if (folder / m).is_dir()), None)
    chosen = find(masks_folder(folder, masks)) if masks else own

    def read_truth() -> dict[str, ObjectTruth]:
        if not (folder / "annotated_poses").is_dir():
            return {}
        files = images.list_files(folder / "annotated_poses", (".txt",), "pose files")
        files = images.check_paired(files, rgb_files)
        return {OBJECT: ObjectTruth(images.read_poses(files), np.ones(len(files), bool))}

    return ImageSequence(
        name=name,
        format="ycbineoat",
        path=folder,
        camera=camera,
        objects=(OBJECT,),
        rgb_files=rgb_files,
        depth_files=depth_files,
        times_s=times_s,
        depth_scale=depth_scale or images.DEPTH_SCALE,
        mask_files=chosen,
        own_masks=own or chosen,
        read_truth=read_truth,
        model_places={OBJECT: _models(folder)},
    )


def _models(folder: Path) -> tuple[Path, ...]:
    at = images.full(folder)
    known = [at.parent / "models" / ycb for begins, ycb in YCB_NAMES.items() if at.name.startswith(begins)]
    return folder / "models" / OBJECT, *known
