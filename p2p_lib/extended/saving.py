"""What is known of objects, taken from a tracker and kept: all of them, to go on another day, or one as a memory.

Not in the paper. Nothing here is asked while frames are tracked, and no pose depends on it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from p2p_lib import __version__
from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import from_dict
from p2p_lib.core.errors import BadInput, in_a_line
from p2p_lib.core.memory import ObjectMemory, camera_words, read_memories, save_memories, save_memory
from p2p_lib.extended.remembered import Remembered
from p2p_lib.extended.remembering import memory_of
from p2p_lib.extended.two_maps import TwoMaps
from p2p_lib.method import pipeline
from p2p_lib.method.object_tracker import ObjectTracker

#: A file of :meth:`Savable.save`: its kind, and what that is to people.
_SAVED, _SAVED_BY = "p2p tracker", "a tracker as tracker.save(path) writes it"
#: What a tracker is given by name, or as an instance.
_PARTS = ("tracker", "detector", "segmenter")
#: What a memory says of the run that it was learnt in: nothing of where its files are.
_OF_RUN = ("sequence", "tracker", "start", "stop", "commit", "modified")


class Savable(pipeline.Point2Pose[TwoMaps]):
    """A tracker that can be saved, and its objects' memories taken.

    _made_of  what its class was called with: camera, config, tracker, detector, segmenter
    """

    _made_of: tuple[Any, ...]

    def save(self, path: str | Path) -> None:
        """Keep what is known of all objects, as plain data, for :meth:`load`; before :meth:`close`.

        Of objects that have not started yet, what is to start them in the next frame: their clicks, box or mask, unless
        these are of an earlier one.

        Tracker, detector and segmenter are kept by the names that were asked for, ``package.module:Class`` among them.
        One that was given as an instance is no plain data: :meth:`load` asks for it.

        :class:`BadInput` for an object of which too little is known to find it again, and with preset ``paper``, whose
        objects begin with no memory.
        """
        from p2p_lib.datasets.prompts import as_entry  # here, since what tracks reads no datasets

        with self.alone():
            if paper := [name for name, obj in self.objects.items() if not isinstance(obj, TwoMaps)]:
                got = f"{paper[0]!r} with mechanisms none"
                fix = "Keep the memory of each object, with which preset default begins."
                raise BadInput("save", got, "preset default: the paper has no memory", fix)
            learnt = {name: self.memory(name) for name, obj in self.objects.items() if not obj.model.empty}
            frozen = {name: isinstance(obj, Remembered) and obj.frozen for name, obj in self.objects.items()}
            given = dict(zip(_PARTS, self._made_of[2:], strict=True))
            parts = {kind: part if isinstance(part, str) else [type(part).__name__] for kind, part in given.items()}
            lives = {name: obj.life for name, obj in self.objects.items()}
            poses = {n: T.tolist() for n, of in lives.items() if (T := of.T_cam_obj) is not None and of.has_pose}
            about: dict[str, Any] = {"camera": asdict(self.camera), "config": self.config.as_dict(), "objects": frozen}
            kept = learnt.keys() | self._earlier.keys()
            waiting = [as_entry(prompt) for name, prompt in self._prompts.items() if name not in kept]
            save_memories(path, learnt, _SAVED, about | {"poses": poses, "prompts": waiting, **parts})

    @classmethod
    def load(cls, path: str | Path, camera: Camera | None = None, **parts: Any) -> Self:
        """A tracker that knows what another one knew when it was saved; its objects are looked for, and found, anew.

        In the first frame each is looked for where it was in the newest before, if it was followed then.

        camera  if it is another one now; ``parts``: a ``tracker``, ``detector`` or ``segmenter`` in place of the saved
                one, needed where that was given as an instance

        Raises as :func:`p2p_lib.core.memory.load_memory`, and :class:`BadInput` where a part is needed.
        """
        from p2p_lib.datasets.prompts import parse_prompts

        if unknown := sorted(parts.keys() - set(_PARTS)):
            fix = "Parameters are those that it was saved with." if unknown[0] == "config" else ""
            raise BadInput("load", repr(unknown[0]), f"camera, {', '.join(_PARTS)}", fix)
        about, learnt = read_memories(path, _SAVED, _SAVED_BY)
        try:
            saved = {kind: about[kind] for kind in _PARTS}
            camera = Camera(**about["camera"]) if camera is None else camera
            config = from_dict(about["config"], str(path))
            frozen = {name: bool(is_frozen) for name, is_frozen in about["objects"].items()}
            left = {name: se3.check("pose", T) for name, T in about.get("poses", {}).items()}
        except (KeyError, TypeError, AttributeError):
            lacking = "a file that does not say with what camera, parameters, parts and objects"
            raise BadInput(str(path), lacking, _SAVED_BY) from None
        for kind, part in saved.items():
            if kind not in parts and not isinstance(part, str):
                got = f"none, and {_name(part)}, which was given as an instance, is no plain data"
                fix = f"Give one: Point2Pose.load(path, {kind}=...)."
                raise BadInput(f"{path}: {kind}", got, f"the {kind} that it was saved with, or another one", fix)
        loaded: Any = cls(camera, config, **(saved | parts))
        for name, is_frozen in frozen.items():
            loaded.add_object(name, memory=learnt.get(name), frozen=is_frozen)
            if name in left:
                loaded.objects[name].left = left[name]
        for prompt in parse_prompts({"objects": waiting}) if (waiting := about.get("prompts")) else ():
            loaded.tell(prompt)
        return loaded

    def memory(self, name: str, **made_of: Any) -> ObjectMemory:
        """What is known of an object now, to be kept by :func:`p2p_lib.core.memory.save_memory`; before :meth:`close`.

        made_of  plain values that say where it comes from, besides version, seed, day and camera. An object that began
                 with a memory, and has learnt nothing since, gives that memory as it was

        Raises :class:`BadInput` where too little is known to find it again.
        """
        with self.alone():
            self._check_known("memory", name)
            try:
                json.dumps(made_of)
            except TypeError as error:
                raise BadInput("memory: made_of", in_a_line(error), "plain values: texts, numbers, lists") from None
            return memory_in(self.objects[name], self.objects[name].known.map_id, **made_of)


def _name(part: Any) -> str:
    """Of a part that was an instance: that of its class."""
    return part[0] if isinstance(part, list) and part and isinstance(part[0], str) else "a part"


def memory_in(obj: TwoMaps | ObjectTracker, number: int, **made_of: Any) -> ObjectMemory:
    """What an object's map of this ``number`` holds; raises as :meth:`Savable.memory`."""
    known, before = obj.known_as(number), None
    if known is None:
        raise BadInput(f"memory of {obj.name!r}", f"map {number}, which was given up", "a map that is kept")
    if isinstance(obj, Remembered):
        before = obj.began_with(number)
        if before is not None and not obj.has_learnt:
            return replace(before, name=obj.name)
    today = datetime.now(UTC).date().isoformat()
    origin = {"version": __version__, "seed": obj.config.seed, "date": today}
    origin["camera"] = camera_words(obj.observer.camera)
    return memory_of(obj.name, known, origin | made_of, before)


def keep_memory(path: Path, obj: TwoMaps | ObjectTracker, number: int, info: dict[str, Any]) -> None:
    """Write the memory of an object's map of this ``number``, if enough is known to find it again.

    info  of the run that it was learnt in: is told of an object that was learnt too little of, and why
          (``without_map``); that one never had a pose is said elsewhere
    """
    made_of = {key: info[key] for key in _OF_RUN if key in info}
    try:
        memory = memory_in(obj, number, **made_of, map_id=number)
    except BadInput as error:
        if (known := obj.known_as(number)) is not None and not known.model.empty:
            info.setdefault("without_map", {})[obj.name] = f"{error.got}. {error.fix}".rstrip(". ")
        return
    save_memory(path, memory)
