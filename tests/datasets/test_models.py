"""Models: every vertex as the file has it, found where they belong, faults named."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.models import find_models, given_models, load_points

POINTS = np.array([[0.01, 0.02, 0.03], [0.04, -0.05, 0.06], [0.01, 0.02, 0.03], [1e-3, 0, -0.1]])  # one twice


def obj_text(points):
    return "# made\nmtllib x.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in points) + "vt 0 0\nvn 0 0 1\nf 1 2 3\n"


def test_obj_keeps_all_vertices_in_order(tmp_path):
    path = tmp_path / "m.obj"
    path.write_text(obj_text(POINTS))  # with a vertex twice and one that no face uses
    np.testing.assert_array_equal(load_points(path), POINTS)


def test_obj_with_colours_and_tabs(tmp_path):
    path = tmp_path / "m.OBJ"
    path.write_text("v 1 2 3 0.5 0.5 0.5\nv\t4 5  6 0.1 0.1 0.1\nvn 0 0 1\n")
    np.testing.assert_array_equal(load_points(path), [[1, 2, 3], [4, 5, 6]])


def test_xyz_with_normals_and_comments(tmp_path):
    path = tmp_path / "points.xyz"
    path.write_text("# x y z nx ny nz\n0.1 0.2 0.3 0 0 1\n\n-1e-2 0 0 1 0 0\n")
    np.testing.assert_array_equal(load_points(path), [[0.1, 0.2, 0.3], [-0.01, 0, 0]])


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply(tmp_path, encoding):
    path = tmp_path / "m.ply"
    path.write_bytes(trimesh.Trimesh(POINTS, [[0, 1, 3]], process=False).export(file_type="ply", encoding=encoding))
    np.testing.assert_allclose(load_points(path), POINTS, atol=1e-8)


def test_ply_of_points_alone(tmp_path):
    path = tmp_path / "m.ply"
    path.write_bytes(trimesh.PointCloud(POINTS).export(file_type="ply"))
    np.testing.assert_allclose(load_points(path), POINTS, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("m.obj", "f 1 2 3\n", r"m\.obj: got no vertices, expected at least one vertex"),
        ("m.xyz", "", r"m\.xyz: got no vertices"),
        ("m.xyz", "0 0 nan\n", r"m\.xyz: got .*not finite"),
        ("m.xyz", "0 0\n", r"m\.xyz: got .*expected at least one vertex of three"),
        ("m.xyz", "0 zero 0\n", r"m\.xyz: got an unreadable model .*zero"),
        ("m.ply", "hello", r"m\.ply: got an unreadable model"),
        ("m.stl", "solid", r"m\.stl: got a file of kind '\.stl', expected a model: \.xyz, \.obj, \.ply"),
        (
            "m.obj",
            obj_text(POINTS * 1000),
            r"m\.obj: got a model 160 m large, expected vertices in metres\. Is it",
        ),
    ],
)
def test_faults_name_the_model(tmp_path, name, text, expected):
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInput, match=expected):
        load_points(tmp_path / name)


def test_a_model_that_is_not_there(tmp_path):
    with pytest.raises(MissingData, match=r"none\.obj: no such file, expected a model"):
        load_points(tmp_path / "none.obj")


def test_models_are_found_in_the_sequence(tmp_path):
    for name, file in (("can", "a.obj"), ("can", "points.xyz"), ("box", "mesh.ply"), ("other", "points.xyz")):
        (tmp_path / "models" / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / "models" / name / file).write_text("")
    (tmp_path / "models" / "empty").mkdir()
    places = {name: (tmp_path / "models" / name,) for name in ("box", "can", "empty", "mug")}
    places["cup"] = (tmp_path / "none", tmp_path / "models/can/a.obj", tmp_path / "models/can")
    found = find_models(SimpleNamespace(model_places=places))
    expected = {"box": "box/mesh.ply", "can": "can/points.xyz", "cup": "can/a.obj"}
    assert found == {name: tmp_path / "models" / file for name, file in expected.items()}
    assert find_models(SimpleNamespace(model_places={})) == {}


def test_bops_models_are_in_millimetres(tmp_path):
    mesh = trimesh.Trimesh(POINTS * 1000, [[0, 1, 3]], process=False)
    (tmp_path / "obj_000001.ply").write_bytes(mesh.export(file_type="ply"))
    with pytest.raises(BadInput, match="vertices in metres"):
        load_points(tmp_path / "obj_000001.ply")
    (tmp_path / "models_info.json").write_text("{}")
    np.testing.assert_allclose(load_points(tmp_path / "obj_000001.ply"), POINTS, atol=1e-8)


def test_models_that_are_given(tmp_path):
    file = tmp_path / "a=b.obj"
    file.write_text(obj_text(POINTS))
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "points.xyz").write_text("0 0 0\n")
    models = given_models({"can": file, "box": tmp_path / "folder"}, ("box", "can"))
    assert models == {"can": file, "box": tmp_path / "folder" / "points.xyz"}
    with pytest.raises(BadInput, match=r"model: got the name 'mug', expected one of the objects: box, can"):
        given_models({"mug": file}, ("box", "can"))
    with pytest.raises(MissingData, match=r"gone\.obj: no such model"):
        given_models({"can": tmp_path / "gone.obj"}, ("box", "can"))


def test_shared_models(shared_data):
    mustard = load_points(shared_data / "ycbineoat" / "006_mustard_bottle_ycbvideo_frame.obj")
    assert mustard.shape == (7866, 3) and 0.18 < np.ptp(mustard, axis=0).max() < 0.2
    sugar = load_points(shared_data / "ycb_models" / "004_sugar_box" / "textured.obj")
    assert sugar.shape == (8194, 3)
