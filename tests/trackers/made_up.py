"""A textured plane in front of a camera, seen by the built-in tracker's parts: values made up, no video."""

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.motion_segments import MotionSegments
from p2p_lib.trackers.builtin.recognition import store_templates
from p2p_lib.trackers.builtin.tracked_points import Points

CAMERA = Camera(300, 300, 159.5, 119.5, 320, 240)
DEPTH_M = 0.5
SHAPE = (240, 320)


def texture(seed: int = 0) -> np.ndarray:
    """(H, W, 3) uint8 grey noise of two scales."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(0, 1, (240 // s, 320 // s)), (320, 240), interpolation=cv2.INTER_CUBIC) for s in (4, 12)
    ]
    return np.repeat(np.clip(128 + 35 * sum(layers), 0, 255).astype(np.uint8)[..., None], 3, 2)


def image(rgb: np.ndarray | None = None, depth_m: np.ndarray | float = DEPTH_M) -> Image:
    depth = np.broadcast_to(np.float32(depth_m), SHAPE).copy()
    return Image.of(Frame(0, 0.0, texture() if rgb is None else rgb, depth), CAMERA)


def shifted(dx: int, dy: int = 0) -> Image:
    """The plane moved sideways by whole pixels; what comes in is the texture's other side."""
    return image(np.roll(texture(), (dy, dx), (0, 1)))


def noisy(dx: int) -> Image:
    """The same with noise of its own in each: no patch correlates perfectly."""
    rgb = np.roll(texture(), dx, 1) + np.random.default_rng(dx).normal(0, 4, (*SHAPE, 1))
    return image(np.clip(rgb, 0, 255).astype(np.uint8))


def grid(u: tuple[int, int], v: tuple[int, int], step: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(*u, step), np.arange(*v, step)), -1).reshape(-1, 2).astype(np.float32)


def started(uv: np.ndarray, now: Image, cfg: TrackingConfig | None = None) -> tuple[Points, MotionSegments]:
    """Points with a template each, assigned to segments."""
    cfg = cfg or TrackingConfig()
    p, segments = Points.new(uv, cfg.templates), MotionSegments(cfg)
    store_templates(p, np.arange(len(uv)), now, 0)
    p.cov[:] = 0.05 * np.eye(2)
    segments.assign(p, np.arange(len(uv)), now)
    return p, segments
