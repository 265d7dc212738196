"""Where SAM 2's image part helps the built-in segmenter: prompts, and now and then what it has followed.

The network knows what things look like and nothing of depth, of the object or of time: of what it offers the candidate
is taken that agrees with what is known, and none where none does. It is asked

- for the masks of prompts, wherever its weights are there: first masks, corrections
- with ``--masks sam2`` also for the masks of all objects, in every ``segmentation.sam2_every``-th frame, prompted by
  their keypoints and the middle of the mask that was followed, which its answer replaces

With ``sam2_every`` 0, and always in ``p2p live``, it works beside the tracking, as often as it is ready: its answer to
an earlier frame is carried to the newest one by the object's motion (:mod:`p2p_lib.segmenters.carried`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.image import in_mask, mask_iou, small_parts
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters import sam2_image
from p2p_lib.segmenters.carried import Moment, carried
from p2p_lib.segmenters.sam2_image import Features, MaskCandidates, Sam2Image

#: A followed object is prompted by so many of its keypoints, and so many pixels of the middle of its mask.
_KEYPOINTS, _MIDDLE = 3, 3
#: Weight of the overlap with the mask that is expected beside the network's own score and the mask's stability.
_OVERLAP = 0.5
#: What looks less like the object than this, see ``Features.look`` of :mod:`p2p_lib.segmenters.sam2_image`, is not it.
_ALIKE = 0.4
#: Looks of an object that are remembered, besides the first.
_LOOKS = 4
#: A candidate with less than this of the object's own points, or more of the others', is another thing.
_OWN, _OTHERS = 0.6, 0.34
#: An answer that overlaps less with what was followed, and of less score, is none.
_LEAST_OVERLAP, _LEAST_SCORE = 0.2, 0.5
#: Parts of a mask, and holes in it, of less than this share of it are flaws.
_FLAW = 0.02
#: Poses are known of frames after the one in question only; the pose of so many frames later is its pose.
_LATE = 3
_NO_PX = np.zeros((0, 2))
_NO_HINT = Hint()


def shared_network(threads: int, at_once: bool) -> Callable[[], Sam2Image]:
    """What gives the network, which is loaded once in a process.

    at_once  load it now, so that what is missing is said before anything is tracked; else when it is needed first
    """
    if at_once:
        _network(threads)
    return lambda: _network(threads)


@lru_cache(maxsize=1)
def _network(threads: int) -> Sam2Image:
    return sam2_image.load(threads)


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked of the network about one object in a frame.

    prompt     what it is told: clicks and a box
    own_px     (K, 2) pixels that are thought to be on the object, others_px (M, 2) on others
    expected   (H, W) bool: the newest answer as the object has moved since, or the mask that was followed; None where
               a prompt starts the object
    looks      (L, D) what the object has looked like; None where nobody knows
    """

    prompt: Prompt
    own_px: np.ndarray
    others_px: np.ndarray = field(default_factory=lambda: _NO_PX)
    expected: np.ndarray | None = None
    looks: np.ndarray | None = None

    @classmethod
    def of_prompt(cls, prompt: Prompt, found: np.ndarray, others_px: np.ndarray, mends: bool) -> Question:
        """Of a prompt and the mask (H, W) bool that the built-in segmenter made of it; ``mends`` one that was."""
        own_px = prompt.points_px
        if mends:  # a click on a part is not meant to select that part alone
            own_px = np.concatenate([own_px, _spread(_middle(found), _MIDDLE)])
        asked = replace(prompt, points_px=own_px) if len(own_px) else prompt
        return cls(asked, own_px, np.concatenate([prompt.negative_px, others_px]))

    @classmethod
    def of_followed(
        cls,
        name: str,
        expected: np.ndarray,
        hint: Hint,
        others_px: np.ndarray,
        looks: np.ndarray | None = None,
    ) -> Question | None:
        """Of an object's keypoints that agree, and the middle of its mask (H, W) bool, where these are at one."""
        keypoints_px = hint.uv_px
        inside = in_mask(keypoints_px, expected)
        if len(keypoints_px) and 2 * inside.sum() < len(keypoints_px):  # the mask is elsewhere
            expected, inside = np.zeros_like(expected), np.ones(len(keypoints_px), bool)
        own_px = np.concatenate([_spread(keypoints_px[inside], _KEYPOINTS), _spread(_middle(expected), _MIDDLE)])
        if not len(own_px):
            return None
        judges_px = np.concatenate([keypoints_px, own_px])
        prompt = Prompt(name, points_px=own_px)
        return cls(prompt, judges_px, others_px, expected if expected.any() else None, looks)

    def answer(self, offered: MaskCandidates, features: Features) -> np.ndarray | None:
        """(H, W) bool: the candidate that agrees best with what is known, nothing where what was expected is alien.

        None where none agrees and what was expected may be right.
        """
        masks, worth = offered.masks(), offered.score + offered.stability()
        own, others = _shares(self.own_px, masks, 1.0), _shares(self.others_px, masks, 0.0)
        fits = (own >= _OWN) & (others <= _OTHERS) & (offered.score >= _LEAST_SCORE)
        worth = worth + own - others
        if self.expected is not None:
            overlap = np.array([mask_iou(mask, self.expected) for mask in masks])
            fits, worth = fits & (overlap >= _LEAST_OVERLAP), worth + _OVERLAP * overlap
        if self.looks is not None:
            alike = np.array([self._alike(mask, features) for mask in masks])
            fits, worth = fits & (alike >= _ALIKE), worth + alike
        if fits.any():
            return _without_flaws(masks[np.where(fits, worth, -np.inf).argmax()])
        alien = self.expected is not None and self._alike(self.expected, features) < _ALIKE
        return np.zeros_like(self.expected) if alien else None

    def _alike(self, mask: np.ndarray, features: Features) -> float:
        """How much a mask's (H, W) bool inside looks like the object; 1 where nobody knows what that looks like."""
        return 1.0 if self.looks is None else float((self.looks @ features.look(mask)).max())


