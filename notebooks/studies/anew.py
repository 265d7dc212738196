"""What of ``figures/`` was measured by other code than this, or by an earlier plan: list, a line in each, remaking.

``p2p benchmark --stale`` is this. :func:`p2p_lib.figures.provenance.earlier` decides, and nothing else.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Collection
from pathlib import Path

from pandas import DataFrame

from p2p_lib.core.files import replace_text
from p2p_lib.datasets.download import sha256
from p2p_lib.figures.provenance import earlier
from studies.paper_figures import ITEMS, commit_of, index, note_of

#: How the line begins that such a table ends with.
LINE = "Made at an earlier state of the tracking code or of its plan"


def stale(folder: Path, only: Collection[str] = ()) -> DataFrame:
    """A row for each table and figure of earlier code, or not made yet: file, commit, command, and processor minutes.

    The shortest first. Where a note has no time, its runs are taken to be as long as those of the other notes (``~``).
    """
    notes = {item.file: note_of(folder / item.file) for item in ITEMS.itertuples()}
    timed = [s for note in notes.values() for s in (note or {}).get("sources", []) if s.get("cpu_min")]
    a_run = sum(s["cpu_min"] for s in timed) / max(sum(len(s["runs"]) for s in timed), 1)
    rows = []
    for item in ITEMS.itertuples():
        note, name = notes[item.file], Path(item.file).stem
        if only and name not in only:
            continue
        if note is None:
            rows.append((item.file, "not made", item.command, float("inf"), "?"))
            continue
        if not of_earlier_code(folder, note):
            continue
        known = [s["cpu_min"] for s in note["sources"] if s.get("cpu_min")]
        runs = sum(len(s.get("runs", [0])) for s in note["sources"])
        minutes = sum(known) if known else a_run * runs
        about = f"{'' if known else '~'}{minutes:.0f}"
        rows.append((item.file, _commit(note), item.command, minutes, about if minutes else "?"))
    found = DataFrame(rows, columns=["file", "commit", "command", "minutes", "CPU min"])
    return found.sort_values("minutes", kind="stable").drop(columns="minutes")


def of_earlier_code(folder: Path, note: dict) -> bool:
    """Whether this is a table or figure of earlier code, or drawn from such a table, or from one that changed since."""
    drawn_from = {folder / "tables" / s["file"]: s["sha256"] for s in note["sources"] if "file" in s}
    if any(table.is_file() and sha256(table) != drawn for table, drawn in drawn_from.items()):
        return True
    return any(earlier(said) for said in [note, *filter(None, map(note_of, drawn_from))])


def say_so(folder: Path) -> None:
    """Write into every table of earlier code that it is, and what makes it anew; into the index, of figures too."""
    for item in ITEMS.itertuples():
        if (note := note_of(folder / item.file)) is None:
            continue
        was = of_earlier_code(folder, note)
        path = (folder / item.file).with_suffix(".json")
        if path.with_suffix(".md").is_file():
            page = path.with_suffix(".md")
            lines = [line for line in page.read_text(encoding="utf-8").splitlines() if not line.startswith(LINE)]
            said = f"{LINE}, commit {_commit(note)}; `{item.command}` makes it anew.  "
            replace_text(page, "\n".join([*lines, *[said] * was]) + "\n")
            note["sha256"][page.name] = sha256(page)
        note.pop("earlier", None)
        note |= {"earlier": True} if was else {}
        replace_text(path, json.dumps(note, indent=1, ensure_ascii=False) + "\n")
    replace_text(folder / "README.md", index(folder))


def make_anew(folder: Path, out: Path, only: Collection[str], say: Callable[[str], None]) -> int:
    """Run what makes the stale ones, each command once; gives the exit status of the last that failed, else 0.

    Killed, the same call goes on: what was run before is found in ``out``.
    """
    status = 0
    places = {"DIR": str(out), "figures/tables": str(folder / "tables")}
    for command in stale(folder, only).command.str.removesuffix(" --poses PATH").unique():
        words = [places.get(word, word) for word in shlex.split(command)[1:]]
        say(shlex.join(["p2p", *words]))
        status = subprocess.run([sys.executable, "-m", "p2p_lib.apps.cli", *words], check=False).returncode or status
        say_so(folder)
    return status


def _commit(note: dict) -> str:
    return (commit_of(note) or "unknown")[:7]
