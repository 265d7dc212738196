"""The plans of the package: they fit the configuration, the paper's tables and the manifests."""

import re
import shutil
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from p2p_lib.benchmark import execution, plan_names, read_plan
from p2p_lib.benchmark.execution import measured
from p2p_lib.benchmark.jobs import _present, jobs_of
from p2p_lib.benchmark.plan import PROMPTS, Method, Plan, PlannedSequence, Scope, prompts_file, prompts_places
from p2p_lib.core.backends import DETECTORS, TRACKERS
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.options import RunOptions
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets import checkpoints
from p2p_lib.datasets.manifests import manifest
from p2p_lib.datasets.paper_reported import paper_reported
from p2p_lib.datasets.prompts import load_prompts, save_prompts
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.synthetic import SCENARIOS
from tests.fixtures.sliding_board import write_ho3d, write_sequence

PLANS = plan_names()


def test_every_table_of_the_paper_has_a_plan():
    planned = {read_plan(name).paper for name in PLANS}
    assert {table.label for table in paper_reported().tables} <= planned
    assert {"readme", "runtime", "long_range", "trackers"} <= set(PLANS)


@pytest.mark.parametrize("name", PLANS)
def test_methods_fit_configuration_and_registry(name):
    for method in read_plan(name).method:
        RunOptions(preset=method.preset, settings=method.settings).config()
        assert method.tracker in {*TRACKERS, OracleTracker.name}
        assert method.detector in DETECTORS


@pytest.mark.parametrize("name", PLANS)
def test_the_quick_form_is_small_and_embedded_and_the_full_one_has_three_seeds(name):
    plan = read_plan(name)
    assert all(s.name.startswith("synthetic/") and s.stop - s.start <= 80 for s in plan.quick.sequence)
    assert plan.quick.seeds == [0] and len(plan.quick.sequence) == 1
    assert len(plan.full.seeds) >= 3 or name == "paper_figures", "which is looked at, not measured"


@pytest.mark.parametrize("name", PLANS)
def test_sequences_are_known_and_columns_are_the_papers(name):
    plan = read_plan(name)
    table = paper_reported().table(plan.paper) if plan.paper else None
    columns = {f"{c.sequence} {c.object}".strip() for c in table.columns} if table else set()
    filled = []
    for sequence in plan.full.sequence:
        dataset, _, own = sequence.name.rpartition("/")
        if dataset == "synthetic":
            assert own in SCENARIOS
        elif dataset and own != "*":
            entries = {entry.name: entry for entry in manifest(dataset).sequences}
            assert own in entries
            assert sequence.column in ("", entries[own].paper)
        filled += [sequence.column] if sequence.column else list(sequence.columns.values())
    assert len(set(filled)) == len(filled) and set(filled) <= columns
    if plan.kind == "sequences":
        assert set(filled) == columns, "every column of the paper's table has its sequence"
    if table and plan.kind == "methods":
        assert {method.paper for method in plan.method} <= {row.method for row in table.rows} | {""}


def test_plans_are_part_of_an_installation():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["p2p_lib"]
    root = Path(__file__).parents[2] / "p2p_lib"
    assert {path.stem for pattern in patterns for path in root.glob(pattern)} >= {*PLANS, "mustard0"}


def test_what_is_not_there_says_why_and_costs_nothing(monkeypatch):
    monkeypatch.delenv("P2P_DATA", raising=False)
    jobs = jobs_of(read_plan("ycbineoat"), "full")
    assert len(jobs) == 7 * 27 and not any(job.key for job in jobs)
    assert {"below $P2P_DATA, which is not set" in job.reason for job in jobs if job.method.name == "Ours"} == {True}
    fetch = "; ".join(f"p2p data fetch {name}" for name in ("sam2_video", "superpoint", "tapir"))
    asked = {job.reason for job in jobs if job.method.name == "paper_full"}
    assert asked == {f"no weights of sam2_video, superpoint, tapir. Run: {fetch}"}
    (real,) = {job.reason for job in jobs_of(read_plan("ycbmultitrack_real"), "full")}
    assert "P2P_DATA" in real


