"""Manifests: every file keeps the schema, the schema refuses what would mislead, sequences are found by name."""

import json

import pytest

from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets import manifests
from p2p_lib.datasets.sequence import FORMATS

FILE = {"path": "archives/a.zip", "url": "https://example.org/a.zip", "bytes": 10, "sha256": "0" * 64, "unpack_to": "."}
GOOD = {
    "kind": "dataset",
    "name": "tiny",
    "title": "Tiny",
    "version": "1",
    "licence": "Any use.",
    "page": "https://example.org",
    "access": "open",
    "how_to_get": "Nothing to know.",
    "folder": "tiny",
    "files": [FILE],
    "units": {"depth": "millimetres"},
    "layout": ["<sequence>/rgb/"],
    "citation": "Nobody: Nothing.",
    "format": "folder",
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A manifest folder of our own, with one good manifest, and a place for data."""
    where = tmp_path / "data_manifests"
    (where / "checkpoints").mkdir(parents=True)
    monkeypatch.setattr(paths, "manifest_dir", lambda: where)
    monkeypatch.setenv("P2P_DATA", str(tmp_path / "data"))
    write(where / "tiny.json", {})
    return where


def write(path, changes):
    manifests.read_manifest.cache_clear()
    path.write_text(json.dumps({k: v for k, v in (GOOD | changes).items() if v is not ...}))


@pytest.mark.parametrize("name", manifests.names())
def test_every_manifest_keeps_the_schema(name):
    read = manifests.manifest(name)
    assert read.name == name
    assert read.format is None or read.format in FORMATS or read.format in ("ho3d", "bop")
    assert read.licence.endswith(".") and read.how_to_get.endswith(".")


def test_the_papers_datasets_are_all_there():
    expected = {"ho3d_v3", "ycbineoat", "ycbmultitrack_real", "ycbmultitrack_synthetic"}
    assert expected <= set(manifests.names("dataset"))
    assert not set(manifests.names("dataset")) & set(manifests.names("checkpoint"))
    assert "paper_reported" not in manifests.names()
    ho3d, eoat = manifests.manifest("ho3d_v3"), manifests.manifest("ycbineoat")
    assert len(ho3d.sequences) == 13 and len(eoat.sequences) == 9
    assert sum(s.frames for s in eoat.sequences) == 7449  # what its paper counts


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"licence": ...}, r"tiny\.json: got licence: missing"),
        ({"licence": ""}, r"licence: '', where some text should be"),
        ({"colour": "red"}, r"colour: a key unknown there"),
        ({"name": "huge"}, r"got the dataset 'huge', expected the dataset 'tiny'"),
        ({"kind": "checkpoint", "used_by": "--tracker x"}, r"got the checkpoint 'tiny', expected the dataset"),
        ({"kind": "checkpoint"}, r"'used_by' must name the option"),
        ({"page": "example.org"}, r"page: 'example\.org', where text of the form"),
        ({"folder": "../tiny"}, r"folder: '\.\./tiny' must be a relative path that stays inside"),
        ({"folder": "/tiny"}, r"must be a relative path"),
        ({"files": []}, r"'files_unknown' must say why"),
        ({"files": [FILE | {"url": None}]}, r"access is 'open', so every file needs a url"),
        ({"files": [FILE | {"sha256": None}]}, r"bytes or sha256 is null, so 'unknown' must say why"),
        ({"files": [FILE | {"bytes": None}]}, r"bytes or sha256 is null"),
        ({"files": [FILE | {"sha256": "0" * 63}]}, r"files\.0\.sha256: '0+\.\.\., where text of the form"),
        ({"files": [FILE | {"bytes": "10"}]}, r"files\.0\.bytes: '10', where a whole number should be"),
        ({"files": [FILE | {"path": "a/../../b"}]}, r"files\.0\.path: .*stays inside"),
        ({"files": [FILE | {"unpack_to": "/"}]}, r"files\.0\.unpack_to: .*stays inside"),
        ({"files": [FILE, FILE]}, r"a path is listed twice"),
        ({"sequences": [{"name": "a"}, {"name": "a"}]}, r"a sequence is listed twice"),
    ],
)
def test_what_would_mislead_is_refused(folder, changes, expected):
    write(folder / "tiny.json", changes)
    with pytest.raises(BadInput, match=expected):
        manifests.manifest("tiny")


def test_unknown_checksums_need_a_reason_only(folder):
    write(folder / "tiny.json", {"files": [FILE | {"sha256": None, "bytes": None, "unknown": "not listed"}]})
    assert manifests.manifest("tiny").files[0].unknown == "not listed"


def test_broken_json_names_the_file(folder):
    (folder / "tiny.json").write_text("{")
    manifests.read_manifest.cache_clear()
    with pytest.raises(BadInput, match=r"tiny\.json: got unreadable JSON"):
        manifests.manifest("tiny")


def test_checkpoints_lie_apart(folder):
    write(folder / "checkpoints" / "net.json", {"name": "net", "kind": "checkpoint", "used_by": "--tracker net"})
    assert manifests.names() == ("net", "tiny")
    assert manifests.names("checkpoint") == ("net",)
    assert manifests.manifest("net").used_by == "--tracker net"
    with pytest.raises(BadInput, match="expected one of net, tiny"):
        manifests.manifest("nat")


def test_sequences_are_found_by_name_below_the_data_folder(folder, tmp_path, monkeypatch):
    write(folder / "other.json", {"name": "other", "folder": "other", "sequences_in": "evaluation"})
    (tmp_path / "data" / "tiny" / "one").mkdir(parents=True)
    (tmp_path / "data" / "other" / "evaluation" / "two").mkdir(parents=True)
    assert manifests.find_sequence("one")[0] == tmp_path / "data" / "tiny" / "one"
    assert manifests.find_sequence("two")[1].name == "other"
    assert manifests.find_sequence("other/two")[0].name == "two"
    for nothing in ("three", "tiny/two", "", "..", "tiny/", "other/../two"):
        assert manifests.find_sequence(nothing) is None
    (tmp_path / "data" / "tiny" / "two").mkdir()
    with pytest.raises(BadInput, match="expected one of other/two, tiny/two"):
        manifests.find_sequence("two")
    assert manifests.find_sequence("tiny/two")[0] == tmp_path / "data" / "tiny" / "two"
    monkeypatch.delenv("P2P_DATA")
    assert manifests.find_sequence("one") is None
    with pytest.raises(MissingData, match=r"tiny: no folder for datasets, \$P2P_DATA is not set\. Say where"):
        manifests.folder_of(manifests.manifest("tiny"))


def test_without_manifests_it_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "manifest_dir", lambda: tmp_path / "none")
    with pytest.raises(MissingData, match="expected the data manifests"):
        manifests.names()
