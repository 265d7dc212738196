"""The page that collects clicks, through HTTP as a browser would use it, and the file of prompts it writes."""

import html
import http.client
import json
import re
import shlex
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

from p2p_lib.apps import cli
from p2p_lib.apps.click import PAGE, Clicker, first_change
from p2p_lib.core.colours import OBJECTS
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.prompts import load_prompts, parse_prompts, run_lengths, save_prompts
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.run import run

H, W = 60, 80


@pytest.fixture
def sequence(tmp_path):
    """Three frames whose blue channel is 10 x their number; no depth in the left quarter."""
    folder = tmp_path / "own"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "cam_K.txt", np.array([[90.0, 0, 40], [0, 90, 30], [0, 0, 1]]))
    for k in range(3):
        rgb, depth = np.full((H, W, 3), (10 * k, 120, 200), np.uint8), np.full((H, W), 700, np.uint16)
        depth[:, : W // 4] = 0
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), rgb)
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), depth)
    return open_sequence(folder)


@pytest.fixture
def out(tmp_path):
    return tmp_path / "made" / "prompts.json"


def get(url: str) -> tuple[int, bytes, str]:
    return ask(urllib.request.Request(url))


def post(url: str, body, kind: str = "application/json", to: str = "prompts") -> tuple[int, dict]:
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    status, answer, _ = ask(urllib.request.Request(url + to, data, {"Content-Type": kind}))
    return status, json.loads(answer)


def ask(request) -> tuple[int, bytes, str]:
    try:
        with urllib.request.urlopen(request, timeout=120) as answer:
            return answer.status, answer.read(), answer.headers.get_content_type()
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers.get_content_type()


def one(name="cup", frame=0, points=((40, 30), [50, 20])) -> dict:
    return {"name": name, "frame": frame, "points": [list(p) for p in points]}


# --- the page ----------------------------------------------------------------------------------


def test_a_whole_visit(sequence, out):
    with Clicker(sequence, out, frame=1) as clicker:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{22}/", clicker.url)
        status, page, kind = get(clicker.url)
        assert (status, kind) == (200, "text/html") and b"<canvas" in page
        status, answer, kind = get(clicker.url + "session")
        session = json.loads(answer)
        assert (status, kind) == (200, "application/json")
        assert (session["frames"], session["width"], session["height"], session["first"]) == (3, W, H, 1)
        assert session["names"] == ["object"] and session["objects"] == []
        assert session["colours"] == list(OBJECTS), "as everywhere else"
        for k in range(3):
            status, png, kind = get(f"{clicker.url}frame/{k}")
            shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
            assert (status, kind) == (200, "image/png")
            np.testing.assert_array_equal(shown[..., ::-1], sequence.frame(k).rgb)
        assert not clicker.wait(0) and not out.exists()
        assert post(clicker.url, {"objects": [one()]})[0] == 200 and out.exists() and not clicker.wait(0), "it goes on"
        status, answer = post(clicker.url, {"objects": [one(), one("bowl", 2, [(60, 40)])], "finish": True})
        assert (status, answer) == (200, {"saved": str(out), "again": ""}) and clicker.wait(0)
        assert [p.name for p in clicker.prompts] == ["cup", "bowl"]
    cup, bowl = load_prompts(out)
    assert (cup.name, cup.frame, bowl.name, bowl.frame) == ("cup", 0, "bowl", 2)
    np.testing.assert_array_equal(cup.points_px, [[40, 30], [50, 20]])
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(clicker.url, timeout=2)


def test_what_the_file_holds_is_shown_first(sequence, out):
    save_prompts(out, [Prompt("cup", 1, [[30, 20]])])
    with Clicker(sequence, out) as clicker:
        assert json.loads(get(clicker.url + "session")[1])["objects"] == [one("cup", 1, [[30, 20]])]
        assert not clicker.wait(0)
        painted = {"name": "lid", "frame": 2, "mask": run_lengths(np.eye(H, W, dtype=bool))}
        assert post(clicker.url, {"objects": [one("cup", 1), painted]})[0] == 200
    with Clicker(sequence, out) as clicker:
        assert json.loads(get(clicker.url + "session")[1])["objects"] == [one("cup", 1), painted]
    np.testing.assert_array_equal(load_prompts(out)[1].mask, np.eye(H, W, dtype=bool))


