"""The sensor model: what is asked for is what comes out, measured on surfaces of known depth."""

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic.noise import PERFECT, Sensor, in_motion, measured_colour, measured_depth
from p2p_lib.synthetic.render import Rendering

CAMERA = Camera(615.0, 615.0, 319.5, 239.5, 640, 480)


def picture(depth_m, cosine=1.0):
    depth_m = np.asarray(depth_m, float)
    shape = depth_m.shape
    rgb = np.zeros((*shape, 3), np.float32)
    return Rendering(rgb, depth_m, np.zeros(shape, np.uint8), np.full(shape, cosine, np.float32))


def only(**values):
    return Sensor(**{**{k: getattr(PERFECT, k) for k in PERFECT.__dataclass_fields__}, **values})


def wall(z):
    return np.full((480, 640), z)


@pytest.mark.parametrize("z", [0.4, 0.7, 1.2])
@pytest.mark.parametrize("radius", [0.0, 1.5])
def test_axial_noise_grows_with_the_range_squared(z, radius):
    depth = measured_depth(
        picture(wall(z)), CAMERA, only(axial_per_m=0.004, correlation_px=radius), np.random.default_rng(0)
    )
    assert depth.std() == pytest.approx(0.004 * z**2, rel=0.03)
    assert abs(depth.mean() - z) < 0.004 * z**2 * 0.03


def test_default_sensor_at_typical_range():
    # All effects together on a wall: about 2 mm at 0.7 m, no bias, hardly a hole.
    depth = measured_depth(picture(wall(0.7)), CAMERA, Sensor(), np.random.default_rng(1))
    valid = depth > 0
    assert valid.mean() > 0.999
    assert depth[valid].std() == pytest.approx(np.hypot(0.004 * 0.49, 0.0005 / np.sqrt(12)), rel=0.05)
    assert abs(np.median(depth[valid]) - 0.7) < 3e-4


def test_noise_is_correlated_as_asked():
    depth = measured_depth(
        picture(wall(1.0)), CAMERA, only(axial_per_m=0.004, correlation_px=1.5), np.random.default_rng(2)
    )
    n = depth - 1.0
    for lag in (1, 2, 4):
        # Blur with radius r makes the autocorrelation exp(-lag^2 / (4 r^2)).
        expected = np.exp(-(lag**2) / (4 * 1.5**2))
        assert (n[:, lag:] * n[:, :-lag]).mean() / n.var() == pytest.approx(expected, abs=0.03)
        assert (n[lag:] * n[:-lag]).mean() / n.var() == pytest.approx(expected, abs=0.03)


def test_disparity_is_quantised():
    ramp = np.tile(np.linspace(0.5, 0.9, 640), (4, 1))
    depth = measured_depth(
        picture(ramp), CAMERA, only(baseline_m=0.05, disparity_step_px=0.125), np.random.default_rng(3)
    )
    seen = depth > 0
    steps = 615 * 0.05 / depth[seen] / 0.125
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    half_step = ramp**2 / (615 * 0.05) * 0.125 / 2
    assert (np.abs(depth - ramp) <= half_step * 1.02)[seen].all()
    steps_in_ramp = 615 * 0.05 * (1 / 0.5 - 1 / 0.9) / 0.125
    assert len(np.unique(depth[seen])) == pytest.approx(steps_in_ramp, abs=2)


def test_what_the_second_imager_cannot_see_has_no_depth():
    near, far = 0.6, 1.0
    z = wall(far)
    z[100:300, 200:400] = near
    depth = measured_depth(picture(z), CAMERA, only(baseline_m=0.05), np.random.default_rng(4))
    width = 615 * 0.05 * (1 / near - 1 / far)  # 20.5 px
    hole = depth == 0
    assert hole[100:300].sum(1).tolist() == [pytest.approx(width, abs=1)] * 200
    assert hole[150, 200 - int(width) + 1 : 200].all()
    assert not hole[:100].any() and not hole[300:].any() and not hole[100:300, 200:].any()


