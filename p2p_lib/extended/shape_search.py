"""Where an object shows by shape and colour when points do not say it: near known places, in known turns.

Frames are compared with the surface by :class:`p2p_lib.extended.image_search.ImageSearch` (not in the paper).
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame
from p2p_lib.extended.gates import SIGHTED
from p2p_lib.extended.image_search import ImageSearch, Sighting, SurfaceSample, most_shown
from p2p_lib.extended.model import JoinableModel, OurKnown
from p2p_lib.extended.observation import OurObservation, cut_off
from p2p_lib.method.observation import Observer
from p2p_lib.method.refinement import surface_distances

#: One frame in so many looks for a lost object in its mask, in the turns of at most so many keyframes. Depth this near
#: to its surface is on it, m.
_TURN_EVERY, _TURNS, _ON_M = 2, 40, 0.01


class ShapeSearch:
    """Looks for one object in the frames of one camera; where it is not ``on``, nothing is looked for."""

    def __init__(self, observer: Observer, config: Config, stopwatch: Stopwatch, on: bool = True):
        self.observer, self.config, self._stopwatch, self._on = observer, config, stopwatch, on
        self._samples: WeakKeyDictionary[JoinableModel, tuple[int, SurfaceSample]] = WeakKeyDictionary()

    def knows(self, known: OurKnown) -> bool:
        """Whether there is a surface to search with."""
        return self._on and known.model.seen_surface is not None and len(self.sample(known.model)) > 0

    def sample(self, model: JoinableModel) -> SurfaceSample:
        """Points of the surface, sampled when first asked for after a keyframe."""
        revision, sample = self._samples.get(model, (None, None))
        if sample is None or revision != model.revision:
            surface = model.surface
            assert surface is not None, "it is asked for where there is one"
            sample = SurfaceSample.of(surface.mesh())
            self._samples[model] = model.revision, sample
        return sample

    def at(self, obs: OurObservation, known: OurKnown, poses: list[np.ndarray]) -> list[Sighting | None]:
        """What of the surface shows under each of some poses; None where too little would show."""
        search = self._search(obs.frame)
        return [search.at(T_cam_obj, self.sample(known.model)) for T_cam_obj in poses]

    def sighted(self, obs: OurObservation, known: OurKnown, carried: bool) -> Sighting | None:
        """Where a sought object shows: near its place by scene, motion or the frame before, or in its mask."""
        life, model, time_s = known.life, known.model, obs.frame.time_s
        proposed = [*life.scene_prior(obs.frame.T_world_cam).values()]
        # With a mask the policy proposes it, on its depth, too.
        if obs.mask is None and carried and life.motion is not None:
            proposed.append(life.motion.at(time_s))
        proposed += [life.T_cam_obj] if life.has_pose and life.T_cam_obj is not None else []
        with self._stopwatch("search"):
            search = self._search(obs.frame)
            found = [search.about(T_cam_obj, self.sample(model)) for T_cam_obj in proposed]
            if obs.mask is not None and life.lost_frames % _TURN_EVERY == 1 and not cut_off(self.observer, obs):
                found.append(self._turned(obs, known, search))
            best = most_shown(found)
            return best if best is not None and best.share >= SIGHTED else None

    def otherwise(self, obs: OurObservation, known: OurKnown, T_cam_obj: np.ndarray) -> tuple[Sighting | None, ...]:
        """What shows under a pose, and the best that is turned otherwise; None where it cannot be said."""
        with self._stopwatch("search"):
            search, sample = self._search(obs.frame), self.sample(known.model)
            views = known.model.views.some(_TURNS)
            return search.at(T_cam_obj, sample), search.otherwise(T_cam_obj, views, obs.cloud, sample)

    def _turned(self, obs: OurObservation, known: OurKnown, search: ImageSearch) -> Sighting | None:
        """Where a lost object shows in its mask, in a turn of one of its keyframes, if enough depth fits."""
        found = search.turned(known.model.views.some(_TURNS), obs.cloud, self.sample(known.model))
        if found is None:
            return None
        surface = known.model.surface
        assert surface is not None, "it was searched with"
        distance_m = surface_distances(surface, obs.cloud, found.T_cam_obj[None])[0]
        return found if (distance_m < _ON_M).mean() >= self.config.lifecycle.surface_only_share else None

    def _search(self, frame: Frame) -> ImageSearch:
        return ImageSearch(frame, self.observer.camera, self.config.depth)
