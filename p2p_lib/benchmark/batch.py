"""Many recordings at once: ``p2p run --batch FOLDER`` runs each folder in it, by the benchmark's machinery.

Each is run into ``OUT/NAME`` with the options given, and its own ``prompts.json`` where it has one. What is finished is
not run again; what was cut short goes on.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from p2p_lib.benchmark.execution import execute
from p2p_lib.benchmark.outcome import Outcome
from p2p_lib.core.errors import BadInput, P2PError
from p2p_lib.core.files import replacing
from p2p_lib.core.memory import load_memories
from p2p_lib.core.options import RunOptions
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import recognise
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.run import run

if TYPE_CHECKING:
    from pandas import DataFrame

PROMPTS = "prompts.json"
TABLE = "batch.csv"


@dataclass(frozen=True)
class Recording:
    """One folder to run, into ``out``; ``key`` is its name."""

    key: str
    folder: Path
    options: RunOptions


def recordings(folder: str | Path, options: RunOptions) -> list[Recording]:
    """The folders in a folder that hold a recording, in the order of their names; BadInput where there are none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(str(folder), "no folder", "a folder of recordings, each a folder of its own")
    found = []
    for path in _folders(folder):
        try:
            recognise(path)
        except BadInput:
            continue
        own = path / PROMPTS
        found.append(Recording(path.name, path, replace(options, prompts=own) if own.is_file() else options))
    if not found:
        fix = "One recording alone: p2p run FOLDER --out DIR"
        raise BadInput(str(folder), "no recording in it", "folders with rgb/, depth/ and cam_K.txt", fix)
    return found


def _folders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def run_batch(
    folder: str | Path,
    out: str | Path,
    options: RunOptions | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool = False,
    say: Callable[[str], object] = lambda line: None,
) -> DataFrame:
    """Run every recording in a folder; the table that ``OUT/batch.csv`` keeps, a row per recording and object.

    jobs       so many at a time (default: one a core); scheduler, instead, the address of a Dask cluster

    A recording that cannot be run has a row that says why; the others are run. ``say`` is told of folders that hold
    none.
    """
    from pandas import DataFrame

    options, out = options or RunOptions(), Path(out)
    options.config()  # what does not fit is said once
    load_memories(options.memory or ())
    todo = recordings(folder, options)
    if out.resolve().is_relative_to(Path(folder).resolve()):
        raise BadInput(str(out), "a folder among the recordings", "another one for the results")
    if passed_over := sorted({path.name for path in _folders(Path(folder))} - {one.key for one in todo}):
        say(f"No recording, and passed over: {', '.join(passed_over)}")
    out.mkdir(parents=True, exist_ok=True)
    done: dict[str, Outcome] = {}
    with progress_bar("batch", len(todo), "recording", progress) as bar:
        for job, outcome in execute(todo, out, jobs or os.cpu_count() or 1, scheduler, tracked):
            done[job.key] = outcome
            bar.update()
    for path in (out / "failures").glob("*.txt"):  # of earlier calls, too
        if path.stem not in done or done[path.stem].status != "failed":
            path.unlink()
    table = DataFrame([row for one in todo for row in _rows(one, out / one.key, done[one.key])])
    table = table[[*(column for column in table if column != "note"), "note"]]  # whose length pads no other
    with replacing(out / TABLE) as file:
        file.write(table.astype({"frames": "Int64"}).to_csv(index=False).encode())  # whole, though some have none
    return table


def tracked(job: Recording, out: Path) -> Outcome:
    """Run one recording; the outcome's reason is what the run advises."""
    result = run(job.folder, out / job.key, job.options, if_exists="resume", progress=False)
    return Outcome(key=job.key, status="done", reason=result.advice)


def _rows(job: Recording, out: Path, outcome: Outcome) -> list[dict[str, Any]]:
    if outcome.status != "done":
        return [{"recording": job.key, "object": None, "frames": None, "note": outcome.reason}]
    done = load_run(out)
    try:
        scores = {row["object"]: row for row in evaluate(done).as_frame().to_dict("records")}
    except P2PError:
        scores = {}
    look_at = done.info.get("look_at") or {}
    rows = []
    for name, obj in done.objects.items():
        doubted = obj.doubted.sum() / max(obj.has_pose.sum(), 1)
        shares = {"pose [%]": obj.has_pose.mean(), "doubted [%]": doubted}
        row: dict[str, Any] = {"recording": job.key, "object": name, "frames": len(obj)}
        row |= {key: round(100 * float(share), 1) for key, share in shares.items()}
        row |= {key: value for key, value in scores.get(name, {}).items() if key in ("ADD-S AUC [%]", "ADD AUC [%]")}
        rows.append(row | {"note": "; ".join(look_at.get(name, ())) or outcome.reason or "good"})
    return rows
