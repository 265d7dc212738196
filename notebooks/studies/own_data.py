"""Notebook 10: what went in and what came out, what good masks are, how to tell without any truth that it works."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from IPython.display import Markdown
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from pandas import DataFrame, Series, read_csv, to_numeric

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.mesh import oriented_box
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.raycasting import ray_scene
from p2p_lib.core.types import Frame, Status
from p2p_lib.datasets.alignment import background_share, rim
from p2p_lib.datasets.models import MESHES, find_models
from p2p_lib.datasets.prompts import prompts_in
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import Sequence as Recording
from p2p_lib.evaluation.evidence import drawn_m, on_surface
from p2p_lib.figures import overlay, style
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.plots import WIDTH_IN, panels
from p2p_lib.figures.provenance import Saved, save_figure
from p2p_lib.figures.scenes import Scene
from p2p_lib.synthetic.shapes import load_mesh
from studies import SHIPPED
from studies.mesh_view import portrait

#: What a fault should at most do: a share of the frames for lies, else what the column of the table is in.
FAULT_GOALS = {"lies in it": 0.005, "lies after": 0.005, "longest": 5.0, "worst": 15.0, "mesh off (%)": 5.0}


@style.styled
def fault_picture(table: DataFrame) -> Figure:
    """A row per fault of ``faults.csv`` (:func:`~p2p_lib.figures.run_tables.by_fault`): its numbers against goals.

    The colour is the number by its goal: from 0 to twice as much or more, or never good again. What misses it is
    bold, what has no number grey.
    """
    numbers = table.replace("never", np.inf).apply(to_numeric, errors="coerce")
    goals = DataFrame(FAULT_GOALS, index=table.index)
    goals[["lies in it", "lies after"]] = goals[["lies in it", "lies after"]].mul(numbers["frames"], axis=0)
    of_goal = numbers[list(goals)] / goals
    figure, (axis,) = panels(1, (WIDTH_IN, 1.4 + 0.2 * len(table)))
    shades = colormaps["Oranges"].with_extremes(bad=style.STATUS[Status.TRACKED][0])
    image = axis.imshow(np.ma.masked_invalid(of_goal.clip(upper=2)), shades, vmin=0, vmax=2, aspect="auto")
    for (row, column), ratio in np.ndenumerate(of_goal.to_numpy()):
        shown = str(table[of_goal.columns[column]].iloc[row])
        shade = to_hex(image.to_rgba(min(float(ratio), 2.0)))
        dark = {"color": style.ink(shade), "weight": "bold" if ratio > 1 else "normal"}
        axis.text(column, row, shown, ha="center", va="center", fontsize=7.5, **dark)
    rows = [
        f"{fault} (failed: {n})" if n not in ("0", 0) else fault for fault, n in zip(table["Fault"], table["failed"])
    ]
    axis.set_yticks(range(len(table)), rows, fontsize=7.5)
    heads = "lies in it\n[frames]|lies after\n[frames]|longest lie\n[frames]|good again,\nworst [frames]|mesh off\n[%]"
    axis.set_xticks(range(len(FAULT_GOALS)), heads.split("|"))
    axis.tick_params(top=True, labeltop=True, bottom=False, labelbottom=False, length=0)
    axis.grid(False)
    bar = figure.colorbar(image, orientation="horizontal", shrink=0.5, aspect=40, pad=0.01)
    bar.set_ticks([0, 1, 2], labels=["0", "the goal", "twice as much, or never"])
    bar.ax.axvline(1, color="#333333", lw=1.5)
    return figure


def shown_faults(parameters: Mapping[str, object], folder: Path = SHIPPED) -> Saved | Markdown:
    """The picture of ``faults.csv`` in a folder for a notebook; without one, the command that makes it."""
    file = folder / "faults.csv"
    if not file.is_file():
        return Markdown("*No table here. `p2p benchmark faults --out out/benchmark --tables figures/tables` makes it.*")
    caption = """Faults of camera, depth, masks and time, each alone for 30 frames or from a frame on. Lies: poses that
