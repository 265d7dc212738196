"""Are objects found again in other videos by their memories, and none where they are not?

    python benchmarks/bench_recall.py OUT [--data DIR] [--cases N]

Writes ``benchmarks/recall.md``; runs go below OUT. DIR holds copies of YCBInEOAT's ``mustard0_first400`` (with its
mesh beside it), ``redkitchen_table`` (7-Scenes in the YCBMultiTrack layout) and ``desk_fast`` (TUM RGB-D): rows whose
data is not there are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import options, tracked, write_page

from p2p_lib.datasets.models import find_models, load_points
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.protocol import model_frames, scored_frames
from p2p_lib.synthetic import SCENARIOS
from p2p_lib.synthetic.generate import write_scenario
from p2p_lib.synthetic.noise import NOISE
from p2p_lib.synthetic.scene import Scenario

#: An object is in sight from so many pixels of its true mask on.
_SIGHT_PX = 800
#: Of what is rendered anew so many frames are looked at.
_FRAMES = 160
_SCENES = ("three_objects", "crossing", "late_object", "occlusion", "moving_camera")
PAGE = """# What memories are worth

Written by `python benchmarks/bench_recall.py`; do not edit. {machine}

## Found again

Objects are learnt in one video with its masks, or from three clicks on each where the case says so, and looked for in
another without any: no mask, no click. Scored with
the object frames of the first video, aligned there by its first scored frame; failures count 0. *first pose*: frames
from the first sight (at least {sight} pixels, or the most that it ever shows) to the first pose. Synthetic cases: the
carton and the tin of `synthetic/crossing` on the paths, in the light and in the room of another scenario and seed, of
which {frames} frames are looked at.

{found}
## Not there

Memories of objects that are not in the video: frames with a pose, of all.

{absent}"""


def memories(folder: Path, names: Sequence[str]) -> list[Path]:
    """Those that a run kept of some objects."""
    return [path for name in names if (path := folder / "maps" / f"{name}.npz").is_file()]


def found(case: str, learnt: Run, again: Run, models: Mapping[str, Path]) -> list[dict[str, object]]:
    """A row for each object: how soon, how often and how exactly it was found."""
    rows = []
    T_obj_model = model_frames(learnt)
    for name, obj in again.objects.items():
        if name not in T_obj_model:
            continue
        scored, points = scored_frames(obj), load_points(models[name])
        pose = scored & obj.has_pose
        T = np.where(pose[:, None, None], obj.T_cam_obj, np.nan) @ T_obj_model[name]
        adds, add = np.full(len(obj), np.inf), np.full(len(obj), np.inf)
        adds[pose] = metrics.adds_m(T[pose], obj.T_cam_model[pose], points)
        add[pose] = metrics.add_m(T[pose], obj.T_cam_model[pose], points)
        sight = np.flatnonzero(scored & (obj.visible_px >= min(_SIGHT_PX, obj.visible_px.max())))
        first = np.flatnonzero(obj.has_pose[sight[0] :]) if len(sight) else ()
        rows.append(
            {
                "case": case,
                "object": name,
                "frames": int(scored.sum()),
                "with pose [%]": round(100 * pose.sum() / max(scored.sum(), 1), 1),
                "first pose": int(first[0]) if len(first) else "never",
                "ADD-S AUC [%]": round(metrics.auc_exact(adds[scored]), 1),
                "ADD AUC [%]": round(metrics.auc_exact(add[scored]), 1),
            }
        )
    return rows


def absent(case: str, sequence: str | Path, out: Path, kept: Sequence[Path], **options: object) -> list[dict]:
    """A row for each memory of something that is not there."""
    rows = []
    for name, obj in tracked(sequence, out, memory=[str(path) for path in kept], **options).objects.items():
        of = next(path.parts[-3] for path in kept if path.stem == name)
        rows.append(
            {"video": case, "memory of": f"{name} ({of})", "frames": len(obj), "posed": int(obj.has_pose.sum())}
        )
    return rows


def other_path(learnt: str, seed: int, scene: str, other: int) -> Scenario:
    """The objects of a scenario on the paths of another, with another seed."""
    own = {body.name: body.mesh for body in SCENARIOS[learnt](seed).bodies}
    made = SCENARIOS[scene](other)
    cut = [replace(b, T_world_model=b.T_world_model[:_FRAMES]) for b in made.bodies]
    bodies = (replace(b, mesh=own.get(b.name, b.mesh)) if b.labelled else b for b in cut)
    return replace(made, bodies=tuple(bodies), T_world_cam=made.T_world_cam[:_FRAMES])


def synthetic(out: Path, cases: int) -> list[dict]:
    """Memories of crossing's objects, looked for on other paths."""
    rows: list[dict] = []
    for case in range(cases):
        seed, scene, other = 500 + case // 2, _SCENES[case % len(_SCENES)], 600 + case
        learnt = tracked(f"synthetic/crossing@{seed}", out / f"crossing_{seed}", seed=seed)
        folder = out / "scenes" / f"{scene}_{other}_with_{seed}"
        if not (folder / "cam_K.txt").is_file():
            write_scenario(folder, other_path("crossing", seed, scene, other), NOISE["realsense"], other)
        kept = [str(path) for path in memories(out / f"crossing_{seed}", ("box", "can"))]
        again = tracked(folder, out / f"case_{case}", memory=kept)
        rows += found(f"{scene} {other}", learnt, again, find_models(open_sequence(folder)))
    return rows


