"""How well a run agrees with what the camera saw: what can be said of it without any truth (``p2p eval``).

A reconstructed surface is laid into the image at the estimated pose. Where the camera measured something behind it, the
object cannot be: a wrong pose, or a surface that bulges. What lies in front of it hides it and says nothing. Where its
mask is not, the object should not be either, and its keypoints should lie where the 2D tracker saw them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import se3, tables
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import P2PError
from p2p_lib.core.raycasting import cast, ray_scene
from p2p_lib.core.types import DOUBTED
from p2p_lib.datasets.keypoint_log import ObjectKeypoints, load_keypoints
from p2p_lib.datasets.models import load_mesh
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.datasets.sequence import Sequence, reopen
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX, WHAT_RAN, rate

if TYPE_CHECKING:
    from pandas import DataFrame, Series

#: As near to the surface is on it; so much before it is something else that hides it.
ON_M, BEFORE_M = 0.005, 0.01
#: Frames that are looked at, evenly spread over the run.
LOOKS = 60
#: What the numbers are called, what they say, and which way is good.
HEADS = {
    "pose": ("pose [%]", "frames with a pose"),
    "doubted": ("doubted [%]", f"of these poses, those of confidence {DOUBTED:g} at most: 0 is best"),
    "pose_where_seen": ("where seen [%]", f"the same of frames whose mask has {MIN_VISIBLE_PX} pixels: 100 is best"),
    "depth_on_surface": (
        "depth on surface [%]",
        f"of the surface in view, where depth was measured within {1000 * ON_M:g} mm of it: 100 is best",
    ),
    "mask_iou": (
        "mask IoU [%]",
        "overlap of the surface's outline, where nothing hides it, with the mask: 100 is best",
    ),
    "reprojection_px": ("reprojection [px]", "from keypoints at the pose to where they were seen: 0 is best"),
}
#: By which runs differ whose poses were put off by 1 cm: where one is beyond, look at the film.
_LOOK_BELOW = {"pose_where_seen": 90.0, "mask_iou": 50.0}
_LOOK_ABOVE = {"doubted": 50.0, "reprojection_px": 2.0}
#: Measured from clicks on three real sequences as tracked, and on two of them with every pose put off by 1 cm.
SCALE = (
    "On real video that was tracked well: depth 70 to 90 %, IoU 80 to 90 %, below 1 px; with poses 1 cm off: "
    "40 to 80 %, 70 to 80 %, 4 to 5 px. "
    "Verdict: good, or look (at the film before you believe it) with a pose in less than 90 % where seen "
    "(of all frames, where no masks tell), IoU < 50 %, doubted > 50 % or more than 2 px."
)


@dataclass(frozen=True, eq=False)
class Consistency:
    """What can be said of a run without truth: per object the numbers of :data:`HEADS`, NaN where there is none.

    depth_on_surface, mask_iou and reprojection_px are medians over the frames that were looked at. not_scored: why
    there is truth and no score.
    """

    objects: dict[str, dict[str, float]]
    info: dict[str, Any] = field(default_factory=dict)
    hz: float | None = None
    not_scored: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``p2p eval --json`` prints them; None where there is nothing to say."""
        plain = {
            name: {key: value if np.isfinite(value) else None for key, value in numbers.items()}
            for name, numbers in self.objects.items()
        }
        ran = {key: self.info.get(key) for key in WHAT_RAN}
        return {"truth": None, "not_scored": self.not_scored or None, "objects": plain, "hz": self.hz, **ran}

    def as_frame(self) -> DataFrame:
        """A row per object."""
        from pandas import DataFrame

        rows = [{"object": name, **numbers, "verdict": verdict(numbers)} for name, numbers in self.objects.items()]
        return DataFrame(rows).round(1).rename(columns={key: head for key, (head, _) in HEADS.items()})

    def as_table(self) -> str:
        """The same for people, with what each number says."""
        told = [f"{head}: {says}" for head, says in HEADS.values()]
        hz = [f"{self.hz:.1f} Hz"] if self.hz is not None else []
        ran = ", ".join(f"{key} {self.info.get(key)}" for key in WHAT_RAN)
        without = f"Not scored: {self.not_scored}.\nWithout a model" if self.not_scored else "Without truth"
        title = f"{without}: how well the run agrees with what the camera saw (- where nothing was kept to tell)"
        return "\n".join([title, tables.as_text(self.as_frame()), *told, SCALE, *hz, ran])


def verdict(numbers: Mapping[str, float]) -> str:
    """In a word, what the numbers of an object say: ``good``, or ``look`` at its film before it is believed.

    Where no masks tell in which frames it is seen, it may be in any.
    """
    if np.isnan(numbers["pose_where_seen"]):
        numbers = {**numbers, "pose_where_seen": numbers["pose"]}
    low = any(numbers[key] < least for key, least in _LOOK_BELOW.items())
    high = any(numbers[key] > most for key, most in _LOOK_ABOVE.items())
    return "look" if low or high or not numbers["pose"] else "good"


def consistency(run: Run, sequence: Sequence | None = None) -> Consistency:
    """What can be said of a run without truth; of its images where they can still be had.

    sequence  that the run was made on (default: opened as the run says)
    """
    with suppress(P2PError):
        sequence = sequence or reopen(run.info)
    keypoints = load_keypoints(run.path)
    objects = {}
    for name, obj in run.objects.items():
        numbers = dict.fromkeys(HEADS, float("nan")) | {"pose": 100 * float(obj.has_pose.mean())}
        if obj.has_pose.any():
            numbers["doubted"] = 100 * float(obj.doubted.sum() / obj.has_pose.sum())
        if sequence is not None:
            numbers |= _seen(run, name, sequence)
            if name in keypoints:
                numbers["reprojection_px"] = _reprojection_px(obj, keypoints[name], sequence.camera)
        objects[name] = numbers
    return Consistency(objects, run.info, rate(run.timings)[0])