are sure (confidence above 0.5) and more than 5 cm off, while the fault lasts and after it, in all frames, and the
longest stretch. Good again: frames in view after it until the pose is within 2 cm, worst object. Mesh off: vertices
more than 1 cm off the true surface at the end. The line in the bar is the goal: lies in 0.5 % of the frames and for 5
in a row, good again after 15 frames, 5 % of the mesh. What misses it is bold."""
    return save_figure(fault_picture(read_csv(file)), "own_faults", caption, sources=[file], parameters=parameters)


def spread_clicks(masks: Mapping[str, np.ndarray], frame: int = 0) -> tuple[Prompt, ...]:
    """Three clicks in each mask (H, W) that is not empty: where it is deepest, and towards both its ends."""
    prompts = []
    for middle in prompts_in(masks, frame):
        depth = cv2.distanceTransform(masks[middle.name].astype(np.uint8), cv2.DIST_L2, 5)
        inside = np.argwhere(depth > 0.5 * depth.max())[:, ::-1].astype(float)
        along = (inside - inside.mean(0)) @ np.linalg.svd(inside - inside.mean(0), full_matrices=False)[2][0]
        ends = inside[[along.argmin(), along.argmax()]]
        prompts.append(Prompt(middle.name, frame, np.concatenate([middle.points_px, ends])))
    return tuple(prompts)


def errors_against(source: Recording, frames: Iterable[int], run: Run) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Object to its rotation (n,) in degrees and translation (n,) in mm off a truth that the run did not know.

    frames  those of ``source`` that the run's were. The object frame is aligned at the first row with a pose; NaN where
    there is no pose.
    """
    errors, frames = {}, np.array(list(frames))
    for name, obj in run.objects.items():
        T_cam_model = source.truth[name].T_cam_model[frames[obj.frame_index]]
        first = int(np.argmax(obj.has_pose))
        T_obj_model = se3.inverse(obj.T_cam_obj[first]) @ T_cam_model[first]
        errors[name] = se3.error_deg_mm(obj.T_cam_obj @ T_obj_model, T_cam_model)
    return errors


def edges_mm(mesh: trimesh.Trimesh) -> np.ndarray:
    """(3,) edges of the box around a surface, longest first, without its fringes.

    Twice, the outermost 0.5 % of the vertices are cut off at each side, along the box's axes.
    """
    p_obj = np.asarray(mesh.vertices)
    for _ in range(2):
        T_box_obj, _ = oriented_box(p_obj)
        p_box = se3.transform(se3.orthonormalised(T_box_obj), p_obj)
        low, high = np.quantile(p_box, [0.005, 0.995], axis=0)
        p_obj = p_obj[((p_box >= low) & (p_box <= high)).all(1)]
    return np.sort(1e3 * oriented_box(p_obj)[1])[::-1]


def true_edges_mm(sequence: Recording) -> dict[str, np.ndarray]:
    """Per object with a model, (3,) edges of the box around it, longest first."""
    meshes = {name: load_mesh(file) for name, file in find_models(sequence, MESHES).items()}
    return {k: np.sort(1e3 * oriented_box(m.vertices)[1])[::-1] for k, m in meshes.items()}


def edges_table(edges: Mapping[str, np.ndarray], ruler: Mapping[str, np.ndarray]) -> DataFrame:
    """A row per edge: the reconstructed surface's beside the ruler's."""
    return DataFrame(
        {"object": name, "edge": edge, "surface [mm]": round(float(found)), "ruler [mm]": round(float(true))}
        for name in edges
        for edge, found, true in zip(("longest", "middle", "shortest"), edges[name], ruler[name], strict=True)
    )


def findings_table(findings: Mapping[str, Sequence[Any]]) -> DataFrame:
    """What ``p2p check`` says about folders: a row per finding (:mod:`p2p_lib.apps.check`) that is not fine."""
    return DataFrame(
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
    )


def story(playback: Playback, prompts: Sequence[Prompt], rows: Sequence[int], width_px: int = 430) -> np.ndarray:
    """Clicks, poses and surfaces on one sheet: the clicked image, the run at some rows, each object reconstructed."""
    assert playback.sequence is not None
    boxes = {name: overlay.tight_box(mesh) for name, mesh in playback.meshes.items()}
    scene = Scene(playback.sequence, playback.run, boxes=boxes, truth=False)
    region_px = scene.region()
    clicked = overlay.draw_clicks(playback.sequence.frame(prompts[0].frame).rgb, prompts, playback.colours)
    clicked, camera = overlay.zoomed(clicked, playback.sequence.camera, region_px, width_px)
    images = [overlay.draw_caption(clicked, "clicks")]
    images += [scene.draw(row, region_px, width_px, trail=60) for row in rows]
    for name, mesh in playback.meshes.items():
        images.append(overlay.draw_caption(portrait(mesh, camera.width, camera.height), f"{name}: surface"))
    return overlay.montage(images, columns=3)


