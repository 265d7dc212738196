"""Models to take away: what they look like, opened by other libraries, and how near they are to the truth."""

import json
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.native import load_open3d
from p2p_lib.core.raycasting import SurfaceDistance
from p2p_lib.core.types import evenly
from p2p_lib.datasets.models import MESHES, find_models, load_mesh
from p2p_lib.datasets.runs import load_run
from p2p_lib.offline import holes, model, texture
from p2p_lib.offline.finished import Finished, Renderer
from p2p_lib.offline.products import write_product
from tests.fixtures.made_run import T_OBJ_MODEL


@pytest.fixture(scope="module")
def models(made, tmp_path_factory):
    from p2p_lib.core.mesh import save

    folder = tmp_path_factory.mktemp("models")
    run = shutil.copytree(made.run.path, folder / "run")
    for name, path in find_models(made.sequence, MESHES).items():
        vertices, faces = load_mesh(path)
        surface = trimesh.Trimesh(se3.transform(T_OBJ_MODEL, vertices), faces, process=False).subdivide_to_size(0.006)
        surface.visual.vertex_colors = np.full((len(surface.vertices), 3), 128, np.uint8)
        save(surface, run / "meshes" / f"{name}.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(texture, "VIEWS", 8)
        said = write_product(run, "model", folder / "out", faces=3000)
    assert "open: " not in said and "texture of 1 views" not in said
    return folder / "out"


def test_other_libraries_open_them_in_metres(made, models):
    open3d = load_open3d()
    for name, path in find_models(made.sequence, MESHES).items():
        true = se3.transform(T_OBJ_MODEL, load_mesh(path)[0])
        for kind in ("obj", "glb"):
            file = models / name / f"textured_simple.{kind}"
            mesh = trimesh.load(file, force="mesh")
            assert len(mesh.faces) <= 3000 and mesh.visual.uv.shape == (len(mesh.vertices), 2)
            np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), np.ptp(true, axis=0), atol=0.004)
        read = open3d.io.read_triangle_mesh(str(models / name / "textured_simple.obj"), True)
        assert read.has_triangle_uvs() and np.asarray(read.textures[0]).shape[0] in (512, 1024, 2048)
        hull = trimesh.load(models / name / "collision.obj")
        assert hull.is_watertight and hull.is_convex and len(hull.faces) <= 256
        about = json.loads((models / name / "model.json").read_text())
        assert about["units"] == "m" and about["watertight"]
        assert (about["parts"], about["holes"], about["largest_hole_m"]) == (1, 0, 0)
        # Of a body however it lies in its frame: here turned and shifted.
        sides_m = sorted(trimesh.Trimesh(true).bounding_box_oriented.primitive.extents, reverse=True)
        np.testing.assert_allclose(about["size_m"], sides_m, atol=0.005)


def test_blender_opens_them_in_metres(made, models):
    bpy = pytest.importorskip("bpy")
    for name, path in find_models(made.sequence, MESHES).items():
        size_m = np.ptp(se3.transform(T_OBJ_MODEL, load_mesh(path)[0]), axis=0)
        for kind, read in (("obj", bpy.ops.wm.obj_import), ("glb", bpy.ops.import_scene.gltf)):
            bpy.ops.wm.read_factory_settings(use_empty=True)
            read(filepath=str(models / name / f"textured_simple.{kind}"))
            meshes = [each for each in bpy.data.objects if each.type == "MESH"]
            vertices = np.array([each.matrix_world @ v.co for each in meshes for v in each.data.vertices])
            # Both importers take y for up, where Blender has z.
            np.testing.assert_allclose(np.ptp(vertices, axis=0), size_m[[0, 2, 1]], atol=0.004)
            assert all(each.data.uv_layers for each in meshes)
            assert any(image.size[0] in (512, 1024, 2048) for image in bpy.data.images)


def test_the_texture_is_what_the_camera_saw(models):
    for folder in models.iterdir():
        off = json.loads((folder / "model.json").read_text())["colour_error_of_255"]
        assert off["texture"] < 0.6 * off["vertex_colours"]  # which are grey here
        assert cv2.imread(str(folder / "textured_simple.png")).std() > 10


