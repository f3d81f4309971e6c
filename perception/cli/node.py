"""`perception node` and `perception launch`."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    _add_node(commands)
    _add_launch(commands)


def _add_node(commands: Any) -> None:
    p = command(commands, "node", _node, "serve a map on DDS or ROS 2: prompts in; points, boxes and markers out")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--transport", help="dds, rclpy or auto: rclpy where ROS 2 is, else dds")
    p.add_argument("--namespace", metavar="NAME", help="before all topics; default: perception")
    p.add_argument("--domain", metavar="N", help="DDS domain; default: ROS_DOMAIN_ID or 0")
    p.add_argument("--network", metavar="NET", help="localhost, or an interface such as eth0 (dds only)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs", help="further settings")


def _node(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.config import read_pairs
    from perception.node.config import node_config

    values = read_pairs(args.pairs)
    for name in ("transport", "namespace", "domain", "network"):
        if getattr(args, name) is not None:
            values[name] = getattr(args, name)
    config = node_config(values)
    from perception.node.run import serve_node, stop_on_signals
    from perception.progress import Progress

    with stop_on_signals() as stop:
        figures = serve_node(args.map, config, stop, Progress().log)
    return figures, f"{figures['answered']} questions answered"


def _add_launch(commands: Any) -> None:
    p = command(commands, "launch", _launch, "start mapper, node and viewer as a YAML file says, and keep them running")
    p.add_argument("file", type=Path, metavar="FILE.yaml")
    p.add_argument("--only", default="", metavar="PARTS", help="comma-separated: mapper, node, viewer")
    p.add_argument("--check", action="store_true", help="check the file and print the commands, start nothing")


def _launch(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.launch.plan import read_plan
    from perception.launch.run import run_plan
    from perception.node.run import stop_on_signals
    from perception.progress import Progress

    jobs = read_plan(args.file, [name.strip() for name in args.only.split(",") if name.strip()])
    if args.check:
        return {"jobs": [job.to_json() for job in jobs]}, "\n".join(shlex.join(job.command) for job in jobs)
    with stop_on_signals() as stop:
        ended = run_plan(jobs, stop, Progress().log)
    return {"ended": ended}, ""
