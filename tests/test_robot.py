"""Tracking alone: what environment.md has a robot install is enough, and nothing else is imported."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text())
GROUP = PYPROJECT["dependency-groups"]["robot"]

#: A printed card that slides over a wall: true poses by construction, made with NumPy and OpenCV alone.
TRACK = """
import cv2
import numpy as np
from p2p_lib import Camera, Frame, Point2Pose, preset
from p2p_lib.core.mesh import save

camera, rng, STEP_PX, Z_M = Camera(300, 300, 159.5, 119.5, 320, 240), np.random.default_rng(0), 3, 0.6
print_ = sum(cv2.resize(rng.integers(0, 256, (s, s, 3)).astype(np.float32), (100, 80)) for s in (5, 15, 40)) / 3
tracker, ends = Point2Pose(camera, preset("default")), []
tracker.add_object("card", clicks=[[110, 119], [90, 110], [130, 130]])
for k in range(20):
    rgb, depth_m = np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 1.0, np.float32)
    part = np.s_[80:160, 60 + STEP_PX * k : 160 + STEP_PX * k]
    rgb[part], depth_m[part] = print_, Z_M
    estimate = tracker.step(Frame(k, k / 30, rgb, depth_m))["card"]
    assert estimate.T_cam_obj is not None, estimate
    ends.append(estimate.T_cam_obj)
moved = ends[-1] @ np.linalg.inv(ends[0])
assert np.abs(moved[:3, :3] - np.eye(3)).max() < 0.02, moved
# A turn and a move of a flat card look alike: what has to be right is where its middle is.
middle = [T[:3, 3] for T in (ends[0], ends[-1])]
assert np.abs(middle[1] - middle[0] - [19 * STEP_PX * Z_M / 300, 0, 0]).max() < 0.003, middle
mesh = tracker.objects["card"].model.surface.mesh()
assert np.abs(np.sort(mesh.extents)[1:] - [80 * Z_M / 300, 100 * Z_M / 300]).max() < 0.015, mesh.extents
save(mesh, "card.ply")
"""
#: Refuses every installed package that is not in ALLOWED, as if it were not there.
BLOCK = """
import sys
from importlib import metadata
homes = metadata.packages_distributions()
class Robot:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in homes and not {re.sub("[-_.]+", "-", d).lower() for d in homes[top]} & ALLOWED:
            raise ModuleNotFoundError(f"{top} is not on the robot", name=top)
import re
sys.meta_path.insert(0, Robot())
"""


def with_all_they_need(names: set[str]) -> set[str]:
    """Distributions and everything that they require here, extras left out."""
    found, ahead = set(), {canonicalize_name(name) for name in names}
    while ahead:
        found.add(name := ahead.pop())
        needs = map(Requirement, metadata.requires(name) or [])
        wanted = {canonicalize_name(n.name) for n in needs if n.marker is None or n.marker.evaluate({"extra": ""})}
        ahead |= wanted - found
    return found


def robot(code: str, folder: Path, leave_out: str = "") -> subprocess.CompletedProcess:
    allowed = with_all_they_need({Requirement(need).name for need in GROUP}) | {"p2p-lib"}
    code = f"ALLOWED = {allowed - {leave_out}!r}\n{BLOCK}\n{code}"
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


def test_a_robot_tracks_and_meshes_with_its_packages_alone(tmp_path):
    ran = robot(TRACK, tmp_path)
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert (tmp_path / "card.ply").stat().st_size > 1000


def test_what_is_not_of_the_robot_is_out_of_reach(tmp_path):
    for module in ("torch", "open3d", "matplotlib", "pandas", "IPython"):
        ran = robot(f"import {module}", tmp_path)
        assert "is not on the robot" in ran.stderr, module
    ran = robot("import numba", tmp_path, leave_out="numba")
    assert "numba is not on the robot" in ran.stderr


def test_the_group_is_of_what_the_package_requires():
    declared = set(PYPROJECT["project"]["dependencies"])
    assert set(GROUP) <= declared, "the same bounds as in dependencies"
    assert 5 < len(GROUP) < 10


def test_environment_says_how():
    page = (PROJECT / "environment.md").read_text()
    assert re.search(r"--group robot .*-c requirements\.lock|-c requirements\.lock .*--group robot", page)
