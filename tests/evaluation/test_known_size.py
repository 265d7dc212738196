"""Known sizes: what does not fit is said, what may not have been in view is not."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from p2p_lib.evaluation import known_size
from p2p_lib.evaluation.known_size import Lengths, mesh_length_m

NAN = float("nan")


@pytest.mark.parametrize(
    ("mask_m", "mesh_m", "said"),
    [
        (0.10, 0.10, ""),
        (0.12, NAN, ""),
        (0.14, 0.10, ""),  # a mask of it from corner to corner
        (0.18, NAN, "1.80 times: masks hold more"),
        (0.05, 0.10, ""),  # a mask that never showed all of it
        (0.10, 0.06, ""),  # a surface of one side
        (NAN, NAN, ""),
        (0.05, 0.05, "0.50 times: its length was never in view, or focal length .* about this factor"),
        (0.19, 0.21, "2.00 times: masks hold more"),
        (0.10, 0.15, "measured 10.0 cm in its masks and 15.0 cm of its surface, 1.50 times"),
    ],
)
def test_what_does_not_fit_is_said(mask_m, mesh_m, said):
    import re

    lengths = Lengths(0.10, mask_m, mesh_m)
    assert re.search(said, lengths.doubt) if said else not lengths.doubt
    assert bool(lengths.fit) == (not said and mask_m > 0), "measured, and fits"


def test_a_run_is_measured_where_its_masks_show_the_most(tmp_path, monkeypatch):
    """In a quarter of the frames all of it is in view; one mask is twice as long, one without depth."""
    sizes = np.array([0.05] * 14 + [0.10] * 5 + [0.20] + [NAN])
    monkeypatch.setattr(known_size, "load_masks", lambda folder: {"box": SimpleNamespace(size_m=sizes)})
    found = known_size.lengths(tmp_path, {"box": 0.1, "other": 0.1})
    assert found["box"].mask_m == pytest.approx(0.1) and np.isnan(found["other"].mask_m)
    assert known_size.that_fit(found | {"long": Lengths(0.1, 0.3)}) == [
        "box: measured 10.0 cm in its masks, 10 cm given: fits, as 6 to 14 cm would"
    ]


def test_a_mesh_is_as_long_as_its_longest_side_however_it_lies_and_whatever_sticks_out(tmp_path):
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.6, 0.2]))
    box = trimesh.creation.box((0.2, 0.1, 0.05), turn)
    shred = trimesh.creation.box((0.3, 0.002, 0.002), turn)
    trimesh.util.concatenate([box, shred]).export(tmp_path / "box.ply")
    long_m, across = mesh_length_m(tmp_path / "box.ply")
    assert across == pytest.approx(np.hypot(1, 0.5), rel=0.02)
    assert long_m == pytest.approx(0.2, rel=0.02)  # the box fitted around it is not the smallest to the last percent
    assert np.isnan(mesh_length_m(tmp_path / "none.ply")[0])


def test_two_faces_of_a_cube_are_no_longer_cube(tmp_path):
    """Seen from one edge, a box around them is as long as the diagonal of a third face."""
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    cube.update_faces(cube.face_normals[:, :2].sum(1) > 0.5)
    cube.export(tmp_path / "cube.ply")
    long_m, across = mesh_length_m(tmp_path / "cube.ply")
    assert long_m > 0.13 and not Lengths(0.1, NAN, long_m, across).doubt
    assert Lengths(0.1, NAN, long_m).doubt


def test_a_size_in_metres_is_told_from_a_wrong_camera():
    assert "sizes are in centimetres, 0.12 may be metres" in Lengths(0.0012, 0.13, 0.12).doubt
    assert "0.08 may be metres" in Lengths(0.0008, 0.113).doubt, "from corner to corner"
    assert "may be metres" not in Lengths(0.0008, 0.02).doubt
    assert "focal length" in Lengths(0.06, 0.13, 0.12).doubt