def test_the_papers_own_configuration_stands_in_every_table_beside_ours():
    for name in PLANS:
        plan = read_plan(name)
        own = [method for method in plan.method if method.name.startswith("paper_")]
        assert own or not plan.paper
        for method in own:
            assert (method.preset, method.tracker, method.masks, method.gpu) == ("paper", "tapir", "sam2_video", True)
            assert method.detector == "superpoint" or "uniform" in method.name
            assert not plan.paper or method.paper, f"{name}: {method.name}"


def test_the_papers_figures_stand_beside_its_own_configuration_alone():
    with pytest.raises(ValueError, match="paper = 'Ours': only with preset, tracker and masks paper, tapir"):
        Method(name="a stand-in", paper="Ours", preset="paper", tracker="builtin2d")


def test_a_configuration_has_one_name_in_all_tables():
    named: dict[str, set[str]] = {}
    for method in (method for name in PLANS for method in read_plan(name).method):
        if method.name not in ("Ours, sensor noise", "Ours, the paper's files", "paper_full_files"):  # say of what data
            same = method.model_dump_json(exclude={"name", "paper", "against", "gpu", "only", "but"})
            named.setdefault(same, set()).add(method.name)
    assert [names for names in named.values() if len(names) > 1] == []


def test_weights_without_a_gpu_are_not_enough(monkeypatch):
    monkeypatch.setattr(checkpoints, "checked_files", lambda name: [])
    for gpu in (False, True):
        monkeypatch.setattr(checkpoints, "device", lambda gpu=gpu: "cuda" if gpu else "cpu")
        (job,) = [job for job in jobs_of(read_plan("long_range"), "quick") if job.method.name == "paper_full"]
        assert bool(job.key) == gpu and ("no GPU here" in job.reason) != gpu


def test_masks_of_some_frames_are_not_taken_for_masks_of_every_frame(tmp_path, monkeypatch):
    """A copy of YCBInEOAT with the first image's mask alone: from it, and from clicks in it."""
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    folder = write_sequence(tmp_path / "YCBInEOAT/mustard0", 6, 2)
    (folder / "masks").mkdir()
    shutil.move(folder / "gt_mask/0000.png", folder / "masks/0000.png")
    shutil.rmtree(folder / "gt_mask")
    jobs = [job for job in jobs_of(read_plan("ycbineoat"), "full") if job.sequence.name == "ycbineoat/mustard0"]
    reasons = {job.method.name: job.reason for job in jobs}
    assert "some of the first frames alone" in reasons["Ours"]
    assert reasons["Ours, first mask"] == reasons["Ours, from clicks"] == ""


def test_ho3d_without_masks_starts_from_the_clicks_that_are_kept(tmp_path, monkeypatch):
    """Without a file it says which is missing and what makes it; with one, that is what the run starts from."""
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    write_ho3d(tmp_path / "HO3D_v3", "SM1")
    asked = read_plan("ho3d")
    ours = [method for method in asked.method if method.name in ("Ours", "Ours, from clicks")]
    mine = [sequence for sequence in asked.full.sequence if sequence.name == "ho3d_v3/SM1"]
    plan = asked.model_copy(update={"method": ours, "full": asked.full.model_copy(update={"sequence": mine})})
    by_masks, by_clicks = jobs_of(plan, "full")[::3]
    file = tmp_path / "prompts/ho3d_v3/SM1.json"
    assert "ho3d_v3/SM1: masks: there are none" in by_masks.reason, "not run, which no mean counts as 0"
    assert f"{file}: no such file" in by_clicks.reason
    assert f"p2p click ho3d_v3/SM1 --out {file}" in by_clicks.reason
    clicks = np.array([[60.0, 50], [40, 30], [70, 60]])
    save_prompts(file, [Prompt("can", points_px=clicks)])
    assert "clicks on 'can', expected the sequence's own names: object" in jobs_of(plan, "full")[3].reason
    save_prompts(file, [Prompt("object", points_px=clicks)])
    job = jobs_of(plan, "full")[3]
    assert job.key and job.options().prompts[0].points_px.tolist() == clicks.tolist()
    outcome = measured(job, tmp_path / "out")
    assert max(outcome.objects["object"].first["add_m"]) < 0.005 and outcome.ran["masks"] == "clicks"
    save_prompts(file, [Prompt("object", points_px=clicks + 1)])
    assert jobs_of(plan, "full")[3].key not in ("", job.key), "other clicks are another run"


