"""p2p check: each fault, put into a good folder, is named with what mends it; good folders raise no alarm."""

import json
import re
import shutil
import subprocess
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.apps import check, cli
from p2p_lib.apps.check import check_folder
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt, MissingData
from p2p_lib.core.findings import Level, as_lines
from p2p_lib.core.mask_length import mask_length_m
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets import folder as own
from p2p_lib.datasets.alignment import Misfit, background_share, misfit
from p2p_lib.datasets.image_sequence import WRITE_K
from p2p_lib.datasets.images import SKIP_BAD, read_rgb
from p2p_lib.datasets.prompts import load_prompts, prompts_in
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.run import run
from p2p_lib.synthetic.faults import Faulty
from tests.fixtures.late_depth import film

CAMERA = open_sequence("synthetic/crossing").camera
#: For runs that are asked for what they say at the start alone: a surface of something five times as large is slow.
POINTS_ALONE = {"method.surface": False, "method.graph": False}


def another_K(sequence, K):
    return replace(sequence, camera=Camera.from_K(K, sequence.camera.width, sequence.camera.height))


#: What goes wrong when one records one's own data, put into a good sequence.
FAULTS = {
    "depth unit": lambda good: replace(good, depth_scale=1.0),
    "a moving scale": lambda good: Faulty(good, "depth scaled anew", 0.15),
    "ten times as far": lambda good: replace(good, depth_scale=0.01),
    "depth not registered": lambda good: Faulty(good, "depth not registered"),
    "depth shifted": lambda good: Faulty(good, "depth misaligned", 18),
    "K of another resolution": lambda good: another_K(good, good.camera.K * [[2], [2], [1]]),
    "K of another aspect": lambda good: another_K(good, np.add(good.camera.K, [[0, 0, 320], [0, 0, 120], [0, 0, 0]])),
    "times in milliseconds": lambda good: replace(good, times_s=1000 * good.times_s),
    "a gap": lambda good: replace(good, times_s=good.times_s + 3 * (np.arange(len(good)) >= len(good) // 2)),
    "pictures twice": lambda good: Faulty(good, "frames twice"),
    "no texture": lambda good: Faulty(good, "colour plain on objects", 2.5),
    "wide masks": lambda good: Faulty(good, "mask wide", 6),
    "no depth on the objects": lambda good: Faulty(good, "depth missing on objects"),
}
#: What must be found: the level, a part of what is said, and a part of the remedy.
EXPECTED = {
    "depth unit": (
        "depth",
        Level.WRONG,
        r"^\d{3} m in the middle",
        r"--depth-scale .*\. A unit of 0\.001 \(millimetres\)",
    ),
    "a moving scale": ("scale", Level.WRONG, r"all depth changes by \d+ % from frame \d to \d", "as the camera"),
    "ten times as far": ("box: depth", Level.WRONG, r"6\.\d+ m away.*0\.1 to 5 m count", "the depth scale is wrong"),
    "depth not registered": ("registration", Level.WRONG, r"0\.7\d times as large", "Register depth to colour"),
    "depth shifted": ("registration", Level.WRONG, r"shifted by \(\+1[6-9]|\(\+20, [+-]0\) px", "Register depth"),
    "K of another resolution": ("camera", Level.WRONG, r"images of about 128\dx96\d", r"first two rows times 0\.5\."),
    "K of another aspect": ("camera", Level.WRONG, "images of about 1280x720", r"Take K at 640x480\.$"),
    "times in milliseconds": ("times", Level.WRONG, "s between images", "These look like milliseconds"),
    "a gap": ("times", Level.LOOK, "but 3.* s between frames 2 and 3", "found again"),
    "pictures twice": ("motion", Level.LOOK, "images equal", "each image once"),
    "no texture": ("box: points", Level.WRONG, r"frame 0: [0-7];", "textured side"),
    "wide masks": ("can: mask", Level.WRONG, r"\d\d+ % of its rim", "a little inside"),
    "no depth on the objects": ("box: depth", Level.WRONG, "only 0 % of its pixels", "shiny"),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Some early frames of an embedded sequence, as if it had been recorded by the user."""
    frames = range(0, 48, 8)
    return own.write(open_sequence("synthetic/crossing"), tmp_path_factory.mktemp("own") / "good", frames)


def found(folder, name, **options):
    return next(f for f in check_folder(folder, **options) if f.name == name)


def alarms(findings):
    return [f for f in findings if f.level in (Level.LOOK, Level.WRONG)]


def test_whether_there_is_truth_is_said(good):
    assert found("synthetic/crossing", "truth").text == (
        "box in 300 images, in sight in 257 of them; can in 300 images, in sight in 260 of them"
    )
    assert found(good, "truth").text.startswith("none (looked for in annotated_poses/")


def test_a_good_folder_raises_no_alarm(good):
    findings = check_folder(good)
    assert alarms(findings) == []
    names = ["files", "camera", "times", "motion", "depth", "scale", "registration", "truth"]
    assert [f.name for f in findings] == names + [
        f"{o}: {w}" for o in ("box", "can") for w in ("depth", "mask", "points")
    ]


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named_with_its_remedy(good, fault):
    name, level, text, fix = EXPECTED[fault]
    finding = found(FAULTS[fault](open_sequence(good)), name)
    assert finding.level is level
    assert re.search(text, finding.text), finding.text
    assert re.search(fix, finding.fix), finding.fix


def test_times_that_jump_back_are_those_of_two_recordings(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "spoilt")
    half = np.loadtxt(folder / "times.txt")[:3]
    np.savetxt(folder / "times.txt", np.r_[half, half])
    finding = found(folder, "files")
    assert finding.level is Level.WRONG and "times.txt: got 0.000000 s at frame 3" in finding.text


def test_depth_of_another_moment_than_its_colour_is_told(tmp_path):
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    for now, late in zip(film(30, 0, 0), film(30, 0, 1), strict=True):  # as clocks that are apart make it: by turns
        frame = (late if late[0].index in (3, 4) else now)[0]
        cv2.imwrite(str(tmp_path / "rgb" / f"{frame.index:03d}.png"), frame.rgb)
        cv2.imwrite(str(tmp_path / "depth" / f"{frame.index:03d}.png"), (1000 * frame.depth_m).astype(np.uint16))
    np.savetxt(tmp_path / "cam_K.txt", CAMERA.K)
    finding = found(tmp_path, "registration")
    assert finding.level is Level.LOOK and "takes both together" in finding.fix
    assert re.search(r"depth and colour are of different moments .*, 3\d px apart in frame 3$", finding.text)


def test_an_embedded_sequence_raises_no_alarm():
    assert alarms(check_folder("synthetic/crossing")) == []


def test_a_run_says_that_depth_is_not_registered_too(good, tmp_path):
    said = "offset from colour: .* Register depth to colour when recording"
    with pytest.warns(Doubt, match=said):
        source = Faulty(open_sequence(good), "depth not registered")
        result = run(source, tmp_path / "run", settings=POINTS_ALONE, progress=False)
    assert [re.search(said, line) is not None for line in result.look_at].count(True) == 2  # of each object


@pytest.mark.parametrize("name", ["ycbineoat/mustard0_first400", "real_multi/redkitchen_table"])
def test_real_sequences_raise_no_alarm(shared_data, name):
    findings = check_folder(shared_data / name)
    # mustard0 really has holes: its pictures carry the time at which they were taken.
    assert [(f.name, f.text) for f in alarms(findings) if f.name != "times"] == []
    assert found(shared_data / name, "times").level is not Level.WRONG


@pytest.mark.parametrize("name", ["mustard0_first400", "redkitchen_table"])
def test_real_sequences_with_clicks_raise_no_alarm(shared_data, name):
    where = next(p for p in shared_data.glob(f"*/{name}"))
    prompts = load_prompts(shared_data / "prompts" / f"{name}.json")
    findings = check_folder(where, prompts=prompts)
    assert [(f.name, f.text) for f in alarms(findings) if f.level is Level.WRONG] == []
    assert {f"{p.name}: points" for p in prompts} <= {f.name for f in findings}


def test_real_depth_that_was_moved_is_found(shared_data, tmp_path):
    folder = own.write(open_sequence(shared_data / "real_multi/redkitchen_table"), tmp_path / "own", range(0, 200, 20))
    assert found(folder, "registration").level is Level.OK
    assert found(Faulty(open_sequence(folder), "depth not registered"), "registration").level is Level.WRONG


# --- the two measures, against what is known -------------------------------------------------------


def scene(du=0, dv=0, scale=1.0):
    """Dark discs before a bright, textured wall; depth moved and scaled about the picture's centre."""
    rng, frames = np.random.default_rng(1), []
    v, u = np.mgrid[:240, :320]
    for k in range(4):
        spots = np.c_[rng.uniform(60, 260, 6), rng.uniform(50, 190, 6), rng.uniform(10, 22, 6)]

        def near(u, v, spots=spots):
            return ((u[..., None] - spots[:, 0]) ** 2 + (v[..., None] - spots[:, 1]) ** 2 < spots[:, 2] ** 2).any(-1)

        rgb = np.where(near(u, v)[..., None], 60, 180) + rng.integers(-20, 20, (240, 320, 3))
        back_u, back_v = (u - du - 159.5) / scale + 159.5, (v - dv - 119.5) / scale + 119.5
        depth = np.where(near(back_u, back_v), 0.6, 1.2).astype(np.float32)
        frames.append(Frame(k, k / 30, rgb.astype(np.uint8), depth))
    return frames


@pytest.mark.parametrize(("du", "dv", "scale"), [(12, 0, 1), (0, -9, 1), (-8, 6, 1), (0, 0, 0.81), (5, 0, 1.23)])
def test_misfit_says_how_depth_lies(du, dv, scale):
    fit = misfit(scene(du, dv, scale))
    assert fit.gain > 1.3
    assert fit.scale == pytest.approx(scale, rel=0.04)
    assert (fit.du_px, fit.dv_px) == (pytest.approx(du, abs=2), pytest.approx(dv, abs=2))


def test_misfit_of_registered_depth_is_none():
    assert misfit(scene()).gain < 1.05
    assert misfit(scene(2, 1)).gain < 1.05, "within the tolerance"


def test_where_depth_would_fit_in_several_places_none_is_called_its_own():
    twice = [replace(a, depth_m=np.minimum(a.depth_m, b.depth_m)) for a, b in zip(scene(16), scene(-16), strict=True)]
    assert misfit(twice) is None


def test_a_hand_that_moves_is_not_taken_for_an_offset(shared_data):
    sequence = open_sequence(shared_data / "real_hand/mug_in_hand")
    fit = misfit([sequence.frame(i) for i in range(0, 16, 2)])  # those that `p2p run --stop 16` looks at, nearly
    assert fit is None or fit.doubt is None


def test_what_cannot_be_told_is_not_fine(good, monkeypatch):
    monkeypatch.setattr(check, "misfit", lambda *_: None)
    finding = found(good, "registration")
    assert finding.level is Level.OPTIONAL and "too few edges" in finding.text and "aligns" in finding.fix


@pytest.mark.parametrize("frame", [0, 500])
def test_of_clicks_that_hit_nothing_only_that_is_said(good, frame):
    """Not that clicks are to be made; a size is of what was clicked on."""
    prompts = [Prompt("mug", frame, [[5000, 5]])]
    assert [f.name for f in alarms(check_folder(good, prompts=prompts, sizes={"mug": 11}))] == ["clicks"]
    with pytest.raises(BadInput, match=r"size: got the name 'mugg', expected one of the objects: mug$"):
        check_folder(good, prompts=prompts, sizes={"mugg": 11})


def test_without_edges_nothing_is_claimed():
    flat = [Frame(0, 0.0, f.rgb, np.full((240, 320), 1, np.float32)) for f in scene()]
    assert misfit(flat) is None
    plain = [Frame(0, 0.0, np.full_like(f.rgb, 128), f.depth_m) for f in scene()]
    assert misfit(plain) is None
    small = [Frame(0, 0.0, f.rgb[:, :300].copy(), f.depth_m[:, :300].copy()) for f in scene(12)]
    assert misfit(small) is None


def test_background_share_of_a_disc():
    """A disc of radius 40 before a wall: none of it is wall; a mask 8 px wider has all of its rim there."""
    v, u = np.mgrid[:200, :200]
    radius = np.hypot(u - 100, v - 100)
    depth = np.where(radius <= 40, 0.6, 1.0).astype(np.float32)
    assert background_share(radius <= 40, depth) == 0
    assert background_share(radius <= 48, depth) == 1
    assert background_share((radius <= 48) & (u >= 100) | (radius <= 40), depth) == pytest.approx(0.55, abs=0.1)
    lying = np.where(radius <= 40, 0.6, 0.61).astype(np.float32)
    assert background_share(radius <= 48, lying) == 0, "a table right under it cannot be told from it"
    assert np.isnan(background_share(radius <= 40, np.zeros_like(depth)))


# --- the command -------------------------------------------------------------------------------


def test_check_prints_findings_and_says_by_its_exit_code(good, tmp_path, capsys):
    assert cli.main(["check", str(good)]) == 0
    assert capsys.readouterr().out.endswith("--out FILE.png, or first_masks.png of a run.\n")
    assert cli.main(["check", str(good), "--out", str(tmp_path / "seen.png")]) == 0
    assert capsys.readouterr().out.endswith(f"Whether masks are objects, {tmp_path}/seen.png shows.\n")
    video = open_sequence(good)
    whole = read_rgb(tmp_path / "seen.png")
    assert whole.shape[0] >= video.camera.height and whole.shape[1] > video.camera.width, "beside it, each object"
    assert cli.main(["check", str(good), "--out", str(tmp_path / "seen.jpg")]) == 2
    assert "got seen.jpg, expected the name of a picture, FILE.png" in capsys.readouterr().err
    folder = shutil.copytree(good, tmp_path / "spoilt")
    np.savetxt(folder / "cam_K.txt", open_sequence(good).camera.K * [[2], [2], [1]])
    assert cli.main(["check", str(folder)]) == 2
    out, err = capsys.readouterr()
    assert "WRONG  camera" in out and "  -> Take K at 640x480" in out and err == ""
    assert out.endswith("To mend first: camera\n")


def test_what_cannot_be_read_is_a_finding(good, tmp_path, capsys):
    folder = shutil.copytree(good, tmp_path / "spoilt")
    (folder / "depth" / "000003.png").unlink()
    assert cli.main(["check", str(folder)]) == 2
    out, err = capsys.readouterr()
    assert "1 of 6 depth images are missing" in out and "000003.png" in out and "--skip-bad" in out and err == ""
    assert "box: points" in out and "can: mask" in out, "what can be told of the other frames is"
    assert cli.main(["check", str(tmp_path / "nowhere"), "--json"]) == 2
    (listed,) = json.loads(capsys.readouterr().out)
    assert listed["name"] == "files" and listed["level"] == "WRONG" and "no such folder" in listed["text"]


def test_without_masks_it_asks_for_clicks(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "bare")
    shutil.rmtree(folder / "masks")
    assert "assumed" not in found(folder, "times").text
    (folder / "times.txt").unlink()
    assert found(folder, "times").text.startswith("30 images per second, 0.2 s; assumed, since there is no times.txt")
    (asked,) = alarms(check_folder(folder))
    assert asked.name == "masks" and asked.level is Level.LOOK and "--prompts" in asked.fix
    assert as_lines(check_folder(folder), "fine").endswith("To look at before tracking: masks")


def test_points_that_a_pose_can_do_with_are_worth_a_look(good):
    few = preset().with_values({"lifecycle.return_inliers": 1000})
    assert {f.name: f.level for f in alarms(check_folder(good, config=few))} == {
        "box: points": Level.LOOK,
        "can: points": Level.LOOK,
    }


def test_empty_masks_are_wrong(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "empty")
    for path in (folder / "masks").rglob("*.png"):
        cv2.imwrite(str(path), np.zeros((480, 640), np.uint8))
    (wrong,) = alarms(check_folder(folder))
    assert (wrong.name, wrong.level) == ("masks", Level.WRONG) and "p2p click" in wrong.fix


def click(u, v):
    return {"prompts": [Prompt("box", 0, np.array([[u, v]], float))]}


def test_a_click_on_the_background_is_worth_a_look(good):
    finding = found(good, "box: clicks", **click(230, 240))
    assert finding.level is Level.LOOK and "lie in the plane around them, like a table or a wall" in finding.text


def test_clicks_all_over_the_background_are_worth_a_look(good):
    clicks = {"prompts": [Prompt("box", 0, np.array([[100.0, 400], [500, 420], [320, 320]]))]}
    finding = found(good, "box: mask", **clicks)
    assert finding.level is Level.LOOK and re.match(r"it covers \d+ % of the image, over 0\.\d+ m", finding.text)
    assert "table or a wall" in finding.fix


def test_clicks_of_two_objects_on_one_body_are_worth_a_look(good):
    """The same warning as a run gives."""
    (box,) = prompts_in({"box": open_sequence(good).masks(0)["box"]})
    twice = [box, Prompt("lid", 0, np.add(box.points_px, [15, 10]))]
    finding = found(good, "lid: clicks", prompts=twice)
    assert finding.level is Level.LOOK and "selects most of 'box', too" in finding.text


def test_corrections_are_said_not_to_be_looked_at(good):
    (box,) = prompts_in({"box": open_sequence(good).masks(0)["box"]})
    later = [replace(box, frame=4), replace(box, frame=2)]
    finding = found(good, "box: corrections", prompts=[box, *later])
    assert finding.level is Level.OPTIONAL and "in 2 later frames, from frame 2 on, not looked at" in finding.text
    assert not [f for f in check_folder(good, prompts=[box]) if "corrections" in f.name]


def test_a_click_that_segments_nothing_is_said_once(good, recwarn):
    (wrong,) = alarms(check_folder(good, **click(5, 5)))
    assert (wrong.name, wrong.level) == (
        "box: mask",
        Level.WRONG,
    ) and "were segmented at the clicks on it" in wrong.text
    assert "Click again" in wrong.fix and not len(recwarn)


def test_a_correction_without_depth_is_said_before_a_run_ends_there(good, tmp_path):
    good = shutil.copytree(good, tmp_path / "hole")
    (box,) = prompts_in({"box": open_sequence(good).masks(0)["box"]})
    (again,) = (replace(p, frame=4) for p in prompts_in({"box": open_sequence(good).masks(4)["box"]}))
    assert alarms(check_folder(good, prompts=[box, again])) == []
    path = sorted((good / "depth").iterdir())[4]
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), 0 * depth)
    wrong = [f for f in alarms(check_folder(good, prompts=[again, box])) if f.name == "clicks"]
    assert len(wrong) == 1 and "has no depth in frame 4" in wrong[0].text


def test_a_later_object_of_nearly_the_same_name_may_be_a_correction(good):
    (box,) = prompts_in({"box": open_sequence(good).masks(0)["box"]})
    masks = open_sequence(good).masks(4)
    later = [replace(p, frame=4) for p in prompts_in({"bx": masks["box"], "lid": masks["can"]})]
    findings = alarms(check_folder(good, prompts=[box, *later]))
    (name,) = (f for f in findings if f.name.endswith("name"))
    assert (name.name, name.text, name.fix) == ("bx: name", "a new object from frame 4 on", "Did you mean box?")


def scaled_depth(folder, factor):
    for path in (folder / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * float(factor)
        cv2.imwrite(str(path), np.clip(np.rint(depth), 0, 65535).astype(np.uint16))
    return folder


@pytest.mark.parametrize(
    ("factor", "limit", "scale"),
    [
        (0.1, "depth.min_m=0.03", "0.01 (centimetres)"),
        (5, "poses are as rough", "0.0002 (TUM RGB-D)"),
        (10, "depth.max_m=13.9", "0.0002 (TUM RGB-D)"),
    ],
)
def test_objects_all_out_of_range_or_far_are_one_finding(good, tmp_path, factor, limit, scale):
    found = alarms(check_folder(scaled_depth(shutil.copytree(good, tmp_path / "scaled"), factor)))
    (wrong,) = (finding for finding in found if finding.name.endswith(": depth"))
    assert wrong.name == "box: depth" and "(can " in wrong.text
    assert wrong.level is Level.WRONG and limit in wrong.fix and scale in wrong.fix
    rest = [finding for finding in found if finding is not wrong]
    assert bool(rest) == (factor == 5), "out of range, nothing else is said"
    assert {finding.level for finding in rest} <= {Level.LOOK}, "what is far is a mask's rim, too: by the same unit"


@pytest.mark.parametrize("away", [1, 5])
def test_what_is_wrong_by_metres_follows_from_a_unit_in_doubt(good, tmp_path, away):
    """Masks that are drawn too wide are wrong; not where all is so far away that the unit may be another."""
    scaled = scaled_depth(shutil.copytree(good, tmp_path / "scaled"), away)
    findings = check_folder(Faulty(open_sequence(scaled), "mask wide", 6))
    wrong = [f.name for f in findings if f.level is Level.WRONG]
    if away == 1:
        assert {"box: mask", "can: mask"} & set(wrong)
        return
    assert wrong == ["box: depth"]
    for after in (f for f in findings if f.name.endswith(": mask")):
        assert after.level is Level.LOOK and after.fix.startswith("If the unit is right (box: depth): Draw it")
    names = [f.name for f in findings]
    assert names.index("box: depth") < names.index("registration"), "in the order in which it should be mended"


def test_registration_is_not_blamed_for_a_unit(good, tmp_path, monkeypatch):
    """What is an edge of depth is in metres; a size that fits says that all is as far as it looks."""
    monkeypatch.setattr(check, "misfit", lambda *_: Misfit(1.0, 20.0, 0.0, 1.5))
    far = scaled_depth(shutil.copytree(good, tmp_path / "far"), 5)
    assert [(f.name, f.level) for f in alarms(check_folder(good))] == [("registration", Level.WRONG)]
    levels = {f.name: f.level for f in check_folder(far)}
    assert (levels["box: depth"], levels["registration"]) == (Level.WRONG, Level.LOOK)
    shutil.rmtree(scaled_depth(far, 4) / "masks")
    levels = {f.name: f.level for f in check_folder(far)}
    assert (levels["depth"], levels["registration"]) == (Level.WRONG, Level.LOOK)
    sized = scaled_depth(shutil.copytree(good, tmp_path / "sized"), 5)
    levels = {f.name: f.level for f in check_folder(sized, sizes={"box": 84})}
    assert (levels["box: depth"], levels["registration"]) == (Level.OK, Level.WRONG)
    assert found(sized, "box: depth", sizes={"box": 17}).level is Level.WRONG, "one that does not fit tells nothing"
    monkeypatch.setattr("p2p_lib.run.misfit", lambda *_: Misfit(1.0, 20.0, 0.0, 1.5))
    for folder, blamed in ((good, True), (scaled_depth(sized, 4), False)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run(folder, tmp_path / "run", stop=2, if_exists="replace", progress=False)
        assert any("offset from colour" in str(doubt.message) for doubt in caught) == blamed


@pytest.mark.parametrize(
    ("times", "text", "fix"),
    [
        (1, "", ""),
        (10, "between 0.1 and 5 m, which count", "--set depth.max_m"),
        (5, r"the nearest 10 % up to [23]\.\d+ m away, off by about 2 cm", r"of 0\.0002 \(TUM RGB-D\)"),
        (0.1, r"the nearest 10 % up to 0\.0[45]\d* m away, nearer than", r"A unit of 0\.01 \(centimetres\)"),
    ],
)
def test_without_objects_depth_out_of_range_is_looked_at(good, tmp_path, times, text, fix):
    """As a whole, or in its near part: the wall may be where it counts."""
    folder = scaled_depth(shutil.copytree(good, tmp_path / "scaled"), times)
    shutil.rmtree(folder / "masks")
    (found,) = (finding for finding in check_folder(folder) if finding.name == "depth")
    assert found.level is (Level.OK if times == 1 else Level.LOOK)
    assert re.search(text, found.text) and re.search(fix, found.fix)


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1, None), (0.1, "0.01 (centimetres)"), (5, "0.0002 (TUM RGB-D)"), (10, "0.0002 (TUM RGB-D)")],
)
@pytest.mark.parametrize("masks", ["dataset", "clicks"])
def test_a_run_says_at_its_first_masks_that_depth_is_out_of_range(good, tmp_path, factor, unit, masks):
    """With the units that would bring it into range, as the check does."""
    folder = scaled_depth(shutil.copytree(good, tmp_path / "scaled"), factor)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(folder, tmp_path / "run", masks=masks, stop=1, settings={"tsdf.voxel_m": 0.02}, progress=False)
    followed = [obj.has_pose.all() for obj in load_run(tmp_path / "run").objects.values()]
    assert followed == [factor in (1, 5)] * 2, "what is far away is followed, too"
    said = [str(doubt.message) for doubt in caught if " m away" in str(doubt.message)]
    if unit is None:
        assert not said
    else:
        (line,) = said
        why = "where depth is off by about [2-4] cm" if factor == 5 else "but 0.1 to 5 m count"
        assert re.match(rf"depth of 'box' in frame 0: .* m away \(can .* m\), {why}\. If it was", line)
        assert f"(--depth-scale). A unit of {unit}" in line


