"""Films: images to MP4 files, and into a notebook."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core.errors import BadInput, MissingData

CRF = 23  # x264's constant quality: smaller is better and larger


def write_video(images: Iterable[np.ndarray], path: str | Path, fps: float = 30.0) -> Path:
    """Write images (H, W, 3) uint8 of one size as H.264 in MP4; the path written.

    The last row or column of an image of odd size is left out, as the pixel format requires.
    """
    import av

    path, stream = Path(path), None
    if path.suffix != ".mp4":
        raise BadInput("video", path.name, "a name that ends in .mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Without "bitexact" the file would name the builds that wrote it.
    with av.open(str(path), "w", options={"movflags": "+faststart", "fflags": "+bitexact"}) as container:
        for image in _checked(images):
            if stream is None:
                stream = container.add_stream("libx264", Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
                # How many threads encode changes the bytes, and x264's macroblock tree reads memory it never wrote.
                stream.options = {"crf": str(CRF), "preset": "medium", "threads": "2", "x264-params": "mbtree=0"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")))
        if stream is None:
            raise BadInput("video", "no images", "at least one")
        container.mux(stream.encode())
    return path


def show_video(path: str | Path, width_px: int | None = None) -> Any:
    """The film inside the notebook itself, so that exported pages play it too: an IPython display object."""
    from IPython.display import Video

    if not Path(path).is_file():
        raise MissingData(str(path), "no such film")
    return Video(str(path), embed=True, width=width_px, html_attributes="controls autoplay loop muted playsinline")


def _checked(images: Iterable[np.ndarray]) -> Iterable[np.ndarray]:
    shape = None
    for image in images:
        shape = shape or image.shape
        if image.shape != shape or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise BadInput("video", f"an image {image.shape} {image.dtype}", "(H, W, 3) uint8, all of one size")
        yield image[: shape[0] // 2 * 2, : shape[1] // 2 * 2]
