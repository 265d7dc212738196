"""Scenes in the BOP format, ``<split>/<scene>/`` of a BOP dataset: read, and written from any sequence.

``rgb/000001.png``, ``depth/000001.png``, ``mask_visib/000001_000000.png`` (image, index in its list of objects),
``scene_camera.json``, ``scene_gt.json`` (millimetres, OpenCV axes), ``scene_gt_info.json``; models in
``models_eval/`` or ``models/`` of the dataset. Images may be keyframes with gaps: their numbers give the times.
An object is called ``obj_000005``; a second one of the same kind in an image ``obj_000005_2``, in the file's order.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import BaseModel, Field

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.paths import full
from p2p_lib.datasets import images
from p2p_lib.datasets.image_sequence import ImageSequence, camera_for, paired_images
from p2p_lib.datasets.masks import MaskFiles
from p2p_lib.datasets.models import load_mesh, load_points, read_mesh
from p2p_lib.datasets.schema import read_json
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.datasets.truth import ObjectTruth

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


def load(folder: Path, masks: str | Path | None) -> ImageSequence:
    """The scene in this folder; ``masks`` as of :func:`~p2p_lib.datasets.sequence.open_sequence`."""
    rgb, depth = paired_images(folder)
    numbers = [_number(path) for path in rgb]
    camera, scale_mm = _camera(folder / "scene_camera.json", numbers, rgb)
    files = ImageSequence(folder, rgb, depth, camera, (np.array(numbers) - numbers[0]) / images.DEFAULT_HZ)
    listed = _named(_lists(folder / "scene_gt.json", dict[int, list[_Pose]]), numbers)
    objects = tuple(sorted({obj for at in listed for obj in at}))
    own = _visible_masks(folder, numbers, listed, objects, files.shape)
    files = replace(files, own_masks=own).with_masks(masks, objects=objects)

    def read_truth() -> dict[str, ObjectTruth]:
        info = _lists(folder / "scene_gt_info.json", dict[int, list[_Info]])
        return {obj: _truth(folder, obj, numbers, listed, info) for obj in objects}

    model_places = {obj: _model_places(folder, obj) for obj in objects}
    return replace(files, depth_scale=scale_mm * MM, read_truth=read_truth, model_places=model_places)


def _number(path: Path) -> int:
    if not path.stem.isdigit():
        raise BadInput(str(path), f"the name {path.name!r}", "a number, as BOP names images")
    return int(path.stem)


def _camera(path: Path, numbers: list[int], rgb: tuple[Path, ...]) -> tuple[Camera, float]:
    """The one camera of a scene, and its depth scale in millimetres per unit."""
    scene = read_json(path, dict[int, _Camera], "cam_K and depth_scale for every image")
    if gone := set(numbers) - scene.keys():
        raise BadInput(str(path), f"no image {min(gone)}", "cam_K and depth_scale for every image")
    found = {(tuple(scene[i].cam_K), scene[i].depth_scale) for i in numbers}
    if len(found) > 1:
        fix = "T-LESS, whose images are crops, cannot be tracked."
        raise BadInput(str(path), f"{len(found)} cameras", "one camera and depth scale for the whole scene", fix)
    K, scale_mm = found.pop()
    return camera_for(rgb, np.reshape(K, (3, 3)), str(path)), scale_mm


def _lists(path: Path, of: Any) -> dict[int, list]:
    """Image number to its list of entries, as the type ``of`` has them; nothing where there is no such file."""
    return read_json(path, of, "a list of objects for each image") if path.is_file() else {}


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

    files: dict[str, Mapping[int, Path | None]]
    files = {obj: {at: file(obj, at) for at in range(len(numbers))} for obj in objects}
    return MaskFiles(files, dict.fromkeys(objects), shape)


def _truth(folder: Path, obj: str, numbers: list[int], listed, info: dict[int, list[_Info]]) -> ObjectTruth:
    poses, labelled = np.full((len(numbers), 4, 4), np.nan), np.zeros(len(numbers), bool)
    for at in (at for at in range(len(numbers)) if obj in listed[at]):
        index, entry = listed[at][obj]
        T = se3.from_rt(np.reshape(entry.cam_R_m2c, (3, 3)), np.array(entry.cam_t_m2c) * MM)
        poses[at] = se3.check(f"{folder / 'scene_gt.json'}: image {numbers[at]}, {obj}", T, images.NOT_RIGID)
        counts = info.get(numbers[at], [])
        labelled[at] = index >= len(counts) or counts[index].px_count_visib > 0
    return ObjectTruth(poses, labelled)


def _model_places(folder: Path, obj: str) -> tuple[Path, ...]:
    root, kind = full(folder).parent.parent, "_".join(obj.split("_")[:2])
    return (folder / "models" / obj, *(root / models / f"{kind}.ply" for models in ("models_eval", "models")))


@dataclass(frozen=True, eq=False)
class Outline:
    """An object in an image, whether something hides it or not, as BOP counts it.

    mask (H, W) bool; px its pixels and box its x, y, width, height, both with what lies beyond the image's borders;
    valid_px  pixels of it at which depth was measured
    """

    mask: np.ndarray
    px: int
    box: tuple[int, int, int, int]
    valid_px: int


def write_scene(
    folder: str | Path,
    sequence: Sequence,
    frames: Iterable[int] | None = None,
    outlines: Callable[[int], Mapping[str, Outline]] | None = None,
) -> dict[str, int]:
    """Write a sequence as the BOP scene ``folder``, which is ``<dataset>/<split>/<scene>``; depth in millimetres.

    frames    those to write, by default all; outlines tells of a frame the objects as if nothing hid them, for
              ``mask/`` and their visible shares

    An object is listed in the images in which it has truth. Returns the objects' numbers: 1, 2, ... in their order.
    """
    folder = Path(folder)
    obj_ids = {name: k for k, name in enumerate(sequence.objects, 1)}
    camera = {"cam_K": sequence.camera.K.ravel().tolist(), "depth_scale": 1.0}
    scenes: dict[str, dict[int, object]] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
    (folder / "mask_visib").mkdir(parents=True, exist_ok=True)
    for i in range(len(sequence)) if frames is None else frames:
        frame, masks = sequence.frame(i), sequence.masks(i) or {}
        whole = outlines(i) if outlines else {}
        depth_mm = np.rint(frame.depth_m.astype(float) * 1000)
        if depth_mm.max(initial=0) > 65535:
            raise BadInput(f"frame {i} depth", f"{frame.depth_m.max():.2f} m", "at most 65.53 m")
        images.save_png(folder / "rgb" / f"{i:06d}.png", frame.rgb)
        images.save_png(folder / "depth" / f"{i:06d}.png", depth_mm.astype(np.uint16))
        truth = {name: sequence.truth[name].T_cam_model[i] for name in obj_ids if name in sequence.truth}
        truth = {name: T for name, T in truth.items() if np.isfinite(T).all()}
        visible = [masks.get(name, np.zeros(frame.shape, bool)) for name in truth]
        for index, mask in enumerate(visible):
            images.save_png(folder / "mask_visib" / f"{i:06d}_{index:06d}.png", mask)
        for index, outline in enumerate(whole[name] for name in truth if name in whole):
            images.save_png(folder / "mask" / f"{i:06d}_{index:06d}.png", outline.mask)
        scenes["scene_camera"][i] = camera
        scenes["scene_gt"][i] = [
            {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (T[:3, 3] / MM).tolist(), "obj_id": obj_ids[name]}
            for name, T in truth.items()
        ]
        scenes["scene_gt_info"][i] = [_visibility(mask, whole.get(name)) for name, mask in zip(truth, visible)]
    for name, scene in scenes.items():
        rows = ",\n".join(f'  "{i}": {json.dumps(entry)}' for i, entry in scene.items())
        (folder / f"{name}.json").write_text("{\n" + rows + "\n}\n")
    return obj_ids


def _visibility(mask: np.ndarray, whole: Outline | None) -> dict[str, object]:
    """Visible pixels, and x, y, width, height around them: -1 where there are none, as BOP writes it."""
    box = cv2.boundingRect(mask.astype(np.uint8)) if mask.any() else [-1] * 4
    visible: dict[str, object] = {"bbox_visib": box, "px_count_visib": int(mask.sum())}
    if whole is None:
        return visible
    counts = {"px_count_all": whole.px, "px_count_valid": whole.valid_px, "visib_fract": mask.sum() / max(whole.px, 1)}
    return {"bbox_obj": whole.box} | visible | counts


def write_models(folder: str | Path, models: Mapping[int, str | Path]) -> None:
    """Write ``models/`` of a BOP dataset: ``obj_000001.ply`` in millimetres, and ``models_info.json``.

    The vertices of a mesh keep their colours.

    models  BOP's number to a model file (see :func:`~p2p_lib.datasets.models.load_points`)
    """
    import trimesh
    from scipy.spatial import ConvexHull
    from scipy.spatial.distance import pdist

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    info = {}
    for number, path in sorted(models.items()):
        points_mm = load_points(path) * 1000
        if Path(path).suffix.lower() == ".xyz":
            shape: trimesh.PointCloud | trimesh.Trimesh = trimesh.PointCloud(points_mm)
        else:
            vertices, faces = load_mesh(path)
            look: Any = read_mesh(Path(path)).visual
            colours = look.vertex_colors if look.kind == "vertex" else None
            shape = trimesh.Trimesh(vertices * 1000, faces, vertex_colors=colours, process=False)
        ply: Any = shape.export(file_type="ply")  # bytes, of this kind of file
        (folder / f"obj_{number:06d}.ply").write_bytes(ply)
        # The two points farthest apart are corners of the hull.
        corners = points_mm[ConvexHull(points_mm, qhull_options="QJ").vertices]
        info[str(number)] = {"diameter": float(pdist(corners).max())}
        info[str(number)] |= {f"min_{axis}": float(x) for axis, x in zip("xyz", points_mm.min(0))}
        info[str(number)] |= {f"size_{axis}": float(x) for axis, x in zip("xyz", np.ptp(points_mm, axis=0))}
    (folder / "models_info.json").write_text(json.dumps(info, indent=1) + "\n")
