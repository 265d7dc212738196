"""Notebook 09: a benchmark's tables, and figures beside them: errors, tracks, returns, reconstructions and rates."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Iterable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from pandas import Series, read_csv, to_numeric

from p2p_lib.benchmark.benchmark import Benchmark, load_benchmark
from p2p_lib.benchmark.execution import measured, perform
from p2p_lib.benchmark.jobs import library_version
from p2p_lib.benchmark.outcome import save_outcome
from p2p_lib.core import se3
from p2p_lib.core.errors import MissingData
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.models import MESHES, find_models, read_mesh
from p2p_lib.datasets.sequence import SYNTHETIC
from p2p_lib.evaluation.consistency import reprojected
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.figures import overlay, style
from p2p_lib.figures.final_tables import paper_table
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.plots import WIDTH_IN, logarithmic, panels
from p2p_lib.figures.provenance import Saved, save_table
from p2p_lib.figures.scenes import Scene, side_by_side
from p2p_lib.synthetic.shapes import load_mesh
from studies import SHIPPED, mesh_view

if TYPE_CHECKING:
    from IPython.display import Markdown


#: Plans whose quick form is run where there is nothing in full: images are drawn from them, or no table is shipped.
RUN_HERE = ("long_range", "segmenters")


def results_to_show(
    plans: Iterable[str], out: Path, profile: str, run_here: Container[str] = RUN_HERE
) -> dict[str, Benchmark]:
    """Plan to what ``out`` has of it in full; where it has nothing, or ``profile`` is quick, to its quick form.

    That is run in this process, for those of ``run_here``: a process of its own, as ``p2p benchmark`` has for each
    run, takes as long to begin as one of these runs takes.
    """
    results = {}
    for name in plans:
        results[name] = load_benchmark(name, out, profile)
        if profile == "full" and results[name].counts()["done"]:
            continue
        for job, outcome in load_benchmark(name, out, "quick").results if name in run_here else ():
            if job.key and outcome.status == "not run":
                save_outcome(out, perform(measured, job, out, library_version()))
        results[name] = load_benchmark(name, out, "quick")
    return results


def first_with_runs(results: Mapping[str, Benchmark], *plans: str) -> Benchmark:
    """Of plans that an image could be of, the first that was run."""
    return next(results[name] for name in plans if results[name].counts()["done"])


def shown_table(benchmark: Benchmark, parameters: Mapping[str, object] | None = None) -> Saved | Markdown:
    """A benchmark's table for a notebook; where only its quick form was run, the one that the project ships, if any.

    Below a shipped one stands with which commit, seeds and parts it was run.
    """
    shipped = SHIPPED / f"{benchmark.plan.name}.md"
    if benchmark.profile == "quick" and shipped.is_file():
        from IPython.display import Markdown

        text = shipped.read_text(encoding="utf-8")
        return Markdown(f"*Shipped with the project: nothing newer was run here.*\n\n{text}")
    name = f"final_{benchmark.plan.name}"
    return save_table(paper_table(benchmark), name, sources=[benchmark], parameters=parameters)


@style.styled
def rate_figure(table: Path) -> Figure:
    """Processor time per frame against objects, tracks, resolution and 2D tracker, from the table ``runtime.csv``."""
    rows = read_csv(table).set_index("Setting")
    time_ms = (
        to_numeric(rows["processor, files included (ms)"], errors="coerce")
        .dropna()
        .rename(lambda name: name.partition(",")[0])
    )
    whole = time_ms.iloc[0]
    panels_of: dict[str, dict[Any, float]] = {
        "objects": {int(k.split()[0]): v for k, v in time_ms.items() if "object" in k},
        "tracks an object": {int(k.split()[0]): v for k, v in time_ms.items() if "tracks" in k} | {60: whole},
        "megapixels": {np.prod([int(n) for n in k.split("x")]) / 1e6: v for k, v in time_ms.items() if "x" in k}
        | {0.3072: whole},
        "2D tracker": {k.split()[1]: v for k, v in time_ms.items() if k.startswith("tracker")} | {"builtin": whole},
    }
    figure, axes = panels(4, (WIDTH_IN, 2.8), side_by_side=True)
    for axis, (label, values) in zip(axes, panels_of.items(), strict=True):
        at = sorted(values, key=lambda k: values[k] if isinstance(k, str) else k)
        if isinstance(at[0], str):
            axis.bar(at, [values[k] for k in at], color=style.METHODS[0])
            axis.tick_params(axis="x", rotation=30)
        else:
            axis.plot(at, [values[k] for k in at], "o-", color=style.METHODS[0])
            axis.set_xlim(0, None)
        axis.set(xlabel=label, ylim=(0, 1.1 * max(values.values())))
    axes[0].set_ylabel("processor time a frame [ms]")
    return figure


#: Errors from a tenth of a millimetre to the ten centimetres at which a frame scores nothing.
EDGES_MM = np.geomspace(0.1, 100, 31)
#: Tracks so far off, or farther, have the brightest colour.
FAR_PX = 4.0


def scene_of(benchmark: Benchmark, method: str, sequence: str = "") -> Scene:
    """A method's first finished run (on a sequence) on its video, ready to be drawn."""
    return Scene.scored(Playback.of(benchmark.run(method, sequence), benchmark.video(method, sequence)))


