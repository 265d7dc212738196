"""A run whose poses and surfaces are the truth, but for what its fixture says is wrong, in a folder to spoil."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.mesh import save
from p2p_lib.datasets.models import MESHES, find_models, load_mesh
from tests.fixtures.made_run import T_OBJ_MODEL


@pytest.fixture
def finished(made, tmp_path) -> Path:
    """The made run with the true models as its surfaces, in grey."""
    folder = Path(shutil.copytree(made.run.path, tmp_path / "run"))
    for name, path in find_models(made.sequence, MESHES).items():
        vertices, faces = load_mesh(path)
        surface = trimesh.Trimesh(se3.transform(T_OBJ_MODEL, vertices), faces, process=False)
        surface.visual.vertex_colors = np.full((len(vertices), 3), 128, np.uint8)
        save(surface, folder / "meshes" / f"{name}.ply")
    return folder
