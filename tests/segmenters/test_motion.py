"""What moves with an object, on a made-up scene: a plate before a wall, a part of it, a neighbour that stays."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin import following
from p2p_lib.segmenters.builtin import segmenter as stages
from p2p_lib.segmenters.builtin.cut import by_geometry
from p2p_lib.segmenters.builtin.motion import Motions, Past, agrees, free_before, parts_that_follow, scene_stays
from p2p_lib.segmenters.builtin.patch import Box, Patch, components_touching, connected_components
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
CONFIG = preset().segmentation
PLATE_M, PART_M, WALL_M = 0.7, 0.76, 1.2
#: (x, y, width, height) in the first frame; the part shows above the plate, the neighbour stands beside it.
PLATE, PART, NEIGHBOUR = (110, 110, 60, 40), (120, 80, 40, 30), (172, 100, 30, 50)


def _texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(30, 226, (60, 80, 3), np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)


def at(place: tuple[int, int, int, int], moved_m: float = 0.0, z_m: float = PLATE_M) -> np.ndarray:
    """(H, W) bool of a rectangle at a depth after a motion to the left."""
    x, y, w, h = place
    x -= round(CAMERA.fx * moved_m / z_m)
    mask = np.zeros((240, 320), bool)
    mask[y : y + h, x : x + w] = True
    return mask


def scene(k: int, moved_m: float, camera_m: float = 0.0, part_m: float | None = None) -> Frame:
    """Plate moved to the left by so much, the part too or by ``part_m``, and everything by what the camera moved."""
    rgb, depth = np.roll(_texture(9), -round(CAMERA.fx * camera_m / WALL_M), 1), np.full((240, 320), WALL_M, np.float32)
    things = (
        (PART, PART_M, 1, moved_m if part_m is None else part_m),
        (NEIGHBOUR, PART_M, 2, 0.0),
        (PLATE, PLATE_M, 3, moved_m),
    )
    for place, z_m, seed, own_m in things:
        mask = at(place, own_m + camera_m, z_m)
        shift = -round(CAMERA.fx * (own_m + camera_m) / z_m)
        rgb[mask], depth[mask] = np.roll(_texture(seed), shift, 1)[mask], z_m
    return Frame(k, k / 30, rgb, depth)


def left(moved_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = -moved_m
    return T


def motions_of(then: Frame, now: Frame, moved_m: float) -> Motions:
    motion = then, np.linalg.inv(left(moved_m))
    return Motions(now, motion, (motion,))


def patch_and_plate(frame: Frame, moved_m: float) -> tuple[Patch, np.ndarray]:
    patch = Patch.of(frame, Box(60, 60, 220, 180), CAMERA, CONFIG)
    return patch, components_touching(
        connected_components(patch.smooth), patch.down(at(PLATE, moved_m).astype(np.float32)) > 0.9
    )


def test_a_part_that_moves_along_is_told_from_a_neighbour_that_stays():
    then, now, moved_m = scene(0, 0.0), scene(30, 0.05), 0.05
    patch, plate = patch_and_plate(now, moved_m)
    motions = motions_of(then, now, moved_m)
    parts = parts_that_follow(patch, connected_components(patch.smooth), plate, motions)
    part, neighbour = (
        patch.down(at(*a).astype(np.float32)) > 0.5 for a in ((PART, moved_m, PART_M), (NEIGHBOUR, 0, PART_M))
    )
    assert (parts & part).sum() > 0.8 * part.sum()
    assert not (parts & ~part).any() and neighbour.any()
    assert scene_stays(patch, motions)


def test_of_its_past_the_first_frame_and_six_recent_ones_are_kept():
    past = Past()
    for k in range(12):
        past = past.with_frame(scene(5 * k, 0.0), left(0.01 * k))
    assert [then.index for then, _ in past.seen] == [0, 30, 35, 40, 45, 50, 55]


def test_what_may_as_well_have_stood_still_is_no_part():
    """A plain board beside the plate is in most of its pixels the same, whether it moved along or not."""
    board, moved_m = np.zeros((240, 320), bool), 0.02
    board[60:105, 80:240] = True
    frames = []
    for k, by_m in enumerate((0.0, moved_m)):
        frame, plate = scene(k, by_m), at(PLATE, by_m)
        frame.rgb[board & ~plate], frame.depth_m[board & ~plate] = 120, PART_M
        frames.append(frame)
    patch = Patch.of(frames[1], Box(40, 40, 280, 200), CAMERA, CONFIG)
    plate = components_touching(
        connected_components(patch.smooth), patch.down(at(PLATE, moved_m).astype(np.float32)) > 0.9
    )
    motions = motions_of(*frames, moved_m)
    assert scene_stays(patch, motions)
    assert not parts_that_follow(patch, connected_components(patch.smooth), plate, motions).any()


@pytest.mark.parametrize("wall", ["printed", "plain"])
def test_a_camera_that_moves_past_what_lies_still_tells_nothing(wall):
    """A plain wall is in most of its pixels as it was, as if the camera stood still."""
    moved_m = 0.05
    then, now = scene(0, 0.0), scene(30, 0.0, moved_m)
    for frame in (then, now) if wall == "plain" else ():
        frame.rgb[frame.depth_m == np.float32(WALL_M)] = 120
    patch, _ = patch_and_plate(now, moved_m)
    motions = motions_of(then, now, moved_m)
    plate = components_touching(
        connected_components(patch.smooth), patch.down(at(PLATE, moved_m).astype(np.float32)) > 0.9
    )
    assert not scene_stays(patch, motions)
    assert not parts_that_follow(patch, connected_components(patch.smooth), plate, motions).any()


def test_points_agree_with_an_earlier_frame_at_their_depth_and_in_their_colour():
    then = scene(0, 0.0)
    uv = np.array([[140.0, 130], [140, 130], [140, 130], [20, 20]])
    p_cam = CAMERA.unproject(uv, np.array([PLATE_M, PLATE_M, PLATE_M + 0.1, WALL_M]))
    rgb = then.rgb[uv[:, 1].astype(int), uv[:, 0].astype(int)].copy()
    rgb[1] = 255 - rgb[1] // 4
    assert agrees(p_cam, rgb, CAMERA, then, np.eye(4)).tolist() == [True, False, False, True]
    far = np.eye(4)
    far[0, 3] = 5.0
    assert not np.any(agrees(p_cam, rgb, CAMERA, then, far))


def test_what_the_mask_touches_but_was_beside_it_a_frame_ago_is_not_taken_in():
    """Flow has moved the mask a little too far: a cell of it lies on what is beside the object."""
    patch, plate = patch_and_plate(scene(0, 0.0), 0.0)
    part = (patch.down((at(PART, 0.0, PART_M) & ~at(PLATE)).astype(np.float32)) > 0.9) & patch.smooth
    rows, columns = np.nonzero(part)
    seeds, touched = plate.copy(), (rows[-1], columns[-1])
    seeds[touched] = True
    for beside, taken in ((part & ~seeds, False), (part & (np.arange(part.shape[1]) % 2 == 0), True), (None, True)):
        _, component = by_geometry(patch, seeds, None, CONFIG, beside=beside)
        assert component[plate].all() and component[part].all() == component[part].any() == taken


@pytest.mark.parametrize("on_surface", [True, False])
def test_what_lies_beside_counts_once_the_masks_are_settled_and_off_the_surface(on_surface, monkeypatch):
    """First masks may still grow; what is on the object's surface is of it, wherever the mask was."""
    told, inner = {}, following.by_geometry

    def by_geometry_noted(patch, seeds, plane, config, motions=None, beside=None, free=None, other=None):
        told[k] = None if beside is None else bool(beside.any())
        return inner(patch, seeds, plane, config, motions, beside, free, other)

    monkeypatch.setattr(following, "by_geometry", by_geometry_noted)
    segmenter = BuiltinSegmenter(CAMERA, CONFIG)
    clicks = [Prompt("it", 0, np.array([[130.0, 125], [150, 130], [140, 140]]))]
    points = np.stack(np.meshgrid(np.linspace(115, 165, 5), np.linspace(115, 145, 4)), -1).reshape(-1, 2)
    surface_m = np.zeros((240, 320), np.float32) if on_surface else None
    for k in range(45):
        moved_m = 0.001 * k
        hint = Hint(points - [CAMERA.fx * moved_m / PLATE_M, 0], surface_m, left(moved_m))
        segmenter.segment(scene(k, moved_m), () if k else clicks, {"it": hint} if k else None)
    early, late = ([told[k] for k in told if lo <= k < hi] for lo, hi in ((1, 25), (40, 45)))
    assert early and set(early) == {None} and late and set(late) == {not on_surface}


