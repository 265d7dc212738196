"""Drawing on images: boxes, axes, masks, points, labels.

Every function takes an RGB image (H, W, 3) uint8 and returns a new one. Colours are ``#RRGGBB``; lines are
antialiased, placed to a sixteenth of a pixel, and carry a dark rim so that they show on any background.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.mesh import oriented_box
from p2p_lib.core.prompts import Prompt
from p2p_lib.figures import style

if TYPE_CHECKING:
    import trimesh

_SHIFT = 4  # OpenCV's fixed-point coordinates: sixteenths of a pixel
_NEAR_M = 0.02  # lines are cut off here, in front of the camera
_GAP_PX = 4  # between the images of a montage
_FONT, _SCALE, _RIM = cv2.FONT_HERSHEY_SIMPLEX, 0.45, "#101010"

_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
#: The 12 edges of a box as pairs of its corners: those that differ in one coordinate.
EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (_SIGNS[a] != _SIGNS[b]).sum() == 1])


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box around an object: its centre and axes in the object's frame, and its edge lengths.

    T_obj_box  (4, 4); size_m (3,)
    """

    T_obj_box: np.ndarray
    size_m: np.ndarray

    def __post_init__(self) -> None:
        se3.check("box", self.T_obj_box)
        if np.shape(self.size_m) != (3,) or not (np.asarray(self.size_m) >= 0).all():
            raise BadInput("box size_m", self.size_m, "three lengths in metres")

    def corners(self, T_cam_obj: np.ndarray) -> np.ndarray:
        """(..., 8, 3) its corners in the camera frame, at poses (..., 4, 4)."""
        return se3.transform(T_cam_obj @ self.T_obj_box, _SIGNS * np.asarray(self.size_m, float) / 2)

    @classmethod
    def around(cls, points: np.ndarray, T_obj_points: np.ndarray = se3.IDENTITY) -> OrientedBox:
        """The box of points (N, 3) along the axes of their own frame."""
        points = np.asarray(points, float)
        points = points[np.isfinite(points).all(1)]
        if not len(points):
            raise BadInput("box", "no finite points", "at least one")
        low, high = points.min(0), points.max(0)
        return cls(T_obj_points @ se3.from_rt(np.eye(3), (low + high) / 2), high - low)


def tight_box(mesh: trimesh.Trimesh) -> OrientedBox:
    """The smallest box around a surface, along its own axes."""
    T_box_obj, size_m = oriented_box(mesh)
    return OrientedBox(se3.orthonormalised(se3.inverse(T_box_obj)), size_m)


def draw_box(
    image: np.ndarray, camera: Camera, T_cam_obj: np.ndarray, box: OrientedBox, colour: str, dashed: bool = False
) -> np.ndarray:
    """A box's edges; those behind it are thin, and so is a dashed box."""
    p_cam, front = box.corners(T_cam_obj), _front_edges(T_cam_obj @ box.T_obj_box, box.size_m)
    behind, before = _segments(camera, p_cam[EDGES[~front]]), _segments(camera, p_cam[EDGES[front]])
    image = _stroke(image, behind, colour, 1, rim=0, strength=0.5)
    if not dashed:
        return _stroke(image, before, colour, 2)
    image = _stroke(image, before, _RIM, 1, rim=0, strength=0.5)
    return _stroke(image, _dashes(before), colour, 1, rim=0)


def draw_axes(image: np.ndarray, camera: Camera, T_cam_obj: np.ndarray, length_m: float) -> np.ndarray:
    """A frame's x, y and z axes, the farthest first, in the colours of :data:`style.AXES`."""
    tips = se3.transform(T_cam_obj, np.eye(3) * length_m)
    for k in np.argsort(-tips[:, 2], kind="stable"):
        line = np.stack([T_cam_obj[:3, 3], tips[k]])[None]
        image = _stroke(image, _segments(camera, line), style.AXES[k], 2)
    return image


def draw_mask(image: np.ndarray, mask: np.ndarray, colour: str, width_px: int = 2, fill: float = 0.0) -> np.ndarray:
    """A mask's (H, W) outline, and its inside tinted by a share ``fill``."""
    image, mask = image.copy(), np.asarray(mask, bool)
    if mask.shape != image.shape[:2]:
        raise BadInput("mask", mask.shape, f"{image.shape[:2]} as the image")
    if fill > 0:
        image[mask] = np.rint((1 - fill) * image[mask] + fill * np.array(style.rgb(colour))).astype(np.uint8)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)

    def draw(on: np.ndarray, paint: Sequence[float] | float, thickness: int) -> np.ndarray:
        return cv2.drawContours(on, outlines, -1, paint, thickness, cv2.LINE_AA)

    return _rimmed(image, draw, np.concatenate(outlines)[:, 0], colour, width_px) if outlines else image


