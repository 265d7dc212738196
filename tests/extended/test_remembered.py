"""An object that was learnt in one video is found in another, in the frame of its map; one that is not there is not."""

import json
from dataclasses import fields, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib import Point2Pose, open_sequence, preset
from p2p_lib.core import memory as memories
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.memory import ObjectMemory, SurfaceMemory, load_memories, load_memory, save_memory
from p2p_lib.core.types import Status
from p2p_lib.datasets.resized import Resized
from p2p_lib.extended.graph import BoundedGraph
from p2p_lib.extended.image_search import ImageSearch, Sighting
from p2p_lib.extended.remembered import Remembered, _certain
from p2p_lib.extended.remembering import _outline, memory_of
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.trackers.builtin.recogniser import Recognised, Recogniser
from p2p_lib.trackers.rollouts import RolloutTracker

LEARNT, LATER = range(0, 45), range(74, 85)


@pytest.fixture(scope="module")
def crossing():
    return open_sequence("synthetic/crossing")


@pytest.fixture(scope="module")
def other(opening):
    """A mug, which has nothing of what was learnt."""
    return opening("mug", range(0, 60, 4))


@pytest.fixture(scope="module")
def learnt(crossing):
    """The carton of ``crossing``, learnt in its first frames: the memory, T_obj_model, and the surface's values."""
    method = Point2Pose(crossing.camera)
    method.add_object("box")
    for i in LEARNT:
        estimate = method.step(crossing.frame(i), {"box": crossing.masks(i)["box"]})["box"]
    T_obj_model = se3.inverse(estimate.T_cam_obj) @ crossing.truth["box"].T_cam_model[LEARNT[-1]]
    surface = method.objects["box"].model.surface
    known = SimpleNamespace(method=method, T_obj_model=T_obj_model, values=surface.values(), mesh=surface.mesh())
    return SimpleNamespace(memory=method.memory("box", sequence="crossing"), **vars(known))


@pytest.fixture
def kept(learnt, tmp_path):
    save_memory(tmp_path / "maps/box.npz", learnt.memory)
    return tmp_path / "maps/box.npz"


def followed(crossing, method, frames, masks=None):
    """The estimates of frames without any masks."""
    return [method.step(crossing.frame(i), masks and masks(i)) for i in frames]


# -- the file ----------------------------------------------------------------------------------------


def test_a_memory_is_read_as_it_was_written_and_is_small(learnt, kept):
    read = load_memory(kept)
    for kind, one, other in (ObjectMemory, learnt.memory, read), (SurfaceMemory, learnt.memory.surface, read.surface):
        for f in fields(kind):
            if isinstance(getattr(one, f.name), np.ndarray):
                np.testing.assert_array_equal(getattr(other, f.name), getattr(one, f.name))
                assert getattr(other, f.name).dtype == getattr(one, f.name).dtype
    assert read.name == "box" and read.made_of == learnt.memory.made_of and read.made_of["sequence"] == "crossing"
    assert kept.stat().st_size < 2e6
    with np.load(kept, allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "iufb" for name in file.files)


def test_the_surface_is_back_as_it_was(crossing, learnt, kept):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=load_memory(kept))
    surface = method.objects["box"].model.surface
    np.testing.assert_allclose(surface.values(), learnt.values, atol=1e-3)
    mesh = surface.mesh()
    assert len(mesh.faces) == pytest.approx(len(learnt.mesh.faces), rel=0.02)
    np.testing.assert_allclose(mesh.bounds, learnt.mesh.bounds, atol=1e-3)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.98])
def test_a_file_that_was_cut_short_is_refused(kept, share):
    data = kept.read_bytes()
    kept.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BadInput, match=r"box\.npz"):
        load_memory(kept)


