"""Small sequences and plans: a printed board that slides before a wall, points alone, a second a run."""

from pathlib import Path

import pytest

from p2p_lib.benchmark import run_benchmarks
from tests.fixtures.runs_here import in_this_process
from tests.fixtures.sliding_board import write_sequence

PLAN = """
title = "A board that slides"
[[method]]
name = "Ours"
settings = {{ "method.surface" = false, "method.graph" = false }}
[[method]]
name = "No multi-hypothesis"
settings = {{ "method.surface" = false, "method.graph" = false, "registration.method" = "svd" }}
[quick]
seeds = [0]
sequence = [{{ name = "{first}", column = "AP10" }}]
[full]
seeds = [0, 1]
sequence = [{{ name = "{first}", column = "AP10" }}, {{ name = "{second}", stop = 5 }}]
"""


@pytest.fixture(scope="session")
def slides(tmp_path_factory) -> tuple[Path, Path]:
    """Two sequences; nobody writes to them."""
    folder = tmp_path_factory.mktemp("slides")
    return write_sequence(folder / "one", 6, 2, seed=2), write_sequence(folder / "two", 6, 3, seed=3)


@pytest.fixture(scope="session")
def plan(slides, tmp_path_factory) -> Path:
    """Two methods on them: eight runs in full, two quick."""
    path = tmp_path_factory.mktemp("plan") / "slides.toml"
    path.write_text(PLAN.format(first=slides[0], second=slides[1]))
    return path


@pytest.fixture(scope="session")
def whole(plan, tmp_path_factory):
    """The plan in full, run at once, in this process: what others make of it in processes of their own is the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("p2p_lib.benchmark.benchmark.execute", in_this_process)
        return run_benchmarks([plan], tmp_path_factory.mktemp("whole"), progress=False)[0]
