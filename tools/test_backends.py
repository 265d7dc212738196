"""Runs the adapters of third-party networks against the official classes, with random weights: ``make test-backends``.

In an environment of its own, ``.venv-backends``: what ``.venv`` has, and on top of it the packages that the adapters
ask for, so that ``.venv`` stays as the lock has it. No weights are fetched. A test that is skipped counts as failed.

P2P_TAPNET, P2P_COTRACKER  a folder or URL to install these from, instead of GitHub
"""

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV, HOME = ROOT / ".venv-backends", ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
TESTS = ("tests/trackers/test_official.py", "tests/segmenters/test_sam2_video.py", "tests/detectors/test_superpoint.py")
TORCHVISION = "torchvision==0.28.0"
#: Without their dependencies: those of tapnet's JAX version are gigabytes that the PyTorch version does not use.
ALONE = {
    "tapnet": os.environ.get("P2P_TAPNET", "git+https://github.com/google-deepmind/tapnet"),
    "cotracker": os.environ.get("P2P_COTRACKER", "git+https://github.com/facebookresearch/co-tracker"),
}
#: With what the adapters were last run.
TRIED = {
    "transformers": "5.24.0",
    "torchvision": "0.28.0",
    "tapnet": "0.1.0 at c2cbab8 (July 2026)",
    "co-tracker": "3.0 at 82e02e8 (January 2025)",
}
WHOLE = ("transformers", "einshape", "dm-tree", "einops")


def on_top_of_venv(folder):
    """An environment in this folder, made where it is not there, that has all that .venv has and takes more."""
    if not (folder / "bin/python").exists():
        base = subprocess.check_output(
            [HOME / "bin/python", "-c", "import sys; print(sys._base_executable)"], text=True
        )
        subprocess.run([base.strip(), "-m", "venv", "--clear", "--without-pip", folder], check=True)
        (inner,) = folder.glob("lib/python*/site-packages")
        (outer,) = HOME.glob("lib/python*/site-packages")
        inner.joinpath("_of_venv.pth").write_text(f"import site; site.addsitedir({str(outer)!r})\n")


def install():
    """Make the environment where it is not there, and put into it what it lacks."""
    on_top_of_venv(VENV)
    uv = [HOME / "bin/uv", "pip", "install", "-q", "--python", PYTHON]
    lacking = "import importlib.util as u, sys; print(*[n for n in sys.argv[1:] if not u.find_spec(n)])"
    names = ("transformers", "einshape", "tree", "einops", *ALONE)
    missing = set(subprocess.check_output([PYTHON, "-c", lacking, *names], text=True).split())
    if missing - set(ALONE):
        subprocess.run([*uv, "-c", ROOT / "constraints.txt", *WHOLE], check=True)
    for name in missing & set(ALONE):
        subprocess.run([*uv, "--no-deps", ALONE[name]], check=True)
    install_torchvision(uv)


def install_torchvision(uv):
    """The build for the torch of .venv, from PyTorch's index; where that is out of reach, PyPI's with its own torch."""
    fits = [PYTHON, "-c", "import torchvision.ops"]
    if subprocess.run(fits, capture_output=True).returncode:
        subprocess.run([*uv, "--no-deps", "--torch-backend=auto", TORCHVISION], capture_output=True)
    if subprocess.run(fits, capture_output=True).returncode:
        print("p2p: that index cannot be reached; PyPI's torchvision with PyPI's torch follows (4 GB)", flush=True)
        subprocess.run([*uv, "--reinstall", TORCHVISION, "-c", ROOT / "pins.txt"], check=True)


def versions():
    """Of each package the version that is installed there, and the one with which its adapters were last run."""
    folders = [str(folder) for home in (VENV, HOME) for folder in home.glob("lib/python*/site-packages")]
    said = {}
    for package, tried in TRIED.items():
        found = metadata.distributions(name=package.replace("co-tracker", "cotracker"), path=folders)
        here = next((distribution.version for distribution in found), "not installed")
        said[package] = f"{here}; last run with {tried}"
    return said


def main():
    if not (HOME / "bin/python").exists():
        sys.exit("p2p: .venv is not there. Run: make setup")
    try:
        install()
    except subprocess.CalledProcessError as error:
        fix = "Where GitHub is out of reach, set P2P_TAPNET and P2P_COTRACKER to folders with their sources."
        sys.exit(f"p2p: {' '.join(map(str, error.cmd[-2:]))} could not be installed. {fix}")
    print("\n".join(f"{package}: {version}" for package, version in versions().items()), flush=True)
    pytest = [PYTHON, "-m", "pytest", "-W", "ignore::DeprecationWarning", *TESTS, *sys.argv[1:]]
    sys.exit(subprocess.run(pytest, cwd=ROOT, env={**os.environ, "P2P_NO_SKIPS": "1"}).returncode)


if __name__ == "__main__":
    main()
