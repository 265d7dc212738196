"""What each mechanism of the method is worth: sequences with and without it.

    python benchmarks/bench_mechanisms.py OUT SEQUENCE ... [--mechanisms A,B] [--clicks] [--stop N]

A mechanism is one of ``p2p_lib.extended.default`` by its name, left out by ``method.mechanisms``, or an entry of
``mechanisms.toml``: one text of the library, and what it is replaced with to switch the mechanism off. Each run is a
process of its own, with a copy of the library that is patched for an entry. ``OUT/runs.jsonl`` keeps a line per
run and no run is done twice; ``OUT/table.md`` and ``OUT/table.csv`` compare with the unchanged method. SEQUENCE is what
``p2p run`` takes, with masks, truth and models; ``--clicks`` starts from one click per object instead of masks. Of each
the first ``--stop`` frames are taken.

Scores are means over the objects of a run, in percent, aligned at the first scored frame with a pose. A frame is
confidently wrong where the confidence is above 0.5 and ADD or the error of translation above 5 cm. The Brier score is
that of the confidence, where a pose within 2 cm and 5 degrees is right; the squared errors are those of rotation and
of translation by the covariance, whose expectation is 3, as medians over the frames.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from common import squared_errors

from p2p_lib.core.tables import as_markdown
from p2p_lib.extended.default import MECHANISMS

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tools"))
from mutants import read_mechanisms, switch_off  # noqa: E402

UNCHANGED = "unchanged"
#: A claim, and an error that belies it.
CONFIDENT, FAR_M = 0.5, 0.05
MIN_VISIBLE_PX = 300
MODEL_POINTS = 2000
SUMS = ["frames", "lost", "confidently_wrong"]
MEANS = ["add", "adds", "brier", "rotation_error2", "translation_error2"]


def track(sequence: str, clicks: bool, stop: int | None, without: str, out: Path) -> None:
    """Follow every object of a sequence with the library that is imported; its estimates go to the file ``out``."""
    from p2p_lib import Point2Pose, open_sequence, preset

    seq = open_sequence(sequence)
    config = preset().with_values({"method.mechanisms": f"all but {without}" if without else "all"})
    method, first = Point2Pose(seq.camera, config), seq.masks(0) or {}
    for name in seq.objects:
        if not clicks:
            method.add_object(name)
        elif name in first and first[name].any():
            method.add_object(name, clicks=innermost_pixel(first[name]))
    frame_ms, told = [], {name: [] for name in method.objects}
    for t in range(len(seq))[:stop]:
        frame, masks = seq.frame(t), None if clicks else seq.masks(t)
        start = time.process_time()
        estimates = method.step(frame, masks)
        frame_ms.append(1e3 * (time.process_time() - start))
        for name, e in estimates.items():
            nothing = np.full((4, 4), np.nan), 0.0, np.full((6, 6), np.nan)
            told[name].append(nothing if e.T_cam_obj is None else (e.T_cam_obj, e.confidence, e.covariance))
    arrays = {}
    for name, frames in told.items():
        keys = f"{name}/T_cam_obj", f"{name}/confidence", f"{name}/covariance"
        arrays |= dict(zip(keys, map(np.array, zip(*frames, strict=True)), strict=True))
    np.savez(out, frame_ms=frame_ms, **arrays)


def innermost_pixel(mask: np.ndarray) -> np.ndarray:
    """(1, 2) the pixel of a mask (H, W) that is farthest from its rim."""
    import cv2

    v, u = np.unravel_index(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5).argmax(), mask.shape)
    return np.array([[u, v]], float)


@lru_cache
def known_truth(sequence: str) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per object with truth and a model: T_cam_model (N, 4, 4), scored frames (N,) bool, points (V, 3) of its model."""
    from p2p_lib import open_sequence
    from p2p_lib.datasets.models import find_models, load_points

    seq, known = open_sequence(sequence), {}
    visible_px = [seq.visible_px(t) or {} for t in range(len(seq))]
    for name, model in find_models(seq).items():
        truth, px = seq.truth[name], np.array([at.get(name, 0) for at in visible_px])
        scored = np.isfinite(truth.T_cam_model).all((1, 2)) & truth.labelled & (px >= MIN_VISIBLE_PX)
        points = np.random.default_rng(0).permutation(load_points(model))[:MODEL_POINTS]
        known[name] = truth.T_cam_model, scored, points
    return known


