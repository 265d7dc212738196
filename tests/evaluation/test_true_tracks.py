"""True tracks: against the renderer's exact ones, by mesh and by depth; and against plane geometry."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.types import Frame
from p2p_lib.datasets.models import MESHES, find_models, load_mesh
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.true_tracks import SurfacePoints, TrueScene, draw_queries, true_tracks
from p2p_lib.synthetic import SCENARIOS
from tests.synthetic.surface_points import see

EVERY = 15  # frames of crossing looked at


@pytest.fixture(scope="module")
def crossing():
    return open_sequence("synthetic/crossing")


@pytest.fixture(scope="module")
def exact(crossing):
    """Random points on the true surfaces and where exact geometry has them, in the frames looked at."""
    scenario = SCENARIOS["crossing"](0)
    bodies = {body.name: (k, body) for k, body in enumerate(scenario.bodies, 1)}
    points = {name: bodies[name][1].mesh.sample(256, np.random.default_rng(0)) for name in crossing.truth}
    uv_px = np.full((len(crossing), 256 * len(points), 2), np.nan)
    visible = np.zeros(uv_px.shape[:2], bool)
    for t in range(0, len(crossing), EVERY):
        image = scenario.rendered(t, None)
        for i, (name, at) in enumerate(points.items()):
            label, body = bodies[name]
            T_cam_model = se3.inverse(scenario.T_world_cam[t]) @ body.T_world_model[t]
            rows = slice(256 * i, 256 * (i + 1))
            uv_px[t, rows], visible[t, rows] = see(
                crossing.camera, T_cam_model, at, image.depth_m, image.label == label
            )
    owner = np.repeat(np.arange(len(points)), 256)
    p_model = np.concatenate([at[0] for at in points.values()])
    return {"uv_px": uv_px, "visible": visible, "object_index": owner, "p_model": p_model}


@pytest.fixture(scope="module")
def by_mesh(crossing):
    return TrueScene(crossing, find_models(crossing, MESHES))


@pytest.fixture(scope="module")
def by_depth(crossing):
    return TrueScene(crossing)


def lifted(scene, exact):
    """Every point of the renderer's, lifted where it first shows in the frames looked at."""
    t0 = exact["visible"][::EVERY].argmax(0) * EVERY
    ever = exact["visible"][::EVERY].any(0)
    p_model, normal = np.full((2, len(t0), 3), np.nan)
    for t in np.unique(t0[ever]):
        rows = np.flatnonzero(ever & (t0 == t))
        found = scene.lift(scene.sequence.frame(t), exact["object_index"][rows], exact["uv_px"][t, rows].astype(float))
        p_model[rows], normal[rows] = found.p_model, found.normal
    return np.flatnonzero(ever), SurfacePoints(exact["object_index"][ever], p_model[ever], normal[ever])


def test_a_ray_meets_the_very_point(by_mesh, exact):
    rows, points = lifted(by_mesh, exact)
    assert len(rows) > 400
    # JPEG and depth noise play no part: pixel, mesh and pose are exact.
    off_m = np.linalg.norm(points.p_model - exact["p_model"][rows], axis=1)
    assert np.mean(off_m < 1e-5) > 0.995


def test_tracks_by_mesh_are_the_renderers(by_mesh, exact):
    rows, points = lifted(by_mesh, exact)
    agree, off_px = [], []
    for t in range(0, len(by_mesh.sequence), EVERY):
        sight = by_mesh.see(by_mesh.sequence.frame(t), points)
        truly = exact["visible"][t, rows]
        assert sight.known.all()
        agree.append(sight.visible == truly)
        off_px.append(np.linalg.norm(sight.uv_px - exact["uv_px"][t, rows], axis=1)[truly])
    assert np.mean(agree) > 0.985
    assert np.percentile(np.concatenate(off_px), 99) < 0.02


