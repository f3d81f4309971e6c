"""Parses untrusted JSON and YAML files; all parse errors become InputError with a one-line message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from perception.errors import InputError

_YAML_ERRORS = (ValueError, LookupError, AttributeError, TypeError, OverflowError, RecursionError)
"""Exceptions that PyYAML raises besides its own, for example on invalid dates or numbers without digits."""


def read_json(file: Path) -> Any:
    """The value in a JSON file; InputError when it is not valid JSON."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: not readable JSON ({brief(error)})") from error


def read_yaml(file: Path, expected: str) -> Any:
    """The value in a YAML file; InputError naming `expected` when it is not valid YAML.

    Aliases (*name) are refused: nested aliases can expand to more values than fit into memory.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("aliases are not taken")
            return super().compose_node(parent, index)

    try:
        return yaml.load(file.read_text(encoding="utf-8"), Loader)
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file; expected {expected}") from error
    except (OSError, yaml.YAMLError, *_YAML_ERRORS) as error:
        raise InputError(f"{file}: not readable YAML ({brief(error)}); expected {expected}") from error


def brief(value: object, most: int = 120) -> str:
    """An error's text, or a value as Python writes it, on one line of bounded length."""
    import reprlib

    text = str(value) if isinstance(value, BaseException) else reprlib.repr(value)
    return " ".join(text.split())[:most] or type(value).__name__
