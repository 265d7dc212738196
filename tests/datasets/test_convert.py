"""What people have recorded: each form, written as its own tools write it, comes out as what went in."""

import shutil
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.apps.check import check_folder
from p2p_lib.apps.cli import main
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from p2p_lib.datasets import convert as converting
from p2p_lib.datasets.convert import convert
from p2p_lib.datasets.sequence import open_sequence

W, H, N = 48, 36, 4
K = np.array([[50.0, 0, 23], [0, 51, 17], [0, 0, 1]])


def colour(k):
    image = np.zeros((H, W, 3), np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = 200, 5 * np.arange(W), 10 * k
    return image


def depth_m(k):
    """Metres on the grid of 0.2 mm that is also one of 1 mm; nothing was measured on the left."""
    depth = np.full((H, W), 0.7 + 0.001 * k)
    depth[:, :10] = 0
    return depth


def png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def own_folder(folder, save, scale=None):
    """A plain folder, of which ``save(path without suffix, depth in metres)`` writes the depth."""
    (folder / "depth").mkdir(parents=True)
    for k in range(N):
        png(folder / "rgb" / f"{k}.png", colour(k))
        save(folder / "depth" / str(k), depth_m(k))
    np.savetxt(folder / "cam_K.txt", K)
    if scale:
        (folder / "depth_scale.txt").write_text(str(scale))
    return folder


def same(sequence, numbers=range(N)):
    np.testing.assert_allclose(sequence.camera.K, K)
    assert len(sequence) == len(numbers)
    for i, k in enumerate(numbers):
        frame = sequence.frame(i)
        np.testing.assert_array_equal(frame.rgb, colour(k))
        np.testing.assert_allclose(frame.depth_m, depth_m(k), atol=1e-6)


# --- folders -------------------------------------------------------------------------------------


def tum(folder, K_file=True):
    """Depth 10 ms after colour and one in between; the last colour image has none within 20 ms."""
    rgb, depth = ["# color images", "# timestamp filename"], ["# depth maps"]
    for k in range(N):
        png(folder / "rgb" / f"{100 + k / 10:.6f}.png", colour(k))
        rgb.append(f"{100 + k / 10:.6f} rgb/{100 + k / 10:.6f}.png")
        for late_s, k_depth in ((0.01, k), (0.05, 9)):
            time_s = 100 + k / 10 + late_s + (k == N - 1) * 0.03
            png(folder / "depth" / f"{time_s:.6f}.png", np.rint(5000 * depth_m(k_depth)).astype(np.uint16))
            depth.append(f"{time_s:.6f} depth/{time_s:.6f}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    if K_file:
        np.savetxt(folder / "cam_K.txt", K)
    return folder


def test_tum_pairs_images_by_time(tmp_path):
    sequence = open_sequence(tum(tmp_path / "desk"))
    assert sequence.format == "tum"
    same(sequence, range(N - 1))
    np.testing.assert_allclose(sequence.times_s, [100, 100.1, 100.2])


def test_tum_knows_its_own_cameras_by_the_folders_name(tmp_path):
    sequence = open_sequence(tum(tmp_path / "rgbd_dataset_freiburg2_desk", K_file=False))
    assert (sequence.camera.fx, sequence.camera.cy) == (520.9, 249.7)
    with pytest.raises(MissingData, match=r"cam_K\.txt: no such file, .*\. Write fx 0 cx 0 fy cy 0 0 1 into cam_K"):
        open_sequence(tum(tmp_path / "mine", K_file=False))


def test_tum_faults_are_named(tmp_path):
    folder = tum(tmp_path / "desk")
    text = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([text[3], text[2]]))
    with pytest.raises(BadInput, match=r"rgb\.txt: got times that run backwards at 100\.0"):
        open_sequence(folder)
    (folder / "rgb.txt").write_text(f"{text[2]}\nnan rgb/none.png")
    with pytest.raises(BadInput, match=r"rgb\.txt: got times that run backwards at nan"):
        open_sequence(folder)
    (folder / "rgb.txt").write_text("100.0\n")
    with pytest.raises(BadInput, match=r"rgb\.txt: got another kind of line"):
        open_sequence(folder)
    (folder / "rgb.txt").write_text(text[2].replace("100.0", "300.0", 1))
    with pytest.raises(BadInput, match=r"images at most 20 ms apart\. Are both of one clock"):
        open_sequence(folder)


def test_open3ds_recordings_are_read_as_open3d_reads_them(tmp_path):
    from p2p_lib.core.native import load_open3d

    open3d, folder = load_open3d(), tmp_path / "recorded"
    for k in range(N):
        png(folder / "color" / f"{k:05d}.png", colour(k))
        png(folder / "depth" / f"{k:05d}.png", np.rint(1000 * depth_m(k)).astype(np.uint16))
    lens = open3d.camera.PinholeCameraIntrinsic(W, H, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    open3d.io.write_pinhole_camera_intrinsic(str(folder / "camera_intrinsic.json"), lens)
    assert open_sequence(folder).format == "open3d"
    same(open_sequence(folder))
    (folder / "color").rename(folder / "rgb")  # as whoever has read the README calls it
    assert open_sequence(folder).format == "folder"
    same(open_sequence(folder))
    (folder / "rgb").rename(folder / "color")
    lens = open3d.camera.PinholeCameraIntrinsic(2 * W, 2 * H, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    open3d.io.write_pinhole_camera_intrinsic(str(folder / "camera_intrinsic.json"), lens)
    with pytest.raises(BadInput, match=f"the camera of images of {2 * W}x{2 * H}, expected that of these, {W}x{H}"):
        open_sequence(folder)
    (folder / "camera_intrinsic.json").unlink()
    with pytest.raises(MissingData, match=r"intrinsic\.json, as Open3D's layout .*name that with --format"):
        open_sequence(folder)
    np.savetxt(folder / "cam_K.txt", K)
    same(open_sequence(folder))


FLOATS = {
    "npy in metres": lambda path, depth: np.save(path, depth),
    "npy in millimetres": lambda path, depth: np.save(path, (1000 * depth).astype(np.float32)),
    "npy of uint16": lambda path, depth: np.save(path, np.rint(1000 * depth).astype(np.uint16)),
    "tif in metres": lambda path, depth: cv2.imwrite(f"{path}.tif", depth.astype(np.float32)),
    "tif in millimetres": lambda path, depth: cv2.imwrite(f"{path}.tif", (1000 * depth).astype(np.float32)),
}


@pytest.mark.parametrize("case", FLOATS)
def test_floats_are_noticed_to_be_metres_or_millimetres(case, tmp_path):
    same(open_sequence(own_folder(tmp_path / "own", FLOATS[case])))


def test_a_scale_that_is_given_counts(tmp_path):
    folder = own_folder(tmp_path / "own", FLOATS["npy in metres"], scale=0.5)
    assert open_sequence(folder).frame(0).depth_m.max() == pytest.approx(0.35)
    assert open_sequence(folder, depth_scale=0.25).frame(0).depth_m.max() == pytest.approx(0.175)


def test_a_damaged_array_is_named(tmp_path):
    folder = own_folder(tmp_path / "own", FLOATS["npy in metres"])
    (folder / "depth" / "0.npy").write_bytes(b"no array")
    with pytest.raises(BadInput, match=r"0\.npy: got an unreadable array"):
        open_sequence(folder)


@pytest.mark.parametrize("make", [tum, lambda folder: own_folder(folder, FLOATS["npy in metres"])], ids=["tum", "npy"])
def test_any_layout_becomes_a_plain_folder(make, tmp_path):
    source = make(tmp_path / "source")
    assert main(["convert", str(source), "--out", str(tmp_path / "out")]) == 0
    sequence = open_sequence(tmp_path / "out")
    same(sequence, range(len(open_sequence(source))))
    assert sequence.format == "folder" and sequence.times_s[0] == 0
    with pytest.raises(BadInput, match="what is there already"):
        convert(source, tmp_path / "out")


# --- files where a folder is meant ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "what"),
    {
        "a.mcap": "got a recording of ROS 2, expected a folder of images. Make a folder of it: p2p convert",
        "a.bag": "got a recording of ROS 1 or a RealSense",
        "a.mkv": "got a recording of an Azure Kinect",
        "a.mp4": "got a video of colour alone, expected colour and depth. Its depth is missing",
        "a.txt": "got a file, expected a folder with rgb/",
    }.items(),
)
def test_a_file_is_told_apart_from_what_is_not_there(name, what, tmp_path, capsys):
    (tmp_path / name).write_text("")
    assert main(["run", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
    assert what in capsys.readouterr().err
    (finding,) = check_folder(tmp_path / name)
    assert what.split("got ")[1].split(",")[0] in finding.text and finding.fix
    with pytest.raises(MissingData, match="no such file"):
        open_sequence(tmp_path / f"gone_{name}")


# --- ROS -----------------------------------------------------------------------------------------

D = (0.4, -0.1, 0, 0, 0)


@pytest.fixture
def ros():
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    return SimpleNamespace(stores=Stores, get=get_typestore)


def write_bag(path, ros, version, compressed=False, distortion=(), depth_encoding="16UC1", storage="mcap", shift_s=0.0):
    """N frames of a realsense2_camera, its infrared image and unregistered depth beside; depth comes 4 ms later."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    store = ros.get(ros.stores.ROS1_NOETIC if version == 1 else ros.stores.ROS2_HUMBLE)
    types, sequence = store.types, {"seq": 0} if version == 1 else {}
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if version == 1 else Writer2(path, version=9, storage_plugin=plugin)
    write = store.serialize_ros1 if version == 1 else store.serialize_cdr
    with writer:
        links = {}

        def put(topic, kind, time_s, **fields):
            name = f"sensor_msgs/msg/{kind}"
            if topic not in links:
                links[topic] = writer.add_connection(topic, name, typestore=store)
            stamp = types["builtin_interfaces/msg/Time"](sec=int(time_s), nanosec=round(time_s % 1 * 1e9))
            header = types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id="camera")
            writer.write(links[topic], round(time_s * 1e9), write(types[name](header=header, **fields), name))

        def image(topic, time_s, array, encoding):
            size = {"height": H, "width": W, "encoding": encoding, "is_bigendian": 0}
            # Rows are padded, as drivers do.
            rows = np.pad(array.reshape(H, -1).view(np.uint8), ((0, 0), (0, 8)))
            put(topic, "Image", time_s, **size, step=rows.shape[1], data=rows.ravel())

        def packed(topic, time_s, array, format, header=b""):
            data = np.frombuffer(header + cv2.imencode(".png", array)[1].tobytes(), np.uint8)
            put(topic, "CompressedImage", time_s, format=format, data=data)

        for k in range(N):
            t = 1000 + k / 30
            values = np.array(distortion, float), K.ravel(), np.eye(3).ravel(), np.zeros(12)
            about = dict(zip("DKRP" if version == 1 else "dkrp", values)) | {"height": H, "width": W}
            about["roi"] = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            about |= {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
            put("/camera/color/camera_info", "CameraInfo", t, **about)
            image("/camera/infra1/image_rect_raw", t, colour(k)[..., 0].copy(), "mono8")
            image("/camera/depth/image_rect_raw", t, np.zeros((H, W), np.uint16), "16UC1")
            depth = depth_m(k).astype(np.float32)
            depth = depth if depth_encoding == "32FC1" else np.rint(1000 * depth).astype(np.uint16)
            topic, later = "/camera/aligned_depth_to_color/image_raw", t + 0.004 + shift_s
            if compressed:
                packed("/camera/color/image_raw/compressed", t, colour(k)[..., ::-1], "rgb8; png compressed bgr8")
                packed(f"{topic}/compressedDepth", later, depth, "16UC1; compressedDepth png", bytes(12))
            else:
                image("/camera/color/image_raw", t, colour(k), "rgb8")
                image(topic, later, depth, depth_encoding)
    return path


ROS = {
    "ros1": {"version": 1},
    "ros1, floats": {"version": 1, "depth_encoding": "32FC1"},
    "mcap": {"version": 2},
    "mcap, compressed": {"version": 2, "compressed": True},
    "db3": {"version": 2, "storage": "sqlite3"},
}


@pytest.mark.parametrize("lone", [False, True], ids=["as recorded", "lone file"])
@pytest.mark.parametrize("case", ROS)
def test_a_ros_recording_comes_out_as_it_went_in(case, lone, ros, tmp_path, capsys):
    source = write_bag(tmp_path / ("a.bag" if ROS[case]["version"] == 1 else "a"), ros, **ROS[case])
    if lone:
        source = next(iter(source.glob("*.[md][cb]*"))) if source.is_dir() else source
        source = shutil.copy(source, tmp_path / f"lone{source.suffix}")
    assert main(["convert", str(source), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert f"{N} frames in" in capsys.readouterr().out
    sequence = open_sequence(tmp_path / "out")
    same(sequence)
    np.testing.assert_allclose(sequence.times_s, np.arange(N) / 30, atol=1e-5)


def test_a_lens_is_straightened(ros, tmp_path):
    """OpenCV's own distortion of a pixel says where its colour has to come from."""
    convert(write_bag(tmp_path / "a", ros, 2, distortion=D), tmp_path / "out", progress=False)
    frame = open_sequence(tmp_path / "out").frame(0)
    u, v = 40, 18
    ray = np.array([[(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0]])
    ((from_u, _),) = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, np.array(D))[0].reshape(1, 2)
    assert abs(from_u - u) > 0.3, "or nothing would be seen of it"
    assert frame.rgb[v, u, 1] == pytest.approx(5 * from_u, abs=1)


def test_what_a_ros_recording_lacks_is_named(ros, tmp_path):
    source = write_bag(tmp_path / "a", ros, 2, shift_s=5.0)
    with pytest.raises(BadInput, match=r"no images of .* within 25 ms"):
        convert(source, tmp_path / "out", progress=False)
    with pytest.raises(BadInput, match=r"depth: got topics /camera.*Name it: --colour TOPIC --depth TOPIC"):
        convert(source, tmp_path / "out", depth="/none", progress=False)
    (tmp_path / "text.bag").write_text("hello")
    with pytest.raises(BadInput, match=r"text\.bag: got an unreadable recording"):
        convert(tmp_path / "text.bag", tmp_path / "out", progress=False)


def test_without_rosbags_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    (tmp_path / "a.mcap").write_text("")
    with pytest.raises(MissingBackend, match=r"ROS recordings: the package rosbags .*pip install .p2p_lib"):
        convert(tmp_path / "a.mcap", tmp_path / "out")


# --- Azure Kinect --------------------------------------------------------------------------------


class KinectReader:
    """Stands in for Open3D's, which needs the camera's own library; every other image was missed by a camera."""

    def open(self, path):
        self.left = [k for k in range(N) for _ in range(2)]
        return path.endswith("a.mkv")

    def get_metadata(self):
        return SimpleNamespace(intrinsics=SimpleNamespace(intrinsic_matrix=K, width=W, height=H))

    def is_eof(self):
        return not self.left

    def next_frame(self):
        k = self.left.pop(0)
        taken = len(self.left) % 2
        return SimpleNamespace(color=colour(k), depth=np.rint(1000 * depth_m(k)).astype(np.uint16)) if taken else None

    def close(self):
        self.left = None


def test_an_azure_kinects_recording_is_what_open3d_reads(tmp_path, monkeypatch):
    io = SimpleNamespace(AzureKinectMKVReader=KinectReader)
    monkeypatch.setattr(converting, "load_open3d", lambda: SimpleNamespace(io=io))
    for name in ("a.mkv", "film.mkv"):
        (tmp_path / name).write_text("")
    assert convert(tmp_path / "a.mkv", tmp_path / "out", progress=False) == N
    same(open_sequence(tmp_path / "out"))
    with pytest.raises(BadInput, match=r"film\.mkv: got what is no recording of an Azure Kinect"):
        convert(tmp_path / "film.mkv", tmp_path / "none", progress=False)


def test_a_text_file_is_no_recording(tmp_path):
    (tmp_path / "int.log").write_text("started")
    with pytest.raises(BadInput, match=r"a text file, expected what a camera recorded\. Give a recording"):
        convert(tmp_path / "int.log", tmp_path / "out")