@style.styled
def error_histograms(benchmark: Benchmark) -> Figure:
    """ADD and ADD-S of each method over all scored frames, aligned at the first; what has no pose stands apart."""
    figure, axes = panels(2, (WIDTH_IN, 3.2), side_by_side=True)
    for axis, (key, title) in zip(axes, (("add_m", "ADD"), ("adds_m", "ADD-S")), strict=True):
        errors: dict[str, list] = defaultdict(list)
        for job, outcome in benchmark.results:
            errors[job.method.name] += [1e3 * obj.errors_m("first")[key] for obj in outcome.objects.values()]
        names = list(filter(errors.get, benchmark.methods))
        for k, (colour, name) in enumerate(zip(style.METHODS, names, strict=False)):
            errors_mm = np.concatenate(errors[name])
            weights = np.full(len(errors_mm), 100 / len(errors_mm))
            percent, _ = np.histogram(np.maximum(errors_mm, EDGES_MM[0]), EDGES_MM, weights=weights)
            wide = len(names) - 1 - k  # what coincides with a later line shows on both sides of it
            look = {"color": colour, "linewidth": 1.2 + 1.2 * wide}
            axis.stairs(percent, EDGES_MM, label=f"{name} ({len(errors_mm)} frames)", **look)
            beyond = weights[errors_mm >= EDGES_MM[-1]].sum()
            axis.plot(1.4 * EDGES_MM[-1], beyond, "x", color=colour, clip_on=False, markersize=5 + 3 * wide)
        axis.axvline(EDGES_MM[-1], color=style.NEUTRAL[1], linewidth=0.8)
        logarithmic(axis.xaxis)
        axis.set(xlabel=f"{title} [mm]", xlim=(EDGES_MM[0], 2 * EDGES_MM[-1]), ylim=(0, None))
        axis.set_title(f"{title}; cross: lost, or off by 10 cm or more")
    axes[0].set_ylabel("frames [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2, fontsize=8)
    return figure


@style.styled
def tracks_by_error(benchmark: Benchmark, method: str, count: int = 3) -> Figure:
    """True boxes (white, dashed), estimated ones, and the 2D tracks of the keypoints coloured by their error.

    From the frame with the smallest ADD, of the worse object, to that with the largest.
    The error is the distance in pixels from where the tracker saw a keypoint to the keypoint of the final map projected
    with the true pose; points that the map has dropped since are not drawn.
    """
    scene, images = scene_of(benchmark, method), []
    run, scores, keypoints = scene.run, evaluate(scene.run).objects, load_keypoints(scene.run.path)
    seen = np.flatnonzero(np.logical_and.reduce([obj.has_pose & obj.has_truth for obj in run.objects.values()]))
    off_m = [Series(s.add_m, s.frame_index).reindex(run.objects[name].frame_index) for name, s in scores.items()]
    worst_m = np.max([off.to_numpy() for off in off_m], 0)
    seen = seen[(seen > 0) & np.isfinite(worst_m[seen])]  # the first has no tracks yet
    if not len(seen):
        raise MissingData(str(run.path), "no frame in which every object has a pose")
    rows = seen[np.argsort(worst_m[seen])][np.linspace(0, len(seen) - 1, count).round().astype(int)].tolist()
    for row in rows:
        tracks = []
        for name, score in scores.items():
            obj = run.objects[name]
            T_cam_obj = obj.T_cam_model[row] @ se3.inverse(score.T_obj_model)
            tracks.append(reprojected(keypoints[name], int(obj.frame_index[row]), scene.sequence.camera, T_cam_obj))
        uv_px, error_px = map(np.concatenate, zip(*tracks, strict=True))
        dots = uv_px, overlay.value_colours(error_px, 0, FAR_PX)
        images.append(scene.draw(row, scene.region(), 420, axes=False, trail=0, dots=dots))
    high_in = WIDTH_IN / count * images[0].shape[0] / images[0].shape[1]
    figure, axes = panels(count, (WIDTH_IN, high_in + 0.9), side_by_side=True)
    for axis, image, row in zip(axes, images, rows, strict=True):
        axis.imshow(image)
        axis.set_title(f"ADD {1e3 * worst_m[row]:.3g} mm", fontsize=9)
        axis.set_axis_off()
    colours = ScalarMappable(Normalize(0, FAR_PX), "cividis")
    bar = figure.colorbar(colours, ax=axes, location="bottom", aspect=60, pad=0.02, extend="max")
    bar.set_label("2D track from its keypoint under the true pose [px]")
    return figure


def recovery_strip(benchmark: Benchmark, count: int = 4, width_px: int = 300) -> np.ndarray:
    """Occlusion and recovery: a line for each method, the same moments below each other."""
    ran = {job.method.name for job, outcome in benchmark.results if outcome.objects}
    scenes = {name: scene_of(benchmark, name) for name in benchmark.methods if name in ran}
    return side_by_side(scenes, count, width_px)


def reconstruction_sheet(benchmark: Benchmark, method: str) -> np.ndarray:
    """Each object's true surface beside its reconstruction, from slightly above its first view and turned by 50°."""
    scene, images = scene_of(benchmark, method), []
    run, models = scene.run, find_models(scene.sequence, MESHES)
    kind = "synthetic" if scene.sequence.name.startswith(SYNTHETIC) else "real"
    for name, score in evaluate(run).objects.items():
        file = run.path / "meshes" / f"{name}.ply"
        if not file.is_file() or name not in models:
            continue
        surface: Any = read_mesh(file)
        truth: Any = load_mesh(models[name])
        truth = replace(truth, vertices=se3.transform(score.T_obj_model, truth.vertices), normals=None)
        chamfer_cm = benchmark.chamfer_cm(method, "", name)
        distance = "" if chamfer_cm is None else f", CD {10 * chamfer_cm:.1f} mm"
        titles = f"{name}, {kind}: truth", f"reconstructed{distance}", "turned by 50 degrees: truth", "reconstructed"
        for title, (turn_deg, mesh) in zip(titles, product((0, 50), (truth, surface)), strict=True):
            image = mesh_view.portrait(mesh, 300, 300, turn_deg, filling=truth.vertices)
            images.append(overlay.draw_caption(image, title, scale=0.4))
    if not images:
        fix = "Run with the setting method.surface = true."
        raise MissingData(str(run.path), "no reconstructed surface", fix)
    return overlay.montage(images, columns=4)