def test_other_files_are_refused_and_say_what_was_expected(learnt, kept, tmp_path, monkeypatch):
    with pytest.raises(MissingData, match=r"maps/OBJECT\.npz"):
        load_memory(tmp_path / "nothing.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(BadInput, match="something else"):
        load_memory(tmp_path / "other.npz")
    with np.load(kept) as file:
        arrays = dict(file)
    np.savez(tmp_path / "part.npz", **{k: v for k, v in arrays.items() if not k.endswith("descriptors")})
    with pytest.raises(BadInput, match="without 'box/descriptors'"):
        load_memory(tmp_path / "part.npz")
    arrays["box/p_obj"] = arrays["box/p_obj"] * np.nan
    np.savez(tmp_path / "nan.npz", **arrays)
    with pytest.raises(BadInput, match="p_obj"):
        load_memory(tmp_path / "nan.npz")
    monkeypatch.setattr(memories, "VERSION", 99)
    save_memory(tmp_path / "newer.npz", learnt.memory)
    monkeypatch.undo()
    with pytest.raises(BadInput, match="version 99"):
        load_memory(tmp_path / "newer.npz")


def test_a_folder_gives_all_its_memories(learnt, tmp_path):
    """A run's folder holds other archives beside its maps."""
    for name in ("box", "can"):
        save_memory(tmp_path / f"maps/{name}.npz", replace(learnt.memory, name=name))
    (tmp_path / "poses.npz").write_bytes(b"")
    assert list(load_memories([tmp_path])) == list(load_memories([tmp_path / "maps"])) == ["box", "can"]
    (tmp_path / "none").mkdir()
    with pytest.raises(MissingData, match="no file in it, expected a memory"):
        load_memories([tmp_path / "none"])
    (tmp_path / "none/run.json").write_text("{}")
    with pytest.raises(MissingData, match=r"a run without maps, .* No object was learnt well enough"):
        load_memories([tmp_path / "none"])


def test_two_of_one_name_and_an_empty_map_are_refused(learnt, kept):
    with pytest.raises(BadInput, match="two of 'box'"):
        load_memories([kept, kept])
    nothing = {f.name: getattr(learnt.memory, f.name)[:0] for f in fields(ObjectMemory)[1:5]}
    with pytest.raises(BadInput, match="0 landmarks"):
        replace(learnt.memory, **nothing)


def test_a_write_that_fails_leaves_the_old_file(learnt, kept, monkeypatch):
    before = kept.read_bytes()
    monkeypatch.setattr(np, "savez_compressed", lambda file, **arrays: file.write(b"half") and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        save_memory(kept, learnt.memory)
    assert kept.read_bytes() == before and [path.name for path in kept.parent.iterdir()] == ["box.npz"]


def test_a_memory_goes_with_nothing_else_and_not_with_the_paper(crossing, learnt):
    with pytest.raises(BadInput, match="clicks or a mask, too"):
        Point2Pose(crossing.camera).add_object("box", clicks=[[3, 3]], memory=learnt.memory)
    with pytest.raises(BadInput, match="preset default"):
        Point2Pose(crossing.camera, preset("paper")).add_object("box", memory=learnt.memory)
    method = Point2Pose(crossing.camera)
    with pytest.raises(BadInput, match="got str, expected a memory, as load_memory reads it"):
        method.add_object("box", memory="box.npz")
    with pytest.raises(BadInput, match="object name"):
        method.add_object("a/b", memory=learnt.memory)
    method.add_object("box", memory=learnt.memory)
    with pytest.raises(BadInput, match="in use"):
        method.add_object("box", memory=learnt.memory)


# -- found again -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def again(crossing, learnt):
    """The carton found without masks: the tracker, its keypoints when it was found, and all estimates."""
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    first = followed(crossing, method, LATER[:3])
    keypoints = len(method.objects["box"].map)
    return SimpleNamespace(method=method, keypoints=keypoints, told=first + followed(crossing, method, LATER[3:]))


def test_it_is_found_by_a_second_image_in_the_frame_of_its_map(crossing, learnt, again):
    assert again.told[0]["box"].status is Status.INITIALISING
    turned_deg = []
    for i, told in zip(LATER[2:], again.told[2:], strict=True):
        assert told["box"].T_cam_obj is not None and told["box"].map_id == 0
        off = off_truth(crossing, learnt, told, i)
        assert np.linalg.norm(off[:3, 3]) < 0.006
        turned_deg.append(np.degrees(se3.angle_rad(off)))
    assert max(turned_deg[:3]) < 2.6 and np.median(turned_deg) < 3 and max(turned_deg) < 3.1
    assert again.told[2]["box"].status is Status.RECOVERED
    mask, true = again.method.masks["box"], crossing.masks(LATER[-1])["box"]
    assert (mask & true).sum() > 0.8 * (mask | true).sum()


def test_landmarks_that_come_into_view_become_keypoints(again):
    of_memory = again.method.objects["box"]._key
    assert again.keypoints >= 8
    assert (of_memory >= 0).sum() > again.keypoints


def test_so_do_those_of_one_that_was_removed_and_added_again(crossing, learnt):
    """Its map has another number then."""
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    followed(crossing, method, range(LATER[0] - 1, LATER[0]))
    method.remove_object("box")
    method.add_object("box", memory=learnt.memory)
    assert followed(crossing, method, LATER[:3])[-1]["box"].map_id == 1
    of_memory = method.objects["box"]._key
    at_first = (of_memory >= 0).sum()
    followed(crossing, method, LATER[3:])
    assert (of_memory >= 0).sum() > at_first


def test_keypoints_lie_where_they_are_seen(crossing, again):
    """A landmark looks like its corner, and is a few pixels beside it: all of them tell the pose, none its point."""
    method, estimate = again.method, again.told[-1]["box"]
    points = method.objects["box"].map
    seen = dict(zip(method.tracks.ids.tolist(), method.tracks.uv_px, strict=True))
    rows = np.flatnonzero(points.promoted & np.isin(points.ids, method.tracks.ids[method.tracks.visible]))
    uv_px = crossing.camera.project(se3.transform(estimate.T_cam_obj, points.p_obj[rows]))
    off_px = np.linalg.norm(uv_px - [seen[k] for k in points.ids[rows]], axis=1)
    assert len(rows) >= 20 and np.quantile(off_px, 0.8) < 1


def test_what_was_found_is_kept_with_what_it_began_with(learnt, again):
    kept = again.method.memory("box")
    before = {tuple(p) for p in learnt.memory.p_obj}
    assert len(before & {tuple(p) for p in kept.p_obj}) > 0.8 * len(before)


def test_a_tracker_without_features_follows_what_was_found(crossing, learnt):
    method = Point2Pose(crossing.camera, tracker="lk")
    method.add_object("box", memory=learnt.memory)
    assert all(one["box"].T_cam_obj is not None for one in followed(crossing, method, LATER[:6])[2:])


def off_truth(crossing, learnt, told, i):
    """(4, 4) from where an estimate has the model in frame i to where it is."""
    return se3.inverse(crossing.truth["box"].T_cam_model[i]) @ told["box"].T_cam_obj @ learnt.T_obj_model


class Flow:
    """A rollout that carries its queries from image to image by optical flow."""

    def __init__(self, pictures, uv_px):
        self.uv_px, self.waiting = uv_px.astype(np.float32), [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in pictures]

    def step(self, rgb):
        self.waiting.append(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        self.uv_px, found, _ = cv2.calcOpticalFlowPyrLK(*self.waiting[:2], self.uv_px[:, None], None)
        self.uv_px, self.waiting = self.uv_px[:, 0], self.waiting[1:]
        return self.uv_px.astype(float), found[:, 0] > 0, np.full(len(found), 0.1)


@pytest.mark.parametrize("late", [0, 3])
def test_a_model_of_rollouts_follows_what_was_found(crossing, learnt, late):
    """Landmarks that are recognised in a frame become its queries there; no image of the first video is needed."""
    tracker = RolloutTracker("flow", Flow, late)
    method = Point2Pose(crossing.camera, tracker=tracker)
    method.add_object("box", memory=learnt.memory)
    told = [one for one in followed(crossing, method, LATER) if one]
    assert len(told) == len(LATER) - late
    for i, one in zip(LATER[2:], told[2:], strict=False):
        off = off_truth(crossing, learnt, one, i)
        assert np.linalg.norm(off[:3, 3]) < 0.006 and np.degrees(se3.angle_rad(off)) < 3
    mine = np.isin(method.tracks.ids, method.objects["box"].map.ids)
    assert method.tracks.visible[mine].sum() >= 8 and told[-1]["box"].inliers >= 8


def test_a_camera_of_half_the_size_finds_it_at_the_same_place(crossing, learnt):
    small, frames = Resized(crossing, 0.5), range(45, 51)
    method = Point2Pose(small.camera)
    method.add_object("box", memory=learnt.memory)
    assert small.camera.width == 320
    for i, one in zip(frames[1:], followed(small, method, frames)[1:], strict=True):
        off = off_truth(crossing, learnt, one, i)
        assert np.linalg.norm(off[:3, 3]) < 0.003 and np.degrees(se3.angle_rad(off)) < 2


@pytest.mark.parametrize("frozen", [False, True])
def test_a_side_that_was_not_seen_before_is_in_the_memory_unless_it_is_frozen(crossing, learnt, frozen):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory, frozen=frozen)
    followed(crossing, method, range(45, 75))
    before, kept = learnt.memory, method.memory("box", sequence="later")
    new = {tuple(p) for p in kept.p_obj} - {tuple(p) for p in before.p_obj}
    surface = (
        kept.surface.value.shape == before.surface.value.shape and (kept.surface.value == before.surface.value).all()
    )
    grown = [len(kept.T_cam_obj) > len(before.T_cam_obj), len(new) >= 20, not surface]
    assert grown == [not frozen] * 3
    assert kept.made_of.get("before") == (None if frozen else [before.made_of])


def sightings(crossing, memory, frame, pairs=None):
    """Where the carton may be in a frame, by some ``pairs`` of all that look alike."""
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=memory)
    obj = method.objects["box"]
    if pairs is not None:
        of = obj._recogniser.pairs(frame, memory.descriptors)
        chosen = Recognised(of.rows[pairs], of.uv_px[pairs], of.p_cam[pairs])
        obj._recogniser = SimpleNamespace(pairs=lambda *_: chosen, agreeing=Recogniser.agreeing)
    return obj._sightings(frame, ImageSearch(frame, crossing.camera, method.config.depth), None, None)


def right(crossing, learnt, sighting, i):
    """Whether a sighting is within 3 cm and 15 degrees of the truth."""
    off = se3.inverse(crossing.truth["box"].T_cam_model[i]) @ sighting.T_cam_obj @ learnt.T_obj_model
    return np.linalg.norm(off[:3, 3]) < 0.03 and np.degrees(se3.angle_rad(off)) < 15


def test_landmarks_alone_find_what_does_not_look_whole(crossing, learnt):
    i = LATER[0]
    frame = crossing.frame(i)
    (found, recognised), *others = sightings(crossing, learnt.memory, frame)
    assert recognised and not others and right(crossing, learnt, found, i)


def test_looks_find_what_few_landmarks_show(crossing, learnt):
    i = 50
    found = sightings(crossing, learnt.memory, crossing.frame(i), pairs=slice(0, 5))
    assert found and not any(recognised for _, recognised in found)
    assert any(right(crossing, learnt, sighting, i) for sighting, _ in found)


def test_landmarks_lie_on_the_surface(learnt):
    distance_m, known = learnt.method.objects["box"].model.surface.query(learnt.memory.p_obj)
    assert known.mean() > 0.9 and np.median(np.abs(distance_m[known])) < 1e-4


def test_what_is_not_there_is_not_found(learnt, other):
    method = Point2Pose(other.camera)
    method.add_object("box", memory=learnt.memory)
    for i in range(0, len(other), 2):
        estimate = method.step(other.frame(i))["box"]
        assert estimate.status is Status.INITIALISING and estimate.T_cam_obj is None
        assert estimate.reason == "known from memory, not found yet"


def lead_astray(obj, monkeypatch):
    """Have every look find the object in yet another place; returns how far aside, m, the next ones will be."""
    look, aside = obj._look, iter(0.4 * np.arange(20))

    def astray(*asked):
        if (found := look(*asked)) is None:
            return None
        off = se3.from_rt(np.eye(3), np.array([next(aside), 0.0, 0.0]))
        return replace(found, sighting=replace(found.sighting, T_cam_obj=off @ found.sighting.T_cam_obj))

    monkeypatch.setattr(obj, "_look", astray)
    return aside


def unseen(tracks):
    """Tracks of which none is visible."""
    return replace(tracks, visible=np.zeros(len(tracks), bool))


def test_what_is_found_in_one_image_and_elsewhere_in_the_next_is_not_claimed(crossing, learnt, monkeypatch):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    obj = method.objects["box"]
    aside = lead_astray(obj, monkeypatch)
    told = followed(crossing, method, LATER[:6])
    assert all(one["box"].status is Status.INITIALISING and one["box"].T_cam_obj is None for one in told)
    assert next(aside) >= 1.2 and not len(obj.map)


def test_one_that_is_seen_here_and_there_does_not_keep_another_waiting(crossing, learnt, monkeypatch):
    """All are looked for in each frame while nothing has a pose; later one in each, those left in turn."""
    method, looks = Point2Pose(crossing.camera), []
    for name in ("box", "elsewhere", "nowhere"):
        method.add_object(name, memory=replace(learnt.memory, name=name))
    lead_astray(method.objects["elsewhere"], monkeypatch)
    for name in ("elsewhere", "nowhere"):
        find = method.objects[name].find
        found = (lambda *asked: None) if name == "nowhere" else find
        monkeypatch.setattr(method.objects[name], "find", lambda *a, n=name, f=found: looks.append(n) or f(*a))
    told = followed(crossing, method, range(45, 47))[-1]
    assert [name for name, one in told.items() if one.T_cam_obj is not None] == ["box"]
    assert looks == 2 * ["elsewhere", "nowhere"]
    followed(crossing, method, range(47, 51))
    assert sorted(looks[4:6]) == sorted(looks[6:]) == ["elsewhere", "nowhere"]


def test_nothing_is_taken_for_two_objects(crossing, learnt):
    method = Point2Pose(crossing.camera)
    for name in ("one", "other"):
        method.add_object(name, memory=replace(learnt.memory, name=name))
    told = followed(crossing, method, range(45, 53))[-1]
    assert sum(one.T_cam_obj is not None for one in told.values()) == 1


def test_a_claim_that_the_surface_alone_bears_out_is_withdrawn_too(crossing, learnt, monkeypatch):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    assert followed(crossing, method, range(45, 48))[-1]["box"].T_cam_obj is not None
    obj, track = method.objects["box"], method.tracker.track
    monkeypatch.setattr(method.tracker, "track", lambda *asked: unseen(track(*asked)))
    monkeypatch.setattr(method.tracker, "suggest", lambda *asked: None)
    monkeypatch.setattr(obj, "_look", lambda *asked: None)
    told = [one["box"] for one in followed(crossing, method, range(48, 54))]
    assert all(one.T_cam_obj is not None and not one.inliers for one in told[:5])
    assert told[5].status is Status.INITIALISING and not len(obj.map)


def test_a_claim_that_nothing_bears_out_is_withdrawn(crossing, learnt, other):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    assert followed(crossing, method, LATER[:3])[-1]["box"].T_cam_obj is not None
    told = [method.step(replace(other.frame(i), index=100 + i, time_s=4 + i / 30)) for i in range(12)]
    assert told[-1]["box"].status is Status.INITIALISING and told[-1]["box"].last_T_cam_obj is None
    obj = method.objects["box"]
    assert not len(obj.map) and "box" not in method.segmenter.names
    assert len(obj.model.views) == len(learnt.memory.T_cam_obj)


def test_what_few_landmarks_find_is_held_by_new_points(crossing, learnt, monkeypatch):
    """Five, as of something small: too few to bear a claim out."""
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    obj = method.objects["box"]
    look = obj._look
    monkeypatch.setattr(obj, "_look", lambda *a: (f := look(*a)) and replace(f, seen=f.seen.select(slice(0, 5))))
    monkeypatch.setattr(obj, "_with_more", lambda requests, *_: requests)
    told = [one["box"] for one in followed(crossing, method, range(45, 75))]
    assert all(one.inliers <= 5 for one in told[:3]) and all(one.T_cam_obj is not None for one in told[2:])
    assert told[-1].inliers >= 8 and (obj.map.promoted & ~np.isin(obj.map.keys, obj._key)).sum() >= 8


def test_a_frozen_map_does_not_grow(crossing, learnt):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory, frozen=True)
    told = followed(crossing, method, range(45, 75))
    model = method.objects["box"].model
    assert all(one["box"].T_cam_obj is not None and not one["box"].keyframe for one in told[2:])
    assert len(model.views) == len(learnt.memory.T_cam_obj)
    np.testing.assert_allclose(model.surface.values(), learnt.values, atol=1e-3)


