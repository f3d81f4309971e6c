"""The scripts of examples/ run as a reader would run them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from perception.language.encoders import make_encoder
from support.paths import REPOSITORY
from support.query_maps import write_map_of
from support.synthetic_map import write_synthetic_map


def run(name: str, *arguments: object, folder: Path) -> str:
    command = [sys.executable, REPOSITORY / "examples" / name, *map(str, arguments)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.slow
def test_asking_for_a_name_finds_its_instance(tmp_path: Path) -> None:
    names = ["banana", "laptop", "teapot"]
    path = tmp_path / "a.gsmap"
    write_synthetic_map(path, names, make_encoder("conse"), gaussians=300, sh_degree=1, encoder_spec="conse")
    out = run("ask_a_map.py", path, "laptop", "helicopter", folder=tmp_path)
    assert out.startswith("laptop: instance 1, score ")
    assert "helicopter: not present" in out


def test_what_is_near_is_told_nearest_first(tmp_path: Path) -> None:
    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    out = run("plan_around.py", path, folder=tmp_path)
    distances = [float(word) for word in re.findall(r" is (\S+) away", out)]
    assert len(distances) == 3 and distances == sorted(distances)
    assert "the corridor is " in out


@pytest.mark.slow
def test_an_image_is_fitted(tmp_path: Path) -> None:
    errors = [float(word) for word in re.findall(r"mean error (\S+)", run("fit_an_image.py", folder=tmp_path))]
    assert len(errors) == 6 and errors[-1] < 0.5 * errors[0]
