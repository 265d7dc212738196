"""The one list of what is ours: preset ``default`` composes it around the paper's method.

Deleting a line here takes a mechanism out; ``method.mechanisms = "all but NAME"`` leaves it out of one run.
"""

from __future__ import annotations

from collections.abc import Container
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core import backends
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config, as_config
from p2p_lib.core.errors import BadInput, did_you_mean
from p2p_lib.core.files import file_name
from p2p_lib.core.interfaces import Detector, PointTracker, Segmenter
from p2p_lib.core.memory import ObjectMemory
from p2p_lib.core.types import Frame
from p2p_lib.extended.depth_lag import DepthLag
from p2p_lib.extended.frame_guard import FrameGuard
from p2p_lib.extended.model import JoinableModel
from p2p_lib.extended.policy import OurPolicy
from p2p_lib.extended.reacquisition import Reacquisition
from p2p_lib.extended.remembered import Remembered
from p2p_lib.extended.saving import Savable
from p2p_lib.extended.scene import CameraTracker
from p2p_lib.extended.two_maps import OurTracker, TwoMaps
from p2p_lib.method import pipeline

#: Name to what it does.
MECHANISMS = {
    # Before a frame: frame_guard.
    "moments": "Depth is ignored while it or colour repeats the same image and the other changes.",
    "lag": "Depth is moved onto colour where a moving camera takes the two at different moments.",
    # Around track and segment: reacquisition, outlook.
    "scene": "Camera motion, from the static scene, tells where an object at rest is.",
    "shape_search": "Absent objects are searched for by the shape and colour of their surface.",
    "redetection": "Where few keypoints are visible, the pose predicts where the tracker finds the others.",
    "rejection": "Tracks that contradict their object's pose or mask are rejected.",
    # Around an object: two_maps.
    "growing": "No map is started while its object is still coming into view.",
    "outgrown": "A map of a sliver, or one that was never followed, is replaced when its object stays lost.",
    "second_map": "A second map is started when an object shows an unknown side.",
    # Inside: policy, motion.
    "motion_prior": "The last pose and constant velocity propose poses; without points the surface tracks them.",
    "motion_weight": "A hypothesis needs more support the farther it is from the predicted motion.",
    "votes": "New points that contradict keypoints which agreed with earlier poses need to be many more.",
    "motion_over_gaps": "The motion of an absent object is extrapolated for a while.",
    "moving_points": "A point becomes a keypoint only if it moves with the object.",
    "pending_points": "While an object is followed, pending points help to register it.",
    "turns": "The pose of a return is compared with other rotations that look alike.",
    # Inside: gates.
    "return_gate": "A return needs many agreeing points, or a match of shape and colour.",
    "surface_gate": "A pose without agreeing points needs a surface that fits the depth.",
    "sliding_gate": "A flat object, whose surface can slide, needs agreeing points or a matching contour.",
    "contour": "A flat object without texture is registered by the contour of its mask.",
    "rest": "An object left at rest is accepted elsewhere only if enough points agree.",
    "scale": "Nothing is learnt while depth shows the resting scene nearer or farther than before.",
    "outline": "Nothing is learnt while the outline of the mask does not follow depth edges.",
    "still": "Nothing is learnt while the camera repeats the same image.",
    # Inside: confidence, graph.
    "confidence": "Each pose gets a confidence, which weights the points that it places.",
    "texture": "A rotation that shape does not constrain has to be constrained by texture.",
    "sure_keyframes": "Poses of low confidence and unconfirmed returns make no keyframes.",
    "stray_points": "A point observed far from its predicted place stays out of the graph.",
}
ALL, NONE, ALL_BUT = "all", "none", "all but "


def chosen(config: Config) -> frozenset[str]:
    """The mechanisms that ``method.mechanisms`` names; :class:`BadInput` for one that is not in the list.

    >>> from p2p_lib.core.config import preset
    >>> some = preset().with_values({"method.mechanisms": "all but scale, outline"})
    >>> sorted(chosen(preset()) - chosen(some)), chosen(preset("paper"))
    (['outline', 'scale'], frozenset())
    """
    spec = config.method.mechanisms.strip()
    if spec in (ALL, NONE):
        return frozenset(MECHANISMS if spec == ALL else ())
    names = {name.strip() for name in spec.removeprefix(ALL_BUT).split(",")}
    for name in sorted(names - set(MECHANISMS)):
        expected = f"all, none, or names, or all but names, of {', '.join(MECHANISMS)}"
        raise BadInput("config method.mechanisms", repr(name), expected, did_you_mean(name, MECHANISMS))
    return frozenset(set(MECHANISMS) - names if spec.startswith(ALL_BUT) else names)


