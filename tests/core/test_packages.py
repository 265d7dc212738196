"""The commands that add what is missing: they work where they are read."""

import subprocess
import sys
from pathlib import Path

import pytest

from p2p_lib.core import packages


@pytest.fixture
def installed(tmp_path, monkeypatch) -> Path:
    """An environment with a Python, uv and pip in the working folder, whose pip is not the one on the path."""
    for name in ("python", "uv", "pip"):
        (tmp_path / ".venv/bin").mkdir(parents=True, exist_ok=True)
        (tmp_path / ".venv/bin" / name).symlink_to(sys.executable)
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv/bin/python"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_is_found_from_the_folder_in_which_it_is_read(installed, monkeypatch):
    template = "{uv} and {pip} and {python}"
    assert packages.command(template) == ".venv/bin/uv and .venv/bin/python -m pip and .venv/bin/python"
    for folder in (installed / ".venv", installed / "elsewhere"):
        folder.mkdir(exist_ok=True)
        monkeypatch.chdir(folder)
        uv, _, pip, *_ = packages.command(template).split()
        for program in (uv, pip):
            subprocess.run([program, "-c", "pass"], check=True, cwd=folder)
    assert uv == str(installed / ".venv/bin/uv")
