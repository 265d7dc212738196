"""Compiled functions: the same as in Python, of whatever else is compiled in their file, and wherever the file lies."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from p2p_lib.core.compiled import uninterrupted

FILE = '''
import numpy as np
from p2p_lib.core.compiled import compiled

@compiled
def square(x):
    """Of x."""
    return x * x

@compiled
def norm(v):
    total = 0.0
    for x in v:
        total += square(x)
    return np.sqrt(total)
'''
CODE = """
import sys, numpy as np, loops
from concurrent.futures import ThreadPoolExecutor
print('numba' in sys.modules, loops.square.__doc__, *ThreadPoolExecutor(2).map(loops.norm, 2 * [np.array([3.0, 4.0])]))
"""


@pytest.fixture
def ask(tmp_path):
    def ask(**environment):
        (tmp_path / "loops.py").write_text(FILE)
        paths = os.pathsep.join([str(tmp_path), *sys.path])
        surroundings = {**os.environ, "PYTHONPATH": paths, **environment}
        ran = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, env=surroundings)
        assert not ran.returncode, ran.stderr
        return ran.stdout.strip()

    return ask


def test_a_function_is_compiled_once_when_it_is_called_and_kept(ask, tmp_path):
    assert ask() == "False Of x. 5.0 5.0"
    assert list((tmp_path / "__pycache__").glob("loops.norm*.nbc"))


def test_it_runs_where_nothing_can_be_written(ask):
    nowhere = os.devnull + "/nowhere"
    assert ask(HOME=nowhere, XDG_CACHE_HOME=nowhere, NUMBA_CACHE_LOCATOR_CLASSES="NoLocator") == "False Of x. 5.0 5.0"


def test_what_is_uninterrupted_hears_the_signal_at_its_end(ctrl_c):
    before, done = signal.getsignal(signal.SIGINT), []
    with pytest.raises(KeyboardInterrupt):
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append("all of it")
    assert done and signal.getsignal(signal.SIGINT) is before


def test_who_insists_is_heard_at_once(ctrl_c):
    went_on = False
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        went_on = True
    assert not went_on


def test_a_signal_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_another_thread_hears_no_signals():
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(uninterrupted()(lambda: 3)).result() == 3