@pytest.mark.parametrize(("share", "doubted"), [(0.9, False), (1.0, True)])
def test_a_mask_that_holds_more_of_what_is_far_behind_tells_nothing_of_units(good, tmp_path, recwarn, share, doubted):
    folder = shutil.copytree(good, tmp_path / "far")
    depth = cv2.imread(str(folder / "depth/000000.png"), cv2.IMREAD_UNCHANGED)
    on_it = np.argwhere(open_sequence(good).masks(0)["box"])
    depth[tuple(on_it[: int(share * len(on_it))].T)] = 6000
    cv2.imwrite(str(folder / "depth/000000.png"), depth)
    run(folder, tmp_path / "run", objects=["box"], stop=1, settings=POINTS_ALONE, progress=False)
    assert any("m count" in str(doubt.message) for doubt in recwarn) == doubted


def test_a_known_size_tells_what_nothing_else_does(good):
    """The focal length of a lens half as long makes everything twice as wide; all other findings stay as they were."""
    assert "--size NAME=CM" in found(good, "camera").text
    length_m = mask_length_m((frame := open_sequence(good).frame(0)), open_sequence(good).masks(0)["box"], CAMERA)
    known = {"sizes": {"box": 100 * length_m}}
    assert found(good, "box: size", **known).level is Level.OK
    shorter = found(good, "box: size", sizes={"box": 90 * length_m})
    said = f"measured {100 * length_m:.1f} cm in its masks, {90 * length_m:g} cm given: fits, as "
    assert shorter.level is Level.OK and shorter.text.startswith(said) and "(frame 0)" in shorter.text
    cut = np.zeros_like(frame.depth_m, bool)
    cut[-40:] = True
    assert "reaches the image's border" in check._size("box", length_m, frame, cut, CAMERA).text, "may be longer"
    bare = replace(frame, depth_m=np.zeros_like(frame.depth_m))
    assert check._size("box", length_m, bare, bare.depth_m == 0, CAMERA).level is Level.OPTIONAL, "not measured"
    wide = another_K(open_sequence(good), CAMERA.K * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]])
    finding = found(wide, "box: size", **known)
    assert finding.level is Level.LOOK and re.search(
        r"(1\.[5-9]|2\.0)\d? times: masks hold more .* or focal length", finding.text
    )
    assert alarms(check_folder(wide, **known)) == [finding]
    assert frame.index == 0


