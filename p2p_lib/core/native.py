"""The system libraries that Open3D wants, and the one way in which this package loads Open3D.

Importing this module loads nothing; the set-up asks it for missing packages before anything else works.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import shutil
from types import ModuleType

from p2p_lib.core.compiled import uninterrupted
from p2p_lib.core.errors import MissingBackend, in_a_line
from p2p_lib.core.packages import INSTALL, command

#: Shared library of the system: the Debian/Ubuntu package that holds it.
SYSTEM_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
}


def loads(library: str) -> bool:
    """Whether the system's loader finds this shared library, or has loaded one of that name already."""
    try:
        ctypes.CDLL(library, ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True


def missing_libraries() -> list[str]:
    """The entries of :data:`SYSTEM_LIBRARIES` that this system lacks."""
    return [library for library in SYSTEM_LIBRARIES if not loads(library)]


def install_command(libraries: list[str]) -> str:
    """What to type to get these libraries: an apt line where there is apt, their names elsewhere."""
    if not shutil.which("apt-get"):
        return f"install {' '.join(libraries)} with your system's package manager"
    sudo = "" if os.geteuid() == 0 else "sudo "
    return f"{sudo}apt-get install -y {' '.join(SYSTEM_LIBRARIES[library] for library in libraries)}"


def preload_libusb() -> bool:
    """Make libusb-1.0 available to Open3D: the system's, else the one in the wheel ``libusb-package``."""
    if loads("libusb-1.0.so.0"):
        return True
    try:
        path = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return False
    return path is not None and loads(str(path))


def load_mesh_libraries() -> None:
    """Import what meshes are made with, which takes seconds."""
    with uninterrupted():  # trimesh takes a Ctrl-C that comes meanwhile for a library that is missing, and goes on
        import skimage.measure  # noqa: F401
        import trimesh  # noqa: F401


def load_open3d() -> ModuleType:
    """The module ``open3d``; :class:`MissingBackend` with the command that mends it where it cannot be loaded."""
    preload_libusb()
    # Else it prints three lines about a web server into every notebook.
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        if missing := missing_libraries():
            raise MissingBackend("open3d", f"needs {', '.join(missing)}", f"Run: {install_command(missing)}") from error
        raise MissingBackend("open3d", in_a_line(error), f"Run: {command(INSTALL['open3d'])}") from error
