"""How to tell that a run is right without any truth: its surfaces, where it says they are, against measured depth.

A reconstructed surface is drawn at the estimated pose. Where the camera measured something behind it, the object cannot
be: a wrong pose, or a surface that bulges. What lies in front of it hides it and says nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.datasets.runs import Run
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.synthetic.render import render
from p2p_lib.synthetic.shapes import Mesh

#: As near to the surface is on it; so much before it is something else that hides it.
ON_M, BEFORE_M = 0.005, 0.01


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """One object's surface against measured depth at some rows of a run.

    row      (k,) rows with a pose
    on       (k,) share of the surface's unhidden pixels where depth was measured on it; NaN where there are none
    offset_m (k,) median distance by which depth was measured behind (+) or before (-) it, where on it
    """

    row: np.ndarray
    on: np.ndarray
    offset_m: np.ndarray


def surface_fit(
    sequence: Sequence,
    run: Run,
    meshes: Mapping[str, Mesh],
    rows: Iterable[int],
    T_obj_wrong: np.ndarray = se3.IDENTITY,
) -> dict[str, SurfaceFit]:
    """Every object's fit at these rows of the run, those with a pose.

    meshes       object to its reconstructed surface (:func:`p2p_lib.figures.mesh_view.as_body`)
    T_obj_wrong  (4, 4) by which all poses are put off on purpose, to see what a wrong pose would look like
    """
    found: dict[str, list[tuple[int, float, float]]] = {name: [] for name in meshes}
    for row in rows:
        frame = sequence.frame(int(next(iter(run.objects.values())).frame_index[row]))
        for name, body in meshes.items():
            obj = run.objects[name]
            if not obj.has_pose[row]:
                continue
            T_obj_cam = se3.inverse(obj.T_cam_obj[row] @ T_obj_wrong)
            drawn_m = render([(body, se3.IDENTITY)], sequence.camera, T_obj_cam).depth_m
            behind_m = (frame.depth_m - drawn_m)[(drawn_m > 0) & (frame.depth_m > 0)]
            behind_m = behind_m[behind_m > -BEFORE_M]
            on = np.abs(behind_m) < ON_M
            share = float(on.mean()) if len(on) else float("nan")
            found[name].append((row, share, float(np.median(behind_m[on])) if on.any() else float("nan")))
    empty = np.zeros(0, int), np.zeros(0), np.zeros(0)
    return {name: SurfaceFit(*(map(np.array, zip(*f)) if f else empty)) for name, f in found.items()}


def errors_against(source: Sequence, frames: Iterable[int], run: Run) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Object to its rotation (n,) in degrees and translation (n,) in mm off a truth that the run did not know.

    frames  those of ``source`` that the run's were. The object frame is fixed at the first row with a pose; NaN where
    there is no pose.
    """
    errors, frames = {}, np.array(list(frames))
    for name, obj in run.objects.items():
        T_cam_model = source.truth[name].T_cam_model[frames[obj.frame_index]]
        first = int(np.argmax(obj.has_pose))
        T_obj_model = se3.inverse(obj.T_cam_obj[first]) @ T_cam_model[first]
        T_error = se3.inverse(T_cam_model) @ obj.T_cam_obj @ T_obj_model
        angle_deg = np.full(len(obj), np.nan)
        angle_deg[obj.has_pose] = np.degrees(se3.angle_rad(T_error[obj.has_pose]))
        errors[name] = angle_deg, 1e3 * np.linalg.norm(T_error[:, :3, 3], axis=1)
    return errors
