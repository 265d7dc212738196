"""Messages of ROS to values of p2p_lib and back.

Messages are filled, not made, so that nothing of ROS is imported here. REP 103 and 105 are kept: metres, quaternions
x, y, z, w, the camera's optical frame (z forward, x right).
"""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, PoseEstimate
from p2p_lib.datasets.ros_messages import pixels, read_depth_m, read_rgb, seconds

#: Of ``visualization_msgs/Marker``: types and actions.
MESH_RESOURCE, ADD, DELETE = 10, 0, 2


def camera_of(info: Any) -> Camera:
    """The camera of a ``sensor_msgs/CameraInfo``; raises :class:`BadInput` where it has not been calibrated."""
    return Camera.from_K(np.reshape(info.k, (3, 3)), info.width, info.height, "camera_info.k")


def frame_of(index: int, rgb: Any, depth: Any) -> Frame:
    """A frame of two ``sensor_msgs/Image`` taken at one time; :class:`BadInput` for encodings that are not known."""
    return Frame(index, seconds(rgb.header.stamp), read_rgb("rgb image", rgb), read_depth_m("depth image", depth))


def prompt_of(request: Any) -> Prompt:
    """What a request of ``AddObject`` or ``CorrectObject`` says; :class:`BadInput` where it says nothing."""
    said: dict[str, Any] = {
        "points_px": [[at.x, at.y] for at in request.points],
        "negative_px": [[at.x, at.y] for at in request.negative],
    }
    box, mask = request.box, request.mask
    if box.width:
        said["box_px"] = [box.x_offset, box.y_offset, box.x_offset + box.width, box.y_offset + box.height]
    if mask.width:
        if mask.encoding not in ("mono8", "8UC1"):
            raise BadInput(f"mask of {request.name!r}", mask.encoding, "mono8, 0 where the object is not")
        said["mask"] = pixels(f"mask of {request.name!r}", mask, 1, "u1")[..., 0] > 0
    return Prompt(request.name, **said)


def covariance_of(estimate: PoseEstimate) -> np.ndarray:
    """(6, 6) as ``geometry_msgs/PoseWithCovariance`` wants it: translation first, about the camera's fixed axes.

    Ours is the right tangent of T_cam_obj, [rotation, translation] in the object's axes: both are turned by R.
    """
    if estimate.covariance is None or estimate.T_cam_obj is None:
        return np.zeros((6, 6))
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = estimate.T_cam_obj[:3, :3]
    return turn @ estimate.covariance @ turn.T


def fill_pose(message: Any, estimate: PoseEstimate, header: Any) -> Any:
    """A ``PoseWithCovarianceStamped`` or ``ObjectEstimate``: header, and the pose where there is one."""
    message.header = header
    if estimate.T_cam_obj is not None:
        _fill(message.pose.pose.position, message.pose.pose.orientation, estimate.T_cam_obj)
        message.pose.covariance = covariance_of(estimate).ravel()
    return message


def fill_estimate(message: Any, estimate: PoseEstimate, header: Any) -> Any:
    """An ``ObjectEstimate``."""
    message.object, message.status, message.reason = estimate.object, str(estimate.status), estimate.reason
    message.confidence, message.map_id = float(estimate.confidence), int(estimate.map_id)
    message.has_pose = estimate.T_cam_obj is not None
    return fill_pose(message, estimate, header)


def fill_transform(message: Any, estimate: PoseEstimate, header: Any, prefix: str = "") -> Any:
    """A ``TransformStamped`` from the camera's frame to the object's, of an estimate that has a pose."""
    message.header, message.child_frame_id = header, prefix + estimate.object
    _fill(message.transform.translation, message.transform.rotation, np.asarray(estimate.T_cam_obj))
    return message


def fill_marker(marker: Any, name: str, mesh: Any, prefix: str = "") -> Any:
    """A ``visualization_msgs/Marker`` that holds a mesh as a PLY file, in the object's frame of tf."""
    marker.ns, marker.header.frame_id, marker.frame_locked = name, prefix + name, True
    marker.type, marker.action = MESH_RESOURCE, ADD
    marker.mesh_resource = f"embedded://{name}.ply"
    marker.mesh_file.filename, marker.mesh_file.data = f"{name}.ply", array("B", mesh.export(file_type="ply"))
    marker.mesh_use_embedded_materials = True
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    marker.color.r = marker.color.g = marker.color.b = marker.color.a = 1.0
    return marker


def _fill(at: Any, turn: Any, T: np.ndarray) -> None:
    at.x, at.y, at.z = map(float, T[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, se3.quaternion_xyzw(T))
