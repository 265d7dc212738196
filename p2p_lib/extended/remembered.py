"""An object that is known from a memory: one that was lost before the video began (not in the paper).

Until it is found it is looked for in the whole image by its landmarks; where enough of them agree on a pose, and the
surface shows there, the segmenter starts from what lies on the surface and the 2D tracker follows the landmarks. From
there on it is an object like any other, in the frame of its old map. Landmarks of sides that come into view later
become keypoints as they show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.memory import ObjectMemory
from p2p_lib.core.types import Frame, Status, Tracks, joined
from p2p_lib.extended.agreement import outline_share
from p2p_lib.extended.image_search import ImageSearch, Sighting, laid_at
from p2p_lib.extended.sight import Sight
from p2p_lib.extended.two_maps import TwoMaps
from p2p_lib.method.object_model import Requests
from p2p_lib.method.object_tracker import ObjectStep, ObjectTracker
from p2p_lib.method.policy import Verdict
from p2p_lib.method.refinement import surface_distance

#: Where so many landmarks agree on a pose by themselves, and so much of the surface shows there, it is the object's. (A
#: label that repeats on the other side of a tin has half of its colours right.)
_AGREEING, _RECOGNISED = 8, 0.65
#: So many things that look alike are told from each other by how much of the surface shows.
_ALIKE = 3
#: Else so many have to show under a pose, and so many of those that a keyframe gave (of so many keyframes, as if each
#: had its own); so much of the surface, too, and along so much of its outline the depth has to have a step.
_FEWEST, _OF_A_VIEW, _VIEWS, _SHARE, _OUTLINE = 4, 0.1, 10, 0.8, 0.45
#: Else it is looked for as it was turned in so many of its keyframes.
_TURNS = 12
#: Pixels are of a found object whose depth is this near to its surface, m.
_ON_SURFACE_M = 0.012
#: Landmarks are looked for on a followed object every so many frames while fewer than so many are seen on it.
_EVERY, _ENOUGH = 5, 60


@dataclass(frozen=True, eq=False)
class Found:
    """Where a remembered object is in an image: its ``mask`` (H, W) bool, what shows of it, and landmarks there.

    keys  (M,) of the landmarks in the map, seen at uv_px (M, 2)
    """

    mask: np.ndarray
    sighting: Sighting
    keys: np.ndarray
    uv_px: np.ndarray


class Remembered(TwoMaps):
    """One object that began with a memory; ``frozen``: its map does not grow.

    recogniser  what finds landmarks in images (:func:`p2p_lib.core.backends.make_recogniser`); objects may share it
    """

    def __init__(self, own: ObjectTracker, memory: ObjectMemory, recogniser: Any, frozen: bool = False):
        super().__init__(own)
        self._rng = np.random.default_rng(0)
        self.policy.frozen = frozen
        own.model.recall(memory)
        self.life = replace(self.life, seen_m2=float(memory.seen_m2))
        self._memory, self._frozen = memory, frozen
        self._recogniser = recogniser
        self._key = np.full(len(memory.p_obj), -1)  # of each landmark that is in the map
        self._fewest = max(_FEWEST, _OF_A_VIEW * len(memory.p_obj) / min(len(memory.T_cam_obj), _VIEWS))
        self._since = 0  # frames since landmarks were looked for on it

    @property
    def recalls(self) -> bool:
        """Whether it is to be looked for by its landmarks."""
        return not self.life.has_pose

    def began_with(self, map_id: int) -> ObjectMemory | None:
        """The memory, of the map that began with it."""
        return self._memory if map_id == 0 else None

    def find(
        self,
        frame: Frame,
        mask: np.ndarray | None,
        taken: np.ndarray | None,
        rivals: Sequence[Remembered] = (),
    ) -> Found | None:
        """Look for it in a frame, outside of what other objects have ``taken`` and inside its ``mask``, (H, W) bool.

        rivals  others that are looked for: what is more like one of them is not this one
        """
        memory, best = self._memory, None
        search = ImageSearch(frame, self.observer.camera, self.config.depth)
        for sighting, recognised in self._sightings(frame, search, mask, taken):
            if recognised and any(rival.beats(frame, search, self._middle(sighting), sighting) for rival in rivals):
                continue
            where = mask if mask is not None else self._on_surface(frame, sighting.T_cam_obj, sighting.uv_px)
            if taken is not None and mask is None:
                if (where & taken).sum() > 0.5 * where.sum():
                    continue
                where = where & ~taken
            if where.sum() < self.config.lifecycle.min_mask_px:
                continue
            seen = self._recogniser.at(frame, where, sighting.T_cam_obj, memory.p_obj, memory.descriptors)
            worth = sighting.share if recognised else len(seen)
            if best is not None and worth <= best[0]:
                continue
            if recognised or _certain(
                len(seen) / self._fewest, sighting.share, partial(outline_share, frame, where, True)
            ):
                best = worth, where, sighting, seen
        if best is None:
            return None
        _, where, sighting, seen = best
        return Found(where, sighting, self._taken_in(seen.rows), seen.uv_px)

    def _sightings(
        self, frame: Frame, search: ImageSearch, mask: np.ndarray | None, taken: np.ndarray | None
    ) -> list[tuple[Sighting, bool]]:
        """Where it may be, and whether landmarks that agree say so or its looks alone."""
        p_obj, sample = self._memory.p_obj, self.policy.shape.sample(self.model)
        pairs = self._recogniser.pairs(frame, self._memory.descriptors)
        if recognised := self._recognised(search, pairs):
            return [(sighting, True) for sighting in recognised]
        turns = self.model.views.some(_TURNS)
        free = np.ones(frame.shape, bool) if mask is None else mask
        free = free if taken is None else free & ~taken
        poses = [laid_at(turns, search.places(free, sample, self._rng), sample)]
        for T in turns:
            one = np.repeat(T[None], len(pairs), 0)
            one[:, :3, 3] = pairs.p_cam - p_obj[pairs.rows] @ T[:3, :3].T
            poses.append(one)
        found = search.among(np.concatenate(poses), sample)
        return [(sighting, False) for sighting in found if sighting.share >= _SHARE]

    def _recognised(self, search: ImageSearch, pairs: Any) -> list[Sighting]:
        """Where landmarks agree on a pose and the surface shows: more than one place where others look alike."""
        p_obj, sample, found = self._memory.p_obj, self.policy.shape.sample(self.model), []
        for _ in range(_ALIKE):
            agreeing = self._recogniser.agreeing(pairs, p_obj)
            if len(agreeing) < _AGREEING:
                break
            found.append(search.about(agreeing.T_cam_obj, sample))
            away_m = np.linalg.norm(pairs.p_cam - agreeing.p_cam.mean(0), axis=1)
            pairs = pairs.select(away_m > np.ptp(sample.p_obj, 0).max())
        return [sighting for sighting in found if sighting is not None and sighting.share >= _RECOGNISED]

    def _middle(self, sighting: Sighting) -> np.ndarray:
        """(3,) where the middle of the surface is."""
        return se3.transform(sighting.T_cam_obj, self.policy.shape.sample(self.model).p_obj).mean(0)

    def beats(self, frame: Frame, search: ImageSearch, middle: np.ndarray, other: Sighting) -> bool:
        """Whether more of this object's surface shows about a place (3,) than of another object's."""
        found = self._recognised(search, self._recogniser.pairs(frame, self._memory.descriptors))
        reach_m = np.ptp(self.policy.shape.sample(self.model).p_obj, 0).max() / 2
        here = [one for one in found if np.linalg.norm(self._middle(one) - middle) < reach_m]
        return any(one.share > other.share for one in here)

    def _on_surface(self, frame: Frame, T_cam_obj: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
        """(H, W) bool: what lies on the surface under a pose, as far as it holds together with pixels (M, 2) on it."""
        distance_m = surface_distance(self.model.surface, frame.depth_m, self.observer.camera, T_cam_obj)
        near = (np.abs(distance_m) < _ON_SURFACE_M).astype(np.uint8)
        near = cv2.morphologyEx(near, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        _, label = cv2.connectedComponents(near)
        u, v = np.rint(uv_px).astype(int).T
        held = np.unique(label[v, u])
        return np.isin(label, held[held > 0])

    def _taken_in(self, rows: np.ndarray) -> np.ndarray:
        """Landmarks (M,) as keypoints of the map, anew where they were lost: their keys."""
        memory = self._memory
        keys = self.model.remember(memory.p_obj[rows].astype(float), memory.confidence[rows])
        self._key[rows] = keys
        return keys

    # -- the step ------------------------------------------------------------------------------

    def step(self, obs: Sight) -> ObjectStep:
        """The object's pose at a frame; once it is followed, landmarks that have come into view are added."""
        if self.life.T_cam_obj is None and obs.mask is None:
            return self.own.absent(obs, Verdict(False, Status.INITIALISING, "remembered, and not found yet"))
        followed = int(np.isin(self.map.keys, self._key)[obs.seen].sum())
        step = super().step(obs)
        self._since += 1
        due = self._since >= _EVERY and step.estimate.T_cam_obj is not None and self.known.map_id == 0
        if not due or followed >= _ENOUGH or step.estimate.status is Status.DEGRADED or obs.mask is None:
            return step
        self._since = 0
        return replace(step, requests=self._with_more(step.requests, obs, step.estimate.T_cam_obj))

    def _with_more(self, requests: Requests, obs: Sight, T_cam_obj: np.ndarray) -> Requests:
        """Requests with landmarks that are seen under a pose, and are not followed yet."""
        absent = np.flatnonzero(~np.isin(self._key, self.map.keys))
        p_obj, descriptors = self._memory.p_obj[absent], self._memory.descriptors[absent]
        seen = self._recogniser.at(obs.frame, obs.mask, T_cam_obj, p_obj, descriptors)
        if not len(seen):
            return requests
        keys = self._taken_in(absent[seen.rows])
        add_px, keys = np.concatenate([requests.add_px, seen.uv_px]), np.concatenate([requests.keys, keys])
        return replace(requests, add_px=add_px, keys=keys)

    def _outgrown(self, obs: Sight) -> bool:
        """A memory is never founded anew."""
        return False

    def _turned_over(self, obs: Sight) -> bool:
        """No second map where the map does not grow, or before the object was ever found."""
        return not self._frozen and self.life.T_cam_obj is not None and super()._turned_over(obs)


def _certain(landmarks: float, share: float, outline: Callable[[], float | None]) -> bool:
    """Whether landmarks, as a multiple of the fewest, a share of the surface and of the outline are the object's.

    What is bland and smooth lies on a wall as well as on itself: but nothing ends there.
    """
    return landmarks >= 1 and share >= _SHARE and (outline() or 0.0) >= _OUTLINE


def follow(obj: Remembered, found: Found, tracker: PointTracker, tracks: Tracks) -> Tracks:
    """Have the tracker follow what was found; everybody's tracks in this frame, with these."""
    ids = tracker.add(found.uv_px)
    obj.map.assign(found.keys, ids)
    count = len(ids)
    return joined([tracks, Tracks(ids, found.uv_px, np.ones(count, bool), np.zeros(count))])
