"""Figures, films and tables are written here alone, each with a note of what it was made from.

Figures and films go to ``$P2P_FIGURES`` (else ``figures/`` of the project), tables to ``$P2P_TABLES`` (else
``out/tables/``). Beside ``NAME.png`` lies ``NAME.json``: parameters, what was read, versions, commit, and a digest of
the code that decides the numbers; of a notebook's quick profile without the digest, which takes a second. Neither
holds a time or a folder of this machine, so that the same work gives the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pandas import DataFrame
from PIL import Image

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.plan import Plan, read_plan
from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput
from p2p_lib.core.packages import needed_for
from p2p_lib.core.tables import as_html, as_markdown
from p2p_lib.datasets.download import sha256
from p2p_lib.datasets.provenance import code_digest, provenance
from p2p_lib.datasets.runs import Run
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.figures import style
from p2p_lib.figures.film import write_video
from p2p_lib.figures.tables import Table

_WHAT_RAN = "sequence objects start stop frames tracker masks preset seed commit modified".split()
#: Of the code, not of the data; the name of a run holds the commit, too.
_OF_THE_CODE = {"versions", "commit", "modified", "run", "runs", "cpu_min"}
_SHOWN_PX = 900  # a notebook shows images at most this wide


@dataclass(frozen=True, eq=False)
class Saved:
    """What was written, and how a notebook shows it: the last expression of a cell, with its caption below."""

    path: Path
    shown: tuple[dict[str, Any], dict[str, Any]]
    caption: str = ""

    def _ipython_display_(self) -> None:
        from IPython.display import publish_display_data

        publish_display_data(*self.shown)
        if self.caption:
            publish_display_data({"text/markdown": f"<small>{self.caption}</small>", "text/plain": self.caption})


def save_figure(
    figure: Any,
    name: str,
    caption: str = "",
    *,
    sources: Iterable[Any] = (),
    parameters: Mapping[str, Any] | None = None,
    to: Path | None = None,
) -> Saved:
    """Write a Matplotlib figure as PNG and PDF, or an image (H, W, 3) uint8 as PNG, with its note.

    Of a quick form a PNG alone, and not as small as it could be: to draw twice and to pack tightly takes longest.

    caption     whole sentences that say what is seen to somebody who reads nothing else; also the alternative text
    sources     what it was drawn from: runs, evaluations, sequences, files
    parameters  what decided how it was made: profile, seed, ...
    to          another folder than that of the figures
    """
    sources = list(sources)
    quick = _is_quick(sources, parameters)
    target = _target(to or paths.figure_dir(), name, quick)
    png = target.with_name(f"{name}.png")
    if isinstance(figure, np.ndarray):
        if figure.ndim != 3 or figure.shape[2] != 3 or figure.dtype != np.uint8:
            raise BadInput(f"figure {name}", f"{figure.shape} {figure.dtype}", "(H, W, 3) uint8, red first")
        Image.fromarray(figure).save(png, optimize=not quick)
        width_px, suffixes, drawn_with = figure.shape[1], [".png"], []
    else:
        with style.applied():
            figure.savefig(png, metadata={"Software": None})
            if not quick:
                figure.savefig(png.with_suffix(".pdf"), metadata={"CreationDate": None})
            width_px = round(figure.get_figwidth() * figure.dpi)
        suffixes, drawn_with = [".png"] if quick else [".png", ".pdf"], ["matplotlib"]
    _write_note(target, suffixes, sources, parameters, drawn_with, caption)
    shown = {"image/png": base64.b64encode(png.read_bytes()).decode(), "text/plain": f"<{name}.png>"}
    look = {"width": min(width_px, _SHOWN_PX), "alt": _plain_words(caption) or name.replace("_", " ")}
    return Saved(png, (shown, {"image/png": look}), caption)


def save_video(
    images: Iterable[np.ndarray],
    name: str,
    caption: str = "",
    *,
    fps: float = 30.0,
    sources: Iterable[Any] = (),
    parameters: Mapping[str, Any] | None = None,
) -> Saved:
    """Write images as a film (see :func:`write_video`) with its note; shown embedded."""
    with needed_for("notebooks"):
        from IPython.display import Video

    sources = list(sources)
    target = _target(paths.figure_dir(), name, _is_quick(sources, parameters))
    path = write_video(images, target.with_name(f"{name}.mp4"), fps)
    _write_note(target, [path.suffix], sources, {**(parameters or {}), "fps": fps}, ["av"], caption)
    # The whole film is inside the page, so that exported pages play it too.
    words = f'aria-label="{html.escape(_plain_words(caption))}" controls autoplay loop muted playsinline'
    page = Video(str(path), embed=True, html_attributes=words)._repr_html_()
    return Saved(path, ({"text/html": page, "text/plain": f"<{path.name}>"}, {}), caption)


def save_table(
    table: DataFrame | Table,
    name: str,
    caption: str = "",
    *,
    sources: Iterable[Any] = (),
    parameters: Mapping[str, Any] | None = None,
    to: Path | None = None,
) -> Saved:
    """Write a table as CSV and Markdown, one for papers as LaTeX besides, with its note; ``to`` another folder."""
    target = _target(to or paths.table_dir(), name)
    if isinstance(table, Table):
        files, page = table.files(), table.html()
    else:
        files = {".csv": table.to_csv(index=False, lineterminator="\n"), ".md": as_markdown(table)}
        page = as_html(table)
    for suffix, text in files.items():
        target.with_name(f"{name}{suffix}").write_text(text, encoding="utf-8")
    _write_note(target, list(files), sources, parameters, ["pandas"], caption)
    return Saved(target.with_name(f"{name}.csv"), ({"text/html": page, "text/plain": files[".md"]}, {}), caption)


def describe(source: Any) -> dict[str, Any]:
    """What a note says of a source: its kind, what ran, and checksums where they are cheap."""
    if isinstance(source, Run):
        ran, config = _what_ran(source.info), source.path / "config.toml"
        # All that decides a run's poses: its parameters and what ran on what.
        text = json.dumps(ran, sort_keys=True) + (config.read_text() if config.is_file() else "")
        name = hashlib.sha256(text.encode()).hexdigest()[:12]
        return {"run": name, **ran, "poses_sha256": _sha256(source.path / "poses.npz")}
    if isinstance(source, Evaluation):
        return {"evaluation": _what_ran(source.info), "align": source.align}
    if isinstance(source, Benchmark):
        keys = sorted({outcome.key for _, outcome in source.results if outcome.status == "done"})
        source_info = {"benchmark": source.plan.name, "profile": source.profile}
        source_info["plan"] = _plan_digest(source.plan, source.profile)
        return {**source_info, "cpu_min": round(source.cpu_min, 1), "runs": keys}
    if isinstance(source, str | Path):
        path = Path(source)
        return _folder(path) if path.is_dir() else {"file": path.name, "sha256": _sha256(path)}
    if hasattr(source, "frame") and hasattr(source, "camera"):
        files = [source.path / name for name in ("cam_K.txt", "scenario.json")] if source.path else []
        checksums = {file.name: _sha256(file) for file in files if file.is_file()}
        first = source.frame(0)
        checksums["first frame"] = hashlib.sha256(first.rgb.tobytes() + first.depth_m.tobytes()).hexdigest()
        return {"sequence": source.name, "format": source.format, "frames": len(source), "sha256": checksums}
    raise BadInput("figure source", type(source).__name__, "a Run, an Evaluation, a Benchmark, a Sequence, or a file")


def earlier(note: Mapping[str, Any]) -> bool:
    """Whether a table or figure was measured by other code than this, or as its plan does not say any more."""
    measured = False
    for source in note["sources"]:
        if "benchmark" in source:
            measured |= bool(source["runs"])
            if source.get("plan") != _plan_digest(read_plan(source["benchmark"]), source["profile"]):
                return True
        measured |= "run" in source or "evaluation" in source
    return measured and note.get("code") != code_digest()


def _plan_digest(plan: Plan, profile: str) -> str:
    """Of what decides the profile's results: what its other one runs does not."""
    text = plan.model_dump_json(exclude_defaults=True, exclude={"quick", "full"} - {profile})
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _plain_words(caption: str) -> str:
    """A caption without the marks of Markdown and TeX."""
    return " ".join(re.sub(r"[*`$\\{}]", "", caption).split())


