"""Launch files: the YAML against the commands' own settings, the processes, ROS 2's file, systemd's unit."""

from __future__ import annotations

import configparser
import importlib.util
import json
import shutil
import subprocess
import sys
import threading
import types
from pathlib import Path
from typing import Any

import pytest
import yaml

from perception.cli import build_parser
from perception.config import load_config, read_pairs
from perception.errors import InputError
from perception.launch.plan import Job, read_plan
from perception.launch.run import run_plan
from perception.node.config import NodeConfig, node_config
from support.node_maps import write_small_map
from support.paths import REPOSITORY

LAUNCH = REPOSITORY / "launch"


def written(folder: Path, document: Any) -> Path:
    file = folder / "site.yaml"
    file.write_text(document if isinstance(document, str) else yaml.safe_dump(document))
    return file


def test_commands_mean_what_the_file_says(tmp_path: Path) -> None:
    file = written(
        tmp_path,
        {
            "mapper": {
                "input": "photos",
                "output": "a.gsmap",
                "preset": "fast",
                "settings": {"train": {"budget": 7000}, "seed": 3, "photos": {"camera": "calib.yaml"}},
            },
            "node": {"settings": {"namespace": "robot/map", "domain": 5, "timeout": 2.5}},
            "viewer": {"port": 1234},
        },
    )
    mapper, node, viewer = read_plan(file)
    assert mapper.once and mapper.command[3:7] == ("map", f"{tmp_path}/photos", "-o", f"{tmp_path}/a.gsmap")
    args = build_parser().parse_args(list(mapper.command[3:]))
    assert load_config(None, args.pairs, args.preset) == load_config(
        None, ["train.budget=7000", "seed=3", "photos.camera=calib.yaml"], "fast"
    )
    args = build_parser().parse_args(list(node.command[3:]))
    assert node_config(read_pairs(args.pairs)) == NodeConfig(namespace="robot/map", domain=5, timeout=2.5)
    assert args.map == node.needs == viewer.needs == tmp_path / "a.gsmap"
    assert viewer.command[3:] == ("view", f"{tmp_path}/a.gsmap", "--host", "127.0.0.1", "--port", "1234")


def test_any_subset_starts(tmp_path: Path) -> None:
    document = {"mapper": {"input": "p", "output": "a.gsmap"}, "node": None, "viewer": {"map": "/b.gsmap"}}
    file = written(tmp_path, document)
    assert [job.name for job in read_plan(file, ["viewer", "node"])] == ["node", "viewer"]
    assert read_plan(file, ["node"])[0].needs == tmp_path / "a.gsmap"
    assert read_plan(file, ["viewer"])[0].needs == Path("/b.gsmap")
    write_small_map(tmp_path / "a.gsmap", ["mug"])
    assert [job.name for job in read_plan(file)] == ["node", "viewer"]  # the map is there: nothing to do for the mapper
    document["mapper"]["again"] = True  # type: ignore[index]
    assert read_plan(written(tmp_path, document))[0].name == "mapper"


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ("a: [", "not valid YAML"),
        ("- node", "expected parts"),
        ({}, "starts nothing"),
        ({"robot": {}}, "unknown part 'robot'"),
        ({"node": {}}, "node: no map given"),
        ({"mapper": {"input": "p"}}, "input and output are needed"),
        ({"node": {"map": "m", "settings": {"wrokers": 2}}}, "unknown setting 'wrokers'"),
        ({"node": {"map": "m", "settings": {"workers": "many"}}}, "workers: found 'many', expected a whole number"),
        ({"node": {"map": "m", "settings": {"timeout": -1}}}, "timeout: found -1"),
        ({"node": {"map": "m", "settings": 5}}, "node.settings: found int"),
        ({"mapper": {"input": "p", "output": "o", "preset": "best"}}, "mapper.preset: found 'best'"),
        ({"mapper": {"input": "p", "output": "o", "settings": {"train": {"budget": 1}}}}, "train.budget"),
        ({"viewer": {"map": "m", "port": 70000}}, "viewer port: found 70000"),
        ({"viewer": {"map": "m", "settings": {}}}, "viewer has no 'settings'"),
    ],
    ids=str,
)
def test_bad_files_name_the_setting(tmp_path: Path, document: Any, words: str) -> None:
    with pytest.raises(InputError) as told:
        read_plan(written(tmp_path, document))
    assert words in str(told.value)


