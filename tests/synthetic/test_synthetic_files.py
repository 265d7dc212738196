"""``p2p synth``: what is rendered is written and read back alike; the paper-like subset; masks, drops, exposure."""

import json

import cv2
import numpy as np
import pytest

from p2p_lib.apps.cli import main
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.synthetic import SCENARIOS, generate, paper_subset, write_sequence
from p2p_lib.synthetic.noise import NOISE, PERFECT, Sensor, kept_frames, measured_mask
from p2p_lib.synthetic.render import render
from p2p_lib.synthetic.scene import Body, Scenario


def short(monkeypatch, name, frames=4):
    """The same scenario, cut to its first frames."""
    make = SCENARIOS[name]

    def cut(seed, models=""):
        whole = make(seed, models=models) if models else make(seed)
        bodies = tuple(Body(b.name, b.mesh, b.T_world_model[:frames], b.labelled) for b in whole.bodies)
        return Scenario(whole.camera, whole.T_world_cam[:frames], bodies, whole.room, whole.light, whole.objects)

    monkeypatch.setitem(SCENARIOS, name, cut)
    return cut


@pytest.mark.parametrize("noise", ["exact", "hard"])
def test_what_is_written_is_read_back(tmp_path, monkeypatch, noise):
    scenario = short(monkeypatch, "ycb_meat_sugar", 3)(3)
    out = write_sequence("ycb_meat_sugar", tmp_path / "s", 3, noise, bop=True)
    kept = kept_frames(3, NOISE[noise], np.random.default_rng([3, 5]))
    numbers = {k: i for i, k in enumerate(kept)}
    obj_id = {name: f"obj_{k:06d}" for k, name in enumerate(sorted(b.name for b in scenario.bodies), 1)}
    flat, bop = open_sequence(out), open_sequence(out / "bop/test/000001", format="bop")
    assert flat.camera == scenario.camera == bop.camera and len(flat) == len(bop) == len(kept)
    for t, i in numbers.items():
        rgb, depth_m, exact = generate.photograph(scenario, NOISE[noise], 3, t)
        frame = flat.frame(i)
        assert frame.time_s == pytest.approx(t / 30, abs=1e-6)
        np.testing.assert_allclose(frame.depth_m, depth_m, atol=0.5e-3 + 1e-6)  # whole millimetres
        assert np.abs(frame.rgb.astype(int) - rgb).mean() < 4  # JPEG
        np.testing.assert_array_equal(bop.frame(i).rgb, frame.rgb)
        np.testing.assert_allclose(bop.frame(i).depth_m, frame.depth_m, atol=1e-7)
        for k, body in enumerate(scenario.bodies, 1):
            T = se3.inverse(scenario.T_world_cam[t]) @ body.T_world_model[t]
            np.testing.assert_allclose(flat.truth[body.name].T_cam_model[i], T, atol=1e-8)
            np.testing.assert_allclose(bop.truth[obj_id[body.name]].T_cam_model[i], T, atol=1e-6)
            rng = np.random.default_rng([3, 6, t, k])
            mask = measured_mask(exact.label == k, NOISE[noise], rng)
            np.testing.assert_array_equal(flat.masks(i)[body.name], mask)
    made = json.loads((out / "scenario.json").read_text())
    assert made["objects"].startswith("procedural stand-ins") and made["noise"] == noise and made["seed"] == 3


def test_a_film_that_is_stopped_is_the_beginning_of_the_whole(tmp_path, monkeypatch):
    """The same frames to the last bit, with those that the sensor drops among the numbers."""
    short(monkeypatch, "ycb_meat_sugar", 4)
    whole, cut = (write_sequence("ycb_meat_sugar", tmp_path / f"{n}", 5, "hard", stop=n) for n in (None, 3))
    files = [path.relative_to(whole) for path in whole.rglob("*.*g") if path.stem.isdigit()]
    first = {path for path in files if int(path.stem) < 3}
    assert first and first < {*files} and first == {p.relative_to(cut) for p in cut.rglob("*.*g") if p.stem.isdigit()}
    assert all((whole / path).read_bytes() == (cut / path).read_bytes() for path in first)
    assert [json.loads((of / "scenario.json").read_text()).get("stop") for of in (whole, cut)] == [None, 3]
    a, b = open_sequence(whole), open_sequence(cut)
    np.testing.assert_array_equal(a.times_s[: len(b)], b.times_s)
    for name, truth in b.truth.items():
        np.testing.assert_array_equal(a.truth[name].T_cam_model[: len(b)], truth.T_cam_model)
    with pytest.raises(BadInput, match="stop: got 0, expected one past the last frame, from 1"):
        write_sequence("ycb_meat_sugar", tmp_path / "none", stop=0)


