"""Parameters: documented, bounded, read from files and words, written back, and who they come from."""

import dataclasses
import re
import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2p_lib.core import config
from p2p_lib.core.config import Config, diff, from_toml, parameters, preset
from p2p_lib.core.errors import BadInput, MissingData

STAGES = [f.name for f in dataclasses.fields(Config) if dataclasses.is_dataclass(f.default)]
FIELDS = {f"{s}.{f.name}": f for s in STAGES for f in dataclasses.fields(getattr(Config(), s))}
EVERY_FIELD = pytest.mark.parametrize("key", FIELDS)
PRESETS = pytest.mark.parametrize("name", ["default", "paper"])
UNITS = {
    "", "1/m", "deg", "frames", "grey levels", "m", "points", "px", "rad", "squared standard deviations", "voxels",
}  # fmt: skip


def value_of(cfg: Config, key: str):
    stage, name = key.split(".")
    return getattr(getattr(cfg, stage), name)


# --- every field says what it is ---------------------------------------------------------------


@EVERY_FIELD
def test_metadata_is_complete(key):
    f, meta = FIELDS[key], FIELDS[key].metadata
    assert set(meta) <= {"meaning", "unit", "source", "low", "high", "choices", "form"}
    assert re.fullmatch(r"[A-Z].{15,}[^ ]\.", meta["meaning"]), "a whole sentence"
    assert not re.search(r"seed|AUC|measured", meta["meaning"]), "what a value is worth stands in benchmarks/"
    assert meta["source"] in ("paper", "release", "ours")
    assert meta["unit"] in UNITS
    assert type(f.default) in (bool, int, float, str)
    if type(f.default) in (int, float):
        assert "low" in meta or "high" in meta, "a number without bounds lets any slip of the keyboard through"
        assert meta.get("low", -1e300) <= f.default <= meta.get("high", 1e300)


@EVERY_FIELD
def test_a_unit_in_the_name_is_the_unit(key):
    for suffix, unit in {"_m": "m", "_px": "px", "_deg": "deg", "_rad": "rad", "_voxels": "voxels"}.items():
        if key.endswith(suffix) and key != "tsdf.max_voxels":
            assert FIELDS[key].metadata["unit"] == unit


@PRESETS
@EVERY_FIELD
def test_presets_choose_parameters_never_backends(key, name):
    """A backend is a name: the only words a preset holds are choices of the method's own."""
    value = value_of(preset(name), key)
    if isinstance(value, str):
        assert value in FIELDS[key].metadata.get("choices", ("all", "none"))
    assert key.split(".")[1] not in ("tracker", "detector", "segmenter", "masks", "backend", "device")


#: What the paper's text says (main text and appendix).
PAPER_TEXT = {
    "method.object_frame": "camera",
    "method.mechanisms": "none",
    "method.surface": True,
    "method.graph": True,
    "keypoint_map.keyframe_angle_deg": 10.0,
    "keypoint_map.keyframe_min_points": 25,
    "keypoint_map.cooldown": 0,
    "keypoint_map.streak": 3,
    "keypoint_map.max_uncertainty": 0.3,
    "keypoint_map.max_scatter_m": 0.008,
    "keypoint_map.max_points": 0,
    "registration.method": "sequential_ransac",
    "selection.rule": "surface",
    "refinement.residuals": "surface",
    "factor_graph.prior": True,
    "factor_graph.between": True,
    "factor_graph.observations": True,
}
#: Where the text is silent: the authors' released configuration.
RELEASE = {
    "lifecycle.min_mask_px": 100,
    "depth.min_m": 0.1,
    "depth.max_m": 2.0,
    "depth.edge_m": 0.01,
    "sampling.candidates": 512,
    "sampling.points": 30,
    "sampling.score_weight": 0.3,
    "sampling.cluster_weight": 0.5,
    "sampling.r_min_px": 5.0,
    "keypoint_map.pending_ttl": 30,
    "registration.iterations": 100,
    "registration.sample_size": 4,
    "registration.inlier_m": 0.006,
    "registration.min_inliers": 5,
    "registration.max_hypotheses": 10,
    "registration.max_uncertainty": 0.3,
    "tsdf.max_voxels": 20_000_000,
    "tsdf.voxel_m": 0.005,
    "tsdf.truncation_voxels": 5.0,
    "refinement.iterations": 8,
    "refinement.max_points": 1500,
    "refinement.huber_m": 0.01,
    "factor_graph.huber": 1.345,
    "factor_graph.bearing_sigma_rad": 0.01,
    "factor_graph.range_sigma_m": 0.01,
    "factor_graph.iterations": 20,
}


