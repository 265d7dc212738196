"""The picture of the first masks that a run writes."""

import cv2
import numpy as np

from p2p_lib.core.types import Frame
from p2p_lib.datasets.first_masks import FILE, FirstMasks
from p2p_lib.run import run


def test_a_run_writes_and_names_its_first_masks(tmp_path):
    result = run("synthetic/crossing", tmp_path / "run", masks="clicks", stop=2, progress=False)
    picture = cv2.imread(str(tmp_path / "run" / FILE))
    assert picture.shape == (344, 640, 3) and FILE in result.summary[-1]
    run(
        "synthetic/crossing",
        tmp_path / "run",
        masks="clicks",
        objects=["box"],
        stop=1,
        progress=False,
        if_exists="replace",
    )
    assert cv2.imread(str(tmp_path / "run" / FILE)).shape == (344, 320, 3)


def test_an_object_is_drawn_where_it_shows_first(tmp_path):
    frame = Frame(3, 0.1, np.full((60, 80, 3), 90, np.uint8), np.ones((60, 80), np.float32))
    mask, nothing, firsts = np.zeros((60, 80), bool), np.zeros((60, 80), bool), FirstMasks()
    mask[20:40, 30:60] = True
    assert not firsts.add(frame, {"a": nothing, "b": None}) and firsts.add(frame, {"a": mask, "b": None})
    drawn = firsts.tiles["a"].copy()
    assert (drawn == [255, 40, 40]).all(-1).sum() > 300
    assert not firsts.add(frame, {"a": ~mask}) and firsts.add(frame, {"a": ~mask, "b": ~mask})
    np.testing.assert_array_equal(firsts.tiles["a"], drawn)
