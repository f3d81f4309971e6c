"""perception/_core/*.pyi against the compiled module: the same names, signatures and documentation."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import perception

_core = pytest.importorskip("perception._core")
REMEDY = "make the stubs anew: python -m nanobind.stubgen -m perception._core -r -O perception"


def parameters(function: ast.FunctionDef) -> tuple[list[str], int, int]:
    """Names, how many have defaults, how many are declared None-able by `| None`."""
    arguments = function.args
    optional = sum("| None" in ast.unparse(a.annotation) for a in arguments.args if a.annotation is not None)
    return [a.arg for a in arguments.args], len(arguments.defaults), optional


def declared(body: list[ast.stmt]) -> dict[str, list[tuple[list[str], int, int]]]:
    """Every function and method of a stub with the parameters of its overloads."""
    found: dict[str, list[tuple[list[str], int, int]]] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef):
            found.setdefault(node.name, []).append(parameters(node))
        elif isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}": calls for name, calls in declared(node.body).items()}
    return found


def signature(text: str) -> ast.FunctionDef:
    """A signature as nanobind keeps it: types with their shapes in brackets, default values as \\0, \\1, ..."""
    while "[" in text:
        text = re.sub(r"\[[^][]*\]", "", text)
    node = ast.parse(re.sub(r"\\\d", "0", text).replace("def (", "def _(") + ": ...").body[0]
    assert isinstance(node, ast.FunctionDef)
    return node


def compiled(owner: Any) -> dict[str, list[tuple[list[str], int, int]]]:
    """The same of a compiled module or class."""
    found: dict[str, list[tuple[list[str], int, int]]] = {}
    for name, value in vars(owner).items():
        value = getattr(value, "fget", None) or value
        if isinstance(value, type):
            found |= {f"{name}.{inner}": calls for inner, calls in compiled(value).items()}
        elif hasattr(value, "__nb_signature__") and name != "__new__":
            found[name] = [parameters(signature(overload[0])) for overload in value.__nb_signature__]
    return found


@pytest.mark.parametrize(("module", "file"), [(_core, "__init__.pyi"), (_core.training, "training.pyi")])
def test_stubs_say_what_is_compiled(module: ModuleType, file: str) -> None:
    path = Path(perception.__file__).parent / "_core" / file
    stub = declared(ast.parse(path.read_text(encoding="utf-8")).body)
    truth = compiled(module)
    assert set(truth) - set(stub) == set() == {n for n in set(stub) - set(truth) if not n.endswith("__init__")}, REMEDY
    for name, calls in truth.items():
        assert stub[name] == calls, f"{name}: {REMEDY}"


def test_sources_that_are_not_built_say_so(tmp_path: Path) -> None:
    """Python takes the stubs' folder for a namespace package: its names would be missing one by one."""
    sources = Path(perception.__file__).parent
    for name in ("__init__.py", "errors.py", "_core/__init__.pyi"):
        (tmp_path / "perception" / name).parent.mkdir(exist_ok=True)
        shutil.copy(sources / name, tmp_path / "perception" / name)
    words = [sys.executable, "-c", "from perception import _core"]
    told = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert told.stderr.splitlines()[-1].startswith("perception.errors.InputError: the compiled core is not in")
    assert str(tmp_path) in told.stderr and "csrc/build_inplace.sh" in told.stderr
