"""Would learned features find fast motion and returns better than our corners? By pairs of frames with exact truth.

    python benchmarks/bench_features.py [--seeds N] [--xfeat FILE] [--superpoint FILE]

Writes ``benchmarks/features.md``. FILE: XFeat's dense part as ONNX for images of 640x640 (needs onnxruntime), and
SuperPoint's official weights (``p2p data fetch superpoint``, needs torch); without them their rows are left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import Times, machine
from pandas import DataFrame

from p2p_lib.core import robust, se3
from p2p_lib.core.config import preset
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.image import bounds
from p2p_lib.core.tables import as_markdown
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.trackers.builtin.features import mutual_match
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.landmarks import corners
from p2p_lib.trackers.builtin.tangent_planes import planes_at

SCENES = ("in_hand", "thin_tools", "cluttered_desk", "mug")
#: Frames between the two of a pair, and pairs of each object: of neighbours those that turn most.
GAPS, PAIRS = (1, 10), 15
#: Features of an image at most; where an object is looked for, around its true box; pixels of it that have to be seen.
MOST, AROUND_PX, SEEN_PX = 900, 60, 400
#: Right is a motion that is off by less.
RIGHT_DEG, RIGHT_M = 5.0, 0.01
PAGE = """# Learned features in the place of our corners

Written by `python benchmarks/bench_features.py`; do not edit. {machine}

Pairs of frames of rendered scenes with exact truth, seeds {seeds}: of each object the {pairs} pairs of neighbours
between which it turns most, and {pairs} pairs ten frames apart. Features inside its mask in the first frame are
matched both ways with those around it in the second one (a box with 60 px of background and neighbours about it), and
the rigid motion that most agree on in 3D is taken, as in `wide_baseline.py`, by all kinds alike. Shares (%) of pairs
whose motion is right, within 5 degrees and 1 cm; median of pairs that agree; processor time of both frames' features.
All work on the same crop, enlarged twice for the learned ones, as their authors advise for small objects.

{rows}
*either* is how often one of the two is right: what a second kind beside ours could gain at most."""
#: Uv pixels (N, 2) of features in a region of an image, and their descriptors, an array (N, D) for each scale.
Features = Callable[[Image, np.ndarray, np.ndarray], tuple[np.ndarray, list[np.ndarray]]]


def surface_corners(image: Image, rgb: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Ours: corners described on the surface's tangent plane."""
    found = corners(image, region, MOST)
    return found.uv_px, list(np.moveaxis(found.descriptors, 1, 0))


