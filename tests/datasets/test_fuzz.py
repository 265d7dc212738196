"""Every reader on files that are nearly right: it reads them, or says in one line what is wrong, and nothing else."""

import json
import math
import pickle
import shutil
import tarfile
import warnings
import zipfile

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from p2p_lib.benchmark.outcome import Outcome, load_outcome, save_outcome
from p2p_lib.benchmark.plan import read_plan
from p2p_lib.core.config import from_toml, preset
from p2p_lib.core.errors import P2PError
from p2p_lib.datasets import images
from p2p_lib.datasets.archives import unpack
from p2p_lib.datasets.exchange import read_poses
from p2p_lib.datasets.ho3d import read_meta, read_pose
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.datasets.manifests import read_manifest
from p2p_lib.datasets.masks import read_labels
from p2p_lib.datasets.models import load_mesh, load_points
from p2p_lib.datasets.prompts import load_prompts
from p2p_lib.datasets.recording import read_log
from p2p_lib.datasets.runs import load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.datasets.ycbmultitrack import read_labels as visibility
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.run import run
from tests.fixtures.sliding_board import K, write_sequence

#: So many files for each reader: all of them take seconds.
EXAMPLES = 40
PLAN = """title = "t"
[[method]]
name = "m"
settings = {"sampling.points" = 20}
[quick]
seeds = [0, 1]
[[quick.sequence]]
name = "synthetic/mug"
[full]
seeds = [0]
[[full.sequence]]
name = "ycbineoat/*"
"""
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
PLY += "property list uchar int vertex_indices\nend_header\n0 0 0\n0 0 1\n0 1 0\n3 0 1 2\n"
LOG = "".join(f"{k / 30} {0.01 * k} 0 0.5 0 0 {math.sin(k)} {math.cos(k)}\n" for k in range(40))


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Good files of every kind that is read."""
    home = tmp_path_factory.mktemp("fuzz")
    sequence = write_sequence(home / "slide", frames=3)
    settings = {"method.surface": False, "method.graph": False}
    run(sequence, home / "run", settings=settings, progress=False)
    rng = np.random.default_rng(0)
    rgb, depth = rng.integers(0, 255, (12, 16, 3), np.uint8), rng.integers(0, 900, (12, 16)).astype(np.uint16)
    for name, image in {"a.png": rgb, "a.jpg": rgb, "a.bmp": rgb, "a.tif": rgb, "d.png": depth}.items():
        cv2.imwrite(str(home / name), image)
    cv2.imwrite(str(home / "d.tif"), depth.astype(np.float32))
    cv2.imwrite(str(home / "m.png"), (depth > 400).astype(np.uint8))
    np.savetxt(home / "K.txt", np.eye(3))
    meta = {"camMat": K, "objTrans": np.ones(3), "objRot": np.ones((3, 1)), "objName": "mug"}
    (home / "meta.pkl").write_bytes(pickle.dumps(meta, 2))
    objects = [{"name": "a", "points": [[1, 2]], "negative": [[5, 5]]}, {"name": "b", "frame": 1, "box": [1, 2, 3, 4]}]
    (home / "prompts.json").write_text(json.dumps({"objects": objects}))
    (home / "config.toml").write_text(preset().to_toml())
    (home / "plan.toml").write_text(PLAN)
    (home / "a.ply").write_text(PLY)
    (home / "a.obj").write_text("v 0 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 3\n")
    (home / "a.xyz").write_text("0 0 0\n0 0 1\n0 1 0\n")
    (home / "log.txt").write_text(LOG)
    (home / "poses.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n1,0,1,0.5,1 0 0 0 1 0 0 0 1,0 0 500,-1\n")
    (home / "tum").mkdir()
    shutil.copy(home / "run" / "poses" / "object.txt", home / "tum" / "object.txt")
    with zipfile.ZipFile(home / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("seq/cam_K.txt", "1 2 3\n" * 50)
    with tarfile.open(home / "a.tar.gz", "w:gz") as archive:
        archive.add(home / "K.txt", "seq/cam_K.txt")
    label = home / "seen" / "is_mask_visible" / "can" / "is_mask_visible.npy"
    label.parent.mkdir(parents=True)
    np.save(label, np.ones(5, bool))
    scene = home / "000001"
    for name in ("rgb", "depth"):
        (scene / name).mkdir(parents=True)
        cv2.imwrite(str(scene / name / "000000.png"), rgb if name == "rgb" else depth)
    (scene / "scene_camera.json").write_text('{"0": {"cam_K": [60, 0, 8, 0, 60, 6, 0, 0, 1], "depth_scale": 1.0}}')
    pose = {"obj_id": 1, "cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 500.0]}
    (scene / "scene_gt.json").write_text(json.dumps({"0": [pose]}))
    (scene / "scene_gt_info.json").write_text('{"0": [{"px_count_visib": 5}]}')
    intrinsic = {"width": 16, "height": 12, "intrinsic_matrix": [60, 0, 0, 0, 60, 0, 8, 6, 1]}
    for name in ("recorded/color", "recorded/depth"):
        shutil.copytree(scene / name[9:].replace("color", "rgb"), home / name)
    (home / "recorded" / "intrinsic.json").write_text(json.dumps(intrinsic))
    shutil.copytree(scene / "rgb", home / "rgbd_freiburg1" / "rgb")
    shutil.copytree(scene / "depth", home / "rgbd_freiburg1" / "depth")
    for name in ("rgb", "depth"):
        (home / "rgbd_freiburg1" / f"{name}.txt").write_text(f"# {name}\n1305031453.35 {name}/000000.png\n")
    np.save(home / "d.npy", depth)
    save_outcome(home, Outcome(key="k", status="done"))
    (home / "tiny.json").write_text('{"kind": "dataset", "name": "tiny", "title": "t", "version": "1"}')
    return home


def scored(home):
    """A run is read, and what is read is fit to be scored."""
    done = load_run(home / "run")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numbers may be wild
        evaluate(done)


def scene(home):
    sequence = open_sequence(home / "000001", "bop")
    return sequence.truth, sequence.frame(0), sequence.visible_px(0)


def slide(home):
    return open_sequence(home / "slide")


#: The file that is changed, and what reads it.
READERS = {
    **{name: lambda home, name=name: images.read_rgb(home / name) for name in ("a.png", "a.jpg", "a.bmp", "a.tif")},
    **{name: lambda home, name=name: images.read_raw_depth(home / name) for name in ("d.png", "d.tif")},
    "d.npy": lambda home: images.read_raw_depth(home / "d.npy"),
    "recorded/intrinsic.json": lambda home: open_sequence(home / "recorded", "open3d").frame(0),
    "rgbd_freiburg1/rgb.txt": lambda home: open_sequence(home / "rgbd_freiburg1", "tum").frame(0),
    "m.png": lambda home: read_labels(home / "m.png", (12, 16)),
    "K.txt": lambda home: images.read_numbers(home / "K.txt", "numbers"),
    "meta.pkl": lambda home: read_pose(home / "meta.pkl", read_meta(home / "meta.pkl"), slide(home).camera),
    "prompts.json": lambda home: load_prompts(home / "prompts.json"),
    "config.toml": lambda home: from_toml(home / "config.toml"),
    "plan.toml": lambda home: read_plan(home / "plan.toml"),
    **{f"a.{end}": lambda home, end=end: load_points(home / f"a.{end}") for end in ("ply", "obj", "xyz")},
    **{f"a.{end} as a mesh": lambda home, end=end: load_mesh(home / f"a.{end}") for end in ("ply", "obj")},
    "log.txt": lambda home: read_log(home / "log.txt"),
    "poses.csv": lambda home: read_poses(home / "poses.csv", slide(home)),
    "tum/object.txt": lambda home: read_poses(home / "tum", slide(home)),
    "a.zip": lambda home: unpack(home / "a.zip", home / "unpacked"),
    "a.tar.gz": lambda home: unpack(home / "a.tar.gz", home / "unpacked"),
    "seen/is_mask_visible/can/is_mask_visible.npy": lambda home: visibility(home / "seen", "can", 5),
    **{f"000001/scene_{kind}.json": scene for kind in ("camera", "gt", "gt_info")},
    **{f"run/{name}": scored for name in ("run.json", "poses.npz", "timings.csv", "models.npz")},
    "run/keypoints.npz": lambda home: load_keypoints(home / "run"),
    "records/k.json": lambda home: load_outcome(home, "k"),
    "tiny.json": lambda home: read_manifest.__wrapped__(home / "tiny.json"),
}
WILD = [b"nan", b"-1", b"1e999", b"9" * 400, b"\0", b"\xff\xfe", b"[", b"{", b'"', b",", b"\n", b"../", b"null", b" "]
CHANGES = st.lists(
    st.tuples(
        st.sampled_from(["set", "insert", "cut", "drop", "repeat"]),
        st.floats(0, 1, exclude_max=True),
        st.one_of(st.sampled_from(WILD), st.binary(min_size=1, max_size=6)),
    ),
    min_size=1,
    max_size=4,
)


def changed(data: bytes, changes) -> bytes:
    for how, place, new in changes:
        at = int(place * len(data))
        if how == "set":
            data = data[:at] + new + data[at + len(new) :]
        elif how == "insert":
            data = data[:at] + new + data[at:]
        elif how == "cut":
            data = data[:at]
        else:  # a piece of it once less or once more
            data = data[:at] + (data[at + 20 :] if how == "drop" else data[max(0, at - 20) :])
    return data


@pytest.mark.parametrize("name", READERS)
def test_a_changed_file_is_read_or_refused(name, home):
    path, read = home / name.partition(" ")[0], READERS[name]
    good = path.read_bytes()

    @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(CHANGES)
    def try_it(changes):
        path.write_bytes(changed(good, changes))
        try:
            read(home)
        except P2PError as error:
            assert "\n" not in str(error) and len(str(error)) < 3000

    try:
        if name != "tiny.json":  # which lacks most of its fields
            read(home)  # as it is, it is good
        try_it()
    finally:
        path.write_bytes(good)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(width=32) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@pytest.mark.parametrize("name", ["run/run.json", "prompts.json", "000001/scene_gt.json", "records/k.json"])
def test_json_of_the_wrong_form_is_refused(name, home):
    """One field of it is something else, or all of it."""
    path, read = home / name, READERS[name]
    good = path.read_text()
    content = json.loads(good)

    @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(st.sampled_from([*content, ""]), VALUES)
    def try_it(key, value):
        path.write_text(json.dumps(content | {key: value} if key else value))
        try:
            read(home)
        except P2PError as error:
            assert "\n" not in str(error)

    try:
        try_it()
    finally:
        path.write_text(good)
