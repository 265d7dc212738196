"""Third-party packages that one can do without, and the commands that install them."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from p2p_lib.core.errors import MissingBackend, in_a_line

_PIP = "{pip} install "
# Without its dependencies: those of the JAX version are gigabytes that the PyTorch version does not use.
_TAPNET = _PIP + "--no-deps 'tapnet @ git+https://github.com/google-deepmind/tapnet'"
_HUB = "import torch; torch.hub.load('facebookresearch/co-tracker', 'cotracker3_online', pretrained=False)"

#: The extras of this package, and what each serves; ``all`` is those of the first lines, up to ``realsense``.
EXTRAS = {
    "notebooks": "notebooks and their figures: make lab, p2p notebooks, p2p figures",
    "view": "p2p view, and films as .mp4",
    "torch": "surfaces on a GPU (--device cuda), and all networks",
    "open3d": "p2p export --format model or foundationpose, scores of p2p benchmark, Azure Kinect recordings",
    "dask": "runs on a cluster, p2p benchmark --scheduler",
    "ros": "ROS 1 and 2 recordings, p2p convert",
    "realsense": "RealSense cameras and recordings, p2p live and p2p convert",
    "sam2": "SAM 2 on a CPU: masks of prompts, --masks sam2",
    "sam2-video": "segmentation by a PyTorch network with a memory: --masks sam2_video",
}


def extra(name: str) -> str:
    """The template of the command that adds an extra to the installed package."""
    return _PIP + f'"p2p_lib[{name}]"'


#: What has to be typed, by package.
INSTALL = {
    "onnxruntime": extra("sam2"),
    "transformers": extra("sam2-video"),
    "rosbags": extra("ros"),
    "pyrealsense2": extra("realsense"),
    "distributed": extra("dask"),
    "open3d": extra("open3d"),
    "torch": extra("torch"),
    "tapnet": _PIP + "einshape dm-tree einops && " + _TAPNET,
    # The one built for the torch that Open3D is built for; any other replaces torch.
    "torchvision": "{uv} pip install --python {python} --torch-backend=auto torchvision==0.28.0",
    "co-tracker": '{python} -c "' + _HUB + '"',
}


def command(template: str) -> str:
    """A template of :data:`INSTALL` for this very Python."""
    here = Path(sys.executable).parent
    uv, pip = (shutil.which(name, path=str(here)) for name in ("uv", "pip"))
    python = from_here(sys.executable)
    pip = "pip" if pip and pip == shutil.which("pip") else f"{python} -m pip"
    return template.format(uv=from_here(uv or "uv"), python=python, pip=pip)


def from_here(path: str) -> str:
    """The path as seen from the working folder where it lies below it: what is typed there finds it."""
    return str(Path(path).relative_to(Path.cwd())) if Path(path).is_relative_to(Path.cwd()) else path


def load(module: str, backend: str, package: str) -> ModuleType:
    """A module of a package that ``backend`` needs; :class:`MissingBackend` with the command where it is not there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        fix = f"Run: {command(INSTALL[package])}"
        missing = f"the package {package} cannot be loaded ({in_a_line(error)})"
        raise MissingBackend(backend, missing, fix) from error


@contextmanager
def needed_for(name: str) -> Iterator[None]:
    """What is imported inside comes with this extra: :class:`MissingBackend` where it is not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module in ("", "p2p_lib", "studies"):
            raise
        what = f"not installed; it comes with the extra {name} ({EXTRAS[name]})"
        raise MissingBackend(module, what, f"Run: {command(extra(name))}") from error


def cotracker_folder() -> Path | None:
    """Where torch.hub keeps CoTracker's code; None where it does not."""
    home = os.environ.get("TORCH_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torch"
    return next(iter(sorted((Path(home).expanduser() / "hub").glob("facebookresearch_co-tracker_*"))), None)