@pytest.mark.parametrize(("key", "value"), (PAPER_TEXT | RELEASE).items())
def test_the_paper_preset_is_the_papers(key, value):
    assert value_of(preset("paper"), key) == value


@EVERY_FIELD
def test_what_is_said_to_be_the_papers_or_the_releases_is(key):
    source, default = FIELDS[key].metadata["source"], value_of(preset("default"), key)
    if source == "paper":
        assert default == PAPER_TEXT.get(key, default) == value_of(preset("paper"), key)
    if source == "release":
        assert default == RELEASE.get(key, default)
        # The paper's text outweighs the release; nothing else may replace its value.
        assert default == value_of(preset("paper"), key) or key in PAPER_TEXT


# --- presets and their difference --------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "key", "source"),
    [
        ("paper", "tsdf.voxel_m", "release"),
        ("paper", "method.mechanisms", "paper"),
        ("paper", "tsdf.truncation_voxels", "release"),
        ("paper", "sampling.r_ideal_px", "ours"),
        ("paper", "method.noise", "ours"),
        ("default", "tsdf.voxel_m", "ours"),
    ],
)
def test_each_value_says_whose_it_is(name, key, source):
    (row,) = parameters(preset(name), key)
    assert row["source"] == source
    changed = preset(name).with_values({"tsdf.voxel_m": 0.004})
    assert parameters(changed, "tsdf.voxel_m")[0]["source"] == "ours"


def test_default_is_the_dataclasses_own():
    assert preset() == preset("default") == Config()
    assert preset("paper").preset == "paper" and preset("paper", seed=7).seed == 7


def test_diff_is_the_difference():
    paper, default = preset("paper"), preset("default")
    expected = {
        key: (value_of(paper, key), value_of(default, key))
        for key in FIELDS
        if value_of(paper, key) != value_of(default, key)
    }
    assert diff() == diff("paper", "default") == expected
    assert diff("default", "paper") == {k: (b, a) for k, (a, b) in expected.items()}
    assert diff("paper", "paper") == {}
    # And it is all the difference there is.
    assert dataclasses.replace(default.with_values({k: a for k, (a, _) in diff().items()}), preset="paper") == paper


def test_nothing_is_replaced_by_itself():
    assert set(config._PRESETS["paper"]) == set(diff())


def test_unknown_presets_are_refused():
    with pytest.raises(BadInput, match=r"preset: got 'papr', expected one of default, paper. Did you mean paper\?"):
        preset("papr")


def test_a_stage_may_be_a_table_of_its_keys_and_is_checked():
    assert Config(tsdf={"carve": False}, seed="3") == Config().with_values({"tsdf.carve": False, "seed": 3})
    for wrong, words in [
        ({"tsdf": {"carv": 1}}, r"key: got 'tsdf.carv', .*Did you mean tsdf.carve\?"),
        ({"tsdf": {"carve": 1}}, "config tsdf.carve: got 1 .*true or false"),
        ({"tsdf": config.DepthConfig()}, "config tsdf: got DepthConfig.*, expected a TsdfConfig, or a table"),
        ({"device": "tpu"}, "config device: got 'tpu'"),
        ({"preset": "papr"}, r"preset: got 'papr', .*Did you mean paper\?"),
    ]:
        with pytest.raises(BadInput, match=words):
            Config(**wrong)


# --- bounds and types --------------------------------------------------------------------------


def outside(f: dataclasses.Field) -> list:
    meta = f.metadata
    numbers = [meta[k] + step for k, step in (("low", -1), ("high", 1)) if k in meta]
    return [type(f.default)(n) for n in numbers] if type(f.default) in (int, float) else []


@EVERY_FIELD
def test_values_out_of_bounds_are_refused_and_named(key):
    f = FIELDS[key]
    for value in [*outside(f), *([float("nan")] if type(f.default) is float else [])]:
        with pytest.raises(BadInput, match=rf"^config {key}: got {value}, expected a value in ") as caught:
            Config().with_values({key: value})
        assert f.metadata["meaning"] in str(caught.value)


