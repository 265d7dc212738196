"""How far the truth of a static scene is from its own images, and what a tracker scores that agrees with them.

    python benchmarks/bench_truth.py --data DIR [--only NAME ...]

Writes ``benchmarks/truth.md``. Truth from motion capture or from another program's camera poses is not exact: nobody
can, or should, score 100 on it. Where nothing moves but the camera, its poses follow from whole images: corners (SIFT)
with the depth of some frames, matched to all others (PnP, Lowe's ratio), far more than any object has. An object that
is moved with that camera from its pose in the first frame agrees with the images; it is scored like a tracker.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from common import machine
from pandas import DataFrame

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.tables import as_markdown
from p2p_lib.core.types import Frame
from p2p_lib.datasets.models import find_models, load_points
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation.metrics import add_m, adds_m, auc_exact
from p2p_lib.extended.depth_lag import DepthLag

VIDEOS = ("desk_fast", "redkitchen_table")
#: Corners of an image, and the ratio that a match needs.
_CORNERS, _RATIO = 1200, 0.8
#: Depth is believed between these, m; of so many frames one is matched to all others.
_NEAR_M, _FAR_M, _EVERY = 0.3, 3.5, 20
#: Reprojection errors that agree, px, in turn; fewer agreeing corners say nothing.
_AGREE_PX, _LEAST = (8.0, 4.0, 3.0), 25
_ROUNDS = 4
PAGE = """# How exact the truth of real static scenes is

Written by `python benchmarks/bench_truth.py`; do not edit. {machine}

*px*, *mm*: the truth's distance from an object that is moved, from its pose in the first frame, with a camera whose
poses all of the image's corners agree on (to {residual} px, median), over the frames that are scored: median and 90 %.
*ADD-S*, *ADD*: what that object scores, the most that can be expected of a tracker. *outside*: frames that are scored
though in the image less than 60 % of the object's points are to be seen.

{rows}
"""


@dataclass(frozen=True, eq=False)
class Corners:
    """Of one frame: uv_px (M, 2), p_cam (M, 3), NaN without depth, and descriptors (M, 128)."""

    uv_px: np.ndarray
    p_cam: np.ndarray
    descriptors: np.ndarray

    @classmethod
    def of(cls, frame: Frame, depth_m: np.ndarray, camera: Camera, sift: cv2.SIFT) -> Corners:
        """Those of a frame."""
        gray = cv2.createCLAHE(2.0, (8, 8)).apply(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY))
        found, descriptors = sift.detectAndCompute(gray, None)
        uv_px = np.asarray(cv2.KeyPoint.convert(found), float)
        u, v = np.rint(uv_px).astype(int).T
        z = depth_m[np.clip(v, 0, len(gray) - 1), np.clip(u, 0, gray.shape[1] - 1)].astype(float)
        z[(z < _NEAR_M) | (z > _FAR_M)] = np.nan
        return cls(uv_px, camera.unproject(uv_px, z), descriptors)

    def in_view_of(self, other: Corners) -> tuple[np.ndarray, np.ndarray]:
        """Points (K, 3) of this frame, in its camera's frame, and the pixels (K, 2) of another one that show them."""
        known = np.flatnonzero(np.isfinite(self.p_cam[:, 2]))
        matches = cv2.BFMatcher().knnMatch(other.descriptors, self.descriptors[known], k=2)
        good = [best for best, second in matches if best.distance < _RATIO * second.distance]
        at, which = [m.queryIdx for m in good], [m.trainIdx for m in good]
        return self.p_cam[known[which]], other.uv_px[at]


def pose(camera: Camera, p: np.ndarray, uv_px: np.ndarray, start: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """T (4, 4) that takes points (K, 3) into the camera, and which (K,) agree; by RANSAC, or from a start."""
    if start is None:
        how = {"iterationsCount": 1000, "reprojectionError": _AGREE_PX[1], "flags": cv2.SOLVEPNP_EPNP}
        found = cv2.solvePnPRansac(p, uv_px, camera.K, None, **how)
        start = se3.from_rt(cv2.Rodrigues(found[1])[0], found[2].ravel())
    turn, place = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:].copy()
    for within_px in _AGREE_PX:
        shown = cv2.projectPoints(p, turn, place, camera.K, None)[0][:, 0]
        agree = np.linalg.norm(shown - uv_px, axis=1) < within_px
        if agree.sum() < _LEAST:
            break
        turn, place = cv2.solvePnPRefineLM(p[agree], uv_px[agree], camera.K, None, turn, place)
    return se3.from_rt(cv2.Rodrigues(turn)[0], place.ravel()), agree


