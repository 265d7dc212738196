"""What the benchmarks share: timing in turn, tables with ratios, runs by seed, and the pages that they write.

Whatever is compared runs in turn in one process, so that what else the machine does slows all of it alike: ratios can
be compared between machines and days, milliseconds cannot.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pandas import DataFrame

from p2p_lib.core.tables import as_markdown
from p2p_lib.datasets.provenance import provenance
from p2p_lib.datasets.runs import Run, load_run
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.run import run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Result = TypeVar("Result")
#: Packages that decide how fast ours and its peers are, beside those that every result names.
PACKAGES = ("scipy", "numba", "gtsam", "open3d")
#: Waiting processes in the last minute, above which the machine is not quiet.
QUIET = 0.5


@dataclass
class Times:
    """Milliseconds of one thing that is done again and again: on the clock, and of the processor in all threads."""

    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def run(self, job: Callable[[], Result]) -> Result:
        """What the job returns; what it took is added."""
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        result = job()
        self.wall_ms.append(1e3 * (time.perf_counter() - wall_s))
        self.cpu_ms.append(1e3 * (time.process_time() - cpu_s))
        return result

    def at(self, which: Iterable[int]) -> Times:
        """Those of some of its rounds."""
        which = list(which)
        return Times([self.wall_ms[i] for i in which], [self.cpu_ms[i] for i in which])

    @property
    def median_ms(self) -> float:
        """Half of them took less on the clock."""
        return float(np.median(self.wall_ms))

    @property
    def p95_ms(self) -> float:
        """Of twenty, nineteen took less on the clock."""
        return float(np.percentile(self.wall_ms, 95))

    @property
    def processor_ms(self) -> float:
        """Their mean, since what goes on beside a frame counts in another one."""
        return float(np.mean(self.cpu_ms))


@dataclass(frozen=True, eq=False)
class Section:
    """A part of the page: its plot's file is ``name``; ``tables`` by their captions."""

    name: str
    title: str
    words: str
    tables: Mapping[str, DataFrame]
    figure: Figure | None = None


def in_turn(jobs: Mapping[str, Callable[[], object]], rounds: int, warm_up: int = 2) -> dict[str, Times]:
    """Every job once a round; what it took in the rounds after the first ones, in which loops are compiled."""
    times = {name: Times() for name in jobs}
    for _ in range(warm_up + rounds):
        for name, job in jobs.items():
            times[name].run(job)
    return {name: spent.at(range(warm_up, warm_up + rounds)) for name, spent in times.items()}


def ratios(ours: Times, peer: Times) -> dict[str, float]:
    """Columns of a table: what ours takes in units of what its peer takes."""
    return {
        "median / peer": rounded(ours.median_ms / peer.median_ms),
        "p95 / peer": rounded(ours.p95_ms / peer.p95_ms),
        "processor / peer": rounded(ours.processor_ms / peer.processor_ms),
    }


def beside(ours: Times, peer: Times) -> dict[str, float]:
    """Columns of a table: milliseconds of both, then their ratios."""
    return {
        "ours, median (ms)": rounded(ours.median_ms),
        "ours, p95 (ms)": rounded(ours.p95_ms),
        "peer, median (ms)": rounded(peer.median_ms),
        "peer, p95 (ms)": rounded(peer.p95_ms),
        **ratios(ours, peer),
    }


def compared(
    times: Mapping[str, Times], peer: str, more: Mapping[str, Mapping[str, object]] | None = None
) -> DataFrame:
    """A row for each, in units of the ``peer`` among them; ``more`` columns by their names."""
    rows = []
    for name, spent in times.items():
        ms = {"median (ms)": rounded(spent.median_ms), "p95 (ms)": rounded(spent.p95_ms)}
        rows.append({"": name, **ms, **ratios(spent, times[peer]), **(more or {}).get(name, {})})
    return DataFrame(rows)


def rounded(value: float) -> float:
    """Three digits: a timing has no more."""
    return float(f"{value:.3g}")


def squared_errors(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(n, 2) normalised squared errors, rotation and translation, of tangents (n, 6) and covariances (n, 6, 6).

    The expectation of each is 3.
    """
    blocks = [(off[:, s, None], covariance[:, s, s]) for s in (slice(0, 3), slice(3, 6))]
    return np.stack([np.sum(e * np.linalg.solve(C, e), axis=(1, 2)) for e, C in blocks], axis=1)


def machine() -> dict[str, str]:
    """What ran where: processor, memory, load before the start, versions and commit."""
    made, cpu = provenance(), Path("/proc/cpuinfo")
    models = [line.partition(":")[2].strip() for line in cpu.read_text().splitlines() if line.startswith("model name")]
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    load = os.getloadavg()[0]
    versions = made["versions"] | {name: version(name) for name in PACKAGES}
    commit = str(made["commit"] or "unknown")[:7] + (", changed since" if made["modified"] else "")
    return {
        "processor": f"{(models or [platform.processor()])[0]}, {len(os.sched_getaffinity(0))} cores",
        "memory": f"{memory_gib:.0f} GiB",
        "system": f"{platform.system()}, {' '.join(platform.libc_ver())}",
        "load in the minute before": f"{load:.1f}" + ("" if load <= QUIET else " (**not quiet**: run it again)"),
        "versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
        "commit": f"{commit}, {time.strftime('%Y-%m-%d', time.gmtime())}",
    }


def in_a_line(**more: str) -> str:
    """The same, with what is named besides; without the load, on which accuracy does not depend."""
    return ", ".join(f"{what} {value}" for what, value in (machine() | more).items() if not what.startswith("load"))


def options(seeds: int | None = None) -> argparse.ArgumentParser:
    """The options of what tracks: a folder for its runs, ``--data`` with videos, and how many ``--seeds``, if any."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("data"))
    if seeds is not None:
        parser.add_argument("--seeds", type=int, default=seeds)
    return parser


def tracked(sequence: str | Path | Sequence, out: Path, **how: Any) -> Run:
    """The run in a folder, made unless it is there and finished."""
    run(sequence, out, if_exists="resume", progress=False, **how)
    return load_run(out)


def seeds_said(count: int) -> str:
    """Seeds as a page names them."""
    return f"0 to {count - 1}" if count > 1 else "0"


def write_page(name: str, page: str, folder: Path = Path(__file__).parent, **parts: object) -> None:
    """``name``.md of a page, whose {parts} are words or the rows of tables; ``machine`` is known. Prints it, too."""
    shown = {
        what: as_markdown(DataFrame(part)) if isinstance(part, list | DataFrame) else part
        for what, part in parts.items()
    }
    text = page.format(**{"machine": in_a_line(), **shown})
    (folder / f"{name}.md").write_text(text, encoding="utf-8")
    print(text)