@EVERY_FIELD
def test_bounds_themselves_are_inside(key):
    f = FIELDS[key]
    for name in ("low", "high"):
        if name in f.metadata:
            value = type(f.default)(f.metadata[name])
            assert value_of(Config().with_values({key: value}), key) == value
    for value in f.metadata.get("choices", ()):
        assert value_of(Config().with_values({key: value}), key) == value


@EVERY_FIELD
def test_values_of_another_kind_are_refused_and_named(key):
    wrong = {bool: [1, "maybe", None], int: [1.5, True, "x", None, [1]], float: [True, "x", None, [1.0]], str: ["?", 3]}
    for value in wrong[type(FIELDS[key].default)]:
        with pytest.raises(BadInput, match=f"^config {key}: got ") as caught:
            Config().with_values({key: value})
        assert "\n" not in str(caught.value)


def test_a_whole_number_is_a_real_number_too():
    assert Config().with_values({"registration.inlier_m": 1}).registration.inlier_m == 1.0
    assert isinstance(Config().with_values({"registration.inlier_m": 1}).registration.inlier_m, float)


def test_stages_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset().sampling.points = 3
    assert Config().with_values({"sampling.points": 3}).sampling.points == 3 and Config().sampling.points != 3


# --- values as words ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "words", "value"),
    [
        ("sampling.points", "12", 12),
        ("sampling.points", " 12 ", 12),
        ("sampling.score_weight", "1", 1.0),
        ("sampling.score_weight", "0.25", 0.25),
        ("sampling.score_weight", ".25", 0.25),
        ("registration.inlier_m", "4e-3", 0.004),
        ("refinement.huber_m", "1E-5", 1e-5),
        ("method.graph", "false", False),
        ("method.graph", "False", False),
        ("method.surface", "TRUE", True),
        ("tsdf.max_voxels", "1_000_000", 1_000_000),
        ("method.object_frame", "camera", "camera"),
        ("method.object_frame", '"camera"', "camera"),
    ],
)
def test_words_are_read_as_values(key, words, value):
    got = value_of(Config().with_values({key: words}), key)
    assert got == value and type(got) is type(value)


@pytest.mark.parametrize("words", ["", "many", "3,", "3 4", "[3]", "0.5", "nan", "1e3", "true"])
def test_unreadable_words_are_refused(words):
    with pytest.raises(
        BadInput, match=r"config sampling.points: got .*expected a whole number: At a keyframe K points"
    ):
        Config().with_values({"sampling.points": words})


@EVERY_FIELD
@PRESETS
def test_every_value_survives_as_a_word(key, name):
    value = value_of(preset(name), key)
    assert value_of(Config().with_values({key: str(value)}), key) == value


@pytest.mark.parametrize(
    ("key", "near"),
    [
        ("sampling.pionts", "sampling.points"),
        ("samplng.points", "sampling.points"),
        ("keypoint_map.maxpoints", "keypoint_map.max_points"),
        ("registration.inlier", "registration.inlier_m"),
        ("Seed", "seed"),
        ("TSDF.CARVE", "tsdf.carve"),
    ],
)
def test_unknown_keys_name_the_nearest(key, near):
    with pytest.raises(BadInput, match=rf"^--set: configuration key: got '{key}'.*Did you mean {near}\?"):
        Config().with_values({key: 1}, source="--set")


@pytest.mark.parametrize("key", ["", "sampling", "sampling.", ".points", "zzz", "preset", "a.b.c"])
def test_other_unknown_keys_are_refused_too(key):
    with pytest.raises(BadInput, match=r"^configuration key: got "):
        Config().with_values({key: 1})


def test_every_key_is_known():
    for key in FIELDS:
        assert Config().with_values({key: value_of(Config(), key)}) == Config()


@pytest.mark.parametrize("value", [5, "5", " 5 "])
def test_seed(value):
    assert Config().with_values({"seed": value}).seed == 5
    assert preset("paper", seed=value).seed == 5


@pytest.mark.parametrize("value", ["x", 1.5, "1.0", True, None, -1, "-3"])
def test_a_seed_is_a_whole_number_from_zero(value):
    for make in (lambda: Config().with_values({"seed": value}), lambda: preset(seed=value)):
        with pytest.raises(BadInput, match=r"config seed: got .*expected a whole number"):
            make()


