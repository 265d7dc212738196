"""An object that is known from a memory: one that was lost before the video began (not in the paper).

It is looked for in the whole image by its landmarks: where enough of them agree on a pose, and the surface shows
there, it may be. It is claimed to be there once another image alone finds it at the same place: what only resembles it
in one image is not found twice. Then the segmenter starts from what lies on the surface, and the 2D tracker follows
the landmarks. From then on it is an object like any other, in the frame of its old map, which grows: of something
small few landmarks are seen, and new points hold what they have found. A claim that loses its points before enough of
them have confirmed it is renewed by its landmarks, or withdrawn, with everything learnt since. Landmarks of sides that
come into view later become keypoints when they are seen.
"""

from __future__ import annotations

from collections.abc import Callable
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
from p2p_lib.extended.image_search import ImageSearch, Sighting, centred_at_points
from p2p_lib.extended.observation import OurObservation
from p2p_lib.extended.two_maps import OurTracker, TwoMaps
from p2p_lib.method.object_model import CONFIRM_FRAMES, Known, Requests
from p2p_lib.method.object_tracker import ObjectStep
from p2p_lib.method.policy import Verdict
from p2p_lib.method.refinement import surface_distance

#: A pose on which so many landmarks agree, and under which this share of the surface shows, is the object's. (A label
#: that repeats on the other side of a tin has half of its colours right.)
_AGREEING, _RECOGNISED = 8, 0.65
#: So many poses that look alike are compared by how much of the surface shows.
_ALIKE = 4
#: Else under a pose have to show: so many landmarks; this share of a keyframe's (all, divided by the keyframes, at most
#: by this number); this share of the surface; and depth steps along its outline, this share of what its keyframes had,
#: and of all of it.
_FEWEST, _OF_A_VIEW, _VIEWS, _SHARE, _OUTLINE, _STEPS = 4, 0.1, 10, 0.8, 0.6, 0.15
#: Without such a pose, turns of so many keyframes are tried.
_TURNS = 12
#: Pixels with depth this near to its surface belong to a found object, m.
_ON_SURFACE_M = 0.012
#: On a followed object landmarks are looked for every so many frames, while fewer than so many are seen.
_EVERY, _ENOUGH = 5, 60
#: It is found again if, within so many looks, it has turned by less than this, rad, and moved by less than half its
#: length plus this speed in the camera frame, m/s.
_LOOKS, _ALIKE_RAD, _FASTEST_M_S = 8, np.radians(25), 1.0
#: A claim with fewer agreeing points is looked for anew, and withdrawn after so many looks in vain.
_BARE, _PATIENCE = 4, 5
#: Why it has no pose yet; and where it has a mask, as after clicks on it.
_WAITS, _UNLIKE = "known from memory, not found yet", ": what is in its mask does not fit it so far"


@dataclass(frozen=True, eq=False)
class Recognition:
    """Where a remembered object is in an image: its ``mask`` (H, W) bool, what shows of it, and landmarks ``seen``."""

    mask: np.ndarray
    sighting: Sighting
    seen: Any


