"""Cost of the surface stages beside their peers, in one run: ``python benchmarks/bench_surface.py``.

A 20 cm egg with a handle, 640x480 depth with a depth camera's noise, 3 mm voxels. Prints the median wall
milliseconds of each operation; then the same job done by Open3D (VoxelBlockGrid for fusing and meshing,
point-to-plane ICP for refining) and SciPy (trilinear interpolation), and the ratio to ours. The bars:
20 ms per keyframe for fusing, 8 ms per object and frame for refining, on two cores.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig, preset
from p2p_lib.core.errors import MissingBackend
from p2p_lib.core.native import load_open3d
from p2p_lib.method.observation import sample_cloud
from p2p_lib.method.refinement import refine, surface_distances
from p2p_lib.method.tsdf import TsdfVolume

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
CONFIG = TsdfConfig(voxel_m=0.003)
#: Centres and half axes of the two ellipsoids that make the object, metres.
PARTS = (
    (np.array([0.0, 0, 0]), np.array([0.06, 0.075, 0.1])),
    (np.array([0.075, 0.0, 0.02]), np.array([0.03, 0.012, 0.04])),
)


def view(angle_rad: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_cam_obj of a camera 0.7 m away, noisy depth (background at 1.2 m), and the object's mask."""
    direction = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.4])
    z = -direction / np.linalg.norm(direction)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    T = se3.from_rt(np.stack([x, np.cross(z, x), z]), np.array([0, 0, 0.7]))
    T_obj_cam = se3.inverse(T)
    ray = CAMERA.rays.astype(float) @ T_obj_cam[:3, :3].T
    depth = np.full(ray.shape[:2], np.inf)
    for centre, half in PARTS:  # |(start + depth * ray - centre) / half| = 1
        d, s = ray / half, (T_obj_cam[:3, 3] - centre) / half
        a, b, c = (d * d).sum(-1), (d * s).sum(-1), (s * s).sum() - 1
        root = b * b - a * c
        hit = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        depth = np.minimum(depth, hit)
    mask = np.isfinite(depth)
    noise = rng.normal(0, 0.0015, depth.shape)
    return T, np.where(mask, np.round(depth + noise, 3), 1.2).astype(np.float32), mask


def median_ms(job: Callable[[], object], times: int = 20) -> float:
    """Median wall time of a job after two warm-up runs."""
    spent = []
    for _ in range(times + 2):
        start = time.perf_counter()
        job()
        spent.append(time.perf_counter() - start)
    return 1e3 * statistics.median(spent[2:])


def row(name: str, ms: float, note: str = "") -> None:
    print(f"{name:58s} {ms:9.2f} ms   {note}")


def pose_error(T: np.ndarray, T_true: np.ndarray) -> str:
    e = se3.log(se3.inverse(T_true) @ T)
    return f"{np.degrees(np.linalg.norm(e[:3])):.2f} deg, {1e3 * np.linalg.norm(e[3:]):.2f} mm off"


