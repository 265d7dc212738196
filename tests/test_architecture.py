"""Packages keep their layers, heavy libraries are used in one place each, and nothing tells of the machine."""

import ast
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
PACKAGE = PROJECT / "p2p_lib"
#: What notebooks share stands beside them: it imports what it likes, and nothing imports it.
STUDIES = sorted((PROJECT / "notebooks" / "studies").glob("*.py"))
#: Lowest first; the packages of one layer do not import each other.
LAYERS = [
    {"core"},
    {"method", "datasets"},
    {"extended"},
    {"synthetic"},
    {"trackers", "detectors", "segmenters"},
    {"evaluation"},
    {"offline"},
    {"keeper"},
    {"run"},
    {"benchmark"},
    {"figures"},
    {"apps"},
]
HOMES = {
    "gtsam": ["p2p_lib/method/factor_graph.py"],
    "numba": ["p2p_lib/core/compiled.py"],
    "matplotlib": ["p2p_lib/figures/*.py", "notebooks/studies/*.py"],
    "open3d": ["p2p_lib/core/native.py"],
    "papermill": ["notebooks/studies/runner.py"],
}
MACHINE = re.compile(r"(?<![\w./~-])/(work|tmp|root|farm|home/[a-z]\w*|opt|mnt|Users)/\w")
REGISTRY = re.compile(r"https?://[^\s\"']*(/simple\b|/packages/[0-9a-f]{2}/|/whl/)|index-url[ =]+http|pypi\.org")
LAZY = ("torch", "numba", "open3d", "matplotlib", "pandas", "scipy", "skimage", "papermill", "gtsam", "trimesh")


def part(module: str) -> str:
    """The package that a module of ours belongs to."""
    return module.split(".")[1]


