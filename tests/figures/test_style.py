"""Colours can be told apart, by the colour-blind and in print; Matplotlib is left as it was."""

from itertools import combinations

import numpy as np
import pytest

from p2p_lib.core.types import Status
from p2p_lib.figures import style

#: Machado, Oliveira and Fernandes (2009), severity 1.0, on linear RGB.
SEEN_BY = {
    "normal": np.eye(3),
    "protanope": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranope": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanope": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lab(colours, seer):
    """CIELAB of what somebody sees of these colours."""
    from skimage.color import rgb2lab

    v = np.array([style.rgb(c) for c in colours]) / 255
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4) @ np.array(SEEN_BY[seer]).T
    linear = np.clip(linear, 0, 1)
    return rgb2lab(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


def apart(colours, seer):
    from skimage.color import deltaE_ciede2000

    points = lab(colours, seer)
    return {(a, b): deltaE_ciede2000(points[a], points[b]) for a, b in combinations(range(len(colours)), 2)}


@pytest.mark.parametrize("seer", SEEN_BY)
def test_objects_differ_for_everybody(seer):
    # 14 is about fourteen just noticeable differences; two blues of 22 are still taken for one another.
    close = {pair: d for pair, d in apart(style.OBJECTS, seer).items() if d < (24 if seer == "normal" else 14)}
    assert len(style.OBJECTS) >= 8 and not close


@pytest.mark.parametrize("seer", SEEN_BY)
def test_methods_differ_for_everybody_and_are_no_object_and_no_status(seer):
    assert min(apart(style.METHODS, seer).values()) > 10
    others = [*style.OBJECTS, *(fill for fill, _ in style.STATUS.values())]
    between = apart([*style.METHODS, *others], "normal")
    assert min(d for (a, b), d in between.items() if a < len(style.METHODS) <= b) > 10


@pytest.mark.parametrize("seer", SEEN_BY)
def test_statuses_differ_by_colour_or_hatch(seer):
    statuses = list(style.STATUS.values())
    for (a, b), distance in apart([fill for fill, _ in statuses], seer).items():
        assert distance > 10 or statuses[a][1] != statuses[b][1]


def test_statuses_differ_in_grey_print():
    lightness = lab([fill for fill, _ in style.STATUS.values()], "normal")[:, 0]
    hatches = [hatch for _, hatch in style.STATUS.values()]
    for a, b in combinations(range(len(lightness)), 2):
        assert abs(lightness[a] - lightness[b]) > 6 or hatches[a] != hatches[b]


def test_every_status_has_a_look():
    assert set(style.STATUS) == set(Status)


def test_no_object_looks_like_a_status():
    assert not set(style.OBJECTS) & {fill for fill, _ in style.STATUS.values()}


def test_colour_follows_the_place_and_comes_round():
    names = [f"o{k}" for k in range(len(style.OBJECTS) + 1)]
    colours = style.object_colours(names)
    assert colours["o0"] == colours[names[-1]] == style.OBJECTS[0]
    assert style.object_colours(names[:3]) == {name: colours[name] for name in names[:3]}


@pytest.mark.parametrize("colour", [*style.OBJECTS, *style.AXES, *(fill for fill, _ in style.STATUS.values())])
def test_ink_is_legible(colour):
    """WCAG asks 4.5 to 1 of small text; the better of black and white always reaches it."""

    def luminance(c):
        v = np.array(style.rgb(c)) / 255
        return np.where(v <= 0.03928, v / 12.92, ((v + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    high, low = sorted([luminance(colour), luminance(style.ink(colour))], reverse=True)
    assert (high + 0.05) / (low + 0.05) >= 4.5


def test_matplotlib_is_left_as_it_was():
    import matplotlib

    before = dict(matplotlib.rcParams)
    with style.applied():
        assert matplotlib.rcParams["axes.grid"] is True
    assert dict(matplotlib.rcParams) == before
