"""The runs that a plan asks for, each known by a key: a hash of all that decides its result.

That is every parameter with the seed, tracker, detector and source of masks, the sequence, and the library's own
source. Equal keys are one run, whichever plans ask for it. What is on disk under a key is never computed again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np

from p2p_lib.benchmark.plan import Method, Plan, PlannedSequence, uses_clicks
from p2p_lib.core.backends import make_detector
from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData, P2PError
from p2p_lib.core.paths import data_dir
from p2p_lib.datasets import manifests, ycbmultitrack
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.prompts import Prompt
from p2p_lib.datasets.resized import Resized
from p2p_lib.datasets.sequence import SYNTHETIC, Sequence, open_sequence
from p2p_lib.run import make_config

_PACKAGE = Path(__file__).resolve().parents[1]
# What only shows results cannot change them.
_WITHOUT = {"report", "notebooks.py", "doctor.py", "cli.py", "click.py", "live.py"}
_NUMERICS = ("numpy", "scipy", "opencv-python-headless", "gtsam")


@dataclass(frozen=True)
class Job:
    """One run: a method on a sequence with a seed.

    measure  "poses": the whole method; "tracks": its 2D tracker alone
    chamfer  whether the reconstruction is scored
    key      16 digits, "" where it cannot run
    reason   why it cannot
    """

    method: Method
    sequence: PlannedSequence
    seed: int
    measure: Literal["poses", "tracks"]
    chamfer: bool
    key: str = ""
    reason: str = ""


def jobs_of(plan: Plan, profile: str) -> list[Job]:
    """Every run of a plan in its order: sequences, methods, seeds. What cannot run says why, and nothing runs yet."""
    scope = plan.scope(profile)
    measures = ("poses", "tracks") if plan.tracks and scope.tracks else ("poses",)
    known: dict[tuple, str] = {}  # of this call alone: files may change until the next
    jobs = []
    for planned in scope.sequence:
        for sequence, missing in _present(planned):
            for method in (m for m in plan.methods(profile) if not m.only or planned.name in m.only):
                for measure in measures:
                    for seed in scope.seeds:
                        job = Job(_with_detector(method), sequence, seed, measure, plan.chamfer)
                        jobs.append(_keyed(job, missing, known))
    return jobs


def open_planned(job: Job) -> Sequence:
    """The sequence of a job, rendered first where it is synthetic and the cache lacks it."""
    planned, method = job.sequence, job.method
    seed = job.seed if planned.seed is None else planned.seed
    folder = None if uses_clicks(method) else method.masks.partition(":")[2] or None
    if planned.name.startswith(SYNTHETIC):
        from p2p_lib.synthetic import scenario_dir

        where = scenario_dir(planned.name.removeprefix(SYNTHETIC), seed, **_synthetic(planned, method)[0])
        sequence = _load(where, planned.name, folder)
    else:
        sequence = open_sequence(planned.name, masks=folder)
    return Resized(sequence, method.scale) if method.scale != 1 else sequence


def objects_of(job: Job, sequence: Sequence) -> tuple[str, ...]:
    """The objects that a job tracks."""
    names = tuple(job.sequence.objects) or (tuple(job.sequence.clicks) if uses_clicks(job.method) else sequence.objects)
    return names[: job.method.count or None]


def prompts_of(job: Job) -> list[Prompt] | None:
    """The clicks that start a job's objects; None where masks do."""
    if not uses_clicks(job.method):
        return None
    if not job.sequence.clicks:
        fix = "Give the plan's sequence clicks = { object = [[u, v], ...] }."
        raise MissingData(job.sequence.name, f"no clicks in the plan, which masks = {job.method.masks!r} needs", fix)
    pairs = job.sequence.clicks.items()
    return [Prompt(name, job.sequence.start, np.array(at) * job.method.scale) for name, at in pairs]


def models_of(job: Job) -> dict[str, Path]:
    """Models that the plan names, below ``$P2P_DATA``."""
    return {name: (data_dir() or Path()) / where for name, where in job.sequence.models.items()}


@cache
def library_version() -> str:
    """A hash of this package's source (without what only shows results) and of the versions of its numerics."""
    sources = [path for path in sorted(_PACKAGE.rglob("*.py")) if path.relative_to(_PACKAGE).parts[0] not in _WITHOUT]
    lines = [f"{path.relative_to(_PACKAGE).as_posix()} {_sha(path.read_bytes())}" for path in sources]
    return _sha("\n".join([*lines, *(f"{name} {version(name)}" for name in _NUMERICS)]).encode())[:12]