def test_a_mask_of_something_else_founds_no_other_map(learnt, other):
    method = Point2Pose(other.camera)
    method.add_object("box", memory=learnt.memory)
    told = [method.step(other.frame(i), {"box": other.masks(i)["mug"]})["box"] for i in range(15)]
    assert all(one.status is Status.LOST and one.map_id == 0 for one in told)


def test_what_was_clicked_on_and_is_not_it_is_said_to_be_unlike_it(learnt, other):
    method = Point2Pose(other.camera)
    method.add_object("box", memory=learnt.memory)
    said = [method.step(other.frame(0))["box"].reason]
    method.correct("box", mask=other.masks(1)["mug"])
    said += [method.step(other.frame(i))["box"].reason for i in (1, 2)]
    assert said[0] == "known from memory, not found yet" and "does not fit it so far" in said[-1], said


def test_few_landmarks_prove_nothing_on_what_does_not_end_where_depth_does():
    assert _certain(1, 0.9, 0.9, lambda: 0.6)
    assert not _certain(5, 0.9, 0.9, lambda: 0.3) and not _certain(5, 0.9, 0.9, lambda: None)
    assert not _certain(0.9, 0.9, 0.9, lambda: 0.9) and not _certain(5, 0.6, 0.9, lambda: 0.9)
    # What was learnt lying in a surface has few steps there, too; but none at all prove nothing.
    assert _certain(1, 0.9, 0.3, lambda: 0.25) and not _certain(5, 0.9, 0.0, lambda: 0.1)


