"""The image part of SAM 2 (Ravi et al., ICLR 2025, Hiera tiny) by onnxruntime: no torch, no GPU, no memory.

An encoder turns an image into features, which are most of the work (2.4 s on two cores); a decoder turns these and what
is said of one object into three candidates of its mask (0.06 s). Code and weights: Apache-2.0. Which candidate is the
object is decided elsewhere (:mod:`p2p_lib.segmenters.sam2`). Last run with onnxruntime 1.32.0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.errors import BadInput, in_a_line
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.raster import to_raster
from p2p_lib.datasets import checkpoints

CHECKPOINT, PACKAGE = "sam2", "onnxruntime"
#: Sides of the images that the encoder takes, and of the decoder's masks.
SIDE, MASK_SIDE = 1024, 256
#: ImageNet's mean and deviation, by which colours in [0, 1] are scaled.
_MEAN, _DEVIATION = np.array([(0.485, 0.456, 0.406), (0.229, 0.224, 0.225)], np.float32)
#: What a point says, as the network numbers it: it is on the object, beside it, a corner of the box around it.
_ON, _BESIDE, _CORNERS = 1, 0, [2, 3]


class Session(Protocol):
    """What is asked of an ``onnxruntime.InferenceSession``."""

    def get_outputs(self) -> Sequence[Any]:
        """Its outputs, each with a ``name``."""

    def run(self, output_names: Sequence[str] | None, input_feed: Mapping[str, np.ndarray]) -> Sequence[Any]:
        """The outputs for these inputs."""


@dataclass(frozen=True, eq=False)
class Features:
    """What the encoder made of an image of ``shape`` (H, W): arrays by the decoder's names for them."""

    arrays: dict[str, np.ndarray]
    shape: tuple[int, int]

    def look(self, mask: np.ndarray) -> np.ndarray:
        """(D,) unit vector: what a mask (H, W) bool holds, by how its mean features differ from the image's.

        The dot product of two of them is in [-1, 1]: 0.85 in the middle for views of one object, 0.45 for two objects.
        """
        parts = []
        for of in self.arrays.values():
            size = of.shape[:1:-1]
            weight = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA).ravel()
            flat = of[0].reshape(of.shape[1], -1)
            part = flat @ weight / max(weight.sum(), 1e-6) - flat.mean(1)
            parts.append(part / max(np.linalg.norm(part), 1e-6))
        return np.concatenate(parts) / np.sqrt(len(parts))


@dataclass(frozen=True, eq=False)
class MaskCandidates:
    """What the decoder offers for one object in an image of ``shape`` (H, W).

    logits  (C, 256, 256) float32: a pixel of the image, scaled to that square, is the object's where they are positive
    score   (C,) the IoU with the object's true mask that the network expects
    """

    logits: np.ndarray
    score: np.ndarray
    shape: tuple[int, int]

    def masks(self) -> np.ndarray:
        """(C, H, W) bool."""
        size = self.shape[::-1]
        return np.stack([cv2.resize(of, size, interpolation=cv2.INTER_LINEAR) > 0 for of in self.logits])

    def stability(self) -> np.ndarray:
        """(C,) in [0, 1]: the share of its pixels that a mask keeps whether it is drawn widely or narrowly.

        Widely is where the logits are above -1, narrowly where they are above 1.
        """
        narrow, wide = (np.count_nonzero(self.logits > level, axis=(1, 2)) for level in (1, -1))
        return narrow / np.maximum(wide, 1)


class Sam2Image:
    """The two networks, each as an onnxruntime session."""

    def __init__(self, encoder: Session, decoder: Session):
        self._encoder, self._decoder = encoder, decoder
        self._names = [output.name for output in encoder.get_outputs()]
        self._newest: tuple[bytes, Features] | None = None  # of somebody who clicks, every click is on one image

    def features(self, rgb: np.ndarray) -> Features:
        """Of an image (H, W, 3) uint8; those of the image before are kept."""
        rgb = np.ascontiguousarray(rgb)
        image, newest = hashlib.blake2b(rgb.data).digest() + str(rgb.shape).encode(), self._newest
        if newest is None or newest[0] != image:
            newest = self._newest = image, self._encoded(rgb)
        return newest[1]

    def _encoded(self, rgb: np.ndarray) -> Features:
        shape = rgb.shape[:2]
        how = cv2.INTER_AREA if max(shape) > SIDE else cv2.INTER_LINEAR
        image = cv2.resize(rgb, (SIDE, SIDE), interpolation=how).astype(np.float32) / 255
        image = np.ascontiguousarray(((image - _MEAN) / _DEVIATION).transpose(2, 0, 1)[None])
        return Features(dict(zip(self._names, self._encoder.run(None, {"image": image}))), shape)

    def candidates(self, features: Features, prompt: Prompt) -> MaskCandidates:
        """What a prompt's clicks and box, of which there is one at least, make of an image."""
        corners = np.zeros((0, 2)) if prompt.box_px is None else prompt.box_px.reshape(2, 2)
        at = np.concatenate([corners, prompt.points_px, prompt.negative_px])
        kinds = _CORNERS[: len(corners)] + [_ON] * len(prompt.points_px) + [_BESIDE] * len(prompt.negative_px)
        inputs = {
            "point_coords": to_raster(at, features.shape, SIDE).astype(np.float32)[None],
            "point_labels": np.array(kinds, np.float32)[None],
            "mask_input": np.zeros((1, 1, MASK_SIDE, MASK_SIDE), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
        }
        logits, score = self._decoder.run(None, features.arrays | inputs)
        return MaskCandidates(logits[0], score[0], features.shape)


def load(threads: int = 0) -> Sam2Image:
    """The network with its weights; :class:`MissingBackend` says what to fetch or install.

    threads  that a session may use; 0: as many as there are cores
    """
    onnxruntime = packages.load("onnxruntime", CHECKPOINT, PACKAGE)
    encoder, decoder = checkpoints.checked_files(CHECKPOINT)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 3
    try:
        return Sam2Image(
            *(
                onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
                for path in (encoder, decoder)
            )
        )
    except Exception as error:  # its errors have no class of their own
        fix = "Install a newer onnxruntime."
        raise BadInput(CHECKPOINT, in_a_line(error), "networks that onnxruntime can run", fix) from error
