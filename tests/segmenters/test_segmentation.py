"""The embedded segmenter on an analytic scene and on the embedded sequence: outlines, absence, causality."""

import copy
from functools import cache

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.depth import depths_at
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.method.refinement import surface_distance
from p2p_lib.segmenters.builtin import following
from p2p_lib.segmenters.builtin import segmenter as segmenter_page
from p2p_lib.segmenters.builtin.colours import colour_codes, evidence, histogram
from p2p_lib.segmenters.builtin.patch import (
    Patch,
    around,
    components_touching,
    connected_components,
    plane_heights,
    support_plane,
)
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter

CAMERA = Camera(300.0, 310.0, 158.3, 121.7, 320, 240)
CONFIG = preset().segmentation
WALL_M, CARD_M, BOARD_M = 1.0, 0.7, 0.5


def card(at: tuple[int, int], size: tuple[int, int] = (60, 50)) -> np.ndarray:
    """(H, W) bool of a card whose upper left corner is at a pixel (x, y)."""
    mask = np.zeros((240, 320), bool)
    x, y = at
    mask[max(y, 0) : max(y + size[1], 0), max(x, 0) : max(x + size[0], 0)] = True
    return mask


@cache
def _print(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(30, 226, (24, 32, 3), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)


def picture(k: int, cards: list[tuple[tuple[int, int], int]], board: np.ndarray | None = None) -> Frame:
    """A frame of a printed wall, cards at pixels, each with its own print and depth, and perhaps a board before all."""
    rng = np.random.default_rng(k)
    rgb, depth = (_print(99) // 2 + 60).copy(), np.full((240, 320), WALL_M)
    for at, seed in cards:
        mask, moved = card(at), np.roll(_print(seed), at[::-1], (0, 1))
        rgb[mask], depth[mask] = moved[mask], CARD_M + 0.05 * (seed % 2)
    if board is not None:
        rgb[board], depth[board] = (150, 110, 70), BOARD_M
    rgb = np.clip(rgb + rng.normal(0, 2, rgb.shape), 0, 255).astype(np.uint8)
    return Frame(k, k / 30, rgb, (depth + rng.normal(0, 0.001, depth.shape)).astype(np.float32))


def on(**at) -> list[Prompt]:
    """Three clicks on each card, whose upper left corners are given."""
    clicks = np.array([[12, 12], [40, 20], [25, 38]])
    return [Prompt(name, points_px=corner + clicks) for name, corner in at.items()]


def segmenter() -> BuiltinSegmenter:
    return BuiltinSegmenter(CAMERA, CONFIG)


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return (one & other).sum() / max((one | other).sum(), 1)


# --- the first frame ---------------------------------------------------------------------------


@pytest.mark.parametrize("at", [(100, 80), (2, 3), (255, 185)])
def test_an_object_is_found_from_clicks(at):
    found = segmenter().segment(picture(0, [(at, 1)]), on(card=at))
    assert found.dtype == np.int32 and iou(found == 1, card(at)) > 0.93


def test_objects_that_touch_in_the_picture_are_told_apart():
    left, right = (90, 80), (150, 90)
    found = segmenter().segment(picture(0, [(left, 2), (right, 3)]), on(one=left, two=right))
    assert iou(found == 1, card(left)) > 0.9 and iou(found == 2, card(right)) > 0.9


def test_a_flat_print_is_found_by_its_colours():
    """A sticker on the wall: depth knows nothing of it."""
    frame = picture(0, [])
    rgb = frame.rgb.copy()
    rgb[card((120, 90))] = (220, 60, 40)
    found = segmenter().segment(Frame(0, 0.0, rgb, frame.depth_m), on(sticker=(120, 90)))
    assert iou(found == 1, card((120, 90))) > 0.9


def test_a_box_on_a_table_ends_at_the_table():
    """Colour and depth are continuous where it stands; the plane tells."""
    v, u = np.mgrid[:240, :320]
    rays_y = (v - CAMERA.cy) / CAMERA.fy
    # A table that falls away from the camera: y = 0.15 + 0 z, seen below the horizon.
    table_m = np.where(rays_y > 0.02, 0.15 / np.maximum(rays_y, 0.02), 3.0)
    foot = 150
    box = (u > 130) & (u < 190) & (v > 90) & (v <= foot)
    depth = np.where(box, table_m[foot, 0], np.minimum(table_m, 2.0))
    rgb = (_print(7) // 8 + 100).astype(np.uint8)
    rgb[box] = rgb[box] // 2 + 40
    frame = Frame(0, 0.0, rgb, depth.astype(np.float32))
    found = segmenter().segment(frame, [Prompt("box", points_px=[[150, 110], [170, 120], [160, 130]])])
    assert iou(found == 1, box) > 0.85


def test_where_nothing_is_measured_colours_say_whose_it_is():
    """A hole in the card, and one across its edge."""
    at, follow = (100, 80), segmenter()
    frame = picture(0, [(at, 1)])
    depth = frame.depth_m.copy()
    depth[95:105, 120:135] = depth[88:112, 90:106] = 0
    for k in range(3):
        found = follow.segment(Frame(k, k / 30, frame.rgb, depth), () if k else on(card=at)) == 1
        assert found[96:104, 121:134].all() and iou(found, card(at)) > 0.96


def test_where_most_of_an_object_loses_its_depth_its_colours_carry_it():
    at, follow = (100, 80), segmenter()
    for k in range(6):
        frame = picture(k, [(at, 1)])
        frame.depth_m[:, : 80 + 14 * k] = 0  # from the left, over most of the card, and the wall before it
        found = follow.segment(frame, () if k else on(card=at)) == 1
    assert iou(found, card(at)) > 0.85


def test_what_has_no_depth_is_taken_in_beside_what_has_it_alone():
    """Beside the card something of its colour begins that has no depth."""
    at, follow = (100, 80), segmenter()
    for k in range(4):
        frame = picture(k, [(at, 1)])
        frame.rgb[card(at)] = 20, 120, 30
        if k:
            frame.rgb[90:120, 160:180], frame.depth_m[90:120, 160:180] = (20, 120, 30), 0
        found = follow.segment(frame, () if k else on(card=at)) == 1
        assert iou(found, card(at)) > 0.96


def test_where_nothing_is_measured_colours_outweigh_where_it_was():
    """From one frame to the next a third of the card shows the wall's colour, and its depth is missing."""
    at, follow = (100, 80), segmenter()
    for k in range(3):
        frame = picture(k, [(at, 1)])
        frame.rgb[:], frame.rgb[card(at)] = (150, 140, 120), (20, 120, 30)
        if k:
            frame.rgb[80:130, 140:160], frame.depth_m[80:130, 140:160] = (150, 140, 120), 0
        found = follow.segment(frame, () if k else on(card=at)) == 1
    assert not found[:, 142:].any() and iou(found, card(at, (40, 50))) > 0.93


# --- from frame to frame -----------------------------------------------------------------------


def path(k: int) -> tuple[int, int]:
    return 60 + 4 * k, 80 + k


def test_a_moving_object_is_followed():
    follow = segmenter()
    for k in range(30):
        found = follow.segment(picture(k, [(path(k), 1)]), () if k else on(card=path(0))) == 1
        assert iou(found, card(path(k))) > 0.9, k


def test_two_objects_pass_and_keep_their_names():
    """The nearer one covers the other for a while, but never all of it."""
    one, two = lambda k: (60 + 4 * k, 90), lambda k: (180 - 4 * k, 120)
    follow = segmenter()
    for k in range(30):
        clicks = () if k else on(far=one(0), near=two(0))
        found = follow.segment(picture(k, [(one(k), 3), (two(k), 2)]), clicks)
        near = card(two(k))
        far = card(one(k)) & ~near
        assert iou(found == 2, near) > 0.85 and iou(found == 1, far) > 0.75, k


def test_objects_beside_it_say_what_is_theirs(monkeypatch):
    """Hints cost: those of objects that are far away are not asked for."""
    places, told = {"one": (80, 80), "two": (145, 80), "far": (230, 160)}, {}
    hints = {name: Hint(np.array([at], float)) for name, at in places.items()}

    def follow(view, target, hint, others, predicted):
        told[tuple(hint.uv_px[0])] = [tuple(other.uv_px[0]) for other in others]
        return predicted.claim

    monkeypatch.setattr(segmenter_page, "follow", follow)
    of = segmenter()
    for k in range(2):
        of.segment(picture(k, [(at, 1) for at in places.values()]), () if k else on(**places), hints)
    assert told == {places["one"]: [places["two"]], places["two"]: [places["one"]], places["far"]: []}


def test_what_is_covered_is_absent_whatever_covers_it():
    """A board slides over the resting card: nothing of the board is taken for it; points bring it back."""
    at = (120, 80)
    follow = segmenter()
    for k in range(26):
        board = np.zeros((240, 320), bool)
        board[40:200, max(0, 8 * k - 60) : 8 * k] = True
        found = follow.segment(picture(k, [(at, 1)], board), () if k else on(card=at)) == 1
        assert not (found & board).any()
        if not (card(at) & ~board).any():
            assert not found.any()
    # Gone since it was covered, until somebody knows points of it.
    assert not found.any()
    frame = picture(40, [((30, 150), 1)])
    assert not (follow.segment(frame) == 1).any()
    points = np.array([[38.0, 158], [50, 165], [60, 170], [70, 160], [80, 190], [45, 185], [60, 190], [75, 175]])
    found = follow.segment(frame, hints={"card": Hint(points)}) == 1
    assert iou(found, card((30, 150))) > 0.9


def test_what_was_found_by_its_colours_alone_is_left_for_where_its_points_are():
    """Something of its colours stood where its motion led; then it comes out elsewhere."""
    at, alike, back, follow = (40, 90), (230, 95), (130, 150), segmenter()

    def red(k: int, *where: tuple[int, int]) -> Frame:
        frame = picture(k, [(corner, 1) for corner in where], None if where else card(at, (160, 120)))
        for corner in where:
            frame.rgb[card(corner)] = 200, 40, 30
        return frame

    follow.segment(red(0, at), on(card=at))
    assert not (follow.segment(red(1)) == 1).any()
    place = CAMERA.unproject(np.add([alike], [30, 25]), np.array([CARD_M + 0.05]))[0]
    found = follow.segment(red(2, alike), hints={"card": Hint(place=np.append(place, 0.05))}) == 1
    assert iou(found, card(alike)) > 0.9
    points = np.add([[8, 8], [50, 10], [30, 20], [12, 30], [45, 40], [25, 42], [52, 28], [18, 18]], back).astype(float)
    for k in (3, 4):
        found = follow.segment(red(k, alike, back), hints={"card": Hint(points, T_cam_obj=np.eye(4))}) == 1
        assert iou(found, card(back)) > 0.9


def test_what_was_seen_beside_the_object_is_not_taken_for_it_while_it_is_hidden():
    """Where its motion leads stands something red: since before, or only now; or the card where it was."""
    at, beside = (40, 90), (230, 95)
    points = np.add([[8, 8], [50, 10], [30, 20], [12, 30], [45, 40], [25, 42], [52, 28], [18, 18]], at).astype(float)

    def red(k: int, *where: tuple[int, int]) -> Frame:
        frame = picture(k, [(corner, 1) for corner in where], card(at, (160, 120)) if at not in where else None)
        for corner in where:
            frame.rgb[card(corner)] = 200, 40, 30
        return frame

    def found(known: BuiltinSegmenter, *where: tuple[int, int]) -> np.ndarray:
        centre = np.add(where[-1], [30, 25])[None]
        place = CAMERA.unproject(centre, np.array([CARD_M + 0.05]))[0]
        return known.segment(red(3, *where), hints={"card": Hint(place=np.append(place, 0.05))}) == 1

    def shown(*others: Frame) -> BuiltinSegmenter:
        """Shown with these beside it, which are hidden with it."""
        known = segmenter()
        known.segment(others[0], on(card=at))
        known.segment(others[1], hints={"card": Hint(points, T_cam_obj=np.eye(4))})
        return known

    with_twin, alone = shown(red(0, at, beside), red(1, at, beside)), shown(red(0, at), red(1, at))
    poster, hand = [red(k, at) for k in (0, 1)], [red(k, at, beside) for k in (0, 1)]
    for frame in poster:
        frame.rgb[card(beside)] = 200, 40, 30
    for frame in hand:
        frame.rgb[card(beside)] = 210, 160, 130
    for known in (with_twin, alone, with_poster := shown(*poster), with_hand := shown(*hand)):
        assert not (known.segment(red(2, *[beside] * (known is with_twin))) == 1).any(), "hidden"
    assert not found(copy.deepcopy(with_twin), beside).any()
    carried = copy.deepcopy(with_twin)
    for left in range(220, 100, -10):
        assert not found(carried, (left, 95)).any(), "it moves, or the camera does"
    assert with_twin._targets["card"].bystanders is not None
    assert iou(found(with_twin, beside, at), card(at)) > 0.9, "that is its own place"
    assert with_twin._targets["card"].bystanders is None
    carried.segment(red(3, beside))
    assert carried._targets["card"].bystanders is None, "nobody expects it any more"
    for known in (alone, with_poster, with_hand):
        assert iou(found(known, beside), card(beside)) > 0.9, "nothing of its colours was there before"


def test_what_comes_out_where_its_motion_leads_is_known_by_its_colours():
    """No point of it is found again, since it shows another side."""
    at, back, follow = (40, 90), (230, 95), segmenter()

    def painted(k: int, where: tuple[int, int], rgb: tuple[int, int, int]) -> Frame:
        frame = picture(k, [(where, 1)])
        frame.rgb[card(where)], frame.rgb[150:] = rgb, (90, 90, 90)
        return frame

    first = painted(0, at, (200, 40, 30))
    first.rgb[card(at, (60, 40))] = (90, 90, 90)  # as the wall's lower end
    follow.segment(first, on(card=at))
    assert not (follow.segment(picture(1, [], card(at, (160, 120)))) == 1).any()

    def found(frame: Frame, reach_m: float = 0.05, aside_m: float = 0.0) -> np.ndarray:
        place = CAMERA.unproject(np.add([back], [30, 25]), np.array([CARD_M + 0.05]))[0] + [aside_m, 0, 0]
        return copy.deepcopy(follow).segment(frame, hints={"card": Hint(place=np.append(place, reach_m))}) == 1

    there = painted(2, back, (200, 40, 30))
    assert iou(found(there), card(back)) > 0.9 and iou(found(there, 0.3, -0.3), card(back)) > 0.9
    assert not found(there, aside_m=-0.3).any(), "out of reach"
    for other in ((40, 160, 30), (90, 90, 90)):
        assert not found(painted(2, back, other)).any(), "in other colours"
    flat = picture(2, [])
    flat.rgb[card(back)] = 200, 40, 30
    place = np.append(CAMERA.unproject(np.add([back], [30, 25]), np.array([WALL_M]))[0], 0.05)
    on_wall = copy.deepcopy(follow).segment(flat, hints={"card": Hint(place=place)})
    assert not (on_wall == 1).any(), "it is painted on the wall"
    tiny = picture(2, [])
    tiny.rgb[card((255, 118), (8, 8))], tiny.depth_m[card((255, 118), (8, 8))] = (200, 40, 30), CARD_M
    assert not found(tiny).any(), "a few pixels"
    speck = painted(2, back, (40, 160, 30))
    speck.rgb[card((255, 118), (8, 8))] = 200, 40, 30
    assert not found(speck).any(), "a few pixels of something else"
    behind = {"card": Hint(place=np.array([0.2, 0.0, -0.6, 0.3]))}
    assert not (copy.deepcopy(follow).segment(there, hints=behind) == 1).any()
    small, piece = picture(2, []), card((250, 115), (14, 12))
    small.rgb[piece], small.depth_m[piece] = (200, 40, 30), CARD_M
    for z_m, there_px in ((CARD_M + 0.05, 100), (CARD_M + 0.25, 0)):
        place = np.append(CAMERA.unproject(np.array([[257, 121]]), np.array([z_m]))[0], 0.05)
        shown = copy.deepcopy(follow).segment(small, hints={"card": Hint(place=place)}) == 1
        assert (shown & piece).sum() >= there_px and shown.any() == (there_px > 0)
    twin = card((162, 90), (60, 56))
    there.rgb[twin], there.depth_m[twin] = (200, 40, 30), CARD_M
    hints = {"card": Hint(place=np.array([0.2, 0.0, 0.75, 0.2]))}
    beside = copy.deepcopy(follow).segment(there, [Prompt("twin", 2, mask=twin)], hints)
    assert iou(beside == 1, card(back)) > 0.7, "its larger twin is another object"
    rest = [Prompt("twin", 2, mask=card(back, (40, 50)))]
    left_out = copy.deepcopy(follow).segment(painted(2, back, (200, 40, 30)), rest, hints)
    assert not (left_out == 1).any(), "what another object's mask leaves out of it"


def test_points_on_something_else_do_not_bring_it_back():
    at = (120, 80)
    follow = segmenter()
    follow.segment(picture(0, [(at, 1)]), on(card=at))
    gone = picture(1, [], board=card(at, (160, 120)))
    assert not (follow.segment(gone) == 1).any()
    wrong = np.stack(np.meshgrid([140.0, 180, 220], [100.0, 130, 160]), -1).reshape(-1, 2)
    assert not (follow.segment(gone, hints={"card": Hint(wrong)}) == 1).any()


def test_points_that_agree_on_its_pose_bring_it_back_in_another_light():
    """The camera looked away and exposes anew: nothing has the colours that were learnt."""
    at, back, follow = (120, 80), (30, 150), segmenter()
    follow.segment(picture(0, [(at, 1)]), on(card=at))
    follow.segment(picture(1, [], board=card(at, (160, 120))))
    bright = picture(2, [(back, 1)])
    bright.rgb[:] = np.clip(bright.rgb * 0.3 + 170, 0, 255)
    points = np.add(back, np.stack(np.meshgrid([8, 20, 35, 50], [8, 22, 40]), -1).reshape(-1, 2)).astype(float)

    def found(hint: Hint) -> np.ndarray:
        return copy.deepcopy(follow).segment(bright, hints={"card": hint}) == 1

    assert iou(found(Hint(points, T_cam_obj=np.eye(4))), card(back)) > 0.9
    assert not found(Hint(points)).any(), "no pose that they agree on"


def test_colours_that_change_are_learned():
    """The light turns from red to blue; when the card comes back it has the colours that it had last."""
    at, follow = (120, 80), segmenter()

    def lit(k: int, where: tuple[int, int]) -> Frame:
        frame, share = picture(k, [(where, 1)]), min(k / 40, 1)
        rgb = frame.rgb.copy()
        rgb[card(where)] = (220 - 190 * share, 40, 40 + 190 * share)
        return Frame(k, k / 30, rgb, frame.depth_m)

    for k in range(80):
        follow.segment(lit(k, at), () if k else on(card=at))
    follow.segment(picture(80, [], card(at, (160, 120))))
    back = (30, 150)
    points = np.add(back, np.stack(np.meshgrid([8, 20, 35, 50], [8, 22, 40]), -1).reshape(-1, 2)).astype(float)
    found = follow.segment(lit(81, back), hints={"card": Hint(points)}) == 1
    assert iou(found, card(back)) > 0.9


def test_what_nothing_else_tells_apart_stays_where_it_was():
    """A piece of the printed wall, given as a mask: neither depth nor colours nor edges end it."""
    piece, follow = card((120, 90)), segmenter()
    follow.segment(picture(0, []), [Prompt("piece", 0, mask=piece)])
    for k in range(1, 6):
        found = follow.segment(picture(k, [])) == 1
    assert iou(found, piece) > 0.8


def test_a_side_that_comes_into_view_is_of_the_object():
    """In a colour that nothing had, and not there a frame ago: it hangs together with what was."""
    at, follow = (120, 80), segmenter()
    side = np.roll(card(at), 60, 1) & (np.arange(320) < 190)

    def turned(k: int) -> Frame:
        frame = picture(k, [(at, 1)])
        if k:
            frame.rgb[side], frame.depth_m[side] = (200, 40, 200), frame.depth_m[card(at)].mean()
        return frame

    for k in range(8):
        found = follow.segment(turned(k), () if k else on(card=at)) == 1
    assert iou(found, card(at) | side) > 0.9 and found[side].mean() > 0.8


@pytest.mark.parametrize("over_px", [0, 12])
@pytest.mark.parametrize("corrected", ["clicks", "negative", "box", "elsewhere"])
def test_what_a_correction_has_taken_from_the_mask_stays_out_when_it_comes_back(corrected, over_px):
    """As a hand: without the correction it is a side that comes into view. Of another place nothing is denied."""
    at, follow = (120, 80), segmenter()
    side = np.roll(card(at), 60, 1) & (np.arange(320) < 190)
    (clicks,) = on(card=at)
    correction = {
        "clicks": [Prompt("card", points_px=clicks.points_px, negative_px=[[185, 90], [185, 105], [185, 120]])],
        "negative": [Prompt("card", negative_px=[[185, 90], [185, 105], [185, 120]])],
        "box": [Prompt("card", box_px=[118, 78, 180, 131])],
        "elsewhere": [Prompt("card", points_px=[[20, 200], [30, 210], [40, 205]])],
    }[corrected]
    prompts = {0: [clicks], 5: correction}
    for k in range(14):
        frame, hand = picture(k, [(at, 1), ((10, 180), 3)]), np.roll(side, -over_px if k > 8 else 0, 1)
        if 0 < k < 6 or k > 8:
            frame.rgb[hand], frame.depth_m[hand] = (200, 40, 200), frame.depth_m[card(at)].mean()
        found = follow.segment(frame, prompts.get(k, ())) == 1
        assert k != 4 or found[hand].mean() > 0.8
    assert (follow._targets["card"].denied is None) == (corrected == "elsewhere")
    assert corrected == "elsewhere" or (found[hand].mean() < 0.05 and iou(found, card(at) & ~hand) > 0.9)


@pytest.mark.parametrize("on_surface", [True, False])
def test_a_side_as_plain_as_the_wall_is_of_the_object_where_its_surface_is(on_surface):
    """By its colours it is the wall, which is beside it and in the same depth; what is reconstructed tells better."""
    at, follow = (120, 80), segmenter()
    side = np.roll(card(at), 60, 1) & (np.arange(320) < 190)
    surface_m = np.where(card(at) | (side & on_surface), 0, np.nan).astype(np.float32)
    for k in range(8):
        frame = picture(k, [(at, 1)])
        if k:
            frame.rgb[side], frame.depth_m[side] = (90, 90, 90), frame.depth_m[card(at)].mean()
        frame.rgb[:, 240:] = 90
        hints = {"card": Hint(np.zeros((0, 2)), surface_m)} if k else None
        found = follow.segment(frame, () if k else on(card=at), hints) == 1
    assert (found[side].mean() > 0.8) == on_surface


def test_colours_are_compared_with_all_that_was_beside_it_connected_or_not(monkeypatch):
    """Something in the card's own colours is connected with it as soon as it touches."""
    at, follow, told, both = (100, 80), segmenter(), {}, 0

    def noted(name):
        inner = getattr(following, name)

        def call(*asked, **more):
            told[name] = asked, inner(*asked, **more)
            return told[name][1]

        monkeypatch.setattr(following, name, call)

    for name in ("follow", "by_geometry", "by_colour"):
        noted(name)
    monkeypatch.setattr(segmenter_page, "follow", following.follow)
    for k in range(14):
        frame, left = picture(k, [(at, 2)]), max(240 - 10 * k, 160)
        thing = (np.arange(320) >= left) & (np.arange(320) < left + 15) & card((0, 85), (320, 40))
        frame.rgb[thing] = np.roll(_print(2), (80, left), (0, 1))[thing]
        frame.depth_m[thing] = CARD_M
        follow.segment(frame, () if k else on(card=at))
        if "follow" in told:
            predicted, (_, component) = told["follow"][0][-1], told["by_geometry"][1]
            unlikely = component & predicted.beside & (predicted.prior < 0.2)
            both += np.count_nonzero(unlikely)
            assert told["by_colour"][0][2][unlikely].all()
    assert both


@pytest.mark.parametrize("over_px", [0, 8, 15])
def test_a_hand_that_takes_hold_of_an_object_is_not_of_it(over_px):
    """It comes to the card, over some pixels of it or none, in the same depth, and stays; its colours are its own."""
    at, follow = (100, 80), segmenter()
    for k in range(14):
        frame, left = picture(k, [(at, 2)]), max(240 - 10 * k, 160 - over_px)
        hand = (np.arange(320) >= left) & (np.arange(320) < left + 15) & card((0, 85), (320, 40))
        frame.rgb[hand], frame.depth_m[hand] = _print(5)[hand] // 8 + np.array((190, 130, 90), np.uint8), CARD_M
        found = follow.segment(frame, () if k else on(card=at)) == 1
    assert found[hand].mean() < 0.1 and iou(found, card(at) & ~hand) > 0.9


def test_where_depth_jumped_the_mask_of_before_says_nothing():
    """A piece of the printed wall, given as a mask; a board with the wall's own print comes before half of it."""
    piece, follow = card((120, 90)), segmenter()
    follow.segment(picture(0, []), [Prompt("piece", 0, mask=piece)])
    for k in (1, 2):
        frame = picture(k, [])
        frame.depth_m[:, :150] = BOARD_M
        found = follow.segment(frame) == 1
    assert not found[:, :145].any() and iou(found, piece & (np.arange(320) >= 150)) > 0.6


def test_what_shows_after_a_gap_in_the_depth_need_not_be_the_object():
    """Half of a card loses its depth for a frame, and something in its colours has come before it when it is back."""
    at, follow = (100, 80), segmenter()
    half = card(at) & (np.arange(320) >= 130)
    for k, half_m in enumerate((None, 0.0, 0.62, 0.62)):
        frame = picture(k, [(at, 1)])
        if half_m is not None:
            frame.depth_m[half] = half_m
        found = follow.segment(frame, () if k else on(card=at)) == 1
        assert k != 1 or found[half].all(), "colours carry it where nothing is measured"
    assert not found[half].any() and found[card(at) & ~half].all()


class Asked(dict):
    """Hints that note who was asked for."""

    def get(self, name, default=None):
        self.names = [*getattr(self, "names", []), name]
        return super().get(name, default)


def sure(**at) -> Asked:
    """Many points that agree, on cards with these upper left corners, which are the objects' origins."""
    points = np.stack(np.meshgrid([10.0, 20, 35, 50], [10, 25, 40]), -1).reshape(-1, 2)
    poses = {
        name: se3.from_rt(np.eye(3), CAMERA.unproject(np.array(c, float), CARD_M + 0.05)) for name, c in at.items()
    }
    return Asked({name: Hint(points + corner, T_cam_obj=poses[name]) for name, corner in at.items()})


def test_objects_with_sure_poses_are_cut_out_in_turns():
    """The hint of one object is asked for in a frame; in between, the flow moves the masks as well."""
    follow, starts = segmenter(), {"one": (20, 20), "two": (120, 80), "three": (220, 150)}
    asked = []
    for k in range(12):
        now = {name: (x + 2 * k, y) for name, (x, y) in starts.items()}
        hints = sure(**now)
        found = follow.segment(picture(k, [(at, 1) for at in now.values()]), () if k else on(**now), hints)
        assert all(iou(found == n, card(at)) > 0.85 for n, at in enumerate(now.values(), 1)), k
        asked.append(set(hints.names))
    assert all(len(names) == 1 for names in asked[4:]) and set.union(*asked[4:7]) == set(starts)


def test_in_doubt_an_object_is_cut_out_though_it_is_not_its_turn():
    """A board comes before half of the card from one frame to the next: whichever frame, none of it is the card's."""
    at, board = (120, 80), np.arange(320) < np.full((240, 1), 150)
    for last in (5, 6, 7):
        follow = segmenter()
        for k in range(last + 1):
            hints = sure(card=at)
            frame = picture(k, [(at, 1)], board if k == last else None)
            found = follow.segment(frame, () if k else on(card=at), hints) == 1
        assert hints.names and not (found & board).any() and iou(found, card(at) & ~board) > 0.85


def test_what_would_lie_outside_the_image_is_absent():
    at, follow = (120, 80), segmenter()
    follow.segment(picture(0, [(at, 1)]), on(card=at))
    assert (follow.segment(picture(1, [(at, 1)])) == 1).any()
    assert not follow.segment(picture(2, [(at, 1)]), hints={"card": Hint(gone=True)}).any()
    assert not follow.segment(picture(3, [(at, 1)])).any()


def test_an_object_leaves_the_picture():
    follow = segmenter()
    for k in range(24):
        found = follow.segment(picture(k, [((30 - 5 * k, 80), 1)]), () if k else on(card=(30, 80))) == 1
        truth = card((30 - 5 * k, 80))
        assert iou(found, truth) > 0.7 or truth.sum() < 400
    assert not found.any()


@pytest.mark.parametrize(("seen", "pixels"), [(8, 40), (7, 0)])
def test_a_few_pixels_of_an_object_are_none(seen, pixels):
    """A strip that leaves the picture, 5 pixels wide."""
    follow, masks = segmenter(), [card((x, 100), (40, 5)) for x in (0, seen - 40)]
    for k, mask in enumerate(masks):
        frame = picture(k, [])
        frame.rgb[mask], frame.depth_m[mask] = (200, 40, 30), CARD_M
        found = follow.segment(frame, [Prompt("strip", 0, mask=masks[0])] if not k else ())
    assert np.count_nonzero(found) == pixels


def test_strictly_causal():
    """Every label image is the same, bit for bit, whatever comes after."""
    short, long = segmenter(), segmenter()
    ends = [short.segment(picture(k, [(path(k), 1)]), () if k else on(card=path(0))) for k in range(8)]
    for k in range(20):
        found = long.segment(picture(k, [(path(k), 1)]), () if k else on(card=path(0)))
        if k < 8:
            np.testing.assert_array_equal(found, ends[k])


def test_late_objects_and_removed_ones():
    follow, cards = segmenter(), [((60, 80), 1), ((200, 80), 2)]
    assert set(np.unique(follow.segment(picture(0, cards), on(one=(60, 80))))) == {0, 1}
    found = follow.segment(picture(1, cards), on(two=(200, 80)))
    assert follow.names == ("one", "two") and iou(found == 2, card((200, 80))) > 0.9
    follow.remove("one")
    found = follow.segment(picture(2, cards))
    assert follow.names == ("two",) and iou(found == 1, card((200, 80))) > 0.9


def test_clicks_without_depth_name_the_click():
    frame = picture(0, [((100, 80), 1)])
    with pytest.raises(BadInput, match=r"clicks on 'card': got \(112, 92\) has no depth in frame 0"):
        segmenter().segment(Frame(0, 0.0, frame.rgb, np.zeros_like(frame.depth_m)), on(card=(100, 80)))


@pytest.mark.parametrize("seed", [0, 1])
def test_embedded_sequence(seed, opening):
    """The first pass of synthetic/crossing: new sides come into view, and one covers part of the other.

    Of another seed at twice the speed.
    """
    sequence = opening("crossing", range(0, 60, 2), seed) if seed else open_sequence("synthetic/crossing")
    new = BuiltinSegmenter(sequence.camera, CONFIG)
    rng, first, clicks = np.random.default_rng(seed), sequence.frame(0), []
    for name, mask in sequence.masks(0).items():
        v, u = np.nonzero((cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0) & (first.depth_m > 0))
        clicks.append(Prompt(name, points_px=np.stack([u, v], -1)[rng.choice(len(v), 3, replace=False)]))
    scores = {prompt.name: [] for prompt in clicks}
    for i in range(min(len(sequence), 60)):
        labels, truth = new.segment(sequence.frame(i), () if i else clicks), sequence.masks(i)
        for k, name in enumerate(new.names, 1):
            if truth[name].sum() >= 300:
                scores[name].append(iou(labels == k, truth[name]))
    assert min(np.mean(s) for s in scores.values()) > 0.85


# --- the parts ---------------------------------------------------------------------------------


def test_colours_speak_for_the_side_they_are_seen_on():
    rng = np.random.default_rng(0)
    red, blue = rng.integers(0, 60, (500, 3), np.uint8), rng.integers(0, 60, (500, 3), np.uint8)
    red[:, 0] += 180
    blue[:, 2] += 180
    shares = histogram(colour_codes(red)), histogram(colour_codes(blue))
    assert all(abs(s.sum() - 1) < 1e-9 for s in shares)
    says = evidence(*shares)
    assert (says[colour_codes(red)] > 1).all() and (says[colour_codes(blue)] < -1).all()
    unseen = colour_codes(np.array([[10, 250, 10]], np.uint8))
    np.testing.assert_allclose(says[unseen], 0, atol=1e-6)
    np.testing.assert_allclose(evidence(*shares[::-1]), -says, atol=1e-12)
    assert not histogram(np.zeros(0, int)).any()


def test_the_support_plane_is_found_among_other_things():
    """n . p = d with n towards the camera, through noise and a third of outliers."""
    normal, d = np.array([0.1, -0.8, -0.59]), -0.5
    normal /= np.linalg.norm(normal)
    depth = np.clip(d / (CAMERA.rays @ normal), 0, 3).astype(np.float32)
    depth[:, 100:200] = 0.45
    depth += np.random.default_rng(0).normal(0, 0.002, depth.shape).astype(np.float32) * (depth > 0)
    frame = Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), np.maximum(depth, 0))
    patch = Patch.of(frame, around(np.array([160, 180.0]), np.array([150, 60.0]), frame.shape), CAMERA, CONFIG)
    plane = support_plane(patch, patch.depth_m > 0)
    assert plane[:3] @ normal > np.cos(np.radians(2)) and abs(plane[3] - d) < 0.01
    on_it = patch.dots(np.array([[20.0, 200], [290, 200]]), 0)
    assert on_it.sum() == 2 and np.abs(plane_heights(patch, plane)[on_it]).max() < 0.02


def test_no_plane_where_there_is_none():
    depth = np.random.default_rng(0).uniform(0.4, 2, (240, 320)).astype(np.float32)
    frame = Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), depth)
    patch = Patch.of(frame, around(np.array([160, 120.0]), np.array([100, 100.0]), frame.shape), CAMERA, CONFIG)
    assert support_plane(patch, patch.depth_m > 0) is None
    assert support_plane(patch, np.zeros(patch.shape, bool)) is None


