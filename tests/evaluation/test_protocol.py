"""The protocol: which frames count, what alignment absorbs, how failures are counted."""

import json
from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame, PoseEstimate, Status
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import NO_MASKS, ObjectRun, Run, load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.alignment import align_all
from p2p_lib.evaluation.protocol import evaluate, scored_frames

RNG = np.random.default_rng(11)
POINTS = RNG.normal([0.01, 0, -0.03], [0.02, 0.04, 0.06], (300, 3))
N = 60


def motion(rng, n=N):
    """A smooth path in front of a camera."""
    steps = se3.exp(rng.normal(0, [0.05] * 3 + [0.01] * 3, (n, 6)))
    T = np.empty((n, 4, 4))
    T[0] = se3.from_rt(np.eye(3), [0, 0, 0.7])
    for i in range(1, n):
        T[i] = T[i - 1] @ steps[i]
    return T


def noisy(T, rng, angle_rad=0.03, shift_m=0.004):
    return T @ se3.exp(rng.normal(0, [angle_rad] * 3 + [shift_m] * 3, (len(T), 6)))


def object_run(T_cam_obj, T_cam_model, **columns):
    n = len(T_cam_obj)
    posed = np.isfinite(T_cam_obj).all((1, 2))
    nothing = np.zeros(n, int)
    plain = {
        "frame_index": np.arange(n),
        "time_s": np.arange(n) / 30,
        "status": np.where(posed, "tracked", "lost"),
        "T_cam_obj": T_cam_obj,
        "confidence": posed * 1.0,
        "covariance": np.full((n, 6, 6), np.nan),
        **{"visible_points": nothing, "inliers": nothing, "keyframe": nothing > 0, "map_id": nothing},
        "joined_map": nothing - 1,
        "T_obj_joined": np.full((n, 4, 4), np.nan),
        "T_cam_model": T_cam_model,
        "labelled": np.ones(n, bool),
        "visible_px": np.full(n, 5000),
        "reason": np.full(n, ""),
    }
    return ObjectRun(**plain | columns)


def a_run(tmp_path=None, points=None, timings=None, **objects):
    info = {"tracker": "lk", "masks": "dataset", "preset": "default", "seed": 4}
    points = dict.fromkeys(objects, POINTS) if points is None else points
    return Run(tmp_path, info, objects, points, timings or {})


def scores(run, **options):
    return evaluate(run, **options).as_dict()["objects"]["mug"]


@pytest.mark.parametrize("align", ["first", "all"])
def test_perfect_poses_in_any_object_frame_score_100(align):
    truth = motion(np.random.default_rng(0))
    T_model_obj = se3.exp(np.array([0.4, -1.0, 2.0, 0.1, -0.2, 0.3]))
    got = scores(a_run(mug=object_run(truth @ T_model_obj, truth)), align=align)
    for key in ("add_auc", "adds_auc", "add_auc_voc", "adds_auc_voc"):
        assert got[key] == pytest.approx(100, abs=1e-6)
    assert (got["frames"], got["lost"]) == (N, 0)


@pytest.mark.parametrize("align", ["first", "all"])
def test_the_choice_of_the_object_frame_does_not_matter(align):
    rng = np.random.default_rng(1)
    truth = motion(rng)
    tracked = noisy(truth, rng)
    tracked[20:24] = np.nan
    one = evaluate(a_run(mug=object_run(tracked, truth)), align=align).objects["mug"]
    other_frame = se3.exp(np.array([1.0, 2.0, -0.5, 0.5, 0.1, -0.3]))
    two = evaluate(a_run(mug=object_run(tracked @ other_frame, truth)), align=align).objects["mug"]
    assert 0.001 < np.median(one.add_m) < 0.05
    np.testing.assert_allclose(two.add_m, one.add_m, atol=1e-6)
    np.testing.assert_allclose(two.adds_m, one.adds_m, atol=1e-6)


def test_first_alignment_is_the_formula_of_the_field():
    rng = np.random.default_rng(2)
    truth = motion(rng)
    tracked = noisy(truth, rng) @ se3.exp(rng.normal(0, 0.3, 6))
    predicted = tracked @ np.linalg.inv(tracked[0]) @ truth[0]
    mug = evaluate(a_run(mug=object_run(tracked, truth)), align="first").objects["mug"]
    np.testing.assert_allclose(mug.add_m, metrics.add_m(predicted, truth, POINTS), atol=1e-12)
    np.testing.assert_allclose(mug.adds_m, metrics.adds_m(predicted, truth, POINTS), atol=1e-12)
    assert mug.add_m[0] < 1e-12


