"""Pickles: what HO-3D holds is read whatever wrote it; what would run code is refused and does not run."""

import os
import pickle
import random

import numpy as np
import pytest

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.pickles import load_plain

META = {
    "camMat": np.array([[614.6, 0, 320.2], [0, 614.1, 241.9], [0, 0, 1]]),
    "objTrans": np.array([0.1, -0.02, -0.5]),
    "objRot": np.array([[0.1], [2.0], [-1.0]], np.float32),
    "objName": "019_pitcher_base",
    "handJoints3D": np.arange(63.0).reshape(21, 3),
    "none": None,
    "nested": [1, 2.5, ("a", b"\x00\xff", True), {"x": np.float32(3)}, np.array(["a", "bc"])],
}


def check(got):
    assert got.keys() == META.keys() and got["none"] is None and got["objName"] == META["objName"]
    for key in ("camMat", "objTrans", "objRot", "handJoints3D"):
        np.testing.assert_array_equal(got[key], META[key])
        assert got[key].dtype == META[key].dtype
    assert (
        got["nested"][:3] == META["nested"][:3]
        and got["nested"][3] == {"x": 3}
        and got["nested"][4].tolist() == ["a", "bc"]
    )


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("numpy_name", [b"numpy.core.multiarray", b"numpy._core.multiarray"])
def test_arrays_and_plain_values_of_every_protocol_and_numpy(tmp_path, protocol, numpy_name):
    data = pickle.dumps(META, protocol=protocol)
    if protocol < 4:  # later protocols write the length before the name
        data = data.replace(b"numpy._core.multiarray", numpy_name)
    (tmp_path / "m.pkl").write_bytes(data)
    check(load_plain(tmp_path / "m.pkl"))


def test_what_python_2_wrote(tmp_path):
    """Strings are bytes (opcode U) and array data a byte string: opcodes by hand, as cPickle 2 writes them."""
    array = np.array([1.5, -2.0])
    data = b"\x80\x02}q\x00(U\x07objNameU\x083_pitchrU\x08objTranscnumpy.core.multiarray\n_reconstruct\n"
    data += b"cnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01K\x02\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R"
    data += b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U" + bytes([16]) + array.tobytes() + b"tbu."
    (tmp_path / "m.pkl").write_bytes(data)
    got = load_plain(tmp_path / "m.pkl")
    assert got["objName"] == "3_pitchr"
    np.testing.assert_array_equal(got["objTrans"], array)


class Runs:
    def __init__(self, function, *arguments):
        self.how = function, arguments

    def __reduce__(self):
        return self.how


ATTACKS = {
    "os.system": lambda where: Runs(os.system, f"touch {where}"),
    "eval": lambda where: Runs(eval, f"open({str(where)!r}, 'w')"),
    "exec": lambda where: Runs(exec, f"open({str(where)!r}, 'w')"),
    "open": lambda where: Runs(open, str(where), "w"),
    "os.mkdir": lambda where: Runs(os.mkdir, str(where)),
    "getattr": lambda where: Runs(getattr, np.ndarray, "tofile"),
    "numpy.save": lambda where: Runs(np.save, str(where), np.zeros(1)),
    "numpy.fromfile": lambda where: Runs(np.fromfile, "/etc/hostname"),
    "hidden in a list": lambda where: {"camMat": [np.eye(3), [Runs(os.mkdir, str(where))]]},
    "hidden in an array": lambda where: {"camMat": np.array([Runs(os.mkdir, str(where))], dtype=object)},
}


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_attacks_are_refused_and_do_not_run(tmp_path, attack, protocol):
    where = tmp_path / "made"
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(ATTACKS[attack](where), protocol=protocol))
    with pytest.raises(BadInput, match=r"evil\.pkl: got an unreadable or unsafe pickle \(it asks for "):
        load_plain(tmp_path / "evil.pkl")
    assert not where.exists()


BY_HAND = {
    "an attribute of something admitted": b"\x80\x04\x8c\x05numpy\x94\x8c\x0endarray.tofile\x94\x93.",
    "the codec that unpacks": b"c_codecs\nencode\n(Vaaa\nVzip\ntR.",
    "a persistent id": b"Pwhatever\n.",
    "an extension code": b"\x80\x02\x82\x01.",
    "an array of Python objects": pickle.dumps(np.array([None, 1], dtype=object)),
    "a class": b"cnumpy\nndarray\n.",
    "an array never filled": b"cnumpy._core.multiarray\n_reconstruct\n)R.",
    "a type alone": pickle.dumps(np.dtype("f8")),
    "an array of records": pickle.dumps(np.zeros(2, [("a", "f8")])),
    "a date": pickle.dumps(np.zeros(2, "M8[s]")),
    "a loop": b"\x80\x02]q\x00h\x00a.",
    "an array larger than the memory": b"cnumpy\nndarray\n(J\xff\xff\xff\x7fJ\xff\xff\xff\x7ft\x85R.",
    "nothing": b"",
    "text": b"hello",
    "an array without its end": pickle.dumps(META)[:-40],
}


@pytest.mark.parametrize("what", BY_HAND)
def test_faults_name_the_file(tmp_path, what):
    (tmp_path / "bad.pkl").write_bytes(BY_HAND[what])
    with pytest.raises(
        BadInput, match=r"bad\.pkl: got an unreadable or unsafe pickle \(.+\), expected a pickle of NumPy"
    ):
        load_plain(tmp_path / "bad.pkl")


def test_damaged_files_never_raise_anything_else(tmp_path):
    """Five hundred files with bytes changed at random: each is read as plain values or refused."""
    rng = random.Random(0)
    refused = 0
    for _ in range(500):
        data = bytearray(pickle.dumps(META, protocol=rng.choice([0, 2, 4])))
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        (tmp_path / "m.pkl").write_bytes(bytes(data))
        try:
            load_plain(tmp_path / "m.pkl")
        except BadInput:
            refused += 1
    assert 50 < refused < 500
    assert np.dtype("f4") == np.float32 and np.zeros(2, "f4").tobytes() == bytes(8)  # NumPy is as it was


def test_a_missing_file_says_so(tmp_path):
    with pytest.raises(MissingData, match=r"none\.pkl: no such file, expected a pickle"):
        load_plain(tmp_path / "none.pkl")
