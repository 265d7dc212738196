"""RealSense cameras, and their recordings (.bag; .db3 of newer software), through pyrealsense2.

Depth is registered to the colour camera by the library itself. A recording becomes a folder of one's own, every pair
of images kept however long it takes; a camera, or a recording in its stead, is read at its own pace.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from threading import Event, Lock
from typing import Any

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from p2p_lib.core.progress import progress_bar
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
TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
}


def convert_bag(bag: str | Path, out: str | Path, progress: bool = True) -> int:
    """Write ``rgb/``, ``depth/``, ``cam_K.txt``, ``depth_scale.txt`` and ``times.txt``; returns the number of frames.

    Times are the colour images', in seconds from the first. ``masks/`` are for the user to add.

    Raises :class:`MissingBackend` without pyrealsense2, :class:`MissingData` and :class:`BadInput` where the recording
    is none, has no depth or no colour, or a lens distortion that cannot be ignored.
    """
    bag, out = Path(bag), Path(out)
    if not bag.is_file():
        raise MissingData(str(bag), "no such recording", "Give a .bag of the RealSense Viewer or of rs-record.")
    rs = _library()
    if out.is_dir() and any(out.iterdir()):
        raise BadInput(str(out), "a folder that is not empty", "a new one for the images")
    times_s: list[float] = []
    with progress_bar(bag.name, shown=progress) as bar:
        for colour, depth in _pairs(rs, bag):
            if not times_s:
                for sub in ("rgb", "depth"):
                    (out / sub).mkdir(parents=True, exist_ok=True)
                _write_camera(rs, bag, out, colour, depth.get_units())
            _save(out / "rgb" / f"{len(times_s):06d}.png", _bgr(str(bag), colour))
            _save(out / "depth" / f"{len(times_s):06d}.png", np.asanyarray(depth.get_data()))
            times_s.append(colour.get_timestamp() / 1000)
            bar.update()
    if not times_s:
        raise BadInput(str(bag), "no pair of a colour and a depth image", "a recording of both cameras")
    (out / "times.txt").write_text("".join(f"{t - times_s[0]:.6f}\n" for t in times_s))
    return len(times_s)


class RealSenseCamera:
    """A connected camera, or a recording that plays as fast as it was made (see :class:`cameras.LiveCamera`).

    Raises :class:`MissingBackend` without pyrealsense2, :class:`MissingData` where there is no camera or recording.
    """

    def __init__(self, recording: Path | None = None):
        if recording is not None and not recording.is_file():
            raise MissingData(str(recording), "no such recording", "Plain `--camera realsense` takes the camera.")
        self._rs, self._recorded = _library(), recording is not None
        self._closed, self._waiting, self._last = Event(), Lock(), -1
        self.name = str(recording) if recording else "realsense"
        self._pipeline, self._align = self._rs.pipeline(), self._rs.align(self._rs.stream.color)
        profile = self._started(recording)
        self._playback = profile.get_device().as_playback() if self._recorded else None
        for _ in range(0 if self._recorded else WARM_UP):
            self._pair()
        self._first = self._pair()
        if self._first is None:
            raise BadInput(self.name, "no pair of a colour and a depth image", "both cameras")
        colour = self._first[0]
        self._number, self._start_ms = colour.get_frame_number(), colour.get_timestamp()
        lens = _pinhole(self._rs, self.name, colour)
        K = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]])
        self.camera = Camera.from_K(K, lens.width, lens.height, name=self.name)

    def read(self) -> Frame | None:
        """The next pair of images, depth registered to colour."""
        pair, self._first = self._first or self._pair(), None
        if pair is None:
            return None
        colour, depth = pair
        rgb = cv2.cvtColor(_bgr(self.name, colour), cv2.COLOR_BGR2RGB)
        depth_m = np.asanyarray(depth.get_data()) * np.float32(depth.get_units())
        time_s = (colour.get_timestamp() - self._start_ms) / 1000
        return Frame(colour.get_frame_number() - self._number, time_s, rgb, depth_m)

    def close(self) -> None:
        """Stop the camera, once the pair that is being waited for has come."""
        if not self._closed.is_set():
            self._closed.set()
            with self._waiting:
                self._pipeline.stop()

    def _started(self, recording: Path | None) -> Any:
        rs, config = self._rs, self._rs.config()
        if recording is not None:
            config.enable_device_from_file(str(recording), repeat_playback=False)
        else:
            config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, RATE_HZ)
            config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, RATE_HZ)
        try:
            return self._pipeline.start(config)
        except RuntimeError as error:
            fix = "Plug a depth camera into USB 3, and close the RealSense Viewer."
            said = " ".join(str(error).split())[:120]
            raise MissingData(self.name, f"no camera of colour and depth answers ({said})", fix) from None

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
            if self._recorded and self._playback.current_status() != self._rs.playback_status.playing:
                return None
            waited_ms = 0 if came else waited_ms + WAIT_MS
            if waited_ms >= GONE_MS:
                raise MissingData(self.name, f"no image for {GONE_MS / 1000:g} s", "Is the cable still in?")


def _together(colour: Any, depth: Any) -> bool:
    """Whether two images are of one moment: when we are late, the library may pair colour with older depth."""
    apart_ms = abs(colour.get_timestamp() - depth.get_timestamp())
    return colour.get_frame_timestamp_domain() != depth.get_frame_timestamp_domain() or apart_ms <= APART_MS


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        fix = "Run: .venv/bin/uv pip install --python .venv pyrealsense2"
        raise MissingBackend("pyrealsense2", f"reads RealSense cameras and recordings ({error})", fix) from None
    return pyrealsense2


def _pairs(rs: Any, bag: Path) -> Iterator[tuple[Any, Any]]:
    """Colour and depth registered to it; each colour image once."""
    pipeline = rs.pipeline()
    recording = _start(rs, pipeline, bag)
    align, last = rs.align(rs.stream.color), None
    try:
        while True:
            came, frames = pipeline.try_wait_for_frames(WAIT_MS)
            if not came:
                if recording.current_status() != rs.playback_status.playing:
                    return
                continue
            colour, depth = frames.get_color_frame(), frames.get_depth_frame()
            if not colour or not depth or colour.get_frame_number() == last or not _together(colour, depth):
                continue
            last = colour.get_frame_number()
            registered = align.process(frames)
            yield registered.get_color_frame(), registered.get_depth_frame()
    finally:
        pipeline.stop()


def _start(rs: Any, pipeline: Any, bag: Path) -> Any:
    """Play a recording from its first image on, waiting for us; the playback."""
    config = rs.config()
    try:
        config.enable_device_from_file(str(bag), repeat_playback=False)
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise BadInput(str(bag), f"an unreadable recording ({' '.join(str(error).split())[:120]})", "a .bag") from None
    recording = profile.get_device().as_playback()
    # It can be told to wait only once it runs, and has dropped images by then: so back to the start.
    recording.pause()
    recording.set_real_time(False)
    while pipeline.try_wait_for_frames(WAIT_MS)[0]:
        pass
    kinds = {stream.stream_type() for stream in profile.get_streams()}
    if not {rs.stream.color, rs.stream.depth} <= kinds:
        pipeline.stop()
        has = ", ".join(sorted(str(kind).removeprefix("stream.") for kind in kinds))
        raise BadInput(str(bag), f"streams of {has}", "colour and depth")
    recording.seek(timedelta(0))
    recording.resume()
    return recording


def _pinhole(rs: Any, name: str, colour: Any) -> Any:
    """The colour camera's intrinsics, where its lens may be left out of account."""
    lens = colour.get_profile().as_video_stream_profile().get_intrinsics()
    moved = max(_distortion_px(rs, lens, u, v) for u in (0, lens.width - 1) for v in (0, lens.height - 1))
    if moved > MOST_DISTORTION_PX:
        got = f"a colour camera whose lens moves the corners by {moved:.1f} px"
        raise BadInput(name, got, f"at most {MOST_DISTORTION_PX} px", "Undistort the images first.")
    return lens


