"""The notebooks of the suite: list, run headless, and collect what their last cells recorded.

A notebook has one cell tagged ``parameters`` (literals alone, ``PROFILE`` among them) and ends with a cell tagged
``checks`` that calls :func:`studies.claims.check` with what it claims. Whatever a run leaves behind is read
back from the executed notebook, so that the gallery, the tests and a later visitor see the same.
"""

from __future__ import annotations

import ast
import logging
import os
import re
import signal
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from p2p_lib.core.errors import BadInput, MissingData, P2PError, did_you_mean
from p2p_lib.core.packages import needed_for
from studies import CLONE, course, equations
from studies.claims import CHECKS_MIME, Claim, Value

if TYPE_CHECKING:
    from nbformat import NotebookNode

#: The folder of the notebooks.
NOTEBOOKS = CLONE / "notebooks"

#: ``quick``: bundled data, CPU. ``full``: the data and backends that are present. Each with what it takes on two cores.
PROFILES = {"quick": "some minutes", "full": "a quarter of an hour without data of yours, hours with it"}


class NotebookFailed(P2PError):
    """A cell of a notebook raised: names the notebook, the cell as ``[n]``, and its message."""


@dataclass(frozen=True)
class NotebookResult:
    """What one executed notebook holds.

    name       file name without suffix, e.g. ``00_quickstart``
    title      its first heading
    executed   the executed notebook; its page for the browser is beside it with the suffix ``.html``
    seconds    wall-clock time of the whole run
    checks     what the last cell claims
    image_png  its first image in base64, or empty
    error      empty, or the cell and the message that ended the run
    changed    the parameters that it was run with instead of its own, in words
    """

    name: str
    title: str
    executed: Path
    seconds: float
    checks: tuple[Claim, ...]
    image_png: str
    error: str
    changed: str


def list_notebooks(folder: Path | None = None, only: Sequence[str] = ()) -> list[Path]:
    """The notebooks ``NN_*.ipynb`` of a folder in order; ``only`` picks by number (``"03"``, ``"3"``) or by name."""
    folder = folder or NOTEBOOKS
    found = sorted(folder.glob("[0-9][0-9]_*.ipynb"))
    if not found:
        raise MissingData(str(folder), "no notebooks NN_*.ipynb there", "Run from a clone of the repository.")
    picked = {}
    for wanted in map(str, only):
        matches = [path for path in found if wanted.removesuffix(".ipynb").zfill(2) in (path.stem, path.stem[:2])]
        if not matches:
            known = [path.stem for path in found]
            raise BadInput("notebook", repr(wanted), "one of " + ", ".join(known), did_you_mean(wanted, known))
        picked.update(dict.fromkeys(matches))
    return sorted(picked) if only else found


