"""Where an object shows by shape and colour, when points do not say it: its last places, its motion, its known turns.

What it is compared with is the surface, by :class:`p2p_lib.recovery.search.ImageSearch` (not in the paper).
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame
from p2p_lib.method.lifecycle import SIGHTED
from p2p_lib.method.object_model import Known
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.refinement import surface_distances
from p2p_lib.recovery.search import ImageSearch, Sighting

#: A lost object is looked for in every so many frames, turned as in so many of its keyframes at most. Depth this near
#: its surface is on it, m.
_TURN_EVERY, _TURNS, _ON_M = 2, 40, 0.01


class ShapeSearch:
    """Looks for objects in the frames of one camera."""

    def __init__(self, observer: Observer, config: Config, stopwatch: Stopwatch):
        self.observer, self.config, self._stopwatch = observer, config, stopwatch

    def knows(self, known: Known) -> bool:
        """Whether shape and colour have a say."""
        return self.config.method.scene and known.model.has_surface

    def at(self, obs: Observation, known: Known, poses: list[np.ndarray]) -> list[Sighting | None]:
        """What of the surface shows under each of some poses; None where too little would be in the image."""
        search = self._search(obs.frame)
        return [search.at(T_cam_obj, known.model.sample) for T_cam_obj in poses]

    def sighted(self, obs: Observation, known: Known) -> Sighting | None:
        """Where a sought object shows: near where scene or motion say, or where it was a frame ago; or in its mask."""
        life, model, time_s = known.life, known.model, obs.frame.time_s
        proposed = [*life.scene_prior(obs.frame.T_world_cam).values()]
        if obs.mask is None and known.carried(time_s):  # in a mask it is laid on its depth besides
            proposed.append(life.motion.at(time_s))
        proposed += [life.T_cam_obj] if life.has_pose else []
        with self._stopwatch("search"):
            search = self._search(obs.frame)
            found = [search.about(T_cam_obj, model.sample) for T_cam_obj in proposed]
            if obs.mask is not None and life.lost_frames % _TURN_EVERY == 1 and not self.observer.cut_off(obs):
                found.append(self._turned(obs, known, search))
            best = max((s for s in found if s is not None), key=lambda s: s.share, default=None)
            return best if best is not None and best.share >= SIGHTED else None

    def otherwise(self, obs: Observation, known: Known, T_cam_obj: np.ndarray) -> tuple[Sighting | None, ...]:
        """What shows under a pose, and the best that is turned otherwise; None where it cannot be said."""
        with self._stopwatch("search"):
            search, sample = self._search(obs.frame), known.model.sample
            views = known.model.views.some(_TURNS)
            return search.at(T_cam_obj, sample), search.otherwise(T_cam_obj, views, obs.cloud, sample)

    def _turned(self, obs: Observation, known: Known, search: ImageSearch) -> Sighting | None:
        """Where a lost object shows in its mask, turned as in one of its keyframes. Of a part of it any turn may be."""
        found = search.turned(known.model.views.some(_TURNS), obs.cloud, known.model.sample)
        if found is None:
            return None
        distance_m = surface_distances(known.model.surface, obs.cloud, found.T_cam_obj[None])[0]
        return found if (distance_m < _ON_M).mean() >= self.config.lifecycle.surface_only_share else None

    def _search(self, frame: Frame) -> ImageSearch:
        return ImageSearch(frame, self.observer.camera, self.config.depth)
