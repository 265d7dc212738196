"""Parts of other people: by their place or by the name that an installed package offers; what is wrong is one line."""

import re
import shutil
import sys

import pytest

from p2p_lib.apps import cli
from p2p_lib.core import plugins
from p2p_lib.core.backends import make_detector, make_segmenter, make_tracker
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt, MissingBackend
from p2p_lib.core.options import RunOptions
from p2p_lib.datasets.cameras import open_camera
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence, recognise
from tests.apps.test_cli import POINTS_ALONE
from tests.fixtures.sliding_board import write_sequence

CODE = """
from p2p_lib.datasets import folder as plain
from p2p_lib.detectors.classical import UniformDetector
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter
from p2p_lib.trackers.lk import LkTracker

class Mine(LkTracker):
    name = "mine"

class Dots(UniformDetector):
    name = "dots"

class Cutter(BuiltinSegmenter):
    def __init__(self, *of):
        super().__init__(*of)
        self.name = "cutter"

class Unfinished:
    def __init__(self, config, rng): ...
    def start(self, frame, camera=None): ...

class Weighty:
    def __init__(self, *, weights): ...

def sized(config, rng, size): ...

made = Mine(None)

def load(folder, masks):
    return plain.load(folder, masks)

load.patterns = ("gt_mask.marked/",)

def nothing(folder, masks): ...

def fail():
    raise ValueError("no luck\\ntoday")

class Unlucky(LkTracker):
    name = "unlucky"
    def track(self, frame, search=None, urgent=False):
        return fail()

class Narrow(LkTracker):
    name = "narrow"
    def track(self, frame):
        return super().track(frame)

class Blind(UniformDetector):
    name = "blind"
    def detect(self, frame, mask):
        return open("/nowhere/weights")

class Torn(BuiltinSegmenter):
    name = "torn"
    def segment(self, *said):
        return {}["labels"]

def unread(folder, masks):
    return fail()
"""
OFFERED = """
[p2p_lib.trackers]
somebodys = their_parts:Mine
builtin = their_parts:Mine
gone = their_lost_parts:Mine

[p2p_lib.detectors]
dots = their_parts:Dots

[p2p_lib.segmenters]
cutter = their_parts:Cutter

[p2p_lib.datasets]
marked = their_parts:load
"""


@pytest.fixture
def theirs(tmp_path, monkeypatch):
    """Somebody's package, as if it were installed."""
    home = tmp_path / "site"
    (home / "their_parts-1.0.dist-info").mkdir(parents=True)
    (home / "their_parts.py").write_text(CODE)
    (home / "their_parts-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: their-parts\nVersion: 1.0\n"
    )
    (home / "their_parts-1.0.dist-info" / "entry_points.txt").write_text(OFFERED)
    monkeypatch.syspath_prepend(str(home))
    yield home
    sys.modules.pop("their_parts", None)


@pytest.fixture
def sequence(tmp_path):
    return write_sequence(tmp_path / "slide")


@pytest.mark.parametrize("place", [True, False], ids=["by its place", "by its name"])
def test_parts_of_others_run_as_ours_do(theirs, sequence, tmp_path, place):
    tracker, detector, cutter = ("their_parts:Mine", "their_parts:Dots", "their_parts:Cutter")
    named = [tracker, detector, cutter] if place else ["somebodys", "dots", "cutter"]
    (tmp_path / "prompts.json").write_text('{"objects": [{"name": "object", "frame": 0, "points": [[60, 50]]}]}')
    words = [f"--{option}={name}" for option, name in zip(("tracker", "detector", "masks"), named)]
    words += ["--prompts", str(tmp_path / "prompts.json"), "--out", str(tmp_path / "run")]
    assert cli.main(["run", str(sequence), *words, *POINTS_ALONE]) == 0
    info = load_run(tmp_path / "run").info
    assert (info["tracker"], info["detector"], info["segmenter"]) == ("mine", "dots", "cutter")


def test_a_layout_of_others_is_recognised_or_named(theirs, sequence):
    (sequence / "gt_mask").rename(sequence / "gt_mask.marked")
    assert open_sequence(sequence).format == "ycbineoat", "ours come first"
    shutil.rmtree(sequence / "annotated_poses")
    assert open_sequence(sequence).format == "marked", "but for those of a mere folder of colour images"
    (sequence / "rgb").rename(sequence / "color")
    assert recognise(sequence) == "marked"
    (sequence / "color").rename(sequence / "rgb")
    for name in ("marked", "their_parts:load"):
        assert open_sequence(sequence, format=name).format == name


