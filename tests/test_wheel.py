"""The wheel in a clean environment does what the checkout does: the first commands of the README, from elsewhere."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

from p2p_lib.core.compiled import warm_up
from p2p_lib.core.paths import cache_dir
from p2p_lib.datasets.runs import load_run
from p2p_lib.run import run

PROJECT = Path(__file__).resolve().parents[1]
SOURCES = ("p2p_lib", "data_manifests", "pyproject.toml", "README.md", "LICENSE")
FRAMES = 6


def ran(*words: object, code: int = 0, **more) -> str:
    """What a program prints, or says on standard error where it is to end with another code."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=1800, **more)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stderr if code else done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy, so that nothing is left in the checkout; without git, as an archive is."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        copy = shutil.copytree if (PROJECT / name).is_dir() else shutil.copy
        copy(PROJECT / name, folder / name)
    return folder


def built(source: Path, out: Path) -> Path:
    """The wheel of a folder or an archive."""
    ran(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", out, source)
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory) -> Path:
    return built(source, tmp_path_factory.mktemp("wheel"))


def with_what_is_compiled(installed: Path) -> None:
    """Inner loops of the same files, at the same times, as this checkout has them: anew they take half a minute."""
    warm_up()
    for path in (PROJECT / "p2p_lib").rglob("*.nb[ic]"):
        to = installed / path.relative_to(PROJECT / "p2p_lib")
        to.parent.mkdir(exist_ok=True)
        shutil.copy(path, to)
        source = path.parents[1] / f"{path.name.partition('.')[0]}.py"
        os.utime(to.parents[1] / source.name, ns=2 * (source.stat().st_mtime_ns,))


@pytest.fixture(scope="module")
def p2p(wheel, tmp_path_factory):
    """Runs a program in an environment with the packages of this one but this project from the wheel."""
    home = tmp_path_factory.mktemp("clean")
    ran(sys.executable, "-m", "venv", "--without-pip", home / "env")
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "P2P_", "VIRTUAL_ENV"))}
    env |= {"P2P_CACHE": str(cache_dir()), "OMP_NUM_THREADS": "1"}
    (home / "empty").mkdir()
    site = ran(home / "env/bin/python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", env=env).strip()
    # Where a .pth file of its own installs a checkout it does not count in a folder that is named like this.
    (Path(site) / "packages.pth").write_text(sysconfig.get_path("purelib") + "\n")
    ran(
        sys.executable,
        "-m",
        "pip",
        "--python",
        home / "env/bin/python",
        "install",
        "-q",
        "--no-deps",
        "--no-index",
        wheel,
    )
    with_what_is_compiled(Path(site) / "p2p_lib")
    return lambda *words, code=0: ran(
        home / "env" / "bin" / words[0], *words[1:], code=code, cwd=home / "empty", env=env
    )


def test_the_wheel_has_all_that_is_no_source(wheel):
    listed = zipfile.ZipFile(wheel).namelist()
    ours = [path for path in (PROJECT / "p2p_lib").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert {str(path.relative_to(PROJECT)) for path in ours} <= set(listed)
    manifests = {str(path.relative_to(PROJECT)) for path in (PROJECT / "data_manifests").rglob("*.json")}
    assert manifests <= {name.partition("share/p2p_lib/")[2] for name in listed}


def test_the_wheel_requires_what_tracks_and_holds_nothing_of_the_notebooks(wheel):
    with zipfile.ZipFile(wheel) as whole:
        listed = whole.namelist()
        said = message_from_bytes(whole.read(next(name for name in listed if name.endswith(".dist-info/METADATA"))))
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    required = {Requirement(need).name for need in said.get_all("Requires-Dist") if "extra ==" not in need}
    assert required == {Requirement(need).name for need in project["dependencies"]}
    assert set(said.get_all("Provides-Extra")) == set(project["optional-dependencies"])
    assert not [name for name in listed if "studies" in name or name.endswith(".ipynb")]


def test_the_sdist_makes_the_same_wheel(source, wheel, tmp_path):
    """As ``make release`` builds it; what it lacks the wheel of it lacks, and it has its readme and licence."""
    code = "import sys; from setuptools.build_meta import build_sdist; print(build_sdist(sys.argv[1]))"
    sdist = tmp_path / ran(sys.executable, "-c", code, tmp_path, cwd=source).splitlines()[-1]
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"README.md", "LICENSE", "pyproject.toml"} <= names

    def held(path: Path) -> dict[str, int]:
        return {info.filename: info.CRC for info in zipfile.ZipFile(path).infolist() if "RECORD" not in info.filename}

    assert held(built(sdist, tmp_path / "wheel")) == held(wheel)


def test_commands_of_a_clone_say_that_they_need_one(p2p):
    for command in (("notebooks", "--only", "03"), ("figures",)):
        said = p2p("p2p", *command, code=2)
        assert said.splitlines() == [
            f"p2p {command[0]}: notebooks: they are not part of the installed package. "
            "Clone the repository and call this inside it (papermill: --cwd CLONE/notebooks)."
        ]


def test_the_first_commands_of_the_readme(p2p, tmp_path):
    where = p2p("python", "-c", "import p2p_lib; print(p2p_lib.__file__)").strip()
    assert "/clean" in where and not Path(where).is_relative_to(PROJECT)
    words = ["--masks", "clicks", "--stop", FRAMES, "--quiet"]
    said = p2p("p2p", "run", "synthetic/crossing", "--out", "out/crossing", *words)
    out = Path(where).parents[5] / "empty" / "out" / "crossing"
    assert f"{FRAMES} of {FRAMES} frames" in said and "ADD-S" in said
    here = run("synthetic/crossing", tmp_path / "here", masks="clicks", stop=FRAMES, progress=False)
    mine, theirs = load_run(here.path).objects, load_run(out).objects
    assert mine.keys() == theirs.keys() and all(mine[name].has_pose.any() for name in mine)
    for name in mine:
        np.testing.assert_array_equal(mine[name].T_cam_obj, theirs[name].T_cam_obj)
        mesh = f"meshes/{name}.ply"
        assert (here.path / mesh).read_bytes() == (out / mesh).read_bytes()
    assert json.loads(p2p("p2p", "eval", "out/crossing", "--json"))["mean"]["adds_auc"] > 50
    assert "view.html" in p2p("p2p", "view", "out/crossing", "--no-browser")
    assert "ycbineoat" in p2p("p2p", "data", "list") and "320x240" in p2p("p2p", "benchmark", "--list", "runtime")
