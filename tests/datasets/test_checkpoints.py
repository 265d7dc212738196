"""Weights from the internet: only the file that is expected, only tensors, and a remedy for whatever is missing."""

import hashlib
import json
import runpy
from importlib import import_module
from pathlib import Path

import pytest

from p2p_lib.core import packages
from p2p_lib.core.backends import TRACKERS, make_tracker
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.datasets import checkpoints
from p2p_lib.datasets.manifests import manifest, names

torch = pytest.importorskip("torch")
NAME, FILE = "tapir", "causal_bootstapir_checkpoint.pt"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Where the checkpoint is expected; nothing is there yet."""
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    folder = tmp_path / manifest(NAME).folder
    folder.mkdir(parents=True)
    return folder / FILE


def record(place, digest):
    (place.parent / f".p2p-{NAME}.json").write_text(json.dumps({"files": {FILE: {"sha256": digest, "bytes": 1}}}))


def test_manifests_of_all_models_say_what_they_must():
    assert {"tapir", "tapnextpp", "cotracker3", "superpoint"} <= set(names("checkpoint"))
    for name in ("tapir", "tapnextpp"):
        assert "Apache" in manifest(name).licence
    assert "NOT for commercial use" in manifest("cotracker3").licence
    assert "non-commercial" in manifest("superpoint").licence
    for name in names("checkpoint"):
        for file in manifest(name).files:
            assert file.url.startswith("https://") and (file.sha256 or file.unknown)


@pytest.mark.parametrize(
    ("module", "package"),
    [
        ("trackers.tapir", "tapnet"),
        ("trackers.tapnextpp", "tapnet"),
        ("trackers.cotracker", "co-tracker"),
        ("segmenters.sam2_video", "transformers"),
    ],
)
def test_every_adapter_states_the_version_that_it_was_last_run_with(module, package):
    said = " ".join(import_module(f"p2p_lib.{module}").__doc__.split())
    backends = runpy.run_path(str(Path(__file__).resolve().parents[2] / "tools" / "test_backends.py"))
    tried = backends["TRIED"][package]
    assert f"Last run with {package} {tried}." in said
    assert backends["versions"]()[package].endswith(f"; last run with {tried}")


def test_tensors_are_read_and_the_first_checksum_is_kept(place):
    torch.save({"state_dict": {"a": torch.ones(3)}}, place)
    assert checkpoints.load_weights(NAME)["a"].tolist() == [1, 1, 1]
    kept = json.loads((place.parent / f".p2p-{NAME}.json").read_text())["files"][FILE]
    assert kept["sha256"] == hashlib.sha256(place.read_bytes()).hexdigest()
    torch.save({"state_dict": {"a": torch.zeros(3)}}, place)
    with pytest.raises(BadInput, match=rf"{FILE}: got sha256 \w+, expected sha256 {kept['sha256']}. Delete it and run"):
        checkpoints.load_weights(NAME)


def test_nothing_is_unpickled_before_or_after_the_checksum(place):
    """A file that runs code when unpickled: refused for its checksum, and for what it holds where that fits."""
    import pickle

    class Trap:
        def __reduce__(self):
            return (open, (str(place.parent / "sprung"), "w"))

    place.write_bytes(pickle.dumps({"a": Trap()}, protocol=2))
    record(place, "0" * 64)
    with pytest.raises(BadInput, match="sha256"):
        checkpoints.load_weights(NAME)
    record(place, hashlib.sha256(place.read_bytes()).hexdigest())
    with pytest.raises(BadInput, match=r"got (more than tensors|an unreadable file)"):
        checkpoints.load_weights(NAME)
    torch.save({"a": Trap()}, place)
    record(place, hashlib.sha256(place.read_bytes()).hexdigest())
    with pytest.raises(BadInput, match="got more than tensors"):
        checkpoints.load_weights(NAME)
    assert not (place.parent / "sprung").exists()


@pytest.mark.parametrize(
    ("save", "says"),
    [
        (lambda path: path.write_bytes(b"<html>not found</html>"), "expected a"),
        (lambda path: path.write_bytes(b""), "an unreadable file"),
        (lambda path: torch.save({"a": 3}, path), "a dictionary of tensors"),
        (lambda path: torch.save([torch.ones(2)], path), "a dictionary of tensors"),
    ],
)
def test_other_files_are_refused_in_one_line(place, save, says):
    save(place)
    with pytest.raises(BadInput, match=says) as caught:
        checkpoints.load_weights(NAME)
    assert "\n" not in str(caught.value) and FILE in str(caught.value)


def test_weights_that_do_not_fit_are_refused():
    with pytest.raises(BadInput, match=r"checkpoint tapir: got .*Missing key.*expected the weights of Linear"):
        checkpoints.fill(torch.nn.Linear(2, 2), NAME, {"a": torch.ones(2)})


def test_an_unreadable_record_is_named(place):
    torch.save({"a": torch.ones(1)}, place)
    (place.parent / f".p2p-{NAME}.json").write_text("{")
    with pytest.raises(BadInput, match=r"\.p2p-tapir\.json: got"):
        checkpoints.load_weights(NAME)


@pytest.mark.parametrize("name", ["tapir", "tapnextpp", "cotracker3"])
def test_a_missing_checkpoint_names_the_commands(name, tmp_path, monkeypatch):
    assert name in TRACKERS
    monkeypatch.delenv("P2P_DATA", raising=False)
    with pytest.raises(MissingBackend, match=rf"{name}: .*Run: export P2P_DATA=DIR; p2p data fetch {name}$"):
        make_tracker(name, TrackingConfig())
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    with pytest.raises(MissingBackend, match=rf"{name}: its checkpoint is missing, .*Run: p2p data fetch {name}$"):
        make_tracker(name, TrackingConfig())


@pytest.mark.parametrize(
    ("module", "package", "words"),
    [
        ("no_such.tapir_model", "tapnet", ["einshape", "--no-deps 'tapnet @ git+https://github.com/google-deepmind/"]),
        ("no_such.torchvision", "torchvision", ["torchvision==", "--torch-backend=auto"]),
        ("no_such.predictor", "co-tracker", ["torch.hub.load('facebookresearch/co-tracker'", "pretrained=False"]),
        ("no_such.transformers", "transformers", ['pip install "p2p_lib[sam2-video]"']),
    ],
)
def test_a_missing_package_names_the_command(module, package, words):
    with pytest.raises(MissingBackend) as caught:
        packages.load(module, "backend", package)
    assert all(word in str(caught.value) for word in words) and "No module named 'no_such'" in str(caught.value)


def test_the_torchvision_named_is_the_one_of_our_torch():
    """torchvision 0.N belongs to torch 2.(N - 15); another one would replace the torch that Open3D is built for."""
    minor = int(packages.INSTALL["torchvision"].split("torchvision==0.")[1].split(".")[0])
    assert torch.__version__.startswith(f"2.{minor - 15}.")
