"""A node for ROS 2: RGB-D images in, a pose per object and transforms out. An example to start from.

Start it with

    python -m p2p_lib.apps.ros2_node --ros-args -p prompts:=prompts.json -r rgb:=/camera/color/image_raw

Needs ROS 2 (``rclpy``, ``cv_bridge``, ``message_filters``, ``tf2_ros``) on the Python that p2p_lib is installed for;
``environment.md`` has the light install for a robot. It subscribes to ``rgb``, ``depth`` (registered to colour; 16UC1
millimetres or 32FC1 metres) and ``camera_info`` (rectified images: distortion is ignored), and publishes
``poses/<object>`` (PoseWithCovarianceStamped in the camera's optical frame) and the transform from it to
``<object>``, while there is a pose and only then. ``prompts.json`` is what ``p2p click`` writes; its frame 0 is the
first image that arrives; ``prompts:=""`` starts without objects. Meanwhile they are added, corrected and removed by
lines of JSON (``std_msgs/String``) on ``words``, ``{"name": "mug", "points": [[320, 240]]}`` or ``{"remove": "mug"}``
(:class:`p2p_lib.apps.live_words.Words`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from p2p_lib.apps.live_words import Words
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import warm_up
from p2p_lib.core.errors import MissingBackend, P2PError
from p2p_lib.core.types import Frame, PoseEstimate
from p2p_lib.datasets.ros_messages import read_depth_m, read_rgb, seconds


def camera_of(info: Any) -> Camera:
    """The camera of a ``sensor_msgs/CameraInfo``; raises :class:`BadInput` where it has not been calibrated."""
    return Camera.from_K(np.reshape(info.k, (3, 3)), info.width, info.height, "camera_info.k")


def frame_of(index: int, rgb: Any, depth: Any) -> Frame:
    """A frame of two ``sensor_msgs/Image`` taken at one time; :class:`BadInput` for encodings that are not known."""
    return Frame(index, seconds(rgb.header.stamp), read_rgb("rgb image", rgb), read_depth_m("depth image", depth))


def covariance_of(estimate: PoseEstimate) -> np.ndarray:
    """(6, 6) as ``geometry_msgs/PoseWithCovariance`` wants it: translation first, about the camera's fixed axes.

    Ours is the right tangent of T_cam_obj, [rotation, translation] in the object's axes: both are turned by R.
    """
    if estimate.covariance is None or estimate.T_cam_obj is None:
        return np.zeros((6, 6))
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = estimate.T_cam_obj[:3, :3]
    return turn @ estimate.covariance @ turn.T


def fill_pose(message: Any, estimate: PoseEstimate, header: Any) -> Any:
    """A ``geometry_msgs/PoseWithCovarianceStamped`` from an estimate that has a pose, in the frame of ``header``."""
    message.header = header
    _fill(message.pose.pose.position, message.pose.pose.orientation, estimate)
    message.pose.covariance = covariance_of(estimate).ravel().tolist()
    return message


def fill_transform(message: Any, estimate: PoseEstimate, header: Any) -> Any:
    """A ``geometry_msgs/TransformStamped`` from the camera's frame to one that is called as the object."""
    message.header, message.child_frame_id = header, estimate.object
    _fill(message.transform.translation, message.transform.rotation, estimate)
    return message


def _fill(at: Any, turn: Any, estimate: PoseEstimate) -> None:
    T = se3.check("estimate", estimate.T_cam_obj)
    at.x, at.y, at.z = map(float, T[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, se3.quaternion_xyzw(T))


class TrackingNode:
    """What happens between messages: starts a tracker with the first image, steps it, publishes what has a pose.

    prompts     what is said of objects, see :func:`p2p_lib.datasets.prompts.load_prompts`
    publish     takes an estimate with a pose and the header of its colour image
    config      parameters or the name of a preset, as :class:`p2p_lib.extended.default.Point2Pose` takes them
    say         is told what does not fit of the ``words`` that come meanwhile
    """

    def __init__(self, prompts: Any, publish: Any, config: Any = None, say: Callable[[str], object] = print):
        self.words = Words(None, say)
        self.prompts, self.publish, self.config = sorted(prompts, key=lambda p: p.frame), publish, config
        self.tracker: Any = None
        self._headers: dict[int, Any] = {}  # of frames without an answer yet
        self._count = 0

    def on_images(self, rgb: Any, depth: Any, info: Any) -> None:
        """One synchronised triple of messages; what is published is of an earlier one if the tracker is late."""
        from p2p_lib.extended.default import Point2Pose

        if self.tracker is None:
            self.tracker = Point2Pose(camera_of(info), self.config)
        while self.prompts and self.prompts[0].frame <= self._count:
            self.tracker.tell(self.prompts.pop(0))
        self.words.tell(self.tracker, self._count)
        self._headers[self._count] = rgb.header
        estimates = self.tracker.step(frame_of(self._count, rgb, depth))
        self._count += 1
        if self.tracker.frame is None:
            return
        header = self._headers.pop(self.tracker.frame.index)
        for estimate in estimates.values():
            if estimate.T_cam_obj is not None:
                self.publish(estimate, header)


def main() -> None:
    """Spin the node until it is shut down. What ROS brings is imported here alone."""
    from p2p_lib.datasets.prompts import load_prompts

    try:
        rclpy, filters, tf2 = map(import_module, ("rclpy", "message_filters", "tf2_ros"))
        sensors, geometry, strings = map(import_module, ("sensor_msgs.msg", "geometry_msgs.msg", "std_msgs.msg"))
    except ModuleNotFoundError as error:
        fix = "Source its setup.bash, with an environment that sees the system's packages: environment.md."
        raise MissingBackend("ros2_node", f"{error.name} of ROS 2 is not to be found", fix) from None
    rclpy.init()
    node = rclpy.create_node("point2pose")
    path = node.declare_parameter("prompts", "prompts.json").value
    preset = node.declare_parameter("preset", "default").value
    transforms, publishers = tf2.TransformBroadcaster(node), {}

    def publish(estimate: PoseEstimate, header: Any) -> None:
        kind = geometry.PoseWithCovarianceStamped
        if estimate.object not in publishers:
            publishers[estimate.object] = node.create_publisher(kind, f"poses/{estimate.object}", 10)
        publishers[estimate.object].publish(fill_pose(kind(), estimate, header))
        transforms.sendTransform(fill_transform(geometry.TransformStamped(), estimate, header))

    say = node.get_logger().warning
    tracking = TrackingNode(load_prompts(path) if path else (), publish, preset, say)
    node.create_subscription(strings.String, "words", lambda message: tracking.words.hear(message.data), 10)
    warm_up(node.get_logger().info)
    kinds = {"rgb": sensors.Image, "depth": sensors.Image, "camera_info": sensors.CameraInfo}
    qos = import_module("rclpy.qos").qos_profile_sensor_data
    topics = [filters.Subscriber(node, kind, topic, qos_profile=qos) for topic, kind in kinds.items()]
    # Drivers publish as sensors do, and what comes while a frame is tracked soon takes the place of what waited.
    synchronised = filters.ApproximateTimeSynchronizer(topics, queue_size=2, slop=0.02)
    synchronised.registerCallback(tracking.on_images)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    try:
        main()
    except P2PError as error:
        sys.exit(str(error))
