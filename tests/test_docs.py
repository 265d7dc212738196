"""What the documents say is so: files exist, commands are known, the example runs, the right people are cited."""

import argparse
import ast
import doctest
import importlib
import inspect
import json
import re
import subprocess
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

import p2p_lib
from p2p_lib import Point2Pose, preset
from p2p_lib.apps import cli, command_line
from p2p_lib.benchmark.jobs import jobs_of
from p2p_lib.benchmark.plan import Plan
from p2p_lib.core.camera import Camera
from p2p_lib.core.interfaces import Detector, PointTracker, Segmenter
from p2p_lib.core.types import Frame, Status
from p2p_lib.datasets.cameras import LiveCamera
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.sequence import no_truth_said, open_sequence
from studies.runner import list_notebooks

PROJECT = Path(__file__).resolve().parents[1]
GUIDES = tuple(f"docs/{path.name}" for path in sorted((PROJECT / "docs").glob("*.md")))
DOCUMENTS = ("README.md", "CONTRIBUTING.md", "environment.md", *GUIDES)
#: Where a file named in passing may lie.
PLACES = ("", "p2p_lib", *(str(p.relative_to(PROJECT)) for p in sorted((PROJECT / "p2p_lib").glob("*/"))), "notebooks")


def read(name: str) -> str:
    """A document; of a notebook its cells."""
    text = (PROJECT / name).read_text(encoding="utf-8")
    return "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"]) if name.endswith(".ipynb") else text


@pytest.mark.parametrize("name", ["CONTRIBUTING.md"])
def test_files_that_are_named_exist(name):
    named = {word for word in re.findall(r"`([\w./]+\.py|[\w./]+/)`", read(name)) if "PATH" not in word}
    named = {word for word in named if not word.startswith("out/") and word not in ("utils.py", "DIR/")}
    assert len(named) > 15
    missing = {word for word in named if not any((PROJECT / place / word).exists() for place in PLACES)}
    assert not missing


PACKAGES = sorted(path.parent for path in (PROJECT / "p2p_lib").glob("*/__init__.py"))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_a_package_says_where_to_look_first(package):
    page = ast.get_docstring(ast.parse((package / "__init__.py").read_text()))
    first = re.findall(r":mod:`~?([\w.]+)`", page)
    assert first, "the modules to look at first"
    assert all(module_of(name) for name in first)
    assert f"`p2p_lib/{package.name}/`" in read("CONTRIBUTING.md")


def test_the_page_of_the_method_names_every_file_of_it():
    folder = PROJECT / "p2p_lib" / "method"
    page = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
    named = set(re.findall(r"``(\w+)``", page)) | set(re.findall(r"p2p_lib\.method\.(\w+)`", page))
    assert named == {path.stem for path in folder.glob("*.py")} - {"__init__"}


def module_of(name: str) -> Path | None:
    """The file or folder of a module of ours; None where there is none."""
    path = PROJECT / name.replace(".", "/")
    return next((place for place in (path, path.with_suffix(".py")) if place.exists()), None)


def test_what_docstrings_refer_to_exists():
    missing = []
    for path in (PROJECT / "p2p_lib").rglob("*.py"):
        for name in re.findall(r":\w+:`~?(p2p_lib\.[\w.]+)`", path.read_text()):
            module, _, thing = name.rpartition(".")
            if module_of(name) is None and not hasattr(importlib.import_module(module), thing):
                missing.append(f"{path.relative_to(PROJECT)}: {name}")
    assert not missing


@pytest.mark.parametrize("name", DOCUMENTS)
def test_links_lead_somewhere(name):
    links = [link for link in re.findall(r"\]\(([^)#]+)[^)]*\)", read(name)) if "://" not in link]
    assert not [link for link in links if not (PROJECT / name).parent.joinpath(link).exists()]


def test_readme_leads_to_every_guide_and_is_read_in_some_minutes():
    assert GUIDES and not [name for name in GUIDES if f"]({name}" not in read("README.md")]
    assert len(read("README.md").split()) < 2500, "what one has to look up belongs in a guide"