@pytest.mark.parametrize("times", [0.1, 6.0])
def test_a_wrong_unit_shows_in_an_objects_size_where_its_distance_may_be(good, times, tmp_path, recwarn):
    scaled = replace(open_sequence(good), depth_scale=0.001 * times)
    wide = {"config": preset().with_values({"depth.min_m": 0.01, "depth.max_m": 10.0})}
    finding = found(scaled, "box: size", **wide)
    assert finding.level is Level.LOOK and re.fullmatch(r"[\d.]+ cm long, [\d.]+ m away", finding.text)
    assert "--depth-scale). A unit of" in finding.fix
    assert "box: size" not in [f.name for f in check_folder(good, **wide)]
    for sizes, doubted in (({}, True), ({"box": 60}, False)):
        settings = {"depth.min_m": 0.01, "depth.max_m": 10.0} | POINTS_ALONE
        run(scaled, tmp_path / f"{doubted}", objects=["box"], stop=1, settings=settings, sizes=sizes, progress=False)
        said = f"{'size' if times < 1 else 'depth'} of 'box' in frame 0"
        assert any(said in str(doubt.message) for doubt in recwarn) == doubted
        recwarn.clear()


def test_depth_that_was_cut_off_must_be_exported_again(good, tmp_path):
    (wrong,) = alarms(check_folder(scaled_depth(shutil.copytree(good, tmp_path / "scaled"), 1000)))
    assert wrong.name == "depth" and "cut off at 65.5 m" in wrong.text and "Export the depth again" in wrong.fix