REFUSED = {
    "outside": (
        {"objects": [one(points=[(W, 5)])]},
        "clicks on 'cup' in frame 0: got (80, 5), expected pixels within 80x60",
    ),
    "no depth": ({"objects": [one(points=[(5, 5)])]}, "(5, 5) has no depth in frame 0"),
    "same click": ({"objects": [one(), one("bowl")]}, "clicks on 'bowl': got a click that is also one of 'cup'"),
    "same name": ({"objects": [one(), one()]}, "'cup' in frame 0 twice"),
    "late frame": ({"objects": [one(frame=3)]}, "prompt of 'cup': got frame 3, expected a frame from 0 to 2"),
    "no points": ({"objects": [one(points=())]}, "at least one [x, y]"),
    "runs of another size": (
        {"objects": [{"name": "cup", "mask": {"size": [1, 3], "counts": [1, 2]}}]},
        "mask of 'cup': got 3x1, expected 80x60",
    ),
    "runs that do not add up": ({"objects": [{"name": "cup", "mask": {"size": [2, 3], "counts": [1, 2]}}]}, "add up"),
    "runs of no size": ({"objects": [{"name": "cup", "mask": {"size": [-2, -3], "counts": [6]}}]}, "add up"),
    "a number": ({"objects": [one() | {"points": 5}]}, "at least one [x, y]"),
    "nothing": ({"objects": []}, "prompts: got"),
    "a list": ([1, 2], "prompts: got"),
    "no JSON": (b"{", "Expecting"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_said_on_the_page_and_not_saved(case, sequence, out):
    content, why = REFUSED[case]
    with Clicker(sequence, out) as clicker:
        status, answer = post(clicker.url, content)
        assert status == 400 and why in answer["error"] and not out.exists() and not clicker.wait(0)
        assert post(clicker.url, {"objects": [one()]})[0] == 200  # it goes on


def test_nothing_else_is_served(sequence, out):
    with Clicker(sequence, out) as clicker:
        for path in ("frame/3", "frame/-1", "frame/x", "../pyproject.toml", "prompts", "frame/"):
            assert get(clicker.url + path)[0] == 404
        assert post(clicker.url, {"objects": [one()]}, kind="text/plain")[0] == 404
        at = http.client.HTTPConnection(clicker.url.split("/")[2], timeout=120)
        at.putrequest("POST", f"/{clicker.token}/prompts")
        at.putheader("Content-Type", "application/json")
        at.putheader("Content-Length", str(1 << 40))  # it answers without waiting for all that
        at.endheaders()
        assert at.getresponse().status == 413
        assert not out.exists()


FOREIGN = {
    "a name that leads here": ({"Host": "evil.example:{port}"}, 403),
    "another page": ({"Origin": "http://evil.example"}, 403),
    "another program of this machine": ({"Origin": "http://127.0.0.1:1"}, 403),
    "a page of nowhere": ({"Origin": "null"}, 403),
    "its own page": ({"Origin": "http://127.0.0.1:{port}"}, 200),
    "through a tunnel": ({"Host": "localhost:9000", "Origin": "http://localhost:9000"}, 200),
}


@pytest.mark.parametrize("who", FOREIGN)
def test_only_the_page_itself_is_answered(who, sequence, out):
    given, status = FOREIGN[who]
    with Clicker(sequence, out) as clicker:
        headers = {key: value.format(port=clicker.url.split("/")[2].partition(":")[2]) for key, value in given.items()}
        assert ask(urllib.request.Request(clicker.url + "session", headers=headers))[0] == status
        body = json.dumps({"objects": [one()]}).encode()
        headers["Content-Type"] = "application/json"
        assert ask(urllib.request.Request(clicker.url + "prompts", body, headers))[0] == status
        assert out.exists() == (status == 200)


def test_who_does_not_know_the_address_gets_nothing(sequence, out):
    with Clicker(sequence, out) as clicker, Clicker(sequence, out) as other:
        root = clicker.url.removesuffix(f"{clicker.token}/")
        for place in (
            "",
            "session",
            "frame/0",
            f"{other.token}/session",
            f"{clicker.token[:-1]}/session",
            clicker.token,
        ):
            assert get(root + place)[0] == 404
        assert post(root, {"objects": [one()]})[0] == 404 and not out.exists()
        assert post(clicker.url, b"[" * 100_000)[0] == 400  # nested too deep
        assert get(clicker.url)[0] == 200


def test_the_notebook_shows_the_page(sequence, out):
    with Clicker(sequence, out) as clicker:
        assert f'src="{clicker.url}"' in clicker._repr_html_()


def test_refusals_at_the_start(sequence, out):
    with pytest.raises(BadInput, match="frame: got 3, expected a number from 0 to 2"):
        Clicker(sequence, out, frame=3)
    with Clicker(sequence, out) as clicker:
        port = int(clicker.url.split("/")[2].partition(":")[2])
        with pytest.raises(BadInput, match=f"port: got {port}, expected a free port"):
            Clicker(sequence, out, port=port)
    out.parent.mkdir()
    out.write_text("{}")
    with pytest.raises(BadInput, match=r"prompts\.json: prompts"):
        Clicker(sequence, out)


def test_the_page_needs_nothing_from_elsewhere():
    text = PAGE.read_text()
    assert "http" not in text.replace("http-equiv", "") and 'src="' not in text


def visit(session: dict, *steps: list, again: str = "") -> dict:
    """What the page's own script makes of these steps of a user; nothing is known without node, which runs it."""
    if shutil.which("node") is None:
        pytest.skip("no node to run the page's script (Debian: apt-get install nodejs)")
    given = json.dumps({"session": session, "steps": steps, "again": again})
    probe = Path(__file__).with_name("click_probe.js")
    done = subprocess.run(["node", str(probe), str(PAGE)], input=given, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


#: Instead of the server, and what it tells of the page in a window: what reaches beyond it, or another thing's place.
LONG = """<script>const told = (where) => where === "session" ? SESSION : ANSWER;
window.fetch = async (where) => ({ ok: true, json: async () => told(where) });
setTimeout(() => { picture.onerror = null; $("save").onclick(); }, 500);  // there is no picture, which may be told late
setTimeout(() => {
  const rows = [...$("objects").children], box = (of) => of.getBoundingClientRect(), wide = document.documentElement;
  const found = { wide: wide.scrollWidth > wide.clientWidth, message: $("message").textContent };
  found.rows = rows.map((row) => ({
    text: row.children[1].textContent,
    inside: [...row.children].every((part) => box(part).right <= box(row).right + 1 && box(part).width > 0),
    cut: row.children[1].scrollWidth > row.children[1].clientWidth + 1,
    beyond: $("message").scrollWidth > $("message").clientWidth + 1,
  }));
  document.body.insertAdjacentHTML("beforeend", "<pre id=probe>" + JSON.stringify(found) + "</pre>");
}, 1500);
</script>"""


def test_long_names_fit_on_the_page(sequence, out, tmp_path, browser):
    """Of objects, of the sequence and of the file, with and without places where they may be broken."""
    names = ["a_very_long_name_of_an_object" * 3, "words of a name " * 6 + "end", "cup"]
    save_prompts(out, [Prompt(name, 0, [[40, 30 + k]]) for k, name in enumerate(names)])
    with Clicker(sequence, out) as clicker:
        session = clicker.session() | {"sequence": "one_folder_below_another_" * 8}
    given = {"SESSION": session, "ANSWER": {"masks": {}, "doubts": [], "saved": "/a_folder_below_another" * 8}}
    script = LONG
    for word, value in given.items():
        script = script.replace(word, json.dumps(value))
    page = tmp_path / "page.html"
    page.write_text(PAGE.read_text().replace("<script>", script + "<script>", 1))
    for width in (1200, 420):
        shown = browser.dom(page, 4000, f"--window-size={width},900")
        seen = json.loads(html.unescape(re.search(r"<pre id=.probe.>(.*?)</pre>", shown, re.DOTALL)[1]))
        assert [row["text"] for row in seen["rows"]] == [*(f"{name}: frame 0" for name in names), "object"]
        assert seen["message"].startswith("Saved to /a_folder") and not seen["wide"], width
        assert all(row["inside"] and not row["cut"] and not row["beyond"] for row in seen["rows"]), (width, seen)


def test_the_page_makes_prompts_of_clicks_boxes_and_later_frames(sequence, out):
    """Dots on the object and beside it, a dragged box, corrections in another frame, one click taken back."""
    save_prompts(out, [Prompt("cup", 0, [[40, 30]]), Prompt("lid", 1, mask=np.eye(H, W, dtype=bool))])
    with Clicker(sequence, out) as clicker:
        session = clicker.session()
        seen = visit(
            session,
            ["press", 50, 20],  # on the cup, frame 0
            ["press", 60, 50, True],  # beside it
            ["press", 30, 40],
            ["press", 30, 40],  # taken back
            ["frame", 2],
            ["press", 62, 51, True],
            ["row", 2],  # the sequence's own object
            ["press", 70, 10, False, 30, 44],  # a box, from its upper right corner
        )
        assert seen["sent"]["objects"] == [
            {"name": "cup", "frame": 0, "points": [[40, 30], [50, 20]], "negative": [[60, 50]]},
            {"name": "cup", "frame": 2, "negative": [[62, 51]]},
            {"name": "lid", "frame": 1, "mask": run_lengths(np.eye(H, W, dtype=bool))},
            {"name": "object", "frame": 2, "box": [30, 10, 70, 44]},
        ]
        assert seen["sent"]["finish"] is True
        assert seen["rows"] == ["cup: frame 0, 2", "lid: frame 1", "object: frame 2"] and seen["message"].startswith(
            "Saved"
        )
        assert post(clicker.url, seen["sent"])[0] == 200
        assert [(p.name, p.frame) for p in clicker.prompts] == [("cup", 0), ("cup", 2), ("lid", 1), ("object", 2)]
        again = visit(clicker.session(), ["remove", 0])
    assert again["sent"]["objects"] == seen["sent"]["objects"][2:]
    np.testing.assert_array_equal(load_prompts(out)[2].mask, np.eye(H, W, dtype=bool))  # masks stay as they were


def test_the_page_undoes_renames_clears_and_zooms(sequence, out):
    with Clicker(sequence, out) as clicker:
        session = clicker.session()
    first = {"name": "object", "frame": 0, "points": [[50, 20]]}
    steps = [["press", 50, 20], ["frame", 1], ["press", 30, 30], ["frame", 0]]
    moved = {"name": "object", "frame": 1, "points": [[30, 30]]}
    cases = {
        "as it is": ([], [first, moved]),
        "undo": ([["undo"]], [first]),
        "clear takes this frame's alone": ([["clear", 0]], [moved]),
        "clear, undone": ([["clear", 0], ["undo"]], [first, moved]),
        "rename": ([["rename", 0, "mug"]], [first | {"name": "mug"}, moved | {"name": "mug"}]),
        "it goes on after saving": ([["save"], ["press", 60, 40]], [first | {"points": [[50, 20], [60, 40]]}, moved]),
        # Zoomed by 1.25 about the upper left corner, the pixel under (20, 10) is (16, 8).
        "zoom": ([["zoom", 0, 0], ["press", 20, 10]], [first | {"points": [[50, 20], [16, 8]]}, moved]),
    }
    for case, (more, objects) in cases.items():
        assert visit(session, *steps, *more)["sent"]["objects"] == objects, case


def test_the_page_asks_for_the_masks_of_the_frame_that_is_shown(sequence, out):
    with Clicker(sequence, out) as clicker:
        seen = visit(clicker.session(), ["press", 50, 20], ["frame", 1], ["press", 30, 30])
        nothing, of_run = (visit(clicker.session() | {"run": it}, ["frame", 1]) for it in (False, True))
    assert seen["asked"][0] == [{"name": "object", "frame": 0, "points": [[50, 20]]}]
    assert seen["asked"][-1] == [{"name": "object", "frame": 1, "points": [[30, 30]]}]
    assert seen["tinted"][-1] == [1, 1, 1, 8] and seen["doubts"] == "is it a table?"
    assert not nothing["asked"] and of_run["asked"] and not any(of_run["asked"]), "the run's own"


def disc(x: int, y: int, radius: int) -> np.ndarray:
    v, u = np.mgrid[:H, :W]
    return (u - x) ** 2 + (v - y) ** 2 <= radius**2


def test_a_brush_mends_a_mask(sequence, out):
    """It starts from the mask that is shown; what it leaves is a mask, which a click replaces and undo brings back."""
    with Clicker(sequence, out) as clicker:
        session = clicker.session()
        first = [["press", 50, 20], ["tool", "paint", 5], ["stroke", [20, 30], [20, 30]]]
        square = np.zeros((H, W), bool)
        square[1:9, 1] = True  # which the click made, as the probe says
        cases = {
            "painted": ([], square | disc(20, 30, 5)),
            "erased": ([["tool", "erase", 3], ["stroke", [20, 30]]], (square | disc(20, 30, 5)) & ~disc(20, 30, 3)),
            "beyond the rim": ([["stroke", [79, 59]]], square | disc(20, 30, 5) | disc(79, 59, 5)),
            "undone": ([["stroke", [60, 30], [70, 30]], ["undo"]], square | disc(20, 30, 5)),
            "clicked and undone": ([["tool", "on"], ["press", 60, 40], ["undo"]], square | disc(20, 30, 5)),
        }
        for case, (more, mask) in cases.items():
            sent = visit(session, *first, *more)["sent"]
            (prompt,) = parse_prompts(sent)
            differs = (prompt.mask ^ mask).sum()
            assert differs <= 8 and prompt.mask[1:9, 1].all() and not len(prompt.points_px), (case, differs)
        assert visit(session, *first, ["tool", "on"], ["press", 60, 40])["sent"]["objects"] == [
            one("object", 0, [[60, 40]])
        ]
        way = visit(session, *first[1:2], ["stroke", [20, 30], [40, 30]])["sent"]
        np.testing.assert_array_equal(parse_prompts(way)[0].mask[30, 15:46], [False] + [True] * 29 + [False])
        assert post(clicker.url, sent)[0] == 200
        np.testing.assert_array_equal(load_prompts(out)[0].mask, prompt.mask)
        assert clicker.session()["objects"] == sent["objects"]


def test_the_masks_of_a_run_are_shown_to_be_mended(sequence, out, tmp_path):
    board = np.zeros((H, W), bool)
    board[20:40, 30:60] = True
    made = [Prompt("board", 0, mask=board)]
    settings = {"method.surface": "false", "method.graph": "false"}
    run(sequence, tmp_path / "run", prompts=made, save_masks=True, settings=settings, progress=False)
    with Clicker(sequence, out, run=load_run(tmp_path / "run")) as clicker:
        assert clicker.session()["names"] == ["board"] and clicker.session()["run"]
        status, found = post(clicker.url, {"objects": [], "frame": 0}, to="masks")
        assert status == 200 and found["masks"] == {"board": run_lengths(board)["counts"]}
        for refused in ({"objects": [], "frame": 3}, {"frame": None}, []):
            assert post(clicker.url, refused, to="masks")[0] == 400
        assert post(clicker.url, {"frame": 0}, to="masks")[1] == found
    command = ["click", str(sequence.path), "--out", str(out), "--run", str(tmp_path / "run"), "--no-browser"]
    process = subprocess.Popen([sys.executable, "-m", "p2p_lib.apps.cli", *command], stdout=subprocess.PIPE, text=True)
    try:
        url = re.search(r"http://\S+", process.stdout.readline())[0]
        content = {"objects": [one("board"), {"name": "board", "frame": 2, "mask": run_lengths(board)}], "finish": True}
        assert post(url, content)[0] == 200
        said, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert "the first new one in frame 0. Next: p2p run" in said and said.endswith("--force\n")
    words = shlex.split(said.partition("Next: ")[2])
    assert words[2:] == [str(sequence.path), "--out", str(tmp_path / "run"), *words[5:]]
    assert words[words.index("--prompts") + 1] == str(out) and words.count("--save-masks") == 1
    assert first_change(load_prompts(out), load_prompts(out)) is None
    assert first_change(load_prompts(out)[:1], load_prompts(out)) == 2


def test_the_page_of_a_run_begins_with_what_the_run_was_started_from(sequence, out, tmp_path, capsys, monkeypatch):
    """What is added to it goes on from there, also where the file of its prompts is not named again."""
    board = np.zeros((H, W), bool)
    board[20:40, 30:60] = True
    made = [Prompt("board", 0, box_px=(29, 19, 60, 40)), Prompt("other", 1, mask=board)]
    settings = {"method.surface": "false", "method.graph": "false"}
    run(sequence, tmp_path / "run", prompts=made, settings=settings, progress=False)
    with Clicker(sequence, out, run=load_run(tmp_path / "run")) as clicker:
        assert clicker.session()["objects"] == [made[0].as_dict()], "of a mask its size alone is kept"
    save_prompts(out, [Prompt("board", 2, points_px=[[40, 30]])])
    with Clicker(sequence, out, run=load_run(tmp_path / "run")) as clicker:
        assert [entry["frame"] for entry in clicker.session()["objects"]] == [2], "a file that is there counts"
    monkeypatch.setattr("p2p_lib.apps.click.wait_for_clicks", lambda page, *_: page.prompts)
    elsewhere = shutil.copytree(sequence.path, tmp_path / "elsewhere")
    assert cli.main(["click", str(elsewhere), "--out", str(out), "--run", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().err
    assert "is a run of own, not of elsewhere: is it the right one?" in said and "kept no masks" in said


def test_the_server_says_what_mask_the_clicks_make(sequence, out):
    """A board before a wall: its outline, and what is doubtful or wrong about the clicks."""
    for k in range(3):
        depth, rgb = np.full((H, W), 900, np.uint16), np.full((H, W, 3), 120, np.uint8)
        depth[20:40, 30:60], rgb[20:40, 30:60] = 600, (30, 160, 220)
        cv2.imwrite(str(sequence.path / "depth" / f"{k}.png"), depth)
        cv2.imwrite(str(sequence.path / "rgb" / f"{k}.png"), rgb)
    with Clicker(sequence, out) as clicker:
        status, found = post(clicker.url, {"objects": [one(points=[(45, 30)])], "frame": 0}, to="masks")
        runs = {"size": [H, W], "counts": found["masks"]["cup"]}
        mask = parse_prompts({"objects": [{"name": "cup", "mask": runs}]})[0].mask
        board = np.zeros((H, W), bool)
        board[20:40, 30:60] = True
        assert status == 200 and (mask & board).sum() / (mask | board).sum() > 0.85
        assert found["doubts"] == []
        wall = post(clicker.url, {"objects": [one(points=[(10, 10)])], "frame": 0}, to="masks")[1]
        assert wall["doubts"][0].startswith("clicks on 'cup' in frame 0: ")
        beside = {"name": "cup", "frame": 1, "negative": [[5, 5]]}
        assert post(clicker.url, {"objects": [beside], "frame": 1}, to="masks") == (200, {"masks": {}, "doubts": []})
        status, found = post(clicker.url, {"objects": [one(points=[(W, 5)])], "frame": 0}, to="masks")
        assert status == 400 and "expected pixels within" in found["error"] and not out.exists()


def test_a_missing_depth_image_does_not_keep_the_page_closed(sequence, out, monkeypatch):
    """`p2p run --skip-bad` goes on without it, and needs the prompts; the frame itself says why it cannot be shown."""
    (sequence.path / "depth" / "1.png").unlink()
    answers = []

    def visit(page: Clicker, *_: object) -> tuple[Prompt, ...]:
        answers.extend(get(f"{page.url}frame/{k}")[:2] for k in range(3))
        answers.append(post(page.url, {"objects": [one(frame=1)]}))
        return page.prompts

    monkeypatch.setattr("p2p_lib.apps.click.wait_for_clicks", visit)
    assert cli.main(["click", str(sequence.path), "--out", str(out)]) == 0
    assert [status for status, _ in answers] == [200, 500, 200, 400]
    assert "1.png" in json.loads(answers[1][1])["error"] and "1.png" in answers[3][1]["error"]


def test_the_command_ends_when_it_is_finished(sequence, out):
    command = [sys.executable, "-m", "p2p_lib.apps.cli", "click", str(sequence.path), "--out", str(out), "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        url = re.search(r"http://\S+", process.stdout.readline())[0]
        assert post(url, {"objects": [one()], "finish": True})[0] == 200
        said, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 0 and f"--prompts {out}" in said and out.is_file()


# --- the file ----------------------------------------------------------------------------------


def test_prompts_survive_the_file(tmp_path):
    given = [Prompt("left mug", 0, [[1.5, 2], [3, 4]]), Prompt("b", 12, [[0, 0]])]
    read = load_prompts(save_prompts(tmp_path / "p.json", given))
    assert [(p.name, p.frame, p.points_px.tolist()) for p in read] == [
        (p.name, p.frame, p.points_px.tolist()) for p in given
    ]


def test_the_frame_may_be_left_out(tmp_path):
    path = tmp_path / "p.json"
    path.write_text('{"objects": [{"name": "a", "points": [[1, 2]]}]}')
    assert load_prompts(path)[0].frame == 0


@pytest.mark.parametrize(
    ("text", "why"),
    {
        "[": "unreadable JSON",
        "[]": "expected",
        '{"objects": {}}': "expected",
        '{"objects": [{"name": "a"}]}': "points",
        '{"objects": [{"name": "a", "points": [[1, 2]], "fram": 3}]}': "fram",
        '{"objects": [{"name": "", "points": [[1, 2]]}]}': "name",
        '{"objects": [{"name": "a", "points": [[1, 2, 3]]}]}': "clicks on 'a'",
        '{"objects": [{"name": "a", "points": [[1, NaN]]}]}': "clicks on 'a'",
        '{"objects": [{"name": "a", "points": "here"}]}': "clicks on 'a'",
        '{"objects": [{"name": "a", "frame": -1, "points": [[1, 2]]}]}': "frame -1",
        '{"objects": [{"name": "a", "frame": 1.5, "points": [[1, 2]]}]}': "frame 1.5",
        '{"objects": [{"name": "a", "frame": true, "points": [[1, 2]]}]}': "frame True",
    }.items(),
)
def test_a_file_that_does_not_fit_is_named(text, why, tmp_path):
    path = tmp_path / "p.json"
    path.write_text(text)
    with pytest.raises(BadInput, match=re.escape(str(path))) as error:
        load_prompts(path)
    assert why in str(error.value) and "\n" not in str(error.value)


def test_no_file_says_how_to_make_one(tmp_path):
    with pytest.raises(MissingData, match="p2p click SEQ --out"):
        load_prompts(tmp_path / "none.json")