def draw_masks(
    image: np.ndarray, masks: Mapping[str, np.ndarray], colours: Mapping[str, str], fill: float = 0.35
) -> np.ndarray:
    """Several objects' masks, each in its colour."""
    for name, mask in masks.items():
        image = draw_mask(image, mask, colours[name], fill=fill)
    return image


def draw_points(
    image: np.ndarray, uv_px: np.ndarray, colours: str | np.ndarray, radius_px: float = 3, filled: bool = True
) -> np.ndarray:
    """Points (N, 2) as dots or rings; NaN ones are left out. One colour, or (N, 3) uint8 as :func:`value_colours`."""
    image, uv_px = image.copy(), np.asarray(uv_px, float).reshape(-1, 2)
    if isinstance(colours, str):
        colours = np.tile(np.array(style.rgb(colours), np.uint8), (len(uv_px), 1))
    shown = np.flatnonzero(np.isfinite(uv_px).all(1) & (np.abs(uv_px) < 1e5).all(1))
    one, radius = 1 << _SHIFT, round(radius_px * (1 << _SHIFT))
    # A dark disc behind a dot, a thicker dark ring behind a ring.
    behind, before = ((radius + one, -1), (radius, -1)) if filled else ((radius, 3), (radius, 1))
    for at, colour in zip(np.rint(uv_px[shown] * one).astype(int).tolist(), colours[shown].tolist()):
        for (size, thickness), paint in ((behind, style.rgb(_RIM)), (before, colour)):
            cv2.circle(image, at, size, paint, thickness, cv2.LINE_AA, _SHIFT)
    return image


def draw_clicks(image: np.ndarray, prompts: Iterable[Prompt], colours: Mapping[str, str]) -> np.ndarray:
    """An image with the clicks on objects, each in its object's colour."""
    for prompt in prompts:
        image = draw_points(image, prompt.points_px, colours[prompt.name], radius_px=7)
        for radius_px in (15, 16, 17):
            image = draw_points(image, prompt.points_px, colours[prompt.name], radius_px, filled=False)
    return image


def draw_crosses(image: np.ndarray, uv_px: np.ndarray, colour: str) -> np.ndarray:
    """Points (N, 2) as oblique crosses; NaN ones are left out."""
    arms = 4 * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]]) / np.sqrt(2)
    lines = np.asarray(uv_px, float).reshape(-1, 1, 1, 2) + arms
    return _stroke(image, lines[np.isfinite(lines).all((1, 2, 3))].reshape(-1, 2, 2), colour, 2, rim=1.0)


def value_colours(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """(N, 3) uint8: dark blue at ``low`` or below to yellow at ``high`` or above (cividis); NaN is white."""
    values = np.asarray(values, float)
    level = np.clip((values - low) / (high - low), 0, 1)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_CIVIDIS)[:, 0, ::-1]
    colours = table[np.rint(np.nan_to_num(level) * 255).astype(int)]
    return np.where(np.isnan(level)[:, None], np.uint8(255), colours)


def depth_scale(depth_m: np.ndarray) -> str:
    """What the colours of :func:`depth_image` mean, for a caption."""
    near, far = _depth_range(depth_m)
    return f"yellow {near:.2f} m to dark blue {far:.2f} m"


def _depth_range(depth_m: np.ndarray) -> tuple[float, float]:
    """Metres from which on all is yellow, and up to which all is dark blue; NaN where nothing was measured."""
    known = depth_m[depth_m > 0]
    return tuple(np.quantile(known, [0.005, 0.995]).tolist()) if len(known) else (np.nan, np.nan)


def depth_image(depth_m: np.ndarray) -> np.ndarray:
    """Depth (H, W) as an image: near is yellow, far is dark blue (cividis), no measurement is white."""
    near, far = _depth_range(depth_m)
    values = np.where(depth_m > 0, -depth_m, np.nan).ravel()
    return value_colours(values, -max(far, near + 1e-6), -near).reshape(*depth_m.shape, 3)


def draw_trail(image: np.ndarray, uv_px: np.ndarray, colour: str, width_px: int = 2) -> np.ndarray:
    """Paths (..., N, 2) through the image; NaN interrupts one."""
    pairs = np.stack([uv_px[..., :-1, :], uv_px[..., 1:, :]], -2).reshape(-1, 2, 2)
    return _stroke(image, pairs[np.isfinite(pairs).all((1, 2))], colour, width_px, rim=0)


