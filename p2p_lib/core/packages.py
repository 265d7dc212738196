"""Third-party packages that are loaded only when asked for by name, and the commands that install them."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from pathlib import Path
from types import ModuleType

from p2p_lib.core.errors import MissingBackend, in_a_line
from p2p_lib.core.paths import PROJECT

PIP = "{uv} pip install --python {python} "
# Without its dependencies: those of the JAX version are gigabytes that the PyTorch version does not use.
_TAPNET = PIP + "--no-deps 'tapnet @ git+https://github.com/google-deepmind/tapnet'"
_HUB = "import torch; torch.hub.load('facebookresearch/co-tracker', 'cotracker3_online', pretrained=False)"

#: What has to be typed, by package.
INSTALL = {
    "transformers": PIP + "transformers",
    "onnxruntime": PIP + "onnxruntime",
    "rosbags": PIP + "rosbags",
    "pyrealsense2": PIP + "pyrealsense2",
    "rerun-sdk": PIP + "rerun-sdk",
    "distributed": PIP + "'dask[distributed]'",
    "tapnet": PIP + "einshape dm-tree einops && " + _TAPNET,
    # The one built for the torch that Open3D is built for; any other replaces torch.
    "torchvision": PIP + "--torch-backend=auto torchvision==0.28.0",
    "co-tracker": '{python} -c "' + _HUB + '"',
}


def command(template: str) -> str:
    """A template of :data:`INSTALL` for this very Python."""
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or "uv"
    return template.format(uv=from_here(uv), python=from_here(sys.executable))


def from_here(path: str) -> str:
    """The path as seen from the project's folder where it lies below it."""
    return str(Path(path).relative_to(PROJECT)) if Path(path).is_relative_to(PROJECT) else path


def load(module: str, backend: str, package: str) -> ModuleType:
    """A module of a package that ``backend`` needs; :class:`MissingBackend` with the command where it is not there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        fix = f"Run: {command(INSTALL[package])}"
        missing = f"the package {package} cannot be loaded ({in_a_line(error)})"
        raise MissingBackend(backend, missing, fix) from error


def cotracker_folder() -> Path | None:
    """Where torch.hub keeps CoTracker's code; None where it does not."""
    home = os.environ.get("TORCH_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torch"
    return next(iter(sorted((Path(home).expanduser() / "hub").glob("facebookresearch_co-tracker_*"))), None)
