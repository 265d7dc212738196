"""A RealSense recording (.bag; .db3 of newer cameras' software) as a folder of one's own, through pyrealsense2.

Depth is registered to the colour camera by the library itself; every pair of pictures is kept, however long it takes.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from p2p_lib.core.errors import BadInput, MissingBackend, MissingData

WAIT_MS = 200
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

    Times are the colour pictures', in seconds from the first. ``masks/`` are for the user to add.

    Raises :class:`MissingBackend` without pyrealsense2, :class:`MissingData` and :class:`BadInput` where the recording
    is none, has no depth or no colour, or a lens distortion that cannot be ignored.
    """
    bag, out = Path(bag), Path(out)
    if not bag.is_file():
        raise MissingData(str(bag), "no such recording", "Give a .bag of the RealSense Viewer or of rs-record.")
    rs = _library()
    if out.is_dir() and any(out.iterdir()):
        raise BadInput(str(out), "a folder that is not empty", "a new one for the pictures")
    times_s: list[float] = []
    with tqdm(unit="frame", desc=bag.name, disable=not progress) as bar:
        for colour, depth in _pairs(rs, bag):
            if not times_s:
                for sub in ("rgb", "depth"):
                    (out / sub).mkdir(parents=True, exist_ok=True)
                _write_camera(rs, bag, out, colour, depth.get_units())
            _save(out / "rgb" / f"{len(times_s):06d}.png", _bgr(bag, colour))
            _save(out / "depth" / f"{len(times_s):06d}.png", np.asanyarray(depth.get_data()))
            times_s.append(colour.get_timestamp() / 1000)
            bar.update()
    if not times_s:
        raise BadInput(str(bag), "no pair of a colour and a depth picture", "a recording of both cameras")
    (out / "times.txt").write_text("".join(f"{t - times_s[0]:.6f}\n" for t in times_s))
    return len(times_s)


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        fix = "Run: .venv/bin/uv pip install --python .venv pyrealsense2"
        raise MissingBackend("pyrealsense2", f"reads RealSense recordings ({error})", fix) from None
    return pyrealsense2


def _pairs(rs: Any, bag: Path) -> Iterator[tuple[Any, Any]]:
    """Colour and depth registered to it; each colour picture once."""
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
            if not colour or not depth or colour.get_frame_number() == last:
                continue
            last = colour.get_frame_number()
            registered = align.process(frames)
            yield registered.get_color_frame(), registered.get_depth_frame()
    finally:
        pipeline.stop()


def _start(rs: Any, pipeline: Any, bag: Path) -> Any:
    """Play a recording from its first picture on, waiting for us; the playback."""
    config = rs.config()
    try:
        config.enable_device_from_file(str(bag), repeat_playback=False)
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise BadInput(str(bag), f"an unreadable recording ({' '.join(str(error).split())[:120]})", "a .bag") from None
    recording = profile.get_device().as_playback()
    # It can be told to wait only once it runs, and has dropped pictures by then: so back to the start.
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


def _write_camera(rs: Any, bag: Path, out: Path, colour: Any, units_m: float) -> None:
    lens = colour.get_profile().as_video_stream_profile().get_intrinsics()
    moved = max(_distortion_px(rs, lens, u, v) for u in (0, lens.width - 1) for v in (0, lens.height - 1))
    if moved > MOST_DISTORTION_PX:
        got = f"a colour camera whose lens moves the corners by {moved:.1f} px"
        raise BadInput(str(bag), got, f"at most {MOST_DISTORTION_PX} px", "Undistort the pictures first.")
    K = [[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]]
    np.savetxt(out / "cam_K.txt", K, fmt="%.9g")
    (out / "depth_scale.txt").write_text(f"{units_m:.9g}\n")


def _distortion_px(rs: Any, lens: Any, u: float, v: float) -> float:
    """How far the lens model puts a pixel's ray from where a pinhole's would go, in pixels."""
    x, y, z = rs.rs2_deproject_pixel_to_point(lens, [u, v], 1.0)
    return float(np.hypot(lens.fx * x / z + lens.ppx - u, lens.fy * y / z + lens.ppy - v))


def _bgr(bag: Path, colour: Any) -> np.ndarray:
    kind = str(colour.get_profile().format()).removeprefix("format.")
    image = np.asanyarray(colour.get_data())
    if kind == "bgr8":
        return image
    if kind not in TO_BGR:
        raise BadInput(str(bag), f"colour as {kind}", "one of bgr8, " + ", ".join(TO_BGR))
    if kind in ("yuyv", "uyvy"):
        image = image.view(np.uint8).reshape(colour.get_height(), colour.get_width(), 2)
    return cv2.cvtColor(image, TO_BGR[kind])


def _save(path: Path, picture: np.ndarray) -> None:
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"{path} could not be written")
