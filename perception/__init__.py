"""From photos to a 3D instance map of Gaussians that answers text prompts.

Public names, by what they are for; each has an example:

- make a map: `perception.pipeline.mapping.build_map`, `perception.config.load_config`, `perception.config.MapConfig`
- open it: `perception.load_map`, `perception.map.map.Map`, `perception.map.write.read_map`,
  `perception.map.write.write_map`
- ask it: `perception.query.QueryMap`, `perception.query.Hit`, `perception.query.Description`,
  `perception.query.Neighbor`, `perception.query.Where`, `perception.query.axis_box`, `perception.query.Frame`
- plan with it: `perception.query.scene_graph.scene_graph`, `perception.query.robot_pose.where_to_stand`,
  `perception.query.robot_pose.RobotPose`, `perception.query.floor_grid.floor_grid`
- ask many maps: `perception.query.indexing.index_maps`
- serve it: `perception.serve.engine.QueryEngine`, `perception.serve.requests.Request`,
  `perception.serve.requests.Reply`, `perception.serve.requests.EngineBusy`,
  `perception.serve.requests.AnswerTimeout`, `perception.serve.requests.EngineClosed`
- correct it: `perception.edit.editor.Editor`, `perception.map.write.set_labels`
- export it: `perception.export.export_map.export_map`, `perception.export.export_map.ExportOptions`,
  `perception.export.mesh.export_mesh`, `perception.export.mesh.export_voxels`
- render Gaussians: `perception.rasterize`
- bad input: `perception.InputError`, one line that says what was found, what was expected and what to do

Importing this package does nothing heavy: torch and the compiled core load on first use of such a name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["InputError", "__version__", "load_map", "rasterize"]

if TYPE_CHECKING:
    from perception.errors import InputError
    from perception.query import load_map
    from perception.rasterizer.rasterize import rasterize

_HOMES = {
    "InputError": "perception.errors",
    "load_map": "perception.query",
    "rasterize": "perception.rasterizer.rasterize",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        import importlib

        return getattr(importlib.import_module(_HOMES[name]), name)
    if name == "_core":
        return _compiled()
    raise AttributeError(f"module 'perception' has no attribute '{name}'")


def _compiled() -> Any:
    """The compiled core. In sources that are not built, Python would import the folder of its stubs in its place."""
    from importlib import import_module
    from importlib.machinery import PathFinder

    found = PathFinder.find_spec("perception._core", __path__)
    if found is None or found.origin is None:
        from perception.errors import InputError

        raise InputError(
            f"the compiled core is not in {__path__[0]}; build it with csrc/build_inplace.sh, "
            "or run outside the source tree to use an installed package"
        )
    return import_module("perception._core")
