"""True poses of a sequence's objects, and whether what a layout gave as such can be true."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, advised, doubt
from p2p_lib.datasets.images import NOT_RIGID

#: How far from the camera objects are, metres, where truth is in metres.
_TRUE_M = (0.02, 20.0)


@dataclass(frozen=True, eq=False)
class ObjectTruth:
    """One object's truth over the whole sequence.

    T_cam_model  (N, 4, 4) metres, OpenCV axes; NaN where there is none
    labelled     (N,) bool: the dataset's own visibility labels hold (all True where it has none)
    """

    T_cam_model: np.ndarray
    labelled: np.ndarray

    def __post_init__(self) -> None:
        T, labelled = self.T_cam_model, self.labelled
        if not (isinstance(T, np.ndarray) and isinstance(labelled, np.ndarray)):
            got = f"{type(T).__name__} and {type(labelled).__name__}"
            raise BadInput("truth", got, "arrays (N, 4, 4) and (N,) bool")
        if T.shape != (len(T), 4, 4) or labelled.shape != (len(T),) or labelled.dtype != bool:
            got = f"T_cam_model {T.shape}, labelled {labelled.shape} {labelled.dtype}"
            raise BadInput("truth", got, "(N, 4, 4) and (N,) bool")


def checked_truth(given: Any, whose: str, camera: Camera, frames: int) -> dict[str, ObjectTruth]:
    """The truth that a layout gave, of each frame, each pose made rigid; ``whose`` names the layout, in brackets.

    Raises :class:`BadInput` for what is none, and warns of poses where nothing can be, or is to be seen.
    """
    if not isinstance(given, dict):
        raise BadInput(f"truth {whose}", f"a value of type {type(given).__name__}", "a dict, object to ObjectTruth")
    found = {}
    for name, of in given.items():
        what, fix = f"truth of {name!r} {whose}", "Poses of frames without truth are NaN."
        if not isinstance(of, ObjectTruth):
            raise BadInput(what, f"a value of type {type(of).__name__}", "an ObjectTruth, see CONTRIBUTING.md")
        if len(of.labelled) != frames:
            raise BadInput(what, f"{len(of.labelled)} poses", f"{frames}, one for each image", fix)
        T, known = np.array(of.T_cam_model, float), np.isfinite(of.T_cam_model).all((1, 2))
        for i in np.flatnonzero(known):
            try:
                se3.check(f"{what}, row {i}", T[i], NOT_RIGID)
            except BadInput as error:
                raise advised(error, f"T_cam_model turns and moves, and scales nothing. {fix}") from None
        T[known] = se3.orthonormalised(T[known])
        found[name] = ObjectTruth(T, of.labelled)
        if wrong := _odd(T[known & of.labelled], camera):
            doubt(what, *wrong, of=name)
    return found


def _odd(T_cam_model: np.ndarray, camera: Camera) -> tuple[str, str] | None:
    """What is odd about an object's poses (n, 4, 4) in frames that show it, and what to do; None where nothing is."""
    at_m = T_cam_model[:, :3, 3]
    if not len(at_m):
        return None
    away_m = float(np.median(np.linalg.norm(at_m, axis=1)))
    if not _TRUE_M[0] <= away_m <= _TRUE_M[1]:
        return f"{away_m:.3g} m from the camera (median)", "Is T_cam_model in metres? Millimetres times 0.001 are."
    outside = ~((at_m[:, 2] > 0) & camera.inside(camera.project(at_m)))
    if outside.mean() <= 0.5:
        return None
    fix = "T_cam_model is from the model to the camera (x right, y down, z forward): is it inverted, or of other axes?"
    return f"the model's origin is outside the image in {outside.sum()} of {len(outside)} frames", fix
