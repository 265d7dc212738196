"""Every notebook has its place in the course: what comes before and after, and what of the pipeline it is about."""

import re

import pytest

from p2p_lib.core.errors import BadInput
from p2p_lib.core.paths import PROJECT
from studies.course import LESSONS, lesson
from studies.pipeline_diagram import STAGES
from studies.runner import list_notebooks


def test_the_course_is_the_notebooks_in_their_order():
    assert [one.name for one in LESSONS] == [path.stem for path in list_notebooks()]


def test_the_readme_says_the_same_of_each():
    rows = re.findall(r"(?m)^\| \[`(\d\d_\w+)`\]\(\S+\) \| (.*) \|$", (PROJECT / "README.md").read_text())
    assert [(name, row.replace("`", "")) for name, row in rows] == [(one.name, one.about) for one in LESSONS]


@pytest.mark.parametrize("one", LESSONS, ids=lambda one: one.name)
def test_each_leads_to_its_neighbours_and_to_all(one):
    page, at = one._repr_html_(), LESSONS.index(one)
    names = [each.name for each in LESSONS]
    nav, rest = page.split("</nav>")
    assert re.findall(r'href="(\w+)\.ipynb"', nav) == names[max(at - 1, 0) : at] + names[at + 1 : at + 2]
    contents = rest.split("</details>")[0]
    assert re.findall(r'href="(\w+)\.ipynb"', contents) == names[:at] + names[at + 1 :]
    assert one.paper.split('"')[1] in page and "<svg" in page


def test_every_stage_belongs_to_one_notebook():
    assert sorted(key for one in LESSONS for key in one.stages) == sorted(STAGES)
    assert lesson("03").stages == ["registration", "selection"] and lesson("00").stages == []


def test_a_notebook_that_is_not_there_is_refused():
    with pytest.raises(BadInput, match="notebook: got '12', expected one of 00, 01"):
        lesson("12")
