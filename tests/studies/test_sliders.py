"""A picture follows its sliders: in the file the start, in the page every position."""

import base64
import io
import json
import re

import numpy as np
import pytest
from PIL import Image

from p2p_lib.core.errors import BadInput
from studies.sliders import save_sliders

SLIDERS = {"red": [0, 100, 200], "blue": [50, 250]}


@pytest.fixture
def saved(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_FIGURES", str(tmp_path))
    return save_sliders(lambda r, b: plain(r, b), "colours", "A plain *colour*.", SLIDERS, (100, 250))


def plain(red, blue):
    return np.full((30, 40, 3), (red, 0, blue), np.uint8)


def colour(address):
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))))
    return picture.reshape(-1, 3).mean(0)


def test_the_start_is_what_is_saved_and_shown_first(saved):
    assert (np.asarray(Image.open(saved.path)) == plain(100, 250)).all()
    page = saved.shown[0]["text/html"]
    assert re.search('alt="([^"]*)"', page)[1] == "A plain colour." and saved.caption == "A plain *colour*."
    np.testing.assert_allclose(colour(re.search('src="([^"]*)"', page)[1]), [100, 0, 250], atol=6)
    assert re.findall(r"<output>(\w+)</output>", page) == ["100", "250"]


def test_a_browser_moves_the_picture(saved, tmp_path, browser):
    page = tmp_path / "page.html"
    move = "const s=document.querySelectorAll('input');s[0].value=2;s[1].value=0;"
    move += "s[1].dispatchEvent(new Event('input'))"
    page.write_text(f"<html><body>{saved.shown[0]['text/html']}<script>{move}</script></body></html>")
    dom = browser.dom(page, 500)
    np.testing.assert_allclose(colour(re.search('src="([^"]*)"', dom)[1]), [200, 0, 50], atol=6)
    assert re.findall(r"<output>(\w+)</output>", dom) == ["200", "50"]


def test_there_is_a_picture_for_every_position(saved):
    pictures = json.loads(re.search("data-pictures='([^']*)'", saved.shown[0]["text/html"])[1])
    expected = [[red, 0, blue] for red in SLIDERS["red"] for blue in SLIDERS["blue"]]
    np.testing.assert_allclose([colour(picture) for picture in pictures], expected, atol=6)


def test_a_start_beside_the_slider_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_FIGURES", str(tmp_path))
    with pytest.raises(BadInput, match="start of slider 'blue': got 3, expected one of 50, 250"):
        save_sliders(plain, "colours", "A colour.", SLIDERS, (0, 3))
