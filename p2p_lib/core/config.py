"""Every parameter of the method, one frozen dataclass per stage, and the two presets.

``paper`` does what the paper's text says; where the text is silent it takes the authors' released
value. ``default`` is whatever measures best here. ``p2p_lib.core.config.diff("paper", "default")``
shows how they differ. Presets choose parameters, never backends: the tracker, the detector and the
source of masks are chosen by name elsewhere.

Each field's metadata says its symbol or meaning, its unit, and whose value it is:
``paper`` (its text, or what it does without), ``release`` (the authors' released configuration) or ``ours``.
"""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from p2p_lib.core.errors import BadInput, did_you_mean
from p2p_lib.core.files import read_toml


def _p(default: Any, meaning: str, unit: str = "", source: str = "ours", **bounds: Any) -> Any:
    """A field with its meaning; ``low``/``high`` bound it (inclusive), ``choices`` lists strings."""
    return field(default=default, metadata={"meaning": meaning, "unit": unit, "source": source, **bounds})


def _section(stage: type) -> str:
    """The key of a stage's table: ``KeypointMapConfig`` is ``keypoint_map``."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", stage.__name__.removesuffix("Config")).lower()


_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


@dataclass(frozen=True)
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
            if "form" in meta and not re.fullmatch(meta["form"], value.strip()):
                expected = meta["meaning"].rpartition(": ")[2].rstrip(".")
                raise BadInput(name, repr(value), expected, "Names are parted by commas.")
            if kind in (int, float) and not meta.get("low", float("-inf")) <= value <= meta.get("high", float("inf")):
                bounds = f"{meta.get('low', '-inf')} to {meta.get('high', 'inf')} {meta['unit']}".strip()
                raise BadInput(name, value, f"a value in {bounds}: {meta['meaning']}")


@dataclass(frozen=True)
class MethodConfig(_Checked):
    """Which parts an object's step is composed of; the two presets differ here first."""

    object_frame: str = _p(
        "centroid",
        "The object frame starts at the camera (T_cam_obj = I) or at the centroid of the first masked cloud.",
        choices=("camera", "centroid"),
    )
    mechanisms: str = _p(
        "all",
        "These mechanisms of ours are composed around the paper's method: all, none, names, or all but names.",
        form=r"(all but )?[a-z_]+( *, *[a-z_]+)*",
    )
    noise: str = _p(
        "sensor",
        "Points have the noise of a depth sensor at their range, or one constant noise each in registration and graph;"
        " the paper gives points none, and its Sigma_reg may vary.",
        choices=("constant", "sensor"),
    )
    surface: bool = _p(True, "Each object's surface is reconstructed.", "", "paper")
    graph: bool = _p(True, "Keyframe poses and keypoints are optimised at each new keyframe.", "", "paper")


@dataclass(frozen=True)
class LifecycleConfig(_Checked):
    """Of an object's life cycle: when it is hidden, started, recovered, and when its pose stands."""

    min_mask_px: int = _p(100, "An object with a smaller mask counts as hidden.", "px", "release", low=1)
    return_inliers: int = _p(
        8, "A return needs so many agreeing points; a pose with fewer is degraded.", "points", low=3
    )
    surface_only_share: float = _p(
        0.6,
        "The surface tracks without agreeing points where this share of the depth points lies on it.",
        low=0,
        high=1,
    )


@dataclass(frozen=True)
class DepthConfig(_Checked):
    """Of measured depth: which of it is used, and how noisy it is."""

    min_m: float = _p(0.1, "Nearer depth is invalid.", "m", "release", low=0)
    max_m: float = _p(5.0, "Farther depth is invalid.", "m", low=0.1)
    edge_m: float = _p(0.01, "A larger depth step in the 3x3 neighbourhood is an edge.", "m", "release", low=0)
    narrow: bool = _p(
        True, "Parts of a mask too narrow for a border and whole neighbourhoods keep depth that agrees with theirs."
    )
    noise_m: float = _p(0.001, "This is the standard deviation of depth at range 0.", "m", low=1e-6)
    noise_per_m2: float = _p(0.0025, "The standard deviation grows by this with the range squared.", "1/m", low=0)