def score_object(
    T_cam_obj: np.ndarray,
    confidence: np.ndarray,
    covariance: np.ndarray,
    T_cam_model: np.ndarray,
    points: np.ndarray,
) -> dict[str, float]:
    """The numbers of one object over its scored frames; poses (n, 4, 4) are NaN where there is none."""
    from p2p_lib.core import se3
    from p2p_lib.evaluation import metrics
    from p2p_lib.evaluation.confidence import MAX_DEG, MAX_M

    posed = np.flatnonzero(np.isfinite(T_cam_obj).all((1, 2)))
    if not len(posed):
        return {"add": 0.0, "adds": 0.0, "frames": len(T_cam_obj), "lost": len(T_cam_obj), "confidently_wrong": 0}
    T_obj_model = se3.inverse(T_cam_obj[posed[0]]) @ T_cam_model[posed[0]]
    T_pred, T_true = T_cam_obj @ T_obj_model, T_cam_model @ se3.inverse(T_obj_model)
    add_m = metrics.add_m(T_pred, T_cam_model, points)
    apart_m = np.linalg.norm((T_pred - T_cam_model)[:, :3, 3], axis=1)
    judged = posed[1:]  # the first is right by alignment
    off = se3.log(se3.inverse(T_true[judged]) @ T_cam_obj[judged])  # right tangent of T_cam_obj, as the covariance
    turned_deg = np.degrees(np.linalg.norm(off[:, :3], axis=1))
    right = (turned_deg <= MAX_DEG) & (apart_m[judged] <= MAX_M)
    error2 = np.median(squared_errors(off, covariance[judged]), axis=0)
    wrong = (add_m[posed] > FAR_M) | (apart_m[posed] > FAR_M)
    return {
        "add": metrics.auc_exact(add_m),
        "adds": metrics.auc_exact(metrics.adds_m(T_pred, T_cam_model, points)),
        "brier": float(np.mean((confidence[judged] - right) ** 2)),
        "rotation_error2": float(error2[0]),
        "translation_error2": float(error2[1]),
        "frames": len(T_cam_obj),
        "lost": len(T_cam_obj) - len(posed),
        "confidently_wrong": int((wrong & (confidence[posed] > CONFIDENT)).sum()),
    }


def score(sequence: str, tracked: Path) -> dict[str, float]:
    """The numbers of one run: means and sums over its objects."""
    run, rows = np.load(tracked), []
    for name, (T_cam_model, scored, points) in known_truth(sequence).items():
        if f"{name}/T_cam_obj" in run:
            T_cam_obj, confidence, covariance = (
                run[f"{name}/{key}"] for key in ("T_cam_obj", "confidence", "covariance")
            )
            at = np.flatnonzero(scored[: len(T_cam_obj)])
            rows.append(score_object(T_cam_obj[at], confidence[at], covariance[at], T_cam_model[at], points))
    table = pd.DataFrame(rows, columns=[*MEANS, *SUMS])
    return table[MEANS].mean().to_dict() | table[SUMS].sum().to_dict() | {"frame_ms": float(run["frame_ms"].mean())}


