"""`perception export` and `perception render`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    _add_export(commands)
    _add_render(commands)


def _add_export(commands: Any) -> None:
    p = command(commands, "export", _export, "instances onto a point cloud or mesh, or onto the map's own points")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--points", type=Path, metavar="CLOUD")
    p.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help=".ply, .pcd or .npz; .mcap (Foxglove, RViz): with boxes, cameras and photos",
    )
    p.add_argument("--smooth", action=argparse.BooleanOptionalAction, default=True)
    p.add_argument(
        "--max-distance",
        type=_length,
        metavar="D",
        help="points farther than D from any Gaussian stay -1 (auto: by the map's own spacing)",
    )
    p.add_argument("--segments", type=Path, metavar="X.segs.json", help="ScanNet segments instead of our own")
    p.add_argument("--color", choices=("original", "instance"), default="original")
    p.add_argument("--split", type=Path, metavar="DIR", help="one cloud an instance")
    p.add_argument("--boxes", type=Path, metavar="OUT.json", help="3D boxes")
    p.add_argument("--scannet", type=Path, metavar="DIR", help="ScanNet submission layout")


def _length(text: str) -> float | str:
    return text if text == "auto" else float(text)


def _export(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.export import ExportOptions
    from perception.pipeline.exporting import Outputs, export_map

    options = ExportOptions(max_distance=args.max_distance, smooth=args.smooth, segments=args.segments)
    outputs = Outputs(args.color, args.split, args.boxes, args.scannet)
    return export_map(args.map, args.output, args.points, options, outputs)


def _add_render(commands: Any) -> None:
    p = command(commands, "render", _render, "pictures of the map from given cameras")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--cameras", type=Path, metavar="transforms.json", help="default: the map's held-out views")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--what", default="rgb", metavar="KINDS", help="comma-separated: rgb, depth, instances, features")


def _render(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.rendering import render_map

    return render_map(args.map, args.output, args.cameras, args.what.split(","))