def test_obj_and_glb_show_the_same(models):
    meshes = [trimesh.load(models / "box" / f"textured_simple.{kind}", force="mesh") for kind in ("obj", "glb")]
    colours = []
    for mesh in meshes:
        image = getattr(mesh.visual.material, "image", None) or mesh.visual.material.baseColorTexture
        middle = mesh.visual.uv[mesh.faces].mean(1)
        order = np.lexsort(mesh.triangles_center.round(4).T)
        colours.append(trimesh.visual.color.uv_to_color(middle, image)[order, :3].astype(float))
    assert np.abs(colours[0] - colours[1]).mean() < 2


def test_foundationpose_folders(finished, made, models, tmp_path, monkeypatch):
    asked = []

    def made_before(run, out, *how):
        asked.append((run, *how))
        shutil.copytree(models, out)

    monkeypatch.setattr(model, "write_models", made_before)
    write_product(finished, "foundationpose", tmp_path / "fp", 0.4, faces=500)
    assert asked == [(finished, 500, 0.4, False)]
    for name in made.sequence.objects:
        folder = tmp_path / "fp" / name
        (mask,) = (folder / "masks").iterdir()
        rgb = sorted((folder / "rgb").iterdir())
        assert mask.name == rgb[0].name == sorted((folder / "depth").iterdir())[0].name
        own = made.sequence.masks(int(mask.stem))[name]
        np.testing.assert_array_equal(cv2.imread(str(mask), -1) > 0, own)
        depth = cv2.imread(str(folder / "depth" / mask.name), -1) / 1000
        np.testing.assert_allclose(depth, made.sequence.frame(int(mask.stem)).depth_m, atol=0.0005)
        np.testing.assert_allclose(np.loadtxt(folder / "cam_K.txt"), made.sequence.camera.K)
        assert {"textured_simple.obj", "textured_simple.png"} <= {path.name for path in (folder / "mesh").iterdir()}


def box(open_above=True):
    mesh = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide_to_size(0.02)
    keep = ~((mesh.triangles_center[:, 2] > 0.049) & open_above)
    mesh.update_faces(keep)
    mesh.remove_unreferenced_vertices()
    n = len(mesh.faces)
    return model.Shape(
        np.array(mesh.vertices), np.array(mesh.faces), np.zeros((len(mesh.vertices), 3)), np.zeros(n, bool)
    )


def test_holes_are_closed_and_marked_unless_a_camera_looked_through():
    camera = Camera(300, 300, 79.5, 59.5, 160, 120)
    above = se3.from_rt(np.diag([1.0, -1, -1]), np.array([0, 0, 0.3]))  # looks down on the opening, 25 cm away
    into = [(above, np.full((120, 160), 0.35, np.float32))] * 3  # and sees the bottom
    onto = [(above, np.full((120, 160), 0.25, np.float32))] * 3
    shut = model.closed(box(), camera, onto)
    assert shut.mesh.is_watertight and shut.guessed.any() and not shut.guessed[: len(box().faces)].any()
    assert (shut.vertices[shut.faces[shut.guessed]][..., 2] > 0.049).all()
    still_open = model.closed(box(), camera, into)
    assert not still_open.mesh.is_watertight and not still_open.guessed.any()


def test_files_tell_what_is_guessed_from_what_was_seen(tmp_path):
    shape = model.closed(box(), Camera(300, 300, 79.5, 59.5, 160, 120), [])
    image = np.random.default_rng(0).integers(0, 255, (512, 512, 3), np.uint8)
    textured = model.Textured(shape, model.atlas(len(shape.faces), 512), image)
    model.write_glb(textured, tmp_path / "box.glb")
    read = trimesh.load(tmp_path / "box.glb")
    assert set(read.geometry) == {"seen", "guessed"}
    for name, of in (("seen", ~shape.guessed), ("guessed", shape.guessed)):
        mesh, own = read.geometry[name], trimesh.Trimesh(shape.vertices, shape.faces[of], process=False)
        np.testing.assert_allclose(mesh.triangles, own.triangles, atol=1e-6)
        np.testing.assert_allclose(mesh.visual.uv[mesh.faces], textured.uv[of], atol=1e-5)
        np.testing.assert_array_equal(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), image)
    whole = trimesh.load(tmp_path / "box.glb", force="mesh")
    assert len(whole.faces) == len(shape.faces) and whole.visual.material.baseColorTexture.size == (512, 512)
    model.write_obj(textured, tmp_path)
    lines = (tmp_path / "textured_simple.obj").read_text().splitlines()
    assert sum(line.startswith("f ") for line in lines[lines.index("g guessed") :]) == shape.guessed.sum() > 0


