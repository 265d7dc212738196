"""Point2Pose: 6D pose tracking and reconstruction of several unknown rigid objects from RGB-D video.

>>> from p2p_lib import Point2Pose, open_sequence, preset
>>> sequence = open_sequence("synthetic/crossing")
>>> tracker = Point2Pose(sequence.camera, preset("default"))
>>> tracker.add_object("box")
>>> for i in range(3):
...     estimates = tracker.step(sequence.frame(i), {"box": sequence.masks(i)["box"]})
>>> estimates["box"].status, estimates["box"].T_cam_obj.shape
(<Status.TRACKED: 'tracked'>, (4, 4))

Importing this package is fast: it loads neither torch nor open3d nor matplotlib.
"""

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what _WHERE says, for type checkers and editors
    from p2p_lib.core.camera import Camera
    from p2p_lib.core.compiled import warm_up
    from p2p_lib.core.config import Config, preset
    from p2p_lib.core.errors import BadInput, MissingBackend, MissingData, P2PError
    from p2p_lib.core.types import Frame, PoseEstimate, Status, Tracks
    from p2p_lib.datasets.sequence import open_sequence
    from p2p_lib.extended.default import Point2Pose

logging.getLogger("p2p_lib").addHandler(logging.NullHandler())  # whoever wants to read it says so
__version__ = "0.1.0"

_NAMES = {
    "p2p_lib.extended.default": ["Point2Pose"],
    "p2p_lib.datasets.sequence": ["open_sequence"],
    "p2p_lib.core.camera": ["Camera"],
    "p2p_lib.core.compiled": ["warm_up"],
    "p2p_lib.core.config": ["Config", "preset"],
    "p2p_lib.core.types": ["Frame", "PoseEstimate", "Status", "Tracks"],
    "p2p_lib.core.errors": ["BadInput", "MissingData", "MissingBackend", "P2PError"],
}
_WHERE = {name: module for module, names in _NAMES.items() for name in names}
__all__ = ["Point2Pose", "open_sequence", "Camera", "Config", "preset", "warm_up"]  # noqa: RUF022 what one needs first comes first
__all__ += ["Frame", "PoseEstimate", "Status", "Tracks"]
__all__ += ["BadInput", "MissingBackend", "MissingData", "P2PError", "__version__"]


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'p2p_lib' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
