"""What messages of ROS hold, ``sensor_msgs`` of ROS 1 and 2, recorded or live: images of colour and of depth.

An Image may have padded rows and bytes of either order; a CompressedImage is JPEG, PNG, or a compressedDepth.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput

#: What an encoding is made RGB with; depth encodings and what their unit is in metres (REP 118).
TO_RGB = {"rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB}
DEPTH_M = {"16UC1": 0.001, "mono16": 0.001, "32FC1": 1.0}
_COMPRESSED_DEPTH_HEADER = 12  # bytes before the PNG


def seconds(stamp: Any) -> float:
    """A ``builtin_interfaces/Time`` in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def read_rgb(name: str, message: Any) -> np.ndarray:
    """(H, W, 3) uint8, red first; :class:`BadInput` calls it ``name``."""
    if hasattr(message, "format"):
        bgr = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            raise BadInput(name, f"an unreadable image ({message.format})", "JPEG or PNG")
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    if message.encoding not in TO_RGB:
        fix = "Name the topic of the colour image, not of a raw one."
        raise BadInput(name, f"colour as {message.encoding}", "rgb8 or bgr8 (or rgba8, bgra8)", fix)
    image, code = pixels(name, message, 4 if "a" in message.encoding else 3, "u1"), TO_RGB[message.encoding]
    return image if code is None else cv2.cvtColor(image, code)


def read_depth_m(name: str, message: Any) -> np.ndarray:
    """(H, W) float32 metres; :class:`BadInput` calls it ``name``."""
    if hasattr(message, "format"):
        start = _COMPRESSED_DEPTH_HEADER if "compressedDepth" in message.format else 0
        raw = cv2.imdecode(np.frombuffer(message.data, np.uint8)[start:], cv2.IMREAD_UNCHANGED)
        if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
            raise BadInput(name, f"depth as {message.format}", "16-bit PNG, or compressedDepth of 16UC1")
        return raw * np.float32(DEPTH_M["16UC1"])
    if message.encoding not in DEPTH_M:
        fix = "Name the topic of a depth image."
        raise BadInput(name, f"depth as {message.encoding}", f"one of {', '.join(DEPTH_M)}", fix)
    raw = pixels(name, message, 1, "f4" if message.encoding == "32FC1" else "u2")[..., 0]
    return raw.astype(np.float32) * np.float32(DEPTH_M[message.encoding])


def pixels(name: str, image: Any, channels: int, dtype: str) -> np.ndarray:
    """(H, W, channels) of a ``sensor_msgs/Image``; :class:`BadInput` where it has too few bytes."""
    kind = np.dtype(dtype).newbyteorder(">" if image.is_bigendian else "<")
    width = image.width * channels * kind.itemsize
    if image.step < width or len(image.data) < image.height * image.step:
        got = f"{len(image.data)} bytes in rows of {image.step}"
        raise BadInput(name, got, f"{image.height} rows of at least {width} bytes")
    rows = np.frombuffer(image.data, np.uint8, image.height * image.step).reshape(image.height, image.step)
    whole = np.ascontiguousarray(rows[:, :width]).view(kind).reshape(image.height, image.width, channels)
    return whole.astype(kind.newbyteorder("="), copy=False)
