"""What becomes of objects, told to the logger ``p2p_lib``: turns of their lives as INFO, each frame as DEBUG."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping

from p2p_lib.core.types import PoseEstimate

_LOG = logging.getLogger("p2p_lib")


class Journal:
    """Tells each turn once; of every object it knows the newest estimate, and the maps that it has had."""

    def __init__(self) -> None:
        self._newest: dict[str, PoseEstimate] = {}
        self._maps: dict[str, set[int]] = {}  # empty until its first pose

    def corrected(self, frame_index: int, names: Iterable[str]) -> None:
        """That masks of objects are corrected in a frame."""
        for name in names:
            _LOG.info("frame %d: %s is corrected", frame_index, name)

    def forget(self, name: str) -> None:
        """That an object is removed: one of its name is a new one."""
        _LOG.info("%s is removed", name)
        self._newest.pop(name, None)
        self._maps.pop(name, None)

    def note(self, estimates: Mapping[str, PoseEstimate], total_ms: float) -> None:
        """The estimates of a frame, which took so long."""
        for name, now in estimates.items():
            if turns := list(self._turns(name, now)):
                _LOG.info("frame %d: %s %s", now.frame_index, name, ", ".join(turns))
            if _LOG.isEnabledFor(logging.DEBUG):
                said = f"{now.status}, confidence {now.confidence:.2f}, map {now.map_id}"
                if now.T_cam_obj is not None:
                    said += f", {now.inliers} of {now.visible_points} points agree" + ", keyframe" * now.keyframe
                _LOG.debug("frame %d (%.0f ms): %s: %s", now.frame_index, total_ms, name, said)

    def _turns(self, name: str, now: PoseEstimate) -> Iterator[str]:
        """What is new of an object in its newest estimate, in words."""
        before, maps = self._newest.get(name), self._maps.setdefault(name, set())
        self._newest[name] = now
        why = f" ({now.reason})" if now.reason else ""
        if now.T_cam_obj is not None:
            if not maps:
                yield "begins"
            elif now.map_id not in maps:
                yield f"begins map {now.map_id}"
            elif before is not None and before.T_cam_obj is None:
                yield f"is found again in map {now.map_id}"
            maps.add(now.map_id)
        if now.joined is not None:
            yield f"has map {now.joined[0]} joined to map {now.map_id}"
        if before is None or now.status is not before.status:
            yield f"is {now.status}{why}"
