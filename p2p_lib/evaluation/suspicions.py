"""What makes a run suspect without any truth: a few rules, each of which counts frames (``p2p eval``, ``p2p run``).

A rule says which frames of an object speak against it, and among which frames; when their share is above the rule's
limit, somebody has to look. The limits separate runs that were measured, good ones and bad ones: see
``benchmarks/verdicts.md``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from p2p_lib.core.mask_length import GROWN
from p2p_lib.core.types import DOUBTED, median_of_known
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX

#: Fewer keypoints in a frame neither carry a pose nor say where the object is.
FEW = 5
#: What is tracked is held or stands on a table: hardly longer, nor shorter, than this, m.
LONGEST_M, SHORTEST_M = 0.6, 0.02
#: A pose that puts keypoints so far from where they are seen, or moves them so much otherwise than they move, px.
OFF_PX, JUMP_PX = 3.0, 12.0
#: A silhouette that overlaps less with the mask does not fit; a surface is seen through where so much of it is, and is
#: elsewhere where depth lies on less of it.
OVERLAP, THROUGH, ON_SURFACE = 0.5, 0.1, 0.6
#: Parts of a first mask that are apart, the smaller one this share of it.
APART = 0.1
#: Away for good is so much of the end of a run, at least so many frames; away too long, so much of all.
_GONE_FRAMES, _GONE_SHARE, _AWAY_SHARE = 30, 0.1, 0.5
#: So few frames may be chance, however short the run; of two in a row, one pair is none.
_CHANCE = 2
#: Stretches of frames that are named, the worst first.
_NAMED = 3


@dataclass(frozen=True, eq=False)
class RunEvidence:
    """What speaks for and against one object in the n frames of a run; NaN where nothing is known.

    frame_index   (n,)
    has_pose      (n,) bool, in the map that is kept; elsewhere (n,) bool: a pose, in a map that was given up
    confidence    (n,)
    mask_px       (n,) pixels of the mask that served, size_m (n,) the length of what it holds
    cut           (n,) bool: the image ends where the mask does
    keypoints     (n,) how many of the object's own were seen, inside (n,) the share of them in its mask
    off_px        (n,) median distance of these from where the pose puts them
    jump_px       (n,) how differently from what was seen the poses moved them since the frame before
    overlap       (n,) of silhouette and mask, through (n,) the share of the surface behind which depth was measured
    on_surface    (n,) the share of the surface on which it was measured
    moved         (n,) bool: by an offline pass, more than three sigmas from the causal pose
    doubts        what was doubted when the run was made, in words
    apart         the share of the first mask that is apart from its largest part
    surface_m     the length of the surface
    """

    frame_index: np.ndarray
    has_pose: np.ndarray
    elsewhere: np.ndarray
    confidence: np.ndarray
    mask_px: np.ndarray
    size_m: np.ndarray
    cut: np.ndarray
    keypoints: np.ndarray
    inside: np.ndarray
    off_px: np.ndarray
    jump_px: np.ndarray
    overlap: np.ndarray
    through: np.ndarray
    on_surface: np.ndarray
    moved: np.ndarray
    doubts: tuple[str, ...] = ()
    apart: float = 0.0
    surface_m: float = float("nan")

    @property
    def seen(self) -> np.ndarray:
        """(n,) bool: the mask is large enough to count."""
        return np.nan_to_num(self.mask_px) >= MIN_VISIBLE_PX

    @property
    def usual_m(self) -> float:
        """The length of what masks hold that the image does not cut; NaN where it cuts all.

        Where the surface is longer, most of the masks hold a part of the object alone, and its length counts.
        """
        return float(np.fmax(median_of_known(self.size_m[self.seen & ~self.cut]), self.surface_m))

    @property
    def carried(self) -> np.ndarray:
        """(n,) bool: seen, and with a pose."""
        return self.seen & self.has_pose

    @property
    def compared(self) -> bool:
        """Whether any pose was compared with what the camera saw: without, nothing speaks against it, nor for it."""
        return any(np.isfinite(of).any() for of in (self.off_px, self.overlap, self.on_surface))


@dataclass(frozen=True)
class Suspicion:
    """Why somebody should look at an object: a rule's name, a line for people, and the frames that it counted."""

    rule: str
    text: str
    frames: tuple[int, ...] = ()


