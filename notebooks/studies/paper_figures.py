"""The paper's qualitative figures (``p2p figures``), and the index of its figures and tables: ``figures/README.md``.

Each is drawn from runs of the plan ``paper_figures``, which are made once and found again. What is not of the paper's
own data says so in the image.
"""

from __future__ import annotations

import io
import json
import subprocess
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pandas import DataFrame
from PIL import Image

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.plan import Plan, read_plan
from p2p_lib.core.errors import BadInput, did_you_mean
from p2p_lib.core.tables import as_markdown
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.figures import overlay, style
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.provenance import Saved, save_figure
from p2p_lib.figures.scenes import Scene, side_by_side
from p2p_lib.run import import_poses
from studies import CLONE, SHIPPED, mesh_view
from studies.final_figures import rate_figure, scene_of
from studies.pipeline_diagram import pipeline_diagram

PLAN = "paper_figures"
_OURS, _MESHES = "Ours", "Ours, YCB meshes"
#: Line by line, what stands in each image's corner, and whose it is.
_TWO_BY_TWO = {
    "memory and scene": _OURS,
    "memory alone": "Ours, points alone",
    "scene alone": "Ours, SH(10)",
    "neither": "Ours, points alone, SH(10)",
}
_THREE, _AIRPLANE, _HIDDEN = "synthetic/three_objects", "synthetic/ycb_airplane_can", "synthetic/occlusion"
#: What each is drawn from.
_DRAWN_FROM = {
    "fig1_three_objects": _THREE,
    "fig2_framework": _THREE,
    "fig3_synthetic": _AIRPLANE,
    "fig5_return": _HIDDEN,
}
_OTHER = "stand-in: rendered, not the paper's sequence"
_RIVAL = "A return: ours above, a competitor's poses below."
_RETURN = (
    "A return, two by two: above with long memory, below without; left with our search by shape and scene. "
    "Right is the paper's pair, Point2Pose and P2P-SH(10)."
)


def picked(only: Collection[str] = ()) -> list[str]:
    """The names of the figures that are drawn here: all of them, or those asked for."""
    known = [Path(item.file).stem for item in ITEMS.itertuples() if item.command.startswith("p2p figures")]
    for name in only:
        if name not in known:
            raise BadInput("figures --only", name, f"names of {', '.join(known)}", did_you_mean(name, known))
    return [name for name in known if name in only or not only]


def plan_for(names: Collection[str]) -> Plan:
    """The runs that the figures of these names are drawn from."""
    plan, wanted = read_plan(PLAN), {_DRAWN_FROM.get(name) for name in names}
    kept = [sequence for sequence in plan.full.sequence if sequence.name in wanted]
    return plan.model_copy(update={"full": plan.full.model_copy(update={"sequence": kept})})


def draw_all(runs: Benchmark, folder: Path, names: Collection[str], poses: Path | None = None) -> list[Saved]:
    """The figures of these names into ``folder`` from these runs, then the index.

    poses  of a competitor on ``synthetic/occlusion``, in any form that ``p2p eval --poses`` takes; without, ours
           with and without long memory stand in for the two
    """
    drawn: dict[str, tuple[Callable[[Benchmark], np.ndarray], str]] = {
        "fig1_three_objects": (three_objects, "Three objects, each hidden by a hand in turn."),
        "fig2_framework": (framework, "The stages, and one frame on its way through them."),
        "fig3_synthetic": (airplane_and_can, "Two objects, one circling the other."),
        "fig5_return": (partial(return_beside, poses=poses), _RETURN if poses is None else _RIVAL),
    }
    drawn_from = {name: [runs] for name in drawn} | ({"fig5_return": [runs, poses]} if poses else {})
    of_runs: dict[str, Any] = {"parameters": {"profile": runs.profile}, "to": folder}
    saved = [
        save_figure(drawn[name][0](runs), name, drawn[name][1], sources=drawn_from[name], **of_runs)
        for name in names
        if name in drawn
    ]
    if "runtime" in names:
        times = next(path for path in (folder / "tables" / "runtime.csv", SHIPPED / "runtime.csv") if path.is_file())
        saved.append(save_figure(rate_figure(times), "runtime", "Processor time a frame.", sources=[times], to=folder))
    (folder / "README.md").write_text(index(folder), encoding="utf-8")
    return saved


def three_objects(runs: Benchmark) -> np.ndarray:
    """The paper's first figure: three objects through occlusion, and back."""
    scene = scene_of(runs, _OURS, _THREE)
    return _marked(scene.story(8, 4, 300), _OTHER)


def airplane_and_can(runs: Benchmark) -> np.ndarray:
    """The synthetic qualitative: airplane and tomato can where their meshes are, else solids of their sizes."""
    real = any(j.method.name == _MESHES and o.status == "done" for j, o in runs.results)
    scene = scene_of(runs, _MESHES if real else _OURS, _AIRPLANE)
    words = (
        "re-creation: the paper's objects on other paths" if real else "stand-in: solids for airplane and tomato can"
    )
    return _marked(scene.story(4, 4, 300), words)


