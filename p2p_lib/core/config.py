"""Every parameter of the method, one frozen dataclass per stage, and the two presets.

``paper`` does what the paper's text says; where the text is silent it takes the authors' released
value. ``default`` is whatever measures best here. ``p2p_lib.core.config.diff("paper", "default")``
shows how they differ. Presets choose parameters, never backends: the tracker, the detector and the
source of masks are chosen by name elsewhere.

Each field's metadata says its symbol or meaning, its unit, and whose value it is:
``paper`` (its text), ``release`` (the authors' released configuration) or ``ours``.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import tomllib
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from p2p_lib.core.errors import BadInput, MissingData


def _p(default: Any, meaning: str, unit: str = "", source: str = "ours", **bounds: float) -> Any:
    """A field with its meaning; ``low``/``high`` bound it (inclusive), ``choices`` lists strings."""
    return field(default=default, metadata={"meaning": meaning, "unit": unit, "source": source, **bounds})


def _section(stage: type) -> str:
    """The key of a stage's table: ``KeypointMapConfig`` is ``keypoint_map``."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", stage.__name__.removesuffix("Config")).lower()


_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


class _Checked:
    """Refuses values of another type or out of bounds when made."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value, meta = getattr(self, f.name), f.metadata
            name = f"config {_section(type(self))}.{f.name}"
            kind = type(f.default)
            if kind is float and type(value) is int:
                object.__setattr__(self, f.name, float(value))
            elif type(value) is not kind:
                raise BadInput(name, f"{value!r} ({type(value).__name__})", f"{_KINDS[kind]}: {meta['meaning']}")
            if "choices" in meta and value not in meta["choices"]:
                raise BadInput(name, repr(value), "one of " + ", ".join(meta["choices"]))
            if kind in (int, float) and not meta.get("low", float("-inf")) <= value <= meta.get("high", float("inf")):
                bounds = f"{meta.get('low', '-inf')} to {meta.get('high', 'inf')} {meta['unit']}".strip()
                raise BadInput(name, value, f"a value in {bounds}: {meta['meaning']}")


@dataclass(frozen=True)
class PipelineConfig(_Checked):
    """Of a frame as a whole: what is used of it, and when a pose stands."""

    object_frame: str = _p(
        "centroid",
        "where the object frame starts: at the camera (paper, T_cam_obj = I) or at the first masked cloud's centroid",
        choices=("camera", "centroid"),
    )
    min_mask_px: int = _p(100, "smaller masks count as hidden", "px", "release", low=1)
    recovered_frames: int = _p(5, "frames after a return that are marked recovered", "frames", low=0)
    start_growth: float = _p(
        1.1, "an object whose mask grows by more than this factor a frame is not started yet; 0 = at once", low=0
    )
    seek_inliers: int = _p(
        3, "agreeing points of a tentative pose by which hidden keypoints are looked for; 0 = never", "points", low=0
    )
    seek_below: int = _p(25, "fewer seen keypoints are joined by those that a tentative pose shows", "points", low=0)
    seek_depth_m: float = _p(0.015, "a keypoint farther from the depth measured there is hidden", "m", low=1e-4)
    recover_min_inliers: int = _p(8, "agreeing points that a return after hiding or loss needs", "points", low=3)
    recover_min_share: float = _p(
        0.3, "share of the depth points that must lie on the surface for it (of new sides nothing does)", low=0, high=1
    )
    max_jump_m: float = _p(0.08, "a larger move between frames needs as many points as a return", "m", "release", low=0)
    max_jump_deg: float = _p(25.0, "a larger turn between frames does too", "deg", "release", low=0)
    carry_frames: int = _p(60, "frames in a row that the surface may carry without registered points", "frames", low=0)
    carry_min_share: float = _p(0.6, "share of the depth points on the surface that it needs for that", low=0, high=1)
    degraded_inliers: int = _p(8, "a pose from fewer agreeing points is degraded", "points", low=3)


@dataclass(frozen=True)
class DepthConfig(_Checked):
    """Of measured depth: which of it is used, and how noisy it is."""

    min_m: float = _p(0.1, "nearer depth is invalid", "m", "release", low=0)
    max_m: float = _p(2.5, "farther depth is invalid", "m", low=0.1)
    edge_m: float = _p(0.01, "a larger depth step in the 3x3 neighbourhood is an edge", "m", "release", low=0)
    noise_m: float = _p(0.001, "standard deviation of depth at range 0", "m", low=1e-6)
    noise_per_m2: float = _p(0.0025, "its growth with the range squared", "1/m", low=0)


@dataclass(frozen=True)
class TrackingConfig(_Checked):
    """Of the built-in tracker, but for ``forget_after``, which all trackers keep."""

    forget_after: int = _p(
        0, "SH(n): points are dropped after this many invisible frames; 0 means never.", "frames", low=0
    )
    window_px: int = _p(13, "Side of the Lucas-Kanade window.", "px", low=5, high=63)
    templates: int = _p(5, "Templates kept of a point's appearance.", low=2, high=20)
    update_every: int = _p(3, "Templates, segments and landmarks are updated every so many frames.", "frames", low=1)
    update_scale_change: float = _p(
        1.35, "A new template is taken when the best one appears scaled by this factor or more.", low=1.01
    )
    update_ncc: float = _p(
        0.85, "A new template is taken when the correlation with the best one is lower.", low=0, high=1
    )
    min_ncc: float = _p(0.7, "A followed point keeps at least this correlation with its template.", low=0, high=1)
    return_ncc: float = _p(0.8, "A point that was invisible returns with at least this one.", low=0, high=1)
    max_colour_change: float = _p(12.0, "A larger difference of chroma (CIELAB) means another point.", low=0)
    max_contrast_change: float = _p(2.5, "A larger ratio of contrasts means another point.", low=1)
    search_px: float = _p(8.0, "A point is searched for no farther from its prediction than this.", "px", low=0.5)
    coast_frames: int = _p(
        8, "Lucas-Kanade alone carries a point whose appearance changed for at most so many frames.", "frames", low=0
    )
    forward_backward_px: float = _p(
        0.7, "Lucas-Kanade forward and backward may differ by this much for such a point.", "px", low=0.05
    )
    linger_frames: int = _p(
        5, "A point or segment that was lost is searched for where it was for so many frames.", "frames", low=0
    )
    depth_jump_m: float = _p(
        0.02, "Depth that differs more from a point's prediction belongs to another surface.", "m", low=1e-3
    )
    textureless_contrast: float = _p(6.0, "A point with less contrast is not searched for.", "grey levels", low=0)
    max_predicted_sigma_px: float = _p(
        3.0, "A point that is not recognised counts as visible if its segment predicts it this well.", "px", low=0
    )
    uncertain_px: float = _p(1.5, "A position with this standard deviation has an uncertainty of 1/2.", "px", low=0.01)
    segment_min_points: int = _p(3, "A segment's pose needs so many points, its start twice as many.", "points", low=3)
    segment_reach_m: float = _p(0.04, "Points nearer to each other than this start in one segment.", "m", low=1e-3)
    segment_inlier_m: float = _p(
        0.008, "Pairs of points with a smaller residual agree with a motion that is searched for.", "m", low=1e-4
    )
    split_points: int = _p(8, "So many points that leave a segment together make another one.", "points", low=3)
    split_m: float = _p(0.02, "They do so when they are this far from their segment's motion.", "m", low=1e-3)
    redetect_every: int = _p(2, "Lost segments are searched for everywhere every so many frames.", "frames", low=1)
    corners: int = _p(200, "So many corners of an image are described.", "points", low=10)
    match_ratio: float = _p(
        0.85, "A corner matches a landmark if it is nearer than this times the next best place.", low=0.1, high=1
    )
    min_landmark_matches: int = _p(5, "A lost segment is found where so many corners agree.", "points", low=3)
    reject_frames: int = _p(
        15, "A segment is not searched for where the caller rejected it for so many frames.", "frames", low=0
    )
    landmark_view_deg: float = _p(
        15.0, "Landmarks are added when a segment is seen from a direction this far from all before.", "deg", low=1
    )
    max_landmarks: int = _p(2500, "No more landmarks of a segment are kept.", "points", low=100)


@dataclass(frozen=True)
class OracleConfig(_Checked):
    """Of the tracker ``oracle``, which knows the truth; no part of the method."""

    noise_px: float = _p(0.5, "standard deviation of a visible point's position, per axis", "px", low=0)
    dropout: float = _p(0.0, "share of the visible points called invisible in a frame", low=0, high=1)
    outliers: float = _p(0.0, "share of the visible points reported at a wrong place in a frame", low=0, high=1)
    outlier_px: float = _p(30.0, "how far off those are", "px", low=0)


@dataclass(frozen=True)
class SegmentationConfig(_Checked):
    """Of the embedded segmenter, which starts from clicks."""

    side_px: int = _p(112, "longest side of the grid on which an object is cut out", "px", low=16, high=640)
    reach_m: float = _p(0.3, "no object is larger than this to any side of its clicks", "m", low=0.01)
    margin: float = _p(0.35, "room around the object, in its own size", low=0.05, high=2)
    start_rounds: int = _p(3, "rounds of cutting and learning colours in the first frame", low=1)
    iterations: int = _p(40, "conjugate gradient steps of a cut at most", low=1)
    evidence_strength: float = _p(0.06, "weight of a pixel's certain evidence beside a tie to a like neighbour", low=0)
    colour_weight: float = _p(0.7, "of colour evidence: neighbouring pixels repeat each other", low=0, high=1)
    colour_rate: float = _p(0.05, "share of a frame in the object's remembered colours", low=0, high=1)
    geometry_weight: float = _p(2.0, "log odds by hanging together in depth, and by lying in the support plane", low=0)
    prior_weight: float = _p(2.5, "log odds by where the object was a frame ago", low=0)
    surface_weight: float = _p(1.5, "log odds by lying on the reconstructed surface or clearly before it", low=0)
    surface_m: float = _p(0.008, "distance to the reconstructed surface that still counts as on it", "m", low=1e-4)
    contradiction: float = _p(3.0, "log odds against a pixel whose depth jumped since the last frame", low=0)
    find_points: int = _p(8, "agreeing tracked points that say where an absent object is back", "points", low=3)
    min_share: float = _p(0.03, "of the area it showed lately; an object that shows less is absent", low=0, high=1)
    min_px: int = _p(40, "fewer pixels are absent", "px", low=1)


@dataclass(frozen=True)
class SamplingConfig(_Checked):
    """Of the sampling objective J and its candidates (section "Sampling Strategy and Keypoints Map")."""

    candidates: int = _p(512, "N_k, candidates from the detector", "points", "release", low=1)
    points: int = _p(30, "K, points chosen at a keyframe", "points", "release", low=1)
    max_visible: int = _p(60, "points followed at a time; a keyframe adds no more than are missing", "points", low=3)
    score_weight: float = _p(0.3, "lambda of the objective", "", "release", low=0, high=1)
    cluster_weight: float = _p(0.5, "beta of the objective", "", "release", low=0)
    r_ideal_px: float = _p(
        20.0,
        "r_ideal of the objective (the paper gives none; 10, 20 and 40 measure alike on synthetic/crossing seed 100, "
        "ADD AUC 96.7, 96.4, 96.4, ADD-S 97.6, 97.8, 97.7, and at 20 thirty points cover the object)",
        "px",
        low=1,
    )
    r_min_px: float = _p(5.0, "r_min of the objective", "px", "release", low=0)
    edge_margin_px: int = _p(2, "distance to the mask's border", "px", "release", low=0)


@dataclass(frozen=True)
class KeypointMapConfig(_Checked):
    """Of keyframes and point promotion (appendices "Sampling Criteria" and "Point Promotion Strategy")."""

    keyframe_angle_deg: float = _p(10.0, "turn since the nearest keyframe that asks for points", "deg", "paper", low=0)
    keyframe_min_points: int = _p(25, "fewer visible points ask for points", "points", "paper", low=0)
    cooldown: int = _p(5, "frames between keyframes asked for by too few points", "frames", low=0)
    streak: int = _p(3, "N_streak, verified frames in a row before promotion", "frames", "paper", low=1)
    stable_rotation_deg: float = _p(2.0, "pose change between frames that still counts", "deg", "paper", low=0)
    stable_translation_m: float = _p(0.01, "pose change between frames that still counts", "m", "paper", low=0)
    max_uncertainty: float = _p(0.3, "track uncertainty that still counts", "", "paper", low=0, high=1)
    min_observations: int = _p(4, "observations before promotion", "frames", "release", low=1)
    max_spread_m: float = _p(0.008, "median absolute deviation of the observations", "m", "paper", low=0)
    pending_ttl: int = _p(30, "frames a point may stay pending", "frames", "release", low=1)
    max_views: int = _p(1000, "keyframe poses remembered to tell a new view; the most alike goes first", low=1)
    max_points: int = _p(300, "cap of the keypoints; the least seen for their time go first", "points", low=10)


@dataclass(frozen=True)
class RegistrationConfig(_Checked):
    """Of hypotheses and their selection (section "Frame-to-Map Registration for Pose Estimation")."""

    multi_hypothesis: bool = _p(True, "sequential RANSAC; off: SVD, outlier removal, SVD (the ablation)", "", "paper")
    iterations: int = _p(400, "RANSAC samples per hypothesis at most", low=1)
    sample_size: int = _p(3, "points per RANSAC sample", "points", low=3)
    inlier_m: float = _p(0.006, "largest residual of an inlier", "m", "release", low=1e-5)
    min_inliers: int = _p(5, "fewest inliers of a hypothesis", "points", "release", low=3)
    max_hypotheses: int = _p(10, "H, hypotheses at most", "", "release", low=1)
    max_uncertainty: float = _p(0.5, "tracks more uncertain than this are left out", low=0, high=1)
    min_promoted: int = _p(12, "with fewer visible keypoints, pending ones help out", "points", "release", low=3)
    motion_priors: bool = _p(True, "the last pose and constant velocity compete as hypotheses")
    contradicted: float = _p(
        0.7, "a smaller share of the keypoints that agree has pending points and surface asked", low=0
    )
    inlier_sigmas: float = _p(3.0, "inlier_m grows to this many sigmas of the depth noise; 0 = one constant", low=0)
    refine_all: bool = _p(True, "refine every hypothesis on the surface before it judges them; off: the chosen one")
    surface_sigmas: float = _p(
        2.5, "standard errors by which the surface must prefer another than the best supported; 0 = least score", low=0
    )
    surface_margin_m: float = _p(2e-4, "and metres of mean distance", "m", low=0)
    unseen_share: float = _p(0.4, "of the truncation that a point counts where nothing was seen", low=0, high=1)
    odds_deg: float = _p(
        5.0, "turn off the motion so far that halves the support of a hypothesis; 0 = none", "deg", low=0
    )
    odds_m: float = _p(0.02, "the same of its move", "m", low=0)
    min_support: int = _p(8, "inliers that let a hypothesis compete on the surface", "points", "release", low=0)
    min_support_share: float = _p(0.25, "or this share of the best supported", "", "release", low=0, high=1)


@dataclass(frozen=True)
class TsdfConfig(_Checked):
    """Of the reconstructed surface (section "3D Reconstruction")."""

    enabled: bool = _p(True, "build a surface per object", "", "paper")
    voxel_m: float = _p(0.003, "edge of a voxel", "m", low=2e-4)
    truncation_voxels: float = _p(5.0, "tau in voxels", "voxels", "release", low=1)
    max_voxels: int = _p(8_000_000, "cap of one volume; parts beyond it are left out", "voxels", low=1000)
    padding_m: float = _p(0.02, "room around new surface when the volume grows", "m", low=0)
    max_moves: int = _p(1, "observations re-integrated per frame, the farthest moved first", low=0)
    carve: bool = _p(True, "free-space carving by depth behind the object, outside the mask")


@dataclass(frozen=True)
class RefinementConfig(_Checked):
    """Of the pose's refinement on the surface (section "SDF Refinement")."""

    enabled: bool = _p(True, "refine the pose on the TSDF", "", "paper")
    iterations: int = _p(8, "L, Levenberg-Marquardt steps at most", "", "release", low=1)
    damping: float = _p(1e-4, "initial damping", "", "release", low=0)
    max_points: int = _p(700, "depth points at most", "points", low=10)
    gradient_voxels: float = _p(0.5, "step of the numeric gradient", "voxels", "release", low=0.01)
    mad_trim: float = _p(2.5, "residuals beyond this many MADs are left out", "", "release", low=0.5)
    huber_m: float = _p(0.005, "Huber threshold of the surface residual", "m", low=1e-5)
    max_step_m: float = _p(0.02, "largest translation of one step", "m", "release", low=0)
    max_step_rad: float = _p(0.2, "largest rotation of one step", "rad", "release", low=0)
    tolerance: float = _p(0.2, "a smaller gain ends the iterations", "squared standard deviations", low=0)
    min_strength: float = _p(0.0005, "directions that the shape holds less firmly are not moved by it; 0 = all", low=0)
    independent_points: int = _p(100, "what the correlated depth points are worth together", "points", low=1)
    keypoint_weight: float = _p(1.0, "weight of keypoint residuals beside the surface; 0 = surface alone", low=0)