def test_first_alignment_takes_the_first_scored_frame():
    rng = np.random.default_rng(3)
    truth = motion(rng)
    tracked = noisy(truth, rng)
    visible_px = np.full(N, 5000)
    visible_px[:7] = 299
    mug = evaluate(a_run(mug=object_run(tracked, truth, visible_px=visible_px))).objects["mug"]
    assert mug.frame_index[0] == 7 and len(mug.add_m) == N - 7
    np.testing.assert_allclose(mug.T_obj_model, se3.inverse(tracked[7]) @ truth[7], atol=1e-12)


def test_no_pose_in_the_first_scored_frame_moves_the_alignment_and_counts_as_failure():
    truth = motion(np.random.default_rng(4))
    tracked = truth.copy()
    tracked[:3] = np.nan
    mug = evaluate(a_run(mug=object_run(tracked, truth))).objects["mug"]
    assert np.isinf(mug.add_m[:3]).all() and mug.add_m[3:].max() < 1e-9 and mug.lost == 3
    assert mug.as_dict()["add_auc"] == pytest.approx(100 * (N - 3) / N)


def test_lost_frames_are_failures_and_hidden_frames_are_not_scored():
    truth = motion(np.random.default_rng(5))
    tracked, labelled, visible_px = truth.copy(), np.ones(N, bool), np.full(N, 300)
    tracked[10:20] = np.nan  # lost while visible
    tracked[30:40] = np.nan  # hidden: labels say so
    labelled[30:40] = False
    tracked[40:45] = np.nan  # hidden: hardly any pixels
    visible_px[40:45] = 299
    moved = truth.copy()
    moved[50:55] = np.nan  # no truth
    got = scores(a_run(mug=object_run(tracked, moved, labelled=labelled, visible_px=visible_px)))
    assert (got["frames"], got["lost"]) == (40, 10)
    assert got["add_auc"] == pytest.approx(75) and got["adds_auc_voc"] == pytest.approx(75)


def test_an_object_that_never_had_a_pose_scores_zero():
    truth = motion(np.random.default_rng(6))
    got = scores(a_run(mug=object_run(np.full((N, 4, 4), np.nan), truth)), align="all")
    nothing = {"add_auc": 0, "adds_auc": 0, "add_auc_voc": 0, "adds_auc_voc": 0}
    assert got == nothing | {"frames": N, "lost": N, "frames_to_recovery": []}


def test_min_visible_px_and_sequences_without_masks():
    truth = motion(np.random.default_rng(7))
    sizes = np.arange(N) * 10
    mug = object_run(truth, truth, visible_px=sizes)
    np.testing.assert_array_equal(scored_frames(mug), sizes >= 300)
    assert scores(a_run(mug=mug), min_visible_px=500)["frames"] == 10
    assert scored_frames(object_run(truth, truth, visible_px=np.full(N, NO_MASKS))).all()