def test_an_image_that_ends_too_early_is_found_wherever_it_is(good, tmp_path, monkeypatch):
    """Of those between the images that are looked at, too."""
    monkeypatch.setattr(check, "FRAMES", 2)
    torn = open_sequence(shutil.copytree(good, tmp_path / "torn")).depth[3]
    torn.write_bytes(torn.read_bytes()[:-500])
    (wrong,) = alarms(check_folder(tmp_path / "torn"))
    assert wrong.level is Level.WRONG and wrong.text == f"1 of 12 images end too early: {torn}"
    assert "--skip-bad" in wrong.fix


def test_a_jpeg_that_ends_too_early_is_found_and_one_that_is_padded_is_whole(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "torn")
    for path in open_sequence(folder).rgb:
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)))
        path.unlink()
    whole, torn = open_sequence(folder).rgb[2:4]
    whole.write_bytes(whole.read_bytes() + bytes(500))
    torn.write_bytes(torn.read_bytes()[:-500])
    (wrong,) = alarms(check_folder(folder))
    assert wrong.text == f"1 of 12 images end too early: {torn}"


@pytest.mark.parametrize("name", ["depths", "depth_images", "aligned_depth", "Depth-PNG"])
def test_check_names_the_likely_folder_and_not_itself(good, tmp_path, name):
    folder = shutil.copytree(good, tmp_path / "open3d")
    (folder / "rgb").rename(folder / "color")
    (folder / "depth").rename(folder / name)
    (folder / "depth_vis").mkdir()
    (wrong,) = check_folder(folder)
    assert "depth: no such folder" in wrong.text and wrong.fix == f"Rename {name}/ to depth/."
    with pytest.raises(MissingData, match=f"Rename {name}/ to depth/. p2p check FOLDER"):
        open_sequence(folder)


