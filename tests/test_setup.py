"""The set-up: its lock, its stamp, its refusals. Real installations are measured in environment.md."""

import ast
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import p2p_lib

PROJECT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text())
HASHED, LOCK = ((PROJECT / name).read_text() for name in ("requirements.lock", "constraints.txt"))
REQUIRED = set("jupyterlab numpy torch opencv-python-headless gtsam open3d trimesh matplotlib pandas papermill".split())
OURS = {"p2p_lib", "studies"}
#: Import name to distribution, where they differ; and what comes as a part of another.
DISTRIBUTIONS = {
    "fast_simplification": "fast-simplification",
    "cv2": "opencv-python-headless",
    "skimage": "scikit-image",
    "PIL": "pillow",
}
PARTS = {"IPython": "jupyterlab", "jupyter_client": "jupyterlab", "nbconvert": "jupyterlab", "nbformat": "papermill"}
PARTS |= {"nbclient": "papermill", "jinja2": "jinja2"}


@pytest.fixture(scope="module")
def bootstrap(tool):
    return tool("bootstrap")


@pytest.fixture
def checkout(tmp_path):
    """What the bootstrap reads, in a folder with a space in its name."""
    folder = tmp_path / "a clone"
    (folder / "tools").mkdir(parents=True)
    for name in ("tools/bootstrap.py", "pyproject.toml", "requirements.lock", "constraints.txt", "pins.txt"):
        shutil.copy(PROJECT / name, folder / name)
    return folder


