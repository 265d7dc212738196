"""Solids of revolution and bent tubes: a mug with its handle."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.synthetic import labels
from p2p_lib.synthetic.shapes import TEXELS_PER_M, Mesh, grid, welded


def mug(rng: np.random.Generator, radius_m: float, height_m: float, reflectance: float, marks: int) -> Mesh:
    """A bellied mug of dark glaze around the z axis, centred, its handle towards +x.

    The body is a solid of revolution and mirrors its surroundings (``reflectance`` at normal incidence):
    what it shows stays where it is when the mug turns. Only ``marks`` small prints and the speckled,
    matt handle turn with it.
    """
    profile = _mug_profile(radius_m, height_m)
    length = np.linalg.norm(np.diff(profile, axis=0), axis=1).sum()
    around, along = round(2 * np.pi * radius_m * TEXELS_PER_M), round(length * TEXELS_PER_M)
    glaze = np.empty((along, around, 3), np.uint8)
    glaze[:] = rng.uniform(28, 70, 3)
    _print_marks(rng, glaze, marks, int(height_m * TEXELS_PER_M))
    body = revolved(profile, glaze)
    t = np.linspace(-1.0, 1.0, 17)
    bow = np.stack([np.cos(t * np.pi / 2) ** 0.6 * 0.75 * radius_m, np.zeros_like(t), t * 0.30 * height_m], 1)
    # Both ends end inside the wall, which is 4 mm thick.
    inner = np.interp(bow[:, 2], *_outside(profile)) - 0.002
    handle = tube(bow + np.stack([inner, 0 * t, 0 * t], 1), 0.008, _speckled(rng))
    return _united(body, handle, reflectance)


def revolved(profile: np.ndarray, texture: np.ndarray, segments: int = 72) -> Mesh:
    """The surface of a profile (P, 2) of radius and height turned about z; the texture runs around and up along it.

    The profile goes from bottom to top on the outside: its right side is outside.
    """
    step = np.diff(profile, axis=0)
    length = np.linalg.norm(step, axis=1)
    flat = np.stack([step[:, 1], -step[:, 0]], 1) / length[:, None]
    smooth = np.einsum("ij,ij->i", flat[:-1], flat[1:]) > np.cos(np.radians(35))
    mean = flat[:-1] + flat[1:]
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    start, stop = flat.copy(), flat.copy()
    start[1:][smooth], stop[:-1][smooth] = mean[smooth], mean[smooth]
    for end, one in ((start, 0), (stop, -1)):
        if profile[one, 0] < 1e-9 and abs(flat[one, 1]) > np.cos(np.radians(35)):
            end[one] = 0, np.sign(flat[one, 1])  # a smooth pole
    along = np.r_[0, np.cumsum(length)] / length.sum()
    cells = grid(np.linspace(0, 1, segments + 1), along)
    row = np.clip(np.searchsorted(along, cells[..., 1].mean(1)) - 1, 0, len(length) - 1)
    share = (cells[..., 1] - along[row, None]) / (along[row + 1] - along[row])[:, None]
    rz = profile[row][:, None] + share[..., None] * step[row][:, None]
    normal = start[row][:, None] + share[..., None] * (stop[row] - start[row])[:, None]
    angle = 2 * np.pi * cells[..., 0]
    out = np.stack([np.cos(angle), np.sin(angle)], -1)
    lifted = [np.concatenate([out * a[..., :1], a[..., 1:]], -1) for a in (rz, normal)]
    area = np.linalg.norm(np.cross(lifted[0][:, 1] - lifted[0][:, 0], lifted[0][:, 2] - lifted[0][:, 0]), axis=1)
    solid = area > 1e-12  # where the profile meets the axis one triangle of each cell vanishes
    return welded(lifted[0][solid], cells[solid], texture, lifted[1][solid])


def tube(path: np.ndarray, radius_m: float, texture: np.ndarray, segments: int = 14) -> Mesh:
    """A round tube along points (P, 3) of the plane y = 0, its ends open; the texture runs around and along."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.array([0, 1.0, 0])
    across = np.cross(tangent, side)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    cells = grid(np.linspace(0, 1, segments + 1), length / length[-1])
    row = np.argmin(np.abs(cells[..., 1:] - length / length[-1]), -1)
    angle = -2 * np.pi * cells[..., :1]
    out = np.cos(angle) * across[row] + np.sin(angle) * side
    return welded(path[row] + radius_m * out, cells, texture, out)