def test_a_memory_knows_along_how_much_of_its_outline_depth_has_a_step(learnt):
    assert learnt.memory.outline > 0.95  # it stands free


def test_the_outline_of_a_part_of_a_plane_has_no_step_and_of_what_nobody_saw_is_as_before():
    camera = Camera(500.0, 500.0, 160.0, 120.0, 320, 240)
    depth_m, mask = np.full((240, 320), 0.6, np.float32), np.zeros((240, 320), bool)
    mask[80:160, 100:220] = True
    shares = {}
    for name, nearer_m in ("book in a stack", 0.0), ("book on a table", 0.05):
        surface = TsdfVolume(TsdfConfig(voxel_m=0.004))
        seen_m = np.where(mask, depth_m - np.float32(nearer_m), depth_m)
        surface.integrate(seen_m, np.zeros((240, 320, 3), np.uint8), mask, camera, np.eye(4), key=0)
        shares[name] = _outline(surface, 0.3)
    assert shares["book in a stack"] == 0 and shares["book on a table"] > 0.9
    assert _outline(TsdfVolume(TsdfConfig(voxel_m=0.004)), 0.3) == 0.3


def test_along_a_plane_landmarks_tell_where_it_is(crossing, learnt, monkeypatch):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    box, frame = method.objects["box"], crossing.frame(40)
    sample, search = box.policy.shape.sample(box.model), ImageSearch(frame, crossing.camera, box.config.depth)
    T_cam_obj = crossing.truth["box"].T_cam_model[40] @ se3.inverse(learnt.T_obj_model)

    def off_by(R, t_m):
        """A sighting whose pose is off."""
        T = T_cam_obj @ se3.from_rt(R, np.array(t_m))
        return Sighting(T, 0.9, crossing.camera.project(se3.transform(T, sample.p_obj)))

    slid = off_by(np.eye(3), [0.03, 0, 0])
    monkeypatch.setattr(box, "_sightings", lambda *_: [(slid, False)])
    for found in box._as_landmarks_tell(frame, search, slid), box._look(frame, None, None).sighting:
        moved = se3.inverse(T_cam_obj) @ found.T_cam_obj
        assert np.linalg.norm(se3.transform(moved, sample.p_obj) - sample.p_obj, axis=1).max() < 0.006
    turned = off_by(Rotation.from_euler("z", 40, degrees=True).as_matrix(), [0, 0, 0])
    assert box._as_landmarks_tell(frame, search, turned) is None  # no pose like it
    monkeypatch.setattr(box, "_fewest", 500)
    assert box._as_landmarks_tell(frame, search, slid) is None  # too few agree