# --- files -------------------------------------------------------------------------------------


def value_strategy(key: str) -> st.SearchStrategy:
    f = FIELDS[key]
    low, high = f.metadata.get("low"), f.metadata.get("high")
    match f.default:
        case bool():
            return st.booleans()
        case int():
            return st.integers(low, high if high is not None else 10**9)
        case float():
            return st.floats(low, high, allow_nan=False)
        case _:
            return st.sampled_from(f.metadata.get("choices", ("all", "none", "all but scale", "scale, outline")))


changes = st.dictionaries(st.sampled_from(sorted(FIELDS)), st.none()).flatmap(
    lambda keys: st.fixed_dictionaries({k: value_strategy(k) for k in keys})
)


@settings(max_examples=50)
@given(name=st.sampled_from(["default", "paper"]), seed=st.integers(0, 2**63), values=changes)
def test_toml_round_trip(tmp_path_factory, name, seed, values):
    cfg = preset(name, seed).with_values(values)
    path = tmp_path_factory.getbasetemp() / "config.toml"
    path.write_text(cfg.to_toml())
    assert from_toml(path) == cfg
    assert tomllib.loads(cfg.to_toml()) == cfg.as_dict()


def written(tmp_path, text: str):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    path = written(tmp_path, "[sampling]\npoints = 12\n[method]\nsurface = false\n")
    expected = {"sampling.points": 12, "method.surface": False}
    assert from_toml(path) == Config().with_values(expected)
    assert from_toml(path, preset("paper", 3)) == preset("paper", 3).with_values(expected)
    assert from_toml(written(tmp_path, "")) == Config()
    assert from_toml(written(tmp_path, 'preset = "paper"\nseed = 4')) == preset("paper", 4)
    assert from_toml(written(tmp_path, "sampling.points = 12\nmethod.surface = false")) == Config().with_values(
        expected
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[sampling]\npionts = 3", "configuration key: got 'sampling.pionts'.*Did you mean sampling.points\\?"),
        ("[samplng]\npoints = 3", "configuration key: got 'samplng.points'.*Did you mean sampling.points\\?"),
        ("[samplng]", "configuration key: got 'samplng'"),
        ("points = 3", "configuration key: got 'points'"),
        ("sampling = 3", "configuration key: got 'sampling'"),
        ("[sampling.points]\nx = 3", "config sampling.points: got .*dict"),
        ("[sampling]\npoints = -3", "config sampling.points: got -3, expected a value in 1 to inf points"),
        ("[sampling]\npoints = '3x'", "config sampling.points: got '3x'"),
        ("[[sampling]]\npoints = 3", "configuration key: got 'sampling'"),
        ("[sampling\npoints = 3", "unreadable TOML"),
        ('preset = "best"', "preset: got 'best', expected one of default, paper"),
        ("preset = 3", "preset: got '?3"),
        ("[preset]\nname = 'paper'", "preset: got"),
        ("preset = ['paper']", "preset: got"),
        ("seed = 'x'", "config seed: got 'x'"),
        ("[seed]\nx = 1", "configuration key: got 'seed.x'"),
        ("[sampling]\npoints = 1979-05-27", "config sampling.points: got .*date"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, text, words):
    with pytest.raises(BadInput, match=words) as caught:
        from_toml(written(tmp_path, text))
    assert "\n" not in str(caught.value)
    if "key" in words or "TOML" in words:
        assert str(tmp_path / "mine.toml") in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(MissingData, match=r"none\.toml: no such file, expected TOML.*--config"):
        from_toml(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInput, match=r"binary\.toml: got unreadable TOML"):
        from_toml(tmp_path / "binary.toml")
    with pytest.raises(MissingData, match="cannot be read"):
        from_toml(tmp_path)


def test_a_key_given_for_a_stage_names_its_stage():
    with pytest.raises(BadInput, match=r"Did you mean method\?"):
        config.parameters(preset(), "mechanisms")
    assert [row["key"] for row in config.parameters(preset(), "method.mechanisms")] == ["method.mechanisms"]
    with pytest.raises(BadInput, match=r"key: got 'method.mechanism', .*Did you mean method.mechanisms\?"):
        config.parameters(preset(), "method.mechanism")
