"""From a recording with motion capture to truth, on made-up recordings with the noise of real ones."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.apps.cli import main
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.recording import PoseLog, calibrate, read_log
from p2p_lib.datasets.sequence import open_sequence
from tests.datasets.recordings import noise, record, seen

CAMERA = Camera(614.4, 615.1, 323.5, 239.1, 640, 480)


def apart(T_a, T_b):
    """Degrees and millimetres between two poses."""
    xi = se3.log(se3.inverse(T_a) @ T_b)
    return np.rad2deg(np.linalg.norm(xi[:3])), 1000 * np.linalg.norm(xi[3:])


def write_log(path, log, delimiter=" ", header="time_s tx ty tz qx qy qz qw"):
    rows = np.c_[log.times_s, log.T[:, :3, 3], Rotation.from_matrix(log.T[:, :3, :3]).as_quat()]
    np.savetxt(path, rows, fmt="%.9f", delimiter=delimiter, header=header)
    return path


def test_log_between_samples_and_across_gaps():
    times = np.delete(np.arange(30) * 0.01, np.arange(12, 24))
    xi = np.array([0.5, -0.2, 0.8, 0.3, 0.1, -0.4])
    log = PoseLog(times, se3.exp(times[:, None] * xi))  # constant twist: interpolation is exact
    at = np.array([0.0, 0.013, 0.25, 0.29, -0.001, 0.2901, 0.15])
    got = log.at(at)
    np.testing.assert_allclose(got[:4], se3.exp(at[:4, None] * xi), atol=1e-12)
    assert np.isnan(got[4:]).all()  # before, after, and in a gap of 0.13 s


@pytest.mark.parametrize("drift", [False, True], ids=["white", "wandering"])
@pytest.mark.parametrize("seed", range(3))
def test_offset_of_the_clocks_within_2_ms(seed, drift):
    offset_s = np.random.default_rng(50 + seed).uniform(-0.7, 0.7)
    recording = record(seed, offset_s, drift=drift)
    found = calibrate(recording.camera, recording.mocap)
    assert abs(found.offset_s - offset_s) < 0.002
    # And it knows how well: within four of its own standard deviations.
    assert found.std_s < 0.001 and abs(found.offset_s - offset_s) < 4 * found.std_s
    if not drift:  # an error that wanders by 9 mm and 2 degrees does not average out over twenty seconds
        B = recording.truth.T[500:4500:100]
        got, true = found.T_cam_world @ B @ found.T_body_model, recording.T_cam_world @ B @ recording.T_body_obj
        degrees, millimetres = np.median([apart(a, b) for a, b in zip(got, true)], axis=0)
        assert degrees < 0.15 and millimetres < 1
        for constant, known in (
            (found.T_cam_world, recording.T_cam_world),
            (found.T_body_model, recording.T_body_obj),
        ):
            degrees, millimetres = apart(constant, known)
            assert degrees < 0.25 and millimetres < 2.5


def test_without_noise_the_constants_are_exact():
    recording = record(3, 0.0)
    times_s = np.arange(400) / 30 + 2.0
    exact = recording.T_cam_world @ recording.truth.at(times_s) @ recording.T_body_obj
    found = calibrate(PoseLog(times_s, exact), PoseLog(recording.truth.times_s + 0.123, recording.truth.T))
    assert found.offset_s == pytest.approx(0.123, abs=1e-6)
    np.testing.assert_allclose(found.T_cam_world, recording.T_cam_world, atol=1e-6)
    np.testing.assert_allclose(found.T_body_model, recording.T_body_obj, atol=1e-6)


def test_what_tells_too_little_is_refused():
    recording = record(0, 0.2)
    still = PoseLog(np.arange(600) / 30 + 2, recording.T_cam_world @ noise(np.random.default_rng(0), 600, 0.2, 1))
    for camera, mocap in (
        (still, recording.mocap),  # it does not move
        (recording.camera, record(1, 0.2).mocap),  # another recording's
        (recording.camera, PoseLog(recording.mocap.times_s + 2, recording.mocap.T)),  # outside the search
        (recording.camera, PoseLog(recording.mocap.times_s + 99, recording.mocap.T)),  # no overlap
    ):
        with pytest.raises(BadInput, match=r"clocks: got no clear optimum within 1 s.*same object"):
            calibrate(camera, mocap)
    one_axis = record(0, 0.0, axis=np.array([0.0, 0.0, 1.0]))
    with pytest.raises(BadInput, match=r"turns 0\.\d degrees about a second axis, expected at least 5"):
        calibrate(one_axis.camera, one_axis.mocap)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda rows: rows[:, :7], r"got 40 rows of 7 numbers, expected .*time_s tx"),
        (lambda rows: rows[:10], r"got 10 rows of 8 numbers, expected 30 rows"),
        (lambda rows: rows[::-1], r"increasing times"),
        (lambda rows: rows * [1, 1, 1, 1, 2, 2, 2, 2], r"quaternions that are not of unit length"),
        (lambda rows: rows[:0], r"got 1 rows of 0 numbers"),
    ],
)
def test_faults_of_a_log_name_the_file(tmp_path, spoil, expected):
    rows = np.c_[np.arange(40.0), np.zeros((40, 3)), np.tile([0, 0, 0, 1.0], (40, 1))]
    np.savetxt(tmp_path / "log.txt", spoil(rows))
    with pytest.raises(BadInput, match=r"log\.txt: got .*" + expected if "got" not in expected else expected):
        read_log(tmp_path / "log.txt")


def test_rows_in_which_nothing_was_seen_are_left_out(tmp_path):
    rows = np.c_[np.arange(40.0), np.zeros((40, 3)), np.tile([0, 0, 0, 1.0], (40, 1))]
    rows[5, 1:] = np.nan
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time_s,tx,ty,tz,qx,qy,qz,qw")
    assert len(read_log(tmp_path / "log.csv").times_s) == 39


def test_a_recording_becomes_a_sequence_with_truth(tmp_path, capsys):
    """Recorded frames, motion capture with a gap, everything estimated: the loader reads poses good to millimetres,
    and none of the frames in which the body was not seen counts."""
    recording = record(5, 0.31, seconds=12)
    folder, n = tmp_path / "waved", 40
    for sub in ("rgb", "depth", "masks/can"):
        (folder / sub).mkdir(parents=True)
    times_s = 2 + np.arange(220, 220 + n) / 30
    for i in range(n):
        cv2.imwrite(str(folder / f"rgb/{i:04d}.png"), np.zeros((480, 640, 3), np.uint8))
        cv2.imwrite(str(folder / f"depth/{i:04d}.png"), np.full((480, 640), 700, np.uint16))
        cv2.imwrite(str(folder / f"masks/can/{i:04d}.png"), np.full((480, 640), 255 * (i != 33), np.uint8))
    np.savetxt(folder / "times.txt", times_s, fmt="%.9f")
    np.savetxt(folder / "cam_K.txt", CAMERA.K)
    hidden = recording.mocap.T.copy()
    gone = (recording.mocap.times_s > times_s[20] + 0.31) & (recording.mocap.times_s < times_s[29] + 0.31)
    hidden[gone] = np.nan
    mocap = write_log(tmp_path / "mocap.csv", seen(recording.mocap.times_s, hidden), ",")
    camera = write_log(tmp_path / "camera.txt", recording.camera)
    (tmp_path / "origin.xyz").write_text("0 0 0\n")
    words = ["--object", "can", "--mocap", str(mocap), "--camera", str(camera)]
    assert main(["data", "record-truth", str(folder), *words, "--model", str(tmp_path / "origin.xyz")]) == 0
    assert float(capsys.readouterr().out.split()[1]) == pytest.approx(0.31, abs=0.002)

    read = open_sequence(folder)
    assert read.format == "ycbmultitrack" and read.objects == ("can",)
    truth = read.truth["can"]
    T_true = recording.T_cam_world @ recording.truth.at(times_s) @ recording.T_body_obj
    tracked = np.r_[np.ones(20, bool), np.zeros(11, bool), np.ones(9, bool)]
    errors = np.array([apart(a, b) for a, b in zip(truth.T_cam_model[tracked], T_true[tracked])])
    assert errors[:, 0].max() < 1.0 and errors[:, 1].max() < 6
    np.testing.assert_array_equal(truth.T_cam_model[22:28], np.broadcast_to(truth.T_cam_model[22], (6, 4, 4)))
    assert not truth.labelled[22:28].any()
    expected = CAMERA.inside(CAMERA.project(T_true[:, :3, 3]))  # the model is its origin alone
    expected[33] = False  # its mask is empty there
    np.testing.assert_array_equal(truth.labelled[tracked], expected[tracked])

    for path, log in ((mocap, recording.mocap), (camera, recording.camera)):
        early = log.times_s < 9
        write_log(path, PoseLog(log.times_s[early], log.T[early]))
    assert main(["data", "record-truth", str(folder), *words]) == 2
    assert "mocap.csv: got no pose at the times of the images" in capsys.readouterr().err