def test_patches_keep_places():
    """A pixel of the picture is found at its place on the grid, and goes back to it."""
    frame = picture(0, [((100, 80), 1)])
    patch = Patch.of(frame, around(np.array([130, 105.0]), np.array([90, 90.0]), frame.shape), CAMERA, CONFIG)
    assert max(patch.shape) <= CONFIG.side_px < max(patch.box.shape)
    mask = np.zeros(frame.shape, np.float32)
    mask[card((100, 80))] = 1
    back = patch.up(patch.down(mask)) > 0.5
    assert iou(back, card((100, 80))[patch.box.slices]) > 0.97
    dots = patch.dots(np.array([[100.0, 80], [-50, 80]]), 0)
    assert dots.sum() == 1
    assert (patch.down(mask)[dots] > 0).all()  # the corner lies on the card
    x, y = patch.rays()
    at = np.argwhere(dots)[0]
    np.testing.assert_allclose([x[at[1]], y[at[0]]], CAMERA.rays[80, 100, :2], atol=2 / 300)


def test_connected_parts_are_those_with_seeds():
    region = np.zeros((10, 20), bool)
    region[2:5, 2:6] = region[2:5, 10:14] = True
    seeds = np.zeros_like(region)
    seeds[3, 3] = seeds[8, 8] = True
    found = components_touching(connected_components(region), seeds)
    assert found[2:5, 2:6].all() and found.sum() == 12