@dataclass(frozen=True)
class _Rule:
    """Frames ``against`` an object, among those that ``count``: too many are more than ``limit`` (a share).

    worse  how bad each frame is, to name the worst
    row    of those that count so many in a row have to be against it
    """

    name: str
    text: str
    limit: float
    against: Callable[[RunEvidence], np.ndarray]
    count: Callable[[RunEvidence], np.ndarray]
    worse: Callable[[RunEvidence], np.ndarray] = lambda e: np.ones(len(e.frame_index))
    row: int = 1


def _known(key: str) -> Callable[[RunEvidence], np.ndarray]:
    return lambda e: np.isfinite(getattr(e, key))


_RULES = (
    _Rule("lost", "a mask, but no pose", 0.1, lambda e: ~(e.has_pose | e.elsewhere), lambda e: e.seen),
    _Rule("doubted", f"confidence at most {DOUBTED:g}", 0.5, lambda e: e.confidence <= DOUBTED, lambda e: e.has_pose),
    _Rule(
        "maps",
        "poses in a second map that was never merged",
        0.05,
        lambda e: e.elsewhere,
        lambda e: e.has_pose | e.elsewhere,
    ),
    _Rule(
        "no keypoints",
        f"a mask and a pose, but fewer than {FEW} visible keypoints",
        0.3,
        lambda e: e.keypoints < FEW,
        lambda e: e.carried & np.isfinite(e.keypoints),
    ),
    _Rule(
        "outside",
        "most keypoints lie outside the mask",
        0.05,
        lambda e: e.inside < 0.5,
        lambda e: e.seen & np.isfinite(e.inside) & (e.keypoints >= FEW),
    ),
    _Rule(
        "keypoints off",
        f"median reprojection error of the keypoints above {OFF_PX:g} px",
        0.25,
        lambda e: e.off_px > OFF_PX,
        _known("off_px"),
        lambda e: e.off_px,
    ),
    _Rule(
        "jumps",
        "the pose jumps, the keypoints do not",
        0.02,
        lambda e: e.jump_px > JUMP_PX,
        _known("jump_px"),
        lambda e: e.jump_px,
    ),
    _Rule(
        "silhouette",
        f"silhouette and mask overlap by less than {OVERLAP:g} (IoU)",
        0.2,
        lambda e: e.overlap < OVERLAP,
        _known("overlap"),
        lambda e: 1 - e.overlap,
    ),
    _Rule(
        "seen through",
        "depth shows empty space where the surface should be",
        0.5,
        lambda e: e.through > THROUGH,
        _known("through"),
        lambda e: e.through,
    ),
    _Rule(
        "off the surface",
        f"a sure pose, and depth lies on less than {100 * ON_SURFACE:.0f} % of the surface in view",
        0.0,
        lambda e: e.on_surface < ON_SURFACE,
        lambda e: (e.confidence > DOUBTED) & np.isfinite(e.on_surface),
        lambda e: ON_SURFACE - e.on_surface,
        row=2,
    ),
    _Rule(
        "moved",
        "the offline pass moved the pose far, to where it does not fit",
        0.05,
        lambda e: e.moved & (e.confidence <= DOUBTED),
        lambda e: e.has_pose,
    ),
    _Rule(
        "grown",
        f"the mask spans more than {GROWN:g} times the object's usual length",
        0.05,
        lambda e: e.size_m > GROWN * e.usual_m,
        lambda e: e.seen & np.isfinite(e.size_m),
        lambda e: e.size_m,
    ),
)


