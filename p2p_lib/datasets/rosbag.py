"""ROS recordings: ``.bag`` of ROS 1; ``.db3``, ``.mcap`` or a folder of them of ROS 2, through the package rosbags.

Colour and depth are topics of ``sensor_msgs``: Image, or CompressedImage (JPEG, PNG, compressedDepth). Depth has to be
registered to colour (``aligned_depth_to_color`` of realsense2_camera, ``depth_registered`` of others). A lens
distortion that the colour camera's CameraInfo tells is taken out of both.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, in_a_line, wrong_size
from p2p_lib.core.types import Frame
from p2p_lib.datasets.ros_messages import read_depth_m, read_rgb, seconds

#: A colour image goes with the depth image nearest in time, if it is as near as this.
APART_S = 0.025
#: Words in the names of topics whose depth is registered, the best first.
REGISTERED = ("aligned_depth_to_color", "registered", "aligned")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"
#: Distortion that moves no pixel further than this is none.
LEAST_DISTORTION_PX = 0.1


class RosRecording:
    """Frames of a recording, until it is closed.

    camera   of the colour images, without distortion; known after the first frame
    unit_m   metres per unit in which depth may be written without loss

    Raises :class:`MissingBackend` without rosbags, :class:`BadInput` for what is no recording of colour and depth.
    """

    unit_m = 0.001
    camera: Camera

    def __init__(self, path: Path, colour: str | None = None, depth: str | None = None):
        self.name, self._open = str(path), ExitStack()
        highlevel = packages.load("rosbags.highlevel", "ROS recordings", "rosbags")
        typesys = packages.load("rosbags.typesys", "ROS recordings", "rosbags")
        try:
            typestore = typesys.get_typestore(typesys.Stores.LATEST)
            reader = highlevel.AnyReader([path], default_typestore=typestore)
            self._reader = self._open.enter_context(reader)
        except Exception as error:  # noqa: BLE001 - whatever the package says of a damaged file
            self.close()
            got = f"an unreadable recording ({in_a_line(error)})"
            raise BadInput(self.name, got, "a whole bag of ROS 1 or 2") from None
        of = {c.topic: c for c in self._reader.connections}
        images = [topic for topic, c in of.items() if c.msgtype in _IMAGES]
        depth = depth or _likeliest(images, "depth")
        colour = colour or _likeliest([t for t in images if t != depth], "colour")
        info = _info_of(colour, [t for t, c in of.items() if c.msgtype == _INFO])
        for what, topic in (("colour", colour), ("depth", depth), ("camera_info of colour", info)):
            if topic not in of:
                self.close()
                got = f"topics {', '.join(sorted(of)) or 'none'}"
                raise BadInput(f"{self.name}: {what}", got, "a topic of it", "Name it: --colour TOPIC --depth TOPIC.")
        self._topics, self._of = {"colour": colour, "depth": depth, "info": info}, of

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def __iter__(self) -> Iterator[Frame]:
        """Frames in the order of their colour images' times, in seconds from the first; those without depth go."""
        lens, first_s, index = None, 0.0, 0
        for time_s, rgb, depth_m in self._pairs():
            if lens is None:
                lens, first_s = _Lens(self.name, self._info(), rgb.shape), time_s
                self.camera = lens.camera
            if depth_m.shape != rgb.shape[:2]:
                fix = "Record depth that is registered to colour (align_depth:=true), or name its topic: --depth."
                name = f"{self.name}: {self._topics['depth']}"
                raise wrong_size(name, depth_m.shape, rgb.shape[:2], "colour", fix)
            yield Frame(index, time_s - first_s, *lens.straightened(rgb, depth_m))
            index += 1
        if lens is None:
            got = f"no images of {self._topics['colour']} and {self._topics['depth']} within {1000 * APART_S:g} ms"
            raise BadInput(self.name, got, "pairs of colour and depth")

    def _messages(self, *whats: str) -> Iterator[tuple[str, Any]]:
        """What it is of, and the message."""
        wanted = {self._topics[what]: what for what in whats}
        for connection, _, raw in self._reader.messages([self._of[topic] for topic in wanted]):
            yield wanted[connection.topic], self._reader.deserialize(raw, connection.msgtype)

    def _info(self) -> Any:
        for _, message in self._messages("info"):
            return message
        raise BadInput(f"{self.name}: {self._topics['info']}", "no message", "the colour camera's")

    def _pairs(self) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """(time_s, rgb, depth_m) of each colour image with a depth image near to it."""
        colours: deque[tuple[float, Any]] = deque()
        depths: deque[tuple[float, Any]] = deque()
        colour_topic, depth_topic = self._topics["colour"] or "", self._topics["depth"] or ""
        last_s, ended = -np.inf, [("", None)]
        for what, message in chain(self._messages("colour", "depth"), ended):
            if message is not None:
                (colours if what == "colour" else depths).append((seconds(message.header.stamp), message))
            # Until a depth image is later than the colour image, a nearer one may come.
            while colours and depths and (message is None or depths[-1][0] >= colours[0][0]):
                time_s, colour = colours.popleft()
                while len(depths) > 1 and abs(depths[1][0] - time_s) <= abs(depths[0][0] - time_s):
                    depths.popleft()
                if abs(depths[0][0] - time_s) <= APART_S and time_s > last_s:
                    last_s = time_s
                    depth = depths[0][1]
                    yield time_s, read_rgb(colour_topic, colour), read_depth_m(depth_topic, depth)


