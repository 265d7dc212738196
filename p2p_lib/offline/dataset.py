"""A run as a dataset for others: a BOP scene with labels (``bop-dataset``), and the folders of FoundationPose.

Labels are the run's trusted poses, of the run's own surfaces. As in the BOP toolkit a surface is hidden where the
measured depth is more than 15 mm before it; where nothing was measured it counts as visible.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replace_text
from p2p_lib.core.image import mask_iou
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.types import DOUBTED, Frame
from p2p_lib.datasets import images
from p2p_lib.datasets.bop import Outline, write_models, write_scene
from p2p_lib.datasets.truth import ObjectTruth
from p2p_lib.evaluation.evidence import on_surface
from p2p_lib.evaluation.suspicions import ON_SURFACE, OVERLAP
from p2p_lib.offline.finished import RULE, Finished, Renderer, Silhouette, new_folder

if TYPE_CHECKING:
    from pandas import DataFrame

#: Depth up to this far before a surface does not hide it, m (the BOP toolkit's).
VISIBLE_M = 0.015
#: Columns of ``labels.csv``: how well each label fits, and whether it is doubtful, by :data:`DOUBTFUL`.
COLUMNS = (
    "image",
    "object",
    "obj_id",
    "confidence",
    "visib_fract",
    "visib_iou",
    "depth_on_surface",
    "depth_off_mm",
    "beside_mask",
    "doubtful",
)
#: If more than this share of an object's labels lies beside its masks, the median over its images, its model is larger
#: than it. (A keyboard with a strip of its table, a roll of tape, a mug of which masks missed a part: 4.6 to 7 %; nine
#: others of five runs: at most 3.4 %.)
BESIDE = 0.04
#: The one rule of which labels are to be looked at. Not by ``depth_off_mm``: a tenth of a surface on the background, as
#: a fringe of it, is decimetres off.
DOUBTFUL = (
    f"confidence at most {DOUBTED:g}, or what shows of the surface and the mask overlap by less than {OVERLAP:g} (IoU),"
    f" or depth lies on less than {100 * ON_SURFACE:.0f} % of what shows, or more than {100 * BESIDE:g} % of what shows"
    " of its object lies beside the masks (the median of its images)"
)
SCENE = "train/000001"


def visible(silhouette: Silhouette, depth_m: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels of an image in which a surface shows, by the depth (H, W) measured."""
    surface_m = silhouette.depth_in(depth_m)
    return np.isfinite(surface_m) & ((depth_m == 0) | (surface_m - depth_m <= VISIBLE_M))


def outline(silhouette: Silhouette, depth_m: np.ndarray) -> Outline:
    """A surface in an image as if nothing hid it."""
    mask = np.isfinite(silhouette.depth_in(depth_m))
    x, y, w, h = cv2.boundingRect(silhouette.hit.astype(np.uint8))
    box = silhouette.corner[0] + x, silhouette.corner[1] + y, w, h
    return Outline(mask, int(silhouette.hit.sum()), box, int(np.count_nonzero(mask & (depth_m > 0))))


def agreement(silhouette: Silhouette, shown: np.ndarray, depth_m: np.ndarray, mask: np.ndarray | None):
    """How well a label fits; NaN where nothing tells.

    The IoU of what is shown of the surface with the mask, the share of it on which depth was measured, by the rule of
    ``p2p eval`` (holes of the depth and what is in front count neither way), and the 90th percentile of its errors, mm.
    """
    surface_m = silhouette.depth_in(depth_m)
    iou = np.nan if mask is None else mask_iou(shown, mask)
    both = shown & (depth_m > 0)
    off_m = np.abs(surface_m[both] - depth_m[both])
    off_mm = float(1000 * np.quantile(off_m, 0.9)) if len(off_m) else np.nan
    return iou, on_surface(np.where(shown, surface_m, 0), depth_m), off_mm


def doubtful(confidence: float, iou: float, on: float, beside: float = np.nan) -> bool:
    """Whether a label is to be looked at, by :data:`DOUBTFUL`; what is not known (NaN) speaks against none.

    beside  the share of its object's labels that lies beside the masks
    """
    return bool(confidence <= DOUBTED or iou < OVERLAP or on < ON_SURFACE or beside > BESIDE)


