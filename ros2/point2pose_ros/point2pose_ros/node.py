"""The node: RGB-D images in; per object a pose, a transform and a mesh out; services add, correct and remove objects.

    ros2 launch point2pose_ros point2pose.launch.py rgb:=/camera/color/image_raw depth:=... camera_info:=...

``README.md`` beside this package lists its topics, services and parameters.
"""

from __future__ import annotations

import re
import sys
from collections import deque
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from p2p_lib.apps.live_words import KEPT
from p2p_lib.core.backends import DEFAULT_SEGMENTER, DEFAULT_TRACKER
from p2p_lib.core.compiled import warm_up
from p2p_lib.core.errors import BadInput, MissingBackend, P2PError, WrongSize
from p2p_lib.core.memory import load_memories, load_memory
from p2p_lib.core.options import RunOptions, pairs
from p2p_lib.core.prompts import check_frame
from p2p_lib.core.types import DOUBTED, Frame, PoseEstimate
from p2p_lib.datasets.cameras import OddImages
from p2p_lib.datasets.prompts import load_prompts
from p2p_lib.datasets.ros_messages import seconds
from p2p_lib.extended.default import Point2Pose
from p2p_lib.run import recall
from point2pose_ros import messages

#: What the node can be told at its start, and what is so by default; config/point2pose.yaml says what each means.
PARAMETERS: dict[str, Any] = {
    "prompts": "",
    "memory": [""],  # an empty list has no type in ROS
    "frozen": False,
    "preset": "default",
    "settings": [""],
    "tracker": DEFAULT_TRACKER,
    "segmenter": DEFAULT_SEGMENTER,
    "frame_prefix": "",
    "min_confidence": DOUBTED,
    "mesh_period_s": 2.0,
    "slop_s": 0.02,
}


def options_of(given: Mapping[str, Any]) -> RunOptions:
    """What the parameters of the node ask of a tracker; :class:`BadInput` for what does not fit."""
    settings = pairs(filter(None, given["settings"]), "settings", "stage.key=value")
    return RunOptions(
        given["preset"],
        settings={"segmentation.sam2_every": 0, **settings},  # no image waits for SAM 2
        tracker=given["tracker"],
        masks=given["segmenter"],
        prompts=given["prompts"] or None,
        memory=tuple(filter(None, given["memory"])),
        frozen=given["frozen"],
    )


class TrackingNode:
    """What happens between messages: starts a tracker with the first image, steps it, hands on what is known.

    options  what is asked of the tracker, its prompts and memories included
    hand_on  takes an estimate and the header of its colour image
    """

    def __init__(self, options: RunOptions, hand_on: Callable[[PoseEstimate, Any], object]):
        self.options, self.hand_on, self.config = options, hand_on, options.config()
        told = options.prompts or ()
        prompts = load_prompts(told) if isinstance(told, str | Path) else told
        self.prompts = sorted(prompts, key=lambda p: p.frame)
        self.memories = load_memories(options.memory or ())
        self.tracker: Point2Pose | None = None
        self._headers: dict[int, Any] = {}  # of frames without an answer yet
        self._count, self._odd = 0, OddImages()
        self._seen: deque[Frame] = deque(maxlen=KEPT)

    def on_images(self, rgb: Any, depth: Any, info: Any) -> None:
        """One synchronised triple of messages; what is handed on is of an earlier one if the tracker is late.

        Images of another size than the camera's are left out; so many in a row end it.
        """
        if self.tracker is None:
            self.tracker = self._started(info)
        try:
            frame = messages.frame_of(self._count, rgb, depth)
            check_frame(frame, self.tracker.camera)
        except WrongSize as error:
            self._odd.leave_out(error)
            return
        self._odd.fits()
        while self.prompts and self.prompts[0].frame <= self._count:
            self.tracker.tell(self.prompts.pop(0))
        self._headers[self._count] = rgb.header
        estimates = self.tracker.step(frame)
        self._seen.append(frame)
        self._count += 1
        if self.tracker.frame is not None:
            header = self._headers.pop(self.tracker.frame.index)
            for estimate in estimates.values():
                self.hand_on(estimate, header)

    def add(self, request: Any, answer: Any) -> Any:
        """Answer an ``AddObject``."""

        def begin() -> None:
            if not request.memory:
                if request.name in self._running().objects:
                    raise BadInput("add_object", repr(request.name), "a name not in use")
                self._running().tell(messages.prompt_of(request), self._clicked_on(request))
                return
            if request.points or request.negative or request.box.width or request.mask.width:
                raise BadInput("add_object", "a memory and clicks", "one of them")
            self._running().add_object(request.name, memory=load_memory(request.memory), frozen=self.options.frozen)

        return _answered(answer, begin)

    def correct(self, request: Any, answer: Any) -> Any:
        """Answer a ``CorrectObject``."""

        def mend() -> None:
            if request.name not in self._running().objects:
                raise BadInput("correct_object", repr(request.name), f"one of {sorted(self._running().objects)}")
            self._running().tell(messages.prompt_of(request), self._clicked_on(request))

        return _answered(answer, mend)

    def remove(self, request: Any, answer: Any) -> Any:
        """Answer a ``RemoveObject``."""
        return _answered(answer, lambda: self._running().remove_object(request.name))

    def meshes(self) -> dict[str, Any]:
        """Object to its surface so far, of those that have one."""
        objects = self.tracker.objects if self.tracker is not None else {}
        surfaces = {name: obj.model.surface for name, obj in objects.items() if obj.model.surface is not None}
        made = {name: surface.mesh() for name, surface in surfaces.items()}
        return {name: mesh for name, mesh in made.items() if len(mesh.faces)}

    def _clicked_on(self, request: Any) -> Frame | None:
        """The image whose stamp a request has; None, which is the next one, without any."""
        time_s = seconds(request.stamp)
        if not time_s:
            return None
        for frame in self._seen:
            if frame.time_s == time_s:
                return frame
        expected = f"that of one of the last {KEPT} images that were tracked"
        raise BadInput(f"stamp of {request.name!r}", f"{time_s:.6f} s", expected, "Click on a newer image.")

    def _running(self) -> Point2Pose:
        if self.tracker is None:
            raise BadInput("object", "a call before the first image", "a camera that runs", "Call again.")
        return self.tracker

    def _started(self, info: Any) -> Point2Pose:
        asked, camera = self.options, messages.camera_of(info)
        tracker = Point2Pose(camera, self.config, asked.tracker, segmenter=asked.masks or DEFAULT_SEGMENTER)
        recall(tracker, self.memories, asked.frozen)
        return tracker


