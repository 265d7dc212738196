"""Sets the project up in .venv beside this file's folder. Standard library only; needs Python 3.11 to 3.13 with venv.

    python3 tools/bootstrap.py

P2P_PYTHON  the Python to build on (default: the one that runs this, else python3.12, 3.11, 3.13)
P2P_TORCH   auto, cpu or cuda: which build of torch (auto: cuda where nvidia-smi lists a GPU)
P2P_APT     "no" leaves the system alone even for root (default: root installs missing system libraries with apt-get)

A stamp in .venv makes the next call instant. A call that was killed half-way is begun again from an empty .venv.
"""

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / ".p2p-stamp"
# Every package with the hashes of its files, the same without, and what was chosen by hand.
LOCK, CONSTRAINTS, PINS = ROOT / "requirements.lock", ROOT / "constraints.txt", ROOT / "pins.txt"
UNFINISHED = "unfinished"
# Where Debian and Fedora keep the certificates they trust, those of a company's proxy among them.
CERTIFICATES = (Path("/etc/ssl/certs/ca-certificates.crt"), Path("/etc/pki/tls/certs/ca-bundle.crt"))
SUPPORTED = ("3.12", "3.11", "3.13")
# No "Build recommended" dialog (open3d's dash ships an old extension) and no question about news at the first start.
JUPYTER_SETTINGS = {
    "etc/jupyter/labconfig/page_config.json": '{"buildCheck": false, "buildAvailable": false}\n',
    "share/jupyter/lab/settings/overrides.json": (
        '{"@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": false}}\n'
    ),
}


def say(text):
    print(f"p2p: {text}", flush=True)


def run(*command, quiet=False, **environment):
    """Whether the command succeeded; ``quiet`` hides what it says."""
    sink = subprocess.DEVNULL if quiet else None
    words = [str(word) for word in command]
    return subprocess.run(words, env={**os.environ, **environment}, stdout=sink, stderr=sink).returncode == 0


def answer(*command):
    """What the command prints, or an empty string where there is no such command or it fails."""
    words = [str(word) for word in command]
    if not shutil.which(words[0]):
        return ""
    result = subprocess.run(words, capture_output=True, text=True)
    return result.stdout.strip() if result.returncode == 0 else ""


def supported_version(python):
    """'3.11', '3.12' or '3.13', or an empty string for any other Python."""
    version = answer(python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])")
    return version if version in SUPPORTED else ""


def base_python():
    asked = os.environ.get("P2P_PYTHON")
    own = getattr(sys, "_base_executable", sys.executable)
    for candidate in [asked] if asked else [own, *(f"python{version}" for version in SUPPORTED)]:
        if supported_version(candidate):
            return candidate
    sys.exit(f"p2p: needs Python 3.11, 3.12 or 3.13; found {asked or own}. Set P2P_PYTHON=/path/to/python3.12")


def torch_build():
    asked = os.environ.get("P2P_TORCH", "auto")
    if asked not in ("auto", "cpu", "cuda"):
        sys.exit(f"p2p: P2P_TORCH: got {asked!r}, expected auto, cpu or cuda")
    if asked != "auto":
        return asked
    return "cuda" if answer("nvidia-smi", "-L") else "cpu"


def stamp_of(root, build):
    """Where and what a finished set-up is of; anything else in the stamp means: set up again."""
    names = ("requirements.lock", "constraints.txt", "pins.txt", "pyproject.toml", "tools/bootstrap.py")
    parts = [(root / name).read_bytes() for name in names]
    return f"{root}\n{hashlib.sha256(build.encode().join(parts)).hexdigest()}"


def right_python():
    """Whether .venv runs a Python that is supported and is the version that P2P_PYTHON asks for, if it does."""
    asked = os.environ.get("P2P_PYTHON")
    return supported_version(PYTHON) == supported_version(asked or PYTHON) != ""


def create_venv():
    """An empty .venv, unless a whole one of the right Python is there."""
    stamp = STAMP.read_text().splitlines() if STAMP.exists() else [str(ROOT)]
    finished = stamp[0] == str(ROOT) and stamp[-1] != UNFINISHED
    if finished and right_python() and answer(PYTHON, "-m", "pip", "--version"):
        return
    base = base_python()
    say(f"environment in .venv on {answer(base, '-V')}")
    if not run(base, "-m", "venv", "--clear", VENV):
        package = f"python{supported_version(base)}-venv"
        sys.exit(f"p2p: this Python cannot make environments. On Debian/Ubuntu: sudo apt-get install -y {package}")


def pinned_torch():
    return next(line.split()[0] for line in PINS.read_text().splitlines() if line.startswith("torch=="))


def cpu_build():
    """Whether .venv has torch's build for the CPU."""
    return any(VENV.glob("lib/*/site-packages/torch-*+cpu.dist-info"))


