"""The command `perception`: arguments in, one library call, words or JSON out. Heavy imports wait for their command."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence

from perception import __version__
from perception.cli import asking, clouds, mapping, robot_inputs, scoring
from perception.cli.parser import Parser
from perception.errors import InputError

_MODULES = (mapping, asking, clouds, scoring, robot_inputs)


def build_parser() -> argparse.ArgumentParser:
    """All subcommands and their options."""
    parser = Parser(prog="perception", description="From photos to a 3D instance map that answers text prompts.")
    parser.add_argument("--version", action="version", version=f"perception {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for module in _MODULES:
        module.register(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0, 2 for bad usage or input, 130 on Ctrl-C."""
    # Threads of torch's OpenMP that spin while they wait would take the cores from the kernels' own threads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        args = build_parser().parse_args(argv)
        result, text = args.run(args)
        if args.json:
            print(json.dumps(result, allow_nan=False, default=str))
        elif text:
            print(text)
    except InputError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; what was done is kept, repeat the command with --resume", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 0
    return 0
