"""A scene in the BOP format: ``<split>/<scene>/`` of a BOP dataset.

``rgb/000001.png``, ``depth/000001.png``, ``mask_visib/000001_000000.png`` (image, index in its list of objects),
``scene_camera.json``, ``scene_gt.json`` (millimetres, OpenCV axes), ``scene_gt_info.json``; models in
``models_eval/`` or ``models/`` of the dataset. Images may be keyframes with gaps: their numbers give the times.
An object is called ``obj_000005``; a second one of the same kind in an image ``obj_000005_2``, in the file's order.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageFiles, ImageSequence, camera_for, paired_images
from p2p_lib.datasets.masks import MaskFiles
from p2p_lib.datasets.sequence import ObjectTruth

MM = 0.001
#: Frame number to what a scene file says of it; a list per object in scene_gt.json and scene_gt_info.json.
Scene = dict[int, Any]


def recognises(folder: Path) -> bool:
    """Whether a folder has ``scene_camera.json``."""
    return (folder / "scene_camera.json").is_file()


def load(folder: Path, name: str, depth_scale: float | None, masks: str | Path | None) -> ImageSequence:
    """The scene in this folder; arguments as of :func:`~p2p_lib.datasets.sequence.open_sequence`.

    The depth scale is the scene's own unless another is given.
    """
    rgb, depth = paired_images(folder)
    numbers = [_number(path) for path in rgb]
    camera, scale_mm = _camera(folder / "scene_camera.json", numbers, rgb[0])
    files = ImageFiles(folder, rgb, depth, camera, (np.array(numbers) - numbers[0]) / images.DEFAULT_HZ)
    listed = _named(folder / "scene_gt.json", numbers)
    objects = tuple(sorted({obj for at in listed for obj in at}))
    own = _visible_masks(folder, numbers, listed, objects, files.shape)
    chosen = files.masks(masks, (), objects or None)[0] if masks else own

    def read_truth() -> dict[str, ObjectTruth]:
        visible = _visibility(folder / "scene_gt_info.json", numbers, listed)
        return {obj: _truth(folder, obj, numbers, listed, visible) for obj in objects}

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


def read_scene(path: Path) -> Scene:
    """A scene file with its frame numbers as integers; :class:`BadInput` names the file where it is none."""
    try:
        return {int(number): value for number, value in json.loads(path.read_text()).items()}
    except FileNotFoundError:
        raise MissingData(str(path), "no such file, expected a BOP scene's") from None
    except (ValueError, AttributeError) as error:
        raise BadInput(str(path), f"unreadable ({error})", "a JSON object with one entry for each image") from None


def _number(path: Path) -> int:
    if not path.stem.isdigit():
        raise BadInput(str(path), f"the name {path.name!r}", "a number, as BOP names images")
    return int(path.stem)


def _camera(path: Path, numbers: list[int], image: Path) -> tuple[Camera, float]:
    """The one camera of a scene, and its depth scale in millimetres per unit."""
    scene = read_scene(path)
    try:
        found = {(tuple(scene[i]["cam_K"]), float(scene[i]["depth_scale"])) for i in numbers}
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(str(path), f"no {error} for an image", "cam_K and depth_scale for every image") from None
    if len(found) > 1:
        fix = "T-LESS, whose images are crops, cannot be tracked."
        raise BadInput(str(path), f"{len(found)} cameras", "one camera and depth scale for the whole scene", fix)
    K, scale_mm = found.pop()
    if len(K) != 9:
        raise BadInput(str(path), f"cam_K with {len(K)} numbers", "9, row by row")
    return camera_for(image, np.reshape(K, (3, 3)), str(path)), scale_mm


def _named(path: Path, numbers: list[int]) -> list[dict[str, tuple[int, Mapping]]]:
    """For each image: object to its index in the list and what the list says. Without truth: nothing."""
    scene = read_scene(path) if path.is_file() else {}
    named = []
    for i in numbers:
        count: Counter = Counter()
        at: dict[str, tuple[int, Mapping]] = {}
        for index, entry in enumerate(scene.get(i, [])):
            try:
                kind = f"obj_{int(entry['obj_id']):06d}"
            except (KeyError, TypeError, ValueError):
                raise BadInput(str(path), f"image {i}: no obj_id at {index}", "a list of objects") from None
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


def _visibility(path: Path, numbers: list[int], listed) -> Callable[[int, str], bool]:
    """Whether an object shows at all in an image, by ``px_count_visib``; True where the scene does not say."""
    info = read_scene(path) if path.is_file() else {}

    def visible(at: int, obj: str) -> bool:
        entries, index = info.get(numbers[at], []), listed[at][obj][0]
        return index >= len(entries) or entries[index].get("px_count_visib", 1) > 0

    return visible


def _truth(folder: Path, obj: str, numbers: list[int], listed, visible) -> ObjectTruth:
    poses, labelled = np.full((len(numbers), 4, 4), np.nan), np.zeros(len(numbers), bool)
    for at in (at for at in range(len(numbers)) if obj in listed[at]):
        entry, name = listed[at][obj][1], f"{folder / 'scene_gt.json'}: image {numbers[at]}, {obj}"
        try:
            R, t = np.reshape(entry["cam_R_m2c"], (3, 3)).astype(float), np.array(entry["cam_t_m2c"], float)
            poses[at] = se3.check(name, se3.from_rt(R, t * MM), images.NOT_RIGID)
        except (KeyError, ValueError, TypeError) as error:
            if isinstance(error, BadInput):
                raise
            raise BadInput(name, f"unreadable ({error})", "cam_R_m2c with 9 and cam_t_m2c with 3 numbers") from None
        labelled[at] = visible(at, obj)
    seen = np.isfinite(poses).all((1, 2))
    poses[seen] = se3.orthonormalised(poses[seen])
    return ObjectTruth(poses, labelled)


def _model_places(folder: Path, obj: str) -> tuple[Path, ...]:
    root, kind = images.full(folder).parent.parent, "_".join(obj.split("_")[:2])
    return (folder / "models" / obj, *(root / models / f"{kind}.ply" for models in ("models_eval", "models")))
