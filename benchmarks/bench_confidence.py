"""Is the covariance honest, and the confidence calibrated, where poses go wrong?

    python benchmarks/bench_confidence.py [SEED ...]      (400 401 402 where none is given)

Writes ``benchmarks/confidence.md``, about ten minutes. Seeds 310 to 314 were used to set the parameters.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from common import machine, squared_errors

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.tables import as_markdown
from p2p_lib.core.types import Status
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation.confidence import MAX_DEG, MAX_M, Judged, pooled
from p2p_lib.extended.default import Point2Pose
from p2p_lib.synthetic.generate import scenario_dir

BLURRED = {"axial_per_m": 0.02, "exposure": 0.2, "shutter_share": 0.8, "read_levels": 10.0}
DEGRADED = [
    ("fading_label", {"contrast": 0.07}),
    ("fading_label", {"contrast": 0.06}),
    ("weak_texture", {"contrast": 0.03, "axial_per_m": 0.02}),
    ("crossing", BLURRED),
    ("occlusion", BLURRED),
]
PAGE = """# What confidence and covariance are worth

Written by `python benchmarks/bench_confidence.py`; do not edit. Seeds {seeds}, on none of which a parameter was
chosen; masks of every frame. Commit {commit}.

## Where poses go wrong

Sequences degraded (pale labels, coarse depth, blurred noisy images) until many poses are wrong. *Right*: within
{max_cm:g} cm and {max_deg:g} degrees of the truth. *ECE*: expected calibration error of the confidence, 0 is ideal.
*AUROC*: the probability that a right pose has a higher confidence than a wrong one, 0.5 is chance.

{}
## Where nothing is degraded

Squared error of tracked poses in units of their covariance, three degrees of freedom each: 3 is expected, more is too
sure.

{}"""
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


def degraded(seeds: list[int]) -> pd.DataFrame:
    """What confidences are worth where poses go wrong."""
    found = {}
    for name, how in DEGRADED:
        of = f"contrast {how['contrast']}" if "contrast" in how else "blurred"
        runs = (judged(tracked(open_sequence(scenario_dir(name, seed, **how)), seed)) for seed in seeds)
        found[f"`{name}`, {of}"] = pooled(runs)
    found["all"] = pooled(found.values())
    rows = []
    for of, one in found.items():
        right = f"{100 * one.right.mean():.0f} %"
        about = {"sequence": of, "poses": len(one), "right": right}
        rows.append(about | {"ECE": one.calibration_error, "AUROC": one.auroc})
    return pd.DataFrame(rows)


def as_they_are(seeds: list[int]) -> pd.DataFrame:
    """How large the errors of tracked poses are in units of their covariance."""
    found = {
        f"`{name}`, seed {seed}": tracked_errors(tracked(open_sequence(scenario_dir(name, seed)), seed))
        for name in AS_THEY_ARE
        for seed in seeds
    }
    found["all"] = np.concatenate([*found.values()])
    rows = []
    for of, off in found.items():
        rotation, translation = off.mean(0)
        rows.append({"sequence": of, "poses": len(off), "rotation": rotation, "translation": translation})
    return pd.DataFrame(rows)


def main(seeds: list[int]) -> None:
    about = machine()
    tables = [as_markdown(table(seeds).round(3)) for table in (degraded, as_they_are)]
    text = PAGE.format(*tables, seeds=", ".join(map(str, seeds)), max_cm=100 * MAX_M, max_deg=MAX_DEG, **about)
    page = Path(__file__).with_name("confidence.md")
    page.write_text(text, encoding="utf-8")
    print(f"{text}\n{page}")


if __name__ == "__main__":
    main([int(a) for a in sys.argv[1:]] or [400, 401, 402])
