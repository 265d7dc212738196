"""Starts the node on the topics of a camera: ``ros2 launch point2pose_ros point2pose.launch.py rgb:=TOPIC ...``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

#: Argument to its default, those of realsense2_camera with align_depth.enable:=true, and its meaning.
TOPICS = {
    "rgb": ("/camera/camera/color/image_raw", "rectified colour images"),
    "depth": ("/camera/camera/aligned_depth_to_color/image_raw", "depth registered to colour"),
    "camera_info": ("/camera/camera/color/camera_info", "intrinsics of the colour camera"),
}


def generate_launch_description() -> LaunchDescription:
    """The node with its parameters."""
    params = PathJoinSubstitution([FindPackageShare("point2pose_ros"), "config", "point2pose.yaml"])
    arguments = [
        *(DeclareLaunchArgument(name, default_value=at, description=means) for name, (at, means) in TOPICS.items()),
        DeclareLaunchArgument("params", default_value=params, description="parameter file"),
        DeclareLaunchArgument("prompts", default_value="", description="file of p2p click; none: services add objects"),
        DeclareLaunchArgument("namespace", default_value="", description="of the node"),
    ]
    prompts = ParameterValue(LaunchConfiguration("prompts"), value_type=str)  # "" is a text, too
    node = Node(
        package="point2pose_ros",
        executable="node",
        name="point2pose",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params"), {"prompts": prompts}],
        remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
        output="screen",
    )
    return LaunchDescription([*arguments, node])
