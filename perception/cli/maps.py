"""What users ask of a finished map: `perception query`, `changes`, `index`, `export`, `render`, `label`, `relink`,
`upgrade`, `scale`, `localise`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from perception.cli.parser import command, map_command
from perception.errors import InputError, visible
from perception.progress import Progress, outlasting


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = map_command(commands, "query", _query, 'ranked 3D instances for each text, or "not present"')
    p.add_argument("text", nargs="+", metavar="TEXT")
    p.add_argument("--top", type=int, default=20, metavar="K", help="at most so many hits of those that answer (20)")
    p.add_argument("--min-score", type=float, metavar="X", help="all with this score instead of those that answer")
    p.add_argument("--points", type=Path, metavar="OUT.ply", help="write the hits' points, labelled by instance_id")
    p.add_argument("--at", metavar="VISIT", help="as of an earlier visit, by number; last: the one before the newest")
    p = map_command(commands, "changes", _changes, "what moved, came and went since an earlier visit of the scene")
    p.add_argument(
        "--since", default="last", metavar="VISIT", help="by number; last (default): the one before the newest"
    )
    p = command(commands, "index", _index, "many maps into one store, for query and serve as a map is")
    p.add_argument("maps", type=Path, nargs="*", metavar="MAP", help="maps that are new or may have changed")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="STORE")
    p.add_argument("--remove", type=Path, action="append", default=[], metavar="MAP", help="take it out of the store")
    p = map_command(commands, "export", _export, "instances onto a point cloud or mesh, or onto the map's own points")
    p.add_argument("--points", type=Path, metavar="CLOUD")
    frame = p.add_mutually_exclusive_group()
    frame.add_argument(
        "--align", action="store_true", help="the cloud lies in a frame of its own: register it, or refuse"
    )
    frame.add_argument(
        "--transform", type=Path, metavar="FILE", help="as --align, by a known 4 x 4 map_from_scan (text or JSON)"
    )
    p.add_argument("-o", "--output", type=Path, metavar="OUT", help=".ply, .pcd or .npz; .spz: Gaussians")
    p.add_argument("--smooth", action=argparse.BooleanOptionalAction, default=True)
    p.add_argument("--max-distance", type=float, metavar="D", help="map units; points farther from any Gaussian are -1")
    p.add_argument("--segments", type=Path, metavar="X.segs.json", help="ScanNet's segments, or scannet: by its rules")
    p.add_argument(
        "--granularity", choices=("parts", "default", "groups"), default="default", help="parts of things, or groups"
    )
    p.add_argument("--color", choices=("original", "instance"), default="original")
    p.add_argument("--mesh", type=Path, metavar="OUT", help="the map's surface as .ply or .glb (extra: open3d)")
    p.add_argument("--instance", type=int, metavar="ID", help="--mesh: the closed body of this one instead")
    p.add_argument("--voxels", type=Path, metavar="OUT.npz", help="free, occupied and unknown space; distances")
    p.add_argument("--voxel-size", type=float, metavar="S", help="of --mesh and --voxels, in map units")
    p.add_argument("--splat", type=Path, metavar="OUT.ply", help="the Gaussians as they are, with their instance_id")
    p.add_argument("--only", type=int, nargs="+", default=[], metavar="ID", help="--splat: these instances alone")
    p.add_argument("--without", type=int, nargs="+", default=[], metavar="ID", help="--splat: all but these instances")
    p.add_argument("--each", action="store_true", help="--splat: one file for each instance, OUT-ID.ply")
    p.add_argument("--graph", type=Path, metavar="OUT.json", help="rooms, supports, things, parts and their relations")

    p = map_command(commands, "render", _render, "pictures of the map from given cameras")
    p.add_argument("--cameras", type=Path, metavar="transforms.json", help="default: the map's held-out views")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--what", default="rgb", metavar="KINDS", help="comma-separated: rgb, depth, instances, features")

    p = map_command(commands, "label", _label, "name an instance; queries know the name from then on")
    p.add_argument("id", type=int, nargs="?", metavar="ID", help="without one, the labels are listed")
    p.add_argument("text", nargs="?", metavar="NAME", help='such as "grandma\'s cup"')
    p.add_argument("--clear", action="store_true", help="take the name away")
    p = map_command(commands, "relink", _relink, "tell a map where its photos lie now")
    p.add_argument("folder", type=Path, metavar="DIR", help="the folder that holds the photos")
    p = map_command(commands, "upgrade", _upgrade, "embed the instances with the current encoder, read printed texts")
    p.add_argument("-o", "--output", type=Path, metavar="OUT.gsmap", help="default: in place")
    p = map_command(commands, "scale", _scale, "give a finished map metres, by a length, tags, a board or GPS")
    p.add_argument("-o", "--output", type=Path, metavar="OUT.gsmap", help="default: in place")
    p.add_argument(
        "--known-length",
        metavar="TEXT",
        help='"0.297: LABEL, LABEL" (or ids), "0.297: X,Y,Z X,Y,Z" or "0.297: PHOTO X,Y X,Y; PHOTO X,Y X,Y"',
    )
    p.add_argument("--tag-size", metavar="M", help="side of the AprilTags or ArUco markers in the photos")
    p.add_argument("--board", metavar="TEXT", help="a calibration board in the photos, such as charuco:8x11:0.02")
    p = map_command(commands, "localise", _localise, "poses of new photos in the map's frame, with standard error")
    p.add_argument("new", type=Path, nargs="+", metavar="PHOTOS", help="photos, or what `map` takes: poses are ignored")
    p.add_argument("-o", "--output", type=Path, metavar="transforms.json", help="the poses, as nerfstudio reads them")
    p.add_argument(
        "--photos", type=Path, metavar="DIR", help="where the map's photos lie, if not where it records them"
    )
    p.add_argument("--camera", type=Path, metavar="FILE.yaml", help="intrinsics of the new photos, ROS camera_info")


def _query(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.map.outputs import refuse_inputs
    from perception.query import load_map
    from perception.query.hit import answer_json
    from perception.report.text import names_of, query_text, write_hits

    refuse_inputs([args.points], [args.map])
    if args.min_score is not None and args.min_score > 1:
        raise InputError(f"--min-score: found {args.min_score:g}, expected a probability, at most 1")
    opened = load_map(args.map)
    opened = opened if args.at is None else opened.at(args.at)
    ways = (opened.query, opened.gone)
    answers = [(text, *(ask(text, args.top, args.min_score) for ask in ways)) for text in args.text]
    of_store = opened.frame is None  # each hit has that of its map
    if args.points and of_store:
        raise InputError(f"{args.map}: is a store, whose maps have their own frames; give --points with one map")
    if args.points:
        write_hits(args.points, [hit for _, hits, _ in answers for hit in hits])
    results = [answer_json(*answer) for answer in answers]
    names = {} if args.json or of_store else names_of(opened)
    shown = query_text(answers, opened.metric, names, opened.visits)
    return {"results": results, "frame": opened.frame, "metric": opened.metric, **opened.visits_json()}, shown


def _changes(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.query import load_map
    from perception.report.text import changes_text, names_of

    opened = load_map(args.map)
    facts = opened.changes_json(args.since)
    return facts, "" if args.json else changes_text(opened, facts["since"], names_of(opened))


def _index(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.query.indexing import index_maps

    if not args.maps and not args.remove:
        raise InputError("index: give maps, or --remove MAP")
    with Progress(quiet=args.json) as progress:
        facts = index_maps(args.output, args.maps, args.remove, progress=progress)
    changes = ", ".join(f"{facts[word]} {word}" for word in ("added", "replaced", "unchanged", "removed"))
    text = f"{args.output}: {facts['instances']} instances of {facts['maps']} maps ({changes})"
    if left_out := facts.pop("left_out"):
        Progress().log("\n".join([text, *left_out]))
        raise InputError(f"index: {len(left_out)} of {len(args.maps)} maps were left out; mend them and run it again")
    return {"store": str(args.output), **facts}, text


def _label(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.map.map import Map
    from perception.map.write import set_labels

    if args.text is not None and args.clear:
        raise InputError("label: give a NAME or --clear, only one of them")
    if args.id is None and args.clear:
        raise InputError("label: --clear needs the ID whose name is taken away")
    if args.id is None:
        named = {entry["id"]: entry["label"] for entry in Map.open(args.map).instances if entry.get("label")}
        lines = [f"{i:>5}  {visible(name)}" for i, name in named.items()]
        return {"labels": named}, "\n".join(lines) or "no instance has a name"
    if args.text is None and not args.clear:
        raise InputError("label: no NAME given; write one, or --clear to take it away")
    label = set_labels(args.map, {args.id: args.text})[args.id]
    text = f"instance {args.id} is called “{label}” now" if label else f"instance {args.id} has no name any more"
    return {"id": args.id, "label": label}, text


def _scale(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.config import FrameConfig, settings_from
    from perception.edit.scale import scale_map
    from perception.report.text import frame_lines

    names = ("known_length", "tag_size", "board")
    given = {n: (getattr(args, n), f"--{n.replace('_', '-')}") for n in names if getattr(args, n) is not None}
    facts = scale_map(args.map, args.output, settings_from(FrameConfig, given))
    lines = [f"{facts['map']}: lengths times {facts['factor']:.6g}", *frame_lines({**facts, "metric": True})]
    return facts, "\n".join([*lines, *(f"warning: {note}" for note in facts["notes"])])


def _relink(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.map.write import relink

    facts = relink(args.map, args.folder)
    lines = [f"{args.map}: {facts['linked']} photos found in {args.folder}"]
    for kind, why in (("missing", "not found there or more than once"), ("differ", "of another size there")):
        if names := facts[kind]:
            shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
            lines.append(f"{len(names)} left as they were, {why}: {shown}")
    return facts, "\n".join(lines)


def _upgrade(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.edit.upgrade import upgrade_map

    facts = upgrade_map(args.map, args.output, progress=Progress(quiet=args.json))
    before, after = facts["encoder"]
    kept = "holds no embeddings, so none were made anew" if after is None else "embeddings as they were"
    change = f"embeddings by {after}, before by {before}" if before != after else kept
    return facts, f"{facts['map']}: {change}"


def _export(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.export.export_map import ExportOptions, export_map, side_file
    from perception.map.outputs import check_side_file, refuse_inputs

    if all(file is None for file in (args.output, args.mesh, args.voxels, args.graph, args.splat)):
        outputs = "-o OUT, --mesh OUT, --splat OUT.ply, --voxels OUT.npz or --graph OUT.json"
        raise InputError(f"export: nothing to write; give {outputs}")
    _refuse_unused(args)
    options = ExportOptions(max_distance=args.max_distance, smooth=args.smooth, segments=args.segments)
    if (args.mesh, args.voxels, args.voxel_size) != (None, None, None):
        from perception.export.mesh import check_outputs

        check_outputs(args.mesh, args.voxels, args.voxel_size)
    side = None if args.output is None else side_file(args.output)
    inputs = [args.map, args.points, args.transform, args.segments]
    refuse_inputs([args.output, side, args.mesh, args.voxels, args.graph, args.splat], inputs)
    if side is not None:
        check_side_file(side, args.output, "instances")
    facts: dict[str, Any] = {}
    lines = []
    if args.splat is not None:
        from perception.export.splat import export_splat

        splat, text = export_splat(args.map, args.splat, args.only, args.without, args.each, inputs)
        facts |= splat
        lines.append(text)
    if args.graph is not None:
        from perception.query import load_map
        from perception.query.scene_graph import write_graph

        facts["graph"], text = write_graph(load_map(args.map), args.graph)
        lines.append(text)
    if args.mesh is not None or args.voxels is not None:
        from perception.export.mesh import export_mesh, export_voxels
        from perception.map.write import read_map

        gmap = read_map(args.map)
        if args.mesh is not None:
            facts["mesh"], text = export_mesh(gmap, args.mesh, args.instance, args.voxel_size, args.color)
            lines.append(text)
        if args.voxels is not None:
            facts["voxels"], text = export_voxels(gmap, args.voxels, args.voxel_size)
            lines.append(text)
    if args.output is None:
        return facts, "\n".join(lines)
    pose = args.transform or args.align
    result, table = export_map(args.map, args.output, args.points, options, args.color, pose, args.granularity)
    return {**facts, **result}, "\n".join([*lines, table])


def _refuse_unused(args: argparse.Namespace) -> None:
    """InputError for an option that nothing of what `export` is to write depends on."""
    cloud = args.output is not None and args.output.suffix.lower() != ".spz"
    scan, written = cloud and args.points is not None, "-o OUT (.ply, .pcd or .npz)"
    uses = (
        ("--only", args.only, args.splat, "--splat OUT.ply"),
        ("--without", args.without, args.splat, "--splat OUT.ply"),
        ("--each", args.each, args.splat, "--splat OUT.ply"),
        ("--instance", args.instance is not None, args.mesh, "--mesh OUT"),
        ("--voxel-size", args.voxel_size is not None, args.mesh or args.voxels, "--mesh OUT or --voxels OUT.npz"),
        ("--points", args.points, args.output, written),
        ("--granularity", args.granularity != "default", cloud, written),
        ("--color", args.color != "original", cloud or args.mesh, f"{written} or --mesh OUT"),
        ("--align", args.align, scan, f"--points CLOUD {written}"),
        ("--transform", args.transform, scan, f"--points CLOUD {written}"),
        ("--segments", args.segments, scan and args.smooth, f"--points CLOUD {written} and --smooth"),
        ("--max-distance", args.max_distance is not None, scan, f"--points CLOUD {written}"),
    )
    for name, given, used, needed in uses:
        if given and not used:
            raise InputError(f"export: {name} changes nothing without {needed}; give that too, or leave {name} out")


def _render(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.export.render import render_map

    return render_map(args.map, args.output, args.cameras, args.what.split(","))


def _localise(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.localise.report import localise_photos

    with Progress(quiet=args.json) as progress:
        facts, lines = localise_photos(args.map, args.new, args.output, args.photos, args.camera, progress)
    if not any(photo["localised"] for photo in facts["photos"]):
        if args.json:
            with outlasting(sys.stdout):
                print(json.dumps(facts, allow_nan=False), flush=True)
        first, gone = facts["photos"][0], len(facts["rendered"])
        found = f"none of {len(facts['photos'])} photos: {first['name']}: {first['why']}"
        todo = f"; {gone} photos of the map are not at hand and were rendered: --photos DIR gives their folder"
        raise InputError(f"{args.map}: {found}{todo if gone else ''}")
    return facts, "\n".join(lines)
