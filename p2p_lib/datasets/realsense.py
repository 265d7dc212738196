"""RealSense cameras, and their recordings (.bag; .db3 of newer software), through pyrealsense2.

Depth is registered to the colour camera by the library itself. Of a recording every pair of images is kept, however
long it takes (``p2p convert``); a camera, or a recording in its stead, is read at its own pace.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from threading import Event, Lock
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingData, in_a_line
from p2p_lib.core.types import Frame

WAIT_MS = 200
#: A camera that sends nothing for so long has gone.
GONE_MS = 5000
#: Images taken further apart are no pair.
APART_MS = 25
#: Images that a camera's exposure takes to settle, and what is asked of it: all RealSense depth cameras can.
WARM_UP, WIDTH, HEIGHT, RATE_HZ = 30, 640, 480, 30
# Distortion that moves no pixel further than this is left as it is: a D435's colour camera has none at all.
MOST_DISTORTION_PX = 0.5
TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
}


class RealSenseCamera:
    """A connected camera, or a recording that plays as fast as it was made (see :class:`cameras.LiveCamera`).

    every   wait for the reader, so that a recording loses no pair of images
    unit_m  metres per unit of the camera's depth

    Raises :class:`MissingBackend` without pyrealsense2, :class:`MissingData` where there is no camera or recording,
    :class:`BadInput` where these are not of colour and depth or have a lens distortion that cannot be ignored.
    """

    def __init__(self, recording: Path | None = None, every: bool = False):
        if recording is not None and not recording.is_file():
            fix = "Give a .bag of the RealSense Viewer or of rs-record, or nothing more than `realsense` for a camera."
            raise MissingData(str(recording), "no such recording", fix)
        self._rs = packages.load("pyrealsense2", "RealSense cameras and recordings", "pyrealsense2")
        self._closed, self._waiting, self._last = Event(), Lock(), -1
        self.name = str(recording) if recording else "realsense"
        self._pipeline, self._align = self._rs.pipeline(), self._rs.align(self._rs.stream.color)
        self._playback = None if recording is None else self._play(recording, every)
        if recording is None:
            self._start()
        for _ in range(0 if recording else WARM_UP):
            self._pair()
        self._first = self._pair()
        if self._first is None:
            raise BadInput(self.name, "no pair of a colour and a depth image", "both cameras")
        colour, depth = self._first
        self._number, self._start_ms = colour.get_frame_number(), colour.get_timestamp()
        self.unit_m = depth.get_units()
        lens = _pinhole(self._rs, self.name, colour)
        K = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]])
        self.camera = Camera.from_K(K, lens.width, lens.height, name=self.name)

    def read(self) -> Frame | None:
        """The next pair of images, depth registered to colour."""
        pair, self._first = self._first or self._pair(), None
        if pair is None:
            return None
        colour, depth = pair
        depth_m = np.asanyarray(depth.get_data()) * np.float32(self.unit_m)
        time_s = (colour.get_timestamp() - self._start_ms) / 1000
        return Frame(colour.get_frame_number() - self._number, time_s, _rgb(self.name, colour), depth_m)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.read, None)

    def close(self) -> None:
        """Stop the camera, once the pair that is being waited for has come."""
        if not self._closed.is_set():
            self._closed.set()
            with self._waiting:
                self._pipeline.stop()

    def _start(self) -> None:
        rs, config = self._rs, self._rs.config()
        config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, RATE_HZ)
        config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, RATE_HZ)
        try:
            if not rs.context().query_devices():  # which start would wait for, 15 s
                raise RuntimeError("no device connected")
            self._pipeline.start(config)
        except RuntimeError as error:
            fix = "Plug a depth camera into USB 3, and close the RealSense Viewer."
            raise MissingData(self.name, f"no camera of colour and depth answers ({in_a_line(error)})", fix) from None

    def _play(self, recording: Path, every: bool) -> Any:
        """Play a recording from its first image on; the playback."""
        rs, config = self._rs, self._rs.config()
        try:
            config.enable_device_from_file(str(recording), repeat_playback=False)
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise BadInput(self.name, f"an unreadable recording ({in_a_line(error)})", "a .bag") from None
        kinds = {stream.stream_type() for stream in profile.get_streams()}
        if not {rs.stream.color, rs.stream.depth} <= kinds:
            self._pipeline.stop()
            has = ", ".join(sorted(str(kind).removeprefix("stream.") for kind in kinds))
            raise BadInput(self.name, f"streams of {has}", "colour and depth")
        playback = profile.get_device().as_playback()
        if every:
            # It can be told to wait only once it runs, and has dropped images by then: so back to the start.
            playback.pause()
            playback.set_real_time(False)
            while self._pipeline.try_wait_for_frames(WAIT_MS)[0]:
                pass
            playback.seek(timedelta(0))
            playback.resume()
        return playback

    def _pair(self) -> tuple[Any, Any] | None:
        """The next colour image with its depth; None at a recording's end, or once closed."""
        waited_ms = 0
        while True:
            with self._waiting:
                if self._closed.is_set():
                    return None
                came, frames = self._pipeline.try_wait_for_frames(WAIT_MS)
            colour, depth = (frames.get_color_frame(), frames.get_depth_frame()) if came else (None, None)
            if colour and depth and colour.get_frame_number() != self._last and _together(colour, depth):
                self._last = colour.get_frame_number()
                registered = self._align.process(frames)
                return registered.get_color_frame(), registered.get_depth_frame()
            ended = self._playback and self._playback.current_status() != self._rs.playback_status.playing
            if ended and not came:
                return None
            waited_ms = 0 if came else waited_ms + WAIT_MS
            if waited_ms >= GONE_MS:
                raise MissingData(self.name, f"no image for {GONE_MS / 1000:g} s", "Is the cable still in?")


