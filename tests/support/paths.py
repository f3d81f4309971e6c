"""Where the repository and the tests' helpers lie."""

from __future__ import annotations

from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
TESTS = SUPPORT.parent
REPOSITORY = TESTS.parent
MAPS = TESTS / "map" / "maps"
"""A small map of every released format version, and the photos of the first."""
