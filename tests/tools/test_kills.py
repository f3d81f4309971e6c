"""A short run of the harness that kills mapping, exporting and editing; `python tools kills.run` is the long one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="the harness needs Linux")
def test_nothing_is_lost_to_a_few_kills(small_scene: Path, tmp_path: Path) -> None:
    """Kills around changes to the file system, which do not hang on the clock; the long run also draws times."""
    facts = tmp_path / "kills.json"
    names = ["mapping", "exporting", "editing", "save", "upgrade", "export"]
    command = [sys.executable, TOOLS, "kills.run", *names, "--kills", "0", "--writes", "3", "--json", facts]
    command += ["--no-sfm", "--no-fresh", "--iterations", "100", "--scene", small_scene, "--folder", tmp_path]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    cases = {case["what"]: case for case in json.loads(facts.read_text())["cases"]}
    assert set(cases) == set(names)
    assert all(case["survived"] == case["kills"] == 3 and not case["lost"] for case in cases.values())