def call(checkout: Path, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, checkout / "tools" / "bootstrap.py"],
        env={"PATH": os.environ["PATH"], **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


def declared(*extras: str) -> dict[str, Requirement]:
    """What the package requires, and what these extras and those that they consist of add."""
    needs = list(map(Requirement, PYPROJECT["project"]["dependencies"])) if not extras else []
    for extra in extras:
        needs += map(Requirement, PYPROJECT["project"]["optional-dependencies"][extra])
    ours = [name for need in needs if need.name == "p2p-lib" for name in need.extras]
    return {need.name: need for need in needs if need.name != "p2p-lib"} | (declared(*ours) if ours else {})


def imported(asked_for: bool = False) -> set[str]:
    """Distributions that the package or what stands beside the notebooks imports; or also those asked for by a name."""
    modules = set()
    for path in [*(PROJECT / "p2p_lib").rglob("*.py"), *(PROJECT / "notebooks" / "studies").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules |= {name.name.split(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules.add(node.module.split(".")[0])
            elif asked_for and isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
                called = getattr(node.func, "attr", getattr(node.func, "id", ""))
                modules |= {str(node.args[0].value).split(".")[0]} if called in ("load", "import_module") else set()
    modules -= OURS | set(sys.stdlib_module_names)
    return {PARTS.get(module) or DISTRIBUTIONS.get(module, module) for module in modules}


def test_declared_is_what_is_used():
    extras = PYPROJECT["project"]["optional-dependencies"].keys() - {"dev"}
    known = declared() | declared(*extras)
    undeclared = imported() - known.keys()
    assert not undeclared, f"imported, not declared in pyproject.toml: {sorted(undeclared)}"
    idle = known.keys() - imported(asked_for=True) - {"jupyterlab", "libusb-package"}
    assert not idle, f"declared, imported nowhere: {sorted(idle)}"


def test_the_set_up_installs_what_the_project_is_built_on():
    """All of it is used above: jupyterlab by ``make lab``."""
    assert (declared() | declared("all")).keys() >= REQUIRED
    assert declared("dev").keys() >= declared("all").keys(), "what make lock resolves, and make setup installs"


def test_lock_pins_everything_declared_and_names_no_host():
    assert "://" not in LOCK and "--" not in LOCK
    pins: dict[str, list[Requirement]] = {}
    for line in LOCK.splitlines():
        pin = Requirement(line)
        assert re.fullmatch(r"==[\w.+]+", str(pin.specifier)), f"not pinned: {line}"
        pins.setdefault(pin.name, []).append(pin)
    for need in (declared() | declared("dev")).values():
        assert need.name in pins, f"{need.name}: run make lock"
        for pin in pins[need.name]:
            version = str(pin.specifier).removeprefix("==")
            assert need.specifier.contains(version), f"{need} but the lock has {version}: run make lock"


def test_the_lock_has_a_hash_for_everything_and_the_constraints_are_the_same_without():
    entries = re.findall(r"(?m)^(\S.*?)((?: \\\n    --hash=sha256:[0-9a-f]{64})*)$", HASHED)
    assert [pin for pin, _ in entries] == LOCK.splitlines()
    assert [pin for pin, hashes in entries if not hashes] == []
    assert "://" not in HASHED and set(re.findall(r"--[\w-]+", HASHED)) == {"--hash"}


def test_the_installer_is_held_by_a_hash_too(bootstrap):
    hand = [line.split()[0] for line in (PROJECT / "pins.txt").read_text().splitlines() if line.startswith("uv")]
    assert [bootstrap.locked("uv").split()[0]] == hand and bootstrap.locked("uv").count("--hash=sha256:") > 5
    assert len(re.findall(r"(?m)^\w", bootstrap.locked("uv"))) == 1


@pytest.mark.parametrize("build", ["cpu", "cuda"])
def test_everything_is_installed_by_its_hash(checkout, bootstrap, monkeypatch, build):
    """But for the libraries of CUDA, where torch is the build that needs them."""
    use(bootstrap, checkout, monkeypatch)
    (checkout / f".venv/lib/python3/site-packages/torch-2.13.0+{build}.dist-info").mkdir(parents=True)
    asked = []
    monkeypatch.setattr(bootstrap, "run", lambda *command, **_: asked.append([str(word) for word in command]) or True)
    bootstrap.install_packages(build)
    free = [
        words for words in asked if "--require-hashes" not in words and "-e" not in words and "uninstall" not in words
    ]
    assert all("--no-deps" in words for words in asked if words not in free)
    assert [words[-1] for words in free if "--no-deps" not in words] == ["torch==2.13.0"] * (build == "cuda")


def test_lock_fits_every_python():
    for version in ("3.11.7", "3.12.1", "3.13.0"):
        environment = {"python_full_version": version, "python_version": version[:4], "sys_platform": "linux"}
        fitting = [p for p in map(Requirement, LOCK.splitlines()) if not p.marker or p.marker.evaluate(environment)]
        names = [pin.name for pin in fitting]
        assert len(names) == len(set(names)) and declared().keys() <= set(names)


def test_torch_is_pinned_once_and_without_its_cuda_parts():
    hand = [line.split()[0] for line in (PROJECT / "pins.txt").read_text().splitlines() if line.startswith("torch")]
    assert hand == re.findall(r"(?m)^torch==\S+", LOCK)
    assert not re.search(r"(?m)^(nvidia-|cuda-|triton)", LOCK)


def test_wrong_python_is_refused_in_one_line(checkout):
    ended = call(checkout, P2P_PYTHON="no-such-python")
    assert ended.returncode == 1
    assert ended.stderr.startswith("p2p: needs Python 3.11, 3.12 or 3.13; found no-such-python. Set P2P_PYTHON=")
    assert not (checkout / ".venv" / "bin").exists()


def test_unknown_torch_build_is_refused(checkout):
    ended = call(checkout, P2P_TORCH="gpu")
    assert ended.returncode == 1 and "P2P_TORCH: got 'gpu', expected auto, cpu or cuda" in ended.stderr


def test_second_call_is_instant_and_changes_nothing(checkout, bootstrap):
    make_whole(checkout, bootstrap)
    before = sorted(checkout.rglob("*"))
    start = time.monotonic()
    ended = call(checkout, P2P_TORCH="cpu")
    assert ended.returncode == 0 and ended.stdout == "" and ended.stderr == ""
    assert sorted(checkout.rglob("*")) == before
    assert time.monotonic() - start < 5  # an installation takes far longer, a busy machine not


@pytest.mark.parametrize(
    "changed", ["requirements.lock", "constraints.txt", "pyproject.toml", "pins.txt", "tools/bootstrap.py"]
)
def test_a_change_sets_up_anew(checkout, bootstrap, changed):
    make_whole(checkout, bootstrap)
    with open(checkout / changed, "a") as file:
        file.write("\n")
    ended = call(checkout, P2P_TORCH="cpu", P2P_PYTHON="no-such-python")
    assert "setting up" in ended.stdout


def test_a_killed_setup_begins_anew(checkout, bootstrap, monkeypatch):
    make_whole(checkout, bootstrap)
    use(bootstrap, checkout, monkeypatch)
    monkeypatch.delenv("P2P_PYTHON", raising=False)
    monkeypatch.setattr(bootstrap, "answer", lambda *command: "3.12")
    commands = []
    monkeypatch.setattr(bootstrap, "run", lambda *command, **_: commands.append(command) or True)
    bootstrap.create_venv()
    assert commands == []  # whole: kept
    bootstrap.STAMP.write_text(f"{checkout}\n{bootstrap.UNFINISHED}")
    bootstrap.create_venv()
    assert commands[0][1:] == ("-m", "venv", "--clear", checkout / ".venv")


@pytest.mark.parametrize(
    ("links", "index", "build", "expected"),
    [
        (True, True, "cpu", ["download", "wheel"]),
        (False, True, "cpu", ["download", "cpu"]),
        (False, False, "cpu", ["download", "cpu"]),
        (True, True, "cuda", ["auto"]),
    ],
)
def test_order_in_which_torch_is_sought(checkout, bootstrap, monkeypatch, links, index, build, expected):
    use(bootstrap, checkout, monkeypatch)
    (checkout / ".venv").mkdir()
    tried = []

    def run(*command, **_):
        words = [str(word) for word in command]
        if "download" in words:
            tried.append("download")
            assert words[-1] == "torch==2.13.0+cpu" and "--no-index" in words
            if links:
                (Path(words[words.index("-d") + 1]) / "torch.whl").touch()
            return links
        backend = [word.partition("=")[2] for word in words if word.startswith("--torch-backend")]
        tried.append(backend[0] if backend else "wheel")
        return index

    monkeypatch.setattr(bootstrap, "run", run)
    bootstrap.install_torch(["uv", "pip", "install", "--python", "python"], build)
    assert tried == expected


def test_make_alone_lists_the_targets():
    make = shutil.which("make")
    if make is None:
        pytest.skip("no make on this machine")
    shown = subprocess.run(
        [make, "--no-print-directory"], cwd=PROJECT, capture_output=True, text=True, check=True
    ).stdout
    for target in ("setup", "reproduce", "test", "lab", "figures"):
        assert f"make {target}" in shown


def test_ci_calls_make_test():
    script = PROJECT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert script.read_text().splitlines()[-1] == "exec make test"


def test_a_release_is_what_its_tag_says(tool, tmp_path):
    release, version = tool("release"), PYPROJECT["project"]["version"]
    assert list(release.problems(PROJECT, "")) == []
    for name in ("pyproject.toml", "CHANGELOG.md", *release.VERSIONS):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PROJECT / name, tmp_path / name)
    log = tmp_path / "CHANGELOG.md"
    log.write_text(re.sub(rf"## {version} \(.*\)", f"## {version} (2026-01-31)", log.read_text()))
    assert list(release.problems(tmp_path, f"v{version}")) == []
    assert list(release.problems(tmp_path, "v9.9.9")) == [f"tag v9.9.9: expected v{version}"]
    (tmp_path / "figures/tables").mkdir(parents=True)
    (tmp_path / "figures/tables/runtime.json").write_text('{"earlier": true}')
    assert list(release.problems(tmp_path, "")) == []
    (old,) = release.problems(tmp_path, f"v{version}")
    assert old.startswith("figures/tables/runtime.json: of earlier code")
    (tmp_path / "figures/tables/runtime.json").write_text('{"code": "a"}')
    log.write_text(log.read_text().replace("(2026-01-31)", "(unreleased)"))
    (tmp_path / "CITATION.cff").write_text("version: 9.9.9\n")
    assert [line.split(":")[0] for line in release.problems(tmp_path, f"v{version}")] == [
        "CITATION.cff",
        "CHANGELOG.md",
    ]


def test_citation_names_the_papers_authors_and_this_version():
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((PROJECT / "CITATION.cff").read_text())
    authors = [f"{a['given-names']} {a['family-names']}" for a in citation["preferred-citation"]["authors"]]
    assert authors == ["Tzu-Yuan Lin", "Ho Jae Lee", "Kevin Doherty", "Yonghyeon Lee", "Sangbae Kim"]
    assert citation["authors"] == [{"name": "Point2Pose suite contributors"}]
    version = PYPROJECT["project"]["version"]
    assert citation["version"] == p2p_lib.__version__ == version
    assert f"## {version}" in (PROJECT / "CHANGELOG.md").read_text()
    assert citation["license"] == PYPROJECT["project"]["license"] == "BSD-3-Clause"


def use(bootstrap, checkout: Path, monkeypatch) -> None:
    """Let the imported bootstrap work on this checkout."""
    monkeypatch.setattr(bootstrap, "ROOT", checkout)
    monkeypatch.setattr(bootstrap, "VENV", checkout / ".venv")
    monkeypatch.setattr(bootstrap, "PYTHON", checkout / ".venv" / "bin" / "python")
    monkeypatch.setattr(bootstrap, "STAMP", checkout / ".venv" / ".p2p-stamp")


def make_whole(checkout: Path, bootstrap) -> None:
    """A .venv as a finished set-up for the CPU leaves it, without its packages."""
    (checkout / ".venv" / "bin").mkdir(parents=True)
    (checkout / ".venv" / "bin" / "python").symlink_to(sys.executable)
    (checkout / ".venv" / ".p2p-stamp").write_text(bootstrap.stamp_of(checkout, "cpu"))


def test_the_container_is_given_what_the_set_up_reads(bootstrap, tmp_path):
    """The steps before RUN of the recipe, followed: the set-up has its files then, and the same ones at the end."""
    recipe = (PROJECT / "tools" / "Dockerfile").read_text()
    early = recipe.partition("RUN python3 tools/bootstrap.py")[0]
    for step in re.findall(r"(?m)^COPY --chown=1000 (.*)$", early):
        *sources, to = step.split()
        (tmp_path / to).mkdir(parents=True, exist_ok=True)
        for source in map(PROJECT.joinpath, sources):
            if source.is_dir():
                shutil.copytree(source, tmp_path / to, dirs_exist_ok=True)
            else:
                shutil.copy(source, tmp_path / to)
    assert bootstrap.stamp_of(tmp_path, "cpu").split()[-1] == bootstrap.stamp_of(PROJECT, "cpu").split()[-1]
    ask = [sys.executable, "-c", "from p2p_lib.core import native; print(native.__file__)"]
    ran = subprocess.run(ask, cwd=tmp_path, capture_output=True, text=True, env={"PYTHONPATH": str(tmp_path)})
    assert Path(ran.stdout.strip()).is_relative_to(tmp_path)
    libraries = set(re.findall(r"lib\S+", early.partition("apt-get install")[2].partition("&&")[0]))
    assert libraries == set(importlib.import_module("p2p_lib.core.native").SYSTEM_LIBRARIES.values())


def test_the_workflow_runs_the_two_commands_on_every_python():
    yaml = pytest.importorskip("yaml")
    flow = yaml.safe_load((PROJECT / ".github" / "workflows" / "ci.yml").read_text())
    job = flow["jobs"]["test"]
    assert tuple(sorted(job["strategy"]["matrix"]["python"])) == tuple(sorted(("3.11", "3.12", "3.13")))
    run = [step["run"] for step in job["steps"] if "run" in step]
    assert {"make reproduce", "make test"} <= set(run)
    weekly = flow["jobs"]["weekly"]
    assert weekly["steps"][-1]["run"] == "make ${{ matrix.target }}"
    once_a_week = set(weekly["strategy"]["matrix"]["target"])
    assert once_a_week == {"test-backends", "test-ros", "figures", "seeds"}
    targets = set(re.findall(r"(?m)^([a-z-]+):", (PROJECT / "Makefile").read_text()))
    assert {line.split()[1] for line in run if line.startswith("make ")} | once_a_week <= targets
    for step in [step for job in flow["jobs"].values() for step in job["steps"]]:
        assert re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", step.get("uses", "a@" + "0" * 40)), "an action at one commit"
