"""The notebooks as a course: which come before and after, where each is in the paper, and which stages it is about."""

from __future__ import annotations

import html
from dataclasses import dataclass
from functools import cache

from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.core.native import load_open3d
from studies.pipeline_diagram import STAGES, as_svg, pipeline_diagram

#: What loads the package of an extra as the notebooks' own code does, and says what to do where it cannot.
_LOADS = {"open3d": load_open3d}


@dataclass(frozen=True)
class Lesson:
    """One notebook: its file without suffix, a title of a few words, where the paper has it, what it shows.

    extra  of the package, besides ``notebooks``, that it cannot run without; empty for most
    """

    name: str
    title: str
    paper: str
    shows: str
    extra: str = ""

    @property
    def about(self) -> str:
        """What it shows, and what it needs."""
        return self.shows + (f"; needs the extra {self.extra}" if self.extra else "")

    def check_installed(self) -> None:
        """:class:`MissingBackend` with the command where the extra that it needs is not there."""
        try:
            if self.extra:
                _LOADS[self.extra]()
        except MissingBackend as error:
            needs = f"needs the extra {self.extra}, which is not there ({error.missing})"
            raise MissingBackend(f"notebook {self.name}", needs, error.fix) from error

    @property
    def stages(self) -> list[str]:
        """The pipeline's stages that it is about; none where it is about all of them."""
        return [key for key, stage in STAGES.items() if stage.notebook == self.name[:2]]

    def _repr_html_(self) -> str:
        at = LESSONS.index(self)
        before, after = LESSONS[at - 1] if at else None, LESSONS[at + 1] if at + 1 < len(LESSONS) else None
        contents = "".join(f"<li>{_link(one, one is not self)}: {html.escape(one.about)}</li>" for one in LESSONS)
        about = "The filled boxes are what this notebook is about." if self.stages else "This notebook uses all of it."
        return (
            '<nav style="display:flex;justify-content:space-between;gap:2em">'
            f"<span>{'← ' + _link(before) if before else ''}</span><span>{_link(after) + ' →' if after else ''}</span>"
            "</nav>"
            f"<details><summary>All notebooks</summary><ul style='list-style:none'>{contents}</ul></details>"
            f"<p><b>In the paper:</b> {html.escape(self.paper)}.</p>{diagram(*self.stages)}"
            f"<p>The pipeline of preset <code>default</code>. {about} The number in a box links to its notebook.</p>"
        )


LESSONS = (
    Lesson(
        "00_quickstart",
        "Quickstart",
        'figure "Overview of the framework"',
        "from three clicks to moving poses, the return after complete occlusion, errors over time",
    ),
    Lesson(
        "01_2d_tracking",
        "2D tracking",
        'section "2D Point Tracker"',
        "tracks through complete occlusion, trackers side by side, and what their uncertainty is worth",
    ),
    Lesson(
        "02_sampling_objective",
        "Sampling objective",
        'section "Sampling Strategy and Keypoints Map"; appendix "Point Sampling"',
        "the terms of J as maps, what each choice does to coverage, pose and tracking; promotion in action",
    ),
    Lesson(
        "03_multi_hypothesis_registration",
        "Multi-hypothesis registration",
        'section "Frame-to-Map Registration for Pose Estimation"',
        "a mug whose tracks mostly lie: hypotheses, and how the surface picks one",
    ),
    Lesson(
        "04_sdf_refinement",
        "SDF refinement",
        'section "Frame-to-Map Registration for Pose Estimation", part "SDF Refinement"',
        "from how far away a pose is pulled onto the surface, and what a tin or a plane leaves free",
    ),
    Lesson(
        "05_factor_graph",
        "Factor graph",
        'section "Graph Optimization" and its appendix',
        "what each loss does to drift, gaps and outliers; how honest the covariance is",
    ),
    Lesson(
        "06_tsdf_reconstruction",
        "TSDF reconstruction",
        'section "3D Reconstruction" and its appendix',
        "the fused surface slice by slice beside the exact distance; its mesh; what a moved keyframe does",
    ),
    Lesson(
        "07_occlusion_recovery",
        "Occlusion and recovery",
        'section "Results on YCBMultiTrack" and the ablation P2P-SH(10); the second half is ours',
        "a box behind a hand: the return frame by frame, long range against SH(10), confidence; never lost for good",
    ),
    Lesson(
        "08_texture_analysis",
        "Texture",
        'section "Results on HO3D and YCBInEOAT", the discussion of failures',
        "the same tin with an ever fainter print: what texture is worth to tracks and poses",
    ),
    Lesson(
        "09_final_tables",
        "Final tables",
        'section "Experiments" and the appendix "Ablation Studies"',
        "every table of the paper with ours beside it, from the results of p2p benchmark; strips, reconstructions",
    ),
    Lesson(
        "10_your_own_data",
        "Your own data",
        'figure "Overview of the framework", from the clicks to the mesh',
        "from a folder to poses and a mesh, on bundled data: what to provide, what goes wrong, how to tell it works",
    ),
    Lesson(
        "11_label_your_own",
        "Label your own",
        'the fused surface alone, section "3D Reconstruction"; offline pass, textured models and labels are ours',
        "from a video and three clicks to a textured model and labelled images, and how to tell that a label is good",
        extra="open3d",
    ),
)


def lesson(number: str) -> Lesson:
    """The notebook of this number (``"03"``); shown as its way through the course and its place in the pipeline.

    It is each notebook's first line: where what the notebook needs is not installed, it says so and nothing is begun.
    """
    found = [one for one in LESSONS if one.name[:2] == number]
    if not found:
        raise BadInput("notebook", repr(number), "one of " + ", ".join(one.name[:2] for one in LESSONS))
    found[0].check_installed()
    return found[0]


@cache
def diagram(*here: str) -> str:
    """The pipeline as SVG, its boxes linked to their notebooks, those in ``here`` marked."""
    pages = {one.name[:2]: f"{one.name}.ipynb" for one in LESSONS}
    return as_svg(pipeline_diagram(here=here, pages=pages))


def _link(one: Lesson, active: bool = True) -> str:
    words = f"{one.name[:2]} {html.escape(one.title)}"
    return f'<a href="{one.name}.ipynb">{words}</a>' if active else f"<b>{words}</b>"
