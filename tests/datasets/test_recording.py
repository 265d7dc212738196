"""From a recording with motion capture to truth, on made-up recordings with the noise of real ones."""

import cv2
import numpy as np
import pytest
import trimesh
from recordings import noise, record

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.recording.alignment import align_markers, refine_on_surface, rigid_fit, surface_in_body
from p2p_lib.datasets.recording.hand_eye import closed_form, hand_eye
from p2p_lib.datasets.recording.synchronise import synchronise
from p2p_lib.datasets.recording.tags import camera_in_world, detect_tags, robust_mean
from p2p_lib.datasets.recording.tracks import PoseTrack
from p2p_lib.datasets.recording.truth import RecordedObject, held, in_image, object_poses, write_truth
from p2p_lib.datasets.sequence import open_sequence

CAMERA = Camera(614.4, 615.1, 323.5, 239.1, 640, 480)


def apart(T_a, T_b):
    """Degrees and millimetres between two poses."""
    xi = se3.log(se3.inverse(T_a) @ T_b)
    return np.rad2deg(np.linalg.norm(xi[:3])), 1000 * np.linalg.norm(xi[3:])


# --- poses over time -------------------------------------------------------------------------------


def test_track_between_samples_and_across_gaps():
    times = np.arange(10) * 0.01
    xi = np.array([0.5, -0.2, 0.8, 0.3, 0.1, -0.4])
    T = se3.exp(times[:, None] * xi)  # constant twist: interpolation is exact
    T[5] = np.nan
    track = PoseTrack(times, T)
    at = np.array([0.0, 0.013, 0.052, 0.09, -0.001, 0.0901])
    got = track.at(at)
    np.testing.assert_allclose(got[:4], se3.exp(at[:4, None] * xi), atol=1e-12)
    assert np.isnan(got[4:]).all()  # outside
    assert np.isnan(track.at(at, max_gap_s=0.015)[2]).all() and np.isfinite(track.at(at, max_gap_s=0.015)[1]).all()
    with pytest.raises(BadInput, match="times that do not increase"):
        PoseTrack(times[::-1], T)


# --- clocks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("drift", [False, True], ids=["white", "wandering"])
@pytest.mark.parametrize("seed", range(5))
def test_offset_of_the_clocks_within_2_ms(seed, drift):
    offset_s = np.random.default_rng(50 + seed).uniform(-0.7, 0.7)
    recording = record(seed, offset_s, drift=drift)
    found = synchronise(recording.camera, recording.mocap)
    assert abs(found.offset_s - offset_s) < 0.002
    # And it knows how well: within four of its own standard deviations.
    assert found.std_s < 0.001 and abs(found.offset_s - offset_s) < 4 * found.std_s
    if not drift:  # an error that wanders by 9 mm and 2 degrees does not average out over twenty seconds
        B = recording.truth.T[500:4500:100]
        got, true = found.T_cam_world @ B @ found.T_body_obj, recording.T_cam_world @ B @ recording.T_body_obj
        degrees, millimetres = np.median([apart(a, b) for a, b in zip(got, true)], axis=0)
        assert degrees < 0.15 and millimetres < 1


def test_what_cannot_be_synchronised_is_refused():
    recording = record(0, 0.2)
    still = PoseTrack(recording.camera.times_s, recording.T_cam_world @ noise(np.random.default_rng(0), 600, 0.2, 1))
    with pytest.raises(BadInput, match="expected a second at least, in which the object turns"):
        synchronise(still, recording.mocap)
    with pytest.raises(BadInput, match=r"a correlation of 0\.\d+ at best, expected at least 0\.5\. Is it"):
        synchronise(recording.camera, record(1, 0.2).mocap)
    with pytest.raises(BadInput, match=r"synchronisation: got"):
        synchronise(record(2, 2.0).camera, record(2, 2.0).mocap, search_s=0.3)  # the offset is outside the search


# --- camera in the world ---------------------------------------------------------------------------


