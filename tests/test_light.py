"""The light install: what ``pip install p2p_lib`` brings is enough to track, and what it lacks is named."""

import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from p2p_lib.core.packages import EXTRAS
from p2p_lib.core.paths import cache_dir
from p2p_lib.offline import PRODUCTS

PROJECT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
LIGHT = {Requirement(need).name for need in PYPROJECT["dependencies"]}
#: As much as anyone who only tracks should have to wait for.
WITHOUT = {"torch", "open3d", "matplotlib", "jupyterlab", "papermill", "ipython", "viser", "av", "distributed"}

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
import re
import sys
from importlib import metadata
homes = metadata.packages_distributions()
class Light:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in homes and not {re.sub("[-_.]+", "-", d).lower() for d in homes[top]} & ALLOWED:
            raise ModuleNotFoundError(f"No module named {top!r}: it is not in the light install", name=top)
sys.meta_path.insert(0, Light())
"""
COMMAND = "import sys\nfrom p2p_lib.apps.cli import main\nsys.exit(main(sys.argv[1:]))"


def with_all_they_need(names: set[str]) -> set[str]:
    """Distributions and everything that they require here, extras left out."""
    found, ahead = set(), {canonicalize_name(name) for name in names}
    while ahead:
        found.add(name := ahead.pop())
        needs = map(Requirement, metadata.requires(name) or [])
        wanted = {canonicalize_name(n.name) for n in needs if n.marker is None or n.marker.evaluate({"extra": ""})}
        ahead |= wanted - found
    return found


def light(code: str, folder: Path, *words: str, leave_out: str = "") -> subprocess.CompletedProcess:
    allowed = with_all_they_need(LIGHT) | {"p2p-lib"}
    code = f"ALLOWED = {allowed - {leave_out}!r}\n{BLOCK}\n{code}"
    environment = {**os.environ, "P2P_CACHE": str(cache_dir()), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(PROJECT)}
    words = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)


def p2p(folder: Path, *words: object, before: str = "") -> str:
    ran = light(before + COMMAND, folder, *words)
    assert ran.returncode == 0, ran.stderr[-2000:]
    return ran.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where a run of a few frames is, made by the light install."""
    folder = tmp_path_factory.mktemp("light")
    words = ["--masks", "clicks", "--stop", 6, "--save-masks", "--quiet"]
    assert "ADD-S" in p2p(folder, "run", "synthetic/crossing", "--out", "run", *words)
    return folder


def test_it_is_light():
    everything = with_all_they_need(LIGHT)
    assert len(LIGHT) < 16 and len(everything) < 50
    assert not everything & WITHOUT


def test_tracks_and_meshes(tmp_path):
    ran = light(TRACK, tmp_path)
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert (tmp_path / "card.ply").stat().st_size > 1000


def test_what_it_leaves_out_is_out_of_reach(tmp_path):
    for module in ("torch", "open3d", "matplotlib", "IPython", "av"):
        assert "it is not in the light install" in light(f"import {module}", tmp_path).stderr, module
    assert "not in the light install" in light("import numba", tmp_path, leave_out="numba").stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("eval run", "ADD-S"),
        ("export run --format tum --out tum", "Written"),
        ("export run --format bop --out bop", "Written"),
        ("film run --out film.webp", "film.webp"),
        ("eval-masks run", "IoU"),
        ("data list", "ycbineoat"),
        ("config --diff", "method"),
        ("benchmark --list runtime", "320x240"),
    ],
)
def test_its_commands(folder, words, said):
    ran = light(COMMAND, folder, *words.split())
    assert ran.returncode == 0 and said in ran.stdout, ran.stdout[-1000:] + ran.stderr[-1000:]


PLAN = """
title = "A few frames"
[[method]]
name = "points"
settings = { "method.surface" = false, "method.graph" = false }
[quick]
seeds = [0]
sequence = [{ name = "synthetic/crossing", objects = ["box"], stop = 4 }]
[full]
seeds = [0]
sequence = [{ name = "synthetic/crossing" }]
"""


def test_a_benchmark_is_run_and_its_tables_are_written(folder):
    (folder / "few.toml").write_text(PLAN)
    assert "1 done, 0 failed" in p2p(folder, "benchmark", "few.toml", "--quick", "--out", "b", "--quiet", "--jobs", 1)
    assert r"\begin{tabular}" in (folder / "b/few-quick/table.tex").read_text()


#: The first frames of a scenario: all take as long as everything else here.
SHORT = """
from functools import partial
from p2p_lib.synthetic import SCENARIOS
SCENARIOS["mug"] = partial(SCENARIOS["mug"], frames=12)
"""


def test_synthetic_sequences_are_rendered_and_played_as_a_camera(folder, monkeypatch):
    monkeypatch.setenv("P2P_CACHE", str(folder / "cache"))
    assert "Written to mug" in p2p(folder, "synth", "mug", "--out", "mug", before=SHORT)
    assert "Nothing is wrong" in p2p(folder, "check", "mug")
    prompts = '{"objects": [{"name": "mug", "frame": 0, "points": [[320, 240]]}]}'
    (folder / "prompts.json").write_text(prompts)
    lines = p2p(folder, "live", "--camera", "folder:mug", "--prompts", "prompts.json", "--stop", 3).splitlines()
    assert len(lines) >= 1 and '"object": "mug"' in lines[0]


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        ("view run --no-browser", "view"),
        ("film run --out film.mp4", "view"),
        ("notebooks --only 03", "notebooks"),
        ("figures", "notebooks"),
        ("convert recording.bag --out converted", "ros"),
        ("live --camera realsense", "realsense"),
        ("convert recording.mkv --out converted", "open3d"),
        ("export run --format model --out models", "open3d"),
        ("export run --format foundationpose --out demo", "open3d"),
        ("run synthetic/crossing --stop 2 --device cuda --out cuda --quiet", "torch"),
        ("run synthetic/crossing --stop 2 --masks sam2 --out sam2 --quiet", "sam2"),
        ("benchmark trackers --quick --scheduler tcp://127.0.0.1:1 --out b --quiet", "dask"),
    ],
)
def test_what_an_extra_lacks_is_one_line_with_the_command(folder, words, extra):
    (folder / "recording.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    (folder / "recording.mkv").write_bytes(bytes(100))
    ran = light(COMMAND, folder, *words.split())
    (line,) = ran.stderr.strip().splitlines()
    assert ran.returncode == 2 and re.search(rf'pip install "p2p_lib\[{extra}\]"$', line), line


def test_every_extra_is_known_and_said():
    declared = set(PYPROJECT["optional-dependencies"]) - {"all", "dev"}
    assert declared == set(EXTRAS)
    (everything,) = map(Requirement, PYPROJECT["optional-dependencies"]["all"])
    assert everything.extras == declared - {"sam2", "sam2-video"}
    page = (PROJECT / "environment.md").read_text()
    (row,) = re.findall(r"(?m)^\| `open3d` \| .*", page)
    written = dict(re.findall(r"(?m)^\| `([\w-]+)` \| (a .*)", (PROJECT / "docs/models_and_labels.md").read_text()))
    for product in {*PRODUCTS} - {"bop-dataset"}:  # what has a textured model
        assert all(product in said for said in (EXTRAS["open3d"], row)), product
        assert "Needs the extra `open3d`" in written[product]
    assert not [name for name in declared if f"`{name}`" not in page]
