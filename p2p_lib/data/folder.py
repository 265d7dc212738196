"""A plain folder of one's own: ``rgb/``, ``depth/`` and ``cam_K.txt``; no truth.

``masks/`` is optional: one folder per object (named by it), or one label image per picture (0 = background,
k = object k). A single mask is taken as the first picture's. ``times.txt`` (seconds, one a line) is optional;
pictures whose names are nanoseconds need none. ``depth_scale.txt`` is optional: metres per unit of the depth images,
which are in millimetres otherwise.
"""

from __future__ import annotations

from pathlib import Path

from p2p_lib.core.errors import BadInput
from p2p_lib.data import images
from p2p_lib.data.image_sequence import ImageSequence, pictures
from p2p_lib.data.masks import find_masks, masks_folder


def recognises(folder: Path) -> bool:
    """Whether a folder has ``rgb/``."""
    return (folder / "rgb").is_dir()


def load(folder: Path, name: str, depth_scale: float | None, masks: str | Path | None) -> ImageSequence:
    """The sequence in this folder; arguments as of :func:`~p2p_lib.data.sequence.open_sequence`."""
    rgb_files, depth_files, camera, times_s = pictures(folder)
    where = masks_folder(folder, masks) if masks else folder / "masks"
    found = None
    if masks or where.is_dir():
        found = find_masks(where, rgb_files, (camera.height, camera.width), first_frame_alone=True)
    return ImageSequence(
        name=name,
        format="folder",
        path=folder,
        camera=camera,
        objects=found.objects if found else ("object",),
        rgb_files=rgb_files,
        depth_files=depth_files,
        times_s=times_s,
        depth_scale=depth_scale or _depth_scale(folder / "depth_scale.txt"),
        mask_files=found,
        own_masks=found,
        model_places={name: (folder / "models" / name,) for name in (found.objects if found else ("object",))},
    )


def _depth_scale(path: Path) -> float:
    """Metres per unit, as the file says; millimetres where there is none."""
    if not path.is_file():
        return images.DEPTH_SCALE
    scale = images.read_numbers(path, "metres per unit of the depth images, one number")
    if scale.shape != (1, 1) or not 0 < scale[0, 0] <= 1:
        got = " ".join(path.read_text().split())[:40]
        raise BadInput(str(path), got, "one number above 0, at most 1: metres per unit")
    return float(scale[0, 0])
