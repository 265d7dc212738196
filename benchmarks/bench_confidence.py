"""Is the covariance honest, and the confidence calibrated, where poses go wrong?

    python benchmarks/bench_confidence.py [SEED ...]      (400 401 402 where none is given)

Tracks synthetic sequences that are degraded (pale labels, coarse depth, blurred noisy images) until many poses are
wrong, and prints per sequence and pooled: the share of poses within 2 cm and 5 degrees, the expected calibration error
and the AUROC of the confidence. Then, on sequences as they are, the normalised squared error of the poses' covariance,
for rotation and for translation, whose expectation is 3. Seeds 310 to 314 were used to set the parameters.
"""

from __future__ import annotations

import sys

import numpy as np
from common import squared_errors

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.types import Status
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation.confidence import MAX_DEG, MAX_M, Judged, pooled
from p2p_lib.method.pipeline import Point2Pose
from p2p_lib.synthetic.generate import scenario_dir

BLURRED = {"axial_per_m": 0.02, "exposure": 0.2, "shutter_share": 0.8, "read_levels": 10.0}
DEGRADED = [
    ("fading_label", {"contrast": 0.07}),
    ("fading_label", {"contrast": 0.06}),
    ("weak_texture", {"contrast": 0.03, "axial_per_m": 0.02}),
    ("crossing", BLURRED),
    ("occlusion", BLURRED),
]
AS_THEY_ARE = ["crossing", "occlusion", "three_objects"]


def tracked(sequence: Sequence, seed: int) -> dict[str, list]:
    """Per object, its poses after the first: (error as a right tangent, covariance, confidence, status)."""
    method, first, told = Point2Pose(sequence.camera, preset("default", seed)), {}, {n: [] for n in sequence.objects}
    for name in sequence.objects:
        method.add_object(name)
    for t in range(len(sequence)):
        for name, e in method.step(sequence.frame(t), sequence.masks(t)).items():
            truth = sequence.truth[name].T_cam_model[t]
            if e.T_cam_obj is None or not np.isfinite(truth).all():
                continue
            if name not in first:
                first[name] = se3.inverse(truth) @ e.T_cam_obj  # T_model_obj
                continue
            off = se3.inverse(truth @ first[name]) @ e.T_cam_obj
            told[name].append((se3.log(off), e.covariance, e.confidence, e.status))
    return told


def judged(told: dict[str, list]) -> Judged:
    """What the confidences of all objects claim, and whether it is so."""
    poses = [pose for many in told.values() for pose in many]
    off = np.array([pose[0] for pose in poses]).reshape(-1, 6)
    shift = se3.exp(off)[:, :3, 3]
    right = (np.degrees(np.linalg.norm(off[:, :3], axis=1)) <= MAX_DEG) & (np.linalg.norm(shift, axis=1) <= MAX_M)
    return Judged(np.array([pose[2] for pose in poses]), right)


def tracked_errors(told: dict[str, list]) -> np.ndarray:
    """(N, 2) normalised squared error of rotation and of translation in the tracked frames."""
    tracked = [pose for many in told.values() for pose in many if pose[3] == Status.TRACKED]
    off, covariance = (np.array([pose[k] for pose in tracked]) for k in (0, 1))
    return squared_errors(off.reshape(-1, 6), covariance.reshape(-1, 6, 6))


def line(label: str, one: Judged) -> None:
    right = f"{100 * one.right.mean():5.0f} %"
    print(f"{label:44} {len(one):6} {right}   {one.calibration_error:.3f}   {one.auroc:.3f}", flush=True)


def errors_line(label: str, off: np.ndarray) -> None:
    print(f"{label:44} {len(off):6}  {off[:, 0].mean():6.2f} {off[:, 1].mean():6.2f}", flush=True)


def main(seeds: list[int]) -> None:
    print(f"{'degraded sequence':44} {'poses':>6} {'right':>7}   ECE     AUROC")
    total = []
    for name, how in DEGRADED:
        of_all = pooled(judged(tracked(open_sequence(scenario_dir(name, s, **how)), s)) for s in seeds)
        line(f"{name} {how.get('contrast', 'blurred')}, seeds {' '.join(map(str, seeds))}", of_all)
        total.append(of_all)
    line("pooled", pooled(total))
    print(f"\n{'sequence as it is':44} {'poses':>6}  squared error, rotation and translation (expected 3)")
    total = []
    for name in AS_THEY_ARE:
        for seed in seeds:
            off = tracked_errors(tracked(open_sequence(scenario_dir(name, seed)), seed))
            errors_line(f"{name} {seed}", off)
            total.append(off)
    errors_line("pooled", np.concatenate(total))


if __name__ == "__main__":
    main([int(a) for a in sys.argv[1:]] or [400, 401, 402])