def test_a_memory_that_no_view_was_added_to_keeps_its_outline(crossing, learnt):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    before = replace(learnt.memory, outline=np.array(0.4))
    assert memory_of("box", method.objects["box"].own.known, {}, before).outline == 0.4


def test_the_graph_keeps_landmarks_where_the_memory_has_them():
    rng = np.random.default_rng(0)
    p_obj = rng.uniform(-0.05, 0.05, (30, 3))
    T_cam_obj = se3.from_rt(np.eye(3), np.array([0.0, 0.0, 0.5]))
    graph = BoundedGraph(preset().factor_graph)
    nothing = np.zeros(0, int), np.zeros((0, 3))
    graph.add_keyframe(T_cam_obj, *nothing, p_obj_init=nothing[1])
    graph.optimise()
    graph.remember(np.arange(30), p_obj)
    off = T_cam_obj @ se3.exp(np.array([0.02, -0.01, 0.02, 0.004, -0.004, 0.004]))
    graph.add_keyframe(off, np.arange(30), se3.transform(T_cam_obj, p_obj), p_obj_init=p_obj)
    result = graph.optimise()
    assert result.ok
    np.testing.assert_allclose(result.p_obj, p_obj, atol=5e-4)
    np.testing.assert_allclose(result.T_cam_obj[-1], T_cam_obj, atol=6e-3)