def test_a_hole_is_looked_through_by_its_area_not_by_its_many_small_faces():
    camera, ahead = Camera(300, 300, 79.5, 59.5, 160, 120), se3.from_rt(np.eye(3), np.array([0, 0, 0.3]))
    x, y = np.linspace(0.04, 0.05, 41), np.array([-0.05, 0.05])
    lid = np.array(
        [[[-0.05, y[0], 0], [0.04, y[0], 0], [0.04, y[1], 0]], [[-0.05, y[0], 0], [0.04, y[1], 0], [-0.05, y[1], 0]]]
    )
    low, high = (np.stack([x, np.full(41, at), 0 * x], 1) for at in y)
    strip = np.concatenate([np.stack([low[:-1], low[1:], high[1:]], 1), np.stack([low[:-1], high[1:], high[:-1]], 1)])
    depth_m = np.full((120, 160), 0.35, np.float32)
    depth_m[:, 118:] = 0.3  # where the strip of small faces is
    for depths, open_ in (([depth_m] * 3, True), ([depth_m], False), ([np.full_like(depth_m, 0.3)] * 3, False)):
        views = [(ahead, depth) for depth in depths]
        assert model._seen_through(np.concatenate([lid, strip]), camera, views) == open_


def tin(columns=400, rows=20):
    """A tin of radius 5 cm and height 10 cm, open above."""
    k, turn = np.arange(columns), 2 * np.pi * np.arange(columns) / columns
    ring = 0.05 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    wall = [ring + np.array([0, 0, 0.1 * row / rows]) for row in range(rows + 1)]
    low, after = columns * np.arange(rows)[:, None], (k + 1) % columns
    a, b, c, d = low + k, low + after, low + columns + k, low + columns + after
    sides = [np.stack(of, -1).reshape(-1, 3) for of in ((a, b, d), (a, d, c))]
    bottom = np.stack([np.full(columns, columns * (rows + 1)), after, k], 1)
    return trimesh.Trimesh(np.concatenate([*wall, np.zeros((1, 3))]), np.concatenate([*sides, bottom]), process=False)


def as_shape(mesh):
    n = len(mesh.vertices), len(mesh.faces)
    return model.Shape(np.array(mesh.vertices), np.array(mesh.faces), np.zeros((n[0], 3)), np.zeros(n[1], bool))


def test_a_large_ragged_hole_is_closed_and_stays_closed_with_fewer_faces():
    """Its rim has more than 500 edges, and other holes meet it and each other at vertices."""
    mesh, camera = tin(), Camera(300, 300, 79.5, 59.5, 160, 120)
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.098 - 0.018 * np.random.default_rng(0).random(len(mesh.faces)))
    there = holes.unpinched(mesh.faces)
    assert max(map(len, holes.rims(mesh.faces[there]))) > 500 < (~there).sum()
    shut = model.closed(as_shape(mesh), camera, [])
    for made in (shut, model.whole(as_shape(mesh), 2000, camera, [])):
        parts, across_m = model.torn(made)
        assert parts == 1 and not len(across_m) and made.mesh.is_watertight and made.mesh.is_winding_consistent
        assert np.pi * 0.05**2 * 0.08 < made.mesh.volume < np.pi * 0.05**2 * 0.09
        guessed = made.vertices[made.faces[made.guessed]].reshape(-1, 3)
        assert guessed[:, 2].min() > 0.07 and np.linalg.norm(guessed[:, :2], axis=1).max() < 0.0505
    assert len(made.faces) <= 2000