@dataclass(frozen=True)
class FactorGraphConfig(_Checked):
    """Of the graph of keyframes and keypoints (section "Graph Optimization")."""

    enabled: bool = _p(True, "optimise keyframe poses and keypoints at each new keyframe", "", "paper")
    prior: bool = _p(True, "L_prior, anchors the first keyframe", "", "paper")
    between: bool = _p(True, "L_reg, relative poses from registration", "", "paper")
    observations: bool = _p(True, "L_obs, bearing and range of the keypoints", "", "paper")
    bearing_sigma_rad: float = _p(0.0015, "noise of a bearing: about a pixel", "rad", low=1e-6)
    range_sigma_m: float = _p(0.003, "noise of a range where the caller gives none", "m", low=1e-6)
    huber: float = _p(1.345, "Huber threshold in standard deviations", "", "release", low=0.1)
    between_sigma_rad: float = _p(0.1, "noise of a relative rotation where the caller gives none", "rad", low=1e-6)
    between_sigma_m: float = _p(0.02, "noise of a relative translation, at the object", "m", low=1e-6)
    prior_sigma_rad: float = _p(1e-4, "noise of the first pose, which defines the object frame", "rad", low=1e-7)
    prior_sigma_m: float = _p(1e-4, "noise of the first pose, which defines the object frame", "m", low=1e-7)
    damping: float = _p(1e-4, "lambda_0 of Levenberg-Marquardt", low=0)
    iterations: int = _p(5, "Levenberg-Marquardt steps at most", low=1)
    relative_tolerance: float = _p(1e-3, "a smaller relative decrease of the loss ends the steps", low=0)
    covariance_scale: float = _p(
        0.55,
        "the noise of points is set for a poor sensor; what is left of the pose's covariance (seeds 310)",
        low=0.01,
    )
    slide_share: float = _p(
        0.03, "standard deviation of how far all points slide on a round body, as a share of its turn", low=0, high=1
    )
    max_keyframes: int = _p(30, "keyframes kept, the most alike are merged; 0 = all", low=0)
    suspect_sigmas: float = _p(4.0, "median misfit in standard deviations of a keypoint to be retired", low=1)