# -- a restart ---------------------------------------------------------------------------------------


def test_a_tracker_survives_a_restart(crossing, learnt, tmp_path):
    learnt.method.save(tmp_path / "tracker.npz")
    with np.load(tmp_path / "tracker.npz", allow_pickle=False) as file:
        assert json.loads(file["about"].tobytes())["about"]["objects"] == {"box": False}
    loaded = Point2Pose.load(tmp_path / "tracker.npz")
    assert loaded.config == learnt.method.config and loaded.camera == crossing.camera
    again = range(LEARNT[-1] + 1, LEARNT[-1] + 5)
    at_once, *_, told = followed(crossing, loaded, again)
    assert at_once["box"].T_cam_obj is not None, "it is looked for where it was"
    *_, goes_on = followed(crossing, learnt.method, again)
    off = se3.inverse(goes_on["box"].T_cam_obj) @ told["box"].T_cam_obj
    assert np.linalg.norm(off[:3, 3]) < 0.004 and np.degrees(se3.angle_rad(off)) < 2
    with pytest.raises(BadInput, match=r"tracker\.save"):
        save_memory(tmp_path / "box.npz", learnt.memory)
        Point2Pose.load(tmp_path / "box.npz")


def test_where_it_was_before_a_restart_its_shape_tells(crossing, learnt, tmp_path, monkeypatch):
    """As of a mug, of which few landmarks show."""
    learnt.method.save(tmp_path / "tracker.npz")
    monkeypatch.setattr(Remembered, "_recognised", lambda *_: [])
    monkeypatch.setattr(ImageSearch, "among", lambda *_: [])
    (told,) = followed(crossing, Point2Pose.load(tmp_path / "tracker.npz"), [LEARNT[-1] + 1])
    assert told["box"].T_cam_obj is not None


