"""Where things live: what the environment says, else the user's own folders."""

from pathlib import Path

import p2p_lib
from p2p_lib.core import paths


def test_the_project_is_the_checkout():
    assert Path(p2p_lib.__file__).parent.parent == paths.PROJECT


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("P2P_CACHE", "~/mine")
    assert paths.cache_dir() == tmp_path / "mine"
    monkeypatch.setenv("P2P_CACHE", "")
    assert paths.cache_dir() == tmp_path / "xdg" / "p2p"
    monkeypatch.delenv("P2P_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert paths.cache_dir() == tmp_path / ".cache" / "p2p"


def test_data_is_where_the_environment_says_or_nowhere(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("P2P_DATA", "~/datasets")
    assert paths.data_dir() == tmp_path / "datasets"
    monkeypatch.setenv("P2P_DATA", "")
    assert paths.data_dir() is None
    monkeypatch.delenv("P2P_DATA")
    assert paths.data_dir() is None


def test_asking_makes_no_folders(monkeypatch, tmp_path):
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "cache"))
    paths.cache_dir()
    assert not list(tmp_path.iterdir())


def test_results_of_benchmarks_are_beside_the_project_unless_quick(monkeypatch, tmp_path):
    monkeypatch.setenv("P2P_RUNS", str(tmp_path))
    assert paths.benchmark_dir("quick") == tmp_path / "benchmark"
    assert paths.benchmark_dir("full") == paths.PROJECT / "out" / "benchmark"
    assert paths.benchmark_dir("quick", "out/mine") == paths.PROJECT / "out" / "mine", "wherever the notebook runs"
    assert paths.benchmark_dir("full", str(tmp_path / "far")) == tmp_path / "far"
