"""One place for colours and type: what is an object's colour, what is a status's, and how a plot looks.

Eight objects differ for the colour-blind, too. Green, yellow and vermillion of Okabe and Ito (2008) are kept for
statuses, whose strips are hatched besides, so that they survive a black-and-white printer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from p2p_lib.core.colours import OBJECTS as OBJECTS
from p2p_lib.core.colours import object_colours as object_colours
from p2p_lib.core.colours import rgb as rgb
from p2p_lib.core.packages import needed_for
from p2p_lib.core.types import Status

#: Statuses: fill and hatch. Tracked is the quiet one.
STATUS: dict[str, tuple[str, str]] = {
    Status.INITIALISING: ("#FFFFFF", "...."),
    Status.TRACKED: ("#D9D9D9", ""),
    Status.DEGRADED: ("#F0E442", "\\\\\\\\"),
    Status.OCCLUDED: ("#6F6F6F", "////"),
    Status.LOST: ("#D55E00", "xxxx"),
    Status.RECOVERED: ("#009E73", ""),
}
#: Methods, or anything else that is compared side by side, in that order: none is an object's or a status's colour.
METHODS = ("#5511DD", "#557711", "#AA99CC", "#114411", "#BB8888", "#885566", "#44BB11")
#: The truth, wherever it stands beside an estimate.
TRUTH = "#FFFFFF"
#: x, y and z of a drawn frame.
AXES = ("#D55E00", "#009E73", "#0072B2")
#: Processing stages, and anything else that is neither an object nor a status.
NEUTRAL = ("#4D4D4D", "#B3B3B3")

_RC = {
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "savefig.facecolor": "white",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E5E5E5",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "p2p",
}


def ink(colour: str) -> str:
    """Black or white, whichever reads better on this colour (relative luminance of WCAG 2)."""
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb(colour))]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return "#000000" if luminance > 0.179 else "#FFFFFF"


@contextmanager
def applied() -> Iterator[None]:
    """Matplotlib with this style inside the ``with``, untouched outside. Needed when drawing and when saving."""
    with needed_for("notebooks"):
        import matplotlib

    with matplotlib.rc_context(_RC):
        yield


#: Decorates a function that draws with this style.
styled = applied()
