"""What everything costs as it grows, on one page: ``make bench``, about ten minutes on two quiet cores.

    python benchmarks/scale.py [--quick] [--only memory,graph] [--out DIR]

Writes ``DIR/README.md`` and ``DIR/plots/*.svg``. DIR is this folder, or ``out/bench`` where only a part is run;
``--quick`` tries every part in seconds, with numbers that mean nothing.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from common import Section, machine
from matplotlib import rc_context

from p2p_lib.core.tables import as_markdown, as_text
from p2p_lib.figures import style

HERE = Path(__file__).resolve().parent
#: Memory first, while the process has held nothing else.
PARTS = ("memory", "tracking", "graph", "registration", "surface", "tracker")
PAGE = """# What it costs as it grows

Written by `make bench`; do not edit. `benchmarks/scale.py` says how to run a part of it.

How to read it: whatever is compared ran in turn, in one process, on the machine below. **Compare ratios, not
milliseconds**: a column "/ peer" is what ours takes in units of what the peer takes, on the clock in the median and at
the 95th percentile, and in processor time of all threads in the mean. Below 1 ours is faster.

| part | peer |
| --- | --- |
| whole frames | `benchmarks/peer.py`: Lucas-Kanade, SIFT and RANSAC in a hundred lines, no surface and no graph |
| keyframe graph | Levenberg-Marquardt over the whole graph at every keyframe (GTSAM) |
| registration | Open3D's RANSAC over correspondences |
| surface | Open3D's VoxelBlockGrid and point-to-plane ICP, SciPy's interpolation |
| 2D tracker | OpenCV's Lucas-Kanade, checked forward and backward |

What mechanisms are worth in accuracy is in [mechanisms.md](mechanisms.md), what memories of objects find again in
[recall.md](recall.md) (`bench_recall.py`). `bench_offline.py` measures what `p2p refine` is worth, `bench_hand.py`
a mug that a hand turns, `bench_variants.py` known videos as nobody has filmed them, `bench_first_masks.py` the masks
that clicks start objects with, `bench_corrections.py` those that clicks correct, and `bench_features.py` what learned
features would gain; each writes a page of its own here.

"""


def write(out: Path, about: Mapping[str, str], sections: Iterable[Section]) -> Path:
    """The page and its plots; every section is on the page as soon as it is done."""
    plots, page = out / "plots", out / "README.md"
    plots.mkdir(parents=True, exist_ok=True)
    text = PAGE + "".join(f"- {what}: {value}\n" for what, value in about.items())
    for section in sections:
        text += f"\n## {section.title}\n\n{section.words}\n"
        if section.figure is not None:
            with style.applied(), rc_context({"svg.fonttype": "none"}):  # text as text: far smaller
                section.figure.savefig(plots / f"{section.name}.svg", metadata={"Date": None})
            text += f"\n![{section.title}](plots/{section.name}.svg)\n"
        for caption, table in section.tables.items():
            text += f"\n*{caption}:*\n\n{as_markdown(table)}"
        page.write_text(text, encoding="utf-8")
        print(f"\n{section.title}\n{section.words}")
        for caption, table in section.tables.items():
            print(f"\n{caption}:\n{as_text(table)}", flush=True)
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few frames of everything")
    parser.add_argument("--only", metavar="A,B", help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--out", type=Path, metavar="DIR")
    asked = parser.parse_args()
    parts = asked.only.split(",") if asked.only else PARTS
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--only {unknown.pop()}: known are {', '.join(PARTS)}")
    out = asked.out or (HERE if tuple(parts) == PARTS and not asked.quick else HERE.parent / "out" / "bench")
    about, start_s = machine(), time.perf_counter()
    modules = (importlib.import_module(f"bench_{part}") for part in parts)
    page = write(out, about, (section for module in modules for section in module.sections(asked.quick)))
    print(f"\n{page} after {(time.perf_counter() - start_s) / 60:.1f} minutes")


if __name__ == "__main__":
    main()
