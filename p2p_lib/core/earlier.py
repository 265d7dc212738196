"""What prompts select in their frame, and whether it holds for a later one: where nothing has moved in and about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np

from p2p_lib.core.backends import DEFAULT_SEGMENTER, make_segmenter
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth_edges import depth_step_m
from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame

#: A colour that is so much another, of 255, is no noise; what has moved differs in so large a share of its colours, or
#: of its depths. By these a mask is refused from where 0.92 of it is still right on, and always below 0.88.
_OTHER_COLOUR, _COLOURS, _DEPTHS = 25, 0.3, 0.2
#: A correction is judged by what is so near its clicks, pixels.
_NEAR_PX = 8


def selected(
    frame: Frame,
    prompts: Iterable[Prompt],
    camera: Camera,
    config: SegmentationConfig,
    was: Mapping[str, np.ndarray] | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Each object's mask (H, W) bool, as the built-in segmenter cuts it out of one frame, and what it doubts of them.

    was  objects' masks (H, W) bool in that frame, which the prompts correct
    """
    prompts, was = list(prompts), was or {}
    segmenter = make_segmenter(DEFAULT_SEGMENTER, camera, config)
    if known := [Prompt(p.name, p.frame, mask=was[p.name]) for p in prompts if p.name in was and p.mask is None]:
        segmenter.segment(frame, known)
    labels = segmenter.segment(frame, prompts)
    masks = {name: labels == label for label, name in enumerate(segmenter.names, 1)}
    return masks, getattr(segmenter, "doubts", {})


def with_mask(prompt: Prompt, made: Mapping[str, np.ndarray]) -> Prompt:
    """The prompt as the mask (H, W) bool that was ``made`` of it, if any; :class:`BadInput` where that is nothing."""
    if prompt.mask is not None or prompt.name not in made:
        return prompt
    if not made[prompt.name].any():
        fix = "Click on another place of it."
        raise BadInput(f"prompt of {prompt.name!r}", "nothing found there", "an object", fix)
    return Prompt(prompt.name, prompt.frame, mask=made[prompt.name])


def check_still(prompt: Prompt, then: Frame, now: Frame) -> None:
    """Refuse a prompt of an earlier frame where something has moved since."""
    if then.index > now.index:
        got, fix = f"frame {then.index}, which is newer", "Give the frame that they were made on, once it was tracked."
        raise BadInput(f"prompt of {prompt.name!r}: frame", got, f"one before frame {now.index}", fix)
    if has_moved(prompt, then, now):
        who, got = f"prompt of {prompt.name!r} in frame {then.index}", f"pixels that have changed by frame {now.index}"
        raise BadInput(who, got, "what stands still meanwhile", "Click again on a newer image.")


def has_moved(prompt: Prompt, then: Frame, now: Frame) -> bool:
    """Whether what is in and about the mask of a prompt of an earlier frame, or near its clicks, is no longer there."""
    mask = _near(prompt, then.shape) if prompt.mask is None else prompt.mask
    before, after = (cv2.blur(frame.rgb, (5, 5)).astype(int) for frame in (then, now))
    other = np.abs(before - after).max(-1)[cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0]
    both = mask & (then.depth_m > 0) & (now.depth_m > 0)
    off = np.abs(then.depth_m - now.depth_m)[both] > depth_step_m(then.depth_m[both])
    return bool((other > _OTHER_COLOUR).sum() > _COLOURS * other.size or off.sum() > _DEPTHS * off.size)


def _near(prompt: Prompt, shape: Sequence[int]) -> np.ndarray:
    """(H, W) bool: the pixels that a prompt without a mask is about."""
    region = np.zeros(shape, np.uint8)
    for u, v in np.concatenate([prompt.points_px, prompt.negative_px]).round().astype(int).tolist():
        cv2.circle(region, (u, v), _NEAR_PX, 1, -1)
    if prompt.box_px is not None:
        left, top, right, bottom = prompt.box_px.round().astype(int).clip(0).tolist()
        region[top : bottom + 1, left : right + 1] = 1
    return region > 0
