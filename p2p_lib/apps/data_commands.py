"""The commands of ``p2p`` for clicks, data of one's own, datasets and checkpoints, parameters, and the installation."""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import asdict
from functools import partial
from pathlib import Path

from p2p_lib.apps.command_line import JSON, NO_BROWSER, QUIET, SEQUENCE, again, arg, command, output, run_options, warn
from p2p_lib.core.errors import BadInput, P2PError
from p2p_lib.core.options import RunOptions, names

_DATASET = arg("dataset", metavar="NAME")
_POSE_LOG = "time_s tx ty tz qx qy qz qw a line (TUM or CSV)"


@command(
    "click",
    "collect clicks on objects, and masks painted with a brush, in the browser, for p2p run --prompts",
    SEQUENCE,
    output("FILE", "the prompts; what it holds is shown first", required=True),
    arg("--frame", type=int, default=0, metavar="I", help="frame to begin with (default 0)"),
    arg("--run", type=Path, metavar="DIR", help="show the masks that a run kept (--save-masks), to be mended"),
    arg("--port", type=int, default=0, metavar="N", help="of the page (default: a free one)"),
    NO_BROWSER,
    run_options("format", "depth_scale"),
)
def _click(a: argparse.Namespace) -> None:
    from p2p_lib.apps.click import Clicker, first_change, wait_for_clicks
    from p2p_lib.datasets.runs import load_run
    from p2p_lib.datasets.sequence import open_sequence

    sequence = open_sequence(a.sequence, a.format, a.depth_scale, gaps=True)  # p2p run --skip-bad needs prompts, too
    shown = load_run(a.run) if a.run is not None else None
    if shown is not None and (of := shown.info["sequence"]) != sequence.name:
        warn(f"p2p click: {a.run} is a run of {of}, not of {sequence.name}: is it the right one?")
    if shown is not None and shown.info["masks"] != "dataset" and not shown.mask_folder.is_dir():
        warn(f"p2p click: {a.run} kept no masks, so none are shown: p2p run --save-masks keeps them")
    page = Clicker(sequence, a.out, a.frame, a.port, shown)
    before = page.prompts
    prompts = wait_for_clicks(page, partial(print, flush=True), not a.no_browser)
    changed = first_change(before, prompts)
    if shown is None or changed is None:
        print(
            f"Prompts in {a.out}: {len(prompts)}. Next: p2p run {a.sequence} --prompts {a.out} --save-masks --out DIR"
        )
    else:
        how = f"--resume --from {changed}" if changed > shown.info["start"] else "--force"
        words = again(shown.info, a.run, prompts=str(a.out), save_masks=True)
        print(f"Prompts in {a.out}: {len(prompts)}, the first new one in frame {changed}. Next: {words} {how}")


@command(
    "check",
    "look at data of your own: what is wrong with it and what to do",
    arg("sequence", metavar="FOLDER", help="rgb/ depth/ cam_K.txt masks/, or any sequence"),
    run_options("format", "depth_scale", "sizes", prompts="clicks, where there are no masks"),
    output("FILE.png", "a picture of the first masks, which a run would begin with"),
    JSON,
)
def _check(a: argparse.Namespace) -> int:
    from p2p_lib.apps.check import check_folder
    from p2p_lib.core.findings import Level, as_lines
    from p2p_lib.datasets.prompts import load_prompts

    if a.out is not None and a.out.suffix.lower() != ".png":
        raise BadInput("--out", a.out.name, "the name of a picture, FILE.png")
    prompts = load_prompts(a.prompts) if a.prompts else ()
    how = {"format": a.format, "depth_scale": a.depth_scale, "sizes": RunOptions.of_arguments(a).sizes}
    findings = check_folder(a.sequence, prompts=prompts, picture=a.out, **how)
    fine = "Nothing is wrong with it as far as can be seen. Whether masks are objects, "
    fine += f"{a.out} shows." if a.out else "a picture of them shows: --out FILE.png, or first_masks.png of a run."
    print(json.dumps([asdict(f) for f in findings]) if a.json else as_lines(findings, fine))
    return P2PError.exit_code if any(f.level is Level.WRONG for f in findings) else 0