def test_what_is_elsewhere_after_a_restart_is_looked_for_as_any(crossing, learnt, tmp_path):
    learnt.method.save(tmp_path / "tracker.npz")
    loaded = Point2Pose.load(tmp_path / "tracker.npz")
    loaded.objects["box"].left = se3.from_rt(np.eye(3), np.array([0.3, 0.0, 0.0])) @ loaded.objects["box"].left
    first, *_, told = followed(crossing, loaded, LATER[:4])
    assert first["box"].T_cam_obj is None and told["box"].T_cam_obj is not None


def test_what_is_frozen_is_so_after_a_restart_and_what_is_not_found_yet_is_looked_for(crossing, learnt, tmp_path):
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory, frozen=True)
    method.save(tmp_path / "tracker.npz")
    loaded = Point2Pose.load(tmp_path / "tracker.npz")
    told = followed(crossing, loaded, range(45, 52))
    assert told[-1]["box"].T_cam_obj is not None and loaded.objects["box"].policy.frozen


def test_after_a_reset_it_is_looked_for_as_at_first(crossing, learnt):
    method, told = Point2Pose(crossing.camera), []
    for _ in range(2):
        method.add_object("box", memory=learnt.memory)
        told.append(followed(crossing, method, LATER[:3])[-1]["box"])
        method.reset()
    np.testing.assert_array_equal(told[1].T_cam_obj, told[0].T_cam_obj)