def _keyed(job: Job, missing: str, known: dict[tuple, str]) -> Job:
    """The job with its key, or with the reason why it cannot run."""
    if missing:
        return Job(**{**_fields(job), "reason": missing})
    method = job.method
    config = make_config(method.preset, settings=method.settings, seed=job.seed)
    try:
        prompts_of(job)
        decides = {
            "library": library_version(),
            "measure": job.measure,
            "config": config.as_dict(),
            "method": {k: getattr(method, k) for k in ("tracker", "detector", "masks", "scale", "count")},
            "sequence": _fingerprint(job, known),
            "cut": [job.sequence.start, job.sequence.stop, job.sequence.objects],
            "clicks": job.sequence.clicks if uses_clicks(method) else {},
            "chamfer": job.chamfer,
        }
    except P2PError as error:
        if isinstance(error, BadInput) and job.sequence.name.startswith(SYNTHETIC):
            raise  # the plan's mistake; of files, it is theirs
        return Job(**{**_fields(job), "reason": str(error)})
    return Job(**{**_fields(job), "key": _sha(json.dumps(decides, sort_keys=True).encode())[:16]})


def _fields(job: Job) -> dict[str, Any]:
    return {k: getattr(job, k) for k in Job.__dataclass_fields__}


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
    for name in names:
        yield planned.model_copy(update={"name": f"{dataset}/{name}"}), ""


@cache
def _detector_there(name: str) -> bool:
    try:
        make_detector(name, SamplingConfig(), np.random.default_rng(0))
    except MissingBackend:
        return False
    return True


def _with_detector(method: Method) -> Method:
    """With the first of its detectors that is installed; the last one where none is, which then says what it needs."""
    if isinstance(method.detector, str):
        return method
    chosen = next(filter(_detector_there, method.detector), method.detector[-1])
    return method.model_copy(update={"detector": chosen})


def _synthetic(planned: PlannedSequence, method: Method) -> tuple[dict[str, Any], dict[str, Any]]:
    """The parameters of a synthetic sequence, and the same with hashes of files in the place of their folder."""
    from p2p_lib.synthetic.noise import NOISE

    given = planned.synthetic | method.synthetic
    noise = given.pop("noise", "realsense")
    if noise not in NOISE:
        raise BadInput(f"plan: noise of {planned.name}", repr(noise), "one of " + ", ".join(NOISE))
    sensor = asdict(NOISE[noise])
    if "models" not in given:
        return sensor | given, sensor | given
    folder = manifests.folder_of(manifests.manifest(given.pop("models")))
    if not folder.is_dir():
        raise MissingData(str(folder), "no such folder of models", "See p2p data info ycb_models.")
    files = _sha("\n".join(f"{p.relative_to(folder)} {p.stat().st_size}" for p in sorted(folder.rglob("*"))).encode())
    return sensor | given | {"models": str(folder)}, sensor | given | {"models": files}


def _fingerprint(job: Job, known: dict[tuple, str]) -> Any:
    """What stands for the sequence: a generator's parameters, else names and sizes of all files, truth and models."""
    planned, method = job.sequence, job.method
    if planned.name.startswith(SYNTHETIC):
        from p2p_lib.synthetic.generate import generator_version

        seed = job.seed if planned.seed is None else planned.seed
        return [planned.name, seed, generator_version(), _synthetic(planned, method)[1]]
    key = (planned.name, method.masks, tuple(planned.models.items()))
    if key not in known:
        known[key] = _files_hash(job)
    return known[key]


def _files_hash(job: Job) -> str:
    """Content of the truth, of the models, of the first picture and its masks; names and sizes of everything else."""
    sequence = open_planned(job)
    first, masks = sequence.frame(job.sequence.start), sequence.masks(job.sequence.start) or {}
    digest = hashlib.sha256(first.rgb.tobytes() + first.depth_m.tobytes())
    for name, truth in sorted(sequence.truth.items()):
        digest.update(name.encode() + truth.T_cam_model.tobytes() + truth.labelled.tobytes())
    for name, mask in sorted(masks.items()):
        digest.update(name.encode() + mask.tobytes())
    for name, path in sorted({**find_models(sequence), **models_of(job)}.items()):
        digest.update(name.encode() + (path.read_bytes() if path.is_file() else b""))
    if sequence.path is not None:
        files = sorted(path for path in sequence.path.rglob("*") if path.is_file())
        digest.update("\n".join(f"{p.relative_to(sequence.path)} {p.stat().st_size}" for p in files).encode())
    return digest.hexdigest()


def _load(folder: Path, name: str, masks: str | None) -> Sequence:
    return ycbmultitrack.load(folder, name=name, depth_scale=None, masks=masks)


def _sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