@pytest.mark.parametrize("part_moves", [True, False])
def test_the_segmenter_takes_in_what_moves_along(part_moves):
    """Clicks lie on the plate alone; the pose of the plate is known. What stands still beside it stays outside."""
    segmenter = BuiltinSegmenter(CAMERA, CONFIG)
    clicks = [Prompt("it", 0, np.array([[130.0, 125], [150, 130], [140, 140]]))]
    points = np.stack(np.meshgrid(np.linspace(115, 165, 5), np.linspace(115, 145, 4)), -1).reshape(-1, 2)
    for k in range(26):
        moved_m = 0.003 * k
        part_m = moved_m if part_moves else 0.0
        frame = scene(k, moved_m, part_m=part_m)
        hint = Hint(points - [CAMERA.fx * moved_m / PLATE_M, 0], T_cam_obj=left(moved_m))
        found = segmenter.segment(frame, () if k else clicks, {"it": hint} if k else None) == 1
    part, neighbour = at(PART, part_m, PART_M) & ~at(PLATE, moved_m), at(NEIGHBOUR, 0.0, PART_M)
    assert found[at(PLATE, moved_m)].mean() > 0.9 and found[neighbour].mean() < 0.05
    assert (found[part].mean() > 0.8) == part_moves


def test_where_the_wall_was_seen_through_it_is_not_the_object():
    """A hand that takes it moves along from then on; where it is now, the wall was seen in the first frame."""
    moved_m = 0.05
    then, now, before = scene(25, 0.0), scene(30, moved_m), scene(0, 0.0)
    empty = at(PART, 0.0, PART_M)
    before.rgb[empty], before.depth_m[empty] = _texture(9)[empty], WALL_M
    patch, plate = patch_and_plate(now, moved_m)
    both = motions_of(then, now, moved_m)
    later = Motions(now, both.recent, (both.recent, (before, both.recent[1])))
    part = patch.down((at(PART, moved_m, PART_M) & ~at(PLATE, moved_m)).astype(np.float32)) > 0.9
    assert not free_before(patch, both)[plate | part].any()
    free = free_before(patch, later)
    assert free[part].mean() > 0.7 and not free[plate].any()
    come = before.rgb.copy(), before.depth_m.copy()  # someone stood before most of the scene
    come[0][:, :200], come[1][:, :200] = _texture(4)[:, :200], np.where(empty, WALL_M, 0.9)[:, :200]
    crowded = Motions(now, both.recent, ((Frame(0, 0.0, *come), both.recent[1]),))
    assert free_before(patch, crowded)[part].mean() > 0.7
    lines = now.depth_m.copy()  # without depth, where few points would lie
    lines[::24] = 0
    assert free_before(patch, replace(later, now=replace(now, depth_m=lines)))[part].mean() > 0.7
    turned = before.rgb[:, ::-1].copy(), before.depth_m[:, ::-1].copy()  # and from where the camera is no more
    elsewhere = Motions(now, both.recent, ((Frame(0, 0.0, *turned), both.recent[1]),))
    assert not free_before(patch, elsewhere).any()
    inner = cv2.erode(part.astype(np.uint8), np.ones((5, 5))) > 0
    touched = plate | (np.arange(inner.size).reshape(inner.shape) == np.flatnonzero(inner)[0])
    for what, taken in ((both, True), (later, False)):
        for seeds, motions, free in ((touched, None, free_before(patch, what)), (plate, what, None)):
            _, component = by_geometry(patch, seeds, None, CONFIG, motions, free=free)
            assert component[plate].all() and component[inner].all() == component[inner].any() == taken


