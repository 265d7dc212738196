"""SuperPoint (DeTone et al., 2018), the paper's detector, through the maintained class of ``transformers``.

The weights are Magic Leap's: for academic and other non-commercial use only. Last run with transformers 5.23.0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.image import bounds, in_mask
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Frame
from p2p_lib.datasets import checkpoints

if TYPE_CHECKING:
    import torch

# The network works in cells of this size; a crop that starts between them would see other features.
_CELL_PX = 8
# Around the mask: what a keypoint depends on, 45 px in the network and some more for its suppressed neighbours.
_MARGIN_PX = 64


def load(config: SamplingConfig, rng: np.random.Generator | None = None) -> SuperPointDetector:
    """The detector with its checkpoint; :class:`MissingBackend` says what to fetch or install."""
    folder = checkpoints.checked_files("superpoint")[0].parent
    packages.load("torch", "superpoint", "transformers")
    module = packages.load("transformers", "superpoint", "transformers")
    # safetensors hold tensors and nothing else; local_files_only: nothing is downloaded here.
    model = module.SuperPointForKeypointDetection.from_pretrained(folder, local_files_only=True, use_safetensors=True)
    return SuperPointDetector(model, config, checkpoints.device())


class SuperPointDetector:
    """Keypoints in the mask with the network's confidence as score. Implements ``Detector``."""

    name = "superpoint"

    def __init__(self, model: torch.nn.Module, config: SamplingConfig, device: str = "cpu"):
        self._model, self._device, self._limit = model.to(device).eval(), device, config.candidates

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Keypoints in the mask, best first, looked for around it alone."""
        import torch

        if not mask.any():
            return Candidates(np.zeros((0, 2)), np.zeros(0))
        rows, columns = bounds(mask, _MARGIN_PX)
        x0, y0 = (span.start // _CELL_PX * _CELL_PX for span in (columns, rows))
        crop = frame.rgb[y0 : rows.stop, x0 : columns.stop]
        gray = torch.from_numpy(cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)).to(self._device).float() / 255
        with torch.inference_mode():
            found = self._model(pixel_values=gray.expand(1, 3, *gray.shape))
        kept = found.mask[0].bool()
        # The class gives indices of pixels over the size of the image.
        uv_px = found.keypoints[0][kept].double().cpu().numpy() * gray.shape[::-1] + [x0, y0]
        score = found.scores[0][kept].double().cpu().numpy()
        inside = np.flatnonzero(in_mask(uv_px, mask))
        best = inside[np.argsort(-score[inside], kind="stable")][: self._limit]
        return Candidates(uv_px[best], np.clip(score[best], 0, 1))
