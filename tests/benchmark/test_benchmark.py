"""A benchmark runs what its plan says once, wherever it runs, and goes on after anything that ends it."""

import csv
import multiprocessing
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib.apps import cli
from p2p_lib.benchmark import Plan, read_plan, run_benchmarks
from p2p_lib.benchmark.benchmark import Benchmark
from p2p_lib.benchmark.execution import execute, perform
from p2p_lib.benchmark.jobs import jobs_of, library_version
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome, load_outcome, save_outcome
from p2p_lib.core.errors import BadInput, Doubt, MissingBackend
from p2p_lib.core.progress import progress_bar
from p2p_lib.datasets.runs import load_run
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.figures.final_tables import paper_table


def run_benchmark(plan, *where, **options):
    """One plan of the benchmarks."""
    return run_benchmarks([plan], *where, **options)[0]


def table(benchmark: Benchmark, name: str = "results") -> list[dict[str, str]]:
    with (benchmark.folder / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def number(rows: list[dict], **wanted) -> float:
    (found,) = (row for row in rows if all(row[key] == str(value) for key, value in wanted.items()))
    return float(found["value"])


EXACT = {"metric": "ADD AUC", "form": "exact", "failures": "zero", "align": "first"}


def test_every_run_of_the_plan_is_there_and_scored_as_p2p_eval_does(whole):
    assert whole.counts() == {"done": 8, "failed": 0, "not run": 0}
    rows = table(whole)
    for job, outcome in whole.results:
        run = whole.out / "runs" / outcome.key
        for align in ("first", "all"):
            scores = evaluate(load_run(run), align=align).as_dict()["objects"]["object"]
            mine = {"key": outcome.key, "failures": "zero", "align": align}
            for metric, key in (("ADD AUC", "add_auc"), ("ADD-S AUC", "adds_auc")):
                assert number(rows, **mine, metric=metric, form="exact") == pytest.approx(scores[key], abs=1e-9)
                assert number(rows, **mine, metric=metric, form="VOC") == pytest.approx(scores[f"{key}_voc"], abs=1e-9)
        assert not (run.parent / f".{outcome.key}").exists() and job.key == outcome.key


def test_a_row_says_all_that_one_needs_to_compare_it(whole):
    row = next(row for row in table(whole) if row["object"] == "object" and row["method"] == "No multi-hypothesis")
    assert (row["tracker"], row["detector"], row["masks"], row["preset"]) == (
        "builtin",
        "corners",
        "dataset",
        "default",
    )
    assert row["unit"] == "%" and row["align"] in ("first", "all") and row["seed"] in "01" and row["frames"] == "6"
    assert len(row["library"]) == 12 and len(row["commit"]) in (0, 40)
    assert {row["column"] for row in table(whole) if row["object"]} == {"AP10", ""}


def test_mean_and_pool_are_those_of_the_runs(whole):
    rows = table(whole)
    runs = [(job, o) for job, o in whole.results if job.method.name == "Ours" and job.seed == 1]
    errors = [np.array(o.objects["object"].first["add_m"]) for _, o in runs]
    assert [len(e) for e in errors] == [6, 5]
    ours = {**EXACT, "method": "Ours", "seed": 1}
    mean = np.mean([metrics.auc_exact(e) for e in errors])
    assert number(rows, **ours, sequence="mean over sequences") == pytest.approx(mean)
    pooled = {**ours, "form": "VOC", "sequence": "pooled over frames"}
    assert number(rows, **pooled) == pytest.approx(metrics.auc_voc(np.concatenate(errors)))


def test_frames_in_which_too_little_is_to_be_seen_are_left_out(plan, tmp_path, here):
    here()
    path = tmp_path / "slides.toml"
    path.write_text("min_visible_px = 1_000_000\n" + plan.read_text())
    found = run_benchmark(path, tmp_path / "out", profile="quick", progress=False)
    assert all("1000000 visible pixels" in outcome.reason for _, outcome in found.results)
    for kind in ("methods", "returns", "runs", "grid", "pairs"):
        shown = replace(found, plan=found.plan.model_copy(update={"kind": kind}))
        assert "less than 1000000 pixels" in paper_table(shown).files()[".md"], kind


def test_the_summary_spreads_over_seeds(whole):
    values = [number(table(whole), **EXACT, method="Ours", seed=s, sequence="mean over sequences") for s in (0, 1)]
    (row,) = (
        row
        for row in table(whole, "summary")
        if row["method"] == "Ours" and row["sequence"] == "mean over sequences" and EXACT.items() <= row.items()
    )
    assert row["seeds"] == "0 1"
    assert [float(row[key]) for key in ("low", "high")] == [min(values), max(values)]
    assert float(row["value"]) == pytest.approx(np.mean(values))
    assert float(row["std"]) == pytest.approx(np.std(values, ddof=1))


def test_nothing_on_disk_is_run_again(whole, plan, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in (whole.out / "records").iterdir()}
    results = (whole.folder / "results.csv").read_bytes()
    start = time.perf_counter()
    again = run_benchmark(plan, whole.out, progress=False)
    quick = run_benchmark(plan, whole.out, "quick", progress=False)
    assert time.perf_counter() - start < 10, "two looks at the disk"
    assert {path: path.stat().st_mtime_ns for path in (whole.out / "records").iterdir()} == before
    assert (again.folder / "results.csv").read_bytes() == results
    assert quick.counts()["done"] == 2, "the quick plan shares runs with the full one"


def test_a_key_is_of_everything_that_decides_a_result(slides, plan, tmp_path, monkeypatch):
    def keys(**changes: str) -> list[str]:
        text = plan.read_text()
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "slides.toml").write_text(text)
        return [job.key for job in jobs_of(read_plan(tmp_path / "slides.toml"), "quick")]

    same = keys()
    assert keys(**{"A board that slides": "Another title", '"Ours"': '"Mine"'}) == same, "names decide nothing"
    assert len(set(same)) == 2
    assert keys(**{"seeds = [0]": "seeds = [4]"})[0] != same[0]
    assert keys(**{'title = "A': 'min_visible_px = 0\ntitle = "A'})[0] != same[0]
    assert keys(**{'column = "AP10" }': "stop = 4 }"})[0] != same[0]
    assert keys(**{'"method.graph" = false': '"method.graph" = true'})[0] != same[0]
    copy = Path(shutil.copytree(slides[0], tmp_path / "copy"))
    assert keys(**{str(slides[0]): str(copy)}) == same, "nor do folders"
    pose = copy / "annotated_poses/0003.txt"
    pose.write_text(pose.read_text().replace("1.0", "1.000000001"))
    assert keys(**{str(slides[0]): str(copy)})[0] != same[0]
    with monkeypatch.context() as other_code:
        other_code.setattr("p2p_lib.benchmark.jobs.code_digest", lambda: "another")
        library_version.cache_clear()
        assert keys()[0] != same[0]
    library_version.cache_clear()
    assert keys() == same