@pytest.mark.parametrize(
    "what, free",
    [("as it is", True), ("thin", False), ("hardly before it", False), ("not seen then", False), ("not seen", False)],
)
def test_what_is_wide_measured_and_far_behind_says_that_it_was_free(what, free):
    """A block where the wall was seen. Depth that is missing is at the camera, of which a motion makes any place."""
    then, now = (Frame(k, k / 30, _texture(9), np.full((240, 320), WALL_M, np.float32)) for k in range(2))
    block, T_then_now = np.zeros((240, 320), bool), np.eye(4)
    block[110:140, 140 : 144 if what == "thin" else 180] = True
    now.depth_m[block] = WALL_M - 0.02 if what == "hardly before it" else PLATE_M
    if what == "not seen then":
        then.depth_m[block] = 0
    if what == "not seen":
        now.depth_m[block], T_then_now[2, 3] = 0, 0.3
    patch = Patch.of(now, Box(110, 80, 210, 170), CAMERA, CONFIG)
    found = free_before(patch, Motions(now, (then, T_then_now), ((then, T_then_now),)))
    inside = patch.down(block.astype(np.float32)) > 0.9
    assert inside.any() and (found[inside].all() if free else not found.any())


@pytest.mark.parametrize("on_surface", [False, True])
def test_what_comes_to_touch_it_is_not_taken_in_unless_it_is_on_its_surface(on_surface):
    """A block, at the same depth and in its colours."""
    segmenter = BuiltinSegmenter(CAMERA, CONFIG)
    clicks = [Prompt("it", 0, np.array([[130.0, 125], [150, 130], [140, 140]]))]
    points = np.stack(np.meshgrid(np.linspace(115, 165, 5), np.linspace(115, 145, 4)), -1).reshape(-1, 2)
    plate, block = at(PLATE), np.zeros((240, 320), bool)
    block[118:142, 170:182] = True
    for k in range(45):
        frame = scene(k, 0.0)
        if k >= 36:
            frame.rgb[block], frame.depth_m[block] = np.roll(_texture(3), 60, 1)[block], PLATE_M
        hint = Hint(points, np.zeros((240, 320), np.float32) if on_surface else None, np.eye(4))
        found = segmenter.segment(frame, () if k else clicks, {"it": hint} if k else None) == 1
    assert found[plate].mean() > 0.9
    assert (found[block].mean() > 0.9) if on_surface else (found[block].mean() < 0.1)