def test_depth_at_clicks_bridges_small_holes_only():
    frame = picture(0, [])
    depth = frame.depth_m.copy()
    depth[50:52, 50:52] = 0
    depth[100:120, 100:120] = 0
    at = np.array([[50.0, 50], [110, 110], [0, 0]])
    z = depths_at(at, Frame(0, 0.0, frame.rgb, depth))
    assert abs(z[0] - WALL_M) < 0.01 and np.isnan(z[1]) and abs(z[2] - WALL_M) < 0.01


def test_distances_to_a_known_surface():
    """A sphere stands for the reconstructed surface."""

    class Sphere:
        tau_m, voxel_m = 1.0, 0.003

        def query(self, p):
            return np.linalg.norm(p, axis=-1) - 0.1, np.linalg.norm(p, axis=-1) < 0.15

        def corners_m(self):
            return np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])

    T_cam_obj = np.eye(4)
    T_cam_obj[:3, 3] = 0.05, -0.02, 0.6
    frame = picture(0, [])
    depth = np.full(frame.shape, 0.52, np.float32)
    depth[:, :20] = 0
    distance = surface_distance(Sphere(), depth, CAMERA, T_cam_obj)
    u, v = np.rint(CAMERA.project(T_cam_obj[:3, 3])).astype(int)
    assert distance[v, u] == pytest.approx(0.08 - 0.1, abs=1e-3)
    assert np.isnan(distance[:, :20]).all()
    assert np.isinf(distance[v, 25]), "off the volume nothing of the object can be"
    p_obj = CAMERA.unproject(np.array([u + 20.0, v + 10]), 0.52) - T_cam_obj[:3, 3]
    assert distance[v + 10, u + 20] == pytest.approx(np.linalg.norm(p_obj) - 0.1, abs=3e-3)


