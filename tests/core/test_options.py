"""Options of a run are declared once: every field is an argument of the command line and comes back from it."""

import argparse
import shlex
from dataclasses import fields, replace
from pathlib import Path

import pytest

from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.options import RunOptions, add_options, differing, located, names, pairs

#: What is typed for each field, and what the field is then.
TYPED = {
    "preset": (["--preset", "paper"], "paper"),
    "config_file": (["--config", "mine.toml"], "mine.toml"),
    "settings": (
        ["--set", "sampling.points=5", "--set", "method.surface=no"],
        {"sampling.points": "5", "method.surface": "no"},
    ),
    "seed": (["--seed", "7"], 7),
    "device": (["--device", "cuda:1"], "cuda:1"),
    "tracker": (["--tracker", "lk"], "lk"),
    "detector": (["--detector", "orb"], "orb"),
    "masks": (["--masks", "dataset:drawn"], "dataset:drawn"),
    "prompts": (["--prompts", "p.json"], "p.json"),
    "memory": (["--memory", "a, b.npz", "--memory", "c.npz"], ["a, b.npz", "c.npz"]),
    "frozen": (["--frozen"], True),
    "save_masks": (["--save-masks"], True),
    "skip_bad": (["--skip-bad"], True),
    "format": (["--format", "bop"], "bop"),
    "depth_scale": (["--depth-scale", "0.0001"], 0.0001),
    "objects": (["--objects", "mug,can"], ["mug", "can"]),
    "start": (["--start", "3"], 3),
    "stop": (["--stop", "9"], 9),
    "models": (["--models", "mug=a.ply", "can=b.ply"], {"mug": "a.ply", "can": "b.ply"}),
    "sizes": (["--size", "mug=9.5"], {"mug": "9.5"}),
}


def test_options_are_spelled_as_they_are_typed():
    words = [word for typed, _ in TYPED.values() for word in typed]
    again = parsed(*shlex.split(" ".join(parsed(*words).words())))
    assert again.as_dict() == parsed(*words).as_dict() and parsed().words() == []
    quoted = RunOptions(prompts="my clicks.json").words()
    assert shlex.split(" ".join(quoted)) == ["--prompts", "my clicks.json"]
    asked = parsed("--stop", "9", "--save-masks").as_dict()
    assert differing(asked, parsed("--seed", "1").as_dict()) == (
        "no --seed --save-masks --stop 9",
        "--seed 1 no --save-masks no --stop",
    )


def parsed(*words: str, wanted: tuple[str, ...] = ()) -> RunOptions:
    parser = argparse.ArgumentParser()
    add_options(parser, *wanted)
    return RunOptions.of_arguments(parser.parse_args(words))


def test_every_field_has_its_argument():
    assert set(TYPED) == {option.name for option in fields(RunOptions)}
    assert parsed() == RunOptions()


@pytest.mark.parametrize("name", TYPED)
def test_what_is_typed_is_the_fields_value_and_comes_back_from_a_record(name):
    words, value = TYPED[name]
    options = parsed(*words)
    assert options.as_dict() == RunOptions().as_dict() | {name: value}
    assert RunOptions(**options.as_dict()).as_dict() == options.as_dict()


def test_a_command_takes_some_of_them():
    assert parsed("--seed", "2", wanted=("seed",)) == RunOptions(seed=2)
    with pytest.raises(SystemExit):
        parsed("--tracker", "lk", wanted=("seed",))


@pytest.mark.parametrize("words", [["--set", "points"], ["--models", "mug="]])
def test_what_is_no_pair_is_refused(words):
    with pytest.raises(BadInput, match=rf"{words[0]}: got '{words[1]}'"):
        parsed(*words)


def test_spaces_around_what_is_typed_are_not_meant():
    assert pairs(["tsdf.voxel_m = 0.01", " a=b c "], "--set", "") == {"tsdf.voxel_m": "0.01", "a": "b c"}
    assert names("mug, tin can ,") == ("mug", "tin can")


def test_later_wins_over_earlier_in_the_configuration(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('preset = "paper"\nseed = 4\n[sampling]\npoints = 17\nr_min_px = 3.0\n')
    options = RunOptions(config_file=file, settings={"sampling.points": "18"}, seed=5)
    expected = preset("paper", seed=5).with_values({"sampling.points": 18, "sampling.r_min_px": 3.0})
    assert options.config() == expected
    assert RunOptions(preset="default", config_file=file).config().preset == "default"
    assert RunOptions(config_file=file).config().seed == 4


def test_paths_are_kept_so_that_they_mean_the_same_from_anywhere(tmp_path, monkeypatch):
    """Names that are no paths stay: of parts, of sources of masks, of a folder of masks inside the sequence."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "video/mine").mkdir(parents=True)
    (tmp_path / "a=b").mkdir()
    asked = RunOptions(memory=["mug=maps/mug.npz", "a=b", "maps"], models={"mug": "m.obj"}, config_file=Path("c.toml"))
    kept = located(replace(asked, masks="mine", prompts="p.json").as_dict(), "video")
    assert kept["memory"] == [f"mug={tmp_path}/maps/mug.npz", f"{tmp_path}/a=b", f"{tmp_path}/maps"]
    assert (kept["models"], kept["config_file"]) == ({"mug": f"{tmp_path}/m.obj"}, f"{tmp_path}/c.toml")
    assert (kept["masks"], kept["prompts"]) == ("mine", f"{tmp_path}/p.json")
    assert located(kept, "video") == kept
    for masks, whole in (("other", f"{tmp_path}/other"), ("builtin", "builtin"), ("first", "first"), (None, None)):
        assert located(replace(asked, masks=masks).as_dict(), "video")["masks"] == whole
    assert located(RunOptions(tracker="mine:Tracker").as_dict(), None) == RunOptions(tracker="mine:Tracker").as_dict()
