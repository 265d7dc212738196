"""Benchmarks: methods on sequences with seeds as a plan says, run on many cores or machines, as tidy tables.

``run_benchmarks(["ycbineoat"], "out/benchmark")`` runs what is not on disk yet and gives the results of all of it.
Look first at :mod:`p2p_lib.benchmark.plan` (what is to run) and :mod:`p2p_lib.benchmark.benchmark` (how it is run).
"""

from p2p_lib.benchmark.benchmark import Benchmark, load_benchmark, run_benchmarks
from p2p_lib.benchmark.plan import Plan, plan_names, read_plan

__all__ = ["Benchmark", "Plan", "load_benchmark", "plan_names", "read_plan", "run_benchmarks"]
