"""A run whose poses and surfaces are the truth, but for what its fixture says is wrong, in a folder to spoil."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.mesh import save
from p2p_lib.datasets.models import MESHES, find_models, load_mesh
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.offline.products import write_product
from tests.fixtures.made_run import T_OBJ_MODEL


@pytest.fixture(scope="session")
def another(made, tmp_path_factory):
    """Makes the made run anew, with the true models as its surfaces, in grey."""
    return lambda: with_surfaces(made, tmp_path_factory.mktemp("finished") / "run")


@pytest.fixture
def finished(another) -> Path:
    """One of these to write to."""
    return another()


@pytest.fixture(scope="module")
def scene(another, tmp_path_factory):
    """What is made of it as a BOP dataset, to be read alone."""
    folder = tmp_path_factory.mktemp("scene")
    write_product(another(), "bop-dataset", folder / "set")
    return open_sequence(folder / "set/train/000001")


def with_surfaces(made, folder: Path) -> Path:
    shutil.copytree(made.run.path, folder)
    for name, path in find_models(made.sequence, MESHES).items():
        vertices, faces = load_mesh(path)
        surface = trimesh.Trimesh(se3.transform(T_OBJ_MODEL, vertices), faces, process=False)
        surface.visual.vertex_colors = np.full((len(vertices), 3), 128, np.uint8)
        save(surface, folder / "meshes" / f"{name}.ply")
    return folder
