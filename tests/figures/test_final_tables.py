"""The paper's tables with ours beside: what is bold, what is a dash and why, in Markdown, LaTeX and CSV."""

import csv
import io
import re
from dataclasses import replace

import pytest

from p2p_lib.benchmark.benchmark import Benchmark, load_benchmark
from p2p_lib.benchmark.jobs import Job
from p2p_lib.benchmark.outcome import ObjectOutcome, Outcome
from p2p_lib.benchmark.plan import Plan, read_plan
from p2p_lib.benchmark.rows import shown_name
from p2p_lib.datasets.paper_reported import FAIL, paper_reported
from p2p_lib.figures.final_tables import KINDS, paper_table, write_table
from p2p_lib.figures.tables import Cell, Table, emboldened
from studies import final_figures


def errors(percent: float, frames: int) -> dict[str, list[float]]:
    """Of a run with this area under both curves."""
    return {key: [0.1 * (1 - percent / 100)] * frames for key in ("add_m", "adds_m")}


def outcome(percent: float, frames: int = 10, **more) -> Outcome:
    scored = errors(percent, frames)
    obj = ObjectOutcome(lost=0, first=scored, all=scored, returns=[3, None], **more)
    ran = {"tracker": "builtin", "detector": "corners", "masks": "dataset", "frames": frames, "commit": "c" * 40}
    return Outcome(key="k", status="done", ran=ran, objects={"object": obj}, times={"rate [Hz]": 20.0})


def benchmark(tmp_path, results: dict, seeds=(0,), **plan) -> Benchmark:
    """results: (method, sequence) to an outcome per seed."""
    of = plan.pop("of", "Ours")
    own = {"paper": of, "preset": "paper", "tracker": "tapir", "masks": "sam2_video"}
    methods = {method: {"name": method, **own} for method, _ in results}
    scope = {"seeds": list(seeds), "sequence": [{"name": "s"}]}
    made = Plan(name="p", title="A table", method=list(methods.values()), quick=scope, full=scope, **plan)
    jobs = []
    for (name, sequence), outcomes in results.items():
        method = next(m for m in made.method if m.name == name)
        planned = made.full.sequence[0].model_validate(sequence_of(sequence))
        jobs += [
            (Job(method, planned, seed, "poses", made.chamfer, key="k"), one)
            for seed, one in zip(seeds, outcomes, strict=True)
        ]
    return Benchmark(made, "full", tmp_path, tuple(jobs))


def sequence_of(name: str) -> dict:
    column = {e: c for e, c in COLUMNS.items() if e == name}
    return {"name": f"ycbineoat/{name}", "column": column.get(name, "")}


COLUMNS = {
    "bleach0": "bleach v1",
    "bleach_hard_00_03_chaitanya": "bleach v2",
    "cracker_box_reorient": "cracker v1",
    "cracker_box_yalehand0": "cracker v2",
    "mustard0": "mustard v1",
    "mustard_easy_00_02": "mustard v2",
    "sugar_box1": "sugar v1",
    "sugar_box_yalehand0": "sugar v2",
    "tomato_soup_can_yalehand0": "tomato",
}
FRAMES = dict(zip(COLUMNS, (663, 441, 375, 1327, 737, 689, 907, 1002, 1308), strict=True))
INEOAT = {"paper": "tab:ycb_ineoat", "kind": "sequences"}


def cell(table: Table, column: str, *words: str) -> Cell:
    (row,) = (row for row in table.rows if [c.text for c in row[: table.words]] == list(words))
    return row[list(table.heads).index(column)]


def test_the_papers_own_bold_is_found_again(tmp_path):
    """Without runs of ours, the bold numbers are those that the paper prints in bold."""
    table = paper_table(benchmark(tmp_path, {("Ours", "else"): [outcome(90)]}, **INEOAT))
    bold = {
        (row[0].text, row[2].text): [head for head, c in zip(table.heads, row, strict=True) if c.bold]
        for row in table.rows
    }
    bundle = ["bleach v1", "bleach v2", "mustard v1", "mustard v2", "sugar v1", "sugar v2", "Mean"]
    assert bold["ADD-S (%)", "BundleSDF (reported)"] == bundle
    assert bold["ADD (%)", "Point2Pose (reported)"] == ["cracker v1", "cracker v2", "tomato"]
    assert bold["ADD-S (%)", "FoundationPose (reported)"] == bold["ADD-S (%)", "Ours"] == []


