"""Each fault does what it says, within its frames alone, and the same for the same seed."""

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.synthetic.faults import FAULTS, Faulty
from tests.fixtures.sliding_board import write_sequence

START, STOP, FRAMES = 3, 6, 10
#: Of faults that need one; 1 for the others.
SEVERITY = {"colour blurred": 3.0, "colour noise": 20.0, "colour cast": 40.0, "mask wide": 6.0, "mask misplaced": 10.0}
SEVERITY |= {"depth scaled": 1.2, "depth offset": 0.1, "depth misaligned": 7.0, "depth noise": 0.02, "depth holes": 0.9}
SEVERITY |= {"depth wild": 0.5, "exposure": 0.5, "mask cut": 0.5, "board unmasked": 0.4, "frames thinned": 0.5}
SEVERITY |= {"time shifted": -10.0, "focal length off": 1.15, "depth scaled anew": 0.15, "colour plain on objects": 2.5}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return open_sequence(write_sequence(tmp_path_factory.mktemp("board") / "one", FRAMES))


def faulty(good, name: str, **changes) -> Faulty:
    return Faulty(good, name, **{"severity": SEVERITY.get(name, 1.0), "start": START, "stop": STOP, **changes})


def same(a: Faulty, b, i: int, j: int) -> bool:
    x, y, masks, others = a.frame(i), b.frame(j), a.masks(i), b.masks(j)
    images = np.array_equal(x.rgb, y.rgb) and np.array_equal(x.depth_m, y.depth_m) and x.time_s == y.time_s
    return images and all(np.array_equal(masks[name], others[name]) for name in others)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_in_its_frames_alone_and_repeats_itself(good, name):
    bad, again = faulty(good, name), faulty(good, name)
    first, end = bad.during
    assert all(same(bad, again, i, i) for i in range(len(bad)))
    for i, at in enumerate(bad.kept):
        if not first <= i < end:
            assert same(bad, good, i, int(at)) and bad.visible_px(i) == good.visible_px(int(at))
    changed = any(not same(bad, good, i, int(bad.kept[i])) for i in range(first, end))
    elsewhere = bad.camera != good.camera or len(bad) < len(good)
    assert changed != elsewhere if name != "none" else not changed and not elsewhere
    np.testing.assert_array_equal(bad.truth["object"].T_cam_model, good.truth["object"].T_cam_model[bad.kept])
    assert len(bad.times_s) == len(bad.frame_names) == len(bad) and bad.name == good.name


def test_depth(good):
    now, before = good.frame(4).depth_m, good.frame(START - 1).depth_m
    at = {name: faulty(good, name).frame(4).depth_m for name in FAULTS if name.startswith("depth")}
    np.testing.assert_array_equal(at["depth frozen"], before)
    np.testing.assert_array_equal(at["depth late"], good.frame(3).depth_m)
    np.testing.assert_allclose(at["depth scaled"], 1.2 * now, rtol=1e-6)
    np.testing.assert_allclose(at["depth offset"], now + 0.1, rtol=1e-6)
    np.testing.assert_array_equal(at["depth misaligned"][:, 7:], now[:, :-7])
    factor = at["depth scaled anew"] / now
    assert 0.85 <= factor.mean() <= 1.15 and np.ptp(factor) < 1e-6 and factor.mean() != pytest.approx(1, abs=1e-3)
    assert (at["depth missing on objects"] == np.where(good.masks(4)["object"], 0, now)).all()
    wider = at["depth not registered"]
    np.testing.assert_array_equal(wider[15:105:3, 32:128:3], now[::4, ::4][:30, :32])
    assert (wider[:15] == 0).all() and (wider[:, :32] == 0).all()
    assert np.std(at["depth noise"] - now) == pytest.approx(0.02, rel=0.05)
    assert (at["depth holes"] == 0).mean() == pytest.approx(0.9, abs=0.01)
    assert (at["depth wild"] != now).mean() == pytest.approx(0.5, abs=0.02)
    assert np.isfinite(at["depth wild"]).all(), "what no camera measures is no measurement"


