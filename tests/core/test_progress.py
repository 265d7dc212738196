"""A bar where there is a terminal, one line where there is none, silence where it was asked for."""

import sys

from p2p_lib.core.progress import progress_bar


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