def test_a_broken_layout_of_others_is_left_out_unless_it_is_named(theirs, sequence):
    lost = "\n[p2p_lib.datasets]\nmarked = their_parts:load\nlost = their_lost_parts:load\n"
    entries = theirs / "their_parts-1.0.dist-info" / "entry_points.txt"
    entries.write_text(OFFERED.partition("\n[p2p_lib.datasets]")[0] + lost)
    plugins._offered.cache_clear()
    shutil.rmtree(sequence / "annotated_poses")
    (sequence / "gt_mask").rename(sequence / "masks")
    with pytest.warns(
        Doubt, match=r"^format 'lost', offered by their-parts: .*their_lost_parts.* left out: mend their-p"
    ):
        assert recognise(sequence) == "folder"
    with pytest.raises(MissingBackend, match=r"^format lost: their_lost_parts cannot be imported"):
        open_sequence(sequence, format="lost")
    plugins._offered.cache_clear()


def test_what_lies_in_the_working_folder_is_meant_where_another_has_its_name(theirs, tmp_path, monkeypatch):
    """As ``p2p`` is started: the folder is on the path, and last, so that none of its files stands in for a library."""
    (tmp_path / "their_parts.py").write_text(CODE.replace('name = "mine"', 'name = "mine, changed"'))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*(place for place in sys.path if place), ""])
    path = list(sys.path)
    assert make_tracker("their_parts:Mine", preset().tracking).name == "mine, changed" and sys.path == path


def test_what_is_installed_is_read_once(monkeypatch):
    """A plan of a hundred runs asks for each of them whether its names are offered by somebody."""
    asked = []
    monkeypatch.setattr(plugins, "entry_points", lambda group: asked.append(group) or [])
    plugins._offered.cache_clear()
    assert not any(plugins.knows("tracker", "somebodys", ()) for _ in range(3)) and asked == ["p2p_lib.trackers"]
    plugins._offered.cache_clear()


def test_our_names_stay_ours(theirs):
    with pytest.warns(Doubt, match=r"tracker 'builtin': ours is used, not their_parts:Mine\. Name that"):
        made = make_tracker("builtin", preset().tracking)
    assert type(made).__module__.startswith("p2p_lib.")


def test_what_cannot_be_had_is_said_in_one_line(theirs, sequence):
    tracking, sampling = preset().tracking, preset().sampling
    with pytest.raises(BadInput, match=r"expected one of builtin, .*somebodys, .*Did you mean somebodys") as refused:
        make_tracker("somebody", tracking)
    assert str(refused.value).count("builtin,") == 1, "a name that both have is listed once"
    for name in ("gone", "their_lost_parts:Mine"):
        with pytest.raises(MissingBackend, match=rf"tracker {name}: their_lost_parts cannot be imported .* PYTHONPATH"):
            make_tracker(name, tracking)
    with pytest.raises(BadInput, match=r"something called Mime in their_parts. Did you mean their_parts:Mine\?"):
        make_tracker("their_parts:Mime", tracking)
    unfinished = (
        "Unfinished: got Unfinished without name, latency_frames, add, track, drop, reject, suggest, expected a"
    )
    with pytest.raises(BadInput, match=f"tracker their_parts:{unfinished}"):
        make_tracker("their_parts:Unfinished", tracking)
    with pytest.raises(BadInput, match="detector their_parts:Mine: got Mine without detect"):
        make_detector("their_parts:Mine", sampling)
    with pytest.raises(BadInput, match="segmenter: got object without name, names, segment, remove"):
        make_segmenter(object(), Camera(100, 100, 10, 10, 20, 20), preset().segmentation)
    with pytest.raises(BadInput, match="detector: got the class object, expected a detector: an instance, or a name"):
        make_detector(object, sampling)
    with pytest.raises(BadInput, match="segmenter their_parts:Mine: got Mine without names, segment, remove"):
        make_segmenter("their_parts:Mine", Camera(100, 100, 10, 10, 20, 20), preset().segmentation)
    with pytest.raises(BadInput, match=r"format: got 'marks', .* or your own as package.module:Class"):
        open_sequence("nowhere", format="marks")
    with pytest.raises(BadInput, match=r"their_parts:nothing: .* gives: got NoneType, expected an ImageSequence"):
        open_sequence(sequence, format="their_parts:nothing")


def test_every_kind_is_found_in_one_way_and_called_as_it_is_promised(theirs, sequence):
    """What cannot be called so is said with what it takes and how it is called, before anything is read."""
    for kind, words in plugins.CALLED_WITH.items():
        call, said = re.escape(f"({', '.join(words)})"), "format" if kind == "dataset" else kind
        with pytest.raises(BadInput, match=rf"{said} their_parts:made: .* instance of Mine, .* called as made{call}"):
            plugins.find(kind, "their_parts:made", {})
        with pytest.raises(BadInput, match=rf"{said} their_parts:sized: got sized\(config, rng, size\), .*sized{call}"):
            plugins.find(kind, "their_parts:sized", {})
    with pytest.raises(BadInput, match=r"Did you mean their_parts:Mine\?"):
        make_tracker("their_parts:made", preset().tracking)
    with pytest.raises(BadInput, match=r"got Weighty\(\*, weights\), .* expected Weighty\(config, rng\)"):
        make_tracker("their_parts:Weighty", preset().tracking)
    with pytest.raises(BadInput, match=r"got Unlucky\(config: .* expected Unlucky\(\)"):
        open_camera("their_parts:Unlucky")
    with pytest.raises(BadInput, match=r"format their_parts:fail: got fail\(\), .* expected fail\(folder, masks\)"):
        open_sequence(sequence, format="their_parts:fail")


