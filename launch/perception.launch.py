"""ros2 launch perception.launch.py [config:=FILE.yaml] [only:=node,viewer] [perception:=PATH]

Needs no workspace. The command `perception` reads and checks the YAML file and tells the commands; ROS 2 runs them.
"""

import json
import subprocess
from pathlib import Path

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription


def generate_launch_description():
    here = Path(__file__).resolve().parent
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value=str(here / "perception.yaml"), description="YAML file"),
            DeclareLaunchArgument(
                "only", default_value="", description="parts to start, comma-separated; all if empty"
            ),
            DeclareLaunchArgument("perception", default_value="perception", description="the command, if not on PATH"),
            OpaqueFunction(function=start),
        ]
    )


def start(context):
    """The actions for what the YAML file names; a node or viewer whose map is not there yet follows the mapper."""
    config, only, program = (LaunchConfiguration(name).perform(context) for name in ("config", "only", "perception"))
    command = [program, "launch", config, "--only", only, "--check", "--json"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        raise RuntimeError(answer.stderr.strip() or f"{program}: cannot be run")
    jobs = json.loads(answer.stdout)["jobs"]
    once = [job for job in jobs if job["once"]]
    waiting = [job for job in jobs if once and job["needs"] and not (Path(job["needs"]) / "map.json").is_file()]
    actions = [process(job) for job in jobs if job not in waiting and job not in once]
    for job in once:
        mapper = process(job)
        followers = [process(later) for later in waiting]

        def after(event, context, followers=followers):
            return followers if event.returncode == 0 else [Shutdown(reason="the mapper failed")]

        actions += [mapper, RegisterEventHandler(OnProcessExit(target_action=mapper, on_exit=after))]
    return actions


def process(job):
    """One process; what is to run on is started again when it dies."""
    lasting = not job["once"]
    return ExecuteProcess(
        cmd=job["command"], name=f"perception_{job['name']}", output="screen", respawn=lasting, respawn_delay=2.0
    )