def run_once(
    mechanism: dict[str, str] | None, sequence: str, clicks: bool = False, stop: int | None = None
) -> dict[str, float | str]:
    """A run without the mechanism, scored by the library as it is; ``failed`` says with which error it ended."""
    with tempfile.TemporaryDirectory() as scratch:
        shutil.copytree(ROOT / "p2p_lib", Path(scratch) / "p2p_lib")
        if mechanism is not None and "file" in mechanism:
            switch_off(mechanism, Path(scratch))
        out = Path(scratch) / "tracked.npz"
        command = [sys.executable, __file__, str(out), sequence, "--track", *(["--clicks"] if clicks else [])]
        command += [] if stop is None else ["--stop", str(stop)]
        command += ["--without", mechanism["name"]] if mechanism is not None and "file" not in mechanism else []
        done = subprocess.run(command, env=os.environ | {"PYTHONPATH": scratch}, capture_output=True, text=True)
        if done.returncode:
            return {"failed": done.stderr.strip().splitlines()[-1]}
        return score(sequence, out)


def compare(runs: pd.DataFrame) -> pd.DataFrame:
    """Per mechanism what the method loses without it, over the sequences on which both ran."""
    numbers = runs.set_index(["sequence", "mechanism"])[MEANS + SUMS].astype(float).unstack("mechanism")
    whole, rows = numbers.xs(UNCHANGED, axis=1, level=1), []
    for name in runs["mechanism"].drop_duplicates().drop(0):
        gain = (whole - numbers.xs(name, axis=1, level=1)).dropna(subset=["add"])
        if len(gain):
            worst, best = gain["add"].idxmax(), gain["add"].idxmin()
            row = {"mechanism": name, "sequences": len(gain), "ADD": gain["add"].mean(), "ADD-S": gain["adds"].mean()}
            row |= {"most": f"{gain['add'][worst]:+.2f} {worst}", "least": f"{gain['add'][best]:+.2f} {best}"}
            row |= {"lost": -gain["lost"].sum(), "confidently wrong": -gain["confidently_wrong"].sum()}
            rows.append(
                row | {"Brier": -gain["brier"].mean(), "unchanged": int((gain[["add", "adds"]] == 0).all(axis=1).sum())}
            )
    return pd.DataFrame(rows).set_index("mechanism").sort_values("ADD", ascending=False) if rows else pd.DataFrame()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    parser.add_argument("--mechanisms", default="", metavar="A,B", help="only these")
    parser.add_argument("--clicks", action="store_true", help="from one click per object instead of masks")
    parser.add_argument("--stop", type=int, metavar="N", help="this many frames of each")
    parser.add_argument("--track", action="store_true", help="one sequence with the library that is imported, into OUT")
    parser.add_argument("--without", default="", metavar="NAME", help="with --track: leave out this mechanism")
    asked = parser.parse_args()
    if asked.track:
        (sequence,) = asked.sequences
        return track(sequence, asked.clicks, asked.stop, asked.without, asked.out)
    asked.out.mkdir(parents=True, exist_ok=True)
    log = asked.out / "runs.jsonl"
    runs = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    done = {(run["mechanism"], run["sequence"]) for run in runs}
    names = [name for name in asked.mechanisms.split(",") if name]
    composed = [{"name": name} for name in MECHANISMS if name in names or not names]
    patched = [name for name in names if name not in MECHANISMS]
    for mechanism in [None, *composed, *(read_mechanisms(patched) if patched or not names else [])]:
        for sequence in asked.sequences:
            what = {
                "mechanism": mechanism["name"] if mechanism else UNCHANGED,
                "sequence": Path(sequence).name + (" clicks" if asked.clicks else ""),
            }
            if tuple(what.values()) in done:
                continue
            runs.append(what | run_once(mechanism, sequence, asked.clicks, asked.stop))
            with log.open("a") as file:
                file.write(json.dumps(runs[-1]) + "\n")
            print(json.dumps(runs[-1]), flush=True)
    table = compare(pd.DataFrame(runs))
    table.to_csv(asked.out / "table.csv")
    shown = table.reset_index().map(lambda cell: f"{cell:+.3f}" if isinstance(cell, float) else str(cell))
    (asked.out / "table.md").write_text(as_markdown(shown))


if __name__ == "__main__":
    main()
