"""The house rules that a machine can check: one-way layers, cheap import, quick help."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "perception"

# Bottom to top; a module may import from its own layer and those below.
LAYERS = [
    {
        "machine",
        "errors",
        "types",
        "config",
        "boxes",
        "geometry",
        "progress",
        "interrupts",
        "listening",
        "_core",
        "pictures",
        "colors",
    },
    {"io"},
    {"masks", "calibration", "bags", "frame"},
    {"gaussians"},
    {"language", "instances"},
    {
        "query",
        "export",
        "evaluate",
        "models",
        "editing",
    },
    {
        "serve",
        "mcp",
        "node",
        "pipeline",
        "viewer",
        "bench",
    },
    {"cli"},
]
HEIGHT = {name: height for height, layer in enumerate(LAYERS) for name in layer}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def imports_of(path: Path) -> set[str]:
    """First-level names below `perception` that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("perception"):
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("perception.")}
    return found - {"__version__", "InputError"}


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path: Path) -> None:
    if path == PACKAGE / "__init__.py":
        return
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    assert own in HEIGHT, f"{own} has no layer: give it one in this test"
    for name in imports_of(path):
        assert HEIGHT[name] <= HEIGHT[own], f"{path.name} ({own}) imports {name} from a layer above it"


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_files_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, perception.cli as c\n"
        "try:\n    c.main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print(sorted({'torch', 'pydantic', 'pycolmap', 'onnxruntime', 'cv2', 'scipy', 'numpy'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip().endswith("[]")
