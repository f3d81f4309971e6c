"""Runs a script of this folder: `python tools NAME ARGUMENTS`, for example `python tools score.instances SCENE MAP`.
Without a name it lists them."""

from __future__ import annotations

import ast
import os
import runpy
import sys
from pathlib import Path

HOME = Path(__file__).resolve().parent
HELPERS = HOME.parent / "tests"
"""Some scripts use the tests' helpers, `support`."""


def scripts() -> dict[str, str]:
    """Name -> first sentence of what it says of itself, of every file that can be run."""
    found = {}
    for file in sorted(HOME.glob("*/*.py")):
        text = file.read_text(encoding="utf-8")
        if '__name__ == "__main__"' in text:
            first = (ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0]
            found[f"{file.parent.name}.{file.stem}"] = " ".join(first.split()).partition(". ")[0].rstrip(".")
    return found


def listing() -> str:
    return "".join(f"{name:20} {sentence}\n" for name, sentence in scripts().items())


def run(name: str, run_name: str = "__main__") -> None:
    """Runs script `name`, or under another `run_name` only reads it. Processes that it starts find the same modules."""
    homes = [str(HOME), str(HELPERS)]
    sys.path[:0] = homes
    os.environ["PYTHONPATH"] = os.pathsep.join([*homes, *filter(None, [os.environ.get("PYTHONPATH")])])
    runpy.run_module(name, run_name=run_name, alter_sys=True)


def main() -> None:
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(listing(), end="")
        return
    name = sys.argv.pop(1)
    if name not in scripts():
        sys.exit(f"tools: no script {name}; python tools lists them")
    sys.argv[0] = name
    run(name)


if __name__ == "__main__":
    main()
