"""Equations of pages: every one of the notebooks becomes MathML, with nothing of its TeX left over."""

import re
from pathlib import Path

import nbformat
import pytest

from studies.equations import mathml

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))


def equations(path: Path) -> list[str]:
    texts = [cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown"]
    return [found for text in texts for found in re.findall(r"\$\$.+?\$\$|(?<!\\)\$[^$\n]+?\$", text, re.S)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_equation_of_a_notebook_is_set(path):
    for equation in equations(path):
        words = re.sub("<[^>]*>", "", mathml(equation.strip("$")))
        assert words.strip() and "\\" not in words and "&#x00026;" not in words, equation


def test_brackets_and_operators():
    norm = mathml(r"\bigl\lVert a \bigr\rVert + \arg\min_x \lvert x \rvert")
    assert norm.count('fence="true"') == 4 and "min" in re.sub("<[^>]*>", "", norm)
    assert '"block"' in mathml("x", display=True) and '"inline"' in mathml("a &lt; b")
    assert mathml(r"\mathcal D_m") == mathml(r"{\mathcal{D}}_m")
