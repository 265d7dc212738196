"""A run in 3D with a time slider, as one page that needs nothing else: what ``p2p view`` opens.

In camera coordinates: what the camera saw as points, its image, and each object where it was estimated to be: axes,
reconstructed surface, keypoints (those seen at the moment are bright), the keyframes as the small cameras they were
taken from; in a map that is not kept, axes alone. An object without a pose is not drawn; its path stays, coloured by
status. The page is made with viser.
"""

from __future__ import annotations

import html
import io
import sys
from contextlib import AbstractContextManager, redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.packages import needed_for
from p2p_lib.core.types import evenly, status_word
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.figures import style
from p2p_lib.figures.playback import CLOUD_MAX_M, Playback
from p2p_lib.figures.provenance import Saved

#: Frames that are shown at most, evenly spread, points of each, and the image's width: a page of at most about 6 MB.
MOMENTS, POINTS, IMAGE_PX = 120, 3000, 240
#: Sizes in metres of what is drawn at the object, its keyframes and its points.
_AXES_M, _KEYFRAME_M, _POINT_M = 0.06, 0.012, 0.003
_CLOUD_POINT_M, _CAMERA_M = 0.006, 0.08
#: Faces of a surface; finer ones are thinned out.
_FACES = 20_000
_LEGEND = """<div style="position:fixed;right:12px;top:12px;z-index:9;font:13px/1.5 system-ui,sans-serif;
background:#fffc;padding:6px 10px;border-radius:4px;pointer-events:none">{title}<br>{objects}<br>{statuses}</div>"""
_SWATCH = '<span style="background:{colour};border:1px solid #888;padding:0 6px"></span> {status} &nbsp;'


def scene_page(playback: Playback, moments: int = MOMENTS, points: int = POINTS) -> str:
    """The whole page as HTML: it works offline, from a file, and inside another page."""
    with needed_for("view"):
        from viser import ViserServer

    with _silent():
        server = ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            scene = _Scene(server, playback, points)
            recording = server.get_scene_serializer()
            # Points, image and objects are all of the same frame: what is left out is left out of all.
            rows = evenly(np.arange(len(playback)), moments)
            ends_s = [*playback.times_s[rows[1:]], playback.times_s[-1] + 1 / 30]
            for before, i, end_s in zip([None, *rows], rows, ends_s):
                scene.show(int(i), before)
                recording.insert_sleep(float(end_s - playback.times_s[i]))
            page = recording.as_html()
        finally:
            server.stop()
    end = page.rindex("</body>") if "</body>" in page else len(page)
    return page[:end] + _legend(playback, len(rows), points) + page[end:]


def _silent() -> AbstractContextManager:
    """Viser prints when it starts and stops, even with verbose=False, and in a notebook it displays that."""
    if "IPython" not in sys.modules:
        return redirect_stdout(io.StringIO())
    from IPython.utils.capture import capture_output

    return capture_output(stderr=False)


def write_page(run: str | Path, out: str | Path | None = None, sequence: Sequence | None = None) -> Path:
    """Write the page of a run's folder (default: ``view.html`` in it); the path written."""
    playback = Playback.of(run, sequence)
    out = Path(out) if out is not None else playback.run.path / "view.html"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(scene_page(playback), encoding="utf-8")
    return out


def show_run(run: str | Path, sequence: Sequence | None = None) -> Saved:
    """The page of a run's folder, written there as ``view.html`` and shown by the cell that ends with it."""
    path = write_page(run, sequence=sequence)
    inside = html.escape(path.read_text(encoding="utf-8"), quote=True)
    frame = f'<iframe srcdoc="{inside}" width="100%" height="560" style="border:0"></iframe>'
    return Saved(path, ({"text/html": frame, "text/plain": f"<{path.name}>"}, {}))


