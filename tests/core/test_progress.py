"""A bar where there is a terminal, one line where there is none, silence where it was asked for."""

import sys

from p2p_lib.core.progress import progress_bar, waiting_for
from p2p_lib.synthetic import SCENARIOS
from p2p_lib.synthetic.generate import write_scenario
from p2p_lib.synthetic.noise import Sensor
from tests.fixtures.terminal import left_on_it, shown_on_a_terminal


def count(n, **options):
    with progress_bar("things", n, unit="thing", **options) as bar:
        for k in range(n):
            bar.set_postfix_str(f"at {k}", refresh=False)
            bar.update()


def test_without_a_terminal_it_is_one_line(capsys):
    count(500)
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "\r" not in err
    assert "things" in err and "500/500" in err and "at 499" in err


def test_to_have_imported_the_packages_of_notebooks_is_not_to_be_in_one(capsys):
    import ipykernel.zmqshell  # noqa: F401

    count(5)
    assert "\r" not in capsys.readouterr().err


def test_a_terminal_gets_a_bar(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    count(3)
    assert "\r" in capsys.readouterr().err


def test_silence(capsys, monkeypatch):
    count(3, shown=False)
    monkeypatch.setenv("P2P_PROGRESS", "off")
    count(3)
    assert capsys.readouterr() == ("", "")


def test_what_breaks_off_says_how_far_it_came(capsys):
    try:
        with progress_bar("things", 10) as bar:
            bar.update(4)
            raise RuntimeError
    except RuntimeError:
        pass
    assert "4/10" in capsys.readouterr().err


def test_a_terminal_that_says_no_size_gets_a_bar():
    code = "from p2p_lib.core.progress import progress_bar\nwith progress_bar('things', 3) as bar: bar.update(2)"
    assert "67%" in (shown := shown_on_a_terminal("-c", code)) and "2/3" in shown and "█" in shown


def test_rendering_has_its_bar_from_the_first_frame_on(tmp_path):
    code = "from p2p_lib.synthetic import scenario_dir\nscenario_dir('crossing', frames=2, progress={})"
    shown = shown_on_a_terminal("-c", code.format(True), P2P_CACHE=str(tmp_path / "a"))
    assert "rendering synthetic/crossing:   0%" in shown and "| 0/2 " in shown
    assert shown_on_a_terminal("-c", code.format(False), P2P_CACHE=str(tmp_path / "b")) == ""


def test_rendering_in_a_pipe_is_one_line(tmp_path, capsys):
    write_scenario(tmp_path / "s", SCENARIOS["crossing"](0, frames=2), Sensor(), 0, "rendering crossing", True)
    err = capsys.readouterr().err
    assert err.startswith("rendering crossing: 100%") and "2/2" in err and err.count("\n") == 1 and "\r" not in err


def test_what_is_waited_for_is_said_at_once(capsys):
    with waiting_for("Reading"):
        assert capsys.readouterr().err == "Reading ...\n"
    with progress_bar("things", 1, first="First thing") as bar:
        assert capsys.readouterr().err == "First thing ...\n"
        bar.update()
    assert capsys.readouterr().err.count("\n") == 1
    with waiting_for("Reading", shown=False), progress_bar("things", 1, first="First thing", shown=False):
        pass
    assert capsys.readouterr().err == ""


def test_on_a_terminal_it_is_a_line_that_makes_room_and_goes_away():
    code = """from p2p_lib.apps.command_line import warn
from p2p_lib.core.progress import progress_bar, waiting_for
with waiting_for("Reading"):
    warn("a doubt")
with progress_bar("things", 1, first="First thing"):
    pass
"""
    shown = shown_on_a_terminal("-c", code)
    doubt, bar, end = left_on_it(shown)
    assert "Reading ..." in shown and doubt == "a doubt"
    assert bar.startswith("things:") and "First thing" in bar and end == ""
