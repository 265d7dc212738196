"""Printed matter, made up: package labels, wood, cardboard. Everything is drawn on uint8 images from an rng."""

from __future__ import annotations

import cv2
import numpy as np

_BRANDS = ("NORDA", "Kestrel", "OLIVIA", "Montara", "PIKOLO", "Harvest", "BELLINI", "Lumen", "TAVOLA", "Rigel")
_GOODS = ("Oat Biscuits", "Green Lentils", "Tomato Soup", "Dark Cocoa", "Crispy Rice", "Wild Berries", "Corn Chips")
_SMALL = (
    "net weight 340 g   best before: see lid",
    "ingredients: wheat, cane sugar, palm oil,",
    "whey powder, salt, raising agent, aroma",
    "store in a cool and dry place. contains",
    "milk and gluten, may contain nuts. made",
    "in a family mill since 1897. recycle me",
)
_FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)


def label(rng: np.random.Generator, width: int, height: int, contrast: float = 1.0, front: bool = True) -> np.ndarray:
    """A package's panel, (height, width, 3) uint8: ``front`` shows brand and picture, else small print and bar code.

    ``contrast`` in [0, 1] fades the print towards the panel's ground colour.
    """
    ground, dark, accent = _palette(rng)
    page = np.empty((height, width, 3), np.uint8)
    page[:] = ground
    _blend_bands(rng, page, accent)
    if front:
        _blobs(rng, page, int(rng.integers(8, 14)))
        _brand(rng, page, dark, accent)
    else:
        _small_print(rng, page, dark)
        _bar_code(rng, page)
    cv2.rectangle(page, (1, 1), (width - 2, height - 2), dark, max(2, width // 120))
    faded = ground + contrast * (page.astype(np.float32) - ground)
    return np.clip(np.round(faded), 0, 255).astype(np.uint8)


def wrapped_label(rng: np.random.Generator, width: int, height: int, contrast: float = 1.0) -> np.ndarray:
    """A can's label, (height, width, 3) uint8: panels side by side, no two alike, that close around the can."""
    edges = np.linspace(0, width, 5).round().astype(int)
    front = (True, False, True, False)
    return np.hstack([label(rng, b - a, height, contrast, f) for a, b, f in zip(edges, edges[1:], front, strict=False)])


def lid(rng: np.random.Generator, size: int, contrast: float = 1.0) -> np.ndarray:
    """A can's lid, (size, size, 3) uint8: pressed rings, a pull tab, a printed date."""
    y, x = np.mgrid[:size, :size].astype(np.float32) / (size - 1) * 2 - 1
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    shade = 165 + contrast * (30 * np.cos(2 * angle + 0.7) + 22 * np.sign(np.sin(22 * r)) * (r > 0.45))
    page = np.repeat(np.clip(shade, 0, 255).astype(np.uint8)[..., None], 3, 2)
    ink = tuple(int(165 - contrast * v) for v in (120, 110, 60))
    cv2.ellipse(page, (size // 2, int(size * 0.36)), (size // 12, size // 7), 0, 0, 360, ink, size // 40, cv2.LINE_AA)
    date = f"{rng.integers(10, 28)}.{rng.integers(1, 12):02d}.{rng.integers(2025, 2031)}"
    cv2.putText(page, date, (int(size * 0.24), int(size * 0.64)), _FONTS[0], size / 330, ink, 2, cv2.LINE_AA)
    lot = f"L{rng.integers(1000, 9999)}"
    cv2.putText(page, lot, (int(size * 0.36), int(size * 0.76)), _FONTS[0], size / 380, ink, 2, cv2.LINE_AA)
    return page


def smooth_noise(rng: np.random.Generator, width: int, height: int, cells: tuple[int, int], octaves: int) -> np.ndarray:
    """(height, width) float32 in about [-1, 1]: octaves of noise, the coarsest of ``cells`` (across, down)."""
    total, weight = np.zeros((height, width), np.float32), 0.0
    for k in range(octaves):
        grid = rng.uniform(-1, 1, (cells[1] * 2**k, cells[0] * 2**k)).astype(np.float32)
        total += 0.5**k * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        weight += 0.5**k
    return total / weight


def wood(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A table top of planks, (height, width, 3) uint8."""
    grain = smooth_noise(rng, width, height, (3, 40), 4) + 0.5 * smooth_noise(rng, width, height, (6, 6), 3)
    planks = np.repeat(rng.uniform(-0.25, 0.25, 7), -(-height // 7))[:height, None]
    page = np.array([168, 132, 96], np.float32) * (1 + 0.22 * grain + planks * 0.6)[..., None]
    page[:: -(-height // 7)] *= 0.55
    return np.clip(page, 0, 255).astype(np.uint8)


def plaster(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A wall, (height, width, 3) uint8: almost even, a little dirty."""
    page = np.array([188, 190, 184], np.float32) * (1 + 0.06 * smooth_noise(rng, width, height, (5, 4), 6))[..., None]
    return np.clip(page, 0, 255).astype(np.uint8)


def cardboard(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Plain brown board with flutes and one faint stamp, (height, width, 3) uint8."""
    flutes = np.sin(np.arange(width) * (2 * np.pi / 14))[None]
    stain = smooth_noise(rng, width, height, (3, 3), 6)
    page = np.clip(np.array([176, 140, 100], np.float32) * (1 + 0.03 * flutes + 0.1 * stain)[..., None], 0, 255).astype(
        np.uint8
    )
    cv2.putText(page, "FRAGILE", (width // 8, int(height * 0.6)), _FONTS[1], width / 190, (120, 60, 50), 4, cv2.LINE_AA)
    return page


def _palette(rng: np.random.Generator) -> tuple[tuple, tuple, tuple]:
    """Ground, dark ink, accent: RGB. Hues are drawn, lightness is set so that print reads on its ground."""
    hue = rng.uniform(0, 180)
    light = [(hue, 70, 225), (hue + 95, 170, 70), (hue + rng.uniform(40, 140), 190, 175)]
    hsv = np.array([[(h % 180, s, v) for h, s, v in light]], np.uint8)
    ground, ink, accent = (tuple(int(c) for c in rgb) for rgb in cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0])
    return ground, ink, accent


def _random_colour(rng: np.random.Generator) -> tuple[int, int, int]:
    hsv = np.array([[[rng.integers(0, 180), rng.integers(90, 230), rng.integers(70, 240)]]], np.uint8)
    red, green, blue = (int(c) for c in cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0])
    return red, green, blue


def _blend_bands(rng: np.random.Generator, page: np.ndarray, accent: tuple) -> None:
    h, w = page.shape[:2]
    top, bottom = int(h * rng.uniform(0.1, 0.2)), int(h * rng.uniform(0.78, 0.88))
    page[:top] = accent
    skew = int(h * rng.uniform(-0.1, 0.1))
    corners = np.array([[0, bottom + skew], [w, bottom - skew], [w, h], [0, h]])
    cv2.fillPoly(page, [corners], _random_colour(rng), cv2.LINE_AA)


def _blobs(rng: np.random.Generator, page: np.ndarray, n: int) -> None:
    """The picture on the pack: fruit-like ellipses and leaves that overlap."""
    h, w = page.shape[:2]
    for _ in range(n):
        at = int(w * rng.uniform(0.08, 0.92)), int(h * rng.uniform(0.42, 0.8))
        axes = int(w * rng.uniform(0.04, 0.13)), int(w * rng.uniform(0.04, 0.1))
        turn, colour = rng.uniform(0, 180), _random_colour(rng)
        cv2.ellipse(page, at, axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
        shine = at[0] - axes[0] // 3, at[1] - axes[1] // 3
        cv2.circle(page, shine, max(2, axes[1] // 4), (245, 245, 235), -1, cv2.LINE_AA)
        cv2.ellipse(page, at, axes, turn, 0, 360, tuple(c // 2 for c in colour), 2, cv2.LINE_AA)


def _brand(rng: np.random.Generator, page: np.ndarray, dark: tuple, accent: tuple) -> None:
    h, w = page.shape[:2]
    words = (
        (str(rng.choice(_BRANDS)), 0.86, 0.33, dark, 5),
        (str(rng.choice(_GOODS)), 0.7, 0.42, tuple(c // 2 for c in accent), 2),
        (f"{rng.integers(150, 990)} g", 0.3, 0.93, (250, 250, 245), 3),
    )
    for text, share, row, colour, weight in words:
        _text(page, text, (int(w * rng.uniform(0.05, 0.12)), int(h * row)), int(w * share), colour, weight, rng)
    star = int(w * 0.82), int(h * 0.9)
    angles = np.arange(16) * np.pi / 8 + rng.uniform(0, 1)
    radii = np.where(np.arange(16) % 2, 0.05, 0.1) * w
    points = np.stack([star[0] + radii * np.cos(angles), star[1] + radii * np.sin(angles)], 1).round().astype(np.int32)
    cv2.fillPoly(page, [points], _random_colour(rng), cv2.LINE_AA)


def _text(page: np.ndarray, text: str, at: tuple, width: int, colour: tuple, weight: int, rng=None) -> None:
    font = _FONTS[int(rng.integers(len(_FONTS)))] if rng is not None else _FONTS[0]
    natural = cv2.getTextSize(text, font, 1.0, weight)[0][0]
    cv2.putText(page, text, at, font, width / natural, colour, weight, cv2.LINE_AA)


def _small_print(rng: np.random.Generator, page: np.ndarray, dark: tuple) -> None:
    h, w = page.shape[:2]
    _text(page, str(rng.choice(_BRANDS)), (int(w * 0.08), int(h * 0.3)), int(w * rng.uniform(0.5, 0.8)), dark, 3, rng)
    for k, line in enumerate(rng.permutation(_SMALL)):
        _text(page, str(line), (int(w * 0.07), int(h * (0.38 + 0.045 * k))), int(w * rng.uniform(0.7, 0.86)), dark, 1)
    rows, left, right = np.linspace(0.68, 0.84, 5), int(w * 0.08), int(w * rng.uniform(0.45, 0.6))
    for row in rows:
        cv2.line(page, (left, int(h * row)), (right, int(h * row)), dark, 2)
    for row in rows[:-1]:
        bar = int(left + (right - left) * rng.uniform(0.2, 0.95))
        cv2.rectangle(page, (left, int(h * (row + 0.01))), (bar, int(h * (row + 0.03))), _random_colour(rng), -1)


def _bar_code(rng: np.random.Generator, page: np.ndarray) -> None:
    h, w = page.shape[:2]
    x0, x1, y0, y1 = int(w * 0.64), int(w * 0.94), int(h * 0.7), int(h * 0.84)
    bars = np.repeat(rng.integers(0, 2, max(1, (x1 - x0) // 4)) * 225 + 20, 4).astype(np.uint8)
    page[y0:y1, x0 : x0 + len(bars)] = bars[None, :, None]
