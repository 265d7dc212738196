"""Each rule by itself: evidence that is spotless, and one thing after the other that is not."""

from dataclasses import fields, replace

import numpy as np
import pytest

from p2p_lib.evaluation.suspicions import RunEvidence, suspicions

N = 100
ROWS = np.arange(N)


def spotless() -> RunEvidence:
    full = np.ones(N)
    numbers = {"mask_px": 5000, "size_m": 0.15, "keypoints": 40, "inside": 1, "off_px": 0.5, "jump_px": 0.2}
    numbers |= {"overlap": 0.9, "through": 0.01, "on_surface": 0.8, "confidence": 0.9}
    numbers = {key: value * full for key, value in numbers.items()}
    return RunEvidence(10 + ROWS, has_pose=full > 0, elsewhere=full < 0, moved=full < 0, cut=full < 0, **numbers)


def with_some(e: RunEvidence, share: float, **wrong: float) -> RunEvidence:
    """The same with these values in a share of the frames, the 21st and those after it."""
    at = (ROWS >= 20) & (ROWS < 20 + round(share * N))
    return replace(e, **{key: np.where(at, value, getattr(e, key)) for key, value in wrong.items()})


#: What is wrong in some frames, the rule that says so, and shares of the frames with and without which it does.
WRONG = {
    "lost": ({"has_pose": False}, 0.05, 0.2),
    "doubted": ({"confidence": 0.5}, 0.4, 0.6),
    "no keypoints": ({"keypoints": 4}, 0.2, 0.4),
    "outside": ({"inside": 0.2}, 0.03, 0.1),
    "keypoints off": ({"off_px": 5}, 0.15, 0.4),
    "jumps": ({"jump_px": 20}, 0.02, 0.05),
    "silhouette": ({"overlap": 0.3}, 0.1, 0.3),
    "seen through": ({"through": 0.3}, 0.4, 0.6),
    "off the surface": ({"on_surface": 0.5}, 0.01, 0.02),
    "moved": ({"moved": True, "confidence": 0.5}, 0.03, 0.1),
    "grown": ({"size_m": 0.25}, 0.03, 0.1),
    "size": ({"size_m": 0.9}, 0.04, 0.6),
}


def test_nothing_speaks_against_what_is_spotless():
    assert suspicions(spotless()) == ()


@pytest.mark.parametrize("rule", WRONG)
def test_a_rule_counts_frames_and_names_them(rule):
    wrong, few, many = WRONG[rule]
    assert rule not in {s.rule for s in suspicions(with_some(spotless(), few, **wrong))}
    (found,) = [s for s in suspicions(with_some(spotless(), many, **wrong)) if s.rule == rule]
    assert found.frames == tuple(range(30, 30 + round(many * N)))
    assert f"frames 30 to {29 + round(many * N)}" in found.text


def test_a_sure_pose_off_the_surface_is_named_where_the_frame_beside_it_is_too():
    """One alone may be a blurred image; of doubted ones a run says so itself."""
    often = np.where(ROWS % 3 == 0, 0.3, 0.8)
    assert not suspicions(replace(spotless(), on_surface=often))
    for confidence, named in ((0.9, (30, 31, 32, 33)), (0.4, ())):
        bad = with_some(spotless(), 0.04, on_surface=0.3, confidence=confidence)
        also = replace(bad, on_surface=np.where(ROWS == 60, 0.3, bad.on_surface))
        assert [s.frames for s in suspicions(also)] == [named] * bool(named)


def test_maps_that_never_met():
    e = with_some(spotless(), 0.2, has_pose=False, elsewhere=True)
    assert {s.rule for s in suspicions(e)} == {"maps"}, "each frame speaks against it once"
    assert "maps" not in {s.rule for s in suspicions(with_some(spotless(), 0.04, has_pose=False, elsewhere=True))}


def gone(rows: np.ndarray) -> RunEvidence:
    e = spotless()
    return replace(e, has_pose=e.has_pose & ~rows, mask_px=np.where(rows, 0, e.mask_px))


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ((ROWS > 30) & (ROWS < 70), ""),
        ((ROWS > 30) & (ROWS < 90), "no mask and no pose (59 %): is it out of view?: frames 41 to 99"),
        (ROWS >= 85, ""),
        (ROWS >= 60, "not found again before the end: is it out of view?: frames 70 to 109"),
        (ROWS >= 0, "no pose in any frame: frames 10 to 109"),
    ],
)
def test_what_is_away_may_be_lost(rows, says):
    """Short absences are what an object is followed through; nothing tells a long one from a loss but looking."""
    assert [s.text for s in suspicions(gone(rows)) if s.rule == "absent"] == [says] * bool(says)


