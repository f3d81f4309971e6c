"""`perception serve`, `mcp`, `node` and `view`: one map over HTTP, for a language model, on ROS 2, in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import map_command
from perception.errors import InputError
from perception.progress import Progress, say


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = map_command(commands, "serve", _serve, "a map over HTTP: JSON and binary points")
    p.set_defaults(interrupted="stopped")
    p.add_argument("--host", default="127.0.0.1", help="other than this machine only with a token")
    p.add_argument("--port", type=int, default=8765, help="0: any free one")
    p.add_argument("--token-file", type=Path, metavar="FILE", help="clients send its content as a bearer token")
    p.add_argument("--timeout", type=float, default=10.0, metavar="S", help="seconds an answer may take")
    p.add_argument("--workers", type=int, default=2, metavar="N", help="questions answered at once")
    p.add_argument("--queue", type=int, default=64, metavar="N", help="questions that may wait; more are refused")
    p.add_argument("--watch", type=float, default=1.0, metavar="S", help="look for a new map this often, 0: never")
    _add_photos(p)

    p = map_command(commands, "mcp", _mcp, "a map as tools of a language model (MCP), over stdio or HTTP; read-only")
    p.set_defaults(interrupted="stopped")
    p.add_argument("--http", metavar="HOST:PORT", help="streamable HTTP at http://HOST:PORT/mcp instead of stdio")
    p.add_argument("--token-file", type=Path, metavar="FILE", help="HTTP clients send its content as a bearer token")
    _add_photos(p)

    p = map_command(commands, "node", _node, "serve a map on ROS 2 (rclpy): prompts in; points, boxes and markers out")
    p.add_argument("--namespace", metavar="NAME", help="before all topics; default: perception")
    p.add_argument("--domain", metavar="N", help="ROS domain; default: ROS_DOMAIN_ID or 0")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs", help="further settings")

    p = map_command(commands, "view", _view, "walk through a map in the browser: ask, pick, correct, save")
    p.add_argument("--host", default="127.0.0.1", help="other than this machine only with a token")
    p.add_argument("--port", type=int, default=8090, help="0: any free one")
    p.add_argument("--token-file", type=Path, metavar="FILE", help="its content opens the page; default: a new token")
    _add_photos(p)


def _add_photos(command: Any) -> None:
    text = "also use photos in this folder; else only those in the map's own: a map from others may name any file"
    command.add_argument("--photos", type=_folder, metavar="DIR", help=text)


def _folder(text: str) -> Path:
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(f"{text} is no folder; give the one that holds the map's photos")
    return Path(text)


def _settings(args: argparse.Namespace, **given: Any) -> Any:
    from perception.config import settings_from
    from perception.serve.listening import read_token
    from perception.serve.requests import ServeSettings

    given["token"] = None if args.token_file is None else read_token(args.token_file)
    options = {name: f"--{name}" if args.command == "serve" else f"--http {name}" for name in given}
    options |= {"queue_size": "--queue", "token": "--token-file"}
    return settings_from(ServeSettings, {name: (value, options[name]) for name, value in given.items()})


def _serve(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.serve.server import serve

    names = ("host", "port", "timeout", "workers", "watch", "photos")
    serve(args.map, _settings(args, queue_size=args.queue, **{name: getattr(args, name) for name in names}))
    return {}, ""


def _mcp(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.serve.mcp import serve_http, serve_stdio

    if args.http is None:
        if args.token_file is not None:
            raise InputError("mcp: --token-file is for HTTP clients; give --http HOST:PORT too, or leave it out")
        serve_stdio(args.map, photos=args.photos)
    else:
        host, _, port = args.http.rpartition(":")
        if not host:
            raise InputError(f"mcp: --http: found '{args.http}', expected HOST:PORT, such as 127.0.0.1:8766")
        serve_http(args.map, _settings(args, host=host.strip("[]"), port=port, photos=args.photos))
    return {}, ""


def _node(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.config import read_pairs, settings_from
    from perception.node.config import NodeConfig

    given = {key: (value, "--set") for key, value in read_pairs(args.pairs).items()}
    options = {name: (getattr(args, name), f"--{name}") for name in ("namespace", "domain")}
    given |= {name: option for name, option in options.items() if option[0] is not None}
    config = settings_from(NodeConfig, given)
    from perception.node.ros import serve_node, stop_on_signals

    with stop_on_signals() as stop:
        figures = serve_node(args.map, config, stop, Progress().log)
    return figures, f"{figures['answered']} questions answered"


def _view(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    import threading

    from perception.interrupts import ends_as_ctrl_c
    from perception.serve.listening import read_token

    token = None if args.token_file is None else read_token(args.token_file)
    from perception.viewer import Viewer

    viewer = Viewer(args.map, args.host, args.port, token, args.photos)
    port = viewer.address.rpartition(":")[2]
    shown = viewer.url if token is None else f"{viewer.address}/?token=CONTENT-OF-{args.token_file.name}"
    hint = f"; over SSH: ssh -L {port}:localhost:{port} THIS-MACHINE, then open it there"
    try:
        with ends_as_ctrl_c():
            say(f"{args.map}: open {shown} in a browser{hint}. Ctrl-C ends.")
            threading.Event().wait()
    except KeyboardInterrupt:
        viewer.stop()
        if (rescued := viewer.session.editor.rescue()) is not None:
            say(f"warning: the last corrections were not saved; {rescued} is the map with them")
    return {"url": viewer.address}, ""
