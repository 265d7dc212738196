"""Bad input: every fault of a sequence on disk is one line that names the file, what was found, what was expected."""

import re
import shutil

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.sequence import open_sequence

W, H, N = 40, 30, 3
LABELS = "is_mask_visible/can/is_mask_visible.npy"


@pytest.fixture
def sequence(tmp_path):
    """A YCBMultiTrack folder of two objects that opens and reads without complaint."""
    folder = tmp_path / "table"
    for sub in ("rgb", "depth"):
        (folder / sub).mkdir(parents=True)
    for i in range(N):
        cv2.imwrite(str(folder / "rgb" / f"{i:04d}.png"), np.full((H, W, 3), 50 + i, np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{i:04d}.png"), np.full((H, W), 700, np.uint16))
        for obj in ("box", "can"):
            for sub in ("masks", "annotated_poses"):
                (folder / sub / obj).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / "masks" / obj / f"{i:04d}.png"), np.full((H, W), 255, np.uint8))
            np.savetxt(folder / "annotated_poses" / obj / f"{i:04d}.txt", se3.exp(np.full(6, 0.1 * i)))
    (folder / "is_mask_visible" / "can").mkdir(parents=True)
    np.save(folder / LABELS, np.ones(N, bool))
    np.savetxt(folder / "cam_K.txt", [[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    read_all(folder)
    return folder


def read_all(folder, **options):
    s = open_sequence(folder, **options)
    for i in range(len(s)):
        s.frame(i), s.masks(i), s.visible_px(i)
    return s, s.truth


def png(path, image):
    assert cv2.imwrite(str(path), image)


MATRIX, TIMES = "expected a 3x3 camera matrix", "expected times in seconds that increase"
#: The file that is spoilt, what it holds then (None: it is gone), and what is said.
FAULTS = {
    "colour unreadable": (
        "rgb/0001.png",
        b"not a picture",
        r"rgb/0001\.png: got an unreadable file of 13 bytes, expected a colour image",
    ),
    "colour empty": ("rgb/0000.png", b"", r"rgb/0000\.png: got an unreadable file of 0 bytes"),
    "colour missing": (
        "rgb/0001.png",
        None,
        r"depth: got 3 files, expected 2, one for each in .*rgb\. 0001\.png is too many",
    ),
    "depth missing": (
        "depth/0001.png",
        None,
        r"depth: got 2 files, expected 3, one for each in .*rgb\. 0001\.png is missing",
    ),
    "colour of another size": (
        "rgb/0002.png",
        np.zeros((H, W + 2, 3), np.uint8),
        r"rgb/0002\.png: got 42x30, expected 40x30 \(width x height\) as the first image",
    ),
    "depth of another size": (
        "depth/0001.png",
        np.zeros((H // 2, W // 2), np.uint16),
        r"depth/0001\.png: got 20x15, expected 40x30 \(width x height\) as the colour image\. .*Register",
    ),
    "depth of eight bits": (
        "depth/0001.png",
        np.zeros((H, W), np.uint8),
        r"depth/0001\.png: got \(30, 40\) uint8, expected one channel, uint16.*8 bits hold no depth: save 16-bit",
    ),
    "colour in the place of depth": (
        "depth/0001.png",
        np.zeros((H, W, 3), np.uint8),
        r"expected one channel, uint16 .*These are colours: are colour and depth images swapped\?",
    ),
    "depth in colour": (
        "depth/0001.png",
        np.zeros((H, W, 3), np.uint16),
        r"depth/0001\.png: got \(30, 40, 3\) uint16, expected one channel",
    ),
    "no depth folder": ("depth", None, "depth: no such folder, expected depth images"),
    "no camera": ("cam_K.txt", None, rf"cam_K\.txt: no such file, {MATRIX}"),
    "camera of two rows": ("cam_K.txt", "50 0 20\n0 50 15\n", rf"cam_K\.txt: got 6 numbers, {MATRIX}"),
    "camera with decimal commas": (
        "cam_K.txt",
        "50,5 0,0 20,0\n0,0 50,5 15,0\n0,0 0,0 1,0\n",
        "18 numbers.*with a point",
    ),
    "camera empty": ("cam_K.txt", "", rf"cam_K\.txt: got 0 numbers, {MATRIX}"),
    "camera in words": ("cam_K.txt", "fx 50\nfy 50\n", rf"cam_K\.txt: got unreadable numbers .*'fx'.*, {MATRIX}"),
    "camera ragged": (
        "cam_K.txt",
        "50 0 20\n0 50\n0 0 1\n",
        rf"cam_K\.txt: got unreadable numbers .*row 2.*, {MATRIX}",
    ),
    "camera NaN": ("cam_K.txt", "nan 0 20\n0 50 15\n0 0 1\n", r"cam_K\.txt: got nan 0 20.*, expected fx 0 cx"),
    "pose NaN": (
        "annotated_poses/can/0001.txt",
        np.full((4, 4), np.nan),
        r"annotated_poses/can/0001\.txt: got NaN or infinite entries, expected a finite 4x4",
    ),
    "pose not rigid": (
        "annotated_poses/can/0001.txt",
        np.diag([1, 1, 1.1, 1]),
        r"annotated_poses/can/0001\.txt: got a matrix that is not a rotation",
    ),
    "pose of three rows": (
        "annotated_poses/can/0001.txt",
        np.eye(4)[:3],
        r"annotated_poses/can/0001\.txt: got shape \(3, 4\), expected a 4x4",
    ),
    "pose missing": (
        "annotated_poses/box/0002.txt",
        None,
        r"annotated_poses/box: got 2 files, expected 3, one for each in .*rgb\. 0002\.txt is missing",
    ),
    "mask missing": ("masks/box/0000.png", None, r"masks/box: got 2 files, expected 3.*0000\.png is missing"),
    "masks of an object missing": ("masks/box", None, "masks/box: no such folder, expected mask"),
    "mask unreadable": (
        "masks/can/0001.png",
        b"x",
        r"masks/can/0001\.png: got an unreadable file of 1 bytes, expected a mask image",
    ),
    "mask of another size": (
        "masks/can/0001.png",
        np.zeros((8, 9), np.uint8),
        r"masks/can/0001\.png: got 9x8, expected 40x30",
    ),
    "labels too short": (LABELS, np.ones(N - 1, bool), rf"{LABELS}: got shape \(2,\) bool, expected 3 labels"),
    "labels pickled": (LABELS, np.array([{}] * N), f"{LABELS}: got an unreadable array"),
    "labels damaged": (LABELS, b"\x93NUMPY", f"{LABELS}: got an unreadable array"),
    "times too few": ("times.txt", "0\n0.1\n", r"times\.txt: got 2 times, expected 3, one for each in .*rgb"),
    "times standing still": ("times.txt", "0\n0.1\n0.1\n", rf"times\.txt: got 0\.100000 s at frame 2, {TIMES}"),
    "times NaN": ("times.txt", "0\n0.1\nnan\n", rf"times\.txt: got nan s at frame 2, {TIMES}"),
}


def put(path, content):
    """What a file holds from now on: bytes, text, an image, numbers, an array; None for nothing, folders too."""
    if content is None:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    elif isinstance(content, np.ndarray):
        write = {".png": png, ".txt": np.savetxt, ".npy": np.save}[path.suffix]
        write(path, content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


def assert_named(sequence, expected):
    with pytest.raises((BadInput, MissingData)) as error:
        read_all(sequence)
    message = str(error.value)
    assert re.search(expected, message), message
    assert "\n" not in message and str(sequence) in message


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_names_the_file(sequence, fault):
    file, content, expected = FAULTS[fault]
    put(sequence / file, content)
    assert_named(sequence, expected)


def test_images_of_other_names_between_are_not_paired_by_their_number(sequence):
    """One colour image and another one's depth were lost: as many of each, and all between are shifted."""
    (sequence / "depth" / "0000.png").rename(sequence / "depth" / f"{N:04d}.png")
    assert_named(
        sequence, rf"depth: got no 0000\.png, and {N:04d}\.png instead, expected .*rgb, called alike. Both are counted"
    )
    for i in range(1, N + 1):
        (sequence / "depth" / f"{i:04d}.png").rename(sequence / "depth" / f"depth_{i:04d}.png")
    read_all(sequence)


@pytest.mark.parametrize("stamped", [False, True], ids=["numbers", "times"])
def test_images_of_unlike_names_are_paired_while_their_numbers_go_on_alike(sequence, stamped):
    """As many of each, but one is missing here and one there: all between would be of another moment."""
    times = [1581120424100262102 + 33_000_000 * i for i in range(9)] if stamped else list(range(9))
    rgb, depth = (sorted((sequence / part).iterdir())[0].read_bytes() for part in ("rgb", "depth"))
    for part in ("masks", "annotated_poses", "is_mask_visible"):
        shutil.rmtree(sequence / part)

    def written(of_rgb, of_depth):
        for part, image, numbers in (("rgb", rgb, of_rgb), ("depth", depth, of_depth)):
            shutil.rmtree(sequence / part)
            (sequence / part).mkdir()
            for k in numbers:
                put(sequence / part / f"{part}_{k:020d}.png", image)

    late = [t + 4_000_000 if stamped else t + 1 for t in times]
    written(times[:3] + times[4:], late[:3] + late[4:])
    assert len(open_sequence(sequence).rgb) == 8, "both lack the same one"
    written(times, [20_000 + 7 * i for i in range(9)] if stamped else [10 * i for i in range(9)])
    assert len(open_sequence(sequence).rgb) == 9, "they count something else"
    written(times[:3] + times[4:], late[:6] + late[7:])
    said = rf"depth: got depth_0*{late[2]}\.png with rgb_0*{times[2]}\.png, and next depth_0*{late[3]}\.png with rgb_0*"
    assert_named(sequence, rf"{said}{times[4]}\.png, expected .*keep their distance. Take out")


def test_a_camera_matrix_may_stand_in_one_line(sequence):
    put(sequence / "cam_K.txt", "50 0 20 0 51 15 0 0 1")
    camera = open_sequence(sequence).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 51, 20, 15)


@pytest.mark.parametrize("mine, ours", [("Depth", "depth"), ("RGB", "rgb"), ("color", "rgb")])
def test_a_folder_of_another_name_is_to_be_renamed(sequence, mine, ours):
    (sequence / ours).rename(sequence / mine)
    assert_named(sequence, f"Rename {mine}/ to {ours}/")


def test_both_folders_of_other_names_are_to_be_renamed(tmp_path):
    for name in ("images", "depth_mm"):
        (tmp_path / name).mkdir()
    assert_named(tmp_path, r"Rename images/ to rgb/\. Rename depth_mm/ to depth/\.")


def test_a_picture_cut_off_is_named(sequence):
    path = sequence / "rgb/0002.png"
    path.write_bytes(path.read_bytes()[:-20])
    assert_named(sequence, r"rgb/0002\.png: got an unreadable file of \d+ bytes")


def test_a_folder_without_pictures_is_named(sequence):
    for path in (sequence / "rgb").iterdir():
        path.unlink()
    assert_named(sequence, r"rgb: got no files, expected colour images \(\.png")


def test_a_picture_that_vanishes_after_opening_is_named(sequence):
    s = open_sequence(sequence)
    (sequence / "rgb/0002.png").unlink()
    with pytest.raises(MissingData, match=r"rgb/0002\.png: no such file, expected a colour image"):
        s.frame(2)


def test_faults_wait_for_their_frame(sequence):
    (sequence / "depth/0002.png").write_bytes(b"x")
    s = open_sequence(sequence)
    assert s.frame(1).index == 1
    with pytest.raises(BadInput, match=r"depth/0002\.png"):
        s.frame(2)


@pytest.mark.parametrize("i", [-1, N])
def test_frames_that_are_not_there(sequence, i):
    s = open_sequence(sequence)
    for read in (s.frame, s.masks, s.visible_px):
        with pytest.raises(BadInput, match=rf"table: frame: got {i}, expected a number from 0 to 2"):
            read(i)


def test_masks_that_are_not_there(sequence):
    with pytest.raises(MissingData, match=r"masks_sam: no such folder of masks\. Name a folder inside the sequence"):
        open_sequence(sequence, masks="masks_sam")


def test_lossy_masks_are_refused(sequence):
    for path in (sequence / "masks/can").iterdir():
        path.rename(path.with_suffix(".jpg"))
    with pytest.raises(BadInput, match=r"masks/can: got no files that fit, but 3 .*mask images \(\.png"):
        open_sequence(sequence)


def test_colour_masks_without_labels_are_refused(sequence):
    rainbow = np.random.default_rng(0).integers(0, 255, (H, W, 3), np.uint8)
    png(sequence / "masks/can/0001.png", rainbow)
    with pytest.raises(BadInput, match=r"masks/can/0001\.png: got a colour image \(RGB\), expected one label"):
        open_sequence(sequence).masks(1)


def test_a_sequence_of_another_layout_says_what_it_lacks(sequence):
    (sequence / "cam_K.txt").unlink()
    shutil.rmtree(sequence / "annotated_poses")
    with pytest.raises(BadInput, match=r"annotated_poses: got no folders, expected one folder of poses"):
        np.savetxt(sequence / "cam_K.txt", [[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
        open_sequence(sequence, format="ycbmultitrack")