class _Labels:
    """The run as a sequence with its trusted poses as truth; ``rows`` say how well each label fits, by itself."""

    def __init__(self, made: Finished, min_confidence: float):
        self.made, self.objects, self.camera = made, made.tracked, made.sequence.camera
        self.rows: list[tuple] = []
        self.truth: dict[str, ObjectTruth] = {}
        for name, trusted in made.trusted(min_confidence).items():
            poses, obj = np.full((len(made.sequence), 4, 4), np.nan), made.run.objects[name]
            poses[obj.frame_index[trusted]] = obj.T_cam_obj[trusted]
            self.truth[name] = ObjectTruth(poses, np.isfinite(poses).all((1, 2)))
        self.frames = np.flatnonzero(np.logical_or.reduce([of.labelled for of in self.truth.values()]))
        surfaces = {name: made.surface(name) for name in self.objects}
        self._render = {name: Renderer(mesh.vertices, mesh.faces, self.camera) for name, mesh in surfaces.items()}
        self._rendered = lru_cache(maxsize=1)(self._render_all)

    def _render_all(self, i: int) -> tuple[Frame, dict[str, Silhouette]]:
        """The image, and each labelled object in it as if nothing hid it."""
        poses = {name: of.T_cam_model[i] for name, of in self.truth.items() if of.labelled[i]}
        return self.made.frame(i), {name: self._render[name](T) for name, T in poses.items()}

    def frame(self, i: int) -> Frame:
        """The image."""
        return self._rendered(i)[0]

    def masks(self, i: int) -> dict[str, np.ndarray]:
        """What shows of each object."""
        frame, silhouettes = self._rendered(i)
        return {name: visible(silhouette, frame.depth_m) for name, silhouette in silhouettes.items()}

    def outlines(self, i: int) -> dict[str, Outline]:
        """The objects as if nothing hid them; notes how well the labels fit."""
        (frame, silhouettes), shown, given = self._rendered(i), self.masks(i), self.made.masks(i)
        whole = {name: outline(silhouette, frame.depth_m) for name, silhouette in silhouettes.items()}
        for name, silhouette in silhouettes.items():
            mask, obj = given.get(name), self.made.run.objects[name]
            iou, on, off_mm = agreement(silhouette, shown[name], frame.depth_m, mask)
            beside = np.nan if mask is None else self.made.beside(shown[name], mask)
            confidence = obj.confidence[np.searchsorted(obj.frame_index, i)]
            share = np.count_nonzero(shown[name]) / max(whole[name].px, 1)
            self.rows.append((i, name, self.objects.index(name) + 1, confidence, share, iou, on, off_mm, beside))
        return whole

    def judged(self) -> tuple[DataFrame, dict[str, float]]:
        """Every label that was written with all its :data:`COLUMNS`, and per object the share beside its masks."""
        from pandas import DataFrame

        table = DataFrame(self.rows, columns=list(COLUMNS[:-1]))
        beside = table.groupby("object", sort=False)["beside_mask"].median()
        of = table["confidence"], table["visib_iou"], table["depth_on_surface"], table["object"].map(beside)
        return table.assign(doubtful=[doubtful(*each) for each in zip(*of, strict=True)]), beside.to_dict()


