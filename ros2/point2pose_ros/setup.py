"""How colcon installs the node, its launch file and its parameters."""

from setuptools import setup

NAME = "point2pose_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/point2pose.launch.py"]),
        (f"share/{NAME}/config", ["config/point2pose.yaml"]),
    ],
    zip_safe=True,
    description="A node that tracks unknown rigid objects in RGB-D images: poses, transforms and meshes.",
    license="BSD-3-Clause",
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
)
