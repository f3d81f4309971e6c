"""What starts the processes on a robot: ROS 2's launch file, systemd's units, the shell script."""

from __future__ import annotations

import configparser
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from perception.cli import build_parser
from support.paths import REPOSITORY

LAUNCH = REPOSITORY / "launch"


EVENTS = ("RegisterEventHandler", "Shutdown")


class Action:
    """Stands for any of ROS 2's actions: keeps what it was given."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


def ros_actions(monkeypatch: pytest.MonkeyPatch, **given: str) -> list[Any]:
    """What the launch file starts. `launch` is not on PyPI: its names as its documentation lists them, which only
    remember what they were given."""
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": [
            "DeclareLaunchArgument",
            "ExecuteProcess",
            "OpaqueFunction",
            "RegisterEventHandler",
            "Shutdown",
        ],
        "launch.event_handlers": ["OnProcessExit"],
        "launch.substitutions": [],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
    }
    for module, inside in names.items():
        made = types.ModuleType(module)
        for name in inside:
            setattr(made, name, type(name, (Action,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    values: dict[str, str] = {}

    class LaunchConfiguration:
        def __init__(self, name: str) -> None:
            self.name = name

        def perform(self, context: Any) -> str:
            return values[self.name]

    sys.modules["launch.substitutions"].LaunchConfiguration = LaunchConfiguration  # type: ignore[attr-defined]
    spec = importlib.util.spec_from_file_location(
        "perception_launch", LAUNCH / "perception/launch/perception.launch.py"
    )
    assert spec is not None and spec.loader is not None
    file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(file)
    *declared, function = file.generate_launch_description().args[0]
    values.update({one.args[0]: one.kwargs["default_value"] for one in declared})
    assert set(given) <= set(values)
    values.update(given)
    return function.kwargs["function"](None)


def processes(actions: list[Any]) -> list[Any]:
    return [one for one in actions if type(one).__name__ == "ExecuteProcess"]


def ends(actions: list[Any], of: Any, code: int) -> list[Any]:
    """What the launch file does when the process `of` ends with `code`."""
    handlers = [one.args[0].kwargs for one in actions if type(one).__name__ == "RegisterEventHandler"]
    (handler,) = [one["on_exit"] for one in handlers if one["target_action"] is of]
    return handler(types.SimpleNamespace(returncode=code), None)


def test_ros_launch_makes_the_map_first_and_keeps_node_and_viewer_running(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = str(tmp_path / "a.gsmap")
    actions = ros_actions(
        monkeypatch, map=path, photos="p", map_args="--preset fast", node="plain", node_args="--domain 5"
    )
    (mapper,) = processes(actions)
    assert not mapper.kwargs["respawn"]
    made = build_parser().parse_args(mapper.kwargs["cmd"][1:])
    assert (str(made.input), str(made.output), made.preset, made.resume) == ("p", path, "fast", True)
    followers = ends(actions, mapper, 0)
    node, viewer = processes(followers)
    assert all(one.kwargs["respawn"] for one in (node, viewer))
    asked = build_parser().parse_args(node.kwargs["cmd"][1:])
    assert (asked.command, str(asked.map), asked.domain) == ("node", path, "5")
    assert viewer.kwargs["cmd"] == ["perception", "view", path]
    assert [type(one).__name__ for one in ends(actions, mapper, 2)] == ["Shutdown"]
    assert [type(one).__name__ for one in ends(followers, node, 2)] == ["Shutdown"]
    assert ends(followers, node, 1) == []


def test_ros_launch_with_a_map_starts_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text("{}")
    (node,) = processes(
        ros_actions(monkeypatch, map=str(tmp_path), photos="p", node="plain", view="false", perception="/v/perception")
    )
    assert node.kwargs["cmd"] == ["/v/perception", "node", str(tmp_path), "--namespace", "perception"]


def test_ros_launch_starts_the_lifecycle_node_and_rviz(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text("{}")
    actions = ros_actions(
        monkeypatch, map=str(tmp_path), frame_file="f.yaml", namespace="arm", view="false", rviz="true"
    )
    node, viewer = [one for one in actions if type(one).__name__ == "Node"]
    assert (node.kwargs["package"], node.kwargs["executable"], node.kwargs["namespace"]) == (
        "perception",
        "node",
        "arm",
    )
    assert node.kwargs["parameters"] == [{"map": str(tmp_path), "frame_file": "f.yaml", "autostart": True}]
    assert [type(one).__name__ for one in ends(actions, node, 2)] == ["Shutdown"]
    assert Path(viewer.kwargs["arguments"][1]) == LAUNCH / "perception/rviz/perception.rviz"


def test_ros_launch_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="map:="):
        ros_actions(monkeypatch)
    with pytest.raises(RuntimeError, match="photos:="):
        ros_actions(monkeypatch, map=str(tmp_path))
    with pytest.raises(RuntimeError, match="lifecycle, plain or false"):
        ros_actions(monkeypatch, map=str(tmp_path), node="yes")


def environment() -> dict[str, str]:
    lines = (LAUNCH / "perception.env").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if not line.startswith("#"))


def unit(name: str) -> configparser.ConfigParser:
    read = configparser.ConfigParser(strict=False, interpolation=None)
    read.optionxform = str  # type: ignore[assignment,method-assign]
    read.read(LAUNCH / f"perception-{name}.service")
    assert set(read.sections()) == {"Unit", "Service", "Install"}
    return read


@pytest.mark.parametrize("name", ["node", "view"])
def test_systemd_units_of_what_runs_on(name: str) -> None:
    service, values = unit(name), environment()
    assert "perception-map.service" in service["Unit"]["Requires"] and service["Service"]["Restart"] == "on-failure"
    assert service["Service"]["RestartPreventExitStatus"] == "2"  # bad input does not get better by itself
    program, *words = service["Service"]["ExecStart"].split()
    options = [part for word in words for part in _expanded(word, values)]
    assert (program, options[0]) == ("/usr/bin/env", "perception")
    asked = build_parser().parse_args(options[1:])
    assert (asked.command, str(asked.map)) == (name, values["MAP"])


def _expanded(word: str, values: dict[str, str]) -> list[str]:
    """As systemd does: ${NAME} is one word, $NAME is split at spaces."""
    if word.startswith("${"):
        return [values[word[2:-1]]]
    return shlex.split(values[word[1:]]) if word.startswith("$") else [word]


@pytest.mark.parametrize("there", [False, True])
def test_systemd_makes_the_map_only_when_it_is_not_there(tmp_path: Path, there: bool) -> None:
    """The unit's own command line, run by the shell that it names, with a command that writes down its arguments."""
    (tmp_path / "perception").write_text('#!/bin/sh\nprintf "%s\\n" "$@" > asked\n')
    (tmp_path / "perception").chmod(0o755)
    values = {**environment(), "MAP": str(tmp_path / "a map"), "PHOTOS": "my photos"}
    if there:
        (tmp_path / "a map").mkdir()
        (tmp_path / "a map/map.json").write_text("{}")
    command = shlex.split(unit("map")["Service"]["ExecStart"])
    path = f"{tmp_path}:{os.environ['PATH']}"
    subprocess.run(command, env={**values, "PATH": path}, cwd=tmp_path, check=True)
    assert (tmp_path / "asked").exists() != there
    if not there:
        asked = build_parser().parse_args((tmp_path / "asked").read_text().splitlines())
        assert (str(asked.input), str(asked.output), asked.preset) == ("my photos", values["MAP"], "default")


def test_systemd_understands_the_units(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    copies = [Path(shutil.copy(file, tmp_path)) for file in LAUNCH.glob("*.service")]
    told = subprocess.run(["systemd-analyze", "verify", *copies], capture_output=True, text=True, check=False)
    assert "Unknown" not in told.stderr and "Invalid" not in told.stderr
