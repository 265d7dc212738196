"""YCBMultiTrack: several objects, occluded and coming back.

``rgb/``, ``depth/`` (uint16 millimetres, 65535 = invalid), ``cam_K.txt``, and for every object
``annotated_poses/<obj>/*.txt`` (4x4 T_cam_model, metres), ``masks/<obj>/*.png`` (visible part) and two labels
a frame, ``is_mask_visible/<obj>/is_mask_visible.npy`` and ``is_obj_in_image_labels/<obj>/is_obj_in_image.npy``.
Models lie in ``models/<obj>/`` of the sequence or of the dataset, one folder above.

The recorded truth is held constant while an object is occluded: it counts only where both labels hold.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, pictures
from p2p_lib.datasets.masks import MaskFiles, find_masks, masks_folder
from p2p_lib.datasets.sequence import ObjectTruth

DEPTH_INVALID = 65535
LABELS = {"is_mask_visible": "is_mask_visible.npy", "is_obj_in_image_labels": "is_obj_in_image.npy"}


def recognises(folder: Path) -> bool:
    """Whether a folder has ``annotated_poses/<obj>/``."""
    return bool(_objects(folder))


def _objects(folder: Path) -> tuple[str, ...]:
    poses = folder / "annotated_poses"
    return tuple(sorted(p.name for p in poses.iterdir() if p.is_dir())) if poses.is_dir() else ()


def load(folder: Path, name: str, depth_scale: float | None, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; arguments as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    rgb_files, depth_files, camera, times_s = pictures(folder)
    shape = camera.height, camera.width
    objects = _objects(folder)
    if not objects:
        raise BadInput(str(folder / "annotated_poses"), "no folders", "one folder of poses for each object")

    def find(where: Path) -> MaskFiles:
        return find_masks(where, rgb_files, shape, objects)

    own = find(folder / "masks") if (folder / "masks").is_dir() else None
    chosen = find(masks_folder(folder, masks)) if masks else own

    def read_truth() -> dict[str, ObjectTruth]:
        truth = {}
        for obj in objects:
            files = images.list_files(folder / "annotated_poses" / obj, (".txt",), "pose files")
            poses = images.read_poses(images.check_paired(files, rgb_files))
            truth[obj] = ObjectTruth(poses, read_labels(folder, obj, len(rgb_files)))
        return truth

    return ImageSequence(
        name=name,
        format="ycbmultitrack",
        path=folder,
        camera=camera,
        objects=objects,
        rgb_files=rgb_files,
        depth_files=depth_files,
        times_s=times_s,
        depth_scale=depth_scale or images.DEPTH_SCALE,
        depth_invalid=DEPTH_INVALID,
        mask_files=chosen,
        own_masks=own or chosen,
        read_truth=read_truth,
        model_places={
            obj: tuple(root / "models" / obj for root in (folder, images.full(folder).parent)) for obj in objects
        },
    )


def read_labels(folder: Path, obj: str, n: int) -> np.ndarray:
    """(n,) bool: both visibility labels of an object hold; a label that is not there counts as holding."""
    holds = np.ones(n, bool)
    for kind, file in LABELS.items():
        path = folder / kind / obj / file
        if not path.is_file():
            continue
        try:
            label = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise BadInput(str(path), f"an unreadable array ({error})", f"{n} labels as a .npy of bool") from None
        if label.size != n or label.dtype.kind not in "biuf":
            raise BadInput(str(path), f"shape {label.shape} {label.dtype}", f"{n} labels, one for each picture")
        holds &= label.ravel().astype(bool)
    return holds
