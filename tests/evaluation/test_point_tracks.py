"""TAP-Vid's scores against hand counts and against the published formulae written out; re-detection by hand."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pandas.testing import assert_frame_equal

from p2p_lib.evaluation.point_tracks import (
    after_query,
    redetection_shares,
    redetections,
    tapvid,
)

SHAPE = (480, 640)


def published(query_frame, gt_occluded, gt_tracks, pred_occluded, pred_tracks):
    """TAP-Vid's section "Evaluation metrics", query-first, point by point; tracks (N, T, 2) in a 256x256 raster."""
    right_occlusion = evaluated = visible_count = 0
    correct = dict.fromkeys((1, 2, 4, 8, 16), 0)
    tp, fp = dict(correct), dict(correct)
    for n, first in enumerate(query_frame):
        for t in range(first + 1, gt_tracks.shape[1]):
            evaluated += 1
            right_occlusion += gt_occluded[n, t] == pred_occluded[n, t]
            visible_count += not gt_occluded[n, t]
            for px in correct:
                close = np.sum((pred_tracks[n, t] - gt_tracks[n, t]) ** 2) < px**2
                correct[px] += close and not gt_occluded[n, t]
                tp[px] += close and not gt_occluded[n, t] and not pred_occluded[n, t]
                # "False positives: points predicted visible, but the ground truth is occluded or farther away."
                fp[px] += (not pred_occluded[n, t]) and (gt_occluded[n, t] or not close)
    within = [correct[px] / visible_count for px in correct]
    jaccard = [tp[px] / (visible_count + fp[px]) for px in correct]
    return np.mean(jaccard), np.mean(within), right_occlusion / evaluated, jaccard, within


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_equal_to_the_published_formulae(seed):
    rng = np.random.default_rng(seed)
    T, N = rng.integers(2, 12), rng.integers(1, 7)
    query_frame = rng.integers(0, T - 1, N)
    gt, noise = rng.uniform(0, 256, (N, T, 2)), rng.choice([0.3, 1, 3, 10, 40], (N, T, 1)) * rng.normal(size=(N, T, 2))
    gt_occluded, pred_occluded = rng.random((2, N, T)) < 0.4
    gt_occluded[0, -1] = False
    expected = published(query_frame, gt_occluded, gt, pred_occluded, gt + noise)
    full = np.array([640, 480]) / 256
    got = tapvid(
        np.swapaxes(gt * full, 0, 1), ~gt_occluded.T, np.swapaxes((gt + noise) * full, 0, 1), ~pred_occluded.T,
        after_query(query_frame, T), SHAPE,
    )  # fmt: skip
    np.testing.assert_allclose(list(got["jaccard"].values()), expected[3])
    np.testing.assert_allclose(list(got["within"].values()), expected[4])
    np.testing.assert_allclose((got["aj"], got["delta_avg"], got["oa"]), expected[:3])


def one_point(off_px, truly, said):
    """A point that stands still, queried in frame 0, predicted ``off_px`` (T,) to the right in the picture."""
    truly, said = np.array(truly, bool)[:, None], np.array(said, bool)[:, None]
    uv = np.full((len(truly), 1, 2), 100.0)
    wrong = uv.copy()
    wrong[:, 0, 0] += off_px
    return tapvid(uv, truly, wrong, said, after_query(np.zeros(1, int), len(uv)), SHAPE)


def test_by_hand():
    # 640 px become 256: 2.5 px in the picture are 1 px. Frames 1 to 4 count: 3 truly visible.
    # frame 1: hit at every threshold; 2: 4 px in the raster; 3: visible, said not to be; 4: said visible, is not.
    score = one_point([99, 0, 10.0, 0, 0], [1, 1, 1, 1, 0], [1, 1, 1, 0, 1])
    assert list(score["within"].values()) == pytest.approx((2 / 3, 2 / 3, 2 / 3, 1, 1))  # 4 px is not below 4 px
    # hits 1, 1, 1, 2, 2; false positives: frame 4 always, frame 2 where it is too far.
    assert list(score["jaccard"].values()) == pytest.approx((1 / 5, 1 / 5, 1 / 5, 2 / 4, 2 / 4))
    assert score["oa"] == pytest.approx(2 / 4)
    assert score["aj"] == pytest.approx((0.6 + 1) / 5) and score["delta_avg"] == pytest.approx((2 + 2) / 5)


def test_axes_are_scaled_each_by_its_own():
    uv = np.zeros((2, 1, 2))
    seen, scored = np.ones((2, 1), bool), after_query(np.zeros(1, int), 2)
    right, down = (tapvid(uv, seen, uv + off, seen, scored, SHAPE)["within"] for off in ([2.4, 0], [0, 2.4]))
    assert right["1_px"] == 1 and down["1_px"] == 0 and down["2_px"] == 1  # 2.4 px are 0.96 px across and 1.28 px down


