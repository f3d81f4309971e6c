"""tools/README.md lists every script as `python tools` does."""

from __future__ import annotations

import subprocess
import sys

from support.paths import REPOSITORY

TOOLS = REPOSITORY / "tools"


def listed() -> str:
    command = [sys.executable, TOOLS]
    return subprocess.run(command, capture_output=True, text=True, check=True, encoding="utf-8").stdout


def test_every_script_is_listed() -> None:
    main = '\nif __name__ == "__main__":\n'
    own = [file for file in TOOLS.glob("*/*.py") if main in file.read_text(encoding="utf-8")]
    names = {f"{file.parent.name}.{file.stem}" for file in own}
    assert len(names) > 20 and {line.split()[0] for line in listed().splitlines()} == names


def test_each_has_one_line_that_fits() -> None:
    lines = [line.split(maxsplit=1) for line in listed().splitlines()]
    assert not [line for line in lines if len(line) < 2 or len(" ".join(line)) > 120 or "python tools" in line[1]]


def test_the_readme_shows_the_same_list() -> None:
    text = (TOOLS / "README.md").read_text(encoding="utf-8")
    assert text.partition("```text\n")[2].partition("```")[0] == listed(), "paste the output of `python tools`"


def test_tests_have_no_main_part() -> None:
    """What people run lies in tools/; processes that tests start lie in tests/support."""
    tests = [file for file in (REPOSITORY / "tests").rglob("test_*.py") if "__main__" in file.read_text("utf-8")]
    assert [file.name for file in tests if '\nif __name__ == "__main__":\n' in file.read_text("utf-8")] == []