def sift(image: Image, rgb: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """OpenCV's, square roots of normalised descriptors."""
    detector = cv2.SIFT.create(MOST, contrastThreshold=0.01)
    found, described = detector.detectAndCompute(image.gray, region.astype(np.uint8))
    if not found:
        return np.zeros((0, 2)), [np.zeros((0, 128), np.float32)]
    unit = np.sqrt(described / np.maximum(described.sum(1, keepdims=True), 1e-6))
    return np.array([point.pt for point in found]), [unit.astype(np.float32)]


def learned(
    network: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    image: Image,
    rgb: np.ndarray,
    region: np.ndarray,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The most probable keypoints of a network on a crop of 320x320, enlarged twice.

    network  of an image (640, 640, 3) uint8: probabilities (640, 640) and descriptors (D, 80, 80)
    """
    rows, columns = bounds(region)
    top = int(np.clip((rows.start + rows.stop) // 2 - 160, 0, max(rgb.shape[0] - 320, 0)))
    left = int(np.clip((columns.start + columns.stop) // 2 - 160, 0, max(rgb.shape[1] - 320, 0)))
    crop = cv2.resize(rgb[top : top + 320, left : left + 320], (640, 640), interpolation=cv2.INTER_LINEAR)
    inside = cv2.resize(region[top : top + 320, left : left + 320].astype(np.uint8), (640, 640)) > 0
    score, dense = network(crop)
    peaks = (score == cv2.dilate(score, np.ones((5, 5)))) & inside & (score > 0)
    v, u = np.nonzero(peaks)
    best = np.argsort(-score[v, u])[:MOST]
    u, v = u[best], v[best]
    at = [(a[None].astype(np.float32) + 0.5) / 8 - 0.5 for a in (u, v)]
    sampled = np.stack([cv2.remap(d, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0] for d in dense], 1)
    unit = sampled / np.maximum(np.linalg.norm(sampled, axis=1, keepdims=True), 1e-6)
    return (np.stack([u, v], 1) + 0.5) / 2 - 0.5 + [left, top], [unit.astype(np.float32)]


def xfeat(file: Path) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """XFeat (Potje et al., CVPR 2024)."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])

    def network(crop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        given = crop.astype(np.float32).transpose(2, 0, 1)[None] / 255
        found: Any = session.run(None, {session.get_inputs()[0].name: given})
        dense, logits, reliable = found
        each = np.exp(logits[0] - logits[0].max(0))
        cells = (each / each.sum(0))[:64].reshape(8, 8, 80, 80).transpose(2, 0, 3, 1).reshape(640, 640)
        return cells * cv2.resize(reliable[0, 0], (640, 640)), dense[0]

    return network


def superpoint(file: Path) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """SuperPoint (DeTone et al., 2018) with its descriptors, which the library's detector leaves out."""
    import torch
    from torch.nn import functional as f

    from p2p_lib.detectors.superpoint import network as layers
    from p2p_lib.detectors.superpoint import probabilities

    weights = torch.load(file, map_location="cpu", weights_only=True)
    net = layers()
    net.load_state_dict({name: value for name, value in weights.items() if not name.startswith("convD")})

    @torch.inference_mode()
    def network(crop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gray = torch.from_numpy(cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255)
        x = gray[None, None]
        for name, layer in net.items():
            if name.startswith("convP"):
                break
            x = f.relu(layer(x))
            x = f.max_pool2d(x, 2) if name in ("conv1b", "conv2b", "conv3b") else x
        x = f.relu(f.conv2d(x, weights["convDa.weight"], weights["convDa.bias"], padding=1))
        dense = f.conv2d(x, weights["convDb.weight"], weights["convDb.bias"])[0]
        return probabilities(net, gray).numpy(), f.normalize(dense, dim=0).numpy()

    return network


def motion(then: tuple, now: tuple, images: tuple[Image, Image], ratio: float) -> tuple[np.ndarray | None, int]:
    """The motion T_now_then (4, 4) in camera axes that most matched features agree on, and how many do."""
    pairs = [mutual_match(a, b, ratio) for a, b in zip(then[1], now[1], strict=True) if min(len(a), len(b)) > 1]
    if not pairs:
        return None, 0
    which, other = np.unique(np.concatenate(pairs, 1), axis=1)
    p = [
        planes_at(image.depth_m, image.camera, uv[rows].astype(np.float32), 2).p_cam
        for image, uv, rows in zip(images, (then[0], now[0]), (which, other), strict=True)
    ]
    known = np.isfinite(p[0][:, 0]) & np.isfinite(p[1][:, 0])
    p_then, p_now = p[0][known].astype(float), p[1][known].astype(float)
    if len(p_then) < 8:
        return None, 0
    limit_m = np.maximum(0.003, 2 * depth_noise_m(p_now[:, 2]))
    T = robust.ransac(p_then, p_now, limit_m, 3, 300, np.random.default_rng(0))
    even, everything = np.ones(len(p_then)), np.ones(len(p_then), bool)
    fit = None if T is None else robust.refit(T, p_then, p_now, limit_m, even, 8, everything)
    return (None, 0) if fit is None else (fit.T_a_b, int(np.count_nonzero(fit.residual_m <= limit_m)))


def pairs_of(video: Sequence, name: str) -> dict[int, list[tuple[int, int]]]:
    """The pairs of frames of an object, by the frames between them."""
    T = video.truth[name].T_cam_model
    seen = [(video.visible_px(i) or {}).get(name, 0) >= SEEN_PX for i in range(len(video))]
    found = {}
    for gap in GAPS:
        starts = [i for i in range(len(T) - gap) if seen[i] and seen[i + gap]]
        if gap == 1:
            starts.sort(key=lambda i: -se3.angle_rad(se3.inverse(T[i]) @ T[i + 1]))
        else:
            starts = starts[:: max(1, len(starts) // PAIRS)]
        found[gap] = [(i, i + gap) for i in starts[:PAIRS]]
    return found


def right(T: np.ndarray | None, true: np.ndarray, centre: np.ndarray) -> bool:
    """Whether a motion is that of the object with this centre (3,), in camera axes."""
    if T is None:
        return False
    off = se3.inverse(true) @ T
    moved_m = np.linalg.norm(se3.transform(T, centre[None]) - se3.transform(true, centre[None]))
    return bool(np.degrees(se3.angle_rad(off)) < RIGHT_DEG and moved_m < RIGHT_M)


def tried(
    video: Sequence,
    name: str,
    pair: tuple[int, int],
    kinds: Mapping[str, Features],
    times: Mapping[str, Times],
    ratio: float,
) -> dict[str, tuple[bool, int]]:
    """Of each kind of features, whether the motion of an object between two frames is right, and how many agree."""
    frames = [video.frame(k) for k in pair]
    images = Image.of(frames[0], video.camera), Image.of(frames[1], video.camera)
    first, second = ((video.masks(k) or {})[name] for k in pair)
    around = np.zeros_like(second)
    around[bounds(second, AROUND_PX)] = True
    T_then, T_now = (video.truth[name].T_cam_model[k] for k in pair)
    found = {}
    for kind, features in kinds.items():

        def both(features: Features = features) -> list[tuple[np.ndarray, list[np.ndarray]]]:
            return [features(images[k], frames[k].rgb, (first, around)[k]) for k in range(2)]

        then, now = times[kind].run(both)
        T, agree = motion(then, now, images, ratio)
        found[kind] = right(T, T_now @ se3.inverse(T_then), T_then[:3, 3]), agree
    return found


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--xfeat", type=Path)
    parser.add_argument("--superpoint", type=Path)
    asked = parser.parse_args()
    kinds: dict[str, Features] = {"ours: corners on the surface": surface_corners, "SIFT": sift}
    if asked.xfeat:
        kinds["XFeat"] = partial(learned, xfeat(asked.xfeat))
    if asked.superpoint:
        kinds["SuperPoint"] = partial(learned, superpoint(asked.superpoint))
    ratio, times, lines = preset("default").tracking.match_ratio, {name: Times() for name in kinds}, []
    for scene in SCENES:
        for seed in range(asked.seeds):
            video = open_sequence(f"synthetic/{scene}@{seed}")
            for name in video.objects:
                for gap, pairs in pairs_of(video, name).items():
                    for pair in pairs:
                        for kind, (correct, agree) in tried(video, name, pair, kinds, times, ratio).items():
                            lines.append((scene, gap, kind, (seed, name, pair[0]), correct, agree))
    found = DataFrame(lines, columns=["scene", "gap", "kind", "pair", "right", "agree"])
    first, rows = next(iter(kinds)), []
    cells = [(scene, gap) for scene in SCENES for gap in GAPS]
    table = found.pivot_table(index=["scene", "gap", "pair"], columns="kind", values="right", aggfunc="first")
    for kind in kinds:
        either = table[kind].astype(bool) | table[first].astype(bool)
        mine = found[found.kind == kind].groupby(["scene", "gap"])
        row: dict[str, object] = {"features": kind}
        for scene, gap in cells:
            row[f"{scene}, {gap}"] = f"{100 * mine.right.mean()[scene, gap]:.0f}"
        row["all"] = f"{100 * found[found.kind == kind].right.mean():.1f}"
        row["either"] = f"{100 * either.mean():.1f}"
        row["agree"] = int(found[found.kind == kind].agree.median())
        row["ms"] = round(times[kind].processor_ms)
        rows.append(row)
    page = {"machine": "; ".join(f"{k}: {v}" for k, v in machine().items()), "pairs": PAIRS}
    page |= {"seeds": f"0 to {asked.seeds - 1}", "rows": as_markdown(DataFrame(rows))}
    Path(__file__).with_name("features.md").write_text(PAGE.format(**page) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
