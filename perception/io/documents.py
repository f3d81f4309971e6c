"""JSON and YAML files that others wrote: parsed, or refused in one line whatever they hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from perception.errors import InputError

_YAML_ERRORS = (ValueError, LookupError, AttributeError, TypeError, OverflowError, RecursionError)
"""What PyYAML raises besides its own errors, on dates that do not exist, numbers without digits and the like."""


def read_json(file: Path) -> Any:
    """The value in a JSON file; InputError when there is none."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: not readable JSON ({brief(error)})") from error


def read_yaml(file: Path, expected: str) -> Any:
    """The value in a YAML file; InputError naming `expected` when there is none.

    Aliases (*name) are refused: a few lines of them stand for more values than any memory holds.
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
