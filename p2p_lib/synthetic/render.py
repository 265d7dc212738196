"""A CPU renderer for textured meshes: exact depth at pixel centres, prefiltered textures, Lambert shading, glaze.

Embree says which face a pixel shows. Where on it follows in float64: with A the camera-space corners of a
face as columns, ``A^-1 @ ray`` are the barycentric coordinates divided by the depth (Olano and Greer, 1997). They are
affine in the pixel, so one 3x3 matrix per face gives the depth, perspective-correct texture coordinates and their
derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.raycasting import cast
from p2p_lib.synthetic import texture
from p2p_lib.synthetic.environment import Environment, fresnel, mirrored
from p2p_lib.synthetic.shapes import Mesh

_NEAR_M = 0.01


@dataclass(frozen=True)
class Light:
    """One distant light, and light from everywhere.

    towards      points from the scene to the light (any length)
    ambient      share of the light that comes from everywhere
    shadow       share of the light that is lost on the room where bodies cover all of the lamp; 0 = no shadows
    environment  what glossy surfaces mirror, and how blurred (glaze: a degree); None = nothing
    """

    towards: tuple[float, float, float] = (-0.35, -0.8, 0.75)
    ambient: float = 0.5
    environment: Environment | None = None
    roughness_rad: float = 0.02
    shadow: float = 0.0


@dataclass(frozen=True, eq=False)
class Rendering:
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
    background: Rendering | None = None,
) -> Rendering:
    """Bodies (mesh, T_world_model) seen by a camera at T_world_cam, in front of an earlier image of the same view."""
    H, W = camera.height, camera.width
    T_cam_world = se3.inverse(np.asarray(T_world_cam, float))
    if background is None:
        nothing = np.zeros((H, W))
        background = Rendering(np.zeros((H, W, 3), np.float32), nothing, nothing, nothing.astype(np.float32))
    rgb, cosine = background.rgb.reshape(-1, 3).copy(), background.cos_incidence.ravel().copy()
    depth = np.where(background.depth_m > 0, background.depth_m, np.inf).ravel()
    label, drawn = np.zeros(H * W, np.uint8), []
    for k, (mesh, T_world_model) in enumerate(bodies, 1):
        hits, depth_m = _hits(mesh, T_cam_world @ T_world_model, camera)
        nearer = depth_m < depth[hits.pixel]
        hits = hits.select(nearer)
        depth[hits.pixel], label[hits.pixel] = depth_m[nearer], k
        drawn.append(hits)
    for k, hits in enumerate(drawn, 1):
        seen = hits.select(label[hits.pixel] == k)
        if len(seen.pixel):
            rgb[seen.pixel], cosine[seen.pixel] = _shade(seen, camera, light or Light(), T_cam_world)
    depth[np.isinf(depth)] = 0
    return Rendering(rgb.reshape(H, W, 3), depth.reshape(H, W), label.reshape(H, W), cosine.reshape(H, W))


@dataclass(frozen=True, eq=False)
class _Hits:
    """Where pixels meet a body.

    R_cam_model  (3, 3)
    pixel        (N,) flat indices
    face         (N,) which face each shows
    planes       (F, 3, 3) ``planes[f] @ (u, v, 1)`` are the barycentric coordinates on a face that shows over the depth
    """

    mesh: Mesh
    R_cam_model: np.ndarray
    pixel: np.ndarray
    face: np.ndarray
    planes: np.ndarray

    def select(self, pixels: np.ndarray) -> _Hits:
        """Some of the pixels, by a mask (N,)."""
        return replace(self, pixel=self.pixel[pixels], face=self.face[pixels])


def _hits(mesh: Mesh, T_cam_model: np.ndarray, camera: Camera) -> tuple[_Hits, np.ndarray]:
    """What pixels see of a body that is alone, and at which depth (N,) in metres."""
    p_cam = se3.transform(T_cam_model, mesh.vertices)
    pixel = _pixels_around(p_cam, camera)
    T_model_cam = se3.inverse(T_cam_model)
    rays = camera.rays.reshape(-1, 3)[pixel].astype(float) @ T_model_cam[:3, :3].T
    face = cast(mesh.ray_scene, T_model_cam[:3, 3], rays)["primitive_ids"].astype(np.int32)
    met = face >= 0  # -1 where a ray meets nothing
    pixel, face = pixel[met], face[met]
    shown = np.flatnonzero(np.bincount(face))
    a, b, c = np.moveaxis(p_cam[mesh.faces[shown]], 1, 0)
    # The inverse of a matrix of three columns is their cross products over the determinant.
    inverse = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)
    inverse /= np.einsum("nc,nc->n", a, inverse[:, 0])[:, None, None]
    planes = np.zeros((len(mesh.faces), 3, 3))
    planes[shown] = inverse @ np.linalg.inv(camera.K)
    v, u = np.divmod(pixel, camera.width)
    per_u, per_v, offset = planes.sum(1).T
    depth_m = 1 / (per_u[face] * u + per_v[face] * v + offset[face])
    return _Hits(mesh, T_cam_model[:3, :3], pixel, face, planes), depth_m


def _pixels_around(p_cam: np.ndarray, camera: Camera) -> np.ndarray:
    """Flat indices of the pixels in the box around projected points (V, 3); all where a point is behind the camera."""
    low, high = np.zeros(2, int), np.array([camera.width, camera.height]) - 1
    if p_cam[:, 2].min() > _NEAR_M:
        uv = camera.project(p_cam)
        low, high = (np.clip(edge, low - 1, high + 1).astype(int) for edge in (np.ceil(uv.min(0)), np.floor(uv.max(0))))
        low, high = low.clip(0), np.minimum(high, [camera.width - 1, camera.height - 1])
    u, v = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    return (v[:, None] * camera.width + u).ravel()


def _shade(seen: _Hits, camera: Camera, light: Light, T_cam_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (N, 3) and cosine of incidence (N,) of pixels."""
    mesh, face = seen.mesh, seen.face
    assert mesh.normals is not None and mesh.reflectance is not None, "a mesh fills them in"
    v, u = np.divmod(seen.pixel, camera.width)
    # What is of faces is worked out there and then taken: they are fewer than pixels.
    per_u, per_v, offset = (np.ascontiguousarray(seen.planes[..., k])[face] for k in range(3))
    over_z = per_u * u[:, None] + per_v * v[:, None] + offset
    inv_z = over_z.sum(1, keepdims=True)
    weight = over_z / inv_z
    # How the barycentric weights change from pixel to pixel, to the right and down.
    totals = seen.planes.sum(1)
    slopes = [(per - weight * totals[face, a, None]) / inv_z for a, per in enumerate((per_u, per_v))]

    def change_per_px(of_corners: np.ndarray) -> np.ndarray:
        return np.maximum(*(np.linalg.norm(_mixed(slope, of_corners), axis=1) for slope in slopes))

    uv, normals = mesh.uv[face], mesh.normals[face]
    texels = uv * mesh.texture.shape[1::-1]
    colour = texture.lookup(mesh.mipmap, _mixed(weight, uv), change_per_px(texels))
    ray = _directions(camera)[seen.pixel]
    cosine = -np.einsum("nc,nc->n", (mesh.face_normals @ seen.R_cam_model.T)[face], ray)
    normal = _mixed(weight, normals) @ seen.R_cam_model.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    towards = T_cam_world[:3, :3] @ (np.asarray(light.towards, float) / np.linalg.norm(light.towards))
    side = np.where(cosine < 0, -1.0, 1.0)
    lit = light.ambient + (1 - light.ambient) * np.maximum(0, side * (normal @ towards))
    colour = colour * lit[:, None].astype(np.float32)
    if light.environment is not None and mesh.reflectance.any():
        reflectance = mesh.reflectance[face]
        share = np.where(reflectance > 0, fresnel(reflectance, np.einsum("nc,nc->n", -ray, normal)), 0)
        away = ray - 2 * np.einsum("nc,nc->n", ray, normal)[:, None] * normal
        spread_rad = 2 * change_per_px(normals) + light.roughness_rad
        shown = mirrored(light.environment, away @ T_cam_world[:3, :3], spread_rad)
        colour += share[:, None].astype(np.float32) * (shown - colour)
    return colour, np.abs(cosine).astype(np.float32)


@lru_cache(maxsize=4)
def _directions(camera: Camera) -> np.ndarray:
    """(H * W, 3) unit vectors along the rays of pixels."""
    rays = camera.rays.reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _mixed(weight: np.ndarray, of_corners: np.ndarray) -> np.ndarray:
    """Values at the corners (N, 3, C) summed with weights (N, 3): (N, C)."""
    return np.einsum("nk,nkc->nc", weight, of_corners)
