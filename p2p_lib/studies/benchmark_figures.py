"""Figures that belong to a benchmark's tables: histograms of its errors, and its reconstructions beside the truth."""

from __future__ import annotations

from collections.abc import Sequence as Rows
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import MissingData
from p2p_lib.datasets.keypoint_log import ObjectKeypoints, load_keypoints
from p2p_lib.datasets.models import MESHES, find_models
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.protocol import Evaluation, evaluate
from p2p_lib.figures import mesh_view, overlay, style
from p2p_lib.figures.overlay import Label
from p2p_lib.figures.plots import panels
from p2p_lib.figures.scenes import Scene
from p2p_lib.synthetic.shapes import load_mesh

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure

_WIDTH_IN = 8.0
#: Errors from a tenth of a millimetre to the ten centimetres at which a frame scores nothing.
EDGES_MM = np.geomspace(0.1, 100, 31)
#: Tracks so far off, or farther, have the brightest colour.
FAR_PX = 4.0


def scene_of(benchmark: Benchmark, method: str, sequence: str = "") -> tuple[Scene, Run, Sequence]:
    """A method's first finished run on its video, ready to be drawn."""
    run, video = benchmark.run(method, sequence), benchmark.video(method, sequence)
    return Scene(video, run, evaluate(run)), run, video


