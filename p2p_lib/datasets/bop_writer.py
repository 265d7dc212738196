"""Writing in the BOP format: a scene from any sequence, and its models."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.models import load_mesh, load_points
from p2p_lib.datasets.sequence import Sequence


def write_scene(folder: str | Path, sequence: Sequence) -> dict[str, int]:
    """Write a sequence as the BOP scene ``folder``, which is ``<dataset>/<split>/<scene>``; depth in millimetres.

    An object is listed in the images in which it has truth. Returns the objects' numbers: 1, 2, ... in their order.
    """
    folder = Path(folder)
    obj_ids = {name: k for k, name in enumerate(sequence.objects, 1)}
    camera = {"cam_K": sequence.camera.K.ravel().tolist(), "depth_scale": 1.0}
    scenes: dict[str, dict[int, object]] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
    (folder / "mask_visib").mkdir(parents=True, exist_ok=True)
    for i in range(len(sequence)):
        frame, masks = sequence.frame(i), sequence.masks(i) or {}
        depth_mm = np.rint(frame.depth_m.astype(float) * 1000)
        if depth_mm.max(initial=0) > 65535:
            raise BadInput(f"frame {i} depth", f"{frame.depth_m.max():.2f} m", "at most 65.53 m")
        save_png(folder / "rgb" / f"{i:06d}.png", frame.rgb)
        save_png(folder / "depth" / f"{i:06d}.png", depth_mm.astype(np.uint16))
        truth = {name: sequence.truth[name].T_cam_model[i] for name in obj_ids if name in sequence.truth}
        truth = {name: T for name, T in truth.items() if np.isfinite(T).all()}
        visible = {name: masks.get(name, np.zeros(frame.shape, bool)).astype(np.uint8) for name in truth}
        for index, mask in enumerate(visible.values()):
            save_png(folder / "mask_visib" / f"{i:06d}_{index:06d}.png", mask * np.uint8(255))
        scenes["scene_camera"][i] = camera
        scenes["scene_gt"][i] = [_pose(obj_ids[name], T) for name, T in truth.items()]
        scenes["scene_gt_info"][i] = [_info(mask) for mask in visible.values()]
    for name, scene in scenes.items():
        rows = ",\n".join(f'  "{i}": {json.dumps(entry)}' for i, entry in scene.items())
        (folder / f"{name}.json").write_text("{\n" + rows + "\n}\n")
    return obj_ids


def _pose(obj_id: int, T_cam_model: np.ndarray) -> dict[str, object]:
    R, t_mm = T_cam_model[:3, :3], T_cam_model[:3, 3] * 1000
    return {"cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": t_mm.tolist(), "obj_id": obj_id}


def _info(mask: np.ndarray) -> dict[str, object]:
    """Visible pixels, and x, y, width, height around them: -1 where there are none, as BOP writes it."""
    box = list(cv2.boundingRect(mask)) if mask.any() else [-1] * 4
    return {"bbox_visib": box, "px_count_visib": int(mask.sum())}


def write_models(folder: str | Path, models: Mapping[int, str | Path]) -> None:
    """Write ``models/`` of a BOP dataset: ``obj_000001.ply`` in millimetres and ``models_info.json``.

    models  BOP's number to a model file (see :func:`p2p_lib.datasets.models.load_points`)
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
            shape = trimesh.PointCloud(points_mm)
        else:
            vertices, faces = load_mesh(path)
            shape = trimesh.Trimesh(vertices * 1000, faces, process=False)
        (folder / f"obj_{number:06d}.ply").write_bytes(shape.export(file_type="ply"))
        # The two points farthest apart are corners of the hull.
        corners = points_mm[ConvexHull(points_mm, qhull_options="QJ").vertices]
        info[str(number)] = {"diameter": float(pdist(corners).max())}
        info[str(number)] |= {f"min_{axis}": float(x) for axis, x in zip("xyz", points_mm.min(0))}
        info[str(number)] |= {f"size_{axis}": float(x) for axis, x in zip("xyz", np.ptp(points_mm, axis=0))}
    (folder / "models_info.json").write_text(json.dumps(info, indent=1) + "\n")
