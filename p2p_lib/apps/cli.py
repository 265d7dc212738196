"""The commands of ``p2p`` that track, score and show; those for data are in :mod:`p2p_lib.apps.data_commands`.

Each is declared where it is carried out, by one call into the library.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import fields, replace
from functools import partial
from itertools import chain
from pathlib import Path
from shlex import quote
from shutil import get_terminal_size
from textwrap import fill
from typing import Any

from p2p_lib.apps.command_line import (
    JSON,
    NO_BROWSER,
    QUIET,
    SEQUENCE,
    again,
    arg,
    as_it_began,
    command,
    main,
    open_page,
    output,
    run_options,
    typed_options,
    warn,
)
from p2p_lib.core.errors import BadInput, MissingData, P2PError
from p2p_lib.core.files import check_new
from p2p_lib.core.options import RunOptions, differing, lengths_m, names, pairs
from p2p_lib.core.progress import waiting_for
from p2p_lib.offline import NOT_CAUSAL, PRODUCTS

#: Options that choose the method and its parameters.
METHOD = ("preset", "config_file", "settings", "seed", "device", "tracker", "detector")
_RUN = arg("run", type=Path, metavar="DIR", help="folder written by p2p run")
_FILES = (
    "poses as bop: p2p_SEQ-test.csv; tum: OBJECT.txt; poses: annotated_poses/OBJECT/FRAME.txt, 4x4 (all in DIR);"
    " bop-dataset: labelled images, masks and models; foundationpose: images, first mask, mesh; model: textured meshes"
)
_OVERLAY = output(
    "FILE", "besides a film of it: .mp4, or a .gif or .webp at most 480 px wide (see p2p film)", "--overlay"
)
_FORCE = arg("--force", dest="if_exists", action="store_const", const="replace", help="replace an earlier run in DIR")
_MIN_VISIBLE = arg("--min-visible-px", type=int, default=300, metavar="N", help="smaller true masks are not scored")


# --- tracking ------------------------------------------------------------------------------------


@command(
    "run",
    "track the objects of a sequence and write poses, timings, scores",
    arg(
        "sequence",
        nargs="?",
        metavar="SEQ",
        help="a folder, synthetic/NAME or NAME@SEED (bundled), or a name below $P2P_DATA",
    ),
    arg(
        "--batch",
        type=Path,
        metavar="FOLDER",
        help="instead of SEQ: every recording in it, each into DIR/NAME; resumes; exit code 2 if one could not be run",
    ),
    arg("--jobs", type=int, metavar="N", help="recordings of --batch at a time (default: one a core)"),
    arg("--scheduler", metavar="tcp://HOST:PORT", help="for --batch: a Dask cluster that sees DIR"),
    output("DIR", "folder for the results", required=True),
    _FORCE,
    arg(
        "--resume",
        dest="if_exists",
        action="store_const",
        const="resume",
        help="go on with one that was cut short, as it began",
    ),
    arg(
        "--from",
        dest="redo_from",
        type=int,
        metavar="N",
        help="with --resume: go on from frame N, say with new prompts",
    ),
    typed_options,
    _OVERLAY,
    QUIET,
)
def _run(a: argparse.Namespace) -> int:
    if (a.sequence is None) == (a.batch is None):
        a.parser.error("needs either SEQ or --batch FOLDER")
    if a.batch is not None and (a.if_exists == "replace" or a.overlay is not None):
        word, fix = ("--force", "another --out") if a.overlay is None else ("--overlay", "p2p film DIR/NAME afterwards")
        a.parser.error(f"{word} does not go with --batch, which goes on with what is in DIR: {fix}")
    if a.batch is None and (a.jobs is not None or a.scheduler is not None):
        a.parser.error("--jobs and --scheduler go with --batch FOLDER: one recording is one job")
    if a.redo_from is not None and (a.batch is not None or a.if_exists != "resume"):
        a.parser.error("--from goes with --resume, and with SEQ")
    options = _asked(a, a.out if a.batch is None and a.if_exists == "resume" else None)
    with waiting_for("Loading libraries", not a.quiet):
        from p2p_lib.datasets.first_masks import FILE as FIRST_MASKS
        from p2p_lib.datasets.runs import read_info
        from p2p_lib.evaluation.known_size import lengths, that_fit
        from p2p_lib.run import run
    if a.batch is not None:
        from p2p_lib.benchmark.batch import TABLE, run_batch
        from p2p_lib.core.tables import as_text

        _check_as_before(a.batch, a.out, options)
        table = run_batch(a.batch, a.out, options, a.jobs, a.scheduler, not a.quiet, warn)
        print(f"{as_text(table)}\nResults in {a.out}, the table in {a.out / TABLE}")
        if failed := int(table["object"].isna().sum()):
            warn(
                f"p2p run: {failed} of {table['recording'].nunique()} recordings could not be run; the table says why."
            )
        return P2PError.exit_code if failed else 0
    film = _film_wanted(a.overlay)
    options = replace(options, save_masks=options.save_masks or film is not None)
    how = {"if_exists": a.if_exists or "refuse", "redo_from": a.redo_from, "progress": not a.quiet, "say": warn}
    result = run(a.sequence, a.out, options, **how)
    known_m = lengths_m(options.sizes, options.sizes or ())
    print("\n".join([*result.summary, *that_fit(lengths(a.out, known_m)), *_without_map(a.out)]))
    if result.look_at:
        title = "What to look at before it is believed, by some of the images (p2p eval takes more of them):"
        print("\n".join([title, *(f"  {line}" for line in result.look_at)]))
    first = a.out / FIRST_MASKS
    results = f"Results in {a.out}" + f", first masks in {first}" * first.is_file()
    if result.evaluation is not None:
        print(result.evaluation.as_table())
    elif a.out.is_dir():
        results += f"; not scored, {_reason(result.not_scored, a.out)}"
    if a.out.is_dir():
        print(f"{results}." + f" Next: p2p view {a.out}" * result.tracked)
    if film is not None and not result.interrupted:
        print(f"Film in {film(a.out, a.overlay)}")
    if result.interrupted:
        info = read_info(a.out)  # none where no frame was finished
        raise KeyboardInterrupt("" if info is None else f"Go on with it: {again(info, a.out)} --resume")
    if result.advice:
        warn(f"p2p run: {result.advice}")
    return 0 if result.tracked else P2PError.exit_code


def _check_as_before(folder: Path, out: Path, options: RunOptions) -> None:
    """Refuse a batch that asks otherwise than its runs began: none would go on, and the table would lose their rows."""
    from p2p_lib.benchmark.batch import recordings
    from p2p_lib.datasets.runs import read_info

    for one in recordings(folder, options):
        try:
            info = read_info(out / one.key) or {"frames": 0}
        except P2PError:  # its row will say why
            continue
        asked = info.get("options") or {}, one.options.as_dict()
        was, now = differing(*({**of, "skip_bad": None} for of in asked))
        if info["frames"] and now:
            fix = "Ask for the same, or name another --out. Nothing was run, and the table is as it was."
            raise BadInput(f"{out / one.key}: the run to go on with", now, f"{was}, as it began", fix)


def _without_map(run: Path) -> list[str]:
    """A line for each object of which too little was learnt for a map, with the reason."""
    from p2p_lib.datasets.runs import read_info

    without = (read_info(run) or {}).get("without_map") or {}
    return [f"{name}: no map was kept, by which --memory would find it: {why}" for name, why in without.items()]


@command(
    "live",
    "track objects before a camera; a line of JSON per object and frame, on a terminal with --out a readable one",
    arg("--camera", required=True, metavar="CAM", help="realsense, realsense:RECORDING, folder:PATH or module:Class"),
    arg("--rate", type=float, metavar="HZ", help="frames per second of folder:PATH (default 30)"),
    arg("--backlog", type=int, metavar="N", help="images that may wait while one takes long (default 4)"),
    run_options(
        *METHOD,
        "memory",
        "frozen",
        prompts="clicks; without and without --memory, the first image is clicked on",
        masks="segmenter (default: builtin)",
        stop="end before the camera's J-th image (default: Ctrl-C)",
    ),
    arg("--to", metavar="URL", help="send the lines to tcp://HOST:PORT or udp://HOST:PORT, not to standard output"),
    arg(
        "--listen",
        action="store_true",
        help="lines of JSON on standard input add, correct and remove objects; their frame is the next one",
    ),
    arg("--click", action="store_true", help="a page on the newest image adds, corrects and removes objects"),
    output("DIR", "folder that keeps the run, as p2p run does"),
    _FORCE,
    _OVERLAY,
    NO_BROWSER,
)
def _live(a: argparse.Namespace) -> None:
    from p2p_lib.apps.click import invite
    from p2p_lib.apps.live import LiveCount, click_first, json_line, segmenter_of, text_line, track_live
    from p2p_lib.apps.live_click import LiveClicker
    from p2p_lib.apps.live_words import Words, outlet
    from p2p_lib.core.voxels import check_device
    from p2p_lib.datasets.cameras import open_camera
    from p2p_lib.datasets.prompts import load_prompts
    from p2p_lib.datasets.run_writer import look_into

    options, count, first = _asked(a), LiveCount(), None
    check_device(options.config().device)  # what does not fit is said before the camera starts
    segmenter_of(options)
    _film_wanted(a.overlay)
    keep = {"count": count, "out": a.out, "overlay": a.overlay, "if_exists": a.if_exists or "refuse"}
    keep["say"] = warn
    keep |= {} if a.backlog is None else {"backlog": a.backlog}
    if a.out is not None:
        look_into(a.out, keep["if_exists"])  # before anyone clicks
    prompts = load_prompts(a.prompts) if a.prompts else ()
    camera = open_camera(a.camera, a.rate)
    try:
        if not (prompts or options.memory or a.listen or a.click):
            prompts, first = click_first(camera, warn, not a.no_browser)
        line = text_line if a.out is not None and sys.stdout.isatty() else json_line
        with ExitStack() as opened:
            send = opened.enter_context(outlet(a.to, warn)) if a.to else partial(print, flush=True)
            if a.listen or a.click:
                keep["words"] = words = Words(sys.stdin if a.listen else None, lambda error: warn(f"p2p live: {error}"))
            if a.click:
                keep["page"] = page = opened.enter_context(LiveClicker(camera, words))
                invite(page, warn, not a.no_browser)
            track_live(camera, prompts, lambda estimate: send(line(estimate)), options, first=first, **keep)
    except KeyboardInterrupt:
        pass  # how one stops a camera
    finally:
        camera.close()
    warn("\n".join([str(count), *(_without_map(a.out) if a.out is not None else ())]))


# --- scoring -------------------------------------------------------------------------------------


@command(
    "eval",
    "score a run against the truth of its sequence; without any, against what the camera saw",
    arg("run", type=Path, nargs="?", metavar="DIR", help="folder written by p2p run"),
    arg(
        "--poses",
        type=Path,
        metavar="PATH",
        help="instead, to score another method: its BOP CSV or TUM file, or a folder of OBJECT.txt or of 4x4 files",
    ),
    arg("--sequence", metavar="SEQ", help="the sequence that --poses belongs to"),
    run_options("start", "stop", "models", "sizes", format="layout of --sequence (default: recognised)"),
    JSON,
    arg("--rows", action="store_true", help="every number as a CSV row: all forms, Chamfer, returns"),
    arg("--align", choices=("first", "all"), default="first", help="object frame: by the first scored frame, or all"),
    _MIN_VISIBLE,
)
def _eval(a: argparse.Namespace) -> None:
    options = RunOptions.of_arguments(a)
    if a.run is not None and a.sequence is not None and a.poses is None:
        a.parser.error(f"DIR and --sequence do not go together: --poses {a.run / 'poses'} --sequence {a.sequence}")
    if (a.run is None) == (a.poses is None) or (a.poses is None) != (a.sequence is None):
        a.parser.error("needs either DIR, a run's folder, or --poses with --sequence")
    if a.rows and a.run is None:
        a.parser.error("--rows needs DIR, a run's folder")
    if a.rows:
        from p2p_lib.benchmark.rows import COLUMNS, as_csv
        from p2p_lib.benchmark.scoring import run_rows
        from p2p_lib.datasets.runs import read_info

        rows = run_rows(a.run, options.models)
        rows = [row | {"plan": "offline run"} for row in rows] if (read_info(a.run) or {}).get("offline") else rows
        print(as_csv(rows, COLUMNS), end="")
    elif a.poses is not None:
        from p2p_lib.run import evaluate_poses

        how: dict[str, Any] = {"format": options.format, "start": options.start, "stop": options.stop}
        _show(evaluate_poses(a.poses, a.sequence, options.models, a.align, a.min_visible_px, **how), a.json)
    else:
        _eval_run(a, options)


def _eval_run(a: argparse.Namespace, options: RunOptions) -> None:
    """Against the truth; where there is none, or no model, against what the camera saw."""
    from p2p_lib.datasets.mask_log import FILE as MASK_LOG
    from p2p_lib.datasets.models import given_models
    from p2p_lib.datasets.runs import load_run
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
            not_scored = _reason(str(error), a.run)
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
    if not (score or a.json or (a.run / MASK_LOG).is_file()):
        then = f"Next: {again(run.info, a.run)} --force"
        warn(f"p2p eval: where seen and mask IoU are empty, because no {MASK_LOG} was kept. {then}")


@command("eval-masks", "score the masks that a run kept against the dataset's own", _RUN, JSON, _MIN_VISIBLE)
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
    arg("--stale", action="store_true", help="what of figures/ is of earlier code: marked so, with --out made anew"),
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
        raise KeyboardInterrupt
    ended = [benchmark.counts() for benchmark in benchmarks]
    if failed := sum(count["failed"] for count in ended):
        warn(f"p2p benchmark: {failed} runs failed; the tables say why. --retry tries them again.")
        return P2PError.exit_code
    if any(count["done"] for count in ended):
        return 0
    warn("p2p benchmark: nothing ran; the tables say why")
    return P2PError.exit_code


def _stale(a: argparse.Namespace) -> int:
    """What of the figures of a clone is of earlier code is listed, says so itself, and is made anew."""
    from p2p_lib.apps.clone import study
    from p2p_lib.core.paths import figure_dir
    from p2p_lib.core.tables import as_text

    anew, folder = study("anew"), figure_dir()
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
    arg("--only", metavar="fig1_three_objects,runtime", help="these pictures alone, by their names"),
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
    from p2p_lib.benchmark import run_benchmarks
    from p2p_lib.core.paths import benchmark_dir, figure_dir

    figures = study("paper_figures")
    drawn = figures.picked(names(a.only) or ())  # what does not fit is said before anything runs
    (runs,) = run_benchmarks([figures.PLAN], a.out or benchmark_dir("full"), progress=not a.quiet)
    if runs.interrupted:
        raise KeyboardInterrupt
    for saved in figures.draw_all(runs, a.figures or figure_dir(), drawn, a.poses):
        print(saved.path)


@command(
    "refine",
    "go over a finished run with the whole video; its better poses and surfaces go to DIR/offline",
    _RUN,
    arg("--force", action="store_true", help="also where DIR/offline is of the same poses and code already"),
    QUIET,
)
def _refine(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.runs import OFFLINE
    from p2p_lib.offline.refine import refine_run

    try:
        print("\n".join(refine_run(a.run, not a.quiet, a.force)))
    except KeyboardInterrupt:
        then = f"Go on: p2p refine {quote(str(a.run))}; it keeps the objects that are finished."
        raise KeyboardInterrupt(then) from None
    print(f"Results in {a.run / OFFLINE}. Next: p2p eval {a.run / OFFLINE}")


# --- looking and handing on ----------------------------------------------------------------------


@command(
    "export",
    "write a run's poses as BOP, TUM or a dataset keeps them, a labelled dataset, or textured models",
    _RUN,
    arg("--format", required=True, choices=("bop", "tum", "poses", *PRODUCTS), help=_FILES),
    output("DIR", "a new or empty folder for the files", required=True),
    arg("--frame", choices=("object", "model"), help="the tracker's (bop without truth needs it) or the model's"),
    arg("--min-confidence", type=float, metavar="C", help="leave less confident poses out (default 0, of labels 0.5)"),
    arg("--faces", type=int, default=5000, metavar="N", help="of a textured model, at most (default 5000)"),
    QUIET,
)
def _export(a: argparse.Namespace) -> None:
    from p2p_lib.offline.products import marked, write_product

    if a.format in PRODUCTS:
        print(write_product(a.run, a.format, a.out, a.min_confidence, a.faces, not a.quiet))
        return
    from p2p_lib.offline.finished import load_posed
    from p2p_lib.run import export_run

    check_new(a.out)
    least = a.min_confidence or 0.0
    run = load_posed(a.run, least)
    written = export_run(a.run, a.format, a.out, a.frame, least)
    written = [marked(path) for path in written] if run.info.get("offline") else written
    files = (f"{path}/*.txt ({len(list(path.iterdir()))})" if path.is_dir() else str(path) for path in written)
    print(f"Written: {', '.join(files)}")


@command(
    "view",
    "look at a run in 3D with a time slider, in the browser",
    _RUN,
    output("FILE", "the page (default DIR/view.html); it needs nothing else"),
    NO_BROWSER,
)
def _view(a: argparse.Namespace) -> None:
    from p2p_lib.figures.viewer import write_page

    page = write_page(a.run, a.out)
    opened = not a.no_browser and open_page(page.resolve().as_uri())
    print(f"Written to {page}" + ("" if opened else ". Open it in a browser."))


@command(
    "film",
    "write a run as a film: boxes, axes, statuses, keypoints, masks",
    _RUN,
    output("FILE", ".mp4, .gif or .webp (default DIR/film.mp4)"),
    arg("--width", type=int, metavar="PX", help="of its images (default: the camera's, at most 480 of a GIF or WebP)"),
    arg("--surfaces", action="store_true", help="outline each reconstructed surface at its pose, in white"),
)
def _film(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.runs import read_info
    from p2p_lib.figures.film import write_film

    how = {"width_px": a.width, "progress": True, "surfaces": a.surfaces}
    print(f"Written to {write_film(a.run, a.out or a.run / 'film.mp4', **how)}")
    info = read_info(a.run) or {}
    if info.get("masks") != "dataset" and not (a.run / info.get("masks_in", "") / "masks").is_dir():
        warn("p2p film: no masks were kept, so none is outlined. p2p run --save-masks keeps them.")


@command(
    "notebooks",
    "run the notebooks headless and collect their results",
    arg("--profile", choices=("quick", "full"), default="quick", help="size of the job (default quick)"),
    arg("--only", metavar="00,03", help="only these notebooks"),
    arg("--jobs", type=int, default=1, metavar="N", help="notebooks at a time"),
    arg("--parameter", action="append", metavar="NAME=VALUE", help="change a notebook parameter; repeatable"),
    output("DIR", "folder of results (default out/PROFILE; with --parameter beside it)"),
)
def _notebooks(a: argparse.Namespace) -> None:
    from p2p_lib.apps.clone import study

    parameters = pairs(a.parameter or (), "--parameter", "NAME=VALUE")
    how = {"only": names(a.only) or (), "jobs": a.jobs, "parameters": parameters, "out": a.out}
    study("runner").run_notebooks(a.profile, **how)


def _asked(a: argparse.Namespace, goes_on: Path | None = None) -> RunOptions:
    """The options of something that is tracked; one without what it is about is refused.

    goes_on  the folder of a run that is resumed, if there is one: what was left out is as it began
    """
    options = RunOptions.of_arguments(a)
    info = None
    if goes_on is not None:
        from p2p_lib.datasets.runs import read_info

        info = read_info(goes_on)
    if info is not None:
        typed = [option.name for option in fields(RunOptions) if hasattr(a, option.name)]
        options = as_it_began(info, **{name: getattr(options, name) for name in typed})
        if taken := replace(options, **{name: getattr(RunOptions(), name) for name in typed}).words():
            warn(f"p2p run: left out, and taken from the run in {goes_on}: {' '.join(taken)}")
    if options.frozen and not options.memory:
        a.parser.error("--frozen keeps the maps of --memory as they are: give --memory PATH, or leave it out")
    return options


def _reason(not_scored: str, folder: Path) -> str:
    """Why a run is not scored, behind words that say already which run, and that it is not."""
    return not_scored.removeprefix(f"{folder}: nothing to score: ")


def _film_wanted(path: Path | None) -> Callable[..., Path] | None:
    """What writes the film of a run, if one is wanted; a name that it cannot have is refused at once."""
    if path is None:
        return None
    from p2p_lib.figures.film import check_suffix, write_film

    check_suffix(path)
    return write_film


def _show(score: Any, as_json: bool, offline: bool = False, others: Any = None) -> None:
    """A score, and what is said of the ``others``, objects that it is not of."""
    if as_json:
        more = ({"others": others.as_dict()} if others else {}) | ({"offline": True} if offline else {})
        print(json.dumps(score.as_dict() | more))
    else:
        tables = [of.as_table() for of in (score, others) if of is not None]
        print("\n".join([*tables, *[NOT_CAUSAL] * offline]))


from p2p_lib.apps import data_commands  # noqa: E402, F401 - declared, and listed by --help, after those above

if __name__ == "__main__":
    sys.exit(main())