def test_colours_in_the_folder_of_depth_are_said_to_be_there(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "swapped")
    (folder / "rgb").rename(folder / "colours")
    (folder / "depth").rename(folder / "rgb")
    (folder / "depth").mkdir()
    for path in (folder / "colours").iterdir():
        cv2.imwrite(str(folder / "depth" / f"{path.stem}.jpg"), cv2.imread(str(path)))
    (wrong,) = (of for of in check_folder(folder) if of.name == "depth/")
    assert "got no files that fit, but 6 of kind .jpg" in wrong.text
    assert "are colour and depth images swapped?" in wrong.fix


def test_a_fault_of_every_image_is_said_once(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "eight")
    for k, path in enumerate(open_sequence(folder).depth):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), (depth // 32).astype(np.uint8) if k % 2 else depth[: 100 + k])
    eight, size = (
        f.text.partition(": ")[2] for f in sorted(check_folder(folder), key=lambda f: "one channel" not in f.text)
    )
    assert eight.startswith("got (480, 640) uint8") and eight.endswith(
        "; 2 more like it of the 6 frames looked at: 000003.png, 000005.png"
    )
    assert size.startswith("got 640x100, expected 640x480") and size.endswith("looked at: 000002.png, 000004.png")


def test_what_is_missing_is_named(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "less")
    (folder / "masks/box/000000.png").unlink()
    (folder / "masks/box/000001.png").rename(folder / "masks/box/one.png")
    (wrong,) = check_folder(folder)
    assert "000000.png is missing. Masks of some images have their names" in wrong.fix
    shutil.rmtree(folder / "rgb")
    (folder / "cam_K.txt").unlink()
    shutil.rmtree(folder / "depth")
    (folder / "depth").mkdir()
    (folder / "times.txt").write_text("noon")
    wrong = check_folder(folder)
    assert [finding.name for finding in wrong] == ["rgb/", "depth/", "cam_K.txt", "times.txt"]
    assert all(finding.level is Level.WRONG and finding.fix for finding in wrong)
    folder = shutil.copytree(good, tmp_path / "torn")
    for k in (1, 3):
        (folder / f"rgb/00000{k}.png").write_bytes(b"torn")
    (wrong,) = alarms(check_folder(folder))
    assert wrong.text == f"2 of 12 images end too early: {folder}/rgb/000001.png, {folder}/rgb/000003.png"
    for k in (1, 3):  # ends as it should, and is none
        (folder / f"rgb/00000{k}.png").write_bytes(b"\x89PNG IEND")
    findings = check_folder(folder)
    (wrong,) = alarms(findings)
    assert "000001.png: got" in wrong.text and wrong.text.endswith(
        "1 more like it of the 6 frames looked at: 000003.png"
    )
    replace_it = "Replace it, or leave out both of its images."
    assert {finding.fix for finding in alarms(findings)} == {f"{replace_it} {SKIP_BAD}"}
    (folder / "rgb/000000.png").write_bytes(b"\x89PNG IEND")
    assert alarms(check_folder(folder))[0].text.partition(":")[0].endswith("rgb/000000.png")
    (folder / "cam_K.txt").unlink()
    (folder / "depth/000000.png").unlink()
    assert [(finding.name, finding.fix) for finding in check_folder(folder)] == [
        ("rgb/", replace_it),
        ("cam_K.txt", WRITE_K),
    ]
    assert as_lines(findings, "fine").endswith("To mend first: files")


def test_what_mends_it_follows_in_every_layout(good, tmp_path):
    """In TUM's, too, which is opened as a whole."""
    folder = shutil.copytree(good, tmp_path / "desk")
    (folder / "cam_K.txt").unlink()
    (plain,) = check_folder(folder)
    for part in ("rgb", "depth"):
        lines = [f"{k / 30} {part}/{path.name}" for k, path in enumerate(sorted((folder / part).iterdir()))]
        (folder / f"{part}.txt").write_text("\n".join(lines))
    (tum,) = check_folder(folder)
    assert (plain.fix, tum.fix) == (WRITE_K, WRITE_K)
    assert tum.text.startswith(f"{folder}/cam_K.txt: ") and WRITE_K not in tum.text


def test_lines_align_and_remedies_follow_what_they_mend(good):
    lines = as_lines(check_folder(good), "fine").splitlines()
    assert all(re.match(r"ok     \S", line) for line in lines[:-1])


# --- a folder of one's own, written ----------------------------------------------------------------


def test_a_written_folder_reads_back(good):
    source, read = open_sequence("synthetic/crossing"), open_sequence(good)
    assert read.format == "folder" and len(read) == 6 and read.truth == {}
    assert read.objects == source.objects and read.camera == source.camera
    np.testing.assert_allclose(read.times_s, source.times_s[:48:8] - source.times_s[0], atol=1e-6)
    for i in (0, 5):
        a, b = source.frame(8 * i), read.frame(i)
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_allclose(a.depth_m, b.depth_m, atol=5.1e-4)
        for name, mask in source.masks(8 * i).items():
            np.testing.assert_array_equal(mask, read.masks(i)[name])


def test_a_folder_is_not_written_over(good):
    with pytest.raises(BadInput, match="what is there already"):
        own.write(open_sequence(good), good)


def test_a_folder_of_ours_may_be_written_anew(good, tmp_path):
    source, out = open_sequence(good), tmp_path / "again"
    own.write(source, out, range(6))
    (out / "notes.txt").write_text("mine")
    assert len(open_sequence(own.write(source, out, range(2), masks=(), overwrite=True))) == 2
    assert not (out / "masks").exists() and (out / "notes.txt").read_text() == "mine"


def test_a_folder_with_the_first_masks_alone(good, tmp_path):
    read = open_sequence(own.write(open_sequence(good), tmp_path / "first", range(6), masks=(0,)))
    assert read.masks(0).keys() == {"box", "can"} and read.masks(1) is None
    assert open_sequence(own.write(open_sequence(good), tmp_path / "none", range(6), masks=())).masks(0) is None


def test_a_wrong_unit_is_told_once(good):
    """Nothing can be said of objects that are a thousand times too far away, and nothing is."""
    assert [f.name for f in alarms(check_folder(replace(open_sequence(good), depth_scale=1.0)))] == ["depth"]


def test_camera_of_a_telescope_is_no_camera():
    assert check._camera(Camera(600, 600, 320, 240, 640, 480)).level is Level.OK
    assert check._camera(Camera(6000, 6000, 320, 240, 640, 480)).level is Level.WRONG


def test_one_that_is_far_away_beside_others_is_and_needs_no_other_unit(good, tmp_path, recwarn):
    folder = shutil.copytree(good, tmp_path / "far")
    for path in (folder / "depth").iterdir():
        depth, mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED), open_sequence(good).masks(int(path.stem))["can"]
        depth[mask] = np.clip(4.0 * depth[mask], 0, 4000)
        cv2.imwrite(str(path), depth)
    assert found(folder, "can: depth").level is Level.OK
    run(folder, tmp_path / "run", stop=1, settings=POINTS_ALONE, progress=False)
    assert not any(" m away, where depth" in str(doubt.message) for doubt in recwarn)


