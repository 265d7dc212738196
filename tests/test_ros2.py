"""The package for ROS 2, on messages as a distribution defines them; ROS itself is not needed.

The definitions are those of rosbags, which writes what is filled as ROS would send it.
"""

import importlib
import io
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as xml
from array import array
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, Doubt
from p2p_lib.core.memory import save_memory
from p2p_lib.core.options import RunOptions
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import PoseEstimate, Status
from point2pose_ros import messages as ros
from point2pose_ros import node as nodes

PROJECT = Path(__file__).resolve().parents[1]
NODE, MESSAGES = PROJECT / "ros2/point2pose_ros", PROJECT / "ros2/point2pose_msgs"
PRINT = np.kron(np.random.default_rng(0).integers(0, 255, (10, 12, 3)), np.ones((8, 8, 1))).astype(np.uint8)
CARD = Prompt("card", 0, points_px=[[100, 119], [80, 110], [120, 130]])


@cache
def definitions(distribution: str = "ros2_humble"):
    """The messages of a distribution, and ours."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores(distribution))
    for path in [*MESSAGES.glob("msg/*.msg"), *MESSAGES.glob("srv/*.srv")]:
        for part, text in zip(("", "_Response"), re.split("^---$", path.read_text(), flags=re.MULTILINE), strict=False):
            store.register(get_types_from_msg(text, f"point2pose_msgs/msg/{path.stem}{part}"))
    return store


#: Words of ROS for numbers that NumPy calls otherwise.
NUMBERS = {"byte": "uint8", "char": "uint8"}


def blank(kind: str, **given: Any) -> Any:
    """A message as rclpy makes it: zeros, "" and nothing in arrays of any length."""
    store = definitions()
    values = {}
    for name, (sort, what) in store.fielddefs[kind][1]:
        if sort == 1:  # a number, a text or a truth value
            values[name] = {"string": "", "bool": False}.get(what[0], 0.0 if "float" in what[0] else 0)
        elif sort == 2:  # a message
            values[name] = blank(what)
        else:  # an array of a length, or of any
            number = what[0][0] == 1 and what[0][1][0] != "string"
            values[name] = np.zeros(what[1], NUMBERS.get(what[0][1][0], what[0][1][0])) if number else []
    return store.types[kind](**(values | given))


def check_fields(message: Any) -> None:
    """A field that the definition lacks is refused by ROS, wherever in the message it is."""
    given = {name: value for name, value in vars(message).items() if not (name.isupper() or name == "__msgtype__")}
    assert given.keys() == {name for name, _ in definitions().fielddefs[message.__msgtype__][1]}
    for name, value in given.items():
        if isinstance(value, array):  # which rclpy wants and rosbags does not know
            setattr(message, name, np.asarray(value))
        for part in value if isinstance(value, list) else [value]:
            if hasattr(part, "__msgtype__"):
                check_fields(part)


def read(message: Any) -> Any:
    """As ROS sends and receives it."""
    check_fields(message)
    kind = message.__msgtype__
    return definitions().deserialize_cdr(definitions().serialize_cdr(message, kind), kind)


def header(time: tuple[int, int] = (0, 0)) -> Any:
    stamp = blank("builtin_interfaces/msg/Time", sec=time[0], nanosec=time[1])
    return blank("std_msgs/msg/Header", stamp=stamp, frame_id="camera_optical")


def image(array: np.ndarray, encoding: str, time: tuple[int, int] = (0, 0), pad: int = 0, big: bool = False) -> Any:
    """A sensor_msgs/Image, its rows padded by so many bytes."""
    kind = array.dtype.newbyteorder(">" if big else "<")
    rows = array.astype(kind).view(np.uint8).reshape(len(array), -1)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    size = {"height": array.shape[0], "width": array.shape[1], "step": rows.shape[1]}
    shape = {"encoding": encoding, "is_bigendian": int(big), "data": rows.ravel(), **size}
    return blank("sensor_msgs/msg/Image", header=header(time), **shape)


def images(k: int) -> tuple[Any, Any, Any]:
    """A printed card that moves by 3 px a frame, as a driver publishes it."""
    rgb, depth_mm = np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 1000, np.uint16)
    part = np.s_[80:160, 60 + 3 * k : 156 + 3 * k]
    rgb[part], depth_mm[part] = PRINT, 600
    time = (5, k * 33_000_000)
    K = np.array([300.0, 0, 159.5, 0, 300.0, 119.5, 0, 0, 1])
    info = blank("sensor_msgs/msg/CameraInfo", k=K, width=320, height=240)
    return image(rgb[..., ::-1], "bgr8", time, pad=8), image(depth_mm, "16UC1", time), info


def request(kind: str, name: str, points=(), **given: Any) -> Any:
    at = [blank("geometry_msgs/msg/Point", x=float(x), y=float(y)) for x, y in points]
    return blank(f"point2pose_msgs/msg/{kind}", name=name, **({"points": at} if at else {}), **given)


def answer(kind: str = "AddObject") -> Any:
    return blank(f"point2pose_msgs/msg/{kind}_Response")


def fill(estimate: PoseEstimate, kind: str = "geometry_msgs/msg/PoseWithCovarianceStamped") -> Any:
    return read(ros.fill_pose(blank(kind), estimate, header()))


def test_clicks_become_poses_of_the_images_they_are_of():
    got = []
    node = nodes.TrackingNode(RunOptions(prompts=[CARD]), lambda estimate, header: got.append((estimate, header)))
    for k in range(4):
        node.on_images(*images(k))
    assert [header.stamp.nanosec for _, header in got] == [k * 33_000_000 for k in range(4)]
    sent = [fill(estimate) for estimate, _ in got]
    assert got[0][1].frame_id == "camera_optical" and got[0][0].time_s == 5.0
    moved_m = sent[-1].pose.pose.position.x - sent[0].pose.pose.position.x
    assert moved_m == pytest.approx(3 * 3 * 0.6 / 300, abs=0.002) and sent[0].pose.pose.position.z > 0.55


def test_messages_have_the_conventions_of_ros():
    T = se3.exp(np.array([0.3, -0.2, 0.9, 0.1, 0.2, 0.7]))
    covariance = np.diag([4.0, 1, 1, 9, 1, 1]) * 1e-6  # uncertain about the object's x, and along it
    estimate = PoseEstimate("mug", 0, 0.0, Status.TRACKED, T, 0.9, covariance)
    sent = read(ros.fill_transform(blank("geometry_msgs/msg/TransformStamped"), estimate, header(), "arm/"))
    assert sent.child_frame_id == "arm/mug" and sent.header.frame_id == "camera_optical"
    turn, at = sent.transform.rotation, sent.transform.translation
    np.testing.assert_allclose(Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), T[:3, :3], atol=1e-9)
    np.testing.assert_allclose([at.x, at.y, at.z], T[:3, 3])
    # By samples: poses drawn around T, their errors measured in the camera's axes.
    xi = np.random.default_rng(0).normal(size=(20_000, 6)) * np.sqrt(np.diag(covariance))
    drawn = T @ se3.exp(xi)
    about = Rotation.from_matrix(drawn[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    errors = np.concatenate([drawn[:, :3, 3] - T[:3, 3], about], -1)
    np.testing.assert_allclose(np.reshape(fill(estimate).pose.covariance, (6, 6)), np.cov(errors.T), atol=4e-7)


def test_an_estimate_says_what_is_known():
    kind = "point2pose_msgs/msg/ObjectEstimate"
    gone = PoseEstimate("mug", 3, 0.1, Status.OCCLUDED, reason="not found since frame 2")
    sent = read(ros.fill_estimate(blank(kind), gone, header()))
    assert (sent.object, sent.status, sent.reason, sent.has_pose) == ("mug", "occluded", gone.reason, False)
    there = PoseEstimate("mug", 3, 0.1, Status.TRACKED, se3.exp(np.array([0, 0, 0, 0.1, 0, 1.0])), 0.75, map_id=2)
    sent = read(ros.fill_estimate(blank(kind), there, header()))
    assert sent.has_pose and sent.pose.pose.position.x == 0.1 and (sent.confidence, sent.map_id) == (0.75, 2)


@pytest.mark.parametrize("distribution", ["ros2_humble", "ros2_jazzy", "ros2_kilted"])
def test_a_mesh_arrives_whole(distribution):
    kind, ball = "visualization_msgs/msg/Marker", trimesh.creation.icosphere(1, 0.05)
    sent = read(ros.fill_marker(blank(kind), "mug", ball, "arm/"))
    got = trimesh.load_mesh(io.BytesIO(bytes(sent.mesh_file.data)), "ply", process=False)
    np.testing.assert_allclose(got.vertices, ball.vertices, atol=1e-7)
    marker = definitions(distribution).types[kind]
    assert (sent.type, sent.action, ros.DELETE) == (marker.MESH_RESOURCE, marker.ADD, marker.DELETE)
    assert sent.header.frame_id == "arm/mug" and sent.ns == "mug" and sent.mesh_resource == "embedded://mug.ply"
    assert sent.mesh_file.filename == "mug.ply" and sent.scale.x == sent.color.a == 1


@pytest.mark.parametrize(("pad", "big"), [(0, False), (6, False), (0, True)])
def test_depth_is_read_whatever_its_rows_and_bytes(pad, big):
    rgb = np.zeros((3, 5, 3), np.uint8)
    depth_m = np.linspace(0, 2, 15, dtype=np.float32).reshape(3, 5)
    for values, encoding, step in ((depth_m, "32FC1", 1e-6), ((depth_m * 1000).astype(np.uint16), "16UC1", 1e-3)):
        frame = ros.frame_of(0, image(rgb, "rgb8"), image(values, encoding, pad=pad, big=big))
        np.testing.assert_allclose(frame.depth_m, depth_m, atol=step)


def test_what_cannot_be_meant_is_refused():
    rgb = np.zeros((3, 5, 3), np.uint8)
    colour, depth = image(rgb, "rgb8"), image(np.zeros((3, 5), np.uint16), "16UC1")
    with pytest.raises(BadInput, match="rgb8 or bgr8"):
        ros.frame_of(0, image(rgb, "bayer_rggb8"), depth)
    with pytest.raises(BadInput, match="16UC1"):
        ros.frame_of(0, colour, image(rgb, "rgb8"))
    depth.data = depth.data[:-1]
    with pytest.raises(BadInput, match="3 rows of at least 10 bytes"):
        ros.frame_of(0, colour, depth)
    with pytest.raises(BadInput, match=r"camera_info\.k"):
        ros.camera_of(blank("sensor_msgs/msg/CameraInfo", width=5, height=3))


def test_a_request_says_points_boxes_and_masks():
    mask = np.zeros((4, 6), np.uint8)
    mask[1:3, 2:5] = 255
    prompt = ros.prompt_of(request("CorrectObject", "mug", mask=image(mask, "mono8", pad=3)))
    np.testing.assert_array_equal(prompt.mask, mask > 0)
    box = blank("sensor_msgs/msg/RegionOfInterest", x_offset=10, y_offset=20, width=30, height=40)
    prompt = ros.prompt_of(request("AddObject", "mug", [(320, 240)], box=box))
    assert prompt.points_px.tolist() == [[320, 240]] and prompt.box_px.tolist() == [10, 20, 40, 60]
    with pytest.raises(BadInput, match="mono8"):
        ros.prompt_of(request("AddObject", "mug", mask=image(mask.astype(np.uint16), "mono16")))


def test_services_add_correct_and_remove(tmp_path):
    got: list[PoseEstimate] = []
    node = nodes.TrackingNode(RunOptions(), lambda estimate, header: got.append(estimate))
    early = node.add(request("AddObject", "card", CARD.points_px), answer())
    assert not early.success and "before the first image" in early.message
    node.on_images(*images(0))
    assert node.add(request("AddObject", "card", CARD.points_px), answer()).success and got == []
    node.on_images(*images(1))
    assert got[-1].object == "card" and got[-1].T_cam_obj is not None
    assert "not in use" in node.add(request("AddObject", "card", [(100, 100)]), answer()).message
    for kind, serve in (("CorrectObject", node.correct), ("RemoveObject", node.remove)):
        assert "cup" in serve(request(kind, "cup", *[[(1, 1)]] * (kind != "RemoveObject")), answer(kind)).message
    assert "at least one" in node.correct(request("CorrectObject", "card"), answer("CorrectObject")).message
    assert node.correct(request("CorrectObject", "card", [(106, 119)]), answer("CorrectObject")).success
    node.on_images(*images(2))
    assert node.meshes().keys() == {"card"} and len(node.meshes()["card"].faces) > 100
    file = tmp_path / "card.npz"
    save_memory(file, node.tracker.memory("card"))
    assert node.remove(request("RemoveObject", "card"), answer("RemoveObject")).success and not node.meshes()
    both = node.add(request("AddObject", "card", [(1, 1)], memory=str(file)), answer())
    assert "one of them" in both.message and not both.success
    assert "no such file" in node.add(request("AddObject", "card", memory="none.npz"), answer()).message
    assert node.add(request("AddObject", "card", memory=str(file)), answer()).success
    for k in range(3, 9):
        node.on_images(*images(k))
    assert got[-1].object == "card" and got[-1].T_cam_obj is not None, "found without a click"


def test_clicks_belong_to_the_image_whose_stamp_they_have():
    """A card that moves: what was clicked on is found where it was, and a correction of it holds no longer."""
    got: list[PoseEstimate] = []
    node = nodes.TrackingNode(RunOptions(), lambda estimate, header: got.append(estimate))
    node.on_images(*images(0))
    stamp = images(0)[0].header.stamp
    assert node.add(request("AddObject", "card", CARD.points_px, stamp=stamp), answer()).success
    node.on_images(*images(0))
    assert got[-1].T_cam_obj is not None, "nothing has moved since"
    moved = request("CorrectObject", "card", CARD.points_px, stamp=stamp)
    assert node.correct(moved, answer("CorrectObject")).success
    with pytest.warns(Doubt, match="have changed by frame 2"):
        node.on_images(*images(9))
    assert "have changed by frame 2" in got[-1].reason
    moved.stamp.nanosec += 1
    late = node.correct(moved, answer("CorrectObject"))
    assert not late.success and "one of the last 60 images that were tracked" in late.message


def test_an_image_of_another_size_is_left_out():
    """Until so many come that the camera is another one."""
    got: list[PoseEstimate] = []
    node = nodes.TrackingNode(RunOptions(prompts=[CARD]), lambda estimate, header: got.append(estimate))
    rgb, depth, info = images(1)
    small = image(np.zeros((60, 80, 3), np.uint8), "rgb8"), image(np.zeros((60, 80), np.uint16), "16UC1"), info
    node.on_images(*images(0))
    node.on_images(*small)
    node.on_images(image(np.zeros((60, 80, 3), np.uint8), "rgb8"), depth, info)
    with pytest.warns(Doubt, match="80x60, not 320x240 .* It is left out") as said:
        node.on_images(rgb, depth, info)
    assert len(got) == 2 and sum("left out" in str(of.message) for of in said) == 2
    with pytest.raises(BadInput, match="30 in a row were"):
        for _ in range(30):
            node.on_images(*small)


def test_parameters_are_options_of_a_run():
    given = {**nodes.PARAMETERS, "settings": ["tsdf.voxel_m=0.004"], "preset": "paper", "memory": ["", "a.npz"]}
    options = nodes.options_of(given)
    assert options.config().tsdf.voxel_m == 0.004 and options.memory == ("a.npz",) and options.prompts is None
    assert options.config().method.mechanisms == "none"
    with pytest.raises(BadInput, match=r"settings.*stage\.key=value"):
        nodes.options_of({**nodes.PARAMETERS, "settings": ["voxel"]})


class Part(SimpleNamespace):
    """Takes whatever it is made of."""

    def __init__(self, *words, **named):
        super().__init__(words=words, **named)


def module(monkeypatch, name: str, **what: Any) -> Any:
    made = SimpleNamespace(__spec__=None, __path__=[], **what)
    monkeypatch.setitem(sys.modules, name, made)
    return made


@pytest.fixture
def spun(monkeypatch):
    """Runs the node on a ROS that is as large as the node asks for; what it sent, called and made, in order."""

    def spin(parameters: dict[str, Any], script) -> list[tuple[str, Any]]:
        sent: list[tuple[str, Any]] = []

        class Node:
            services, timers = {}, []

            def declare_parameter(self, name, default):
                return Part(value=parameters.get(name, default))

            def create_publisher(self, kind, topic, how):
                assert kind is not None
                return Part(publish=lambda message: sent.append((topic, read(message))))

            def create_service(self, kind, name, serve):
                made = {"add_object": "AddObject", "correct_object": "CorrectObject", "remove_object": "RemoveObject"}
                assert kind == made[name.removeprefix("~/")]
                self.services[name] = serve

            def create_timer(self, period_s, call):
                self.timers.append((period_s, call))

            def get_logger(self):
                return Part(info=lambda line: None, warning=lambda line: sent.append(("warning", line)))

            def destroy_node(self):
                sent.append(("destroyed", None))

        class Together:
            def __init__(self, topics, queue_size, slop):
                assert [words[2] for words in (topic.words for topic in topics)] == ["rgb", "depth", "camera_info"]

            def registerCallback(self, call):
                Node.call = staticmethod(call)

        def kinds(package, *names):
            return {n: lambda n=n, **given: blank(f"{package}/msg/{n}", **given) for n in names}

        class Stopped(Exception): ...

        def spin_once(node):
            script(node)
            raise Stopped

        qos = Part(qos_profile_sensor_data="sensors", QoSProfile=Part, DurabilityPolicy=Part(TRANSIENT_LOCAL=1))
        executors = Part(ExternalShutdownException=Stopped)
        over = {"init": lambda: None, "try_shutdown": lambda: sent.append(("shut down", None)), "spin": spin_once}
        module(monkeypatch, "rclpy", create_node=lambda name: Node(), **over)
        module(monkeypatch, "rclpy.qos", **vars(qos))
        module(monkeypatch, "rclpy.executors", **vars(executors))
        module(monkeypatch, "message_filters", Subscriber=Part, ApproximateTimeSynchronizer=Together)
        broadcaster = Part(sendTransform=lambda message: sent.append(("tf", read(message))))
        module(monkeypatch, "tf2_ros", TransformBroadcaster=lambda node: broadcaster)
        module(monkeypatch, "sensor_msgs.msg", Image="image", CameraInfo="info")
        stamped = ("PoseWithCovarianceStamped", "TransformStamped")
        module(monkeypatch, "geometry_msgs.msg", **kinds("geometry_msgs", *stamped))
        module(monkeypatch, "visualization_msgs.msg", **kinds("visualization_msgs", "Marker", "MarkerArray"))
        module(monkeypatch, "point2pose_msgs.msg", **kinds("point2pose_msgs", "ObjectEstimate"))
        services = ("AddObject", "CorrectObject", "RemoveObject")
        module(monkeypatch, "point2pose_msgs.srv", **{name: name for name in services})
        for package in ("sensor_msgs", "geometry_msgs", "visualization_msgs", "point2pose_msgs"):
            module(monkeypatch, package)
        nodes.main()
        return sent

    return spin


def test_the_node_spins_and_publishes(spun):
    def script(node):
        node.call(*images(0))
        assert node.services["~/add_object"](request("AddObject", "2 cards", CARD.points_px), answer()).success
        node.call(*images(1))
        ((period_s, show),) = node.timers
        assert period_s in (0.5, 2.0)
        show()
        node.services["~/remove_object"](request("RemoveObject", "2 cards"), answer("RemoveObject"))
        show()

    sent = spun({"mesh_period_s": 0.5, "frame_prefix": "a/"}, script)
    topics = [topic for topic, _ in sent]
    assert topics == ["~/estimates", "~/poses/_2_cards", "tf", "~/meshes", "~/meshes", "destroyed", "shut down"]
    said = dict(sent[:3])
    assert said["~/estimates"].object == "2 cards" and said["tf"].child_frame_id == "a/2 cards"
    assert said["~/poses/_2_cards"].pose.pose.position.z > 0.55
    assert [[marker.action for marker in message.markers] for _, message in sent[3:5]] == [[0], [2]]
    only_sure = [topic for topic, _ in spun({"min_confidence": 1.0}, script)]
    assert [topic for topic in only_sure if topic in ("~/poses/_2_cards", "tf")] == [] and "~/estimates" in only_sure


def test_what_is_wrong_with_the_node_is_one_line(spun, tmp_path):
    with pytest.raises(SystemExit, match=r"point2pose: .*missing\.json"):
        spun({"prompts": str(tmp_path / "missing.json")}, lambda node: None)
    ran = subprocess.run([sys.executable, "-m", "point2pose_ros.node"], cwd=NODE, capture_output=True, text=True)
    assert ran.returncode == 1 and "Traceback" not in ran.stderr and "of ROS 2 is not to be found" in ran.stderr


# --- ROS itself, where it is installed: make test-ros ------------------------------------------


@pytest.fixture
def rclpy(monkeypatch):
    """The real one, with the messages built; heard on this machine alone."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for name in ("rclpy", "point2pose_msgs.msg"):
        pytest.importorskip(name, reason="no ROS is installed. Run: make test-ros")
    return sys.modules["rclpy"]


