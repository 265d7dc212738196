"""Files made to do harm: each is refused in one line that names it, within bounds of time and memory."""

import io
import json
import os
import pickle
import resource
import signal
import struct
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from p2p_lib.benchmark.plan import read_plan
from p2p_lib.core import files
from p2p_lib.core.config import from_toml
from p2p_lib.core.errors import BadInput, P2PError
from p2p_lib.datasets import images
from p2p_lib.datasets.archives import unpack
from p2p_lib.datasets.exchange import _bop_rows
from p2p_lib.datasets.images import read_numbers, read_raw_depth, read_rgb
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.manifests import Manifest
from p2p_lib.datasets.models import load_mesh, load_points
from p2p_lib.datasets.pickles import load_plain
from p2p_lib.datasets.prompts import load_prompts
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.schema import read_json
from p2p_lib.datasets.ycbmultitrack import read_labels

SECONDS, MEGABYTES = 20, 400


@pytest.fixture(autouse=True)
def bounds():
    """Nothing here takes long or much: a reader that hangs is ended by an alarm."""

    def too_long(*_):
        raise AssertionError(f"longer than {SECONDS} s")

    before, kb = signal.signal(signal.SIGALRM, too_long), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - kb < 1024 * MEGABYTES


@contextmanager
def refused(path: Path, words: str = ""):
    with pytest.raises(P2PError) as error:
        yield
    said = str(error.value)
    assert path.name in said and words in said and "\n" not in said and len(said) < 700, said


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def tiff(width: int, height: int) -> bytes:
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: width * height % 2**32}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags)) + entries + bytes(4)


BOMBS = {
    "65-byte.png": png(100_000, 100_000),
    "large.png": png(30_000, 30_000),
    "bomb.tif": tiff(60_000, 60_000),
    "bomb.bmp": b"BM" + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0),
    "bomb.jpg": b"\xff\xd8\xff\xc0\x00\x0b\x08\xea\x60\xea\x60\x01\x01\x11\x00\xff\xda\x00\x08\x01\x01\x00\x00?\x00",
}


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("read", [read_rgb, read_raw_depth])
def test_images_larger_than_any_camera_makes(name, read, tmp_path):
    path = tmp_path / name
    path.write_bytes(BOMBS[name])
    assert len(BOMBS[name]) < 200
    with refused(path, "pixels"):
        read(path)