def test_of_all_that_are_far_away_one_is_judged_and_a_known_size_says_that_they_are(good, tmp_path, recwarn):
    folder = scaled_depth(shutil.copytree(good, tmp_path / "scaled"), 5)
    assert [f.name for f in check_folder(folder) if f.name.endswith(": depth")] == ["box: depth"]
    run(folder, tmp_path / "run", stop=1, sizes={"box": 100.0}, settings=POINTS_ALONE, progress=False)
    assert not any(" m away, where depth" in str(doubt.message) for doubt in recwarn)


def test_pairs_side_by_side_are_told_how_to_be_put(tmp_path):
    for kind in ("color.jpg", "depth.png"):
        (tmp_path / f"frame-000000.{kind}").touch()
    (found,) = check_folder(tmp_path)
    assert "as in 7-Scenes" in found.text and "into rgb/" in found.fix


def numbered(folder, first, name="{:06d}"):
    """The images of a folder, called anew from a number on."""
    for k, path in reversed(list(enumerate(sorted(folder.iterdir())))):
        path.rename(folder / f"{name.format(first + k)}{path.suffix}")


@pytest.mark.parametrize("gone", [0, 1])
@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_folder_that_counts_from_1_is_renamed_and_nothing_taken_out(good, tmp_path, part, gone):
    """By their names each image would be paired with the next one; the command that is named mends it."""
    folder = shutil.copytree(good, tmp_path / "my ffmpeg")
    shutil.rmtree(folder / "masks")
    numbered(folder / part, 1)
    for path in sorted((folder / part).iterdir())[6 - gone :]:
        path.unlink()
    wrong, *_ = alarms(check_folder(folder))
    assert f"Rename those in {folder / part}, and take none out: " in wrong.fix and "ffmpeg begins with 1" in wrong.fix
    assert ("is too many. Or" in wrong.fix or "Put them back. " in wrong.fix) == bool(gone)
    assert "no counterpart" not in wrong.fix
    subprocess.run(["bash", "-c", wrong.fix.partition("take none out: ")[2]], check=True)
    assert [path.stem for path in sorted((folder / part).iterdir())] == [f"{k:06d}" for k in range(6 - gone)]