def test_a_length_does_not_read_as_the_limit_that_it_exceeds():
    full = np.ones(N)
    short = "spans 1.9 cm, shorter than 2 cm: is it a part of the object alone"
    for size_m, says in ((0.0196, ""), (0.01954, ""), (0.0194, short), (0.6004, "")):
        found = [s.text for s in suspicions(replace(spotless(), size_m=size_m * full)) if s.rule == "size"]
        assert len(found) == bool(says) and says in "".join(found), size_m


def test_how_it_started():
    found = suspicions(replace(spotless(), doubts=("clicks on 'cup': flat",), apart=0.4))
    assert [s.rule for s in found] == ["start", "start"] and "40 % of the first mask is apart" in found[1].text


def test_stretches_are_named_across_frames_that_do_not_count():
    """Silhouettes are looked at in some frames only: those between two that do not fit are named with them."""
    overlap = np.where(ROWS % 10 == 0, 0.9, np.nan)
    overlap[[20, 30, 40, 70]] = 0.1
    (found,) = suspicions(replace(spotless(), overlap=overlap))
    assert found.text.endswith("(in 40 % of the frames): frames 30 to 50, 80") and found.frames == (30, 40, 50, 80)


@pytest.mark.parametrize(("apart", "says"), [(4, " and 1 more stretch"), (5, " and 2 more stretches")])
def test_stretches_that_are_not_named_are_counted(apart, says):
    overlap = np.where(ROWS % 10 == 0, 0.9, np.nan)
    overlap[: 20 * apart : 20] = 0.1
    assert any(of.text.endswith(says) for of in suspicions(replace(spotless(), overlap=overlap)))


def test_the_worst_stretches_are_named_and_the_worst_first():
    on_surface = np.full(N, 0.9)
    for first, value in ((0, 0.55), (10, 0.4), (20, 0.55), (30, 0.1), (40, 0.3)):
        on_surface[first : first + 2] = value
    (found,) = suspicions(replace(spotless(), on_surface=on_surface))
    assert found.text.endswith(": frames 40 to 41, 50 to 51, 20 to 21 and 2 more stretches")
    where_all_are_named = np.where(ROWS < 25, on_surface, 0.9)
    (found,) = suspicions(replace(spotless(), on_surface=where_all_are_named))
    assert found.text.endswith(": frames 10 to 11, 20 to 21, 30 to 31")


def test_what_is_not_known_is_not_held_against_anybody():
    unknown = {f.name for f in fields(RunEvidence)} - {
        "frame_index",
        "has_pose",
        "elsewhere",
        "confidence",
        "moved",
        "cut",
        "doubts",
        "apart",
        "surface_m",
    }
    nothing = replace(spotless(), **{key: np.full(N, np.nan) for key in unknown})
    assert suspicions(nothing) == () and spotless().compared and not nothing.compared


def test_masks_as_long_as_the_surface_are_not_too_long():
    """Where most of the masks hold a part of the object, what is usual is no measure."""
    parts = with_some(spotless(), 0.4, size_m=0.28)
    assert {s.rule for s in suspicions(parts)} == {"grown"}
    assert not suspicions(replace(parts, surface_m=0.29))
    assert {s.rule for s in suspicions(replace(parts, surface_m=0.2))} == {"grown"}
    assert {s.rule for s in suspicions(replace(parts, surface_m=0.1))} == {"grown"}, "a surface may be a part, too"


def test_what_the_image_cuts_is_not_the_usual_length():
    """Most of a run shows half of it at the image's end: the frames before are not too long for that."""
    half = with_some(spotless(), 0.7, size_m=0.07)
    assert [s.rule for s in suspicions(half)] == ["grown"]
    assert not suspicions(replace(half, cut=half.size_m < 0.1))
    assert not suspicions(replace(half, cut=ROWS >= 0)), "of what is cut everywhere no length is usual"
