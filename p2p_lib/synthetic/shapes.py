"""Textured meshes: procedural packages, and any mesh with a texture from disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.raycasting import SurfaceDistance, ray_scene
from p2p_lib.synthetic import labels, texture

#: Print resolution of the procedural labels; at 0.5 m and 615 px focal length the image has 1.2 px/mm.
TEXELS_PER_M = 3000.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """A rigid surface with an image on it. Faces are counter-clockwise seen from outside.

    vertices     (V, 3) float64, metres, model frame
    faces        (F, 3) int
    uv           (F, 3, 2) texture coordinates per face corner, (0, 0) = bottom left of the texture
    texture      (H, W, 3) uint8, RGB
    normals      (F, 3, 3) unit normals per face corner for shading; None = those of the flat faces
    reflectance  (F,) share of light mirrored at normal incidence (glaze 0.05); None = matt all over
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    normals: np.ndarray | None = None
    reflectance: np.ndarray | None = None

    def __post_init__(self) -> None:
        F = len(self.faces)
        if self.faces.shape != (F, 3) or self.uv.shape != (F, 3, 2) or self.vertices.shape[1:] != (3,):
            shapes = f"vertices {self.vertices.shape}, faces {self.faces.shape}, uv {self.uv.shape}"
            raise BadInput("mesh", shapes, "(V, 3), (F, 3), (F, 3, 2)")
        if self.texture.ndim != 3 or self.texture.shape[2] != 3 or self.texture.dtype != np.uint8:
            raise BadInput("mesh texture", f"{self.texture.shape} {self.texture.dtype}", "(H, W, 3) uint8")
        if self.normals is None:
            object.__setattr__(self, "normals", np.repeat(self.face_normals[:, None], 3, 1))
        if self.reflectance is None:
            object.__setattr__(self, "reflectance", np.zeros(F))

    @cached_property
    def face_normals(self) -> np.ndarray:
        """(F, 3) outward unit normals (zero for a face without area)."""
        n = self._doubled_area_normals
        length = np.linalg.norm(n, axis=1, keepdims=True)
        return n / np.where(length > 0, length, 1)

    @property
    def _doubled_area_normals(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def mipmap(self) -> list[np.ndarray]:
        """The texture at every size, see :func:`p2p_lib.synthetic.texture.mipmap`."""
        return texture.mipmap(self.texture)

    @cached_property
    def ball(self) -> tuple[np.ndarray, float]:
        """Middle (3,) and radius of a ball around it."""
        centre = (self.vertices.max(0) + self.vertices.min(0)) / 2
        return centre, float(np.linalg.norm(self.vertices - centre, axis=1).max())

    @cached_property
    def ray_scene(self) -> Any:
        """The mesh for :mod:`p2p_lib.core.raycasting`."""
        return ray_scene(self.vertices, self.faces)

    @cached_property
    def distance(self) -> SurfaceDistance:
        """How far points are from the surface."""
        return SurfaceDistance(self.vertices, self.faces)

    def sample(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draws n points (n, 3) and normals (n, 3) on the surface, even in area, in model coordinates."""
        area = np.linalg.norm(self._doubled_area_normals, axis=1)
        # One point per equal share of area: even cover with fewer points than independent draws.
        at = (np.arange(n) + rng.uniform(0, 1, n)) / n * area.sum()
        face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
        r, s = np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 1, n)
        weights = np.stack([1 - r, r * (1 - s), r * s], 1)
        return np.einsum("nk,nkc->nc", weights, self.vertices[self.faces[face]]), self.face_normals[face]


@dataclass(frozen=True, eq=False)
class Patch:
    """Loose triangles with an image of their own, from which :func:`assembled` makes a mesh.

    corners  (F, 3, 3) metres
    uv       (F, 3, 2) on the patch's image, (0, 0) = bottom left
    normals  (F, 3, 3)
    image    (H, W, 3) uint8
    """

    corners: np.ndarray
    uv: np.ndarray
    normals: np.ndarray
    image: np.ndarray


def assembled(patches: Sequence[Patch], rows: Sequence[Sequence[int]] = ((0,),), ground: int = 128) -> Mesh:
    """One mesh of patches: corners at one place become one vertex, the images parts of one texture.

    rows    which patches' images stand side by side in each row of the texture, from the top
    ground  grey level of the texture where there is none
    """
    page, uv = _on_one_page([(patch.image, patch.uv) for patch in patches], rows, ground)
    flat = np.concatenate([patch.corners for patch in patches]).reshape(-1, 3)
    _, first, index = np.unique(np.round(flat, 9), axis=0, return_index=True, return_inverse=True)
    normals = np.concatenate([patch.normals for patch in patches])
    return Mesh(flat[first], index.reshape(-1, 3), uv, page, normals)


def _on_one_page(
    images: Sequence[tuple[np.ndarray, np.ndarray]], rows: Sequence[Sequence[int]], ground: int = 128
) -> tuple[np.ndarray, np.ndarray]:
    """Images with coordinates (F, 3, 2) on each, in rows on one texture (H, W, 3), and all coordinates on that."""
    sizes = [image.shape[1::-1] for image, _ in images]
    heights = [max(sizes[k][1] for k in row) for row in rows]
    W, H = max(sum(sizes[k][0] for k in row) for row in rows), sum(heights)
    page = np.full((H, W, 3), ground, np.uint8)
    uv: list[np.ndarray] = [np.zeros(0)] * len(images)
    for row, top in zip(rows, np.cumsum([0, *heights]), strict=False):
        left = 0
        for k in row:
            w, h = sizes[k]
            page[top : top + h, left : left + w] = images[k][0]
            uv[k] = (images[k][1] * [w, h] + [left, H - top - h]) / [W, H]
            left += w
    return page, np.concatenate(uv)


def box(rng: np.random.Generator, size_m: tuple[float, float, float], contrast: float = 1.0) -> Mesh:
    """A carton of size (x, y, z), centred, with six printed panels; the front faces -y, the top +z."""
    x, y, z = (max(8, round(s * TEXELS_PER_M)) for s in size_m)
    sides = [labels.label(rng, w, z, contrast, front) for w, front in ((x, True), (y, False), (x, True), (y, False))]
    ends = [labels.label(rng, x, y, contrast, front) for front in (True, False)]
    return six_sided(size_m, sides + ends)


def slab(rng: np.random.Generator, size_m: tuple[float, float, float]) -> Mesh:
    """A plain board of size (x, y, z), centred: an occluder."""
    x, y, z = (max(8, round(s * TEXELS_PER_M / 3)) for s in size_m)
    panels = (x, z), (y, z), (x, z), (y, z), (x, y), (x, y)
    return six_sided(size_m, [labels.cardboard(rng, w, h) for w, h in panels])


def can(rng: np.random.Generator, radius_m: float, height_m: float, contrast: float = 1.0, segments: int = 72) -> Mesh:
    """A tin around the z axis, centred, with a label wrapped around it and two lids."""
    around, tall, disc = (round(s * TEXELS_PER_M) for s in (2 * np.pi * radius_m, height_m, 2 * radius_m))
    across, up = np.linspace(0, 1, segments + 1), np.linspace(0, 1, max(2, round(height_m / 0.01)) + 1)
    cells = grid(across, up)
    angle = 2 * np.pi * cells[..., 0]
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
    corners = out * radius_m + (cells[..., 1:] - 0.5) * [0, 0, height_m]
    patches = [Patch(corners, cells, out, labels.wrapped_label(rng, around, tall, contrast))]
    rim = np.stack([np.cos(2 * np.pi * across), np.sin(2 * np.pi * across)], -1)
    fan = np.stack([np.zeros_like(rim[1:]), rim[:-1], rim[1:]], 1)
    for sign in (1, -1):
        flat = fan if sign > 0 else fan[:, ::-1]
        corners = np.concatenate([flat * radius_m, np.full((segments, 3, 1), sign * height_m / 2)], -1)
        # Just inside the disc's edge, so that filtering does not mix in what lies outside.
        uv = flat * [sign, 1] * 0.98 / 2 + 0.5
        normals = np.broadcast_to([0.0, 0, sign], corners.shape)
        patches.append(Patch(corners, uv, normals, labels.lid(rng, disc, contrast)))
    return assembled(patches, [[0], [1, 2]], ground=0)


def block(rng: np.random.Generator, radius_m: float, height_m: float, contrast: float = 1.0) -> Mesh:
    """A leaning, five-sided stump with a slanted top: seven flat, printed faces, no two alike, and no symmetry.

    Its sides lie on planes through one apex, so that they stay flat. Its origin is the middle of its height.
    """
    angle = np.radians(72 * np.arange(5) + rng.uniform(-20, 20, 5) + rng.uniform(0, 360))
    foot = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) * radius_m * rng.uniform(0.75, 1.25, 5)[:, None]
    apex = np.r_[rng.uniform(-0.6, 0.6, 2) * radius_m, 2.6 * height_m]
    slant = np.r_[rng.uniform(0.2, 0.35) * np.array([np.cos(angle[0] + 1), np.sin(angle[0] + 1)]), 1]
    share = (height_m - foot @ slant) / ((apex - foot) @ slant)
    top = foot + share[:, None] * (apex - foot)
    sides = [np.stack([foot[k], foot[k - 4], top[k - 4], top[k]]) for k in range(5)]
    patches = []
    for k, corners in enumerate([*sides, top, foot[::-1]]):
        right = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        out = np.cross(right, corners[2] - corners[1])
        out /= np.linalg.norm(out)
        flat = (corners - corners[0]) @ np.stack([right, np.cross(out, right)], 1)
        flat -= flat.min(0)
        w, h = np.maximum(8, np.round(flat.max(0) * TEXELS_PER_M)).astype(int)
        fan = np.stack([[0, i, i + 1] for i in range(1, len(corners) - 1)])
        placed, normals = corners[fan] - [0, 0, height_m / 2], np.broadcast_to(out, (len(fan), 3, 3))
        image = labels.label(rng, w, h, contrast, front=k % 2 == 0)
        patches.append(Patch(placed, flat[fan] / flat.max(0), normals, image))
    return assembled(patches, [[k] for k in reversed(range(len(patches)))])


def plane(image: np.ndarray, corners_m: ArrayLike) -> Mesh:
    """A flat image: corners (4, 3) at its bottom left, bottom right, top right, top left."""
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(np.asarray(corners_m, float), faces, uv[faces], image)


def joined(parts: Sequence[tuple[Mesh, np.ndarray]]) -> Mesh:
    """One mesh of several at poses (4, 4), each in its frame; their textures stand one on the other."""
    page, uv = _on_one_page([(mesh.texture, mesh.uv) for mesh, _ in parts], [[k] for k in range(len(parts))])
    meshes = [moved(mesh, T) for mesh, T in parts]
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + count for mesh, count in zip(meshes, before, strict=False)])
    vertices, normals, mirrors = (
        np.concatenate([getattr(mesh, key) for mesh in meshes]) for key in ("vertices", "normals", "reflectance")
    )
    return Mesh(vertices, faces, uv, page, normals, mirrors)


def moved(mesh: Mesh, T: np.ndarray) -> Mesh:
    """The mesh with its vertices moved by T (4, 4): part of a room."""
    return replace(mesh, vertices=se3.transform(T, mesh.vertices), normals=mesh.normals @ T[:3, :3].T)


def load_ycb(models: str | Path, name: str) -> Mesh:
    """A model of a folder of YCB models (``NAME/textured.obj``, metres)."""
    return load_mesh(Path(models) / name / "textured.obj")


def load_mesh(path: str | Path) -> Mesh:
    """Any mesh with a texture that trimesh reads (metres), such as a YCB ``textured.obj``."""
    import trimesh

    path = Path(path).expanduser()
    if not path.is_file():
        raise MissingData(f"mesh {path}", "no such file", "YCB models lie in a folder each: NAME/textured.obj.")
    m: Any = trimesh.load(path, process=False, force="mesh")
    uv = getattr(m.visual, "uv", None)
    material = getattr(m.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if uv is None or image is None:
        raise BadInput(f"mesh {path}", "no texture", "a mesh with texture coordinates and an image")
    faces = np.asarray(m.faces)
    normals = np.asarray(m.vertex_normals)[faces]
    return Mesh(np.asarray(m.vertices, float), faces, np.asarray(uv)[faces], np.array(image.convert("RGB")), normals)


def grid(across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Two counter-clockwise triangles per cell of a grid in the plane: (2 * cells, 3, 2)."""
    nodes = np.stack(np.meshgrid(across, up), -1)
    low_left, low_right, top_right, top_left = (
        corner.reshape(-1, 2) for corner in (nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, 1:], nodes[1:, :-1])
    )
    return np.concatenate([np.stack([low_left, low_right, top_right], 1), np.stack([low_left, top_right, top_left], 1)])


def six_sided(size_m: tuple[float, float, float], panels: list[np.ndarray]) -> Mesh:
    """A box of panels (images) -y, +x, +y, -x, top, bottom; faces of about 1 cm, so that vertices cover the surface."""
    x, y, z = np.eye(3)
    size, patches = np.asarray(size_m, float), []
    for (right, up), panel in zip([(x, z), (y, z), (-x, z), (-y, z), (x, y), (-x, y)], panels, strict=True):
        out = np.cross(right, up)
        w, h, deep = (np.abs(axis) @ size for axis in (right, up, out))
        cells = grid(*(np.linspace(0, 1, max(1, round(s / 0.01)) + 1) for s in (w, h)))
        corners = (cells[..., :1] - 0.5) * w * right + (cells[..., 1:] - 0.5) * h * up + out * deep / 2
        patches.append(Patch(corners, cells, np.broadcast_to(out, corners.shape), panel))
    return assembled(patches, [[0, 1, 2, 3], [4, 5]])
