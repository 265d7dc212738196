"""Pictures for data of one's own: what went in and what came out, what good masks are, how to tell that it works."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from p2p_lib.apps.check import Finding
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame, Status
from p2p_lib.datasets.alignment import background_share, rim
from p2p_lib.datasets.models import MESHES, find_models
from p2p_lib.datasets.prompts import Prompt
from p2p_lib.datasets.sequence import Sequence as Recording
from p2p_lib.figures import overlay, style
from p2p_lib.figures.mesh_view import draw_mesh
from p2p_lib.figures.overlay import Box
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.plots import panels
from p2p_lib.figures.scenes import Scene
from p2p_lib.studies.self_check import SurfaceFit
from p2p_lib.synthetic.shapes import load_mesh

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure
    from pandas import DataFrame


def story(playback: Playback, prompts: Sequence[Prompt], rows: Sequence[int], width_px: int = 430) -> np.ndarray:
    """Clicks, poses and surfaces on one sheet: the clicked picture, the run at some rows, each object reconstructed."""
    boxes = {name: tight_box(mesh) for name, mesh in playback.meshes.items()}
    scene = Scene(playback.sequence, playback.run, boxes=boxes, truth=False)
    region_px = scene.region()
    clicked = clicked_picture(playback.sequence.frame(prompts[0].frame), prompts, playback.colours)
    clicked, _ = overlay.zoomed(clicked, playback.sequence.camera, region_px, width_px)
    sheets = [
        overlay.draw_caption(clicked, "clicks"),
        *(scene.draw(row, region_px, width_px, trail=60) for row in rows),
    ]
    shape = sheets[0].shape
    for name, mesh in playback.meshes.items():
        sheets.append(overlay.draw_caption(mesh_portrait(mesh, shape[1], shape[0]), f"{name}: surface"))
    return overlay.montage(sheets, columns=3)


def tight_box(mesh: trimesh.Trimesh) -> Box:
    """The smallest box around a surface, along its own axes."""
    import trimesh

    T_box_obj, size_m = trimesh.bounds.oriented_bounds(mesh)
    return Box(se3.orthonormalised(se3.inverse(T_box_obj)), size_m)


def edges_mm(mesh: trimesh.Trimesh, beyond: float = 0.005, rounds: int = 2) -> np.ndarray:
    """(3,) edges of the box around a surface, longest first, without its fringes.

    Twice, the outermost share ``beyond`` of the vertices is cut off at each side, along the box's axes.
    """
    import trimesh

    p_obj = np.asarray(mesh.vertices)
    for _ in range(rounds):
        T_box_obj, _ = trimesh.bounds.oriented_bounds(p_obj)
        p_box = se3.transform(se3.orthonormalised(T_box_obj), p_obj)
        low, high = np.quantile(p_box, [beyond, 1 - beyond], axis=0)
        p_obj = p_obj[((p_box >= low) & (p_box <= high)).all(1)]
    return np.sort(1e3 * trimesh.bounds.oriented_bounds(p_obj)[1])[::-1]


def true_edges_mm(sequence: Recording) -> dict[str, np.ndarray]:
    """Per object with a model, (3,) edges of the box around it, longest first."""
    import trimesh

    p_model = {name: load_mesh(file).vertices for name, file in find_models(sequence, MESHES).items()}
    return {name: np.sort(1e3 * trimesh.bounds.oriented_bounds(p)[1])[::-1] for name, p in p_model.items()}


def edges_table(edges: Mapping[str, np.ndarray], ruler: Mapping[str, np.ndarray]) -> DataFrame:
    """A row per edge: the reconstructed surface's beside the ruler's."""
    from pandas import DataFrame

    rows = [
        {"object": name, "edge": edge, "surface [mm]": round(float(found)), "ruler [mm]": round(float(true))}
        for name in edges
        for edge, found, true in zip(("longest", "middle", "shortest"), edges[name], ruler[name], strict=True)
    ]
    return DataFrame(rows)


def clicked_picture(frame: Frame, prompts: Sequence[Prompt], colours: Mapping[str, str]) -> np.ndarray:
    """A picture with the clicks in it."""
    image = frame.rgb
    for prompt in prompts:
        image = overlay.draw_points(image, prompt.points_px, colours[prompt.name], radius_px=7)
        for radius_px in (15, 16, 17):
            image = overlay.draw_points(image, prompt.points_px, colours[prompt.name], radius_px, filled=False)
    return image


def mesh_portrait(mesh: trimesh.Trimesh, width_px: int, height_px: int, turn_deg: float = 25.0) -> np.ndarray:
    """A surface from slightly above, filling the picture; ``turn_deg`` about the vertical, 0 as it was first seen."""
    box = Box.around(mesh.vertices)
    radius_m = float(np.linalg.norm(mesh.vertices - box.T_obj_box[:3, 3], axis=1).max())
    away_m = 3.2 * radius_m
    focal_px = 1.4 * min(height_px, width_px)
    camera = Camera(focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2, width_px, height_px)
    turn = se3.exp(np.array([0, np.radians(turn_deg), 0, 0, 0, 0]))
    tilt = se3.exp(np.array([np.radians(25), 0, 0, 0, 0, 0]))
    centred = se3.from_rt(np.eye(3), -box.T_obj_box[:3, 3])
    return draw_mesh(mesh, camera, se3.from_rt(np.eye(3), [0, 0, away_m]) @ tilt @ turn @ centred)


def mask_picture(frame: Frame, mask: np.ndarray, title: str, width_px: int = 430) -> np.ndarray:
    """A mask around its object: its rim on the object is blue, on the background vermillion; the share says how bad."""
    on_rim, behind = rim(mask, frame.depth_m)
    image = overlay.draw_mask(frame.rgb, mask, style.NEUTRAL[1], width_px=1, fill=0.15)
    for pixels, colour in ((on_rim & ~behind, style.OBJECTS[0]), (on_rim & behind, style.STATUS[Status.LOST][0])):
        image[cv2.dilate(pixels.astype(np.uint8), np.ones((2, 2))) > 0] = style.rgb(colour)
    v, u = np.nonzero(mask)
    margin = 30
    left, top = max(int(u.min()) - margin, 0), max(int(v.min()) - margin, 0)
    right, bottom = min(int(u.max()) + margin, mask.shape[1]), min(int(v.max()) + margin, mask.shape[0])
    camera = Camera(1, 1, 0, 0, mask.shape[1], mask.shape[0])
    image, _ = overlay.zoomed(image, camera, (left, top, right, bottom), width_px)
    share = background_share(mask, frame.depth_m)
    return overlay.draw_caption(image, f"{title}: {100 * share:.0f} % of the rim on the background")


def masks_picture(frame: Frame, masks: Mapping[str, np.ndarray], width_px: int = 420) -> np.ndarray:
    """Several masks of one object side by side, by their titles (see :func:`mask_picture`)."""
    pictures = [mask_picture(frame, mask, title, width_px) for title, mask in masks.items()]
    height_px = min(picture.shape[0] for picture in pictures)
    return overlay.montage([picture[:height_px] for picture in pictures], columns=len(pictures))


def widened(mask: np.ndarray, by_px: int) -> np.ndarray:
    """A mask (H, W) bool drawn too wide."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by_px + 1,) * 2, np.uint8)) > 0


