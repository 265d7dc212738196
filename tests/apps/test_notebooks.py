"""Every notebook of the suite is clean and runs in the quick profile; the runner refuses and reports as it should."""

import ast
import math
import os
import re
import sys
from contextlib import suppress
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from p2p_lib.apps import cli
from p2p_lib.apps import clone as apps_clone
from p2p_lib.core import compiled
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from studies import course, runner
from studies.claims import Claim, check
from studies.course import LESSONS
from studies.runner import (
    NotebookFailed,
    NotebookResult,
    list_notebooks,
    notebook_parameters,
    read_result,
    run_notebooks,
)

SUITE = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))
MAX_CELL_LINES = 15
FIRST = 'from p2p_lib.apps.clone import study\n\nstudy("course").lesson("{}")'  # the first cell of code of each
PARAMETERS = "PROFILE = 'quick'\nSEED: int = 0\nSCALE = 1.0\nNAME = 'a'"
CHECKS = """from studies.claims import Claim, check
check(
    Claim("seed", SEED, "what is drawn"),
    Claim("scale [mm]", SCALE, "how large it is", at_least=0.5),
    Claim("profile", PROFILE, "its name"),
)"""


def check_notebook(path: Path) -> list[str]:
    """What is wrong with a notebook's source as it is kept in git; empty where nothing is."""
    code = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    problems = []
    for number, cell in enumerate(code, 1):
        found = ["has outputs (run nbstripout)"] if cell.outputs or cell.execution_count else []
        problems += [f"code cell {number} {problem}" for problem in found + source_problems(cell.source)]
    if sum("parameters" in tags(cell) for cell in code) != 1:
        problems.append("needs exactly one cell tagged parameters")
    else:
        try:
            problems += [] if "PROFILE" in notebook_parameters(path) else ["has no parameter PROFILE"]
        except BadInput as error:
            problems.append(str(error))
    if not code or "checks" not in tags(code[-1]):
        problems.append("needs a last code cell tagged checks")
    return problems


def source_problems(source: str) -> list[str]:
    lines = len(source.splitlines())
    problems = [f"has {lines} lines, more than {MAX_CELL_LINES}"] if lines > MAX_CELL_LINES else []
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except SyntaxError:
        return [*problems, "is not plain Python (no shell, no magics)"]
    if any(isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) for node in nodes):
        problems.append("defines a function or class (it belongs in notebooks/studies)")
    modules = [name.name for node in nodes if isinstance(node, ast.Import) for name in node.names]
    modules += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    if {module.split(".")[0] for module in modules} & {"os", "subprocess"}:
        problems.append("imports os or subprocess (the library has a function for it)")
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    problems += [f"holds the absolute path {text!r}" for text in texts if re.match(r"(/|~/|[A-Za-z]:\\)\w", text)]
    return problems


def course_problems(path: Path) -> list[str]:
    """What a notebook of the course lacks: its place in it, captions, exercises with answers, the way on."""
    cells = nbformat.read(path, 4).cells
    code = [cell.source for cell in cells if cell.cell_type == "code"]
    text = [cell.source for cell in cells if cell.cell_type == "markdown"]
    names = [one.name for one in LESSONS]
    problems = [] if code[0] == FIRST.format(path.stem[:2]) else ["does not begin with its lesson"]
    problems += [f"{call} without a caption" for source in code for call in uncaptioned(source)]
    problems += [
        f"{call} is not the last of its cell, so it is not shown" for source in code for call in unshown(source)
    ]
    literals = "\n".join(cell.source for cell in cells if "parameters" in tags(cell)).splitlines()
    problems += [f"says nothing of its parameter {line}" for line in literals if "#" not in line]
    if len(answers(path)) < 2:
        problems.append(f"has {len(answers(path))} exercises with an answer in code, not two or more")
    links = set(re.findall(r"\]\((\w+)\.ipynb\)", "\n".join(text)))
    problems += [f"links to {link}, which is not there" for link in links - set(names)]
    after = (names + names[:1])[names.index(path.stem) + 1]
    if cells[-1].cell_type != "markdown" or f"({after}.ipynb)" not in cells[-1].source:
        problems.append(f"does not lead on to {after}")
    return problems


