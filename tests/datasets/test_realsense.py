"""RealSense recordings: one made with the library's own software device comes out as it went in.

Skipped where pyrealsense2 is not installed, but for what happens without it.
"""

import sys
import time

import numpy as np
import pytest

from p2p_lib.apps.cli import main
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from p2p_lib.datasets import realsense
from p2p_lib.datasets.convert import convert
from p2p_lib.datasets.sequence import open_sequence

W, H, N = 64, 48, 20


def colour(k):
    image = np.zeros((H, W, 3), np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = 200, np.arange(W), 10 + k
    return image


def depth(k):
    image = np.full((H, W), 7000 + k, np.uint16)
    image[:, :20] = 0
    return image


def record(path, streams=("depth", "color"), coefficients=(0, 0, 0, 0, 0), units_m=1e-4):
    """N frames of a camera that does not exist, recorded to a file in the library's own format."""
    rs = pytest.importorskip("pyrealsense2")
    device = rs.software_device()
    sensors, profiles = [], []
    for uid, name in enumerate(streams):
        sensor = device.add_sensor(name)
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = W, H, 50.0, 51.0, 31.5, 23.5
        lens.model, lens.coeffs = (
            rs.distortion.inverse_brown_conrady,
            list(coefficients) if name == "color" else [0] * 5,
        )
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fps = getattr(rs.stream, name), 0, uid, 30
        stream.width, stream.height, stream.intrinsics = W, H, lens
        stream.bpp, stream.fmt = (2, rs.format.z16) if name == "depth" else (3, rs.format.rgb8)
        if name == "depth":
            sensor.add_read_only_option(rs.option.depth_units, units_m)
        sensors.append(sensor)
        profiles.append(sensor.add_video_stream(stream).as_video_stream_profile())
    if len(profiles) > 1:
        together = rs.extrinsics()
        together.rotation, together.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0.0, 0, 0]
        profiles[0].register_extrinsics_to(profiles[1], together)
    device.create_matcher(rs.matchers.default)
    try:
        recorder = rs.recorder(str(path), device)
    except RuntimeError:  # versions from 2.57 on record .db3, and read both
        path = path.with_suffix(".db3")
        recorder = rs.recorder(str(path), device)
    queue = rs.frame_queue(100)
    opened = recorder.query_sensors()
    for sensor in opened:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    for k in range(N):
        for name, sensor, profile in zip(streams, sensors, profiles):
            frame = rs.software_video_frame()
            frame.bpp = 2 if name == "depth" else 3
            frame.stride, frame.timestamp, frame.frame_number = W * frame.bpp, 5000 + k * 100 / 3, k
            frame.domain, frame.profile = rs.timestamp_domain.hardware_clock, profile
            frame.pixels = depth(k) if name == "depth" else colour(k)
            sensor.on_video_frame(frame)
        time.sleep(0.02)
    time.sleep(0.2)
    for sensor in opened:
        sensor.stop()
        sensor.close()
    return path


def test_a_recording_comes_out_as_it_went_in(tmp_path, capsys):
    bag = record(tmp_path / "a.bag")
    assert main(["convert", str(bag), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert "frames in" in capsys.readouterr().out
    read = open_sequence(tmp_path / "out")
    assert read.camera.K.tolist() == [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]]
    # Which picture it is stands in its blue; the newer library's recorder now and then loses one itself.
    numbers = [int(read.frame(i).rgb[0, 0, 2]) - 10 for i in range(len(read))]
    assert len(numbers) >= N - 2 and (np.diff(numbers) > 0).all()
    np.testing.assert_allclose(read.times_s, (np.array(numbers) - numbers[0]) / 30, atol=1e-4)
    for i, k in enumerate(numbers):
        frame = read.frame(i)
        np.testing.assert_array_equal(frame.rgb, colour(k))
        # Registration leaves some pixels out, in newer versions even between cameras at one place; it makes none up.
        measured = frame.depth_m > 0
        np.testing.assert_allclose(frame.depth_m[measured], depth(k)[measured] * 1e-4, atol=1e-7)
        assert measured.sum() > 0.9 * (depth(k) > 0).sum()


def test_what_cannot_be_used_is_refused(tmp_path):
    pytest.importorskip("pyrealsense2")
    (tmp_path / "text.bag").write_text("hello")
    with pytest.raises(BadInput, match=r"text\.bag: got an unreadable recording"):
        realsense.RealSenseCamera(tmp_path / "text.bag", every=True)
    bag = record(tmp_path / "depth.bag", streams=("depth",))
    with pytest.raises(BadInput, match=r"depth\.\w+: got streams of depth, expected colour and depth"):
        convert(bag, tmp_path / "out", progress=False)
    bag = record(tmp_path / "bent.bag", coefficients=(0.2, 0, 0, 0, 0))
    with pytest.raises(BadInput, match=r"lens moves the corners by \d+\.\d px, expected at most 0\.5 px"):
        convert(bag, tmp_path / "bent", progress=False)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("")
    with pytest.raises(BadInput, match=r"full: got what is there already"):
        convert(bag, tmp_path / "full", progress=False)


def test_without_the_library_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    (tmp_path / "a.bag").write_text("/device_0/sensor_0/Color_0/image/data")
    with pytest.raises(MissingBackend, match=r"RealSense cameras and .* pyrealsense2 .*pip install .p2p_lib"):
        convert(tmp_path / "a.bag", tmp_path / "out")
    with pytest.raises(MissingData, match=r"b\.bag: no such recording"):
        realsense.RealSenseCamera(tmp_path / "b.bag")


def test_a_recording_plays_as_a_camera_does(tmp_path):
    bag = record(tmp_path / "a.bag")
    camera = realsense.RealSenseCamera(bag)
    try:
        frames = list(iter(camera.read, None))
    finally:
        camera.close()
    assert camera.camera.K.tolist() == [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]]
    # Which picture it is stands in its blue. Nobody waited for us: some may be missing, and the index says so.
    numbers = np.array([int(frame.rgb[0, 0, 2]) - 10 for frame in frames])
    assert len(frames) >= N // 2 and (np.diff(numbers) > 0).all()
    np.testing.assert_allclose([f.time_s for f in frames], (numbers - numbers[0]) / 30, atol=1e-4)
    for k, frame in zip(numbers, frames):
        np.testing.assert_array_equal(frame.rgb, colour(k))
        measured = frame.depth_m > 0
        np.testing.assert_allclose(frame.depth_m[measured], depth(k)[measured] * 1e-4, atol=1e-6)
        assert measured.sum() > 0.9 * (depth(k) > 0).sum()
    assert camera.read() is None, "closed"


def test_without_a_camera_it_says_so():
    pytest.importorskip("pyrealsense2")
    with pytest.raises(MissingData, match="realsense: no camera of colour and depth answers"):
        realsense.RealSenseCamera()
