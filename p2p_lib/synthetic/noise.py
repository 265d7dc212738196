"""What a real RGB-D camera does to a perfect image (active stereo, as a RealSense D435)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.synthetic.render import Rendering


def _effect(size: float, meaning: str, high: float = np.inf) -> Any:
    """A field of :class:`Sensor`, from 0 to ``high``."""
    return field(default=size, metadata={"meaning": meaning, "high": high})


@dataclass(frozen=True)
class Sensor:
    """Sensor model; 0 switches an effect off. The defaults are about those of a RealSense D435 at 640x480.

    It makes errors; what the method assumes of them is :func:`p2p_lib.core.depth.depth_noise_m`, a model of its own, so
    that no experiment is told what it is to find.
    """

    axial_per_m: float = _effect(0.004, "standard deviation of depth at 1 m, in m; grows with the range squared")
    correlation_px: float = _effect(1.5, "depth noise is even over this radius: stereo matches windows, not pixels")
    disparity_step_px: float = _effect(1 / 32, "disparity is quantised to this: depth steps grow with range squared")
    baseline_m: float = _effect(0.05, "distance of the two imagers: what only one of them sees has no depth")
    lateral_px: float = _effect(0.6, "standard deviation of the raggedness of depth edges")
    edge_m: float = _effect(0.02, "a larger step in depth is an edge")
    edge_loss: float = _effect(0.5, "probability that a pixel beside an edge has no depth", 1)
    grazing_deg: float = _effect(80.0, "incidence at which half of the depth is lost", 90)
    psf_px: float = _effect(0.6, "standard deviation of the blur of lens and demosaicing")
    read_levels: float = _effect(1.5, "standard deviation of colour noise in the dark, in grey levels")
    shot_levels: float = _effect(2.5, "that at full brightness, added in variance")
    exposure: float = _effect(0.04, "largest relative change of brightness over time, which is slow", 0.9)
    shutter_share: float = _effect(0.0, "share of the frame time that the shutter is open: motion blur", 1)
    blur_samples: int = _effect(10, "images rendered for it at most; each is smeared along its own motion")
    motion_blur: float = _effect(1.0, "share taken of the shutter time that a scene asks for by itself", 1)
    mask_px: float = _effect(0.0, "standard deviation of the displacement of mask outlines, which wobble smoothly")
    mask_loss: float = _effect(0.0, "probability that an object's mask is missing in a frame", 1)
    drop: float = _effect(0.0, "probability that a frame is missing; the first never is", 1)

    def __post_init__(self) -> None:
        for f in fields(self):
            value, low, high = getattr(self, f.name), int(f.name == "blur_samples"), f.metadata["high"]
            if not np.isfinite(value) or not low <= value <= high:
                raise BadInput(f"sensor {f.name}", value, f"a number from {low} to {high}: {f.metadata['meaning']}")


#: An edge may pass so many pixels between two of the instants at which a moving image is known.
_PASSED_PX = 11

#: Exact depth and clean colour.
PERFECT = Sensor(**{f.name: 1 if f.name == "blur_samples" else 0 for f in fields(Sensor)})

#: What ``p2p synth --noise`` takes.
NOISE = {
    "exact": PERFECT,
    "realsense": Sensor(),
    "hard": Sensor(
        axial_per_m=0.006, exposure=0.15, shutter_share=0.4, mask_px=1.5, mask_loss=0.01, drop=0.02, edge_loss=0.8
    ),
}


def measured_depth(image: Rendering, camera: Camera, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """Depth (H, W) float64 in metres as the sensor reports it; 0 = no measurement."""
    exact = image.depth_m
    H, W = exact.shape
    hole = (exact <= 0) | _second_imager_blind(exact, camera.fx * sensor.baseline_m)
    if sensor.edge_loss:
        hole |= _edges(exact, sensor.edge_m) & (rng.random((H, W), np.float32) < sensor.edge_loss)
    if sensor.grazing_deg:
        incidence = np.degrees(np.arccos(np.clip(image.cos_incidence, 0, 1)))
        lost = np.clip((incidence - sensor.grazing_deg) / 10 + 0.5, 0, 1)
        hole |= rng.random((H, W), np.float32) < lost
    depth = _ragged(exact, sensor, rng) if sensor.lateral_px else exact
    if sensor.axial_per_m:
        depth = depth + sensor.axial_per_m * depth**2 * _correlated(H, W, sensor.correlation_px, rng)
    if sensor.disparity_step_px and sensor.baseline_m:
        unit = camera.fx * sensor.baseline_m / sensor.disparity_step_px
        steps = np.round(np.divide(unit, depth, out=np.zeros((H, W)), where=depth > 0))
        depth = np.divide(unit, steps, out=np.zeros((H, W)), where=steps > 0)
    return np.where(hole, 0.0, depth)


def in_motion(
    measured_m: np.ndarray, during_m: list[np.ndarray], sensor: Sensor, rng: np.random.Generator
) -> np.ndarray:
    """Measured depth (H, W) given the exact one at several instants while the imagers' shutters were open.

    Where an edge passed meanwhile there is nothing (as often as beside any edge), what was there for a part of the
    time, or, in a fifth of the pixels, a mixture of near and far; all in patches, because stereo matches windows.
    """
    inverse = [np.divide(1.0, z, out=np.zeros_like(z), where=z > 0) for z in during_m]
    near, far = np.maximum.reduce(inverse), np.minimum.reduce(inverse)
    # On a slope depth changes as well, but no edge passes.
    edges = np.logical_or.reduce([_edges(z, sensor.edge_m) for z in during_m]).astype(np.uint8)
    passed = cv2.dilate(edges, np.ones((_PASSED_PX, _PASSED_PX), np.uint8)) > 0
    v, u = np.nonzero(passed & (near - far > sensor.edge_m * near * far))
    every = np.stack([a[v, u] for a in inverse])
    height, width = measured_m.shape
    patchy = [_even(_correlated(height, width, 2 * sensor.correlation_px, rng)[v, u]) for _ in range(2)]
    seen = every[(patchy[0] * len(every)).astype(int), np.arange(len(v))]
    seen = np.where(rng.random(len(v)) < 0.2, every.mean(0), seen)
    seen[patchy[1] < sensor.edge_loss] = 0
    depth = measured_m.copy()
    depth[v, u] = np.divide(1.0, seen, out=np.zeros_like(seen), where=seen > 0)
    return depth


def _even(normal: np.ndarray) -> np.ndarray:
    """Normal values as their share of smaller ones, in [0, 1), by a logistic curve."""
    return np.clip(1 / (1 + np.exp(-1.702 * normal)), 0, 1 - 1e-9)


def measured_colour(rgb: np.ndarray, sensor: Sensor, gain: float, rng: np.random.Generator) -> np.ndarray:
    """Colour (H, W, 3) uint8 of a rendered (H, W, 3) float32 image at a relative exposure ``gain``."""
    rgb = rgb * np.float32(gain)
    if sensor.psf_px:
        rgb = cv2.GaussianBlur(rgb, (0, 0), sensor.psf_px)
    if sensor.read_levels or sensor.shot_levels:
        variance = sensor.read_levels**2 + sensor.shot_levels**2 * np.clip(rgb, 0, 255) / 255
        noise = rng.standard_normal(rgb.shape, np.float32)
        noise *= np.sqrt(variance, dtype=np.float32)
        rgb += noise
    return np.clip(np.round(rgb, out=rgb), 0, 255, out=rgb).astype(np.uint8)


def measured_mask(mask: np.ndarray, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """A segmenter's mask (H, W) bool of an exact one: its outline wobbles; now and then it is missing."""
    if sensor.mask_loss and rng.random() < sensor.mask_loss:
        return np.zeros_like(mask)
    if not sensor.mask_px or not mask.any():
        return mask
    H, W = mask.shape
    wobble = [sensor.mask_px * _correlated(H, W, 6.0, rng) for _ in range(2)]
    v, u = np.mgrid[:H, :W].astype(np.float32)
    at = u + wobble[0], v + wobble[1]
    moved = cv2.remap(mask.astype(np.uint8), *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return moved > 0


def kept_frames(frames: int, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """The frames that arrive; the first always does."""
    kept = rng.random(frames) >= sensor.drop
    kept[0] = True
    return np.flatnonzero(kept)


def _second_imager_blind(depth_m: np.ndarray, f_times_b: float) -> np.ndarray:
    """Pixels hidden from the second imager, which sits a baseline to the right: nearer surface covers them there."""
    z = np.where(depth_m > 0, depth_m, np.inf)
    column = np.arange(depth_m.shape[1]) - f_times_b / z
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return column > nearest


def _edges(depth_m: np.ndarray, step_m: float) -> np.ndarray:
    """Pixels within one pixel of a depth step."""
    z = depth_m.astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    return cv2.dilate(z, square) - cv2.erode(z, square) > step_m


def _ragged(depth_m: np.ndarray, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """Depth looked up at randomly displaced pixels beside edges; even surface stays as it is."""
    H, W = depth_m.shape
    v, u = np.nonzero(_edges(depth_m, sensor.edge_m))
    shift = np.round(sensor.lateral_px * rng.standard_normal((2, len(v)))).astype(int)
    ragged = depth_m.copy()
    ragged[v, u] = depth_m[np.clip(v + shift[0], 0, H - 1), np.clip(u + shift[1], 0, W - 1)]
    return ragged


def _correlated(height: int, width: int, radius_px: float, rng: np.random.Generator) -> np.ndarray:
    """(height, width) float32 Gaussian noise of unit standard deviation, blurred by ``radius_px``."""
    noise = rng.standard_normal((height, width), np.float32)
    if radius_px <= 0:
        return noise
    half = int(np.ceil(3 * radius_px))
    kernel = cv2.getGaussianKernel(2 * half + 1, radius_px, cv2.CV_32F)
    return cv2.sepFilter2D(noise, -1, kernel, kernel) / np.float32((kernel**2).sum())
