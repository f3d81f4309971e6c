"""The one exception that means "the user's input is at fault"; the command line turns it into exit code 2."""

from __future__ import annotations

import unicodedata


class InputError(ValueError):
    """Bad input from the user, told in one line: what was read, what was found, what was expected, what to do.

    What file names and contents bring along that is no visible text (line ends, control codes) is shown escaped.
    """

    def __init__(self, message: object = ""):
        super().__init__("".join(c if _visible(c) else ascii(c)[1:-1] for c in str(message)))


def _visible(character: str) -> bool:
    return unicodedata.category(character) not in ("Cc", "Cs", "Zl", "Zp")


def missing_extra(package: str, extra: str) -> InputError:
    """An error for an optional dependency that is absent, with the exact line that installs it."""
    return InputError(f"the package '{package}' is not installed; run in its clone: pip install \".[{extra}]\"")
