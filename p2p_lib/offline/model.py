"""Textured models: a run's surfaces cleaned, holes closed where allowed, simplified and textured.

A folder per object: ``textured_simple.obj`` with ``.mtl`` and ``.png``, ``textured_simple.glb``,
``collision.obj`` (convex) and ``model.json``, which says what they are. All in metres, in the object frame of the
run's poses. Faces that nobody saw are the group, in the GLB the mesh, ``guessed``. ``size_m`` in ``model.json`` has the
sides of the smallest box around the model, longest first, however the object frame lies in it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replace_text, replacing
from p2p_lib.core.image import nearest_px
from p2p_lib.core.mesh import oriented_box
from p2p_lib.core.native import load_open3d
from p2p_lib.core.options import lengths_m
from p2p_lib.core.progress import progress_bar
from p2p_lib.core.types import DOUBTED, evenly
from p2p_lib.datasets.images import save_png
from p2p_lib.datasets.runs import ObjectRun
from p2p_lib.evaluation.consistency import Consistency, consistency
from p2p_lib.evaluation.suspicions import Suspicion
from p2p_lib.offline import holes, texture
from p2p_lib.offline.finished import Finished, Renderer, new_folder

NAME = "textured_simple"
#: Components with less of the largest one's area are left out.
_MIN_COMPONENT = 0.05
#: A patch is open if depth this far behind it, m, was measured in at least so many views.
_SEEN_THROUGH_M, _SEEN_THROUGH_VIEWS = 0.012, 2
#: More holes than this are the raggedness of what was hardly seen.
_HOLES = 10
#: Faces of a collision mesh, at most.
_HULL_FACES = 256
#: If more than this share of the masks' pixels lie beside a model, a part is missing. (A real mug without its handle:
#: 4 to 5 %; 45 other objects of 22 runs: at most 1.7 %.)
_MISSING = 0.025
#: Of poses so many of which are doubted a model may have parts twice, whose surface was fused at them.
_OFTEN_DOUBTED = 0.2
#: The edge of a texture, px, at least and at most, and the room around its charts.
TEXTURE_PX, _GUTTER_PX = (512, 2048), 2


@dataclass(frozen=True, eq=False)
class Shape:
    """A surface: vertices (V, 3) metres, faces (F, 3), colours (V, 3) 0 to 255, guessed (F,) bool: not seen."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    guessed: np.ndarray

    @property
    def mesh(self) -> Any:
        """As ``trimesh.Trimesh``, without colours."""
        import trimesh

        return trimesh.Trimesh(self.vertices, self.faces, process=False)


@dataclass(frozen=True, eq=False)
class Textured:
    """A shape with uv (F, 3, 2) of each face's corners, from the lower left, and an image (S, S, 3) uint8."""

    shape: Shape
    uv: np.ndarray
    image: np.ndarray


def write_models(
    folder: str | Path, out: str | Path, faces: int = 5000, min_confidence: float = DOUBTED, progress: bool = False
) -> str:
    """Write a model of each object of the run in ``folder`` below the new folder ``out``; what they are, in words.

    faces           most faces of a model
    min_confidence  only views with poses of more confidence are used

    Needs Open3D; raises :class:`MissingBackend` without, :class:`BadInput` where ``faces`` is no number of faces.
    """
    if faces < 100:
        raise BadInput("faces", faces, "at least 100")
    open3d = load_open3d()
    made, lines = Finished.of(folder), []
    sizes = (made.run.info.get("options") or {}).get("sizes")
    judged = consistency(made.run, made.sequence, known_m=lengths_m(sizes, made.run.objects))
    quiet = open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error)
    with quiet, new_folder(out) as there, progress_bar("models", len(made.tracked), "object", progress) as bar:
        for name in made.tracked:
            lines.append(_write_model(made, judged, name, there / name, faces, min_confidence))
            bar.update()
    return "; ".join(lines)


