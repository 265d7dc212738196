"""Equations of pages as MathML, which a browser sets by itself: no script, no network."""

from __future__ import annotations

import html
import re

#: Fonts with a MATH table, by which a browser stretches brackets; the browser's own where none is there.
STYLE = """<style>
math { font-family: "STIX Two Math", "Latin Modern Math", "Cambria Math", "DejaVu Math TeX Gyre", math; }
math[display="block"] { margin: 1em 0; }
</style>"""
#: What the converter does not know, said in words that it does.
_SAID_OTHERWISE = (
    (r"\\arg\s*\\min", r"\\mathrm{arg}\\,\\min"),
    (r"(\\[bB]igg?[lr]\s*)?\\lVert", r"\\left\\|"),
    (r"(\\[bB]igg?[lr]\s*)?\\rVert", r"\\right\\|"),
    (r"(\\[bB]igg?[lr]\s*)?\\lvert", r"\\left|"),
    (r"(\\[bB]igg?[lr]\s*)?\\rvert", r"\\right|"),
    (r"\\(mathcal|mathbf|hat|tilde|bar)\s*(\\[A-Za-z]+|[A-Za-z])", r"{\\\1{\2}}"),
)


def mathml(tex: str, display: bool = False) -> str:
    """TeX, as it stands between dollars, as MathML; ``display`` on a line of its own."""
    from latex2mathml.converter import convert

    plain = html.unescape(tex).strip()
    for pattern, words in _SAID_OTHERWISE:
        plain = re.sub(pattern, words, plain)
    return convert(plain, display="block" if display else "inline")
