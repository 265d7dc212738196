"""What is known of objects, taken from a tracker and kept: all of them, to go on another day, or one as a memory.

Not in the paper. Nothing here is asked while frames are tracked, and no pose depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import from_dict
from p2p_lib.core.errors import BadInput
from p2p_lib.core.memory import ObjectMemory, read_memories, save_memories, save_memory
from p2p_lib.extended.remembered import Remembered
from p2p_lib.extended.remembering import memory_of
from p2p_lib.extended.two_maps import TwoMaps
from p2p_lib.method import pipeline
from p2p_lib.method.object_tracker import ObjectTracker

#: A file of :meth:`Savable.save`: its kind, and what that is to people.
_SAVED, _SAVED_BY = "p2p tracker", "a tracker as Point2Pose.save writes it"


class Savable(pipeline.Point2Pose):
    """A tracker that can be saved, and its objects' memories taken.

    _made_of  what its class was called with: camera, config, tracker, detector, segmenter
    """

    _made_of: tuple[Any, ...]

    def save(self, path: str | Path) -> None:
        """Keep what is known of all objects, as plain data, for :meth:`load`.

        :class:`BadInput` for an object of which too little is known to find it again.
        """
        learnt = {name: self.memory(name) for name, obj in self.objects.items() if not obj.model.empty}
        parts = {"tracker": self.tracker.name, "detector": self.detector.name, "segmenter": self.segmenter.name}
        frozen = {name: isinstance(obj, Remembered) and obj.frozen for name, obj in self.objects.items()}
        about = {"camera": asdict(self.camera), "config": self.config.as_dict(), "objects": frozen, **parts}
        save_memories(path, learnt, _SAVED, about)

    @classmethod
    def load(cls, path: str | Path, camera: Camera | None = None, **parts: Any) -> Self:
        """A tracker that knows what another one knew when it was saved; its objects are looked for, and found, anew.

        camera  if it is another one now; ``parts``: a tracker, detector or segmenter in place of the saved ones
        """
        about, learnt = read_memories(path, _SAVED, _SAVED_BY)
        try:
            named = {name: about[name] for name in ("tracker", "detector", "segmenter")} | parts
            loaded: Any = cls(camera or Camera(**about["camera"]), from_dict(about["config"], str(path)), **named)
            for name, frozen in about["objects"].items():
                loaded.add_object(name, memory=learnt.get(name), frozen=frozen)
        except (KeyError, TypeError, AttributeError) as error:
            raise BadInput(str(path), f"a file without {error}", _SAVED_BY) from None
        return loaded

    def memory(self, name: str, **made_of: Any) -> ObjectMemory:
        """What is known of an object now, to be kept by :func:`p2p_lib.core.memory.save_memory`.

        made_of  plain values that say where it comes from

        Raises :class:`BadInput` where too little is known to find it again.
        """
        if name not in self.objects:
            raise BadInput("memory", repr(name), "one of " + (", ".join(self.objects) or "no objects"))
        return memory_in(self.objects[name], self.objects[name].known.map_id, **made_of)


def memory_in(obj: TwoMaps | ObjectTracker, number: int, **made_of: Any) -> ObjectMemory:
    """What an object's map of this ``number`` holds; raises as :meth:`Savable.memory`."""
    before, known = (obj.began_with(number) if isinstance(obj, Remembered) else None), obj.known_as(number)
    if known is None:
        raise BadInput(f"memory of {obj.name!r}", f"map {number}, which was given up", "a map that is kept")
    return memory_of(obj.name, known, made_of, before)


def keep_memory(path: Path, obj: TwoMaps | ObjectTracker, number: int, info: Mapping[str, Any]) -> None:
    """Write the memory of an object's map of this ``number``, if enough is known to find it again.

    info  of the run that it was learnt in
    """
    made_of = {key: info[key] for key in ("sequence", "tracker", "start", "stop") if key in info}
    with suppress(BadInput):  # too little is known to find it again
        save_memory(path, memory_in(obj, number, **made_of, map_id=number))
