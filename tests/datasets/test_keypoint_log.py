"""Keypoints of a run: what is written is read back, whoever comes and goes."""

import numpy as np
import pytest

from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.keypoint_log import FILE, KeypointLog, load_keypoints


def test_keypoints_survive_the_file(tmp_path):
    rng, log = np.random.default_rng(0), KeypointLog()
    seen = {k: (np.sort(rng.choice(40, k, replace=False)), rng.uniform(0, 640, (k, 2))) for k in (0, 3, 7)}
    for frame, (ids, uv_px) in zip((4, 5, 9), seen.values()):
        log.add(frame, "my mug/left", ids, uv_px)
    p_obj, promoted = rng.normal(size=(5, 3)), rng.random(5) < 0.5
    nobody = np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, bool)
    log.save(tmp_path, {"my mug/left": (np.arange(5), p_obj, promoted), "never seen": nobody})
    read = load_keypoints(tmp_path)
    assert list(read) == ["my mug/left", "never seen"] and len(read["never seen"].ids) == 0
    mug = read["my mug/left"]
    np.testing.assert_allclose(mug.p_obj, p_obj, atol=1e-6)
    assert mug.promoted.tolist() == promoted.tolist() and mug.ids.tolist() == [0, 1, 2, 3, 4]
    for frame, (ids, uv_px) in zip((4, 5, 9), seen.values()):
        assert mug.track_id[mug.at(frame)].tolist() == ids.tolist()
        np.testing.assert_allclose(mug.uv_px[mug.at(frame)], uv_px, atol=1e-4)
    assert len(mug.track_id[mug.at(7)]) == 0


def test_no_file_and_a_damaged_one(tmp_path):
    assert load_keypoints(tmp_path) == {}
    (tmp_path / FILE).write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(BadInput, match=r"keypoints\.npz: got an unreadable archive"):
        load_keypoints(tmp_path)
