"""Measurements in a process of their own run this very package, whatever folder the bench was started from."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import perception


def child_options() -> dict[str, Any]:
    """cwd and env for subprocess: started in a repository's root, Python would find sources without their core."""
    home = str(Path(perception.__file__).resolve().parents[1])
    path = os.environ.get("PYTHONPATH")
    return {
        "cwd": tempfile.gettempdir(),
        "env": {**os.environ, "PYTHONPATH": home if path is None else f"{home}{os.pathsep}{path}"},
    }