def test_no_frame_pays_for_compilation(tmp_path, monkeypatch):
    """What warms up takes a second of the processor, and none of it is the run's."""

    def slow() -> None:
        began_s = time.process_time()
        while time.process_time() < began_s + 1:
            pass

    monkeypatch.setattr(execution, "warm_up", slow)
    plan = read_plan("ablation_trackers")
    job = next(job for job in jobs_of(plan, "quick") if job.key)
    began_s = time.process_time()
    times = measured(job, tmp_path).times
    spent_s = time.process_time() - began_s
    frames = job.sequence.stop
    assert times["processor time, files included [ms]"] * frames / 1e3 < spent_s - 0.9


def test_clicks_of_ones_own_come_before_those_of_the_package(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    shipped = sorted(path.relative_to(PROMPTS).with_suffix("").as_posix() for path in PROMPTS.rglob("*.json"))
    named = {sequence.name for name in PLANS for sequence in read_plan(name).full.sequence}
    assert shipped and set(shipped) <= named
    for name in shipped:
        assert all(prompt.starts for prompt in load_prompts(prompts_file(name)))
    own = tmp_path / "prompts" / f"{shipped[0]}.json"
    save_prompts(own, [Prompt("object", points_px=np.array([[1.0, 2]]))])
    assert prompts_file(shipped[0]) == own and prompts_file(shipped[1]) == PROMPTS / f"{shipped[1]}.json"
    assert prompts_places("/somewhere/x") == prompts_places("../x") == () and prompts_file("unheard/of") is None


def test_every_sequence_of_a_dataset_that_is_there(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    for name in ("b_two", "a_one"):
        (tmp_path / "YCBMultiTrack/real" / name / "rgb").mkdir(parents=True)
    (tmp_path / "YCBMultiTrack/real/models").mkdir()
    jobs = jobs_of(read_plan("ycbmultitrack_real"), "full")
    names = list(dict.fromkeys(job.sequence.name for job in jobs))
    assert names == ["ycbmultitrack_real/a_one", "ycbmultitrack_real/b_two"]
    ours = [job.reason for job in jobs if job.method.name == "Ours"]
    assert ours and all("no files, expected colour" in reason for reason in ours), "and what is wrong with it"


def test_whose_folders_are_which_rows_a_file_beside_them_says(tmp_path, monkeypatch):
    """Both of YCBMultiTrack: what it names fills the paper's rows, the rest has rows of its own."""
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    for kind, column in (("real", "one object 2 mustard"), ("synthetic", "one object 1 sugar")):
        root = tmp_path / "YCBMultiTrack" / kind
        for name in ("a", "b"):
            (root / name / "rgb").mkdir(parents=True)
        (root / "columns.toml").write_text(f'[b]\nthing = "{column}"\n')
        plan = read_plan(f"ycbmultitrack_{kind}")
        jobs, methods = jobs_of(plan, "full"), {True: set(), False: set()}
        for job in jobs:
            methods[job.sequence.name.startswith(plan.name)].add(job.method.name)
        columns = {job.sequence.name: job.sequence.column_of("thing") for job in jobs if plan.name in job.sequence.name}
        assert columns == {f"{plan.name}/a": "", f"{plan.name}/b": column}
        own = PlannedSequence(name=f"{plan.name}/*", columns={"thing": "the plan's"})
        assert [one.column_of("thing") for one, _ in _present(own)] == ["the plan's", column]
        assert not methods[True] & methods[False], "of the paper's files, or of ours"
        assert not methods[True] & {"Ours, exact depth", "Ours, sensor noise"}
        (root / "columns.toml").write_text(f'[bb]\nthing = "{column}"\n')
        with pytest.raises(
            BadInput, match=r"columns\.toml: got \[bb\], expected sequences in .*: a, b\. Did you mean b\?"
        ):
            jobs_of(plan, "full")
        (root / "columns.toml").write_text(f'b = "{column}"\n')
        with pytest.raises(BadInput, match=r"columns\.toml: got b: .*, expected a table \[SEQUENCE\] each"):
            jobs_of(plan, "full")


SMALL = 'title = "t"\n[[method]]\nname = "Ours"\n[quick]\nseeds = [0]\nsequence = [{ name = "a" }]\n'
SMALL += '[full]\nseeds = [0]\nsequence = [{ name = "a" }]\n'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "Ours"', 'name = "Ours"\ntraker = "lk"', r"method\.0\.traker, a key unknown .* Did you mean tracker"),
        ("seeds = [0]", "seeds = [0.5]", r"quick\.seeds\.0: 0\.5, where a whole number should be"),
        ("seeds = [0]", "seeds = []", r"quick\.seeds: \[\], where a list of at least 1 should be"),
        ('name = "a" }', 'name = "a", stop = -1 }', r"quick\.sequence\.0\.stop"),
        ("[quick]", '[[method]]\nname = "Ours"\n[quick]', "two methods have one name"),
        ("seeds = [0]", 'seeds = [0]\nmethods = ["Theirs"]', "no method is called 'Theirs'"),
        ('title = "t"', "title = ", "unreadable TOML"),
        ('name = "a" }', 'name = "a", start = 50, stop = 5 }', r"a: start = 50, stop = 5: that is no frame"),
        ('name = "Ours"', 'name = "Ours"\nonly = ["b"]', r"only: no sequence is called 'b' \(There are a\.\)"),
        ('name = "Ours"', 'name = "Ours"\nbut = ["ab"]', r"but: no sequence is called 'ab' \(Did you mean a\?\)"),
        (
            'name = "Ours"',
            'name = "Ours"\nformat = "bop"',
            r"method\.0\.format, a key unknown there, .* section Plans\)$",
        ),
        ('name = "a" }', 'name = "synthetic/mug", format = "bop" }', r"format = 'bop': synthetic/mug is rendered"),
    ],
)
def test_a_plan_that_does_not_fit_names_the_key(tmp_path, old, new, message):
    assert old in SMALL
    (tmp_path / "small.toml").write_text(SMALL)
    assert read_plan(tmp_path / "small.toml").name == "small"
    (tmp_path / "small.toml").write_text(SMALL.replace(old, new))
    with pytest.raises(BadInput, match=message):
        read_plan(tmp_path / "small.toml")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            'settings = { "registration.hypotheses" = 3 }',
            r"configuration key: got 'registration\.hypotheses', expected a key",
        ),
        ('settings = { "tsdf.voxel_m" = "small" }', r"config tsdf\.voxel_m: got 'small' \(str\), expected a number"),
        ('preset = "papr"', r"preset: got 'papr', expected one of default, paper"),
    ],
)
def test_a_parameter_that_does_not_fit_names_plan_and_method(tmp_path, line, message):
    (tmp_path / "small.toml").write_text(SMALL.replace('name = "Ours"', f'name = "Ours"\n{line}'))
    with pytest.raises(BadInput, match=rf"^plan small, method 'Ours': {message}"):
        jobs_of(read_plan(tmp_path / "small.toml"), "full")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"Ours"', '"Ours"\ntracker = "lkk"', r"^plan small, method 'Ours': tracker: got 'lkk', .* Did you mean lk\?"),
        ('"Ours"', '"Ours"\ndetector = "cornrs"', r"method 'Ours': detector: got 'cornrs', .* Did you mean corners\?"),
        ('"Ours"', '"Ours"\nmasks = "click"', r"masks of synthetic/mug: got 'click', .* Did you mean clicks\?"),
        ("synthetic/mug", "synthetic/mgu", r"got 'synthetic/mgu', .* Did you mean synthetic/mug\?"),
        ('mug"', 'mug", objects = ["mugg"]', r"objects of synthetic/mug: got 'mugg', .* Did you mean mug\?"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_rendered(tmp_path, monkeypatch, old, new, message):
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "cache"))
    small = SMALL.replace('"a"', '"synthetic/mug"')
    (tmp_path / "small.toml").write_text(small)
    assert all(job.key for job in jobs_of(read_plan(tmp_path / "small.toml"), "full"))
    assert old in small
    (tmp_path / "small.toml").write_text(small.replace(old, new))
    with pytest.raises(BadInput, match=message):
        jobs_of(read_plan(tmp_path / "small.toml"), "full")
    assert not (tmp_path / "cache").exists()