def mask_image(frame: Frame, mask: np.ndarray, title: str, width_px: int = 430) -> np.ndarray:
    """A mask around its object: its rim on the object is blue, on the background vermillion."""
    on_rim, behind = rim(mask, frame.depth_m)
    image = overlay.draw_mask(frame.rgb, mask, style.NEUTRAL[1], width_px=1, fill=0.15)
    for pixels, colour in ((on_rim & ~behind, style.OBJECTS[0]), (on_rim & behind, style.STATUS[Status.LOST][0])):
        image[cv2.dilate(pixels.astype(np.uint8), np.ones((2, 2))) > 0] = style.rgb(colour)
    camera = Camera(mask.shape[1], mask.shape[1], 0, 0, mask.shape[1], mask.shape[0])
    image, _ = overlay.zoomed(image, camera, overlay.region_around(mask, camera, (30, 30)), width_px)
    share = background_share(mask, frame.depth_m)
    return overlay.draw_caption(image, f"{title}: {100 * share:.0f} % of the rim on the background")


def masks_image(frame: Frame, masks: Mapping[str, np.ndarray], width_px: int = 420) -> np.ndarray:
    """Several masks of one object side by side, by their titles (see :func:`mask_image`)."""
    images = [mask_image(frame, mask, title, width_px) for title, mask in masks.items()]
    height_px = min(image.shape[0] for image in images)
    return overlay.montage([image[:height_px] for image in images], columns=len(images))


def surface_fit(
    sequence: Recording,
    run: Run,
    meshes: Mapping[str, Any],
    rows: Iterable[int],
    T_obj_wrong: np.ndarray = se3.IDENTITY,
) -> dict[str, Series]:
    """Per object, at these rows with a pose: the fraction of its unhidden surface on which depth was measured.

    meshes       object to its reconstructed surface: anything with ``vertices`` (V, 3) in its frame and ``faces``
    T_obj_wrong  (4, 4) by which all poses are put off on purpose, to see what a wrong pose would look like
    """
    found: dict[str, dict[int, float]] = {name: {} for name in meshes}
    scenes = {name: ray_scene(mesh.vertices, mesh.faces) for name, mesh in meshes.items()}
    for row in rows:
        frame = sequence.frame(int(next(iter(run.objects.values())).frame_index[row]))
        for name, scene in scenes.items():
            obj = run.objects[name]
            if obj.has_pose[row]:
                surface_m = drawn_m(scene, sequence.camera, obj.T_cam_obj[row] @ T_obj_wrong)
                found[name][row] = on_surface(surface_m, frame.depth_m)
    return {name: Series(fits, dtype=float) for name, fits in found.items()}


@style.styled
def fit_plot(playback: Playback, fits: Mapping[str, Mapping[str, Series]]) -> Figure:
    """The fraction of each surface on which depth was measured, over time; the confidence below.

    fits  label to the objects' fits (:func:`surface_fit`); the first is drawn full, the others dashed
    """
    figure, axes = panels(2, (WIDTH_IN, 4.2), [2, 1])
    for k, (label, objects) in enumerate(fits.items()):
        line = {"linestyle": (0, (3 + k, 2)) if k else "-", "marker": "."}
        for name, fit in objects.items():
            without = np.flatnonzero(~playback.run.objects[name].has_pose)
            fit = fit.reindex(fit.index.union(without))  # a gap, and no line across it
            times_s, colour = playback.times_s[fit.index], playback.colours[name]
            axes[0].plot(times_s, 100 * fit, color=colour, label=f"{name}, {label}", **line)
    for name, obj in playback.run.objects.items():
        axes[1].plot(playback.times_s, np.where(obj.has_pose, obj.confidence, np.nan), color=playback.colours[name])
    axes[0].set(ylabel="depth on the surface [%]", ylim=(0, 102))
    axes[0].legend(loc="lower left", ncols=len(fits))
    axes[0].set_title(f"Does the surface lie where depth was measured? {playback.run.info['sequence']}")
    axes[1].set(ylabel="confidence", ylim=(0, 1.05), xlabel="time [s]")
    return figure
