"""The one exception that means "the user's input is at fault"; the command line turns it into exit code 2."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input from the user, told in one line: what was read, what was found, what was expected, what to do."""


def missing_extra(package: str, extra: str) -> InputError:
    """An error for an optional dependency that is absent, with the exact line that installs it."""
    return InputError(f"the package '{package}' is not installed; run: pip install \"perception[{extra}]\"")
