"""Files are written whole, and hold nothing that runs when it is read."""

import numpy as np
import pytest

from p2p_lib.core.files import save_arrays


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_of_objects_are_not_pickled(tmp_path, compressed):
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        save_arrays(tmp_path / "a.npz", {"a": np.array([{}], object)}, compressed)
    assert not list(tmp_path.iterdir())