def test_missing_positions_are_wrong_and_nothing_scored_is_nan():
    assert one_point([0, np.nan], [1, 1], [1, 0])["delta_avg"] == 0
    empty = one_point([0], [1], [1])
    assert np.isnan([empty["aj"], empty["delta_avg"], empty["oa"]]).all()


# --- re-detection ------------------------------------------------------------------------------

TURN = {deg: [np.sin(np.radians(deg)), 0, np.cos(np.radians(deg))] for deg in range(0, 181, 10)}


def returns_of(truly, off_px=0.0, said=None, turn_deg=None, known=None, query=0):
    """Re-detections of one point; everything (T,)."""
    truly = np.array(truly, bool)
    T = len(truly)
    said = truly if said is None else np.array(said, bool)
    known = np.ones(T, bool) if known is None else np.array(known, bool)
    view = np.array([TURN[d] for d in (turn_deg if turn_deg is not None else [0] * T)])
    uv = np.full((T, 1, 2), 50.0)
    return redetections(
        uv, truly[:, None], known[:, None], view[:, None],
        uv + np.broadcast_to(off_px, T)[:, None, None] * [1, 0], said[:, None], np.array([query]),
    )  # fmt: skip


def shown(*spans, T=120):
    seen = np.zeros(T, bool)
    for a, b in spans:
        seen[a:b] = True
    return seen


@pytest.mark.parametrize(("gap", "count"), [(29, 0), (30, 1), (50, 1)])
def test_thirty_frames_make_an_absence(gap, count):
    back = returns_of(shown((0, 10), (10 + gap, 100)))
    assert len(back.point) == count and (back.frame == 10 + gap).all() and back.found.all()


def test_found_in_the_first_five_visible_frames_or_not():
    seen = shown((0, 10), (50, 52), (60, 100))
    late, later = seen.copy(), seen.copy()
    late[50:62] = False  # said visible from 62 on: its fifth visible frame
    later[50:63] = False
    assert returns_of(seen, said=late).found.tolist() == [True]
    assert returns_of(seen, said=late).share_found.tolist() == [1 / 5]
    assert returns_of(seen, said=later).found.tolist() == [False]


def test_the_place_must_be_right_to_eight_pixels():
    seen = shown((0, 10), (50, 100))
    assert returns_of(seen, off_px=7.9).found.all() and not returns_of(seen, off_px=8.1).found.any()
    assert not returns_of(seen, off_px=np.nan).found.any()


def test_a_short_second_visit_is_not_mixed_with_the_third():
    seen = shown((0, 5), (40, 42), (80, 120))
    said = seen.copy()
    said[40:42] = False
    back = returns_of(seen, said=said)
    assert back.frame.tolist() == [40, 80] and back.found.tolist() == [False, True]
    assert back.share_found.tolist() == [0, 1]


def test_only_what_was_asked_for_and_what_truth_knows():
    seen = shown((0, 5), (40, 42), (80, 120))
    assert returns_of(seen, query=41).frame.tolist() == [80]
    assert returns_of(seen, query=90).frame.tolist() == []
    unsure = np.ones(120, bool)
    unsure[60] = False
    assert returns_of(seen, known=unsure).frame.tolist() == [40]


def test_the_angle_is_to_the_nearest_view_it_was_seen_from():
    seen = shown((10, 20), (60, 100))
    turn = np.zeros(120, int)
    turn[:12], turn[12:20], turn[20:60], turn[60:] = 0, 30, 70, 80  # at 70 it was hidden
    back = returns_of(seen, turn_deg=turn, query=10)
    assert back.view_deg.tolist() == pytest.approx([50])
    assert redetection_shares(back)["returns_same_view"] == 0 and redetection_shares(back)["returns"] == 1
    assert np.isnan(redetection_shares(back)["found_same_view"])
    turn[19] = 50
    assert redetection_shares(returns_of(seen, turn_deg=turn, query=10))["found_same_view"] == 1


def test_many_points_are_the_single_ones():
    rng = np.random.default_rng(3)
    T, N = 200, 30
    truly = np.repeat(rng.random((T // 20, N)) < 0.4, 20, axis=0)
    said = truly & (rng.random((T, N)) < 0.5)
    query = rng.integers(0, 60, N)
    uv, view = np.zeros((T, N, 2)), np.broadcast_to(np.array([0, 0, 1.0]), (T, N, 3))
    known = rng.random((T, N)) < 0.999
    one = [
        redetections(*(x[:, k : k + 1] for x in (uv, truly, known, view, uv, said)), query[k : k + 1]) for k in range(N)
    ]
    all_ = redetections(uv, truly, known, view, uv, said, query)
    assert len(all_) > 10
    assert_frame_equal(all_, pd.concat([o.assign(point=k) for k, o in enumerate(one)], ignore_index=True))


def test_no_returns_at_all():
    assert redetection_shares(returns_of(shown((0, 100))))["returns"] == 0
    assert redetection_shares(returns_of(shown()))["returns"] == 0