def real(message: Any, into: Any = None) -> Any:
    """The same message of ROS itself; ``into`` a request, whose kind ROS calls otherwise."""
    package, name = message.__msgtype__.split("/msg/")
    made = into or getattr(importlib.import_module(f"{package}.msg"), name)()
    for field, _ in definitions().fielddefs[message.__msgtype__][1]:
        value = getattr(message, field)
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            value = array("B", value.tobytes())
        values = [
            real(one) if hasattr(one, "__msgtype__") else one for one in (value if isinstance(value, list) else [value])
        ]
        setattr(made, field, values if isinstance(value, list) else values[0])
    return made


def test_real_messages_are_filled_and_sent_as_the_definitions_say(rclpy):
    from rclpy.serialization import deserialize_message, serialize_message

    T, ball = se3.exp(np.array([0.3, -0.2, 0.9, 0.1, 0.2, 0.7])), trimesh.creation.icosphere(1, 0.05)
    sure = np.diag([4.0, 1, 1, 9, 1, 1]) * 1e-6
    mug = PoseEstimate("mug", 3, 0.1, Status.DEGRADED, T, 0.75, sure, map_id=2, reason="a doubt")
    filled = {
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda blank, header: ros.fill_pose(blank, mug, header),
        "point2pose_msgs/msg/ObjectEstimate": lambda blank, header: ros.fill_estimate(blank, mug, header),
        "geometry_msgs/msg/TransformStamped": lambda blank, header: ros.fill_transform(blank, mug, header, "arm/"),
        "visualization_msgs/msg/Marker": lambda blank, header: ros.fill_marker(blank, "mug", ball, "arm/"),
    }
    for kind, fill_it in filled.items():
        made = fill_it(real(blank(kind)), real(header((5, 7))))
        sent = serialize_message(made)
        assert deserialize_message(sent, type(made)) == made
        theirs = fill_it(blank(kind), header((5, 7)))
        check_fields(theirs)
        again = definitions().deserialize_cdr(sent, kind)  # what ROS leaves between fields is not the same twice
        assert definitions().serialize_cdr(again, kind) == definitions().serialize_cdr(theirs, kind), kind