def _write_model(made: Finished, judged: Consistency, name: str, out: Path, faces: int, min_confidence: float) -> str:
    obj, surface = made.run.objects[name], made.surface(name)
    rows = np.flatnonzero(obj.has_pose & (obj.confidence > min_confidence))
    if not len(rows):
        raise BadInput(str(made.run.path), f"no pose of {name!r} above confidence {min_confidence:g}", "one at least")
    kept, held_out = rows[np.arange(len(rows)) % texture.HELD_OUT_EVERY != 5], rows[5 :: texture.HELD_OUT_EVERY]
    camera = made.sequence.camera
    render = Renderer(surface.vertices, surface.faces, camera)
    views = texture.chosen_rows(made, name, kept, render)
    seen = [(T, made.frame(view.frame).depth_m) for view in views[::3] for T in [view.T_cam_obj]]
    shape = whole(cleaned(surface), faces, camera, seen)
    textured = with_texture(shape, views, camera)
    out.mkdir(parents=True)
    write_obj(textured, out)
    write_glb(textured, out / f"{NAME}.glb")
    hull = collision(shape)
    with replacing(out / "collision.obj") as file:
        file.write(hull.export(file_type="obj", include_normals=False).encode())
    tried = evenly(held_out, 12)
    off = errors(made, name, tried, textured, render, surface)
    off_model = beside(made, name, tried, Renderer(shape.vertices, shape.faces, camera))
    about = _about(made, name, textured, len(views), off)
    about |= {"masks_beside": round(off_model, 4), "collision_faces": len(hull.faces)}
    about |= {"verdict": judged.verdict(name), "look_at": [found.text for found in judged.suspicions[name]]}
    replace_text(out / "model.json", json.dumps(about, indent=1, ensure_ascii=False) + "\n")
    guessed = f", {100 * about['guessed_share']:.0f} % of its area unseen, guessed" if shape.guessed.any() else ""
    textured_of = f"{len(shape.faces)} faces, texture of {len(views)} view{'s' * (len(views) != 1)}"
    line = f"{name}: {suspect(obj, judged.suspicions[name])}{textured_of}{guessed}{no_better(off)}{lacks(off_model)}"
    return line + how_open(about["parts"], about["holes"], about["largest_hole_m"], bool(made.about.get("offline")))


def how_open(parts: int, count: int, largest_m: float, offline: bool) -> str:
    """What there is to say of a model that is not one closed surface; nothing of one that is.

    parts, count, largest_m  its parts, its holes, and how far the largest is across
    offline                  whether it is of an offline run already
    """
    found = [f"in {parts} parts"] * (parts > 1)
    if count:
        found.append(f"open: {count} hole{'s' * (count > 1)}, the largest {100 * largest_m:.1f} cm across")
    told = "".join(f"; {one}" for one in found)
    if parts == 1 and count <= _HOLES:
        return told
    fix = "" if offline else "a model of RUN/offline (p2p refine RUN) or "
    return f"{told}: {fix}a video that shows each side longer and nearer has fewer"


def no_better(off: dict[str, float]) -> str:
    """What there is to say of a texture that is no better than vertex colours, by :func:`errors`; else nothing."""
    texture_off, vertex_off = off["texture"], off["vertex_colours"]
    if not texture_off >= vertex_off:
        return ""
    return f", no better than the surface's vertex colours (error {texture_off:.1f} against {vertex_off:.1f} of 255)"


def beside(made: Finished, name: str, rows: np.ndarray, render: Renderer) -> float:
    """The share of an object's masks that lies beside its model, the median over frames ``rows``; 0 without masks.

    render  renders the model
    """
    found = [0.0]
    for row in rows:
        mask = made.masks(int(made.frames[row])).get(name)
        if mask is None or not mask.any():
            continue
        shown = np.isfinite(render(made.run.objects[name].T_cam_obj[row]).depth_in(mask))
        found.append(made.beside(mask, shown))
    return float(np.median(found[1:] or found))


def suspect(obj: ObjectRun, found: Iterable[Suspicion]) -> str:
    """What there is to say, before anything else, of a model that was made of poses which are suspect.

    found  what speaks against them by ``p2p eval``
    """
    share, rules = float(obj.doubted.sum() / obj.has_pose.sum()), dict.fromkeys(of.rule for of in found)
    told = f"the run's verdict is look ({', '.join(rules)}): p2p eval says why; " * bool(rules)
    if share < _OFTEN_DOUBTED:
        return told
    median = np.median(obj.confidence[obj.has_pose])
    doubted = f"{100 * share:.0f} % of the run's poses are doubted (median confidence {median:.2f})"
    return f"{told}{doubted}, parts of it may be doubled or out of place: p2p eval says where to look; "


