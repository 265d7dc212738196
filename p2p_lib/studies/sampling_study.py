"""What a choice of points is worth: how it covers the object, how firmly it holds the pose, how well it is tracked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.backends import make_detector, make_tracker
from p2p_lib.core.config import Config, SamplingConfig, preset
from p2p_lib.core.depth import depth_noise_m, lift
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import Sequence as Video
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.method import registration
from p2p_lib.method.registration import Hypothesis
from p2p_lib.method.sampling import Terms, choose, distance_px, terms, usable_region

#: Ways to choose: detector and settings. The last three leave out the objective or one of its terms.
CHOICES: dict[str, tuple[str, dict[str, Any]]] = {
    "J": ("corners", {}),
    "J without spread": ("corners", {"sampling.score_weight": 1.0}),
    "J without score": ("corners", {"sampling.score_weight": 0.0}),
    "score alone": (
        "corners",
        {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0},
    ),
    "uniform": ("uniform", {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0}),
    "farthest": ("farthest", {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0}),
}
_DENSE = 400  # points of the visible surface that a pose's error is felt at


@dataclass(frozen=True, eq=False)
class Situation:
    """One object in one frame, before any point is chosen: where points may lie, and its visible surface.

    mask    (H, W) bool; usable, those pixels of it where a point can be lifted
    """

    video: Video
    name: str
    frame: Frame
    mask: np.ndarray
    usable: np.ndarray
    config: Config

    @classmethod
    def of(cls, video: Video, name: str, index: int, settings: Mapping[str, Any] | None = None) -> Situation:
        """The object ``name`` in frame ``index``, with the default parameters and ``settings``."""
        config, frame = preset().with_values(dict(settings or {})), video.frame(index)
        mask = (video.masks(index) or {})[name]
        return cls(video, name, frame, mask, usable_region(frame, mask, config.depth.edge_m), config)

    def candidates(self, detector: str = "corners", seed: int = 0) -> Candidates:
        """What a detector offers here, as far as it can be lifted."""
        found = make_detector(detector, self.config.sampling, np.random.default_rng(seed))
        offered = found.detect(self.frame, self.usable)
        return offered.select(np.isfinite(self.lift(offered.uv_px)[:, 0]))

    def lift(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 3) in the camera frame, NaN where depth is missing."""
        return lift(self.frame, uv_px, self.video.camera, self.config.depth)


def greedy_terms(candidates: Candidates, chosen: np.ndarray, stored_px: np.ndarray, config: SamplingConfig) -> Terms:
    """The terms (K,) of each choice at the moment it was taken."""
    before = [np.concatenate([stored_px, candidates.uv_px[chosen[:k]]]) for k in range(len(chosen))]
    d = [distance_px(candidates.uv_px[[i]], points)[0] for i, points in zip(chosen, before, strict=True)]
    return terms(candidates.score[chosen], np.array(d), config)


def coverage(mask: np.ndarray, uv_px: np.ndarray, within_px: float) -> float:
    """Share of a mask's pixels that have a chosen point within so many pixels."""
    v, u = np.nonzero(mask)
    return float((distance_px(np.stack([u, v], 1).astype(float), uv_px) <= within_px).mean())


def conditioning(p_cam: np.ndarray, surface_cam: np.ndarray, config: Config) -> tuple[float, float]:
    """How firmly points p_cam (N, 3) hold a pose, by the covariance that the pipeline states of a registration.

    Returns the standard deviation about the least certain axis in degrees, and the error in metres (root mean
    square) that the covariance implies at the points of the visible surface (M, 3).
    """
    T_cam_obj = se3.from_rt(np.eye(3), surface_cam.mean(0))
    p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
    hypothesis = Hypothesis(T_cam_obj, np.ones(len(p_cam), bool), np.zeros(len(p_cam)), "truth")
    sigma = registration.covariance(hypothesis, p_obj, p_cam, depth_noise_m(p_cam[:, 2], config.depth))
    at = se3.transform(se3.inverse(T_cam_obj), surface_cam)
    moved = np.concatenate([-se3.hat(at), np.broadcast_to(np.eye(3), (len(at), 3, 3))], -1)
    error_m = np.sqrt(np.einsum("nki,ij,nkj->n", moved, sigma, moved).mean())
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(sigma[:3, :3]).max()))), float(error_m)