def test_a_sequence_that_cannot_be_scored_or_has_no_such_object_says_so(tmp_path, monkeypatch):
    """Of files the line says why; the plan's other sequences run."""
    board = write_sequence(tmp_path / "board", 6, 2)
    own = "p2p_lib.datasets.ycbineoat:load"

    def reasons(**more):
        planned = {"name": str(board), "models": {}} | more
        method = Method(name="Ours", masks=planned.pop("masks", "dataset"))
        scope = Scope(seeds=[0], sequence=[PlannedSequence(**planned)])
        return [job.reason for job in jobs_of(Plan(name="p", title="t", method=[method], full=scope), "full")]

    assert reasons() == [""]
    assert "objects of" in reasons(objects=["objct"])[0] and "Did you mean object?" in reasons(objects=["objct"])[0]
    assert "Did you mean clicks?" in reasons(masks="click")[0]
    assert "got start = 9, expected one of its 6 frames" in reasons(start=9)[0]
    for model in (board / "models").rglob("*.*"):
        model.unlink()
    assert "models of object: none at" in reasons()[0]
    with monkeypatch.context() as patch:
        patch.setattr("p2p_lib.datasets.ycbineoat.np.ones", lambda n, kind: np.full(n - 1, True))
        assert "truth: got T_cam_model (6, 4, 4), labelled (5,)" in reasons(format=own)[0]