def test_what_is_simplified_stays_whole():
    """A sheet without thickness, closed by its back, tears where the two touch; a splinter is no part of it."""
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 41), np.linspace(-0.1, 0.1, 41))
    k, camera = np.arange(41 * 41).reshape(41, 41), Camera(300, 300, 79.5, 59.5, 160, 120)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel()
    splinter = np.array([[0, 41 * 41, 41 * 41 + 1]])
    vertices = np.concatenate([np.stack([x, y, 0 * x], -1).reshape(-1, 3), [[-0.11, -0.1, 0], [-0.1, -0.11, 0]]])
    sheet = trimesh.Trimesh(vertices, np.concatenate([np.c_[a, b, d], np.c_[a, d, c], splinter]), process=False)
    full = model.closed(as_shape(sheet), camera, [])
    assert model.torn(full)[0] == 1 and np.abs(full.vertices).max() < 0.101
    assert len(model.torn(model.simplified(full, 300))[1]), "what this test is about"
    few = model.whole(as_shape(sheet), 300, camera, [])
    assert model.torn(few)[0] == 1 and few.mesh.is_watertight and len(few.faces) <= 300


def test_parts_and_holes_are_counted():
    whole, opened = model.closed(box(), Camera(300, 300, 79.5, 59.5, 160, 120), []), box()
    (parts, none), (one, across_m) = model.torn(whole), model.torn(opened)
    assert (parts, len(none), one) == (1, 0, 1)
    np.testing.assert_allclose(across_m, [0.1 * 2**0.5])
    n = len(whole.vertices)
    two = np.concatenate([whole.faces, n + opened.faces])
    pair = model.Shape(np.tile(whole.vertices, (2, 1)), two, np.tile(whole.colours, (2, 1)), np.zeros(len(two), bool))
    parts, across_m = model.torn(pair)
    assert (parts, len(across_m)) == (2, 1)


def test_what_is_open_is_told_however_few_holes_it_has():
    assert model.how_open(1, 0, 0.0, False) == ""
    assert model.how_open(1, 1, 0.123, True) == "; open: 1 hole, the largest 12.3 cm across"
    torn = model.how_open(2, 12, 0.02, False)
    assert torn.startswith("; in 2 parts; open: 12 holes, the largest 2.0 cm across: a model of RUN/offline")
    assert "refine" not in model.how_open(2, 0, 0.0, True)


def test_fewer_faces_keep_the_shape_and_what_is_guessed():
    shape = model.closed(box(), Camera(300, 300, 79.5, 59.5, 160, 120), [])
    few = model.simplified(shape, 100)
    assert len(few.faces) <= 100 and few.guessed.any()
    assert (few.vertices[few.faces[few.guessed]].mean(1)[:, 2] > 0.04).all()
    assert SurfaceDistance(few.vertices, few.faces)(shape.vertices).max() < 0.002


def test_of_one_direction_the_sharpest_frame_is_taken(monkeypatch):
    sharpness = np.random.default_rng(0).uniform(1, 9, 40)
    T = np.tile(se3.from_rt(np.eye(3), np.array([0, 0, 0.5])), (40, 1, 1))
    T[20:] = T[20:] @ se3.exp(np.array([0, 1.0, 0, 0, 0, 0]))  # seen from two sides
    made = SimpleNamespace(run=SimpleNamespace(objects={"box": SimpleNamespace(T_cam_obj=T)}))
    nothing = np.zeros((1, 1, 3), np.float32), np.zeros((1, 1), bool), np.zeros((1, 1), np.float32)
    monkeypatch.setattr(texture, "view_of", lambda *of: texture.View(of[2], T[of[2]], *nothing, sharpness[of[2]]))
    chosen = [view.frame for view in texture.chosen_rows(made, "box", np.arange(40), None)]
    looked_at = [evenly(of, texture._SHARPEST_OF) for of in (np.arange(20), np.arange(20, 40))]
    assert chosen == [rows[sharpness[rows].argmax()] for rows in looked_at]


CAMERA = Camera(300, 300, 79.5, 59.5, 160, 120)
TOWARDS, HALF_A_METRE = np.array([[0, 0, -1.0]]), se3.from_rt(np.eye(3), np.array([0, 0, 0.5]))


def grey_views(*greys_and_sharpness):
    """Views of a plane at half a metre, each of one grey and sharpness."""
    depth_m, shows = np.full((120, 160), 0.5, np.float32), np.ones((120, 160), bool)
    return [
        texture.View(k, HALF_A_METRE, np.full((120, 160, 3), grey, np.float32), shows, depth_m, sharpness)
        for k, (grey, sharpness) in enumerate(greys_and_sharpness)
    ]