def test_all_absorbs_noise_of_the_first_truth_that_first_does_not():
    rng = np.random.default_rng(8)
    truth = motion(rng)
    tracked = truth @ se3.exp(rng.normal(0, 0.3, 6))
    shown = truth.copy()
    shown[0] = shown[0] @ se3.exp(np.array([0.05, 0, 0.05, 0.01, 0.01, 0]))
    run = a_run(mug=object_run(tracked, shown))
    first, everything = (evaluate(run, align=a).objects["mug"] for a in ("first", "all"))
    assert np.median(first.add_m) > 0.01
    np.testing.assert_allclose(everything.add_m[1:], 0, atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_all_is_better_than_first_on_noisy_poses(seed):
    rng = np.random.default_rng(seed)
    truth = motion(rng)
    tracked = noisy(truth, rng, 0.1, 0.02)
    wild = rng.random(N) < 0.3
    tracked[wild] = motion(rng)[wild] @ se3.exp(rng.normal(0, 1, (int(wild.sum()), 6)))
    run = a_run(mug=object_run(tracked, truth))
    assert scores(run, align="all")["add_auc"] > scores(run, align="first")["add_auc"]


def test_all_is_exact_and_not_spoiled_by_wild_frames():
    rng = np.random.default_rng(9)
    truth, T_obj_model = motion(rng), se3.exp(rng.normal(0, 0.5, 6))
    tracked = truth @ se3.inverse(T_obj_model)
    tracked[: N // 3] = tracked[: N // 3] @ se3.exp(rng.normal(0, 1.0, (N // 3, 6)))
    np.testing.assert_allclose(align_all(tracked, truth, POINTS), T_obj_model, atol=1e-7)


def test_all_finds_the_minimum_of_its_cost():
    rng = np.random.default_rng(10)
    truth = motion(rng)
    tracked = noisy(truth, rng)

    def cost(T_obj_model):
        apart = se3.transform(tracked @ T_obj_model, POINTS) - se3.transform(truth, POINTS)
        return np.minimum(np.sqrt((apart**2).sum(-1).mean(-1)), 0.1).sum()

    best = align_all(tracked, truth, POINTS)
    se3.check("fit", best, 1e-9)
    nudges = np.concatenate([np.eye(6), -np.eye(6), rng.normal(0, 1, (30, 6))]) * [2e-3] * 6
    worse = [cost(best @ se3.exp(nudge)) for nudge in nudges]
    assert cost(best) < min(worse)


@pytest.mark.parametrize("seed", [1, 3])
def test_all_leaves_the_frame_that_it_starts_from(seed):
    """Rotations are exact, positions are not: no constant at all fits better than what fits one frame exactly."""
    rng = np.random.default_rng(seed)
    points = rng.normal(scale=0.05, size=(200, 3))
    truth = se3.exp(rng.normal(size=(38, 6)) * ([0.6] * 3 + [0.1] * 3))
    tracked = truth.copy()
    tracked[:, :3, 3] += rng.normal(scale=0.002, size=(38, 3))

    def cost(T_obj_model):
        return np.linalg.norm((tracked @ T_obj_model - truth)[:, :3, 3], axis=1).sum()

    assert cost(align_all(tracked, truth, points)) < cost(np.eye(4))


@pytest.mark.parametrize("flatness", [[1, 1, 0], [1, 0, 0]])
def test_all_copes_with_flat_and_thin_models(flatness):
    rng = np.random.default_rng(12)
    truth, T_obj_model = motion(rng), se3.exp(rng.normal(0, 0.5, 6))
    tracked = noisy(truth, rng, 0.01, 0.001) @ se3.inverse(T_obj_model)
    fitted = align_all(tracked, truth, POINTS * flatness)
    assert se3.angle_rad(se3.inverse(T_obj_model) @ fitted) < 0.02


def test_mean_rate_and_what_ran_are_reported_in_exactly_these_keys():
    truth = motion(np.random.default_rng(13))
    half = truth.copy()
    half[::2] = np.nan
    timings = {"total_ms": np.r_[np.full(95, 10.0), np.full(5, 110.0)]}
    evaluation = evaluate(a_run(cup=object_run(truth, truth), mug=object_run(half, truth), timings=timings))
    got = evaluation.as_dict()
    assert set(got) == {"objects", "mean", "hz", "p95_ms", "tracker", "masks", "segmenter", "preset", "seed", "align"}
    areas = {"add_auc", "adds_auc", "add_auc_voc", "adds_auc_voc"}
    assert set(got["mean"]) == areas and set(got["objects"]["cup"]) == areas | {"frames", "lost", "frames_to_recovery"}
    assert got["mean"]["add_auc"] == pytest.approx(75)
    assert got["hz"] == pytest.approx(98 / 1.48), "all but the first two frames"
    assert got["p95_ms"] == pytest.approx(np.percentile(timings["total_ms"][2:], 95))
    what_ran = {"tracker": "lk", "masks": "dataset", "preset": "default", "seed": 4, "align": "first"}
    assert got | what_ran == got
    assert json.loads(json.dumps(got)) == got
    table = evaluation.as_table()
    assert all(word in table for word in ("cup", "mug", "mean", "100", "75", "66.2 Hz", "aligned by first"))


def test_a_score_says_which_parameters_are_not_the_presets():
    run = a_run(mug=object_run(*2 * [motion(np.random.default_rng(13))]))
    run.info["options"] = {"settings": {"tsdf.voxel_m": "0.004", "method.graph": "off"}, "config_file": "/at/own.toml"}
    assert (
        "preset default, seed 4, changed method.graph=off, tsdf.voxel_m=0.004, by own.toml" in evaluate(run).as_table()
    )


def test_objects_that_cannot_be_scored_are_left_out_with_the_reason():
    truth = motion(np.random.default_rng(14))
    none = np.full((N, 4, 4), np.nan)
    objects = {
        "cup": object_run(truth, truth),
        "lid": object_run(truth, none),
        "jar": object_run(truth, truth),
        "pen": object_run(truth, truth, visible_px=np.full(N, 10)),
    }
    run = a_run(**objects, points=dict.fromkeys(("cup", "lid", "pen"), POINTS))
    evaluation = evaluate(run)
    assert list(evaluation.objects) == ["cup"] and set(evaluation.as_dict()["objects"]) == {"cup"}
    assert evaluation.left_out == {
        "lid": "the sequence has no truth for it",
        "jar": f"no model for ADD (give --models jar=PATH); its poses are 0.0° and 0.0 mm off the truth "
        f"(medians of {N} frames, aligned at the first)",
        "pen": "in no frame it has truth and 300 visible pixels",
    }
    assert "jar: not scored, no model" in evaluation.as_table()
    with pytest.raises(MissingData, match=r"nothing to score: jar: no model for ADD \(give --models jar=PATH\)"):
        evaluate(a_run(jar=objects["jar"], points={}))


def test_without_a_model_the_poses_are_still_compared_with_the_truth():
    """Whatever the object frame: two thirds of the poses are off by 4 degrees and 30 mm, one frame has none."""
    truth = motion(np.random.default_rng(2))
    poses = truth @ se3.exp(np.array([0.4, -1.0, 2.0, 0.1, -0.2, 0.3]))
    off = se3.from_rt(se3.exp(np.array([0, np.radians(4), 0, 0, 0, 0]))[:3, :3], np.array([0.03, 0, 0]))
    wrong = truth @ off @ se3.inverse(truth) @ poses
    poses[N // 3 :] = wrong[N // 3 :]
    poses[1] = np.nan
    with pytest.raises(MissingData, match=rf"4\.0° and 30\.0 mm off the truth \(medians of {N - 1} frames, aligned"):
        evaluate(a_run(jar=object_run(poses, truth), points={}))
    never = a_run(jar=object_run(np.full_like(truth, np.nan), truth), points={})
    with pytest.raises(MissingData, match=r"jar=PATH\)$"):
        evaluate(never)


def test_models_given_to_the_evaluation(tmp_path):
    truth = motion(np.random.default_rng(15))
    np.savetxt(tmp_path / "mug.xyz", POINTS)
    run = a_run(mug=object_run(noisy(truth, np.random.default_rng(15)), truth), points={})
    given, kept = evaluate(run, {"mug": tmp_path / "mug.xyz"}), evaluate(replace(run, points={"mug": POINTS}))
    np.testing.assert_allclose(given.objects["mug"].add_m, kept.objects["mug"].add_m, atol=1e-12)
    with pytest.raises(BadInput, match=r"model: got the name 'cup', expected one of the objects: mug"):
        evaluate(run, {"cup": tmp_path / "mug.xyz"})
    with pytest.raises(BadInput, match=r"align: got 'best', expected one of first, all"):
        evaluate(run, {"mug": tmp_path / "mug.xyz"}, align="best")


def test_a_real_sequence_through_disk(shared_data, tmp_path):
    """Poses with known errors on the real table: the books' labels, masks, truth and model decide the score."""
    sequence = open_sequence(shared_data / "real_multi" / "redkitchen_table")
    truth = sequence.truth["books"].T_cam_model
    T_model_obj, blank = se3.exp(np.array([0.3, 0.2, 0.1, 0.05, 0, 0.1])), np.zeros((480, 640))
    model = sequence.path / "models/books/points.xyz"
    with RunWriter(tmp_path, sequence, preset(), "lk", "dataset", objects=("books",), models={"books": model}) as w:
        for i in range(len(sequence)):
            frame = Frame(i, i / 30, np.zeros((480, 640, 3), np.uint8), blank)
            shift = se3.from_rt(np.eye(3), [0.02 if i >= 150 else 0, 0, 0])  # 2 cm off after the return
            found = i not in range(90, 100)
            estimate = PoseEstimate("books", i, i / 30, Status.TRACKED, shift @ truth[i] @ T_model_obj)
            w.add(frame, {"books": estimate} if found else {}, 20.0)
    got = evaluate(load_run(tmp_path)).as_dict()
    # 135 frames count (away in 102-196); of these 10 have no pose and 33 are 2 cm off.
    assert (got["objects"]["books"]["frames"], got["objects"]["books"]["lost"]) == (135, 10)
    assert got["objects"]["books"]["add_auc"] == pytest.approx(100 * (92 + 33 * 0.8) / 135, abs=1e-6)
    assert got["hz"] == pytest.approx(50)
