"""Masks that are kept coarsely come back as they were at the pixels that are kept, and measured in metres."""

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.mask_length import CELLS
from p2p_lib.core.types import Frame
from p2p_lib.datasets.mask_log import FILE, MaskLog, load_masks

CAMERA = Camera(500, 500, 159.5, 119.5, 322, 241)
SHAPE = (241, 322)


def picture(index: int, depth_m: float = 0.5) -> Frame:
    return Frame(index, index / 30, np.zeros((*SHAPE, 3), np.uint8), np.full(SHAPE, depth_m, np.float32))


def test_masks_come_back(tmp_path):
    rng, log = np.random.default_rng(0), MaskLog(CAMERA)
    masks = [rng.random(SHAPE) < 0.3, np.zeros(SHAPE, bool), np.ones(SHAPE, bool)]
    masks[0][:90], masks[0][:, :50] = False, False
    for k, mask in enumerate(masks):
        log.add(picture(3 + 2 * k), "cup", mask)
    log.save(tmp_path)
    kept = load_masks(tmp_path)["cup"]
    assert kept.px.tolist() == [np.count_nonzero(mask) for mask in masks]
    assert [kept.row(i) for i in range(2, 8)] == [None, 0, None, 1, None, 2]
    for k, mask in enumerate(masks):
        np.testing.assert_array_equal(kept.cells(k, SHAPE), mask[CELLS])


def test_what_a_mask_holds_is_measured(tmp_path):
    """A bar 200 px long half a metre away is 20 cm long, wherever a few of its pixels see far behind it."""
    log, mask, frame = MaskLog(CAMERA), np.zeros(SHAPE, bool), picture(0)
    mask[100:120, 60:260] = True
    frame.depth_m[100:120, 60:64] = 3.0
    log.add(frame, "bar", mask)
    hidden = picture(1, 0.0)
    log.add(hidden, "bar", mask)
    log.save(tmp_path)
    kept = load_masks(tmp_path)["bar"]
    assert kept.size_m[0] == pytest.approx(0.2, rel=0.05) and np.isnan(kept.size_m[1])
    np.testing.assert_allclose(kept.centre_m[0], [0, -0.01, 0.5], atol=0.005)


def test_a_damaged_file_is_named(tmp_path):
    assert load_masks(tmp_path) == {}
    log = MaskLog(CAMERA)
    log.add(picture(0), "cup", np.ones(SHAPE, bool))
    log.save(tmp_path)
    arrays = dict(np.load(tmp_path / FILE))
    np.savez(tmp_path / FILE, **{key: value for key, value in arrays.items() if key != "cup/px"})
    with pytest.raises(BadInput, match=r"masks\.npz"):
        load_masks(tmp_path)
    np.savez(tmp_path / FILE, **arrays | {"cup/bits": arrays["cup/bits"][:-1]})
    with pytest.raises(BadInput, match="masks: bits"):
        load_masks(tmp_path)
