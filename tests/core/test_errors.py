"""Messages of one line that name the thing, what came, what was expected, what to do."""

import pickle

import numpy as np
import pytest

from p2p_lib.core.depth import check_metres
from p2p_lib.core.errors import BadInput, Doubt, Doubts, MissingBackend, MissingData, P2PError, did_you_mean
from p2p_lib.core.types import Frame

EVERY = [
    BadInput("depth", "3x2", "640x480", "Register it first."),
    MissingData("cam_K.txt", "no such file", "Write one."),
    MissingBackend("tapir", "package tapnet is missing", "pip install tapnet"),
]


@pytest.mark.parametrize("error", EVERY, ids=lambda e: type(e).__name__)
def test_everything_that_can_be_mended_is_one_family(error):
    assert isinstance(error, P2PError) and error.exit_code == 2
    assert str(error) == error.args[0] and "\n" not in str(error)
    assert error.fix in str(error)


def test_each_is_also_what_python_calls_it():
    for error, kind in zip(EVERY, (ValueError, FileNotFoundError, ImportError)):
        assert isinstance(error, kind)


def test_a_doubt_names_the_line_that_called_the_library():
    frame = Frame(0, 0.0, np.zeros((8, 8, 3), np.uint8), np.where(np.arange(64) < 20, 1, 99).reshape(8, 8) / 1.0)
    with pytest.warns(Doubt) as said:
        check_metres(frame)
    assert said[0].filename == __file__


def test_bad_input_says_name_got_expected_fix():
    error = EVERY[0]
    assert str(error) == "depth: got 3x2, expected 640x480. Register it first."
    assert (error.name, error.got, error.expected, error.fix) == ("depth", "3x2", "640x480", "Register it first.")
    assert str(BadInput("seed", 1.5, "a whole number")) == "seed: got 1.5, expected a whole number"


def test_missing_data_says_where_and_how_to_mend():
    assert str(EVERY[1]) == "cam_K.txt: no such file. Write one."
    assert str(MissingData("cam_K.txt", "no such file")) == "cam_K.txt: no such file"


def test_missing_backend_names_the_backend_and_the_command():
    error = EVERY[2]
    assert str(error) == "tapir: package tapnet is missing. pip install tapnet"
    assert error.name == "tapir" and error.missing == "package tapnet is missing"


def test_messages_with_line_breaks_become_one_line():
    assert str(BadInput("file", "first\nsecond", "one\n  line")) == "file: got first second, expected one line"
    assert str(MissingBackend("a", "b\nc", "d\ne")) == "a: b c. d e"
    assert "\n" not in str(MissingData("a\nb", "c", "d\n"))


@pytest.mark.parametrize("error", EVERY, ids=lambda e: type(e).__name__)
def test_errors_cross_process_borders(error):
    """A worker process hands its error to the parent as a pickle."""
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error) and str(again) == str(error)


@pytest.mark.parametrize(("word", "meant"), [("sed", "SEED"), ("Seeed", "SEED"), ("Bxo", "box"), ("zzz", None)])
def test_what_is_meant_is_found_in_capitals_and_without(word, meant):
    assert did_you_mean(word, ["SEED", "box"], "of.") == (f"Did you mean of.{meant}?" if meant else "")
    assert did_you_mean("box", ["SEED", "box"]) == "", "what came is no better a second time"


def test_doubts_that_differ_in_numbers_are_one_but_not_those_of_other_names():
    doubts = Doubts()
    names = ("object_1", "object_2")
    told = [doubts.add(Doubt(f"mask of {name!r} in frame {k}", name)) for k in range(3) for name in names]
    assert told == [True, True, False, False, False, False]
    assert [str(of) for of in doubts] == [f"mask of 'object_{k}' in frame 0 (2 more like it)" for k in (1, 2)]
    assert doubts.more == [f"2 more like: mask of 'object_{k}' in frame N" for k in (1, 2)]
    assert tuple(of.object for of in doubts) == names
    doubts.add(Doubt("once"))
    assert str(list(doubts)[-1]) == "once" and len(doubts.more) == 2
