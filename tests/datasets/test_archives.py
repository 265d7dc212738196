"""Archives: what is inside comes out; what would get out of the folder is refused and nothing of it is written."""

import io
import stat
import tarfile
import zipfile

import pytest

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.archives import unpack

FILES = {"seq/rgb/0000.png": b"a" * 5000, "seq/cam_K.txt": b"1 2 3\n", "empty": b""}


def make_tar(path, members=(), mode="w"):
    """A tar of FILES and then ``members``: (TarInfo, bytes)."""
    with tarfile.open(path, mode) as tar:
        for name, data in FILES.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
        for info, data in members:
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return path


def make_zip(path, members=()):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in FILES.items():
            archive.writestr(name, data)
        for info, data in members:
            archive.writestr(info, data)
    return path


def contents(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", ["a.zip", "a.tar", "a.tar.gz", "a.tgz", "a.tar.bz2", "a.tar.xz"])
def test_what_is_inside_comes_out(tmp_path, kind):
    mode = {"gz": "w:gz", "tgz": "w:gz", "bz2": "w:bz2", "xz": "w:xz"}.get(kind.split(".")[-1], "w")
    path = make_zip(tmp_path / kind) if kind == "a.zip" else make_tar(tmp_path / kind, mode=mode)
    seen = []
    assert unpack(path, tmp_path / "out", seen.append) == {name: len(data) for name, data in FILES.items()}
    assert contents(tmp_path / "out") == FILES and seen == [5000, 6, 0]
    assert unpack(path, tmp_path / "out") and contents(tmp_path / "out") == FILES  # over what is there


def tar_member(name, kind=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname, info.mode = kind, link, 0o4777
    return info, b"evil" if kind == tarfile.REGTYPE else b""


TARS = {
    "traversal": tar_member("../evil"),
    "traversal inside": tar_member("seq/../../evil"),
    "absolute": tar_member("/dev/shm/p2p_evil"),
    "symbolic link": tar_member("seq/link", tarfile.SYMTYPE, "/etc"),
    "symbolic link inside": tar_member("seq/link", tarfile.SYMTYPE, "cam_K.txt"),
    "hard link": tar_member("seq/link", tarfile.LNKTYPE, "../../outside"),
    "device": tar_member("seq/null", tarfile.CHRTYPE),
    "block device": tar_member("seq/disk", tarfile.BLKTYPE),
    "pipe": tar_member("seq/pipe", tarfile.FIFOTYPE),
    "backslash": tar_member("..\\evil"),
}


@pytest.mark.parametrize("attack", TARS)
def test_attacks_by_tar(tmp_path, attack):
    (tmp_path / "outside").write_text("mine")
    before = set(tmp_path.iterdir())
    path = make_tar(tmp_path / "a.tar", [TARS[attack]])
    with pytest.raises(BadInput, match=r"a\.tar: got '.*', a (link|path).*if you trust the archive"):
        unpack(path, tmp_path / "in" / "out")
    assert set(tmp_path.iterdir()) == {*before, path, tmp_path / "in"}
    assert contents(tmp_path / "in" / "out") == FILES  # what came before it; of the attack nothing
    assert not any(p.is_symlink() for p in (tmp_path / "in").rglob("*"))
    assert (tmp_path / "outside").read_text() == "mine"


def zip_member(name, mode=stat.S_IFREG | 0o644):
    info = zipfile.ZipInfo("x")
    info.filename = name  # past ZipInfo's own mending
    info.external_attr = mode << 16
    return info, b"evil"


ZIPS = {
    "traversal": zip_member("../evil"),
    "traversal inside": zip_member("seq/../../evil"),
    "absolute": zip_member("/dev/shm/p2p_evil"),
    "symbolic link": zip_member("seq/link", stat.S_IFLNK | 0o777),
    "device": zip_member("seq/null", stat.S_IFCHR | 0o666),
    "backslash": zip_member("..\\..\\evil"),
}


@pytest.mark.parametrize("attack", ZIPS)
def test_attacks_by_zip(tmp_path, attack):
    path = make_zip(tmp_path / "a.zip", [ZIPS[attack]])
    with pytest.raises(BadInput, match=r"a\.zip: got '.*', a (link|path)"):
        unpack(path, tmp_path / "in" / "out")
    assert set(tmp_path.iterdir()) == {path, tmp_path / "in"} and contents(tmp_path / "in" / "out") == FILES


@pytest.mark.parametrize("make", [make_tar, make_zip])
def test_a_link_that_lay_there_before_is_not_followed(tmp_path, make):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "seq").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match=r"a path that leaves the folder through a link"):
        unpack(make(tmp_path / "a"), tmp_path / "out")
    assert contents(tmp_path / "elsewhere") == {}
    (tmp_path / "out" / "seq").unlink()
    (tmp_path / "out" / "empty").symlink_to(tmp_path / "elsewhere" / "new")
    with pytest.raises(BadInput, match="'empty', a path that leaves the folder through a link"):
        unpack(tmp_path / "a", tmp_path / "out")
    assert contents(tmp_path / "elsewhere") == {}


def test_set_user_id_is_not_taken_over(tmp_path):
    path = make_tar(tmp_path / "a.tar", [tar_member("run")])
    unpack(path, tmp_path / "out")
    assert not (tmp_path / "out" / "run").stat().st_mode & (stat.S_ISUID | 0o111)


@pytest.mark.parametrize("kind", ["a.zip", "a.tar", "a.tar.gz", "a.tar.bz2", "a.tar.xz"])
@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "text"])
def test_damaged_archives_name_themselves(tmp_path, kind, damage):
    mode = {"gz": "w:gz", "bz2": "w:bz2", "xz": "w:xz"}.get(kind.split(".")[-1], "w")
    path = make_zip(tmp_path / kind) if kind == "a.zip" else make_tar(tmp_path / kind, mode=mode)
    data = bytearray(path.read_bytes())
    if damage == "changed" and kind == "a.tar":
        data[0] ^= 0xFF  # a plain tar has checksums of its headers alone
    elif damage == "changed":
        data[len(data) // 3] ^= 0xFF
    changed = {"cut": bytes(data[: len(data) // 2]), "changed": bytes(data), "empty": b"", "text": b"hello" * 400}
    path.write_bytes(changed[damage])
    with pytest.raises(BadInput, match=r"a\.(zip|tar[.\w]*): got a damaged archive \(.+\), expected a whole one"):
        unpack(path, tmp_path / "out")


def test_a_locked_zip_says_so(tmp_path):
    path = make_zip(tmp_path / "a.zip")
    data = bytearray(path.read_bytes())
    at = data.find(b"PK\x01\x02")  # the first entry's flags in the central directory
    data[at + 8] |= 1
    path.write_bytes(bytes(data))
    with pytest.raises(BadInput, match="locked by a password"):
        unpack(path, tmp_path / "out")


def test_no_room_is_said_before_writing(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 100}))
    with pytest.raises(BadInput, match=r"got seq/rgb/0000\.png of 5000 bytes, expected room for it"):
        unpack(make_tar(tmp_path / "a.tar"), tmp_path / "out")
    assert contents(tmp_path / "out") == {}


def test_no_archive(tmp_path):
    with pytest.raises(MissingData, match="no such archive"):
        unpack(tmp_path / "a.zip", tmp_path / "out")