def _what_ran(info: Mapping[str, Any]) -> dict[str, Any]:
    return {key: info.get(key) for key in _WHAT_RAN} | ({"offline": True} if info.get("offline") else {})


def _folder(path: Path) -> dict[str, Any]:
    """A folder's name, how many files it holds, and a checksum of their names and contents."""
    files = sorted(file for file in path.rglob("*") if file.is_file())
    listed = "".join(f"{sha256(file)}  {file.relative_to(path).as_posix()}\n" for file in files)
    return {"folder": path.name, "files": len(files), "sha256": hashlib.sha256(listed.encode()).hexdigest()}


def _sha256(path: Path) -> str | None:
    return sha256(path) if path.is_file() else None


def _is_quick(sources: Iterable[Any], parameters: Mapping[str, Any] | None) -> bool:
    """Whether a figure is of a quick form: of few frames of bundled data."""
    profiles = {source.profile for source in sources if isinstance(source, Benchmark)}
    return "quick" in profiles | {(parameters or {}).get("PROFILE")}


def _target(folder: Path, name: str, quick: bool = False) -> Path:
    """The path of NAME, without a suffix. A quick form goes into ``quick/`` where a full one of this name lies."""
    if not re.fullmatch(r"\w[\w-]*", name):
        raise BadInput("figure name", repr(name), "letters, digits, '_' and '-': it names files")
    note = folder / f"{name}.json"
    if quick and note.is_file():
        before = json.loads(note.read_text(encoding="utf-8"))
        profiles = {source.get("profile") for source in before["sources"]} | {before["parameters"].get("PROFILE")}
        folder = folder / "quick" if "quick" not in profiles else folder
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