def main() -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    views = [view(a, rng) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    T, depth, mask = view(0.3, rng)
    volume = TsdfVolume(CONFIG)
    for key, (T_key, d, m) in enumerate(views):
        volume.integrate(d, rgb, m, CAMERA, T_key, key=key)
    print(f"volume {'x'.join(map(str, volume.shape))} voxels of 3 mm, {mask.sum()} mask pixels\n")

    fuse = median_ms(lambda: volume.integrate(depth, rgb, mask, CAMERA, T, key=99))
    row("fuse one keyframe anew, in place of its old observation", fuse)
    plain = TsdfVolume(TsdfConfig(voxel_m=0.003, carve=False))
    for T_key, d, m in views:
        plain.integrate(d, rgb, m, CAMERA, T_key)
    fuse = median_ms(lambda: plain.integrate(depth, rgb, mask, CAMERA, T))
    row("fuse one keyframe, paper", fuse)
    carve = median_ms(lambda: volume.integrate(depth, rgb, mask, CAMERA, T))
    row("fuse one keyframe, with carving", carve, "bar 20 ms")
    nudge = [T_key @ se3.exp([0, 0, 0.02, 0, 0, 0]) for T_key, _, _ in views]
    back = [dict(enumerate(poses)) for poses in (nudge, [v[0] for v in views])]
    turn = iter(range(10**6))
    moved = median_ms(lambda: volume.move(back[next(turn) % 2], limit=16), times=4)
    row("re-integrate all 16 keyframes", moved, f"{moved / 16:.1f} ms each")

    p = np.concatenate([sample_cloud(depth, mask, CAMERA, 1500)])
    p_obj = se3.transform(se3.inverse(T), p)
    query = median_ms(lambda: volume.query(p_obj), 100)
    row(f"query {len(p)} points", query)
    row(f"query {len(p)} points with gradient", median_ms(lambda: volume.query_with_gradient(p_obj), 100))
    many = np.stack([T @ se3.exp(rng.normal(0, 0.02, 6)) for _ in range(10)])
    row(f"score 10 hypotheses on {len(p)} points", median_ms(lambda: surface_distances(volume, p, many).mean(1), 50))

    start = T @ se3.exp([0.03, -0.03, 0.03, 0.003, -0.003, 0.003])
    refining = {}
    for name in ("default", "paper"):
        config = preset(name).refinement
        cloud = sample_cloud(depth, mask, CAMERA, config.max_points)
        found = refine(start, cloud, volume, config)
        sampling = median_ms(lambda n=config.max_points: sample_cloud(depth, mask, CAMERA, n), 50)
        refining[name] = median_ms(lambda c=cloud, f=config: refine(start, c, volume, f), 50)
        row(f"sample {len(cloud)} points", sampling)
        note = f"{found.iterations} steps, {pose_error(found.T_cam_obj, T)}; bar 8 ms"
        row(f"refine on {len(cloud)} points, preset {name}", refining[name], note)
    meshing = median_ms(volume.mesh, 3)
    row("mesh with colours, small components removed", meshing, f"{len(volume.mesh().faces)} faces")
    print()
    scipy_peer(volume, p_obj, query)
    open3d_peers(views, (T, depth, mask), rgb, start, plain_ms=fuse, refine_ms=refining["default"], mesh_ms=meshing)


def scipy_peer(volume: TsdfVolume, p_obj: np.ndarray, ours: float) -> None:
    from scipy.ndimage import map_coordinates

    values, index = volume.values(), (p_obj - volume.origin_m) / volume.voxel_m
    peer = median_ms(lambda: map_coordinates(values, index.T, order=1, cval=np.nan), 50)
    row("SciPy map_coordinates, the same points", peer, f"{peer / ours:.1f}x ours")


def open3d_peers(views, live, rgb, start, *, plain_ms: float, refine_ms: float, mesh_ms: float) -> None:
    try:
        o3d = load_open3d()
    except MissingBackend as error:
        print(f"Open3D not compared: {error}")
        return
    core, K = o3d.core, o3d.core.Tensor(CAMERA.K)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32, core.float32, core.float32), ((1), (1), (3)), 0.003, 16, 2000
    )
    colour = o3d.t.geometry.Image(core.Tensor(rgb.astype(np.float32) / 255))

    def integrate(T_cam_obj, depth, mask) -> None:
        image = o3d.t.geometry.Image(core.Tensor(np.where(mask, depth, 0).astype(np.float32)))
        T = core.Tensor(T_cam_obj)
        blocks = grid.compute_unique_block_coordinates(image, K, T, 1.0, 3.0, 5.0)
        grid.integrate(blocks, image, colour, K, T, 1.0, 3.0, 5.0)

    for keyframe in views:
        integrate(*keyframe)
    peer = median_ms(lambda: integrate(*live))
    row("Open3D VoxelBlockGrid, fuse one keyframe (near the surface only)", peer, f"{peer / plain_ms:.1f}x ours")
    peer = median_ms(lambda: grid.extract_triangle_mesh(1.0), 3)
    row("Open3D VoxelBlockGrid, mesh", peer, f"{peer / mesh_ms:.1f}x ours")

    reg = o3d.pipelines.registration
    target = grid.extract_point_cloud(1.0).to_legacy()
    T, depth, mask = live
    source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(sample_cloud(depth, mask, CAMERA, 700)))
    estimate = reg.TransformationEstimationPointToPlane(reg.HuberLoss(0.003))
    guess = se3.inverse(start)

    def icp():
        return reg.registration_icp(source, target, 0.015, guess, estimate, reg.ICPConvergenceCriteria(max_iteration=8))

    found = se3.inverse(icp().transformation)
    peer = median_ms(icp)
    note = f"{pose_error(found, T)}; {peer / refine_ms:.1f}x ours"
    row(f"Open3D ICP, 700 points on {len(target.points)}, map extracted beforehand", peer, note)


if __name__ == "__main__":
    main()