@dataclass(frozen=True)
class TrackingConfig(_Checked):
    """Of the built-in tracker, but for ``forget_after``, which all trackers keep, and what has a tracker's name."""

    forget_after: int = _p(0, "SH(n): points are dropped after so many invisible frames; 0: never.", "frames", low=0)
    tapir_resolutions: str = _p(
        "mean",
        "TAPIR's answers at its resolutions are averaged, as its own forward does, or the last one is taken.",
        choices=("mean", "last"),
    )
    window_px: int = _p(13, "The Lucas-Kanade window has this side.", "px", low=5, high=63)
    templates: int = _p(5, "So many templates of a point's appearance are kept.", low=2, high=20)
    update_every: int = _p(3, "Templates, segments and landmarks are updated every so many frames.", "frames", low=1)
    update_scale_change: float = _p(1.35, "A new template is taken when the best one appears scaled by this.", low=1.01)
    update_ncc: float = _p(0.85, "A new template is taken when the best one correlates less.", low=0, high=1)
    min_ncc: float = _p(0.7, "A followed point keeps at least this correlation with its template.", low=0, high=1)
    return_ncc: float = _p(0.8, "A point that was invisible returns with at least this one.", low=0, high=1)
    max_colour_change: float = _p(12.0, "A larger difference of chroma (CIELAB) means another point.", low=0)
    max_contrast_change: float = _p(2.5, "A larger ratio of contrasts means another point.", low=1)
    search_px: float = _p(8.0, "A point is searched for no farther from its prediction than this.", "px", low=0.5)
    coast_frames: int = _p(8, "Lucas-Kanade alone carries a point of changed looks for so long.", "frames", low=0)
    forward_backward_px: float = _p(
        0.7, "Lucas-Kanade forward and backward may differ by this much for such a point.", "px", low=0.05
    )
    linger_frames: int = _p(5, "What was lost is searched for where it was for so many frames.", "frames", low=0)
    depth_jump_m: float = _p(0.02, "Depth farther off a point's prediction is another surface's.", "m", low=1e-3)
    textureless_contrast: float = _p(6.0, "A point with less contrast is not searched for.", "grey levels", low=0)
    max_predicted_sigma_px: float = _p(
        3.0, "A point that is not recognised counts as visible if its segment predicts it this well.", "px", low=0
    )
    uncertain_px: float = _p(1.5, "A position with this standard deviation has an uncertainty of 1/2.", "px", low=0.01)
    segment_min_points: int = _p(3, "A segment's pose needs so many points, its start twice as many.", "points", low=3)
    segment_reach_m: float = _p(0.04, "Points nearer to each other than this start in one segment.", "m", low=1e-3)
    segment_inlier_m: float = _p(0.008, "Pairs with a smaller residual agree with a motion.", "m", low=1e-4)
    overruled_below: float = _p(
        0.9,
        "A motion by all colours and depth of a segment counts where it fits them this much better than its points'; "
        "0: never.",
        low=0,
        high=1,
    )
    split_points: int = _p(8, "So many points that leave a segment together make another one.", "points", low=3)
    split_m: float = _p(0.02, "They do so when they are this far from their segment's motion.", "m", low=1e-3)
    redetect_every: int = _p(2, "Lost segments are searched for everywhere every so many frames.", "frames", low=1)
    corners: int = _p(200, "So many corners of an image are described.", "points", low=10)
    match_ratio: float = _p(0.85, "A match is nearer than this times the next best place.", low=0.1, high=1)
    min_landmark_matches: int = _p(5, "A lost segment is found where so many corners agree.", "points", low=3)
    reject_frames: int = _p(15, "A segment is not searched for where it was rejected for so long.", "frames", low=0)
    landmark_view_deg: float = _p(15.0, "Landmarks are added in views this far from all before.", "deg", low=1)
    max_landmarks: int = _p(2500, "No more landmarks of a segment are kept.", "points", low=100)


@dataclass(frozen=True)
class OracleConfig(_Checked):
    """Of the tracker ``oracle``, which knows the truth; no part of the method."""

    noise_px: float = _p(0.5, "This is the standard deviation of a visible point's position, per axis.", "px", low=0)
    dropout: float = _p(0.0, "This share of the visible points is called invisible in a frame.", low=0, high=1)
    outliers: float = _p(0.0, "This share of the visible points is at a wrong place in a frame.", low=0, high=1)
    outlier_px: float = _p(30.0, "Points at a wrong place are this far off.", "px", low=0)
    slide_px: float = _p(0.0, "This is the standard deviation of the error that lasts, per axis.", "px", low=0)
    lasting_frames: int = _p(1, "Dropouts, wrong places and the error that lasts last so long.", "frames", low=1)


