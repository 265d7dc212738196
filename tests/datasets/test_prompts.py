"""Prompts on disk, by frame, and drawn from masks."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, Doubt, MissingData
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.prompts import first_prompts, load_prompts, prompts_by_frame, save_prompts

H, W = 60, 80
CAMERA = Camera(90.0, 90.0, 40.0, 30.0, W, H)


def disc(x: float, y: float, radius: float) -> np.ndarray:
    v, u = np.mgrid[:H, :W]
    return (u - x) ** 2 + (v - y) ** 2 <= radius**2


def test_every_kind_survives_the_file(tmp_path):
    given = [
        Prompt("mug", 0, [[30, 20], [31.5, 22]], negative_px=[[60, 50]]),
        Prompt("mug", 7, negative_px=[[61, 51]]),
        Prompt("tin", 3, box_px=(10, 12, 40, 44)),
        Prompt("lid", 3, mask=disc(60, 30, 8)),
    ]
    read = load_prompts(save_prompts(tmp_path / "made" / "p.json", given))
    assert [p.as_dict() for p in read] == [p.as_dict() for p in given]
    assert read[0].as_dict() == {"name": "mug", "frame": 0, "points": [[30, 20], [31.5, 22]], "negative": [[60, 50]]}
    np.testing.assert_array_equal(read[3].mask, given[3].mask)


@pytest.mark.parametrize(
    ("entry", "error", "why"),
    {
        "no box": ({"box": [1, 2, 3]}, BadInput, r"box around 'a': got \[1, 2, 3\]"),
        "box inside out": ({"box": [9, 2, 3, 8]}, BadInput, r"\[left, top, right, bottom\]"),
        "no mask file": ({"mask": "none.png"}, MissingData, "none.png"),
        "mask of numbers": ({"mask": [[0, 1]]}, BadInput, "an image beside the prompts"),
        "mask and clicks": ({"mask": "m.png", "points": [[1, 2]]}, BadInput, "a mask and clicks"),
        "nothing": ({}, BadInput, "at least one"),
        "a word misspelt": ({"pionts": [[1, 2]]}, BadInput, r"got pionts, expected some of .* Did you mean points\?"),
    }.values(),
)
def test_entries_that_do_not_fit_are_named(entry, error, why, tmp_path):
    cv2.imwrite(str(tmp_path / "m.png"), disc(40, 30, 9).astype(np.uint8))
    (tmp_path / "p.json").write_text(json.dumps({"objects": [{"name": "a", "frame": 0, **entry}]}))
    with pytest.raises(error, match=why):
        load_prompts(tmp_path / "p.json")


def test_corrections_follow_what_starts_the_object():
    start, mend = Prompt("mug", 2, [[30, 20]]), Prompt("mug", 5, negative_px=[[60, 50]])
    by_frame = prompts_by_frame([mend, start], range(10), CAMERA)
    assert by_frame == {2: (start,), 5: (mend,)}
    with pytest.raises(BadInput, match="prompt of 'mug': got nothing on it in frame 5"):
        prompts_by_frame([mend], range(10), CAMERA)
    assert prompts_by_frame([mend], range(10), CAMERA, started=["mug"]) == {5: (mend,)}
    for prompt, why in (
        (Prompt("mug", 2, mask=np.ones((H, W), bool)), "the whole image"),
        (Prompt("mug", 2, mask=np.ones((W, H), bool)), "60x80, expected 80x60"),
        (Prompt("mug", 2, mask=np.zeros((H, W), bool)), "nothing on it"),
        (Prompt("mug", 2, box_px=(-30, 4, -10, 9)), "a box within 80x60"),
        (Prompt("mug", 2, [[3, 3]], negative_px=[[200, 3]]), r"negative clicks of 'mug' in frame 2: got \(200, 3\)"),
    ):
        with pytest.raises(BadInput, match=why):
            prompts_by_frame([prompt], range(10), CAMERA)


def growing(radii_px, hole=None):
    """An object whose mask is a disc of these radii, frame by frame; without depth where a ``hole`` (H, W) is."""
    depth = np.where(np.zeros((H, W), bool) if hole is None else hole, 0, 0.7).astype(np.float32)
    frames = [Frame(k, k / 30, np.zeros((H, W, 3), np.uint8), depth) for k in range(len(radii_px))]
    masks = [None if r is None else {"mug": disc(38, 29, r), "never": disc(-99, 0, 1)} for r in radii_px]
    return SimpleNamespace(frame=frames.__getitem__, masks=masks.__getitem__, name="s")


@pytest.mark.parametrize("name", ["Mug", "red mug", "red-Mug", "REDMUG"])
def test_an_object_that_is_called_nearly_as_another_is_doubted(name):
    known = "mug" if name == "Mug" else "red_mug"
    told = [Prompt(known, 0, [[5, 5]]), Prompt("cup", 1, [[9, 9]]), Prompt(name, 2, [[5, 6]])]
    with pytest.warns(Doubt, match=f"object '{name}': another one than '{known}', which is known. To correct that"):
        prompts_by_frame(told, range(3), CAMERA)
    with pytest.warns(Doubt, match="another one than"):
        prompts_by_frame(told[2:], range(3), CAMERA, started=[known])


@pytest.mark.parametrize("clicks", [0, 1, 3])
def test_what_starts_an_object_is_drawn_from_its_first_usable_mask(clicks):
    """Not before it is large enough and has stopped growing; well inside, the first in its middle."""
    sequence, names = growing([None, -1, 3, 12, 18, 18.2, 18]), ["mug", "never"]

    def draw(seed):
        return first_prompts(sequence, range(7), names, 100, clicks, np.random.default_rng(seed))

    (prompt,) = draw(0)
    assert (prompt.name, prompt.frame) == ("mug", 5)
    if not clicks:
        np.testing.assert_array_equal(prompt.mask, disc(38, 29, 18.2))
        return
    away = np.linalg.norm(prompt.points_px - [38, 29], axis=1)
    assert len(away) == clicks and away[0] <= 1 and away.max() <= 0.6 * 19
    assert len(np.unique(prompt.points_px, axis=0)) == clicks
    np.testing.assert_array_equal(prompt.points_px, draw(0)[0].points_px)
    assert clicks == 1 or (prompt.points_px != draw(1)[0].points_px).any()


def test_clicks_are_drawn_where_depth_is_measured():
    hole = disc(38, 29, 6)
    (prompt,) = first_prompts(growing([18, 18], hole), range(2), ["mug"], 100, 3, np.random.default_rng(0))
    u, v = prompt.points_px.astype(int).T
    assert not hole[v, u].any() and disc(38, 29, 11.5)[v, u].all()
    assert first_prompts(growing([18, 18], hole=disc(38, 29, 30)), range(2), ["mug"], 100, 3, None) == ()
