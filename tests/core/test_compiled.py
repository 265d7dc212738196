"""Compiled functions: the same as in Python, of whatever else is compiled in their file, and wherever the file lies."""

import ast
import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from p2p_lib.core.compiled import LOOPS, LOOPS_IN_BACKGROUND, uninterrupted, warm_up
from p2p_lib.core.paths import PROJECT
from p2p_lib.datasets.runs import load_run

FILE = '''
import numpy as np
from p2p_lib.core.compiled import compiled

@compiled()
def square(x):
    """Of x."""
    return x * x

@compiled("f8[::1]")
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
    def ask(code=CODE, **environment):
        (tmp_path / "loops.py").write_text(FILE)
        paths = os.pathsep.join([str(tmp_path), *sys.path])
        surroundings = {**os.environ, "PYTHONPATH": paths, **environment}
        ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=surroundings)
        assert not ran.returncode, ran.stderr
        return ran.stdout.strip()

    return ask


def test_a_function_is_compiled_once_when_it_is_called_and_kept(ask, tmp_path):
    assert ask() == "False Of x. 5.0 5.0"
    assert list((tmp_path / "__pycache__").glob("loops.norm*.nbc"))


def test_what_was_made_ready_is_there_for_who_calls_it_in_another_process(ask, tmp_path):
    ask("import loops; from p2p_lib.core import compiled; compiled._ready('loops')")
    (kept,) = (tmp_path / "__pycache__").glob("loops.norm*.nbc")
    before = kept.stat().st_mtime_ns
    assert ask() == "False Of x. 5.0 5.0"
    assert list(kept.parent.glob("loops.norm*.nbc")) == [kept] and kept.stat().st_mtime_ns == before


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


WARM = """
import sys
import time
from collections import Counter

import p2p_lib
from p2p_lib.core import compiled
from p2p_lib.run import run


def known():
    return {key: set(function.signatures) for key, function in loops.items()}


def counted(name, function):
    def call(*args):
        calls[name] += 1
        return function(*args)
    return call


p2p_lib.warm_up()
loops = {(module, name): vars(sys.modules[module])[name] for module, name in compiled._arguments}
ready, calls = known(), Counter()
declared = [key for key, arguments in compiled._arguments.items() if arguments]
for module, name in declared:
    vars(sys.modules[module])[name] = counted(name, loops[module, name])
slowest_s, step = [0.0], p2p_lib.Point2Pose.step


def timed(*args):
    # Of all threads: a step waits for its own. Other programs make it wait, too, and do not count.
    start_s = time.process_time()
    estimates = step(*args)
    slowest_s[0] = max(slowest_s[0], time.process_time() - start_s)
    return estimates


p2p_lib.Point2Pose.step = timed
for n, (sequence, stop) in enumerate((("synthetic/crossing", 30), (sys.argv[2], None))):
    run(sequence, f"{sys.argv[1]}/{n}", masks=("first", "dataset")[n], progress=False, stop=stop)
print([key for key, now in known().items() if now != ready[key]], [name for _, name in declared if not calls[name]])
print(*slowest_s)
"""
AGAIN = "import p2p_lib; said = []; p2p_lib.warm_up(said.append); print(p2p_lib.__file__, len(said))"


def test_once_warmed_up_nothing_is_compiled_or_loaded_in_any_frame(tmp_path, opening):
    """With absences, returns, the scene's search and a second map, which call every function that is declared.

    And no step takes above a second: of processor time, since other programs may keep both cores. A function that is
    compiled in one takes several.
    """
    turning = opening("other_side", range(60, 216, 4))
    words = [sys.executable, "-c", WARM, str(tmp_path), str(turning.path)]
    ran = subprocess.run(words, capture_output=True, text=True)
    assert not ran.returncode, ran.stderr
    late, slowest_s = ran.stdout.strip().splitlines()
    assert late == "[] []"
    assert 0 < float(slowest_s) <= 1
    assert load_run(tmp_path / "1", every_map=True).objects["box"].map_id.max() == 1, "and a second map was begun"


def test_what_is_missing_is_compiled_again_and_said(tmp_path):
    """Whichever it is. In a copy, which has what was compiled here."""
    warm_up()
    copy = shutil.copytree(PROJECT / "p2p_lib", tmp_path / "p2p_lib")
    surroundings = {**os.environ, "PYTHONPATH": str(tmp_path)}
    for lost, lines in ((), 0), ((LOOPS[1],), 1), ((), 0), ((LOOPS_IN_BACKGROUND[-1],), 1):
        for module in lost:
            places = [file for file in copy.rglob("*.nbi") if file.name.startswith(module.rpartition(".")[2] + ".")]
            assert places
            for file in places:
                file.unlink()
        ran = subprocess.run(
            [sys.executable, "-c", AGAIN], capture_output=True, text=True, env=surroundings, cwd=tmp_path
        )
        assert ran.stdout.split() == [str(copy / "__init__.py"), str(lines)], (lost, ran.stderr)


def slow_to_compile(function: ast.FunctionDef) -> list[int]:
    """Lines of a function that take numba seconds: an array assigned to a slice, np.partition."""
    lines = []
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and not isinstance(node.value, ast.Constant):
            targets = [e for t in node.targets for e in (t.elts if isinstance(t, ast.Tuple) else [t])]
        else:
            targets = [node.target] if isinstance(node, ast.AugAssign) else []
        sliced = any(isinstance(part, ast.Slice) for t in targets for part in ast.walk(t))
        if sliced or (isinstance(node, ast.Attribute) and node.attr == "partition"):
            lines.append(node.lineno)
    return lines


def test_compiled_functions_hold_nothing_that_takes_seconds_to_compile():
    for text, slow in (
        ("a[:3], b = c, d", [1]),
        ("a[:] = 1.0", []),
        ("a[:, 2] *= b", [1]),
        ("np.partition(a, 2)", [1]),
    ):
        assert slow_to_compile(ast.parse(text)) == slow
    for path in (PROJECT / "p2p_lib").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            marks = [ast.unparse(d) for d in getattr(node, "decorator_list", ())]
            if any(mark.startswith("compiled(") for mark in marks):
                assert not slow_to_compile(node), f"{path}: {node.name}"


def test_every_file_with_compiled_functions_is_warmed_up():
    files = (PROJECT / "p2p_lib").rglob("*.py")
    have = {
        str(p.relative_to(PROJECT).with_suffix("")).replace("/", ".") for p in files if "\n@compiled" in p.read_text()
    }
    assert have == {*LOOPS, *LOOPS_IN_BACKGROUND}
