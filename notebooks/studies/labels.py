"""Notebook 11: the model over the image, the texture, and labels against what the camera saw and against the truth."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from shutil import rmtree
from typing import Any

import cv2
import numpy as np
import trimesh
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from pandas import DataFrame, read_csv
from scipy.spatial import cKDTree

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.image import mask_iou
from p2p_lib.datasets.models import MESHES, find_models
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation.suspicions import ON_SURFACE, OVERLAP
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import WIDTH_IN, panels
from p2p_lib.offline.model import NAME, Shape, Textured, rendered
from p2p_lib.synthetic.shapes import load_mesh

#: A true surface shows where depth was measured so near it; a model lacks what is farther from it than that, m.
SEEN_M, LACKS_M = 0.005, 0.01


def fresh(folder: Path) -> Path:
    """The folder without what an earlier call of the same cell left there: exports and runs want a new one."""
    rmtree(folder, ignore_errors=True)
    return folder


def read_model(folder: Path) -> Textured:
    """A model as ``p2p export --format model`` wrote it, read back by trimesh."""
    mesh: Any = trimesh.load(folder / f"{NAME}.glb", force="mesh")  # declared as its base class
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    shape = Shape(vertices, faces, np.zeros_like(vertices), np.zeros(len(faces), bool))
    return Textured(shape, np.asarray(mesh.visual.uv)[faces], image)


def read_back(dataset: Path, models: Path) -> tuple[Sequence, dict[str, str], dict[str, Textured]]:
    """A labelled dataset as ``p2p export`` wrote it: its scene, BOP's names to the run's, and the models by BOP's."""
    told = json.loads((dataset / "labels.json").read_text())
    names = {f"obj_{number:06d}": name for name, number in told["objects"].items()}
    return (
        open_sequence(dataset / "train/000001"),
        names,
        {bop: read_model(models / name) for bop, name in names.items()},
    )


def over_image(
    rgb: np.ndarray, models: dict[str, Textured], poses: dict[str, np.ndarray], camera: Camera
) -> np.ndarray:
    """An image (H, W, 3) with each model over the right half of its object, at its pose, and its whole outline."""
    drawn = rgb.copy()
    for name in sorted(poses, key=lambda name: -poses[name][2, 3]):  # the nearest last
        image, at = rendered(models[name], poses[name], camera)
        edge = cv2.dilate(at.astype(np.uint8), np.ones((3, 3))) > at
        left, _, width, _ = cv2.boundingRect(at.astype(np.uint8))
        at[:, : left + width // 2] = False
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
        tiles.append(overlay.draw_caption(tile, f"image {scene.frame_names[i]}: right half of each object rendered"))
    return overlay.montage(tiles, columns=2)


def label_errors(scene: Sequence, source: Sequence, frames: list[int], names: dict[str, str]) -> DataFrame:
    """How far labels are off a truth that they were not made from: object, image, degrees, mm at the object's middle.

    ``mask_iou`` is that of the label's visible mask with the true one.

    frames  those of ``source`` that the recording was made of; names BOP's name to the source's
    """
    numbers = [int(number) for number in scene.frame_names]
    masks = [(scene.masks(k) or {}, source.masks(frames[number]) or {}) for k, number in enumerate(numbers)]
    rows = []
    for bop, name in names.items():
        labelled, T, true, T_obj_model = _aligned(scene, source, frames, bop, name)
        off = se3.error_deg_mm(T @ T_obj_model, true)
        rows += [
            {"object": name, "image": numbers[k], "off_deg": d, "off_mm": m}
            | {"mask_iou": mask_iou(masks[k][0][bop], masks[k][1][name])}
            for k, d, m in zip(labelled, *off)
        ]
    return DataFrame(rows)


def _aligned(scene: Sequence, source: Sequence, frames: list[int], bop: str, name: str) -> tuple[np.ndarray, ...]:
    """Which images have a label and a truth, both poses there, and the truth's model frame in the label's object."""
    T = scene.truth[bop].T_cam_model
    true = source.truth[name].T_cam_model[[frames[int(number)] for number in scene.frame_names]]
    both = np.flatnonzero(np.isfinite(T[:, 0, 0]) & np.isfinite(true[:, 0, 0]))
    return both, T[both], true[both], se3.median(se3.inverse(T[both]) @ true[both])


def lacking(
    scene: Sequence, source: Sequence, frames: list[int], names: dict[str, str], models: dict[str, Textured]
) -> dict[str, float]:
    """The share of what the images show of each true surface from which its model is farther than :data:`LACKS_M`."""
    shares, meshes = {}, find_models(source, MESHES)
    for bop, name in names.items():
        labelled, _, true, T_obj_model = _aligned(scene, source, frames, bop, name)
        points = load_mesh(meshes[name]).sample(20_000, np.random.default_rng(0))[0]
        shown = np.zeros(len(points), bool)
        for k, T_cam_model in zip(labelled, true):
            at = frames[int(scene.frame_names[k])]
            p_cam = se3.transform(T_cam_model, points)
            uv = source.camera.project(p_cam)
            inside = np.flatnonzero(source.camera.inside(uv))
            u, v = np.rint(uv[inside]).astype(int).T
            at_depth = np.abs(source.frame(at).depth_m[v, u] - p_cam[inside, 2]) < SEEN_M
            shown[inside] |= at_depth & (source.masks(at) or {})[name][v, u]
        surface = trimesh.sample.sample_surface(models[bop].shape.mesh, 30_000, seed=0)[0]
        off_m = cKDTree(surface).query(se3.transform(T_obj_model, points[shown]))[0]
        shares[name] = float((off_m > LACKS_M).mean())
    return shares


def against_truth(dataset: Path, models: Path, source: Sequence, frames: list[int]) -> DataFrame:
    """A row per object: what its labels and its model are worth by a truth, beside what the labels' witnesses say."""
    scene, names, textured = read_back(dataset, models)
    off, told = label_errors(scene, source, frames, names), read_csv(dataset / "labels.csv")
    lacks = lacking(scene, source, frames, names, textured)
    rows = []
    for name in names.values():
        one, its = off[off["object"] == name], told[told["object"] == name]
        iou = 100 * one["mask_iou"]
        row = {"object": name, "labels": len(one)}
        row |= {"off [°]": one["off_deg"].median(), "off [mm]": one["off_mm"].median()}
        row |= {
            "true IoU [%]": iou.median(),
            "5th percentile": iou.quantile(0.05),
            "model lacks [%]": 100 * lacks[name],
        }
        row |= {"lowest visib_iou [%]": 100 * its["visib_iou"].min(), "doubtful": int(its["doubtful"].sum())}
        rows.append(row)
    return DataFrame(rows)


@style.styled
def evidence_plot(labels: DataFrame) -> Figure:
    """What ``labels.csv`` says of each label over the images: overlap with the mask, and depth on the surface."""
    figure, axes = panels(2, (WIDTH_IN, 3.6), [1, 1])
    colours = style.object_colours(labels["object"].unique())
    for axis, column, limit in zip(axes, ("visib_iou", "depth_on_surface"), (OVERLAP, ON_SURFACE)):
        for name, rows in labels.groupby("object", sort=False):
            axis.plot(rows["image"], 100 * rows[column], marker=".", color=colours[name], label=name)
        axis.axhline(100 * limit, color="grey", linestyle="--", linewidth=0.8)
    axes[0].set(ylabel="visible IoU [%]", ylim=(0, 102))
    axes[0].legend(loc="lower left")
    axes[0].set_title("Two witnesses for each label")
    axes[1].set(ylabel="depth on it [%]", xlabel="image", ylim=(0, 102))
    axes[1].xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure
