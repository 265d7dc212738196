"""The command line ``p2p``. Thin: every command is one call into the library."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import traceback
from collections.abc import Sequence
from dataclasses import asdict
from difflib import get_close_matches
from functools import partial
from pathlib import Path

from p2p_lib import __version__
from p2p_lib.core.errors import BadInput, P2PError

EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (0 fine, 2 something to mend, 130 interrupted)."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        # The matrices are small: more threads cost time, most of all where other programs run. Set it to override.
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    arguments = _parser().parse_args(argv)
    try:
        return arguments.command(arguments) or 0
    except BrokenPipeError:  # the reader of our output (head, less) has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (P2PError, OSError) as error:  # OSError: a full disk, a folder that may not be written
        if arguments.debug:
            traceback.print_exc()
        else:
            print(f"p2p {arguments.name}: {error}", file=sys.stderr)
        return P2PError.exit_code
    except KeyboardInterrupt:
        print(f"p2p {arguments.name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def _run(a: argparse.Namespace) -> int:
    from p2p_lib.run import run

    result = run(
        a.sequence,
        a.out,
        preset=a.preset,
        config_file=a.config,
        settings=_pairs("--set", a.set, "stage.key=value"),
        seed=a.seed,
        tracker=a.tracker,
        detector=a.detector,
        masks=a.masks,
        prompts=a.prompts,
        save_masks=a.save_masks,
        format=a.format,
        depth_scale=a.depth_scale,
        objects=a.objects.split(",") if a.objects else None,
        start=a.start,
        stop=a.stop,
        models=_pairs("--models", a.models, "NAME=PATH"),
        progress=not a.quiet,
        say=partial(print, file=sys.stderr),
    )
    print("\n".join(result.summary))
    if result.evaluation is not None:
        print(result.evaluation.as_table())
        print(f"Results in {a.out}. Next: p2p eval {a.out} --json")
    else:
        print(f"Results in {a.out}; not scored, {result.not_scored}." + f" Next: p2p view {a.out}" * result.tracked)
    if result.interrupted:
        raise KeyboardInterrupt
    if result.advice:
        print(f"p2p run: {result.advice}", file=sys.stderr)
    return 0 if result.tracked else P2PError.exit_code


def _eval(a: argparse.Namespace) -> None:
    from p2p_lib.run import evaluate_poses, evaluate_run

    options = _pairs("--models", a.models, "NAME=PATH"), a.align, a.min_visible_px
    if (a.run is None) == (a.poses is None) or (a.poses is None) != (a.sequence is None):
        a.parser.error("needs either DIR, a run's folder, or --poses with --sequence")
    if a.rows:
        from p2p_lib.benchmark.rows import COLUMNS, as_csv
        from p2p_lib.benchmark.scoring import run_rows

        if a.run is None:
            a.parser.error("--rows needs DIR, a run's folder")
        print(as_csv(run_rows(a.run, options[0]), COLUMNS), end="")
        return
    if a.poses is not None:
        evaluation = evaluate_poses(a.poses, a.sequence, *options, a.format, a.start, a.stop)
    else:
        evaluation = evaluate_run(a.run, *options)
    print(json.dumps(evaluation.as_dict()) if a.json else evaluation.as_table())


def _export(a: argparse.Namespace) -> None:
    from p2p_lib.run import export_run

    for path in export_run(a.run, a.format, a.out, a.frame):
        print(path)


def _eval_masks(a: argparse.Namespace) -> None:
    from p2p_lib.run import evaluate_run_masks

    evaluation = evaluate_run_masks(a.run, a.min_visible_px)
    print(json.dumps(evaluation.as_dict()) if a.json else evaluation.as_table())


def _eval_tracks(a: argparse.Namespace) -> None:
    from p2p_lib.run import evaluate_tracker

    score = evaluate_tracker(
        a.sequence,
        a.tracker,
        seed=a.seed,
        models=_pairs("--models", a.models, "NAME=PATH"),
        count=a.queries,
        search=a.search == "masks",
        format=a.format,
        depth_scale=a.depth_scale,
        settings=_pairs("--set", a.set, "stage.key=value"),
    )
    print(json.dumps(score.as_dict()) if a.json else score.as_table())


def _click(a: argparse.Namespace) -> None:
    from p2p_lib.apps.click import collect_clicks, wait_for_clicks
    from p2p_lib.datasets.sequence import open_sequence

    _check_writable(a.out)
    sequence = open_sequence(a.sequence, a.format, a.depth_scale, a.seed)
    page = collect_clicks(sequence, a.out, a.frame, a.port)
    prompts = wait_for_clicks(page, partial(print, flush=True), not a.no_browser)
    print(f"{len(prompts)} objects in {a.out}. Next: p2p run {a.sequence} --prompts {a.out} --out DIR")


def _check_writable(path: Path) -> None:
    """Refuse a file that could not be written in the end, before anyone works for it."""
    folder = next(p for p in path.absolute().parents if p.exists())
    if path.is_dir() or not folder.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        what = "a folder" if path.is_dir() else "what cannot be written"
        raise BadInput(f"--out {path}", what, "a file in a folder that can be written")


def _live(a: argparse.Namespace) -> None:
    from p2p_lib.apps.live import LiveCount, click_first, json_line, track_live
    from p2p_lib.datasets.cameras import open_camera
    from p2p_lib.datasets.prompts import load_prompts
    from p2p_lib.run import make_config

    config = make_config(a.preset, a.config, _pairs("--set", a.set, "stage.key=value"), a.seed)
    prompts, first = load_prompts(a.prompts) if a.prompts else (), None
    backends = {"tracker": a.tracker, "detector": a.detector, "segmenter": a.masks}
    camera, count = open_camera(a.camera, a.rate), LiveCount()
    try:
        if not prompts:  # standard output is for the poses
            prompts, first = click_first(camera, lambda line: print(line, file=sys.stderr), not a.no_browser)
        track_live(
            camera,
            prompts,
            lambda estimate: print(json_line(estimate), flush=True),
            config=config,
            **{key: name for key, name in backends.items() if name},
            first=first,
            count=count,
        )
    except KeyboardInterrupt:
        pass  # how one stops a camera
    finally:
        camera.close()
    print(count, file=sys.stderr)


def _check(a: argparse.Namespace) -> int:
    from p2p_lib.apps.check import Level, as_lines, check_folder
    from p2p_lib.datasets.prompts import load_prompts

    prompts = load_prompts(a.prompts) if a.prompts else ()
    findings = check_folder(a.sequence, prompts=prompts, format=a.format, depth_scale=a.depth_scale)
    print(json.dumps([asdict(f) for f in findings]) if a.json else as_lines(findings))
    return P2PError.exit_code if any(f.level is Level.WRONG for f in findings) else 0


def _view(a: argparse.Namespace) -> None:
    if a.rerun is not None:
        from p2p_lib.figures.rerun_file import write_rerun

        print(f"Written to {write_rerun(a.run, a.rerun)}. Next: rerun {a.rerun}")
        return
    from p2p_lib.core.browser import open_page
    from p2p_lib.figures.viewer import write_page

    page = write_page(a.run, a.out)
    opened = not a.no_browser and open_page(page.resolve().as_uri())
    print(f"Written to {page}" + ("" if opened else ". Open it in a browser."))


def _synth(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.sequence import SYNTHETIC, unknown_scenario
    from p2p_lib.synthetic import SCENARIOS, describe, write_sequence

    if a.list:
        print("\n".join(f"{name:18}{re.sub('`+', '', describe(name))}" for name in SCENARIOS))
        return
    if a.scenario is None or a.out is None:
        raise BadInput("synth", "no scenario or no --out", "p2p synth SCENARIO --out DIR; p2p synth --list names them")
    if unknown := unknown_scenario(a.scenario, SCENARIOS):
        raise unknown
    out = write_sequence(a.scenario.removeprefix(SYNTHETIC), a.out, a.seed, a.noise, a.models or "", a.bop)
    print(f"Written to {out}. Next: p2p run {out} --out RUN")


def _benchmark(a: argparse.Namespace) -> int:
    from p2p_lib.benchmark import plan_names, read_plan, run_benchmarks
    from p2p_lib.core.paths import data_dir
    from p2p_lib.studies.final_tables import write_table

    if a.list:
        for name in plan_names():
            plan = read_plan(name)
            print(f"{name:24}{plan.title}" + (f" (data: {', '.join(plan.data)})" if plan.data else ""))
        print("(data: ...) is looked for below $P2P_DATA, see p2p data list; with --quick no plan needs any.")
        return 0
    if not a.plan or a.out is None:
        raise BadInput(
            "benchmark", "no plan or no --out", "p2p benchmark PLAN --out DIR; p2p benchmark --list names them"
        )
    profile = "quick" if a.quick else "full"
    lacking = [str(plan) for plan in a.plan if read_plan(plan).data] if data_dir() is None and not a.quick else []
    if lacking:
        what = f"{', '.join(lacking)}: $P2P_DATA is not set, so what needs data will not run"
        print(f"p2p benchmark: {what}. Set it (see p2p data list), or add --quick.", file=sys.stderr)
    options = {"jobs": a.jobs, "scheduler": a.scheduler, "retry": a.retry, "progress": not a.quiet}
    benchmarks = run_benchmarks(a.plan, a.out, profile, **options)
    for benchmark in benchmarks:
        counts = ", ".join(f"{count} {what}" for what, count in benchmark.counts().items())
        print(f"{write_table(benchmark)}\n{counts}. Tables in {benchmark.folder}\n")
    if any(benchmark.interrupted for benchmark in benchmarks):
        raise KeyboardInterrupt
    if any(benchmark.counts()["done"] for benchmark in benchmarks):
        return 0
    print("p2p benchmark: nothing ran; the tables say why", file=sys.stderr)
    return P2PError.exit_code


def _notebooks(a: argparse.Namespace) -> None:
    from p2p_lib.apps.notebooks import run_notebooks

    only = tuple(part for part in a.only.split(",") if part)
    run_notebooks(a.profile, only=only, jobs=a.jobs, parameters=_pairs("--parameter", a.parameter, "NAME=VALUE"))


def _data_list(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import overview

    print(overview())


def _data_info(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import describe, manifest

    print(describe(manifest(a.dataset)))


def _data_fetch(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import fetch, manifest

    for line in fetch(manifest(a.dataset), tuple(part for part in a.only.split(",") if part), not a.quiet):
        print(line, flush=True)


def _data_verify(a: argparse.Namespace) -> int:
    from p2p_lib.datasets.inventory import manifest, verify

    good = True
    for check in verify(manifest(a.dataset), a.every_frame):
        print(f"{'ok   ' if check.ok else 'WRONG'}  {check.what}: {check.text}", flush=True)
        good &= check.ok
    return 0 if good else P2PError.exit_code


def _data_where(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import where

    print(where(a.dataset))


def _data_convert_bag(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.realsense import convert_bag

    count = convert_bag(a.recording, a.out, not a.quiet)
    print(f"{count} frames in {a.out}. Next: put the masks into {a.out}/masks, then p2p run {a.out} --out DIR")


def _doctor(a: argparse.Namespace) -> int:
    from p2p_lib.apps.doctor import format_checks, run_doctor

    checks = run_doctor()
    print(format_checks(checks))
    return 0 if all(check.ok or check.optional for check in checks) else 2


def _pairs(option: str, given: list[str] | None, form: str) -> dict[str, str]:
    """``["a=1", ...]`` to ``{"a": "1", ...}``."""
    pairs = {}
    for item in given or []:
        name, equals, value = item.partition("=")
        if not (name and equals and value):
            raise BadInput(option, repr(item), form)
        pairs[name] = value
    return pairs


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the words of a command in one line, and what was meant."""

    def parse_known_args(self, args=None, namespace=None):
        if args is not None and self._subparsers is None:  # before argparse misses --out where --ouput was given
            known = list(self._option_string_actions)
            for word in args[: args.index("--") if "--" in args else None]:
                name = word.partition("=")[0]
                if re.match("--[a-z]", name) and not any(option.startswith(name) for option in known):
                    self.error(f"there is no option {name}{_meant(name, known)}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str):
        if choice := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message):
            message += _meant(choice[1], re.findall(r"[\w-]+", choice[2]))
        print(
            f"{self.prog}: {message.rstrip('.')}{'' if message.endswith('?') else '.'} See {self.prog} --help",
            file=sys.stderr,
        )
        raise SystemExit(2)


def _meant(word: str, known: list[str]) -> str:
    near = get_close_matches(word, known, n=1, cutoff=0.6)
    return f". Did you mean {near[0]}?" if near else ""


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="p2p",
        description="Point2Pose: 6D tracking and reconstruction of several unknown rigid objects in RGB-D video.",
        epilog="Start with: p2p run synthetic/crossing --out out/crossing",
    )
    parser.add_argument("--version", action="version", version=__version__)
    parser.set_defaults(debug=False)
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)

    p = _command(commands, "run", _run, "track the objects of a sequence and write poses, timings, scores")
    p.add_argument("sequence", metavar="SEQ", help="a folder, synthetic/NAME (embedded), or a name below $P2P_DATA")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    p.add_argument("--format", help="layout: ho3d, bop, ycbmultitrack, ycbineoat, folder (default: recognised)")
    p.add_argument("--depth-scale", type=float, metavar="M", help="metres per raw depth unit (default 0.001)")
    p.add_argument("--objects", metavar="A,B", help="track only these objects")
    _add_method(p)
    p.add_argument("--prompts", type=Path, metavar="FILE", help="clicks on the objects (see p2p click)")
    p.add_argument(
        "--masks",
        metavar="SOURCE",
        help="dataset, dataset:FOLDER, embedded, sam2 (default: dataset; with --prompts embedded)",
    )
    p.add_argument("--save-masks", action="store_true", help="keep the masks used as DIR/masks/OBJECT/*.png")
    p.add_argument("--start", type=int, default=0, metavar="I", help="first frame")
    p.add_argument("--stop", type=int, metavar="J", help="one past the last frame")
    p.add_argument("--models", nargs="+", action="extend", metavar="NAME=PATH", help="models for scoring")
    p.add_argument("--quiet", action="store_true", help="no progress bar")

    p = _command(commands, "eval", _eval, "score a run against the truth of its sequence")
    p.add_argument("run", type=Path, nargs="?", metavar="DIR", help="folder written by p2p run")
    p.add_argument("--poses", type=Path, metavar="PATH", help="instead: any method's poses (BOP CSV, TUM, 4x4 files)")
    p.add_argument("--sequence", metavar="SEQ", help="the sequence that --poses belongs to")
    p.add_argument("--format", help="layout of --sequence (default: recognised)")
    p.add_argument("--start", type=int, default=0, metavar="I", help="first frame of --sequence to score")
    p.add_argument("--stop", type=int, metavar="J", help="one past the last frame to score")
    p.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    p.add_argument("--rows", action="store_true", help="every number as a CSV row: all forms, Chamfer, returns")
    p.add_argument("--models", nargs="+", action="extend", metavar="NAME=PATH", help="models for scoring")
    p.add_argument(
        "--align",
        choices=("first", "all"),
        default="first",
        help="object frame fixed at the first scored frame (default), or by one constant over all",
    )
    p.add_argument("--min-visible-px", type=int, default=300, metavar="N", help="smaller masks are not scored")

    p = _command(commands, "eval-masks", _eval_masks, "score the masks that a run kept against the dataset's own")
    p.add_argument("run", type=Path, metavar="DIR", help="folder written by p2p run --save-masks")
    p.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    p.add_argument("--min-visible-px", type=int, default=300, metavar="N", help="smaller true masks are not scored")

    p = _command(commands, "eval-tracks", _eval_tracks, "score a 2D point tracker against true tracks")
    p.add_argument("sequence", metavar="SEQ", help="a folder with true poses, or synthetic/NAME (embedded)")
    p.add_argument("--tracker", default=None, metavar="NAME", help="2D point tracker (default: the embedded one)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of the queries and the tracker (default 0)")
    p.add_argument("--queries", type=int, default=256, metavar="N", help="points to follow (default 256)")
    p.add_argument(
        "--search", choices=("picture", "masks"), default="picture", help="where invisible points are sought"
    )
    p.add_argument("--models", nargs="+", action="extend", metavar="NAME=PATH", help="meshes; else by measured depth")
    p.add_argument("--format", help="layout: ycbineoat, ycbmultitrack, folder (default: recognised)")
    p.add_argument("--depth-scale", type=float, metavar="M", help="metres per raw depth unit (default 0.001)")
    p.add_argument("--set", action="append", metavar="STAGE.KEY=VALUE", help="change one parameter; repeatable")
    p.add_argument("--json", action="store_true", help="one JSON object instead of a table")

    p = _command(commands, "export", _export, "write a run's poses as BOP, TUM or a dataset keeps them")
    p.add_argument("run", type=Path, metavar="DIR", help="folder written by p2p run")
    p.add_argument("--format", required=True, choices=("bop", "tum", "poses"), help="BOP CSV, TUM, or 4x4 files")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    p.add_argument(
        "--frame",
        choices=("object", "model"),
        help="the tracker's own object frame, or the model's by the truth of the first scored frame (default for bop)",
    )

    p = _command(commands, "click", _click, "collect clicks on objects in the browser, for p2p run --prompts")
    p.add_argument("sequence", metavar="SEQ", help="a folder, or synthetic/NAME (embedded)")
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the prompts; what it holds is shown first")
    p.add_argument("--frame", type=int, default=0, metavar="I", help="frame to begin with (default 0)")
    p.add_argument("--port", type=int, default=0, metavar="N", help="of the page (default: a free one)")
    p.add_argument("--no-browser", action="store_true", help="only say where the page is")
    p.add_argument("--format", help="layout (default: recognised)")
    p.add_argument("--depth-scale", type=float, metavar="M", help="metres per raw depth unit (default 0.001)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of a synthetic sequence (default 0)")

    p = _command(commands, "live", _live, "track objects before a camera; a line of JSON per object and frame")
    p.add_argument("--camera", required=True, metavar="CAM", help="realsense, realsense:RECORDING or folder:PATH")
    p.add_argument("--rate", type=float, metavar="HZ", help="frames per second of folder:PATH (default 30)")
    p.add_argument("--prompts", type=Path, metavar="FILE", help="clicks; without, the first picture is clicked on")
    p.add_argument("--masks", metavar="NAME", help="segmenter: embedded (default) or sam2")
    _add_method(p)
    p.add_argument("--no-browser", action="store_true", help="only say where the page to click on is")

    p = _command(commands, "check", _check, "look at data of your own: what is wrong with it and what to do")
    p.add_argument("sequence", metavar="FOLDER", help="rgb/ depth/ cam_K.txt masks/, or any sequence")
    p.add_argument("--prompts", type=Path, metavar="FILE", help="clicks, where there are no masks")
    p.add_argument("--format", help="layout (default: recognised)")
    p.add_argument("--depth-scale", type=float, metavar="M", help="metres per raw depth unit (default 0.001)")
    p.add_argument("--json", action="store_true", help="a JSON list instead of lines")

    p = _command(commands, "view", _view, "look at a run in 3D with a time slider, in the browser")
    p.add_argument("run", type=Path, metavar="DIR", help="folder written by p2p run")
    p.add_argument("--out", type=Path, metavar="FILE", help="the page (default DIR/view.html); it needs nothing else")
    p.add_argument("--rerun", type=Path, metavar="FILE", help="instead: a Rerun recording, with video and tracks")
    p.add_argument("--no-browser", action="store_true", help="write the page, do not open it")

    p = _command(commands, "synth", _synth, "render a synthetic sequence in the YCBMultiTrack layout, with exact truth")
    p.add_argument("scenario", nargs="?", metavar="SCENARIO", help="what happens; --list shows all")
    p.add_argument("--list", action="store_true", help="list the scenarios")
    p.add_argument("--out", type=Path, metavar="DIR", help="a new folder for the sequence")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of labels, paths and noise (default 0)")
    p.add_argument("--noise", default="realsense", metavar="NAME", help="exact, realsense (default) or hard")
    p.add_argument("--models", type=Path, metavar="DIR", help="YCB models for the ycb_ scenarios (default: stand-ins)")
    p.add_argument("--bop", action="store_true", help="write a BOP scene besides, in DIR/bop")

    p = _command(commands, "benchmark", _benchmark, "run methods on sequences with seeds as a plan says; resumes")
    p.add_argument("plan", nargs="*", metavar="PLAN", help="TOML files, or names that --list shows")
    p.add_argument("--list", action="store_true", help="list the plans of the paper's tables and of the README")
    p.add_argument("--out", type=Path, metavar="DIR", help="runs, records and tables; several plans may share it")
    p.add_argument("--quick", action="store_true", help="a few frames of embedded data instead of the plan in full")
    p.add_argument("--jobs", type=int, metavar="N", help="runs at a time on this machine (default: one a core)")
    p.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="of a Dask cluster whose workers see DIR, too")
    p.add_argument("--retry", action="store_true", help="try again what failed before")
    p.add_argument("--quiet", action="store_true", help="no progress bar")

    p = _command(commands, "notebooks", _notebooks, "run the notebooks headless and collect their results")
    p.add_argument("--profile", choices=("quick", "full"), default="quick", help="size of the job (default quick)")
    p.add_argument("--only", default="", metavar="00,03", help="only these notebooks")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="notebooks at a time")
    p.add_argument("--parameter", action="append", metavar="NAME=VALUE", help="change a notebook parameter; repeatable")

    p = commands.add_parser("data", help="datasets and checkpoints: what they are, where, whether whole")
    data = p.add_subparsers(metavar="ACTION", required=True, parser_class=_Parser)
    _command(data, "list", _data_list, "list every dataset and checkpoint that is known")
    p = _command(data, "info", _data_info, "say what a dataset is, its licence and how to get it")
    p.add_argument("dataset", metavar="NAME")
    p = _command(data, "fetch", _data_fetch, "download into $P2P_DATA, check and unpack; unpack what was had by hand")
    p.add_argument("dataset", metavar="NAME")
    p.add_argument("--only", default="", metavar="PART,PART", help="only the files whose names contain one of these")
    p.add_argument("--quiet", action="store_true", help="no progress bar")
    p = _command(data, "verify", _data_verify, "check what is on disk: checksums, sequences, frames, truth")
    p.add_argument("dataset", metavar="NAME")
    p.add_argument("--every-frame", action="store_true", help="read every picture, not only the first and the last")
    p = _command(data, "convert-bag", _data_convert_bag, "turn a RealSense recording into a folder for p2p run")
    p.add_argument("recording", type=Path, metavar="FILE", help="a .bag (or .db3)")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    p.add_argument("--quiet", action="store_true", help="no progress bar")
    p = _command(data, "where", _data_where, "print the folder of a dataset, checkpoint or sequence")
    p.add_argument("dataset", metavar="NAME")

    _command(commands, "doctor", _doctor, "check this installation and say how to mend it")
    return parser


def _add_method(p: argparse.ArgumentParser) -> None:
    """Which method with which parameters: what everything that tracks lets one choose."""
    p.add_argument("--preset", default=None, help="paper or default: parameters only, never backends")
    p.add_argument("--config", type=Path, metavar="FILE", help="TOML file with [stage] key = value")
    p.add_argument("--set", action="append", metavar="STAGE.KEY=VALUE", help="change one parameter; repeatable")
    p.add_argument("--tracker", default=None, metavar="NAME", help="2D point tracker (default: the embedded one)")
    p.add_argument("--detector", default=None, metavar="NAME", help="source of new points (default: corners)")
    p.add_argument("--seed", type=int, default=None, metavar="N", help="of every random choice (default 0)")


def _command(commands, name: str, function, help: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.set_defaults(command=function, parser=parser, name=parser.prog.partition(" ")[2])
    return parser


if __name__ == "__main__":
    sys.exit(main())
