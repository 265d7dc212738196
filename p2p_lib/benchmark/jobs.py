"""The runs that a plan asks for, each known by a key: a hash of all that decides its result.

That is every parameter with the seed, tracker, detector and source of masks, the sequence, and the library's own
source with that of the modules of others that are named (not of what these import). Equal keys are one run, whichever
plans ask for it. What is on disk under a key is never computed again.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from p2p_lib.benchmark.plan import Method, Plan, PlannedSequence, prompts_file, prompts_places, uses_clicks
from p2p_lib.core import plugins
from p2p_lib.core.backends import ALIASES, DETECTORS, SEGMENTERS, TRACKERS
from p2p_lib.core.config import Config, preset
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData, P2PError, did_you_mean, listed
from p2p_lib.core.files import read_toml
from p2p_lib.core.options import MASK_SOURCES, RunOptions
from p2p_lib.core.paths import data_dir
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets import checkpoints, manifests
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.prompts import load_prompts
from p2p_lib.datasets.provenance import code_digest
from p2p_lib.datasets.resized import Resized, resized_prompt
from p2p_lib.datasets.schema import first_fault
from p2p_lib.datasets.sequence import SYNTHETIC, Sequence, open_sequence
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX
from p2p_lib.synthetic.faults import Faulty
from p2p_lib.synthetic.scenarios import SCENARIOS

#: Beside the sequences of ``DATASET/*``, written by whoever knows: ``[SEQUENCE]``, then a line ``OBJECT = "COLUMN"``
#: each, with the column of the paper's table that it fills ("one object 1 sugar"). Others have columns of their own.
COLUMNS = "columns.toml"
_NUMERICS = ("numpy", "scipy", "opencv-python-headless", "gtsam")


@dataclass(frozen=True)
class Job:
    """One run: a method on a sequence with a seed.

    measure  "poses": the whole method; "tracks": its 2D tracker alone
    chamfer  whether the reconstruction is scored
    min_visible_px  of an object's mask in frames that are scored
    key      16 digits, "" where it cannot run; then ``reason`` says why
    """

    method: Method
    sequence: PlannedSequence
    seed: int
    measure: Literal["poses", "tracks"]
    chamfer: bool
    min_visible_px: int = MIN_VISIBLE_PX
    key: str = ""
    reason: str = ""

    @property
    def models(self) -> dict[str, Path]:
        """Models that the plan names, below ``$P2P_DATA``."""
        return {name: (data_dir() or Path()) / where for name, where in self.sequence.models.items()}

    @property
    def sequence_seed(self) -> int:
        """The seed of a synthetic sequence."""
        return self.seed if self.sequence.seed is None else self.sequence.seed

    @property
    def prompts(self) -> tuple[Prompt, ...]:
        """What is kept for its sequence, where its method starts from clicks; where nothing is, the run draws some."""
        file = prompts_file(self.sequence.name) if uses_clicks(self.method) else None
        return tuple(resized_prompt(prompt, self.method.scale) for prompt in load_prompts(file)) if file else ()

    def options(self, known: tuple[str, ...] = ()) -> RunOptions:
        """What its run is asked for, on a sequence of the ``known`` objects."""
        planned, method, prompts = self.sequence, self.method, self.prompts
        objects = tuple(planned.objects) or tuple(dict.fromkeys(p.name for p in prompts)) or known
        return RunOptions(
            **method.model_dump(include={"preset", "settings", "tracker", "detector", "masks"}),
            seed=self.seed,
            prompts=prompts or None,
            objects=objects[: method.count or None] or None,
            start=planned.start,
            stop=planned.stop,
            models=self.models,
        )


def jobs_of(plan: Plan, profile: str) -> list[Job]:
    """Every run of a plan in its order: sequences, methods, seeds. What cannot run says why, and nothing runs yet."""
    scope = plan.scope(profile)
    measures: list[Literal["poses", "tracks"]] = ["poses", "tracks"] if plan.tracks and scope.tracks else ["poses"]
    methods = plan.methods(profile)
    lacking = {method.name: _unknown(plan, method) or _lacking(method) for method in methods}
    configs = {method.name: _config(plan, method) for method in methods}
    known: dict[tuple, tuple[str, Sequence]] = {}  # of this call alone: files may change until the next
    jobs = []
    for planned in scope.planned:
        for sequence, missing in _present(planned):
            for method in (method for method in methods if method.runs_on(planned.name)):
                for measure in measures:
                    for seed in scope.seeds:
                        reason = missing or lacking[method.name]
                        job = Job(method, sequence, seed, measure, plan.chamfer, plan.min_visible_px, reason=reason)
                        jobs.append(job if reason else _keyed(job, configs[method.name], known))
    return jobs


def open_planned(job: Job) -> Sequence:
    """The sequence of a job, rendered first where it is synthetic and the cache lacks it."""
    planned, method = job.sequence, job.method
    masks = RunOptions(masks=method.masks).mask_source().folder
    if planned.name.startswith(SYNTHETIC):
        from p2p_lib.synthetic import scenario_dir

        scenario = planned.name.removeprefix(SYNTHETIC)
        folder = scenario_dir(scenario, job.sequence_seed, **_synthetic(planned, method)[0])
        rendered: Any = open_sequence(folder, "ycbmultitrack", masks=masks)  # of files
        sequence: Sequence = replace(rendered, name=planned.name, scene_seed=job.sequence_seed)
    else:
        sequence = open_sequence(planned.name, planned.format or None, masks=masks)
    if (fault := planned.fault) is not None:
        severity = 1.0 if fault.severity is None else fault.severity
        start, stop = planned.during
        sequence = Faulty(sequence, fault.name, severity, start or 0, stop, seed=job.seed)
    return Resized(sequence, method.scale) if method.scale != 1 else sequence


@cache
def library_version() -> str:
    """A hash of the sources that decide a result (:func:`code_digest`) and of the versions of their numerics."""
    return _sha("\n".join([code_digest(), *(f"{name} {version(name)}" for name in _NUMERICS)]).encode())[:12]


def _config(plan: Plan, method: Method) -> Config:
    """The parameters of a method; :class:`BadInput` names the plan and the method whose preset or setting is wrong."""
    try:
        return preset(method.preset).with_values(method.settings)
    except BadInput as error:
        name = f"plan {plan.name}, method {method.name!r}: {error.name}"
        raise BadInput(name, error.got, error.expected, error.fix) from None


def _unknown(plan: Plan, method: Method) -> str:
    """Why a part of somebody else's cannot be loaded; "" where all can. :class:`BadInput` where a name is none."""
    parts = [
        ("tracker", method.tracker, TRACKERS | {OracleTracker.name: ""}),
        ("detector", method.detector, DETECTORS),
        ("segmenter", RunOptions(masks=method.masks).mask_source().segmenter, SEGMENTERS),
    ]
    try:
        for kind, name, ours in parts:
            if ALIASES.get(name, name) not in ours:
                plugins.find(kind, name, ours)
    except MissingBackend as error:
        return str(error)
    except BadInput as error:
        name = f"plan {plan.name}, method {method.name!r}: {error.name}"
        raise BadInput(name, error.got, error.expected, error.fix) from None
    return ""


