"""Object models for scoring: where they are and their vertices, in metres.

Tracking never sees them: ADD and ADD-S are measured over all vertices of the true model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core.errors import BadInput, MissingData, doubt, in_a_line
from p2p_lib.core.files import UNREADABLE, read_bytes
from p2p_lib.datasets.sequence import FORMATS, Sequence

if TYPE_CHECKING:
    import trimesh

#: What a model's folder is searched for, best first: the points that YCBInEOAT scores with, then meshes.
PREFERRED = ("points.xyz", "textured_simple.obj", "textured.obj", "*.xyz", "*.obj", "*.ply")
SUFFIXES = (".xyz", ".obj", ".ply")
#: The same for a surface with faces.
MESHES = ("textured_simple.obj", "textured.obj", "*.obj", "*.ply")
# No object that a camera at arm's length tracks is larger: such a model is in millimetres.
LARGEST_M = 10.0


def find_models(sequence: Sequence, preferred: tuple[str, ...] = PREFERRED) -> dict[str, Path]:
    """Object to model file, for those objects that have one where the sequence's layout keeps it.

    Warns of files that a layout of somebody else's names, and that are not there.
    """
    found = {}
    for name, places in sequence.model_places.items():
        found[name] = next(filter(None, (model_in(place, preferred) for place in places)), None)
        files = [str(place) for place in places if place.suffix.lower() in SUFFIXES]
        if found[name] is None and files and sequence.format not in FORMATS:
            what, fix = f"model of {name!r} (format {sequence.format})", f"Give one with --models {name}=PATH."
            doubt(what, f"no file {', '.join(files)}, so that nothing is scored", fix, of=name)
    return {name: path for name, path in found.items() if path is not None}


def model_in(place: Path, preferred: tuple[str, ...]) -> Path | None:
    """The model file of a folder, or the file itself; None where there is none of the preferred kinds."""
    if place.is_file():
        return place if any(place.match(pattern) for pattern in preferred) else None
    return next((p for pattern in preferred for p in sorted(place.glob(pattern))), None)


def given_models(
    given: Mapping[str, str | Path], objects: Iterable[str], preferred: tuple[str, ...] = PREFERRED
) -> dict[str, Path]:
    """Object to model file of what was given (``--models NAME=PATH``); a path may be a model's folder.

    Raises :class:`BadInput` for a name that is none of ``objects``, :class:`MissingData` for a file not there.
    """
    known, models = tuple(sorted(objects)), {}
    for name, where in given.items():
        if name not in known:
            listed = ", ".join(known) or "there are none"
            raise BadInput("model", f"the name {name!r}", f"one of the objects: {listed}")
        path = Path(where).expanduser()
        file = model_in(path, preferred) if path.is_dir() else path
        if file is None or not file.is_file():
            raise MissingData(str(path), f"no such model, expected a file {', '.join(SUFFIXES)} (or a folder with one)")
        models[name] = file
    return models


def load_points(path: str | Path) -> np.ndarray:
    """(V, 3) all vertices of a model in its own frame, metres, in the file's order.

    .xyz has x y z in its first columns, .obj its ``v`` lines, .ply its vertices. A model beside a
    ``models_info.json`` is BOP's, which are in millimetres.
    """
    path = Path(path)
    readers = {".xyz": _read_xyz, ".obj": _read_obj, ".ply": _read_ply}
    if path.suffix.lower() not in readers:
        raise BadInput(str(path), f"a file of kind {path.suffix or 'unknown'!r}", "a model: " + ", ".join(SUFFIXES))
    data = read_bytes(path, "a model")
    try:
        points = readers[path.suffix.lower()](data) * unit_m(path)
    except UNREADABLE as error:
        raise BadInput(str(path), f"an unreadable model ({in_a_line(error)})", "x y z of each vertex") from None
    if points.ndim != 2 or points.shape[1:] != (3,) or len(points) < 1 or not np.isfinite(points).all():
        got = "no vertices" if points.size == 0 else f"{points.shape} values, some not finite"
        raise BadInput(str(path), got, "at least one vertex of three finite coordinates")
    size = float(np.ptp(points, axis=0).max())
    if size > LARGEST_M:
        fix = "Is it in millimetres? Divide by 1000."
        raise BadInput(str(path), f"a model {size:.4g} m large", "vertices in metres", fix)
    return points


def load_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in metres and faces (F, 3) of a mesh file .obj or .ply; raises as :func:`load_points`."""
    load_points(path)  # whatever is wrong with the vertices is said there
    mesh = read_mesh(Path(path))
    if not len(mesh.faces):
        raise BadInput(str(path), "a model without faces", "a mesh", "Give a mesh, or none to go by the depth.")
    return np.asarray(mesh.vertices, float) * unit_m(Path(path)), np.asarray(mesh.faces)


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A mesh file .obj or .ply as it is, without its materials; what it names beside itself is not looked at.

    Raises as :func:`load_points`, and :class:`BadInput` for a face without its vertex.
    """
    import trimesh

    data, kind = read_bytes(path, "a mesh"), path.suffix[1:].lower()
    try:
        mesh: Any = trimesh.load(BytesIO(data), file_type=kind, process=False, force="mesh", skip_materials=True)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces).reshape(-1, 3)
    except UNREADABLE as error:
        raise BadInput(str(path), f"an unreadable mesh ({in_a_line(error)})", "vertices and faces") from None
    if not np.isfinite(vertices).all():
        raise BadInput(str(path), "vertices that are not finite", "finite coordinates")
    if faces.size and not (0 <= faces.min() and faces.max() < len(vertices)):
        odd = faces.min() if faces.min() < 0 else faces.max()
        raise BadInput(str(path), f"a face of vertex {odd}", f"vertices 0 to {len(vertices) - 1}")
    return mesh


def unit_m(path: Path) -> float:
    """Metres per unit of a model file: BOP's are in millimetres."""
    return 0.001 if (path.parent / "models_info.json").is_file() else 1.0


def _read_xyz(data: bytes) -> np.ndarray:
    lines = data.decode("utf-8", "replace").splitlines()
    return np.array([line.split()[:3] for line in lines if line.strip() and line.lstrip()[0] != "#"], float)


def _read_obj(data: bytes) -> np.ndarray:
    # Not through a mesh library: those merge, split or reorder vertices, and ADD is a mean over them.
    return np.array([line.split()[1:4] for line in data.splitlines() if line.startswith((b"v ", b"v\t"))], float)


def _read_ply(data: bytes) -> np.ndarray:
    import trimesh

    loaded: Any = trimesh.load(BytesIO(data), file_type="ply", process=False)  # a mesh, or points
    return np.asarray(loaded.vertices, float)