def test_a_changed_tracker_of_ones_own_is_another_run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    code = tmp_path / "my_changing_tracker.py"
    code.write_text("def made(config, rng): ...\n")
    small = SMALL.replace('"a"', '"synthetic/mug"').replace('"Ours"', '"Ours"\ntracker = "my_changing_tracker:made"')
    (tmp_path / "small.toml").write_text(small)
    (before,), (same,) = (jobs_of(read_plan(tmp_path / "small.toml"), "full") for _ in range(2))
    code.write_text("def made(config, rng): return 1\n")
    (after,) = jobs_of(read_plan(tmp_path / "small.toml"), "full")
    assert before.key == same.key != after.key


def test_a_plan_may_do_without_a_quick_profile_which_is_then_refused(tmp_path):
    (tmp_path / "small.toml").write_text(re.sub(r"(?s)\[quick\].*(?=\[full\])", "", SMALL))
    plan = read_plan(tmp_path / "small.toml")
    assert [method.name for method in plan.methods("full")] == ["Ours"]
    with pytest.raises(BadInput, match=r"^plan small: got the profile quick, .* Run it in full, or give it a table"):
        jobs_of(plan, "quick")


def test_a_plan_that_is_not_there_lists_those_that_are():
    with pytest.raises(MissingData, match=r"ycb: no such plan\. Give a TOML file, or one of ablation, .*ycbineoat"):
        read_plan("ycb")