def run_notebooks(
    profile: str = "quick",
    only: Sequence[str] = (),
    out: Path | None = None,
    jobs: int = 1,
    parameters: Mapping[str, Any] | None = None,
    *,
    folder: Path | None = None,
    say: Callable[[str], None] = print,
) -> list[NotebookResult]:
    """Run the notebooks, write executed copies, pages, images, tables and a gallery.

    only        numbers or names of notebooks; all by default
    out         folder of the results, default ``out/<profile>``, beside it with other parameters, named by them; images
                of the full profile go to ``figures/`` by default.
                Notebooks find their folders in ``$P2P_FIGURES``, ``$P2P_TABLES`` and ``$P2P_RUNS``
    jobs        how many run at a time; one: in order, more: from the last one on
    parameters  of the notebooks, besides ``PROFILE``; a string is read as the kind of value the notebook has
    folder      where the notebooks are, default ``notebooks/`` of the project
    say         is told of progress, line by line

    Raises :class:`BadInput` for unknown parameters and :class:`MissingBackend` for an extra that a notebook lacks,
    both before anything runs, and :class:`NotebookFailed` at the first notebook with a failing cell; what ran so far is
    on disk and in the gallery.
    """
    with needed_for("notebooks"):
        for package in ("jinja2", "nbconvert", "papermill"):
            import_module(package)
    if profile not in PROFILES:
        raise BadInput("profile", repr(profile), "one of " + ", ".join(PROFILES))
    if jobs < 1:
        raise BadInput("jobs", jobs, "at least 1")
    paths = list_notebooks(folder, only)
    if "PROFILE" in (parameters or {}):
        fix = "The profile is chosen by --profile, in Python by profile=."
        raise BadInput("parameter", "PROFILE", "one of a notebook's others", fix)
    given = {**(parameters or {}), "PROFILE": profile}
    for one in course.LESSONS:
        if one.name in {path.stem for path in paths}:
            one.check_installed()
    plans = [(path, _fitting_parameters(path, given)) for path in paths]
    own = [re.sub(r"[^\w.]+", "-", f"{name}={value}") for name, value in (parameters or {}).items()]
    home = (out or CLONE / "out" / "_".join([profile, *own])).resolve()
    figures = CLONE / "figures" if profile == "full" and out is None and not own else home / "figures"
    places = {"P2P_FIGURES": figures, "P2P_TABLES": home / "tables", "P2P_RUNS": home / "runs"}
    for place in (home / "notebooks", *places.values()):
        place.mkdir(parents=True, exist_ok=True)
    for path in paths:  # nothing of an earlier run passes for one of this
        for suffix in (".ipynb", ".html"):
            (home / "notebooks" / path.name).with_suffix(suffix).unlink(missing_ok=True)

    takes = "" if only else f" (all of them take {PROFILES[profile]})"
    images = f", images in {_near(figures)}" if figures.parent != home else ""
    say(f"{_counted(plans)}, profile {profile}, results in {_near(home)}{images}{takes}")
    results: list[NotebookResult] = []
    kernels: list[Any] = []
    pool = ThreadPoolExecutor(jobs)
    # The long ones are among the last, and what begins last should be short: in the end it runs alone.
    order = plans if jobs == 1 else plans[::-1]
    runs = {
        path: pool.submit(_run_one, path, home, values, _kernel_manager(path.parent, places, kernels), say)
        for path, values in order
    }
    try:
        for path in paths:
            results.append(runs[path].result())
            if results[-1].error:
                page = _near(results[-1].executed.with_suffix(".html"))
                raise NotebookFailed(f"notebook {results[-1].name}, {results[-1].error}. See {page}")
    except KeyboardInterrupt:
        for kernel in kernels:
            kernel.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        index = write_gallery(home, profile)
    say(f"Look at {_near(index)}, which has all that ran there; images are in {_near(figures)}/")
    return results


def notebook_parameters(path: Path) -> dict[str, Value]:
    """Names and values in the cell tagged ``parameters``, which holds assignments of literals and nothing else."""
    source = "\n".join(cell.source for cell in _read(path).cells if "parameters" in cell.metadata.get("tags", []))
    values = {}
    try:
        statement: Any
        for statement in ast.parse(source).body:
            target: Any = statement.target if isinstance(statement, ast.AnnAssign) else statement.targets[0]
            values[target.id] = ast.literal_eval(statement.value)
    except (SyntaxError, ValueError, AttributeError, TypeError):
        raise BadInput(f"{path.name}: parameters", repr(source), "lines of the form NAME = literal") from None
    return values


def read_result(executed: Path) -> NotebookResult:
    """What an executed notebook says of its run."""
    notebook = _read(executed)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    outputs = [(cell, output) for cell in code for output in cell.outputs]
    kept = [row for _, output in outputs for row in output.get("data", {}).get(CHECKS_MIME, ())]
    images = [output.data["image/png"] for _, output in outputs if "image/png" in output.get("data", {})]
    errors = [
        f"cell [{cell.execution_count}] {_failing_line(cell.source, output)!r}: "
        + " ".join(f"{output['ename']}: {output['evalue']}".split()).removesuffix(":")
        for cell, output in outputs
        if output.output_type == "error"
    ]
    errors += [
        f"cell {cell.source.splitlines()[0]!r}: the kernel ended there (killed, or out of memory)"
        for cell in code
        if cell.source.strip() and "shell.execute_reply" not in cell.metadata.get("execution", {})
    ]
    titles = re.findall(r"(?m)^# +(.+)$", "\n".join(c.source for c in notebook.cells if c.cell_type == "markdown"))
    return NotebookResult(
        name=executed.stem,
        title=[*titles, executed.stem][0].strip(),
        executed=executed,
        seconds=float(notebook.metadata.get("papermill", {}).get("duration") or 0.0),
        checks=tuple(Claim(**row) for row in kept),
        image_png="".join(images[0].split()) if images else "",
        error=errors[0] if errors else "",
        changed=_changed(notebook, notebook_parameters(executed)),
    )


