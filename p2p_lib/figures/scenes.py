"""What a run shows at a frame: boxes, axes, paths and statuses on its video; single images, stories, films."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import DOUBTED, Frame, PoseEstimate, status_word
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.datasets.sequence import Sequence as Video
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.extended.default import Point2Pose
from p2p_lib.figures import overlay, style
from p2p_lib.figures.overlay import Label, OrientedBox
from p2p_lib.figures.playback import Playback
from p2p_lib.figures.plots import gaps

#: How strongly a mask tints its inside, and the radius of a keypoint.
_FILL, _POINT_PX = 0.15, 2.5
#: Of the outline of a surface, beside that of its object's mask in the object's colour.
_SURFACE = "#ffffff"


class Scene:
    """A run on its video, ready to be drawn.

    evaluation  brings the model's frame into the object's, and with it true boxes beside the estimated ones
    boxes       object to its box in the frame of the map that is kept, where there is no model or another is wanted
    objects     what is drawn, by default those of the run, which are in the map that is kept (see :class:`Playback`)
    """

    def __init__(
        self,
        sequence: Video,
        run: Run,
        evaluation: Evaluation | None = None,
        boxes: Mapping[str, OrientedBox] | None = None,
        truth: bool = True,
        objects: Mapping[str, ObjectRun] | None = None,
    ):
        if sequence.name != run.info["sequence"]:
            raise BadInput("scene", f"a run of {run.info['sequence']!r}", f"one of {sequence.name!r}")
        for name, obj in run.objects.items():
            if name not in sequence.truth:
                continue
            T_cam_model = sequence.truth[name].T_cam_model[obj.frame_index]
            if not np.allclose(T_cam_model, obj.T_cam_model, atol=1e-6, equal_nan=True):
                # A synthetic sequence may have been generated anew since.
                raise BadInput("scene", f"a run on another {sequence.name!r}", "the data it ran on", "Run it again.")
        self.sequence, self.run, self.objects = sequence, run, objects or run.objects
        known = set(run.objects) <= set(sequence.objects)  # a folder without masks knows no names
        self.colours = style.object_colours(sequence.objects if known else run.objects)
        self._model_boxes = {name: OrientedBox.around(points) for name, points in run.points.items()} if truth else {}
        kept = {name: obj.kept_map for name, obj in self.objects.items()}
        self._boxes: dict[tuple[str, int], OrientedBox] = {}  # of an object's map, in the frame of that map
        for name, score in evaluation.objects.items() if evaluation else ():
            obj, points = self.objects[name], run.points.get(name)
            if points is None or not np.isfinite(score.T_obj_model).all():
                continue
            both = np.flatnonzero(obj.has_pose & obj.has_truth)
            for k in both[np.unique(obj.map_id[both], return_index=True)[1]].tolist():  # the first of each map
                T_obj_model = se3.inverse(obj.T_cam_obj[k]) @ obj.T_cam_model[k]
                self._boxes[name, int(obj.map_id[k])] = OrientedBox.around(points, T_obj_model)
            self._boxes[name, kept[name]] = OrientedBox.around(points, score.T_obj_model)
        self._boxes |= {(name, kept[name]): box for name, box in (boxes or {}).items()}
        self._playback: Playback | None = None
        self._surfaces = False

    @classmethod
    def of(cls, playback: Playback, surfaces: bool = False) -> Scene:
        """With all that the run's folder holds: keypoints, masks, and a box around each reconstructed surface.

        surfaces  whether the outline of each surface at its pose is drawn, too
        """
        boxes = {name: overlay.tight_box(mesh) for name, mesh in playback.meshes.items()}
        scene = cls(playback.images, playback.run, boxes=boxes, truth=False, objects=playback.objects)
        scene._playback, scene._surfaces = playback, surfaces
        return scene

    @classmethod
    def scored(cls, playback: Playback) -> Scene:
        """With the model's box, true and as estimated: in each map of an object by the first frame that has both."""
        return cls(playback.images, playback.run, playback.evaluation, objects=playback.objects)

    def __len__(self) -> int:
        return len(next(iter(self.objects.values())))

    def row(self, index: int) -> int:
        """The row of the run that is of frame ``index`` of the sequence; :class:`BadInput` where there is none."""
        frames = next(iter(self.objects.values())).frame_index
        rows = np.flatnonzero(frames == index)
        if not len(rows):
            raise BadInput("frame", index, f"one of the run, {frames[0]} to {frames[-1]}")
        return int(rows[0])

    def draw(
        self,
        row: int,
        region_px: tuple[int, int, int, int] | None = None,
        width_px: int | None = None,
        axes: bool = True,
        trail: int = 30,
        words: bool = True,
        dots: tuple[np.ndarray, np.ndarray] | None = None,
        note: str = "",
    ) -> np.ndarray:
        """The run's ``row``-th frame, cut to a region and scaled to a width; ``words`` are names, statuses, the time.

        They say of an offline run that it is one. Estimated boxes are in their object's colour, true ones white and
        dashed; ``trail`` is how many earlier frames the path goes back; ``dots`` are pixels (K, 2) of the whole image
        and their colours (K, 3); ``note`` stands in the lower left corner.
        """
        first = next(iter(self.objects.values()))
        frame = self.sequence.frame(int(first.frame_index[row]))
        whole, image = self.sequence.camera, self._with_what_was_seen(frame, row)
        region_px = region_px or (0, 0, whole.width, whole.height)
        image, camera = overlay.zoomed(image, whole, region_px, width_px or region_px[2] - region_px[0])
        foot = (0, image.shape[0] - 2, 1, image.shape[0] - 1)
        labels = [Label(note, "#222222", foot)] if note else []
        for name, obj in self.objects.items():
            image = self._draw_object(image, camera, name, obj, row, axes, trail)
            if (label := self._label(camera, name, obj, row)) is not None:
                labels.append(label)
        if dots is not None:
            image = overlay.draw_points(image, overlay.zoomed_px(dots[0], whole, camera), dots[1], 3)
        if not words:
            return image
        caption = f"{self.sequence.name}  frame {frame.index}  {frame.time_s - first.time_s[0]:.2f} s"
        caption += "  offline" * bool(self.run.info.get("offline"))
        return overlay.draw_labels(image, labels, caption)

    def story(self, count: int = 6, columns: int = 3, width_px: int = 360) -> np.ndarray:
        """One sheet of ``count`` frames that tell what happened, cut to where the objects are."""
        region_px = self.region()
        return overlay.montage([self.draw(row, region_px, width_px, trail=0) for row in self.moments(count)], columns)

    def moments(self, count: int) -> list[int]:
        """Rows that tell the story: the first, each gap's middle and the return from it, then what lies between."""
        n, wanted = len(self), [0]
        for obj in self.objects.values():
            for start, stop in gaps(obj):
                wanted += [(start + stop) // 2, min(stop + 2, n - 1)]
        rows = sorted(set(wanted))[:count]
        while len(rows) < min(count, n):
            ends = [*rows, n - 1 + (rows[-1] != n - 1)]
            widest = max(range(len(ends) - 1), key=lambda k: ends[k + 1] - ends[k])
            rows = sorted({*rows, (ends[widest] + ends[widest + 1]) // 2})
        return rows

    def region(self, margin: float = 0.08) -> tuple[int, int, int, int]:
        """The rectangle of the objects over the whole run, with a margin (a fraction of the image's width)."""
        camera, corners = self.sequence.camera, [np.zeros((0, 2))]
        for name, obj in self.objects.items():
            shown = [(self._model_boxes.get(name), obj.T_cam_model[obj.has_truth])]
            for map_id in np.unique(obj.map_id).tolist():
                shown.append((self._boxes.get((name, map_id)), obj.T_cam_obj[obj.has_pose & (obj.map_id == map_id)]))
            corners += [camera.project(box.corners(T)).reshape(-1, 2) for box, T in shown if box]
        uv = np.concatenate(corners)
        uv = uv[camera.inside(uv)]
        if not len(uv):
            return 0, 0, camera.width, camera.height
        margin_px = round(margin * camera.width)
        return overlay.region_around(uv, camera, (margin_px, margin_px))

    def _box(self, name: str, row: int) -> OrientedBox | None:
        """An object's box in the frame of its pose at a row, where there is one."""
        return self._boxes.get((name, int(self.objects[name].map_id[row])))

    def _with_what_was_seen(self, frame: Frame, row: int) -> np.ndarray:
        """The image with the masks and keypoints of the row, where the run's folder has them."""
        if self._playback is None:
            return frame.rgb
        image = overlay.draw_masks(frame.rgb, self._playback.masks(row), self.colours, fill=_FILL)
        for name, points in self._playback.keypoints.items():
            image = overlay.draw_points(image, points.uv_px[points.at(frame.index)], self.colours[name], _POINT_PX)
        for shown in self._playback.silhouettes(row).values() if self._surfaces else ():
            image = overlay.draw_mask(image, shown, _SURFACE, width_px=1)
        return image

    def _draw_object(
        self, image: np.ndarray, camera: Camera, name: str, obj: ObjectRun, row: int, axes: bool, trail: int
    ) -> np.ndarray:
        colour, true_box = self.colours[name], self._model_boxes.get(name)
        box = self._box(name, row)
        if true_box and obj.has_truth[row]:
            image = overlay.draw_box(image, camera, obj.T_cam_model[row], true_box, style.TRUTH, dashed=True)
        if not obj.has_pose[row]:
            return image
        past = slice(max(row - trail, 0), row + 1)
        T_cam_box = obj.T_cam_obj[past] @ (box.T_obj_box if box else se3.IDENTITY)
        centres = np.where((obj.map_id[past] == obj.map_id[row])[:, None], T_cam_box[:, :3, 3], np.nan)
        image = overlay.draw_trail(image, camera.project(centres), colour)
        if box:
            image = overlay.draw_box(image, camera, obj.T_cam_obj[row], box, colour)
        length_m = 0.45 * float(np.max(box.size_m)) if box else 0.05
        return overlay.draw_axes(image, camera, T_cam_box[-1], length_m) if axes else image

    def _label(self, camera: Camera, name: str, obj: ObjectRun, row: int) -> Label | None:
        """The object's name and status, at its estimated box, else its true one, else where it was last seen."""
        if not obj.followed[row]:
            return None
        before = np.flatnonzero(obj.has_pose[: row + 1])
        box: OrientedBox | None
        if not obj.has_pose[row] and name in self._model_boxes and obj.has_truth[row]:
            box, T_cam_obj = self._model_boxes[name], obj.T_cam_model[row]
        elif len(before):
            box, T_cam_obj = self._box(name, before[-1]), obj.T_cam_obj[before[-1]]
        else:
            return None
        uv = camera.project(box.corners(T_cam_obj) if box else T_cam_obj[None, :3, 3])
        if not np.isfinite(uv).all():
            return None
        text = _status(name, obj.status[row], obj.reason[row], obj.doubted[row])
        return Label(text, self.colours[name], (*uv.min(0), *uv.max(0)))


def side_by_side(
    scenes: Mapping[str, Scene], shown: int | Sequence[int], width_px: int = 300, axes: bool = False, across: int = 1
) -> np.ndarray:
    """The same frames of each method under its name, one method a line, or ``across`` of them.

    shown  frames, or how many moments that tell the story of the first
    """
    first = next(iter(scenes.values()))
    frames = shown
    if isinstance(frames, int):
        frames = next(iter(first.objects.values())).frame_index[first.moments(frames)].tolist()
    region_px, images = first.region(), []
    for name, scene in scenes.items():
        for index in frames:
            images.append(scene.draw(scene.row(index), region_px, width_px, axes=axes, trail=0, note=name))
    return overlay.montage(images, columns=across * len(frames))


def draw_live(
    method: Point2Pose,
    frame: Frame,
    estimates: Mapping[str, PoseEstimate],
    title: str,
    start_s: float = 0.0,
    names: Iterable[str] = (),
) -> np.ndarray:
    """The tracker's own view of a frame: masks, boxes, axes, statuses, and the map's keypoints (pending ones as rings).

    start_s  the time of the first frame, from which seconds are counted
    names    objects so far, removed ones too, in whose order they get their colours
    """
    colours, labels = style.object_colours(dict.fromkeys([*names, *method.objects])), []
    masks = {name: mask for name, mask in method.masks.items() if mask is not None}
    image = overlay.draw_masks(frame.rgb, masks, colours, fill=_FILL)
    for name, estimate in estimates.items():
        T_cam_obj, keypoints = estimate.T_cam_obj, method.objects[name].map
        if T_cam_obj is None or not len(keypoints):
            continue
        uv_px = method.camera.project(se3.transform(T_cam_obj, keypoints.p_obj))
        image = overlay.draw_points(image, uv_px[~keypoints.promoted], colours[name], 3, filled=False)
        image = overlay.draw_points(image, uv_px[keypoints.promoted], colours[name], _POINT_PX)
        image = overlay.draw_box(image, method.camera, T_cam_obj, OrientedBox.around(keypoints.p_obj), colours[name])
        image = overlay.draw_axes(image, method.camera, T_cam_obj, 0.06)
        low, high = np.nanmin(uv_px, 0), np.nanmax(uv_px, 0)
        text = _status(name, estimate.status, estimate.reason, estimate.confidence <= DOUBTED)
        labels.append(Label(text, colours[name], (*low, *high)))
    return overlay.draw_labels(image, labels, f"{title}  {frame.time_s - start_s:.2f} s")


def _status(name: str, status: str, reason: str, doubted: bool) -> str:
    """What a label says of an object."""
    return f"{name}: {status_word(status, reason)}" + ", doubted" * bool(doubted)