def _keyed(job: Job, config: Config, known: dict[tuple, tuple[str, Sequence]]) -> Job:
    """The job with its key, or with the reason why it cannot run."""
    method, planned = job.method, job.sequence
    try:
        job.options()
        decides = {
            "library": library_version(),
            "measure": job.measure,
            "config": config.with_values({"seed": job.seed}).as_dict(),
            "method": method.model_dump(include={"tracker", "detector", "masks", "scale", "count"}),
            "sequence": _fingerprint(job, known),
            "cut": [planned.start, planned.stop, planned.objects],
            "fault": planned.fault and [planned.fault.model_dump(), planned.during],
            "prompts": [[p.as_dict(), "" if p.mask is None else _sha(p.mask.tobytes())] for p in job.prompts],
            "chamfer": job.chamfer,
            "min_visible_px": job.min_visible_px,
        } | _others(method, planned)
    except P2PError as error:
        if isinstance(error, BadInput) and planned.name.startswith(SYNTHETIC):
            raise  # the plan's mistake; of files, it is theirs
        return replace(job, reason=str(error))
    return replace(job, key=_sha(json.dumps(decides, sort_keys=True).encode())[:16])


def _present(planned: PlannedSequence) -> Iterator[tuple[PlannedSequence, str]]:
    """The sequence itself, or each present one of ``DATASET/*``; with the reason where there is none."""
    dataset, _, every = planned.name.rpartition("/")
    if every != "*":
        yield planned, ""
        return
    of = manifests.manifest(dataset)
    try:
        root = manifests.folder_of(of) / of.sequences_in
    except MissingData as error:
        yield planned, str(error)
        return
    names = [path.name for path in sorted(root.glob("*")) if (path / "rgb").is_dir()]
    if not names:
        yield planned, f"{dataset}: no sequence in {of.folder} below $P2P_DATA"
    columns = _columns(root / COLUMNS)
    for name in sorted(columns.keys() - set(names)) if names else ():
        expected = f"sequences in {root}: {', '.join(names)}"
        raise BadInput(str(root / COLUMNS), f"[{name}]", expected, did_you_mean(name, names))
    for name in names:
        filled = columns.get(name, planned.columns)
        yield planned.model_copy(update={"name": f"{dataset}/{name}", "columns": filled}), ""


