"""What of a plan can run here and now, and what would have to be fetched for the rest."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from textwrap import shorten

from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.jobs import Job, jobs_of
from p2p_lib.benchmark.plan import plan_names, read_plan
from p2p_lib.core.paths import data_dir
from p2p_lib.datasets import manifests
from p2p_lib.datasets.sequence import SYNTHETIC

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
    return "\n".join([*lines, *(f"  {'; '.join(methods)}: {count}" for count, methods in alike.items())])


def overview() -> Iterator[str]:
    """A row for each plan as soon as it is known, how many of its methods on a sequence can run here; then the sum."""
    names, whole, here, every = plan_names(), 0, 0, 0
    width = max(map(len, names))
    yield f"{'plan':{width}}  {'can run':11}  what"
    for name in names:
        plan = read_plan(name)
        jobs = {(job.method.name, job.sequence.name): job.reason for job in jobs_of(plan, "full")}
        ready = sum(not reason for reason in jobs.values())
        whole, here, every = whole + (ready == len(jobs)), here + ready, every + len(jobs)
        what = plan.title + ", the paper's" * bool(plan.paper)
        if not ready and (bundled := f"{name}_embedded") in names:
            what += f"; here: {bundled}"
        what = shorten(what, _TITLE, placeholder=" ...")
        yield f"{name:{width}}  {f'{ready} of {len(jobs)}':11}  {what}"
    yield f"{whole} of {len(names)} plans can run here and now in full; {here} of {every} methods on a sequence can."


def present_plans() -> list[str]:
    """The plans that some dataset is there for: of one at least one job is no synthetic sequence and can run."""
    plans = [name for name in plan_names() if read_plan(name).data]
    return [name for name in plans if any(_on_data(job) and not job.reason for job in jobs_of(read_plan(name), "full"))]


def what_to_fetch(benchmark: Benchmark) -> list[str]:
    """A line for each sequence that is missing, and one per dataset: what to fetch, how, and how large it is."""
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
