"""Every command in the documentation: all are parsed, and those that end by themselves are run on a small scene."""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import perception
from bench import run
from perception.bench import rasterizer
from perception.cli import build_parser, main
from support.paths import tracked_files

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "launch/README.md", ROOT / "calib/README.md"]

SCRIPT = re.compile(r"\bpython tools ([a-z_]+\.[a-z_]+)")

# Run elsewhere: servers by their own tests, calibration on rendered boards, bags on written ones, models on built ones.
ELSEWHERE = {"demo", "serve", "mcp", "node", "view", "bench", "calibrate", "frames", "models"}


def documented() -> list[tuple[str, str]]:
    """(page, command) of every line of code that starts with `perception`, and of inline code with a known command."""
    found: dict[tuple[str, str], None] = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        lines = re.findall(r"^(?: {4}|\$ )?(perception [a-z].*)$", text, re.M)
        inline = re.findall(r"`(perception [a-z][^`]*)`", text)
        for command in [*lines, *inline]:
            for part in re.split(r" && | \| ", re.sub(r"\s+#.*", "", command)):
                if part.startswith("perception ") and not re.search(r"…|\.\.\.|\[--", part):
                    found[(page.name, part.strip())] = None
    return list(found)


def arguments(command: str) -> list[str]:
    """The words after `perception`; a bare name of a subcommand is completed, as in running text."""
    words = ["0" if word == "ID" else word for word in shlex.split(command)[1:]]
    return [*words, "--help"] if len(words) == 1 else words


parser = functools.cache(build_parser)


@pytest.mark.parametrize(("page", "command"), documented(), ids=lambda value: str(value)[:60])
def test_documented_commands_are_understood(page: str, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        parser().parse_args(arguments(command))
    except SystemExit as done:  # --help
        assert done.code == 0


READ_ALL = """
import os, runpy, sys, traceback
import cv2, onnxruntime, pycolmap, pydantic, scipy.optimize, scipy.spatial, torch  # once, not in every fork

run = runpy.run_path(sys.argv[1])["run"]
for script in sys.argv[2:]:
    if (child := os.fork()) == 0:
        code = 1
        try:
            run(script, "imported")
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    if os.waitpid(child, 0)[1]:
        print(script)
"""


@pytest.mark.slow
def test_documented_scripts_find_what_they_import(tmp_path: Path) -> None:
    """From any folder, with the package installed and nothing set; each in a process of its own."""
    scripts = sorted({name for page in PAGES for name in SCRIPT.findall(page.read_text("utf-8"))})
    command = [sys.executable, "-c", READ_ALL, str(ROOT / "tools/__main__.py"), *scripts]
    environment = {**os.environ, "PYTHONPATH": str(Path(perception.__file__).parents[1])}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert len(scripts) > 20 and (done.returncode, done.stdout) == (0, ""), done.stderr


def test_no_line_installs_the_stranger_called_perception() -> None:
    """That name on the package index is another project; ours is installed from a clone, as `.`."""
    kinds = {".py", ".md", ".toml", ".sh", ".yaml", ".yml", ".service", ".txt", ".cff"}
    files = [path for path in tracked_files() if path.suffix in kinds]
    assert len(files) > 200
    found = [path for path in files if re.search(r"install\W+perception\b", path.read_text(encoding="utf-8"))]
    assert not found


def test_paths_named_for_contributors_exist() -> None:
    """A bare file name stands in the folder of the first path of its row."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|]+ \| ([^|]*`[^|]*) \|$", text, re.M)
    assert 15 < len(rows) <= 25
    missing = []
    for row in [re.findall(r"`([^`]+)`", row) for row in rows]:
        paths = [Path(row[0]).parent / name if "/" not in name and name != "tools" else Path(name) for name in row]
        missing += [str(path) for path in paths if not (ROOT / path).exists()]
    named = re.findall(r"`((?:perception|tests|tools|csrc)/[\w/.]+)`", text)
    assert missing + [path for path in named if not (ROOT / path).exists()] == []


def heading_anchors(page: Path) -> set[str]:
    """As GitHub names the headings of a page: small letters and hyphens, without punctuation."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


def test_links_lead_to_files_and_headings() -> None:
    broken, count = [], 0
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "tools/README.md"]:
        for link in re.findall(r"\]\((?!http)([^)\s]+)\)", page.read_text(encoding="utf-8")):
            file, _, anchor = link.partition("#")
            target, count = page.parent / file if file else page, count + 1
            if not target.exists() or (anchor and anchor not in heading_anchors(target)):
                broken.append(f"{page.name}: {link}")
    assert broken == [] and count > 40


