"""Films come back with as many images as went in, looking as they did."""

import numpy as np
import pytest

from p2p_lib.core.errors import BadInput
from p2p_lib.figures.provenance import save_video, write_video


def images(count, height=120, width=160):
    """A bright square that moves a little from image to image."""
    for k in range(count):
        image = np.full((height, width, 3), [40, 90, 140], np.uint8)
        image[30:60, 10 + 3 * k : 50 + 3 * k] = [220, 180, 60]
        yield image


def decoded(path):
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        return frames, stream.codec_context.name, stream.codec_context.pix_fmt, float(stream.average_rate)


@pytest.mark.parametrize("count", [1, 2, 23])
def test_mp4_reads_back(tmp_path, count):
    path = write_video(images(count), tmp_path / "film.mp4", fps=15)
    frames, codec, pixels, rate = decoded(path)
    assert len(frames) == count and codec == "h264" and pixels == "yuv420p"
    assert rate == pytest.approx(15)
    for written, read in zip(images(count), frames):
        assert np.abs(written.astype(int) - read).mean() < 4


def test_odd_sizes_lose_a_row_and_a_column(tmp_path):
    frames, *_ = decoded(write_video(images(3, 121, 159), tmp_path / "odd.mp4"))
    assert frames[0].shape == (120, 158, 3)


def test_same_images_same_bytes(tmp_path):
    first = write_video(images(12), tmp_path / "a.mp4").read_bytes()
    assert first == write_video(images(12), tmp_path / "b.mp4").read_bytes()


def test_shown_films_are_embedded(tmp_path, monkeypatch):
    import base64

    monkeypatch.setenv("P2P_FIGURES", str(tmp_path))
    saved = save_video(images(3), "film")
    page = saved._repr_mimebundle_()[0]["text/html"]
    assert base64.b64encode(saved.path.read_bytes()).decode() in page and "autoplay" in page


def test_what_is_no_film_is_refused(tmp_path):
    with pytest.raises(BadInput, match="no images"):
        write_video([], tmp_path / "film.mp4")
    with pytest.raises(BadInput, match=r"\.mp4"):
        write_video(images(1), tmp_path / "film.avi")
    with pytest.raises(BadInput, match="all of one size"):
        write_video([*images(1), *images(1, 100, 100)], tmp_path / "film.mp4")
    with pytest.raises(BadInput, match="uint8"):
        write_video([np.zeros((8, 8, 3))], tmp_path / "film.mp4")
