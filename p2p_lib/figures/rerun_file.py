"""A run as a Rerun recording: video, masks, tracks, 3D, status and error over time (``p2p view DIR --rerun FILE``).

For looking closely, frame by frame; the viewer is the package's own (``rerun FILE``). An optional dependency.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from p2p_lib.core import packages, se3
from p2p_lib.core.types import Status
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.figures import style
from p2p_lib.figures.playback import Playback

JPEG_QUALITY = 80
#: Points of a frame, and the radii in metres of those points and of keypoints.
POINTS, _POINT_M, _KEYPOINT_M, _AXES_M = 5000, 0.002, 0.002, 0.06
#: Where things are: as parts, since an object's name may hold what a path may not.
_IMAGE, _SCENE = ["camera", "picture"], ["scene"]


def write_rerun(run: str | Path, out: str | Path, sequence: Sequence | None = None) -> Path:
    """Write the recording of a run's folder; the path written.

    Raises :class:`MissingBackend` without the package rerun-sdk.
    """
    rr = packages.load("rerun", "--rerun", "rerun-sdk")
    playback, out = Playback.of(run, sequence), Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    stream = rr.RecordingStream("p2p", recording_id=f"{playback.run.info['sequence']}, {playback.run.path.name}")
    stream.save(out, default_blueprint=_layout())
    _log_constants(rr, stream, playback)
    for i in range(len(playback)):
        stream.set_time("frame", sequence=int(playback.frame_index[i]))
        stream.set_time("time", duration=float(playback.times_s[i]))
        _log_images(rr, stream, playback, i)
        for name in playback.run.objects:
            _log_object(rr, stream, playback, name, i)
    stream.flush()
    stream.disconnect()
    return out


def _layout() -> Any:
    """How the viewer divides its window: 3D beside the video, error and status below."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(name="3D", origin="/"),
                rrb.Spatial2DView(name="video, masks, tracks", origin="/camera/picture"),
            ),
            rrb.Horizontal(
                rrb.TimeSeriesView(name="ADD [mm]", origin="/error"),
                rrb.TimeSeriesView(name="confidence", origin="/confidence"),
                rrb.StateTimelineView(name="status", origin="/status"),
            ),
            row_shares=[3, 1],
        )
    )


def _log_constants(rr: Any, stream: Any, playback: Playback) -> None:
    """What does not change: the camera, colours, names of statuses, the objects' paths."""
    stream.log("/", rr.ViewCoordinates.RDF, static=True)
    names = list(playback.run.objects)
    classes = [(k, name, style.rgb(playback.colours[name])) for k, name in enumerate(names, 1)]
    stream.log("/", rr.AnnotationContext([(0, "background", (0, 0, 0, 0)), *classes]), static=True)
    if playback.sequence is not None:
        camera = playback.sequence.camera
        pinhole = rr.Pinhole(
            image_from_camera=camera.K, width=camera.width, height=camera.height, image_plane_distance=0.1
        )
        stream.log(_IMAGE, pinhole, static=True)
    statuses = [str(status) for status in Status]
    fills = [style.rgb(style.STATUS[status][0]) for status in Status]
    for name in names:
        colour = style.rgb(playback.colours[name])
        for plot in ("error", "confidence"):
            stream.log([plot, name], rr.SeriesLines(colors=colour, names=name), static=True)
        stream.log(["status", name], rr.StateConfiguration(values=statuses, colors=fills), static=True)
        positions, colours = playback.path(name)
        if len(positions):
            stream.log(["paths", name], rr.Points3D(positions, colors=colours, radii=_POINT_M), static=True)


def _log_images(rr: Any, stream: Any, playback: Playback, i: int) -> None:
    """The image, the masks on it, and the points behind it."""
    frame = playback.frame(i)
    if frame is None:
        return
    stream.log([*_IMAGE, "rgb"], rr.Image(frame.rgb).compress(jpeg_quality=JPEG_QUALITY))
    labels = np.zeros(frame.shape, np.uint8)
    masks = playback.masks(i)
    for k, name in enumerate(playback.run.objects, 1):
        if name in masks:
            labels[masks[name]] = k
    if masks:
        stream.log([*_IMAGE, "masks"], rr.SegmentationImage(labels, opacity=0.4))
    p_cam, colours = playback.cloud(i, frame, POINTS)
    stream.log("points", rr.Points3D(p_cam, colors=colours, radii=_POINT_M))


def _log_object(rr: Any, stream: Any, playback: Playback, name: str, i: int) -> None:
    """One object at row i: where it is, what is known of it, how good that is."""
    obj, colour = playback.objects[name], style.rgb(playback.colours[name])
    has, whole = obj.has_pose, playback.of_kept_map(name)
    changed = not i or (has[i], whole[i]) != (has[i - 1], whole[i - 1])
    if i == 0 or obj.status[i] != obj.status[i - 1]:
        stream.log(["status", name], rr.StateChange(state=str(obj.status[i])))
    stream.log(["confidence", name], rr.Scalars(float(obj.confidence[i])))
    error_mm = 1e3 * playback.add_m(name)[i]
    if np.isfinite(error_mm):
        stream.log(["error", name], rr.Scalars(float(error_mm)))
    points = playback.keypoints.get(name)
    if points is not None:
        seen = points.at(int(playback.frame_index[i]))
        stream.log([*_IMAGE, "tracks", name], rr.Points2D(points.uv_px[seen], colors=colour, radii=2.5))
    if i and changed:
        stream.log([*_SCENE, name], rr.Clear(recursive=True))
    if not has[i]:
        return
    T_cam_obj = obj.T_cam_obj[i]
    pose = rr.Transform3D(translation=T_cam_obj[:3, 3], quaternion=se3.quaternion_xyzw(T_cam_obj))
    stream.log([*_SCENE, name], pose)
    if changed:
        _log_shape(rr, stream, playback, name, whole[i])
    if obj.keyframe[i] and whole[i]:
        rows, T_obj_cam = playback.keyframes(name)
        at = T_obj_cam[rows <= i, :3, 3]
        stream.log([*_SCENE, name, "keyframes"], rr.Points3D(at, colors=colour, radii=2 * _KEYPOINT_M))


def _log_shape(rr: Any, stream: Any, playback: Playback, name: str, whole: bool) -> None:
    """What an object looks like in its own frame, whenever it appears: axes, and of the map that is kept the rest."""
    at, axes = [*_SCENE, name], np.eye(3) * _AXES_M
    stream.log([*at, "axes"], rr.Arrows3D(vectors=axes, colors=[style.rgb(colour) for colour in style.AXES]))
    if not whole:
        return
    if name in playback.meshes:
        mesh: Any = playback.meshes[name]
        surface = rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.faces,
            vertex_normals=mesh.vertex_normals,
            vertex_colors=mesh.visual.vertex_colors,
        )
        stream.log([*at, "surface"], surface)
    points = playback.keypoints.get(name)
    if points is not None and len(points.ids):
        colour = style.rgb(playback.colours[name])
        stream.log([*at, "keypoints"], rr.Points3D(points.p_obj, colors=colour, radii=_KEYPOINT_M))