def _changed(notebook: NotebookNode, own: Mapping[str, Value]) -> str:
    """The parameters that an executed notebook was given and that are not those that its source has."""
    given = notebook.metadata.get("papermill", {}).get("parameters") or {}
    return ", ".join(f"{name}={value}" for name, value in given.items() if name != "PROFILE" and own.get(name) != value)


def write_gallery(home: Path, profile: str) -> Path:
    """``index.html`` over all executed notebooks in ``home/notebooks``: title, first image, seconds, checks.

    It and their pages link to each other, and to nothing that was not run.
    """
    import jinja2

    results = [read_result(path) for path in sorted((home / "notebooks").glob("*.ipynb"))]
    there = {result.name for result in results}
    for page in (home / "notebooks").glob("*.html"):
        page.write_text(as_pages(page.read_text(encoding="utf-8"), there), encoding="utf-8")
    seconds, claims = sum(r.seconds for r in results), sum(len(r.checks) for r in results)
    templates = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True)
    html = templates.get_template("gallery.html").render(
        title=f"Point2Pose notebooks, profile {profile}",
        summary=f"{_counted(results)}, {seconds:.0f} s, {claims} claims checked",
        diagram=as_pages(course.diagram().replace('href="', 'href="notebooks/'), there),
        missing=[lesson.name for lesson in course.LESSONS if lesson.name not in there],
        lessons={lesson.name: lesson for lesson in course.LESSONS},
        failed=sum(bool(result.error) for result in results),
        results=results,
    )
    page = home / "index.html"
    page.write_text(html, encoding="utf-8")
    return page


def _run_one(
    source: Path, home: Path, values: dict[str, Value], kernel_manager: type, say: Callable[[str], None]
) -> NotebookResult:
    """Execute one notebook; a failing cell ends up in the result, not in an exception."""
    import papermill
    from nbclient.exceptions import DeadKernelError

    logging.getLogger("papermill").setLevel(logging.ERROR)  # it warns of widgets that a page does not have
    executed = home / "notebooks" / source.name
    say(f"{source.stem} ...")
    with suppress(papermill.PapermillExecutionError, DeadKernelError):  # the executed notebook says so, and where
        papermill.execute_notebook(
            source,
            executed,
            parameters=values,
            kernel_name="python3",
            kernel_manager_class=kernel_manager,
            progress_bar=False,
        )
    write_page(executed, executed.with_suffix(".html"))
    result = read_result(executed)
    outcome = "FAILED" if result.error else f"{len(result.checks)} claims checked"
    say(f"{source.stem}: {result.seconds:.1f} s, {outcome}")
    return result


def _kernel_manager(folder: Path, places: Mapping[str, Path], kernels: list[Any]) -> type:
    """A manager whose kernels run in a folder, talk over private sockets (TCP warns) and know this run's places.

    Each joins ``kernels`` when started, so that all can be ended at once.
    """
    from jupyter_client.manager import AsyncKernelManager

    environment = {
        **{name: str(place) for name, place in places.items()},
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "OPEN3D_DISABLE_WEB_VISUALIZER": "true",
        "PYTHONHASHSEED": "0",
        "P2P_PROGRESS": "off",  # a bar of the notebook's own is blank in a page
        # A copy of a notebook, elsewhere, finds what it shares with the others, too.
        "PYTHONPATH": os.pathsep.join(filter(None, [str(NOTEBOOKS), os.environ.get("PYTHONPATH")])),
    }

    class Manager(AsyncKernelManager):
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            self._folder = tempfile.TemporaryDirectory(prefix="p2p-")  # goes with the manager
            self.transport, self.ip = "ipc", str(Path(self._folder.name) / "kernel")

        async def start_kernel(self, **options: Any) -> None:  # type: ignore[override]
            # What a cell raises is in the notebook; a kernel logs besides that it was interrupted when it is shut down.
            quiet = [*options.pop("extra_arguments", ()), "--log-level=CRITICAL"]
            # Papermill's own cwd moves the whole process there and back, which two notebooks at a time get in a tangle.
            options |= {"extra_arguments": quiet, "env": {**os.environ, **environment}, "cwd": str(folder.resolve())}
            await super().start_kernel(**options)
            kernels.append(self)

        def kill(self) -> None:
            provisioner: Any = self.provisioner
            with suppress(ProcessLookupError):  # it has ended by itself
                os.killpg(os.getpgid(provisioner.pid), signal.SIGKILL)

    return Manager