def _write_camera(rs: Any, bag: Path, out: Path, colour: Any, units_m: float) -> None:
    lens = _pinhole(rs, str(bag), colour)
    K = [[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]]
    np.savetxt(out / "cam_K.txt", K, fmt="%.9g")
    (out / "depth_scale.txt").write_text(f"{units_m:.9g}\n")


def _distortion_px(rs: Any, lens: Any, u: float, v: float) -> float:
    """How far the lens model puts a pixel's ray from where a pinhole's would go, in pixels."""
    x, y, z = rs.rs2_deproject_pixel_to_point(lens, [u, v], 1.0)
    return float(np.hypot(lens.fx * x / z + lens.ppx - u, lens.fy * y / z + lens.ppy - v))


def _bgr(name: str, colour: Any) -> np.ndarray:
    kind = str(colour.get_profile().format()).removeprefix("format.")
    image = np.asanyarray(colour.get_data())
    if kind == "bgr8":
        return image
    if kind not in TO_BGR:
        raise BadInput(name, f"colour as {kind}", "one of bgr8, " + ", ".join(TO_BGR))
    if kind in ("yuyv", "uyvy"):
        image = image.view(np.uint8).reshape(colour.get_height(), colour.get_width(), 2)
    return cv2.cvtColor(image, TO_BGR[kind])


def _save(path: Path, image: np.ndarray) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path} could not be written")
