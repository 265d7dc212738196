"""CoTracker3 online (Karaev et al., ICCV 2025), through torch.hub. Code and weights: CC BY-NC, not for commercial use.

The model looks at windows of 16 images, 8 of them new, so an answer comes up to 7 frames late. A rollout
begins with 8 copies of its first image, so that the first window is full after 8 real ones. Last run with co-tracker
3.0 at 82e02e8 (January 2025).
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.config import TrackingConfig
from p2p_lib.datasets import checkpoints
from p2p_lib.trackers.rollouts import RolloutTracker

if TYPE_CHECKING:
    import torch

# The predictor's own: steps of refinement, and the product of visibility and confidence that counts as visible.
_ITERATIONS, _VISIBLE = 6, 0.6


def load(config: TrackingConfig, rng: np.random.Generator | None = None) -> RolloutTracker:
    """The tracker with its checkpoint; :class:`MissingBackend` says what to fetch or install."""
    weights = checkpoints.load_weights("cotracker3")
    predictor = new_predictor()
    checkpoints.fill(predictor.model, "cotracker3", weights)
    return tracker(predictor, checkpoints.device())


def new_predictor() -> Any:
    """The official predictor with random weights, from torch.hub's folder or an installed package; never downloads."""
    import torch

    folder = packages.cotracker_folder()
    if folder is not None:
        return torch.hub.load(str(folder), "cotracker3_online", source="local", pretrained=False)
    module = packages.load("cotracker.predictor", "cotracker3", "co-tracker")
    return module.CoTrackerOnlinePredictor(checkpoint=None, window_len=16)


def tracker(predictor: Any, device: str = "cpu") -> RolloutTracker:
    """A tracker that runs the predictor's model."""
    predictor.model.to(device).eval()
    return RolloutTracker("cotracker3", partial(CoTrackerRollout, predictor, device), predictor.step - 1)


class CoTrackerRollout:
    """The model's sliding window with a fixed set of queries. It keeps its state in the model: swapped in and out."""

    def __init__(self, predictor: Any, device: str, images: list[np.ndarray], uv_px: np.ndarray):
        import torch

        self._model, self._device = predictor.model, device
        self._size, self._fresh = tuple(predictor.interp_shape), predictor.step
        h, w = images[0].shape[:2]
        self._scale = (np.array(self._size[::-1]) - 1) / [w - 1, h - 1]  # the model's pixels per pixel
        queries = np.concatenate([np.zeros((len(uv_px), 1)), uv_px * self._scale], 1).astype(np.float32)
        self._queries = torch.from_numpy(queries).to(device)[None]
        self._images = deque([self._resized(images[0])] * self._fresh, maxlen=self._model.window_len)
        self._taken = 0  # real images so far
        self._state: dict = {}
        for rgb in images:
            self._take(rgb)

    def step(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (Q, 2) in pixels, visible (Q,), uncertainty (Q,) of the frame answered, NaN before the first."""
        self._take(rgb)
        answered = self._taken - self._fresh
        if answered < 0:
            q = self._queries.shape[1]
            return np.full((q, 2), np.nan), np.zeros(q, bool), np.ones(q)
        xy, visible, confidence = (answer[answered - self._first] for answer in self._answers)
        return xy / self._scale, visible * confidence > _VISIBLE, 1 - confidence

    def _take(self, rgb: np.ndarray) -> None:
        self._images.append(self._resized(rgb))
        self._taken += 1
        if self._taken % self._fresh == 0:
            self._run_window()

    def _resized(self, rgb: np.ndarray) -> torch.Tensor:
        """(3, h, w) float32 in [0, 255]; the corners' pixel centres stay in the corners."""
        import torch

        image = torch.from_numpy(rgb).to(self._device).permute(2, 0, 1)[None].float()
        return torch.nn.functional.interpolate(image, self._size, mode="bilinear", align_corners=True)[0]

    def _run_window(self) -> None:
        """One window over the newest images; of what the model predicts the window's part is kept."""
        import torch

        model, window = self._model, self._model.window_len
        with torch.inference_mode():
            model.init_video_online_processing()
            vars(model).update(self._state)
            video = torch.stack(list(self._images))[None]
            answer = model(video=video, queries=self._queries, iters=_ITERATIONS, is_online=True)[:3]
        self._state = {key: value for key, value in vars(model).items() if key.startswith("online_")}
        self._answers = tuple(part[0, -window:].double().cpu().numpy() for part in answer)
        self._first = self._taken - window  # the frame, counted from the queries', that its first row is of