def _fitting_parameters(path: Path, given: Mapping[str, Any]) -> dict[str, Value]:
    """The given values as this notebook's kinds of value; papermill would only warn of one that it does not have."""
    known = notebook_parameters(path)
    values = {}
    for name, value in given.items():
        if name not in known:
            fix = did_you_mean(name, known) or "Pick the notebooks that have it with --only."
            others = ", ".join(own for own in known if own != "PROFILE")
            raise BadInput(f"{path.stem} parameter", name, f"one of {others}" if others else "none: it has none", fix)
        kind = type(known[name])
        try:
            values[name] = TypeAdapter(kind).validate_python(value, strict=not isinstance(value, str))
        except ValidationError:
            expected = f"{kind.__name__} like {known[name]!r}"
            raise BadInput(f"{path.stem} parameter {name}", repr(value), expected) from None
    return values


def write_page(notebook: Path, page: Path) -> None:
    """A notebook, executed or not, as a page for the browser; nothing in it is fetched from the network.

    Its links are to notebooks, until the gallery knows which of their pages are there.
    """
    from nbconvert import HTMLExporter
    from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

    class Renderer(IPythonRenderer):
        def block_math(self, body: str) -> str:
            return equations.mathml(body, display=True)

        def inline_math(self, body: str) -> str:
            return equations.mathml(body)

    def as_html(source: str) -> str:
        return MarkdownWithMath(renderer=Renderer(escape=False)).render(source)

    template = Path(__file__).with_name("notebook.html").read_text(encoding="utf-8")
    exporter = HTMLExporter(embed_images=True, raw_template=template)
    exporter.register_filter("markdown2html", as_html)
    body, _ = exporter.from_filename(str(notebook), resources={"equation_style": equations.STYLE})
    page.write_text(body, encoding="utf-8")


def as_pages(html: str, there: Collection[str]) -> str:
    """Links from notebook to notebook as links to the pages that are there; others wait for theirs as ``data-href``."""

    def link(found: re.Match[str]) -> str:
        folder, name = found.groups()
        return f'{"" if name in there else "data-"}href="{folder}{name}.html"'

    return re.sub(r'(?:data-)?href="([\w/]*?)(\d\d_\w+)\.(?:ipynb|html)"', link, html)


def _read(path: Path) -> NotebookNode:
    import nbformat

    try:
        return nbformat.read(path, as_version=4)
    except (nbformat.reader.NotJSONError, UnicodeDecodeError):
        raise BadInput(path.name, "a file that is not JSON", "a Jupyter notebook (.ipynb)") from None


def _failing_line(source: str, error: Mapping[str, Any]) -> str:
    """The line of the cell that raised, else its first."""
    lines = source.splitlines() or [""]
    plain = re.sub(r"\x1b\[[0-9;]*m", "", "\n".join(error["traceback"]))
    at = re.search(r"(?m)^-+> +(\d+) ", plain)
    return lines[min(int(at[1]), len(lines)) - 1 if at else 0].strip()


def _counted(notebooks: Sequence[Any]) -> str:
    return f"{len(notebooks)} notebook{'s' * (len(notebooks) != 1)}"


def _near(path: Path) -> Path:
    """The path as seen from the current folder where it lies below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
