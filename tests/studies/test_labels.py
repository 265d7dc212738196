"""Notebook 11: the pictures of what labels say, and their comparison with the truth."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from pandas import DataFrame

from p2p_lib.core.camera import Camera
from p2p_lib.datasets.truth import ObjectTruth
from p2p_lib.figures import style
from p2p_lib.offline.model import Shape, Textured
from p2p_lib.synthetic.noise import PERFECT
from p2p_lib.synthetic.scene import VGA
from studies import labels, surface
from studies.labels import evidence_plot

CAMERA = Camera(200, 200, 79.5, 59.5, 160, 120)


def textured(mesh):
    shape = Shape(mesh.vertices, mesh.faces, np.zeros_like(mesh.vertices), np.zeros(len(mesh.faces), bool))
    return Textured(shape, np.full((len(mesh.faces), 3, 2), 0.5), np.full((8, 8, 3), 200, np.uint8))


def at(x_m, z_m=0.5):
    T = np.eye(4)
    T[:3, 3] = x_m, 0, z_m
    return T


def test_images_have_whole_numbers_and_objects_their_colours():
    told = DataFrame({"image": range(18), "object": "box", "visib_iou": 0.8, "depth_on_surface": 0.9})
    axes = evidence_plot(told).axes
    ticks = axes[1].get_xticks()
    assert len(ticks) > 3 and (ticks == np.rint(ticks)).all()
    assert axes[0].lines[0].get_color() == style.object_colours(["box"])["box"]


def test_of_each_object_the_right_half_is_rendered():
    """Wherever it is in the image, so that each view compares prints."""
    cube = textured(trimesh.creation.box((0.06, 0.06, 0.06)))
    poses = {"left": at(-0.12), "right": at(0.12)}
    drawn = labels.over_image(np.zeros((120, 160, 3), np.uint8), {"left": cube, "right": cube}, poses, CAMERA)
    for x_m in (-0.12, 0.12):
        u = round(79.5 + 200 * x_m / 0.5)
        assert (drawn[60, u + 3] == 200).all() and (drawn[60, u - 3] == 0).all()
        outline = np.flatnonzero((drawn[60, u - 20 : u + 21] == 255).all(-1))
        assert len(outline) and outline.min() < 20 < outline.max(), "the outline is whole"


def test_a_mask_and_a_model_that_lack_a_part_alike_are_measured_by_the_truth(monkeypatch):
    body, T = surface.carton(0), surface.ring(8)[:1]
    (shot,) = surface.photograph(body, T, 0, PERFECT)
    half = shot.mask & (np.arange(VGA.width) < np.median(np.nonzero(shot.mask)[1]))
    truth, BOP = ObjectTruth(T, np.ones(1, bool)), "obj_000001"
    source = SimpleNamespace(truth={"box": truth}, camera=VGA, masks=lambda i: {"box": shot.mask}, frame=lambda i: shot)
    scene = SimpleNamespace(truth={BOP: truth}, frame_names=("000000",), masks=lambda k: {BOP: half})
    (label,) = labels.label_errors(scene, source, [0], {BOP: "box"}).to_dict("records")
    assert label["mask_iou"] == pytest.approx(0.5, abs=0.02) and label["off_mm"] < 1e-6 and label["image"] == 0
    monkeypatch.setattr(labels, "find_models", lambda *_: {"box": body})
    monkeypatch.setattr(labels, "load_mesh", lambda found: found.mesh)
    facing = body.mesh.face_normals @ -(T[0, :3, :3].T @ T[0, :3, 3])
    for faces, low, high in ((facing < np.inf, 0, 0.01), (facing < facing.max(), 0.2, 0.8)):
        model = textured(trimesh.Trimesh(body.mesh.vertices, body.mesh.faces[faces], process=False))
        lacks = labels.lacking(scene, source, [0], {BOP: "box"}, {BOP: model})
        assert low <= lacks["box"] <= high