def lacks(off_model: float) -> str:
    """What there is to say of a model that masks reach beyond, by :func:`beside`; else nothing."""
    if off_model < _MISSING:
        return ""
    told = f", {100 * off_model:.0f} % of its masks lie beside it"
    return f"{told}: it lacks a part (a handle?), or the masks hold something else"


def _about(made: Finished, name: str, textured: Textured, views: int, off: dict[str, float]) -> dict[str, Any]:
    mesh, shape = textured.shape.mesh, textured.shape
    frame = "the object frame of the run's poses: p_cam = T_cam_obj p_obj, OpenCV's camera axes"
    record = {
        "object": name,
        "units": "m",
        "frame": frame,
        "faces": len(shape.faces),
        "watertight": bool(mesh.is_watertight),
    }
    record |= {"guessed_share": float(mesh.area_faces[shape.guessed].sum() / mesh.area), "views": views}
    sides_m = sorted(oriented_box(mesh)[1].tolist(), reverse=True)
    parts, across_m = torn(shape)
    record |= {"parts": parts, "holes": len(across_m), "largest_hole_m": round(float(across_m.max(initial=0)), 5)}
    record |= {"size_m": np.round(sides_m, 5).tolist(), "colour_error_of_255": off}
    return record | {"run": made.about}


# --- shape ---------------------------------------------------------------------------------------


def cleaned(surface: Any) -> Shape:
    """A surface without its small components, faces of no area and edges of more than two faces; smoothed a little."""
    import trimesh
    from scipy.spatial import cKDTree

    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    legacy = _legacy(mesh.vertices, mesh.faces)
    legacy.remove_non_manifold_edges()
    component, _, area = legacy.cluster_connected_triangles()
    component, area = np.asarray(component), np.asarray(area)
    legacy.remove_triangles_by_mask(area[component] < _MIN_COMPONENT * area.max())
    legacy.remove_unreferenced_vertices()
    # Taubin smoothing removes the steps of voxels without shrinking the shape.
    legacy = legacy.filter_smooth_taubin(number_of_iterations=5)
    vertices, faces = np.asarray(legacy.vertices), np.asarray(legacy.triangles)
    colours = np.asarray(surface.visual.vertex_colors)[cKDTree(surface.vertices).query(vertices)[1], :3]
    return Shape(vertices, faces, colours.astype(float), np.zeros(len(faces), bool))


def _legacy(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """As ``open3d.geometry.TriangleMesh``."""
    open3d = load_open3d()
    return open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(faces))


def _tensor(shape: Shape) -> Any:
    """As ``open3d.t.geometry.TriangleMesh``."""
    open3d = load_open3d()
    vertices, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.int64)
    return open3d.t.geometry.TriangleMesh(open3d.core.Tensor(vertices), open3d.core.Tensor(faces))


def whole(shape: Shape, faces: int, camera: Any, views: list[tuple[np.ndarray, np.ndarray]]) -> Shape:
    """The shape closed where no views (T_cam_obj, depth_m) looked through, of at most so many faces."""
    full, most = closed(shape, camera, views), faces
    # Where an open or a thin surface is simplified it may tear, and what closes it counts, too.
    while len((made := closed(simplified(full, most), camera, views)).faces) > faces and most > faces // 2:
        most -= len(made.faces) - faces
    return made


def closed(shape: Shape, camera: Any, views: list[tuple[np.ndarray, np.ndarray]]) -> Shape:
    """The shape with its holes filled where no views (T_cam_obj, depth_m) looked through.

    Faces at which holes meet, and what else hangs on by a vertex or is small by itself, are left out.
    """
    kept = np.flatnonzero(holes.unpinched(shape.faces))
    patches, face_area = _patches(shape.faces[kept]), shape.mesh.area_faces[kept]
    area = [face_area[patch].sum() for patch in patches]
    large = [patch for patch, of in zip(patches, area, strict=True) if of >= _MIN_COMPONENT * max(area)]
    kept = kept[np.sort(np.concatenate(large))]
    faces = shape.faces[kept]
    filled = holes.closing(shape.vertices, faces)
    new = [patch for patch in filled if not _seen_through(shape.vertices[patch], camera, views)]
    added = np.concatenate([faces[:0], *new])
    guessed = np.concatenate([shape.guessed[kept], np.ones(len(added), bool)])
    used, corner = np.unique(np.concatenate([faces, added]), return_inverse=True)
    return Shape(shape.vertices[used], corner.reshape(-1, 3), shape.colours[used], guessed)