def suspicions(e: RunEvidence) -> tuple[Suspicion, ...]:
    """Everything that speaks against an object's part of a run; none: nothing that a run keeps does."""
    found = [Suspicion("start", text) for text in e.doubts]
    if e.apart > APART:
        found.append(Suspicion("start", f"{100 * e.apart:.0f} % of the first mask is apart: two objects?"))
    found += [s for s in (_absent(e), _size(e)) if s is not None]
    for rule in _RULES:
        count = rule.count(e)
        wrong = _in_a_row(count & rule.against(e), count, rule.row)
        if wrong.sum() > max(rule.limit * count.sum(), _CHANCE // rule.row):
            share = f"in {100 * wrong.sum() / count.sum():.0f} % of the frames"
            found.append(_suspicion(rule.name, f"{rule.text} ({share})", e, wrong, count, rule.worse(e)))
    return tuple(found)


def _absent(e: RunEvidence) -> Suspicion | None:
    """Away at the end, or for most of the run: a run cannot tell what is out of view from what it does not find."""
    if not e.has_pose.any():
        return _suspicion("absent", "no pose in any frame", e, ~e.has_pose)
    away = ~e.seen & ~e.has_pose
    back = np.flatnonzero(~away)[-1] + 1
    last = np.arange(len(away)) >= back
    if last.sum() > max(_GONE_FRAMES, _GONE_SHARE * len(away)):
        return _suspicion("absent", "not found again before the end: is it out of view?", e, last)
    if away.mean() > _AWAY_SHARE:
        return _suspicion("absent", f"no mask and no pose ({100 * away.mean():.0f} %): is it out of view?", e, away)
    return None


def _size(e: RunEvidence) -> Suspicion | None:
    known = e.seen & np.isfinite(e.size_m)
    # To the millimetre, as it is said: what reads as a limit is within it.
    size_m = round(median_of_known(e.size_m[known]), 3)
    if not known.any() or SHORTEST_M <= size_m <= LONGEST_M:
        return None
    long = f"longer than {100 * LONGEST_M:g} cm: does it hold other things"
    short = f"shorter than {100 * SHORTEST_M:g} cm: is it a part of the object alone"
    than = long if size_m > LONGEST_M else short
    text = f"the mask spans {100 * size_m:.4g} cm, {than}, or is the depth unit wrong?"
    return _suspicion("size", text, e, known & ((e.size_m > LONGEST_M) | (e.size_m < SHORTEST_M)), known)


def _suspicion(
    rule: str,
    text: str,
    e: RunEvidence,
    wrong: np.ndarray,
    count: np.ndarray | None = None,
    worse: np.ndarray | None = None,
) -> Suspicion:
    """One of frames ``wrong`` (n,) bool; those between two of them that do not ``count`` are named with them.

    worse  (n,) how bad each is: where not all stretches are named, these are the worst, and the worst comes first
    """
    ends = _stretches(wrong, np.ones(len(wrong), bool) if count is None else count)
    if len(ends) > _NAMED:
        bad = wrong.astype(float) if worse is None else np.where(wrong, worse, 0)
        ends.sort(key=lambda end: -bad[end[0] : end[1] + 1].sum())
    of = [tuple(e.frame_index[list(end)].tolist()) for end in ends[:_NAMED]]
    named = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in of)
    left = len(ends) - _NAMED
    more = f" and {left} more stretch{'es' * (left > 1)}" if left > 0 else ""
    return Suspicion(rule, f"{text}: frames {named}{more}", tuple(e.frame_index[wrong].tolist()))


def _stretches(wrong: np.ndarray, count: np.ndarray) -> list[tuple[int, int]]:
    """The first and the last row of each stretch of ``wrong`` (n,) bool among those that ``count`` (n,) bool."""
    at = np.flatnonzero(count)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wrong[at], [False]]).astype(int)))
    return [(int(at[a]), int(at[b - 1])) for a, b in edges.reshape(-1, 2)]


def _in_a_row(wrong: np.ndarray, count: np.ndarray, least: int) -> np.ndarray:
    """(n,) bool: those ``wrong`` of which at least so many that ``count`` follow each other."""
    kept = np.zeros(len(wrong), bool)
    for first, last in _stretches(wrong, count):
        kept[first : last + 1] = wrong[first : last + 1].sum() >= least
    return kept & wrong
