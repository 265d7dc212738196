"""Checks every part of this installation and says how to mend what is missing (``p2p doctor``)."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from p2p_lib.core import native
from p2p_lib.core.findings import Finding
from p2p_lib.core.packages import INSTALL, command, cotracker_folder
from p2p_lib.core.paths import PROJECT, cache_dir, data_dir

#: Distributions whose module has another name.
MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL", "scikit-image": "skimage"}
#: Optional backend: module, what it serves, remedy.
OPTIONAL = {
    "transformers": ("transformers", "segmentation and features by neural networks", INSTALL["transformers"]),
    "onnxruntime": ("onnxruntime", "SAM 2 on a CPU: first masks, --masks sam2", INSTALL["onnxruntime"]),
    "tapnet": ("tapnet", "2D trackers tapir and tapnextpp", INSTALL["tapnet"]),
    "torchvision": ("torchvision", "2D tracker tapnextpp", INSTALL["torchvision"]),
    "rerun": ("rerun", "recordings to look at frame by frame, p2p view --rerun", INSTALL["rerun-sdk"]),
    "rosbags": ("rosbags", "ROS 1 and 2 recordings, p2p convert", INSTALL["rosbags"]),
    "pyrealsense2": ("pyrealsense2", "RealSense cameras and recordings", INSTALL["pyrealsense2"]),
    "dask": ("dask.distributed", "runs on a cluster", INSTALL["distributed"]),
}
FREE_GB = 5.0
# How long a package may take to load before something is taken to be wrong with it.
IMPORT_TIMEOUT_S = 180


def run_doctor() -> list[Finding]:
    """Python, required packages (really imported, in a process of their own), libraries, GPU, backends, data."""
    required = required_packages()
    # Together they take seconds; where that fails each is imported by itself, which tells which it is.
    fine = not _fails("\n".join(map(_loading, required)))
    imports = [_package(name, "" if fine else None) for name in required]
    libraries = [_library(library, package) for library, package in native.SYSTEM_LIBRARIES.items()]
    optional = [_optional(name, *about) for name, about in OPTIONAL.items()]
    return [_python(), *imports, *libraries, _kernel(), _gpu(), *optional, _cotracker(), _data(), _cache(), _disk()]


def required_packages() -> list[str]:
    """The distributions that this package requires, as its own metadata says."""
    needs = metadata.requires("p2p-lib") or []
    return sorted(re.match(r"[A-Za-z0-9._-]+", need)[0] for need in needs if "extra ==" not in need)


def _python() -> Finding:
    fine = (3, 11) <= sys.version_info[:2] <= (3, 13)
    found = f"{platform.python_version()}, glibc {platform.libc_ver()[1] or 'none'}, {os.cpu_count()} cores"
    return Finding.whether(fine, "Python", found, "Set P2P_PYTHON to a Python 3.11 to 3.13 and run: make setup")


def _loading(name: str) -> str:
    """Code that imports a distribution's module."""
    if name == "open3d":
        return "from p2p_lib.core.native import load_open3d; load_open3d()"
    return f"import {MODULES.get(name, name.replace('-', '_'))}"


def _package(name: str, error: str | None = None) -> Finding:
    """A required package; ``error`` is what ended its import, None where nobody has tried."""
    if name == "libusb-package" and native.loads("libusb-1.0.so.0"):
        return Finding.whether(True, name, "not needed: the system has libusb")
    error = _fails(_loading(name)) if error is None else error
    remedy = error.partition("Run: ")[2] or "make setup"
    return Finding.whether(not error, name, error or metadata.version(name), remedy)


def _fails(code: str) -> str:
    """What ends a fresh Python that runs this code, in one line; empty where nothing does."""
    try:
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=IMPORT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"not loaded within {IMPORT_TIMEOUT_S} s"
    if result.returncode < 0:
        return f"ended by signal {-result.returncode} (a processor that its build does not know?)"
    last = (result.stderr.strip().splitlines() or ["no message"])[-1]
    return last if result.returncode else ""


def _library(library: str, package: str) -> Finding:
    if native.loads(library):
        return Finding.whether(True, library, "of the system")
    if package == "libusb-1.0-0" and native.preload_libusb():
        return Finding.whether(True, library, "of the package libusb-package")
    return Finding.whether(False, library, "not found; Open3D needs it", native.install_command([library]))


def _kernel() -> Finding:
    there = (Path(sys.prefix) / "share" / "jupyter" / "kernels" / "python3").is_dir()
    return Finding.whether(there, "Jupyter kernel", "python3" if there else "none", "make setup")


def _gpu() -> Finding:
    smi = shutil.which("nvidia-smi")
    listed = subprocess.run([smi, "-L"], capture_output=True, text=True).stdout.strip().splitlines() if smi else []
    if not listed:
        found = "none; everything runs on the CPU"
        return Finding.whether(False, "GPU", found, "nothing to do without an NVIDIA GPU", optional=True)
    name = re.sub(r" \(UUID.*", "", listed[0])
    error = _fails("import torch, sys; sys.exit(None if torch.cuda.is_available() else f'torch {torch.__version__}')")
    found = f"{name}; {error or 'torch uses it'}"
    return Finding.whether(not error, "GPU", found, "P2P_TORCH=cuda make setup", optional=True)


def _optional(name: str, module: str, serves: str, remedy: str) -> Finding:
    try:
        there = importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # its parent package is missing
        there = False
    return Finding.whether(there, name, serves + ("" if there else "; not installed"), command(remedy), optional=True)


def _cotracker() -> Finding:
    there = cotracker_folder() is not None  # it comes through torch.hub, which keeps it under its own cache folder
    serves = "2D tracker cotracker3, CC BY-NC: not for commercial use" + ("" if there else "; not there")
    return Finding.whether(there, "cotracker", serves, command(INSTALL["co-tracker"]), optional=True)


def _data() -> Finding:
    folder = data_dir()
    if folder is None:
        remedy = "export P2P_DATA=FOLDER of your datasets"
        return Finding.whether(False, "$P2P_DATA", "not set; bundled data only", remedy, optional=True)
    found = f"{folder}{'' if folder.is_dir() else ' does not exist'}"
    return Finding.whether(folder.is_dir(), "$P2P_DATA", found, "point P2P_DATA at an existing folder", optional=True)


def _cache() -> Finding:
    folder = cache_dir()
    nearest = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    used_mb = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
    remedy = "set P2P_CACHE to a folder you may write to"
    return Finding.whether(os.access(nearest, os.W_OK), "cache folder", f"{folder}, {used_mb:.0f} MB used", remedy)


def _disk() -> Finding:
    free_gb = shutil.disk_usage(PROJECT).free / 1e9
    remedy = f"free {FREE_GB:.0f} GB beside the project"
    return Finding.whether(free_gb >= FREE_GB, "disk", f"{free_gb:.0f} GB free", remedy)
