"""What somebody says of an object, to the built-in segmenter: boxes, masks, clicks beside it, corrections."""

import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin import prompted
from p2p_lib.segmenters.builtin import segmenter as built_in
from p2p_lib.segmenters.builtin.patch import Box, Patch
from p2p_lib.segmenters.builtin.prompted import NO_PX, Cut, Cutter, Effect, _measured
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter
from p2p_lib.segmenters.builtin.start_doubts import doubt_prompt
from p2p_lib.segmenters.builtin.start_evidence import Clicked

CAMERA = Camera(300.0, 310.0, 158.3, 121.7, 320, 240)


def rectangle(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros((240, 320), bool)
    mask[top:bottom, left:right] = True
    return mask


LEFT, RIGHT = rectangle(90, 80, 150, 140), rectangle(150, 80, 200, 140)  # two cards side by side at one depth


def picture(k: int = 0, moved: int = 0, likeness: float = 0.0) -> Frame:
    """A printed wall and the two cards before it; ``likeness`` of 1 gives both one colour, but a dark line between."""
    rng = np.random.default_rng(3)
    rgb = cv2.resize(rng.integers(60, 120, (24, 32, 3), np.uint8), (320, 240)).astype(float)
    depth = np.full((240, 320), 1.0)
    colours = np.array([[200.0, 60, 40], [40, 90, 200]])
    for mask, colour in zip((LEFT, RIGHT), (colours[0], (1 - likeness) * colours[1] + likeness * colours[0])):
        mask = np.roll(mask, moved, 1)
        rgb[mask], depth[mask] = colour, 0.7
    rgb[:, 149 + moved : 151 + moved][np.roll(LEFT | RIGHT, moved, 1)[:, 149 + moved : 151 + moved]] *= 0.3
    rng = np.random.default_rng(k)
    rgb = np.clip(rgb + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)
    return Frame(k, k / 30, rgb, (depth + rng.normal(0, 0.001, depth.shape)).astype(np.float32))


def segmenter() -> BuiltinSegmenter:
    return BuiltinSegmenter(CAMERA, preset().segmentation)


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return (one & other).sum() / max((one | other).sum(), 1)


def on_a_table(thing: np.ndarray, colour: tuple[int, ...], shade: np.ndarray, seed: int) -> Frame:
    """A thing (H, W) bool as flat as the pale, shaded table that it lies on; the floor beyond is dark."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:240, :320]
    rgb = (np.array([190.0, 175, 150]) - 0.25 * v[..., None] + 8 * np.sin(u / 25)[..., None]) * shade[..., None]
    rgb[thing] = colour
    rgb[200:] = 35, 35, 30
    depth = np.where(v < 200, 0.7, 1.2) + rng.normal(0, 0.0015, v.shape)
    rgb = np.clip(cv2.GaussianBlur(rgb, (0, 0), 0.7) + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)
    return Frame(0, 0.0, rgb, depth.astype(np.float32))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_clicks_along_something_thin_select_it_and_not_the_table(seed):
    """Clicks at both ends of a knife are far apart, and most of what lies between them and around is table."""
    v, u = np.mgrid[:240, :320]
    shadow = 1 - 0.2 * np.exp(-(((u - 168) / 22) ** 2) - ((v - 120) / 45) ** 2)
    knife = cv2.line(np.zeros((240, 320), np.uint8), (150, 90), (175, 150), 1, 7) > 0
    clicks = Prompt("knife", points_px=[[151, 93], [162, 119], [173, 146]])
    assert iou(segmenter().segment(on_a_table(knife, (30, 28, 30), shadow, seed), [clicks]) == 1, knife) > 0.8


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_clicks_on_tongs_do_not_select_the_table_between_their_arms(seed):
    """Most of what lies between the clicks is table, and depth, noisy where things are black, tells nothing."""
    tongs = cv2.line(np.zeros((240, 320), np.uint8), (128, 96), (142, 146), 1, 4)
    tongs = cv2.line(tongs, (166, 98), (142, 146), 1, 5) > 0
    frame = on_a_table(tongs, (25, 24, 26), np.ones(tongs.shape), seed)
    noise_m = np.random.default_rng(seed).normal(0, 0.008, tongs.shape).astype(np.float32)
    frame = replace(frame, depth_m=frame.depth_m + noise_m * tongs)
    clicks = Prompt("tongs", points_px=[[129, 100], [142, 143], [163, 104]])
    assert iou(segmenter().segment(frame, [clicks]) == 1, tongs) > 0.8


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_clicks_close_together_select_all_of_a_cover(seed):
    """Of a printed book, as flat as the table, a fifth lies between the clicks."""
    cover = rectangle(90, 70, 210, 180)
    frame = on_a_table(cover, (120, 70, 130), np.ones(cover.shape), seed)
    rng = np.random.default_rng(seed)
    for line in range(12):
        frame.rgb[95 + 6 * line : 98 + 6 * line, 110 : 110 + rng.integers(40, 80)] = 190, 170, 200
    clicks = Prompt("cover", points_px=[[135, 110], [155, 118], [145, 130]])
    assert iou(segmenter().segment(frame, [clicks]) == 1, cover) > 0.9


def test_a_click_on_one_of_two_stickers_alike_selects_that_one():
    """What is as flat as the table, and of one colour, is told apart by the table between alone."""
    one, other = rectangle(120, 90, 150, 120), rectangle(156, 90, 186, 120)
    frame = on_a_table(one | other, (150, 40, 40), np.ones(one.shape), 0)
    with pytest.warns(Doubt, match="lie in the plane around them"):
        found = segmenter().segment(frame, [Prompt("sticker", points_px=[[135, 105]])]) == 1
    assert iou(found, one) > 0.95


@pytest.mark.parametrize(
    ("ties", "chosen"),
    [((0.44, 0.45, 0.42), 1.0), ((0.44, 0.45, 0.3), 2.5), ((0.3, 0.45, 0.42), 1.0), ((0.2, 0.45, 0.42), 0.4)],
)
def test_another_scale_than_that_of_the_clicks_has_to_be_clearly_better(monkeypatch, ties, chosen):
    """With a towel the outline of a mug is as good as without."""
    told, cut_at = iter(ties), Cutter._cut_at  # one scale after the other, the smallest first
    monkeypatch.setattr(Patch, "outline_tie", lambda patch, mask: next(told))

    def cut(self, scale, *more):
        made = cut_at(self, scale, *more)
        return replace(made, x=np.full_like(made.x, scale))

    monkeypatch.setattr(Cutter, "_cut_at", cut)
    prompt = Prompt("left", points_px=[[110, 100], [120, 110]])
    _, x = Cutter(picture(), CAMERA, preset().segmentation, prompt, np.zeros((0, 2))).start()
    np.testing.assert_allclose(x, chosen)


@pytest.mark.parametrize(
    ("doubtful", "another", "mask", "others", "said"),
    [
        (0.33, LEFT | RIGHT, LEFT, {}, True),
        (0.40, LEFT | RIGHT, LEFT, {}, False),  # its outline is worse
        (0.33, rectangle(90, 80, 160, 140), LEFT, {}, False),  # about the same
        (0.33, LEFT | RIGHT, LEFT, {"right": RIGHT}, False),  # that is another object
        (0.33, LEFT | RIGHT, RIGHT, {}, False),  # not what was cut out: SAM 2 knows better
    ],
)
def test_where_two_cuts_are_as_good_a_click_is_asked_for(monkeypatch, doubtful, another, mask, others, said):
    box = Box(0, 0, 320, 240)
    cuts = [Cut(0.3, box, LEFT.astype(np.float32)), Cut(doubtful, box, another.astype(np.float32))]
    monkeypatch.setattr(Cutter, "cuts", cuts)
    prompt = Prompt("left", points_px=[[110, 100]])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        doubt_prompt(
            Cutter(picture(), CAMERA, preset().segmentation, prompt, np.zeros((0, 2))), mask, others, Effect.BEGUN
        )
    assert bool(caught) == said
    if said:
        text = r"3600 pixels selected; a mask of 6600 fits as well. If pixel \((\d+), (\d+)\)"
        found = re.search(text, str(caught[0].message))
        assert RIGHT[int(found[2]), int(found[1])]


@pytest.mark.parametrize(
    ("clicks", "named"),
    [
        ([[110, 100], [130, 120], [175, 110]], (175, 110)),
        ([[110, 100], [175, 110]], (175, 110)),  # of two, the last
        ([[175, 110], [110, 100], [130, 120]], (175, 110)),
        ([[110, 100], [130, 120], [100, 125]], None),
        ([*([100 + k, 100] for k in range(10)), [175, 110]], None),  # one of many does little harm
    ],
)
def test_a_click_on_another_thing_is_named(clicks, named):
    frame = picture()
    frame.depth_m[RIGHT] += 0.06  # a step of depth and of colour
    cutter = Cutter(frame, CAMERA, preset().segmentation, Prompt("left", points_px=clicks), np.zeros((0, 2)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        doubt_prompt(cutter, LEFT | RIGHT if named else LEFT, {}, Effect.BEGUN_ELSEWHERE)
    said = [re.search(r"alone, the click at \((\d+), (\d+)\) selects something else", str(w.message)) for w in caught]
    assert [tuple(map(int, found.groups())) for found in said if found] == ([named] if named else [])


def test_all_others_that_belong_to_what_is_clicked_are_named():
    prompts = [Prompt(name, points_px=[at]) for name, at in (("a", [100, 90]), ("b", [140, 130]), ("c", [120, 110]))]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        segmenter().segment(picture(), prompts)
    of_c = [str(doubt.message) for doubt in caught if doubt.message.object == "c"]
    assert [any(f"most of {other!r}" in text for text in of_c) for other in "ab"] == [True, True]


def test_one_click_in_a_hole_of_the_depth_does_no_harm():
    frame = picture()
    frame.depth_m[95:106, 105:116] = 0
    clicks = Prompt("left", points_px=[[110, 100], [130, 120], [100, 125]]), Prompt("right", points_px=[[175, 110]])
    assert iou(segmenter().segment(frame, clicks) == 1, LEFT) > 0.9


def test_a_click_beside_the_edge_that_has_no_depth_is_not_on_the_wall():
    """In the shadow beside an edge most of what is measured around is the wall behind. With depth a click stays."""
    frame = picture()
    frame.depth_m[:, 89:92] = frame.depth_m[160:, 200:230] = 0
    clicks = np.array([[89.0, 110], [87.0, 110], [120.4, 110], [215.0, 200]])
    assert _measured(clicks, frame).tolist() == [[92, 110], [87, 110], [120.4, 110], [215, 200]]


def test_one_click_on_an_objects_edge_without_depth_selects_the_object(opening):
    """By a sensor's noise and shadows; around this pixel the wall alone is measured nearer by."""
    video = opening("three_objects", 1)
    frame, block = video.frame(0), video.masks(0)["block"]
    assert frame.depth_m[208, 601] == 0 and block[208, 601]
    follow = BuiltinSegmenter(video.camera, preset().segmentation)
    found = follow.segment(frame, [Prompt("block", points_px=[[601, 208]])]) == 1
    assert iou(found, block) > 0.8


def before(frame: Frame, part: np.ndarray, colour: tuple[int, ...], z_m: float = 0.66) -> Frame:
    """With something else (H, W) bool before it."""
    rgb, depth_m = frame.rgb.copy(), frame.depth_m.copy()
    rgb[part], depth_m[part] = colour, z_m
    return replace(frame, rgb=rgb, depth_m=depth_m)


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_a_finger_between_the_clicks_is_not_of_the_object(tilt):
    """Its hand is beyond them; of a card that is tilted a click is as near as the finger before its far side."""
    finger = rectangle(112, 40, 126, 125) | rectangle(80, 20, 170, 72)
    frame = before(picture(), RIGHT, (90, 90, 90), 1.0)  # one card alone
    frame.depth_m[LEFT] += (tilt * (np.arange(320) - 90) / 60 * np.ones((240, 1)))[LEFT]
    frame = before(frame, finger, (205, 150, 120), 0.66 + 0.6 * tilt)
    clicks = Prompt("left", points_px=[[100, 90], [104, 130], [138, 100]])
    found = segmenter().segment(frame, [clicks]) == 1
    assert iou(found, LEFT & ~finger) > 0.85 and not found[finger].mean() > 0.1


def test_what_ends_between_the_clicks_is_a_part_of_the_object():
    """As a camera's lens."""
    knob = rectangle(106, 98, 130, 122)
    clicks = Prompt("left", points_px=[[100, 90], [98, 130], [142, 110]])
    found = segmenter().segment(before(before(picture(), RIGHT, (90, 90, 90), 1.0), knob, (30, 30, 30)), [clicks]) == 1
    assert found[knob].mean() > 0.9 and iou(found, LEFT) > 0.85


@pytest.mark.parametrize("wrong_px", [(0, 0, 0, 0), (-4, 3, 5, -2), (2, 2, -2, -2)])
def test_a_box_starts_an_object(wrong_px):
    """Drawn a little too wide or too tight; what lies outside is not of the object, though nothing parts them."""
    box = np.add((90, 80, 150, 140), wrong_px)
    found = segmenter().segment(picture(likeness=1.0), [Prompt("left", box_px=box)]) == 1
    assert iou(found, LEFT) > 0.85


@pytest.mark.parametrize("clicks", [(), ((120, 110),)])
def test_a_box_starts_an_object_whose_middle_has_no_depth(clicks):
    """As that of a screen; a click on it is one, too."""
    frame = picture()
    frame.depth_m[95:125, 105:135] = 0
    prompt = Prompt("left", points_px=np.reshape(clicks, (-1, 2)), box_px=(90, 80, 150, 140))
    found = segmenter().segment(frame, [prompt]) == 1
    assert iou(found, LEFT) > 0.8


@pytest.mark.parametrize(("shown", "chosen"), [(1.0, 2.5), (0.9, 2.5), (0.4, 1.0)])
def test_a_cut_that_leaves_much_of_a_box_is_doubted(monkeypatch, shown, chosen):
    """Of two cuts, the better outline but for what a box asks for."""
    ties, cut_out = iter((9.0, 0.45, 0.2)), Cutter._cut_out
    monkeypatch.setattr(Patch, "outline_tie", lambda patch, mask: next(ties))

    def cut(self, patch, *more):
        x, (v, _) = np.zeros_like(cut_out(self, patch, *more)), patch.centres_px()[::-1]
        u, v = patch.centres_px()
        part = shown if len(more) > 4 and next(made) == 2 else 1.0
        x[np.ix_((v >= 80) & (v < 140), (u >= 90) & (u < 90 + 60 * part))] = 1
        return x

    made = iter(range(3))
    monkeypatch.setattr(Cutter, "_cut_out", cut)
    frame, prompt = picture(), Prompt("left", box_px=(90, 80, 150, 140))
    best = Cutter(frame, CAMERA, preset().segmentation, prompt, np.zeros((0, 2))).cuts[0]
    assert (best.whole(frame.shape).sum() > 0.95 * LEFT.sum()) == (chosen == 1.0 or shown > 0.95)


@pytest.mark.parametrize("behind_m", [0.8, 0.9])
def test_a_click_at_an_edge_is_not_on_what_lies_behind_it(behind_m):
    """Three pixels beside it, less than a cell of the coarse grid on which an object is cut out first."""
    rng = np.random.default_rng(0)
    rgb, depth = np.full((240, 320, 3), 150.0), np.full((240, 320), 1.0)
    rgb[90:170, 160:230], depth[90:170, 160:230] = (200, 110, 60), behind_m
    rgb[110:170, 100:160], depth[110:170, 100:160] = (60, 90, 200), 0.7
    rgb[110:170, 140:160] = 200, 110, 60
    frame = Frame(0, 0.0, np.clip(rgb + rng.normal(0, 6, rgb.shape), 0, 255).astype(np.uint8), depth.astype(np.float32))
    found = segmenter().segment(frame, [Prompt("block", points_px=[[157, 140], [120, 120], [110, 160]])]) == 1
    assert iou(found, rectangle(100, 110, 160, 170)) > 0.9


def test_what_depth_keeps_apart_lends_its_colours_to_the_background(monkeypatch):
    """A block before a wall, clicked near another one: before the first cut that is background, however near it is."""
    asked, shares = [], prompted.by_shares
    monkeypatch.setattr(prompted, "by_shares", lambda *more: asked.append(more[:3]) or shares(*more))
    frame, other = picture(), rectangle(154, 80, 200, 140)
    frame.depth_m[other] = 0.8
    cutter = Cutter(frame, CAMERA, preset().segmentation, Prompt("left", points_px=[[145, 110], [100, 90]]), NO_PX)
    assert iou(cutter.cuts[0].whole(frame.shape), LEFT) > 0.9
    patch, own, background = asked[0]
    inner = patch.down(rectangle(164, 90, 190, 130).astype(np.float32)) == 1
    assert inner.any() and not own[inner].any() and (background[inner] == 1).all()


@pytest.mark.parametrize("in_box", [False, True])
def test_within_a_box_points_stand_for_what_is_around_them_and_holes_do_not_end_it(monkeypatch, in_box):
    """A click is exact, and what lies beyond a hole of depth may be another thing."""
    told, of, by = {}, Clicked.of, prompted.by_connection
    monkeypatch.setattr(
        Clicked, "of", lambda patch, px, z_m, *more: told.update(exact=more[1:]) or of(patch, px, z_m, *more)
    )
    monkeypatch.setattr(prompted, "by_connection", lambda *more: told.update(holes=more[4:]) or by(*more))
    prompt = Prompt("left", box_px=(90, 80, 150, 140)) if in_box else Prompt("left", points_px=[[110, 100], [120, 110]])
    assert Cutter(picture(), CAMERA, preset().segmentation, prompt, NO_PX).cuts
    assert told == {"exact": (not in_box,), "holes": (in_box,)}


def test_a_box_that_reaches_beyond_the_image_is_cut_to_it():
    frame = picture(moved=-100)
    found = segmenter().segment(frame, [Prompt("left", box_px=(-40, 75, 52, 145))]) == 1
    assert iou(found, rectangle(0, 80, 50, 140)) > 0.85


def test_a_mask_is_taken_as_it_is_and_followed():
    follow, odd = segmenter(), LEFT & ~rectangle(100, 90, 110, 100)
    np.testing.assert_array_equal(follow.segment(picture(), [Prompt("left", mask=odd)]) == 1, odd)
    for k in range(1, 4):
        found = follow.segment(picture(k, 3 * k)) == 1
        assert iou(found, np.roll(LEFT, 3 * k, 1)) > 0.9


def test_masks_in_between_are_taken_and_an_empty_one_says_hidden():
    """The segmenter goes on from the newest: an object that is said to be hidden is not found where nobody saw it."""
    follow = segmenter()
    follow.segment(picture(0), [Prompt("left", mask=LEFT)])
    follow.segment(picture(1))
    given = np.roll(LEFT, 12, 1)
    np.testing.assert_array_equal(follow.segment(picture(2, 12), [Prompt("left", mask=given)]) == 1, given)
    assert iou(follow.segment(picture(3, 14)) == 1, np.roll(LEFT, 14, 1)) > 0.9
    nothing = np.zeros_like(LEFT)
    assert not follow.segment(picture(4, 14), [Prompt("left", mask=nothing)]).any()
    assert not follow.segment(picture(5, 14)).any() and follow.names == ("left",)


def test_two_of_one_colour_that_touch_are_told_apart_by_the_clicks_on_each():
    prompts = [Prompt("left", points_px=[[110, 100]]), Prompt("right", points_px=[[175, 110]])]
    found = segmenter().segment(picture(likeness=1.0), prompts)
    assert iou(found == 1, LEFT) > 0.85 and iou(found == 2, RIGHT) > 0.85


def test_a_click_beside_the_object_says_what_is_not_of_it():
    """Both cards are one surface of one colour; the click on the other one takes it off, up to the line between."""
    frame, on = picture(likeness=1.0), [[110, 100]]
    without = segmenter().segment(frame, [Prompt("left", points_px=on)]) == 1
    found = segmenter().segment(frame, [Prompt("left", points_px=on, negative_px=[[175, 110]])]) == 1
    assert iou(without, LEFT | RIGHT) > 0.9 and iou(found, LEFT) > 0.9


@pytest.mark.parametrize(
    ("was", "say"),
    [
        (LEFT | RIGHT, {"negative_px": [[175, 110]]}),
        (LEFT & rectangle(90, 80, 115, 140), {"points_px": [[140, 120]], "negative_px": [[175, 110]]}),
        (RIGHT, {"box_px": (90, 80, 150, 140)}),
    ],
)
def test_a_correction_mends_the_mask_and_lasts(was, say):
    follow = segmenter()
    follow.segment(picture(0), [Prompt("left", mask=was)])
    found = follow.segment(picture(1), [Prompt("left", 1, **say)]) == 1
    assert iou(found, LEFT) > 0.85 > iou(was, LEFT)
    assert iou(follow.segment(picture(2)) == 1, LEFT) > 0.8


WALL = rectangle(20, 20, 60, 50)  # part of it


@pytest.mark.parametrize(
    ("was", "say", "left", "right", "wall"),
    [
        (LEFT | WALL, {"points_px": [[110, 100]], "negative_px": [[175, 110]]}, 1, 0, 1),
        (LEFT | RIGHT | WALL, {"negative_px": [[40, 35]]}, 1, 1, 0),
        (WALL | LEFT & rectangle(90, 80, 120, 140), {"points_px": [[140, 120]]}, 1, 0, 1),
        (WALL, {"points_px": [[120, 110]], "negative_px": [[175, 110]]}, 1, 0, 0),
    ],
    ids=["clicks that agree", "one beside it", "one on what is missing", "all clicks far from it"],
)
def test_what_no_click_contradicts_stays(was, say, left, right, wall):
    """Part of the wall counts as the object until a click says that it does not, or none is near the mask."""
    frame, follow = picture(), segmenter()
    follow.segment(frame, [Prompt("left", mask=was)])
    found = follow.segment(frame, [Prompt("left", **say)]) == 1
    for part, share in ((LEFT, left), (RIGHT, right), (WALL, wall)):
        assert found[part].mean() == pytest.approx(share, abs=0.1)


@pytest.mark.parametrize(
    ("say", "stays"),
    [
        ({"negative_px": [[175, 110]]}, False),
        ({"points_px": [[61, 101]], "negative_px": [[175, 110]]}, True),
        ({"points_px": [[110, 100]]}, True),
    ],
    ids=["a click beside the object", "and one on the speck", "clicks on the object alone"],
)
def test_specks_go_where_clicks_take_something_away(say, stays):
    """Unless one is clicked on; another part, that is no speck, stays all the same."""
    frame, follow, speck = picture(), segmenter(), rectangle(60, 100, 63, 103)
    follow.segment(frame, [Prompt("left", mask=LEFT | RIGHT | WALL | speck)])
    found = follow.segment(frame, [Prompt("left", **say)]) == 1
    assert found[speck].any() == stays and found[WALL].mean() > 0.9


def test_a_mask_is_corrected_in_the_image_that_it_is_of():
    """As the page shows what a click makes of a run's mask: nothing is followed from an image to itself."""
    odd = LEFT & ~rectangle(100, 90, 110, 100) | rectangle(60, 100, 90, 110)
    frame, follow = picture(0), segmenter()
    follow.segment(frame, [Prompt("left", mask=odd)])
    np.testing.assert_array_equal(follow.segment(frame, [Prompt("left", points_px=[[130, 120]])]) == 1, odd)
    mended = follow.segment(frame, [Prompt("left", negative_px=[[70, 105]])]) == 1
    assert not mended[100:110, 60:86].any() and iou(mended, odd & LEFT) > 0.95


def test_a_click_brings_back_what_was_given_up():
    follow = segmenter()
    follow.segment(picture(0), [Prompt("left", mask=LEFT)])
    follow.segment(picture(1), [Prompt("left", mask=np.zeros_like(LEFT))])
    say = Prompt("left", 2, points_px=[[110, 100]], negative_px=[[175, 110]])
    assert iou(follow.segment(picture(2), [say]) == 1, LEFT) > 0.9


def test_a_refused_prompt_changes_nothing():
    follow, other = segmenter(), segmenter()
    for one in (follow, other):
        one.segment(picture(0), [Prompt("left", mask=LEFT)])
    frame = picture(1)
    hole = frame.depth_m.copy()
    hole[95:106, 170:181] = 0
    frame = Frame(1, 1 / 30, frame.rgb, hole)
    for prompt, match in (
        (Prompt("right", 1, points_px=[[175, 100]]), r"clicks on 'right': got \(175, 100\) has no depth in frame 1"),
        (Prompt("right", 1, points_px=[[320, 100]]), "clicks on 'right'"),
        (Prompt("right", 1, box_px=(172, 97, 178, 103)), "box around 'right': got no depth inside it in frame 1"),
    ):
        with pytest.raises(BadInput, match=match):
            follow.segment(frame, [Prompt("left", 1, negative_px=[[5, 5]]), prompt])
    assert follow.names == ("left",)
    np.testing.assert_array_equal(follow.segment(frame), other.segment(frame))


@pytest.mark.parametrize(
    ("prompts", "said"),
    [
        ([Prompt("a", points_px=[[30, 40]])], "clicks on 'a' in frame 0: .* lie in the plane around them"),
        (
            [Prompt("a", points_px=[[100, 90]]), Prompt("b", points_px=[[140, 130]])],
            "clicks on 'b' in frame 0: the prompt selects most of 'a', too. If they are one object",
        ),
        ([Prompt("left", points_px=[[100, 90]]), Prompt("right", points_px=[[175, 110]])], None),
        ([Prompt("left", box_px=(90, 80, 150, 140))], None),
    ],
)
def test_what_is_hardly_meant_is_said(prompts, said):
    """The wall; two objects on one body. What is meant is taken without a word."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        labels = segmenter().segment(picture(), prompts)
    assert [d.category for d in doubts] == [Doubt] * len(doubts) and bool(doubts) == bool(said)
    assert said is None or any(re.search(said, str(d.message)) for d in doubts)
    assert labels.max() == len(prompts)  # tracking goes on


def test_nothing_found_is_said():
    frame = picture()
    speck = np.zeros_like(frame.depth_m)
    speck[108:111, 173:176] = frame.depth_m[108:111, 173:176]
    with pytest.warns(Doubt, match="clicks on 'right' in frame 0: no object was found there"):
        segmenter().segment(Frame(0, 0.0, frame.rgb, speck), [Prompt("right", points_px=[[174, 109]])])


@pytest.mark.parametrize("say", [{"points_px": [[280, 200]]}, {"box_px": (278, 198, 283, 203)}])
def test_what_selects_nothing_leaves_an_object_its_mask(say):
    """A correction on a speck of depth where nothing else has any; the object goes on as it was."""
    follow, frame = segmenter(), picture(1)
    speck = np.where(rectangle(230, 150, 320, 240), 0, frame.depth_m)
    speck[199:202, 279:282] = frame.depth_m[199:202, 279:282]
    follow.segment(picture(0), [Prompt("left", mask=LEFT)])
    instead = ", too." if "box_px" in say else ", or draw a box."  # that is no advice to who drew one
    words = r"'left' in frame 1: no object was found there\. It keeps the mask that it had\. .* of other colours"
    with pytest.warns(Doubt, match=words + instead) as said:
        kept = follow.segment(Frame(1, 1 / 30, frame.rgb, speck), [Prompt("left", 1, **say)]) == 1
    assert [str(doubt.message) for doubt in said] == [follow.doubts["left"]], "and nothing else is"
    assert iou(kept, LEFT) > 0.9 and iou(follow.segment(picture(2)) == 1, LEFT) > 0.9


def test_doubts_are_of_the_newest_prompts(monkeypatch):
    """Whether one began a mask, or mended it, and whether that was far from another."""
    monkeypatch.setattr(built_in, "doubt_prompt", lambda cutter, mask, others, effect: effect)
    cutter = segmenter()
    cutter.segment(picture(), [Prompt("left", points_px=[[120, 110]])])
    assert cutter.doubts == {"left": "begun"}
    cutter.segment(picture(1), [Prompt("left", points_px=[[121, 111]]), Prompt("right", points_px=[[174, 109]])])
    assert cutter.doubts == {"left": "mended", "right": "begun"}
    cutter.segment(picture(2))
    assert cutter.doubts == {}
    cutter.segment(picture(3), [Prompt("left", points_px=[[40, 35]])])
    assert cutter.doubts == {"left": "begun elsewhere"}, "far from what it was followed by"


@pytest.mark.parametrize(
    ("was", "say", "said"),
    [
        (LEFT, {"points_px": [[122, 112]]}, ""),
        (WALL, {"points_px": [[120, 110]]}, "farther from its mask than that is long. It starts anew there."),
        (LEFT, {"points_px": [[290, 220]]}, "check that depth is in metres."),
        (LEFT, {"box_px": (250, 180, 310, 230)}, "check that depth is in metres."),
    ],
)
def test_a_correction_that_starts_anew_is_doubted(was, say, said):
    follow = segmenter()
    follow.segment(picture(0), [Prompt("left", mask=was)])
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        follow.segment(picture(1), [Prompt("left", 1, **say)])
    assert follow.doubts.get("left", "").endswith(said) and bool(follow.doubts) == bool(said)


def test_a_click_that_the_mask_goes_against_all_the_same_is_named(recwarn):
    cutter = SimpleNamespace(prompt=Prompt("left", 1, [[110, 100], [40, 35]], [[100, 90]]), frame=picture(1))
    assert "(40, 35) is outside its mask all the same" in doubt_prompt(cutter, LEFT, {}, Effect.MENDED)
    cutter.prompt = Prompt("left", 1, [[110, 100]], [[100, 90]])
    assert "(100, 90) is inside its mask all the same" in doubt_prompt(cutter, LEFT, {}, Effect.MENDED)


@pytest.mark.parametrize(
    ("was", "say", "match"),
    [
        (
            WALL,
            {"box_px": (85, 75, 155, 145)},
            "box around 'left' in frame 1: nothing of its mask is inside. It starts",
        ),
        (LEFT, {"box_px": (85, 75, 155, 145)}, None),
        (
            None,
            {"negative_px": [[175, 110]]},
            "negative clicks on 'left' in frame 1: it has no mask .* Click on it, too",
        ),
    ],
    ids=["a box beside it", "a box around it", "negative clicks while it is away"],
)
def test_a_correction_that_begins_elsewhere_or_takes_from_nothing_says_so(was, say, match):
    follow = segmenter()
    follow.segment(picture(0), [Prompt("left", mask=LEFT if was is None else was)])
    if was is None:
        follow.segment(picture(0), [Prompt("left", mask=np.zeros_like(LEFT))])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        follow.segment(picture(1), [Prompt("left", 1, **say)])
    assert [bool(re.match(match or "", str(doubt.message))) for doubt in caught] == [True] * bool(match)