def _write_note(
    target: Path,
    suffixes: list[str],
    sources: Iterable[Any],
    parameters: Mapping[str, Any] | None,
    drawn_with: list[str],
    caption: str,
) -> None:
    from importlib.metadata import version

    made = provenance()
    made["versions"] |= {name: version(name) for name in drawn_with}
    files = {f"{target.name}{suffix}": _sha256(target.with_name(f"{target.name}{suffix}")) for suffix in suffixes}
    quick = (parameters or {}).get("PROFILE") == "quick"
    note = {
        **({"caption": caption} if caption else {}),
        "parameters": dict(parameters or {}),
        "sources": [describe(source) for source in sources],
        **made,
        **({} if quick else {"code": code_digest()}),
        "sha256": files,
    }
    path, text = target.with_name(f"{target.name}.json"), json.dumps(note, ensure_ascii=False, default=_plain)
    note = json.loads(text)
    if path.is_file() and _of_the_data(json.loads(path.read_text(encoding="utf-8"))) == _of_the_data(note):
        return  # other code made the same of the same: the note of the first stands, so that nothing has changed
    path.write_text(json.dumps(note, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _of_the_data(note: Any) -> Any:
    """A note, or a part of it, without what it says of the code."""
    if isinstance(note, dict):
        return {key: _of_the_data(value) for key, value in note.items() if key not in _OF_THE_CODE}
    return [_of_the_data(value) for value in note] if isinstance(note, list) else note


def _plain(value: Any) -> Any:
    """As JSON holds a dataclass, a path (by its last part alone) or an array."""
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return value.name if isinstance(value, Path) else value.tolist()