class Point2Pose(Savable):
    """Causal 6D tracking of any number of unknown rigid objects in one RGB-D stream.

    config  parameters, or the name of a preset (default: ``default``)

    Changes of status go to the logger ``p2p_lib``. :meth:`close`, or the end of a ``with`` block, ends its threads.
    One thread at a time may call it: another one that calls meanwhile gets :class:`BadInput`.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | str | None = None,
        tracker: str | PointTracker = backends.DEFAULT_TRACKER,
        detector: str | Detector = backends.DEFAULT_DETECTOR,
        segmenter: str | Segmenter = backends.DEFAULT_SEGMENTER,
    ):
        config = as_config("default" if config is None else config)
        self._made_of: tuple[Any, ...] = camera, config, tracker, detector, segmenter
        self._recogniser: Any = None  # of all objects that are known from memories
        super().__init__(*self._made_of, compose(camera, config))

    def reset(self) -> None:
        """Forget all objects and the stream: as new, with the same camera, parameters and parts.

        A 2D tracker or a segmenter that was given as an instance is kept, and starts anew.
        """
        self.closed = False
        with self.alone():
            for name in self.segmenter.names:
                self.segmenter.remove(name)
            self.close()
            turn = self._turn
            Point2Pose.__init__(self, *self._made_of)
            self._turn = turn

    def add_object(
        self,
        name: str,
        mask: np.ndarray | None = None,
        clicks: ArrayLike | None = None,
        negative: ArrayLike | None = None,
        box: ArrayLike | None = None,
        *,
        frame: Frame | None = None,
        memory: ObjectMemory | None = None,
        frozen: bool = False,
    ) -> None:
        """As in :class:`p2p_lib.core.objects.Objects`, or an object that is known from a memory.

        memory  as :func:`p2p_lib.core.memory.load_memory` reads it: the object is looked for in every frame until it is
                found, and its pose is in the object frame of the memory's map. No clicks or masks go with it
        frozen  whether that map stays as it is

        Raises :class:`BadInput` for a memory together with clicks or masks, and with preset ``paper``.
        """
        if memory is None:
            if frozen:
                raise BadInput("add_object", "frozen without a memory", "a memory, whose map is then kept as it is")
            super().add_object(name, mask, clicks, negative, box, frame=frame)
            return
        alone = mask is clicks is negative is box is frame is None
        if not alone or file_name("object name", name) in self.objects:
            got = f"{name!r}, which is in use" if alone else "clicks or a mask, too"
            raise BadInput("add_object with a memory", got, "a new name and the memory alone")
        if not isinstance(memory, ObjectMemory):
            raise BadInput("add_object with a memory", type(memory).__name__, "a memory, as load_memory reads it")
        if not chosen(self.config):
            raise BadInput("add_object with a memory", "mechanisms none", "preset default: the paper has no memory")
        with self.alone():
            self.begin(name)
            self._recogniser = self._recogniser or backends.make_recogniser(self.camera)
            self.objects[name] = Remembered(self.objects[name].own, memory, self._recogniser, frozen)


def compose(camera: Camera, config: Config) -> pipeline.Parts:
    """What the method is made of, by ``method.mechanisms``; where that names none, the paper's parts alone."""
    on = chosen(config)
    if not on:
        return pipeline.Parts()
    scene = None
    if "scene" in on:
        scene = CameraTracker(camera, config.depth, np.random.default_rng([config.seed, 2]))
    front = partial(Reacquisition, on=on, scene=scene)
    guard = FrameGuard("moments" in on, DepthLag() if "lag" in on else None)
    return pipeline.Parts(guard, front, partial(object_tracker, on=on))


def object_tracker(*paper: Any, on: Container[str] = frozenset(MECHANISMS), map_id: int = 0) -> TwoMaps:
    """An object with the mechanisms that are ``on``; the others are the arguments of :class:`ObjectTracker`."""
    own = partial(OurTracker, policy=partial(OurPolicy, on=on), model=JoinableModel)
    return TwoMaps(own(*paper, map_id=map_id))