def _mug_profile(radius_m: float, height_m: float) -> np.ndarray:
    """Radius and height from the middle of the foot up the belly, over the rim, down to the middle inside."""
    h = height_m / 2
    z = np.linspace(-h, h, 25)
    outside = np.stack([radius_m * (0.62 + 0.38 * np.cos(z / h * 1.15)), z], 1)
    inside = outside[::-1][:23] - [0.004, 0]
    return np.concatenate([[[0, -h]], outside, inside, [[0, inside[-1, 1]]]])


def _outside(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights and radii of the outer wall."""
    return profile[1:26, 1], profile[1:26, 0]


def _print_marks(rng: np.random.Generator, glaze: np.ndarray, marks: int, tall: int) -> None:
    """Small prints, evenly around the belly at different heights; the outside starts at the texture's bottom."""
    along, around = glaze.shape[:2]
    foot = round(0.032 * TEXELS_PER_M)
    for k in range(marks):
        size = int(rng.uniform(40, 52))
        at = int((k + rng.uniform(0.2, 0.8)) / marks * around), along - foot - int(tall * rng.uniform(0.3, 0.75))
        ink = tuple(int(c) for c in rng.uniform(170, 240, 3))
        turn = rng.uniform(0, 2 * np.pi, 3)
        corners = np.stack([np.cos(turn), np.sin(turn)], 1) * size / 2 + at
        cv2.fillPoly(glaze, [corners.round().astype(np.int32)], ink, cv2.LINE_AA)
        cv2.circle(glaze, (at[0] + size // 3, at[1] - size // 3), size // 6, ink, -1, cv2.LINE_AA)


def _speckled(rng: np.random.Generator, width: int = 128, height: int = 512) -> np.ndarray:
    """Matt clay with dark and light speckles."""
    page = np.float32([176, 150, 120]) * (1 + 0.1 * labels.smooth_noise(rng, width, height, (2, 8), 3))[..., None]
    page = np.clip(page, 0, 255).astype(np.uint8)
    for _ in range(110):
        at = int(rng.integers(width)), int(rng.integers(height))
        shade = int(rng.choice([25, 60, 235]))
        cv2.circle(page, at, int(rng.integers(3, 9)), (shade, shade, int(shade * 0.9)), -1, cv2.LINE_AA)
    return page


def _united(glossy: Mesh, matt: Mesh, reflectance: float) -> Mesh:
    """Two meshes with one texture, the first one's above; only the first mirrors."""
    (h0, w0), (h1, w1) = glossy.texture.shape[:2], matt.texture.shape[:2]
    H, W = h0 + h1, max(w0, w1)
    texture = np.full((H, W, 3), 96, np.uint8)
    texture[:h0, :w0], texture[h0:, :w1] = glossy.texture, matt.texture
    uv = np.concatenate([(glossy.uv * [w0, h0] + [0, h1]) / [W, H], matt.uv * [w1, h1] / [W, H]])
    faces = np.concatenate([glossy.faces, matt.faces + len(glossy.vertices)])
    mirrors = np.repeat([reflectance, 0.0], [len(glossy.faces), len(matt.faces)])
    vertices = np.concatenate([glossy.vertices, matt.vertices])
    return Mesh(vertices, faces, uv, texture, np.concatenate([glossy.normals, matt.normals]), reflectance=mirrors)
