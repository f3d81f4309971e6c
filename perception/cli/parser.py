"""What all subcommands share: errors on one line, and `--json`."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from perception.errors import InputError, local_path


class Parser(argparse.ArgumentParser):
    """argparse with a one-line error and exit code 2 on bad usage. late_epilog makes the epilog, when help is shown.
    Arguments of type Path are refused where they are URLs."""

    late_epilog: Callable[[], str] | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register("type", Path, _path)
        self._negative_number_matcher = re.compile(r"-([\d.]|[xyz]$)")  # no options: -1, and -y or -0.1,-0.9,0 of --up

    def parse_known_args(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        """As argparse, but a subcommand itself refuses what it does not know."""
        given, unknown = super().parse_known_args(*args, **kwargs)
        if unknown:
            options = [option.lstrip("-") for option in self._option_string_actions]
            near = difflib.get_close_matches(unknown[0].strip("-").partition("=")[0], options, 1, 0.7)
            advice = f", did you mean --{near[0]}?" if near else ""
            if not unknown[0].startswith("-"):
                advice = "; options stand after all other arguments, and a text with blanks in quotes"
            self.error(f"unrecognized arguments: {' '.join(unknown)}{advice}")
        return given, unknown

    def error(self, message: str) -> Any:  # type: ignore[override]
        raise InputError(f"{self.prog}: {message} (see {self.prog} --help)")

    def format_help(self) -> str:
        if self.late_epilog is not None:
            self.epilog = self.late_epilog()
        return super().format_help()


def _path(text: str) -> Path:
    try:
        if not text.strip():
            raise InputError("found an empty text, expected a path; is a variable of the shell not set?")
        path = local_path(text)
        return path if path.name else path.absolute()  # a map that is written anew takes the working folder's name
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


Run = Callable[[argparse.Namespace], tuple[dict[str, Any], str]]


def command(commands: Any, name: str, run: Run, summary: str) -> Parser:
    """Adds a subcommand. `run` takes the parsed arguments and returns (the object for --json, the text otherwise)."""
    parser: Parser = commands.add_parser(name, help=summary, description=summary)
    parser.set_defaults(run=run)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else there")
    return parser


def map_command(commands: Any, name: str, run: Run, summary: str) -> Parser:
    """As `command`, with the argument `map`, the path of a map."""
    parser = command(commands, name, run, summary)
    parser.add_argument("map", type=Path, metavar="MAP")
    return parser
