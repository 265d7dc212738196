"""Type checkers find the library where it is installed to be edited, and the documents' examples are sound."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
SCRIPT = """
import p2p_lib

tracker = p2p_lib.Point2Pose(p2p_lib.open_sequence("synthetic/crossing").camera)
reveal_type(tracker)
reveal_type(p2p_lib.warm_up())
tracker.step("no frame")
tracker.add_object("mug", klicks=[[320, 240]])
tracker.correct("mug", click=[[320, 240]])
"""


def checked(script: Path, *words: str, **environment: str) -> str:
    pytest.importorskip("mypy")
    plain = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "MYPY"))}
    words = (sys.executable, "-m", "mypy", "--cache-dir", str(script.parent / "cache"), *words, str(script))
    return subprocess.run(words, capture_output=True, text=True, env=plain | environment, cwd=script.parent).stdout


@pytest.fixture(scope="module")
def edited(tmp_path_factory) -> Path:
    """The Python of an environment in which a copy of this project is installed to be edited."""
    pytest.importorskip("setuptools")
    home = tmp_path_factory.mktemp("edited")
    for name in ("p2p_lib", "data_manifests"):
        shutil.copytree(PROJECT / name, home / "clone" / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(PROJECT / name, home / "clone" / name)
    build = "import sys; from setuptools.build_meta import build_editable; print(build_editable(sys.argv[1]))"
    (home / "wheel").mkdir()
    words = [sys.executable, "-c", build, str(home / "wheel")]
    subprocess.run(words, check=True, capture_output=True, cwd=home / "clone")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home / "env")], check=True)
    (site,) = (home / "env").glob("lib/python*/site-packages")
    zipfile.ZipFile(next((home / "wheel").glob("*.whl"))).extractall(site)
    return home / "env/bin/python"


def test_a_script_sees_the_types_of_an_editable_install(edited, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    said = checked(tmp_path / "script.py", "--python-executable", str(edited), "--ignore-missing-imports")
    assert 'Revealed type is "p2p_lib.extended.default.Point2Pose"' in said
    assert (
        'Revealed type is "float"' in said.replace("builtins.", "")
        and 'Argument 1 to "step" of "Point2Pose" has incompatible type "str"' in said
    )
    for keyword, method in (("klicks", "add_object"), ("click", "correct")):
        assert f'Unexpected keyword argument "{keyword}" for "{method}"' in said
    assert "Found 3 errors" in said


def test_the_python_of_the_documents_is_sound_and_what_it_guards_against_is_reported(tmp_path):
    pages = [(PROJECT / name).read_text() for name in ("README.md", "docs/python.md")]
    blocks = re.findall(r"```python\n(.*?)```", "\n".join(pages), re.DOTALL)
    found = {}
    for name, guard in (("readme", "if model.surface is not None:"), ("unguarded", "if True:")):
        path = tmp_path / f"{name}.py"
        path.write_text("\n".join(blocks).replace("if model.surface is not None:", guard))
        found[name] = checked(path, "--strict", "--follow-imports=silent", MYPYPATH=str(PROJECT))
    assert "Success" in found["readme"]
    assert 'Item "None" of "TsdfVolume | None" has no attribute "mesh"' in found["unguarded"]
    assert "Found 1 error" in found["unguarded"]


def test_no_file_of_the_library_is_left_out():
    """And no module is let off by a section of its own."""
    mypy = tomllib.loads((PROJECT / "pyproject.toml").read_text())["tool"]["mypy"]
    assert "p2p_lib" in mypy["files"] and mypy["check_untyped_defs"] and "exclude" not in mypy
    assert not [name for of in mypy["overrides"] for name in of["module"] if name.startswith("p2p_lib")]
    ignored = [
        path for path in (PROJECT / "p2p_lib").rglob("*.py") if re.search("(?m)^# (mypy|type):", path.read_text())
    ]
    assert not ignored