def _patches(faces: np.ndarray) -> list[np.ndarray]:
    """Rows of the faces (F, 3) of each edge-connected patch."""
    import trimesh

    if not len(faces):
        return []
    labels = trimesh.graph.connected_component_labels(trimesh.graph.face_adjacency(faces), len(faces))
    return [np.flatnonzero(labels == k) for k in range(labels.max() + 1)]


def _seen_through(triangles: np.ndarray, camera: Any, views: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Whether enough views measured depth well behind more than a third of the area of a patch (F, 3, 3)."""
    points = np.concatenate([triangles.mean(1), (triangles + triangles.mean(1, keepdims=True)).reshape(-1, 3) / 2])
    sides = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    area = np.concatenate([area, area.repeat(3)])
    through = 0
    for T_cam_obj, depth_m in views:
        p_cam = se3.transform(T_cam_obj, points)
        uv_px = camera.project(p_cam)
        inside = camera.inside(uv_px)
        u, v = nearest_px(uv_px, depth_m.shape)
        behind = inside & (depth_m[v, u] > p_cam[:, 2] + _SEEN_THROUGH_M)
        through += area[behind].sum() > area.sum() / 3
    return through >= _SEEN_THROUGH_VIEWS


def simplified(shape: Shape, faces: int) -> Shape:
    """The shape with at most so many faces, by quadric error; guessed faces stay marked."""
    from scipy.spatial import cKDTree

    # Marching cubes' faces are so regular and so many slivers that the atlas takes minutes: half of them say the same.
    faces = min(faces, max(len(shape.faces) // 2, 100))
    if len(shape.faces) <= faces:
        return shape
    legacy = _legacy(shape.vertices, shape.faces).simplify_quadric_decimation(faces)
    legacy.remove_degenerate_triangles()
    legacy.remove_non_manifold_edges()
    legacy.remove_unreferenced_vertices()
    vertices, made = np.asarray(legacy.vertices), np.asarray(legacy.triangles)
    colours = shape.colours[cKDTree(shape.vertices).query(vertices)[1]]
    nearest = cKDTree(shape.vertices[shape.faces].mean(1)).query(vertices[made].mean(1))[1]
    return Shape(vertices, made, colours, shape.guessed[nearest])


def torn(shape: Shape) -> tuple[int, np.ndarray]:
    """Into how many parts a shape falls, and how far each of its holes is across, m: closed lines of edges of one face.

    Holes that meet are one.
    """
    from scipy.spatial.distance import pdist
    from trimesh.graph import connected_component_labels

    edges, faces = np.unique(np.sort(holes.edges(shape.faces), 1), axis=0, return_counts=True)
    part, hole = (connected_component_labels(of, len(shape.vertices)) for of in (edges, edges[faces == 1]))
    at = np.unique(edges[faces == 1])
    rims = [at[hole[at] == k] for k in np.unique(hole[at])]
    return len(np.unique(part[edges])), np.array([pdist(shape.vertices[rim]).max() for rim in rims])


def collision(shape: Shape) -> Any:
    """A convex mesh around a shape, a ``trimesh.Trimesh`` of few faces."""
    hull = shape.mesh.convex_hull
    if len(hull.faces) <= _HULL_FACES:
        return hull
    import trimesh
    from scipy.spatial import ConvexHull

    # Of the hull's corners those that are farthest along directions all around.
    k = np.arange(_HULL_FACES // 2) + 0.5
    z, turn = 1 - 2 * k / len(k), np.pi * (1 + 5**0.5) * k
    ways = np.stack([np.cos(turn) * np.sqrt(1 - z**2), np.sin(turn) * np.sqrt(1 - z**2), z], 1)
    corners = hull.vertices[np.unique((hull.vertices @ ways.T).argmax(0))]
    return trimesh.convex.convex_hull(corners[ConvexHull(corners).vertices])


# --- texture -------------------------------------------------------------------------------------


def with_texture(shape: Shape, views: list[texture.View], camera: Any) -> Textured:
    """A shape with an atlas, textured from views."""
    size = texture_px(shape, views, camera)
    mesh, to = _tensor(shape), load_open3d().core.Tensor
    uv = atlas(len(shape.faces), size)
    mesh.triangle.texture_uvs = to(uv.astype(np.float32))
    normals = np.array(shape.mesh.vertex_normals)
    mesh.vertex.normals = to(normals.astype(np.float32))
    mesh.vertex.own = to(shape.colours.astype(np.float32))
    mesh.vertex.here = to(np.ones((len(normals), 1), np.float32))
    # What is outside of all charts is 0.
    maps = mesh.bake_vertex_attr_textures(size, {"positions", "normals", "own", "here"}, 0.0, 0.0, False)
    point, normal, own, here = (maps[key].numpy() for key in ("positions", "normals", "own", "here"))
    at = here[..., 0] > 0.5
    unit = normal[at] / np.maximum(np.linalg.norm(normal[at], axis=1, keepdims=True), 1e-9)
    even = texture.evened(views, camera, evenly(point[at], 4000), evenly(unit, 4000))
    image = np.zeros((size, size, 3), np.uint8)
    image[at] = texture.baked(even, camera, point[at], unit, own[at])
    return Textured(shape, uv, spread(image, at))


def texture_px(shape: Shape, views: list[texture.View], camera: Any) -> int:
    """The edge of a texture whose texels are as fine as the pixels of the nearest views, for nine of ten faces."""
    nearest_m = np.quantile([view.depth_m.min() for view in views], 0.1) if views else 1.0
    edge_px = np.quantile(shape.mesh.edges_unique_length, 0.9) * camera.fx / nearest_m
    wanted = (edge_px + 3.5 * _GUTTER_PX) * _squares(len(shape.faces))
    return int(np.clip(2 ** np.ceil(np.log2(wanted)), *TEXTURE_PX))


def _squares(faces: int) -> int:
    """The number of squares, of two faces each, along an edge of a texture."""
    return int(np.ceil(np.sqrt(np.ceil(faces / 2))))


def atlas(faces: int, size: int) -> np.ndarray:
    """(F, 3, 2) places of faces in a texture: each its own triangle, two in a square.

    Open3D's atlas (UVAtlas) has larger charts; on reconstructed surfaces it takes minutes, and some end the process.
    xatlas (0.0.11) has larger charts in 0.4 s and is no better: on two reconstructed surfaces of 5000 faces it uses 55
    and 47 % of the texture, ours 56; colour errors 3.24 against 3.29 and 8.53 against 8.52.
    """
    squares = _squares(faces)
    low, high = _GUTTER_PX * squares / size, 1 - 2.5 * _GUTTER_PX * squares / size
    half = np.array([[low, low], [high, low], [low, high]])
    k = np.arange(faces)
    inside = np.where((k % 2 == 0)[:, None, None], half, 1 - half)
    corner = np.stack([k // 2 % squares, k // 2 // squares], 1)
    return (corner[:, None] + inside) / squares


def spread(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """An image (H, W, 3) with the nearest texel's colour where there is none: charts do not fade at their borders."""
    if at.all() or not at.any():
        return image
    _, label = cv2.distanceTransformWithLabels((~at).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    colour_of = np.zeros((label.max() + 1, 3), np.uint8)
    colour_of[label[at]] = image[at]
    return colour_of[label]


def rendered(textured: Textured, T_cam_obj: np.ndarray, camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """A model as a camera sees it: (H, W, 3) uint8 and where it shows (H, W) bool."""
    shape, size = textured.shape, textured.image.shape[0]
    weights, at, face = _corners(Renderer(shape.vertices, shape.faces, camera), T_cam_obj)
    uv = np.einsum("nk,nkd->nd", weights, textured.uv[face])
    x, y = uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5
    image = np.zeros((*at.shape, 3), np.uint8)
    image[at] = texture.lookup(textured.image, np.stack([x, y], 1))
    return image, at


def _corners(render: Renderer, T_cam_obj: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Barycentric weights (N, 3) at each pixel where a mesh shows, (H, W) bool, and in which face (N,)."""
    import trimesh

    silhouette, rays = render(T_cam_obj), render.camera.rays
    image, own = silhouette.inside(rays)
    at = np.isfinite(depth_m := silhouette.depth_in(rays))
    face = silhouette.face[own][at[image]]
    points = se3.transform(se3.inverse(T_cam_obj), (rays[at].T * depth_m[at]).T)
    return trimesh.triangles.points_to_barycentric(render.vertices[render.faces[face]], points), at, face


def errors(
    made: Finished, name: str, rows: np.ndarray, textured: Textured, render: Renderer, surface: Any
) -> dict[str, float]:
    """Mean colour error in held-out frames ``rows``: of the texture, and of the surface's vertex colours.

    render  renders the run's ``surface``
    """
    colours, off = np.asarray(surface.visual.vertex_colors)[:, :3].astype(float), []
    for row in rows:
        view = texture.view_of(made, name, int(row), render)
        mine, mine_at = rendered(textured, view.T_cam_obj, render.camera)
        weights, at, face = _corners(render, view.T_cam_obj)
        theirs = np.zeros_like(mine)
        theirs[at] = np.einsum("nk,nkd->nd", weights, colours[render.faces[face]]).round()
        both = mine_at & at
        off.append((texture.colour_error(view, mine, both), texture.colour_error(view, theirs, both)))
    found = np.nanmean(np.array(off), axis=0) if np.isfinite(off).any() else (np.nan, np.nan)
    return {"texture": round(float(found[0]), 3), "vertex_colours": round(float(found[1]), 3), "frames": len(rows)}


# --- files ---------------------------------------------------------------------------------------


def write_obj(textured: Textured, folder: Path) -> None:
    """``textured_simple.obj`` with ``.mtl`` and ``.png``; corners of a face have their own place in the texture."""
    shape = textured.shape
    uv, which = np.unique(textured.uv.reshape(-1, 2).round(7), axis=0, return_inverse=True)
    corner = np.stack([shape.faces + 1, which.reshape(-1, 3) + 1], -1)
    lines = [f"# metres\nmtllib {NAME}.mtl\nusemtl {NAME}"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in shape.vertices.tolist()]
    lines += [f"vt {u:.7f} {v:.7f}" for u, v in uv.tolist()]
    for group, of in (("seen", ~shape.guessed), ("guessed", shape.guessed)):
        rows = corner[of].reshape(-1, 6).tolist()
        lines += [f"g {group}"] * bool(rows) + ["f {}/{} {}/{} {}/{}".format(*row) for row in rows]
    replace_text(folder / f"{NAME}.obj", "\n".join(lines) + "\n")
    replace_text(folder / f"{NAME}.mtl", f"newmtl {NAME}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {NAME}.png\n")
    save_png(folder / f"{NAME}.png", textured.image)


def write_glb(textured: Textured, path: Path) -> None:
    """One file with meshes ``seen`` and ``guessed``, as the groups of the OBJ, and one texture (glTF: metres)."""
    import trimesh
    from PIL import Image

    # Of one material: where a reader makes one mesh of both, the texture stays as it is.
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(textured.image), metallicFactor=0.0, roughnessFactor=1.0
    )
    shape, scene = textured.shape, trimesh.Scene()
    for name, of in (("seen", ~shape.guessed), ("guessed", shape.guessed)):
        if not of.any():
            continue
        corners, which = np.unique(
            np.concatenate([shape.faces[of].reshape(-1, 1), textured.uv[of].reshape(-1, 2).round(7)], 1),
            axis=0,
            return_inverse=True,
        )
        visual = trimesh.visual.TextureVisuals(uv=corners[:, 1:], material=material)
        vertices = shape.vertices[corners[:, 0].astype(int)]
        mesh = trimesh.Trimesh(vertices, which.reshape(-1, 3), visual=visual, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    glb: Any = scene.export(file_type="glb")  # bytes, of this kind of file
    with replacing(path) as file:
        file.write(glb)