def main() -> None:
    """See the module."""
    parser = options()
    parser.add_argument("--cases", type=int, default=20)
    asked = parser.parse_args()
    out, data = asked.out, asked.data
    rows: list[dict] = []
    nothing: list[dict] = []
    mustard, table, desk = (
        next(iter(data.glob(f"**/{name}")), None) for name in ("mustard0_first400", "redkitchen_table", "desk_fast")
    )
    tracked("synthetic/crossing@500", out / "crossing_500", seed=500)
    other = memories(out / "crossing_500", ("box", "can"))
    bottle: list[Path] = []
    if mustard is not None:
        model = {"object": next(mustard.parent.glob("*.obj"))}
        learnt = tracked(mustard, out / "mustard_a", stop=200)
        bottle = memories(out / "mustard_a", ("object",))
        again = tracked(mustard, out / "mustard_b", start=200, memory=[str(path) for path in bottle])
        rows += found("mustard0 200 to 399", learnt, again, model)
        nothing += absent("mustard0", mustard, out / "mustard_absent", other)
    if table is not None:
        learnt = tracked(table, out / "table_a", stop=75)
        own = memories(out / "table_a", tuple(learnt.objects))
        again = tracked(table, out / "table_b", start=75, memory=[str(path) for path in own])
        rows += found("redkitchen_table 75 to 229", learnt, again, find_models(open_sequence(table)))
        for seed in range(3):
            learnt = tracked(table, out / f"clicked_{seed}_a", masks="clicks", seed=seed, stop=75)
            clicked = memories(out / f"clicked_{seed}_a", tuple(learnt.objects))
            again = tracked(table, out / f"clicked_{seed}_b", start=75, memory=[str(path) for path in clicked])
            rows += found(f"the same, clicks of seed {seed}", learnt, again, find_models(open_sequence(table)))
            if desk is not None:
                nothing += absent("desk_fast", desk, out / f"desk_absent_{seed}", clicked)
        nothing += absent("redkitchen_table", table, out / "table_absent", bottle + other)
        if mustard is not None:
            nothing += absent("mustard0", mustard, out / "mustard_absent_table", own)
        if desk is not None:
            nothing += absent("desk_fast", desk, out / "desk_absent", bottle + own)
        nothing += absent("synthetic/occlusion", "synthetic/occlusion", out / "occlusion_absent", bottle + own)
    rows += synthetic(out, asked.cases)
    write_page("recall", PAGE, found=rows, absent=nothing, sight=_SIGHT_PX, frames=_FRAMES)


if __name__ == "__main__":
    main()