# --- a mask that is not the object's -----------------------------------------------------------


def _leap(to: tuple[int, int]) -> list[Frame]:
    """A red card that lies still, and then is elsewhere on a green wall from one frame to the next."""
    frames = []
    for k, at in enumerate([(100, 80)] * 3 + [to] * 3):
        frame = picture(k, [(at, 2)])
        frame.rgb[:], frame.rgb[card(at)] = (60, 120, 60), (200, 60, 50)
        frames.append(frame)
    return frames


def test_what_leaps_is_found_by_its_colours_near_to_where_it_was():
    """The flow cannot follow it: what it leaves behind has other colours, and the object is not far."""
    follow = segmenter()
    for k, frame in enumerate(_leap((158, 96))):
        found = follow.segment(frame, () if k else on(card=(100, 80))) == 1
    assert iou(found, card((158, 96))) > 0.85


@pytest.mark.parametrize("held", [True, False])
def test_a_mask_that_loses_the_points_which_were_on_it_is_found_anew_at_them(held, monkeypatch):
    """Points that were not on it a frame ago may be on its double."""
    monkeypatch.setattr(segmenter_page, "follow", lambda view, target, hint, others, predicted: predicted.claim)
    follow, was, now = segmenter(), (60, 80), (170, 100)
    for k, at in enumerate([was] * 4 + [now]):
        hints = sure(card=at) if held or at == now else {}
        found = follow.segment(picture(k, [(at, 1)]), () if k else on(card=was), hints) == 1
    assert (iou(found, card(now)) > 0.85) == held


def test_points_on_its_double_do_not_move_a_mask_that_they_were_on_before():
    """Once they are lost, they may be found again on what looks the same, and stay there."""
    follow, at, double = segmenter(), (60, 80), (170, 100)
    for k in range(12):
        hints = sure(card=at) if k < 3 else sure(card=double) if k > 5 else {}
        found = follow.segment(picture(k, [(at, 1), (double, 1)]), () if k else on(card=at), hints) == 1
        assert iou(found, card(at)) > 0.85


@pytest.mark.parametrize("told", [True, False])
def test_an_exposure_that_changes_its_colours_does_not_take_a_mask_from_its_points(told):
    """Overexposed, a red card on a green wall is as white as what surrounds it."""
    follow, at = segmenter(), (100, 80)
    for k in range(5):
        frame = picture(k, [(at, 2)])
        frame.rgb[:], frame.rgb[card(at)] = (60, 120, 60), (200, 60, 50)
        if k == 4:
            frame.rgb[:], frame.rgb[card(at)] = (200, 60, 50), (60, 120, 60)
        found = follow.segment(frame, () if k else on(card=at), sure(card=at) if told else {}) == 1
    assert (iou(found, card(at)) > 0.8) == told
