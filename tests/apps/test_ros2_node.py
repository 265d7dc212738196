"""The node for ROS 2, with stand-ins that have the fields of its messages; ROS itself is not needed."""

import subprocess
import sys
from types import SimpleNamespace as Message

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.apps import ros2_node
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import PoseEstimate, Status

PRINT = np.kron(np.random.default_rng(0).integers(0, 255, (10, 12, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def image(array: np.ndarray, encoding: str, stamp: Message, pad: int = 0, big: bool = False) -> Message:
    """A sensor_msgs/Image, its rows padded by so many bytes."""
    kind = array.dtype.newbyteorder(">" if big else "<")
    rows = array.astype(kind).view(np.uint8).reshape(len(array), -1)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    header = Message(stamp=stamp, frame_id="camera_optical")
    size = {"height": array.shape[0], "width": array.shape[1], "step": rows.shape[1]}
    return Message(header=header, encoding=encoding, is_bigendian=int(big), data=rows.tobytes(), **size)


def messages(k: int) -> tuple[Message, Message, Message]:
    """A printed card that moves by 3 px a frame, as a driver publishes it."""
    rgb, depth_mm = np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 1000, np.uint16)
    part = np.s_[80:160, 60 + 3 * k : 156 + 3 * k]
    rgb[part], depth_mm[part] = PRINT, 600
    stamp = Message(sec=5, nanosec=k * 33_000_000)
    info = Message(k=np.array([300.0, 0, 159.5, 0, 300.0, 119.5, 0, 0, 1]), width=320, height=240)
    return image(rgb[..., ::-1], "bgr8", stamp, pad=8), image(depth_mm, "16UC1", stamp), info


def blank() -> Message:
    vector = Message(x=0.0, y=0.0, z=0.0)
    turn = Message(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = Message(pose=Message(position=vector, orientation=turn), covariance=[0.0] * 36)
    return Message(header=None, child_frame_id="", pose=pose, transform=Message(translation=vector, rotation=turn))


def test_clicks_become_poses_of_the_images_they_are_of():
    published = []
    prompt = Prompt("card", 0, points_px=[[100, 119], [80, 110], [120, 130]])
    node = ros2_node.TrackingNode([prompt], lambda estimate, header: published.append((estimate, header)))
    for k in range(4):
        node.on_images(*messages(k))
    assert [header.stamp.nanosec for _, header in published] == [k * 33_000_000 for k in range(4)]
    sent = [ros2_node.fill_pose(blank(), *one) for one in published]
    assert sent[0].header.frame_id == "camera_optical" and published[0][0].time_s == 5.0
    moved_m = sent[-1].pose.pose.position.x - sent[0].pose.pose.position.x
    assert moved_m == pytest.approx(3 * 3 * 0.6 / 300, abs=0.002) and sent[0].pose.pose.position.z > 0.55


def test_messages_have_the_conventions_of_ros():
    T = se3.exp(np.array([0.3, -0.2, 0.9, 0.1, 0.2, 0.7]))
    covariance = np.diag([4.0, 1, 1, 9, 1, 1]) * 1e-6  # uncertain about the object's x, and along it
    estimate = PoseEstimate("mug", 0, 0.0, Status.TRACKED, T, 0.9, covariance)
    header = Message(frame_id="camera")
    sent = ros2_node.fill_transform(blank(), estimate, header)
    assert sent.child_frame_id == "mug" and sent.header is header
    turn, at = sent.transform.rotation, sent.transform.translation
    np.testing.assert_allclose(Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), T[:3, :3], atol=1e-9)
    np.testing.assert_allclose([at.x, at.y, at.z], T[:3, 3])
    got = np.reshape(ros2_node.fill_pose(blank(), estimate, header).pose.covariance, (6, 6))
    # By samples: poses drawn around T, their errors measured in the camera's axes.
    xi = np.random.default_rng(0).normal(size=(20_000, 6)) * np.sqrt(np.diag(covariance))
    drawn = T @ se3.exp(xi)
    about = Rotation.from_matrix(drawn[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    errors = np.concatenate([drawn[:, :3, 3] - T[:3, 3], about], -1)
    np.testing.assert_allclose(got, np.cov(errors.T), atol=4e-7)


@pytest.mark.parametrize(("pad", "big"), [(0, False), (6, False), (0, True)])
def test_depth_is_read_whatever_its_rows_and_bytes(pad, big):
    stamp, rgb = Message(sec=0, nanosec=0), np.zeros((3, 5, 3), np.uint8)
    depth_m = np.linspace(0, 2, 15, dtype=np.float32).reshape(3, 5)
    for array, encoding, step in ((depth_m, "32FC1", 1e-6), ((depth_m * 1000).astype(np.uint16), "16UC1", 1e-3)):
        frame = ros2_node.frame_of(0, image(rgb, "rgb8", stamp), image(array, encoding, stamp, pad, big))
        np.testing.assert_allclose(frame.depth_m, depth_m, atol=step)


def test_what_cannot_be_meant_is_refused():
    stamp, rgb = Message(sec=0, nanosec=0), np.zeros((3, 5, 3), np.uint8)
    colour, depth = image(rgb, "rgb8", stamp), image(np.zeros((3, 5), np.uint16), "16UC1", stamp)
    with pytest.raises(BadInput, match="rgb8 or bgr8"):
        ros2_node.frame_of(0, image(rgb, "bayer_rggb8", stamp), depth)
    with pytest.raises(BadInput, match="16UC1"):
        ros2_node.frame_of(0, colour, image(rgb, "rgb8", stamp))
    depth.data = depth.data[:-1]
    with pytest.raises(BadInput, match="3 rows of at least 10 bytes"):
        ros2_node.frame_of(0, colour, depth)
    with pytest.raises(BadInput, match=r"camera_info\.k"):
        ros2_node.camera_of(Message(k=np.zeros(9), width=5, height=3))


#: As much of ROS as main() asks for; spinning hands the node what the synchroniser is called with.
ROS = """
import sys
from types import ModuleType, SimpleNamespace as M
def module(name, **what):
    sys.modules[name] = made = ModuleType(name)
    vars(made).update(what)
    return made
calls = []
class Node:
    def declare_parameter(self, name, default): return M(value={"prompts": sys.argv[1]}.get(name, default))
    def create_publisher(self, kind, topic, depth): return M(publish=lambda m: calls.append((topic, m)))
    def create_subscription(self, kind, topic, hear, depth): Node.hear = hear
    def get_logger(self): return M(info=lambda line: None, warning=lambda line: calls.append((line[:4], None)))
    def destroy_node(self): calls.append(("destroyed", None))
class Sync:
    def __init__(self, topics, queue_size, slop): self.topics = topics
    def registerCallback(self, back): Sync.back = back
sys.path.insert(0, sys.argv[2])
from tests.apps.test_ros2_node import blank, messages
qos = module("rclpy.qos", qos_profile_sensor_data="sensors")
module("rclpy", init=lambda: None, create_node=lambda name: Node(), shutdown=lambda: None, qos=qos,
       spin=lambda node: [(Sync.back(*messages(k)), Node.hear(M(data=line))) for k, line in enumerate(sys.argv[3:])])
module("std_msgs"); module("std_msgs.msg", String=object)
module("message_filters", Subscriber=lambda node, kind, topic, qos_profile: topic, ApproximateTimeSynchronizer=Sync)
module("tf2_ros", TransformBroadcaster=lambda node: M(sendTransform=lambda m: calls.append(("tf", m))))
module("sensor_msgs"); module("sensor_msgs.msg", Image=object, CameraInfo=object)
module("geometry_msgs"); module("geometry_msgs.msg", PoseWithCovarianceStamped=blank, TransformStamped=blank)
from p2p_lib.apps.ros2_node import main
main()
print(*(topic for topic, _ in calls))
"""


def test_the_node_spins_and_publishes(tmp_path):
    prompts = tmp_path / "prompts.json"
    prompts.write_text('{"objects": [{"name": "card", "frame": 0, "points": [[100, 119], [80, 110], [120, 130]]}]}')
    lines = ["", '{"remove": "card"}', '{"name": "more", "points": [[110, 100]]}', "hello", '{"remove": "more"}', ""]
    words = [sys.executable, "-c", ROS, prompts, __file__.rpartition("/tests/")[0], *lines]
    ran = subprocess.run(words, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-2000:]
    card, more = ["poses/card", "tf"], ["poses/more", "tf"]
    assert ran.stdout.split() == [*card, *card, *more, "line", *more, "destroyed"]