def imports(path: Path) -> list[str]:
    """Full names of the modules that a file imports anywhere."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; say from p2p_lib... so that the layer is plain"
            whole = {"p2p_lib"} >= {node.module}
            found += [f"{node.module}.{name.name}" for name in node.names] if whole else [node.module]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module":
            found += [node.args[0].value] if isinstance(node.args[0], ast.Constant) else []
    return found


def sources() -> list[Path]:
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


def tracked_files() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=PROJECT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    return [PROJECT / name for name in listed.stdout.split("\0") if name and (PROJECT / name).is_file()]


def test_every_package_has_a_layer():
    parts = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in sources()}
    assert parts <= set().union(*LAYERS), "give the new package its layer in LAYERS"


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    layer = {name: level for level, names in enumerate(LAYERS) for name in names}
    mine = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    for module in imports(path):
        if module.startswith("p2p_lib.") and module != "p2p_lib.__version__" and part(module) != mine:
            assert layer[part(module)] < layer[mine], f"{mine} (layer {layer[mine]}) imports {module}"
        assert module.partition(".")[0] != "studies", "notebooks are no part of the package"


def test_the_papers_method_knows_core_alone_and_can_be_read_in_one_sitting():
    files, told = sorted((PACKAGE / "method").rglob("*.py")), re.compile(r"aside|gates|doubt|outlook", re.IGNORECASE)
    for path in files:
        ours = {part(module) for module in imports(path) if module.startswith("p2p_lib.")}
        assert ours <= {"core", "method"}, f"{path} imports {ours}"
        assert not told.search(path.read_text()), f"{path} tells of what is not the paper's"
    assert sum(map(lines_of_code, files)) <= 1800


def lines_of_code(path: Path) -> int:
    """Lines that hold more than docstrings and comments."""
    tree, source = ast.parse(path.read_text()), path.read_bytes()
    told: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            told |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    held: set[int] = set()
    for token in tokenize.tokenize(io.BytesIO(source).readline):
        if token.type in (tokenize.NAME, tokenize.NUMBER, tokenize.STRING, tokenize.OP):
            held |= set(range(token.start[0], token.end[0] + 1))
    return len(held - told)


def test_an_answer_to_a_user_of_the_paper_needs_nothing_of_ours():
    code = "import sys\nimport numpy as np\nfrom p2p_lib.method.pipeline import Point2Pose\n"
    code += "from p2p_lib.core.camera import Camera\nfrom p2p_lib.core.types import Frame\n"
    code += "frame = Frame(0, 0.0, np.zeros((60, 80, 3), np.uint8), np.ones((60, 80), np.float32))\n"
    code += "with Point2Pose(Camera(80, 80, 40, 30, 80, 60), 'paper') as method:\n"
    code += "    method.add_object('cup')\n    method.step(frame, {'cup': np.eye(60, 80) < 1})\n"
    code += "print(*sys.modules)"
    assert not [module for module in answer(code).split() if module.startswith("p2p_lib.extended")]


@pytest.mark.parametrize("library", HOMES)
def test_heavy_library_has_one_home(library):
    users = {path for path in [*sources(), *STUDIES] if library in {module.split(".")[0] for module in imports(path)}}
    homes = {path for pattern in HOMES[library] for path in PROJECT.glob(pattern)}
    assert users <= homes, f"{library} is used outside its home: {sorted(map(str, users - homes))}"


HELP = "from p2p_lib.apps.cli import main\ntry: main(['--help'])\nexcept SystemExit as end: assert not end.code"


@pytest.mark.parametrize("code", ["import p2p_lib", HELP], ids=["import p2p_lib", "p2p --help"])
def test_loads_nothing_heavy(code):
    report = f"import sys\n{code}\nprint('LOADED', *[m for m in {LAZY!r} if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", report], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "LOADED"


def answer(code: str) -> str:
    """The last line that a fresh Python prints."""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ran.stdout.splitlines()[-1]


def test_the_package_is_imported_at_once():
    code = "import time\nstart = time.process_time()\nimport p2p_lib\nprint(time.process_time() - start)"
    assert float(answer(code)) < 0.3, "seconds of processor time"


METHOD = "import p2p_lib.extended.default as pipeline"
MADE = METHOD + "\nfrom p2p_lib import Camera\npipeline.Point2Pose(Camera(300, 300, 160, 120, 320, 240))"


@pytest.mark.parametrize(("code", "parts"), [(METHOD, 0), (MADE, 3)], ids=["imported", "made with what is built in"])
def test_the_method_loads_neither_datasets_nor_downloads_nor_drawing(code, parts):
    allowed = {"core", "method", "extended", *("trackers", "detectors", "segmenters")[:parts]}
    loaded = answer(f"import sys\n{code}\nprint(*sys.modules)").split()
    ours = {module.split(".")[1] for module in loaded if module.startswith("p2p_lib.")}
    assert {"core", "method", "extended"} <= ours <= allowed
    unwanted = {"pooch", "requests", "urllib3", "tqdm", "pydantic", "PIL", *LAZY} - {"scipy"}
    assert not unwanted & set(loaded)


def test_every_module_imports_without_torch_open3d_and_plots():
    """Importing any file of ours alone must not load them; figures may plot."""
    names = [".".join(path.relative_to(PROJECT).with_suffix("").parts) for path in sources()]
    names = [
        name.removesuffix(".__init__")
        for name in names
        if part(name) not in ("figures", "trackers", "detectors", "segmenters")
    ]
    code = f"import importlib, sys\nfor n in {names!r}: importlib.import_module(n)\n"
    code += "print('LOADED', *[m for m in ('torch', 'open3d', 'matplotlib', 'papermill') if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.stdout.splitlines()[-1:] == ["LOADED"], ran.stdout[-500:] + ran.stderr[-500:]


def test_what_compares_equal_is_sorted_alike_on_every_processor():
    """NumPy's default order of equal values depends on the processor's instructions, and poses on the order."""
    unstable = [
        f"{path.relative_to(PROJECT)}:{node.lineno}"
        for path in sources()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("argsort", "argpartition")
        if not any(word.arg == "kind" and ast.unparse(word.value) == "'stable'" for word in node.keywords)
    ]
    assert not unstable, "say kind='stable'"


def test_files_tell_nothing_of_a_machine_or_registry():
    told = []
    for path in tracked_files():
        if path.suffix in {".png", ".jpg", ".npz", ".npy", ".pdf", ".mp4", ".webp"} or path == Path(__file__):
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if MACHINE.search(line) or REGISTRY.search(line):
                told.append(f"{path.relative_to(PROJECT)}:{number}: {line.strip()[:80]}")
    assert not told, "\n".join(told)


def test_the_patterns_see_what_they_look_for():
    for text in ('open("/root/x")', "cd /work/main", "PATH=/home/ann/bin", "/opt/wheels"):
        assert MACHINE.search(text), text
    # In pieces, so that a search of this very file finds nothing.
    for text in ("https://a.b/" + "simple", "--index" + "-url https://a.b/c", "http://a.b/" + "packages/0a/ff/x.whl"):
        assert REGISTRY.search(text), text
    for text in ("out/work/x", "~/tmp/x", "docs/home/ann", "https://github.com/a/tmp/b"):
        assert not MACHINE.search(text), text
    assert {"ast", "pytest"} <= set(imports(Path(__file__)))
