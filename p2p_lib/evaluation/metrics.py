"""Pose errors and their summaries: arrays in, numbers out.

ADD is Hinterstoisser et al. (ACCV 2012), ADD-S the variant for symmetric objects, AUC the area under the
accuracy-threshold curve of PoseCNN (Xiang et al., RSS 2018). A frame without a pose has an infinite error.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3

MAX_M = 0.1
# Differences of points held at once: 4 million doubles are 96 MB with their three coordinates.
_CHUNK = 4_000_000


def add_m(T_pred: np.ndarray, T_gt: np.ndarray, points: np.ndarray) -> np.ndarray:
    """ADD (N,) in metres: the mean distance between model points at the predicted and at the true pose.

    T_pred, T_gt  (N, 4, 4) T_cam_model; where either is not finite the error is infinite
    points        (V, 3) in the model frame
    """
    D = np.asarray(T_pred, float)[:, :3] - np.asarray(T_gt, float)[:, :3]
    errors = np.full(len(D), np.inf)
    usable = np.flatnonzero(np.isfinite(D).all((1, 2)))
    step = max(1, _CHUNK // len(points))
    for at in np.split(usable, range(step, len(usable), step)):
        apart = points @ np.swapaxes(D[at, :, :3], 1, 2) + D[at, None, :, 3]
        errors[at] = np.sqrt(np.einsum("nvi,nvi->nv", apart, apart)).mean(1)
    return errors


def adds_m(T_pred: np.ndarray, T_gt: np.ndarray, points: np.ndarray) -> np.ndarray:
    """ADD-S (N,) in metres: the mean distance from each truly placed point to the nearest predicted one.

    One-directional, as the field computes it. Poses are rigid, so distances are the same in the predicted
    model's frame, where one search tree serves all frames. Arguments as of :func:`add_m`.
    """
    from scipy.spatial import cKDTree

    T_pred, T_gt = np.asarray(T_pred, float), np.asarray(T_gt, float)
    errors = np.full(len(T_pred), np.inf)
    tree = cKDTree(points)
    usable = np.flatnonzero(np.isfinite(T_pred).all((1, 2)) & np.isfinite(T_gt).all((1, 2)))
    step = max(1, _CHUNK // len(points))
    for at in np.split(usable, range(step, len(usable), step)):
        moved = se3.transform(se3.inverse(T_pred[at]) @ T_gt[at], points)
        errors[at] = tree.query(moved, workers=2)[0].mean(-1)
    return errors


def auc_exact(errors: np.ndarray, max_m: float = MAX_M) -> float:
    """Area under the accuracy-threshold curve over [0, max_m], in percent, as the exact integral.

    Mean of clip(1 - e / max_m, 0, 1); an infinite or NaN error counts as 0, no errors at all give NaN.
    """
    errors = np.nan_to_num(np.asarray(errors, float), nan=np.inf, posinf=np.inf)
    return float(np.clip(1 - errors / max_m, 0, 1).mean() * 100) if len(errors) else float("nan")


def auc_voc(errors: np.ndarray, max_m: float = MAX_M) -> float:
    """The same area in percent in the VOC form that the field's tables use.

    Precision k/n at the k-th smallest error below max_m, integrated as a right-hand sum: at most 1/n above
    the exact integral. Where no error is below max_m it is 0; no errors at all give NaN.
    """
    errors = np.sort(np.nan_to_num(np.asarray(errors, float), nan=np.inf, posinf=np.inf))
    if not len(errors):
        return float("nan")
    below = errors[errors < max_m]
    if not len(below):
        return 0.0
    precision = np.arange(1, len(below) + 1) / len(errors)
    widths = np.diff(below, prepend=0.0, append=max_m)
    return float(widths @ np.append(precision, precision[-1]) / max_m * 100)