def test_ours_is_compared_where_the_whole_sequence_ran(tmp_path):
    runs = {("Ours", name): [outcome(99, FRAMES[name])] for name in COLUMNS}
    runs["Ours", "mustard0"] = [outcome(99, 400)]
    table = paper_table(benchmark(tmp_path, runs, **INEOAT))
    ours = ("ADD (%)", "CAD-free", "Ours")
    assert cell(table, "bleach v1", *ours) == Cell("99.00", bold=True)
    assert cell(table, "bleach v1", "ADD (%)", "CAD-free", "BundleSDF (reported)").bold is False
    assert cell(table, "mustard v1", *ours) == Cell("99.00", note="400 of 737 frames")
    assert cell(table, "mustard v1", "ADD (%)", "CAD-free", "BundleSDF (reported)") == Cell("90.44", bold=True)
    some = "of 8 of the table's 9 columns, which were run in whole"
    assert cell(table, "Mean", *ours) == Cell("99.00", note=some), "shown, and not compared"
    runs["Ours", "mustard0"] = [outcome(90, 737)]
    table = paper_table(benchmark(tmp_path, runs, **INEOAT))
    assert cell(table, "Mean", *ours) == Cell("98.00", bold=True), "the mean over sequences"


def test_the_mean_is_over_the_rows_that_ran_where_no_column_is_named_for_them(tmp_path):
    runs = {("Ours", "folder_a"): [outcome(90)], ("Ours", "folder_b"): [outcome(80)]}
    ours = ("ADD (%)", "CAD-free", "Ours")
    none = "0 of the table's 9 columns were run in whole"
    said = f"{none}; 2 more that no column is named for are in the mean"
    assert cell(paper_table(benchmark(tmp_path, runs, **INEOAT)), "Mean", *ours) == Cell("85.00", note=said)
    runs["Ours", "bleach0"] = [outcome(70, FRAMES["bleach0"])]
    assert cell(paper_table(benchmark(tmp_path, runs, **INEOAT)), "Mean", *ours).text == "80.00"


def test_a_re_creation_is_never_compared_with_the_papers_numbers(tmp_path):
    """It ran in whole and is better than all that is reported: not bold, and said so."""
    plan = read_plan("ycbmultitrack_synthetic")
    method, scored = next(m for m in plan.method if m.synthetic), errors(99.9, 10)
    jobs = []
    for planned in (planned for planned in plan.full.sequence if method.runs_on(planned.name)):
        objects = {n: ObjectOutcome(lost=0, first=scored, all=scored, returns=[]) for n in planned.columns}
        one = outcome(99.9).model_copy(update={"objects": objects})
        jobs += [(Job(method, planned, seed, "poses", False, key="k"), one) for seed in plan.full.seeds]
    table = paper_table(Benchmark(plan, "full", tmp_path, tuple(jobs)))
    at = [k for k, head in enumerate(table.heads) if head == method.name]
    mine = [row[k] for row in table.rows for k in at]
    assert {cell.text for cell in mine} == {"99.90 ± 0.00"} and not any(cell.bold for cell in mine)
    assert {cell.note for row in table.rows[:-1] for cell in [row[at[0]]]} == {"re-created, not the paper's files"}
    reported = [k for k, head in enumerate(table.heads) if head == "Point2Pose (reported)"]
    assert table.rows[-1][reported[0]].bold, "the paper's own stays the best of what is compared"


def test_pairs_are_differences_run_against_run(tmp_path):
    """The scenes differ by 40 points, the component is worth 1 to 3 in each: only a paired comparison sees it."""
    levels = {"bleach0": 95, "mustard0": 75, "sugar_box1": 55}
    gains = {"bleach0": (1, 2, 3), "mustard0": (2, 1, 3), "sugar_box1": (3, 2, 1)}
    runs = {("With", scene): [outcome(level)] * 3 for scene, level in levels.items()}
    runs |= {("With, less", s): [outcome(levels[s] - gain) for gain in gains[s]] for s in levels}
    made = benchmark(tmp_path, runs, seeds=(0, 1, 2), kind="pairs")
    methods = [m.model_copy(update={"against": "With" * ("less" in m.name)}) for m in made.plan.method]
    made = replace(made, plan=made.plan.model_copy(update={"method": methods}))
    base, without = paper_table(made).rows
    assert [cell.text for cell in base][:4] == ["With", "with all", "9", "75.0"]
    assert [cell.text for cell in without][:3] == ["", "less", "9"]
    mean, low, high = map(float, re.findall(r"[+-][\d.]+", without[4].text))
    assert mean == 2.0 and 1.0 < low < 2.0 < high < 3.0 and without[4].bold
    assert not any(cell.bold for cell in without[5:]), "three runs of a scene prove nothing"
    (job, _), *later = made.results
    later = [pair for pair in later if pair[0].method.against]
    unrun = replace(made, results=((job, Outcome(key="k", status="not run", reason="later")), *later))
    assert {cell.note for cell in paper_table(unrun).rows[0][3:]} == {"later"}