@dataclass(frozen=True)
class Label:
    """A word at an object: what it says, its colour, and the rectangle (left, top, right, bottom) it belongs to."""

    text: str
    colour: str
    around_px: tuple[float, float, float, float]


def draw_labels(image: np.ndarray, labels: Iterable[Label], caption: str = "") -> np.ndarray:
    """Labels beside their rectangles, so that none covers another or the caption: above, else below, right or left."""
    image, taken = draw_caption(image, caption) if caption else image.copy(), []
    if caption:
        taken.append((0, 0, *_caption_size(caption, _SCALE)))
    for label in labels:
        (w, h), base = cv2.getTextSize(label.text, _FONT, _SCALE, 1)
        w, h = w + 10, h + base + 4
        left, top = _free_place((w, h), label.around_px, taken, image.shape)
        taken.append((left, top, left + w, top + h))
        cv2.rectangle(image, (left, top), (left + w - 1, top + h - 1), style.rgb(label.colour), -1)
        at, colour = (left + 5, top + h - base - 1), style.rgb(style.ink(label.colour))
        cv2.putText(image, label.text, at, _FONT, _SCALE, colour, 1, cv2.LINE_AA)
    return image


def draw_caption(image: np.ndarray, text: str, scale: float = _SCALE) -> np.ndarray:
    """White words on a dark ground in the upper left corner."""
    image, (w, h) = image.copy(), _caption_size(text, scale)
    ground = image[:h, :w]
    ground[:] = (ground * 0.35).astype(np.uint8)
    at = (6, 4 + cv2.getTextSize(text, _FONT, scale, 1)[0][1])
    cv2.putText(image, text, at, _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def _caption_size(text: str, scale: float) -> tuple[int, int]:
    (w, h), base = cv2.getTextSize(text, _FONT, scale, 1)
    return w + 12, h + base + 6


def zoomed(
    image: np.ndarray, camera: Camera, region_px: tuple[int, int, int, int], width_px: int
) -> tuple[np.ndarray, Camera]:
    """A region (left, top, right, bottom; the latter exclusive) at another width, and the camera that sees it so."""
    left, top, right, bottom = region_px
    if not (0 <= left < right <= image.shape[1] and 0 <= top < bottom <= image.shape[0]):
        raise BadInput("region_px", region_px, f"a rectangle within {image.shape[1]}x{image.shape[0]}")
    size = width_px, round(width_px / (right - left) * (bottom - top))
    how = cv2.INTER_AREA if width_px < right - left else cv2.INTER_CUBIC
    part = cv2.resize(image[top:bottom, left:right], size, interpolation=how)
    region = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=right - left, height=bottom - top)
    return part, region.resized(*size)


def zoomed_px(uv_px: np.ndarray, camera: Camera, seen_by: Camera) -> np.ndarray:
    """Pixels (..., 2) of one camera in the image of the camera that :func:`zoomed` returned."""
    scale = np.array([seen_by.fx / camera.fx, seen_by.fy / camera.fy])
    return scale * (uv_px - np.array([camera.cx, camera.cy])) + [seen_by.cx, seen_by.cy]


def region_around(
    shown: np.ndarray, camera: Camera, margin_px: tuple[int, int] = (12, 12)
) -> tuple[int, int, int, int]:
    """The rectangle (left, top, right, bottom) around a mask (H, W) bool or pixels (N, 2), with margins (u, v)."""
    uv_px = np.argwhere(shown)[:, ::-1] if shown.dtype == bool else shown
    left, top = np.maximum(np.floor(uv_px.min(0)).astype(int) - margin_px, 0)
    right, bottom = np.minimum(np.ceil(uv_px.max(0)).astype(int) + margin_px + 1, [camera.width, camera.height])
    return int(left), int(top), int(right), int(bottom)


