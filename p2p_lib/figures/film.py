"""Films: pictures to MP4 (or GIF) files, and into a notebook."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from p2p_lib.core.errors import BadInput, MissingData

CRF = 23  # x264's constant quality: smaller is better and larger


def write_video(images: Iterable[np.ndarray], path: str | Path, fps: float = 30.0) -> Path:
    """Write pictures (H, W, 3) uint8 of one size as H.264 in MP4, or as a GIF where the path ends so.

    Returns the path written: a ``.gif`` beside the one asked for where PyAV is missing or built without an H.264
    encoder. The last row or column of a picture of odd size is left out, which the pixel format wants.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise BadInput("video", path.name, "a name that ends in .mp4 or .gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4" and not _can_encode():
        path = path.with_suffix(".gif")
    writer = _write_mp4 if path.suffix == ".mp4" else _write_gif
    if not writer(_checked(images), path, fps):
        raise BadInput("video", "no pictures", "at least one")
    return path


def show_video(path: str | Path, width_px: int | None = None):
    """The film inside the notebook itself, so that exported pages play it too: an IPython display object."""
    from IPython.display import Image, Video

    path = Path(path)
    if not path.is_file():
        raise MissingData(str(path), "no such film")
    if path.suffix == ".gif":
        return Image(filename=str(path), width=width_px)
    return Video(str(path), embed=True, width=width_px, html_attributes="controls autoplay loop muted playsinline")


def _can_encode() -> bool:
    try:
        import av
    except ImportError:
        return False
    return "libx264" in av.codecs_available


def _checked(images: Iterable[np.ndarray]) -> Iterable[np.ndarray]:
    shape = None
    for image in images:
        shape = shape or image.shape
        if image.shape != shape or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise BadInput("video", f"a picture {image.shape} {image.dtype}", "(H, W, 3) uint8, all of one size")
        yield image[: shape[0] // 2 * 2, : shape[1] // 2 * 2]


def _write_mp4(images: Iterable[np.ndarray], path: Path, fps: float) -> bool:
    from fractions import Fraction

    import av

    stream = None
    # Without "bitexact" the file would name the builds that wrote it.
    with av.open(str(path), "w", options={"movflags": "+faststart", "fflags": "+bitexact"}) as container:
        for image in images:
            if stream is None:
                stream = container.add_stream("libx264", Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
                # How many threads encode changes the bytes, and x264's macroblock tree reads memory it never wrote.
                stream.options = {"crf": str(CRF), "preset": "medium", "threads": "2", "x264-params": "mbtree=0"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")))
        if stream is not None:
            container.mux(stream.encode())
    return stream is not None


def _write_gif(images: Iterable[np.ndarray], path: Path, fps: float) -> bool:
    from PIL import Image

    pages = [Image.fromarray(image).quantize(128) for image in images]
    if pages:
        # GIF counts in hundredths of a second, and players take less than two for ten.
        duration_ms = max(20, round(100 / fps) * 10)
        pages[0].save(path, save_all=True, append_images=pages[1:], duration=duration_ms, loop=0)
    return bool(pages)
