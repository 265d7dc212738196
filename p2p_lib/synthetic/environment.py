"""What a glossy surface mirrors: an image of the room all around, far away, with lights brighter than white."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from p2p_lib.synthetic import texture
from p2p_lib.synthetic.labels import smooth_noise

#: Light arriving from every direction of the world (z up), see :func:`p2p_lib.synthetic.texture.mipmap`: (H, W, 3),
#: RGB, 255 = white paper in full light; columns are azimuth from -180 to 180 degrees (0 = +x, 90 = +y), rows elevation
#: from 90 degrees (top) to -90. Blur does not reach across the seam at 180 degrees or around the poles.
Environment = list[np.ndarray]


def mirrored(environment: Environment, direction: np.ndarray, spread_rad: np.ndarray) -> np.ndarray:
    """Light (N, 3) from unit directions (N, 3), averaged over cones of that width (N,)."""
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    elevation = np.arcsin(np.clip(direction[:, 2], -1, 1))
    uv = np.stack([azimuth / (2 * np.pi) + 0.5, elevation / np.pi + 0.5], 1)
    return texture.lookup(environment, uv, spread_rad / (np.pi / len(environment[0])))


def fresnel(reflectance: float, cosine: np.ndarray) -> np.ndarray:
    """Share of light that a surface mirrors (Schlick, 1994): ``reflectance`` at normal incidence, all at grazing."""
    return reflectance + (1 - reflectance) * (1 - np.clip(cosine, 0, 1)) ** 5


def living_room(rng: np.random.Generator, windows: int = 2, height: int = 512) -> Environment:
    """Four places opposite the table: ``windows`` (0 to 4) with the street behind them, shelves elsewhere; and lamps.

    A glaze mirrors a twentieth: only what is several times brighter than paper shows in it. Windows and lamps do.
    """
    width, per_deg = 2 * height, height / 180
    page = np.empty((height, width, 3), np.float32)
    page[: height // 2], page[height // 2 :] = (120, 118, 112), (95, 72, 52)
    page *= 1 + 0.15 * smooth_noise(rng, width, height, (8, 4), 4)[..., None]
    az = -90 - 75 + rng.uniform(-10, 10)
    for wide, rank in zip(rng.uniform(30, 45, 4), (2, 0, 1, 3), strict=True):  # windows opposite the table first
        furnish = _window if rank < windows else _shelf
        left, right = (int((a + 180) * per_deg) for a in (az, az + wide))
        furnish(rng, page, left, right, int(rng.uniform(25, 40) * per_deg), int(rng.uniform(105, 125) * per_deg))
        az += wide + rng.uniform(4, 10)
    for _ in range(3):
        at = int(rng.uniform(0.05, 0.6) * width), int(rng.uniform(8, 24) * per_deg)
        cv2.ellipse(page, at, (int(14 * per_deg), int(4 * per_deg)), 0, 0, 360, (3800, 3600, 3100), -1, cv2.LINE_AA)
    return texture.mipmap(page)


def _window(rng: np.random.Generator, page: np.ndarray, left: int, right: int, top: int, bottom: int) -> None:
    """Sky, roofs, trees at several times the brightness of paper, behind a dark cross of bars."""
    h, w = bottom - top, right - left
    sky = np.linspace(3600, 2200, h, dtype=np.float32)[:, None, None] * np.array([0.92, 0.97, 1.0], np.float32)
    view = np.broadcast_to(sky, (h, w, 3)).copy()
    for _ in range(int(rng.integers(6, 10))):
        x, y, size = int(rng.uniform(0, w)), int(h * rng.uniform(0.15, 0.9)), int(w * rng.uniform(0.12, 0.3))
        colour = tuple(float(c) for c in rng.uniform(150, 1500) * rng.uniform(0.7, 1.0, 3))
        cv2.rectangle(view, (x - size // 2, y), (x + size // 2, y + size), colour, -1)
    page[top:bottom, left:right] = view
    bar = int(5 * h / 90)
    for x in np.linspace(left, right, int(rng.integers(2, 4))).astype(int):
        page[top:bottom, max(0, x - bar // 2) : x + bar // 2 + 1] = 60
    for y in np.linspace(top, bottom, int(rng.integers(5, 9))).astype(int):
        page[y - bar // 2 : y + bar // 2 + 1, left:right] = 60


def _shelf(rng: np.random.Generator, page: np.ndarray, left: int, right: int, top: int, bottom: int) -> None:
    """Rows of books."""
    rows = np.linspace(top, bottom, 5).astype(int)
    for a, b in pairwise(rows):
        x = left
        while x < right:
            book = int(rng.integers(3, 8))
            page[a + 2 : b, x : min(x + book, right)] = rng.uniform(10, 260, 3)
            x += book
