"""HO-3D, version 3: one object in a hand, as BundleSDF evaluates on it.

``HO3D_v3/evaluation/<sequence>/`` with ``rgb/0000.jpg``, ``depth/0000.png`` (see :func:`read_raw_depth`) and
``meta/0000.pkl``: camera matrix, object pose (OpenGL camera axes) or None, object name. The dataset has no masks of
the object; those of others lie in ``HO3D_v3/masks/<sequence>/`` or ``HO3D_v3/masks_XMem/<sequence>/``, models in
``HO3D_v3/models/<YCB name>/``. Every frame with truth is scored, as the field does it: such masks are not truth.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.paths import full
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, camera_for, paired_images
from p2p_lib.datasets.pickles import load_plain
from p2p_lib.datasets.truth import ObjectTruth

OBJECT = "object"
MASKS = ("masks", "masks_XMem")
DEPTH_SCALE = 0.00012498664727900177  # metres per unit, from the dataset's own reader
# OpenGL's camera looks along -z with y up, OpenCV's along +z with y down.
T_CV_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    rgb, depth = paired_images(folder)
    meta_files = images.check_paired(images.list_files(folder / "meta", (".pkl",), "meta files"), rgb)
    first = read_meta(meta_files[0])
    camera = camera_for(rgb, first["camMat"], f"{meta_files[0]}: camMat")
    files = ImageSequence(folder, rgb, depth, camera, images.frame_times(folder, rgb))
    at = full(folder)
    folders = [at.parents[1] / str(where) / at.name for where in ([masks] if masks else MASKS)]
    files = files.with_masks(next((where for where in folders if where.is_dir()), masks), objects=(OBJECT,))

    def read_truth() -> dict[str, ObjectTruth]:
        poses = [read_pose(path, read_meta(path), camera) for path in meta_files]
        return {OBJECT: ObjectTruth(np.stack(poses), np.ones(len(poses), bool))}

    return replace(
        files,
        depth_scale=DEPTH_SCALE,
        read_depth=read_raw_depth,
        own_masks=None,
        read_truth=read_truth,
        model_places={OBJECT: _models(folder, first)},
    )


def read_meta(path: Path) -> dict:
    """One frame's ``meta`` as it is, read by the unpickler that admits arrays and plain values alone."""
    meta = load_plain(path)
    if not isinstance(meta, dict):
        raise BadInput(str(path), f"a {type(meta).__name__}", "a dict with camMat, objTrans, objRot")
    K: Any = meta.get("camMat")
    if not isinstance(K, np.ndarray) or K.shape != (3, 3) or K.dtype.kind not in "fiu":
        raise BadInput(f"{path}: camMat", f"{type(K).__name__} {np.shape(K)}", "an array of 3x3 numbers")
    return meta


def read_pose(path: Path, meta: dict, camera: Camera) -> np.ndarray:
    """T_cam_model (4, 4) in metres and OpenCV axes; NaN where the frame has no truth.

    ``meta`` is what ``path`` holds, its camera must be the sequence's.
    """
    if Camera.from_K(meta["camMat"], camera.width, camera.height, name=f"{path}: camMat") != camera:
        raise BadInput(f"{path}: camMat", "another camera than the first frame's", "one camera for the whole sequence")
    t, w = meta.get("objTrans"), meta.get("objRot")
    if t is None or w is None:
        return np.full((4, 4), np.nan)
    t, w = np.asarray(t), np.asarray(w)
    if not all(x.size == 3 and x.dtype.kind in "fiu" and np.isfinite(x).all() for x in (t, w)):
        raise BadInput(str(path), f"objTrans {t}, objRot {w}", "three finite numbers each: metres, axis-angle")
    return T_CV_GL @ se3.from_rt(se3.exp(np.r_[w.ravel().astype(float), 0, 0, 0])[:3, :3], t.ravel().astype(float))


def read_raw_depth(path: Path) -> np.ndarray:
    """(H, W) uint16 of a PNG whose red byte is the low one and whose green byte the high one."""
    bgr = images.read_image(path, cv2.IMREAD_COLOR, "a depth image in two colour bytes")
    # uint16 first: NumPy 2 refuses 256 * uint8, older versions overflowed.
    return bgr[..., 2].astype(np.uint16) + (bgr[..., 1].astype(np.uint16) << 8)


def _models(folder: Path, meta: dict) -> tuple[Path, ...]:
    """Where the model lies: BundleSDF scores with all vertices of ``textured_simple.obj``."""
    own, known = folder / "models" / OBJECT, meta.get("objName")
    if not isinstance(known, str) or not re.fullmatch(r"[\w-]+", known):
        return (own,)
    models = full(folder).parents[1] / "models" / known
    return own, models / "textured_simple.obj", models