def mesh_portraits(meshes: Mapping[str, trimesh.Trimesh], turns_deg: Sequence[float] = (-70, 0, 70, 180)) -> np.ndarray:
    """Every surface from several sides, a row each."""
    sides = [
        overlay.draw_caption(mesh_portrait(mesh, 300, 260, turn), f"{name}, {turn:+g} deg")
        for name, mesh in meshes.items()
        for turn in turns_deg
    ]
    return overlay.montage(sides, columns=len(turns_deg))


def findings_table(findings: Mapping[str, Sequence[Finding]]) -> DataFrame:
    """What ``p2p check`` says about folders: a row per finding that is not fine."""
    from pandas import DataFrame

    rows = [
        {
            "what was done to the folder": label,
            "where": f.name,
            "says": str(f.level),
            "found": f.text.replace("`", ""),
            "what to do": f.fix.replace("`", ""),
        }
        for label, found in findings.items()
        for f in found
        if f.level != "ok"
    ]
    return DataFrame(rows)


def fit_plot(playback: Playback, fits: Mapping[str, Mapping[str, SurfaceFit]], confidence: bool = True) -> Figure:
    """The share of each surface that measured depth lies on, over time, per way; the confidence below.

    fits  label of the way to objects and their fit; the first is drawn full, the others dashed
    """
    with style.applied():
        figure, axes = panels(1 + confidence, (8.0, 2.6 + 1.6 * confidence), [2, 1][: 1 + confidence])
        for k, (label, objects) in enumerate(fits.items()):
            for name, fit in objects.items():
                times_s, line = playback.times_s[fit.row], "-" if k == 0 else (0, (3 + k, 2))
                axes[0].plot(
                    *(times_s, 100 * fit.on),
                    linestyle=line,
                    marker=".",
                    color=playback.colours[name],
                    label=f"{name}, {label}",
                )
        axes[0].set(ylabel="depth on the surface [%]", ylim=(0, 102))
        axes[0].legend(loc="lower left", ncols=len(fits))
        axes[0].set_title(f"Does the surface lie where depth was measured? {playback.run.info['sequence']}")
        for name, obj in playback.run.objects.items() if confidence else ():
            known = np.where(obj.has_pose, obj.confidence, np.nan)
            axes[1].plot(playback.times_s, known, color=playback.colours[name], label=name)
        if confidence:
            axes[1].set(ylabel="confidence", ylim=(0, 1.05))
        axes[-1].set_xlabel("time [s]")
    return figure
