"""The API reference as pages that need nothing else, from the docstrings: ``make docs`` fills out/docs.

What users call comes first: the names of ``p2p_lib`` itself. Behind it are all modules.
"""

import sys
import warnings
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pdoc

import p2p_lib

ROOT = Path(__file__).resolve().parents[1]


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


def write(out):
    """Render all; whatever cannot be imported or resolved is an error, not a gap."""
    for name in p2p_lib.__all__:  # pdoc sees what is there, not what is loaded when asked for
        setattr(p2p_lib, name, getattr(p2p_lib, name))
    pdoc.render.configure(docformat="google", search=True, math=False)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="pdoc")
        pdoc.pdoc(*modules(), output_directory=out)
    return out / "index.html"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "docs"
    print(f"Look at {write(folder)}")
