"""Shared fixtures. The suite passes without any data beside the project; tests that want some say so."""

import html
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import settings

#: A test that is slow on a busy machine is not wrong.
settings.register_profile("suite", deadline=None)
settings.load_profile("suite")

PROJECT = Path(__file__).resolve().parents[1]
#: Fixtures of several packages.
pytest_plugins = ["tests.fixtures.made_run", "tests.fixtures.moving_frames", "tests.fixtures.runs_here"]


NO_GPU = "torch finds no CUDA device"


def _skipped(reporter) -> list[str]:
    """Why tests were."""
    return [str(report.longrepr[2]).removeprefix("Skipped: ") for report in reporter.stats.get("skipped", [])]


def pytest_terminal_summary(terminalreporter):
    """How many tests were skipped for want of what."""
    reasons = _skipped(terminalreporter)
    wants = Counter(reason.partition(". Run:")[0] for reason in reasons)
    terminalreporter.section(f"{len(reasons)} tests skipped" if reasons else "no test skipped")
    for want, count in wants.most_common():
        terminalreporter.write_line(f"{count:5}  {want}")


def pytest_sessionfinish(session):
    """Where everything but a GPU should be there, a test that is skipped has failed."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("P2P_NO_SKIPS") and reporter and set(_skipped(reporter)) - {NO_GPU}:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session", autouse=True)
def compiled_as_declared():
    """Whatever the tests have met, no compiled function was called with types that it does not declare.

    ``warm_up`` compiles the declared ones: another would stop the frame that first meets it for seconds.
    """
    yield
    from p2p_lib.core import compiled

    undeclared = []
    for (module, name), arguments in compiled._arguments.items():
        function = vars(sys.modules[module])[name] if module in sys.modules else None
        if arguments and hasattr(function, "signatures"):
            from numba.core.sigutils import normalize_signature

            declared = {normalize_signature(f"({types},)")[0] for types in arguments}
            undeclared += [f"{module}.{name}{types}" for types in set(function.signatures) - declared]
    assert not undeclared, undeclared


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of third-party test data (``$P2P_SHARED_DATA``, default ``../shared/data``); skips where absent."""
    folder = Path(os.environ.get("P2P_SHARED_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"test data not present at {folder} (set P2P_SHARED_DATA)")
    return folder


@pytest.fixture(scope="session")
def tool():
    """A module of tools/, by its name."""

    def load(name: str):
        spec = importlib.util.spec_from_file_location(name, PROJECT / "tools" / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def opening(tmp_path_factory):
    """Renders some frames of a bundled sequence, so many or a range, for those who look at no others.

    All take half a minute.
    """
    from studies.recovery import excerpt

    def render(name: str, frames: int | range, seed: int = 0):
        return excerpt(name, range(frames) if isinstance(frames, int) else frames, seed, tmp_path_factory.mktemp(name))

    return render


@pytest.fixture
def ctrl_c():
    """Ctrl-C interrupts, also where a shell that runs its jobs in the background has them ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Browser:
    """A headless Chromium that looks at one page at a time."""

    def __init__(self, program: str, home: Path):
        # As root, in a container, without a GPU: the same everywhere.
        self._words = [program, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars"]
        self._words += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run"]
        self._words += [f"--user-data-dir={home}", "--host-resolver-rules=MAP * ~NOTFOUND"]  # nothing from outside

    def dom(self, page: Path, wait_ms: int = 5000, *more: str) -> str:
        """What the page has become once its scripts have run."""
        return self._look("--dump-dom", page, wait_ms, *more).stdout.decode()

    def figures(self, page: Path, wait_ms: int = 10_000) -> list[dict]:
        """Each picture, film and inner page as the browser has it: kind, width, height, shown_px (0: none), alt."""
        return self.seen(page, 1280, wait_ms)[0]

    def seen(self, page: Path, width_px: int, wait_ms: int = 10_000) -> tuple[list[dict], list[str]]:
        """In a window of this width: those, and the tables, drawings and equations that reach beyond it."""
        told = self._probed(page, wait_ms, f"--window-size={width_px},900")
        return told["found"], told["wide"]

    def _probed(self, page: Path, wait_ms: int, *more: str) -> dict:
        text, probe = page.read_text(encoding="utf-8"), page.with_name(f"{page.stem}.probe.html")
        end, script = text.rindex("</body>"), (PROJECT / "tests" / "figures_probe.js").read_text()
        probe.write_text(f"{text[:end]}<script>{script}</script>{text[end:]}", encoding="utf-8")
        try:
            found = re.search(r'<pre id="probe">(.*?)</pre>', self.dom(probe, wait_ms, *more), re.DOTALL)
            return json.loads(html.unescape(found[1]))
        finally:
            probe.unlink()

    def screenshot(self, page: Path, to: Path, size: tuple[int, int] = (1000, 700), wait_ms: int = 5000) -> np.ndarray:
        """(H, W, 3) uint8 of its window; also written to ``to``."""
        self._look(f"--screenshot={to}", page, wait_ms, f"--window-size={size[0]},{size[1]}")
        return cv2.cvtColor(cv2.imread(str(to)), cv2.COLOR_BGR2RGB)

    def _look(self, how: str, page: Path, wait_ms: int, *more: str) -> subprocess.CompletedProcess:
        words = [*self._words, f"--virtual-time-budget={wait_ms}", *more, how, page.resolve().as_uri()]
        return subprocess.run(words, capture_output=True, timeout=180, check=True)


@pytest.fixture(scope="session")
def browser(tmp_path_factory) -> Browser:
    """Skips where there is no Chromium (Debian: apt-get install chromium)."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no chromium on this machine (Debian: apt-get install chromium)")
    return Browser(program, tmp_path_factory.mktemp("browser"))


@pytest.fixture
def exact_cuda(monkeypatch):
    """A GPU that multiplies in full precision; skips where there is none."""
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip(NO_GPU)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    monkeypatch.setattr(torch.backends.cuda.matmul, "allow_tf32", False)