@dataclass(frozen=True)
class SegmentationConfig(_Checked):
    """Of the built-in segmenter, which starts from clicks."""

    side_px: int = _p(112, "The grid on which an object is cut out has this longest side.", "px", low=16, high=640)
    reach_m: float = _p(0.3, "No object is larger than this to any side of its clicks.", "m", low=0.01)
    margin: float = _p(0.35, "This much room is left around the object, in its own size.", low=0.05, high=2)
    colour_weight: float = _p(0.7, "Colour evidence counts this much: neighbours repeat each other.", low=0, high=1)
    colour_rate: float = _p(0.05, "A frame has this share in the object's remembered colours.", low=0, high=1)
    geometry_weight: float = _p(2.0, "These are the log odds by connected depth and by the support plane.", low=0)
    prior_weight: float = _p(2.5, "These are the log odds by where the object was a frame ago.", low=0)
    surface_weight: float = _p(1.5, "These are the log odds by lying on the reconstructed surface.", low=0)
    find_points: int = _p(8, "So many agreeing tracked points say where an absent object is back.", "points", low=3)
    min_px: int = _p(40, "An object of fewer pixels is absent.", "px", low=1)
    first_masks: str = _p(
        "auto",
        "Prompts become masks by the built-in segmenter, by SAM 2, or by SAM 2 where its weights are there.",
        choices=("auto", "builtin", "sam2"),
    )
    sam2_every: int = _p(
        10, "With --masks sam2, SAM 2 looks at every so many frames; 0: whenever it is ready.", "frames", low=0
    )
    sam2_threads: int = _p(0, "So many threads run SAM 2; 0: one for each core.", low=0)


@dataclass(frozen=True)
class SamplingConfig(_Checked):
    """Of the sampling objective J and its candidates (section "Sampling Strategy and Keypoints Map")."""

    candidates: int = _p(512, "The detector offers at most N_k candidates.", "points", "release", low=1)
    points: int = _p(30, "At a keyframe K points are chosen.", "points", "release", low=1)
    max_visible: int = _p(60, "A keyframe adds what is missing to so many visible points.", "points", low=3)
    score_weight: float = _p(0.3, "This is lambda of the objective.", "", "release", low=0, high=1)
    cluster_weight: float = _p(0.5, "This is beta of the objective.", "", "release", low=0)
    r_ideal_px: float = _p(20.0, "This is r_ideal of the objective, for which the paper gives no value.", "px", low=1)
    r_min_px: float = _p(5.0, "This is r_min of the objective.", "px", "release", low=0)


@dataclass(frozen=True)
class KeypointMapConfig(_Checked):
    """Of keyframes and point promotion (appendices "Sampling Criteria" and "Point Promotion Strategy")."""

    keyframe_angle_deg: float = _p(
        10.0, "A larger turn since the nearest keyframe asks for a new one.", "deg", "paper", low=0
    )
    keyframe_min_points: int = _p(25, "Fewer visible points ask for a keyframe.", "points", "paper", low=0)
    cooldown: int = _p(5, "Keyframes asked for by too few points are so many frames apart; 0: any.", "frames", low=0)
    streak: int = _p(3, "A point is promoted after N_streak verified frames in a row.", "frames", "paper", low=1)
    max_uncertainty: float = _p(0.3, "A more uncertain track verifies nothing.", "", "paper", low=0, high=1)
    max_scatter_m: float = _p(0.008, "A point is promoted below this median absolute deviation.", "m", "paper", low=0)
    pending_ttl: int = _p(30, "A point is dropped when it is pending for longer.", "frames", "release", low=1)
    max_points: int = _p(
        300, "A map keeps so many keypoints and none that mostly disagrees; 0 keeps all.", "points", low=0
    )


@dataclass(frozen=True)
class RegistrationConfig(_Checked):
    """Of pose hypotheses (section "Frame-to-Map Registration for Pose Estimation")."""

    method: str = _p(
        "sequential_ransac",
        "Hypotheses come from sequential RANSAC, or one from two SVDs (the ablation of the paper).",
        "",
        "paper",
        choices=("sequential_ransac", "svd"),
    )
    iterations: int = _p(400, "RANSAC draws at most so many samples for each hypothesis.", low=1)
    sample_size: int = _p(3, "A RANSAC sample has so many points.", "points", low=3)
    inlier_m: float = _p(0.006, "An inlier has at most this residual.", "m", "release", low=1e-5)
    min_inliers: int = _p(5, "A hypothesis has at least so many inliers.", "points", "release", low=3)
    max_hypotheses: int = _p(10, "There are at most H hypotheses.", "", "release", low=1)
    max_uncertainty: float = _p(0.5, "More uncertain tracks are left out.", low=0, high=1)
    contradicted: float = _p(
        0.7, "When a smaller share of the keypoints agrees, pending points and the surface propose too.", low=0, high=1
    )


