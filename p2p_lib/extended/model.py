"""An object's model that can take in another one: with a bounded graph, and views with accumulated turns."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.memory import ObjectMemory
from p2p_lib.extended.graph import BoundedGraph
from p2p_lib.extended.lifecycle import Lifecycle
from p2p_lib.extended.remembering import restored
from p2p_lib.extended.views import AccumulatedViews
from p2p_lib.method.object_model import NO_IDS, Known, ObjectModel, Requests


class JoinableModel(ObjectModel):
    """A model that can take in another one; ``revision`` grows with every keyframe and with every model taken in."""

    make_graph, make_views = BoundedGraph, AccumulatedViews
    views: AccumulatedViews
    _graph: BoundedGraph | None
    revision = 0

    @property
    def graph(self) -> BoundedGraph | None:
        """As in the paper."""
        self._settle()
        return self._graph

    def insert_keyframe(self, *args: Any) -> Requests:
        """As in the paper, counted in ``revision``."""
        self.revision += 1
        return super().insert_keyframe(*args)

    def recall(self, memory: ObjectMemory) -> None:
        """Begin with a memory, in its frame; its landmarks are added when they are seen (:meth:`remember`)."""
        kept, config = memory.surface, self.config.tsdf
        if self._surface is not None:
            voxel_m = float(kept.voxel_m)
            how = replace(config, voxel_m=voxel_m, truncation_voxels=float(kept.tau_m) / voxel_m)
            self._surface = restored(kept, how, self.config.device)
        if self._graph is not None:
            self._graph.add_keyframe(memory.T_cam_obj[0], NO_IDS, np.zeros((0, 3)), p_obj_init=np.zeros((0, 3)))
            self._graph.optimise()
        for T_cam_obj in memory.T_cam_obj:
            self.views.add(T_cam_obj)
        self.covariance = memory.covariance.copy()
        self.revision += 1

    def remember(self, p_obj: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        """Take in landmarks (N, 3) of the memory that are seen now, as keypoints; returns their keys (N,).

        In the graph the first keyframe, which stands for the memory, observes them: so they stay where they were.
        """
        keys = self._next_key + np.arange(len(p_obj))
        self._next_key += len(keys)
        self.map.add(keys, p_obj, True)
        self.map.confidence[-len(keys) :] = confidence
        if self._graph is not None:
            self._submit(self._graph.remember, keys, p_obj)
        return keys

    def join(self, other: JoinableModel, T_obj_other: np.ndarray) -> None:
        """Take in another model of the same object; T_obj_other (4, 4) maps its frame to this one's.

        Its points are appended to the map's own.
        """
        self.map.join(other.map, T_obj_other, self._next_key)
        vertices = 0 if self.graph is None else self.graph.next_key
        if self.graph is not None and other.graph is not None:
            self.graph.join(other.graph, T_obj_other, self._next_key)
        if (surface := self.surface) is not None:
            self._submit(surface.join, other.surface, T_obj_other, vertices)
        for T_cam_obj in other.views.T_cam_obj @ se3.inverse(T_obj_other):
            self.views.add(T_cam_obj)
        self._next_key += other._next_key
        self.revision += 1


#: What is known of an object in one of its maps.
OurKnown = Known[JoinableModel, Lifecycle]
