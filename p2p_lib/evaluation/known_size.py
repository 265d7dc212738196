"""Whether an object is measured as long as it is known to be: the one thing that tells a wrong focal length or scale.

Both agree with themselves: everything is longer or shorter by one factor, poses and surface alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from p2p_lib.core.mesh import oriented_box
from p2p_lib.datasets.mask_log import load_masks

#: What is longer than known by more than this factor and this slack, m, is not the object as it is, nor what is always
#: so much shorter: a part of it may be hidden, or seen end-on. Surfaces of well tracked objects are 1 cm too long.
LONGER, SLACK_M, SHORTER = 1.15, 0.01, 0.7
#: Points of a surface that are measured, and the share of them at either end that is not: shreds at its rim.
_POINTS, _SHREDS = 4000, 0.01
#: A mask shows the whole object at least so often.
_OFTEN = 0.9


def size_doubt(known_m: float, mask_m: float, mesh_m: float = float("nan")) -> str:
    """What speaks against a known length, in words; "" where nothing does. NaN: not measured.

    mask_m  the length of what masks hold, where they show the most of it
    mesh_m  the longest side of the reconstructed surface
    """
    measured = {"in its masks": mask_m, "of its surface": mesh_m}
    measured = {what: m for what, m in measured.items() if np.isfinite(m)}
    off = {
        what: m / known_m for what, m in measured.items() if not SHORTER * known_m <= m <= LONGER * known_m + SLACK_M
    }
    if not off or (len(off) < len(measured) and min(off.values()) < 1):  # the other has seen all of it
        return ""
    found = " and ".join(f"{100 * m:.1f} cm {what}" for what, m in measured.items())
    factor = float(np.median(list(off.values())))
    text = f"known to be {100 * known_m:.1f} cm long, measured {found}, {factor:.2f} times"
    besides = "its length was never in view" if factor < 1 else "masks hold more than the object"
    return f"{text}: focal length or depth scale is wrong by this factor, or {besides}"


def size_doubts(folder: str | Path, known_m: Mapping[str, float]) -> dict[str, str]:
    """Object to what speaks against its known length in a run's folder, for those of which something does."""
    masks, found = load_masks(folder) if known_m else {}, {}
    for name, length_m in known_m.items():
        sizes = masks[name].size_m[np.isfinite(masks[name].size_m)] if name in masks else np.zeros(0)
        mask_m = float(np.quantile(sizes, _OFTEN)) if len(sizes) else float("nan")
        found[name] = size_doubt(length_m, mask_m, mesh_length_m(Path(folder) / "meshes" / f"{name}.ply"))
    return {name: text for name, text in found.items() if text}


def mesh_length_m(path: Path) -> float:
    """The longest side of a box around a surface without its shreds; NaN where there is none."""
    if not path.is_file():
        return float("nan")
    import trimesh

    mesh = trimesh.load_mesh(path)
    if len(mesh.vertices) < 4:
        return float("nan")
    p, _ = trimesh.sample.sample_surface(mesh, _POINTS, seed=0)
    sides = p @ np.linalg.inv(oriented_box(mesh)[0])[:3, :3]
    return float(np.ptp(np.quantile(sides, [_SHREDS, 1 - _SHREDS], axis=0), axis=0).max())