def test_a_label_that_repeats_is_looked_at_from_both_sides(crossing, learnt):
    """Most landmarks agree on the wrong side, and the others on the right one, at the same place."""
    method = Point2Pose(crossing.camera)
    method.add_object("box", memory=learnt.memory)
    rows, middle = np.arange(60), learnt.memory.p_obj.mean(0)
    right = crossing.truth["box"].T_cam_model[LEARNT[-1]] @ se3.inverse(learnt.T_obj_model)
    turn = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    wrong = right @ se3.from_rt(turn, middle - turn @ middle)
    p_obj = learnt.memory.p_obj[rows].astype(float)
    p_cam = np.where((rows < 35)[:, None], se3.transform(wrong, p_obj), se3.transform(right, p_obj))
    pairs, asked = Recognised(rows, crossing.camera.project(p_cam), p_cam), []
    search = SimpleNamespace(about=lambda T_cam_obj, sample: asked.append(T_cam_obj))
    method.objects["box"]._recognised(search, pairs)
    assert [np.degrees(se3.angle_rad(se3.inverse(right) @ T)) for T in asked] == pytest.approx([180, 0], abs=1)


def test_look_alikes_are_not_taken_for_each_other(opening):
    alike = opening("look_alikes", range(0, 62, 2))
    method = Point2Pose(alike.camera)
    for name in alike.objects:
        method.add_object(name)
    for i in range(20):
        told = method.step(alike.frame(i), alike.masks(i))
    T_obj_model = {n: se3.inverse(told[n].T_cam_obj) @ alike.truth[n].T_cam_model[19] for n in alike.objects}
    again = Point2Pose(alike.camera)
    for name in alike.objects:
        again.add_object(name, memory=method.memory(name))
    told = followed(alike, again, range(25, 31))[-1]
    for name in alike.objects:
        off = se3.inverse(alike.truth[name].T_cam_model[30]) @ told[name].T_cam_obj @ T_obj_model[name]
        assert np.linalg.norm(off[:3, 3]) < 0.01
