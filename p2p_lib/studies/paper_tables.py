"""The table of a benchmark: the paper's own arrangement where it has one, ours beside the columns that it reports.

Ours are exact areas under the curve over 0 to 0.1 m, aligned at the first scored frame, frames without a pose counted
as 0, mean over seeds ± their standard deviation; every other form is in the benchmark's ``results.csv``.
"""

from __future__ import annotations

from collections.abc import Callable

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.outcome import replace_text
from p2p_lib.figures.tables import Table
from p2p_lib.studies import comparisons, paper_columns
from p2p_lib.studies.benchmark_numbers import Numbers

#: Arrangements by the ``kind`` of a plan.
KINDS: dict[str, Callable[[Numbers], Table]] = {
    "sequences": paper_columns.by_sequence,
    "objects": paper_columns.by_object,
    "methods": comparisons.by_method,
    "returns": comparisons.by_return,
    "rates": comparisons.by_rate,
    "runs": comparisons.by_run,
}


def paper_table(benchmark: Benchmark) -> Table:
    """The table of a benchmark, arranged as its plan's ``kind`` says."""
    return KINDS[benchmark.plan.kind](Numbers(benchmark))


def write_table(benchmark: Benchmark) -> str:
    """``table.md``, ``table.tex`` and ``table.csv`` into the benchmark's folder; gives the first."""
    table = paper_table(benchmark)
    for suffix, text in (("md", table.markdown()), ("tex", table.latex()), ("csv", table.csv())):
        replace_text(benchmark.folder / f"table.{suffix}", text)
    return table.markdown()