@dataclass(frozen=True, eq=False)
class _Answered:
    """What the network has said of an object.

    newest  the newest frame with an answer, and the object's pose and mask (H, W) bool there; the pose is None until
            somebody knows it
    looks   (L, D) of its first mask and of the newest ones
    """

    newest: Moment
    looks: np.ndarray

    def now(
        self, frame: Frame, T_cam_obj: np.ndarray | None, followed: np.ndarray, camera: Camera
    ) -> np.ndarray | None:
        """(H, W) bool: the newest mask in this frame; None where a pose is not known, or it is not seen again."""
        return carried(self.newest, Moment(frame, T_cam_obj, followed), camera)


@dataclass(frozen=True, eq=False)
class _Answer:
    """A mask (H, W) bool of a frame, and what it looks like there."""

    mask: np.ndarray
    look: np.ndarray


class Sam2Refiner:
    """Mends the masks of a segmenter in some frames.

    network     gives the network when it is needed first
    every       followed objects are asked for in every so many frames; None: never, only what prompts say is
    background  it works beside the tracking, and followed objects are asked for whenever it is ready; only for the
                first frame, before which nothing is followed, it is waited for
    """

    def __init__(
        self,
        network: Callable[[], Sam2Image],
        camera: Camera,
        config: SegmentationConfig,
        every: int | None = None,
        background: bool = False,
    ):
        self.name = "builtin+sam2" if every is None else "sam2"
        self._network, self._camera, self._config, self._every = network, camera, config, every
        self._executor = ThreadPoolExecutor(1, "sam2") if background else None
        self._working: _Working | None = None
        self._answered: dict[str, _Answered] = {}
        self._frames = 0

    def refine(
        self,
        frame: Frame,
        prompts: Mapping[str, Prompt],
        found: Mapping[str, np.ndarray],
        hints: Mapping[str, Hint],
        mended: Collection[str] = (),
    ) -> dict[str, np.ndarray]:
        """Better masks (H, W) bool of some of the objects in this frame.

        prompts  those of this frame that are no masks
        found    every object that the segmenter located, to its mask (H, W) bool, which may be empty
        mended   the objects whose masks the prompts mend
        """
        executor = self._executor if self._frames else None  # the first image waits
        due = self._every is not None and (executor is not None or self._frames % self._every == 0)
        self._frames += 1
        if any(name in self._answered for name in prompts):
            self._working = None  # what is thought of it is wrong, as the answer to come may be
        self._place(frame, hints)
        arrived = self._arrived(frame, found, hints)
        if self._working is None and (questions := self._questions(frame, prompts, found, hints, mended, due)):
            T_cam_obj = {name: hints.get(name, _NO_HINT).T_cam_obj for name in questions}
            if executor is None:
                answers = _answers(self._network, frame, questions)
                self._keep(frame, answers, T_cam_obj)
                return {name: answer.mask for name, answer in answers.items()}
            self._working = _Working(frame, executor.submit(_answers, self._network, frame, questions), T_cam_obj)
        return arrived

    def _place(self, frame: Frame, hints: Mapping[str, Hint]) -> None:
        """Of a frame in which no pose was known, as of an object's first, the pose of few frames later is its pose."""
        for name, of in self._answered.items():
            if of.newest.T_cam_obj is None and frame.index - of.newest.frame.index <= _LATE and name in hints:
                self._answered[name] = replace(of, newest=replace(of.newest, T_cam_obj=hints[name].T_cam_obj))
        if self._working is not None and frame.index - self._working.frame.index <= _LATE:
            poses = self._working.T_cam_obj
            poses |= {name: hints[name].T_cam_obj for name, T in poses.items() if T is None and name in hints}

    def _questions(
        self,
        frame: Frame,
        prompts: Mapping[str, Prompt],
        found: Mapping[str, np.ndarray],
        hints: Mapping[str, Hint],
        mended: Collection[str],
        followed: bool,
    ) -> dict[str, Question]:
        """By object; of the ``followed`` ones too, or of those with prompts alone."""
        questions: dict[str, Question | None] = {}
        names = [name for name in found if name in prompts or followed]
        known_px = {name: _known_px(name, prompts, found, hints) for name in found} if names else {}
        for name in names:
            others_px = np.concatenate([_NO_PX, *(px for other, px in known_px.items() if other != name)])
            if name in prompts:
                questions[name] = Question.of_prompt(prompts[name], found[name], others_px, name in mended)
                self._answered.pop(name, None)  # what was thought of it was wrong
                continue
            hint, known = hints.get(name, _NO_HINT), self._answered.get(name)
            if not found[name].any() and len(hint.uv_px) < self._config.find_points:
                continue
            moved = None if known is None else known.now(frame, hint.T_cam_obj, found[name], self._camera)
            expected, looks = found[name] if moved is None else moved, None if known is None else known.looks
            questions[name] = Question.of_followed(name, expected, hint, others_px, looks)
        return {name: question for name, question in questions.items() if question is not None}

    def _keep(self, frame: Frame, answers: Mapping[str, _Answer], T_cam_obj: Mapping[str, np.ndarray | None]) -> None:
        """Remember what was answered about a frame, and the objects' poses there."""
        for name, answer in answers.items():
            if answer.mask.any():
                known = self._answered.get(name)
                looks = np.empty((0, len(answer.look))) if known is None else known.looks
                looks = np.concatenate([looks[:1], looks[1:][1 - _LOOKS :], answer.look[None]])
                self._answered[name] = _Answered(Moment(frame, T_cam_obj[name], answer.mask), looks)

    def _arrived(
        self, frame: Frame, found: Mapping[str, np.ndarray], hints: Mapping[str, Hint]
    ) -> dict[str, np.ndarray]:
        """Answers to an earlier frame, if they have come, as they look in this one."""
        working = self._working
        if working is None or not working.answers.done():
            return {}
        self._working, answers = None, working.answers.result()
        self._keep(working.frame, answers, working.T_cam_obj)
        moved = {
            name: self._answered[name].now(frame, hints.get(name, _NO_HINT).T_cam_obj, found[name], self._camera)
            for name, answer in answers.items()
            if name in found and answer.mask.any()
        }
        return {name: mask for name, mask in moved.items() if mask is not None}