def test_a_grid_has_a_row_per_sequence_and_the_mean_of_those_that_all_methods_ran(tmp_path):
    runs = {
        ("Paper's text", "bleach0"): [outcome(90), outcome(80)],
        ("Paper's text", "mustard0"): [outcome(70)] * 2,
    }
    runs[("Ours, LK", "bleach0")] = [outcome(99)] * 2
    table = paper_table(benchmark(tmp_path, runs, seeds=(0, 1), kind="grid"))
    assert list(table.heads) == ["Sequence", "built-in", "LK"]
    assert list(table.groups) == [("", 1), ("Paper's text", 1), ("Ours", 1)]
    first, second, mean = [[cell.text for cell in row] for row in table.rows]
    assert first == ["ycbineoat/bleach0", "85.0 / 85.0 (0)", "99.0 / 99.0 (0)"]
    assert second == ["ycbineoat/mustard0", "70.0 / 70.0 (0)", "-"]
    assert mean == ["mean of 1", *first[1:]]
    assert any("; mean over seeds 0, 1" in note for note in table.notes) and "±" not in str(table.notes)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_what_a_plan_has_to_say_stands_below_its_table(tmp_path, kind):
    papers = {"sequences": "tab:ycb_ineoat", "objects": "tab:ycbmultitrack_real"}
    made = {"kind": kind, "of": "Point2Pose" if kind == "returns" else "Ours", "paper": papers.get(kind, "")}
    runs = {("Ours", "mustard0"): [outcome(90)]}
    assert "A word" not in paper_table(benchmark(tmp_path, runs, **made)).notes
    assert paper_table(benchmark(tmp_path, runs, **made, note="A word")).notes.count("A word") == 1


