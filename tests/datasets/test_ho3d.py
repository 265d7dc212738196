"""HO-3D: files as the dataset writes them (by code of our own here) come out in metres and OpenCV axes."""

import pickle

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.ho3d import DEPTH_SCALE
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.sequence import open_sequence

W, H, N = 64, 48, 5
K = np.array([[61.5, 0, 31.0], [0, 61.4, 24.5], [0, 0, 1]])
NO_TRUTH = {1, 4}


def gl_pose(i):
    """Object-to-camera in OpenGL axes: the object sits half a metre ahead, which is -z there."""
    return Rotation.from_rotvec([0.4 * i, 1.0, -0.3]).as_matrix(), np.array([0.02 * i, 0.05, -0.5])


@pytest.fixture
def sequence(tmp_path):
    folder = tmp_path / "HO3D_v3" / "evaluation" / "AP10"
    for sub in ("rgb", "depth", "meta"):
        (folder / sub).mkdir(parents=True)
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 65536, (N, H, W))  # every byte takes part
    raw[:, 0, 0], raw[:, 0, 1] = 0, 65535
    for i in range(N):
        cv2.imwrite(str(folder / "rgb" / f"{i:04d}.jpg"), np.full((H, W, 3), 40 * i, np.uint8))
        bytes_bgr = np.stack([np.zeros((H, W)), raw[i] // 256, raw[i] % 256], -1).astype(np.uint8)
        cv2.imwrite(str(folder / "depth" / f"{i:04d}.png"), bytes_bgr)
        R, t = gl_pose(i)
        meta = {"camMat": K, "objName": "019_pitcher_base", "objTrans": t, "handJoints3D": np.zeros(3)}
        meta["objRot"] = Rotation.from_matrix(R).as_rotvec()[:, None].astype(np.float32)
        if i in NO_TRUTH:
            meta |= {"objTrans": None, "objRot": None}
        (folder / "meta" / f"{i:04d}.pkl").write_bytes(pickle.dumps(meta, protocol=2))
    return folder, raw


def test_depth_of_two_bytes(sequence):
    folder, raw = sequence
    read = open_sequence(folder)
    assert read.format == "ho3d" and read.camera.K.tolist() == K.tolist() and len(read) == N
    for i in range(N):
        depth_m = read.frame(i).depth_m
        written = raw[i] * DEPTH_SCALE
        np.testing.assert_allclose(depth_m, np.where(written < 0.001, 0, written), rtol=1e-6)  # nearer is no depth
        assert depth_m[0, 0] == 0 and depth_m[0, 1] == pytest.approx(8.19099, abs=1e-4)


def test_poses_in_opencv_axes_and_frames_without_truth(sequence):
    """A point of the model lands on the pixel that an OpenGL projection of it gives."""
    truth = open_sequence(sequence[0]).truth["object"].T_cam_model
    p_model = np.array([0.03, -0.02, 0.04])
    for i in range(N):
        assert np.isnan(truth[i]).all() == (i in NO_TRUTH)
        if i in NO_TRUTH:
            continue
        R, t = gl_pose(i)
        x, y, z = R @ p_model + t
        u, v = K[0, 2] + K[0, 0] * x / -z, K[1, 2] - K[1, 1] * y / -z  # y up, looking along -z
        camera = open_sequence(sequence[0]).camera
        np.testing.assert_allclose(camera.project(truth[i][:3, :3] @ p_model + truth[i][:3, 3]), [u, v], atol=1e-4)
        assert truth[i][2, 3] == pytest.approx(0.5)
        np.testing.assert_allclose(truth[i][:3, :3] @ truth[i][:3, :3].T, np.eye(3), atol=1e-12)


def test_masks_and_models_beside_evaluation(sequence):
    folder, _ = sequence
    root = folder.parents[1]
    assert open_sequence(folder).masks(0) is None and find_models(open_sequence(folder)) == {}
    for name, rows in (("masks_XMem", 10), ("masks", 20)):
        (root / name / "AP10").mkdir(parents=True)
        for i in range(N):
            mask = np.zeros((H, W), np.uint8)
            mask[:rows] = 255
            cv2.imwrite(str(root / name / "AP10" / f"{i:05d}.png"), mask)
    model = root / "models" / "019_pitcher_base"
    model.mkdir(parents=True)
    (model / "points.xyz").write_text("0 0 0\n")
    (model / "textured_simple.obj").write_text("v 0 0 0\n")
    read = open_sequence(folder)
    assert read.masks(2)["object"].sum() == 20 * W
    assert open_sequence(folder, masks="masks_XMem").masks(2)["object"].sum() == 10 * W
    assert open_sequence(folder, masks=root / "masks_XMem" / "AP10").masks(2)["object"].sum() == 10 * W
    assert read.visible_px(2) is None  # not the dataset's own: they decide nothing about scoring
    assert find_models(read) == {"object": model / "textured_simple.obj"}


def rewrite(path, **changes):
    meta = pickle.loads(path.read_bytes())
    path.write_bytes(pickle.dumps(meta | changes, protocol=2))


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (lambda f: rewrite(f / "meta/0002.pkl", objTrans=np.zeros(2)), r"meta/0002\.pkl: got objTrans .*three finite"),
        (lambda f: rewrite(f / "meta/0002.pkl", objRot=np.full(3, np.nan)), r"meta/0002\.pkl: got objTrans .*finite"),
        (lambda f: rewrite(f / "meta/0002.pkl", objRot="abc"), r"meta/0002\.pkl: got objTrans .*finite"),
        (lambda f: rewrite(f / "meta/0003.pkl", camMat=K * 2), r"meta/0003\.pkl: camMat: got "),
        (
            lambda f: rewrite(f / "meta/0003.pkl", camMat=K + np.diag([1, 0, 0])),
            r"0003\.pkl: camMat: got another camera",
        ),
        (
            lambda f: rewrite(f / "meta/0000.pkl", camMat=None),
            r"0000\.pkl: camMat: got NoneType \(\), expected an array",
        ),
        (lambda f: (f / "meta/0000.pkl").write_bytes(pickle.dumps([1])), r"0000\.pkl: got a list, expected a dict"),
        (lambda f: (f / "meta/0001.pkl").write_bytes(b"\x80"), r"0001\.pkl: got an unreadable or unsafe pickle"),
        (lambda f: (f / "meta/0001.pkl").unlink(), r"meta: got 4 files, expected 5.*0001\.pkl is missing"),
        (lambda f: (f / "depth/0001.png").write_bytes(b"x"), r"depth/0001\.png: got an unreadable file of 1 bytes"),
    ],
)
def test_faults_name_the_file(sequence, fault, expected):
    fault(sequence[0])
    with pytest.raises(BadInput, match=expected):
        read = open_sequence(sequence[0])
        assert read.truth
        [read.frame(i) for i in range(N)]


def test_found_by_name_below_the_data_folder(sequence, tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    assert open_sequence("AP10").path == open_sequence("ho3d_v3/AP10").path == sequence[0]
