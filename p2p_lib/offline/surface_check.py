"""Whether an object's surface is where a pose has it: by the frame's mask, or by depth and colours without one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.types import Frame, evenly
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX
from p2p_lib.method.refinement import refine
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.offline.dataset import agreement, visible
from p2p_lib.offline.finished import Finished, Renderer

#: Distances from the surface are cut at this, m.
_FAR_M = 0.01
#: Depth this near to the rendered surface is on it, m: while it is sought; once found, or within three sigmas.
_SEEK_M, _ON_M = 0.02, 0.006
#: Without a mask: depth may be behind this share of the surface; colour errors may be this many times the usual one;
#: the correlation must be this share of the usual one. So many frames say what is usual.
_BEHIND, _OTHER_COLOURS, _LESS_ALIKE, _CALIBRATED = 0.15, 1.4, 0.6, 12
#: Range of the gain of a frame's colours over the surface's, by the light.
_GAINS = 0.7, 1.4


class FittedPose(NamedTuple):
    """A pose (4, 4) of a frame, its covariance (6, 6), and its cost."""

    T_cam_obj: np.ndarray
    covariance: np.ndarray
    cost: float


class _Look(NamedTuple):
    """Points (N, 3) measured on the surface, the share measured behind it, mean error and correlation of colours."""

    cloud: np.ndarray
    behind: float
    off: float
    alike: float


def off_surface(volume: TsdfVolume, T_cam_obj: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """(N,) distance of points (N, 3) from a surface at a pose, 0 to 1: 1 is far, or off the observed surface."""
    distance_m, valid = volume.query(se3.transform(se3.inverse(T_cam_obj), cloud.astype(float)))
    return np.where(valid, np.minimum(np.abs(distance_m), _FAR_M), _FAR_M) / _FAR_M


class SurfaceCheck:
    """Looks at one object's surface, which has faces, in the frames of a run.

    rows  of frames with a certain pose in T (n, 4, 4): they say how its colours usually look
    """

    def __init__(self, made: Finished, name: str, config: Config, volume: TsdfVolume, T: np.ndarray, rows: np.ndarray):
        self._made, self._name, self._config, self._volume = made, name, config, volume
        mesh: Any = volume.mesh()  # its colours are those of vertices
        colours = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(float)
        self._colours = colours[mesh.faces].mean(1)
        self._render = Renderer(mesh.vertices, mesh.faces, made.sequence.camera)
        looks = (self._look(self._frame(k), T[k]) for k in evenly(rows, _CALIBRATED))
        usual = [look.off for look in looks if look]
        self._usual = float(np.median(usual)) if usual else 0.0

    def _frame(self, k: int) -> Frame:
        return self._made.frame(int(self._made.frames[k]))

    def found(self, k: int, candidates: list[np.ndarray], near: int, T_near: np.ndarray) -> FittedPose | None:
        """The best pose of the k-th frame; None where the surface is not seen from any of these.

        near  a frame next to it with its pose, in the same light
        """
        frame, best = self._frame(k), None
        known = self._look(self._frame(near), T_near)
        usual, alike = (max(self._usual, known.off), known.alike) if known else (self._usual, 1.0)
        for T in candidates:
            covariance = None
            for _ in range(3):
                if (look := self._look(frame, T, wide=True)) is None:
                    break
                refined = refine(T, look.cloud, self._volume, self._config.refinement)
                T, covariance = refined.T_cam_obj, refined.covariance
            look = None if covariance is None else self._look(frame, T)
            if look is None or look.behind > _BEHIND:
                continue
            if look.off > _OTHER_COLOURS * usual or look.alike < _LESS_ALIKE * alike:
                continue
            cost = float(off_surface(self._volume, T, look.cloud).mean())
            if covariance is not None and (best is None or cost < best.cost):
                best = FittedPose(T, covariance, cost)
        return best

    def overlap(self, k: int, T: np.ndarray) -> float:
        """IoU of what shows of the surface at a pose with the mask of the k-th frame."""
        return self._agreement(k, T)[0]

    def on_surface(self, k: int, T: np.ndarray) -> float:
        """The share of the surface in view at a pose on which depth was measured in the k-th frame; NaN without any."""
        return self._agreement(k, T)[1]

    def _agreement(self, k: int, T: np.ndarray) -> tuple[float, float, float]:
        frame, silhouette = self._frame(k), self._render(se3.orthonormalised(T))
        mask = self._made.masks(frame.index).get(self._name)
        return agreement(silhouette, visible(silhouette, frame.depth_m), frame.depth_m, mask)

    def _look(self, frame: Frame, T: np.ndarray, wide: bool = False) -> _Look | None:
        """What a frame shows where a pose has the surface; None with too few pixels on it."""
        silhouette = self._render(se3.orthonormalised(T))
        image, own = silhouette.inside(frame.depth_m)
        depth_m, z, hit = frame.depth_m[image], silhouette.depth_m[own], silhouette.hit[own]
        use = hit & (depth_m > 0)
        off = np.where(use, depth_m - np.where(hit, z, 0), 0)
        within = _SEEK_M if wide else np.maximum(_ON_M, 3 * depth_noise_m(depth_m, self._config.depth))
        on, behind = use & (np.abs(off) < within), use & (off > within)
        if on.sum() < MIN_VISIBLE_PX:
            return None
        colour, true = self._colours[silhouette.face[own][on]], frame.rgb[image][on].astype(float)
        gain = np.median(true, axis=0) / np.maximum(np.median(colour, axis=0), 1)
        wrong = float(np.abs(np.clip(colour * np.clip(gain, *_GAINS), 0, 255) - true).mean())
        vu = evenly(np.argwhere(on), self._config.refinement.max_points)
        uv_px = vu[:, ::-1] + (image[1].start, image[0].start)
        cloud = self._made.sequence.camera.unproject(uv_px, depth_m[tuple(vu.T)])
        a, b = colour - colour.mean(0), true - true.mean(0)
        alike = (a * b).sum() / max(np.sqrt((a**2).sum() * (b**2).sum()), 1e-9)
        return _Look(cloud, float(behind.sum() / (on.sum() + behind.sum())), wrong, float(alike))