@pytest.mark.parametrize(
    ("line", "error", "said"),
    [
        ("class Mine(:", BadInput, r"got a syntax error in \S+their_odd_parts.py:1 \(.*Mend that line"),
        ("import no_such", MissingBackend, r"is there, but not what it imports \(No module named 'no_such'\). Install"),
        ("from re import no", MissingBackend, r"is there, but not what it imports \(cannot import name 'no' from 're'"),
    ],
)
def test_a_module_that_does_not_load_says_what_of_it(theirs, line, error, said):
    (theirs / "their_odd_parts.py").write_text(line)
    with pytest.raises(error, match=rf"tracker their_odd_parts:Mine: .*{said}"):
        make_tracker("their_odd_parts:Mine", preset().tracking)


@pytest.mark.parametrize(
    ("option", "part", "said"),
    [
        ("tracker", "Unlucky", r"Unlucky.track raised ValueError: no luck today \(\S+their_parts.py:(\d+)\)"),
        ("detector", "Blind", r"Blind.detect raised FileNotFoundError: .*weights' \(\S+their_parts.py:(\d+)\)"),
        ("masks", "Torn", r"Torn.segment raised KeyError: 'labels' \(\S+their_parts.py:(\d+)\)"),
        ("format", "unread", r"unread raised ValueError: no luck today \(\S+their_parts.py:(\d+)\)"),
    ],
)
def test_what_a_part_raises_is_said_with_its_place(theirs, sequence, tmp_path, capsys, option, part, said):
    (tmp_path / "prompts.json").write_text('{"objects": [{"name": "object", "frame": 0, "points": [[60, 50]]}]}')
    words = ["run", str(sequence), f"--{option}=their_parts:{part}", "--prompts", str(tmp_path / "prompts.json")]
    words += ["--out", str(tmp_path / "run"), *POINTS_ALONE]
    words += ["--tracker=their_parts:Mine"] if option != "tracker" else []
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    found = re.fullmatch(rf"p2p run: {option} their_parts:{part}: {said}. --debug shows the traceback.", line)
    assert found, line
    if found.groups():
        source = CODE.replace("\\\\", "\\").splitlines()[int(found[1]) - 1]
        assert "raise ValueError" in source or "nowhere" in source or "labels" in source
    assert cli.main([*words, "--debug", "--force"]) == 2 and "Traceback" in capsys.readouterr().err


def test_a_part_whose_methods_are_called_otherwise_is_refused_before_anything_runs(theirs):
    said = r"tracker their_parts:Narrow \(Narrow\): got track\(frame\), .* expected track\(frame, search, urgent\), see"
    with pytest.raises(BadInput, match=said):
        make_tracker("their_parts:Narrow", preset().tracking)
    camera, config = Camera(100, 100, 10, 10, 20, 20), preset().segmentation
    own = make_segmenter("their_parts:Cutter", camera, config)
    own.remove = None
    with pytest.raises(BadInput, match=r"segmenter \(Cutter\): got remove = None, expected remove\(name\)"):
        make_segmenter(own, camera, config)

    class Called:
        name = "called"

        def names(self):
            return ()

        def segment(self, frame, prompts, hints):
            return None

        def remove(self, name):
            return None

    with pytest.raises(BadInput, match=r"segmenter \(Called\): names: got a method, .* Put @property before it"):
        make_segmenter(Called(), camera, config)


def test_a_near_name_is_one_that_can_be_called(theirs):
    with pytest.raises(BadInput, match=r"something called load_it in their_parts. Did you mean their_parts:load\?"):
        make_tracker("their_parts:load_it", preset().tracking)
    with pytest.raises(BadInput, match=r"something called Nope in their_parts\. It has Mine, Dots, Cutter, .* more\.$"):
        make_tracker("their_parts:Nope", preset().tracking)
    (theirs / "their_parts.py").write_text("import numpy as nq")
    sys.modules.pop("their_parts")
    with pytest.raises(BadInput, match=r"something called nd in their_parts$"):
        make_tracker("their_parts:nd", preset().tracking)


def test_a_mistake_of_ours_is_none_of_theirs(theirs, sequence, tmp_path, monkeypatch):
    def broken(*of, **more):
        raise ZeroDivisionError

    monkeypatch.setattr("p2p_lib.run.run", broken)
    with pytest.raises(ZeroDivisionError):
        cli.main(["run", str(sequence), "--tracker=their_parts:Mine", "--out", str(tmp_path / "run")])


def test_a_folder_of_masks_is_no_segmenter(theirs):
    assert RunOptions(masks="drawn").mask_source().folder == "drawn"
    assert RunOptions(masks="their_parts:Cutter").mask_source().segmenter == "their_parts:Cutter"