def runnable() -> list[str]:
    """The complete commands of all pages on a map of one's own: the README's walkthrough, in its order, comes first."""
    commands = [re.sub(r" MAP\b", " kitchen.gsmap", command) for _, command in documented() if "SCENE" not in command]
    commands = [command for command in commands if re.search(r" kitchen\.gsmap\b", command)]
    return [command for command in dict.fromkeys(commands) if shlex.split(command)[1] not in ELSEWHERE]


def test_documented_options_and_settings_exist() -> None:
    """Every `--option` in running text is one of some command or its script, every `--set KEY=VALUE` can be set."""
    from perception.config import load_config

    options, settings = set(), set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name, rest in re.findall(r"python tools ([a-z_]+\.[a-z_]+)([^`\n#]*)", text):
            source = (ROOT / "tools" / f"{name.replace('.', '/')}.py").read_text(encoding="utf-8")
            if name != "bench.run":  # whose options are those of the benches below
                assert [o for o in re.findall(r"(?<![\w-])--[a-z][\w-]+", rest) if o not in source] == [], name
        for code in re.findall(r"`([^`\n]*)`", text):
            if not code.startswith(("pip", "cmake", "ros2", "python tools", "ray")):
                options |= set(re.findall(r"(?<![\w-])--[a-z][\w-]+", code))
            settings |= set(re.findall(r"--set ([a-z][\w.]*=[\w:.]+)", code))
    assert len(options) > 15 and settings
    benches = [rasterizer.main, *(bench.main for bench in run.BENCHES.values())]
    known = " ".join([*(command.format_help() for command in _commands()), *map(_bench_help, benches)])
    assert [option for option in sorted(options) if not re.search(rf"{option}\b", known)] == []
    load_config(None, sorted(settings))


def _bench_help(bench: Callable[[list[str]], object]) -> str:
    """The `bench` commands parse their own arguments."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        bench(["--help"])
    return text.getvalue()


def _commands() -> list[argparse.ArgumentParser]:
    """Every command with its own commands."""

    def below(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
        yield parser
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for command in action.choices.values():
                    yield from below(command)

    return list(below(build_parser()))


@pytest.mark.slow
def test_the_walkthrough_runs(small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From photos to answers exactly as the README has it, on a small scene with short training."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(small_scene / "truth" / "gt_points.ply", tmp_path / "scan.ply")
    commands = runnable()
    assert any(command.startswith("perception map PHOTOS") for command in commands)
    # The map's own arguments are kept; what is added makes it small, and gives it masks and poses.
    small = f"--masks labels:{small_scene / 'labels'} --iterations 60 --budget 2000 --set instances.min_cluster_size=8"
    small += " --set language.views=1 --set language.zooms=1"
    for command in commands:
        words = arguments(command)
        words = ["mug" if word == "TEXT" else word for word in words]
        if words[0] == "map":
            words = [str(small_scene / "transforms.json") if word == "PHOTOS" else word for word in words]
            words += shlex.split(small)
        if words[0] == "update":
            words = [str(small_scene / "transforms.json") if word == "NEW_PHOTOS" else word for word in words]
            words += ["--masks", f"labels:{small_scene / 'labels'}"]
        if words[0] == "relink":
            words = [str(small_scene / "images") if word == "DIR" else word for word in words]
        if words[0] == "label":  # the id of an instance that this map has
            words[2] = str(_first_id(tmp_path / "kitchen.gsmap"))
        assert main(words) == 0, command
    for name in ("labelled.ply", "kitchen.html"):
        assert (tmp_path / name).is_file(), name


def _first_id(path: Path) -> int:
    from perception.query import load_map

    return int(load_map(path).instances[0]["id"])