class Remembered(TwoMaps):
    """One object that began with a memory; ``frozen``: its map does not grow.

    recogniser  what finds landmarks in images (:func:`p2p_lib.core.backends.make_recogniser`); objects may share it
    """

    def __init__(self, own: OurTracker, memory: ObjectMemory, recogniser: Any, frozen: bool = False):
        super().__init__(own)
        self._rng = np.random.default_rng(0)
        self._memory, self.frozen = memory, frozen
        self._first_map = own.known.map_id
        self._recogniser = recogniser
        self._fewest = max(_FEWEST, _OF_A_VIEW * len(memory.p_obj) / min(len(memory.T_cam_obj), _VIEWS))
        self._begin()

    def _begin(self) -> None:
        """Reset what is known to the memory alone."""
        own, memory = self.own, self._memory
        own.known = Known(own.new_model(), replace(self.policy.life, seen_m2=float(memory.seen_m2)), self._first_map)
        own.known.model.recall(memory)
        self._recalled = own.known.model.revision
        self.other, self.policy.frozen, self.policy.trusted = None, self.frozen, None
        self._key = np.full(len(memory.p_obj), -1)  # of each landmark that is in the map
        self._since = 0  # frames since landmarks were looked for on it
        self._finds: list[tuple[float, np.ndarray | None]] = []  # the newest looks, until two agree: time_s, T_cam_obj
        self._claimed, self._borne_out = False, 0  # whether it is said to be there; frames whose points agreed
        self._bare, self._in_vain = True, 0  # whether few points agree; looks in a row that did not find it
        self.left: np.ndarray | None = None  # T_cam_obj of a moment ago, where a tracker goes on after a restart

    @property
    def recalls(self) -> bool:
        """Whether it is to be looked for by its landmarks."""
        return not self.life.has_pose or (self._bare and not self._confirmed)

    @property
    def _confirmed(self) -> bool:
        return self._borne_out >= CONFIRM_FRAMES

    @property
    def forsaken(self) -> bool:
        """Whether it was claimed to be there, and neither points nor landmarks have confirmed that."""
        return self._claimed and not self._confirmed and self._in_vain >= _PATIENCE

    def withdraw(self) -> Requests:
        """Withdraw the claim, with everything learnt since."""
        ids = self.ids
        self._begin()
        return Requests(drop=ids[ids >= 0])

    def began_with(self, map_id: int) -> ObjectMemory | None:
        """The memory that this map began with; None for a later map."""
        return self._memory if map_id == self._first_map else None

    @property
    def has_learnt(self) -> bool:
        """Whether the map that the memory began holds more than the memory."""
        known = self.known_as(self._first_map)
        return known is not None and known.model.revision > self._recalled

    def find(self, frame: Frame, mask: np.ndarray | None, taken: np.ndarray | None) -> Recognition | None:
        """Look for it in a frame, outside of what other objects have ``taken`` and inside its ``mask``, (H, W) bool.

        It counts as found where one of the last looks found it, too, or where its pose has it; in a mask, at once.
        """
        found = self._look(frame, mask, taken)
        T = None if found is None else found.sighting.T_cam_obj
        before = [(self.life.seen_s, self.life.T_cam_obj)] if self.life.has_pose else self._finds
        before, self.left = before if self.left is None else [(frame.time_s, self.left)], None
        alike = (T is not None and self._alike(T, other, frame.time_s - time_s) for time_s, other in before)
        again = found is not None and (mask is not None or any(alike))
        self._finds = [] if again or self.life.has_pose else [*self._finds, (frame.time_s, T)][-_LOOKS:]
        self._in_vain = 0 if again else self._in_vain + 1
        self._claimed |= again
        return found if again else None

    def _alike(self, T_cam_obj: np.ndarray, other: np.ndarray | None, after_s: float) -> bool:
        """Whether two poses (4, 4), ``after_s`` apart in time, may be of one object."""
        if other is None or se3.angle_rad(se3.inverse(other) @ T_cam_obj) > _ALIKE_RAD:
            return False
        p_obj = self.policy.shape.sample(self.model).p_obj
        moved_m = se3.transform(T_cam_obj, p_obj).mean(0) - se3.transform(other, p_obj).mean(0)
        return bool(np.linalg.norm(moved_m) < np.ptp(p_obj, 0).max() / 2 + _FASTEST_M_S * after_s)

    def _look(self, frame: Frame, mask: np.ndarray | None, taken: np.ndarray | None) -> Recognition | None:
        """Where it may be in one frame."""
        search, best = ImageSearch(frame, self.observer.camera, self.config.depth), None
        for sighting, recognised in self._sightings(frame, search, mask, taken):
            judged = self._judged(frame, sighting, recognised, mask, taken)
            told = self._as_landmarks_tell(frame, search, sighting) if judged is None and not recognised else None
            if told is not None:
                judged = self._judged(frame, told, False, mask, taken)
            if judged is not None and (best is None or judged[0] > best[0]):
                best = judged
        return None if best is None else best[1]

    def _judged(
        self,
        frame: Frame,
        sighting: Sighting,
        recognised: bool,
        mask: np.ndarray | None,
        taken: np.ndarray | None,
    ) -> tuple[float, Recognition] | None:
        """What a sighting is worth, and what shows of the object under it; None where it does not suffice."""
        memory = self._memory
        where = mask if mask is not None else self._on_surface(frame, sighting)
        if taken is not None and mask is None:
            if (where & taken).sum() > 0.5 * where.sum():
                return None
            where = where & ~taken
        if where.sum() < self.config.lifecycle.min_mask_px:
            return None
        seen = self._recogniser.at(frame, where, sighting.T_cam_obj, memory.p_obj, memory.descriptors)
        steps = partial(outline_share, frame, where, True)
        if recognised or _certain(len(seen) / self._fewest, sighting.share, float(memory.outline), steps):
            return sighting.share if recognised else len(seen), Recognition(where, sighting, seen)
        return None

    def _sightings(
        self, frame: Frame, search: ImageSearch, mask: np.ndarray | None, taken: np.ndarray | None
    ) -> list[tuple[Sighting, bool]]:
        """Where it may be, and whether by agreeing landmarks (True) or by shape and colour alone."""
        p_obj, sample = self._memory.p_obj, self.policy.shape.sample(self.model)
        there = None if self.left is None else search.about(self.left, sample)
        if there is not None and there.share >= _RECOGNISED:
            return [(there, True)]
        pairs = self._recogniser.pairs(frame, self._memory.descriptors)
        if recognised := self._recognised(search, pairs):
            return [(sighting, True) for sighting in recognised]
        turns = self.model.views.some(_TURNS)
        free = np.ones(frame.shape, bool) if mask is None else mask
        free = free if taken is None else free & ~taken
        poses = [centred_at_points(turns, search.places(free, sample, self._rng), sample)]
        for T in turns:
            one = np.repeat(T[None], len(pairs), 0)
            one[:, :3, 3] = pairs.p_cam - p_obj[pairs.rows] @ T[:3, :3].T
            poses.append(one)
        found = search.among(np.concatenate(poses), sample)
        return [(sighting, False) for sighting in found if sighting.share >= _SHARE]

    def _as_landmarks_tell(self, frame: Frame, search: ImageSearch, sighting: Sighting) -> Sighting | None:
        """The place of a sighting, with a pose like it on which landmarks in it agree; None where they do not.

        By its shape a part of a plane may lie anywhere in that plane.
        """
        pairs = self._recogniser.within(frame, self._on_surface(frame, sighting), self._memory.descriptors)
        agreeing = self._recogniser.agreeing(pairs, self._memory.p_obj)
        if len(agreeing) < self._fewest or not self._alike(agreeing.T_cam_obj, sighting.T_cam_obj, 0.0):
            return None
        return search.at(agreeing.T_cam_obj, self.policy.shape.sample(self.model))

    def _recognised(self, search: ImageSearch, pairs: Any) -> list[Sighting]:
        """Where landmarks agree on a pose and the surface shows: several where something looks alike, or turned.

        On a label that repeats most landmarks may agree on the wrong side, and those that are left on the right one.
        """
        p_obj, sample, found = self._memory.p_obj, self.policy.shape.sample(self.model), []
        for _ in range(_ALIKE):
            agreeing = self._recogniser.agreeing(pairs, p_obj)
            if len(agreeing) < _AGREEING:
                break
            found.append(search.about(agreeing.T_cam_obj, sample))
            pairs = pairs.select(~np.isin(pairs.rows, agreeing.rows))
        return [sighting for sighting in found if sighting is not None and sighting.share >= _RECOGNISED]

    def _on_surface(self, frame: Frame, sighting: Sighting) -> np.ndarray:
        """(H, W) bool: pixels on the surface under a sighting's pose that are connected with what was found of it."""
        surface = self.model.surface
        assert surface is not None, "a memory has one"
        distance_m = surface_distance(surface, frame.depth_m, self.observer.camera, sighting.T_cam_obj)
        near = (np.abs(distance_m) < _ON_SURFACE_M).astype(np.uint8)
        near = cv2.morphologyEx(near, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        _, label = cv2.connectedComponents(near)
        u, v = np.rint(sighting.uv_px).astype(int).T
        held = np.unique(label[v, u])
        return np.isin(label, held[held > 0])

    def taken_in(self, seen: Any) -> np.ndarray:
        """Add the corners at which landmarks are ``seen`` as keypoints of the map; returns their keys (M,).

        A landmark tells where the object is to a few millimetres, all of them to a fraction of that. So they say where
        the object is, and its keypoints are what is there.
        """
        p_obj = se3.transform(se3.inverse(seen.T_cam_obj), seen.p_cam)
        keys = self.model.remember(p_obj, self._memory.confidence[seen.rows])
        self._key[seen.rows] = keys
        return keys

    # -- the step ------------------------------------------------------------------------------

    def step(self, obs: OurObservation) -> ObjectStep:
        """The object's pose at a frame; once it is followed, landmarks that have come into view are added."""
        given = obs.mask is not None and obs.given
        if not given and not (self._claimed and (obs.mask is not None or self.life.T_cam_obj is not None)):
            return self.own.absent(obs, Verdict(False, Status.INITIALISING, _WAITS + _UNLIKE * bool(obs.mask_px)))
        followed = int(np.isin(self.map.keys, self._key)[obs.seen].sum())
        step = super().step(obs)
        if step.estimate.T_cam_obj is not None:
            self._claimed, self._bare = True, step.estimate.inliers < _BARE
            self._borne_out += step.estimate.inliers >= self.config.lifecycle.return_inliers
        self._since += 1
        T_cam_obj = step.estimate.T_cam_obj if self._since >= _EVERY and self.known.map_id == self._first_map else None
        if T_cam_obj is None or followed >= _ENOUGH or step.estimate.status is Status.DEGRADED or obs.mask is None:
            return step
        self._since = 0
        return replace(step, requests=self._with_more(step.requests, obs, T_cam_obj))

    def _with_more(self, requests: Requests, obs: OurObservation, T_cam_obj: np.ndarray) -> Requests:
        """Requests with landmarks that are seen under a pose, and are not followed yet."""
        absent = np.flatnonzero(~np.isin(self._key, self.map.keys))
        p_obj, descriptors = self._memory.p_obj[absent], self._memory.descriptors[absent]
        seen = self._recogniser.at(obs.frame, obs.mask, T_cam_obj, p_obj, descriptors)
        if not len(seen):
            return requests
        keys = self.taken_in(replace(seen, rows=absent[seen.rows]))
        add_px, keys = np.concatenate([requests.add_px, seen.uv_px]), np.concatenate([requests.keys, keys])
        return replace(requests, add_px=add_px, keys=keys)

    def _outgrown(self, obs: OurObservation) -> bool:
        """A memory is never founded anew."""
        return False

    def _turned_over(self, obs: OurObservation) -> bool:
        """No second map where the map does not grow, nor before points have confirmed what was found."""
        return self._confirmed and not self.frozen and super()._turned_over(obs)


def _certain(landmarks: float, share: float, outline: float, steps: Callable[[], float | None]) -> bool:
    """Whether landmarks, as a multiple of the fewest, the share of the surface, and depth ``steps`` are the object's.

    A bland, smooth surface fits a wall, too: but the depth has no steps there, where the object's ``outline`` had some.
    """
    return landmarks >= 1 and share >= _SHARE and (steps() or 0.0) >= max(_OUTLINE * outline, _STEPS)


def follow(obj: Remembered, found: Recognition, tracker: PointTracker, tracks: Tracks) -> Tracks:
    """Have the tracker follow the landmarks found; returns all objects' tracks in this frame, with these."""
    keys, ids = obj.taken_in(found.seen), tracker.add(found.seen.uv_px)
    obj.map.assign(keys, ids)
    count = len(ids)
    return joined([tracks, Tracks(ids, found.seen.uv_px, np.ones(count, bool), np.zeros(count))])
