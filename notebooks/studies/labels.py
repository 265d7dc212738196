"""Notebook 11: the model over the image, the texture, and labels against what the camera saw and against the truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from pandas import DataFrame

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.suspicions import ON_SURFACE, OVERLAP
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import WIDTH_IN, panels
from p2p_lib.offline.model import NAME, Shape, Textured, rendered


def read_model(folder: Path) -> Textured:
    """A model as ``p2p export --format model`` wrote it, read back by trimesh."""
    mesh: Any = trimesh.load(folder / f"{NAME}.glb", force="mesh")  # declared as its base class
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    shape = Shape(vertices, faces, np.zeros_like(vertices), np.zeros(len(faces), bool))
    return Textured(shape, np.asarray(mesh.visual.uv)[faces], image)


def over_image(
    rgb: np.ndarray, models: dict[str, Textured], poses: dict[str, np.ndarray], camera: Camera
) -> np.ndarray:
    """An image (H, W, 3) with the models drawn over its right half, at their poses, and their outlines everywhere."""
    drawn, middle = rgb.copy(), rgb.shape[1] // 2
    nearest = sorted(poses, key=lambda name: -poses[name][2, 3])
    for name in nearest:
        image, at = rendered(models[name], poses[name], camera)
        edge = cv2.dilate(at.astype(np.uint8), np.ones((3, 3))) > at
        at[:, :middle] = False
        drawn[at] = image[at]
        drawn[edge] = 255
    return drawn


def sheet(scene: Sequence, models: dict[str, Textured], frames: Iterable[int]) -> np.ndarray:
    """A few labelled images of a BOP scene with the models over them; ``models`` by BOP's names."""
    tiles = []
    for i in frames:
        poses = {name: scene.truth[name].T_cam_model[i] for name in models}
        poses = {name: T for name, T in poses.items() if np.isfinite(T).all()}
        tile = over_image(scene.frame(i).rgb, models, poses, scene.camera)
        tiles.append(overlay.draw_caption(tile, f"image {scene.frame_names[i]}: left half as recorded, right rendered"))
    return overlay.montage(tiles, columns=2)


def label_errors_mm(scene: Sequence, source: Sequence, frames: list[int], names: dict[str, str]) -> DataFrame:
    """How far labels are off a truth that they were not made from: object, image, and mm at the object's middle.

    frames  those of ``source`` that the recording was made of; names BOP's name to the source's
    """
    rows = []
    for bop, name in names.items():
        T = scene.truth[bop].T_cam_model
        true = source.truth[name].T_cam_model[[frames[int(number)] for number in scene.frame_names]]
        both = np.flatnonzero(np.isfinite(T[:, 0, 0]) & np.isfinite(true[:, 0, 0]))
        off = se3.error_deg_mm(T[both] @ se3.median(se3.inverse(T[both]) @ true[both]), true[both])
        rows += [
            {"object": name, "image": int(scene.frame_names[k]), "off_deg": d, "off_mm": m}
            for k, d, m in zip(both, *off)
        ]
    return DataFrame(rows)


@style.styled
def evidence_plot(labels: DataFrame) -> Figure:
    """What ``labels.csv`` says of each label over the images: overlap with the mask, and depth on the surface."""
    figure, axes = panels(2, (WIDTH_IN, 3.6), [1, 1])
    for axis, column, limit in zip(axes, ("visib_iou", "depth_on_surface"), (OVERLAP, ON_SURFACE)):
        for name, rows in labels.groupby("object"):
            axis.plot(rows["image"], 100 * rows[column], marker=".", label=name)
        axis.axhline(100 * limit, color="grey", linestyle="--", linewidth=0.8)
    axes[0].set(ylabel="visible IoU [%]", ylim=(0, 102))
    axes[0].legend(loc="lower left")
    axes[0].set_title("Two witnesses for each label")
    axes[1].set(ylabel="depth on it [%]", xlabel="image", ylim=(0, 102))
    axes[1].xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure
