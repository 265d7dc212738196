"""The commands of ``p2p`` that track: ``run``, ``live``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

from p2p_lib.apps.command_line import (
    NO_BROWSER,
    QUIET,
    again,
    arg,
    as_it_began,
    command,
    output,
    run_options,
    typed_options,
    unscored,
    warn,
)
from p2p_lib.core.errors import BadInput, MissingData, P2PError
from p2p_lib.core.options import RunOptions, differing, lengths_m, located
from p2p_lib.core.progress import waiting_for

#: Options that choose the method and its parameters.
METHOD = ("preset", "config_file", "settings", "seed", "device", "tracker", "detector")
_OVERLAY = output(
    "FILE", "besides a film of it: .mp4, or a .gif or .webp at most 480 px wide (see p2p film)", "--overlay"
)
_FORCE = arg("--force", dest="if_exists", action="store_const", const="replace", help="replace an earlier run in DIR")


@command(
    "run",
    "track the objects of a sequence and write poses, timings, scores",
    arg(
        "sequence",
        nargs="?",
        metavar="SEQ",
        help="a folder, synthetic/NAME or NAME@SEED (bundled), or a name below $P2P_DATA (with --resume: as it began)",
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
    if a.sequence is None and a.batch is None and a.if_exists == "resume":
        a.sequence = _sequence_of(a.out)
        if a.sequence is None:
            raise MissingData(str(a.out), "no run there to go on with", "Name its folder, or what to run: p2p run SEQ")
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
        title = "What to look at before it is believed, by some of the images:"
        print("\n".join([title, *(f"  {line}" for line in said_once(result.look_at))]))
    elif result.tracked:
        print("Nothing is suspicious by some of the images.")
    first = a.out / FIRST_MASKS
    results = f"Results in {a.out}" + f", first masks in {first}" * first.is_file()
    if result.evaluation is not None:
        print(result.evaluation.as_table())
    elif a.out.is_dir():
        results += f"; not scored, {unscored(result.not_scored, a.out)}"
    if a.out.is_dir():
        following = [f"Next: p2p view {a.out}"] * result.tracked
        if result.unstarted or (result.look_at and options.save_masks):
            where = f" ({', '.join(result.unstarted)} never started)" if result.unstarted else ""
            following.append(f"where a mask is wrong{where}: p2p click {a.sequence} --run {a.out} --out prompts.json")
        print(f"{results}. {'; '.join(following)}".rstrip())
    if film is not None and not result.interrupted:
        print(f"Film in {film(a.out, a.overlay)}")
    if result.interrupted:
        info = read_info(a.out)  # none where no frame was finished
        raise KeyboardInterrupt("" if info is None else f"Go on with it: {again(info, a.out)} --resume")
    if result.advice:
        warn(f"p2p run: {result.advice}")
    return 0 if result.tracked else P2PError.exit_code


def said_once(lines: Iterable[str]) -> list[str]:
    """What is said of objects, what is said of several in one line.

    >>> said_once(["cup: far away", "can: blurred", "can: far away"])
    ['cup, can: far away', 'can: blurred']
    """
    names: dict[str, list[str]] = {}
    for name, _, text in (line.partition(": ") for line in lines):
        names.setdefault(text, []).append(name)
    return [f"{', '.join(of)}: {text}" for text, of in names.items()]


def _check_as_before(folder: Path, out: Path, options: RunOptions) -> None:
    """Refuse a batch that asks otherwise than its runs began: none would go on, and the table would lose their rows."""
    from p2p_lib.benchmark.batch import recordings
    from p2p_lib.datasets.runs import read_info

    for one in recordings(folder, options):
        try:
            info = read_info(out / one.key) or {"frames": 0}
        except P2PError:  # its row will say why
            continue
        asked = info.get("options") or {}, located(one.options.as_dict(), one.folder)
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
        "sizes",
        prompts="clicks; without and without --memory, the first image is clicked on",
        masks="segmenter (default: builtin)",
        stop="end before the camera's J-th image (default: Ctrl-C)",
    ),
    arg(
        "--min-confidence",
        type=float,
        metavar="C",
        help="poses of no more confidence are null in the lines (0.5: all that are doubted; default: none)",
    ),
    arg("--to", metavar="URL", help="send the lines to tcp://HOST:PORT or udp://HOST:PORT, not to standard output"),
    arg(
        "--listen",
        action="store_true",
        help="lines of JSON on standard input add, correct and remove objects, in the next frame or the one they name",
    ),
    arg("--click", action="store_true", help="a page on the newest image adds, corrects and removes objects"),
    output("DIR", "folder that keeps the run, as p2p run does"),
    _FORCE,
    _OVERLAY,
    NO_BROWSER,
)
def _live(a: argparse.Namespace) -> None:
    from p2p_lib.apps.click import invite
    from p2p_lib.apps.live import LiveCount, LiveOptions, click_first, json_line, segmenter_of, text_line, track_live
    from p2p_lib.apps.live_click import LiveClicker
    from p2p_lib.apps.live_words import Words, outlet
    from p2p_lib.core.voxels import check_device
    from p2p_lib.datasets.cameras import open_camera
    from p2p_lib.datasets.prompts import load_prompts
    from p2p_lib.datasets.run_writer import look_into
    from p2p_lib.offline.finished import check_confidence

    options, count = _asked(a), LiveCount()
    check_device(options.config().device)  # what does not fit is said before the camera starts
    segmenter_of(options)
    check_confidence(a.min_confidence or 0.0)
    lengths_m(options.sizes, options.sizes or ())
    _film_wanted(a.overlay)
    live = LiveOptions(out=a.out, overlay=a.overlay, if_exists=a.if_exists or "refuse", say=warn)
    live = live if a.backlog is None else replace(live, backlog=a.backlog)
    if a.out is not None:
        look_into(a.out, live.if_exists, resumable=False)  # before anyone clicks
    prompts = load_prompts(a.prompts) if a.prompts else ()
    camera = open_camera(a.camera, a.rate)
    try:
        if not (prompts or options.memory or a.listen or a.click):
            prompts, first = click_first(camera, warn, not a.no_browser)
            live = replace(live, first=first)
        line = text_line if a.out is not None and sys.stdout.isatty() else json_line
        if a.min_confidence is not None:
            line = partial(line, least=a.min_confidence)
        with ExitStack() as opened:
            send = opened.enter_context(outlet(a.to, warn)) if a.to else partial(print, flush=True)
            if a.listen or a.click:
                words = Words(sys.stdin if a.listen else None, lambda error: warn(f"p2p live: {error}"))
                page = opened.enter_context(LiveClicker(camera, words)) if a.click else None
                live = replace(live, words=words, page=page)
            if live.page is not None:
                invite(live.page, warn, not a.no_browser)
            track_live(camera, prompts, lambda estimate: send(line(estimate)), options, live, count)
    except KeyboardInterrupt:
        pass  # how one stops a camera
    finally:
        camera.close()
    warn("\n".join([str(count), *(_without_map(a.out) if a.out is not None else ())]))


def _sequence_of(out: Path) -> str | None:
    """What the run in a folder is of, in the words of who made it; None where there is no run."""
    from p2p_lib.datasets.runs import read_info

    info = read_info(out)
    return None if info is None else info["path"] or info["sequence"]


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


def _film_wanted(path: Path | None) -> Callable[..., Path] | None:
    """What writes the film of a run, if one is wanted; a name that it cannot have is refused at once."""
    if path is None:
        return None
    from p2p_lib.figures.film import check_suffix, write_film

    check_suffix(path)
    return write_film
