"""Small sequences and plans: a printed board that slides before a wall, points alone, a second a run."""

from pathlib import Path

import cv2
import numpy as np
import pytest

FRAMES, W, H, DEPTH_M = 6, 160, 120, 0.5
K = np.array([[200.0, 0, 79.5], [0, 200, 59.5], [0, 0, 1]])

PLAN = """
title = "A board that slides"
[[method]]
name = "Ours"
paper = "Ours"
settings = {{ "method.surface" = false, "method.graph" = false }}
[[method]]
name = "No multi-hypothesis"
settings = {{ "method.surface" = false, "method.graph" = false, "registration.method" = "svd" }}
[quick]
seeds = [0]
sequence = [{{ name = "{first}", column = "AP10" }}]
[full]
seeds = [0, 1]
sequence = [{{ name = "{first}", column = "AP10" }}, {{ name = "{second}", stop = 5 }}]
"""


def slide(folder: Path, step_px: int, frames: int = FRAMES) -> Path:
    """A board that moves by so many pixels a frame, in the YCBInEOAT layout."""
    rng = np.random.default_rng(step_px)
    print_ = [cv2.resize(rng.integers(0, 256, (s, s, 3)).astype(np.float32), (60, 60)) for s in (6, 15, 30)]
    board = np.clip(np.mean(print_, 0) * 1.6 - 70, 0, 255).astype(np.uint8)
    for name in ("rgb", "depth", "gt_mask", "annotated_poses", "models/object"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "cam_K.txt", K)
    corners = np.array([[x, y, 0] for x in np.linspace(-0.075, 0.075, 7) for y in np.linspace(-0.075, 0.075, 7)])
    np.savetxt(folder / "models/object/points.xyz", corners)
    for k in range(frames):
        x, y = 30 + step_px * k, 20 + k
        rgb, depth = np.full((H, W, 3), 90, np.uint8), np.full((H, W), 900, np.uint16)
        rgb[y : y + 60, x : x + 60], depth[y : y + 60, x : x + 60] = board, 1000 * DEPTH_M
        mask = np.zeros((H, W), np.uint8)
        mask[y : y + 60, x : x + 60] = 255
        for name, image in (("rgb", rgb), ("depth", depth), ("gt_mask", mask)):
            cv2.imwrite(str(folder / name / f"{k:04d}.png"), image)
        T = np.eye(4)
        T[:3, 3] = (x + 29.5 - K[0, 2]) / 200 * DEPTH_M, (y + 29.5 - K[1, 2]) / 200 * DEPTH_M, DEPTH_M
        np.savetxt(folder / "annotated_poses" / f"{k:04d}.txt", T)
    return folder


@pytest.fixture(scope="session")
def slides(tmp_path_factory) -> tuple[Path, Path]:
    """Two sequences; nobody writes to them."""
    folder = tmp_path_factory.mktemp("slides")
    return slide(folder / "one", 2), slide(folder / "two", 3)


@pytest.fixture(scope="session")
def plan(slides, tmp_path_factory) -> Path:
    """Two methods on them: eight runs in full, two quick."""
    path = tmp_path_factory.mktemp("plan") / "slides.toml"
    path.write_text(PLAN.format(first=slides[0], second=slides[1]))
    return path


@pytest.fixture(scope="session")
def whole(plan, tmp_path_factory):
    """The plan in full, run at once."""
    from p2p_lib.benchmark import run_benchmarks

    return run_benchmarks([plan], tmp_path_factory.mktemp("whole"), progress=False, jobs=2)[0]
