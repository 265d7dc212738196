"""What a benchmark is to run, as a TOML file says it: methods, and what they run on with which seeds.

That is in ``full`` the data of the paper, where it is present, in ``quick`` a few frames of bundled data. Plans of this
package lie in ``plans/`` and are known by their names.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from p2p_lib.core.backends import DEFAULT_DETECTOR, DEFAULT_TRACKER
from p2p_lib.core.errors import BadInput, MissingData, did_you_mean
from p2p_lib.core.files import file_name, read_toml
from p2p_lib.core.options import RunOptions
from p2p_lib.core.paths import data_dir
from p2p_lib.datasets.schema import Strict, first_fault
from p2p_lib.datasets.sequence import SYNTHETIC
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX

PROFILES = ("quick", "full")
#: Where the plans of this package lie, and the prompts of sequences that methods from clicks start from.
PLANS, PROMPTS = Path(__file__).parent / "plans", Path(__file__).parent / "prompts"

#: Preset, tracker and masks of the paper.
_PAPERS = ("paper", "tapir", "sam2_video")

Text = Annotated[str, Field(min_length=1)]
Count = Annotated[int, Field(ge=0)]


class Method(Strict):
    """One way to run: a row or column of the table.

    paper     the method of the paper's table that it is ("Ours", "No SDF refinement"): its figures stand beside it. ""
              for all others: no stand-in has them
    against   the method that it is compared with, run by run (a plan of kind ``pairs``)
    gpu       whether it is left out where there is no GPU: its networks take seconds a frame without one
    masks     as of ``p2p run``; clicks are those kept for the sequence (:func:`prompts_file`), or drawn where there are
              none
    settings  single parameters of the configuration, ``{"stage.key" = value}``
    synthetic parameters of synthetic sequences; ``noise`` is one of exact, realsense, hard
    scale     of the images, 1 = as they are
    count     only so many of the objects, 0 = all
    only      names of the sequences that it runs on, none for all; ``but``, of those that it does not
    """

    name: Text
    paper: str = ""
    against: str = ""
    gpu: bool = False
    preset: Text = "default"
    tracker: Text = DEFAULT_TRACKER
    detector: Text = DEFAULT_DETECTOR
    masks: Text = "dataset"
    settings: dict[str, Any] = {}
    synthetic: dict[str, Any] = {}
    scale: Annotated[float, Field(gt=0, le=4)] = 1.0
    count: Count = 0
    only: list[Text] = []
    but: list[Text] = []

    @model_validator(mode="after")
    def _is_the_papers(self) -> Method:
        if self.paper and (self.preset, self.tracker, self.masks) != _PAPERS:
            raise ValueError(f"paper = {self.paper!r}: only with preset, tracker and masks {', '.join(_PAPERS)}")
        return self

    def runs_on(self, sequence: str) -> bool:
        """Whether it runs on the sequence of this name."""
        return sequence not in self.but and (not self.only or sequence in self.only)


class PlannedFault(Strict):
    """A fault of :data:`p2p_lib.synthetic.faults.FAULTS`.

    severity  in the unit that it says
    when      in the frames that the sequence says, in all, or in the first one
    """

    name: Text
    severity: float | None = None
    when: Literal["for a while", "always", "at first"] = "for a while"

    @property
    def shown(self) -> str:
        """What tables call it."""
        period = "" if self.when == "for a while" else self.when
        return ", ".join(filter(None, (self.name, "" if self.severity is None else f"{self.severity:g}", period)))


class PlannedSequence(Strict):
    """One sequence to run on.

    name       as ``p2p run`` takes it; ``DATASET/*`` stands for every sequence of a dataset that is present
    format     its layout, as ``--format`` takes it, "": recognised; a synthetic one has its own
    objects    only these (default: all)
    seed       of a synthetic sequence; None: that of the run
    synthetic  parameters of a synthetic sequence; ``models = "DATASET"`` stands for that dataset's folder
    models     object to model file or folder, relative to ``$P2P_DATA``, where the layout has none
    column     of the paper's table; with several objects, ``columns`` has one for each
    fault      what goes wrong in it, and in which frames, from and to, where that is for a while
    """

    name: Text
    format: str = ""
    objects: list[Text] = []
    start: Count = 0
    stop: Count | None = None
    seed: Count | None = None
    synthetic: dict[str, Any] = {}
    models: dict[str, Text] = {}
    column: str = ""
    columns: dict[str, str] = {}
    fault: PlannedFault | None = None
    fault_frames: list[Count] = Field(default=[30, 60], min_length=2, max_length=2)

    @model_validator(mode="after")
    def _fits(self) -> PlannedSequence:
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"{self.name}: start = {self.start}, stop = {self.stop}: that is no frame")
        if self.format and self.name.startswith(SYNTHETIC):
            raise ValueError(f"format = {self.format!r}: {self.name} is rendered and has its own")
        return self

    @property
    def during(self) -> list[int | None]:
        """The frames of its fault, from and to; None: to the end."""
        when = self.fault.when if self.fault else ""
        whole: dict[str, list[int | None]] = {"always": [0, None], "at first": [self.start, self.start + 1]}
        return whole.get(when, [*self.fault_frames])

    def column_of(self, object: str) -> str:
        """The column of the paper's table that this object belongs to, "" for none."""
        return self.columns.get(object, self.column)


class Scope(Strict):
    """What the methods run on.

    methods  the names of some of them, none for all
    tracks   whether 2D trackers are scored by themselves, where the plan wants it
    alone    one run at a time, since times are measured
    fault    faults with each of which every sequence is run, none for once without any
    """

    seeds: Annotated[list[Count], Field(min_length=1)]
    sequence: Annotated[list[PlannedSequence], Field(min_length=1)]
    methods: list[str] = []
    tracks: bool = True
    alone: bool = False
    fault: list[PlannedFault] = []

    @property
    def planned(self) -> list[PlannedSequence]:
        """The sequences, with each fault."""
        if not self.fault:
            return self.sequence
        return [s.model_copy(update={"fault": fault}) for fault in self.fault for s in self.sequence]


class Plan(Strict):
    """A benchmark.

    name     of its file
    paper    LaTeX label of the paper's table that it re-creates, "" for none
    kind     how its table is arranged (see :mod:`p2p_lib.figures.final_tables`)
    note     a sentence below its table, without its full stop
    gpu_jobs so many runs at a time of methods that need a GPU
    chamfer  whether reconstructions are scored as well
    tracks   whether the 2D trackers are scored by themselves as well
    min_visible_px  frames in which less of an object's mask is to be seen are not scored: often the first of a return
    quick    a few frames of bundled data, None where it has none
    """

    name: Annotated[str, AfterValidator(lambda name: file_name("name", name))]
    title: Text
    paper: str = ""
    kind: Literal["sequences", "objects", "methods", "returns", "rates", "runs", "grid", "pairs", "faults"] = "methods"
    note: str = ""
    gpu_jobs: Annotated[int, Field(ge=1)] = 1
    chamfer: bool = False
    tracks: bool = False
    min_visible_px: Count = MIN_VISIBLE_PX
    method: Annotated[list[Method], Field(min_length=1)]
    quick: Scope | None = None
    full: Scope

    @model_validator(mode="after")
    def _consistent(self) -> Plan:
        names, scopes = [method.name for method in self.method], [of for of in (self.quick, self.full) if of]
        if len(set(names)) < len(names):
            raise ValueError("two methods have one name")
        sequences = {sequence.name for of in scopes for sequence in of.sequence}
        for key, what, given, known in (
            ("methods", "method", {name for of in scopes for name in of.methods}, set(names)),
            ("against", "method", {method.against for method in self.method}, {*names, ""}),
            ("only", "sequence", {name for method in self.method for name in method.only}, sequences),
            ("but", "sequence", {name for method in self.method for name in method.but}, sequences),
        ):
            for name in sorted(given - known):
                near = did_you_mean(name, known) or f"There are {', '.join(sorted(filter(None, known)))}."
                raise ValueError(f"{key}: no {what} is called {name!r} ({near})")
        return self

    @property
    def data(self) -> list[str]:
        """What it needs in full below ``$P2P_DATA``: datasets, and models of rendered sequences."""
        names = [s.name.partition("/")[0] for s in self.full.sequence if not s.name.startswith((SYNTHETIC, "/"))]
        rendered = [*(s.synthetic for s in self.full.sequence), *(m.synthetic for m in self.methods("full"))]
        models = [parameters.get("models") for parameters in rendered]
        return list(dict.fromkeys([*names, *(str(m) for m in models if m)]))

    def scope(self, profile: str) -> Scope:
        """``quick`` or ``full``."""
        if profile not in PROFILES:
            raise BadInput("profile", repr(profile), "one of " + ", ".join(PROFILES))
        if (scope := getattr(self, profile)) is None:
            fix = f"Run it in full, or give it a table [{profile}]."
            raise BadInput(f"plan {self.name}", f"the profile {profile}", "one that the plan has", fix)
        return scope

    def methods(self, profile: str) -> list[Method]:
        """The methods of a scope."""
        wanted = self.scope(profile).methods
        return [method for method in self.method if not wanted or method.name in wanted]


def plan_names() -> list[str]:
    """The plans of this package."""
    return sorted(path.stem for path in PLANS.glob("*.toml"))


def read_plan(plan: str | Path) -> Plan:
    """The plan in a TOML file, or the one of this package that is called so.

    Raises :class:`MissingData` where there is none, :class:`BadInput` with the key that does not fit.
    """
    path = Path(plan).expanduser()
    if path.suffix != ".toml":
        path = PLANS / f"{plan}.toml"
    if not path.exists():
        fix = "Give a TOML file, or one of " + ", ".join(plan_names()) + "."
        raise MissingData(str(plan), "no such plan", fix)
    expected = "a plan (see docs/results.md, section Plans)"
    content = read_toml(path, expected)
    try:
        return Plan.model_validate({"name": path.stem, **content})
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] != "extra_forbidden":
            raise BadInput(f"plan {path.name}", first_fault(error), expected) from None
        parts = (Plan, Scope, PlannedSequence, PlannedFault, Method)
        word, known = str(first["loc"][-1]), {key for part in parts for key in part.model_fields}
        got = f"{'.'.join(map(str, first['loc']))}, a key unknown there"
        raise BadInput(f"plan {path.name}", got, expected, did_you_mean(word, known)) from None


def prompts_places(sequence: str) -> tuple[Path, ...]:
    """Where prompts are looked for of a sequence that a plan calls so, ``DATASET/SEQUENCE``; none for an absolute path.

    That is ``prompts/DATASET/SEQUENCE.json`` below ``$P2P_DATA``, then the same of this package.
    """
    relative = PurePosixPath(f"{sequence}.json")
    if relative.is_absolute() or ".." in relative.parts:
        return ()
    own = data_dir()
    return (*([own / "prompts" / relative] if own else []), PROMPTS / relative)


def prompts_file(sequence: str) -> Path | None:
    """The first of :func:`prompts_places` that is there."""
    return next((path for path in prompts_places(sequence) if path.is_file()), None)


def uses_clicks(method: Method) -> bool:
    """Whether its objects are started by clicks."""
    return RunOptions(masks=method.masks).mask_source().name == "clicks"
