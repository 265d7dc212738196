"""A memory's file is refused with a sentence, whatever is wrong with what it holds."""

import json
import re

import numpy as np
import pytest

from p2p_lib.core import memory as memories
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.memory import DESCRIPTOR, load_memories, load_memory, save_memory
from p2p_lib.trackers.builtin import landmarks
from tests.fixtures.made_memory import VOXEL_M, made_memory

#: What Python and numpy say among themselves.
JARGON = re.compile(r"ufunc|' object|NoneType|attribute|argument|len\(|index out|broadcast|<class")


@pytest.fixture
def refused(tmp_path):
    """What :func:`load_memory` says of a file some of whose arrays were replaced, or taken away (None)."""

    def load(about=None, **changed) -> str:
        path = tmp_path / "ball.npz"
        save_memory(path, made_memory())
        with np.load(path) as file:
            arrays = dict(file)
        head = json.loads(arrays["about"].tobytes())
        head = about(head) if about else head
        arrays["about"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
        arrays |= {f"ball/{key.replace('surface_', 'surface/')}": value for key, value in changed.items()}
        np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
        with pytest.raises(BadInput) as error:
            load_memory(path)
        said = str(error.value)
        assert "ball.npz" in said and not JARGON.search(said), said
        return said

    return load


def test_what_is_whole_is_read(tmp_path):
    save_memory(tmp_path / "ball.npz", made_memory())
    assert load_memory(tmp_path / "ball.npz").made_of == {"sequence": "nowhere"}


def test_descriptors_are_as_the_recogniser_makes_them():
    assert landmarks.Landmarks().descriptors.shape[1:] == DESCRIPTOR


MADE = made_memory()
SURFACE = MADE.surface
M, N = len(SURFACE.index), len(MADE.p_obj)


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"descriptors": MADE.descriptors[:, :0]}, "descriptors: got uint8 20 x 0 x 128, expected bytes 20 x 2 x 128"),
        ({"descriptors": MADE.descriptors[..., :64]}, "descriptors: got uint8 20 x 2 x 64"),
        ({"descriptors": MADE.descriptors[:, 0]}, "descriptors: got uint8 20 x 128"),
        ({"descriptors": MADE.descriptors.astype(float)}, "descriptors: got float64"),
        ({"descriptors": MADE.descriptors[1:]}, "descriptors: got uint8 19 x"),
        ({"p_obj": np.float64(3)}, "p_obj: got float64 alone, expected numbers any x 3"),
        ({"p_obj": MADE.p_obj[:, :2]}, "p_obj: got float64 20 x 2"),
        ({"p_obj": MADE.p_obj.astype(str)}, "p_obj: got <U"),
        ({"p_obj": MADE.p_obj > 0}, "p_obj: got bool"),
        ({"p_obj": np.full((N, 3), np.inf)}, "p_obj: got some that are not finite"),
        ({"p_obj": 1000 * MADE.p_obj}, r"p_obj: got landmarks .* m beside the surface, expected metres"),
        ({"p_obj": np.zeros((0, 3))}, "0 landmarks and 1 keyframes"),
        ({"confidence": -MADE.confidence}, "confidence: got -0.9 to -0.9, expected 0 to 1"),
        ({"confidence": MADE.confidence[1:]}, "confidence: got float64 19"),
        ({"T_cam_obj": MADE.T_cam_obj[0]}, "T_cam_obj: got float64 4 x 4"),
        ({"T_cam_obj": np.zeros((0, 4, 4))}, "20 landmarks and 0 keyframes"),
        ({"T_cam_obj": se3.from_rt(np.eye(3), np.array([0, 0, 500]))[None]}, "T_cam_obj: got a keyframe 500 m away"),
        ({"T_cam_obj": np.ones((1, 4, 4))}, "T_cam_obj: got a matrix that is not a rotation"),
        ({"covariance": np.eye(5)}, "covariance: got float64 5 x 5"),
        ({"covariance": -np.eye(6)}, "covariance: got no covariance"),
        ({"covariance": np.eye(6) + np.eye(6, k=1)}, "covariance: got no covariance"),
        ({"seen_m2": np.float64(-1)}, "seen_m2: got -1 to -1"),
        ({"seen_m2": np.zeros(1)}, "seen_m2: got float64 1, expected numbers alone"),
        ({"outline": np.float64(1.5)}, "outline: got 1.5 to 1.5, expected 0 to 1"),
        ({"surface_index": SURFACE.index[:, None]}, f"surface: index: got int32 {M} x 1, expected whole numbers any"),
        ({"surface_index": SURFACE.index.astype(float)}, "surface: index: got float64"),
        ({"surface_index": np.int64(3)}, "surface: index: got int64 alone"),
        ({"surface_index": SURFACE.index[::-1]}, "surface: index: got none, some twice, or some outside the grid"),
        ({"surface_index": SURFACE.index + 2**15}, "surface: index: got none, some twice, or some outside the grid"),
        ({"surface_index": np.zeros(M, np.int64)}, "surface: index: got none, some twice"),
        ({"surface_shape": SURFACE.shape.astype(float)}, "surface: shape: got float64 3, expected whole numbers 3"),
        ({"surface_shape": SURFACE.shape[:2]}, "surface: shape: got int64 2"),
        ({"surface_shape": np.array([1, 32, 32])}, "1 x 32 x 32 voxels"),
        ({"surface_shape": np.array([4000, 4000, 4000])}, "4000 x 4000 x 4000 voxels, expected as many as"),
        ({"surface_lo": SURFACE.lo.astype(float)}, "surface: lo: got float64"),
        ({"surface_lo": SURFACE.lo - 10**9}, r"surface: got voxels 3e\+06 m away"),
        ({"surface_origin_m": SURFACE.origin_m + 1e4}, r"surface: got voxels 1e\+04 m away"),
        ({"surface_voxel_m": np.float64(3)}, "32 x 32 x 32 voxels of 3.0 m"),
        ({"surface_voxel_m": np.full(3, VOXEL_M)}, "surface: voxel_m: got float64 3, expected numbers alone"),
        ({"surface_tau_m": np.float64(0)}, "which end 0.0 m from the surface"),
        ({"surface_value": SURFACE.value * 3}, r"surface: value: got -\d.* to \d.*, expected -1 to 1"),
        ({"surface_value": SURFACE.value[1:]}, "surface: value: got float16"),
        ({"surface_value": SURFACE.value * np.nan}, "surface: value: got some that are not finite"),
        ({"surface_weight": -SURFACE.weight}, "surface: weight: got -1 to -1, expected 0 to 1e"),
        ({"surface_weight": np.full(M, 1e300)}, "surface: weight: got 1e"),
        ({"surface_rgb": SURFACE.rgb.astype(int)}, "surface: rgb: got int64"),
        ({"surface_rgb": SURFACE.rgb[:, :2]}, f"surface: rgb: got uint8 {M} x 2"),
        ({"surface_rgb_weight": -SURFACE.weight}, "surface: rgb_weight: got -1 to -1"),
        ({"surface_rgb_weight": None}, "a file without 'ball/surface/rgb_weight'"),
        ({"covariance": None}, "a file without 'ball/covariance'"),
    ],
)
def test_arrays_that_are_wrong_are_refused(refused, changed, said):
    assert re.search(said, refused(**changed))


