"""Does this code track as another commit's does, bit for bit? Then tables of that commit are tables of this code.

    python tools/same_results.py COMMIT [--only SEQUENCE ...]

For a change that decides no pose: names, types, messages, what is kept and shown; or none but of runs from clicks. Runs
of both presets, of 2D trackers that need no weights, of every source of masks and of some faults are made with the
library of COMMIT and with this one, and every array of their poses, keypoints and masks is compared, but words. Where
all are the same, tables and figures whose note has the digest of COMMIT's code get this code's, and ``same_as``: the
digest that they were made with, and how many runs were compared. Where runs from clicks alone differ, those get it
whose plan has none. Ends with exit code 1 where another run differs; then nothing is written. Sequences below
``$P2P_DATA`` are compared where they are there. Where a bundled sequence is another film than it was, its runs tell
nothing, and plans with it stay of earlier code.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.benchmark.plan import Plan, plan_names, read_plan, uses_clicks

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "figures"
#: Sequence, and what it is run with.
CASES: tuple[tuple[str, ...], ...] = (
    ("synthetic/crossing", "--masks", "clicks"),
    ("synthetic/look_away", "--masks", "first"),
    ("synthetic/mug", "--stop", "160"),
    ("synthetic/other_side", "--seed", "1"),
    ("synthetic/in_hand", "--masks", "clicks", "--stop", "200"),
    ("synthetic/thin_tools", "--masks", "clicks", "--stop", "150"),
    ("synthetic/cluttered_desk", "--masks", "clicks", "--stop", "150"),
    ("synthetic/occlusion", "--set", "tracking.forget_after=10"),
    ("synthetic/crossing", "--preset", "paper", "--tracker", "builtin2d", "--stop", "150"),
    ("synthetic/weak_texture", "--preset", "paper", "--tracker", "lk", "--stop", "120"),
    ("synthetic/crossing", "--tracker", "oracle", "--stop", "120"),
    ("redkitchen_table", "--masks", "clicks"),
    ("desk_fast", "--prompts", "p2p_lib/benchmark/prompts/desk_fast.json"),
    ("YCBInEOAT/mustard0", "--masks", "first", "--stop", "150"),
)
#: Faults, with their severity, of frames 30 to 60 of ``synthetic/crossing``.
FAULTS = (
    ("none", 1.0),
    ("depth scaled", 1.2),
    ("depth frozen", 1.0),
    ("depth holes", 0.9),
    ("mask whole image", 1.0),
    ("frames dropped", 1.0),
    ("time shifted", 10.0),
)
#: What makes a run start from clicks.
CLICKS = ("clicks", "--prompts")
ARRAYS = ("poses.npz", "keypoints.npz", "masks.npz")
#: What of these is told to people, and in no table.
WORDS = "/reason"
#: Of the library that is imported: prints its digest; is its command line.
_DIGEST = "from p2p_lib.datasets.provenance import code_digest; print(code_digest())"
#: Prints the digest of some of a sequence's images and of its truth.
_FILM = """import hashlib, sys
import numpy as np
from p2p_lib.datasets.sequence import open_sequence
film, said = open_sequence(sys.argv[1], progress=False), hashlib.sha256()
for frame in [film.frame(i) for i in np.linspace(0, len(film) - 1, 5).astype(int)]:
    said.update(frame.rgb.tobytes() + frame.depth_m.tobytes())
