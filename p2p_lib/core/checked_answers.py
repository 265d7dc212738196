"""What a detector and a segmenter promise (:mod:`p2p_lib.core.interfaces`), checked as they answer."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.image import in_image, in_mask
from p2p_lib.core.interfaces import Candidates, Detector, Hint, Segmenter, Wrapper
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame

#: Where no more of a detector's points than this share are inside the mask that it was given, it has swapped something.
_INSIDE = 0.5


class CheckedDetector(Wrapper):
    """A detector whose answers are checked: :class:`BadInput` names it, the frame, and what cannot be used.

    Implements :class:`~p2p_lib.core.interfaces.Detector`; whatever else the detector has is reached through it.
    """

    def __init__(self, detector: Detector):
        self.name, self.original = detector.name, detector

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Candidates in ``mask`` (H, W) bool, best first."""
        found = self.original.detect(frame, mask)
        check_candidates(self.original, frame, mask, found)
        return found


def check_candidates(detector: Detector, frame: Frame, mask: np.ndarray, found: Candidates) -> None:
    """Refuse candidates (N,) that are none, are nowhere, or lie outside the mask (H, W) bool that was asked about."""
    bad = partial(bad_answer, "detector", detector, frame.index, "detect()")
    if not isinstance(found, Candidates):
        raise bad(kind_of(found), "Candidates(uv_px, score)")
    uv_px, score = found.uv_px, found.score
    shapes = (2, 1) if all(isinstance(a, np.ndarray) and a.dtype.kind in "fiu" for a in (uv_px, score)) else ()
    if (getattr(uv_px, "ndim", 0), getattr(score, "ndim", 0)) != shapes or uv_px.shape != (len(score), 2):
        got = f"uv_px {kind_of(uv_px)}, score {kind_of(score)}"
        raise bad(got, "NumPy arrays of numbers: uv_px (N, 2), score (N,)")
    if not len(score):
        return
    outside = ~(in_image(uv_px, mask.shape, -0.5) & np.isfinite(score))
    if outside.any():
        got = f"{outside.sum()} of {len(outside)} points outside the image, one at {uv_px[outside][0].tolist()}"
        raise bad(got, f"pixels (u, v) of {mask.shape[1]}x{mask.shape[0]}")
    if (inside := in_mask(uv_px, mask)).mean() <= _INSIDE:
        got = f"{len(inside) - inside.sum()} of {len(inside)} points outside the mask"
        fix = "A pixel is (u, v), the column first."
        raise bad(got, "points inside the mask that it was given", fix)


def labelled(segmenter: Segmenter, frame: Frame, prompts: Collection[Prompt], hints: Mapping[str, Hint]) -> np.ndarray:
    """The label image (H, W) of the next frame, checked (:class:`~p2p_lib.core.interfaces.Segmenter`)."""
    labels = segmenter.segment(frame, prompts, hints)
    check_labels(segmenter, frame, prompts, labels)
    return labels


def check_labels(segmenter: Segmenter, frame: Frame, prompts: Iterable[Prompt], labels: np.ndarray) -> None:
    """Refuse what is no label image of the frame, and one that leaves out an object which a prompt has started."""
    bad = partial(bad_answer, "segmenter", segmenter, frame.index, "segment()")
    wanted, names = f"a NumPy array {frame.shape} of whole numbers", segmenter.names
    fix = "0 is no object, 1 the first of its names, and so on."
    if not isinstance(labels, np.ndarray) or labels.dtype.kind not in "iu" or labels.shape != frame.shape:
        raise bad(kind_of(labels), wanted, fix)
    if lacking := [prompt.name for prompt in prompts if prompt.starts and prompt.name not in names]:
        got, expected = f"names {tuple(names)}", f"{lacking[0]!r} among them, which a prompt has started"
        raise bad(got, expected)
    least, most = int(labels.min()), int(labels.max())
    if least < 0 or most > len(names):
        got, expected = f"label {least if least < 0 else most}", f"0 to {len(names)}"
        raise bad(got, expected, fix)


def kind_of(value: object) -> str:
    """What came in the place of an array."""
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def bad_answer(kind: str, part: Any, frame: int, call: str, got: str, expected: str, fix: str = "") -> BadInput:
    """What names a part of a kind, the frame (-1: before the first) and the call that answered wrongly."""
    at = f", frame {frame}" if frame >= 0 else ""
    return BadInput(f"{kind} {part.name!r} ({type(part).__name__}){at}: {call}", got, expected, fix)
