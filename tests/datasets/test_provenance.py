"""The digest of the code changes with what decides a number, and with nothing else."""

import ast
from types import FunctionType

import pytest

from p2p_lib.benchmark.plan import Method, Plan
from p2p_lib.datasets import provenance
from p2p_lib.extended.saving import Savable
from p2p_lib.method import pipeline

SOURCE = '"""Doc."""\n\n\ndef f(x: int) -> int:\n    """Doc."""\n    return x + 1  # one more\n'


@pytest.fixture
def digest(tmp_path, monkeypatch):
    """Of a package of two files, whose first is given."""

    def of(source: str = SOURCE, name: str = "core/a.py") -> str:
        monkeypatch.setattr(provenance, "_PACKAGE", tmp_path)
        for path in tmp_path.rglob("*.py"):
            path.unlink()
        for path, text in (("run.py", "A = 1\n"), (name, source)):
            (tmp_path / path).parent.mkdir(exist_ok=True)
            (tmp_path / path).write_text(text)
        provenance.code_digest.cache_clear()
        return provenance.code_digest()

    yield of
    provenance.code_digest.cache_clear()


def test_words_and_layout_decide_nothing(digest):
    same = digest()
    assert digest(SOURCE.replace("Doc.", "Other words.").replace("  # one more", "")) == same
    assert digest(SOURCE.replace("x: int", "\n    x: int,\n")) == same
    for name in ("figures/a.py", "__init__.py"):
        assert digest(SOURCE, name) == digest("B = 2\n", name), "what only shows results, and the version"


def test_code_decides(digest):
    same = digest()
    for old, new in (("x + 1", "x + 2"), ("x + 1", "1 + x"), ("return x", "return -x"), ("f(x", "g(x")):
        assert digest(SOURCE.replace(old, new)) != same, new
    assert digest(SOURCE, "core/b.py") != same
    for name in ("execution", "jobs", "rows", "scoring"):
        assert digest(SOURCE, f"benchmark/{name}.py") != digest("B = 2\n", f"benchmark/{name}.py"), name


def test_every_python_gives_the_same():
    """What newer ones add to a tree is empty; a string at the head of a body is the only thing that is left out."""
    tree = ast.parse(SOURCE)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.type_params = []
            node._fields = (*node._fields, "type_params")
    assert provenance._syntax(tree) == provenance._syntax(ast.parse(SOURCE))
    assert provenance._syntax(ast.parse('x = """Doc."""\n')) != provenance._syntax(ast.parse("x = 1\n"))


def test_what_only_memories_use_decides_no_table(digest):
    for name in ("remembered", "remembering", "saving"):
        assert digest(SOURCE, f"extended/{name}.py") == digest("B = 2\n", f"extended/{name}.py"), name
    assert not {"memory", "frozen"} & {*Method.model_fields, *Plan.model_fields}, "then it decides"


def test_what_saves_a_tracker_has_no_part_in_tracking():
    """It stands between the method and the class that users call, and would go before the method."""
    own = {name for name, value in vars(Savable).items() if isinstance(value, FunctionType | classmethod | property)}
    assert own == {"save", "load", "memory"}
    assert not own & set(dir(pipeline.Point2Pose))