def uncaptioned(source: str) -> list[str]:
    """Calls that save a picture or a film without a caption of whole sentences."""
    tree = ast.parse(source)
    said = {
        n.targets[0].id: n.value for n in ast.walk(tree) if isinstance(n, ast.Assign) and hasattr(n.targets[0], "id")
    }
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("save_figure", "save_video", "save_sliders"):
            given = node.args[2] if len(node.args) > 2 else None
            given = said.get(given.id) if isinstance(given, ast.Name) else given
            parts = given.values if isinstance(given, ast.JoinedStr) else [given]
            words = " ".join(part.value for part in parts if isinstance(part, ast.Constant)).rstrip()
            if len(words.split()) < 6 or not words.endswith("."):
                found.append(ast.unparse(node)[:60])
    return found


def unshown(source: str) -> list[str]:
    """Calls that save a picture and whose answer, which shows it, is dropped: a cell shows its last line alone."""
    calls = [one.value for one in ast.parse(source).body[:-1] if isinstance(one, ast.Expr)]
    saving = [call for call in calls if isinstance(call, ast.Call) and getattr(call.func, "id", "").startswith("save_")]
    return [ast.unparse(call)[:60] for call in saving]


def answers(path: Path) -> list[str]:
    """The code of each answer that can be unfolded."""
    text = "\n".join(cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown")
    folded = re.findall(r"<details><summary>Answer</summary>\n(.*?)\n</details>", text, re.DOTALL)
    return [code for answer in folded for code in re.findall(r"```python\n(.*?)```", answer, re.DOTALL)]


def with_answers(path: Path, folder: Path) -> Path:
    """A copy of a notebook that runs the answers to its exercises where they stand."""
    notebook, to = nbformat.read(path, 4), folder / path.name
    at = max(k for k, cell in enumerate(notebook.cells) if "<details>" in cell.source) + 1
    notebook.cells[at:at] = map(new_code_cell, answers(path))
    nbformat.write(notebook, to)
    return to


def tags(cell) -> list[str]:
    return cell.metadata.get("tags", [])


def cell(source: str, tag: str = ""):
    return new_code_cell(source, metadata={"tags": [tag]} if tag else {})


def write(path: Path, *middle: str, parameters: str = PARAMETERS, checks: str = CHECKS) -> Path:
    cells = [new_markdown_cell("# A story\n\nWhy."), cell(parameters, "parameters"), *map(cell, middle)]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    nbformat.write(new_notebook(cells=[*cells, cell(checks, "checks")], metadata={"kernelspec": kernel}), path)
    return path


# The suite


@pytest.fixture(scope="session")
def suite_out(request, tmp_path_factory) -> Path:
    """Where all notebooks that are asked for were run with the answers to their exercises, two at a time."""
    out, copies = tmp_path_factory.mktemp("suite"), tmp_path_factory.mktemp("copies")
    asked = [i for i in request.session.items if i.originalname == test_notebook_runs_in_the_quick_profile.__name__]
    names = [with_answers(item.callspec.params["path"], copies).stem for item in asked]
    if names:
        with suppress(NotebookFailed):  # what failed is read back
            run_notebooks("quick", names, out, folder=copies, say=lambda line: None, jobs=2)
    return out


def test_the_suite_is_there():
    assert [path.name for path in SUITE] == [path.name for path in list_notebooks()]


@pytest.mark.parametrize("path", SUITE, ids=lambda path: path.stem)
def test_notebook_is_clean(path):
    assert check_notebook(path) + course_problems(path) == []


def assert_ran(result: NotebookResult) -> None:
    """Every claim has a bar that is met or says what it tells."""
    assert result.error == "" and all(result.checks) and len(result.checks) > 3
    assert sum(bool(claim.bar) for claim in result.checks) > 2, "claims that can fail"
    assert result.executed.with_suffix(".html").stat().st_size > 10_000
    assert result.seconds > 0


@pytest.mark.parametrize("path", SUITE, ids=lambda path: path.stem)
def test_notebook_runs_in_the_quick_profile(path, suite_out):
    assert_ran(read_result(suite_out / "notebooks" / path.name))


@pytest.mark.skipif(not os.environ.get("P2P_SEEDS"), reason="takes an hour: make seeds")
@pytest.mark.parametrize("seed", [int(seed) for seed in os.environ.get("P2P_SEEDS", "1").split(",")])
@pytest.mark.parametrize("path", [path for path in SUITE if "SEED" in path.read_text()], ids=lambda path: path.stem)
def test_the_claims_hold_on_other_seeds(path, seed, tmp_path):
    folder = with_answers(path, tmp_path).parent
    options = {"parameters": {"SEED": seed}, "folder": folder, "say": lambda line: None}
    (result,) = run_notebooks("quick", [path.stem], tmp_path / "out", **options)
    assert_ran(result)


def test_a_browser_shows_every_figure_of_the_gallery(suite_out, browser):
    """All that the tests above have executed, as a visitor sees it: the gallery, and every page that it links to."""
    pages = sorted((suite_out / "notebooks").glob("*.html"))
    if not pages:
        pytest.skip("no notebook was executed before this test")
    thumbnails = browser.figures(suite_out / "index.html")
    assert len(thumbnails) == len(pages), "a thumbnail per notebook"
    links = set(re.findall(r'href="(notebooks/[^"]+)"', (suite_out / "index.html").read_text()))
    assert links == {f"notebooks/{page.name}" for page in pages}
    for page in pages:
        code = [c for c in nbformat.read(page.with_suffix(".ipynb"), 4).cells if c.cell_type == "code"]
        outputs = [output.get("data", {}) for c in code for output in c.outputs]
        made = sum(
            "image/png" in data or bool(re.search("<(video|iframe)", data.get("text/html", ""))) for data in outputs
        )
        figures, wide = browser.seen(page, 1280)
        assert len(figures) == made > 0, page.name
        assert [f for f in figures if f["kind"] == "IMG" and len(f["alt"]) < 30] == [], f"{page.name}: no words for it"
        assert wide == [], page.name
        thumbnails += figures
    assert [f for f in thumbnails if min(f["width"], f["height"], f["shown_px"]) < 20] == []


def test_the_browser_sees_what_is_not_shown(tmp_path, browser):
    page = tmp_path / "page.html"
    gone, fine = '<img src="gone.png">', f'<img width="40" height="40" src="data:image/png;base64,{PNG}">'
    page.write_text(f"<html><body>{gone}{fine}<video src='data:video/mp4;base64,AAAA'></video></body></html>")
    seen = browser.figures(page)
    assert [(f["kind"], f["width"]) for f in seen] == [("IMG", 0), ("IMG", 1), ("VIDEO", 0)]
    assert seen[1]["shown_px"] == 1600


@pytest.mark.parametrize("clone", [True, False])
def test_the_first_cell_finds_the_clone_from_any_folder_or_says_what_to_do(tmp_path, monkeypatch, clone):
    for name in [name for name in sys.modules if name.partition(".")[0] == "studies"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(SUITE[0].parent))])
    monkeypatch.chdir(tmp_path)
    if clone:
        exec(FIRST.format("03") + "\nfrom studies import claims", {})
        return
    monkeypatch.setattr(apps_clone, "PROJECT", tmp_path / "site-packages")
    with pytest.raises(MissingData, match=r"Clone the repository .* --cwd CLONE/notebooks"):
        exec(FIRST.format("03"), {})