@pytest.mark.parametrize("first", [0, 2])
def test_images_that_are_missing_here_and_there_are_not_taken_for_a_count_from_1(good, tmp_path, first):
    folder = shutil.copytree(good, tmp_path / "gaps")
    (folder / f"rgb/00000{first}.png").unlink()
    (folder / "depth/000004.png").unlink()
    assert found(folder, "depth/").fix == "Take out what has no counterpart."


@pytest.mark.parametrize(
    ("name", "said"),
    [("{:06d}", "3 {}/%06d.png"), ("d-{}", "3 {}/d-%d.png"), ("{:03d}x", "0 {}/%06d.png")],
)
def test_of_a_video_beside_depth_ffmpeg_makes_images_that_are_called_as_those(good, tmp_path, name, said):
    folder = shutil.copytree(good, tmp_path / "video")
    numbered(folder / "depth", 3, name)
    shutil.rmtree(folder / "rgb")
    (folder / "rgb.mp4").write_bytes(b"film")
    (folder / "depth.mp4").write_bytes(b"film")
    rgb = folder / "rgb"
    made = f"mkdir {rgb} && ffmpeg -i {rgb}.mp4 -fps_mode passthrough -start_number {said.format(rgb)}"
    assert found(folder, "rgb/").fix == f"rgb.mp4 is a video; its images: {made}"
    (folder / "depth").rename(folder / "depth16")
    with pytest.raises(BadInput, match=r"rgb\.mp4 is a video"):
        open_sequence(folder)
    rgb.mkdir()
    shutil.move(folder / "rgb.mp4", rgb)
    assert found(folder, "rgb/").fix.startswith(f"rgb.mp4 is a video; its images: ffmpeg -i {rgb}/rgb.mp4 ")