def test_closed_form_is_exact_without_noise():
    rng = np.random.default_rng(0)
    X, Y, B = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=(6, 6)))
    found = closed_form(X @ B @ Y, B)
    np.testing.assert_allclose(found[0], X, atol=1e-9)
    np.testing.assert_allclose(found[1], Y, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_hand_eye_with_noise_and_wild_poses(seed):
    recording = record(seed, 0.0)
    B = recording.truth.at(recording.camera.times_s)
    found = hand_eye(recording.camera.T, B)
    for got, true in ((found.T_cam_world, recording.T_cam_world), (found.T_body_obj, recording.T_body_obj)):
        degrees, millimetres = apart(got, true)
        assert degrees < 0.25 and millimetres < 2.5
    assert 0.5 < np.rad2deg(found.rotation_rad) < 2 and 2 < found.translation_m * 1000 < 8


def test_hand_eye_needs_two_axes():
    recording = record(0, 0.0, axis=np.array([0.0, 0.0, 1.0]))
    with pytest.raises(BadInput, match=r"turns 0\.\d degrees about a second axis, expected at least 5"):
        hand_eye(recording.camera.T, recording.truth.at(recording.camera.times_s))
    few = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(BadInput, match="got 3 pairs of poses"):
        hand_eye(few, few)


def picture_of_tag(T_cam_tag, number, size_m, rng, family=cv2.aruco.DICT_APRILTAG_36h11):
    """A photograph: the printed tag with its white margin, three samples a pixel, blur and noise."""
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(family), number, 400)
    sheet = np.pad(tag, 80, constant_values=255)
    px_m = size_m / 400
    # Sheet pixel (c, r) lies at ((c - 279.5) px, (279.5 - r) px, 0) of the tag's frame.
    P = CAMERA.K @ T_cam_tag[:3] @ np.array([[px_m, 0, -279.5 * px_m], [0, -px_m, 279.5 * px_m], [0, 0, 0], [0, 0, 1]])
    fine = np.array([[3, 0, 1], [0, 3, 1], [0, 0, 1.0]])  # the centre of a pixel is that of its nine
    image = cv2.warpPerspective(sheet, fine @ P, (1920, 1440), flags=cv2.INTER_AREA, borderValue=120)
    image = cv2.resize(cv2.GaussianBlur(image, (0, 0), 2.0), (640, 480), interpolation=cv2.INTER_AREA)
    image = np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
    return np.repeat(image[..., None], 3, 2)


def facing(rng, distance_m=0.8):
    """A tag tilted by 20 to 50 degrees, its z towards the camera."""
    tilt = np.deg2rad(rng.uniform(20, 50)) * np.array([np.cos(a := rng.uniform(0, 2 * np.pi)), np.sin(a), 0])
    R = se3.exp(np.r_[tilt, 0, 0, 0])[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    return se3.from_rt(R, np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.1, 0.1), distance_m]))


@pytest.mark.parametrize("family", ["APRILTAG_36h11", "5X5_100"])
def test_tags_in_pictures(family):
    rng = np.random.default_rng(0)
    errors = []
    for number in range(12):
        truth = facing(rng)
        picture = picture_of_tag(truth, number, 0.16, rng, getattr(cv2.aruco, f"DICT_{family}"))
        found = detect_tags(picture, CAMERA, 0.16, family)
        assert list(found) == [number]
        assert found[number].error_px < 0.5 and found[number].error_px <= found[number].other_error_px
        errors.append(apart(found[number].T_cam_tag, truth))
    degrees, millimetres = np.median(errors, axis=0)
    assert degrees < 1.0 and millimetres < 5
    assert detect_tags(np.full((480, 640, 3), 128, np.uint8), CAMERA, 0.16, family) == {}


def test_camera_in_the_world_from_pictures_of_a_tag_moved_about():
    """Motion capture follows the tag; flipped poses, of which a flat square has one each, are outvoted."""
    rng = np.random.default_rng(1)
    T_cam_world = se3.exp(rng.normal(size=6))
    T_cam_tag = np.stack([facing(rng) for _ in range(25)])
    T_world_tag = se3.inverse(T_cam_world) @ T_cam_tag
    seen = []
    for k, T in enumerate(T_cam_tag):
        found = detect_tags(picture_of_tag(T, 7, 0.16, rng), CAMERA, 0.16)[7]
        seen.append(found.other_T_cam_tag if k % 5 == 0 else found.T_cam_tag)
    seen.append(np.full((4, 4), np.nan))
    T_world_tag = np.concatenate([T_world_tag, T_world_tag[:1]])
    degrees, millimetres = apart(camera_in_world(np.stack(seen), T_world_tag), T_cam_world)
    assert degrees < 0.3 and millimetres < 5