@pytest.mark.parametrize(
    "head, said",
    [
        (lambda head: head | {"version": "2"}, 'got version "2", expected a memory .* of version 3. Make it again'),
        (lambda head: head | {"version": None}, "got version null"),
        (lambda head: {k: v for k, v in head.items() if k != "version"}, "got version null"),
        (lambda head: head | {"version": {"a": 3}}, "got version {"),
        (lambda head: head | {"kind": "soup"}, "an archive of something else"),
        (lambda head: [head], "an archive of something else"),
        (lambda head: head | {"objects": ["ball"]}, "does not say what is in it"),
        (lambda head: head | {"objects": {}}, "0 objects"),
        (lambda head: head | {"objects": {"ball": {}, "other": {}}}, "a file without 'other/surface/voxel_m'"),
        (lambda head: head | {"objects": {"../ball": {}}}, "a file without|memory name"),
        (lambda head: head | {"objects": {"ball": []}}, "made_of: got .*, expected values by name"),
        (lambda head: head | {"objects": {"ball": {"before": "long ago"}}}, "made_of: got .*, expected values by name"),
        (lambda head: head | {"objects": {"ball": {"before": ["long ago"]}}}, "made_of"),
        (lambda head: head | {"about": 3}, "does not say what is in it"),
    ],
)
def test_a_head_that_is_wrong_is_refused(refused, head, said):
    assert re.search(said, refused(head))


def test_a_file_of_another_version_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(memories, "VERSION", memories.VERSION + 1)
    save_memory(tmp_path / "ball.npz", made_memory())
    monkeypatch.undo()
    with pytest.raises(BadInput, match=r"version 4, expected a memory .* of version 3\. Make it again"):
        load_memory(tmp_path / "ball.npz")


def test_what_is_made_in_python_is_checked_as_well():
    with pytest.raises(BadInput, match="memory of 'ball': p_obj: got no array"):
        made_memory(p_obj=MADE.p_obj.tolist())


@pytest.mark.parametrize(
    "info, why",
    [
        ({"offline": True}, "An offline pass keeps none: give the run that it was made of."),
        ({"offline": False}, "No object was learnt well enough in it"),
        ({}, "No object was learnt well enough in it"),
    ],
)
def test_a_run_without_maps_says_why(tmp_path, info, why):
    (tmp_path / "run.json").write_text(json.dumps(info))
    with pytest.raises(MissingData, match="a run without maps") as error:
        load_memories([tmp_path])
    assert why in str(error.value) and ("offline" in str(error.value)) == bool(info.get("offline"))