def test_pages_lead_to_pages_and_dead_links_are_found(tool, tmp_path):
    docs, linked = tool("docs"), []
    text = "[a](LICENSE), [b](ros2/README.md#top), [c](tests), ![d](figures/x.png), [e](#here), [f](https://a.b/c.md)"
    turned = docs._turned(text, "README.md", linked)
    links = re.findall(r"\]\((.*?)\)", turned)
    expected = ["LICENSE", "ros2/README.html#top", "tests/index.html", "figures/x.webp", "#here", "https://a.b/c.md"]
    assert links == expected and linked == ["LICENSE", "ros2/README.md", "tests", "figures/x.png"]
    (tmp_path / "below").mkdir()
    (tmp_path / "below/other.html").write_text('<p id="a place">')
    hrefs = ("below/other.html#a%20place", "#here", "https://a.b/c", "gone.html", "below/other.html#gone", "#gone")
    page = "".join(f'<a href="{href}">' for href in hrefs)
    (tmp_path / "page.html").write_text(f'<h1 id="here">{page}<script>href="no link"</script>')
    assert list(docs.dead_links(tmp_path)) == [f"page.html: {href}" for href in sorted(hrefs[3:])]


def test_the_page_of_the_lines_says_what_each_status_means(tool, tmp_path):
    tool("docs").json_lines(tmp_path)
    page = (tmp_path / "docs/json_lines.html").read_text()
    assert 'as <a href="python.html#estimates">of an estimate</a>' in page
    _, _, below = page.partition('<h2 id="estimates">')
    assert not [status for status in Status if f"<code>{status}</code>" not in below]