def test_robust_mean_and_faults():
    rng = np.random.default_rng(2)
    true = se3.exp(rng.normal(size=6))
    T = true @ noise(rng, 400, 0.5, 2)
    T[:120] = T[:120] @ noise(rng, 120, 50, 300)
    degrees, millimetres = apart(robust_mean(T), true)
    assert degrees < 0.2 and millimetres < 0.8
    with pytest.raises(BadInput, match="expected at least one picture"):
        camera_in_world(np.full((2, 4, 4), np.nan), np.eye(4))
    with pytest.raises(BadInput, match=r"tag family: got 'X', expected one of .*APRILTAG_36h11"):
        detect_tags(np.zeros((48, 64, 3), np.uint8), CAMERA, 0.1, "X")
    with pytest.raises(BadInput, match="tag size: got 160"):
        detect_tags(np.zeros((48, 64, 3), np.uint8), CAMERA, 160)


# --- the mesh in its body --------------------------------------------------------------------------

MARKERS = np.array([[0.05, 0.01, 0.09], [-0.04, 0.03, 0.02], [0.01, -0.05, 0.12], [-0.02, 0.05, 0.15], [0.03, 0.04, 0]])


@pytest.mark.parametrize("count", [4, 5])
def test_markers_in_any_order(count):
    rng = np.random.default_rng(count)
    true = se3.exp(rng.normal(size=6))
    order = rng.permutation(count)
    p_body = se3.transform(true, MARKERS[:count])[order] + rng.normal(0, 0.0005, (count, 3))
    found = align_markers(p_body, MARKERS[:count])
    assert [order[k] for k in found.order] == list(range(count))
    degrees, millimetres = apart(found.T_body_model, true)
    assert degrees < 0.8 and millimetres < 1.5 and found.rms_m < 0.001


def test_symmetric_markers_and_wrong_counts_are_refused():
    square = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * 0.04
    with pytest.raises(BadInput, match=r"two orders that fit to .* mm, expected one .*Place the markers"):
        align_markers(square, square)
    with pytest.raises(BadInput, match=r"markers: got \(2, 3\) and \(2, 3\), expected as many"):
        align_markers(MARKERS[:2], MARKERS[:2])


def test_rigid_fit_never_mirrors():
    p = MARKERS[:3]
    T, rms = rigid_fit(p, p * [-1, 1, 1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1) and rms < 1e-12  # three points: a turn does it
    T, rms = rigid_fit(MARKERS, MARKERS * [-1, 1, 1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1) and rms > 0.005


@pytest.fixture(scope="module")
def bottle():
    """A lopsided mesh: nothing of it looks the same from two sides."""
    parts = [trimesh.creation.box((0.09, 0.06, 0.16)), trimesh.creation.cylinder(0.02, 0.05, sections=40)]
    parts[1].apply_translation([0.02, 0.01, 0.105])
    parts.append(trimesh.creation.box((0.03, 0.04, 0.05)))
    parts[2].apply_translation([-0.05, -0.02, -0.03])
    return trimesh.util.concatenate(parts)


def depth_of(mesh, T_cam_model, camera, rng):
    """Depth of the mesh, the nearest of a hundred surface points a pixel, with a sensor's noise."""
    surface, _ = trimesh.sample.sample_surface(mesh, 150_000, seed=rng)
    p_cam = se3.transform(T_cam_model, surface)
    u, v = np.rint(camera.project(p_cam)).astype(int).T
    depth_m = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth_m, (v, u), p_cam[:, 2])
    return np.where(np.isfinite(depth_m), depth_m + rng.normal(0, 0.0015, depth_m.shape), 0)


def test_surface_seen_lays_the_mesh_into_its_body(bottle):
    """From 8 mm and 4 degrees off, as markers picked by hand leave it, to a millimetre."""
    rng = np.random.default_rng(3)
    camera = Camera(150, 150, 80, 60, 160, 120)
    T_body_model = se3.exp(rng.normal(size=6))
    points = []
    for _ in range(10):
        view = se3.from_rt(se3.exp(np.r_[rng.normal(0, 2, 3), 0, 0, 0])[:3, :3], [0, 0, 0.5])
        depth_m = depth_of(bottle, view, camera, rng)
        T_cam_body = view @ se3.inverse(T_body_model) @ noise(rng, 1, 0.1, 0.3)[0]
        points.append(surface_in_body(depth_m, depth_m > 0, camera, T_cam_body))
    points.append(rng.normal(0, 0.3, (300, 3)))  # a hand
    start = T_body_model @ se3.exp(np.r_[np.deg2rad([2, -3, 2]), 0.005, -0.005, 0.004])
    found = refine_on_surface(start, np.concatenate(points), bottle.vertices, bottle.faces, rng)
    degrees, millimetres = apart(found.T_body_model, T_body_model)
    assert apart(start, T_body_model)[1] > 8
    assert degrees < 0.4 and millimetres < 1.0 and found.rms_m < 0.003
    with pytest.raises(BadInput, match="surface: got 50 points, expected at least 100"):
        refine_on_surface(start, np.zeros((50, 3)), bottle.vertices, bottle.faces, rng)
    with pytest.raises(BadInput, match=r"points near the mesh, expected at least 100\. Is the start right"):
        refine_on_surface(start, np.concatenate(points) + 5, bottle.vertices, bottle.faces, rng)


# --- truth -----------------------------------------------------------------------------------------


def test_held_and_in_image():
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, 0, 3] = np.arange(6)
    T[[0, 3, 4]] = np.nan
    assert held(T)[:, 0, 3].tolist() == [1, 1, 2, 2, 2, 5]
    with pytest.raises(BadInput, match="no pose at all"):
        held(T[3:5])
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, :3, 3] = [[0, 0, 1], [0, 0, 1], [0.6, 0, 1], [0, 0, 1], [0, 0, -1], [0.5, 0, 1]]
    T[0] = np.nan
    points = np.array([[0.0, 0, 0], [-0.02, 0, 0]])
    assert in_image(T, points, CAMERA).tolist() == [False, True, False, True, False, True]


