"""ros2 launch perception perception.launch.py map:=site.gsmap [frame_file:=frame.yaml] [rviz:=true] [photos:=DIR] …

Without a workspace: ros2 launch perception.launch.py node:=plain map:=site.gsmap, which runs `perception node`.
With `photos` and no map yet, `perception map` runs first. Node and viewer start when the map is there, and again when
they die; bad input (exit code 2) shuts everything down.
"""

import shlex
from pathlib import Path

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

ARGUMENTS = {
    "map": ("", "the map directory; needed"),
    "photos": ("", "photos, a COLMAP workspace or a transforms.json; makes the map when it is not there"),
    "node": (
        "lifecycle",
        "lifecycle: the node of this package, which activates itself; plain: `perception node`; false",
    ),
    "namespace": ("perception", "before all topics of the node"),
    "frame_file": ("", "where the map lies in the robot's world, see config/frame.yaml; lifecycle node only"),
    "rviz": ("false", "whether to start RViz on the topics in the namespace `perception`"),
    "view": ("true", "whether to start `perception view`"),
    "map_args": ("", "further options of `perception map`, such as --preset quality"),
    "node_args": ("", "further arguments of the node: --set workers=4 (plain), --ros-args -p workers:=4 (lifecycle)"),
    "view_args": ("", "further options of `perception view`, such as --port 8091"),
    "perception": ("perception", "the command, if it is not on PATH: /venv/bin/perception"),
}
BAD_INPUT = 2


def generate_launch_description():
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def start(context):
    """The processes that the arguments ask for; node and viewer follow the mapper where the map is still to be made."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if not given["map"]:
        raise RuntimeError("map:= is needed, the map directory")
    if given["node"] not in ("lifecycle", "plain", "false"):
        raise RuntimeError(f"node:={given['node']}: expected lifecycle, plain or false")
    lasting = []
    if given["node"] == "lifecycle":
        lasting += lifecycle_node(given)
    if given["node"] == "plain":
        lasting += process("node", [given["map"], "--namespace", given["namespace"]], given)
    if given["view"] == "true":
        lasting += process("view", [given["map"]], given)
    if given["rviz"] == "true":
        config = Path(__file__).resolve().parents[1] / "rviz" / "perception.rviz"
        lasting.append(Node(package="rviz2", executable="rviz2", arguments=["-d", str(config)]))
    if (Path(given["map"]) / "map.json").is_file():
        return lasting
    if not given["photos"]:
        raise RuntimeError(f"map:={given['map']}: is no map; photos:= would make it")
    mapper, _ = process("map", [given["photos"], "-o", given["map"], "--resume"], given, respawn=False)

    def after(event, context):
        return lasting if event.returncode == 0 else [Shutdown(reason="the map could not be made")]

    return [mapper, RegisterEventHandler(OnProcessExit(target_action=mapper, on_exit=after))]


def lifecycle_node(given):
    """The package's node, which configures and activates itself, and what happens when it ends."""
    made = Node(
        package="perception",
        executable="node",
        namespace=given["namespace"],
        parameters=[{"map": given["map"], "frame_file": given["frame_file"], "autostart": True}],
        arguments=shlex.split(given["node_args"]),
        output="screen",
        respawn=True,
        respawn_delay=2.0,
    )
    return [made, RegisterEventHandler(OnProcessExit(target_action=made, on_exit=ended("node")))]


def process(name, words, given, respawn=True):
    """A subcommand, and what happens when it ends."""
    command = [given["perception"], name, *words, *shlex.split(given[f"{name}_args"])]
    made = ExecuteProcess(cmd=command, name=f"perception_{name}", output="screen", respawn=respawn, respawn_delay=2.0)
    return [made, RegisterEventHandler(OnProcessExit(target_action=made, on_exit=ended(name)))]


def ended(name):
    """What happens when a process ends: everything stops after bad input."""

    def handler(event, context):
        return [Shutdown(reason=f"{name}: bad input")] if event.returncode == BAD_INPUT else []

    return handler