@dataclass(frozen=True)
class ConfidenceConfig(_Checked):
    """Log odds that a pose is within 2 cm and 5 degrees of the truth.

    Fitted on ``fading_label``, ``weak_texture`` and ``crossing``, degraded until half of the poses were wrong, seeds
    310 to 313, through the trust that passes from pose to point to pose; ``benchmarks/bench_confidence.py`` says what
    they are worth on others.
    """

    offset: float = _p(-2.0, "log odds at a standard deviation of one degree, without any point", low=-50, high=50)
    per_log_sigma: float = _p(-0.75, "of the largest standard deviation of rotation, by its logarithm", low=-20, high=0)
    per_log_inliers: float = _p(1.1, "of the agreeing keypoints, by the logarithm of their number + 1", low=0, high=20)
    per_agreement: float = _p(0.9, "of their share of the keypoints seen", low=0, high=50)


@dataclass(frozen=True)
class Config:
    """All stages together. Immutable; :meth:`with_values` makes a changed copy."""

    preset: str = "default"
    seed: int = 0
    pipeline: PipelineConfig = PipelineConfig()
    depth: DepthConfig = DepthConfig()
    tracking: TrackingConfig = TrackingConfig()
    oracle: OracleConfig = OracleConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    sampling: SamplingConfig = SamplingConfig()
    keypoint_map: KeypointMapConfig = KeypointMapConfig()
    registration: RegistrationConfig = RegistrationConfig()
    tsdf: TsdfConfig = TsdfConfig()
    refinement: RefinementConfig = RefinementConfig()
    factor_graph: FactorGraphConfig = FactorGraphConfig()
    confidence: ConfidenceConfig = ConfidenceConfig()

    def with_values(self, values: dict[str, Any], source: str = "") -> Config:
        """A copy with ``{"stage.key": value}`` replaced. Strings are read as TOML values.

        Raises :class:`BadInput` for an unknown stage or key (naming the nearest known one) or a
        value that does not fit. ``source`` says where the values came from, for the message.
        """
        stages: dict[str, dict[str, Any]] = {}
        top: dict[str, Any] = {}
        known = {**{f"{s}.{f.name}": f for s in _STAGES for f in fields(getattr(self, s))}, "seed": None}
        for key, value in values.items():
            if key not in known:
                raise _unknown(f"{source}: configuration key" if source else "configuration key", key, known)
            if key == "seed":
                top["seed"] = _whole_number("config seed", value)
                continue
            stage, name = key.split(".", 1)
            stages.setdefault(stage, {})[name] = _parse(value, type(known[key].default))
        return replace(self, **top, **{s: replace(getattr(self, s), **v) for s, v in stages.items()})

    def as_dict(self) -> dict[str, Any]:
        """Nested plain values, as written to ``config.toml`` and to provenance."""
        return dataclasses.asdict(self)

    def to_toml(self) -> str:
        """As TOML that :func:`from_toml` reads back to an equal configuration."""
        lines = [f'preset = "{self.preset}"', f"seed = {self.seed}"]
        for stage in _STAGES:
            lines += ["", f"[{stage}]"]
            part = getattr(self, stage)
            lines += [f"{f.name} = {_toml_value(getattr(part, f.name))}" for f in fields(part)]
        return "\n".join(lines) + "\n"


