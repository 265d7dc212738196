"""SuperPoint (DeTone et al., 2018), the paper's detector, with the official weights.

The weights are Magic Leap's: for academic and other non-commercial use only. The half of the network that finds
keypoints is written from the publication (section 3 and appendix A); descriptors are not needed. It gives the
probabilities of the class of ``transformers``.
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
# A keypoint is the most probable within this distance, and so far from the border. None is too improbable: a small
# object has few, and the sampler weighs their scores.
_APART_PX, _BORDER_PX = 4, 4
#: Layers in order: name, channels in and out, width of the kernel. A pooling follows 1b, 2b and 3b, a ReLU all but Pb.
_LAYERS = (
    ("1a", 1, 64, 3), ("1b", 64, 64, 3), ("2a", 64, 64, 3), ("2b", 64, 64, 3), ("3a", 64, 128, 3),
    ("3b", 128, 128, 3), ("4a", 128, 128, 3), ("4b", 128, 128, 3), ("Pa", 128, 256, 3), ("Pb", 256, 65, 1),
)  # fmt: skip


def load(config: SamplingConfig, rng: np.random.Generator | None = None) -> SuperPointDetector:
    """The detector with its checkpoint; :class:`MissingBackend` says what to fetch or install."""
    weights = checkpoints.load_weights("superpoint")
    packages.load("torch", "superpoint", "torch")
    net = network()
    kept = {name: value for name, value in weights.items() if not name.startswith("convD")}  # the descriptors'
    checkpoints.fill(net, "superpoint", kept)
    return SuperPointDetector(net, config, checkpoints.device())


def network() -> torch.nn.ModuleDict:
    """The layers, under the names of the official checkpoint."""
    from torch import nn

    return nn.ModuleDict({f"conv{name}": nn.Conv2d(i, o, k, padding=k // 2) for name, i, o, k in _LAYERS})


def probabilities(net: torch.nn.ModuleDict, gray: torch.Tensor) -> torch.Tensor:
    """(H, W) of every pixel being a keypoint, of an image (H, W) in 0..1; both sides are cut to whole cells."""
    from torch.nn import functional as f

    x = gray[None, None]
    for name, layer in net.items():
        x = layer(x) if name == "convPb" else f.relu(layer(x))
        x = f.max_pool2d(x, 2) if name in ("conv1b", "conv2b", "conv3b") else x
    # Of the 65 classes of a cell 64 are its pixels, and the last is that none is a keypoint.
    return f.pixel_shuffle(x.softmax(1)[:, :-1], _CELL_PX)[0, 0]


class SuperPointDetector:
    """Keypoints in the mask with the network's probability as score. Implements ``Detector``."""

    name = "superpoint"

    def __init__(self, net: torch.nn.ModuleDict, config: SamplingConfig, device: str = "cpu"):
        self._net, self._device, self._limit = net.to(device).eval(), device, config.candidates

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
            likely = probabilities(self._net, gray)
            best = torch.nn.functional.max_pool2d(likely[None], 2 * _APART_PX + 1, 1, _APART_PX)[0]
            found = torch.nonzero((likely == best) & (likely > 0)).cpu().numpy()
            score = likely.cpu().numpy()
        uv_px = found[:, ::-1] + [x0, y0]
        size = np.array(mask.shape[::-1])
        inside = in_mask(uv_px, mask) & ((uv_px >= _BORDER_PX) & (uv_px < size - _BORDER_PX)).all(1)
        uv_px, at = uv_px[inside], score[found[inside, 0], found[inside, 1]]
        order = np.argsort(-at, kind="stable")[: self._limit]
        return Candidates(uv_px[order].astype(float), at[order].astype(float))
