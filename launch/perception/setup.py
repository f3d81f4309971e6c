"""The ROS 2 package `perception`: node, launch file and RViz configuration. Its module is `perception_ros`, because
`perception` is the Python package that it runs."""

from setuptools import setup

SHARE = "share/perception"

setup(
    name="perception",
    version="0.1.0",
    packages=["perception_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/perception"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", ["launch/perception.launch.py"]),
        (f"{SHARE}/rviz", ["rviz/perception.rviz"]),
        (f"{SHARE}/config", ["config/frame.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    license="Apache-2.0",
    entry_points={"console_scripts": ["node = perception_ros.node:main"]},
)
