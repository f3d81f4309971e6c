"""The command `perception`: parses arguments, calls the library, prints text or JSON. Heavy imports are deferred."""

from __future__ import annotations

import argparse
import errno
import io
import json
import os
import shlex
import sys
import threading
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from perception import __version__
from perception.cli.parser import Parser
from perception.errors import InputError
from perception.io.documents import brief
from perception.machine import limit_threads
from perception.progress import mute, say

_MODULES = ("mapping", "maps", "scoring", "serving", "models")
"""Files of this package that add subcommands, in the order of --help."""
SERVERS = ("localiser", "query-")
"""How the names of threads begin that `perception.serve` starts."""


def build_parser() -> argparse.ArgumentParser:
    """The parser with all subcommands and their options."""
    parser = Parser(prog="perception", description="From photos to a 3D instance map that answers text prompts.")
    parser.add_argument("--version", action="version", version=f"perception {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for name in _MODULES:
        import_module(f"perception.cli.{name}").register(commands)
    return parser


_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.ENOENT}
"""Errors without a path: the last where no folder for temporary files can be written."""
_KEEPING = (["map"], ["update"], ["fleet"], ["index"], ["models"])
"""Commands that go on with what an interrupted run has made; the first two with --resume."""


def _interrupted(argv: Sequence[str] | None) -> str:
    """What to do after Ctrl-C."""
    arguments = [str(argument) for argument in (sys.argv[1:] if argv is None else argv)]
    more = ["--resume"] if arguments[:1] in _KEEPING[:2] and "--resume" not in arguments else []
    kept = "what was done is kept, go on with" if arguments[:1] in _KEEPING else "begin again with"
    return f"interrupted; {kept}: {shlex.join(['perception', *arguments, *more])}"


def _warn(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    say(f"warning: {' '.join(str(message).split())}")


def _open_streams() -> None:
    """Gives a closed standard stream, as of some daemons, the null device: a file that is opened later would get its
    number, and in it what libraries print; and Python would print on stdout what is meant for stderr."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout, sys.stderr = (stream or Path(os.devnull).open("w") for stream in (sys.stdout, sys.stderr))  # noqa: SIM115


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0, 2 for bad usage, input or paths, 130 on Ctrl-C."""
    # Threads of torch's OpenMP that spin while they wait would take the cores from the kernels' own threads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    limit_threads()
    _open_streams()
    args = argparse.Namespace()
    warnings.showwarning = _warn  # type: ignore[assignment]
    if isinstance(sys.stdout, io.TextIOWrapper):  # not every path can be written as UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        args = build_parser().parse_args(argv)
        result, text = args.run(args)
        if args.json or text:
            _answer(json.dumps(result, allow_nan=False, default=str) if args.json else text)
    except InputError as error:
        return _refused(error)
    except KeyboardInterrupt:
        say(getattr(args, "interrupted", _interrupted(argv)))
        return 130
    except MemoryError as error:
        todo = "use less (map: --max-side, --budget), or a machine with more; map goes on with --resume"
        return _refused(InputError(f"the memory is full ({brief(error)}); {todo}"))
    except OSError as error:  # a path that the system refuses, wherever it is used first
        if error.filename is not None and error.strerror is not None:
            advice = "give another path, or allow access to this one"
            return _refused(InputError(f"{error.filename}: {error.strerror}; {advice}"))
        if error.errno not in _OF_THE_DISK:
            raise
        return _refused(InputError(f"{error.strerror}; free some space, or set TMPDIR to a folder that may be written"))
    return 0


def run() -> NoReturn:
    """The console script: `main`. A server's thread may be in compiled code for minutes, as when it reads the photos of
    a map to localise others. It cannot be ended there, and Python would wait for it or abort: it ends with the process.
    """
    code = main()
    if any(thread.daemon and thread.name.startswith(SERVERS) for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _answer(text: str) -> None:
    """Prints the answer. InputError where it cannot be written."""
    try:
        print(text, flush=True)
    except BrokenPipeError:  # the reader has what it wants
        mute(sys.stdout)
    except OSError as error:
        mute(sys.stdout)
        raise InputError(f"the answer cannot be written: {error.strerror}; make space for it") from error


def _refused(error: InputError) -> int:
    """Prints an error as one line; the exit code."""
    say(f"error: {' '.join(str(error).split())}")
    return 2