def test_the_first_frame_is_remembered_and_the_newest():
    past, seen = Past(), range(0, 60)
    for k in seen:
        if past.due(scene_of_nothing(k)):
            past = past.with_frame(scene_of_nothing(k), left(0.01 * k))
    kept = [frame.index for frame, _ in past.seen]
    assert kept[0] == 0 and kept[-1] == 55 and len(kept) < 10 and min(np.diff(kept)) >= 5
    motions = past.motions(scene_of_nothing(60), left(0.6))
    np.testing.assert_allclose(motions.compared[0][1], left(-0.6), atol=1e-12)
    assert [then.index for then, _ in motions.compared] == kept and motions.recent in motions.compared[1:]
    then, T_then_now = motions.recent
    np.testing.assert_allclose(T_then_now, left(0.01 * then.index - 0.6), atol=1e-12)
    assert 25 <= then.index <= 55
    assert Past().motions(scene_of_nothing(0), left(0.0)) is None


def scene_of_nothing(k: int) -> Frame:
    return Frame(k, k / 30, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32))


@pytest.mark.parametrize("came", [False, True])
def test_there_is_room_for_parts_that_reach_farther_than_all_that_was_seen(came, monkeypatch):
    """The part sticks out of the box that the plate alone asks for; what came since asks for none."""
    rooms: list[float] = []

    def with_room_noted(*asked):
        rooms.append(following.with_room(*asked).room_m.max())
        return following.with_room(*asked)

    monkeypatch.setattr(stages, "with_room", with_room_noted)
    segmenter, tall = BuiltinSegmenter(CAMERA, CONFIG), (125, 20, 30, 90)
    points = np.stack(np.meshgrid(np.linspace(115, 165, 5), np.linspace(115, 145, 4)), -1).reshape(-1, 2)
    for k in range(50 if came else 36):
        moved_m = 0.003 * k
        frame, plate, part = scene(k, moved_m), at(PLATE, moved_m), at(tall, moved_m, PART_M)
        if k >= 12 or not came:
            frame.rgb[part & ~plate], frame.depth_m[part & ~plate] = (40, 170, 60), PART_M
        hint = Hint(points - [CAMERA.fx * moved_m / PLATE_M, 0], T_cam_obj=left(moved_m))
        clicks = () if k else [Prompt("it", 0, np.array([[130.0, 125], [150, 130], [140, 140]]))]
        found = segmenter.segment(frame, clicks, {"it": hint} if k else None) == 1
    assert (max(rooms[-4:]) > 0.15) != came
    assert (found[part & ~plate].mean() > 0.8) != came


def test_a_look_alike_in_view_is_not_the_absent_object():
    """The tracked points of the one that is covered have gone over to the other, which has its colours."""
    here, there = (60, 90, 50, 50), (200, 90, 50, 50)

    def two(k: int, covered: bool) -> Frame:
        rgb, depth = _texture(9) // 4 + 20, np.full((240, 320), WALL_M, np.float32)
        for place in (here, there):
            rgb[at(place)], depth[at(place)] = np.roll(_texture(5), place[0], 1)[at(place)], PLATE_M
        if covered:
            rgb[:, :150], depth[:, :150] = 90, 0.5
        return Frame(k, k / 30, rgb, depth)

    segmenter = BuiltinSegmenter(CAMERA, CONFIG)
    clicks = [
        Prompt(name, 0, np.add(at_px[:2], [[15.0, 15], [30, 30], [15, 35]]))
        for name, at_px in (("one", here), ("two", there))
    ]
    points = np.stack(np.meshgrid(np.linspace(205, 245, 4), np.linspace(95, 135, 4)), -1).reshape(-1, 2)
    for k in range(4):
        found = segmenter.segment(two(k, k > 0), () if k else clicks, {"one": Hint(points)} if k > 1 else None)
    assert not (found == 1).any() and (found == 2)[at(there)].mean() > 0.9
