"""The camera in the world from a square tag (AprilTag or ArUco) whose place in the world is known.

A tag's frame: origin in its middle, x to its right, y up, z out of it, as it is printed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput

FAMILY = "APRILTAG_36h11"  # the paper's tag: AprilTag 2 (Wang and Olson, IROS 2016)


@dataclass(frozen=True, eq=False)
class TagPose:
    """A tag in one picture.

    T_cam_tag   (4, 4) metres
    error_px    root mean square distance of its corners from where this pose puts them
    other       the second pose that a flat square allows, and its error: seen from far both fit
    """

    T_cam_tag: np.ndarray
    error_px: float
    other_T_cam_tag: np.ndarray
    other_error_px: float


def detect_tags(rgb: np.ndarray, camera: Camera, size_m: float, family: str = FAMILY) -> dict[int, TagPose]:
    """Number to pose of every tag in a picture (H, W, 3).

    size_m  side of the black square; family one of OpenCV's predefined dictionaries, such as ``5X5_100``
    """
    known = getattr(cv2.aruco, f"DICT_{family}", None)
    if known is None:
        names = sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise BadInput("tag family", repr(family), "one of " + ", ".join(names))
    if not 0 < size_m < 10:
        raise BadInput("tag size", size_m, "the side of its black square in metres")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(known), parameters)
    corners, numbers, _ = detector.detectMarkers(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    found = [] if numbers is None else numbers.ravel()
    return {int(number): _pose(four[0], camera, size_m) for number, four in zip(found, corners)}


def camera_in_world(T_cam_tag: np.ndarray, T_world_tag: np.ndarray) -> np.ndarray:
    """T_cam_world (4, 4) from poses (N, 4, 4) of a tag in N pictures of a camera that does not move.

    T_world_tag  (4, 4), or one for each picture (N, 4, 4) where motion capture follows the tag

    NaN poses are left out, wild ones are outvoted.
    """
    T = T_cam_tag @ se3.inverse(np.broadcast_to(T_world_tag, T_cam_tag.shape))
    T = T[np.isfinite(T).all((1, 2))]
    if not len(T):
        raise BadInput("tag", "no pose of it", "at least one picture in which it is seen")
    return robust_mean(T)


def robust_mean(T: np.ndarray, iterations: int = 50) -> np.ndarray:
    """The pose in the middle of (N, 4, 4): least sum of distances, 10 mm counting as much as 1 degree."""
    unit = np.repeat([np.deg2rad(1.0), 0.01], 3)
    apart = [np.linalg.norm(se3.log(se3.inverse(c) @ T) / unit, axis=1).sum() for c in T[:: max(1, len(T) // 200)]]
    mean = T[:: max(1, len(T) // 200)][int(np.argmin(apart))]
    for _ in range(iterations):
        steps = se3.log(se3.inverse(mean) @ T)
        weights = 1 / np.maximum(np.linalg.norm(steps / unit, axis=1), 1e-3)
        step = weights @ steps / weights.sum()
        mean = mean @ se3.exp(step)
        if np.linalg.norm(step / unit) < 1e-6:
            break
    return mean


def _pose(corners_px: np.ndarray, camera: Camera, size_m: float) -> TagPose:
    # OpenCV names the corners clockwise from the top left; integer pixels are pixel centres there too.
    half = size_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    _, w, t, error_px = cv2.solvePnPGeneric(
        square, corners_px.astype(float), camera.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    poses = [se3.from_rt(cv2.Rodrigues(wi)[0], ti.ravel()) for wi, ti in zip(w, t)]
    error_px = np.ravel(error_px)
    best, other = (0, 1) if len(poses) > 1 else (0, 0)
    return TagPose(poses[best], float(error_px[best]), poses[other], float(error_px[other]))
