"""Registration of one object in one frame, beside Open3D's RANSAC over the same correspondences."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from common import Section, Times, beside, rounded
from pandas import DataFrame

from p2p_lib.core import se3
from p2p_lib.core.config import RegistrationConfig, preset
from p2p_lib.core.native import load_open3d
from p2p_lib.method.registration import register

PEER = "Open3D's RANSAC"
SEEDS, WARM_UP = 40, 2
SIZES, OUTLIERS = (60, 150), (0.0, 0.3, 0.5, 0.7)
#: Open3D counts correspondences nearer than this as inliers: about three standard deviations of the noise below.
INLIER_M = 0.008
RIGHT_DEG = 3.0
#: How far off the pose of the frame before and its prediction are.
PRIORS = {"last pose": 0.01, "constant velocity": 0.002}
#: What makes poses (4, 4) of p_obj, p_cam, the true pose (for priors alone) and a generator.
Method = Callable[[np.ndarray, np.ndarray, np.ndarray, np.random.Generator], list[np.ndarray]]


def scene(rng: np.random.Generator, n: int, outliers: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """N correspondences on a 12 cm object at 0.6 m with 1.5 mm noise, a share of them wrong by centimetres."""
    p_obj = rng.uniform(-0.06, 0.06, (n, 3))
    T = se3.exp(rng.normal(size=6) * np.repeat([0.5, 0.05], 3))
    T[2, 3] += 0.6
    p_cam = se3.transform(T, p_obj) + 0.0015 * rng.normal(size=(n, 3))
    wrong = rng.random(n) < outliers
    p_cam[wrong] = rng.uniform(-0.06, 0.06, (wrong.sum(), 3)) + T[:3, 3]
    return p_obj, p_cam, T


def open3d_ransac(p_obj: np.ndarray, p_cam: np.ndarray, T: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """T_cam_obj by Open3D's RANSAC over given correspondences, as one-element list."""
    o3d = load_open3d()
    reg, cloud = o3d.pipelines.registration, o3d.geometry.PointCloud
    pairs = np.repeat(np.arange(len(p_obj))[:, None], 2, 1).astype(np.int32)
    found = reg.registration_ransac_based_on_correspondence(
        *(cloud(o3d.utility.Vector3dVector(p)) for p in (p_obj, p_cam)),
        o3d.utility.Vector2iVector(pairs),
        INLIER_M,
        reg.TransformationEstimationPointToPoint(),
        ransac_n=3,
        criteria=reg.RANSACConvergenceCriteria(max_iteration=1000, confidence=0.999),
    )
    return [np.array(found.transformation)]


def registering(config: RegistrationConfig, priors_off: dict[str, float]) -> Method:
    """The method's registration; each prior is so far off along every tangent (rad, m)."""

    def run(p_obj: np.ndarray, p_cam: np.ndarray, T: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
        priors = {name: T @ se3.exp(np.full(6, off)) for name, off in priors_off.items()}
        return [h.T_cam_obj for h in register(p_obj, p_cam, config, rng, priors=priors)]

    return run


METHODS: dict[str, Method] = {
    "preset default": registering(preset("default").registration, {}),
    "preset default, with the priors that it has in a sequence": registering(preset("default").registration, PRIORS),
    "preset paper": registering(preset("paper").registration, {}),
    PEER: open3d_ransac,
}


def measure(n: int, outliers: float, seeds: int) -> tuple[dict[str, Times], dict[str, float], dict[str, float]]:
    """Per method what each scene took; how many poses it found in the mean; the share where one of them is right."""
    times = {name: Times() for name in METHODS}
    found, right = {name: [] for name in METHODS}, {name: [] for name in METHODS}
    for seed in range(-WARM_UP, seeds):
        p_obj, p_cam, T = scene(np.random.default_rng(seed + WARM_UP), n, outliers)
        for name, method in METHODS.items():
            poses = times[name].run(lambda: method(p_obj, p_cam, T, np.random.default_rng(seed + WARM_UP)))  # noqa: B023
            off_deg = [np.degrees(se3.angle_rad(se3.inverse(T) @ pose)) for pose in poses]
            found[name].append(len(poses))
            right[name].append(min(off_deg, default=np.inf) < RIGHT_DEG)
    spent = {name: t.at(range(WARM_UP, WARM_UP + seeds)) for name, t in times.items()}
    return spent, *({name: float(np.mean(k[WARM_UP:])) for name, k in of.items()} for of in (found, right))


def sections(quick: bool) -> Iterator[Section]:
    """By points and share of wrong ones."""
    rows = {name: [] for name in METHODS if name != PEER}
    for n in SIZES[:1] if quick else SIZES:
        for outliers in OUTLIERS[1:2] if quick else OUTLIERS:
            times, found, right = measure(n, outliers, 3 if quick else SEEDS)
            for name in rows:
                scored = {"poses found": rounded(found[name])}
                scored |= {"right (%)": rounded(100 * right[name]), "peer, right (%)": rounded(100 * right[PEER])}
                where = {"points": n, "wrong ones": f"{outliers:.0%}"}
                rows[name].append(where | beside(times[name], times[PEER]) | scored)
    words = (
        f"Correspondences of one object with 1.5 mm noise, {SEEDS} scenes of each kind. The peer is Open3D's RANSAC, "
        "up to 1000 samples, which gives one pose, that of the best sample. Right: a pose "
        f"within {RIGHT_DEG:g} degrees is among those found."
    )
    yield Section("registration", "Registration by points", words, {name: DataFrame(r) for name, r in rows.items()})