def error_histograms(benchmark: Benchmark) -> Figure:
    """ADD and ADD-S of all scored frames of each method, one line a method; what has no pose stands apart.

    Aligned at the first scored frame. Shares are of the scored frames, over all sequences, objects and seeds.
    """
    with style.applied():
        figure, axes = panels(2, (_WIDTH_IN, 3.2), [1, 1], side_by_side=True)
        for axis, (key, title) in zip(axes, (("add_m", "ADD"), ("adds_m", "ADD-S")), strict=True):
            for colour, method in zip(style.METHODS, benchmark.plan.methods(benchmark.profile), strict=False):
                errors_mm = 1e3 * _errors(benchmark, method.name, key)
                if not len(errors_mm):
                    continue
                share = 100 * np.histogram(np.maximum(errors_mm, EDGES_MM[0]), EDGES_MM)[0] / len(errors_mm)
                beyond = 100 * float((errors_mm >= EDGES_MM[-1]).mean())
                label = f"{method.name} ({len(errors_mm)} frames)"
                axis.stairs(share, EDGES_MM, color=colour, linewidth=1.4, label=label)
                axis.plot(1.4 * EDGES_MM[-1], beyond, "x", color=colour, clip_on=False, markersize=5)
            axis.axvline(EDGES_MM[-1], color=style.NEUTRAL[1], linewidth=0.8)
            axis.set(xscale="log", xlabel=f"{title} [mm]", xlim=(EDGES_MM[0], 2 * EDGES_MM[-1]), ylim=(0, None))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set_title(f"{title}; cross: lost, or off by 10 cm or more")
        axes[0].set_ylabel("frames [%]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=2, fontsize=8)
    return figure


def tracks_by_error(
    benchmark: Benchmark, method: str, sequence: str = "", count: int = 3, width_px: int = 420
) -> Figure:
    """True boxes (white, dashed), estimated ones, and the 2D tracks of the keypoints coloured by their error.

    The error is the distance in pixels from where the tracker saw a keypoint to the keypoint of the final map projected
    with the true pose; points that the map has dropped since are not drawn.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scene, run = scene_of(benchmark, method, sequence)[:2]
    evaluation, keypoints, region_px = evaluate(run), load_keypoints(run.path), scene.region()
    pictures = []
    for row in _well_seen(run, count):
        image = scene.draw(row, region_px, width_px, axes=False, trail=0)
        for name, score in evaluation.objects.items():
            uv_px, error_px = _track_errors(scene, run.objects[name], keypoints[name], score.T_obj_model, row)
            scale = image.shape[1] / (region_px[2] - region_px[0])
            at = (uv_px - region_px[:2] + 0.5) * scale - 0.5
            image = overlay.draw_points(image, at, overlay.value_colours(error_px, 0, FAR_PX), 2.5)
        pictures.append(image)
    with style.applied():
        high_in = _WIDTH_IN / count * pictures[0].shape[0] / pictures[0].shape[1]
        figure, axes = panels(count, (_WIDTH_IN, high_in + 0.6), [1] * count, side_by_side=True)
        for axis, picture in zip(axes, pictures, strict=True):
            axis.imshow(picture)
            axis.set_axis_off()
        colours = ScalarMappable(Normalize(0, FAR_PX), "cividis")
        bar = figure.colorbar(colours, ax=axes, location="bottom", aspect=60, pad=0.02, extend="max")
        bar.set_label("2D track from its keypoint under the true pose [px]")
    return figure


def recovery_strip(benchmark: Benchmark, sequence: str = "", count: int = 4, width_px: int = 300) -> np.ndarray:
    """Occlusion and recovery: a line for each method, the same moments below each other.

    White and dashed is the truth, in colour the estimate; a method that has lost the object draws none.
    """
    scenes = {m.name: scene_of(benchmark, m.name, sequence)[0] for m in benchmark.plan.methods(benchmark.profile)}
    first = next(iter(scenes.values()))
    moments, region_px, pictures = first.moments(count), first.region(), []
    for name, scene in scenes.items():
        for row in moments:
            image = scene.draw(row, region_px, width_px, axes=False, trail=0)
            foot = (0, image.shape[0] - 2, 1, image.shape[0] - 1)
            pictures.append(overlay.draw_labels(image, [Label(name, "#222222", foot)]))
    return overlay.montage(pictures, columns=count)


def reconstruction_sheet(benchmark: Benchmark, method: str, sequence: str = "", width_px: int = 300) -> np.ndarray:
    """Each object's reconstruction beside its true surface: seen as in its first frame, from behind, and as clay."""
    run, video = benchmark.run(method, sequence), benchmark.video(method, sequence)
    evaluation, pictures = evaluate(run), []
    for name in evaluation.objects:
        pictures += _rows(benchmark, run, video, evaluation, name, method, width_px)
    if not pictures:
        raise MissingData(str(run.path), "no reconstructed surface", "Run with the setting method.surface = true.")
    return overlay.montage(pictures, columns=4)


def _rows(
    benchmark: Benchmark, run: Run, video: Sequence, evaluation: Evaluation, name: str, method: str, width_px: int
) -> list[np.ndarray]:
    import trimesh

    file, model = run.path / "meshes" / f"{name}.ply", find_models(video, MESHES).get(name)
    if not file.is_file() or model is None:
        return []
    surface = trimesh.load(file, process=False)
    surface.apply_transform(se3.inverse(evaluation.objects[name].T_obj_model))
    truth = load_mesh(model)
    middle = (truth.vertices.max(0) + truth.vertices.min(0)) / 2
    camera, T_cam_model = _portrait(run, name, middle, float(np.ptp(truth.vertices, axis=0).max()), width_px)
    turned = T_cam_model @ se3.from_rt(np.eye(3), middle) @ se3.exp(np.array([0, 0, np.pi, 0, 0, 0]))
    behind = turned @ se3.from_rt(np.eye(3), -middle)
    chamfer = benchmark.chamfer_cm(method, video.name, name)
    said = f", CD {10 * chamfer:.1f} mm" if chamfer is not None else ""
    kind = "synthetic" if video.name.startswith("synthetic") else "real"
    pictures = []
    for words, T in ((f"{name}, {kind}", T_cam_model), ("from behind", behind)):
        pictures.append(_captioned(truth, camera, T, f"{words}: truth"))
        pictures.append(_captioned(surface, camera, T, f"reconstructed{said if T is T_cam_model else ''}"))
    return pictures


def _captioned(mesh: trimesh.Trimesh, camera: Camera, T_cam_model: np.ndarray, words: str) -> np.ndarray:
    return overlay.draw_caption(mesh_view.draw_mesh(mesh, camera, T_cam_model), words, scale=0.4)


def _portrait(run: Run, name: str, middle: np.ndarray, size_m: float, width_px: int) -> tuple[Camera, np.ndarray]:
    """A camera that sees the whole object as the first scored frame did, with its middle in the middle."""
    obj = run.objects[name]
    T = obj.T_cam_model[np.flatnonzero(obj.has_truth)[0]].copy()
    T[:3, 3] = np.array([0, 0, 4 * size_m]) - T[:3, :3] @ middle
    focal_px = 3.1 * width_px
    return Camera(focal_px, focal_px, (width_px - 1) / 2, (width_px - 1) / 2, width_px, width_px), T


def _well_seen(run: Run, count: int) -> list[int]:
    """Rows spread over the frames in which every object has a pose; the first has no tracks yet."""
    seen = np.flatnonzero(np.logical_and.reduce([obj.has_pose & obj.has_truth for obj in run.objects.values()]))
    seen = seen[seen > 0]
    if not len(seen):
        raise MissingData(str(run.path), "no frame in which every object has a pose")
    return seen[np.linspace(0, len(seen) - 1, count).round().astype(int)].tolist()


def _track_errors(
    scene: Scene, obj: ObjectRun, keypoints: ObjectKeypoints, T_obj_model: np.ndarray, row: int
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) tracks of one object in a frame and (K,) their errors, of the points that its final map still holds."""
    now = keypoints.at(int(obj.frame_index[row]))
    ids, uv_px = keypoints.track_id[now], keypoints.uv_px[now].astype(float)
    place = {id: k for k, id in enumerate(keypoints.ids.tolist())}
    kept = np.array([id in place for id in ids.tolist()], bool)
    p_obj = keypoints.p_obj[[place[id] for id in ids[kept].tolist()]]
    T_cam_obj = obj.T_cam_model[row] @ se3.inverse(T_obj_model)
    true_px = scene.sequence.camera.project(se3.transform(T_cam_obj, p_obj.reshape(-1, 3)))
    return uv_px[kept], np.linalg.norm(uv_px[kept] - true_px, axis=1)


def _errors(benchmark: Benchmark, method: str, key: str) -> np.ndarray:
    of: Rows[np.ndarray] = [
        obj.errors_m("first")[key]
        for job, outcome in benchmark.results
        if job.method.name == method
        for obj in outcome.objects.values()
    ]
    return np.concatenate(of) if of else np.zeros(0)
