"""Where the repository and the tests' helpers lie."""

from __future__ import annotations

import subprocess
from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
TESTS = SUPPORT.parent
REPOSITORY = TESTS.parent
MAPS = TESTS / "map" / "maps"
"""A small map of every released format version, and the photos of the first."""


def tracked_files() -> list[Path]:
    """The files of the repository that Git tracks: not a virtual environment, builds or maps inside the clone."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode:
        import pytest

        pytest.skip("these files are no clone, so what belongs to the repository is not known")
    files = (REPOSITORY / name for name in listed.stdout.split("\0") if name)
    return [file for file in files if file.is_file()]