def camera_poses(video: Sequence) -> tuple[np.ndarray, float]:
    """T_cam_first (N, 4, 4) of every frame, by whole images, and the median reprojection error, px."""
    sift, lag = cv2.SIFT.create(_CORNERS, contrastThreshold=0.02), DepthLag()
    frames: list[Corners] = []
    for i in range(len(video)):
        frame = video.frame(i)
        moved = lag.moved(frame)
        frames.append(Corners.of(frame, frame.depth_m if moved is None else moved, video.camera, sift))
    poses = [np.eye(4)]
    for i in range(1, len(video)):  # by the first frame where that is in view, else by the one before
        pairs = [(frames[k].in_view_of(frames[i]), poses[k]) for k in {0, i - 1}]
        found = [(*pose(video.camera, *pair), T) for pair, T in pairs if len(pair[0]) >= _LEAST]
        T, _, before = max(found, key=lambda one: one[1].sum())
        poses.append(T @ before)
    seen: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    for k in range(0, len(video), _EVERY):
        for i in range(1, len(video)):
            p, uv_px = frames[k].in_view_of(frames[i])
            if i != k and len(p) >= _LEAST:
                agree = pose(video.camera, p, uv_px)[1]
                if agree.sum() >= _LEAST:
                    seen[i, k] = p[agree], uv_px[agree]
    for _ in range(_ROUNDS):
        errors_px, newer = [], poses[:1]
        for i in range(1, len(video)):
            views = [(se3.transform(se3.inverse(poses[k]), p), uv) for (j, k), (p, uv) in seen.items() if j == i]
            if not views:
                newer.append(poses[i])
                continue
            p, uv_px = (np.concatenate(column) for column in zip(*views, strict=True))
            newer.append(pose(video.camera, p, uv_px, poses[i])[0])
            errors_px.append(
                np.median(np.linalg.norm(video.camera.project(se3.transform(newer[-1], p)) - uv_px, axis=1))
            )
        poses = newer
    return np.stack(poses), float(np.median(errors_px))


def rows(video: Sequence) -> tuple[list[dict[str, object]], float]:
    """One row for each object, and how well corners agree, px."""
    T_cam_first, residual_px = camera_poses(video)
    made, models = [], find_models(video)
    for name, truth in video.truth.items():
        points, at = load_points(models[name]), np.flatnonzero(truth.labelled)
        seen = T_cam_first[at] @ se3.inverse(T_cam_first[at[0]]) @ truth.T_cam_model[at[0]]
        there, here = se3.transform(truth.T_cam_model[at], points), se3.transform(seen, points)
        uv, true_uv = video.camera.project(here), video.camera.project(there)
        off_px = np.linalg.norm(uv - true_uv, axis=-1).mean(1)
        errors_m = add_m(seen, truth.T_cam_model[at], points)
        inside = video.camera.inside(uv, -0.5).mean(1)
        spread = [f"{np.median(x):.0f} ({np.percentile(x, 90):.0f})" for x in (off_px, 1e3 * errors_m)]
        row: dict[str, object] = {"video": video.name, "object": name, "frames": len(at)}
        row |= dict(zip(("px", "mm"), spread, strict=True))
        row["ADD-S [%]"] = f"{auc_exact(adds_m(seen, truth.T_cam_model[at], points)):.1f}"
        row["ADD [%]"] = f"{auc_exact(errors_m):.1f}"
        made.append(row | {"outside": int((inside < 0.6).sum())})
    return made, residual_px


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--only", nargs="+", choices=VIDEOS, default=VIDEOS)
    asked = parser.parse_args()
    found = [rows(open_sequence(next(asked.data.glob(f"**/{name}")))) for name in asked.only]
    ran = ", ".join(f"{what} {value}" for what, value in machine().items() if not what.startswith("load"))
    table = as_markdown(DataFrame([row for of, _ in found for row in of]))
    page = PAGE.format(machine=ran, residual=" and ".join(f"{px:.1f}" for _, px in found), rows=table)
    (Path(__file__).parent / "truth.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main()