def _columns(file: Path) -> dict[str, dict[str, str]]:
    """Sequence, object and its column, as the file says; none where there is no file."""
    expected = 'a table [SEQUENCE] each, with a line OBJECT = "COLUMN" for each object'
    try:
        content = read_toml(file, expected) if file.is_file() else {}
        return TypeAdapter(dict[str, dict[str, str]]).validate_python(content)
    except ValidationError as error:
        raise BadInput(str(file), first_fault(error), expected) from None


def _lacking(method: Method) -> str:
    """What this machine lacks to run a method, with the commands that fetch it; "" where it lacks nothing known."""
    networks = {method.tracker, method.detector, RunOptions(masks=method.masks).mask_source().segmenter}
    missing = []
    for name in sorted(networks & set(manifests.names("checkpoint"))):
        try:
            checkpoints.checked_files(name)
        except MissingBackend:
            missing.append(name)
        except BadInput as error:
            return str(error)
    if missing:
        commands = "; ".join(f"p2p data fetch {name}" for name in missing)
        return f"no weights of {', '.join(missing)}. Run: {commands}"
    slow = method.gpu and checkpoints.device() == "cpu"
    return "no GPU here, and on a CPU its networks take seconds a frame" if slow else ""


def _synthetic(planned: PlannedSequence, method: Method) -> tuple[dict[str, Any], dict[str, Any]]:
    """The parameters of a synthetic sequence, and the same with hashes of files in the place of their folder."""
    from p2p_lib.synthetic.noise import NOISE

    given = planned.synthetic | method.synthetic
    noise = given.pop("noise", "realsense")
    if noise not in NOISE:
        raise BadInput(f"plan: noise of {planned.name}", repr(noise), "one of " + ", ".join(NOISE))
    given = asdict(NOISE[noise]) | given
    if "models" not in given:
        return given, given
    folder = manifests.folder_of(manifests.manifest(given["models"]))
    if not folder.is_dir():
        raise MissingData(str(folder), "no such folder of models", "See p2p data info ycb_models.")
    return given | {"models": str(folder)}, given | {"models": _sha(_listing(folder))}


def _fingerprint(job: Job, known: dict[tuple, tuple[str, Sequence]]) -> Any:
    """What stands for the sequence: a generator's parameters, else names and sizes of all files, truth and models."""
    planned, method = job.sequence, job.method
    if planned.name.startswith(SYNTHETIC):
        from p2p_lib.synthetic.generate import generator_version

        _check_scene(job)
        return [planned.name, job.sequence_seed, generator_version(), _synthetic(planned, method)[1]]
    key = (planned.name, planned.format, planned.start, method.masks, job.measure, tuple(planned.models.items()))
    if key not in known:
        known[key] = _files_hash(job)
    _check_objects(job, known[key][1].objects)
    return known[key][0]


def _others(method: Method, planned: PlannedSequence) -> dict[str, Any]:
    """Hashes of the modules in which named parts of others are, which have been loaded; nothing where all are ours."""
    named = {"tracker": method.tracker, "detector": method.detector, "dataset": planned.format}
    named["segmenter"] = RunOptions(masks=method.masks).mask_source().segmenter
    offered = {kind: plugins.offered(kind).get(name) for kind, name in named.items()}
    places = [point.value if (point := offered[kind]) else name for kind, name in named.items()]
    modules = [sys.modules.get(place.partition(":")[0]) for place in places if plugins.is_place(place)]
    files = [module.__file__ for module in modules if module is not None and module.__file__]
    return {"others": [_sha(Path(file).read_bytes()) for file in files]} if files else {}


def _check_objects(job: Job, known: Iterable[str]) -> None:
    """That the sequence has the objects that the plan names."""
    for name in job.sequence.objects:
        if name not in known:
            what, expected = f"plan: objects of {job.sequence.name}", f"some of {', '.join(known)}"
            raise BadInput(what, repr(name), expected, did_you_mean(name, known))