def test_pages_that_weigh_too_much_are_refused(tool, tmp_path):
    docs = tool("docs")
    for name, size in (("page.html", 4_000_000), ("below/picture.webp", 6_000_000)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        with open(tmp_path / name, "wb") as file:
            file.truncate(size)
    assert not list(docs.too_large(tmp_path))
    (tmp_path / "one_more.html").write_bytes(bytes(100_000))
    assert list(docs.too_large(tmp_path)) == ["The reference has 10.1 MB, expected at most 10."]


def commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return dict(groups[0].choices) if groups else {}


@pytest.mark.parametrize("name", [*DOCUMENTS, *(f"notebooks/{path.name}" for path in list_notebooks())])
def test_commands_and_their_options_are_known(name):
    known = commands(command_line.parser())
    for line in re.findall(r"\bp2p ([a-z][^`\n]*)", read(name)):
        words = line.partition("#")[0].split()
        if words[0] not in known:
            assert not re.match(r"[a-z-]+$", words[0]) or words[0] in ("on", "does"), f"p2p {words[0]}"
            continue
        parser = known[words[0]]
        if commands(parser) and len(words) > 1:
            assert words[1] in commands(parser), f"p2p {line}"
            parser = commands(parser)[words[1]]
        options = {option for action in parser._actions for option in action.option_strings}
        for word in words[1:]:
            if word.startswith("--"):
                assert word.rstrip(".,;:)") in options, f"p2p {line}"


def test_the_map_of_notebooks_is_whole():
    listed = re.findall(r"(?m)^\| \[`(\d\d_\w+)`\]\(notebooks/\1\.ipynb\) \|", read("README.md"))
    assert listed == [path.stem for path in list_notebooks()]


def test_the_example_tracker_tracks():
    """The tracker of CONTRIBUTING.md, taken from there: a still scene is tracked, and stays where it was."""
    source = re.search(r"```python\n(import numpy.*?)```", read("CONTRIBUTING.md"), re.DOTALL)[1]
    names: dict = {}
    exec(source, names)
    camera = Camera(300, 300, 79.5, 59.5, 160, 120)
    rgb = np.kron(np.random.default_rng(0).integers(0, 255, (15, 20, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    config = preset("default").with_values({"method.surface": False, "method.graph": False})
    method, mask = Point2Pose(camera, config, tracker=names["StillTracker"]()), np.zeros((120, 160), bool)
    mask[20:100, 30:130] = True
    method.add_object("poster")
    for k in range(3):  # more of the same image would be a camera that hangs
        estimate = method.step(Frame(k, k / 30, rgb, np.full((120, 160), 0.8, np.float32)), {"poster": mask})["poster"]
    assert estimate.status is Status.TRACKED and estimate.inliers >= 20
    np.testing.assert_allclose(estimate.T_cam_obj[:3, :3], np.eye(3), atol=1e-6)


@pytest.mark.parametrize("protocol", [Detector, LiveCamera, PointTracker, Segmenter])
def test_the_calls_that_parts_are_to_have_are_said_with_their_defaults(protocol):
    """A class that is written by them is one to a type checker."""
    said = dict(re.findall(r"(?:def |`)(\w+)(\((?:[\w=, ]|\(\))*\))(?::|`)", read("CONTRIBUTING.md")))
    calls = {key: of for key, of in vars(protocol).items() if inspect.isfunction(of) and not key.startswith("_")}
    for name, function in calls.items():
        plain = [f"{p.name}={p.default}" if p.default is not p.empty else p.name for p in parameters(function)]
        assert said[name].replace("self, ", "").replace("self", "") == f"({', '.join(plain)})", name


def parameters(function) -> list[inspect.Parameter]:
    return list(inspect.signature(function).parameters.values())[1:]


def test_the_example_loader_loads(tmp_path, monkeypatch):
    """The loader of CONTRIBUTING.md, taken from there, by ``--format``'s name for it."""
    source = re.search(
        r"```python\n(from dataclasses import replace\n\nimport numpy.*?)```", read("CONTRIBUTING.md"), re.DOTALL
    )
    (tmp_path / "documented_loader.py").write_text(source[1])
    monkeypatch.syspath_prepend(str(tmp_path))
    mask = np.zeros((480, 640), bool)
    mask[100:200, 100:200] = True
    for part, image in (
        ("color", np.zeros((480, 640, 3), np.uint8)),
        ("depth16", np.full((480, 640), 6000, np.uint16)),
    ):
        save_png(tmp_path / "mine" / part / "0.png", image)
    save_png(tmp_path / "mine/masks/mug/0.png", mask)
    np.savetxt(tmp_path / "mine/K.txt", [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    sequence = open_sequence(tmp_path / "mine", format="documented_loader:load")
    assert np.allclose(sequence.frame(0).depth_m, 0.6) and sequence.camera.fx == 500
    np.testing.assert_array_equal(sequence.masks(0)["mug"], mask)
    assert sequence.truth == {} and no_truth_said(sequence) == " (its loader gives none, see CONTRIBUTING.md)"

    np.save(tmp_path / "mine/poses.npy", np.eye(4)[None])
    trimesh.creation.box().export(tmp_path / "mine/mug.ply")
    sequence = open_sequence(tmp_path / "mine", format="documented_loader:load")
    assert sequence.truth["mug"].T_cam_model.shape == (1, 4, 4)
    assert find_models(sequence) == {"mug": tmp_path / "mine/mug.ply"}


def test_the_example_plan_is_one():
    """The plan of docs/results.md, as it stands."""
    source = re.search(r"```toml\n(title.*?)```", read("docs/results.md"), re.DOTALL)[1]
    plan = Plan.model_validate({"name": "mine", **tomllib.loads(source)})
    assert plan.full.sequence[1].format == "mine:load" and plan.methods("quick") == plan.method[:1]
    jobs = jobs_of(plan, "full")
    assert {job.sequence.name for job in jobs if job.key} == {"synthetic/crossing"}, "the other is the reader's own"


def test_the_example_camera_is_played_live(tmp_path, monkeypatch, capsys):
    """The camera of CONTRIBUTING.md, taken from there, by its place: what a program has put there is tracked."""
    source = re.search(r"```python\n(import time\n.*?)```", read("CONTRIBUTING.md"), re.DOTALL)[1]
    (tmp_path / "documented_camera.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "frames").mkdir()
    print_ = np.kron(np.random.default_rng(0).integers(0, 255, (20, 25, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    for k in range(4):
        rgb, depth_m = np.full((480, 640, 3), 90, np.uint8), np.full((480, 640), 1.0, np.float32)
        part = np.s_[160:320, 220 + 4 * k : 420 + 4 * k]
        rgb[part], depth_m[part] = print_, 0.6
        np.savez(tmp_path / f"frames/{k}.npz", time_s=k / 30, rgb=rgb, depth_m=depth_m)
    (tmp_path / "frames/end").touch()
    (tmp_path / "prompts.json").write_text('{"objects": [{"name": "card", "points": [[320, 240], [331, 252]]}]}')
    words = ["live", "--camera", "documented_camera:DropFolder", "--prompts", "prompts.json"]
    assert cli.main([*words, "--set", "method.surface=false", "--set", "method.graph=false"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2, 3] and {line["object"] for line in lines} == {"card"}
    assert all(line["T_cam_obj"] is not None for line in lines)

    camera = importlib.import_module("documented_camera").DropFolder()
    (tmp_path / "frames/end").unlink()
    with ThreadPoolExecutor(1) as pool:  # a read that waits comes back when the camera is closed
        assert [camera.read().index for _ in range(4)] == [0, 1, 2, 3]
        waits = pool.submit(camera.read)
        camera.close()
        assert waits.result(20) is None


def python_of(name: str) -> str:
    """The blocks of Python of a document, one after the other."""
    return "".join(re.findall(r"```python\n(.*?)```", read(name), re.DOTALL))


def test_the_python_of_the_readme_runs(capsys):
    exec(python_of("README.md"), names := {})
    assert names["estimate"].status is Status.TRACKED and "tracked" in capsys.readouterr().out


def test_the_page_on_python_runs(tmp_path, monkeypatch):
    """All blocks as they stand, but for ``video``: a printed card that slides by."""
    monkeypatch.chdir(tmp_path)
    print_ = np.kron(np.random.default_rng(0).integers(0, 255, (20, 25, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    video = []
    for k in range(5):
        rgb, depth_mm = np.full((480, 640, 3), 90, np.uint8), np.full((480, 640), 1000, np.uint16)
        part = np.s_[160:320, 220 + 4 * k : 420 + 4 * k]
        rgb[part], depth_mm[part] = print_, 600
        video.append((rgb, depth_mm))
    names: dict = {"video": video}
    source, emptied = re.subn(r"(?m)^video: .* = \[\].*\n", "", python_of("docs/python.md"))
    assert emptied == 1
    exec(source, names)
    assert names["estimates"]["mug"].status is Status.TRACKED
    assert np.isfinite(names["t_m"]).all() and len(names["keypoints_m"]) > 10
    assert names["poses"].shape == (30, 4, 4) and np.isfinite(names["poses"][-1]).all()
    assert (tmp_path / "box.ply").stat().st_size > 10_000 and 0.05 < names["mesh"].extents.max() < 0.5


EXAMPLES = [path for path in sorted((PROJECT / "p2p_lib").rglob("*.py")) if ">>> " in path.read_text()]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_examples_of_docstrings_say_what_happens(path):
    name = ".".join(path.relative_to(PROJECT).with_suffix("").parts).removesuffix(".__init__")
    ran = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert ran.attempted and not ran.failed


def test_public_names_are_the_same_for_people_and_type_checkers():
    body = ast.parse((PROJECT / "p2p_lib" / "__init__.py").read_text()).body
    (typed,) = (node.body for node in body if isinstance(node, ast.If) and node.test.id == "TYPE_CHECKING")
    said = {name.name: node.module for node in typed for name in node.names}
    assert said == p2p_lib._WHERE and {*said, "__version__"} == set(p2p_lib.__all__)
    assert (PROJECT / "p2p_lib" / "py.typed").exists()


def test_the_papers_authors_are_cited_for_the_method_and_ours_for_the_package():
    cited = yaml.safe_load(read("CITATION.cff"))
    names = [f"{author['given-names']} {author['family-names']}" for author in cited["preferred-citation"]["authors"]]
    assert names == ["Tzu-Yuan Lin", "Ho Jae Lee", "Kevin Doherty", "Yonghyeon Lee", "Sangbae Kim"]
    assert cited["authors"] == [{"name": "Point2Pose suite contributors"}]
    project = tomllib.loads(read("pyproject.toml"))["project"]
    assert project["authors"] == cited["authors"] and project["version"] == cited["version"]
    assert project["license"] == cited["license"] == "BSD-3-Clause" and read("LICENSE").startswith("BSD 3-Clause")


def test_the_linter_asks_for_docstrings_of_everything_public():
    rules = tomllib.loads(read("pyproject.toml"))["tool"]["ruff"]["lint"]
    assert "D" in rules["select"] and not {"D100", "D101", "D102", "D103", "D104"} & set(rules["ignore"])


def test_no_document_names_a_file_that_git_does_not_know():
    listed = subprocess.run(["git", "ls-files"], cwd=PROJECT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    assert set(DOCUMENTS) <= set(listed.stdout.split())