READERS = {
    "rgb": read_rgb,
    "depth": read_raw_depth,
    "numbers": lambda path: read_numbers(path, "numbers"),
    "pickle": load_plain,
    "prompts": load_prompts,
    "config.toml": from_toml,
    "plan.toml": read_plan,
    "run.json": lambda path: load_run(path.parent),
    "keypoints.npz": lambda path: load_keypoints(path.parent),
    "manifest": lambda path: read_json(path, Manifest, "a manifest"),
    "poses.csv": _bop_rows,
    **{f"model.{end}": load_points for end in ("xyz", "obj", "ply")},
    "is_mask_visible.npy": lambda path: files.read_array(path, "labels"),
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file(name, tmp_path):
    path = tmp_path / name
    os.mkfifo(path)
    with refused(path):
        READERS[name](path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with refused(path):
        READERS[name](path)
    path.unlink()
    path.touch()
    os.truncate(path, 1 << 40)  # a file with a hole as large as a disk
    with refused(path):
        READERS[name](path)
    path.unlink()
    path.mkdir()
    with refused(path):
        READERS[name](path)


def laughs(levels: int) -> bytes:
    """Ten times a list of ten times a list of ..."""
    value = ["ha"]
    for _ in range(levels):
        value = [value] * 10
    return pickle.dumps(value)


def memo(number: int) -> bytes:
    return b"\x80\x04]r" + struct.pack("<I", number) + b"."


def copies(count: int) -> bytes:
    """One text, made into bytes again and again."""
    text = b"X" + struct.pack("<I", 1 << 20) + b"a" * (1 << 20) + b"q\x00X\x06\x00\x00\x00latin1q\x01"
    return b"\x80\x02]q\x02c_codecs\nencode\nq\x03" + text + b"000(" + b"h\x03h\x00h\x01\x86R" * count + b"l."


PICKLES = {
    "laughs": laughs(9),
    "deep": b"(" * 50_000 + b"l" * 50_000 + b".",
    "deep list": b"]" + b"]" * 100_000 + b"a" * 100_000 + b".",
    "memo": memo(2**32 - 1),
    "copies": copies(3000),
    "one array often": pickle.dumps([np.zeros(100_000)] * 1000),
    "a long number": b"\x8b" + struct.pack("<I", 2**31 - 1) + b"1.",
    "a long text": b"\x8d" + struct.pack("<Q", 2**40) + b"a.",
}


@pytest.mark.parametrize("what", PICKLES)
def test_pickles_that_grow(what, tmp_path):
    (tmp_path / "meta.pkl").write_bytes(PICKLES[what])
    with refused(tmp_path / "meta.pkl", "unsafe pickle"):
        load_plain(tmp_path / "meta.pkl")


TOML = {
    "deep": "x = " + "[" * 20_000,
    "deep tables": "x = " + "{a=" * 10_000,
    "a long key": ".".join("a" * 30_000) + " = 1",
    "long": "# " + "a" * 1_000_000,
    "many keys below a long one": f"[{'a.' * 500}a]\n" + "".join(f"b{k}=1\n" for k in range(7000)) + "=",
    "a long number": "x = " + "9" * 900,
    "a longer number": "x = " + "9" * 60_000,
}


@pytest.mark.parametrize("what", TOML)
@pytest.mark.parametrize("read", [from_toml, read_plan])
def test_toml_that_grows(what, read, tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(TOML[what])
    with pytest.raises(P2PError) as error:
        read(path)
    assert len(str(error.value)) < 2000


JSON = {
    "deep": "[" * 200_000,
    "deep and closed": "[" * 100_000 + "]" * 100_000,
    "deep objects": '{"a":' * 100_000,
    "a long number": "9" * 100_000,
    "not a number": "NaN",
    "text": '"run"',
    "bytes": "\ufffd",
}


@pytest.mark.parametrize("what", JSON)
@pytest.mark.parametrize("name", ["run.json", "prompts", "manifest"])
def test_json_that_grows(what, name, tmp_path):
    path = tmp_path / name
    for text in (JSON[what], '{"objects": ' + JSON[what]):
        path.write_text(text)
        with refused(path):
            READERS[name](path)


def test_many_clicks_are_refused_before_they_are_compared(tmp_path):
    points = [[k, k] for k in range(20_000)]
    path = tmp_path / "p.json"
    path.write_text(json.dumps({"objects": [{"name": "a", "points": points, "negative": points}]}))
    with refused(path, "20000 of them"):
        load_prompts(path)
    path.write_text(json.dumps({"objects": [{"name": f"a{k}", "points": [[k, k]]} for k in range(20_000)]}))
    with refused(path, "20000 entries"):
        load_prompts(path)


@pytest.mark.parametrize("name", ["../x", "/x", "a/b", "..", "x" * 200])
def test_names_lead_nowhere(name, tmp_path):
    path = tmp_path / "p.json"
    path.write_text(json.dumps({"objects": [{"name": name, "points": [[1, 2]]}]}))
    with refused(path, "object name"):
        load_prompts(path)
    plan = tmp_path / "plan.toml"
    scope = "[SCOPE]\nseeds = [0]\n[[SCOPE.sequence]]\nname = 'synthetic/mug'\n"
    text = f"name = '{name}'\ntitle = 't'\n[[method]]\nname = 'm'\n" + scope.replace("SCOPE", "quick")
    plan.write_text(text + scope.replace("SCOPE", "full"))
    with refused(plan, "name:"):
        read_plan(plan)
    plan.write_text(plan.read_text().replace(name, "mine", 1))
    assert read_plan(plan).name == "mine"


def zipped(members: dict[str, bytes], claimed: int | None = None) -> bytes:
    """An archive; ``claimed`` is the size that its directory says each member has."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    data = bytearray(out.getvalue())
    at = data.find(b"PK\x01\x02")
    while claimed is not None and at >= 0:
        data[at + 24 : at + 28] = struct.pack("<I", claimed)
        at = data.find(b"PK\x01\x02", at + 4)
    return bytes(data)


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


ARRAYS = {
    "claims 2 GiB": zipped({"a/points.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}")}, 2**31),
    "claims 8 TB": zipped({"a.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000)}")}),
    "claims more": zipped(
        {"a.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000000000000, 9)}")}
    ),
    "objects": zipped({"a.npy": npy("{'descr': '|O', 'fortran_order': False, 'shape': (2,)}", pickle.dumps([1, 2]))}),
    "deep header": zipped({"a.npy": npy("(" * 100)}),
    "no arrays": zipped({"a.txt": b"hello"}),
    "no archive": b"hello",
    "cut": zipped({"a.npy": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}", bytes(16))})[:-30],
}


@pytest.mark.parametrize("what", ARRAYS)
def test_archives_of_arrays(what, tmp_path):
    (tmp_path / "keypoints.npz").write_bytes(ARRAYS[what])
    with refused(tmp_path / "keypoints.npz"):
        load_keypoints(tmp_path)


def test_labels_that_claim_much(tmp_path):
    path = tmp_path / "is_mask_visible" / "can" / "is_mask_visible.npy"
    path.parent.mkdir(parents=True)
    path.write_bytes(npy("{'descr': '|b1', 'fortran_order': False, 'shape': (10000000000000,)}", b"\1"))
    with refused(path):
        read_labels(tmp_path, "can", 3)


@pytest.mark.parametrize("many", [False, True])
def test_archives_that_grow(many, tmp_path):
    path = tmp_path / "a.zip"
    large = {"large": bytes(90 << 20)}
    path.write_bytes(zipped({f"{k}": b"" for k in range(2000)} if many else large))
    if many:
        path.write_bytes(path.read_bytes())
        assert len(unpack(path, tmp_path / "out")) == 2000  # small files are fine
        return
    assert path.stat().st_size < 1 << 20
    with refused(path, "more than it may unpack to"):
        unpack(path, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*"))


PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n0 0 1\n0 1 0\n"
MESHES = {
    "far.ply": PLY + "3 0 1 7\n",
    "negative.ply": PLY + "3 0 1 -5\n",
    "none.ply": PLY.replace("0 0 1\n", "nan 0 1\n") + "3 0 1 2\n",
    "many.ply": PLY.replace("vertex 3", "vertex 4000000000") + "3 0 1 2\n",
    "binary.ply": PLY.replace("ascii", "binary_little_endian").replace("vertex 3", "vertex 99999999999") + "3 0 1 2\n",
    "far.obj": "v 0 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 9\n",
    "words.obj": "v 0 0 0\nv 0 0 1\nv 0 1 0\nf a b c\n",
}


@pytest.mark.parametrize("name", MESHES)
def test_meshes(name, tmp_path):
    path = tmp_path / name
    path.write_text(MESHES[name])
    with refused(path):
        load_mesh(path)


def test_a_mesh_reads_nothing_beside_itself(tmp_path):
    """A material library, here a pipe that nobody writes to, would be waited for."""
    os.mkfifo(tmp_path / "m.mtl")
    os.mkfifo(tmp_path / "t.png")
    (tmp_path / "a.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 0 0 1\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    assert load_mesh(tmp_path / "a.obj")[1].tolist() == [[0, 1, 2]]
    (tmp_path / "a.ply").write_text(
        PLY.replace("element vertex", "comment TextureFile t.png\nelement vertex") + "3 0 1 2\n"
    )
    assert load_mesh(tmp_path / "a.ply")[1].tolist() == [[0, 1, 2]]


def test_limits_are_above_what_is_real():
    assert files.LARGEST_IMAGE_PX > 7680 * 4320
    with pytest.raises(BadInput):
        files.file_name("name", "../x")


def test_depth_images_that_are_named_otherwise_than_colour_ones_are_not_guessed(tmp_path):
    """With --skip-bad, too: which of them are missing, nobody knows."""
    rgb = tuple(tmp_path / f"{k:06d}.jpg" for k in range(3))
    depth = (tmp_path / "d0.png", tmp_path / "d1.png")
    for allowed in (False, True):
        with images.gaps_allowed(allowed), pytest.raises(BadInput) as refused:
            images.paired_depth(depth, rgb)
        assert "d0.png is that of no colour image, as 000000.jpg" in str(refused.value)
        assert "--skip-bad" not in str(refused.value)
