"""SAM 2.1 (Ravi et al., ICLR 2025) as a segmenter, through the maintained classes of ``transformers``.

Causal, frame by frame: a memory of the object's last frames and of the one with the clicks conditions the mask in
the next. Code and weights: Apache-2.0. Each object has an inference session of its own, so that it can come late and
go; the image's features, which are most of the work, are computed once for all of them. Last run with transformers
5.24.0.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import packages
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt, check_depth, check_prompt
from p2p_lib.core.raster import to_raster
from p2p_lib.core.types import Frame
from p2p_lib.datasets import checkpoints

if TYPE_CHECKING:
    import torch

#: What the publisher's image processor, which needs torchvision, scales colours by: ImageNet's mean and deviation.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
#: What a click says, as the network numbers it: it is on the object, beside it, a corner of the box around it.
_ON, _BESIDE, _CORNERS = 1, 0, [2, 3]
_OBJECT = 1  # the id of a session's only object
_ABSENT = -1024.0  # the logit of pixels of an object that is not to be seen, as the network itself has it
#: What a session keeps of a frame but reads no more once its memory is encoded.
_READ_ONCE = ("pred_masks", "high_res_masks")
_SPATIAL = ("maskmem_features", "maskmem_pos_enc")


def load(camera: Camera, config: SegmentationConfig, checkpoint: str = "sam2_video") -> Sam2VideoSegmenter:
    """The segmenter with a checkpoint, by default that of the smallest network.

    :class:`MissingBackend` says what to fetch or install.
    """
    packages.load("torch", "sam2_video", "transformers")
    transformers = packages.load("transformers", "sam2_video", "transformers")
    folder = checkpoints.checked_files(checkpoint)[0].parent
    # Nothing but tensors is in a file of this kind, and nothing is fetched from elsewhere.
    model = transformers.Sam2VideoModel.from_pretrained(folder, local_files_only=True, use_safetensors=True)
    return Sam2VideoSegmenter(model, camera, checkpoints.device(), checkpoint)


#: The same with the larger networks.
load_small, load_base_plus, load_large = (
    partial(load, checkpoint=f"sam2_video_{size}") for size in ("small", "base_plus", "large")
)


class Sam2VideoSegmenter:
    """Streams images through a ``Sam2VideoModel``. Implements :class:`p2p_lib.core.interfaces.Segmenter`.

    It looks at colour alone: hints are not used, and unmeasured pixels are labelled too.
    """

    def __init__(self, model: Any, camera: Camera, device: str = "cpu", name: str = "sam2_video"):
        self.name = name
        self._model, self._device, self._camera = model.to(device).eval(), device, camera
        self._size = int(model.config.image_size)
        self._sessions: dict[str, Any] = {}  # None where nothing has been seen of the object yet
        self._given: dict[str, tuple[Frame, np.ndarray]] = {}  # newest masks, that no session has been told of yet
        self._at = 0  # number of the frame to come

    @property
    def names(self) -> tuple[str, ...]:
        """The objects that it looks after, in the order in which they came."""
        return tuple(self._sessions)

    def remove(self, name: str) -> None:
        """Forget an object."""
        del self._sessions[name]
        self._given.pop(name, None)

    def segment(
        self,
        frame: Frame,
        prompts: Iterable[Prompt] = (),
        hints: Mapping[str, Hint] | None = None,
    ) -> np.ndarray:
        """One frame in, one label image out; where two objects claim a pixel the likelier one has it."""
        import torch

        prompt_of = {prompt.name: prompt for prompt in prompts}
        for prompt in (p for p in prompt_of.values() if p.mask is None):
            check_prompt(prompt, self._camera)
            check_depth(prompt, frame)
        masks = {name: prompt.mask for name, prompt in prompt_of.items() if prompt.mask is not None}
        for name in prompt_of:
            self._sessions.setdefault(name, None)
        self._given |= {name: (frame, mask) for name, mask in masks.items() if mask.any()}
        with torch.inference_mode():
            for name in self._given.keys() - masks.keys():
                self._restart(name, *self._given.pop(name))
            self._click([prompt for prompt in prompt_of.values() if prompt.mask is None])
            known = [name for name, session in self._sessions.items() if session is not None]
            labels = self._labels(frame, [name for name in known if name not in masks])
        self._at += 1
        for label, name in enumerate(self._sessions, 1):
            if name in masks:
                labels[masks[name]] = label
        return labels

    def _restart(self, name: str, frame: Frame, mask: np.ndarray) -> None:
        """A session that begins with a mask (H, W) bool given in an earlier frame.

        Not before it is needed: where every frame brings a mask, the network has nothing to do.
        """
        session = self._sessions[name] = self._session()
        at, before = session.obj_id_to_idx(_OBJECT), self._at - 1
        session.add_mask_inputs(at, before, self._mask(mask))
        session.obj_with_new_inputs = [_OBJECT]
        self._look(session, self._pixels(frame.rgb), before)

    def _click(self, prompts: Iterable[Prompt]) -> None:
        """Put clicks into the sessions for the frame to come; an object that has none yet gets one."""
        for prompt in prompts:
            before = self._sessions[prompt.name]
            session = self._sessions[prompt.name] = self._session() if before is None else before
            at = session.obj_id_to_idx(_OBJECT)
            if before is not None:  # a correction: what the memory says of this frame counts as well
                session.frames_tracked_per_obj[at][self._at] = {"reverse": False}
            session.add_point_inputs(at, self._at, self._points(prompt))
            session.obj_with_new_inputs = [_OBJECT]

    def _points(self, prompt: Prompt) -> dict[str, torch.Tensor]:
        """Clicks as the network takes them: a box is two of them, which are its corners."""
        import torch

        corners = np.zeros((0, 2)) if prompt.box_px is None else prompt.box_px.reshape(2, 2)
        at = np.concatenate([corners, prompt.points_px, prompt.negative_px])
        kinds = _CORNERS[: len(corners)] + [_ON] * len(prompt.points_px) + [_BESIDE] * len(prompt.negative_px)
        shape = self._camera.height, self._camera.width
        # The network adds the half by which a pixel's centre is off its edge.
        points = torch.from_numpy(to_raster(at, shape, self._size) - 0.5).float()[None, None]
        return {"point_coords": points, "point_labels": torch.tensor(kinds, dtype=torch.int32)[None, None]}

    def _mask(self, mask: np.ndarray) -> torch.Tensor:
        """(1, 1, S, S) as the network wants it."""
        import torch

        image = torch.from_numpy(mask).to(self._device)[None, None].float()
        size = (self._size, self._size)
        return (torch.nn.functional.interpolate(image, size, mode="bilinear", antialias=True) >= 0.5).float()

    def _session(self) -> Any:
        """A session of one object, of which nothing is said yet."""
        import torch
        from transformers import Sam2VideoInferenceSession

        return Sam2VideoInferenceSession(
            video_height=self._camera.height,
            video_width=self._camera.width,
            inference_device=torch.device(self._device),
            inference_state_device=torch.device(self._device),
            video_storage_device=torch.device(self._device),
            dtype=torch.float32,
        )

    def _labels(self, frame: Frame, names: Sequence[str]) -> np.ndarray:
        """The label image of these objects."""
        import torch

        if not names:
            return np.zeros(frame.shape, np.int32)
        pixels = self._pixels(frame.rgb)
        features = self._features(pixels)
        logits = [self._look(self._sessions[name], pixels, self._at, features) for name in names]
        masks = torch.nn.functional.interpolate(torch.cat(logits), frame.shape, mode="bilinear", align_corners=False)
        best, which = masks[:, 0].max(0)
        label = torch.tensor([1 + list(self._sessions).index(name) for name in names], device=best.device)
        return torch.where(best > 0, label[which], 0).cpu().numpy().astype(np.int32)

    def _features(self, pixels: torch.Tensor) -> dict[str, Any]:
        """The image's features, which all objects share."""
        found = self._model.get_image_features(pixels, return_dict=True)
        return {"vision_feats": found.fpn_hidden_states, "vision_pos_embeds": found.fpn_position_encoding}

    def _look(
        self, session: Any, pixels: torch.Tensor, at: int, features: dict[str, Any] | None = None
    ) -> torch.Tensor:
        """(1, 1, h, w) the logits of a session's object in the image of number ``at``."""
        import torch

        session.cache.cache_vision_features(at, features or self._features(pixels))
        output = self._model(inference_session=session, frame=pixels, frame_idx=at)
        self._trim(session, at)
        return torch.where(output.object_score_logits.view(-1, 1, 1, 1) > 0, output.pred_masks, _ABSENT)

    def _pixels(self, rgb: np.ndarray) -> torch.Tensor:
        """(1, 3, S, S) as the network wants it."""
        import torch

        image = torch.from_numpy(rgb).to(self._device).permute(2, 0, 1)[None].float() / 255
        image = torch.nn.functional.interpolate(
            image, (self._size, self._size), mode="bilinear", align_corners=False, antialias=True
        )
        mean, deviation = (torch.tensor(v, device=self._device).view(1, 3, 1, 1) for v in (MEAN, DEVIATION))
        return (image - mean) / deviation

    def _trim(self, session: Any, now: int) -> None:
        """Let go of what is not read any more: by itself a session grows by megabytes a frame."""
        config = self._model.config
        session.processed_frames = {}
        at = session.obj_id_to_idx(_OBJECT)
        session.frames_tracked_per_obj[at] = {now: {"reverse": False}}
        kept = session.output_dict_per_obj[at]
        recent = kept["non_cond_frame_outputs"]
        for old in [i for i in recent if i <= now - config.max_object_pointers_in_encoder]:
            del recent[old]
        for i, output in [*recent.items(), *kept["cond_frame_outputs"].items()]:
            spent = _SPATIAL if i in recent and i <= now - config.num_maskmem else ()
            for key in (*_READ_ONCE, *spent):
                output.pop(key, None)
