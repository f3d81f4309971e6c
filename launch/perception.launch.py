"""ros2 launch perception.launch.py map:=site.gsmap [photos:=DIR] [view:=false] [map_args:="..."] [node_args:="..."] …

Needs no workspace. With `photos` and no map yet, `perception map` runs first. Node and viewer start when the map is
there, and again when they die; bad input (exit code 2) shuts everything down.
"""

import shlex
from pathlib import Path

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

ARGUMENTS = {
    "map": ("", "the map directory; needed"),
    "photos": ("", "photos, a COLMAP workspace or a transforms.json; makes the map when it is not there"),
    "node": ("true", "whether to start `perception node`"),
    "view": ("true", "whether to start `perception view`"),
    "map_args": ("", "further options of `perception map`, such as --preset quality"),
    "node_args": ("", "further options of `perception node`, such as --set workers=4"),
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
    lasting = [
        action for name in ("node", "view") if given[name] == "true" for action in process(name, [given["map"]], given)
    ]
    if (Path(given["map"]) / "map.json").is_file():
        return lasting
    if not given["photos"]:
        raise RuntimeError(f"map:={given['map']}: is no map; photos:= would make it")
    mapper, _ = process("map", [given["photos"], "-o", given["map"], "--resume"], given, respawn=False)

    def after(event, context):
        return lasting if event.returncode == 0 else [Shutdown(reason="the map could not be made")]

    return [mapper, RegisterEventHandler(OnProcessExit(target_action=mapper, on_exit=after))]


def process(name, words, given, respawn=True):
    """A subcommand, and what happens when it ends."""
    command = [given["perception"], name, *words, *shlex.split(given[f"{name}_args"])]
    made = ExecuteProcess(cmd=command, name=f"perception_{name}", output="screen", respawn=respawn, respawn_delay=2.0)

    def ended(event, context):
        return [Shutdown(reason=f"{name}: bad input")] if event.returncode == BAD_INPUT else []

    return [made, RegisterEventHandler(OnProcessExit(target_action=made, on_exit=ended))]