@dataclass(frozen=True)
class SelectionConfig(_Checked):
    """Of the choice among hypotheses (section "Multi-Hypothesis Pose Generation and Selection")."""

    rule: str = _p(
        "support",
        "The hypothesis nearest to the surface is selected and then refined (the paper), or all are refined and the"
        " best supported one is selected unless the surface prefers another significantly.",
        choices=("surface", "support"),
    )
    surface_sigmas: float = _p(
        5.0, "The surface must prefer another one, that no keypoints agree with, by so many standard errors.", low=0
    )


@dataclass(frozen=True)
class TsdfConfig(_Checked):
    """Of the reconstructed surface (section "3D Reconstruction")."""

    voxel_m: float = _p(0.003, "A voxel has this edge.", "m", low=2e-4, high=0.05)
    truncation_voxels: float = _p(5.0, "The truncation tau is so many voxels.", "voxels", "release", low=1)
    max_voxels: int = _p(8_000_000, "A volume has at most so many voxels; parts beyond are left out.", low=1000)
    carve: bool = _p(True, "Depth behind the object, outside the mask, carves free space.")


@dataclass(frozen=True)
class RefinementConfig(_Checked):
    """Of the pose's refinement on the surface (section "SDF Refinement")."""

    residuals: str = _p(
        "surface_and_keypoints",
        "Poses are not refined, refined on the surface (the paper), or on the surface in the directions that it"
        " determines together with the keypoints.",
        choices=("none", "surface", "surface_and_keypoints"),
    )
    iterations: int = _p(8, "Levenberg-Marquardt makes at most L steps.", "", "release", low=1)
    max_points: int = _p(700, "At most so many depth points are used.", "points", low=10)
    huber_m: float = _p(0.005, "This is the Huber threshold of the surface residual.", "m", low=1e-5)
    min_eigenvalue: float = _p(
        0.0005,
        "Directions with a smaller eigenvalue are not determined by the shape; residuals = surface moves in all.",
        low=0,
    )


@dataclass(frozen=True)
class FactorGraphConfig(_Checked):
    """Of the graph of keyframes and keypoints (section "Graph Optimization")."""

    prior: bool = _p(True, "L_prior anchors the first keyframe.", "", "paper")
    between: bool = _p(True, "L_reg ties keyframes by their registration.", "", "paper")
    observations: bool = _p(True, "L_obs ties keypoints by bearing and range.", "", "paper")
    bearing_sigma_rad: float = _p(0.0015, "This is the noise of a bearing.", "rad", low=1e-6)
    range_sigma_m: float = _p(0.01, "This is the noise of a range where it is constant.", "m", "release", low=1e-6)
    huber: float = _p(1.345, "This is the Huber threshold in standard deviations.", "", "release", low=0.1)
    between_sigma_rad: float = _p(0.02, "A relative rotation has this noise where it is constant.", "rad", low=1e-6)
    between_sigma_m: float = _p(0.005, "A relative translation has this noise where it is constant.", "m", low=1e-6)
    iterations: int = _p(5, "Levenberg-Marquardt makes at most so many steps.", low=1)
    max_keyframes: int = _p(30, "Keyframes beyond this number are merged, the most similar first; 0 keeps all.", low=0)


