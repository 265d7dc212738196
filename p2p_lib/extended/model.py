"""What an object is known by, where a map can take in another one: a bounded graph, and views that add up."""

from __future__ import annotations

from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.extended.graph import BoundedGraph
from p2p_lib.extended.views import AccumulatedViews
from p2p_lib.method.object_model import ObjectModel, Requests


class JoinableModel(ObjectModel):
    """A model that can take in another one; ``revision`` grows with every keyframe and with every model taken in."""

    make_graph, make_views = BoundedGraph, AccumulatedViews
    revision = 0

    def insert_keyframe(self, *args: Any) -> Requests:
        """As in the paper."""
        self.revision += 1
        return super().insert_keyframe(*args)

    def join(self, other: JoinableModel, T_obj_other: np.ndarray) -> None:
        """Take in what another model knows of the same object; T_obj_other (4, 4) maps its frame to this one's.

        Its points come behind the map's own.
        """
        self.map.join(other.map, T_obj_other, self._next_key)
        vertices = 0 if self.graph is None else self.graph.next_key
        if self.graph is not None:
            self.graph.join(other.graph, T_obj_other, self._next_key)
        if self.surface is not None:
            self._beside_after(self._surface.join, other.surface, T_obj_other, vertices)
        for T_cam_obj in other.views.T_cam_obj @ se3.inverse(T_obj_other):
            self.views.add(T_cam_obj)
        self._next_key += other._next_key
        self.revision += 1