def test_a_recording_becomes_a_sequence_with_truth(tmp_path):
    """Recorded frames, motion capture with a gap, everything estimated: the loader reads poses good to millimetres,
    and none of the frames in which the body was not seen counts."""
    recording = record(5, 0.31, seconds=12)
    sync = synchronise(recording.camera, recording.mocap)
    folder = tmp_path / "waved"
    for sub in ("rgb", "depth", "masks/can"):
        (folder / sub).mkdir(parents=True)
    n = 40
    times_s = recording.camera.times_s[220 : 220 + n]
    for i in range(n):
        cv2.imwrite(str(folder / f"rgb/{i:04d}.png"), np.zeros((480, 640, 3), np.uint8))
        cv2.imwrite(str(folder / f"depth/{i:04d}.png"), np.full((480, 640), 700, np.uint16))
        cv2.imwrite(str(folder / f"masks/can/{i:04d}.png"), np.full((480, 640), 255 * (i != 33), np.uint8))
    np.savetxt(folder / "times.txt", times_s, fmt="%.9f")
    np.savetxt(folder / "cam_K.txt", CAMERA.K)
    hidden = recording.mocap.T.copy()
    gone = (recording.mocap.times_s > times_s[20] + 0.31) & (recording.mocap.times_s < times_s[29] + 0.31)
    hidden[gone] = np.nan
    mocap = PoseTrack(recording.mocap.times_s, hidden)
    can = RecordedObject(mocap, recording.T_body_obj, np.zeros((1, 3)))
    write_truth(folder, open_sequence(folder), {"can": can}, sync.offset_s, sync.T_cam_world, min_visible_px=300)

    read = open_sequence(folder)
    assert read.format == "ycbmultitrack" and read.objects == ("can",)
    truth = read.truth["can"]
    T_true = recording.T_cam_world @ recording.truth.at(times_s) @ recording.T_body_obj
    seen = np.isfinite(object_poses(times_s, sync.offset_s, sync.T_cam_world, can)).all((1, 2))
    assert not seen[22:28].any() and seen[:20].all() and seen[31:].all()
    errors = np.array([apart(a, b) for a, b in zip(truth.T_cam_model[seen], T_true[seen])])
    assert errors[:, 0].max() < 1.0 and errors[:, 1].max() < 6
    np.testing.assert_array_equal(truth.T_cam_model[22:28], np.broadcast_to(truth.T_cam_model[22], (6, 4, 4)))
    expected = seen & in_image(T_true, can.points, CAMERA)
    expected[33] = False  # its mask is empty there
    np.testing.assert_array_equal(truth.labelled, expected)