def install_torch(uv, build):
    """The CPU build from pip's find-links, else this machine's build from PyTorch's index, else PyPI's by the lock."""
    torch = pinned_torch()
    if cpu_build() and build == "cpu":
        return
    if cpu_build():
        run(*uv[:2], "uninstall", *uv[3:], "torch")
    if build == "cpu":
        with tempfile.TemporaryDirectory(dir=VENV) as folder:
            pip = [PYTHON, "-m", "pip", "download", "--no-index", "--no-deps", "-d", folder, f"{torch}+cpu"]
            if run(*pip, quiet=True):
                say(f"{torch}, CPU build from pip's find-links")
                if run(*uv, "--no-deps", *Path(folder).glob("*.whl")):
                    return
    say(f"{torch}, {build} build from PyTorch's index")
    backend = {"cpu": "cpu", "cuda": "auto"}[build]  # auto: the CUDA version that fits the driver
    # Where nobody watches the download there is no need to read why it cannot be had.
    if not run(*uv, "--no-deps", f"--torch-backend={backend}", torch, quiet="-q" in uv, UV_HTTP_RETRIES="1"):
        say("that index cannot be reached; PyPI's build follows (CUDA, 2.6 GB, runs without a GPU as well)")


def locked(name):
    """The lines of a package in the lock: its version, and the hashes that its file has to have."""
    return re.search(rf"(?m)^{name}==.*(?:\n +--hash=.*)+", LOCK.read_text())[0]


def install_packages(build):
    if any(path.exists() for path in CERTIFICATES):
        os.environ.setdefault("UV_SYSTEM_CERTS", "true")
    say("installer")
    pip = [PYTHON, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    with tempfile.TemporaryDirectory(dir=VENV) as folder:
        (Path(folder) / "uv.txt").write_text(locked("uv"))
        installed = run(*pip, "--require-hashes", "--no-deps", "-r", Path(folder) / "uv.txt")
    if not installed:
        sys.exit("p2p: pip cannot install uv: is there a network, or a mirror in pip's configuration?")
    quiet = [] if sys.stderr.isatty() else ["-q"]
    uv = [VENV / "bin" / "uv", "pip", "install", *quiet, "--python", PYTHON]
    install_torch(uv, build)
    say("packages of requirements.lock")
    # Plain pip is slower and knows mirrors that are configured for pip alone.
    # The lock is whole: with --no-deps nothing comes that is not in it.
    whole = ("--require-hashes", "--no-deps", "-r", LOCK)
    if not (run(*uv, *whole) or run(*pip, *whole)):
        sys.exit("p2p: installing requirements.lock failed, see above; `make setup` tries again")
    if not cpu_build():  # the libraries of CUDA, of which torch itself names the versions
        run(*uv, "-c", CONSTRAINTS, pinned_torch()) or run(*pip, "-c", CONSTRAINTS, pinned_torch())
    if not (run(*uv, "--no-deps", "-e", ROOT) or run(*pip, "--no-deps", "-e", ROOT)):
        sys.exit("p2p: installing p2p_lib failed, see above; `make setup` tries again")
    for name, text in JUPYTER_SETTINGS.items():
        (VENV / name).parent.mkdir(parents=True, exist_ok=True)
        (VENV / name).write_text(text)


def install_system_libraries():
    """What Open3D wants of the system; never fatal, since p2p doctor and the error itself name the remedy."""
    ask = "from p2p_lib.core import native as n; print(*[n.SYSTEM_LIBRARIES[x] for x in n.missing_libraries()])"
    missing = answer(PYTHON, "-c", ask).split()
    if missing and os.geteuid() == 0 and shutil.which("apt-get") and os.environ.get("P2P_APT") != "no":
        say(f"system packages {' '.join(missing)}")
        apt = ["apt-get", "install", "-y", "-q", "--no-install-recommends", *missing]
        quietly = {"quiet": True, "DEBIAN_FRONTEND": "noninteractive"}
        if not run(*apt, **quietly):
            run("apt-get", "update", "-q", **quietly)
            run(*apt, **quietly)
    ask = "from p2p_lib.core import native as n; n.preload_libusb(); m = n.missing_libraries(); "
    remedy = answer(PYTHON, "-c", ask + "print(n.install_command(m) if m else '')")
    if remedy:
        say(f"Open3D cannot be loaded yet. To mend it: {remedy}")


def main():
    start = time.monotonic()
    build = torch_build()
    want = stamp_of(ROOT, build)
    with open(__file__) as turn:  # one set-up at a time; the others wait here and then find the stamp
        fcntl.flock(turn, fcntl.LOCK_EX)
        if STAMP.exists() and STAMP.read_text() == want and right_python():
            return
        say("setting up in .venv (once; takes a minute or two)")
        create_venv()
        STAMP.write_text(f"{ROOT}\n{UNFINISHED}")
        install_packages(build)
        install_system_libraries()
        STAMP.write_text(want)
    say(f"ready after {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