class _Lens:
    """A camera's matrix, and how its distortion is taken out of images."""

    def __init__(self, name: str, info: Any, shape: tuple[int, ...]):
        K = np.array(getattr(info, "k", getattr(info, "K", None)), float).reshape(3, 3)
        D = np.array(getattr(info, "d", getattr(info, "D", ())), float)
        self.camera = Camera.from_K(K, shape[1], shape[0], name=f"{name}: camera_info")
        self._maps = None
        if not D.any():
            return
        if info.distortion_model not in ("plumb_bob", "rational_polynomial"):
            got = f"the lens model {info.distortion_model}"
            raise BadInput(name, got, "plumb_bob or rational_polynomial", "Rectify the images first (image_proc).")
        u, v = cv2.initUndistortRectifyMap(K, D, None, K, shape[1::-1], cv2.CV_32FC1)
        rows, columns = np.mgrid[: shape[0], : shape[1]]
        if max(np.abs(u - columns).max(), np.abs(v - rows).max()) > LEAST_DISTORTION_PX:
            self._maps = u, v

    def straightened(self, rgb: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both as a pinhole camera sees them; depth from the nearest pixel, since means across edges are neither."""
        if self._maps is None:
            return rgb, depth_m
        return cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR), cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST)


def _likeliest(topics: list[str], kind: str) -> str | None:
    """The topic that is most likely of colour or depth; uncompressed before compressed ones."""
    of_depth = [topic for topic in topics if "depth" in topic.replace("aligned_depth_to_color/image", "depth")]
    if kind == "depth":
        rank = [next((k for k, word in enumerate(REGISTERED) if word in topic), len(REGISTERED)) for topic in of_depth]
        chosen = [(k, "ompressed" in topic, False, topic) for k, topic in zip(rank, of_depth)]
    else:
        others = [topic for topic in topics if topic not in of_depth and "infra" not in topic and "/ir/" not in topic]
        named = [not any(word in topic for word in ("color", "colour", "rgb")) for topic in others]
        chosen = [(no, "rect" not in topic, "ompressed" in topic, topic) for no, topic in zip(named, others)]
    return min(chosen)[-1] if chosen else None


def _info_of(topic: str | None, infos: list[str]) -> str | None:
    """The CameraInfo of an image topic: the one beside it."""
    parent = (topic or "").removesuffix("/compressed").rpartition("/")[0]
    return next((info for info in infos if info.rpartition("/")[0] == parent), None)