def test_where_only_the_quick_form_ran_the_shipped_table_is_shown(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_TABLES", str(tmp_path / "out"))
    monkeypatch.setattr(final_figures, "SHIPPED", tmp_path)
    made = benchmark(tmp_path, {("Ours", "x"): [outcome(90)]})
    quick = replace(made, profile="quick")
    assert final_figures.shown_table(quick).path == tmp_path / "out/final_p.csv", "none is shipped"
    (tmp_path / "p.md").write_text("| the shipped one |")
    assert "the shipped one" in final_figures.shown_table(quick)._repr_markdown_()
    assert "nothing newer was run here" in final_figures.shown_table(quick)._repr_markdown_()
    assert final_figures.shown_table(made).path == tmp_path / "out/final_p.csv", "a full run is newer"


def test_seeds_show_their_spread(tmp_path):
    runs = {("Ours", "bleach0"): [outcome(90, 663), outcome(92, 663), outcome(94, 663)]}
    table = paper_table(benchmark(tmp_path, runs, seeds=(0, 1, 2), **INEOAT))
    assert cell(table, "bleach v1", "ADD (%)", "CAD-free", "Ours").text == "92.00 ± 2.00"
    assert any("over seeds 0, 1, 2" in note for note in table.notes)


def test_a_number_of_fewer_seeds_than_planned_says_so(tmp_path):
    absent = Outcome(key="k", status="not run", reason="killed")
    runs = {("Ours", "bleach0"): [outcome(90, 663), outcome(94, 663), absent]}
    table = paper_table(benchmark(tmp_path, runs, seeds=(0, 1, 2), **INEOAT))
    assert cell(table, "bleach v1", "ADD (%)", "CAD-free", "Ours").note == "of 2 of 3 seeds"
    (row,) = paper_table(benchmark(tmp_path, runs, seeds=(0, 1, 2), kind="runs")).rows
    assert (row[2].text, row[2].note) == ("92.0 (90.0 to 94.0)", "of 2 of 3 seeds")
    (row,) = paper_table(benchmark(tmp_path, {("Ours", "a"): [outcome(90)]}, kind="runs")).rows
    assert row[2].note == ""


def test_latex_has_groups_rules_and_notes():
    heads, groups = ["Method", "ADD (%)", "lost", "Hz"], [("", 1), ("first", 2), ("rate", 1)]
    rows = [[Cell("a_b"), Cell("1 ± 2", bold=True), Cell(note="none"), Cell("3")], [Cell("c"), *[Cell()] * 3]]
    table = Table("50 %", heads, rows, groups, rules=[1], notes=["All of it"])
    assert table.latex().splitlines() == [
        r"\begin{table}",
        r"\centering",
        r"\caption{50 \%}",
        r"\begin{tabular}{@{}lccc@{}}",
        r"\toprule",
        r" & \multicolumn{2}{c}{first} & rate \\",
        r"Method & ADD (\%) & lost & Hz \\",
        r"\midrule",
        r"a\_b & \textbf{1 $\pm$ 2} & --\textsuperscript{a} & 3 \\",
        r"\midrule c & -- & -- & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\par\footnotesize \textsuperscript{a}~none. All of it.",
        r"\end{table}",
    ]


def test_a_note_that_asks_has_one_mark():
    lines = Table("t", ["a"], [[Cell(note="Did you mean lk?")]], notes=["Why?", "So."]).markdown()
    assert all(f"{end}\n" in f"{lines}\n" or f"{end} " in lines for end in ("lk?", "Why?", "So.")) and "?." not in lines


def test_what_did_not_run_says_why(tmp_path):
    failed = Outcome(key="k", status="failed", reason="BadInput: a broken picture.")
    missing = Outcome(key="", status="not run", reason="bleach: $P2P_DATA is not set.")
    runs = {("Ours", "mustard0"): [failed], ("Ours", "bleach0"): [missing]}
    table = paper_table(benchmark(tmp_path, runs, **INEOAT))
    ours = ("ADD-S (%)", "CAD-free", "Ours")
    assert cell(table, "mustard v1", *ours) == Cell(FAIL, note="BadInput: a broken picture")
    assert cell(table, "bleach v1", *ours) == Cell(note="bleach: $P2P_DATA is not set")
    assert cell(table, "sugar v1", *ours).note == "no run of the plan is of this"
    markdown, latex = table.markdown(), table.latex()
    assert "fail (" in markdown and r") bleach: \$P2P_DATA is not set." in markdown, "or it is taken for an equation"
    assert ") bleach: <span>$</span>P2P_DATA is not set." in table.html()
    assert r"\$P2P\_DATA is not set" in latex and "--\\textsuperscript{" in latex
    rows = list(csv.DictReader(io.StringIO(table.csv())))
    (row,) = (r for r in rows if r["Metric"] == "ADD-S (%)" and r["Method"] == "Ours")
    assert row["bleach v1"] == "" and row["mustard v1"] == FAIL
    assert "bleach v1: bleach: $P2P_DATA is not set" in row["notes"]


def test_both_chamfer_forms_stand_beside_the_reported(tmp_path):
    plan = {"paper": "tab:bundlesdf_point2pose_comparison", "kind": "sequences", "chamfer": True}
    made = benchmark(tmp_path, {("Ours", "x"): [outcome(90, chamfer_cm={"BundleSDF": 0.4, "release": 0.31})]}, **plan)
    table = paper_table(made)
    name = shown_name(made.results[0][0])
    assert cell(table, name, "CD (cm)", "CAD-free", "Ours, BundleSDF's form").text == "0.40"
    assert cell(table, name, "CD (cm)", "CAD-free", "Ours, release's form").text == "0.31"
    reported = cell(table, "SB11", "CD (cm)", "CAD-free", "BundleSDF (reported)")
    assert reported == Cell("0.45", bold=True), "less is better"


def test_objects_are_rows_and_methods_columns(tmp_path):
    plan = {"paper": "tab:ycbmultitrack_syn", "kind": "objects"}
    table = paper_table(benchmark(tmp_path, {("Ours", "x"): [outcome(90)]}, **plan))
    paper = paper_reported().table("tab:ycbmultitrack_syn")
    assert len(table.rows) == len(paper.columns) + 2
    assert [c.text for c in table.rows[0]][:5] == ["one object 1", "sugar", "98.44", "69.80", "96.97"]
    assert [c.text for c in table.rows[3]][:2] == ["", "sugar"], "the sequence is said once"
    assert [c.text for c in table.rows[-2]][:2] == ["ycbineoat/x", "object"]
    assert [c.text for c in table.rows[-1]][:5] == ["Mean", "", "98.39", "76.74", "88.67"]
    assert table.rows[4][4].bold and not table.rows[4][3].bold, "41.80 against 12.36"


def test_a_page_is_as_wide_as_one_metric_of_many_methods(tmp_path):
    runs = {("Ours", "x"): [outcome(90)], ("Mine", "x"): [outcome(80)]}
    table = paper_table(benchmark(tmp_path, runs, paper="tab:ycbmultitrack_syn", kind="objects"))
    first, second = (line.split(" | ") for line in table.markdown().splitlines() if line.startswith("| Category"))
    assert len(first) == len(second) == 7 and len(table.heads) == 12
    assert {head.partition(":")[0] for head in first[2:]} == {"ADD-S (%)"} and second[2].startswith("ADD (%): ")


def test_methods_against_each_other(tmp_path):
    runs = {
        ("Proposed", "a"): [outcome(90)],
        ("Proposed", "b"): [outcome(80)],
        ("Mine", "a"): [outcome(70)],
        ("Mine", "b"): [outcome(72)],
    }
    made = benchmark(tmp_path, runs, of="Proposed", paper="tab:ablation_mean_std", kind="methods")
    table = paper_table(made)
    assert [c.text for c in table.rows[0]] == ["Proposed", "85.00", "7.07", "85.00", "7.07", "95.07", "82.76"]
    assert [c.bold for c in table.rows[0]][1::2] == [True, True, True] and not table.rows[1][1].bold


def test_a_mean_over_some_of_the_sequences_says_so(tmp_path):
    missing = Outcome(key="", status="not run", reason="not there")
    runs = {("Proposed", "a"): [outcome(90)], ("Proposed", "b"): [missing]}
    made = benchmark(tmp_path, runs, of="Proposed", paper="tab:ablation_mean_std", kind="methods")
    assert paper_table(made).rows[0][1] == Cell("90.00", bold=False, note="1 of 2 sequences")


def test_returns_are_summed_over_seeds(tmp_path):
    runs = {("Ours", "a"): [outcome(90), outcome(90)]}
    made = benchmark(tmp_path, runs, seeds=(0, 1), of="Point2Pose", kind="returns")
    (row,) = paper_table(made).rows
    assert [c.text for c in row] == ["Ours", "2/4", "90.00 ± 0.00", "90.00 ± 0.00", "5/5", "93.79", "84.36"]


def test_rates_and_runs(tmp_path):
    runs = {("Ours", "a"): [outcome(90), outcome(94)]}
    (row,) = paper_table(benchmark(tmp_path, runs, seeds=(0, 1), kind="rates")).rows
    assert [c.text for c in row][:2] == ["Ours", "20.0"]
    (row,) = paper_table(benchmark(tmp_path, runs, seeds=(0, 1), kind="runs")).rows
    area = "92.0 (90.0 to 94.0)"
    assert [c.text for c in row] == [
        "Ours",
        "ycbineoat/a",
        area,
        area,
        area,
        area,
        "0 of 10",
        "2 of 4 after 3 frames",
        "20.0",
    ]
    for returns, said in (([], "none"), ([None], "0 of 1"), ([0, 7], "2 of 2 after 0 to 7 frames")):
        one = outcome(90)
        objects = {"object": one.objects["object"].model_copy(update={"returns": returns})}
        runs = {("Ours", "a"): [one.model_copy(update={"objects": objects})]}
        assert paper_table(benchmark(tmp_path, runs, kind="runs")).rows[0][7].text == said
    absent = Outcome(key="k", status="not run", reason="no models")
    (row,) = paper_table(benchmark(tmp_path, {("Ours", "a"): [absent]}, kind="runs")).rows
    assert {(c.text, c.note) for c in row[2:]} == {("-", "no models")}, "every dash has its reason"


def test_what_has_no_rate_says_why(tmp_path):
    absent = Outcome(key="", status="not run", reason="no weights of tapir.")
    failed = Outcome(key="k", status="failed", reason="ValueError: no")
    runs = {("Ours", "a"): [outcome(90)], ("tapir", "a"): [absent], ("broken", "a"): [failed]}
    table = paper_table(benchmark(tmp_path, runs, kind="rates"))
    ours, tapir, broken = ([(c.text, c.note) for c in row[1:]] for row in table.rows)
    assert ours[0] == ("20.0", "") and set(ours[1:]) == {("-", "its runs have no such time")}
    assert set(tapir) == {("-", "no weights of tapir")} and set(broken) == {(FAIL, "ValueError: no")}


def test_a_dataset_that_is_not_there_is_the_reason_of_every_dash_and_has_no_row(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    for name, mine in (("ycbmultitrack_real", "Ours"), ("ycbmultitrack_synthetic", "Ours, the paper's files")):
        plan = read_plan(name)
        table = paper_table(load_benchmark(plan, tmp_path, "full"))
        columns = paper_reported().table(plan.paper).columns
        assert len(table.rows) == len(columns) + 1, "no row that is not of an object"
        at = [k for k, head in enumerate(table.heads) if head == mine]
        reasons = {row[k].note for row in table.rows[:-1] for k in at}
        assert len(reasons) == 1 and reasons.pop().startswith(f"{name}: no sequence in YCBMultiTrack/")


def test_three_files_lie_beside_the_results(tmp_path):
    made = benchmark(tmp_path, {("Ours", "x"): [outcome(90)]}, **INEOAT)
    shown = write_table(made)
    files = {path.suffix: path.read_text() for path in (tmp_path / "p-full").iterdir()}
    assert set(files) == {".md", ".tex", ".csv"} and files[".md"] == shown
    widths = {line.count("|") for line in shown.splitlines() if line.startswith("|")}
    assert len(widths) == 1, "as many cells in every line"
    columns = {len(re.findall(r"(?<!\\)&", line)) for line in files[".tex"].splitlines() if line.endswith(r"\\")}
    assert columns == {len(made.plan.title and paper_table(made).heads) - 1}


@pytest.mark.parametrize(
    ("texts", "bold"),
    [
        (["1.00", "2.00"], [False, True]),
        (["2.00", "2.00 ± 0.10"], [True, True]),
        (["fail", "0.50"], [False, True]),
        (["-", "0.50"], [False, False]),
        (["fail", "-"], [False, False]),
        (["0.50"], [False]),
    ],
)
def test_bold_is_the_best_of_those_that_tried(texts, bold):
    assert [c.bold for c in emboldened([Cell(text) for text in texts], True)] == bold


def test_a_page_has_the_groups_above_their_heads():
    rows = [[Cell("Ours"), Cell("1.00", bold=True), Cell(note="no <data>")]]
    page = Table("A table", ["Method", "ADD", "rate"], rows, [("", 1), ("reported", 2)], notes=["All"]).html()
    assert [head.count("<th") for head in page.partition("</thead>")[0].split("<tr>")[1:]] == [2, 3]
    assert 'colspan="2">reported</th>' in page
    assert "<b>1.00</b>" in page and "-<sup>a</sup>" in page and "(a) no &lt;data&gt;." in page


def test_a_few_frames_crown_nobody(tmp_path):
    runs = {("Ours", "x"): [outcome(90)], ("Ours, less", "x"): [outcome(80)]}
    for kind in ("methods", "runs"):
        made = benchmark(tmp_path, runs, kind=kind)
        quick = paper_table(replace(made, profile="quick"))
        assert not any(c.bold for row in quick.rows for c in row) and "rate (Hz)" not in quick.heads
        full = paper_table(replace(made, profile="full"))
        assert "quick profile" in quick.title and "no result" in quick.title and full.title == made.plan.title
        assert any(c.bold for row in full.rows for c in row) or "rate (Hz)" in full.heads


def test_a_row_is_a_fault(tmp_path):
    def one(lies_in, longest, until_good, mesh_off):
        score = {"frames": 100, "lies_in": lies_in, "lies_after": 0, "longest": longest}
        return outcome(50, fault={**score, "until_good": until_good, "mesh_off": mesh_off})

    failed = Outcome(key="k", status="failed", reason="ValueError: no")
    outcomes = [one(3, 2, 0, 0.1), one(1, 1, 7, 0.3), one(0, 0, float("inf"), float("nan")), failed]
    made = benchmark(tmp_path, {("Ours", "mustard0"): outcomes}, seeds=(0, 1, 2, 3), kind="faults")
    (row,) = [[cell.text for cell in row] for row in paper_table(made).rows]
    assert row == ["-", "4", "1", "300", "4", "0", "2", "7", "never", "20.0"]
