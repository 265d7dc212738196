"""What users read as pages that need nothing else: ``make docs`` fills out/docs.

The reference from the docstrings, first the names of ``p2p_lib`` itself; README and all that it leads to, of notebooks
their words and code (``make book`` has them executed); a page for the lines of JSON that ``p2p live`` writes and reads.
"""

import json
import re
import shutil
import sys
import warnings
from html import unescape
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules, walk_packages
from typing import get_type_hints
from urllib.parse import unquote

import numpy as np
import pdoc
from markdown2 import markdown
from PIL import Image

import p2p_lib
from p2p_lib.apps.clone import study

ROOT = Path(__file__).resolve().parents[1]
#: What a page has of its own to the suffix of a file and how pages get it.
_SHARED = {"style": ("css", '<link rel="stylesheet" href="{}">'), "script": ("js", '<script src="{}"></script>')}
#: All pages together; without pictures as WebP and shared styles they have several times as much.
_MOST_MB = 10
_EMPTY_LINES = re.compile(r"\n(?:[ \t]*\n)+")
_LINK = re.compile(r"(\]\()([^)\s#:]*)(#[^)\s]*)?\)")
_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
  body {{ margin: 2rem auto; max-width: 60rem; padding: 0 1rem; font: 16px/1.5 system-ui, sans-serif; color: #212529; }}
  table {{ border-collapse: collapse; display: block; overflow-x: auto; }}
  td, th {{ border: 1px solid #ccc; padding: .2rem .5rem; text-align: left; vertical-align: top; }}
  pre {{ background: #f5f5f5; padding: .6rem; overflow-x: auto; }}
  img {{ max-width: 100%; }}
</style>
<p>{links}</p>
{body}
</html>
"""
#: What every page leads to, from the top folder.
_FIRST = {"README": "README.html", "environment": "environment.html", "JSON lines": "docs/json_lines.html"}
_FIRST |= {"contributing": "CONTRIBUTING.html", "changes": "CHANGELOG.html", "reference": "p2p_lib.html"}


def modules():
    """``p2p_lib`` itself and its packages, each of which brings its modules along."""
    found = ["p2p_lib"]
    for module in iter_modules(p2p_lib.__path__, "p2p_lib."):
        if module.name != "p2p_lib.__main__":
            found.append(module.name)
            part = import_module(module.name)
            if hasattr(part, "__all__"):  # which pdoc takes to be all there is
                found += [inner.name for inner in iter_modules(part.__path__, f"{module.name}.")]
    return found


def documents(out):
    """README and every document, image and file that one leads to, as pages; links lead to pages, folders are lists."""
    to_do, done = ["README.md", "environment.md", "CONTRIBUTING.md", "CHANGELOG.md"], set()
    while to_do:
        name = to_do.pop()
        if name in done:
            continue
        done.add(name)
        at = ROOT / name
        linked = []
        if at.is_dir():
            text = "\n".join(f"- [{path.name}]({path.name})" for path in sorted(at.glob("*.md")))
            _write(out, f"{name}/index.html", at.name, _turned(text, f"{name}/index", linked))
        elif at.suffix == ".md":
            text = at.read_text(encoding="utf-8")
            _write(out, _page(name), re.sub("[#*`]", "", text.splitlines()[0]).strip(), _turned(text, name, linked))
        else:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            if at.suffix == ".ipynb":
                _write_notebook(at, out / _page(name))
            elif at.suffix == ".png":
                Image.open(at).save(out / _page(name), quality=80)
            else:
                shutil.copy(at, out / name)
        to_do += linked


def _write_notebook(at, page):
    runner = study("runner")
    runner.write_page(at, page)
    there = {path.stem for path in runner.list_notebooks()}
    page.write_text(runner.as_pages(page.read_text(encoding="utf-8"), there), encoding="utf-8")


def _turned(text, name, linked):
    """A document's text with links to pages; ``linked`` gets the files that it leads to."""

    def turn(found):
        if not found[2]:
            return found[0]
        target = (ROOT / name).parent.joinpath(found[2]).resolve().relative_to(ROOT).as_posix()
        linked.append(target)
        if (ROOT / target).is_dir():
            return f"{found[1]}{found[2].rstrip('/')}/index.html)"
        return f"{found[1]}{_page(found[2])}{found[3] or ''})"

    return _LINK.sub(turn, text)


def _page(name):
    """What a file of the repository is called here; pictures are smaller as WebP."""
    return re.sub(r"\.png$", ".webp", re.sub(r"\.(md|ipynb)$", ".html", name))


def _write(out, name, title, text):
    up = "../" * name.count("/")
    links = " · ".join(f'<a href="{up}{where}">{word}</a>' for word, where in _FIRST.items())
    extras = {"fenced-code-blocks": None, "header-ids": {"reset-count": True}, "tables": None, "cuddled-lists": None}
    page = _PAGE.format(title=title, links=links, body=markdown(text, extras=extras))
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text(page, encoding="utf-8")


def json_lines(out):
    """What the guides say of the lines, and two of them as they are written."""
    from p2p_lib.apps.live import json_line
    from p2p_lib.apps.live_words import Words
    from p2p_lib.core import se3
    from p2p_lib.core.types import PoseEstimate, Status

    said = ""
    for page, part in (("user_guide", "A camera"), ("python", "Estimates")):
        text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
        said += re.search(rf"\n## {part}\n.*?\n(?=## )", text, re.DOTALL)[0]
    T_cam_obj = se3.exp(np.array([0, 0, 0, 0.1, 0.0, 0.6])).round(3)
    seen = PoseEstimate("mug", 31, 1.033, Status.TRACKED, T_cam_obj, 0.93, np.diag([4.0, 4, 9, 1, 1, 1]) * 1e-6)
    gone = PoseEstimate("mug", 32, 1.067, Status.OCCLUDED, reason="not found since frame 32")
    lines = "\n\n".join(f"```json\n{json_line(estimate)}\n```" for estimate in (seen, gone))
    title, words = "Lines of JSON", Words.__doc__.replace("``", "`").replace("    ", "")
    said = _turned(said, "docs/json_lines.md", [])
    text = f"# {title}\n{said}\n## Out\n\n{lines}\n\n## In\n\n{re.sub(r':meth:', '', words)}\n"
    _write(out, "docs/json_lines.html", title, text)


def _share(out):
    """Styles and scripts, which pdoc and notebooks repeat on every page, become files; links to what is left out go.

    So do empty lines outside of code, which weigh a tenth of a megabyte.
    """
    files = {}
    for page in [out / "p2p_lib.html", *out.glob("p2p_lib/**/*.html"), *out.glob("notebooks/*.html")]:
        text = page.read_text(encoding="utf-8")
        up = "../" * (len(page.relative_to(out).parts) - 1)

        def linked(found, up=up):
            suffix, link = _SHARED[found[1]]
            name = files.setdefault(found[2], f"shared{len(files)}.{suffix}")
            return link.format(up + name)

        text = re.sub(r'<(style|script)(?: type="text/css")?>(.*?)</\1>', linked, text, flags=re.DOTALL)
        text = re.sub(r'<a href="#_\w+">(.*?)</a>', r"\1", text)
        parts = re.split(r"(<pre\b.*?</pre>)", text, flags=re.DOTALL)
        parts[::2] = (_EMPTY_LINES.sub("\n", part) for part in parts[::2])
        page.write_text("".join(parts), encoding="utf-8")
    for content, name in files.items():
        (out / name).write_text(content, encoding="utf-8")


def dead_links(out):
    """What pages lead to that is not there, files and places in them."""
    pages = {path.resolve(): path.read_text(encoding="utf-8") for path in out.rglob("*.html")}
    places = {path: set(re.findall(r'\bid="([^"]+)"', text)) for path, text in pages.items()}
    for path, text in pages.items():
        text = re.sub(r"<(script|svg)\b.*?</\1>", "", text, flags=re.DOTALL)
        for link in sorted(set(re.findall(r'\b(?:href|src)="([^"]+)"', text))):
            where, _, place = unescape(link).partition("#")
            if re.match(r"[a-z]+:", where):
                continue
            target = (path.parent / unquote(where)).resolve() if where else path
            if not target.is_file() or (place and unquote(place) not in places.get(target, {unquote(place)})):
                yield f"{path.relative_to(out.resolve())}: {link}"


def too_large(out):
    """What is to be said of pages that weigh more than a reference should."""
    weight_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    if weight_mb > _MOST_MB:
        yield f"The reference has {weight_mb:.1f} MB, expected at most {_MOST_MB}."


def _index(documents, _):
    """What the search reads, as the browser does it where there is no node: compiled it is ten times as large.

    Signatures are plain: the marks around their words would be a tenth of all pages.
    """
    plain = [
        d | {"signature": re.sub(r"</?span[^>]*>", "", d["signature"])} if "signature" in d else d for d in documents
    ]
    return json.dumps(plain)


def write(out):
    """Render all; whatever cannot be imported or resolved is an error, not a gap."""
    for name in p2p_lib.__all__:  # pdoc sees what is there, not what is loaded when asked for
        setattr(p2p_lib, name, getattr(p2p_lib, name))
    for module in walk_packages(p2p_lib.__path__, "p2p_lib."):
        for kind in vars(import_module(module.name)).values() if module.name != "p2p_lib.__main__" else ():
            if isinstance(kind, type) and hasattr(kind, "_fields"):  # pdoc cannot read what a NamedTuple is made of
                kind.__new__.__annotations__ = get_type_hints(kind)
    pdoc.render.precompile_index = _index
    # Sources are beside the documents, and would be most of the pages.
    pdoc.render.configure(docformat="google", search=True, math=False, show_source=False)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="pdoc")
        pdoc.pdoc(*modules(), output_directory=out)
    documents(out)
    json_lines(out)
    _share(out)
    shutil.copy(out / "README.html", out / "index.html")
    if dead := list(dead_links(out)):
        sys.exit("\n".join(["These links of the reference lead nowhere:", *dead]))
    if heavy := list(too_large(out)):
        sys.exit("\n".join(heavy))
    return out / "index.html"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "docs"
    print(f"Look at {write(folder)}")