def return_beside(runs: Benchmark, poses: Path | None = None) -> np.ndarray:
    """A complete occlusion and the return, ours above imported poses; or two by two: long memory, our search by scene.

    The paper's pair is the right one: it has no such search, and what forgets its points stays lost.
    """
    if poses is not None:
        ours = scene_of(runs, _OURS, _HIDDEN)
        rival = imported(poses, ours.sequence)
        scenes = {"ours": ours, poses.stem: Scene(ours.sequence, rival, evaluate(rival))}
        return _marked(side_by_side(scenes, 4, axes=True), _OTHER)
    scenes = {words: scene_of(runs, method, _HIDDEN) for words, method in _TWO_BY_TWO.items()}
    event = evaluate(next(iter(scenes.values())).run).objects["box"].returns[0]
    shown = [event.hidden_frame - 15, (event.hidden_frame + event.return_frame) // 2, event.return_frame + 10]
    return _marked(side_by_side(scenes, shown, 240, across=2), _OTHER)


def imported(poses: Path, video: Sequence) -> Run:
    """Any method's poses as a run that can be drawn and scored."""
    run = import_poses(poses, video)
    there = {name: obj for name, obj in run.objects.items() if obj.has_pose.any()}
    return Run(run.path, run.info, there, run.points, {})


def framework(runs: Benchmark) -> np.ndarray:
    """The stages as a diagram, and below it one frame: image, depth, masks, tracked points, surfaces, poses."""
    scene = scene_of(runs, _OURS, _THREE)
    run, video = scene.run, scene.sequence
    playback = Playback.of(run, video)
    row = len(playback) - 1
    frame, region_px, width_px = video.frame(int(playback.frame_index[row])), scene.region(), 290
    tracked = frame.rgb
    for name, points in playback.keypoints.items():
        tracked = overlay.draw_points(tracked, points.uv_px[points.at(frame.index)], scene.colours[name], 2.5)
    masks = video.masks(frame.index) or {}
    surfaces = np.full_like(frame.rgb, 255)
    for name, mesh in playback.meshes.items():
        if run.objects[name].has_pose[row]:
            drawn = mesh_view.draw_mesh(mesh, video.camera, run.objects[name].T_cam_obj[row])
            surfaces = np.where((drawn < 255).any(-1, keepdims=True), drawn, surfaces)
    shown = {
        "colour": frame.rgb,
        "depth": overlay.depth_image(frame.depth_m),
        "segment": overlay.draw_masks(frame.rgb, masks, scene.colours),
        "track, lift": tracked,
        "fuse": surfaces,
    }
    images = [
        overlay.draw_caption(overlay.zoomed(image, video.camera, region_px, width_px)[0], title)
        for title, image in shown.items()
    ]
    pose = overlay.draw_caption(scene.draw(row, region_px, width_px, trail=0, words=False), "register, refine")
    strip = overlay.montage([*images, pose], 6)
    with io.BytesIO() as page, style.applied():
        pipeline_diagram().savefig(page, format="png", dpi=200)
        wide: Any = Image.open(page).convert("RGB")
        size = strip.shape[1], round(wide.height * strip.shape[1] / wide.width)
        diagram = np.array(wide.resize(size, Image.Resampling.LANCZOS))
    return np.concatenate([diagram, _marked(strip, "one rendered frame")])


def _marked(image: np.ndarray, words: str) -> np.ndarray:
    """With a line above it that says what it stands for."""
    head = overlay.draw_caption(np.full((22, image.shape[1], 3), 90, np.uint8), words)
    return np.concatenate([head, image])


# --- the index -------------------------------------------------------------------------------------


def _table(paper: str, shows: str, plan: str, notebook: str, data: str, on: str) -> tuple[str, ...]:
    command = f"p2p benchmark {plan} --out DIR --tables figures/tables"
    return paper, shows, f"tables/{plan}.md", command, notebook, data, on


_STAND_IN, _BUNDLED = "stand-in, rendered", "bundled sequences"
_AND_MUSTARD = f"{_BUNDLED}, YCBInEOAT mustard0"
_ROWS = (
    ("Figure 1", "three objects through occlusion", "fig1_three_objects.png", "p2p figures", "07",
     "ycbmultitrack_real", _STAND_IN),
    ("Figure 2", "the framework: stages and one frame", "fig2_framework.png", "p2p figures", "00", "-",
     "drawn from the code, a rendered frame"),
    ("Figure 3", "synthetic sequence: airplane and tomato can", "fig3_synthetic.png", "p2p figures", "09",
     "ycb_models", _STAND_IN),
    ("Figure 4", "texture: tracks on low and high texture, Sobel gradient against track error and ADD",
     "texture.png", "p2p notebooks --profile full --only 08", "08", "ho3d_v3", _STAND_IN),
    ("Figure 5", "a return, by memory and scene; or beside a competitor's poses", "fig5_return.png",
     "p2p figures --poses PATH", "07", "ycbmultitrack_real, a competitor's poses", _STAND_IN),
    _table("Table 1", "HO3D", "ho3d", "09", "ho3d_v3", "the paper's data"),
    _table("Table 2", "YCBInEOAT", "ycbineoat", "09", "ycbineoat", "the paper's data"),
    _table("Table 3 (a)", "YCBMultiTrack-Synthetic", "ycbmultitrack_synthetic", "09", "ycb_models", "re-creation"),
    _table("", "the same with stand-ins", "ycbmultitrack_standins", "09", "-", _STAND_IN),
    _table("Table 3 (b)", "YCBMultiTrack-Real", "ycbmultitrack_real", "09", "ycbmultitrack_real", "the paper's data"),
    _table("Table 4", "ablation of components", "ablation", "09", "ho3d_v3", "the paper's data"),
    _table("", "the same on bundled sequences", "ablation_embedded", "09", "-", _BUNDLED),
    _table("", "what each component is worth, by 2D tracker", "ablation_trackers", "09", "-", _BUNDLED),
    _table("Table 5", "ablation of sampling", "sampling", "09", "ho3d_v3", "the paper's data"),
    _table("", "the same on bundled sequences", "sampling_embedded", "09", "-", _BUNDLED),
    _table("Section 4.4, runtime", "2 to 10 Hz", "runtime", "09", "-", _BUNDLED),
    ("", "the same as a plot", "runtime.png", "p2p figures", "09", "-", _BUNDLED),
    _table("Section 4.5, long range", "5 of 5 returns against 0 of 5", "long_range", "07, 09", "ycbmultitrack_real",
           _BUNDLED),
    _table("", "the same, scored from the first visible pixel on", "long_range_every_pixel", "-", "-", _BUNDLED),
    _table("-", "README's first tables", "readme", "-", "-", f"{_AND_MUSTARD}, 7-Scenes, TUM RGB-D"),
    _table("-", "hard scenes, from three clicks", "hard_scenes", "-", "-", _BUNDLED),
    _table("-", "2D point trackers, and what of the built-in one is 2D alone", "trackers", "01", "-", _AND_MUSTARD),
    _table("-", "whose method: the paper's text and ours, by 2D tracker", "presets", "09", "-",
           f"{_AND_MUSTARD}, 7-Scenes"),
    _table("-", "faults of camera, depth, masks and time", "faults", "10", "-", _AND_MUSTARD),
)  # fmt: skip
#: The paper's figures, tables and statements: where each is found (``file``, below ``figures/``), what that is made
#: ``on``, and what ``data`` the paper's own form needs.
ITEMS = DataFrame(_ROWS, columns=["paper", "shows", "file", "command", "notebook", "data", "on"])

_INDEX = """# The paper's figures and tables

Written by `p2p figures`. *Made on* says whether what is here is of the paper's data, of a re-creation of it,
or of a stand-in, which carries the word in the picture. Tables of data that was not there hold the paper's
numbers and, for ours, dashes with the reason. `make figures` makes all of it from what is on disk;
`p2p benchmark --list` says what can run here. *Earlier code*: what decides the numbers has changed since;
`p2p benchmark --stale` lists these with the minutes they take, and makes them anew with `--out DIR`.

"""


def index(folder: Path, day_of: Callable[[str], str] | None = None) -> str:
    """``README.md`` of the figures: every item of the paper, what is here in its place, and how it was made."""
    rows = []
    for item in ITEMS.itertuples():
        seeds, made, on = _made(folder / item.file, item.on, day_of or _day)
        row = {"paper": item.paper, "what it shows": item.shows}
        row["here"] = f"[{item.file}]({item.file})" if (folder / item.file).is_file() else "not made yet"
        row |= {"made on": on, "seeds": seeds, "commit, date": made, "command": f"`{item.command}`"}
        rows.append(row | {"notebook": item.notebook, "the paper's data": item.data})
    return _INDEX + as_markdown(DataFrame(rows))


def _made(file: Path, on: str, day_of: Callable[[str], str]) -> tuple[str, str, str]:
    """Seeds, commit with date, and what it was made on, as the note beside a file says."""
    if (said := note_of(file)) is None or not file.is_file():
        return "-", "-", "-"
    asked = said["parameters"]
    if asked.get("runs", "").startswith("0 of"):
        return "-", "-", "not run for this table: its data was not there"
    commit = commit_of(said)
    part = f", {asked['runs']} runs" if "runs" in asked else ""
    made = f"{commit[:7]} {day_of(commit)}".strip() or "-"
    return str(asked.get("seeds", "0")), made + ", *earlier code*" * said.get("earlier", False), on + part


def note_of(file: Path) -> dict[str, Any] | None:
    """What the note beside a figure or table says; None where there is none."""
    note = file.with_suffix(".json")
    return json.loads(note.read_text(encoding="utf-8")) if note.is_file() else None


def commit_of(note: Mapping[str, Any]) -> str:
    """The commit of the runs, else of the drawing; "" where a note says neither."""
    return note["parameters"].get("commit") or note.get("commit") or ""


def _day(commit: str) -> str:
    asked = ["git", "-C", str(CLONE), "show", "-s", "--format=%cs", commit]
    found = subprocess.run(asked, capture_output=True, text=True, check=False)
    return found.stdout.strip() if commit and found.returncode == 0 else ""
