"""Makes what a release consists of, and tries it: ``make release`` fills out/release. Nothing is published.

A commit with a tag has to be what the tag says: ``v1.2.3`` for version 1.2.3, with a dated section of CHANGELOG.md, and
tables and figures of its own code.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
UV = Path(sys.executable).with_name("uv")
#: Where the version stands besides pyproject.toml.
VERSIONS = {
    "p2p_lib/__init__.py": r'__version__ = "(.*)"',
    "CITATION.cff": r"(?m)^version: (.*)$",
    "ros2/point2pose_msgs/package.xml": r"<version>(.*)</version>",
    "ros2/point2pose_ros/package.xml": r"<version>(.*)</version>",
    "ros2/point2pose_ros/setup.py": r'version="(.*)"',
}


def problems(root, tag):
    """What keeps the files of a folder from being a release; ``tag`` is "" where the commit has none."""
    version = tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"]
    for name, form in VERSIONS.items():
        found = re.search(form, (root / name).read_text())
        if found is None or found[1] != version:
            yield f"{name}: version {found[1] if found else 'missing'}, expected {version} as in pyproject.toml"
    section = re.search(rf"(?m)^## {re.escape(version)} \((.*)\)$", (root / "CHANGELOG.md").read_text())
    if section is None:
        yield f"CHANGELOG.md: no section '## {version} (...)'"
    elif tag and not re.fullmatch(r"\d{4}-\d\d-\d\d", section[1]):
        yield f"CHANGELOG.md: section {version} is of '{section[1]}', expected a date as 2026-01-31"
    if tag and tag != f"v{version}":
        yield f"tag {tag}: expected v{version}"
    for note in sorted((root / "figures").glob("**/*.json")) if tag else ():
        if json.loads(note.read_text()).get("earlier"):
            yield f"{note.relative_to(root)}: of earlier code or an earlier plan; p2p benchmark --stale --out DIR"


def tag_of(root):
    """The tag of the commit that is checked out; "" where it has none."""
    asked = ["git", "-C", root, "describe", "--tags", "--exact-match", "--match", "v*"]
    return subprocess.run(asked, capture_output=True, text=True).stdout.strip()


def build(out):
    """Wheel and sdist; the wheel is built of the sdist, so that this one is known to be whole."""
    shutil.rmtree(out, ignore_errors=True)
    subprocess.run([UV, "build", "--quiet", "--out-dir", out, ROOT], check=True)
    return sorted(out.glob("p2p_lib-*"))


def tried(artefact, home):
    """What a clean environment with it alone says of its version, after it has tracked a few frames."""
    python = home / "bin/python"
    subprocess.run([UV, "venv", "--quiet", "--python", sys.executable, home], check=True)
    versions = ROOT / "constraints.txt"
    subprocess.run([UV, "pip", "install", "--quiet", "--python", python, "-c", versions, artefact], check=True)
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    how = {"cwd": home, "env": env, "check": True, "text": True, "stdout": subprocess.PIPE}
    subprocess.run([python.with_name("p2p"), "run", "synthetic/crossing", "--stop", "3", "--out", "run"], **how)
    return subprocess.run([python.with_name("p2p"), "--version"], **how).stdout.strip()


def main():
    """Check, build, try, and go through what publishing would do, up to the upload."""
    if wrong := list(problems(ROOT, tag_of(ROOT))):
        sys.exit("\n".join(wrong))
    artefacts = build(ROOT / "out" / "release")
    for artefact in artefacts:
        with tempfile.TemporaryDirectory() as home:
            print(f"{artefact.name}: installed alone it is {tried(artefact, Path(home))}")
    nobody = {"UV_PUBLISH_USERNAME": "nobody", "UV_PUBLISH_PASSWORD": "nothing"}
    subprocess.run([UV, "publish", "--dry-run", *artefacts], check=True, env=os.environ | nobody)


if __name__ == "__main__":
    main()
