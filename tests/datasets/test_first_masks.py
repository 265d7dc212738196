"""The picture of what objects were started with: written once an object has pixels, with all that started so far."""

import cv2
import numpy as np

from p2p_lib.core.colours import OBJECTS, rgb
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.first_masks import FirstMasks

H, W = 240, 320
GRAY = 90


def picture(index: int) -> Frame:
    return Frame(index, index / 30, np.full((H, W, 3), GRAY, np.uint8), np.ones((H, W), np.float32))


def square(top: int, left: int, size: int = 30, shape: tuple[int, int] = (H, W)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[top : top + size, left : left + size] = True
    return mask


def read(path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def test_each_object_is_drawn_in_the_frame_that_it_starts_in(tmp_path):
    path = tmp_path / "first.png"
    firsts = FirstMasks(path, [Prompt("cup", 0, [[65, 65]], negative_px=[[20, 100]]), Prompt("box", 3, [[10, 40]])])
    assert firsts.add(picture(0), {"cup": None, "box": np.zeros((H, W), bool)}) == ([], []) and not path.exists()
    assert firsts.add(picture(1), {"cup": square(50, 50), "box": None}) == (["cup"], [])
    image, cup, box = read(path), np.array(rgb(OBJECTS[0])), np.array(rgb(OBJECTS[1]))
    assert (image[50, 50:80] == cup).all() and (image[50:80, 79] == cup).all(), "the outline, where the mask is"
    assert (image[65, 65] == cup).all() and (image[100, 20] == cup).all(), "clicks on it and beside it"
    assert (image[55:60, 55:60] == GRAY).all() and (image[30:48, 40:120] == GRAY).all(), "and nothing elsewhere"
    before = path.read_bytes()
    assert firsts.add(picture(2), {"cup": square(10, 10), "box": None}) == ([], []) and path.read_bytes() == before
    assert firsts.add(picture(3), {"cup": square(10, 10), "box": square(30, 0)}) == (["box"], [])
    both = read(path)
    np.testing.assert_array_equal(both[: len(image), : image.shape[1]], image)
    assert (both[len(image) + 30, 0:30] == box).all(), "at the image's edge"


def test_what_was_said_meanwhile_is_drawn_and_an_object_that_was_added_again(tmp_path):
    """Of several prompts the newest one, none that is yet to come."""
    path, cup, said = tmp_path / "first.png", np.array(rgb(OBJECTS[0])), [Prompt("cup", 9, [[10, 100]])]
    firsts = FirstMasks(path, said)
    said += [Prompt("cup", 0, [[20, 40]]), Prompt("cup", 1, [[65, 65]])]
    assert firsts.add(picture(2), {"cup": square(50, 50)}) == (["cup"], [])
    image = read(path)
    assert (image[65, 65] == cup).all() and (image[30:48, 10:48] == GRAY).all()
    assert firsts.add(picture(3), {"cup": None}) == firsts.add(picture(4), {"cup": square(9, 9)}) == ([], [])
    assert firsts.add(picture(5), {}) == ([], []) and firsts.add(picture(9), {"cup": square(0, 50)}) == (["cup"], [])
    again = read(path)[len(image) :]
    assert (again[100, 10] == cup).all() and (again[65, 65] == GRAY).all() and (again[29, 50:80] == cup).all()


def test_a_correction_that_was_not_used_is_not_drawn_as_one(tmp_path):
    firsts = FirstMasks(tmp_path / "first.png", [Prompt("cup", 0, [[65, 65]]), Prompt("cup", 2, [[10, 10]])])
    masks = {"cup": square(50, 50)}
    assert firsts.add(picture(0), masks) == (["cup"], [])
    before = read(tmp_path / "first.png")
    assert firsts.add(picture(2), masks, refused={"cup": "no depth"}) == ([], [])
    np.testing.assert_array_equal(read(tmp_path / "first.png"), before)
    assert firsts.add(picture(2), masks) == ([], ["cup"])


def test_no_object_is_smaller_by_itself_than_in_the_frame(tmp_path):
    mask = np.zeros((600, 800), bool)
    mask[100:500, 100:600] = True
    frame = Frame(0, 0.0, np.full((600, 800, 3), GRAY, np.uint8), np.ones((600, 800), np.float32))
    FirstMasks(tmp_path / "first.png").add(frame, {"book": mask, "pin": square(10, 10, 10, mask.shape)})
    red = (read(tmp_path / "first.png")[:, 800:] == np.array(rgb(OBJECTS[0]))).all(-1)
    rows, columns = np.nonzero(red)
    assert np.ptp(columns) >= 499 and np.ptp(rows) >= 399


def test_eight_objects_fit(tmp_path):
    frame = Frame(0, 0.0, np.full((480, 640, 3), GRAY, np.uint8), np.ones((480, 640), np.float32))
    # In a square beside the frame, which is as high: nothing is left empty but the end of the last row.
    for objects, shape in ((1, (480, 640 + 480)), (2, (480, 640 + 240)), (8, (720, 960 + 3 * 240))):
        at = [(10 + 50 * (k // 4), 5 + 35 * (k % 4)) for k in range(objects)]
        masks = {f"a long name of object {k}": square(*corner, 20, (480, 640)) for k, corner in enumerate(at)}
        assert len(FirstMasks(tmp_path / "first.png").add(frame, masks)[0]) == objects
        image = read(tmp_path / "first.png")
        assert image.shape == (*shape, 3) and (image.max(-1) > 0).mean() > 0.92


def test_corrections_are_drawn_below_the_newest_ones_of_many(tmp_path):
    """Frame by frame, under what the objects started with; of an object that is hidden there is nothing to draw."""
    path, cup = tmp_path / "first.png", np.array(rgb(OBJECTS[0]))
    said = [Prompt("cup", 0, [[65, 65]]), *(Prompt("cup", k, [[75, 75]]) for k in range(3, 60))]
    firsts = FirstMasks(path, said)
    assert firsts.add(picture(0), {"cup": square(50, 50)}) == (["cup"], [])
    image = read(path)
    assert firsts.add(picture(2), {"cup": square(50, 50)}) == firsts.add(picture(3), {"cup": None}) == ([], [])
    assert firsts.add(picture(4), {"cup": square(40, 60)}) == ([], ["cup"])
    both = read(path)
    np.testing.assert_array_equal(both[: len(image)], image)
    assert (both[len(image) + 40, 60:90] == cup).all() and len(both) == 2 * len(image)
    for k in range(5, 60):
        assert firsts.add(picture(k), {"cup": square(k, 60)}) == ([], ["cup"])
    many = read(path)
    np.testing.assert_array_equal(many[: len(image)], image)
    assert len(many) == 13 * len(image) and (many[12 * len(image) + 59, 60:90] == cup).all()


def test_objects_have_the_colours_of_the_order_of_their_prompts(tmp_path):
    """As in the rest of a run, whichever of them is seen first."""
    path, said = tmp_path / "first.png", [Prompt("cup", 3, [[65, 65]]), Prompt("box", 0, [[10, 40]])]
    FirstMasks(path, said).add(picture(0), {"box": square(30, 0)})
    first, second = ((read(path) == np.array(rgb(colour))).all(-1).any() for colour in OBJECTS[:2])
    assert second and not first
