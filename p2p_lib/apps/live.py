"""Track objects in front of a running camera: what ``p2p live`` calls.

The newest frame wins: when a frame takes longer than the camera's, those that came meanwhile are dropped, and counted.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from time import monotonic

import numpy as np

from p2p_lib.apps.click import Clicker, wait_for_clicks
from p2p_lib.core.backends import SEGMENTERS
from p2p_lib.core.errors import BadInput
from p2p_lib.core.options import RunOptions
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, PoseEstimate
from p2p_lib.datasets.cameras import LiveCamera, Newest, Still
from p2p_lib.method.pipeline import Point2Pose


@dataclass
class LiveCount:
    """What became of a camera's frames: how many were tracked, how many dropped, in how many seconds."""

    frames: int = 0
    dropped: int = 0
    seconds: float = 0.0
    _last: int | None = field(default=None, repr=False)

    def count(self, frame: Frame) -> None:
        """One more tracked; what lies between it and the one before was dropped."""
        self.dropped += 0 if self._last is None else frame.index - self._last - 1
        self.frames, self._last = self.frames + 1, frame.index

    def __str__(self) -> str:
        rate = f" ({self.frames / self.seconds:.1f} Hz)" if self.seconds else ""
        return f"{self.frames} frames in {self.seconds:.1f} s{rate}, {self.dropped} dropped"


def track_live(
    camera: LiveCamera,
    prompts: Iterable[Prompt],
    on_estimate: Callable[[PoseEstimate], None],
    options: RunOptions | None = None,
    *,
    first: Frame | None = None,
    count: LiveCount | None = None,
) -> LiveCount:
    """Follow the objects of the prompts until the camera ends; every estimate goes to ``on_estimate`` at once.

    prompts  clicks, boxes, masks; those of frame k start their object, or correct its mask, at the camera's k-th image,
             which is not dropped
    options  the method and its parameters; ``masks`` names the segmenter
    first    an image that was taken before, and is the one that the prompts' frame 0 means (see ``p2p live``)
    count    filled as frames pass, for whoever wants to know meanwhile or after an interruption

    Closes the camera at the end, whatever ends it. Raises :class:`BadInput` for clicks that do not fit.
    """
    options, count = options or RunOptions(), count or LiveCount()
    prompts = sorted(prompts, key=lambda p: p.frame)
    config, masks = options.config(), replace(options, prompts=prompts).mask_source()
    if masks.name != "clicks":
        raise BadInput("masks", repr(options.masks), f"the name of a segmenter: {', '.join(SEGMENTERS)}")
    method = Point2Pose(camera.camera, config, options.tracker, options.detector, masks.segmenter)
    if config.method.surface:
        import_module("torch")  # which takes seconds, in which the camera need not run
    start_s = monotonic()
    with Newest(camera, keep={p.frame for p in prompts}) as newest:
        frame = first or newest.take()
        while frame is not None:
            while prompts and prompts[0].frame <= (0 if frame is first else frame.index):
                method.tell(prompts.pop(0))
            for estimate in method.step(frame).values():
                on_estimate(estimate)
            if frame is not first:  # which may be long ago
                count.count(frame)
            count.seconds = monotonic() - start_s
            frame = newest.take()
        for estimates in method.finish():
            for estimate in estimates.values():
                on_estimate(estimate)
    if prompts:
        got = f"frame {prompts[0].frame}, which never came"
        raise BadInput(f"prompt of {prompts[0].name!r}", got, "a frame of the camera", "Click in an earlier one.")
    return count


def click_first(
    camera: LiveCamera, say: Callable[[str], object], open_browser: bool = True
) -> tuple[tuple[Prompt, ...], Frame]:
    """Let the user click on objects in the camera's next image: the prompts, and that image, for ``track_live``."""
    image = camera.read()
    if image is None:
        raise BadInput(camera.name, "no image", "one to click on")
    with tempfile.TemporaryDirectory() as folder:
        page = Clicker(Still(camera.name, camera.camera, image), Path(folder) / "prompts.json")
        return wait_for_clicks(page, say, open_browser), image


def json_line(estimate: PoseEstimate) -> str:
    """An estimate as one line of JSON: time_s, frame, object, status, confidence, T_cam_obj, covariance, reason.

    ``T_cam_obj`` (4x4, metres) and ``covariance`` (6x6, [rotation rad, translation m] on the right) are null without
    a pose.
    """
    line = {
        "time_s": round(estimate.time_s, 6),
        "frame": estimate.frame_index,
        "object": estimate.object,
        "status": str(estimate.status),
        "confidence": round(estimate.confidence, 4),
        "T_cam_obj": estimate.T_cam_obj,
        "covariance": estimate.covariance,
        "reason": estimate.reason,
    }
    return json.dumps(line, allow_nan=False, default=np.ndarray.tolist)
