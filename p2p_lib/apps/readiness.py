"""What of a plan can run here and now, and what would have to be fetched for the rest."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from textwrap import shorten

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.jobs import Job, jobs_of
from p2p_lib.benchmark.plan import plan_names, read_plan
from p2p_lib.core.errors import P2PError
from p2p_lib.core.paths import data_dir
from p2p_lib.datasets import manifests
from p2p_lib.datasets.sequence import SYNTHETIC, open_sequence

_TITLE = 62  # letters on a plan that a narrow table has room for


def readiness(name: str) -> str:
    """Lines on a plan: its title, its methods with how many of their sequences can run here in full, and why not."""
    plan = read_plan(name)
    lines = [f"{name:26}{plan.title}" + (f" ({plan.paper})" if plan.paper else "")]
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for job in jobs_of(plan, "full"):
        found[job.method.name][job.sequence.name] = job.reason
    alike: dict[str, list[str]] = defaultdict(list)
    for method, reasons in found.items():
        ready = sum(not reason for reason in reasons.values())
        count = f"{ready} of {len(reasons)} sequences"
        why: dict[str, list[str]] = defaultdict(list)  # by what they say but for the sequence's name
        for sequence, reason in reasons.items():
            if reason:
                why[reason.replace(sequence, "")].append(reason)
        told = [f"{of[0]}" + f" ({len(of) - 1} more likewise)" * (len(of) > 1) for of in why.values()]
        count += "; else: " * bool(told) + "; ".join(told)
        alike[count].append(method)
    lines += [f"  {'; '.join(methods)}: {count}" for count, methods in alike.items()]
    cut = _cut_short(name for reasons in found.values() for name in reasons)
    return "\n".join([*lines, *(f"  {line}" for line in cut)])


def overview() -> Iterator[str]:
    """A row for each plan as soon as it is known, how many of its methods on a sequence can run here; then the sum."""
    names, whole, here, every, used = plan_names(), 0, 0, 0, list[str]()
    width = max(map(len, names))
    yield f"{'plan':{width}}  {'can run':11}  what"
    for name in names:
        plan = read_plan(name)
        jobs = {(job.method.name, job.sequence.name): job.reason for job in jobs_of(plan, "full")}
        ready = sum(not reason for reason in jobs.values())
        used += [sequence for _, sequence in jobs]
        whole, here, every = whole + (ready == len(jobs)), here + ready, every + len(jobs)
        what = plan.title + ", the paper's" * bool(plan.paper)
        if not ready and (bundled := f"{name}_embedded") in names:
            what += f"; here: {bundled}"
        what = shorten(what, _TITLE, placeholder=" ...")
        yield f"{name:{width}}  {f'{ready} of {len(jobs)}':11}  {what}"
    yield f"{whole} of {len(names)} plans can run here and now in full; {here} of {every} methods on a sequence can."
    yield from _cut_short(used)


def present_plans() -> list[str]:
    """The plans that some dataset is there for: of one at least one job is no synthetic sequence and can run."""
    plans = [name for name in plan_names() if read_plan(name).data]
    return [name for name in plans if any(_on_data(job) and not job.reason for job in jobs_of(read_plan(name), "full"))]


def what_to_fetch(benchmark: Benchmark) -> list[str]:
    """A line per dataset: what is missing of it, how to fetch that, how large it is; and one for what is cut short."""
    missing: dict[str, list[str]] = defaultdict(list)
    for job, outcome in benchmark.results:
        dataset = job.sequence.name.partition("/")[0]
        models = {**job.sequence.synthetic, **job.method.synthetic}.get("models")
        wanted = str(models) if models else dataset
        if outcome.status == "not run" and not _there(job.sequence.name, wanted):
            missing[wanted].append(job.sequence.name)
    lines = []
    for dataset in missing:
        of, sequences = manifests.manifest(dataset), dict.fromkeys(missing[dataset])
        frames = {f"{dataset}/{entry.name}": entry.frames for entry in of.sequences}
        named = [name + (f" ({frames[name]} frames)" if frames.get(name) else "") for name in sequences]
        size = of.size or "size not published"
        how = f"p2p data fetch {dataset}" if of.access == "open" else f"by hand, see p2p data info {dataset}"
        lines.append(f"Missing: {', '.join(named)}. {of.title}, {size}: {how}")
    return [*lines, *_cut_short(job.sequence.name for job, _ in benchmark.results)]


def _cut_short(names: Iterable[str]) -> list[str]:
    """A line for each sequence that is here with fewer frames than its dataset's manifest says."""
    lines = []
    for name in dict.fromkeys(names):
        with suppress(P2PError):  # what is not there, or cannot be opened, is said already
            place = None if name.startswith(SYNTHETIC) else manifests.find_sequence(name)
            known = {entry.name: entry.frames for entry in place[1].sequences} if place else {}
            if (frames := known.get(name.rpartition("/")[2])) and (here := len(open_sequence(name))) < frames:
                lines.append(f"{name}: {here} of its {frames} frames are here, and its rows are of these")
    return lines


def _there(sequence: str, dataset: str) -> bool:
    """Whether nothing of a dataset has to be fetched for a sequence: models of a rendered one, or its own files."""
    if dataset not in manifests.names("dataset"):
        return True
    if not sequence.startswith(SYNTHETIC):
        return manifests.find_sequence(sequence) is not None
    return data_dir() is not None and manifests.folder_of(manifests.manifest(dataset)).is_dir()


def _on_data(job: Job) -> bool:
    return not job.sequence.name.startswith((SYNTHETIC, "/"))
