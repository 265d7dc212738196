"""An image while the shutter is open: the mean of what is there from moment to moment."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic.render import Rendering
from p2p_lib.synthetic.scene import Scenario, at_time

#: So many pixels may lie between two images that are rendered: each is smeared along its own motion. What a turning
#: camera sees moves as one, and a smear is all; before a camera that stands still outlines move over their background.
_STILL_PX, _TURNING_PX = 6.0, 20.0
_SMEARS = 7


def exposed(
    scenario: Scenario, t: int, share: float, most: int, exact: Rendering, room: Rendering | None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Frame t exposed for a share of the frame's time, with t in its middle: rgb (H, W, 3), and depths on the way.

    most   how many images are rendered, at most
    exact  the scene at t; ``room`` without its bodies, where the camera stands still
    """
    ends = np.clip([t - share / 2, t + share / 2], 0, scenario.frames - 1)
    travel_px = _travel_px(scenario, *ends)
    if share <= 0 or travel_px < 0.25:
        return exact.rgb, []
    count = min(most, int(np.ceil(travel_px / (_TURNING_PX if room is None else _STILL_PX))))
    times = ends[0] + np.ptp(ends) * (np.arange(count) + 0.5) / count
    rgb, depths = np.zeros_like(exact.rgb), []
    for s in times:
        image = exact if s == t else scenario.rendered(s, room)
        smeared, passing = _smeared(scenario, image, s, np.ptp(ends) / count, room is not None)
        rgb += smeared / np.float32(count)
        depths += passing
    return rgb, depths


def _travel_px(scenario: Scenario, start: float, stop: float) -> float:
    """How far anything in the image moves between two times, about."""
    camera = scenario.camera
    corners = np.array([[0, 0], [0.5, 0.5], [1, 0], [0, 1], [1, 1]]) * [camera.width, camera.height]
    T0, T1 = (at_time(scenario.T_world_cam, s) for s in (start, stop))
    far = se3.transform(T0, camera.unproject(corners, np.full(5, 0.7)))
    shifts = [_shift_px(camera, far, se3.inverse(T0), se3.inverse(T1))]
    for body in scenario.bodies:
        some = body.mesh.vertices[:: max(1, len(body.mesh.vertices) // 60)]
        there = [se3.inverse(T) @ at_time(body.T_world_model, s) for T, s in ((T0, start), (T1, stop))]
        shifts.append(_shift_px(camera, some, *there))
    return float(np.concatenate(shifts).max(initial=0.0))


def _shift_px(camera, points: np.ndarray, T0: np.ndarray, T1: np.ndarray) -> np.ndarray:
    """Of the points that are in the image at either time."""
    a, b = (se3.transform(T, points) for T in (T0, T1))
    front = (a[:, 2] > 0.05) & (b[:, 2] > 0.05)
    a, b = camera.project(a[front]), camera.project(b[front])
    return np.linalg.norm(a - b, axis=1)[camera.inside(a) | camera.inside(b)]


def _smeared(
    scenario: Scenario, image: Rendering, s: float, share: float, still: bool
) -> tuple[np.ndarray, list[np.ndarray]]:
    """An image averaged along the motion of each of its pixels, over a share of the frame's time around s.

    Besides, the depths (H, W) that pass meanwhile, first to last. Before a ``still`` camera only bodies are smeared.
    """
    camera = scenario.camera
    pixel = np.flatnonzero(image.label) if still else np.arange(image.label.size)
    v, u = (a.astype(np.float32) for a in np.divmod(pixel, camera.width))
    shift = _motion_px(scenario, image, pixel, *np.clip([s, s - share / 2, s + share / 2], 0, scenario.frames - 1))
    rgb, passing = image.rgb.copy(), [image.depth_m]
    if not still:
        ends = [(u + a * shift[:, 0], v + a * shift[:, 1]) for a in (-0.4, 0.4)]
        images = [np.stack(end).reshape(2, camera.height, camera.width) for end in ends]
        first, last = (
            cv2.remap(image.depth_m, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) for x, y in images
        )
        passing = [first, image.depth_m, last]
    total = np.zeros((len(pixel), 3), np.float32)
    at = np.zeros((2, -(-max(1, len(pixel)) // 1024) * 1024), np.float32)
    for a in (np.arange(_SMEARS, dtype=np.float32) + 0.5) / _SMEARS - 0.5:
        at[:, : len(pixel)] = u + a * shift[:, 0], v + a * shift[:, 1]
        x, y = at.reshape(2, -1, 1024)
        found = cv2.remap(image.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += found.reshape(-1, 3)[: len(pixel)]
    rgb.reshape(-1, 3)[pixel] = total / np.float32(_SMEARS)
    return rgb, passing


def _motion_px(
    scenario: Scenario, image: Rendering, pixel: np.ndarray, s: float, start: float, stop: float
) -> np.ndarray:
    """How far (N, 2) float32 what some pixels of the image at s show moves between two times."""
    camera, label = scenario.camera, image.label.ravel()[pixel]
    depth = image.depth_m.ravel()[pixel, None]
    p_s = camera.rays.reshape(-1, 3)[pixel] * np.where(depth > 0, depth, 5.0).astype(np.float32)
    T_world_cam = [at_time(scenario.T_world_cam, time) for time in (s, start, stop)]
    projected = []
    for time, T_world_now in zip((start, stop), T_world_cam[1:], strict=True):
        T_now_s = se3.inverse(T_world_now) @ T_world_cam[0]
        p = se3.transform(T_now_s.astype(np.float32), p_s)
        for k, body in enumerate(scenario.bodies, 1):
            T0, T1 = (at_time(body.T_world_model, moment) for moment in (s, time))
            on = np.flatnonzero(label == k) if (T0 != T1).any() else np.zeros(0, int)
            if len(on):
                T = se3.inverse(T_world_now) @ T1 @ se3.inverse(T0) @ T_world_cam[0]
                p[on] = se3.transform(T.astype(np.float32), p_s[on])
        p[:, 2] = np.maximum(p[:, 2], 0.02)
        projected.append(camera.project(p))
    return (projected[1] - projected[0]).astype(np.float32)
