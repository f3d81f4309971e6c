"""`perception view`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = command(commands, "view", _view, "walk through a map in the browser: ask, pick, correct, save")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--host", default="127.0.0.1", help="other than this machine only with a token")
    p.add_argument("--port", type=int, default=8090, help="0: any free one")
    p.add_argument("--token-file", type=Path, metavar="FILE", help="its content opens the page; default: a new token")


def _view(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    import sys
    import threading

    from perception.listening import check_address, read_token

    token = None if args.token_file is None else read_token(args.token_file)
    check_address(args.host, args.port, token)
    from perception.viewer import start_viewer

    viewer = start_viewer(args.map, args.host, args.port, token)
    port = viewer.address.rpartition(":")[2]
    shown = viewer.url if token is None else f"{viewer.address}/?token=CONTENT-OF-{args.token_file.name}"
    hint = f"; over SSH: ssh -L {port}:localhost:{port} THIS-MACHINE, then open it there"
    print(f"{args.map}: open {shown} in a browser{hint}. Ctrl-C ends.", file=sys.stderr, flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        viewer.stop()
        if viewer.session.editor.dirty:
            print("warning: the last corrections were not saved", file=sys.stderr)
    return {"url": viewer.address}, ""