def test_the_subset_is_as_the_papers():
    assert len(paper_subset.SEQUENCES) == 5 and 5 * paper_subset.FRAMES == 2705
    for name in paper_subset.SEQUENCES:
        scenario = SCENARIOS[name](1)
        assert scenario.frames == 541 and (scenario.camera.fx, scenario.camera.cx, scenario.camera.width) == (
            380,
            320,
            640,
        )
        T_cam_world = se3.inverse(scenario.T_world_cam)
        middles = []
        for body in scenario.bodies:
            T = T_cam_world @ body.T_world_model
            R = T[:, :3, :3]
            cosine = (np.einsum("ij,tij->t", R[0], R) - 1) / 2
            assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() > 90
            assert np.degrees(se3.angle_rad(se3.inverse(T[:-1]) @ T[1:])).max() < 2
            uv = scenario.camera.project(se3.transform(T[::10], body.mesh.vertices))
            assert scenario.camera.inside(uv).all()
            middles.append(se3.transform(T, body.mesh.vertices.mean(0)[None])[:, 0])
        if len(middles) == 2:
            first, second = middles
            aside = np.abs(np.diff([scenario.camera.project(m)[:, 0] for m in middles], axis=0)[0])
            for behind, is_behind in enumerate((first[:, 2] > second[:, 2], first[:, 2] < second[:, 2])):
                t = int(np.argmin(np.where(is_behind, aside, np.inf)))
                placed = [(b.mesh, b.T_world_model[t]) for b in scenario.bodies]
                both = render(placed, scenario.camera, scenario.T_world_cam[t]).label == behind + 1
                alone = render([placed[behind]], scenario.camera, scenario.T_world_cam[t]).label == 1
                assert both.sum() < 0.95 * alone.sum(), (name, behind)  # each is hidden in part by the other
            assert np.linalg.norm(first - second, axis=1).min() > 0.15


def test_the_ycb_models_are_drawn_where_they_are_given(shared_data):
    models = shared_data / "ycb_models"
    if not models.is_dir():
        pytest.skip("no ycb_models in the test data")
    scenario = SCENARIOS["ycb_airplane_can"](1, frames=3, models=str(models))
    assert scenario.objects == "YCB models"
    rgb, _, exact = generate.photograph(scenario, PERFECT, 1, 0)
    for k, body in enumerate(scenario.bodies, 1):
        assert 0.05 < np.ptp(body.mesh.vertices, axis=0).max() < 0.4
        shown = exact.label == k
        assert shown.sum() > 400 and rgb[shown].std() > 15


def test_missing_models_bad_noise_and_full_folders_are_refused(tmp_path):
    with pytest.raises(MissingData, match=r"004_sugar_box.*textured\.obj"):
        write_sequence("ycb_sugar_box", tmp_path / "a", models=tmp_path)
    with pytest.raises(BadInput, match="exact, realsense, hard"):
        write_sequence("crossing", tmp_path / "a", noise="loud")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(BadInput, match="new or empty"):
        write_sequence("crossing", tmp_path)
    with pytest.raises(BadInput, match="'models'"):
        write_sequence("crossing", tmp_path / "a", models=tmp_path)
    assert not (tmp_path / "a").exists()


def test_the_command(tmp_path, monkeypatch, capsys):
    short(monkeypatch, "mug", 2)
    assert main(["synth", "mug", "--out", str(tmp_path / "m"), "--noise", "exact", "--seed", "5"]) == 0
    assert open_sequence(tmp_path / "m").objects == ("mug",)
    monkeypatch.undo()
    assert main(["synth", "--list"]) == 0
    listed = capsys.readouterr().out
    assert all(f"\n{name}" in "\n" + listed for name in SCENARIOS)
    assert main(["synth", "mug"]) == 2 and "--out" in capsys.readouterr().err


def test_masks_wobble_by_what_is_asked_and_vanish_as_often():
    exact = np.zeros((240, 320), bool)
    exact[:, 160:] = True  # the outline is the column 160
    rows = [measured_mask(exact, Sensor(mask_px=2.0), np.random.default_rng(k)) for k in range(20)]
    edge = 160.0 - np.array([row.sum(1) for row in rows])
    assert np.std(edge) == pytest.approx(2.0, rel=0.2) and abs(np.mean(edge)) < 0.7
    assert np.abs(np.diff(edge, axis=1)).mean() < 0.7  # smooth along the outline
    rng = np.random.default_rng(1)
    gone = [not measured_mask(exact, Sensor(mask_loss=0.2), rng).any() for _ in range(1000)]
    assert np.mean(gone) == pytest.approx(0.2, abs=0.04)
    assert measured_mask(exact, Sensor(), rng) is exact


def test_frames_are_dropped_as_often_as_asked():
    kept = kept_frames(20000, Sensor(drop=0.1), np.random.default_rng(2))
    assert kept[0] == 0 and len(kept) / 20000 == pytest.approx(0.9, abs=0.01)
    np.testing.assert_array_equal(kept_frames(50, Sensor(), np.random.default_rng(2)), np.arange(50))


def test_exposure_changes_by_what_is_asked():
    scenario = SCENARIOS["ycb_sugar_box"](1, frames=120)
    blank = render([], scenario.camera, scenario.T_world_cam[0])
    sensor = Sensor(**{**vars(PERFECT), "exposure": 0.2})
    shown = []
    for t in range(0, 120, 10):
        (rgb, _, exact), (plain, _, _) = (generate.photograph(scenario, s, 1, t, blank) for s in (sensor, PERFECT))
        inner = cv2.erode((exact.label > 0).astype(np.uint8), np.ones((5, 5))) > 0
        usable = inner & (plain.max(-1) < 190)
        shown.append(rgb[usable].sum() / plain[usable].sum())
    assert 1.15 < max(shown) < 1.21 and 0.79 < min(shown) < 0.85
