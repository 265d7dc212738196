"""Films: images to MP4, GIF or WebP, and a run as one (``p2p film``)."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from p2p_lib.core.errors import BadInput
from p2p_lib.core.packages import needed_for
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.scenes import Scene

SUFFIXES = (".mp4", ".gif", ".webp")
_CRF = 23  # x264's constant quality: smaller is better and larger
#: Wider images that move are larger than what one wants to put on a page, and few programs play more a second.
_PAGE_PX, _PAGE_HZ = 480, 15.0
#: A quarter of a GIF's size at this quality of WebP.
_GIF_COLOURS, _WEBP_QUALITY = 128, 60
_TICK = Fraction(1, 90_000)  # of a film's clock: MPEG's


def write_film(
    run: str | Path,
    out: str | Path,
    sequence: Sequence | None = None,
    width_px: int | None = None,
    progress: bool = False,
    surfaces: bool = False,
) -> Path:
    """A run's folder as a film: boxes, axes, statuses, keypoints, and masks where the run has them; the path written.

    It plays as fast as it was recorded. width_px: of its images (default: the camera's; at most 480 but for MP4).
    surfaces: whether each reconstructed surface is outlined in white at its pose, so that both can be judged.

    Raises :class:`BadInput` for another kind of file, :class:`MissingData` where the images are gone.
    """
    check_suffix(out)
    playback = Playback.of(run, sequence)
    scene, for_a_page = Scene.of(playback, surfaces), Path(out).suffix != ".mp4"
    width_px = width_px or min(playback.images.camera.width, _PAGE_PX if for_a_page else 1 << 16)
    every = max(1, round(playback.rate_hz / _PAGE_HZ)) if for_a_page else 1
    rows = range(0, len(playback), every)
    with Film(out, playback.rate_hz / every) as film, progress_bar(film.path.name, len(rows), shown=progress) as bar:
        for row in rows:
            film.add(scene.draw(row, width_px=width_px), playback.times_s[row])
            bar.update()
    return film.path


def check_suffix(path: str | Path) -> None:
    """Refuse a film that could not be written, before anyone waits for it."""
    if Path(path).suffix not in SUFFIXES:
        raise BadInput("film", Path(path).name, f"a name that ends in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if Path(path).suffix == ".mp4":
        with needed_for("view"):
            import_module("av")


def write_video(images: Iterable[np.ndarray], path: str | Path, fps: float = 30.0) -> Path:
    """Write images (H, W, 3) uint8 of one size as H.264 in MP4, or as a GIF or WebP that repeats; the path written.

    The last row or column of an image of odd size is left out, as MP4's pixel format requires.
    """
    with Film(path, fps) as film:
        for k, image in enumerate(images):
            film.add(image, k / fps)
    return film.path


class Film(AbstractContextManager):
    """A film that is being written, image by image, each at its time (see :func:`write_video`); a context manager.

    fps  about how many images a second are to come
    """

    def __init__(self, path: str | Path, fps: float = 30.0):
        check_suffix(path)
        self.path, self._fps = Path(path), fps
        self._shape: tuple[int, ...] | None = None
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._images: list[tuple[float, Image.Image]] = []  # of what is written as a whole
        self._container: Any = None  # PyAV's, and its stream
        self._stream: Any = None

    def add(self, image: np.ndarray, time_s: float) -> None:
        """One more image (H, W, 3) uint8, red first, shown from ``time_s`` on; :class:`BadInput` for another size."""
        self._shape = self._shape or image.shape
        if image.shape != self._shape or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise BadInput("film", f"an image {image.shape} {image.dtype}", "(H, W, 3) uint8, all of one size")
        image = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
        if self.path.suffix != ".mp4":
            picture = Image.fromarray(image)
            if self.path.suffix == ".gif":
                picture = picture.quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
            self._images.append((time_s, picture))
            return
        import av

        if self._container is None:
            # Without "bitexact" the file would name the builds that wrote it.
            how = {"movflags": "+faststart", "fflags": "+bitexact"}
            self._container = av.open(str(self.path), "w", options=how)
            self._stream = self._container.add_stream("libx264", Fraction(self._fps).limit_denominator(1000))
            self._stream.height, self._stream.width = image.shape[:2]
            self._stream.pix_fmt = "yuv420p"
            # How many threads encode changes the bytes, and x264's macroblock tree reads memory it never wrote.
            how = {"crf": str(_CRF), "preset": "medium", "threads": "2", "x264-params": "mbtree=0"}
            self._stream.options, self._stream.codec_context.time_base = how, _TICK
        frame = av.VideoFrame.from_ndarray(image, "rgb24")
        frame.pts, frame.time_base = round(time_s / _TICK), _TICK
        self._container.mux(self._stream.encode(frame))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None and self._shape is None:
            raise BadInput("film", "no images", "at least one")
        if self._images:
            times_s = [time_s for time_s, _ in self._images]
            first, *images = [image for _, image in self._images]
            shown_ms = np.rint(1000 * np.diff([*times_s, times_s[-1] + 1 / self._fps])).astype(int).tolist()
            how: dict[str, Any] = {"quality": _WEBP_QUALITY} if self.path.suffix == ".webp" else {}
            first.save(self.path, save_all=True, append_images=images, duration=shown_ms, loop=0, **how)
        if self._container is not None:
            self._container.mux(self._stream.encode())
            self._container.close()
