"""A CPU renderer for textured meshes: exact depth at pixel centres, prefiltered textures, Lambert shading.

Homogeneous rasterisation (Olano and Greer, 1997): with A the camera-space corners of a face as columns,
``A^-1 @ ray`` are the barycentric coordinates divided by the depth. They are affine in the pixel, so
one 3x3 matrix per face gives the inside test, the depth, perspective-correct texture coordinates and
their exact derivatives, without clipping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.synthetic.environment import Environment, fresnel
from p2p_lib.synthetic.shapes import Mesh

_NEAR_M = 0.01
_INSIDE = -1e-9  # so that a pixel exactly on the edge between two faces belongs to at least one


@dataclass(frozen=True)
class Light:
    """One distant light, and light from everywhere.

    towards      points from the scene to the light (any length)
    ambient      share of the light that comes from everywhere
    environment  what glossy surfaces mirror, and how blurred (glaze: a degree); None = nothing
    """

    towards: tuple[float, float, float] = (-0.35, -0.8, 0.75)
    ambient: float = 0.5
    environment: Environment | None = None
    roughness_rad: float = 0.02


@dataclass(frozen=True, eq=False)
class Picture:
    """What the renderer saw.

    rgb            (H, W, 3) float32, 0 to 255
    depth_m        (H, W) float64, along the optical axis at the pixel centre; 0 = nothing there
    label          (H, W) uint8, 0 = background, k = the k-th body
    cos_incidence  (H, W) float32, cosine between the surface normal and the ray back to the camera
    """

    rgb: np.ndarray
    depth_m: np.ndarray
    label: np.ndarray
    cos_incidence: np.ndarray


def render(
    bodies: Sequence[tuple[Mesh, np.ndarray]],
    camera: Camera,
    T_world_cam: np.ndarray,
    light: Light | None = None,
    background: Picture | None = None,
) -> Picture:
    """Bodies (mesh, T_world_model) seen by a camera at T_world_cam, in front of an earlier picture of the same view."""
    light = light or Light()
    H, W = camera.height, camera.width
    T_cam_world = se3.inverse(np.asarray(T_world_cam, float))
    owner = np.zeros(H * W, np.uint8)
    if background is None:
        inv_depth = np.zeros(H * W)
        rgb, cosine = np.zeros((H * W, 3), np.float32), np.zeros(H * W, np.float32)
    else:
        z = background.depth_m.ravel()
        inv_depth = np.divide(1.0, z, out=np.zeros(H * W), where=z > 0)
        rgb, cosine = background.rgb.reshape(-1, 3).copy(), background.cos_incidence.ravel().copy()
    drawn = []
    for k, (mesh, T_world_model) in enumerate(bodies, 1):
        T_cam_model = T_cam_world @ T_world_model
        drawn.append(_rasterise(mesh, T_cam_model, camera, inv_depth, owner, k))
    for k, ((mesh, T_world_model), fragments) in enumerate(zip(bodies, drawn, strict=True), 1):
        seen = fragments.select(owner[fragments.pixel] == k)
        shades = _shade(mesh, T_cam_world @ T_world_model, camera, seen, light, T_cam_world)
        rgb[seen.pixel], cosine[seen.pixel] = shades
    depth = np.divide(1.0, inv_depth, out=np.zeros(H * W), where=inv_depth > 0)
    return Picture(rgb.reshape(H, W, 3), depth.reshape(H, W), owner.reshape(H, W), cosine.reshape(H, W))


@dataclass(frozen=True, eq=False)
class _Fragments:
    """Pixels (N,) of a body, the faces (N,) they show, and the faces' planes (N, 3, 3), see _faces_in_view."""

    pixel: np.ndarray
    face: np.ndarray
    planes: np.ndarray

    def select(self, rows: np.ndarray) -> _Fragments:
        return _Fragments(self.pixel[rows], self.face[rows], self.planes[rows])


def _rasterise(
    mesh: Mesh, T_cam_model: np.ndarray, camera: Camera, inv_depth: np.ndarray, owner: np.ndarray, k: int
) -> _Fragments:
    """Draws one body into the depth buffer; returns the pixels it won."""
    faces, box, planes = _faces_in_view(mesh, T_cam_model, camera)
    width = box[:, 2] - box[:, 0] + 1
    count = width * (box[:, 3] - box[:, 1] + 1)
    f = np.repeat(np.arange(len(faces)), count)
    inner = np.arange(len(f)) - np.repeat(np.cumsum(count) - count, count)
    down, across = np.divmod(inner, width[f])
    u, v = box[f, 0] + across, box[f, 1] + down
    a, b, c = (planes[f, i, 0] * u + planes[f, i, 1] * v + planes[f, i, 2] for i in range(3))
    inside = np.flatnonzero((a >= _INSIDE) & (b >= _INSIDE) & (c >= _INSIDE))
    pixel, f = (v * camera.width + u)[inside], f[inside]
    inv_z = (a + b + c)[inside]
    before = inv_depth[pixel]
    np.maximum.at(inv_depth, pixel, inv_z)
    won = np.flatnonzero((inv_z == inv_depth[pixel]) & (inv_z > before))
    pixel, first = np.unique(pixel[won], return_index=True)
    f = f[won[first]]
    owner[pixel] = k
    return _Fragments(pixel, faces[f], planes[f])