class _Scene:
    """What stands in the scene, and how it changes with time."""

    def __init__(self, server: Any, playback: Playback, points: int):
        self._playback, self._points, self._scene = playback, points, server.scene
        server.scene.set_up_direction("-y")
        objects = playback.objects.values()
        places = np.concatenate([obj.T_cam_obj[obj.has_pose, :3, 3] for obj in objects])
        centre = np.median(places, 0) if len(places) else np.array([0.0, 0.0, 0.7])
        server.initial_camera.position = tuple(centre + centre[2] * np.array([0.35, -0.5, -1.0]))
        server.initial_camera.look_at = tuple(centre)
        self._camera: Any = None
        if playback.sequence is not None:
            camera = playback.sequence.camera
            self._camera = server.scene.add_camera_frustum(
                "/camera",
                fov=float(2 * np.arctan(camera.height / 2 / camera.fy)),
                aspect=camera.width / camera.height,
                scale=_CAMERA_M,
                thickness=_CAMERA_M / 40,
                color=style.rgb(style.NEUTRAL[0]),
            )
        self._objects = {name: self._add_object(name) for name in playback.run.objects}

    def _add_object(self, name: str) -> dict[str, Any]:
        """The nodes of one object; those below its frame follow it."""
        scene, playback, colour = self._scene, self._playback, style.rgb(self._playback.colours[name])
        at = f"/objects/{name}"
        nodes = {"frame": scene.add_frame(at, axes_length=_AXES_M, axes_radius=_AXES_M / 25, visible=False)}
        nodes["map"] = scene.add_frame(f"{at}/map", show_axes=False)
        nodes["label"] = scene.add_label(f"/labels/{name}", name, visible=False, anchor="bottom-center")
        if name in playback.meshes:
            scene.add_mesh_trimesh(f"{at}/map/surface", _thinned(playback.meshes[name]))
        if name in playback.keypoints and len(playback.keypoints[name].ids):
            p_obj = playback.keypoints[name].p_obj
            faint = np.tile(np.array(style.rgb(style.NEUTRAL[1]), np.uint8), (len(p_obj), 1))
            nodes["keypoints"] = scene.add_point_cloud(
                f"{at}/map/keypoints",
                p_obj,
                faint,
                point_size=1.4 * _POINT_M,
                point_shape="circle",
                precision="float32",
            )
        rows, T_obj_cam = playback.keyframes(name)
        wxyz, aspect = se3.quaternion_xyzw(T_obj_cam)[:, [3, 0, 1, 2]], 4 / 3
        nodes["keyframes"] = [
            scene.add_camera_frustum(
                f"{at}/map/keyframes/{playback.frame_index[row]}",
                fov=0.8,
                aspect=aspect,
                scale=_KEYFRAME_M,
                thickness=_KEYFRAME_M / 12,
                color=colour,
                wxyz=q,
                position=T[:3, 3],
                visible=False,
            )
            for row, q, T in zip(rows, wxyz, T_obj_cam, strict=True)
        ]
        nodes["keyframe_rows"] = rows
        positions, colours = playback.path(name)
        if len(positions):
            scene.add_point_cloud(f"/paths/{name}", positions, colours, point_size=_POINT_M, precision="float32")
        return nodes

    def show(self, i: int, before: int | None) -> None:
        """Change the scene from row ``before`` to row i."""
        for name, nodes in self._objects.items():
            self._show_object(name, nodes, i, before)
        frame = self._playback.frame(i)
        if frame is not None:
            p_cam, colours = self._playback.cloud(i, frame, self._points)
            self._scene.add_point_cloud("/points", p_cam, colours, point_size=_CLOUD_POINT_M)
            size = (IMAGE_PX, round(IMAGE_PX * frame.shape[0] / frame.shape[1]))
            self._camera.image = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)

    def _show_object(self, name: str, nodes: dict[str, Any], i: int, before: int | None) -> None:
        obj = self._playback.objects[name]
        for node, shown in (("frame", obj.has_pose), ("map", self._playback.of_kept_map(name))):
            if before is None or shown[i] != shown[before]:
                nodes[node].visible = bool(shown[i])
        nodes["label"].text = f"{name}: {status_word(obj.status[i], obj.reason[i])}"
        if obj.has_pose[i]:
            T = obj.T_cam_obj[i]
            x, y, z, w = se3.quaternion_xyzw(T)
            nodes["frame"].wxyz, nodes["frame"].position = (w, x, y, z), T[:3, 3]
            nodes["label"].position = T[:3, 3] - [0, 1.5 * _AXES_M, 0]
            if not nodes["label"].visible:
                nodes["label"].visible = True
        since = -1 if before is None else before
        for k in np.flatnonzero((nodes["keyframe_rows"] > since) & (nodes["keyframe_rows"] <= i)):
            nodes["keyframes"][k].visible = True
        if "keypoints" in nodes:
            points = self._playback.keypoints[name]
            seen = np.isin(points.ids, points.track_id[points.at(int(self._playback.frame_index[i]))])
            shades = np.array([style.rgb(style.NEUTRAL[1]), style.rgb(self._playback.colours[name])], np.uint8)
            nodes["keypoints"].colors = shades[seen.astype(int)]


def _thinned(mesh: Any) -> Any:
    """A surface of at most so many faces, as a trimesh."""
    import trimesh
    from scipy.spatial import cKDTree

    if len(mesh.faces) <= _FACES:
        return mesh
    with needed_for("view"):
        from fast_simplification import simplify

    vertices, faces = simplify(np.asarray(mesh.vertices), np.asarray(mesh.faces), target_count=_FACES)
    colours = mesh.visual.vertex_colors[cKDTree(mesh.vertices).query(vertices)[1]]
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


def _legend(playback: Playback, shown: int, points: int) -> str:
    info, run = playback.run.info, playback.run
    occurring = [s for s in style.STATUS if any((obj.status == str(s)).any() for obj in run.objects.values())]
    title = f"{info['sequence']}, tracker {info['tracker']}, "
    title += f"{len(playback)} frames" if shown == len(playback) else f"{shown} of {len(playback)} frames are shown"
    title += ", offline" * bool(info.get("offline"))
    if playback.sequence is not None:
        title += f", about {points} points of each, up to {CLOUD_MAX_M:g} m away"
    return _LEGEND.format(
        title=html.escape(title),
        objects=", ".join(f'<b style="color:{c}">{html.escape(name)}</b>' for name, c in playback.colours.items()),
        statuses=" ".join(_SWATCH.format(colour=style.STATUS[s][0], status=s) for s in occurring),
    )