@command(
    "convert",
    "make a folder for p2p run of a recording (ROS, RealSense, Azure Kinect) or of another layout",
    arg("source", type=Path, metavar="SOURCE", help=".bag, .db3, .mcap, .mkv, a ROS 2 folder, or any sequence"),
    output("DIR", "a new folder", required=True),
    arg("--colour", metavar="TOPIC", help="of a ROS recording (default: the likeliest)"),
    arg("--depth", metavar="TOPIC", help="of a ROS recording, registered to colour (default: the likeliest)"),
    run_options("format", "depth_scale"),
    QUIET,
)
def _convert(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.convert import convert

    count = convert(a.source, a.out, a.format, a.depth_scale, a.colour, a.depth, not a.quiet)
    print(f"{count} frames in {a.out}. Next: p2p check {a.out}")


@command(
    "synth",
    "render a synthetic sequence in the YCBMultiTrack layout, with exact truth",
    arg("scenario", nargs="?", metavar="SCENARIO", help="what happens; --list shows all"),
    arg("--list", action="store_true", help="list the scenarios"),
    output("DIR", "a new folder for the sequence"),
    arg("--seed", type=int, default=0, metavar="N", help="of labels, paths and noise (default 0)"),
    arg("--noise", default="realsense", metavar="NAME", help="exact, realsense (default) or hard"),
    arg(
        "--models",
        type=Path,
        metavar="DIR",
        help="YCB models, for ycb_, in_hand and thin_ scenarios (default: procedural ones)",
    ),
    arg("--bop", action="store_true", help="write a BOP scene besides, in DIR/bop"),
    run_options(stop="one past the last frame (default: all)"),
    QUIET,
)
def _synth(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.sequence import SYNTHETIC
    from p2p_lib.synthetic import SCENARIOS, describe, write_sequence

    if a.list:
        print("\n".join(f"{name:18}{re.sub('`+', '', describe(name))}" for name in SCENARIOS))
        return
    if a.scenario is None or a.out is None:
        raise BadInput("synth", "no scenario or no --out", "SCENARIO --out DIR; p2p synth --list names the scenarios")
    how = {"models": a.models or "", "bop": a.bop, "progress": not a.quiet, "stop": a.stop}
    out = write_sequence(a.scenario.removeprefix(SYNTHETIC), a.out, a.seed, a.noise, **how)
    print(f"Written to {out}. Next: p2p run {out} --out RUN")


@command("data list", "list every dataset and checkpoint that is known")
def _data_list(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import overview

    print(overview())


@command("data info", "say what a dataset is, its licence and how to get it", _DATASET)
def _data_info(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import describe, manifest

    print(describe(manifest(a.dataset)))


@command(
    "data fetch",
    "download into $P2P_DATA, check and unpack; unpack what was had by hand",
    _DATASET,
    arg("--only", metavar="PART,PART", help="only the files whose names contain one of these"),
    arg("--from", dest="source", type=Path, metavar="FILE", help="take them from a file, folder or archive you have"),
    QUIET,
)
def _data_fetch(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import fetch, manifest

    for line in fetch(manifest(a.dataset), names(a.only) or (), not a.quiet, a.source):
        print(line, flush=True)


@command(
    "data verify",
    "check what is on disk: checksums, sequences, frames, truth",
    _DATASET,
    arg("--every-frame", action="store_true", help="read every image, not only the first and the last"),
)
def _data_verify(a: argparse.Namespace) -> int:
    from p2p_lib.datasets.inventory import manifest, verify

    good = True
    for finding in verify(manifest(a.dataset), a.every_frame):
        print(finding.line(), flush=True)
        good &= finding.fine
    return 0 if good else P2PError.exit_code


@command(
    "data record-truth",
    "add truth by motion capture to a folder of one's own",
    arg("folder", type=Path, metavar="FOLDER", help="rgb/ depth/ cam_K.txt times.txt, and masks/ if any"),
    arg("--object", required=True, metavar="NAME", help="the object's name, as of its masks"),
    arg("--mocap", type=Path, required=True, metavar="LOG", help=f"its marker body in the world: {_POSE_LOG}"),
    arg("--camera", type=Path, required=True, metavar="LOG", help="the model in the camera, at image times"),
    arg("--model", type=Path, metavar="FILE", help="its model, which says when it is in the image"),
)
def _data_record_truth(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.recording import record_truth

    found = record_truth(a.folder, a.object, a.camera, a.mocap, a.model)
    print(f"clocks {found.offset_s:.4f} s apart, known to {found.std_s * 1000:.1f} ms. Truth in {a.folder}")


@command("data where", "print the folder of a dataset, checkpoint or sequence", _DATASET)
def _data_where(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.inventory import where

    print(where(a.dataset))


@command(
    "config",
    "list and explain the parameters, or how the presets differ",
    arg("only", nargs="?", metavar="STAGE[.KEY]", help="only this one: registration, tsdf.voxel_m, ..."),
    arg("--diff", action="store_true", help="only those in which the presets paper and default differ"),
    run_options("preset", "config_file", "settings"),
    JSON,
)
def _config(a: argparse.Namespace) -> None:
    from p2p_lib.core import config as configuration
    from p2p_lib.extended.default import MECHANISMS, chosen

    options = RunOptions.of_arguments(a)
    config, other = options.config(), "default" if options.preset == "paper" else "paper"
    rows, on = configuration.parameters(config, a.only), chosen(config)
    if a.diff:
        differ = configuration.diff()
        others = {
            row["key"]: row for row in configuration.parameters(configuration.preset(other)) if row["key"] in differ
        }
        rows = [
            {"key": key, other: of["value"], f"{other}_source": of["source"], **row}
            for row in rows
            if (of := others.get(key := row["key"]))
        ]
    if a.json:
        print(json.dumps(rows))
        return
    stage = ""
    for row in rows:
        if (its := row["key"].partition(".")[0]) != stage:
            stage = its
            print("# " + _about(getattr(config, stage), stage))
        value = f"{row['value']} {row['unit']}".strip()
        value += f" [{row['source']}], preset {other}: {row[other]} [{row[f'{other}_source']}]" if a.diff else ""
        print(f"{row['key']} = {value}\n    {row['meaning']}" + f" [{row['source']}]" * (not a.diff))
        for name, does in MECHANISMS.items() if row["key"] == "method.mechanisms" else ():
            print(f"        {name}{'' if name in on else ' (left out)'}: {does}")
    whose = "paper (its text; none, false and 0 of what it does without), release (the authors' configuration) or ours"
    print(f"In brackets, whose value it is: {whose}. Change one with --set KEY=VALUE.")


def _about(parameters: object, stage: str) -> str:
    """A stage's heading: its name, what its parameters are of, and the section of the paper."""
    first = (type(parameters).__doc__ or "").strip().partition("\n\n")[0]
    return f"{stage}: {' '.join(first.split()).removeprefix('Of ')}".replace("``", "")


@command(
    "doctor",
    "check this installation and say how to mend it",
    arg(
        "--warm-up",
        action="store_true",
        help="instead compile what is compiled once on a machine, and say how long it took",
    ),
)
def _doctor(a: argparse.Namespace) -> int:
    if a.warm_up:
        from p2p_lib.core.compiled import warm_up

        print(f"Inner loops are ready, after {warm_up(warn):.1f} s.")
        return 0
    from p2p_lib.apps.doctor import run_doctor
    from p2p_lib.core.findings import Level, as_lines

    findings = run_doctor()
    print(as_lines(findings, "All that is required is there. A dash is optional."))
    return P2PError.exit_code if any(f.level is Level.WRONG for f in findings) else 0
