"""Is every mechanism held by a test? Each is switched off in a copy of the project, and its test has to fail.

    python tools/mutants.py [NAME ...]      (all mechanisms that name a test where none is given)

The mechanisms are those of ``benchmarks/mechanisms.toml``. A mutant is killed where its test fails, survives where it
passes. Ends with exit code 1 where one survives, 2 where an entry does not fit: its text is not found once, or its test
does not pass without it or does not run with it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MECHANISMS = ROOT / "benchmarks" / "mechanisms.toml"
#: What tests need of the project.
COPIED = ("p2p_lib", "data_manifests", "notebooks", "tests", "pyproject.toml")
PASSED, FAILED = 0, 1


class DoesNotFit(Exception):
    """An entry of the list that says nothing about the library as it is."""


def read_mechanisms(names: list[str], path: Path = MECHANISMS) -> list[dict[str, str]]:
    """The entries of these names, all where there are none; :class:`DoesNotFit` for a name that is not there once."""
    entries = tomllib.loads(path.read_text(encoding="utf-8"))["mechanism"]
    known = {entry["name"]: entry for entry in entries}
    if len(known) < len(entries):
        twice = next(entry["name"] for entry in entries if known[entry["name"]] is not entry)
        raise DoesNotFit(f"{path.name} has two mechanisms {twice!r}")
    if unknown := [name for name in names if name not in known]:
        raise DoesNotFit(f"{path.name} has no mechanism {unknown[0]!r}")
    return [known[name] for name in names or known]


def switch_off(mechanism: dict[str, str], root: Path) -> None:
    """Change the one text in the library below ``root``; :class:`DoesNotFit` where it is not there exactly once."""
    file = root / mechanism["file"]
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    if (times := text.count(mechanism["find"])) != 1:
        raise DoesNotFit(f"{mechanism['name']}: its text is {times} times in {mechanism['file']}")
    file.write_text(text.replace(mechanism["find"], mechanism["replace"]), encoding="utf-8")


def run_tests(tests: list[str], mechanism: dict[str, str] | None = None) -> tuple[int, str]:
    """Exit code and output of pytest on these tests in a copy of the project, with the mechanism switched off."""
    with tempfile.TemporaryDirectory() as scratch:
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
            copy(ROOT / name, Path(scratch) / name)
        if mechanism is not None:
            switch_off(mechanism, Path(scratch))
        command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *tests]
        environment = os.environ | {"PYTHONPATH": scratch}
        done = subprocess.run(command, cwd=scratch, env=environment, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def judge(mechanism: dict[str, str]) -> tuple[str, float]:
    """What became of one mutant, and after how many seconds."""
    start = time.perf_counter()
    try:
        code, output = run_tests([mechanism["test"]], mechanism)
    except DoesNotFit as error:
        return str(error), 0.0
    verdict = {PASSED: "survived", FAILED: "killed"}.get(code)
    return verdict or f"its test does not run: {output.strip().splitlines()[-1]}", time.perf_counter() - start


def main(names: list[str]) -> int:
    """Every mutant's line, then how many were killed; the exit code."""
    try:
        mechanisms = [entry for entry in read_mechanisms(names) if entry["test"] or names]
    except DoesNotFit as error:
        print(error)
        return 2
    if without := [entry["name"] for entry in mechanisms if not entry["test"]]:
        print(f"no test is named for {', '.join(without)}")
        return 2
    code, output = run_tests(sorted({entry["test"] for entry in mechanisms}))
    if code != PASSED:
        print(f"{output}\nThe tests do not pass as the library is: nothing can be said of the mutants.")
        return 2
    verdicts = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for entry, (verdict, seconds) in zip(mechanisms, pool.map(judge, mechanisms), strict=True):
            print(f"{verdict:9} {seconds:5.1f} s  {entry['name']}  ({entry['test']})", flush=True)
            verdicts.append(verdict)
    print(f"{verdicts.count('killed')} of {len(verdicts)} mutants are killed")
    return 2 if set(verdicts) - {"killed", "survived"} else int("survived" in verdicts)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