# What needs an extra besides the notebooks' own


@pytest.fixture
def without_open3d(monkeypatch):
    def load():
        raise MissingBackend("open3d", "No module named 'open3d'", "Run: pip install 'p2p_lib[open3d]'")

    monkeypatch.setitem(course._LOADS, "open3d", load)
    return r"^notebook 11_label_your_own: needs the extra open3d, .*Run: pip install 'p2p_lib\[open3d\]'"


def test_a_notebook_without_its_extra_says_so_in_its_first_cell(without_open3d):
    with pytest.raises(MissingBackend, match=without_open3d):
        course.lesson("11")
    assert course.lesson("10").name == "10_your_own_data"


def test_nothing_runs_where_one_of_the_notebooks_lacks_its_extra(tmp_path, without_open3d):
    write(tmp_path / "10_your_own_data.ipynb")
    write(tmp_path / "11_label_your_own.ipynb")
    with pytest.raises(MissingBackend, match=without_open3d):
        run_notebooks(out=tmp_path / "out", folder=tmp_path, say=lambda line: None)
    assert not (tmp_path / "out").exists()


# The runner


def test_loops_are_compiled_before_the_first_kernel_starts(monkeypatch):
    did = []
    monkeypatch.setattr(compiled, "warm_up", lambda say: did.append("compiled"))
    monkeypatch.setattr(runner, "run_notebooks", lambda profile, **how: did.append(how["only"]))
    assert cli.main(["notebooks", "--only", "03"]) == 0
    assert did == ["compiled", ("03",)] or did == ["compiled", ["03"]]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Three small notebooks, the second of which fails, run two at a time."""
    folder, out = tmp_path_factory.mktemp("notebooks"), tmp_path_factory.mktemp("out")
    picture = "import base64\nfrom IPython.display import Image, display\n"
    picture += f"display(Image(base64.b64decode({PNG!r})))"
    where = "import os\nprint(os.environ['P2P_FIGURES'], os.environ['P2P_TABLES'], os.getcwd())"
    write(folder / "00_first.ipynb", picture, where)
    fails = CHECKS.replace('"its name"', '"its name"),\n    Claim("AUC [%]", 12.34, "of ADD-S", at_least=95')
    write(folder / "01_fails.ipynb", checks=fails)
    write(folder / "02_last.ipynb")
    lines, moved, chdir = [], [], os.chdir
    with pytest.raises(NotebookFailed) as failed, pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "chdir", lambda path: (moved.append(Path(path).resolve()), chdir(path)))
        run_notebooks("quick", out=out, folder=folder, jobs=2, parameters={"SEED": "3", "SCALE": 2}, say=lines.append)
    assert set(moved) <= {Path.cwd()}, "threads have one working directory between them"
    return folder, out, failed.value, lines


PNG = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="


def test_failing_check_names_notebook_cell_and_claim(run):
    message = str(run[2])
    assert message.startswith("notebook 01_fails, cell [3] 'check('")
    assert "AssertionError: AUC [%]: 12.34, not at least 95 (of ADD-S). See " in message and "\n" not in message
    assert run[2].exit_code == 2


def test_what_a_notebook_claimed_is_read_back(run):
    result = read_result(run[1] / "notebooks" / "00_first.ipynb")
    seed, scale, profile = result.checks
    assert (seed.value, seed.bar) == (3, "") and (scale.value, scale.bar) == (2.0, "at least 0.5")
    assert isinstance(scale.value, float) and profile.value == "quick"
    assert result.title == "A story" and result.image_png == PNG and result.error == ""
    assert "SEED=3" in result.changed and "SEED=3" in (run[1] / "index.html").read_text()
    assert result.seconds > 0


def test_notebooks_learn_their_folders(run):
    folder, out, *_ = run
    notebook = nbformat.read(out / "notebooks" / "00_first.ipynb", 4)
    printed = [o.text for c in notebook.cells for o in c.get("outputs", ()) if o.output_type == "stream"]
    assert printed == [f"{out / 'figures'} {out / 'tables'} {folder}\n"], "and nothing else is printed"
    assert (out / "figures").is_dir() and (out / "tables").is_dir()


def test_a_kernel_logs_nothing_to_the_terminal(tmp_path, capfd):
    """As it would when it is interrupted to be shut down."""
    write(tmp_path / "00_logs.ipynb", "get_ipython().kernel.log.error('caught in kernel')")
    lines = []
    run_notebooks("quick", out=tmp_path / "out", folder=tmp_path, say=lines.append)
    assert "index.html, which has all that ran there; images are in" in lines[-1], "earlier ones, too"
    assert "caught in kernel" not in "".join(capfd.readouterr())


def test_gallery_shows_what_ran(run):
    page = (run[1] / "index.html").read_text()
    assert PNG in page and "AUC [%]: 12.34, not at least 95" in page
    rows = [re.findall("<td[^>]*>(.*?)</td>", row) for row in re.findall("<tr.*?</tr>", page, re.DOTALL)]
    assert ["scale [mm]", "2", "at least 0.5", "holds", "how large it is"] in rows
    assert ["seed", "3", "-", "for information", "what is drawn"] in rows
    assert ["AUC [%]", "12.34", "at least 95", "does not hold", "of ADD-S"] in rows
    assert re.search(r"3 notebooks, \d+ s, 10 claims checked, <b class=\"failed\">1 failed</b>", page)
    assert set(re.findall(r'[" ]href="(notebooks/[^"]*)"', page)) == {
        f"notebooks/{name}.html" for name in ("00_first", "01_fails", "02_last")
    }
    assert f"{len(LESSONS)} of the course's {len(LESSONS)} notebooks were not run here" in page
    assert not re.search(r'(src|href)="\w+://', page), "nothing is fetched"
    assert (run[1] / "notebooks" / "01_fails.html").exists(), "the failed notebook can be looked at too"


def test_pages_link_to_what_was_run_and_to_more_once_that_was_run(tmp_path):
    def links(page):
        return set(re.findall(r' href="([\w/]*\d\d_\w+\.\w+)"', (tmp_path / "out" / page).read_text()))

    for path, other in (("03_a", "04_b"), ("04_b", "03_a")):
        notebook = nbformat.read(write(tmp_path / f"{path}.ipynb"), 4)
        notebook.cells[0].source += f" [Next]({other}.ipynb)"
        nbformat.write(notebook, tmp_path / f"{path}.ipynb")
    how = {"out": tmp_path / "out", "folder": tmp_path, "say": lambda line: None}
    run_notebooks(only=["03"], **how)
    assert (links("index.html"), links("notebooks/03_a.html")) == ({"notebooks/03_a.html"}, set())
    run_notebooks(only=["04"], **how)
    assert links("index.html") == {"notebooks/03_a.html", "notebooks/04_b.html"}
    assert (links("notebooks/03_a.html"), links("notebooks/04_b.html")) == ({"04_b.html"}, {"03_a.html"})


def test_progress_is_told(run):
    lines = run[3]
    assert lines[0].startswith("3 notebooks, profile quick, results in ")
    begun = [line.removesuffix(" ...") for line in lines if line.endswith(" ...")]
    assert sorted(begun[:2]) == ["01_fails", "02_last"], "two at a time: the long ones, which are last, first"
    assert any(line.startswith("00_first: ") and line.endswith(" s, 3 claims checked") for line in lines)
    assert any(line.startswith("01_fails: ") and line.endswith("FAILED") for line in lines)


def test_a_kernel_that_dies_is_a_failure(tmp_path):
    write(tmp_path / "00_dies.ipynb", "import signal\nsignal.raise_signal(signal.SIGKILL)")
    with pytest.raises(NotebookFailed, match=r"00_dies, cell 'import signal': the kernel ended there"):
        run_notebooks("quick", out=tmp_path / "out", folder=tmp_path, say=lambda line: None)


# Refusals, all before anything runs


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"parameters": {"SED": 1}},
            "00_a parameter: got SED, expected one of SEED, SCALE, NAME. Did you mean SEED?",
        ),
        ({"parameters": {"SEED": "many"}}, "00_a parameter SEED: got 'many', expected int like 0"),
        ({"parameters": {"SEED": True}}, "00_a parameter SEED: got True, expected int like 0"),
        ({"parameters": {"NAME": 3}}, "00_a parameter NAME: got 3, expected str like 'a'"),
        ({"profile": "fast"}, "profile: got 'fast', expected one of quick, full"),
        ({"parameters": {"sed": 1}, "only": ["0"]}, "00_a parameter: got sed, expected one of SEED, SCALE"),
        (
            {"parameters": {"PROFILE": "huge"}},
            "parameter: got PROFILE, expected one of a notebook's others. The profile is chosen by --profile",
        ),
        ({"only": ["07"]}, "notebook: got '07', expected one of 00_a, 01_b"),
        ({"jobs": 0}, "jobs: got 0, expected at least 1"),
    ],
)
def test_refusals(tmp_path, arguments, message):
    write(tmp_path / "00_a.ipynb")
    write(tmp_path / "01_b.ipynb", parameters="PROFILE = 'quick'")
    with pytest.raises(BadInput) as refused:
        run_notebooks(**{"only": ["00"], **arguments}, out=tmp_path / "out", folder=tmp_path, say=lambda line: None)
    assert str(refused.value).startswith(message)
    assert not (tmp_path / "out").exists()


def test_what_runs_with_other_values_goes_beside_and_not_over(tmp_path, monkeypatch):
    """Also of the full profile, whose images are those of the repository else."""
    monkeypatch.setattr(runner, "CLONE", tmp_path / "clone")
    write(tmp_path / "00_a.ipynb")
    earlier = tmp_path / "clone/out/full/notebooks/00_a.ipynb"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("earlier")
    said: list[str] = []
    run_notebooks("full", folder=tmp_path, parameters={"SEED": "3", "NAME": "a b"}, say=said.append)
    assert "images in" not in said[0]
    (home,) = set((tmp_path / "clone/out").iterdir()) - {earlier.parents[1]}
    assert home.name == "full_SEED-3_NAME-a-b" and earlier.read_text() == "earlier"
    assert (home / "notebooks/00_a.ipynb").is_file() and (home / "index.html").is_file()
    assert (home / "figures").is_dir() and not (tmp_path / "clone/figures").exists()
    run_notebooks("full", folder=tmp_path, say=said.clear() or said.append)
    assert f"images in {tmp_path}/clone/figures" in said[0], "that they go there is said first"


def test_a_parameter_must_be_known_to_all_notebooks_that_run(tmp_path):
    write(tmp_path / "00_a.ipynb")
    write(tmp_path / "01_b.ipynb", parameters="PROFILE = 'quick'")
    with pytest.raises(BadInput, match=r"01_b parameter: got SEED, expected none: it has none\. Pick the"):
        run_notebooks(out=tmp_path / "out", folder=tmp_path, parameters={"SEED": 1}, say=lambda line: None)


def test_picking_keeps_the_order(tmp_path):
    for name in ("00_a", "01_b", "02_c", "draft"):
        write(tmp_path / f"{name}.ipynb")
    assert [path.stem for path in list_notebooks(tmp_path)] == ["00_a", "01_b", "02_c"]
    assert [path.stem for path in list_notebooks(tmp_path, ["02_c.ipynb", "00", "00_a"])] == ["00_a", "02_c"]
    with pytest.raises(MissingData, match="no notebooks"):
        list_notebooks(tmp_path / "nowhere")


# The rules for sources


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("def f():\n    pass", "code cell 2 defines a function or class"),
        ("class A: pass", "code cell 2 defines a function or class"),
        ("!ls", "code cell 2 is not plain Python"),
        ("%matplotlib inline", "code cell 2 is not plain Python"),
        ("import subprocess", "code cell 2 imports os or subprocess"),
        ("from os import system", "code cell 2 imports os or subprocess"),
        ("open('/data/a.txt')", "code cell 2 holds the absolute path '/data/a.txt'"),
        ("open('~/a.txt')", "code cell 2 holds the absolute path '~/a.txt'"),
        ("\n".join(f"x{k} = {k}" for k in range(16)), "code cell 2 has 16 lines, more than 15"),
    ],
)
def test_rules_for_cells(tmp_path, source, problem):
    (found,) = check_notebook(write(tmp_path / "00_a.ipynb", source))
    assert found.startswith(problem)


def test_harmless_cells_pass(tmp_path):
    fine = ["speed = '3 m/s'\nshare = f'{100 * 0.5:.0f} % of n=%d' % 3", "y = [lambda x: x != 2]\nz = 7 % 4"]
    assert check_notebook(write(tmp_path / "00_a.ipynb", *fine)) == []


def test_outputs_do_not_belong_into_git(tmp_path):
    path = write(tmp_path / "00_a.ipynb", "1")
    notebook = nbformat.read(path, 4)
    notebook.cells[2].outputs = [new_output("stream", text="1")]
    nbformat.write(notebook, path)
    assert check_notebook(path) == ["code cell 2 has outputs (run nbstripout)"]


def test_special_cells_are_needed(tmp_path):
    nbformat.write(new_notebook(cells=[cell("x = 1")]), tmp_path / "00_a.ipynb")
    wanted = ["needs exactly one cell tagged parameters", "needs a last code cell tagged checks"]
    assert check_notebook(tmp_path / "00_a.ipynb") == wanted
    assert check_notebook(write(tmp_path / "01_b.ipynb", parameters="SEED = 1")) == ["has no parameter PROFILE"]


@pytest.mark.parametrize(
    "source", ["PROFILE = 'a' + 'b'", "import os", "PROFILE = f()", "PROFILE: str", "a, b = 1, 2", "x ="]
)
def test_parameters_are_literals(tmp_path, source):
    path = write(tmp_path / "00_a.ipynb", parameters=source)
    with pytest.raises(BadInput, match="expected lines of the form NAME = literal"):
        notebook_parameters(path)


def test_a_file_that_is_no_notebook_is_named(tmp_path):
    (tmp_path / "00_a.ipynb").write_text("PROFILE = 1")
    with pytest.raises(BadInput, match=r"00_a\.ipynb: got a file that is not JSON"):
        notebook_parameters(tmp_path / "00_a.ipynb")


@pytest.mark.parametrize("value", [math.nan, math.inf, [1, 2], None])
def test_only_plain_finite_values_are_claimed(value):
    with pytest.raises(BadInput, match=r"claim 'AUC'"):
        Claim("AUC", value, "a value")


@pytest.mark.parametrize(
    ("claim", "holds", "bar"),
    [
        (Claim("a", 3, "told"), True, ""),
        (Claim("a", "words", "told"), True, ""),
        (Claim("a", True, "it is so"), True, "yes"),
        (Claim("a", np.bool_(False), "it is not so"), False, "yes"),
        (Claim("a", np.float32(0.5), "b", at_least=0.5), True, "at least 0.5"),
        (Claim("a", 0.49, "b", at_least=0.5), False, "at least 0.5"),
        (Claim("a", np.int64(7), "b", at_most=6), False, "at most 6"),
        (Claim("a", 5, "b", at_least=4, at_most=6), True, "at least 4 and at most 6"),
    ],
)
def test_a_claim_holds_or_not(claim, holds, bar):
    assert (bool(claim), claim.bar) == (holds, bar) and not hasattr(claim.value, "dtype")


def test_all_claims_that_fail_are_named():
    claims = Claim("a", 1, "x", at_least=2), Claim("b", 5, "y", at_least=2), Claim("c", False, "z")
    with pytest.raises(AssertionError, match=r"^a: 1, not at least 2 \(x\); c: no, not yes \(z\)$"):
        check(*claims)
    check(claims[1])
    check(*claims, bars=False)


def test_without_bars_all_is_told_and_nothing_has_to_hold():
    claims = Claim("a", 1, "x", at_least=2), Claim("c", False, "z"), Claim("d", True, "y"), Claim("e", "words", "w")
    told = [claim.told for claim in claims]
    assert [claim.value for claim in told] == [1, "no", "yes", "words"] and all(told)
    assert {claim.row[""] for claim in told} == {"for information"}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("save_figure(f, 'a')", 1),
        ("save_figure(f, 'a', 'Too short.')", 1),
        ("save_video(f, 'a', 'A box that turns before the camera and never ends')", 1),
        ("save_figure(f, 'a', 'A box that turns before the camera.')", 0),
        ("caption = f'A box of {n} mm that turns before us.'\nsave_sliders(f, 'a', caption, {}, ())", 0),
    ],
)
def test_pictures_without_captions_are_seen(source, found):
    assert len(uncaptioned(source)) == found


def test_a_picture_that_is_not_shown_is_seen():
    assert unshown("save_figure(f, 'a', c)\n{'n': 1}") == ["save_figure(f, 'a', c)"]
    assert unshown("print(1)\nx = save_figure(f, 'a', c)\nsave_table(t, 'b')") == []