def test_methods_that_need_a_gpu_share_it_as_the_plan_says(plan, tmp_path, monkeypatch):
    ran = []

    def none(jobs, out, at_a_time, scheduler):
        ran.append(({job.method.name for job in jobs}, at_a_time))
        return ((job, Outcome(key=job.key, status="failed")) for job in jobs)

    monkeypatch.setattr("p2p_lib.benchmark.benchmark.execute", none)
    monkeypatch.setattr("p2p_lib.datasets.checkpoints.device", lambda: "cuda")
    (tmp_path / "on.toml").write_text(plan.read_text().replace('name = "No', 'gpu = true\nname = "No'))
    asked = read_plan(tmp_path / "on.toml")
    for limit in (1, 2):
        run_benchmarks([asked.model_copy(update={"gpu_jobs": limit})], tmp_path / str(limit), jobs=4, progress=False)
    assert ran == [({"Ours"}, 4), ({"No multi-hypothesis"}, 1), ({"Ours"}, 4), ({"No multi-hypothesis"}, 2)]


# --- whatever ends it ----------------------------------------------------------------------------


def test_a_killed_benchmark_resumes_to_the_identical_table(whole, plan, tmp_path, here):
    command = [sys.executable, "-m", "p2p_lib.apps.cli", "benchmark", str(plan), "--out", str(tmp_path), "--jobs", "1"]
    killed = subprocess.Popen([*command, "--quiet"], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while len(list((tmp_path / "records").glob("*.json"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    killed.kill()
    killed.wait()
    kept = {path: path.read_bytes() for path in (tmp_path / "records").glob("*.json")}
    assert 2 <= len(kept) < 8, "it was killed on the way"
    assert not (tmp_path / "slides-full").exists()
    here()
    done = run_benchmark(plan, tmp_path, progress=False)
    assert {path: path.read_bytes() for path in kept} == kept, "what was done stays as it was"
    assert (done.folder / "results.csv").read_bytes() == (whole.folder / "results.csv").read_bytes()
    assert (done.folder / "summary.csv").read_bytes() == (whole.folder / "summary.csv").read_bytes()


def test_a_long_reason_keeps_what_to_do(tmp_path):
    def fail(job, out):
        raise BadInput("tracker", "'lkk'", "one of " + ", ".join(f"tracker_{k}" for k in range(99)), "Did you mean lk?")

    reason = perform(fail, SimpleNamespace(key="a"), tmp_path, library_version()).reason
    assert reason.startswith("tracker: got 'lkk'") and reason.endswith("Did you mean lk?") and len(reason) <= 500


def test_a_failing_run_is_a_row_and_the_others_go_on(slides, plan, tmp_path, capsys, here):
    broken = Path(shutil.copytree(slides[0], tmp_path / "broken"))
    (broken / "rgb/0004.png").write_bytes(b"no picture")
    text = plan.read_text().replace("seeds = [0, 1]", "seeds = [0]").replace(str(slides[1]), str(broken))
    (tmp_path / "plan.toml").write_text(text)
    done = run_benchmark(tmp_path / "plan.toml", tmp_path / "out", progress=False, jobs=2)
    assert done.counts() == {"done": 2, "failed": 2, "not run": 0}
    rows = table(done)
    failed = [row for row in rows if row["metric"] == "failed"]
    assert len(failed) == 2 and all("0004.png" in row["reason"] and row["value"] == "" for row in failed)
    again = ["benchmark", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "out"), "--quiet"]
    here()
    assert cli.main(again) == 2 and "2 runs failed; the tables say why" in capsys.readouterr().err
    ours = {"method": "Ours", "seed": 0}
    alone = number(rows, **EXACT, **ours, sequence=str(slides[0]))
    means = {**EXACT, **ours, "sequence": "mean over sequences"}
    assert number(rows, **means) == pytest.approx(alone / 2), "a failure counts as 0"
    assert number(rows, **{**means, "failures": "left out"}) == pytest.approx(alone), "or is left out"
    assert "Traceback" in (tmp_path / "out/failures" / f"{failed[0]['key']}.txt").read_text()
    # Mended, it is another sequence: it runs without being asked for again.
    shutil.copy(slides[0] / "rgb/0004.png", broken / "rgb/0004.png")
    assert run_benchmark(tmp_path / "plan.toml", tmp_path / "out", progress=False).counts()["done"] == 4


def test_what_has_no_truth_is_not_run_for_nothing(plan, slides, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(slides[1], bare)
    shutil.rmtree(bare / "annotated_poses")
    (tmp_path / "plan.toml").write_text(plan.read_text().replace(str(slides[1]), str(bare)))
    of_bare = [job for job in jobs_of(read_plan(tmp_path / "plan.toml"), "full") if job.sequence.name == str(bare)]
    assert of_bare and all(not job.key and "nothing could be scored" in job.reason for job in of_bare)


LOADER = """
from dataclasses import replace
from p2p_lib.datasets import ycbineoat

def load(folder, masks):
    return ycbineoat.load(folder / "inside", masks)

def darker(folder, masks):
    return replace(load(folder, masks), depth_scale=0.0009)
"""


def test_a_sequence_of_ones_own_layout_is_run_by_its_loader(plan, slides, tmp_path, monkeypatch, here):
    here()
    (tmp_path / "mine_of_a_plan.py").write_text(LOADER)
    monkeypatch.syspath_prepend(str(tmp_path))
    shutil.copytree(slides[0], tmp_path / "own/inside")
    text = plan.read_text().replace(f'name = "{slides[0]}"', f'name = "{tmp_path}/own", format = "mine_of_a_plan:load"')
    (tmp_path / "own.toml").write_text(text)
    done = run_benchmark(tmp_path / "own.toml", tmp_path / "out", "quick", progress=False)
    assert done.counts() == {"done": 2, "failed": 0, "not run": 0}
    assert number(table(done), **EXACT, method="Ours", sequence=f"{tmp_path}/own", object="object") > 50
    assert done.run("Ours").info["format"] == "mine_of_a_plan:load" and len(done.video("Ours")) == 6
    (tmp_path / "own.toml").write_text(text.replace(":load", ":darker"))
    keys = {job.key for job in jobs_of(read_plan(tmp_path / "own.toml"), "quick")}
    assert len(keys) == 2 and not keys & {job.key for job, _ in done.results}
    (tmp_path / "own.toml").write_text(text.replace(', format = "mine_of_a_plan:load"', ""))
    reasons = {job.reason for job in jobs_of(read_plan(tmp_path / "own.toml"), "quick")}
    assert all("Give a folder that is in it" in reason for reason in reasons), "of itself it is no recording"


def test_a_run_whose_process_dies_fails_alone_and_is_retried_on_demand(plan, tmp_path, here):
    def kill_the_first() -> None:
        while not (found := [p for p in multiprocessing.active_children() if p.pid]):
            time.sleep(0.001)
        os.kill(found[0].pid, signal.SIGKILL)

    threading.Thread(target=kill_the_first, daemon=True).start()
    done = run_benchmark(plan, tmp_path, "quick", progress=False, jobs=1)
    assert done.counts() == {"done": 1, "failed": 1, "not run": 0}
    (reason,) = (outcome.reason for _, outcome in done.results if outcome.status == "failed")
    assert "its process was ended" in reason
    here()
    assert run_benchmark(plan, tmp_path, "quick", progress=False).counts()["failed"] == 1, "not without being told"
    assert run_benchmark(plan, tmp_path, "quick", progress=False, retry=True).counts()["done"] == 2


def hold(job, out: Path) -> None:
    """A run that has opened a progress bar and does not end."""
    progress_bar("held", 1, shown=False)
    (out / "held").touch()
    time.sleep(60)


def test_what_a_run_doubts_it_keeps_and_other_warnings_are_shown(tmp_path):
    def doubtful(job, out):
        warnings.warn(Doubt("a mask of the whole image"), stacklevel=1)
        warnings.warn("something else", stacklevel=1)
        return Outcome(key=job.key, status="done")

    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        assert perform(doubtful, SimpleNamespace(key="a"), tmp_path, library_version()).status == "done"
    assert [str(one.message) for one in shown] == ["something else"]


INTERRUPTED = """
import os, signal, sys, threading, time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from p2p_lib.benchmark.execution import execute
from tests.benchmark.test_benchmark import hold

def interrupt():
    while not (out / "held").exists():
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell runs in the background ignores it
out = Path(sys.argv[1])
outcomes = execute([SimpleNamespace(key="a")], out, 1, None, hold)
threading.Thread(target=interrupt).start()
try:
    next(outcomes)
    sys.exit("it was not interrupted")
except KeyboardInterrupt:
    outcomes.close()
"""


def test_a_run_that_is_killed_leaves_no_semaphore(tmp_path):
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", INTERRUPTED, str(tmp_path)]
    ran = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=300)
    assert (ran.returncode, ran.stderr) == (0, "") and (tmp_path / "held").exists()


def test_sigterm_ends_the_command_itself_and_nothing_is_left(plan, tmp_path):
    """The real thing: a run is done, another one under way in a process of its own, and six are to come."""
    words = ["benchmark", str(plan), "--out", str(tmp_path), "--jobs", "1"]
    command = [sys.executable, "-m", "p2p_lib.apps.cli", *words]
    ran = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while not (list(tmp_path.glob("records/*.json")) and list(tmp_path.glob("runs/.*"))):
        assert ran.poll() is None and time.monotonic() < deadline, ran.communicate()
        time.sleep(0.01)
    ran.send_signal(signal.SIGTERM)
    out, err = ran.communicate(timeout=300)  # the end of its output is that of all its processes
    goes_on = f"p2p benchmark: interrupted. Go on with it: p2p benchmark {plan} --out {tmp_path}"
    assert ran.returncode == 128 + signal.SIGTERM and err.splitlines()[-1] == goes_on, err
    assert "semaphore" not in err and "Traceback" not in err
    assert 1 <= len(list(tmp_path.glob("records/*.json"))) < 8 and " 0 failed, " in out


def test_what_is_stale_is_not_made_anew_in_part(capsys):
    assert cli.main(["benchmark", "--stale", "--quick"]) == 2
    assert "got --stale with --quick, expected one of them" in capsys.readouterr().err


def test_an_interrupted_plan_replaces_no_table_that_was_made(plan, tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("p2p_lib.benchmark.benchmark.execute", interrupted)
    table, options = tmp_path / "tables/slides.md", ["--quick", "--out", str(tmp_path), "--quiet"]
    table.parent.mkdir()
    table.write_text("as it was")
    assert cli.main(["benchmark", str(plan), *options, "--tables", str(table.parent)]) == 130
    out, err = capsys.readouterr()
    assert table.read_text() == "as it was" and "2 not run" in out and f"not run yet: p2p benchmark {plan}" in out
    assert err.endswith(f"Go on with it: p2p benchmark {plan} --out {tmp_path} --quick\n")


def test_interrupted_figures_say_so_and_draw_nothing(tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("p2p_lib.benchmark.benchmark.execute", interrupted)
    folder, runs = tmp_path / "pictures", tmp_path / "runs"
    assert cli.main(["figures", "--out", str(runs), "--figures", str(folder), "--quiet"]) == 130
    assert capsys.readouterr().err == "p2p figures: interrupted\n" and not folder.exists()
    monkeypatch.setenv("P2P_FIGURES", str(folder))
    assert cli.main(["figures", "--out", str(runs)]) == 130
    first = f"Pictures and their index go to {folder}, over those there; --figures DIR: elsewhere. Runs go to {runs}."
    assert capsys.readouterr().err.splitlines()[0] == first


def test_figures_that_are_not_known_are_refused_before_anything_runs(tmp_path, capsys):
    assert cli.main(["figures", "--out", str(tmp_path / "runs"), "--only", "runtime,fig5_retrun"]) == 2
    said = capsys.readouterr().err
    assert "figures --only: got fig5_retrun, expected names of fig1_three_objects, " in said
    assert said.endswith("Did you mean fig5_return?\n") and not (tmp_path / "runs").exists()


# --- on a cluster --------------------------------------------------------------------------------


def test_a_cluster_finds_the_same_table(whole, plan, tmp_path, capsys):
    distributed = pytest.importorskip("distributed", reason="extra dask is not installed")
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None)
    with cluster:
        address = cluster.scheduler_address
        assert address.startswith("tcp://")
        options = ["--quick", "--out", str(tmp_path), "--scheduler", address, "--quiet"]
        assert cli.main(["benchmark", str(plan), *options]) == 0
    assert "2 done, 0 failed, 0 not run" in capsys.readouterr().out
    here = run_benchmark(plan, whole.out, "quick", progress=False).folder / "results.csv"
    assert (tmp_path / "slides-quick/results.csv").read_bytes() == here.read_bytes()


def test_a_scheduler_that_does_not_answer_is_named(plan, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="extra dask is not installed")
    monkeypatch.setattr("p2p_lib.benchmark.execution._CONNECT_S", 1)
    with pytest.raises(BadInput, match=r"scheduler: got tcp://127\.0\.0\.1:9 .*expected a Dask scheduler that answers"):
        run_benchmark(plan, tmp_path, "quick", scheduler="tcp://127.0.0.1:9", progress=False)


def test_without_distributed_it_says_what_to_install(plan, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    told = r"--scheduler: the package distributed cannot be loaded .*\. Run: .*p2p_lib\[dask\]"
    with pytest.raises(MissingBackend, match=told):
        run_benchmark(plan, tmp_path, "quick", scheduler="tcp://127.0.0.1:9", progress=False)


def test_what_dead_processes_left_is_swept(tmp_path):
    left = tmp_path / "runs" / f".abc.{platform.node()}.999999999"
    running = tmp_path / "runs" / f".abc.{platform.node()}.{os.getpid()}"
    elsewhere = tmp_path / "runs" / ".abc.another-machine.999999999"
    for folder in (left, running, elsewhere):
        folder.mkdir(parents=True)
    assert not list(execute([], tmp_path, 1, None))
    assert not left.exists() and running.exists() and elsewhere.exists()


def test_a_record_with_lost_frames_is_read_back_as_it_was(tmp_path):
    """Infinite errors, as JSON knows none."""
    errors = {"add_m": [0.001, float("inf")], "adds_m": [0.0, float("inf")]}
    box = ObjectOutcome(lost=1, first=errors, all=errors, returns=[3, None], chamfer_cm={"BundleSDF": 0.2})
    made = Outcome(key="abc", status="done", objects={"box": box}, times={"hz": float("nan")})
    save_outcome(tmp_path, made)
    again = load_outcome(tmp_path, "abc")
    assert again.objects == made.objects and np.isnan(again.times["hz"])
    assert np.isinf(again.objects["box"].errors_m("first")["add_m"][1])


def test_every_sequence_is_run_with_every_fault_and_a_row_says_what_it_did(slides, plan, tmp_path, here):
    here()
    known = read_plan(plan)
    scaled = {"name": "depth scaled", "severity": 1.3, "when": "at first"}
    scope = {"seeds": [0], "sequence": [{"name": str(slides[0]), "fault_frames": [3, 5]}]}
    scope["fault"] = [{"name": "none"}, scaled, {"name": "frames dropped"}]
    faults = Plan(name="f", title="Faults", kind="faults", method=known.method[:1], quick=scope, full=scope)
    run = run_benchmark(faults, tmp_path / "out", "quick", progress=False)
    assert run.counts() == {"done": 3, "failed": 0, "not run": 0}
    known = {row["sequence"].partition(" with ")[2] for row in run.rows if row["metric"] == "fault"}
    assert known >= {"none", "depth scaled, 1.3, at first", "frames dropped"}
    assert len({job.key for job, _ in run.results}) == 3, "a fault is part of what decides a result"
    frames = [outcome.objects["object"].fault["frames"] for _, outcome in run.results]
    assert frames == [3, 6, 1], "with truth, from the fault's first on"
    rows = paper_table(run).rows
    assert [row[0].text for row in rows] == ["none", "depth scaled, 1.3, at first", "frames dropped"]
    assert [row[2].text for row in rows] == ["0"] * 3