@dataclass(frozen=True, eq=False)
class ChoiceScore:
    """One choice of points in one situation.

    uv_px     (K, 2)
    coverage  share of the mask within r_ideal of a point
    turn_deg  standard deviation about the least certain axis; error_m what it means at the surface
    kept      share of the points in sight some frames later that the 2D tracker has within 2 px
    """

    label: str
    uv_px: np.ndarray
    coverage: float
    turn_deg: float
    error_m: float
    kept: float


def compare_choices(
    situations: Sequence[Situation],
    choices: Mapping[str, tuple[str, Mapping[str, Any]]] = CHOICES,
    tracker: str = "builtin",
    frames_on: int = 20,
    seed: int = 0,
) -> list[ChoiceScore]:
    """Every way to choose in every situation; ``frames_on`` is how long the points are then tracked, 0 for not."""
    return [
        _score_choice(situation, label, *choice, follow, seed)
        for situation in situations
        for follow in [_Following(situation, tracker, frames_on, seed)]
        for label, choice in choices.items()
    ]


def _score_choice(
    at: Situation, label: str, detector: str, settings: Mapping[str, Any], follow: _Following, seed: int
) -> ChoiceScore:
    sampling = at.config.with_values(dict(settings)).sampling
    candidates = at.candidates(detector, seed)
    uv_px = candidates.uv_px[choose(candidates, np.zeros((0, 2)), sampling.points, sampling)]
    v, u = np.nonzero(at.usable)
    every = max(len(u) // _DENSE, 1)
    surface = at.video.camera.unproject(np.stack([u, v], 1)[::every].astype(float), at.frame.depth_m[v, u][::every])
    turn_deg, error_m = conditioning(at.lift(uv_px), surface, at.config)
    covered = coverage(at.mask, uv_px, at.config.sampling.r_ideal_px)
    return ChoiceScore(label, uv_px, covered, turn_deg, error_m, follow.kept(uv_px))


class _Following:
    """The frames after a situation, read once, through which each choice of points is tracked."""

    def __init__(self, at: Situation, tracker: str, frames_on: int, seed: int):
        self._at, self._tracker, self._seed = at, tracker, seed
        indices = range(at.frame.index + 1, at.frame.index + frames_on + 1)
        self._frames = [(at.video.frame(i), (at.video.masks(i) or {}).get(at.name)) for i in indices]
        self._scene = TrueScene.of(at.video) if frames_on else None

    def kept(self, uv_px: np.ndarray) -> float:
        """Share of the points truly in sight in the last frame that the tracker has within 2 px; NaN if none is."""
        if self._scene is None:
            return float("nan")
        at = self._at
        points = self._scene.lift(at.frame, np.full(len(uv_px), self._scene.objects.index(at.name)), uv_px)
        follower = make_tracker(self._tracker, at.config.tracking, np.random.default_rng(self._seed))
        follower.start(at.frame)
        follower.add(uv_px)
        for frame, mask in self._frames:
            tracks = follower.track(frame, mask)
        sight = self._scene.see(frame, points)
        near = tracks.visible & (np.linalg.norm(tracks.uv_px - sight.uv_px, axis=1) < 2)
        return float(near[sight.visible].mean()) if sight.visible.any() else float("nan")


def open_views(video: Video, count: int, frames_on: int, min_px: int = 2000) -> list[Situation]:
    """``count`` situations per object, spread over the frames in which it is well in sight for ``frames_on`` more."""
    looked = range(0, len(video) - frames_on, 5)
    sizes = {i: {name: int(mask.sum()) for name, mask in (video.masks(i) or {}).items()} for i in looked}
    found = []
    for name in video.truth:
        clear = [i for i in looked if sizes[i].get(name, 0) >= min_px and sizes.get(i + frames_on, sizes[i])[name] > 0]
        rows = np.linspace(0, len(clear) - 1, min(count, len(clear))).astype(int)
        found += [Situation.of(video, name, clear[row]) for row in rows]
    return found
