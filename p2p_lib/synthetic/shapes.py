"""Textured meshes: procedural packages, and any mesh with a texture from disk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.synthetic import labels

#: Print resolution of the procedural labels; at 0.5 m and 615 px focal length the picture has 1.2 px/mm.
TEXELS_PER_M = 3000.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """A rigid surface with a picture on it. Faces are counter-clockwise seen from outside.

    vertices     (V, 3) float64, metres, model frame
    faces        (F, 3) int
    uv           (F, 3, 2) texture coordinates per face corner, (0, 0) = bottom left of the texture
    texture      (H, W, 3) uint8, RGB
    normals      (F, 3, 3) unit normals per face corner for shading; None = those of the flat faces
    closed       faces seen from behind are not drawn
    reflectance  (F,) share of light mirrored at normal incidence (glaze 0.05); None = matt all over
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    normals: np.ndarray | None = None
    closed: bool = True
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
        """The texture, each next level averaged to half the size, down to one texel: (h, w, 3) float32."""
        levels = [self.texture.astype(np.float32)]
        while max(levels[-1].shape[:2]) > 1:
            h, w = levels[-1].shape[:2]
            half = (max(1, w // 2), max(1, h // 2))
            levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
        return levels

    def sample(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draws n points (n, 3) and normals (n, 3) on the surface, even in area, in model coordinates."""
        area = np.linalg.norm(self._doubled_area_normals, axis=1)
        # One point per equal share of area: even cover with fewer points than independent draws.
        at = (np.arange(n) + rng.uniform(0, 1, n)) / n * area.sum()
        face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
        r, s = np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 1, n)
        weights = np.stack([1 - r, r * (1 - s), r * s], 1)
        return np.einsum("nk,nkc->nc", weights, self.vertices[self.faces[face]]), self.face_normals[face]


def box(rng: np.random.Generator, size_m: tuple[float, float, float], contrast: float = 1.0) -> Mesh:
    """A carton of size (x, y, z), centred, with six printed panels; the front faces -y, the top +z."""
    x, y, z = (max(8, round(s * TEXELS_PER_M)) for s in size_m)
    sides = [labels.label(rng, w, z, contrast, front) for w, front in ((x, True), (y, False), (x, True), (y, False))]
    ends = [labels.label(rng, x, y, contrast, front) for front in (True, False)]
    return _carton(size_m, sides, ends)


def slab(rng: np.random.Generator, size_m: tuple[float, float, float]) -> Mesh:
    """A plain board of size (x, y, z), centred: an occluder."""
    x, y, z = (max(8, round(s * TEXELS_PER_M / 3)) for s in size_m)
    sides = [labels.cardboard(rng, w, z) for w in (x, y, x, y)]
    return _carton(size_m, sides, [labels.cardboard(rng, x, y) for _ in range(2)])


def can(rng: np.random.Generator, radius_m: float, height_m: float, contrast: float = 1.0, segments: int = 72) -> Mesh:
    """A tin around the z axis, centred, with a label wrapped around it and two lids."""
    around, tall = round(2 * np.pi * radius_m * TEXELS_PER_M), round(height_m * TEXELS_PER_M)
    disc = round(2 * radius_m * TEXELS_PER_M)
    texture = np.zeros((tall + disc, max(around, 2 * disc), 3), np.uint8)
    texture[:tall, :around] = labels.wrapped_label(rng, around, tall, contrast)
    for k in range(2):
        texture[tall:, k * disc : (k + 1) * disc] = labels.lid(rng, disc, contrast)
    H, W = texture.shape[:2]

    rows = max(2, round(height_m / 0.01))
    across, up = np.linspace(0, 1, segments + 1), np.linspace(0, 1, rows + 1)
    side = grid(across, up)
    angle = 2 * np.pi * side[..., 0]
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
    points = out * radius_m + (side[..., 1:] - 0.5) * [0, 0, height_m]
    parts = [(points, side * [around / W, tall / H] + [0, disc / H], out)]
    rim = np.stack([across[:-1], across[1:]], -1) * 2 * np.pi
    fan = np.stack([np.zeros_like(rim[:, :1].repeat(2, 1)), np.stack([np.cos(rim[:, 0]), np.sin(rim[:, 0])], -1)], 1)
    fan = np.concatenate([fan, np.stack([np.cos(rim[:, 1]), np.sin(rim[:, 1])], -1)[:, None]], 1)
    for k, sign in enumerate((1, -1)):
        flat = fan if sign > 0 else fan[:, ::-1]
        p = np.concatenate([flat * radius_m, np.full((segments, 3, 1), sign * height_m / 2)], -1)
        # Just inside the disc's edge, so that filtering does not mix in what lies outside.
        uv = ((flat * [sign, 1] * 0.98 / 2 + 0.5) * disc + [k * disc, 0]) / [W, H]
        parts.append((p, uv, np.broadcast_to([0.0, 0, sign], p.shape)))
    corners, uv, normals = (np.concatenate(a) for a in zip(*parts, strict=True))
    return welded(corners, uv, texture, normals)


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
    around = [np.stack([foot[k], foot[k - 4], top[k - 4], top[k]]) for k in range(5)]
    return _flat_faced([*around, top, foot[::-1]], [0, 0, -height_m / 2], rng, contrast)


def plane(texture: np.ndarray, corners_m: np.ndarray) -> Mesh:
    """A flat picture: corners (4, 3) bottom left, bottom right, top right, top left of the texture."""
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(np.asarray(corners_m, float), faces, uv[faces], texture, closed=False)


def load_mesh(path: str | Path) -> Mesh:
    """Any mesh with a texture that trimesh reads (metres), such as a YCB ``textured.obj``."""
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise MissingData(f"mesh {path}", "no such file")
    m = trimesh.load(path, process=False, force="mesh")
    uv = getattr(m.visual, "uv", None)
    material = getattr(m.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if uv is None or image is None:
        raise BadInput(f"mesh {path}", "no texture", "a mesh with texture coordinates and a picture")
    faces = np.asarray(m.faces)
    normals = np.asarray(m.vertex_normals)[faces]
    return Mesh(np.asarray(m.vertices, float), faces, np.asarray(uv)[faces], np.array(image.convert("RGB")), normals)


def grid(across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Two counter-clockwise triangles per cell of a grid in the plane: (2 * cells, 3, 2)."""
    a0, u0 = np.meshgrid(across[:-1], up[:-1])
    a1, u1 = np.meshgrid(across[1:], up[1:])
    p00, p10, p11, p01 = (np.stack([a.ravel(), u.ravel()], -1) for a, u in ((a0, u0), (a1, u0), (a1, u1), (a0, u1)))
    return np.concatenate([np.stack([p00, p10, p11], 1), np.stack([p00, p11, p01], 1)])


def _carton(size_m: tuple, sides: list[np.ndarray], ends: list[np.ndarray]) -> Mesh:
    """Panels -y, +x, +y, -x and top, bottom around a box; faces of about 1 cm, so that vertices cover the surface."""
    top_row, low_row = np.hstack(sides), np.hstack(ends)
    H, W = len(top_row) + len(low_row), max(top_row.shape[1], low_row.shape[1])
    texture = np.full((H, W, 3), 128, np.uint8)
    texture[: len(top_row), : top_row.shape[1]] = top_row
    texture[len(top_row) :, : low_row.shape[1]] = low_row
    x, y, z = np.eye(3)
    frames = [(x, z), (y, z), (-x, z), (-y, z), (x, y), (-x, y)]
    size, left, parts = np.asarray(size_m, float), 0, []
    for k, ((right, up), panel) in enumerate(zip(frames, sides + ends, strict=True)):
        out = np.cross(right, up)
        w, h = np.abs(right) @ size, np.abs(up) @ size
        cells = grid(*(np.linspace(0, 1, max(1, round(s / 0.01)) + 1) for s in (w, h)))
        p = (cells[..., :1] - 0.5) * w * right + (cells[..., 1:] - 0.5) * h * up + out * (np.abs(out) @ size) / 2
        left = 0 if k == 4 else left
        bottom = 0 if k >= 4 else len(low_row)
        uv = (cells * panel.shape[1::-1] + [left, bottom]) / [W, H]
        left += panel.shape[1]
        parts.append((p, uv, np.broadcast_to(out, p.shape)))
    corners, uv, normals = (np.concatenate(a) for a in zip(*parts, strict=True))
    return welded(corners, uv, texture, normals)


def _flat_faced(faces: list[np.ndarray], shift: list[float], rng: np.random.Generator, contrast: float) -> Mesh:
    """A solid of flat convex faces (corners (K, 3) counter-clockwise), each with a label of its own."""
    panels, parts = [], []
    for corners in faces:
        right = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        out = np.cross(right, corners[2] - corners[1])
        out /= np.linalg.norm(out)
        flat = (corners - corners[0]) @ np.stack([right, np.cross(out, right)], 1)
        flat -= flat.min(0)
        w, h = np.maximum(8, np.round(flat.max(0) * TEXELS_PER_M)).astype(int)
        panels.append(labels.label(rng, w, h, contrast, front=len(panels) % 2 == 0))
        fan = np.stack([[0, k, k + 1] for k in range(1, len(corners) - 1)])
        parts.append((corners[fan] + shift, flat[fan] / flat.max(0), np.broadcast_to(out, (len(fan), 3, 3))))
    bottom = np.cumsum([0, *(len(p) for p in panels)])
    texture = np.full((bottom[-1], max(p.shape[1] for p in panels), 3), 128, np.uint8)
    H, W = texture.shape[:2]
    uvs = []
    for panel, low, (_, uv, _) in zip(panels, bottom, parts, strict=False):
        texture[H - low - len(panel) : H - low, : panel.shape[1]] = panel
        uvs.append((uv * panel.shape[1::-1] + [0, low]) / [W, H])
    corners, normals = (np.concatenate([p[k] for p in parts]) for k in (0, 2))
    return welded(corners, np.concatenate(uvs), texture, normals)


def welded(corners: np.ndarray, uv: np.ndarray, texture: np.ndarray, normals: np.ndarray) -> Mesh:
    """A mesh from loose triangles (F, 3, 3): corners at one place become one vertex."""
    flat = corners.reshape(-1, 3)
    _, first, index = np.unique(np.round(flat, 9), axis=0, return_index=True, return_inverse=True)
    return Mesh(flat[first], index.reshape(-1, 3), uv, texture, np.array(normals))
