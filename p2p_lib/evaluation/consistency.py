"""How well a run agrees with what the camera saw: what can be said of it without any truth (``p2p eval``).

A reconstructed surface is laid into the image at the estimated pose. Where the camera measured something behind it, the
object cannot be: a wrong pose, or a surface that bulges. What lies in front of it hides it and says nothing. Where its
mask is not, the object should not be either, and its keypoints should lie where the 2D tracker saw them. What is
suspicious in all this is judged by :mod:`p2p_lib.evaluation.suspicions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import tables
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import DEPTH_MOVED
from p2p_lib.core.types import DOUBTED, median_of_known
from p2p_lib.datasets.keypoint_log import ObjectKeypoints, load_keypoints
from p2p_lib.datasets.mask_log import load_masks
from p2p_lib.datasets.runs import ObjectRun, Run, load_run
from p2p_lib.datasets.sequence import Sequence, reopen_if_there
from p2p_lib.evaluation.evidence import ON_M, depth_as_taken, gathered, reprojected, surface_in_view
from p2p_lib.evaluation.known_size import lengths, mesh_length_m
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX, ran_with, rate
from p2p_lib.evaluation.suspicions import Suspicion, suspicions

if TYPE_CHECKING:
    from pandas import DataFrame

#: Frames that are looked at, evenly spread over the run: at its end the same as in ``p2p eval``, which say the same.
LOOKS = 60
#: What the numbers are called, and what they say.
HEADS = {
    "pose": ("pose [%]", ""),
    "doubted": ("doubted [%]", f"of confidence {DOUBTED:g} at most"),
    "pose_where_seen": ("where seen [%]", f"a pose where the mask has {MIN_VISIBLE_PX} pixels"),
    "depth_on_surface": (
        "depth on surface [%]",
        f"of the surface in view, within {1000 * ON_M:g} mm or noise",
    ),
    "mask_iou": (
        "mask IoU [%]",
        "of the surface's unhidden outline with the mask",
    ),
    "reprojection_px": ("reprojection [px]", "keypoints at the pose to where they were seen"),
}
#: Measured from clicks on three real sequences as tracked, and on two of them with every pose put off by 1 cm.
SCALE = (
    "On real video that was tracked well: depth 70 to 90 %, IoU 80 to 90 %, below 1 px; with poses 1 cm off: "
    "40 to 80 %, 70 to 80 %, 4 to 5 px."
)


@dataclass(frozen=True, eq=False)
class Consistency:
    """What can be said of a run without truth: per object the numbers of :data:`HEADS`, NaN where there is none.

    depth_on_surface, mask_iou and reprojection_px are medians over the frames that were looked at. suspicions: per
    object, what there is to look at before the run is believed. unknown: object to why no pose of it was compared with
    what the camera saw, of those of which none was. not_scored: why there is truth and no score.
    """

    objects: dict[str, dict[str, float]]
    suspicions: dict[str, tuple[Suspicion, ...]]
    unknown: dict[str, str] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    hz: float | None = None
    not_scored: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as ``p2p eval --json`` prints them; None where there is nothing to say."""
        plain = {
            name: {key: value if np.isfinite(value) else None for key, value in numbers.items()}
            | {"verdict": self.verdict(name), "look_at": [asdict(found) for found in self.suspicions[name]]}
            | {"unknown": self.unknown.get(name)}
            for name, numbers in self.objects.items()
        }
        ran = ran_with(self.info)
        return {"truth": None, "not_scored": self.not_scored or None, "objects": plain, "hz": self.hz, **ran}

    def as_frame(self) -> DataFrame:
        """A row per object."""
        from pandas import DataFrame

        rows = [{"object": name, **numbers, "verdict": self.verdict(name)} for name, numbers in self.objects.items()]
        return DataFrame(rows).round(1).rename(columns={key: head for key, (head, _) in HEADS.items()})

    def as_table(self) -> str:
        """The same for people, with what each number says."""
        said = {key for numbers in self.objects.values() for key, value in numbers.items() if np.isfinite(value)}
        legend = "; ".join(f"{head}: {says}" for key, (head, says) in HEADS.items() if key in said and says)
        hz = [f"{self.hz:.1f} Hz"] if self.hz is not None else []
        ran = ", ".join(f"{key} {value}" for key, value in ran_with(self.info).items())
        without = f"Not scored: {self.not_scored}.\nWithout a model" if self.not_scored else "Without truth"
        title = f"{without}: how well the run agrees with what the camera saw (- where nothing was kept to tell)"
        return "\n".join(
            [title, tables.as_text(self.as_frame()), *self.look_at(), *filter(None, [legend]), SCALE, *hz, ran]
        )

    def verdict(self, name: str) -> str:
        """In a word: ``good``, ``look`` at the film before an object's poses are believed, or ``unknown``."""
        return "look" if self.suspicions[name] else "unknown" if name in self.unknown else "good"

    def look_at(self) -> list[str]:
        """A line per object and suspicion: why, and at which frames to look; and where nothing could be compared."""
        lines = [f"look at {name}: {found.text}" for name, of in self.suspicions.items() for found in of]
        return lines + [f"unknown, {name}: {why}" for name, why in self.unknown.items()]


