"""Checks every part of this installation and says how to mend what is missing (``p2p doctor``)."""

from __future__ import annotations

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
from p2p_lib.core.packages import EXTRAS, INSTALL, command, cotracker_folder, extra
from p2p_lib.core.paths import PROJECT, cache_dir, data_dir

#: Distributions whose module has another name.
MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL", "scikit-image": "skimage"}
#: What no extra brings: what it serves.
OPTIONAL = {"tapnet": "2D trackers tapir and tapnextpp", "torchvision": "2D tracker tapnextpp"}
#: Room for the results of a clone's notebooks, and of some runs.
CLONE_GB, FREE_GB = 5.0, 1.0
# How long a package may take to load before something is taken to be wrong with it.
IMPORT_TIMEOUT_S = 180


def run_doctor() -> list[Finding]:
    """Python, packages (really imported, in a process of their own), libraries, GPU, data, disk.

    An extra that is not installed is left out on purpose: optional, as one line. What is installed has to work.
    """
    extras = {name: packages_of(name) for name in EXTRAS}
    there = {name: [package for package in of if _installed(package)] for name, of in extras.items()}
    names = packages_of() + sorted({package for of in there.values() for package in of})
    # Together they take seconds; where that fails each is imported by itself, which tells which it is.
    fine = not _fails("\n".join(map(_loading, names)))
    imports = [_package(name, "" if fine else None) for name in names]
    optional = [_extra(name, sorted(set(of) - set(there[name]))) for name, of in extras.items()]
    optional += [_optional(name, serves) for name, serves in OPTIONAL.items()]
    libraries = [_library(*pair) for pair in native.SYSTEM_LIBRARIES.items() if _installed("open3d")]
    kernel = [_kernel()] if _installed("jupyterlab") else []
    return [_python(), *imports, *libraries, *kernel, *optional, _gpu(), _cotracker(), _data(), _cache(), _disk()]


def packages_of(extra: str = "") -> list[str]:
    """The distributions that this package requires, or that one of its extras adds, as its own metadata says."""
    found = set()
    for need in metadata.requires("p2p-lib") or []:
        name, marker = re.split(r"[^A-Za-z0-9._-]", need)[0], re.search(r"""extra == ['"]([\w-]+)""", need)
        if (marker[1] if marker else "") == extra and name != "p2p-lib":
            found.add(name)
    return sorted(found)


def _python() -> Finding:
    fine = (3, 11) <= sys.version_info[:2] <= (3, 13)
    found = f"{platform.python_version()}, glibc {platform.libc_ver()[1] or 'none'}, {os.cpu_count()} cores"
    return Finding.whether(fine, "Python", found, "Set P2P_PYTHON to a Python 3.11 to 3.13 and run: make setup")


def _loading(name: str) -> str:
    """Code that imports a distribution's module."""
    if name == "open3d":
        return "from p2p_lib.core.native import load_open3d; load_open3d()"
    return f"import {MODULES.get(name, name.replace('-', '_'))}"


def _setup(name: str) -> str:
    """What installs a package anew: in a clone the set-up, elsewhere pip."""
    return "make setup" if (PROJECT / "notebooks").is_dir() else command(f"{{pip}} install --force-reinstall {name}")


def _package(name: str, error: str | None = None) -> Finding:
    """A required package; ``error`` is what ended its import, None where nobody has tried."""
    if name == "libusb-package" and native.loads("libusb-1.0.so.0"):
        return Finding.whether(True, name, "not needed: the system has libusb")
    error = _fails(_loading(name)) if error is None else error
    remedy = error.partition("Run: ")[2] or _setup(name)
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
    if not _installed("torch"):
        return Finding.whether(False, "GPU", f"{name}; torch is not installed", command(extra("torch")), optional=True)
    error = _fails("import torch, sys; sys.exit(None if torch.cuda.is_available() else f'torch {torch.__version__}')")
    found = f"{name}; {error or 'torch uses it'}"
    return Finding.whether(not error, "GPU", found, "P2P_TORCH=cuda make setup", optional=True)


def _extra(name: str, lacking: list[str]) -> Finding:
    found = EXTRAS[name] + (f"; not installed: {', '.join(lacking)}" if lacking else "")
    return Finding.whether(not lacking, f"extra {name}", found, command(extra(name)), optional=True)


def _optional(name: str, serves: str) -> Finding:
    there = _installed(name)
    remedy = command(INSTALL[name])
    return Finding.whether(there, name, serves + ("" if there else "; not installed"), remedy, optional=True)


def _installed(name: str) -> bool:
    try:
        return bool(metadata.version(name))
    except metadata.PackageNotFoundError:
        return False


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
    in_clone = (PROJECT / "notebooks").is_dir()
    needed, where = (CLONE_GB, PROJECT) if in_clone else (FREE_GB, Path.cwd())
    free_gb = shutil.disk_usage(where).free / 1e9
    return Finding.whether(free_gb >= needed, "disk", f"{free_gb:.0f} GB free", f"free {needed:.0f} GB in {where}")
