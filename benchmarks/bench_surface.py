"""The surface of one object beside its peers: fusing and meshing, distances, refinement of a pose.

A 20 cm egg with a handle, 640x480 depth with a depth camera's noise, 3 mm voxels. Open3D's VoxelBlockGrid fuses and
meshes, its point-to-plane ICP refines, SciPy interpolates.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from common import Section, compared, in_turn

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TsdfConfig, preset
from p2p_lib.core.native import load_open3d
from p2p_lib.method.observation import sample_cloud
from p2p_lib.method.refinement import refine, surface_distances
from p2p_lib.method.tsdf import TsdfVolume

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
VOXEL_M = 0.003
ICP_POINTS = 700
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


def pose_error(T: np.ndarray, T_true: np.ndarray) -> dict[str, float]:
    deg, mm = se3.error_deg_mm(T, T_true)
    return {"off (deg)": round(float(deg), 2), "off (mm)": round(float(mm), 2)}


class Open3dGrid:
    """The same keyframes in Open3D's VoxelBlockGrid, which fuses near the surface only."""

    def __init__(self, voxel_m: float, rgb: np.ndarray):
        self.o3d = load_open3d()
        core = self.o3d.core
        kinds = (core.float32, core.float32, core.float32)
        self.K, self.T = core.Tensor(CAMERA.K), core.Tensor
        self.colour = self.o3d.t.geometry.Image(core.Tensor(rgb.astype(np.float32) / 255))
        attributes = ("tsdf", "weight", "color"), kinds, ((1), (1), (3))
        self.grid = self.o3d.t.geometry.VoxelBlockGrid(*attributes, voxel_m, 16, 2000)

    def integrate(self, T_cam_obj: np.ndarray, depth: np.ndarray, mask: np.ndarray) -> None:
        """A keyframe."""
        image = self.o3d.t.geometry.Image(self.T(np.where(mask, depth, 0).astype(np.float32)))
        T = self.T(T_cam_obj)
        blocks = self.grid.compute_unique_block_coordinates(image, self.K, T, 1.0, 3.0, 5.0)
        self.grid.integrate(blocks, image, self.colour, self.K, T, 1.0, 3.0, 5.0)

    def mesh(self) -> object:
        """The surface, with colours."""
        return self.grid.extract_triangle_mesh(1.0)

    def icp(self, start: np.ndarray, depth: np.ndarray, mask: np.ndarray) -> Callable[[], np.ndarray]:
        """What refines a pose on points of the grid that are extracted beforehand."""
        reg, cloud = self.o3d.pipelines.registration, self.o3d.geometry.PointCloud
        target = self.grid.extract_point_cloud(1.0).to_legacy()
        source = cloud(self.o3d.utility.Vector3dVector(sample_cloud(depth, mask, CAMERA, ICP_POINTS)))
        estimate = reg.TransformationEstimationPointToPlane(reg.HuberLoss(0.003))
        stop, guess = reg.ICPConvergenceCriteria(max_iteration=8), se3.inverse(start)
        return lambda: se3.inverse(reg.registration_icp(source, target, 0.015, guess, estimate, stop).transformation)


def sections(quick: bool) -> Iterator[Section]:
    """Every operation in turn with its peer."""
    from scipy.ndimage import map_coordinates

    rng, rounds = np.random.default_rng(0), 1 if quick else 20
    rgb = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    views = [view(a, rng) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    T, depth, mask = live = view(0.3, rng)
    plain, carving = TsdfVolume(TsdfConfig(voxel_m=VOXEL_M, carve=False)), TsdfVolume(TsdfConfig(voxel_m=VOXEL_M))
    grid = Open3dGrid(VOXEL_M, rgb)
    for key, (T_key, d, m) in enumerate(views):
        plain.integrate(d, rgb, m, CAMERA, T_key)
        carving.integrate(d, rgb, m, CAMERA, T_key, key=key)
        grid.integrate(T_key, d, m)

    p = sample_cloud(depth, mask, CAMERA, 1500)
    p_obj = se3.transform(se3.inverse(T), p)
    values, index = carving.values(), ((p_obj - carving.origin_m) / carving.voxel_m).T
    many = np.stack([T @ se3.exp(rng.normal(0, 0.02, 6)) for _ in range(10)])
    query = {
        "ours": lambda: carving.query(p_obj),
        "with gradient": lambda: carving.query_with_gradient(p_obj),
        "ten poses scored": lambda: surface_distances(carving, p, many).mean(1),
        "SciPy's map_coordinates": lambda: map_coordinates(values, index, order=1, cval=np.nan),
    }

    start = T @ se3.exp([0.03, -0.03, 0.03, 0.003, -0.003, 0.003])
    refining = {"Open3D's ICP": grid.icp(start, depth, mask)}
    for name in ("default", "paper"):
        config = preset(name).refinement
        cloud = sample_cloud(depth, mask, CAMERA, config.max_points)
        refining[f"preset {name}"] = lambda c=cloud, f=config: refine(start, c, carving, f).T_cam_obj
    off = {name: pose_error(job(), T) for name, job in refining.items()}

    nudged, true = [dict(enumerate(v[0] @ se3.exp([0, 0, turn, 0, 0, 0]) for v in views)) for turn in (0.02, 0.0)]
    turn = itertools.cycle((nudged, true))
    fusing = {
        "preset paper": lambda: plain.integrate(depth, rgb, mask, CAMERA, T),
        "preset default, with carving": lambda: carving.integrate(depth, rgb, mask, CAMERA, T),
        "the same, in place of its old observation": lambda: carving.integrate(depth, rgb, mask, CAMERA, T, key=99),
        "all 16 keyframes moved": lambda: carving.move(next(turn), limit=16),
        "VoxelBlockGrid": lambda: grid.integrate(*live),
    }
    meshing = {"ours": carving.mesh, "VoxelBlockGrid": grid.mesh}
    tables = {
        "Fuse a keyframe": compared(in_turn(fusing, rounds), "VoxelBlockGrid"),
        "Mesh with colours": compared(in_turn(meshing, max(rounds // 10, 1), 1), "VoxelBlockGrid"),
        f"Distances of {len(p)} points": compared(in_turn(query, rounds), "SciPy's map_coordinates"),
        "Refine a pose that is 3 degrees and 5 mm off": compared(in_turn(refining, rounds), "Open3D's ICP", off),
    }
    words = (
        f"A 20 cm object of {'x'.join(map(str, carving.shape))} voxels of 3 mm, {mask.sum()} pixels of it in 640x480. "
        "Open3D fuses near the surface only and clears nothing in front of it; its ICP has the points of the surface "
        "extracted beforehand."
    )
    yield Section("surface", "Surface", words, tables)
