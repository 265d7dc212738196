"""Whether an object is measured as long as it is known to be: the one thing that tells a wrong focal length or scale.

Both agree with themselves: everything is longer or shorter by one factor, poses and surface alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.mask_length import mask_length_m
from p2p_lib.core.mesh import oriented_box
from p2p_lib.core.types import Frame
from p2p_lib.datasets.mask_log import load_masks

#: What is longer than known by more than this factor and this slack, m, is not the object as it is, nor what is always
#: so much shorter: a part of it may be hidden, or seen end-on. Surfaces of well tracked objects are 1 cm too long.
LONGER, SLACK_M, SHORTER = 1.15, 0.01, 0.7
#: A mask is as long as what it shows from corner to corner: of a cube's side by up to this factor longer.
_ACROSS = 2**0.5
#: Points of a surface that are measured, and the share of them at either end that is not: shreds at its rim.
_POINTS, _SHREDS = 4000, 0.01
#: By this factor everything is longer than known where the length was given in metres for centimetres.
_CM_IN_M = 100
_MASKS = "in its masks"
#: After so many masks that were measured it is said that they are too long.
_SOON = 30
#: A mask shows the whole object at least so often.
_OFTEN = 0.9


@dataclass(frozen=True)
class Lengths:
    """One object's length, m, as known and as measured; NaN: not measured.

    mask_m   the length of what masks hold, where they show the most of it
    mesh_m   the longest side of a box around the reconstructed surface
    across   how much longer than a side of the object that may be, where a part of the surface lies askew in its box
    """

    known_m: float
    mask_m: float
    mesh_m: float = float("nan")
    across: float = 1.0

    @property
    def doubt(self) -> str:
        """What speaks against the known length, in words; "" where nothing does."""
        off = [m / self.known_m for what, m in self._measured.items() if not self._fits(what, m)]
        if not off or (len(off) < len(self._measured) and min(off) < 1):  # the other has seen all of it
            return ""
        factor = float(np.median(off))
        text = f"known to be {100 * self.known_m:g} cm long, measured {self._found}, {factor:.2f} times"
        if all(replace(self, known_m=_CM_IN_M * self.known_m)._fits(*of) for of in self._measured.items()):
            return f"{text}: sizes are in centimetres, {100 * self.known_m:g} may be metres"
        mask = "its length was never in view" if factor < 1 else "masks hold more than the object"
        return f"{text}: {mask}, or focal length or depth scale is wrong by about this factor"

    @property
    def fit(self) -> str:
        """That it is measured as long as it is known to be, in words; "" where it is not, or not measured."""
        if self.doubt or not self._measured:
            return ""
        least_m, most_m = self._fitting_m(*list(self._measured.items())[-1])
        given = f"{100 * self.known_m:g} cm given"
        return f"measured {self._found}, {given}: fits, as {100 * least_m:.0f} to {100 * most_m:.0f} cm would"

    def _fits(self, what: str, m: float) -> bool:
        least_m, most_m = self._fitting_m(what, m)
        return least_m <= self.known_m <= most_m

    def _fitting_m(self, what: str, m: float) -> tuple[float, float]:
        """Between which lengths, m, something is that was measured ``m`` long."""
        return (m - SLACK_M) / (LONGER * (_ACROSS if what == _MASKS else self.across)), m / SHORTER

    @property
    def _measured(self) -> dict[str, float]:
        each = {_MASKS: self.mask_m, "of its surface": self.mesh_m}
        return {what: m for what, m in each.items() if np.isfinite(m)}

    @property
    def _found(self) -> str:
        return " and ".join(f"{100 * m:.1f} cm {what}" for what, m in self._measured.items())


def in_masks_m(sizes_m: np.ndarray) -> float:
    """The length, m, of an object whose masks are so long (n,), where they show the most of it; NaN: none measured."""
    measured = sizes_m[np.isfinite(sizes_m)]
    return float(np.quantile(measured, _OFTEN)) if len(measured) else float("nan")


def lengths(folder: str | Path, known_m: Mapping[str, float]) -> dict[str, Lengths]:
    """Objects of known length, m, as a run's folder has measured them."""
    masks, found = load_masks(folder) if known_m else {}, {}
    for name, length_m in known_m.items():
        mask_m = in_masks_m(masks[name].size_m) if name in masks else float("nan")
        found[name] = Lengths(length_m, mask_m, *mesh_length_m(Path(folder) / "meshes" / f"{name}.ply"))
    return found


class Watch:
    """Compares what masks hold with how long objects are known to be, m, while they are tracked; to be told frames.

    say  told once of each object, in a line, that it does not fit: that it is too long soon, the rest at the end
    """

    def __init__(self, known_m: Mapping[str, float], say: Callable[[str], object]):
        self._known_m, self._say = known_m, say
        self._measured_m: dict[str, list[float]] = {name: [] for name in known_m}
        self._doubted: set[str] = set()

    def add(self, frame: Frame, masks: Mapping[str, np.ndarray | None], camera: Camera) -> None:
        """One more frame, with the objects' masks (H, W) bool in it."""
        for name, measured_m in self._measured_m.items():
            if (mask := masks.get(name)) is None or not np.isfinite(m := mask_length_m(frame, mask, camera)):
                continue
            measured_m.append(m)
            if len(measured_m) % _SOON == 0 and in_masks_m(np.array(measured_m)) > self._known_m[name]:
                self._judge(name)

    def end(self) -> None:
        """Say of each object whether it fits, where that is not said."""
        for name in self._known_m:
            if of := self._judge(name):
                self._say(f"{name}: {of}")

    def _judge(self, name: str) -> str:
        """That an object fits, in words; else that it does not is said, once."""
        of = Lengths(self._known_m[name], in_masks_m(np.array(self._measured_m[name])))
        if of.doubt and name not in self._doubted:
            self._doubted.add(name)
            self._say(f"size of {name!r}: {of.doubt}")
        return of.fit


def that_fit(measured: Mapping[str, Lengths]) -> list[str]:
    """A line for each object that was measured as long as it is known to be."""
    return [f"{name}: {of.fit}" for name, of in measured.items() if of.fit]


def mesh_length_m(path: Path) -> tuple[float, float]:
    """The longest side, m, of a box around a surface without its shreds, and how much longer its face's diagonal is.

    Two faces of a cube are a box as long as the diagonal of a third. NaN where there is no surface.
    """
    if not path.is_file():
        return float("nan"), 1.0
    import trimesh

    mesh = trimesh.load_mesh(path)
    if len(mesh.vertices) < 4:
        return float("nan"), 1.0
    p, _ = trimesh.sample.sample_surface(mesh, _POINTS, seed=0)
    sides = p @ np.linalg.inv(oriented_box(mesh)[0])[:3, :3]
    _, wide_m, long_m = np.sort(np.ptp(np.quantile(sides, [_SHREDS, 1 - _SHREDS], axis=0), axis=0)).tolist()
    return long_m, float(np.hypot(1, wide_m / long_m))