def test_edges_and_grazing_surfaces_lose_depth():
    z = wall(1.0)
    z[:, 320:] = 0.7
    edge = measured_depth(picture(z), CAMERA, only(edge_m=0.02, edge_loss=0.4), np.random.default_rng(5)) == 0
    assert edge[:, 319:321].mean() == pytest.approx(0.4, abs=0.05)
    assert not edge[:, :318].any() and not edge[:, 323:].any()
    for incidence, share in ((70, 0.0), (80, 0.5), (82, 0.7), (86, 1.0)):
        grazing = picture(wall(0.7), np.cos(np.radians(incidence)))
        lost = measured_depth(grazing, CAMERA, only(grazing_deg=80.0), np.random.default_rng(6)) == 0
        assert lost.mean() == pytest.approx(share, abs=0.01)


def test_edges_are_ragged_and_even_surface_is_not():
    z = wall(1.0)
    z[:, 320:] = 0.7
    depth = measured_depth(picture(z), CAMERA, only(edge_m=0.02, lateral_px=1.0), np.random.default_rng(7))
    moved = depth != z
    assert 0.1 < moved[:, 319:321].mean() < 0.5
    assert not moved[:, :318].any() and not moved[:, 323:].any()
    assert set(np.unique(depth)) == {0.7, 1.0}


def test_perfect_sensor_changes_nothing():
    z = wall(0.8)
    z[:50] = 0
    rng = np.random.default_rng(8)
    np.testing.assert_array_equal(measured_depth(picture(z, 0.05), CAMERA, PERFECT, rng), z)
    rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.float32)
    np.testing.assert_array_equal(measured_colour(rgb, PERFECT, 1.0, rng), rgb)


@pytest.mark.parametrize("level", [20, 120, 220])
def test_colour_noise_and_exposure(level):
    rgb = np.full((480, 640, 3), level / 0.8, np.float32)
    sensor = only(read_levels=1.5, shot_levels=2.5)
    noisy = measured_colour(rgb, sensor, 0.8, np.random.default_rng(9)).astype(float)
    assert noisy.mean() == pytest.approx(level, abs=0.02)
    expected = np.sqrt(1.5**2 + 2.5**2 * level / 255 + 1 / 12)
    assert noisy.std() == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    "wrong", [{"axial_per_m": -1}, {"edge_loss": 1.5}, {"exposure": float("nan")}, {"blur_samples": 0}]
)
def test_impossible_sensors_are_refused(wrong):
    with pytest.raises(BadInput, match=next(iter(wrong))):
        Sensor(**wrong)


def test_an_edge_that_passes_leaves_patches_and_a_slope_does_not():
    v, u = np.mgrid[:120, :160].astype(float)
    slopes = [0.5 + 0.004 * (v + k) for k in (-5, 0, 5)]  # 4 cm of depth pass every pixel, and no edge
    sensor = only(edge_m=0.02, edge_loss=0.5, correlation_px=1.5)
    measured = in_motion(slopes[1], slopes, sensor, np.random.default_rng(0))
    np.testing.assert_array_equal(measured, slopes[1])
    steps = [np.where(u < 80 + k, 0.6, 1.0) for k in (-8, 0, 8)]
    measured = in_motion(steps[1], steps, sensor, np.random.default_rng(1))
    passed = (u >= 72) & (u < 88)
    np.testing.assert_array_equal(measured[~passed], steps[1][~passed])
    seen = measured[passed]
    assert 0.35 < (seen == 0).mean() < 0.65
    near, far = (np.abs(seen - z) < 1e-9 for z in (0.6, 1.0))
    mixed = (seen > 0.61) & (seen < 0.99)
    assert near.mean() > 0.1 and far.mean() > 0.1 and 0.03 < mixed.mean() < 0.2
    np.testing.assert_allclose(1 / seen[mixed], np.where(u < 80, 2 / 3, 1 / 3)[passed][mixed] * (1 / 0.6 - 1) + 1)
