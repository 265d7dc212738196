"""Keeps what a tracker says as a run's folder: what ``p2p run`` and ``p2p live`` share."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from p2p_lib.core.errors import Doubt, Doubts
from p2p_lib.core.mesh import save as save_mesh
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, PoseEstimate
from p2p_lib.datasets import sequence as sequences
from p2p_lib.datasets.cameras import Stream
from p2p_lib.datasets.first_masks import FILE as FIRST_MASKS
from p2p_lib.datasets.first_masks import FirstMasks
from p2p_lib.datasets.keypoint_log import KeypointLog
from p2p_lib.datasets.mask_log import MaskLog
from p2p_lib.datasets.run_writer import RunWriter
from p2p_lib.datasets.runs import load_run
from p2p_lib.evaluation.consistency import LOOKS, consistency
from p2p_lib.extended.default import Point2Pose
from p2p_lib.extended.saving import keep_memory


@dataclass(frozen=True, eq=False)
class Keeper:
    """Keeps what a tracker says as a run's folder: frame by frame poses, times and masks, and its maps at the end.

    masks     whether to keep the masks as images
    prompts   what started the objects, to be drawn with their first masks
    sizes_m   how long objects are known to be
    doubts    what was doubted meanwhile, which the caller fills (:func:`noted`)
    followed  what followed each object: one tracker, and one more each time that it was added again after its removal.
              What was removed is as it was then
    """

    writer: RunWriter
    method: Point2Pose
    masks: bool = False
    prompts: Iterable[Prompt] = ()
    sizes_m: Mapping[str, float] = field(default_factory=dict)
    doubts: Doubts = field(default_factory=Doubts)
    keypoints: KeypointLog = field(default_factory=KeypointLog)
    followed: dict[str, list[Any]] = field(default_factory=dict)

    @cached_property
    def mask_log(self) -> MaskLog:
        """The masks so far, coarsely."""
        return MaskLog(self.method.camera)

    @cached_property
    def first_masks(self) -> FirstMasks:
        """The picture of what the objects were started with, and of what corrections made."""
        return FirstMasks(self.writer.path / FIRST_MASKS, self.prompts)

    def add(self, frame: Frame, estimates: Mapping[str, PoseEstimate]) -> tuple[list[str], list[str]]:
        """The frame that has just been estimated; of which objects the first mask in it is drawn, a corrected one."""
        method, anew = self.method, list[str]()
        for name, obj in method.objects.items():
            if obj not in (trackers := self.followed.setdefault(name, [])):
                trackers.append(obj)
                anew.append(name)
            seen = method.tracks.visible & np.isin(method.tracks.ids, obj.model.map.ids)
            self.keypoints.add(frame.index, name, method.tracks.ids[seen], method.tracks.uv_px[seen])
        stages_ms = dict(method.stopwatch.last_ms)
        self.writer.add(frame, estimates, stages_ms.pop("total"), stages_ms)
        if self.masks:
            self.writer.add_masks(frame, method.masks)
        for name, mask in method.masks.items():
            if mask is not None:
                self.mask_log.add(frame, name, mask)
        return self.first_masks.add(frame, method.masks, anew, method.refused)

    def save_maps(self) -> None:
        """``meshes/<object>.ply`` and ``maps/<object>.npz`` of each surface in its object's frame, and the two logs."""
        path, maps = self.writer.path, {}
        for name, trackers in self.followed.items():
            map_id = self.writer.kept_map(name)
            for obj in (obj for obj in trackers if obj.known_as(map_id) is not None):
                model = obj.known_as(map_id).model
                if model.surface is not None and len((mesh := model.surface.mesh()).faces):
                    save_mesh(mesh, path / "meshes" / f"{name}.ply")
                keep_memory(path / "maps" / f"{name}.npz", obj, map_id, self.writer.info)
                maps[name] = model.map.ids, model.map.p_obj, model.map.promoted
        self.keypoints.save(path, maps)
        self.mask_log.save(path)

    def judge(self, sequence: sequences.Sequence | None = None) -> None:
        """Have ``run.json`` say what was doubted, and what to look at before the run is believed; when all is kept.

        sequence  whose images are looked at; None where they are gone
        """
        self.writer.info["doubts"] = [doubt.as_dict() for doubt in self.doubts]
        self.writer.flush()
        seen, looks = (Stream("", self.method.camera), 0) if sequence is None else (sequence, LOOKS)
        found = consistency(load_run(self.writer.path), seen, looks, self.sizes_m)
        self.writer.info["look_at"] = {name: [why.text for why in of] for name, of in found.suspicions.items()}


@contextmanager
def noted(doubts: Doubts) -> Iterator[None]:
    """Keeps what is doubted inside (:class:`~p2p_lib.core.errors.Doubt`), which is shown as before."""
    shown = warnings.showwarning

    def note(message: Warning | str, category: type[Warning], *where: Any, **how: Any) -> None:
        if isinstance(message, Doubt):
            doubts.add(message)
        shown(message, category, *where, **how)

    warnings.showwarning = note
    try:
        yield
    finally:
        warnings.showwarning = shown
