"""Online BootsTAPIR (Doersch et al., ACCV 2024), the paper's tracker, through the official package ``tapnet``.

Causal, frame by frame. Every query is a feature that is compared with the whole image, so a point is found
again wherever it returns. Code and weights: Apache-2.0. Last run with tapnet 0.1.0 at c2cbab8 (July 2026).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.image import in_image
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.raster import from_raster, square, to_raster
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.datasets import checkpoints
from p2p_lib.trackers.ids import PointIds

if TYPE_CHECKING:
    import torch

#: Side of the square that images are scaled to, and the visibility threshold (the paper's, both).
SIZE_PX, VISIBLE = 480, 0.5
# Queries whose cost volumes are held at once.
_CHUNK = 64


def load(config: TrackingConfig, rng: np.random.Generator | None = None) -> TapirTracker:
    """The tracker with its checkpoint; :class:`MissingBackend` says what to fetch or install."""
    weights = checkpoints.load_weights("tapir")
    model = new_model()
    checkpoints.fill(model, "tapir", weights)
    return TapirTracker(model, checkpoints.device(), resolutions=config.tapir_resolutions)


def new_model() -> Any:
    """The official class as the online checkpoint wants it, with random weights."""
    module = packages.load("tapnet.torch.tapir_model", "tapir", "tapnet")
    return module.TAPIR(pyramid_level=1, use_casual_conv=True)


class TapirTracker(PointTracker):
    """Streams images through a TAPIR model, which searches every frame anew: rejections and suggestions are ignored.

    resolutions  ``mean``: averaged over the model's resolutions, as its own forward does; ``last``: the finest alone

    Visible where (1 - occluded)(1 - expected to be far off) exceeds a half; the uncertainty is the second of these.
    """

    name = "tapir"
    latency_frames = 0

    def __init__(self, model: Any, device: str = "cpu", size_px: int = SIZE_PX, resolutions: str = "mean"):
        self._model, self._device, self._size = model.to(device).eval(), device, size_px
        self._last_alone = resolutions == "last"
        self._ids = PointIds()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._ids.start()
        self._features: Any = None  # of the queries
        self._state: list[dict[str, torch.Tensor]] = []
        self._observe(frame)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids. They begin with an empty memory."""
        import torch

        uv = np.asarray(uv_px, float).reshape(-1, 2)
        ids = self._ids.add(len(uv))
        if not len(ids):
            return ids
        xy = to_raster(uv, self._shape, self._size)
        tyx = np.concatenate([np.zeros((len(uv), 1)), xy[:, ::-1]], 1).astype(np.float32)
        with torch.inference_mode():
            new = self._model.get_query_features(
                self._video,
                is_training=False,
                query_points=torch.from_numpy(tyx).to(self._device)[None],
                feature_grids=self._grids,
            )
            state = self._model.construct_initial_causal_state(len(uv), len(new.resolutions) - 1)
            state = [{key: value.to(self._device) for key, value in part.items()} for part in state]
            if self._features is not None:
                new = self._each(self._features, lambda a, b: torch.cat([a, b], 1), new)
                state = [
                    {key: torch.cat([old[key], part[key]], 1) for key in part}
                    for old, part in zip(self._state, state, strict=True)
                ]
        self._features, self._state = new, state
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; it always searches the whole image."""
        import torch

        self._ids.check_started()
        self._observe(frame)
        if not len(self._ids.live):
            return self._ids.unseen()
        with torch.inference_mode():
            out = self._model.estimate_trajectories(
                (self._size, self._size),
                is_training=False,
                feature_grids=self._grids,
                query_features=self._features,
                query_points_in_video=None,
                query_chunk_size=_CHUNK,
                causal_context=self._state,
                get_causal_context=True,
            )
            self._state = out["causal_context"]
            # The last iteration at each resolution, or that of the last resolution.
            pips = self._model.num_pips_iter
            last = slice(-1, None) if self._last_alone else slice(pips, None, pips)
            xy, occluded, far = (
                torch.stack(out[key][last]).mean(0)[0, :, 0] for key in ("tracks", "occlusion", "expected_dist")
            )
            far = torch.sigmoid(far)
            visible = (1 - torch.sigmoid(occluded)) * (1 - far) > VISIBLE
        uv = from_raster(xy.double().cpu().numpy(), self._shape, self._size)
        visible = visible.cpu().numpy() & in_image(uv, self._shape, -0.5)
        return Tracks(self._ids.live.copy(), uv, visible, far.double().cpu().numpy())

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        import torch

        keep = self._ids.drop(ids)
        if keep.all():
            return
        rows = torch.from_numpy(np.flatnonzero(keep)).to(self._device)
        self._features = self._each(self._features, lambda a: a[:, rows])
        self._state = [{key: value[:, rows] for key, value in part.items()} for part in self._state]

    def _observe(self, frame: Frame) -> None:
        import torch

        self._shape = frame.shape
        self._video = square(frame.rgb, self._size, self._device)
        with torch.inference_mode():
            self._grids = self._model.get_feature_grids(self._video, is_training=False)

    @staticmethod
    def _each(features: Any, function: Any, *others: Any) -> Any:
        """Query features with a function applied to each tensor (and its counterparts in the others)."""
        return features._replace(
            lowres=tuple(map(function, features.lowres, *(o.lowres for o in others))),
            hires=tuple(map(function, features.hires, *(o.hires for o in others))),
        )
