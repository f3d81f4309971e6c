"""`perception node`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
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
    from perception.node.serving import serve_node, stop_on_signals
    from perception.progress import Progress

    with stop_on_signals() as stop:
        figures = serve_node(args.map, config, stop, Progress().log)
    return figures, f"{figures['answered']} questions answered"