def _faces_in_view(mesh: Mesh, T_cam_model: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces that may cover a pixel centre: indices (N,), boxes (N, 4) u0 v0 u1 v1 (inclusive), planes (N, 3, 3).

    ``planes[i] @ (u, v, 1)`` are the barycentric coordinates over the depth.
    """
    p = se3.transform(T_cam_model, mesh.vertices)
    u, v = camera.project(p).T
    corners = mesh.faces.T
    u0, u1, v0, v1 = _bounds(u, corners, camera.width) + _bounds(v, corners, camera.height)
    behind = p[:, 2] <= _NEAR_M
    if behind.any():
        clipped = behind[mesh.faces]
        whole, none = clipped.any(1), clipped.all(1)
        u0[whole], v0[whole], u1[whole], v1[whole] = 0, 0, camera.width - 1, camera.height - 1
        u1[none] = -1
    keep = np.flatnonzero((u1 >= u0) & (v1 >= v0))
    a, b, c = (p[k[keep]] for k in corners)
    rows = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], 1)
    det = np.einsum("nc,nc->n", a, rows[:, 0])
    facing = np.flatnonzero(det < -1e-15 if mesh.closed else np.abs(det) > 1e-15)
    keep, planes = keep[facing], rows[facing] / det[facing, None, None] @ np.linalg.inv(camera.K)
    return keep, np.stack([u0[keep], v0[keep], u1[keep], v1[keep]], 1).astype(np.int64), planes


def _bounds(at: np.ndarray, corners: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last pixel centre (F,) between the corners along one axis of the picture; first > last where none."""
    a, b, c = (at[k] for k in corners)
    first = np.ceil(np.minimum(np.minimum(a, b), c))
    last = np.floor(np.maximum(np.maximum(a, b), c))
    return np.maximum(first, 0), np.minimum(last, size - 1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (N, 3), several times faster than np.cross."""
    (a0, a1, a2), (b0, b1, b2) = a.T, b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], 1)


def _shade(
    mesh: Mesh, T_cam_model: np.ndarray, camera: Camera, seen: _Fragments, light: Light, T_cam_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colour (N, 3) and cosine of incidence (N,) of pixels on known faces."""
    if not len(seen.pixel):
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    v, u = np.divmod(seen.pixel, camera.width)
    planes, face, R = seen.planes, seen.face, T_cam_model[:3, :3]
    over_z = planes[..., 0] * u[:, None] + planes[..., 1] * v[:, None] + planes[..., 2]
    inv_z = over_z.sum(1, keepdims=True)
    weight = over_z / inv_z
    # How the barycentric weights change from pixel to pixel, to the right and down.
    slopes = [(planes[..., a] - weight * planes[..., a].sum(1, keepdims=True)) / inv_z for a in range(2)]
    corner_uv = mesh.uv[face]
    uv = np.einsum("nk,nkc->nc", weight, corner_uv)
    size = np.array(mesh.texture.shape[1::-1])
    steps = [np.linalg.norm(np.einsum("nk,nkc->nc", slope, corner_uv) * size, axis=1) for slope in slopes]
    colour = _texture(mesh.mipmap, uv, np.log2(np.maximum(np.maximum(*steps), 1e-6)))
    ray = camera.rays.reshape(-1, 3)[seen.pixel]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    cosine = -np.einsum("nc,nc->n", mesh.face_normals[face] @ R.T, ray)
    side = np.where(cosine < 0, -1.0, 1.0)
    normal = np.einsum("nk,nkc->nc", weight, mesh.normals[face]) @ R.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    towards = T_cam_world[:3, :3] @ (np.asarray(light.towards, float) / np.linalg.norm(light.towards))
    lit = light.ambient + (1 - light.ambient) * np.maximum(0, side * (normal @ towards))
    colour = colour * lit[:, None].astype(np.float32)
    if light.environment is not None and mesh.reflectance is not None:
        bend = [np.linalg.norm(np.einsum("nk,nkc->nc", slope, mesh.normals[face]), axis=1) for slope in slopes]
        spread = 2 * np.maximum(*bend) + light.roughness_rad
        mirrored, share = _mirrored(light.environment, ray, normal, spread, T_cam_world, mesh.reflectance[face])
        colour += share * (mirrored - colour)
    return colour, np.abs(cosine).astype(np.float32)


def _mirrored(
    environment: Environment,
    ray: np.ndarray,
    normal: np.ndarray,
    spread_rad: np.ndarray,
    T_cam_world: np.ndarray,
    reflectance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """What arrives by way of the surface (N, 3), and its share (N, 1): rays and normals (N, 3) in camera axes."""
    cosine = -np.einsum("nc,nc->n", ray, normal)
    away_world = (ray + 2 * cosine[:, None] * normal) @ T_cam_world[:3, :3]
    share = np.where(reflectance > 0, fresnel(reflectance, cosine), 0)
    return _texture(environment.mipmap, *environment.lookup(away_world, spread_rad)), share[:, None].astype(np.float32)


def _texture(mipmap: list[np.ndarray], uv: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Trilinear lookup: uv (N, 2), level (N,) log2 of texels per pixel; (N, 3) float32."""
    level = np.clip(level, 0, len(mipmap) - 1)
    colour = np.zeros((len(uv), 3), np.float32)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        near = np.flatnonzero(np.abs(level - k) < 1)
        if not len(near):
            continue
        h, w = mipmap[k].shape[:2]
        x, y = uv[near, 0] * w - 0.5, (1 - uv[near, 1]) * h - 0.5
        # cv2.remap works on pictures with sides below 32768: fold the list into rows.
        folded = np.zeros((2, -(-len(near) // 1024) * 1024), np.float32)
        folded[0, : len(near)], folded[1, : len(near)] = x, y
        mx, my = folded.reshape(2, -1, 1024)
        found = cv2.remap(mipmap[k], mx, my, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        weight = (1 - np.abs(level[near] - k)).astype(np.float32)
        colour[near] += weight[:, None] * found.reshape(-1, 3)[: len(near)]
    return colour
