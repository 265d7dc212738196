"""The page that collects clicks, through HTTP as a browser would use it, and the file of prompts it writes."""

import http.client
import json
import re
import subprocess
import sys
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from p2p_lib.apps.click import PAGE, Clicker
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.prompts import load_prompts, save_prompts
from p2p_lib.datasets.sequence import open_sequence

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


def post(url: str, body, kind: str = "application/json") -> tuple[int, dict]:
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    status, answer, _ = ask(urllib.request.Request(url + "prompts", data, {"Content-Type": kind}))
    return status, json.loads(answer)


def ask(request) -> tuple[int, bytes, str]:
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read(), answer.headers.get_content_type()
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers.get_content_type()


def one(name="cup", frame=0, points=((40, 30), [50, 20])) -> dict:
    return {"name": name, "frame": frame, "points": [list(p) for p in points]}


# --- the page ----------------------------------------------------------------------------------


def test_a_whole_visit(sequence, out):
    with Clicker(sequence, out, frame=1) as clicker:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", clicker.url)
        status, page, kind = get(clicker.url)
        assert (status, kind) == (200, "text/html") and b"<canvas" in page
        status, answer, kind = get(clicker.url + "session")
        session = json.loads(answer)
        assert (status, kind) == (200, "application/json")
        assert (session["frames"], session["width"], session["height"], session["first"]) == (3, W, H, 1)
        assert session["names"] == ["object"] and session["objects"] == []
        for k in range(3):
            status, png, kind = get(f"{clicker.url}frame/{k}")
            shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
            assert (status, kind) == (200, "image/png")
            np.testing.assert_array_equal(shown[..., ::-1], sequence.frame(k).rgb)
        assert not clicker.wait(0) and not out.exists()
        status, answer = post(clicker.url, {"objects": [one(), one("bowl", 2, [(60, 40)])]})
        assert (status, answer) == (200, {"saved": str(out)}) and clicker.wait(0)
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


REFUSED = {
    "outside": ({"objects": [one(points=[(W, 5)])]}, "clicks on 'cup': got (80, 5), expected pixels within 80x60"),
    "no depth": ({"objects": [one(points=[(5, 5)])]}, "(5, 5) has no depth in frame 0"),
    "same click": ({"objects": [one(), one("bowl")]}, "clicks on 'bowl': got a click that is also one of 'cup'"),
    "same name": ({"objects": [one(), one()]}, "'cup' in frame 0 twice"),
    "late frame": ({"objects": [one(frame=3)]}, "prompt of 'cup': got frame 3, expected a frame from 0 to 2"),
    "no points": ({"objects": [one(points=())]}, "at least one [x, y]"),
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
        at = http.client.HTTPConnection(clicker.url.split("/")[2], timeout=20)
        at.putrequest("POST", "/prompts")
        at.putheader("Content-Type", "application/json")
        at.putheader("Content-Length", str(1 << 40))  # it answers without waiting for all that
        at.endheaders()
        assert at.getresponse().status == 413
        assert not out.exists()


def test_the_notebook_shows_the_page(sequence, out):
    with Clicker(sequence, out) as clicker:
        assert f'src="{clicker.url}"' in clicker._repr_html_()


def test_refusals_at_the_start(sequence, out):
    with pytest.raises(BadInput, match="frame: got 3, expected a number from 0 to 2"):
        Clicker(sequence, out, frame=3)
    with Clicker(sequence, out) as clicker:
        port = int(clicker.url.rstrip("/").rpartition(":")[2])
        with pytest.raises(BadInput, match=f"port: got {port}, expected a free port"):
            Clicker(sequence, out, port=port)
    out.parent.mkdir()
    out.write_text("{}")
    with pytest.raises(BadInput, match=r"prompts\.json: prompts"):
        Clicker(sequence, out)


def test_the_page_needs_nothing_from_elsewhere():
    text = PAGE.read_text()
    assert "http" not in text.replace("http-equiv", "") and 'src="' not in text


def test_the_command_ends_when_it_is_saved(sequence, out):
    command = [sys.executable, "-m", "p2p_lib.apps.cli", "click", str(sequence.path), "--out", str(out), "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        url = re.search(r"http://\S+", process.stdout.readline())[0]
        assert post(url, {"objects": [one()]})[0] == 200
        said, _ = process.communicate(timeout=30)
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