@dataclass(frozen=True)
class Config:
    """All stages together. Immutable; :meth:`with_values` makes a changed copy.

    device  where the surface is kept and asked: cpu, cuda or cuda:N
    """

    preset: str = "default"
    seed: int = 0
    device: str = "cpu"
    method: MethodConfig = MethodConfig()
    lifecycle: LifecycleConfig = LifecycleConfig()
    depth: DepthConfig = DepthConfig()
    sampling: SamplingConfig = SamplingConfig()
    keypoint_map: KeypointMapConfig = KeypointMapConfig()
    registration: RegistrationConfig = RegistrationConfig()
    selection: SelectionConfig = SelectionConfig()
    tsdf: TsdfConfig = TsdfConfig()
    refinement: RefinementConfig = RefinementConfig()
    factor_graph: FactorGraphConfig = FactorGraphConfig()
    tracking: TrackingConfig = TrackingConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    oracle: OracleConfig = OracleConfig()

    def __post_init__(self) -> None:
        """A stage may be given as a table of some of its keys; what does not fit is refused."""
        _of_preset(self.preset)
        for key in _OF_ALL:
            object.__setattr__(self, key, _value_of_all(key, getattr(self, key)))
        for stage, kind in _STAGES.items():
            given = getattr(self, stage)
            if isinstance(given, Mapping):
                table = {f"{stage}.{key}": value for key, value in given.items()}
                object.__setattr__(self, stage, getattr(Config().with_values(table), stage))
            elif not isinstance(given, kind):
                raise BadInput(f"config {stage}", repr(given)[:60], f"a {kind.__name__}, or a table of its keys")

    def with_values(self, values: dict[str, Any], source: str = "") -> Config:
        """A copy with ``{"stage.key": value}`` replaced. Strings are read as TOML values.

        Raises :class:`BadInput` for an unknown stage or key (naming the nearest known one) or a
        value that does not fit. ``source`` says where the values came from, for the message.
        """
        changes: dict[str, Any] = {}
        for key, value in values.items():
            if key not in _OF_ALL and key not in _FIELDS:
                raise _unknown(f"{source}: configuration key" if source else "configuration key", key)
            if key in _OF_ALL:
                changes[key] = _value_of_all(key, value)
            else:
                stage, name = key.split(".")
                part = changes.get(stage, getattr(self, stage))
                changes[stage] = replace(part, **{name: _parse(value, type(_FIELDS[key].default))})
        return replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Nested plain values, as written to ``config.toml`` and to provenance."""
        return dataclasses.asdict(self)

    def to_toml(self) -> str:
        """As TOML that :func:`from_toml` reads back to an equal configuration."""
        lines = [f'preset = "{self.preset}"', f"seed = {self.seed}", f'device = "{self.device}"']
        for stage in _STAGES:
            lines += ["", f"[{stage}]"]
            part = getattr(self, stage)
            lines += [f"{f.name} = {_toml_value(getattr(part, f.name))}" for f in fields(part)]
        return "\n".join(lines) + "\n"


def parameters(config: Config, only: str | None = None) -> list[dict[str, Any]]:
    """All parameters, or ``only`` those of STAGE or the one STAGE.KEY: key, value here, unit, source, meaning.

    Raises :class:`BadInput` for an unknown stage or key.
    """
    stage, _, key = (only or "").partition(".")
    if stage and stage not in _STAGES:
        # The key of a parameter, or a slip of the pen.
        of = [s for s in _STAGES if stage in {f.name for f in fields(getattr(Config, s))}]
        fix = f"Did you mean {of[0]}?" if of else did_you_mean(stage, _STAGES)
        raise BadInput("stage", repr(stage), f"one of {', '.join(_STAGES)}", fix)
    rows = [
        {"key": f"{s}.{f.name}", "value": getattr(getattr(config, s), f.name)}
        | {about: f.metadata[about] for about in ("unit", "source", "meaning")}
        for s in ([stage] if stage else _STAGES)
        for f in fields(getattr(config, s))
        if key in ("", f.name)
    ]
    for row in rows:
        if _PRESETS[config.preset].get(row["key"]) == row["value"]:
            row["source"] = "paper" if row["key"] in _TEXT else "release" if row["key"] in _RELEASE else "ours"
    if not rows:
        raise _unknown("configuration key", f"{stage}.{key}")
    return rows


_STAGES = {f.name: type(f.default) for f in fields(Config) if dataclasses.is_dataclass(f.default)}
_FIELDS = {f"{stage}.{f.name}": f for stage in _STAGES for f in fields(getattr(Config, stage))}

#: What the paper's text says, or does without.
_TEXT: dict[str, Any] = {
    "method.object_frame": "camera",
    "method.mechanisms": "none",
    "keypoint_map.cooldown": 0,
    "keypoint_map.max_points": 0,
    "selection.rule": "surface",
    "depth.narrow": False,
    "tsdf.carve": False,
    "refinement.residuals": "surface",
    "factor_graph.max_keyframes": 0,
}
#: Where it is silent: the authors' released values.
_RELEASE: dict[str, Any] = {
    "depth.max_m": 2.0,
    "tracking.tapir_resolutions": "last",
    "sampling.max_visible": 50,
    "registration.iterations": 100,
    "registration.sample_size": 4,
    "registration.max_uncertainty": 0.3,
    "tsdf.voxel_m": 0.005,
    "tsdf.max_voxels": 20_000_000,
    "refinement.max_points": 1500,
    "refinement.huber_m": 0.01,
    "factor_graph.bearing_sigma_rad": 0.01,
    "factor_graph.iterations": 20,
}
#: Where neither says it: our reading.
_READING: dict[str, Any] = {"method.noise": "constant"}
_PRESETS: dict[str, dict[str, Any]] = {"default": {}, "paper": _TEXT | _RELEASE | _READING}


def preset(name: str = "default", seed: int = 0) -> Config:
    """The configuration called ``default`` or ``paper``.

    >>> preset("default", seed=3).with_values({"tsdf.voxel_m": 0.004}).tsdf.voxel_m
    0.004
    >>> preset("default").with_values({"tsdf.voxel": 0.004})
    Traceback (most recent call last):
    p2p_lib.core.errors.BadInput: configuration key: got 'tsdf.voxel', expected ... Did you mean tsdf.voxel_m?
    """
    return replace(Config().with_values(_of_preset(name) | {"seed": seed}), preset=name)


def _of_preset(name: str) -> dict[str, Any]:
    """Where this preset differs from the dataclasses' own values."""
    if not isinstance(name, str) or name not in _PRESETS:
        raise BadInput("preset", repr(name), f"one of {', '.join(_PRESETS)}", did_you_mean(str(name), _PRESETS))
    return _PRESETS[name]