def test_tracks_by_depth_are_nearly_those(by_depth, exact):
    """Without a mesh the sensor's noise decides: a pixel or so, and the far side is told by depth alone."""
    rows, points = lifted(by_depth, exact)
    met = np.isfinite(points.p_model[:, 0])
    assert met.mean() > 0.8
    rows, points = rows[met], points.select(met)
    agree, off_px = [], []
    for t in range(0, len(by_depth.sequence), EVERY):
        sight = by_depth.see(by_depth.sequence.frame(t), points)
        truly = exact["visible"][t, rows]
        agree.append(sight.visible == truly)
        off_px.append(np.linalg.norm(sight.uv_px - exact["uv_px"][t, rows], axis=1)[truly])
    assert np.mean(agree) > 0.93
    assert np.median(np.concatenate(off_px)) < 1.5


def test_queries_are_visible_pixels_of_four_frames(by_mesh):
    queries = draw_queries(by_mesh, np.random.default_rng(0))
    assert len(queries) == 256
    assert np.unique(queries.frame, return_counts=True)[0].tolist() == [0, 75, 150, 225]
    assert np.unique(queries.frame, return_counts=True)[1].tolist() == [64] * 4
    for t in np.unique(queries.frame):
        now = queries.frame == t
        sight = by_mesh.see(by_mesh.sequence.frame(t), queries.points.select(now))
        assert sight.visible.all() and sight.known.all()
        np.testing.assert_allclose(sight.uv_px, queries.uv_px[now], atol=1e-2)
    # Spread over the masks, not bunched: the carton's share of pixels is its share of points.
    masks = by_mesh.sequence.masks(0)
    share = masks["box"].sum() / sum(m.sum() for m in masks.values())
    assert np.mean(queries.points.object[queries.frame == 0] == 0) == pytest.approx(share, abs=0.2)


def test_queries_follow_their_seed(by_mesh):
    first, same, other = (draw_queries(by_mesh, np.random.default_rng(s), 16) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.uv_px, same.uv_px)
    assert (first.uv_px != other.uv_px).any()


# --- a plate whose truth can be written down ----------------------------------------------------


class Plate:
    """A square plate, 0.2 m wide, 1 m away, turning about the vertical through the frames' angles."""

    name, path, objects, format = "plate", None, ("plate",), "ycbineoat"

    def __init__(self, crossing, turns_deg, depth_m=None, mask=True, labelled=None):
        from p2p_lib.core import se3
        from p2p_lib.datasets.truth import ObjectTruth

        self.camera, self._depth, self._mask = crossing.camera, depth_m, mask
        T = se3.exp(np.array([[0, np.radians(d), 0, 0, 0, 0] for d in turns_deg]))
        T[:, 2, 3] = 1.0
        n = len(T)
        self.truth = {"plate": ObjectTruth(T, np.ones(n, bool) if labelled is None else np.array(labelled))}

    def __len__(self):
        return len(self.truth["plate"].labelled)

    def frame(self, i):
        depth = np.full((480, 640), 1.0 if self._depth is None else self._depth[i], np.float32)
        return Frame(i, i / 30, np.zeros((480, 640, 3), np.uint8), depth)

    def masks(self, i):
        return {"plate": np.full((480, 640), self._mask)} if self._mask is not None else None


@pytest.fixture(scope="module")
def plate_mesh(tmp_path_factory):
    path = tmp_path_factory.mktemp("plate") / "plate.obj"
    square = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
    path.write_text("".join(f"v {x} {y} 0\n" for x, y in square) + "f 1 3 2\nf 1 4 3\n")
    return {"plate": path}


def seen(plate, mesh=None):
    """Visibility (T,) and known (T,) of the plate's middle, lifted in frame 0."""
    scene = TrueScene(plate, mesh)
    middle = np.array([[plate.camera.cx, plate.camera.cy]])
    points = scene.lift(plate.frame(0), np.zeros(1, int), middle)
    tracks = true_tracks(scene, points)
    np.testing.assert_allclose(points.p_model[0], 0, atol=1e-6)
    return tracks.visible[:, 0].tolist(), tracks.known[:, 0].tolist()


