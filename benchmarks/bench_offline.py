"""What the pass over the whole video is worth: poses, surfaces and time beside those of the causal run.

    python benchmarks/bench_offline.py OUT [--data DIR] [--seeds N]

Writes ``benchmarks/offline.md``; runs go below OUT. DIR holds copies of YCBInEOAT's ``mustard0_first400`` (with its
mesh beside it), ``redkitchen_table`` (7-Scenes in the YCBMultiTrack layout) and ``ycb_models``: rows whose data is not
there are left out.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from common import machine
from pandas import DataFrame

from p2p_lib.benchmark.scoring import chamfer
from p2p_lib.core.tables import as_markdown
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import reopen
from p2p_lib.evaluation.protocol import evaluate, rate
from p2p_lib.offline.refine import refine_run
from p2p_lib.run import run
from p2p_lib.synthetic.generate import scenario_dir

_SCENES = ("crossing", "mug", "weak_texture", "three_objects")
_YCB = "ycb_sugar_box"
PAGE = """# What the pass over the whole video is worth

Written by `python benchmarks/bench_offline.py`; do not edit. {machine}

`p2p run` from three clicks an object, then `p2p refine`; mean over objects and seeds {seeds}, in brackets the lowest
and the highest seed. AUC in percent, the object frame aligned over all frames, failures count 0; lost: frames of all
objects without a pose; the mesh as the poses place it (no registration), to the part of the true surface that was seen:
half the sum of the two mean distances; time: of `p2p refine` in units of that of `p2p run`, without its start.

{rows}"""


def measured(folder: Path, models: dict[str, Path]) -> dict[str, float]:
    """A run's means over its objects, and the frames that it lost of all of them."""
    done = load_run(folder)
    score, sequence = evaluate(done, models, "all"), reopen(done.info)
    distances = [chamfer(done, sequence, models, name, of).get("chamfer_cm", {}) for name, of in score.objects.items()]
    mean = score.as_dict()["mean"]
    return {
        "ADD-S": mean["adds_auc"],
        "ADD": mean["add_auc"],
        "lost": float(sum(of.lost for of in score.objects.values())),
        "mesh (mm)": 10 * float(np.mean([of.get("as aligned", np.nan) for of in distances])),
    }


def pair(sequence: str | Path, folder: Path, seed: int, models: dict[str, Path]) -> dict[str, float]:
    """Of one seed: causal, offline, and the time of the latter in units of the former's."""
    options = {"masks": "clicks", "models": models, "save_masks": True}
    run(sequence, folder, seed=seed, if_exists="resume", progress=False, **options)
    took = folder / "refine_s.json"
    if not took.is_file():
        began = time.perf_counter()
        refine_run(folder)
        took.write_text(json.dumps(time.perf_counter() - began))
    causal = load_run(folder)
    frames = len(next(iter(causal.objects.values())))
    hz, _ = rate(causal.timings)
    sides = {"causal": measured(folder, models), "offline": measured(folder / "offline", models)}
    found = {
        f"{what}, {side}": value for what in sides["causal"] for side, of in sides.items() for value in (of[what],)
    }
    return found | {"time": json.loads(took.read_text()) * (hz or np.nan) / frames}


def row(name: str, sequence: str | Path, out: Path, seeds: int, models: dict[str, Path]) -> dict[str, str]:
    """Causal beside offline: mean, lowest and highest of the seeds."""
    of_seeds = DataFrame([pair(sequence, out / f"{name}_{seed}", seed, models) for seed in range(seeds)])
    return {"": name} | {
        what: f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})" for what, values in of_seeds.items()
    }


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--seeds", type=int, default=3)
    asked = parser.parse_args()
    mustard, table, ycb = (
        next(iter(asked.data.glob(f"**/{name}")), None)
        for name in ("mustard0_first400", "redkitchen_table", "ycb_models")
    )
    videos: dict[str, tuple[str | Path, dict[str, Path]]] = {name: (f"synthetic/{name}", {}) for name in _SCENES}
    if ycb is not None:
        videos[_YCB] = scenario_dir(_YCB, models=str(ycb)), {}
    if mustard is not None:
        videos["mustard0"] = mustard, {"object": next(mustard.parent.glob("*.obj"))}
    if table is not None:
        videos["redkitchen_table"] = table, {}
    rows = [row(name, video, asked.out, asked.seeds, models) for name, (video, models) in videos.items()]
    ran = ", ".join(f"{what} {value}" for what, value in machine().items() if not what.startswith("load"))
    page = PAGE.format(machine=ran, seeds=", ".join(map(str, range(asked.seeds))), rows=as_markdown(DataFrame(rows)))
    (Path(__file__).parent / "offline.md").write_text(page)


if __name__ == "__main__":
    main()
