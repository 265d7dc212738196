"""TAPNext++ (arXiv:2604.10582): a recurrent tracker of points as tokens, through the official package ``tapnet``.

Causal, frame by frame; its state takes no further queries. Its points see each other, so each query has company, as in
the authors' submission to VOTSp2026: points around it that are followed with it and not reported. Code and weights:
Apache-2.0. Last run with tapnet 0.1.0 at c2cbab8 (July 2026).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.raster import from_raster, square, to_raster
from p2p_lib.datasets import checkpoints
from p2p_lib.trackers.rollouts import RolloutTracker

if TYPE_CHECKING:
    import torch

#: Side of the square that images are scaled to; coordinates have one bin per pixel of it.
SIZE_PX = 256
#: Points around each query: a grid of so many to a side, which reaches this far from it, in pixels of the raster.
SUPPORT_SIDE, SUPPORT_REACH_PX = 8, SIZE_PX / 16
# The uncertainty is the probability that the model puts farther off than this, in pixels of its raster.
_NEAR_PX = 8


def load(config: TrackingConfig, rng: np.random.Generator | None = None) -> RolloutTracker:
    """The tracker with its checkpoint; :class:`MissingBackend` says what to fetch or install."""
    weights = checkpoints.load_weights("tapnextpp")
    model = new_model()
    # The trainer's prefix, where the checkpoint still has it.
    checkpoints.fill(model, "tapnextpp", {key.removeprefix("tapnext."): value for key, value in weights.items()})
    return tracker(model, checkpoints.device())


def new_model() -> torch.nn.Module:
    """The official class for 256 x 256 pixels, with random weights."""
    packages.load("torchvision", "tapnextpp", "torchvision")
    module = packages.load("tapnet.tapnext.tapnext_torch", "tapnextpp", "tapnet")
    return module.TAPNext(image_size=(SIZE_PX, SIZE_PX))


def tracker(model: torch.nn.Module, device: str = "cpu") -> RolloutTracker:
    """A tracker that runs a TAPNext model."""
    return RolloutTracker("tapnextpp", partial(TapNextRollout, model.to(device).eval(), device), latency_frames=0)


class TapNextRollout:
    """The model's recurrent state with a fixed set of queries in the only image: it is never late."""

    def __init__(self, model: torch.nn.Module, device: str, images: list[np.ndarray], uv_px: np.ndarray):
        import torch

        self._model, self._device, (rgb,) = model, device, images
        xy = to_raster(uv_px, rgb.shape[:2], SIZE_PX)
        self._count = len(xy)
        xy = np.concatenate([xy, support_points(xy)])
        tyx = np.concatenate([np.zeros((len(xy), 1)), xy[:, ::-1]], 1).astype(np.float32)
        self._state = self._forward(rgb, query_points=torch.from_numpy(tyx).to(device)[None])[-1]

    def step(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (Q, 2) in pixels, visible (Q,), uncertainty (Q,) in the next image."""
        yx, logits, visible, self._state = self._forward(rgb, state=self._state)
        yx, logits, visible = (part[0, 0, : self._count].double() for part in (yx, logits, visible))
        confidence = _mass_near(yx[:, 0], logits[:, :SIZE_PX]) * _mass_near(yx[:, 1], logits[:, SIZE_PX:])
        uv = from_raster(yx.flip(-1).cpu().numpy(), rgb.shape[:2], SIZE_PX)
        return uv, (visible[:, 0] > 0).cpu().numpy(), 1 - confidence.cpu().numpy()

    def _forward(self, rgb: np.ndarray, **given: Any) -> tuple:
        import torch

        with torch.inference_mode():
            return self._model(video=square(rgb, SIZE_PX, self._device), **given)


def support_points(xy: np.ndarray) -> np.ndarray:
    """Points (64 Q, 2) of the raster around queries (Q, 2) of it; none lies farther out than the outermost pixels."""
    cells = (np.arange(SUPPORT_SIDE) + 0.5) / SUPPORT_SIDE
    offsets = SUPPORT_REACH_PX * (2 * np.stack(np.meshgrid(cells, cells), -1).reshape(-1, 2) - 1)
    return np.clip(xy[:, None] + offsets, 0.5, SIZE_PX - 0.5).reshape(-1, 2)


def _mass_near(at: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
    """Probability (Q,) of the bins (Q, B) whose centre is near a coordinate (Q,)."""
    import torch

    centre = torch.arange(logits.shape[1], device=logits.device) + 0.5
    return (torch.softmax(logits, 1) * ((centre - at[:, None]).abs() <= _NEAR_PX)).sum(1)
