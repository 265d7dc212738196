"""What the pass over the whole video is worth: poses, surfaces, textures and time beside those of the causal run.

    python benchmarks/bench_offline.py OUT [--data DIR] [--seeds N] [--all] [--only NAME,...] [--stop J]

Writes ``benchmarks/offline.md``; runs go below OUT. DIR holds copies of YCBInEOAT's ``mustard0_first400`` (with its
mesh beside it), ``redkitchen_table`` (7-Scenes in the YCBMultiTrack layout) and ``ycb_models``: rows whose data is not
there are left out. ``--all`` takes all five re-created YCB scenes, of 541 frames each, not the first alone. With
``--only`` or ``--stop``, the first J frames, the page goes into OUT. Textures need the extra ``open3d``.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from common import options, tracked, write_page
from pandas import DataFrame, Series, concat

from p2p_lib.benchmark.scoring import chamfer
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import reopen
from p2p_lib.evaluation.protocol import evaluate, rate
from p2p_lib.offline.products import write_product
from p2p_lib.offline.refine import refine_run
from p2p_lib.synthetic.generate import scenario_dir
from p2p_lib.synthetic.paper_subset import SEQUENCES

_SCENES = ("crossing", "mug", "weak_texture", "three_objects")
_HELD_OUT = "texture / vertex colours"
PAGE = """# What the pass over the whole video is worth

Written by `python benchmarks/bench_offline.py`; do not edit. {machine}

`p2p run` from three clicks an object, then `p2p refine`; mean over objects and seeds {seeds}, in brackets the lowest
and the highest seed. AUC in percent, the object frame aligned over all frames, failures count 0; lost: frames of all
objects without a pose; the mesh as the poses place it (no registration), to the part of the true surface that was seen:
half the sum of the two mean distances; texture / vertex colours: colour error of the offline run's textured model in
frames that the texture is not of, in units of that of the surface's vertex colours; time: of `p2p refine` in units of
that of `p2p run`, without its start.

{rows}
Run against run, the ADD AUC of each object with each seed, offline less causal, and the share of the gap to 100 that
it closes:

{pairs}"""


def scores(folder: Path, models: dict[str, Path]) -> DataFrame:
    """A row for each object of a run."""
    done = load_run(folder)
    sequence, rows = reopen(done.info), {}
    for name, of in evaluate(done, models, "all").objects.items():
        numbers, mesh_cm = of.as_dict(), chamfer(done, sequence, models, name, of).get("chamfer_cm") or {}
        rows[name] = {"ADD-S": numbers["adds_auc"], "ADD": numbers["add_auc"], "lost": of.lost}
        rows[name]["mesh (mm)"] = 10 * mesh_cm.get("as aligned", np.nan)
    return DataFrame.from_dict(rows, orient="index")


def colours(folder: Path) -> dict[str, float]:
    """Object to the colour error of its textured model, in units of that of vertex colours."""
    if not (out := folder / "models").is_dir():
        write_product(folder, "model", out)
    found = {path.parent.name: json.loads(path.read_text()) for path in out.glob("*/model.json")}
    off = {name: about["colour_error_of_255"] for name, about in found.items()}
    return {name: of["texture"] / of["vertex_colours"] for name, of in off.items()}


def pair(sequence: str | Path, folder: Path, seed: int, models: dict[str, Path], stop: int | None) -> DataFrame:
    """A row for each object: causal, offline, and the time of the latter in units of the former's."""
    causal = tracked(sequence, folder, seed=seed, masks="clicks", models=models, save_masks=True, stop=stop)
    took = folder / "refine_s.json"
    if not took.is_file():
        began = time.perf_counter()
        refine_run(folder)
        took.write_text(json.dumps(time.perf_counter() - began))
    frames = len(next(iter(causal.objects.values())))
    hz, _ = rate(causal.timings)
    sides = {"causal": scores(folder, models), "offline": scores(folder / "offline", models)}
    table = concat([side.add_suffix(f", {name}") for name, side in sides.items()], axis=1)
    table = table[[f"{what}, {side}" for what in sides["causal"] for side in sides]]
    table[_HELD_OUT] = Series(colours(folder / "offline"))
    return table.assign(time=json.loads(took.read_text()) * (hz or np.nan) / frames, seed=seed)


def row(name: str, objects: DataFrame) -> dict[str, str]:
    """Causal beside offline: mean, lowest and highest of the seeds."""
    of_seeds = objects.groupby("seed")
    shown = of_seeds.mean()
    lost = [what for what in shown if what.startswith("lost")]
    shown[lost] = of_seeds[lost].sum()
    return {"": name} | {what: f"{of.mean():.2f} ({of.min():.2f} to {of.max():.2f})" for what, of in shown.items()}


def paired(name: str, objects: DataFrame) -> dict[str, object]:
    """Offline less causal, run against run."""
    more = objects["ADD, offline"] - objects["ADD, causal"]
    closed = more.sum() / (100 - objects["ADD, causal"]).sum()
    lower = f"{(more < 0).sum()} of {len(more)}"
    return {"": name, "mean": f"{more.mean():+.2f}", "lowest": f"{more.min():+.2f}", "lower": lower} | {
        "gap closed": f"{100 * closed:.0f} %"
    }


def main() -> None:
    """See the module."""
    parser = options(seeds=3)
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--only", type=lambda names: names.split(","))
    parser.add_argument("--stop", type=int)
    asked = parser.parse_args()
    mustard, table, ycb = (
        next(iter(asked.data.glob(f"**/{name}")), None)
        for name in ("mustard0_first400", "redkitchen_table", "ycb_models")
    )
    videos: dict[str, tuple[str | Path, dict[str, Path]]] = {name: (f"synthetic/{name}", {}) for name in _SCENES}
    scenes = list(SEQUENCES) if asked.all else list(SEQUENCES)[:1]
    videos |= {name: (name, {}) for name in scenes if ycb is not None}
    if mustard is not None:
        videos["mustard0"] = mustard, {"object": next(mustard.parent.glob("*.obj"))}
    if table is not None:
        videos["redkitchen_table"] = table, {}
    measured = {}
    for name in [name for name in videos if asked.only is None or name in asked.only]:
        video, models = videos[name]
        video = scenario_dir(name, models=str(ycb)) if name in SEQUENCES else video  # rendered when it is needed
        runs = [pair(video, asked.out / f"{name}_{seed}", seed, models, asked.stop) for seed in range(asked.seeds)]
        measured[name] = concat(runs)
    seeds, where = ", ".join(map(str, range(asked.seeds))), {"folder": asked.out} if asked.only or asked.stop else {}
    rows = [row(name, objects) for name, objects in measured.items()]
    pairs = [paired(*one) for one in [*measured.items(), ("all", concat(measured.values()))]]
    write_page("offline", PAGE, seeds=seeds, rows=rows, pairs=pairs, **where)


if __name__ == "__main__":
    main()
