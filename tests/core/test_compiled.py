"""Compiled functions: the same as in Python, of whatever else is compiled in their file, and wherever the file lies."""

import os
import subprocess
import sys

import pytest

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