def test_plain_objects_are_of_one_colour(good):
    now, mask = good.frame(4).rgb, good.masks(4)["object"]
    plain = faulty(good, "colour plain on objects").frame(4).rgb
    np.testing.assert_allclose(plain[mask].mean(0), np.median(now[mask], 0), atol=0.5)
    assert plain[mask].std(0).max() < 3 < now[mask].std(0).min()
    away = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) == 0
    np.testing.assert_array_equal(plain[away], now[away])


def test_masks(good):
    now = good.masks(4)["object"]
    at = {name: faulty(good, name).masks(4)["object"] for name in FAULTS if name.startswith("mask")}
    rows, columns = np.ptp(np.nonzero(now), 1), np.ptp(np.nonzero(at["mask wide"]), 1)
    np.testing.assert_array_equal(columns, rows + 12)
    assert at["mask whole image"].all() and not at["mask empty"].any()
    np.testing.assert_array_equal(at["mask misplaced"][:, 10:], now[:, :-10])
    assert at["mask cut"].sum() == pytest.approx(now.sum() / 2, rel=0.05) and not (at["mask cut"] & ~now).any()
    flickers = faulty(good, "mask flickers")
    assert [flickers.masks(i)["object"].any() for i in range(START, STOP)] == [False, True, False]


def test_frames_and_times(good):
    assert faulty(good, "frames dropped").kept.tolist() == [0, 1, 2, 6, 7, 8, 9]
    assert faulty(good, "frames dropped").during == (3, 3), "none of its frames is there"
    assert faulty(good, "frames thinned").kept.tolist() == [0, 1, 2, 4, 6, 7, 8, 9]
    frozen, twice = faulty(good, "frames frozen"), faulty(good, "frames twice")
    for bad, shown in ((frozen, [2, 2, 2]), (twice, [3, 3, 5])):
        for i, k in zip(range(START, STOP), shown, strict=True):
            np.testing.assert_array_equal(bad.frame(i).rgb, good.frame(k).rgb)
            np.testing.assert_array_equal(bad.masks(i)["object"], good.masks(k)["object"])
            assert bad.frame(i).time_s == good.times_s[i], "time goes on"
    assert faulty(good, "time shifted").frame(4).time_s == pytest.approx(good.times_s[4] - 10)
    assert faulty(good, "time standing").frame(4).time_s == good.times_s[2]


def test_a_board_hides_and_no_mask_knows(good):
    bad = faulty(good, "board unmasked")
    nearer = [(bad.frame(i).depth_m < 0.4).mean(0) for i in range(START, STOP)]
    assert all(set(columns) == {0.0, 1.0} for columns in nearer), "whole columns"
    middles = [np.flatnonzero(columns).mean() for columns in nearer]
    assert middles == sorted(middles) and max(columns.mean() for columns in nearer) == pytest.approx(0.4, abs=0.01)
    np.testing.assert_array_equal(bad.masks(4)["object"], good.masks(4)["object"])


def test_a_cut_is_to_the_view_that_is_turned_most():
    good = open_sequence("synthetic/crossing")
    bad, T = Faulty(good, "frames dropped, turned", start=30, stop=60), good.truth["box"].T_cam_model
    turned_rad = se3.angle_rad(se3.inverse(T[29]) @ T[30 : len(T) - 60])
    assert bad.kept[30] == 30 + turned_rad.argmax() and np.degrees(turned_rad.max()) > 90
    assert len(bad) - bad.during[1] >= 60


@pytest.mark.parametrize(("name", "start", "stop"), [("rain", 0, 3), ("none", 4, 4), ("none", 2, 11), ("none", -1, 3)])
def test_what_is_no_fault_is_refused(good, name, start, stop):
    with pytest.raises(BadInput):
        Faulty(good, name, start=start, stop=stop)
