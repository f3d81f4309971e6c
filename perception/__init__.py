"""From photos to a 3D instance map of Gaussians that answers text prompts.

Importing this package does nothing heavy: torch and the compiled core load on first use of a name below.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["InputError", "__version__", "load_map", "rasterize"]

if TYPE_CHECKING:
    from perception.errors import InputError
    from perception.gaussians.rasterize import rasterize
    from perception.query import load_map

_HOMES = {
    "InputError": "perception.errors",
    "load_map": "perception.query",
    "rasterize": "perception.gaussians.rasterize",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        import importlib

        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'perception' has no attribute '{name}'")