print(said.hexdigest(), len(film))"""
_FAULTY = """import sys
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.run import run
from p2p_lib.synthetic.faults import Faulty
fault, severity, out = sys.argv[1:]
film = open_sequence("synthetic/crossing", progress=False)
run(Faulty(film, fault, float(severity), 30, 60), out, stop=100, progress=False)"""
_P2P = "import sys; from p2p_lib.apps.cli import main; sys.exit(main())"


def of_commit(commit: str, folder: Path) -> Path:
    """The library of a commit, below ``folder``."""
    packed = subprocess.run(
        ["git", "-C", str(ROOT), "archive", commit, "p2p_lib", "data_manifests"], check=True, capture_output=True
    )
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return folder


def python(library: Path, *arguments: str) -> str:
    """What Python prints with this library; raises where it fails."""
    environment = os.environ | {"PYTHONPATH": str(library), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *arguments], env=environment, cwd=library, text=True, capture_output=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}\n{done.stderr}")
    return done.stdout.strip()


def differences(one: Path, other: Path) -> list[str]:
    """Arrays of two runs that are not the same to the last bit, but for words."""
    found = []
    for name in ARRAYS:
        kept = [dict(np.load(folder / name)) if (folder / name).is_file() else {} for folder in (one, other)]
        for key in sorted(key for key in {*kept[0], *kept[1]} if not key.endswith(WORDS)):
            a, b = (arrays.get(key) for arrays in kept)
            if a is None or b is None or a.dtype != b.dtype or a.tobytes() != b.tobytes():
                found.append(f"{name}: {key}")
    return found


def plans(note: dict[str, Any]) -> list[Plan]:
    """The plans that a table or figure is of, itself or by the tables that it is drawn from."""
    names = {source.get("benchmark") or Path(source.get("file", "")).stem for source in note.get("sources", ())}
    return [read_plan(name) for name in names & {*plan_names()}]


def from_clicks(plan: Plan) -> bool:
    """Whether a plan has runs from clicks; none counts that a network starts, which needs a GPU and is not compared."""
    return any(uses_clicks(method) and method.masks != "sam2_video" for method in plan.method)


def restamp(
    folder: Path,
    was: str,
    now: str,
    compared: int,
    clicks: bool = True,
    films: Collection[str] = (),
    faults: bool = True,
) -> list[str]:
    """Give notes that hold the digest ``was`` the digest ``now``, and say so in them; the names of their files.

    clicks  also those of runs from clicks
    films   sequences that are other films than they were
    faults  also those of runs with faults
    """
    changed = []
    for path in sorted([*folder.glob("*.json"), *folder.glob("tables/*.json")]):
        note = json.loads(path.read_text(encoding="utf-8"))
        if note.get("code") != was:
            continue
        if any(
            (from_clicks(plan) and not clicks)
            or (plan.full.fault and not faults)
            or {*films} & {s.name for s in plan.full.sequence}
            for plan in plans(note)
        ):
            continue
        note |= {"code": now, "same_as": [*note.get("same_as", []), {"code": was, "runs compared": compared}]}
        path.write_text(json.dumps(note, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        changed.append(path.name)
    return changed


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commit")
    parser.add_argument("--only", nargs="*", default=(), metavar="SEQUENCE")
    asked = parser.parse_args()
    data = Path(os.environ.get("P2P_DATA", os.devnull))
    cases = [c for c in CASES if c[0].startswith("synthetic/") or (data / c[0]).is_dir()]
    cases = [c for c in cases if not asked.only or c[0] in asked.only]
    with tempfile.TemporaryDirectory() as scratch:
        before = of_commit(asked.commit, Path(scratch) / "before")
        same, clicks_too, films = 0, True, set()
        was, now = python(before, "-c", _DIGEST), python(ROOT, "-c", _DIGEST)
        for k, (sequence, *options) in enumerate(cases):
            if (
                sequence.startswith("synthetic/")
                and len({python(of, "-c", _FILM, sequence) for of in (before, ROOT)}) > 1
            ):
                print(f"another film: {sequence}", flush=True)
                films.add(sequence)
                continue
            runs = [Path(scratch) / f"{k}_{side}" for side in ("before", "now")]
            for library, out in zip((before, ROOT), runs, strict=True):
                python(library, "-c", _P2P, "run", sequence, *options, "--out", str(out), "--quiet")
            differ = differences(*runs)
            print(f"{'differs' if differ else 'same'}: {sequence} {' '.join(options)}", *differ[:5], flush=True)
            same += not differ
            if differ and not {*options} & {*CLICKS}:
                return 1
            clicks_too &= not differ
        faults = [] if asked.only or "synthetic/crossing" in films else list(FAULTS)
        for fault, severity in faults:
            runs = [Path(scratch) / f"{fault}_{side}" for side in ("before", "now")]
            for library, out in zip((before, ROOT), runs, strict=True):
                python(library, "-c", _FAULTY, fault, str(severity), str(out))
            differ = differences(*runs)
            print(f"{'differs' if differ else 'same'}: fault {fault}", *differ[:5], flush=True)
            if differ:
                return 1
            same += 1
    stand = restamp(FIGURES, was, now, same, clicks_too, films, bool(faults))
    print(f"{same} of {len(cases) + len(faults)} runs are the same; {was} -> {now}:", *stand)
    return 0


if __name__ == "__main__":
    sys.exit(main())
