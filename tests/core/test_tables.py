"""Tables as text, Markdown and HTML, beside what is written here by hand."""

import numpy as np
from pandas import DataFrame

from p2p_lib.core.tables import as_html, as_markdown, as_text, shown

TABLE = DataFrame({"object": ["a|b <", "c"], "ADD [%]": [91.25, None], "frames": [3, 1400]})


def test_text_has_words_left_and_numbers_right():
    assert as_text(TABLE).splitlines() == [
        "object  ADD [%]  frames",
        "a|b <     91.25       3",
        "c             -    1400",
    ]


def test_markdown_keeps_its_columns():
    assert as_markdown(TABLE).splitlines()[1:3] == ["| --- | ---: | ---: |", "| a\\|b < | 91.25 | 3 |"]


def test_html_is_escaped_and_the_same_each_time():
    page = as_html(TABLE.assign(price="$5"))
    assert "a|b &lt;" in page and "<span>$</span>5" in page and page == as_html(TABLE.assign(price="$5"))
    assert ".col0" in page and ".col1 {" not in page, "the first column is words, the second numbers"
    assert "td.row1" in as_html(TABLE, rules=[1]) and "<b>x</b>" in as_html(DataFrame({"": ["<b>x</b>"]}), escape=False)


def test_missing_values_are_dashes():
    assert [shown(value) for value in (None, np.nan, 0.1 + 0.2, 3, "x")] == ["-", "-", "0.3", "3", "x"]