def as_config(config: Config | str) -> Config:
    """The configuration, or the preset of this name."""
    config = preset(config) if isinstance(config, str) else config
    if not isinstance(config, Config):
        raise BadInput("config", type(config).__name__, 'a Config, or the name of a preset: "default", "paper"')
    return config


def diff(a: str = "paper", b: str = "default") -> dict[str, tuple[Any, Any]]:
    """``{"stage.key": (value in a, value in b)}`` for every parameter that differs.

    >>> diff("paper", "default")["selection.rule"]
    ('surface', 'support')
    """
    left, right = preset(a).as_dict(), preset(b).as_dict()
    return {f"{s}.{k}": (left[s][k], right[s][k]) for s in _STAGES for k in left[s] if left[s][k] != right[s][k]}


def from_toml(path: str | Path, base: Config | None = None) -> Config:
    """Read ``[stage] key = value`` from a TOML file over ``base``, else over the file's own ``preset``."""
    path = Path(path)
    table = read_toml(path, "TOML, [stage] tables of key = value", "Give --config an existing TOML file.")
    return from_dict(table, str(path), base)


def from_dict(table: Mapping[str, Any], source: str, base: Config | None = None) -> Config:
    """Nested plain values, as :meth:`Config.as_dict` gives them, over ``base``, else over their own ``preset``."""
    named = table.get("preset", "default")
    base = base or preset(named)
    values: dict[str, Any] = {}
    for key, value in table.items():
        is_table = isinstance(value, dict) and (value or key in _STAGES)
        values |= {f"{key}.{k}": v for k, v in value.items()} if is_table else {key: value}
    values.pop("preset", None)
    return base.with_values(values, source=source)


def _unknown(what: str, key: str) -> BadInput:
    stage, _, name = str(key).partition(".")
    if name and stage in _STAGES:
        keys = [f.name for f in fields(getattr(Config, stage))]
        fix = did_you_mean(name, keys, f"{stage}.")
        return BadInput(what, repr(key), f"a key of [{stage}]: {', '.join(keys)}", fix)
    expected = f"stage.key, where stage is one of {', '.join(_STAGES)}"
    return BadInput(what, repr(key), expected, did_you_mean(str(key), [*_OF_ALL, *_FIELDS]))


#: Values of no stage: their type, how they are written, and what that means.
_OF_ALL = {
    "seed": (int, r"\s*\d+\s*", "a whole number from 0"),
    "device": (str, r"cpu|cuda(:\d+)?", "cpu, cuda or cuda:N: where the surface is kept"),
}


def _value_of_all(key: str, value: Any) -> Any:
    kind, form, expected = _OF_ALL[key]
    if not re.fullmatch(form, str(value)):
        raise BadInput(f"config {key}", repr(value), expected)
    return kind(value)


def _parse(value: Any, kind: type) -> Any:
    """A command-line string as a TOML value; anything unreadable stays a string and fails the type check."""
    if not isinstance(value, str) or kind is str:
        return value.strip("\"'") if isinstance(value, str) else value
    text = value.strip().lower()
    try:
        # TOML wants a digit before the point.
        return tomllib.loads(f"x = {'0' * text.startswith('.')}{text}")["x"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return value


def _toml_value(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)
