"""Fetching from a server of our own: resume, checksums kept from the first time, unpacking, verifying, describing."""

import hashlib
import io
import json
import re
import tarfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from p2p_lib.apps.cli import main
from p2p_lib.core import paths
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets import inventory, manifests

N, W, H = 3, 32, 24
K = "40 0 16\n0 40 12\n0 0 1\n"


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


def archive(extra=()):
    """One sequence with two objects' worth of nothing but pictures, as a .tar.gz."""
    files = {"one/cam_K.txt": K.encode(), "one/noise.bin": np.random.default_rng(0).bytes(300_000), **dict(extra)}
    for i in range(N):
        files[f"one/rgb/{i:04d}.png"] = png(np.full((H, W, 3), i, np.uint8))
        files[f"one/depth/{i:04d}.png"] = png(np.full((H, W), 700, np.uint16))
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return out.getvalue()


class Server:
    """Serves ``data`` at any path, with ranges; ``breaks_at`` cuts the next answer short."""

    def __init__(self):
        self.data, self.etag, self.breaks_at, self.ranges, self.asked = archive(), '"one"', None, True, []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                outer.answer(self)

            def log_message(self, *_):
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.http.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}/one.tar.gz"

    def answer(self, request):
        wanted = request.headers.get("Range")
        self.asked.append(wanted)
        start = 0
        if wanted and self.ranges and request.headers.get("If-Range") == self.etag:
            start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1])
        body = self.data[start:]
        request.send_response(206 if start else 200)
        request.send_header("Content-Length", str(len(body)))
        if self.etag:
            request.send_header("ETag", self.etag)
        request.end_headers()
        cut, self.breaks_at = self.breaks_at, None
        request.wfile.write(body[:cut])
        if cut is not None:
            request.wfile.flush()
            request.connection.close()


@pytest.fixture
def server():
    made = Server()
    yield made
    made.http.shutdown()
    made.http.server_close()


@pytest.fixture
def tiny(tmp_path, monkeypatch, server):
    """Writes the manifest ``tiny`` with changes to its one file, and says where data live."""
    folder = tmp_path / "data_manifests"
    (folder / "checkpoints").mkdir(parents=True)
    monkeypatch.setattr(paths, "manifest_dir", lambda: folder)
    monkeypatch.setenv("P2P_DATA", str(tmp_path / "data"))

    def write(access="open", **changes):
        file = {"path": "archives/one.tar.gz", "url": server.url, "bytes": None, "sha256": None, "unpack_to": "."}
        file |= {"unknown": "nobody knows", **changes}
        made = {"kind": "dataset", "name": "tiny", "title": "Tiny", "version": "1", "licence": "Any use."}
        made |= {"page": "https://example.org", "access": access, "how_to_get": "Ask.", "folder": "tiny"}
        made |= {"files": [file], "units": {"depth": "mm"}, "layout": ["x"], "citation": "Nobody.", "format": "folder"}
        made["sequences"] = [{"name": "one", "frames": N}]
        (folder / "tiny.json").write_text(json.dumps(made))
        manifests.read_manifest.cache_clear()
        return manifests.manifest("tiny")

    yield write
    manifests.read_manifest.cache_clear()


def fetch(of, **options):
    return list(inventory.fetch(of, progress=False, **options))


def test_fetched_recorded_unpacked_and_verified(tiny, server, tmp_path):
    of = tiny()
    [line] = fetch(of)
    assert "what came, and is checked from now on, 8 files unpacked" in line
    record = json.loads((tmp_path / "data/tiny/.p2p-tiny.json").read_text())["files"]["archives/one.tar.gz"]
    assert record["sha256"] == hashlib.sha256(server.data).hexdigest() and record["bytes"] == len(server.data)
    checks = list(inventory.verify(of, every_frame=True))
    assert [(c.name, c.fine, c.text) for c in checks] == [
        ("archives/one.tar.gz", True, "sha256 as expected"),
        ("one", True, "3 frames, truth none"),
    ]
    assert "checked" in fetch(of)[0] and len(server.asked) == 1  # nothing is fetched twice
    (tmp_path / "data/tiny/archives/one.tar.gz").unlink()
    assert fetch(of) == ["archives/one.tar.gz: unpacked already"] and len(server.asked) == 1