_STAGES = tuple(f.name for f in fields(Config) if dataclasses.is_dataclass(f.default))

#: What ``paper`` changes against the defaults above: all of ours is taken out again.
_PAPER: dict[str, Any] = {
    "pipeline.object_frame": "camera",
    "sampling.max_visible": 50,  # the release's
    "keypoint_map.cooldown": 0,
    "pipeline.start_growth": 0.0,
    "pipeline.seek_inliers": 0,
    "pipeline.recover_min_share": 0.0,
    "registration.iterations": 100,
    "registration.sample_size": 4,
    "registration.motion_priors": False,
    "tsdf.voxel_m": 0.005,
    "tsdf.carve": False,
    "refinement.max_points": 1500,
    "refinement.huber_m": 0.01,
    "refinement.min_strength": 0.0,
    "refinement.keypoint_weight": 0.0,
    "registration.inlier_sigmas": 0.0,
    "registration.surface_margin_m": 0.0,
    "registration.surface_sigmas": 0.0,
    "registration.refine_all": False,
    "registration.min_support": 0,
    "registration.contradicted": 0.0,
    "registration.unseen_share": 1.0,
    "registration.odds_deg": 0.0,
    "factor_graph.bearing_sigma_rad": 0.01,
    "factor_graph.range_sigma_m": 0.01,
    "factor_graph.between_sigma_rad": 0.02,
    "factor_graph.between_sigma_m": 0.005,
    "factor_graph.damping": 0.1,
    "factor_graph.iterations": 20,
    "factor_graph.relative_tolerance": 1e-5,
    "factor_graph.max_keyframes": 0,
}
_PRESETS: dict[str, dict[str, Any]] = {"default": {}, "paper": _PAPER}