def _answered(answer: Any, act: Callable[[], object]) -> Any:
    """The answer of a service, filled: whether it was done, and why not."""
    answer.success, answer.message = True, ""
    try:
        act()
    except P2PError as error:
        answer.success, answer.message = False, str(error)
    return answer


def main() -> None:
    """Spin the node until it is shut down; what the user has to mend is one line."""
    try:
        _spin()
    except P2PError as error:
        sys.exit(f"point2pose: {error}")


def _ros(*names: str) -> list[Any]:
    try:
        return [import_module(name) for name in names]
    except ModuleNotFoundError as error:
        fix = "Source the setup.bash of ROS and of the workspace, in an environment that sees the system's packages."
        raise MissingBackend("point2pose_ros", f"{error.name} of ROS 2 is not to be found", fix) from None


def _spin() -> None:
    rclpy, qos, executors, filters = _ros("rclpy", "rclpy.qos", "rclpy.executors", "message_filters")
    rclpy.init()
    node = rclpy.create_node("point2pose")
    try:
        given = {name: node.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        publish = Publisher(node, given["frame_prefix"], given["min_confidence"])
        tracking = TrackingNode(options_of(given), publish.estimate)
        warm_up(node.get_logger().info)
        (services, sensors) = _ros("point2pose_msgs.srv", "sensor_msgs.msg")
        node.create_service(services.AddObject, "~/add_object", tracking.add)
        node.create_service(services.CorrectObject, "~/correct_object", tracking.correct)
        node.create_service(services.RemoveObject, "~/remove_object", tracking.remove)
        if given["mesh_period_s"] > 0:
            node.create_timer(given["mesh_period_s"], lambda: publish.meshes(tracking.meshes()))
        kinds = {"rgb": sensors.Image, "depth": sensors.Image, "camera_info": sensors.CameraInfo}
        # Drivers publish as sensors do, and what comes while a frame is tracked soon takes the place of what waited.
        how = qos.qos_profile_sensor_data
        topics = [filters.Subscriber(node, kind, topic, qos_profile=how) for topic, kind in kinds.items()]
        together = filters.ApproximateTimeSynchronizer(topics, queue_size=2, slop=given["slop_s"])
        together.registerCallback(tracking.on_images)
        rclpy.spin(node)
    except (KeyboardInterrupt, executors.ExternalShutdownException):
        pass  # how one stops a node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


class Publisher:
    """The topics of a node: ``~/estimates``, ``~/poses/OBJECT``, ``~/meshes``, and the transforms of tf.

    prefix          before the names of objects as frames of tf
    min_confidence  topics that say no confidence get poses of more than this
    """

    def __init__(self, node: Any, prefix: str = "", min_confidence: float = DOUBTED):
        self._node, self._prefix, self._min_confidence = node, prefix, min_confidence
        tf2, qos, ours = _ros("tf2_ros", "rclpy.qos", "point2pose_msgs.msg")
        self._geometry, self._markers = _ros("geometry_msgs.msg", "visualization_msgs.msg")
        self._transforms, self._estimate = tf2.TransformBroadcaster(node), ours.ObjectEstimate
        self._estimates = node.create_publisher(ours.ObjectEstimate, "~/estimates", 10)
        late = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)  # whoever comes late has them
        self._meshes = node.create_publisher(self._markers.MarkerArray, "~/meshes", late)
        self._poses: dict[str, Any] = {}
        self._shown: set[str] = set()

    def estimate(self, estimate: PoseEstimate, header: Any) -> None:
        """What is known of an object; its pose and transform where there is one that is not doubted."""
        self._estimates.publish(messages.fill_estimate(self._estimate(), estimate, header))
        if estimate.T_cam_obj is None or estimate.confidence <= self._min_confidence:
            return
        kind, name = self._geometry.PoseWithCovarianceStamped, estimate.object
        if name not in self._poses:
            topic = re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)  # what ROS takes for a topic
            self._poses[name] = self._node.create_publisher(kind, f"~/poses/{topic}", 10)
        self._poses[name].publish(messages.fill_pose(kind(), estimate, header))
        transform = messages.fill_transform(self._geometry.TransformStamped(), estimate, header, self._prefix)
        self._transforms.sendTransform(transform)

    def meshes(self, meshes: Mapping[str, Any]) -> None:
        """All surfaces; what was removed since is deleted."""
        kind = self._markers.Marker
        gone = [kind(ns=name, action=messages.DELETE) for name in sorted(self._shown - meshes.keys())]
        shown = [messages.fill_marker(kind(), name, mesh, self._prefix) for name, mesh in meshes.items()]
        self._shown = set(meshes)
        self._meshes.publish(self._markers.MarkerArray(markers=gone + shown))


if __name__ == "__main__":
    main()
