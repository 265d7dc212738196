"""The pipeline of preset ``default`` as one diagram: its stages in the order of a run, and where each is kept.

The paper's figure "Overview of the framework", drawn from :data:`STAGES`: the names under which the pipeline takes its
times.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from p2p_lib.core.errors import BadInput
from p2p_lib.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BOX, _GRID, _MODEL = (1.24, 0.5), (1.42, 0.94), "#F1EFE9"
_FLOW = {"arrowstyle": "-|>", "color": "#333333", "lw": 1.0, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}


@dataclass(frozen=True)
class Stage:
    """One box.

    title     what it does; ``source``, the module or package that does
    notebook  number of the notebook about it
    at        its column and row
    ours      whether the paper does without it
    """

    title: str
    source: str
    notebook: str
    at: tuple[float, float]
    ours: bool = False


#: By the name that the pipeline's stopwatch and ``timings.csv`` have for it; judging takes no time worth a name. In the
#: order in which a frame that becomes a keyframe meets them.
STAGES = {
    "tracking": Stage("track points", "trackers/", "01", (1, 2)),
    "scene": Stage("locate camera", "extended/scene.py", "07", (4, 2), True),
    "search": Stage("search", "extended/image_search.py", "07", (3, 2), True),
    "segmentation": Stage("segment", "segmenters/", "10", (2, 2)),
    "observation": Stage("lift to 3D", "method/observation.py", "10", (0, 1)),
    "registration": Stage("register", "method/registration.py", "03", (1, 1)),
    "refinement": Stage("refine", "method/refinement.py", "04", (2, 1)),
    "selection": Stage("select", "method/selection.py", "03", (3, 1)),
    "judging": Stage("judge", "extended/gates.py", "07", (4, 1), True),
    "map": Stage("keypoint map", "method/keypoint_map.py", "02", (1, 0)),
    "sampling": Stage("sample points", "method/sampling.py", "02", (0, 0)),
    "graph": Stage("factor graph", "method/factor_graph.py", "05", (2.15, 0)),
    "fusion": Stage("TSDF surface", "method/tsdf.py", "06", (3.25, 0)),
}


@style.styled
def pipeline_diagram(here: Collection[str] = (), pages: Mapping[str, str] | None = None) -> Figure:
    """The stages and what flows between them.

    here   stages that are marked: "you are here"
    pages  notebook number to the address that its boxes link to (in SVG and PDF)
    """
    from matplotlib.figure import Figure

    if unknown := sorted(set(here) - set(STAGES)):
        raise BadInput("stage", repr(unknown[0]), "one of " + ", ".join(STAGES))
    figure = Figure((8.6, 3.35))
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set(xlim=(-0.95, 7.65), ylim=(-0.62, 2.73))
    axis.axis("off")
    at = {name: (stage.at[0] * _GRID[0], stage.at[1] * _GRID[1]) for name, stage in STAGES.items()}
    _model(axis, at["judging"][0] + _BOX[0] / 2)
    for name, (x, y) in at.items():
        _box(axis, name, x, y, name in here, pages or {})
    _flow(axis, at)
    return figure


def as_svg(figure: Figure) -> str:
    """A figure as SVG for a page, its words as text: the same figure gives the same."""
    import matplotlib

    with style.applied(), matplotlib.rc_context({"svg.fonttype": "none"}), io.StringIO() as text:
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
        svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _model(axis: Axes, right: float) -> None:
    """What is known of an object: the ground on which map, surface and graph stand."""
    from matplotlib.patches import FancyBboxPatch

    left, h = -_BOX[0] / 2, _BOX[1]
    style_of = {"boxstyle": "round,pad=0.08", "facecolor": _MODEL, "edgecolor": "none", "zorder": 0}
    axis.add_patch(FancyBboxPatch((left, -h / 2 - 0.02), right - left, h + 0.06, **style_of))
    words = (
        "the object's model: every accepted frame extends the map; a keyframe brings points, is solved for and fused"
    )
    axis.text(left, -h / 2 - 0.2, words, fontsize=7, color=style.NEUTRAL[0], ha="left", va="center")


def _box(axis: Axes, name: str, x: float, y: float, marked: bool, pages: Mapping[str, str]) -> None:
    from matplotlib.patches import FancyBboxPatch

    stage, (w, h) = STAGES[name], _BOX
    fill = style.METHODS[0] if marked else "#FFFFFF"
    ink = style.ink(fill)
    corner, line = (x - w / 2, y - h / 2), "--" if stage.ours else "-"
    box = FancyBboxPatch(corner, w, h, "round,pad=0,rounding_size=0.06", facecolor=fill, edgecolor="#333333", lw=0.9)
    box.set(linestyle=line, zorder=3, url=pages.get(stage.notebook))
    axis.add_patch(box)
    axis.text(x, y + 0.07, stage.title, ha="center", va="center", fontsize=8.5, color=ink, zorder=4, weight="bold")
    small = {"fontsize": 6 * min(1, 22 / len(stage.source)), "family": "monospace"}  # so many characters fit
    axis.text(x, y - 0.12, stage.source, ha="center", va="center", color=ink, zorder=4, **small)
    number = {"ha": "right", "va": "top", "fontsize": 6.5, "zorder": 4, "color": ink}
    axis.text(x + w / 2 - 0.04, y + h / 2 - 0.03, stage.notebook, **number)


def _flow(axis: Axes, at: Mapping[str, tuple[float, float]]) -> None:
    """The arrows: along the step, to the model and back, and the words at its ends."""
    w, h = _BOX[0] / 2, _BOX[1] / 2

    def arrow(*corners: tuple[float, float], look: str = "-|>") -> None:
        *_, bend, end = corners
        axis.plot(*zip(*corners[:-1], strict=True), color=_FLOW["color"], lw=_FLOW["lw"], zorder=2)
        axis.annotate("", end, bend, arrowprops={**_FLOW, "arrowstyle": look}, zorder=2)

    said = {"va": "center", "fontsize": 7.5}
    (tx, ty), (ox, oy), (sx, _) = at["tracking"], at["observation"], at["segmentation"]
    axis.text(ox, ty, "RGB-D frame $F_t$;\nat first also clicks,\nboxes or masks", ha="center", **said)
    arrow((ox + w, ty), (tx - w, ty))
    arrow((tx + w, ty), (sx - w, ty))
    arrow((sx, ty - h), (sx, (ty + oy) / 2), (ox, (ty + oy) / 2), (ox, oy + h))
    arrow((at["scene"][0] - w, ty), (at["search"][0] + w, ty))
    arrow((at["search"][0] - w, ty), (sx + w, ty))
    for a, b in pairwise(("observation", "registration", "refinement", "selection", "judging")):
        arrow((at[a][0] + w, oy), (at[b][0] - w, oy))
    last = at["judging"][0]
    arrow((last + w, oy), (last + w + 0.22, oy))
    axis.text(last + w + 0.28, oy, "pose $T^C_O$,\nstatus,\nconfidence", ha="left", **said)
    arrow((last + 0.4, oy - h), (last + 0.4, h + 0.12))

    (mx, my), (px, _), (gx, _), (fx, _) = at["map"], at["sampling"], at["graph"], at["fusion"]
    arrow((mx, my + h), (mx, oy - h))
    arrow((px + w, my), (mx - w, my))
    arrow((px - w, my), (-0.8, my), (-0.8, ty + h + 0.2), (tx, ty + h + 0.2), (tx, ty + h))
    axis.text(-0.88, oy, "new points", rotation=90, ha="center", **said)
    arrow((gx - w, my), (mx + w, my), look="<|-|>")
    arrow((gx + w, my), (fx - w, my))
    for name in ("refinement", "selection"):
        x = min(at[name][0] + 0.25, fx + 0.1)
        arrow((fx + (x - fx) / 4, my + h), (x, oy - h))
    ours = "dashed: ours beyond the paper, which selects before it refines"
    axis.text(7.6, -0.56, ours, ha="right", fontsize=6.5, color=style.NEUTRAL[0])