def montage(images: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Images of one size, row by row, with white between them."""
    from skimage.util import montage as sheet

    if not len(images) or len({image.shape for image in images}) != 1:
        raise BadInput("montage", sorted({image.shape for image in images}), "images of one size")
    rows = -(-len(images) // columns)
    how = {"grid_shape": (rows, columns), "padding_width": _GAP_PX, "channel_axis": -1}
    return sheet(np.stack(images), fill=[255, 255, 255], **how)[_GAP_PX:-_GAP_PX, _GAP_PX:-_GAP_PX]


def _front_edges(T_cam_box: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """(12,) bool: edges of at least one face that looks at the camera."""
    outward = np.concatenate([np.eye(3), -np.eye(3)])
    centres = se3.transform(T_cam_box, outward * size_m / 2)
    faces = np.einsum("fi,fi->f", outward @ T_cam_box[:3, :3].T, centres) < 0
    in_face = np.concatenate([_SIGNS > 0, _SIGNS < 0], 1)
    return (in_face[EDGES[:, 0]] & in_face[EDGES[:, 1]] & faces).any(1)


def _segments(camera: Camera, p_cam: np.ndarray) -> np.ndarray:
    """Lines (M, 2, 3) in pixels (K, 2, 2), cut off at the near plane; those behind it are gone."""
    p_cam = p_cam[(p_cam[..., 2] > _NEAR_M).any(1)]
    z = p_cam[..., 2]
    behind = z <= _NEAR_M
    step = z[:, ::-1] - z
    share = np.where(behind, (_NEAR_M - z) / np.where(behind, step, 1), 0)
    return camera.project(p_cam + share[..., None] * (p_cam[:, ::-1] - p_cam))


def _stroke(
    image: np.ndarray, segments: np.ndarray, colour: str, width_px: int, rim: float = 0.6, strength: float = 1.0
) -> np.ndarray:
    """Segments (M, 2, 2) in pixels; ``rim`` is how dark the rim is, ``strength`` how opaque the line."""
    lines = list(np.rint(segments * (1 << _SHIFT)).astype(np.int32)[:, :, None])

    def draw(on: np.ndarray, paint: Sequence[float] | float, thickness: int) -> np.ndarray:
        return cv2.polylines(on, lines, False, paint, thickness, cv2.LINE_AA, _SHIFT)

    return _rimmed(image, draw, segments.reshape(-1, 2), colour, width_px, rim, strength) if lines else image.copy()


def _rimmed(
    image: np.ndarray, draw: Callable, uv_px: np.ndarray, colour: str, width_px: int, rim: float = 0.6, strength=1.0
) -> np.ndarray:
    """``draw(image, rgb, thickness)`` about pixels (N, 2): a dark rim, then in colour, each as opaque as it says."""
    image, reach, size = image.copy(), width_px + 4, image.shape[1::-1]
    left, top = np.clip(np.floor(uv_px.min(0)) - reach, 0, size).astype(int)
    right, bottom = np.clip(np.ceil(uv_px.max(0)) + reach, 0, size).astype(int)
    part = image[top:bottom, left:right]  # nothing is drawn elsewhere, and to blend a whole image takes long
    for paint, thickness, opacity in ((_RIM, width_px + 2, rim), (colour, width_px, strength)):
        if opacity and part.size:
            before = part.copy()
            draw(image, style.rgb(paint), thickness)
            part[:] = cv2.addWeighted(part, opacity, before, 1 - opacity, 0)
    return image


def _dashes(segments: np.ndarray) -> np.ndarray:
    """Segments (M, 2, 2) cut into dashes of 5 px and gaps as long, beginning and ending with a dash."""
    pieces = [np.zeros((0, 2, 2))]
    for a, b in segments:
        n = 2 * min(round(float(np.linalg.norm(b - a)) / 10), 500) + 1
        s = np.linspace(0, 1, n + 1)[:, None]
        at = a + s * (b - a)
        pieces.append(np.stack([at[:-1:2], at[1::2]], 1))
    return np.concatenate(pieces)


def _free_place(
    size: tuple[int, int], around: tuple[float, ...], taken: list[tuple[int, int, int, int]], shape: tuple[int, ...]
) -> tuple[int, int]:
    """Upper left corner for a label: the first free place beside its rectangle, else the nearest in the image."""
    w, h = size
    left, top, right, bottom = around
    middle, centre = (left + right - w) / 2, (top + bottom - h) / 2
    wanted = [(middle, top - h - 4), (middle, bottom + 4), (right + 4, centre), (left - w - 4, centre)]
    anywhere = [(u, v) for v in range(0, shape[0], h + 2) for u in (0, middle, shape[1])]
    wanted += sorted(anywhere, key=lambda at: np.hypot(at[0] - middle, at[1] - top))
    within = [(round(min(max(u, 0), shape[1] - w)), round(min(max(v, 0), shape[0] - h))) for u, v in wanted]
    free = (
        (u, v)
        for u, v in within
        if not any(u < x1 and x0 < u + w and v < y1 and y0 < v + h for x0, y0, x1, y1 in taken)
    )
    return next(free, within[0])