def test_a_download_that_breaks_off_is_resumed(tiny, server):
    of = tiny()
    server.breaks_at = 100_000
    with pytest.raises(MissingData, match=r"one\.tar\.gz: cannot be fetched .*it goes on where it stopped"):
        fetch(of)
    assert fetch(of)
    assert server.asked == [None, "bytes=65536-"]
    assert all(check.fine for check in inventory.verify(of))


@pytest.mark.parametrize("change", ["another version", "no ranges", "no mark"])
def test_halves_of_different_files_are_not_put_together(tiny, server, change):
    of = tiny()
    server.etag = None if change == "no mark" else server.etag
    server.breaks_at = 100_000
    with pytest.raises(MissingData):
        fetch(of)
    if change == "another version":
        server.data, server.etag = archive([("one/new.txt", b"new")]), '"two"'
    server.ranges = change != "no ranges"
    assert fetch(of)
    assert all(check.fine for check in inventory.verify(of))
    assert server.asked[1] is None if change == "no mark" else server.asked[1] == "bytes=65536-"


def test_a_wrong_checksum_or_size_is_refused_and_not_kept(tiny, server, tmp_path):
    place = tmp_path / "data/tiny/archives"
    with pytest.raises(BadInput, match=r"one\.tar\.gz: got .*expected sha256 0000.*It was not kept"):
        fetch(tiny(sha256="0" * 64))
    with pytest.raises(
        BadInput, match=rf"one\.tar\.gz: got {len(server.data)} bytes, expected 17, as the manifest says"
    ):
        fetch(tiny(bytes=17))
    assert list(place.iterdir()) == [] and not (tmp_path / "data/tiny/one").exists()
    assert fetch(tiny(sha256=hashlib.sha256(server.data).hexdigest(), bytes=len(server.data)))


def test_the_recorded_checksum_holds_from_then_on(tiny, server, tmp_path):
    of = tiny()
    fetch(of)
    (tmp_path / "data/tiny/archives/one.tar.gz").unlink()
    (tmp_path / "data/tiny/.p2p-tiny.json").write_text(
        (tmp_path / "data/tiny/.p2p-tiny.json").read_text().replace("unpacked", "was_unpacked")
    )
    server.data = archive([("one/other.txt", b"other")])
    with pytest.raises(BadInput, match="the publisher has changed the file"):
        fetch(of)


def test_damage_on_disk_is_found(tiny, tmp_path):
    of = tiny()
    fetch(of)
    at = tmp_path / "data/tiny/archives/one.tar.gz"
    whole = at.read_bytes()
    at.write_bytes(whole[:-1] + b"\1")
    assert [c.fine for c in inventory.verify(of)] == [False, True]
    assert "checked" in fetch(of)[0] and at.read_bytes() == whole  # mended
    at.unlink()
    (tmp_path / "data/tiny/one/noise.bin").unlink()
    (tmp_path / "data/tiny/one/depth/0001.png").unlink()
    checks = {c.name: c for c in inventory.verify(of)}
    assert checks["archives/one.tar.gz"].text.startswith("2 unpacked files are missing or changed, one/noise.bin first")
    assert not checks["one"].fine and "depth: got 2 files, expected 3" in checks["one"].text
    (tmp_path / "data/tiny/one/rgb/0001.png").unlink()
    assert "2 frames, truth none, expected 3 frames" in [c.text for c in inventory.verify(of)]


def test_what_must_be_had_by_hand(tiny, server, tmp_path):
    of = tiny(access="by hand", url=None)
    with pytest.raises(
        MissingData, match=r"tiny: archives/one\.tar\.gz must be had by hand and put into .*Ask\. Page: https"
    ):
        fetch(of)
    place = tmp_path / "data/tiny/archives"
    place.mkdir(parents=True)
    (place / "one.tar.gz").write_bytes(server.data)
    assert "what came, and is checked from now on, 8 files unpacked" in fetch(of)[0] and server.asked == []
    (place / "one.tar.gz").write_bytes(server.data[:-9])
    with pytest.raises(BadInput, match=r"one\.tar\.gz: got sha256 .*, expected sha256 "):
        fetch(of)


def test_an_attacking_archive_stays_inside(tiny, server, tmp_path):
    server.data = archive([("../../evil", b"evil")])
    with pytest.raises(BadInput, match=r"one\.tar\.gz: got '\.\./\.\./evil', a path that leaves the folder"):
        fetch(tiny())
    assert not list(tmp_path.rglob("evil"))