class Driver:
    """A camera and somebody who listens, in a context of ROS of their own."""

    def __init__(self, rclpy):
        from rclpy.executors import SingleThreadedExecutor

        self.rclpy, self.context = rclpy, rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.node = rclpy.create_node("camera", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        sent = real(images(0)[0]), real(images(0)[1]), real(images(0)[2])
        self.topics = [self.node.create_publisher(type(m), n, 5) for m, n in zip(sent, ("rgb", "depth", "camera_info"))]

    def heard(self, kind: Any, topic: str) -> list[Any]:
        came: list[Any] = []
        self.node.create_subscription(kind, topic, came.append, 10)
        return came

    def until(self, done, again=lambda: None) -> None:
        """Do it again every half second until something has come; what is sent as sensors do may be lost."""
        for _ in range(120):
            again()
            for _ in range(10):
                self.executor.spin_once(timeout_sec=0.05)
                if done():
                    return
        raise AssertionError("nothing came in a minute")

    def show(self, k: int) -> None:
        """The k-th image, with its depth and camera."""
        for topic, message in zip(self.topics, map(real, images(k))):
            message.header.stamp.sec, message.header.stamp.nanosec = 5, k * 33_000_000
            topic.publish(message)

    def call(self, service: str, asked: Any) -> Any:
        kind = getattr(importlib.import_module("point2pose_msgs.srv"), asked.__msgtype__.split("/")[-1])
        client = self.node.create_client(kind, f"/point2pose/{service}")
        self.until(client.service_is_ready)
        answered = client.call_async(real(asked, kind.Request()))
        self.until(answered.done)
        return answered.result()

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.rclpy.shutdown(context=self.context)
        self.rclpy.try_shutdown()  # the node's, which ends it


class Subscriber:
    """Of message_filters: a subscription, whose messages go to whoever synchronises."""

    def __init__(self, node, kind, topic, qos_profile):
        self.take = lambda message: None
        self.subscription = node.create_subscription(kind, topic, lambda message: self.take(message), qos_profile)


class Together:
    """Of message_filters: calls with messages of one time, once."""

    def __init__(self, topics, queue_size, slop):
        self.topics, self.waiting = topics, {}

    def registerCallback(self, call):
        def take(index, message):
            of_time = self.waiting.setdefault((message.header.stamp.sec, message.header.stamp.nanosec), {})
            before, of_time[index] = len(of_time), message
            if before < len(of_time) == len(self.topics):
                call(*(of_time[k] for k in range(len(self.topics))))

        for index, topic in enumerate(self.topics):
            topic.take = partial(take, index)


def test_a_real_node_serves_and_publishes(rclpy, monkeypatch):
    """Over DDS, with parameters as a command gives them; message_filters and tf2_ros alone, of no wheels, stand in."""
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from point2pose_msgs.msg import ObjectEstimate
    from visualization_msgs.msg import MarkerArray

    transforms: list[Any] = []
    module(monkeypatch, "message_filters", Subscriber=Subscriber, ApproximateTimeSynchronizer=Together)
    module(monkeypatch, "tf2_ros", TransformBroadcaster=lambda node: Part(sendTransform=transforms.append))
    given = {"mesh_period_s": "0.2", "frame_prefix": "arm/", "settings": "['tsdf.voxel_m=0.004']"}
    words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    monkeypatch.setattr(sys, "argv", ["node", "--ros-args", *words])

    def drive(driver: Driver) -> tuple[list, list]:
        try:
            estimates = driver.heard(ObjectEstimate, "/point2pose/estimates")
            poses = driver.heard(PoseWithCovarianceStamped, "/point2pose/poses/card")
            shown = driver.heard(MarkerArray, "/point2pose/meshes")
            said = [driver.call("add_object", card := request("AddObject", "card", CARD.points_px))]
            while not said[-1].success:
                assert "before the first image" in said[-1].message
                driver.show(0)
                said.append(driver.call("add_object", card))
            for k in range(1, 4):
                driver.until(lambda k=k: len(estimates) >= k and len(poses) >= k, partial(driver.show, k))
            driver.until(lambda: any(array_of.markers for array_of in shown))
            (marker,) = next(array_of.markers for array_of in shown if array_of.markers)
            mesh = trimesh.load_mesh(io.BytesIO(bytes(marker.mesh_file.data)), "ply")
            assert marker.header.frame_id == "arm/card" and len(mesh.faces) > 100
            assert driver.call("remove_object", request("RemoveObject", "card")).success
            driver.until(lambda: any(m.action == ros.DELETE for array_of in shown for m in array_of.markers))
            return estimates, poses
        finally:
            driver.close()

    with ThreadPoolExecutor(1) as pool:
        driven = pool.submit(drive, Driver(rclpy))
        nodes.main()
        estimates, poses = driven.result()
    assert [(e.object, e.status, e.header.stamp.nanosec) for e in estimates] == [
        ("card", "tracked", k * 33_000_000) for k in range(1, 4)
    ]
    moved_m = poses[2].pose.pose.position.x - poses[0].pose.pose.position.x
    assert moved_m == pytest.approx(2 * 3 * 0.6 / 300, abs=0.002) and poses[0].header.frame_id == "camera_optical"
    assert [t.child_frame_id for t in transforms] == ["arm/card"] * 3


def test_the_package_is_whole(tmp_path):
    given = yaml.safe_load((NODE / "config/point2pose.yaml").read_text())["/**"]["ros__parameters"]
    assert {"prompts": "", **given} == nodes.PARAMETERS
    listed = (MESSAGES / "CMakeLists.txt").read_text()
    assert set(re.findall(r"\w+/\w+\.(?:msg|srv)", listed)) == {
        str(path.relative_to(MESSAGES)) for path in [*MESSAGES.glob("msg/*"), *MESSAGES.glob("srv/*")]
    }
    packages = [xml.parse(folder / "package.xml").getroot() for folder in (NODE, MESSAGES)]
    assert [package.findtext("name") for package in packages] == [NODE.name, MESSAGES.name]
    source = shutil.copytree(NODE, tmp_path / "source")
    installed = [sys.executable, "setup.py", "-q", "install", "--root", tmp_path, "--prefix", "/ws", "--no-compile"]
    ran = subprocess.run(
        [*installed, "--single-version-externally-managed"], cwd=source, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "ws/lib/point2pose_ros/node").read_text().startswith("#!/usr/bin/env python3\n")
    for shared in ("launch/point2pose.launch.py", "config/point2pose.yaml", "package.xml"):
        assert (tmp_path / "ws/share/point2pose_ros" / shared).is_file()