def _together(colour: Any, depth: Any) -> bool:
    """Whether two images are of one moment: when we are late, the library may pair colour with older depth."""
    apart_ms = abs(colour.get_timestamp() - depth.get_timestamp())
    return colour.get_frame_timestamp_domain() != depth.get_frame_timestamp_domain() or apart_ms <= APART_MS


def _pinhole(rs: Any, name: str, colour: Any) -> Any:
    """The colour camera's intrinsics, where its lens may be left out of account."""
    lens = colour.get_profile().as_video_stream_profile().get_intrinsics()
    moved = max(_distortion_px(rs, lens, u, v) for u in (0, lens.width - 1) for v in (0, lens.height - 1))
    if moved > MOST_DISTORTION_PX:
        got = f"a colour camera whose lens moves the corners by {moved:.1f} px"
        raise BadInput(name, got, f"at most {MOST_DISTORTION_PX} px", "Undistort the images first.")
    return lens


def _distortion_px(rs: Any, lens: Any, u: float, v: float) -> float:
    """How far the lens model puts a pixel's ray from where a pinhole's would go, in pixels."""
    x, y, z = rs.rs2_deproject_pixel_to_point(lens, [u, v], 1.0)
    return float(np.hypot(lens.fx * x / z + lens.ppx - u, lens.fy * y / z + lens.ppy - v))


def _rgb(name: str, colour: Any) -> np.ndarray:
    kind = str(colour.get_profile().format()).removeprefix("format.")
    image = np.asanyarray(colour.get_data())
    if kind == "rgb8":
        return image.copy()  # the library's memory is used again
    if kind not in TO_RGB:
        raise BadInput(name, f"colour as {kind}", "one of rgb8, " + ", ".join(TO_RGB))
    if kind in ("yuyv", "uyvy"):
        image = image.view(np.uint8).reshape(colour.get_height(), colour.get_width(), 2)
    return cv2.cvtColor(image, TO_RGB[kind])
