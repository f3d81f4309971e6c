"""`perception serve`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = command(commands, "serve", _serve, "a map over HTTP: JSON, binary points and a page")
    p.set_defaults(interrupted="stopped")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--host", default="127.0.0.1", help="other than this machine only with a token")
    p.add_argument("--port", type=int, default=8765, help="0: any free one")
    p.add_argument("--token-file", type=Path, metavar="FILE", help="clients send its content as a bearer token")
    p.add_argument(
        "--photos",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="show photos from this folder too, not only from the map's own; repeatable",
    )
    p.add_argument("--timeout", type=float, default=10.0, metavar="S", help="seconds an answer may take")
    p.add_argument("--workers", type=int, default=2, metavar="N", help="questions answered at once")
    p.add_argument("--queue", type=int, default=64, metavar="N", help="questions that may wait; more are refused")
    p.add_argument("--rate", type=float, default=100.0, metavar="R", help="requests a second and client, 0: no bound")
    p.add_argument("--watch", type=float, default=1.0, metavar="S", help="look for a new map this often, 0: never")


def _serve(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.listening import read_token
    from perception.serve.settings import ServeSettings

    settings = ServeSettings(
        host=args.host,
        port=args.port,
        token=None if args.token_file is None else read_token(args.token_file),
        timeout=args.timeout,
        workers=args.workers,
        queue_size=args.queue,
        rate=args.rate,
        watch=args.watch,
        photos=tuple(args.photos),
    )
    from perception.serve.server import serve

    serve(args.map, settings)
    return {}, ""