def test_what_shows_a_point_better_counts_more():
    own, p = np.full((1, 3), 7.0), np.zeros((1, 3))
    sharp_first, sharp_last = (
        texture.baked(grey_views((100, one), (102, other)), CAMERA, p, TOWARDS, own) for one, other in ((9, 1), (1, 9))
    )
    assert (sharp_first == 100).all() and (sharp_last == 102).all()
    assert (texture.baked([], CAMERA, p, TOWARDS, own) == 7).all()
    (blind,) = grey_views((50, 9))
    blind.shows[:] = False
    assert (texture.baked([blind], CAMERA, p, TOWARDS, own) == 7).all()


def test_a_reflection_that_few_views_have_is_left_out():
    views = grey_views(*((40, 1.0),) * 7, *((220, 1.0),) * 3)
    assert (texture.baked(views, CAMERA, np.zeros((1, 3)), TOWARDS, np.zeros((1, 3))) <= 48).all()  # their mean is 94


def test_a_colour_error_is_of_the_best_gains():
    """As a search over gains finds them; a quarter of it is of another colour, as a print is, and in another light."""
    rng = np.random.default_rng(0)
    (view,) = grey_views((0, 1.0))
    printed = rng.random((120, 160, 1)) < 0.25
    rendered = np.where(printed, [200, 140, 90], [30, 160, 120]) + rng.integers(0, 9, (120, 160, 3))
    view.rgb[:] = rendered * np.where(printed, 1.2, [0.8, 1.1, 1.3]) + rng.normal(0, 4, rendered.shape)
    off = [np.abs(np.clip(rendered * g, 0, 255) - view.rgb).mean((0, 1)) for g in np.linspace(0.7, 1.4, 701)]
    found = texture.colour_error(view, rendered.astype(np.uint8), view.shows)
    assert np.isclose(found, np.min(off, axis=0).mean(), atol=0.01)
    assert np.isnan(texture.colour_error(view, rendered.astype(np.uint8), np.zeros_like(view.shows)))


def test_exposure_is_evened_out():
    rng = np.random.default_rng(0)
    print_ = cv2.resize(rng.uniform(60, 180, (12, 16, 3)).astype(np.float32), (160, 120))
    views = [replace(view, rgb=print_ * gain) for view, gain in zip(grey_views(*[(0, 10.0)] * 3), (0.8, 1.0, 1.25))]
    p = np.stack([*rng.uniform(-0.08, 0.08, (2, 500)), np.zeros(500)], 1)
    even = texture.evened(views, CAMERA, p, np.tile(TOWARDS, (500, 1)))
    for view in even:
        assert np.abs(view.rgb[10:-10, 10:-10] / even[1].rgb[10:-10, 10:-10] - 1).max() < 0.02


def test_a_texture_that_is_no_better_than_vertex_colours_is_told(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(model, "errors", lambda *of: {"texture": 16.34, "vertex_colours": 15.52, "frames": 12})
    monkeypatch.setattr(model, "beside", lambda *of: 0.08)
    chosen = texture.chosen_rows  # of one row: all take their time
    monkeypatch.setattr(texture, "chosen_rows", lambda made, name, rows, of: chosen(made, name, rows[:1], of))
    told = write_product(finished, "model", tmp_path / "out", faces=3000)
    assert "texture of 1 view," in told
    assert ", no better than the surface's vertex colours (error 16.3 against 15.5 of 255)" in told
    assert ", 8 % of its masks lie beside it: it lacks a part" in told
    assert model.no_better({"texture": 9.0, "vertex_colours": 15.5}) == ""


def grown(mask: np.ndarray, by_px: int) -> np.ndarray:
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) <= by_px