def surface_fit(
    sequence: Sequence,
    run: Run,
    meshes: Mapping[str, Any],
    rows: Iterable[int],
    T_obj_wrong: np.ndarray = se3.IDENTITY,
) -> dict[str, Series]:
    """Per object, at these rows with a pose: the fraction of its unhidden surface on which depth was measured.

    meshes       object to its reconstructed surface: anything with ``vertices`` (V, 3) in its frame and ``faces``
    T_obj_wrong  (4, 4) by which all poses are put off on purpose, to see what a wrong pose would look like
    """
    from pandas import Series

    found: dict[str, dict[int, float]] = {name: {} for name in meshes}
    scenes = {name: ray_scene(mesh.vertices, mesh.faces) for name, mesh in meshes.items()}
    for row in rows:
        frame = sequence.frame(int(next(iter(run.objects.values())).frame_index[row]))
        for name, scene in scenes.items():
            obj = run.objects[name]
            if obj.has_pose[row]:
                drawn_m = _drawn_m(scene, sequence.camera, obj.T_cam_obj[row] @ T_obj_wrong)
                found[name][row] = _on_surface(drawn_m, frame.depth_m)
    return {name: Series(fits, dtype=float) for name, fits in found.items()}


def _seen(run: Run, name: str, sequence: Sequence) -> dict[str, float]:
    """What the images and masks of some frames say of one object."""
    obj, path = run.objects[name], run.path / "meshes" / f"{name}.ply"
    scene = ray_scene(*load_mesh(path)) if path.is_file() else None
    found: dict[str, list[float]] = {"pose_where_seen": [], "depth_on_surface": [], "mask_iou": []}
    for row in np.unique(np.linspace(0, len(obj) - 1, LOOKS).astype(int)):
        index = int(obj.frame_index[row])
        mask = run.masks(sequence, index).get(name)
        if mask is not None and mask.sum() >= MIN_VISIBLE_PX:
            found["pose_where_seen"].append(obj.has_pose[row])
        if scene is None or not obj.has_pose[row]:
            continue
        drawn_m, depth_m = _drawn_m(scene, sequence.camera, obj.T_cam_obj[row]), sequence.frame(index).depth_m
        found["depth_on_surface"].append(_on_surface(drawn_m, depth_m))
        if mask is not None:
            hidden = (drawn_m > 0) & (depth_m > 0) & (depth_m < drawn_m - BEFORE_M) & ~mask
            drawn = (drawn_m > 0) & ~hidden
            found["mask_iou"].append((drawn & mask).sum() / max((drawn | mask).sum(), 1))
    told = {key: np.array(values, float) for key, values in found.items()}
    told = {key: values[np.isfinite(values)] for key, values in told.items()}
    middle = {key: np.mean if key == "pose_where_seen" else np.median for key in told}
    return {key: 100 * float(middle[key](values)) for key, values in told.items() if len(values)}


def _drawn_m(scene: Any, camera: Camera, T_cam_obj: np.ndarray) -> np.ndarray:
    """(H, W) depth in metres of a surface at a pose; 0 where it is not."""
    T_obj_cam = se3.inverse(T_cam_obj)
    rays = camera.rays.reshape(-1, 3) @ T_obj_cam[:3, :3].T  # of which z is 1, so that their length is the depth
    hit = cast(scene, T_obj_cam[:3, 3], rays)["t_hit"].reshape(camera.height, camera.width)
    return np.where(np.isfinite(hit), hit, 0)


def _on_surface(drawn_m: np.ndarray, depth_m: np.ndarray) -> float:
    """The fraction of what is drawn and not hidden on which depth (H, W) was measured; NaN where there is nothing."""
    behind_m = (depth_m - drawn_m)[(drawn_m > 0) & (depth_m > 0)]
    unhidden_m = behind_m[behind_m > -BEFORE_M]
    return float((np.abs(unhidden_m) < ON_M).mean()) if len(unhidden_m) else float("nan")


def reprojected(
    points: ObjectKeypoints, frame: int, camera: Camera, T_cam_obj: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) where the tracker saw keypoints of the final map in a frame, and (K,) pixels from there to their place.

    T_cam_obj  (4, 4) the pose, estimated or true, by which the map is laid into the image
    """
    now, keypoints = points.at(frame), np.flatnonzero(points.promoted)
    _, seen, known = np.intersect1d(points.track_id[now], points.ids[keypoints], return_indices=True)
    uv_px = points.uv_px[now][seen].astype(float)
    placed_px = camera.project(se3.transform(T_cam_obj, points.p_obj[keypoints[known]]))
    return uv_px, np.linalg.norm(uv_px - placed_px, axis=1)


def _reprojection_px(obj: ObjectRun, points: ObjectKeypoints, camera: Camera) -> float:
    """The median over all observations, in frames with a pose, of keypoints that the map still has; NaN without any."""
    posed = zip(obj.frame_index[obj.has_pose].tolist(), obj.T_cam_obj[obj.has_pose], strict=True)
    off_px = [reprojected(points, frame, camera, T_cam_obj)[1] for frame, T_cam_obj in posed]
    off_px = np.concatenate([np.zeros(0), *off_px])
    return float(np.median(off_px)) if len(off_px) else float("nan")