def preset(name: str = "default", seed: int = 0) -> Config:
    """The configuration called ``default`` or ``paper``."""
    if not isinstance(name, str) or name not in _PRESETS:
        raise _unknown("preset", name, _PRESETS)
    return replace(Config().with_values(_PRESETS[name]), preset=name, seed=_whole_number("config seed", seed))


def diff(a: str = "paper", b: str = "default") -> dict[str, tuple[Any, Any]]:
    """``{"stage.key": (value in a, value in b)}`` for every parameter that differs."""
    left, right = preset(a).as_dict(), preset(b).as_dict()
    return {f"{s}.{k}": (left[s][k], right[s][k]) for s in _STAGES for k in left[s] if left[s][k] != right[s][k]}


def from_toml(path: str | Path, base: Config | None = None) -> Config:
    """Read ``[stage] key = value`` from a TOML file over ``base``, else over the file's own ``preset``."""
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingData(str(path), "no such configuration file", "Give --config an existing TOML file.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise BadInput(str(path), f"unreadable TOML ({error})", "[stage] tables of key = value") from None
    named = table.pop("preset", "default")
    base = base or preset(named)
    values: dict[str, Any] = {}
    for key, value in table.items():
        is_table = isinstance(value, dict) and (value or key in _STAGES)
        values |= {f"{key}.{k}": v for k, v in value.items()} if is_table else {key: value}
    return base.with_values(values, source=str(path))


def _unknown(what: str, key: str, known: Any) -> BadInput:
    stage, _, name = str(key).partition(".")
    if name and stage in _STAGES:
        known = [f.name for f in fields(getattr(Config, stage))]
        expected = f"a key of [{stage}]: {', '.join(known)}"
    else:
        name = str(key)
        stages = f"stage.key, where stage is one of {', '.join(_STAGES)}"
        expected = f"one of {', '.join(known)}" if len(known) < 8 else stages
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    prefix = f"{stage}." if stage in _STAGES and name != str(key) else ""
    return BadInput(what, repr(key), expected, f"Did you mean {prefix + near[0]!r}?" if near else "")


def _whole_number(name: str, value: Any) -> int:
    if not re.fullmatch(r"\s*\d+\s*", str(value)):
        raise BadInput(name, repr(value), "a whole number from 0")
    return int(value)


def _parse(value: Any, kind: type) -> Any:
    """A command-line string as a TOML value; anything unreadable stays a string and fails the type check."""
    if not isinstance(value, str) or kind is str:
        return value.strip("\"'") if isinstance(value, str) else value
    text = value.strip().lower()
    try:
        # TOML wants a digit before the point.
        return tomllib.loads(f"x = {'0' * text.startswith('.')}{text}")["x"]
    except tomllib.TOMLDecodeError:
        return value


def _toml_value(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)
