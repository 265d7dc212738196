"""Point2Pose: 6D pose tracking and reconstruction of several unknown rigid objects from RGB-D video.

Importing this package is fast: it loads neither torch nor open3d nor matplotlib.
"""

import logging
from importlib import import_module

logging.getLogger("p2p_lib").addHandler(logging.NullHandler())  # whoever wants to read it says so
__version__ = "0.1.0"

_WHERE = {
    "Point2Pose": "p2p_lib.method.pipeline",
    "open_sequence": "p2p_lib.datasets.sequence",
    "Camera": "p2p_lib.core.camera",
    "Config": "p2p_lib.core.config",
    "preset": "p2p_lib.core.config",
    "Frame": "p2p_lib.core.types",
    "PoseEstimate": "p2p_lib.core.types",
    "Status": "p2p_lib.core.types",
    "Tracks": "p2p_lib.core.types",
    "BadInput": "p2p_lib.core.errors",
    "MissingData": "p2p_lib.core.errors",
    "MissingBackend": "p2p_lib.core.errors",
    "P2PError": "p2p_lib.core.errors",
}
__all__ = [*_WHERE, "__version__"]


def __getattr__(name: str):
    if name in _WHERE:
        return getattr(import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'p2p_lib' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
