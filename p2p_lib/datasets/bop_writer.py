"""Writing in the BOP format: a scene from any sequence, and its models."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.models import load_mesh, load_points
from p2p_lib.datasets.sequence import Sequence

#: Object to (H, W) bool of its whole outline at frame i, hidden parts included.
Outlines = Callable[[int], Mapping[str, np.ndarray]]


def write_scene(
    folder: str | Path,
    sequence: Sequence,
    obj_ids: Mapping[str, int] | None = None,
    outlines: Outlines | None = None,
    depth_scale_mm: float = 1.0,
) -> dict[str, int]:
    """Write a sequence as the BOP scene ``folder``, which is ``<dataset>/<split>/<scene>``.

    obj_ids         object to BOP's number; by default 1, 2, ... in the sequence's order
    outlines        whole outlines, for ``mask/`` and the counts over them; without it those are left out
    depth_scale_mm  millimetres per unit of the depth written

    An object is listed in the images in which it has truth. Returns the numbers used.
    """
    folder = Path(folder)
    obj_ids = dict(obj_ids or {name: k for k, name in enumerate(sequence.objects, 1)})
    (folder / "mask_visib").mkdir(parents=True, exist_ok=True)
    camera = {"cam_K": sequence.camera.K.ravel().tolist(), "depth_scale": depth_scale_mm}
    truth = {name: sequence.truth[name].T_cam_model for name in obj_ids if name in sequence.truth}
    gt, info = {}, {}
    for i in range(len(sequence)):
        frame, masks = sequence.frame(i), sequence.masks(i) or {}
        listed = [name for name in truth if np.isfinite(truth[name][i]).all()]
        _write_images(folder, i, frame, depth_scale_mm)
        gt[str(i)] = [_pose(obj_ids[name], truth[name][i]) for name in listed]
        whole = outlines(i) if outlines else {}
        info[str(i)] = []
        for index, name in enumerate(listed):
            file = f"{i:06d}_{index:06d}.png"
            visible = masks.get(name, np.zeros(frame.shape, bool))
            save_png(folder / "mask_visib" / file, visible.astype(np.uint8) * 255)
            if outlines:
                save_png(folder / "mask" / file, whole[name].astype(np.uint8) * 255)
            info[str(i)].append(_info(visible, whole.get(name), frame.depth_m > 0))
    cameras = {str(i): camera for i in range(len(sequence))}
    for name, scene in (("scene_camera", cameras), ("scene_gt", gt), ("scene_gt_info", info)):
        rows = ",\n".join(f'  "{i}": {json.dumps(entry)}' for i, entry in scene.items())
        (folder / f"{name}.json").write_text("{\n" + rows + "\n}\n")
    return obj_ids


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
        low, size = points_mm.min(0), np.ptp(points_mm, axis=0)
        # The two points farthest apart are corners of the hull.
        diameter = pdist(points_mm[ConvexHull(points_mm, qhull_options="QJ").vertices]).max()
        box = {f"min_{a}": x for a, x in zip("xyz", low)} | {f"size_{a}": x for a, x in zip("xyz", size)}
        info[str(number)] = {"diameter": float(diameter)} | {key: float(x) for key, x in box.items()}
    (folder / "models_info.json").write_text(json.dumps(info, indent=1) + "\n")


def _write_images(folder: Path, i: int, frame: Frame, depth_scale_mm: float) -> None:
    raw = np.rint(frame.depth_m.astype(float) * 1000 / depth_scale_mm)
    if raw.max(initial=0) > 65535:
        got = f"{frame.depth_m.max():.2f} m"
        raise BadInput(
            f"frame {i} depth", got, f"at most {65.535 * depth_scale_mm:.2f} m", "Take a larger depth_scale_mm."
        )
    save_png(folder / "rgb" / f"{i:06d}.png", frame.rgb)
    save_png(folder / "depth" / f"{i:06d}.png", raw.astype(np.uint16))


def _pose(obj_id: int, T_cam_model: np.ndarray) -> dict:
    R, t_mm = T_cam_model[:3, :3], T_cam_model[:3, 3] * 1000
    return {"cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": t_mm.tolist(), "obj_id": obj_id}


def _info(visible: np.ndarray, whole: np.ndarray | None, measured: np.ndarray) -> dict:
    info: dict = {"bbox_visib": _box(visible), "px_count_visib": int(visible.sum())}
    if whole is not None:
        count = int(whole.sum())
        info |= {"bbox_obj": _box(whole), "px_count_all": count, "px_count_valid": int((whole & measured).sum())}
        info["visib_fract"] = info["px_count_visib"] / count if count else 0.0
    return info


def _box(mask: np.ndarray) -> list[int]:
    """x, y, width, height around a mask; -1 where it is empty, as BOP writes it."""
    v, u = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return [int(u[0]), int(v[0]), int(u[-1] - u[0] + 1), int(v[-1] - v[0] + 1)] if len(v) else [-1, -1, -1, -1]