@pytest.mark.parametrize("with_mesh", [True, False])
def test_a_surface_turned_away_is_invisible(crossing, plate_mesh, with_mesh):
    turns = [0, 60, 83, 86, 120, 180, 300]
    assert seen(Plate(crossing, turns), plate_mesh if with_mesh else None)[0] == [
        True, True, True, False, False, False, True
    ]  # fmt: skip


def test_measured_depth_must_agree(crossing, plate_mesh):
    depths = [1.0, 0.985, 0.975, 1.015, 1.03, 0.0]
    assert seen(Plate(crossing, [0] * 6, depths), plate_mesh)[0] == [True, True, False, True, False, True]
    # Without masks, a pixel that measures nothing is no witness.
    assert seen(Plate(crossing, [0] * 6, depths, mask=None), plate_mesh)[0] == [True, True, False, True, False, False]


def test_where_labels_do_not_hold(crossing, plate_mesh):
    labelled = [True, False]
    assert seen(Plate(crossing, [0, 0], labelled=labelled), plate_mesh) == ([True, False], [True, False])
    assert seen(Plate(crossing, [0, 0], mask=False, labelled=labelled), plate_mesh) == ([False] * 2, [True] * 2)


def test_a_mesh_hides_its_own_far_side(crossing, plate_mesh, tmp_path):
    plates = plate_mesh["plate"].read_text() + "v -0.1 -0.1 -0.05\nv 0 -0.1 -0.05\nv 0 0.1 -0.05\nv -0.1 0.1 -0.05\n"
    path = tmp_path / "two.obj"
    path.write_text(plates.replace("f 1 3 2\nf 1 4 3\n", "") + "f 1 3 2\nf 1 4 3\nf 5 7 6\nf 5 8 7\n")
    plate = Plate(crossing, [0])
    points = SurfacePoints(np.zeros(2, int), np.array([[-0.05, 0.01, 0], [0.05, 0.01, 0]]), np.full((2, 3), np.nan))
    assert TrueScene(plate, {"plate": path}).see(plate.frame(0), points).visible.tolist() == [False, True]
    assert TrueScene(plate, plate_mesh).see(plate.frame(0), points).visible.tolist() == [True, True]


def test_views_are_directions_to_the_camera_in_the_objects_frame(crossing, plate_mesh):
    scene = TrueScene(Plate(crossing, [0, 40]), plate_mesh)
    view = true_tracks(scene, scene.lift(scene.sequence.frame(0), np.zeros(1, int), np.array([[319.5, 239.5]]))).view
    np.testing.assert_allclose(np.linalg.norm(view, axis=-1), 1)
    assert np.degrees(np.arccos(view[0, 0] @ view[1, 0])) == pytest.approx(40, abs=1e-4)
    np.testing.assert_allclose(view[0, 0], [0, 0, -1], atol=1e-9)


# --- refusals ----------------------------------------------------------------------------------


def test_no_truth_no_masks_no_faces(crossing, tmp_path):
    with pytest.raises(MissingData, match="no true poses"):
        TrueScene(replace(crossing, read_truth=dict))
    with pytest.raises(MissingData, match="no visible point"):
        draw_queries(TrueScene(Plate(crossing, [0, 0], mask=None)), np.random.default_rng(0))
    points = tmp_path / "points.obj"
    points.write_text("v 0 0 0\nv 0 0 1\nv 0 1 0\n")
    with pytest.raises(BadInput, match="without faces"):
        load_mesh(points)
    cloud = tmp_path / "points.ply"
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    cloud.write_text(header + "0 0 0\n0 0 1\n0 1 0\n")
    with pytest.raises(BadInput, match="without faces"):
        load_mesh(cloud)
