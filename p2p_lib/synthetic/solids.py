"""Solids of revolution and bent tubes: a mug with its handle, a hand with its forearm."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic import labels
from p2p_lib.synthetic.shapes import TEXELS_PER_M, Mesh, Patch, assembled, grid

#: Corners of a profile that bend by less than this are shaded smooth.
_CREASE_COSINE = np.cos(np.radians(35))


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
    handle = tube(_mug_handle(profile, radius_m, height_m), 0.008, _speckled(rng))
    mirrors = np.repeat([reflectance, 0.0], [len(body.corners), len(handle.corners)])
    return replace(assembled([body, handle], [[0], [1]], ground=96), reflectance=mirrors)


def speckled_mug(rng: np.random.Generator, radius_m: float = 0.042, height_m: float = 0.102) -> Mesh:
    """A mug of glazed, speckled clay around the z axis, centred, its handle towards +x; a bare foot and one stamp.

    The speckles are all alike: near by they hold points, and blurred they are gone.
    """
    profile = _mug_profile(radius_m, height_m)
    length = np.linalg.norm(np.diff(profile, axis=0), axis=1).sum()
    around, along = round(2 * np.pi * radius_m * TEXELS_PER_M), round(length * TEXELS_PER_M)
    glaze = cv2.cvtColor(
        np.array([[[rng.integers(0, 180), rng.integers(90, 170), rng.integers(80, 150)]]], np.uint8), cv2.COLOR_HSV2RGB
    )
    clay = _speckles(rng, around, along, glaze[0, 0], 0.05)
    tall, foot = round(height_m * TEXELS_PER_M), round(radius_m * 0.62 * TEXELS_PER_M)
    clay[along - foot - round(0.10 * tall) :] = _speckles(
        rng, around, foot + round(0.10 * tall), (206, 190, 160), 0.006
    )
    _stamp(rng, clay, (around // 2, along - foot - tall // 2), round(0.26 * tall))
    bow = _mug_handle(profile, radius_m, height_m)
    handle = tube(bow, 0.0075, _speckles(rng, 160, 512, glaze[0, 0], 0.05))
    mesh = assembled([revolved(profile, clay), handle], [[0], [1]], ground=96)
    return replace(mesh, reflectance=np.full(len(mesh.faces), 0.03))


def hand(rng: np.random.Generator) -> Mesh:
    """A right hand held flat, fingers together and up (+z), palm towards -y, its middle at the origin; plain skin."""
    size = rng.uniform(0.95, 1.08)
    tone = np.array([205, 160, 132], np.float32) * np.float32(rng.uniform(0.55, 1.05))
    blotches = labels.smooth_noise(rng, 256, 512, (3, 6), 5)[..., None]
    skin = np.clip(tone * (1 + 0.08 * blotches), 0, 255).astype(np.uint8)
    fingers = [(-0.0285, 0.066), (-0.0095, 0.078), (0.0095, 0.073), (0.0285, 0.058)]
    limbs = [
        limb(skin, 0.030, 0.30, (0, 0, -0.20), (1.0, 0.8, 1.0)),
        limb(skin, 0.046, 0.112, (0, 0, -0.035), (1.0, 0.35, 1.0)),
        limb(skin, 0.011, 0.075, (-0.050, 0, -0.025), lean_rad=-0.5),
        *(limb(skin, 0.0105, 2 * tall, (x, 0, 0.016)) for x, tall in fingers),
    ]
    corners, uv, normals = (np.concatenate([getattr(p, a) for p in limbs]) for a in ("corners", "uv", "normals"))
    return assembled([Patch(size * corners, uv, normals, skin)])


def revolved(profile: np.ndarray, image: np.ndarray, segments: int = 72) -> Patch:
    """The surface of a profile (P, 2) of radius and height turned about z; the image runs around and up along it.

    The profile goes from bottom to top on the outside: its right side is outside.
    """
    step = np.diff(profile, axis=0)
    length = np.linalg.norm(step, axis=1)
    flat = np.stack([step[:, 1], -step[:, 0]], 1) / length[:, None]
    smooth = np.einsum("ij,ij->i", flat[:-1], flat[1:]) > _CREASE_COSINE
    mean = flat[:-1] + flat[1:]
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    start, stop = flat.copy(), flat.copy()
    start[1:][smooth], stop[:-1][smooth] = mean[smooth], mean[smooth]
    for end, one in ((start, 0), (stop, -1)):
        if profile[one, 0] < 1e-9 and abs(flat[one, 1]) > _CREASE_COSINE:
            end[one] = 0, np.sign(flat[one, 1])  # a smooth pole
    along = np.r_[0, np.cumsum(length)] / length.sum()
    cells = grid(np.linspace(0, 1, segments + 1), along)
    row = np.clip(np.searchsorted(along, cells[..., 1].mean(1)) - 1, 0, len(length) - 1)
    share = ((cells[..., 1] - along[row, None]) / (along[row + 1] - along[row])[:, None])[..., None]
    radius_height = profile[row][:, None] + share * step[row][:, None]
    normal = start[row][:, None] + share * (stop[row] - start[row])[:, None]
    angle = 2 * np.pi * cells[..., 0]
    out = np.stack([np.cos(angle), np.sin(angle)], -1)
    corners, normals = (np.concatenate([out * a[..., :1], a[..., 1:]], -1) for a in (radius_height, normal))
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    solid = area > 1e-12  # where the profile meets the axis one triangle of each cell vanishes
    return Patch(corners[solid], cells[solid], normals[solid], image)


def tube(path: np.ndarray, radius_m: float, image: np.ndarray, segments: int = 14) -> Patch:
    """A round tube along points (P, 3) of the plane y = 0, its ends open; the image runs around and along."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.array([0, 1.0, 0])
    across = np.cross(tangent, side)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    cells = grid(np.linspace(0, 1, segments + 1), length / length[-1])
    row = np.argmin(np.abs(cells[..., 1:] - length / length[-1]), -1)
    angle = -2 * np.pi * cells[..., :1]
    out = np.cos(angle) * across[row] + np.sin(angle) * side
    return Patch(path[row] + radius_m * out, cells, out, image)


