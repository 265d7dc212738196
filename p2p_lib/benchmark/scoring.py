"""Every number of one run, as a benchmark keeps them and ``p2p eval --rows`` prints them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome
from p2p_lib.benchmark.plan import Method, Plan, PlannedSequence, Scope
from p2p_lib.benchmark.rows import MEAN, MEAN_OF_ONE, Row, result_rows
from p2p_lib.core import se3
from p2p_lib.core.errors import MissingData
from p2p_lib.datasets.exchange import IMPORTED
from p2p_lib.datasets.models import MESHES, find_models, given_models, read_mesh
from p2p_lib.datasets.runs import Run, load_run
from p2p_lib.datasets.sequence import Sequence, reopen
from p2p_lib.evaluation import reconstruction
from p2p_lib.evaluation.faults import fault_score, mesh_off_share
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX, ObjectScore, evaluate, ran_with

if TYPE_CHECKING:
    import trimesh

    from p2p_lib.synthetic.faults import Faulty

#: What of ``run.json`` an outcome repeats.
RAN = ("tracker", "detector", "masks", "segmenter", "preset", "frames", "commit", "modified", "versions")
Models = Mapping[str, str | Path]
#: Fields of the outcome of an object of this name and score.
Judge = Callable[[str, ObjectScore], dict[str, Any]]


def scored(
    done: Run, models: Models, judge: Judge | None, key: str = "", min_visible_px: int = MIN_VISIBLE_PX
) -> Outcome:
    """A run's errors by both alignments, its returns, and what ``judge`` says of each object besides.

    models  object to model file, over those that the run was made with
    judge   :func:`chamfer` or :func:`fault_done` of the run
    """
    first, over_all = (evaluate(done, models, align, min_visible_px) for align in ("first", "all"))
    objects = {}
    for name, score in first.objects.items():
        objects[name] = ObjectOutcome(
            lost=score.lost,
            first=_errors(score),
            all=_errors(over_all.objects[name]),
            returns=[event.frames_to_recovery for event in score.returns],
            **(judge(name, score) if judge else {}),
        )
    ran = {key: done.info.get(key) for key in RAN} | {"changed": ran_with(done.info).get("changed", "")}
    return Outcome(key=key, status="done", ran=ran, objects=objects, left_out=first.left_out)


def run_rows(
    run: str | Path | Run,
    models: Models | None = None,
    min_visible_px: int = MIN_VISIBLE_PX,
    method: str = "",
    sequence: PlannedSequence | None = None,
) -> list[Row]:
    """Every number of a run, or of its folder, each a row (see :mod:`p2p_lib.benchmark.rows`).

    method    what the rows call it (default: the tracker, of imported poses their file)
    sequence  what the rows call that, with the frames (default: as the run calls it, and all)

    The Chamfer distance needs the sequence; where that has gone, a row says so.
    """
    done, models = run if isinstance(run, Run) else load_run(run), models or {}
    name, seed = done.info["sequence"], done.info["seed"]
    try:
        judge = partial(chamfer, done, reopen(done.info), models)
        outcome = scored(done, models, judge, min_visible_px=min_visible_px)
    except MissingData as error:
        gone = {"no_chamfer": str(error)}
        outcome = scored(done, models, lambda name, score: gone, min_visible_px=min_visible_px)
    called = Method(name=method or (done.path.stem if done.info["tracker"] == IMPORTED else str(done.info["tracker"])))
    scope = Scope(seeds=[seed or 0], sequence=[sequence or PlannedSequence(name=name)])
    plan = Plan(name="run", title="one run", method=[called], full=scope)
    rows = result_rows(plan, "full", [(Job(called, scope.sequence[0], seed or 0, "poses", True), outcome)])
    named = {MEAN: MEAN_OF_ONE}
    return [row | {"seed": seed, "sequence": named.get(row["sequence"], row["sequence"])} for row in rows]


def chamfer(done: Run, sequence: Sequence, models: Models, name: str, score: ObjectScore) -> dict[str, Any]:
    """The Chamfer distance of an object's surface, or why there is none."""
    surface = _surface(done, name)
    posed = np.isfinite(score.T_obj_model).all()
    if surface is None or not posed:
        return {"no_chamfer": "no surface was reconstructed" if surface is None else "no pose, so no model frame"}
    model = _true_model(done, sequence, models, name)
    truth, reference = reconstruction.seen_surface(sequence, name, model, score.frame_index)
    chamfer_cm = reconstruction.chamfer_cm(surface, se3.inverse(score.T_obj_model), truth)
    return {"chamfer_cm": chamfer_cm, "reference": reference, "no_chamfer": "" if chamfer_cm else "nothing near it"}


def fault_done(done: Run, sequence: Faulty, models: Models, name: str, score: ObjectScore) -> dict[str, Any]:
    """What the fault of a sequence did to an object, and to its surface: NaN without one."""
    surface, off = _surface(done, name), float("nan")
    if surface is not None and np.isfinite(score.T_obj_model).all():
        true = reconstruction.dense(_true_model(done, sequence, models, name))
        off = mesh_off_share(surface, score.T_obj_model, true)
    found = fault_score(done.objects[name], score.T_obj_model, done.points[name], sequence.during)
    return {"fault": found | {"mesh_off": off}}


def _errors(score: ObjectScore) -> dict[str, list[float]]:
    return {"adds_m": score.adds_m.tolist(), "add_m": score.add_m.tolist()}


def _surface(done: Run, name: str) -> trimesh.Trimesh | None:
    mesh = done.path / "meshes" / f"{name}.ply"
    return read_mesh(mesh) if mesh.is_file() else None


def _true_model(done: Run, sequence: Sequence, models: Models, name: str) -> Path | np.ndarray:
    """The mesh of an object where one is known, else the points of its model."""
    folder = sequence.path or Path()
    made_with = {name: folder / where for name, where in (done.info.get("models") or {}).items()}
    made_with = {name: path for name, path in made_with.items() if path.is_file()}
    known = find_models(sequence, MESHES) | made_with | given_models(models, sequence.objects, MESHES)
    return known[name] if name in known and known[name].suffix != ".xyz" else done.points[name]
