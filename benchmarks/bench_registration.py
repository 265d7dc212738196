"""Cost of registration per object and frame, beside Open3D's: ``python benchmarks/bench_registration.py``.

Prints CPU milliseconds (median and 95th percentile over seeds; the clock on the wall says more about
who else is on the machine), hypotheses found, and how often the true pose is among them within 3 degrees.
Open3D's RANSAC on the same correspondences gives one pose; the last column is its median time over ours.
The bar is 6 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import RegistrationConfig, preset
from p2p_lib.core.native import load_open3d
from p2p_lib.core.robust import fit_rigid
from p2p_lib.method.registration import covariance, register

SEEDS = 40
#: Open3D counts correspondences nearer than this as inliers: about three standard deviations of the noise below.
INLIER_M = 0.008
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


def cpu_ms(run: Callable[[], object]) -> tuple[float, object]:
    """CPU time of one call in ms, and what it returned."""
    start = time.process_time()
    result = run()
    return 1e3 * (time.process_time() - start), result


def open3d_ransac(p_obj: np.ndarray, p_cam: np.ndarray) -> list[np.ndarray]:
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


def measure(name: str, method: Method, n: int, outliers: float, ours_ms: float | None = None) -> float:
    """Prints a row of the table; returns the median in milliseconds."""
    times, found, right = [], [], []
    for seed in range(SEEDS):
        p_obj, p_cam, T = scene(np.random.default_rng(seed), n, outliers)
        ms, poses = cpu_ms(lambda: method(p_obj, p_cam, T, np.random.default_rng(seed)))  # noqa: B023
        off = [se3.angle_rad(se3.inverse(T) @ pose) for pose in poses]
        times.append(ms)
        found.append(len(poses))
        right.append(bool(off) and min(off) < np.radians(3))
    ratio = f" {np.median(times) / ours_ms:5.1f}x ours" if ours_ms else ""
    print(
        f"{name:8} {n:6} {outliers:6.0%} {np.median(times):5.2f} ms {np.percentile(times, 95):5.2f} ms"
        f" {np.mean(found):6.1f} {np.mean(right):6.0%}{ratio}"
    )
    return float(np.median(times))


def registering(config: RegistrationConfig) -> Method:
    """The method's registration, with the priors it has in a sequence."""

    def run(p_obj: np.ndarray, p_cam: np.ndarray, T: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
        priors = {"last pose": T @ se3.exp(np.full(6, 0.01)), "constant velocity": T}
        return [h.T_cam_obj for h in register(p_obj, p_cam, config, rng, priors=priors)]

    return run


def main() -> None:
    """Every preset and Open3D, over numbers of points and shares of outliers."""
    variants = {name: preset(name).registration for name in ("default", "paper")}
    register(*scene(np.random.default_rng(0), 60, 0.1)[:2], variants["default"], np.random.default_rng(0))
    open3d_ransac(*scene(np.random.default_rng(0), 60, 0.1)[:2])
    print(f"{'variant':8} {'points':>6} {'wrong':>6} {'median':>8} {'p95':>8} {'found':>6} {'right':>6}")
    for n in (60, 100, 150):
        for outliers in (0.0, 0.1, 0.3, 0.5, 0.7):
            ours = {name: measure(name, registering(config), n, outliers) for name, config in variants.items()}
            measure("Open3D", lambda p_obj, p_cam, T, rng: open3d_ransac(p_obj, p_cam), n, outliers, ours["default"])
    p_obj, p_cam, _ = scene(np.random.default_rng(0), 100, 0.0)
    (best, *_) = register(p_obj, p_cam, variants["default"], np.random.default_rng(0))
    samples = np.random.default_rng(0).normal(size=(2, 100, 4, 3))
    for what, run in {
        "fit_rigid, 100 samples of 4": lambda: [fit_rigid(*samples) for _ in range(20)],
        "covariance, 100 points": lambda: [covariance(best, p_obj, p_cam, 0.002) for _ in range(20)],
    }.items():
        print(f"{what:28} {min(cpu_ms(run)[0] for _ in range(5)) / 20:.2f} ms")


if __name__ == "__main__":
    main()