def test_the_datasets_own_list_of_checksums(tiny, tmp_path):
    of = tiny()
    fetch(of)
    root = tmp_path / "data/tiny"
    digest = hashlib.sha256((root / "one/cam_K.txt").read_bytes()).hexdigest()
    files = [{"path": "one/cam_K.txt", "sha256": digest.upper()}, {"path": "two.zip", "sha256": "0" * 64}]
    (root / "sequences.json").write_text(json.dumps({"sequences": [{"name": "one", "files": files}]}))
    check = {c.name: c for c in inventory.verify(of)}["sequences.json"]
    assert check.fine and check.text == "1 of the 2 files it lists are here"
    (root / "one/cam_K.txt").write_text(K + "\n")
    check = {c.name: c for c in inventory.verify(of)}["sequences.json"]
    assert not check.fine and check.text.endswith("wrong: one/cam_K.txt")


def test_the_commands(tiny, server, tmp_path, capsys, monkeypatch):
    tiny()

    def p2p(*words):
        code = main(["data", *words])
        return code, *capsys.readouterr()

    code, out, _ = p2p("list")
    assert code == 0 and re.search(r"tiny +dataset +no +open +Tiny", out) and server.asked == []
    code, out, _ = p2p("info", "tiny")
    assert code == 0 and "licence   Any use." in out and "one, 3 frames" in out and server.asked == []
    code, _, err = p2p("where", "tiny")
    assert code == 2 and err.startswith("p2p data where: tiny: not there, expected in ")
    code, out, _ = p2p("verify", "tiny")
    assert code == 2 and out.startswith("WRONG") and server.asked == []
    code, _, err = p2p("fetch", "tiny", "--only", "two", "--quiet")
    assert code == 2 and "--only: got two, expected part of one of archives/one.tar.gz" in err and server.asked == []
    code, out, _ = p2p("fetch", "tiny", "--only", "one", "--quiet")
    assert code == 0 and "8 files unpacked" in out
    assert p2p("verify", "tiny")[0] == 0
    assert p2p("where", "tiny") == (0, f"{tmp_path / 'data/tiny'}\n", "")
    assert p2p("where", "one") == (0, f"{tmp_path / 'data/tiny/one'}\n", "")
    assert re.search(r"tiny +dataset +yes", p2p("list")[1])
    code, _, err = p2p("info", "tony")
    assert code == 2 and "got 'tony', expected one of tiny" in err
    monkeypatch.delenv("P2P_DATA")
    code, _, err = p2p("fetch", "tiny")
    assert code == 2 and "export P2P_DATA=DIR" in err
    assert "$P2P_DATA is not set" in p2p("list")[1]


@pytest.mark.parametrize("kind", ["file", "folder", "archive"])
def test_files_that_one_has_are_taken_checked_and_nothing_is_asked(tiny, server, tmp_path, kind):
    """A file by its name, a folder or an archive that holds it somewhere: the same as if it had been downloaded."""
    own = tmp_path / "own"
    path = own / "package" / "dist" / "one.tar.gz"
    path.parent.mkdir(parents=True)
    path.write_bytes(server.data)
    source = {"file": path, "folder": own, "archive": own / "pack.tgz"}[kind]
    if kind == "archive":
        with tarfile.open(source, "w:gz") as tar:
            tar.add(path, "package/dist/one.tar.gz")
        path.unlink()
    [line] = fetch(tiny(), source=source)
    assert "8 files unpacked" in line and not server.asked
    assert (tmp_path / "data/tiny/archives/one.tar.gz").read_bytes() == server.data


def test_what_is_not_the_file_that_is_meant_is_not_taken(tiny, server, tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    (own / "one.tar.gz").write_bytes(b"something else")
    known = tiny(sha256=hashlib.sha256(server.data).hexdigest())
    with pytest.raises(BadInput, match=r"expected sha256 \w+. It was not taken"):
        fetch(known, source=own)
    (own / "one.tar.gz").unlink()
    with pytest.raises(MissingData, match=r"no file one.tar.gz in it"):
        fetch(known, source=own)
    assert not list((tmp_path / "data/tiny").rglob("*.gz"))
