"""The mug of the paper's text as an experiment: what registration gets to see when a glossy mug has turned.

Between two pictures a real 2D tracker follows what it sees. Much of that is the room's mirror image on the
body, which stays where it is. Poses of the keyframes before are taken from the truth, so that only
registration is on trial.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.backends import make_detector, make_tracker
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.core.depth import depth_noise_m, lift
from p2p_lib.core.image import in_mask
from p2p_lib.core.types import Frame
from p2p_lib.method.refinement import Keypoints, refine, sample_cloud, surface_distances
from p2p_lib.method.registration import Hypothesis, competing, generate, select
from p2p_lib.method.sampling import choose, usable_region
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.synthetic.ablations import mug
from p2p_lib.synthetic.generate import photograph
from p2p_lib.synthetic.noise import Sensor
from p2p_lib.synthetic.render import render
from p2p_lib.synthetic.scene import FPS, Scenario


@dataclass(frozen=True, eq=False)
class Moment:
    """Correspondences (p_obj, p_cam) at one picture, and what else is known then.

    frame, mask      the later picture, and the mug's pixels in it
    uv_before_px     (N, 2) where the points were sampled, some frames ago; uv_px (N, 2) where the tracker has them
    p_obj, p_cam     (N, 3) in the map and as seen now; NaN where the tracker lost them or depth is missing
    off_m            (N,) how far each is from where it would be if it were on the mug
    right            (N,) bool: within three standard deviations of the depth noise of there
    cloud            (M, 3) dense masked depth points, camera frame
    surface          the volume fused from the keyframes before
    T_cam_obj        (4, 4) the truth now; T_before that of the picture in which the points were sampled
    vertices, faces  of the true model, for drawing
    """

    camera: Camera
    frame: Frame
    mask: np.ndarray
    uv_before_px: np.ndarray
    uv_px: np.ndarray
    p_obj: np.ndarray
    p_cam: np.ndarray
    off_m: np.ndarray
    right: np.ndarray
    cloud: np.ndarray
    surface: TsdfVolume
    T_cam_obj: np.ndarray
    T_before: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray

    @property
    def turned_deg(self) -> float:
        """How far the mug turned between the two pictures."""
        return float(np.degrees(se3.angle_rad(se3.inverse(self.T_before) @ self.T_cam_obj)))

    def error(self, T_cam_obj: np.ndarray) -> tuple[float, float]:
        """Degrees and millimetres between a pose and the truth."""
        apart = se3.inverse(self.T_cam_obj) @ T_cam_obj
        return float(np.degrees(se3.angle_rad(apart))), float(1e3 * np.linalg.norm(apart[:3, 3]))


def mug_moment(
    config: Config, seed: int = 0, frames: int = 16, every: int = 10, points: int = 90, marks: int = 2
) -> Moment:
    """Points sampled on ``synthetic/mug`` and tracked over so many frames, while the handle comes into view.

    The surface is fused from every ``every``-th frame before, the last one six frames ago: keyframes are ten
    degrees apart. ``marks`` is the number of small prints on the body that do turn with it.
    """
    scenario = mug(seed, marks=marks)
    rng = np.random.default_rng([seed, 7])
    poses = se3.inverse(scenario.T_world_cam) @ scenario.bodies[0].T_world_model
    now = _handle_in_view(poses, frames)
    sampled = now - frames
    room = render([(m, se3.IDENTITY) for m in scenario.room], scenario.camera, scenario.T_world_cam[0], scenario.light)
    keyframes = range(now - _KEYFRAME_AGO, max(now - 100, 0), -every)
    shots = {t: _shot(scenario, seed, t, room) for t in {*keyframes, *range(sampled, now + 1)}}
    surface = TsdfVolume(config.tsdf)
    for t in keyframes:
        frame, mask = shots[t]
        surface.integrate(frame.depth_m, frame.rgb, mask, scenario.camera, poses[t])
    first, first_mask = shots[sampled]
    region = usable_region(first, first_mask, config.sampling, config.depth.edge_m)
    found = make_detector("corners", config.sampling, rng).detect(first, region)
    uv_before = found.uv_px[choose(found, np.zeros((0, 2)), points, config.sampling)]
    uv = _tracked([shots[t][0] for t in range(sampled, now + 1)], uv_before, config, rng)
    frame, mask = shots[now]
    uv[~in_mask(uv, mask)] = np.nan
    p_first = lift(first, uv_before, scenario.camera, config.depth)
    p_cam = lift(frame, uv, scenario.camera, config.depth)
    p_obj = se3.transform(se3.inverse(poses[sampled]), p_first)
    off_m = np.linalg.norm(se3.transform(poses[now], p_obj) - p_cam, axis=1)
    right = off_m < 3 * depth_noise_m(p_cam[:, 2], config.depth)
    cloud = sample_cloud(frame.depth_m, mask, scenario.camera, config.refinement.max_points)
    mesh = scenario.bodies[0].mesh
    truth = poses[now], poses[sampled], mesh.vertices, mesh.faces
    return Moment(scenario.camera, frame, mask, uv_before, uv, p_obj, p_cam, off_m, right, cloud, surface, *truth)


@dataclass(frozen=True, eq=False)
class Decisions:
    """What each way to decide makes of one moment.

    hypotheses, scores_m  those with enough support, and their mean absolute TSDF value in metres
    refined, refined_scores_m  the poses after SDF refinement of each, and the same score
    chosen, reason        what the configured selection takes, and why
    poses                 way to decide to T_cam_obj (4, 4), refined only where it says so or by the configuration;
                          NaN where it finds none
    """

    hypotheses: list[Hypothesis]
    scores_m: np.ndarray
    refined: np.ndarray
    refined_scores_m: np.ndarray
    chosen: Hypothesis
    reason: str
    poses: dict[str, np.ndarray]


def decide(moment: Moment, config: Config, seed: int = 0) -> Decisions:
    """Ways to one pose on the same correspondences: one hypothesis, or several and the surface's word.

    The paper's least score, the least score after each hypothesis was refined, and what the configuration says.
    """
    cfg, rng = config.registration, np.random.default_rng([seed, 8])
    found = generate(moment.p_obj, moment.p_cam, cfg, rng)
    hypotheses = competing(found, cfg)
    single = generate(moment.p_obj, moment.p_cam, replace(cfg, multi_hypothesis=False), rng)
    T_raw = np.stack([h.T_cam_obj for h in hypotheses])
    T_refined = np.stack([_refined(moment, h, config) for h in hypotheses])
    raw_m, refined_m = (
        surface_distances(moment.surface, moment.cloud, T, cfg.unseen_share) for T in (T_raw, T_refined)
    )
    chosen, reason = select(hypotheses, refined_m if cfg.refine_all else raw_m, cfg)
    at = next(i for i, h in enumerate(hypotheses) if h is chosen)
    poses = {
        "SVD, outliers out, SVD": single[0].T_cam_obj if single else np.full((4, 4), np.nan),
        "RANSAC: most inliers": select(hypotheses, None, cfg)[0].T_cam_obj,
        "least score": T_raw[np.argmin(raw_m.mean(1))],
        "refine all, least score": T_refined[np.argmin(refined_m.mean(1))],
        "configured selection": T_refined[at],
    }
    return Decisions(hypotheses, raw_m.mean(1), T_refined, refined_m.mean(1), chosen, reason, poses)


def _refined(moment: Moment, hypothesis: Hypothesis, config: Config) -> np.ndarray:
    """The hypothesis after SDF refinement with its own inliers."""
    at = hypothesis.inliers
    keypoints = Keypoints(moment.p_obj[at], moment.p_cam[at], depth_noise_m(moment.p_cam[at, 2], config.depth))
    found = refine(hypothesis.T_cam_obj, moment.cloud, moment.surface, config.refinement, keypoints=keypoints)
    return found.T_cam_obj


def mug_trials(config: Config, seeds: Iterable[int], **moment: Any) -> list[dict[str, float]]:
    """A row per mug: how far it turned, the share of right tracks, and the rotation error of each way in degrees."""
    rows = []
    for seed in seeds:
        seen = mug_moment(config, seed, **moment)
        decided = decide(seen, config, seed)
        usable = np.isfinite(seen.off_m)
        best = min(seen.error(h.T_cam_obj)[0] for h in decided.hypotheses)
        row = {"mug": seed, "turned [°]": seen.turned_deg, "right tracks [%]": 100 * seen.right[usable].mean()}
        errors = {f"{way} [°]": seen.error(T)[0] for way, T in decided.poses.items()}
        rows.append({**row, **errors, "best hypothesis [°]": best})
    return rows


#: The newest keyframe that the surface holds is this many frames old.
_KEYFRAME_AGO = 6


def _handle_in_view(poses: np.ndarray, frames: int) -> int:
    """The frame, of those a whole history lies before, that ends the largest turn with the handle towards the camera.

    poses (T, 4, 4) T_cam_obj; the handle points along the mug's x axis. Between half in front and sideways, it
    stands clear of the body.
    """
    ends = np.arange(100, len(poses))
    turned = se3.angle_rad(se3.inverse(poses[ends - frames]) @ poses[ends])
    towards = -poses[:, 2, 0]
    shown = np.minimum(towards[ends], towards[ends - frames]) > 0.2
    return int(ends[np.argmax(np.where(shown, turned, -1))])


def _shot(scenario: Scenario, seed: int, t: int, room) -> tuple[Frame, np.ndarray]:
    """Frame and mask at time t, with the sensor's noise."""
    rgb, depth_m, exact = photograph(scenario, Sensor(), seed, t, room)
    return Frame(t, t / FPS, rgb, depth_m), exact.label == 1


def _tracked(frames: list[Frame], uv_px: np.ndarray, config: Config, rng: np.random.Generator) -> np.ndarray:
    """Where the embedded tracker has the points (N, 2) of the first frame in the last one; NaN where lost."""
    tracker = make_tracker("lk", config.tracking, rng)
    tracker.start(frames[0])
    ids = tracker.add(uv_px)
    for frame in frames[1:]:
        tracks = tracker.track(frame)
    tracks = tracks.select(ids)
    return np.where(tracks.visible[:, None], tracks.uv_px, np.nan)
