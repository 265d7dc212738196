"""What can run here and now, and what would have to be fetched."""

import pytest

from p2p_lib.apps.readiness import overview, present_plans, readiness, what_to_fetch
from p2p_lib.benchmark import load_benchmark
from tests.fixtures.sliding_board import write_sequence


@pytest.fixture
def nothing(monkeypatch):
    monkeypatch.delenv("P2P_DATA", raising=False)


def test_a_plan_says_which_rows_can_run(nothing):
    title, ours, papers = readiness("long_range").splitlines()
    assert title.split()[0] == "long_range"
    assert ours.startswith(
        "  Ours, points alone; Ours, points alone, SH(10); Ours; Ours, SH(10): 4 of 5 sequences; else:"
    )
    assert papers.startswith(
        "  paper_full; paper_sh10: 0 of 5 sequences; else: no weights of sam2_video, superpoint, tapir. Run:"
    )


def test_missing_data_is_said_in_few_words(nothing, tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    _, ours, *_ = readiness("ho3d").splitlines()
    missing = "ho3d_v3/AP10: not below $P2P_DATA. See p2p data info ho3d_v3. (12 more likewise)"
    assert ours == f"  Ours; Ours, from clicks: 0 of 13 sequences; else: {missing}"


def test_every_kind_of_reason_is_told(nothing, tmp_path, monkeypatch):
    """Eight sequences are not there, and the ninth has a mask of its first frame alone."""
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    folder = write_sequence(tmp_path / "YCBInEOAT/mustard0", 6, 2, seed=2)
    _, *others = sorted((folder / "gt_mask").rename(folder / "masks").iterdir())
    for mask in others:
        mask.unlink()
    _, ours, *_ = readiness("ycbineoat").splitlines()
    assert "(7 more likewise); ycbineoat/mustard0: masks: there are some of the first frames alone" in ours


def test_what_is_missing_names_sequences_frames_size_and_command(nothing, tmp_path):
    (line,) = what_to_fetch(load_benchmark("ycbineoat", tmp_path))
    assert "ycbineoat/mustard0 (737 frames)" in line and "about 22 GB" in line
    assert line.endswith("p2p data fetch ycbineoat")
    (line,) = what_to_fetch(load_benchmark("ho3d", tmp_path))
    assert line.count("ho3d_v3/") == 13 and line.endswith("by hand, see p2p data info ho3d_v3")
    own, line = what_to_fetch(load_benchmark("ycbmultitrack_synthetic", tmp_path))
    assert "ycbmultitrack_synthetic/*" in own
    assert "synthetic/ycb_pitcher" in line and line.endswith("p2p data fetch ycb_models")
    assert what_to_fetch(load_benchmark("ablation_embedded", tmp_path)) == []


def test_what_is_there_and_only_not_run_yet_is_not_missing(nothing, tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    write_sequence(tmp_path / "YCBInEOAT/mustard0", 6, 2, seed=2)
    line, cut = what_to_fetch(load_benchmark("ycbineoat", tmp_path / "out"))
    assert "ycbineoat/mustard_easy_00_02" in line and "mustard0" not in line
    assert cut == "ycbineoat/mustard0: 6 of its 737 frames are here, and its rows are of these"
    assert cut in list(overview()) and readiness("ycbineoat").endswith(f"\n  {cut}")


def test_plans_whose_data_is_there_are_found(nothing, tmp_path, monkeypatch):
    assert present_plans() == []
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    write_sequence(tmp_path / "YCBInEOAT/mustard0", 6, 2, seed=2)
    assert set(present_plans()) == {"faults", "presets", "readme", "segmenters", "trackers", "ycbineoat"}