def consistency(
    run: Run, sequence: Sequence | None = None, looks: int = LOOKS, known_m: Mapping[str, float] | None = None
) -> Consistency:
    """What can be said of a run without truth; of its images where they can still be had.

    Frames before an object was added and after it was removed count neither for nor against it.

    sequence  that the run was made on (default: opened as the run says)
    looks     frames of which the images are looked at, evenly spread; where there are none to be had, 0
    known_m   how long objects are known to be: what was measured is compared with it
    """
    no_images = ""
    if sequence is None:
        sequence, no_images = reopen_if_there(run.info)
    # Those of an offline result are its run's.
    keypoints = load_keypoints(run.path / run.info.get("masks_in", ""))
    masks, every = load_masks(run.path), load_run(run.path, every_map=True)
    sizes = {name: of.doubt for name, of in lengths(run.path, known_m or {}).items() if of.doubt}
    objects, found, unknown = {}, {}, {}
    measured_m = depth_as_taken(sequence, run.doubts, looks) if sequence is not None else None
    for name, whole in run.objects.items():
        rows = whole.followed if whole.followed.any() else np.ones(len(whole), bool)
        obj, of_every_map = whole.select(rows), every.objects[name].select(rows)
        mesh = run.path / "meshes" / f"{name}.ply"
        fit = surface_in_view(obj, sequence, mesh, masks.get(name), looks, measured_m)
        doubts = tuple(str(of) for of in run.doubts if of.object in (None, name) and of.kind != DEPTH_MOVED)
        moved = run.info.get("disagrees_above_3_sigma", {}).get(name, ())
        kept_of = masks.get(name), keypoints.get(name)
        evidence = gathered(obj, of_every_map, sequence, *kept_of, fit, doubts, moved, mesh_length_m(mesh)[0])
        off = (Suspicion("known size", sizes[name]),) if name in sizes else ()
        found[name] = off + suspicions(evidence)
        if obj.has_pose.any() and not evidence.compared:
            kept = mesh.is_file() or name in keypoints
            why = "it is in none of the frames looked at" if kept else "neither its surface nor its keypoints were kept"
            unknown[name] = f"no pose was compared with what the camera saw: {no_images or why}"
        numbers = dict.fromkeys(HEADS, float("nan")) | {"pose": 100 * float(obj.has_pose.mean())}
        if obj.has_pose.any():
            numbers["doubted"] = 100 * float(obj.doubted.sum() / obj.has_pose.sum())
        if evidence.seen.any():
            numbers["pose_where_seen"] = 100 * float(obj.has_pose[evidence.seen].mean())
        for key, values in (("depth_on_surface", fit.on_surface), ("mask_iou", fit.overlap)):
            numbers[key] = 100 * median_of_known(values)
        if name in keypoints and sequence is not None:
            numbers["reprojection_px"] = _reprojection_px(obj, keypoints[name], sequence.camera)
        objects[name] = numbers
    return Consistency(objects, found, unknown, run.info, rate(run.timings)[0])


def _reprojection_px(obj: ObjectRun, points: ObjectKeypoints, camera: Camera) -> float:
    """The median over all observations, in frames with a pose, of keypoints that the map still has; NaN without any."""
    posed = zip(obj.frame_index[obj.has_pose].tolist(), obj.T_cam_obj[obj.has_pose], strict=True)
    each_px = (reprojected(points, frame, camera, T_cam_obj)[1] for frame, T_cam_obj in posed)
    off_px = np.concatenate([np.zeros(0), *each_px])
    return float(np.median(off_px)) if len(off_px) else float("nan")