def _check_scene(job: Job) -> None:
    """What can be told of a synthetic sequence before it is rendered."""
    planned, folder = job.sequence, RunOptions(masks=job.method.masks).mask_source().folder
    if (name := planned.name.removeprefix(SYNTHETIC)) not in SCENARIOS:
        near = did_you_mean(name, SCENARIOS, SYNTHETIC) or "See p2p data list."
        raise BadInput("plan: synthetic sequence", repr(planned.name), f"a bundled one, {SYNTHETIC}NAME", near)
    if folder and not (Path(folder).expanduser().is_dir() or Path(folder).parts[0] == "masks"):
        expected = f"a folder, or one of {', '.join(dict.fromkeys(MASK_SOURCES))}"
        raise BadInput(f"plan: masks of {planned.name}", repr(folder), expected, did_you_mean(folder, MASK_SOURCES))
    if planned.objects:
        given, own = _synthetic(planned, job.method)[0], signature(SCENARIOS[name]).parameters
        taken = {key: value for key, value in given.items() if key in own}
        _check_objects(job, _labelled(name, job.sequence_seed, tuple(sorted(taken.items()))))


@cache
def _labelled(scenario: str, seed: int, parameters: tuple[tuple[str, Any], ...]) -> tuple[str, ...]:
    """The objects of a scenario."""
    return tuple(body.name for body in SCENARIOS[scenario](seed, **dict(parameters)).bodies if body.labelled)


def _files_hash(job: Job) -> tuple[str, Sequence]:
    """Content of the truth, of the models, of the first image and its masks; names and sizes of everything else.

    With the sequence itself.
    """
    job = replace(job, sequence=job.sequence.model_copy(update={"fault": None}))
    sequence, start = open_planned(job), job.sequence.start
    _check_start(job, sequence)
    first = sequence.frame(start)
    parts = [("rgb", first.rgb.tobytes()), ("depth", first.depth_m.tobytes())]
    parts += [(name, mask.tobytes()) for name, mask in sorted((sequence.masks(start) or {}).items())]
    for name, truth in sorted(sequence.truth.items()):
        parts.append((name, truth.T_cam_model.tobytes() + truth.labelled.tobytes()))
    models = sorted((find_models(sequence) | job.models).items())
    if job.measure == "poses" and not models:
        places = listed([place for name in sequence.truth for place in sequence.model_places.get(name, ())], 3)
        what = "none at " + places if places else "the layout has no place for any"
        fix = 'Put one there, or name it in the plan: models = { OBJECT = "PATH" }.'
        raise MissingData(f"{job.sequence.name}: models of {', '.join(sequence.truth)}", what, fix)
    parts += [(name, path.read_bytes() if path.is_file() else b"") for name, path in models]
    parts += [] if sequence.path is None else [("files", _listing(sequence.path))]
    parts += [("format", job.sequence.format.encode())] if job.sequence.format else []
    return _sha(b"".join(name.encode() + content for name, content in parts)), sequence


def _check_start(job: Job, sequence: Sequence) -> None:
    """That the sequence has what the method starts from; :class:`MissingData` says what to put where."""
    name, by = job.sequence.name, RunOptions(masks=job.method.masks).mask_source().name
    if job.sequence.start >= len(sequence):
        raise BadInput(f"plan: frames of {name}", f"start = {job.sequence.start}", f"one of its {len(sequence)} frames")
    if not sequence.truth:
        raise MissingData(f"{name}: truth", "there is none, so nothing could be scored", "Track it with p2p run.")
    if prompts := job.prompts:
        if unknown := sorted({prompt.name for prompt in prompts} - set(sequence.objects)) if sequence.truth else ():
            expected = f"the sequence's own names: {', '.join(sequence.objects)}"
            raise BadInput(str(prompts_file(name)), f"clicks on {unknown[0]!r}", expected, "It could not be scored.")
        return
    if all(sequence.masks(i) is None for i in range(job.sequence.start, len(sequence))):
        places = prompts_places(name)
        if by != "clicks":
            raise MissingData(f"{name}: masks", "there are none", 'Methods with masks = "clicks" need none.')
        if not places:
            fix = "Clicks are kept by name: give its path below $P2P_DATA, and clicks in $P2P_DATA/prompts/NAME.json."
            raise MissingData(f"{name}: masks", "none to draw clicks from", fix)
        fix = f"Make it once: p2p click {name} --out {places[0]}"
        raise MissingData(str(places[0]), "no such file, and the sequence has no masks to draw clicks from", fix)
    # Some copies have masks of the first frames alone.
    if by == "dataset" and sequence.masks(job.sequence.start) is not None and sequence.masks(len(sequence) - 1) is None:
        fix = 'Methods with masks = "first" or "clicks" need no more.'
        raise MissingData(f"{name}: masks", "there are some of the first frames alone", fix)


def _listing(folder: Path) -> bytes:
    """Names and sizes of all files below a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return "\n".join(f"{path.relative_to(folder)} {path.stat().st_size}" for path in files).encode()


def _sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
