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
    p.add_argument("--host", default="127.0.0.1", help="default: this machine only; 0.0.0.0 lets others in")
    p.add_argument("--port", type=int, default=8090)


def _view(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    import sys
    import threading

    from perception.viewer import start_viewer

    viewer = start_viewer(args.map, args.host, args.port)
    hint = f"; over SSH: ssh -L {args.port}:localhost:{args.port} THIS-MACHINE, then open it there"
    print(f"{args.map}: open {viewer.url} in a browser{hint}. Ctrl-C ends.", file=sys.stderr, flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        viewer.stop()
        if viewer.session.editor.dirty:
            print("warning: the last corrections were not saved", file=sys.stderr)
    return {"url": viewer.url}, ""