def test_open3ds_layout_without_its_files_says_at_once_how_to_make_a_folder_of_ones_own(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "own")
    (folder / "rgb").rename(folder / "color")
    (folder / "cam_K.txt").unlink()
    (folder / "intrinsics.txt").write_text("525 524 319.5 239.5\n")
    (folder / "notes.txt").write_text("a mug\n")
    (wrong,) = check_folder(folder)
    K = "525 0 319.5 0 524 239.5 0 0 1"
    assert "no camera_intrinsic.json or intrinsic.json" in wrong.text
    assert wrong.fix == (
        "If it is of another layout, name that with --format; if it is a folder of your own, rename color/ to rgb/ "
        "and write cam_K.txt. intrinsics.txt holds four numbers. "
        f"If these are fx fy cx cy, write {K} into cam_K.txt."
    )
    (folder / "color").rename(folder / "rgb")
    for text, said in (
        ("fx: 525\n", f"{WRITE_K} intrinsics.txt may hold them."),
        ("1 0 2\n0 1 2\n0 0 1\n", "nine numbers"),
    ):
        (folder / "intrinsics.txt").write_text(text)
        assert said in found(folder, "cam_K.txt").fix
    (folder / "intrinsics.txt").write_text("525 524 319.5 239.5\n")
    assert K in found(folder, "cam_K.txt").fix, "likewise in a plain folder"
    shutil.copy(folder / "intrinsics.txt", folder / "cam_K.txt")
    assert found(folder, "cam_K.txt").fix == f"If these are fx fy cx cy, write {K} into cam_K.txt."
    (folder / "cam_K.txt").write_text(str(CAMERA.K))
    assert found(folder, "cam_K.txt").fix == f"Write the numbers alone, without brackets. {WRITE_K}"
    (folder / "cam_K.txt").write_text(K.replace("/", "\n"))
    assert not [f for f in check_folder(folder) if f.name in ("files", "cam_K.txt") and not f.fine]


def test_depth_of_half_the_size_says_how_to_enlarge_it_where_it_may_show_the_same(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "half")
    for size, same in (((320, 240), True), ((320, 288), False)):
        for path in (folder / "depth").iterdir():
            cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), -1), size, interpolation=cv2.INTER_NEAREST))
        wrong, *_ = check_folder(folder)
        assert ("cv2.resize(depth, (640, 480), interpolation=cv2.INTER_NEAREST)" in wrong.fix) == same
        assert wrong.fix.endswith("Register the depth to the colour camera first.")


@pytest.mark.parametrize("given", ["masks", "prompts"])
def test_a_scene_that_is_near_as_a_whole_is_doubted_beside_objects_that_count(good, tmp_path, given):
    """Depth in centimetres of a room: its things are a tenth as far away as they are, and not too near to count."""
    clicks = [Prompt("box", 0, [(170, 245), (190, 220), (150, 270)])] if given == "prompts" else []
    folder = scaled_depth(shutil.copytree(good, tmp_path / "near"), 0.25)
    depth = found(folder, "depth", prompts=clicks)
    assert depth.level is Level.LOOK
    assert re.search(r"^0\.2\d* m in the middle.*half of all nearer than 0\.3 m", depth.text)
    assert "the depth scale is wrong (--depth-scale). A unit of 0.01 (centimetres)" in depth.fix
    assert found(folder, "box: depth", prompts=clicks).level is Level.OK
    near = check_folder(folder, prompts=clicks, sizes={"box": 16.8 / 4})
    assert next(f for f in near if f.name == "depth").level is Level.OK, "a size that fits says that it is so near"
    assert found(good, "depth", prompts=clicks).level is Level.OK