def write_bop(folder: str | Path, out: str | Path, min_confidence: float = DOUBTED, progress: bool = False) -> str:
    """Write the run in ``folder`` as the BOP dataset ``out`` (see the module); what it holds, in words.

    Its scene is ``train/000001``, its images keep the run's frame numbers, its models are the run's surfaces.
    ``labels.csv`` says of each label how well it fits, ``labels.json`` by what rules frames were left out and labels
    are doubtful, and which number is which object. Raises :class:`BadInput` where no frame has a label.
    """
    labels = _Labels(made := Finished.of(folder), min_confidence)
    if not len(labels.frames):
        fix = "Lower --min-confidence, or look at what was wrong: p2p eval RUN."
        raise BadInput(str(folder), "no frame to label", RULE.format(min_confidence), fix)
    with new_folder(out) as there:
        with progress_bar("dataset", shown=progress, iterable=labels.frames.tolist()) as kept:
            obj_ids = write_scene(there / SCENE, labels, kept, labels.outlines)  # type: ignore[arg-type]
        write_models(there / "models", {obj_ids[n]: made.run.path / "meshes" / f"{n}.ply" for n in labels.objects})
        camera = labels.camera
        intrinsics = {key: getattr(camera, key) for key in ("cx", "cy", "fx", "fy", "width", "height")}
        replace_text(there / "camera.json", json.dumps(intrinsics | {"depth_scale": 1.0}, indent=1) + "\n")
        how: Any = {"index": False, "lineterminator": "\n", "float_format": "%.4f", "na_rep": "nan"}
        table, beside = labels.judged()
        replace_text(there / "labels.csv", table.to_csv(**how))
        about = {
            "rule": RULE.format(min_confidence),
            "min_confidence": min_confidence,
            "visible_m": VISIBLE_M,
            "doubtful": DOUBTFUL,
        }
        about |= {"run": made.about, "objects": obj_ids}
        about |= {"frames": len(made.frames), "labelled": len(labels.frames)}
        about |= {"beside_masks": {n: round(share, 4) for n, share in beside.items() if np.isfinite(share)}}
        replace_text(there / "labels.json", json.dumps(about, indent=1, ensure_ascii=False) + "\n")
    lines = [f"{len(table)} labels in {len(labels.frames)} of {len(made.frames)} images"]
    if left_out := len(made.frames) - len(labels.frames):
        lines.append(f"{left_out} left out, in which an object has no pose of confidence above {min_confidence:g}")
    lines.append(f"{table['doubtful'].sum()} of the labels doubtful ({DOUBTFUL}): see labels.csv")
    return "; ".join([*lines, *_beside(beside)])


def _beside(beside: Mapping[str, float]) -> list[str]:
    """Which share of each object's labels lies beside its masks, in words, and what to do where it is large."""
    known = {name: share for name, share in beside.items() if np.isfinite(share)}
    if not known:
        return []
    said = f"beside the masks lies {', '.join(f'{100 * share:.1f} % of {name}' for name, share in known.items())}"
    large = [name for name, share in known.items() if share > BESIDE]
    look = f": the model of {', '.join(large)} holds more than the object, or the masks less: p2p film RUN --surfaces"
    return [said + look * bool(large)]


def write_foundationpose(
    folder: str | Path, out: str | Path, meshes: Mapping[str, Path], min_confidence: float = DOUBTED
) -> str:
    """Write a folder for each object as FoundationPose's demo reads it; what was written, in words.

    ``rgb/`` and ``depth/`` (millimetres) from its first trusted frame on, ``masks/`` of that frame, ``cam_K.txt`` and
    ``mesh/``: the files of ``meshes`` (object to a folder of them).
    """
    made, lines = Finished.of(folder), []
    first = {}
    for name, trusted in made.trusted(min_confidence).items():
        masks = ((int(i), made.masks(int(i)).get(name)) for i in made.frames[trusted])
        if shown := next(((i, mask) for i, mask in masks if mask is not None and mask.any()), None):
            first[name] = shown
    if not first:
        raise BadInput(str(folder), "no trusted frame with a mask", "one of an object", "Run it with --save-masks.")
    with new_folder(out) as there:
        for name, (start, mask) in first.items():
            at, numbers = there / name, [int(i) for i in made.frames if i >= start]
            for i in numbers:
                frame = made.frame(i)
                images.save_png(at / "rgb" / f"{i:06d}.png", frame.rgb)
                depth_mm = np.clip(np.rint(frame.depth_m.astype(float) * 1000), 0, 65535).astype(np.uint16)
                images.save_png(at / "depth" / f"{i:06d}.png", depth_mm)
            images.save_png(at / "masks" / f"{start:06d}.png", mask)
            np.savetxt(at / "cam_K.txt", made.sequence.camera.K, fmt="%.9g")
            shutil.copytree(meshes[name], at / "mesh")
            lines.append(f"{name}: {len(numbers)} images from frame {start} on")
    return "; ".join(lines)
