"""`perception export` and `perception render`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import map_command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = map_command(commands, "export", _export, "instances onto a point cloud or mesh, or onto the map's own points")
    p.add_argument("--points", type=Path, metavar="CLOUD")
    place = p.add_mutually_exclusive_group()
    place.add_argument(
        "--align", action="store_true", help="the cloud lies in a frame of its own: register it, or refuse"
    )
    place.add_argument(
        "--transform", type=Path, metavar="FILE", help="as --align, by a known 4 x 4 map_from_scan (text or JSON)"
    )
    p.add_argument("-o", "--output", type=Path, metavar="OUT", help=".ply, .pcd or .npz")
    p.add_argument("--smooth", action=argparse.BooleanOptionalAction, default=True)
    p.add_argument("--max-distance", type=float, metavar="D", help="points farther from any Gaussian stay -1")
    p.add_argument("--segments", type=Path, metavar="X.segs.json", help="ScanNet's segments, or scannet: by its rules")
    p.add_argument(
        "--granularity", choices=("parts", "default", "groups"), default="default", help="parts of things, or groups"
    )
    p.add_argument("--color", choices=("original", "instance"), default="original")
    p.add_argument("--mesh", type=Path, metavar="OUT", help="the map's surface as .ply or .glb (extra: open3d)")
    p.add_argument("--instance", type=int, metavar="ID", help="--mesh: the closed body of this one instead")
    p.add_argument("--voxels", type=Path, metavar="OUT.npz", help="free, occupied and unknown space; distances")
    p.add_argument("--voxel-size", type=float, metavar="S", help="of --mesh and --voxels, in map units")
    p.add_argument("--scannet", type=Path, metavar="DIR", help="ScanNet submission layout")

    p = map_command(commands, "render", _render, "pictures of the map from given cameras")
    p.add_argument("--cameras", type=Path, metavar="transforms.json", help="default: the map's held-out views")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--what", default="rgb", metavar="KINDS", help="comma-separated: rgb, depth, instances, features")


def _export(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.errors import InputError
    from perception.export.transfer import ExportOptions
    from perception.io.store import read_map
    from perception.pipeline.exporting import export_map
    from perception.pipeline.meshing import check_outputs, export_mesh, export_voxels

    if args.output is None and args.mesh is None and args.voxels is None:
        raise InputError("export: nothing to write; give -o OUT, --mesh OUT or --voxels OUT.npz")
    if args.output is None and args.points is not None:
        raise InputError("export: --points labels a cloud; give the file to write it to with -o")
    if args.instance is not None and args.mesh is None:
        raise InputError("export: --instance selects what --mesh writes; give --mesh OUT")
    check_outputs(args.mesh, args.voxels, args.voxel_size)
    facts: dict[str, Any] = {}
    lines = []
    if args.mesh is not None or args.voxels is not None:
        gmap = read_map(args.map)
        if args.mesh is not None:
            facts["mesh"], text = export_mesh(gmap, args.mesh, args.instance, args.voxel_size, args.color)
            lines.append(text)
        if args.voxels is not None:
            facts["voxels"], text = export_voxels(gmap, args.voxels, args.voxel_size)
            lines.append(text)
        if args.output is None:
            return facts, "\n".join(lines)
    options = ExportOptions(max_distance=args.max_distance, smooth=args.smooth, segments=args.segments)
    how = (options, args.color, args.scannet, args.transform or args.align, args.granularity)
    result, table = export_map(args.map, args.output, args.points, *how)
    return {**facts, **result}, "\n".join([*lines, table])


def _render(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.rendering import render_map

    return render_map(args.map, args.output, args.cameras, args.what.split(","))
