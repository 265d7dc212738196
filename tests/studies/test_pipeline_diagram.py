"""The diagram shows the pipeline that is there: its stages, in the order in which a run meets them."""

import ast

import pytest

from p2p_lib.core.errors import BadInput
from p2p_lib.core.paths import PROJECT
from p2p_lib.extended.default import Point2Pose
from studies.pipeline_diagram import STAGES, as_svg, pipeline_diagram
from studies.runner import list_notebooks
from tests.method.test_pipeline import CAMERA, film


def timed_stages() -> set[str]:
    """The names that the method gives its stopwatch."""
    found = set()
    for path in [p for room in ("method", "extended") for p in (PROJECT / "p2p_lib" / room).glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("stopwatch", "_stopwatch"):
                found.add(node.args[0].value)
    return found


def test_a_box_for_every_stage_that_is_timed_and_for_judging():
    assert set(STAGES) == timed_stages() | {"judging"}


def test_every_box_names_what_is_there():
    numbers = {path.stem[:2] for path in list_notebooks()}
    for stage in STAGES.values():
        assert (PROJECT / "p2p_lib" / stage.source).exists() and stage.notebook in numbers


def test_the_order_is_that_of_a_run():
    method = Point2Pose(CAMERA)
    method.add_object("left")
    for frame, masks in film():
        estimate = method.step(frame, {"left": masks["left"]})["left"]
        if estimate.keyframe and frame.index:
            break
    beside = {"fusion", "graph", "scene"}  # what waits for them is what a frame meets of them
    met = [stage for stage in method.stopwatch.last_ms if stage not in {"total", *beside}]
    assert [stage for stage in STAGES if stage in met] == met
    assert set(STAGES) - set(met) <= {*beside, "search", "judging"}, "these take no time here, or none worth a name"


def test_boxes_lead_to_their_notebooks_and_the_same_work_gives_the_same_text():
    one, again = (as_svg(pipeline_diagram(here=["map"], pages={"03": "c.ipynb"})) for _ in range(2))
    assert one == again and one.count("c.ipynb") == 2, "registration and selection"
    assert one != as_svg(pipeline_diagram(pages={"03": "c.ipynb"})), "a mark is seen"


def test_a_stage_that_is_not_there_is_refused():
    with pytest.raises(BadInput, match="stage: got 'guess', expected one of tracking"):
        pipeline_diagram(here=["guess"])