def _mug_profile(radius_m: float, height_m: float) -> np.ndarray:
    """Radius and height from the middle of the foot up the belly (rows 1 to 25), over the rim, to the middle inside."""
    h = height_m / 2
    z = np.linspace(-h, h, 25)
    outside = np.stack([radius_m * (0.62 + 0.38 * np.cos(z / h * 1.15)), z], 1)
    inside = outside[::-1][:23] - [0.004, 0]
    return np.concatenate([[[0, -h]], outside, inside, [[0, inside[-1, 1]]]])


def _mug_handle(profile: np.ndarray, radius_m: float, height_m: float) -> np.ndarray:
    """A handle's middle line (17, 3); both ends end inside the wall, which is 4 mm thick."""
    t = np.linspace(-1.0, 1.0, 17)
    bow = np.stack([np.cos(t * np.pi / 2) ** 0.6 * 0.75 * radius_m, np.zeros_like(t), t * 0.30 * height_m], 1)
    outside = profile[1:26]
    bow[:, 0] += np.interp(bow[:, 2], outside[:, 1], outside[:, 0]) - 0.002
    return bow


def _speckles(rng: np.random.Generator, width: int, height: int, glaze: tuple, share: float) -> np.ndarray:
    """Glaze (height, width, 3) uint8 with a cloud in it, and light and dark specks that cover about ``share`` of it."""
    page = np.array(glaze, np.float32) * (1 + 0.08 * labels.smooth_noise(rng, width, height, (4, 4), 4))[..., None]
    for size, shade in ((3, 225), (5, 210), (8, 230), (5, 30)):
        n = round(share * width * height / 4 / (0.8 * size**2))
        specks: np.ndarray = np.zeros((height, width), np.float32)
        specks[rng.integers(0, height, n), rng.integers(0, width, n)] = 1
        specks = cv2.dilate(specks, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))[..., None]
        page += 0.75 * specks * (shade - page)
    return np.clip(page, 0, 255).astype(np.uint8)


def _stamp(rng: np.random.Generator, page: np.ndarray, at: tuple[int, int], radius: int) -> None:
    """A round seal with rings, a word and a few drawn leaves, in pale ink."""
    ink = tuple(int(c) for c in rng.uniform(185, 225, 3))
    cv2.circle(page, at, radius, ink, -1, cv2.LINE_AA)
    dark = tuple(int(0.4 * c) for c in ink)
    for share in (0.92, 0.70):
        cv2.circle(page, at, int(share * radius), dark, 3, cv2.LINE_AA)
    for turn in rng.uniform(0, 360, 7):
        centre = at[0] + int(0.35 * radius * np.cos(turn)), at[1] + int(0.35 * radius * np.sin(turn))
        cv2.ellipse(page, centre, (radius // 4, radius // 9), turn, 0, 360, dark, 2, cv2.LINE_AA)
    cv2.putText(page, "KILN", (at[0] - radius // 2, at[1] + radius // 5), 4, radius / 60, dark, 3, cv2.LINE_AA)


def _print_marks(rng: np.random.Generator, glaze: np.ndarray, marks: int, tall: int) -> None:
    """Small prints, evenly around the belly at different heights; the outside starts at the image's bottom."""
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


def _speckled(rng: np.random.Generator) -> np.ndarray:
    """Matt clay (512, 128, 3) uint8 with dark and light speckles."""
    width, height = 128, 512
    page = (
        np.array([176, 150, 120], np.float32)
        * (1 + 0.1 * labels.smooth_noise(rng, width, height, (2, 8), 3))[..., None]
    )
    page = np.clip(page, 0, 255).astype(np.uint8)
    for _ in range(110):
        at = int(rng.integers(width)), int(rng.integers(height))
        shade = int(rng.choice([25, 60, 235]))
        cv2.circle(page, at, int(rng.integers(3, 9)), (shade, shade, int(shade * 0.9)), -1, cv2.LINE_AA)
    return page


def capsule(
    image: np.ndarray, radius_m: float, length_m: float, squash: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Mesh:
    """A capsule along z, centred, with an image wrapped around it; ``squash`` flattens it along its axes."""
    return assembled([limb(image, radius_m, length_m, (0, 0, 0), squash)])


def limb(
    skin: np.ndarray,
    radius_m: float,
    length_m: float,
    at: tuple[float, float, float],
    squash: tuple[float, float, float] = (1.0, 1.0, 1.0),
    lean_rad: float = 0.0,
) -> Patch:
    """A capsule along z, squashed along its axes, leant sideways, moved."""
    angle = np.linspace(0, np.pi / 2, 6)
    cap = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    profile = np.concatenate([cap - [0, length_m / 2], [1, -1] * cap[::-1] + [0, length_m / 2]])
    capsule = revolved(profile, skin, segments=20)
    R = se3.exp(np.array([0, lean_rad, 0, 0, 0, 0.0]))[:3, :3]
    normals = capsule.normals / np.array(squash)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True) @ R.T
    return replace(capsule, corners=capsule.corners * squash @ R.T + at, normals=normals)
