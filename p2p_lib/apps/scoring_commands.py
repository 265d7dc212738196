"""The commands of ``p2p`` that score, compare and draw what was compared: ``eval``, ``benchmark``, ``figures``."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from typing import Any

from p2p_lib.apps.command_line import (
    JSON,
    QUIET,
    RUN,
    SEQUENCE,
    again,
    arg,
    command,
    output,
    run_options,
    unscored,
    warn,
)
from p2p_lib.core.errors import BadInput, MissingData, P2PError
from p2p_lib.core.options import RunOptions, differing, lengths_m, names
from p2p_lib.offline import NOT_CAUSAL

_MIN_VISIBLE = arg("--min-visible-px", type=int, default=300, metavar="N", help="smaller true masks are not scored")


@command(
    "eval",
    "score a run against the truth of its sequence; without any, against what the camera saw",
    arg("runs", type=Path, nargs="*", metavar="DIR", help="folder of p2p run; several of one video are compared"),
    arg(
        "--poses",
        type=Path,
        metavar="PATH",
        help="instead, to score another method, T_cam_obj with OpenCV's axes: its BOP CSV (mm), its TUM file or folder "
        "of OBJECT.txt (time_s tx ty tz qx qy qz qw, m), or a folder of 4x4 files (m; images' names or frame numbers)",
    ),
    arg("--sequence", metavar="SEQ", help="the sequence that --poses belongs to"),
    run_options("start", "stop", "models", "sizes", format="layout of --sequence (default: recognised)"),
    JSON,
    arg("--rows", action="store_true", help="every number as a CSV row, as in results.csv of p2p benchmark"),
    arg(
        "--name",
        dest="method",
        metavar="METHOD",
        default="",
        help="its name in --rows (default: of the tracker or of PATH)",
    ),
    arg("--align", choices=("first", "all"), default="first", help="object frame: by the first scored frame, or all"),
    _MIN_VISIBLE,
)
def _eval(a: argparse.Namespace) -> None:
    options = RunOptions.of_arguments(a)
    if a.runs and a.sequence is not None and a.poses is None:
        a.parser.error(f"DIR and --sequence do not go together: --poses {a.runs[0] / 'poses'} --sequence {a.sequence}")
    if bool(a.runs) == (a.poses is not None) or (a.poses is None) != (a.sequence is None):
        a.parser.error("needs either DIR, a run's folder, or --poses with --sequence")
    if len(a.runs) > 1:
        _compare(a, options)
        return
    a.run = a.runs[0] if a.runs else None
    imported = None
    if a.poses is not None:
        from p2p_lib.run import import_poses

        how: dict[str, Any] = {"format": options.format, "start": options.start, "stop": options.stop}
        imported = import_poses(a.poses, a.sequence, options.models, a.align, a.min_visible_px, **how)
    if a.rows:
        from p2p_lib.benchmark.plan import PlannedSequence
        from p2p_lib.benchmark.rows import COLUMNS, as_csv
        from p2p_lib.benchmark.scoring import run_rows
        from p2p_lib.datasets.runs import load_run

        run = imported or load_run(a.run)
        sequence = PlannedSequence(name=a.sequence or run.info["sequence"], start=options.start, stop=options.stop)
        rows = run_rows(run, options.models, a.min_visible_px, a.method, sequence)
        rows = [row | {"plan": "offline run"} for row in rows] if run.info.get("offline") else rows
        print(as_csv(rows, COLUMNS), end="")
    elif imported is not None:
        from p2p_lib.evaluation.protocol import evaluate

        _show(evaluate(imported, None, a.align, a.min_visible_px), a.json)
    else:
        _eval_run(a, options)


def _compare(a: argparse.Namespace, options: RunOptions) -> None:
    """Runs of one video: each as alone, what it was asked for otherwise than the first, and how far it is from that."""
    from p2p_lib.datasets.runs import load_run
    from p2p_lib.evaluation.apart import apart

    if a.json or a.rows:
        a.parser.error("--json and --rows are of one DIR")
    runs = [load_run(folder) for folder in a.runs]
    moved = {run.path: apart(runs[0], run) for run in runs[1:]}
    for run in runs:
        print(run.path)
        _eval_run(argparse.Namespace(**vars(a) | {"run": run.path}), options)
        print()
    for run in runs[1:]:
        here, there = differing(run.info.get("options") or {}, runs[0].info.get("options") or {})
        asked = f"{here}, where {runs[0].path} has {there}" if here else f"asked for as {runs[0].path} was"
        print(f"{run.path}: {asked}")
        print("".join(f"  {name}: {words}\n" for name, words in moved[run.path].items()), end="")


def _eval_run(a: argparse.Namespace, options: RunOptions) -> None:
    """Against the truth; where there is none, or no model, against what the camera saw."""
    from p2p_lib.datasets.mask_log import FILE as MASK_LOG
    from p2p_lib.datasets.models import given_models
    from p2p_lib.datasets.runs import load_run
    from p2p_lib.datasets.sequence import LIVE
    from p2p_lib.evaluation.consistency import consistency
    from p2p_lib.evaluation.known_size import lengths, that_fit
    from p2p_lib.evaluation.protocol import evaluate

    run = load_run(a.run)
    score, not_scored = None, ""
    sizes = options.sizes or (run.info.get("options") or {}).get("sizes")
    known_m = lengths_m(sizes, run.objects)
    measured = lengths(a.run, known_m)
    if any(obj.has_truth.any() for obj in run.objects.values()):
        try:
            score = evaluate(run, options.models, a.align, a.min_visible_px)
        except MissingData as error:
            if run.points.keys() & run.objects.keys() or options.models:
                raise
            not_scored = unscored(str(error), a.run)
    elif given_models(options.models or {}, run.objects):
        warn("p2p eval: --models is not used, because the run has no truth.")
    for name, of in measured.items():
        if score and of.doubt:
            warn(f"p2p eval: {name}: {of.doubt}")
    rest = run.objects if score is None else {n: obj for n, obj in run.objects.items() if not obj.has_truth.any()}
    judged = replace(consistency(replace(run, objects=rest), known_m=known_m), not_scored=not_scored) if rest else None
    said = [of for of in (score, judged) if of is not None]
    _show(said[0], a.json, bool(run.info.get("offline")), *said[1:])
    print("".join(f"{line}\n" for line in that_fit(measured) if not a.json), end="")
    if not run.info["finished"] and not a.json:
        goes_on = "" if run.info["format"] == LIVE else f" Go on with it: {again(run.info, a.run)} --resume"
        warn(f"p2p eval: the run is not finished, {run.info['frames']} frames of it are there.{goes_on}")
    elif not (score or a.json or (a.run / MASK_LOG).is_file()):
        then = f"Next: {again(run.info, a.run)} --force"
        warn(f"p2p eval: where seen and mask IoU are empty, because no {MASK_LOG} was kept. {then}")


@command("eval-masks", "score the masks that a run kept against the dataset's own", RUN, JSON, _MIN_VISIBLE)
def _eval_masks(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.runs import load_run
    from p2p_lib.evaluation.mask_score import evaluate_masks

    _show(evaluate_masks(load_run(a.run), min_visible_px=a.min_visible_px), a.json)


@command(
    "eval-tracks",
    "score a 2D point tracker against true tracks",
    SEQUENCE,
    run_options("settings", "seed", "tracker", "format", "depth_scale", "stop", models="meshes; else measured depth"),
    arg("--queries", type=int, default=256, metavar="N", help="points to follow (default 256)"),
    arg("--search", choices=("image", "masks"), default="image", help="where invisible points are looked for"),
    JSON,
)
def _eval_tracks(a: argparse.Namespace) -> None:
    from p2p_lib.run import evaluate_tracker

    options = RunOptions.of_arguments(a)
    _show(evaluate_tracker(a.sequence, options, count=a.queries, search=a.search == "masks"), a.json)


@command(
    "benchmark",
    "run methods on sequences with seeds as a plan says; resumes",
    arg("plan", nargs="*", metavar="PLAN", help="TOML files, or names that --list shows"),
    arg("--list", action="store_true", help="what can run here and now; of PLAN: what it lacks"),
    output("DIR", "runs, records and tables; several plans may share it"),
    arg("--quick", action="store_true", help="a few frames of bundled data instead of the plan in full"),
    arg("--jobs", type=int, metavar="N", help="runs at a time on this machine (default: one a core)"),
    arg("--scheduler", metavar="tcp://HOST:PORT", help="of a Dask cluster that sees DIR; trust who can reach it"),
    arg("--retry", action="store_true", help="try again what failed before"),
    arg("--present", action="store_true", help="instead of plans: all whose data is there, at least in part"),
    output("DIR", "tables with notes of what they are of go here, too", "--tables"),
    arg("--stale", action="store_true", help="list what of figures/ is of earlier code; with --out it is made anew"),
    arg("--mark", action="store_true", help="with --stale: write into tables and figures whether they are"),
    QUIET,
)
def _benchmark(a: argparse.Namespace) -> int:
    from p2p_lib.apps.readiness import overview, present_plans, readiness, what_to_fetch
    from p2p_lib.benchmark import read_plan, run_benchmarks
    from p2p_lib.core.paths import data_dir
    from p2p_lib.figures.final_tables import paper_table, write_table
    from p2p_lib.figures.provenance import save_table

    if a.list:
        wide = get_terminal_size((10_000, 24)).columns  # elsewhere than on a terminal lines stay whole
        last = "Data and weights are looked for below $P2P_DATA (see p2p data list); with --quick no plan needs any."
        plans = (line for plan in a.plan for line in readiness(plan).splitlines())
        lines = plans if a.plan else chain(overview(), ["What a plan lacks: p2p benchmark --list PLAN"])
        for line in chain(lines, [last]):
            words = fill(line, wide, subsequent_indent=" " * 6, break_long_words=False, break_on_hyphens=False)
            print(words, flush=True)
        return 0
    if a.stale:
        if a.quick:
            raise BadInput("benchmark", "--stale with --quick", "one of them", "What is stale is made anew in full.")
        return _stale(a)
    if a.present and not (present := present_plans()):
        warn("p2p benchmark: no dataset of a plan is below $P2P_DATA (see p2p data list), so there is nothing to run")
        return 0
    a.plan = present if a.present else a.plan
    if not a.plan or a.out is None:
        raise BadInput("benchmark", "no plan or no --out", "PLAN --out DIR; p2p benchmark --list names the plans")
    if not a.quick and data_dir() is None and (lacking := [str(plan) for plan in a.plan if read_plan(plan).data]):
        what = f"{', '.join(lacking)}: $P2P_DATA is not set, so what needs data will not run"
        warn(f"p2p benchmark: {what}. Set it (see p2p data list), or add --quick.")
    options = {"jobs": a.jobs, "scheduler": a.scheduler, "retry": a.retry, "progress": not a.quiet}
    benchmarks = run_benchmarks(a.plan, a.out, "quick" if a.quick else "full", **options)
    for benchmark in benchmarks:
        counts = ", ".join(f"{count} {what}" for what, count in benchmark.counts().items())
        print(f"{write_table(benchmark)}\n{counts}. Tables in {benchmark.folder}\n")
        print("".join(f"{line}\n" for line in what_to_fetch(benchmark)), end="")
        if a.tables and not benchmark.interrupted:  # a table with holes does not replace a whole one
            done = [(job, outcome) for job, outcome in benchmark.results if outcome.status == "done"]
            made: dict[str, str | None] = {"runs": f"{len(done)} of {len(benchmark.results)}"}
            made |= {"seeds": ", ".join(map(str, sorted({job.seed for job, _ in done})))}
            made["commit"] = next((str(outcome.ran.get("commit")) for _, outcome in done), None)
            save_table(paper_table(benchmark), benchmark.plan.name, sources=[benchmark], parameters=made, to=a.tables)
    if any(benchmark.interrupted for benchmark in benchmarks):
        again = shlex.join([*map(str, a.plan), "--out", str(a.out), *["--quick"] * a.quick])
        raise KeyboardInterrupt(f"Go on with it: p2p benchmark {again}")
    ended = [benchmark.counts() for benchmark in benchmarks]
    if failed := sum(count["failed"] for count in ended):
        warn(f"p2p benchmark: {failed} runs failed; the tables say why. --retry tries them again.")
        return P2PError.exit_code
    if any(count["done"] for count in ended):
        return 0
    warn("p2p benchmark: nothing ran; the tables say why")
    return P2PError.exit_code


def _stale(a: argparse.Namespace) -> int:
    """What of the figures of a clone is of earlier code is listed, and told to say so, or made anew."""
    from p2p_lib.apps.clone import study
    from p2p_lib.core.paths import figure_dir
    from p2p_lib.core.tables import as_text

    anew, folder = study("anew"), figure_dir()
    if a.mark:
        anew.say_so(folder)
    found = anew.stale(folder, a.plan)
    print(as_text(found) if len(found) else "All tables and figures are of this code.")
    return 0 if a.out is None else anew.make_anew(folder, a.out, a.plan, partial(print, flush=True))


@command(
    "figures",
    "draw the paper's qualitative figures and write the index of all its figures and tables",
    output("DIR", "runs, found again the next time (default out/benchmark)"),
    output(
        "DIR",
        "pictures and their index go here, over those there (default $P2P_FIGURES, else figures/ of the clone)",
        "--figures",
    ),
    arg(
        "--only",
        metavar="fig1_three_objects,runtime",
        help="these pictures alone, by their names, and the runs that they need",
    ),
    arg(
        "--poses",
        type=Path,
        metavar="PATH",
        help="a competitor's on synthetic/occlusion (as of p2p eval), drawn beside ours",
    ),
    QUIET,
)
def _figures(a: argparse.Namespace) -> None:
    from p2p_lib.apps.clone import study
    from p2p_lib.benchmark import load_benchmark, run_benchmarks
    from p2p_lib.core.paths import benchmark_dir, figure_dir

    figures = study("paper_figures")
    drawn = figures.picked(names(a.only) or ())  # what does not fit is said before anything runs
    out, folder = a.out or benchmark_dir("full"), a.figures or figure_dir()
    if not a.quiet:
        elsewhere = "" if a.figures else "; --figures DIR: elsewhere"
        warn(f"Pictures and their index go to {folder}, over those there{elsewhere}. Runs go to {out}.")
    (ran,) = run_benchmarks([figures.plan_for(drawn)], out, progress=not a.quiet)
    if ran.interrupted:
        raise KeyboardInterrupt
    # Drawn from the whole plan, which is what their notes name.
    for saved in figures.draw_all(load_benchmark(figures.PLAN, out), folder, drawn, a.poses):
        print(saved.path)


def _show(score: Any, as_json: bool, offline: bool = False, others: Any = None) -> None:
    """A score, and what is said of the ``others``, objects that it is not of."""
    if as_json:
        more = ({"others": others.as_dict()} if others else {}) | ({"offline": True} if offline else {})
        print(json.dumps(score.as_dict() | more))
    else:
        tables = [of.as_table() for of in (score, others) if of is not None]
        print("\n".join([*tables, *[NOT_CAUSAL] * offline]))