@dataclass(frozen=True, eq=False)
class _Working:
    """What the network works at beside the tracking, and the objects' poses T_cam_obj (4, 4) in that frame."""

    frame: Frame
    answers: Future[dict[str, _Answer]]
    T_cam_obj: dict[str, np.ndarray | None]


def _answers(network: Callable[[], Sam2Image], frame: Frame, questions: Mapping[str, Question]) -> dict[str, _Answer]:
    """By object, of those of which one candidate fits; the image is encoded once for all."""
    sam2 = network()
    features, answers = sam2.features(frame.rgb), {}
    for name, question in questions.items():
        mask = question.answer(sam2.candidates(features, question.prompt), features)
        if mask is not None:
            answers[name] = _Answer(mask, features.look(mask))
    return answers


def _known_px(
    name: str, prompts: Mapping[str, Prompt], found: Mapping[str, np.ndarray], hints: Mapping[str, Hint]
) -> np.ndarray:
    """(K, 2) pixels that are another object's for sure: clicks on it, or keypoints that agree and its mask holds."""
    if name in prompts:
        return prompts[name].points_px
    uv_px = hints.get(name, _NO_HINT).uv_px
    return uv_px[in_mask(uv_px, found[name])]


def _middle(mask: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of a mask (H, W) bool that are at least half as far from its edge as the farthest."""
    if not mask.any():
        return _NO_PX
    inner = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    v, u = np.nonzero(inner >= inner.max() / 2)
    return np.stack([u, v], -1).astype(float)


def _spread(uv_px: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of the pixels (N, 2): the one in their middle, then each the farthest from those before."""
    if len(uv_px) <= count:
        return uv_px
    chosen = [np.linalg.norm(uv_px - np.median(uv_px, 0), axis=1).argmin()]
    apart = np.linalg.norm(uv_px - uv_px[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(apart.argmax())
        apart = np.minimum(apart, np.linalg.norm(uv_px - uv_px[chosen[-1]], axis=1))
    return uv_px[chosen]


def _shares(uv_px: np.ndarray, masks: Iterable[np.ndarray], none: float) -> np.ndarray:
    """(C,) the share of the pixels (N, 2) in each mask; ``none`` where there are no pixels."""
    return np.array([in_mask(uv_px, mask).mean() if len(uv_px) else none for mask in masks])


def _without_flaws(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) bool without its small parts and holes."""
    flaw = _FLAW * np.count_nonzero(mask)
    for region in (True, False):
        part, small = small_parts(mask == region, flaw)
        mask = np.where(small[part], not region, mask)
    return mask
