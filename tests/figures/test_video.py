"""Films come back with as many images as went in, looking as they did."""

import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.figures import overlay, style
from p2p_lib.figures.film import Film, write_film, write_video
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.provenance import save_video
from p2p_lib.figures.scenes import Scene


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
    page = saved.shown[0]["text/html"]
    assert base64.b64encode(saved.path.read_bytes()).decode() in page and "autoplay" in page


def test_what_is_no_film_is_refused(tmp_path):
    with pytest.raises(BadInput, match="no images"):
        write_video([], tmp_path / "film.mp4")
    with pytest.raises(BadInput, match=r"\.mp4, \.gif or \.webp"):
        write_video(images(1), tmp_path / "film.avi")
    with pytest.raises(BadInput, match="all of one size"):
        write_video([*images(1), *images(1, 100, 100)], tmp_path / "film.mp4")
    with pytest.raises(BadInput, match="uint8"):
        write_video([np.zeros((8, 8, 3))], tmp_path / "film.mp4")


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_film_for_a_page_reads_back_and_repeats(tmp_path, suffix):
    from PIL import Image

    with Image.open(write_video(images(5), (tmp_path / "film").with_suffix(suffix), fps=10)) as film:
        assert (film.n_frames, film.info["loop"]) == (5, 0)
        for k, written in enumerate(images(5)):
            film.seek(k)
            film.load()
            assert film.info["duration"] == 100
            assert np.abs(np.asarray(film.convert("RGB")).astype(int) - written).mean() < 4


def test_images_are_shown_when_they_were_taken(tmp_path):
    """As those of a camera of which some were dropped."""
    import av

    times_s = [0.0, 0.04, 0.3, 0.31]
    with Film(tmp_path / "film.mp4") as film:
        for image, time_s in zip(images(4), times_s):
            film.add(image, time_s)
    with av.open(str(film.path)) as container:
        assert [frame.time for frame in container.decode(video=0)] == pytest.approx(times_s, abs=1e-3)


def test_a_run_as_a_film_has_its_masks_keypoints_and_seconds(made, tmp_path):
    """Drawn from what the folder holds: without masks and keypoints these pixels are the image's."""
    run, row = shutil.copytree(made.run.path, tmp_path / "run"), 2
    playback = Playback.of(run, made.sequence)
    at = int(playback.frame_index[row])
    plain = Scene.of(playback).draw(row, axes=False, words=False)
    mask = np.zeros(plain.shape[:2], bool)
    mask[40:80, 20:90] = True
    save_png(run / "masks" / "box" / f"{at:06d}.png", mask)
    log, ids, nobody = KeypointLog(), np.arange(3), (np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, bool))
    log.add(at, "can", ids, np.array([[30.0, 20], [50, 20], [70, 20]]))
    log.save(run, {"box": nobody, "can": (ids, np.zeros((3, 3)), np.ones(3, bool))})
    scene = Scene.of(Playback.of(run, made.sequence))
    drawn = scene.draw(row, axes=False, words=False)
    for name, pixels in (("box", ([40, 79], [50, 50])), ("can", ([20, 20, 20], [30, 50, 70]))):
        assert (np.abs(drawn[pixels].astype(int) - style.rgb(scene.colours[name])).max(-1) < 60).all(), name
        assert (np.abs(plain[pixels].astype(int) - style.rgb(scene.colours[name])).max(-1) > 60).all(), name
    frames, *_ = decoded(write_film(run, tmp_path / "film.mp4", made.sequence, width_px=160))
    assert len(frames) == len(playback) and frames[0].shape == (120, 160, 3)


def test_a_film_outlines_the_surfaces_at_their_poses_where_that_is_asked_for(made, tmp_path, monkeypatch):
    """A ball of 4 cm at each object's origin: white where its rim is seen, and the rest of the image as without."""
    import trimesh

    run, row = shutil.copytree(made.run.path, tmp_path / "run"), 2
    (name, obj), *_ = made.run.objects.items()
    (run / "meshes").mkdir(exist_ok=True)
    trimesh.creation.icosphere(radius=0.04).export(run / "meshes" / f"{name}.ply")
    playback = Playback.of(run, made.sequence)
    shown = playback.silhouettes(row)[name]
    u, v = made.sequence.camera.project(obj.T_cam_obj[row][None, :3, 3])[0]
    np.testing.assert_allclose(np.argwhere(shown).mean(0), (v, u), atol=1.5)
    plain, outlined = (Scene.of(playback, surfaces).draw(row, words=False).astype(int) for surfaces in (False, True))
    changed = np.argwhere((plain != outlined).any(-1))
    away_px = np.abs(np.linalg.norm(changed - (v, u), axis=1) - np.sqrt(shown.sum() / np.pi))
    assert len(changed) > 50 and away_px.max() < 5
    frames = [decoded(write_film(run, tmp_path / f"{of}.mp4", made.sequence, surfaces=of))[0] for of in (0, 1)]
    assert any((a != b).any() for a, b in zip(*frames))
    monkeypatch.setattr(Playback, "of_kept_map", lambda self, name: np.zeros(len(self), bool))
    assert playback.silhouettes(row) == {}, "of a pose in another map there is no surface"


def test_seconds_count_from_the_start(made):
    """A camera's clock may begin anywhere."""
    later = {k: replace(obj, time_s=obj.time_s + 1.6e9) for k, obj in made.run.objects.items()}
    first = replace(made.sequence.frame(0), time_s=made.sequence.times_s[0] + 1.6e9)
    sequence = SimpleNamespace(**{k: getattr(made.sequence, k) for k in ("name", "camera", "objects", "truth")})
    sequence.frame = lambda i: first
    images = Scene(sequence, replace(made.run, objects=later)).draw(0), Scene(made.sequence, made.run).draw(0)
    np.testing.assert_array_equal(*images)


def test_the_caption_names_the_frame_as_reports_do(made, monkeypatch):
    said = []
    monkeypatch.setattr(overlay, "draw_labels", lambda image, labels, caption: said.append(caption) or image)
    Scene(made.sequence, made.run).draw(3)
    seconds = made.sequence.times_s[3] - made.sequence.times_s[0]
    assert said == [f"{made.sequence.name}  frame 3  {seconds:.2f} s"]


def test_images_of_an_offline_run_say_so_in_their_corner(made):
    refined = replace(made.run, info=made.run.info | {"offline": True})
    plain, marked = (Scene(made.sequence, run).draw(3) for run in (made.run, refined))
    v, u = np.nonzero((plain != marked).any(-1))
    assert len(v) > 100 and v.max() < 40 and u.max() < 400
    np.testing.assert_array_equal(*(Scene(made.sequence, run).draw(3, words=False) for run in (made.run, refined)))


def test_a_film_of_images_that_are_gone_says_so(made, tmp_path):
    run = shutil.copytree(made.run.path, tmp_path / "run")
    info = (run / "run.json").read_text()
    (run / "run.json").write_text(re.sub(r'"path": [^,]*,', '"path": "/gone/away",', info))
    with pytest.raises(MissingData, match="away: no such folder, so there are no images"):
        write_film(run, tmp_path / "film.mp4")