def test_missing_file_and_unknown_part(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_plan(tmp_path / "no.yaml")
    with pytest.raises(InputError, match="--only: found 'robot'"):
        read_plan(LAUNCH / "perception.yaml", ["robot"])


def job(name: str, code: str, **more: Any) -> Job:
    return Job(name, (sys.executable, "-c", code), **more)


def test_mapper_first_then_node_and_what_dies_starts_again(tmp_path: Path) -> None:
    """The node waits for the map, dies twice, and is up the third time; stopping ends it."""
    made, tally = tmp_path / "a.gsmap", tmp_path / "tally"
    write_small_map(tmp_path / "aside", ["mug"])
    mapper = job("mapper", f"import os; os.rename({str(tmp_path / 'aside')!r}, {str(made)!r})", once=True)
    node = job(
        "node",
        f"import os, sys, time\nassert os.path.isdir({str(made)!r})\nopen({str(tally)!r}, 'a').write('x')\n"
        f"sys.exit(1) if os.path.getsize({str(tally)!r}) < 3 else time.sleep(60)",
        needs=made,
    )
    stop, told = threading.Event(), []

    def watch() -> None:
        while not (tally.exists() and tally.stat().st_size == 3):
            threading.Event().wait(0.02)
        stop.set()

    threading.Thread(target=watch, daemon=True).start()
    ended = run_plan([mapper, node], stop, told.append, respawn=0.05)
    assert ended["mapper"] == {"starts": 1, "exit": 0}
    assert ended["node"]["starts"] == 3 and ended["node"]["exit"] == -15
    assert any("starts again" in line for line in told)


def test_bad_input_ends_everything(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="viewer: ended with code 2"):
        run_plan(
            [job("node", "import time; time.sleep(60)"), job("viewer", "exit(2)")], threading.Event(), lambda _: None
        )
    with pytest.raises(InputError, match="mapper: ended with code 1"):
        run_plan([job("mapper", "exit(1)", once=True)], threading.Event(), lambda _: None)
    with pytest.raises(InputError, match="is no map, and no mapper"):
        run_plan([job("node", "", needs=tmp_path / "none")], threading.Event(), lambda _: None)


# ------------------------------------------------------------------------------------------------ ROS 2's launch file


class Action:
    """Stands for any of ROS 2's actions: keeps what it was given."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


def ros_launch_stub(monkeypatch: pytest.MonkeyPatch, values: dict[str, str]) -> None:
    """`launch` is not on PyPI; its names as its documentation lists them, doing nothing but remember."""
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
    }
    for module, inside in names.items():
        made = types.ModuleType(module)
        for name in inside:
            setattr(made, name, type(name, (Action,), {}))
        monkeypatch.setitem(sys.modules, module, made)

    class LaunchConfiguration:
        def __init__(self, name: str) -> None:
            self.name = name

        def perform(self, context: Any) -> str:
            return values[self.name]

    sys.modules["launch.substitutions"].LaunchConfiguration = LaunchConfiguration  # type: ignore[attr-defined]


def ros_actions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, config: Path, only: str = "") -> list[Any]:
    program = tmp_path / "perception"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m perception.cli "$@"\n')
    program.chmod(0o755)
    ros_launch_stub(monkeypatch, {"config": str(config), "only": only, "perception": str(program)})
    spec = importlib.util.spec_from_file_location("perception_launch", LAUNCH / "perception.launch.py")
    assert spec is not None and spec.loader is not None
    file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(file)
    described = file.generate_launch_description().args[0]
    assert [one.args[0] for one in described[:3]] == ["config", "only", "perception"]
    return described[3].kwargs["function"](None)


def test_ros_launch_file_starts_the_same_commands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config = written(tmp_path, {"mapper": {"input": "p", "output": "a.gsmap"}, "node": None, "viewer": {"map": "b"}})
    write_small_map(tmp_path / "b", ["mug"])
    viewer, mapper, handler = ros_actions(monkeypatch, tmp_path, config)
    jobs = {job.name: list(job.command) for job in read_plan(config)}
    assert viewer.kwargs["cmd"] == jobs["viewer"] and viewer.kwargs["respawn"]
    assert mapper.kwargs["cmd"] == jobs["mapper"] and not mapper.kwargs["respawn"]
    on_exit = handler.args[0].kwargs
    assert on_exit["target_action"] is mapper
    followers = on_exit["on_exit"](types.SimpleNamespace(returncode=0), None)
    assert [one.kwargs["cmd"] for one in followers] == [jobs["node"]]
    failed = on_exit["on_exit"](types.SimpleNamespace(returncode=2), None)
    assert [type(one).__name__ for one in failed] == ["Shutdown"]


def test_ros_launch_file_tells_what_is_wrong(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config = written(tmp_path, {"node": {"map": "b", "settings": {"workers": 0}}})
    with pytest.raises(RuntimeError, match=r"workers: found 0"):
        ros_actions(monkeypatch, tmp_path, config)


def test_shipped_yaml_is_valid() -> None:
    assert [one.name for one in read_plan(LAUNCH / "perception.yaml")] == ["mapper", "node", "viewer"]


def test_cli_prints_the_commands(tmp_path: Path) -> None:
    file = written(tmp_path, {"viewer": {"map": "b"}})
    out = subprocess.run(
        [sys.executable, "-m", "perception.cli", "launch", str(file), "--check", "--json"],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert json.loads(out.stdout)["jobs"] == [one.to_json() for one in read_plan(file)]


def test_systemd_unit(tmp_path: Path) -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(LAUNCH / "perception.service")
    assert set(unit.sections()) == {"Unit", "Service", "Install"}
    command = unit["Service"]["ExecStart"].split()
    assert command[:2] == ["/usr/bin/env", "perception"]
    args = build_parser().parse_args(command[2:])
    assert args.file.suffix == ".yaml"
    assert unit["Service"]["RestartPreventExitStatus"] == "2"  # bad input does not get better by itself
    if shutil.which("systemd-analyze"):
        copy = tmp_path / "perception.service"
        copy.write_text((LAUNCH / "perception.service").read_text())
        told = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, check=False)
        assert "Unknown" not in told.stderr and "Invalid" not in told.stderr
