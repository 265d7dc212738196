"""A scene in the BOP format: ``<split>/<scene>/`` of a BOP dataset.

``rgb/000001.png``, ``depth/000001.png``, ``mask_visib/000001_000000.png`` (image, index in its list of objects),
``scene_camera.json``, ``scene_gt.json`` (millimetres, OpenCV axes), ``scene_gt_info.json``; models in
``models_eval/`` or ``models/`` of the dataset. Images may be keyframes with gaps: their numbers give the times.
An object is called ``obj_000005``; a second one of the same kind in an image ``obj_000005_2``, in the file's order.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageFiles, ImageSequence, camera_for, paired_images
from p2p_lib.datasets.masks import MaskFiles
from p2p_lib.datasets.schema import read_json
from p2p_lib.datasets.sequence import ObjectTruth

MM = 0.001
Nine = Annotated[list[float], Field(min_length=9, max_length=9)]


class _Camera(BaseModel):
    cam_K: Nine
    depth_scale: float


class _Pose(BaseModel):
    obj_id: int
    cam_R_m2c: Nine
    cam_t_m2c: Annotated[list[float], Field(min_length=3, max_length=3)]


class _Info(BaseModel):
    px_count_visib: int = 1


def load(folder: Path, name: str, depth_scale: float | None, masks: str | Path | None) -> ImageSequence:
    """The scene in this folder; arguments as of :func:`~p2p_lib.datasets.sequence.open_sequence`.

    The depth scale is the scene's own unless another is given.
    """
    rgb, depth = paired_images(folder)
    numbers = [_number(path) for path in rgb]
    camera, scale_mm = _camera(folder / "scene_camera.json", numbers, rgb[0])
    files = ImageFiles(folder, rgb, depth, camera, (np.array(numbers) - numbers[0]) / images.DEFAULT_HZ)
    listed = _named(_lists(folder / "scene_gt.json", _Pose), numbers)
    objects = tuple(sorted({obj for at in listed for obj in at}))
    own = _visible_masks(folder, numbers, listed, objects, files.shape)
    chosen = files.masks(masks, (), objects or None)[0] if masks else own

    def read_truth() -> dict[str, ObjectTruth]:
        info = _lists(folder / "scene_gt_info.json", _Info)
        return {obj: _truth(folder, obj, numbers, listed, info) for obj in objects}

    return ImageSequence(
        name=name,
        format="bop",
        files=files,
        objects=objects or ("object",),
        depth_scale=depth_scale or scale_mm * MM,
        mask_files=chosen,
        own_masks=own or chosen,
        read_truth=read_truth,
        model_places={obj: _model_places(folder, obj) for obj in objects},
    )


def _number(path: Path) -> int:
    if not path.stem.isdigit():
        raise BadInput(str(path), f"the name {path.name!r}", "a number, as BOP names images")
    return int(path.stem)


def _camera(path: Path, numbers: list[int], image: Path) -> tuple[Camera, float]:
    """The one camera of a scene, and its depth scale in millimetres per unit."""
    scene = read_json(path, dict[int, _Camera], "cam_K and depth_scale for every image")
    if gone := set(numbers) - scene.keys():
        raise BadInput(str(path), f"no image {min(gone)}", "cam_K and depth_scale for every image")
    found = {(tuple(scene[i].cam_K), scene[i].depth_scale) for i in numbers}
    if len(found) > 1:
        fix = "T-LESS, whose images are crops, cannot be tracked."
        raise BadInput(str(path), f"{len(found)} cameras", "one camera and depth scale for the whole scene", fix)
    K, scale_mm = found.pop()
    return camera_for(image, np.reshape(K, (3, 3)), str(path)), scale_mm


def _lists(path: Path, entry: type) -> dict[int, list]:
    """Image number to its list of entries; nothing where there is no such file."""
    return read_json(path, dict[int, list[entry]], "a list of objects for each image") if path.is_file() else {}


def _named(scene: dict[int, list[_Pose]], numbers: list[int]) -> list[dict[str, tuple[int, _Pose]]]:
    """For each image: object to its index in the list and its pose."""
    named = []
    for i in numbers:
        count: Counter = Counter()
        at: dict[str, tuple[int, _Pose]] = {}
        for index, entry in enumerate(scene.get(i, [])):
            kind = f"obj_{entry.obj_id:06d}"
            count[kind] += 1
            at[kind if count[kind] == 1 else f"{kind}_{count[kind]}"] = index, entry
        named.append(at)
    return named


def _visible_masks(folder: Path, numbers, listed, objects, shape: tuple[int, int]) -> MaskFiles | None:
    where = folder / "mask_visib"
    if not where.is_dir() or not objects:
        return None

    def file(obj: str, at: int) -> Path | None:
        found = listed[at].get(obj)
        return None if found is None else where / f"{numbers[at]:06d}_{found[0]:06d}.png"

    files = {obj: tuple(file(obj, at) for at in range(len(numbers))) for obj in objects}
    return MaskFiles(files, dict.fromkeys(objects), shape)


def _truth(folder: Path, obj: str, numbers: list[int], listed, info: dict[int, list[_Info]]) -> ObjectTruth:
    poses, labelled = np.full((len(numbers), 4, 4), np.nan), np.zeros(len(numbers), bool)
    for at in (at for at in range(len(numbers)) if obj in listed[at]):
        index, entry = listed[at][obj]
        T = se3.from_rt(np.reshape(entry.cam_R_m2c, (3, 3)), np.array(entry.cam_t_m2c) * MM)
        T = se3.check(f"{folder / 'scene_gt.json'}: image {numbers[at]}, {obj}", T, images.NOT_RIGID)
        poses[at] = se3.orthonormalised(T)
        counts = info.get(numbers[at], [])
        labelled[at] = index >= len(counts) or counts[index].px_count_visib > 0
    return ObjectTruth(poses, labelled)


def _model_places(folder: Path, obj: str) -> tuple[Path, ...]:
    root, kind = images.full(folder).parent.parent, "_".join(obj.split("_")[:2])
    return (folder / "models" / obj, *(root / models / f"{kind}.ply" for models in ("models_eval", "models")))