def test_a_model_that_lacks_a_part_is_told(finished):
    """None, a tenth and three tenths of a box are cut off."""
    whole, made = trimesh.load(finished / "meshes/box.ply"), Finished.of(finished)
    axis, shares = int(np.argmax(np.ptp(whole.bounds, axis=0))), []
    for cut in (0.0, 0.1, 0.3):
        vertices, top = whole.vertices.copy(), whole.bounds[1, axis] - cut * np.ptp(whole.bounds[:, axis])
        vertices[:, axis] = np.minimum(vertices[:, axis], top)
        render = Renderer(vertices, whole.faces, made.sequence.camera)
        shares.append(model.beside(made, "box", np.arange(0, len(made.frames), 4), render))
    assert shares[0] == 0 and shares[0] < shares[1] < shares[2]
    # A surface without its fringe lacks no part, and with masks of every fourth pixel one without a wider fringe.
    for off_px, exact in ((4, True), (8, False)):
        masks = {int(i): {"box": grown(made.masks(int(i))["box"], off_px)} for i in made.frames[::4]}
        wide = SimpleNamespace(frames=made.frames, run=made.run, masks=masks.get, exact_masks=exact)
        wide.beside = partial(Finished.beside, wide)
        render = Renderer(whole.vertices, whole.faces, made.sequence.camera)
        assert model.beside(wide, "box", np.arange(0, len(made.frames), 4), render) == 0
    assert model.lacks(shares[0]) == "" and "lacks a part" in model.lacks(shares[2])


@pytest.mark.parametrize(("share", "says"), [(0.1, ""), (0.6, "6")])
def test_a_model_of_doubted_poses_says_so_first(finished, share, says):
    obj = load_run(finished).objects["box"]
    obj = obj.select(obj.has_pose)
    doubted = replace(obj, confidence=np.where(np.arange(len(obj)) < share * len(obj), 0.3, 0.9))
    said = model.suspect(doubted, [])
    assert bool(said) == bool(says) and said.startswith(says) and ("(median confidence 0.30)" in said) == bool(says)


def test_a_model_has_the_verdict_of_its_run(finished, tmp_path):
    """As ``p2p eval`` gives it: of its own doubts, of what the images show, and of known sizes."""
    info = json.loads((finished / "run.json").read_text())
    doubts, options = [{"text": "clicks on 'box': flat", "object": "box", "kind": ""}], {"sizes": {"can": "90"}}
    (finished / "run.json").write_text(json.dumps(info | {"doubts": doubts, "options": options}))
    said = write_product(finished, "model", tmp_path / "models", faces=500)
    of = {name: json.loads((tmp_path / "models" / name / "model.json").read_text()) for name in ("box", "can")}
    assert [about["verdict"] for about in of.values()] == ["look", "look"]
    assert of["box"]["look_at"] == ["clicks on 'box': flat"] and "known to be 90 cm" in of["can"]["look_at"][0]
    assert "box: the run's verdict is look (start): p2p eval says why" in said


def test_a_surface_is_cleaned_of_what_no_object_has():
    """A ball with the steps of voxels, a speck beside it, a face without area and a third face at an edge."""
    ball = trimesh.creation.icosphere(4, 0.05)
    rough = np.rint(ball.vertices / 0.002) * 0.002
    speck = trimesh.creation.icosphere(1, 0.003)
    (a, b, c), (d, e, _) = ball.faces[0], ball.faces[len(ball.faces) // 2]
    middle = len(rough) + len(speck.vertices)  # of an edge; the vertex after it is off the ball
    vertices = np.concatenate(
        [rough, speck.vertices + np.array([0.1, 0, 0]), [(rough[a] + rough[b]) / 2], [rough[d] * 1.02]]
    )
    split, off = [[a, middle, c], [middle, b, c], [a, b, middle]], [[d, e, middle + 1]]
    faces = np.concatenate([ball.faces[1:], speck.faces + len(rough), split, off])
    surface = trimesh.Trimesh(vertices, faces, process=False)
    surface.visual.vertex_colors = np.full((len(vertices), 3), 128, np.uint8)
    got = model.cleaned(surface)
    assert np.linalg.norm(got.vertices, axis=1).max() < 0.06, "the speck is gone"
    flat = trimesh.Trimesh(rough, ball.faces, process=False).area_faces < 1e-12
    assert len(got.faces) == (~flat).sum() + 1, "of the faces that were added the two halves alone are left"
    off_m, steps_m = (np.linalg.norm(of, axis=1) - 0.05 for of in (got.vertices, rough))
    assert np.std(off_m) < 0.6 * np.std(steps_m) and abs(off_m.mean()) < 5e-4
