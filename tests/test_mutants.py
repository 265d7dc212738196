"""The list of mechanisms fits the library: ``make mutants`` and ``benchmarks/bench_mechanisms.py`` go by it."""

import importlib.util
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]


def load_mutants():
    spec = importlib.util.spec_from_file_location("mutants", PROJECT / "tools" / "mutants.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


mutants = load_mutants()
MECHANISMS = mutants.read_mechanisms([])


def test_a_name_that_is_there_twice_is_refused(tmp_path):
    (tmp_path / "twice.toml").write_text('[[mechanism]]\nname = "sight"\n' * 2)
    with pytest.raises(mutants.DoesNotFit, match="two mechanisms 'sight'"):
        mutants.read_mechanisms([], tmp_path / "twice.toml")


@pytest.mark.parametrize("entry", MECHANISMS, ids=lambda entry: entry["name"])
def test_an_entry_switches_one_text_off(entry, tmp_path):
    copy = tmp_path / entry["file"]
    copy.parent.mkdir(parents=True)
    copy.write_text((PROJECT / entry["file"]).read_text())
    mutants.switch_off(entry, tmp_path)
    compile(copy.read_text(), str(copy), "exec")
    with pytest.raises(mutants.DoesNotFit, match="0 times"):
        mutants.switch_off(entry | {"find": "nothing of the kind"}, tmp_path)


@pytest.mark.parametrize("entry", [e for e in MECHANISMS if e["test"]], ids=lambda entry: entry["name"])
def test_the_test_of_an_entry_exists(entry):
    file, _, test = entry["test"].partition("::")
    assert f"def {test.partition('[')[0]}(" in (PROJECT / file).read_text()


def test_an_unknown_name_is_refused():
    with pytest.raises(mutants.DoesNotFit, match="no mechanism 'teleport'"):
        mutants.read_mechanisms(["teleport"])
