"""Whatever one has recorded as a folder that every command reads: what ``p2p convert`` does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.core.files import check_new
from p2p_lib.core.native import load_open3d
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.types import Frame
from p2p_lib.datasets import folder
from p2p_lib.datasets.sequence import RECORDINGS, is_recording, open_sequence

#: The ends of a file that tell a RealSense recording from others of ROS.
_LOOKED_AT, _REALSENSE = 1 << 20, b"/device_0/sensor_"

_TEXTS = (".log", ".txt", ".csv", ".json", ".yaml", ".md")


def convert(
    source: str | Path,
    out: str | Path,
    format: str | None = None,
    depth_scale: float | None = None,
    colour: str | None = None,
    depth: str | None = None,
    progress: bool = True,
) -> int:
    """Write a recording, or a sequence of any layout, as a plain folder (:mod:`p2p_lib.datasets.folder`).

    colour, depth  topics of a ROS recording, where there are several
    format, depth_scale  of a sequence, as of :func:`~p2p_lib.datasets.sequence.open_sequence`

    Returns the number of frames. Raises :class:`BadInput` where ``out`` is not empty or the source does not fit,
    :class:`MissingBackend` where it takes a package that is not there.
    """
    check_new(out)
    if not is_recording(Path(source)):
        if Path(source).is_file() and Path(source).suffix.lower() in _TEXTS:
            fix = f"Give a recording ({' '.join(RECORDINGS)}, or a folder of ROS 2), or a folder of images."
            raise BadInput(str(source), "a text file", "what a camera recorded", fix)
        sequence = open_sequence(source, format, depth_scale)
        folder.write(sequence, out)
        return len(sequence)
    recording = _opened(Path(source), colour, depth)
    with closing(recording), progress_bar(Path(source).name, shown=progress, iterable=recording) as frames:
        times_s = folder.write_images(out, frames, recording.unit_m)
        folder.write_about(out, recording.camera, times_s, recording.unit_m)
    return len(times_s)


def _opened(path: Path, colour: str | None, depth: str | None) -> Any:
    """A recording to iterate over and to close, with its ``camera`` (known after the first frame) and ``unit_m``."""
    if path.suffix == ".mkv":
        return AzureKinectRecording(path)
    if path.is_file() and _by_realsense(path):
        from p2p_lib.datasets.realsense import RealSenseCamera

        return RealSenseCamera(path, every=True)
    from p2p_lib.datasets.rosbag import RosRecording

    return RosRecording(path, colour, depth)


def _by_realsense(path: Path) -> bool:
    with path.open("rb") as file:
        start = file.read(_LOOKED_AT)
        file.seek(max(0, path.stat().st_size - _LOOKED_AT))
        return _REALSENSE in start or _REALSENSE in file.read()


class AzureKinectRecording:
    """Frames of an Azure Kinect's ``.mkv``, depth registered to colour, through Open3D and the camera's own library."""

    unit_m = 0.001
    camera: Camera

    def __init__(self, path: Path):
        open3d = load_open3d()
        try:
            self._reader = open3d.io.AzureKinectMKVReader()
        except RuntimeError as error:
            fix = "Install Microsoft's libk4arecord 1.4, or export the recording as color/ and depth/ where it is."
            reason = " ".join(str(error).split())[-80:]
            raise MissingBackend("Azure Kinect recordings", f"its library is not there ({reason})", fix) from None
        if not self._reader.open(str(path)):
            raise BadInput(str(path), "what is no recording of an Azure Kinect", "one that k4arecorder has made")
        lens = self._reader.get_metadata().intrinsics
        self.camera = Camera.from_K(np.asarray(lens.intrinsic_matrix), lens.width, lens.height, name=str(path))

    def __iter__(self) -> Iterator[Frame]:
        index = 0
        while not self._reader.is_eof():
            images = self._reader.next_frame()
            if images is not None:  # None where either camera missed it
                rgb, depth = np.asarray(images.color), np.asarray(images.depth)
                yield Frame(index, index / 30, np.ascontiguousarray(rgb), depth * np.float32(self.unit_m))
                index += 1

    def close(self) -> None:
        """Close the file."""
        self._reader.close()
