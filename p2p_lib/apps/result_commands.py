"""The commands of ``p2p`` that use a finished run, ``refine``, ``export``, ``view``, ``film``, and ``notebooks``."""

from __future__ import annotations

import argparse
from shlex import quote

from p2p_lib.apps.command_line import NO_BROWSER, QUIET, RUN, arg, command, open_page, output, warn
from p2p_lib.core.files import check_new
from p2p_lib.core.options import names, pairs
from p2p_lib.offline import PRODUCTS

_FILES = (
    "poses as bop: p2p_SEQ-test.csv; tum: OBJECT.txt; poses: annotated_poses/OBJECT/FRAME.txt, 4x4 (all in DIR);"
    " bop-dataset: labelled images, masks and models; foundationpose: images, first mask, mesh; model: textured meshes"
)


@command(
    "refine",
    "go over a finished run with the whole video; its better poses and surfaces go to DIR/offline",
    RUN,
    arg("--force", action="store_true", help="also where DIR/offline is of the same poses and code already"),
    QUIET,
)
def _refine(a: argparse.Namespace) -> None:
    from p2p_lib.datasets.runs import OFFLINE
    from p2p_lib.offline.compared import compared
    from p2p_lib.offline.refine import refine_run

    try:
        print("\n".join(refine_run(a.run, not a.quiet, a.force)))
        title = "Causal -> offline, by some of the images (p2p eval takes more of them):"
        print("\n".join([title, *(f"  {line}" for line in compared(a.run))]))
    except KeyboardInterrupt:
        then = f"Go on: p2p refine {quote(str(a.run))}; it keeps the objects that are finished."
        raise KeyboardInterrupt(then) from None
    print(f"Results in {a.run / OFFLINE}. Next: p2p eval {a.run / OFFLINE}")


@command(
    "export",
    "write a run's poses as BOP, TUM or a dataset keeps them, a labelled dataset, or textured models",
    RUN,
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
    poses = [(obj.has_pose.sum(), obj.of_confidence(least).has_pose.sum()) for obj in run.objects.values()]
    had, kept = map(sum, zip(*poses))
    if kept < had:
        warn(f"p2p export: {had - kept} of {had} poses left out, of a confidence below {least:g}.")


@command(
    "view",
    "look at a run in 3D with a time slider, in the browser",
    RUN,
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
    RUN,
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
    from p2p_lib.core.compiled import warm_up

    parameters = pairs(a.parameter or (), "--parameter", "NAME=VALUE")
    runner = study("runner")
    warm_up(warn)  # once, and not in every kernel that begins meanwhile
    how = {"only": names(a.only) or (), "jobs": a.jobs, "parameters": parameters, "out": a.out}
    runner.run_notebooks(a.profile, **how)
