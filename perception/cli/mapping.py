"""`perception map`, `update`, `info`, `report`, `demo`; `calibrate` and `frames`, which prepare inputs of `map`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import Parser, command, map_command
from perception.errors import InputError
from perception.interrupts import ends_as_ctrl_c
from perception.progress import Progress


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    _add_map(commands)
    p = command(commands, "fleet", _fleet, "build the maps of a list of jobs, here or on a Ray cluster")
    p.add_argument("jobs", type=Path, metavar="JOBS.yaml", help="a list of {input, output, preset, config, set}")
    _add_engine(p, "where maps are built")

    p = map_command(commands, "info", _info, "what a map holds, how it was made, how good it is")
    p.add_argument("--verify", action="store_true", help="read every byte and compare it with the checksums")

    p = map_command(commands, "report", _report, "one self-contained page: held-out views, instances, answers")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.html")
    p.add_argument("--ask", action="append", default=[], metavar="TEXT", help="a prompt to answer on the page")

    p = command(commands, "demo", _demo, "photos -> SfM -> map -> export -> text query, on photos that come with it")
    p.add_argument("-o", "--output", type=Path, default=Path("perception-demo"), metavar="DIR")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of all random choices (default 0)")

    p = command(commands, "calibrate", _calibrate, "a camera file from photos or a video of a calibration board")
    p.add_argument("input", type=Path, metavar="INPUT", help="a folder of photos, or a video")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="CAMERA.yaml")
    p.add_argument("--board", choices=("charuco", "checkerboard"), default="charuco")
    p.add_argument("--squares", default="8x11", metavar="COLSxROWS", help="squares, not inner corners")
    p.add_argument("--square", type=float, default=0.02, metavar="M", help="side of a square (default 0.02)")
    p.add_argument("--marker", type=float, metavar="M", help="side of a marker (default 3/4 of the square)")
    p.add_argument("--dictionary", default="5X5_100", help="of the markers, as OpenCV names it")
    p.add_argument("--model", choices=("auto", "pinhole", "fisheye"), default="auto")

    p = command(commands, "frames", _frames, "sharp, well-spaced photos out of a ROS bag, with intrinsics and poses")
    p.add_argument("bag", type=Path, metavar="BAG", help="ROS 1 .bag, ROS 2 bag folder, .mcap or .db3")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--topic", help="of the images (default: the bag's only one)")
    p.add_argument("--camera-info", metavar="TOPIC", help="default: beside the images")
    p.add_argument("--camera", type=Path, metavar="FILE.yaml", help="a camera file instead of camera_info")
    p.add_argument("--fixed-frame", metavar="FRAME", help="the world (default: map, odom, world, or the tree's root)")
    p.add_argument("--odometry", metavar="TOPIC", help="its poses before all others (default: tf, then the first)")
    p.add_argument(
        "--depth", metavar="TOPIC", help="none, or a topic (default: registered to the images, or the only one)"
    )
    p.add_argument("--max-frames", type=int, default=200, metavar="N")
    p.add_argument("--spacing", type=float, default=0.08, metavar="S", help="least motion, as share of the width")
    p.add_argument("--strict", action="store_true", help="refuse damaged messages instead of leaving them out")


def _add_map(commands: Any) -> None:
    p = command(commands, "map", _map, "build a map of photos, a video, posed photos, RGB-D or a finished splat")
    p.add_argument("input", type=Path, metavar="INPUT")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="MAP")
    p.add_argument("--preset", default="default", help="fast, default, quality or paper")
    _add_settings(p)
    _add_engine(p, "where blocks are trained")
    p = map_command(commands, "update", _update, "a map of today, from a map and the photos of a new visit")
    p.add_argument("input", type=Path, metavar="INPUT", help="of the visit; photos without poses are localised")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="NEW")
    _add_settings(p)


def _add_settings(p: Parser) -> None:
    """The options of `map` and `update` for settings, which their help lists, and --resume."""
    p.formatter_class, p.late_epilog = argparse.RawDescriptionHelpFormatter, _settings
    p.add_argument("--config", type=Path, metavar="FILE.toml")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    p.add_argument(
        "--strict", action="store_const", const=True, help="refuse damaged photos instead of leaving them out"
    )
    p.add_argument(
        "--keep-world", action=argparse.BooleanOptionalAction, help="keep the input's frame (default: if it has poses)"
    )
    for key, (metavar, text) in _SHORTCUTS.items():
        p.add_argument(_option(key), metavar=metavar, help=text, dest=key)
    p.add_argument("--resume", action="store_true", help="go on with an interrupted run")


def _add_engine(p: argparse.ArgumentParser, what: str) -> None:
    p.add_argument("--engine", choices=("local", "ray"), default="local", help=what)
    p.add_argument("--address", metavar="HOST:PORT", help="of the Ray cluster, or auto; default: one on this machine")


def _settings() -> str:
    """All settings with default, range and effect, user settings first, for `--help`."""
    from perception.config import METHOD, MapConfig, expected, fields

    lines: dict[bool, list[str]] = {False: [], True: []}
    for key, field in fields(MapConfig):
        default = field.default
        default = "none" if default is None else str(default).lower() if isinstance(default, bool) else default
        lines[key.startswith(METHOD)] += [f"  {key}={default}  ({expected(field)})", f"      {field.description}"]
    head = "settings, for --set KEY=VALUE and --config FILE.toml:"
    return "\n".join([head, *lines[False], "settings that vary the method, for experiments:", *lines[True]])


_SHORTCUTS = {
    "masks": ("SOURCE", "auto, builtin, sam:PATH or labels:DIR"),
    "photos.camera": ("FILE.yaml", "fixed intrinsics, ROS camera_info"),
    "photos.ignore_masks": ("DIR", "PNG masks, same stem as the photo; black pixels are ignored"),
    "photos.init_points": ("CLOUD", "start from these points, in the frame of the input's poses"),
    "frame.known_length": ("TEXT", '"0.297: a.jpg 100,200 300,220; b.jpg 110,190 310,215"'),
    "frame.tag_size": ("M", "side of the AprilTags or ArUco markers in the photos"),
    "frame.board": ("TEXT", "a calibration board in the photos, such as charuco:8x11:0.02"),
    "splat.cameras": ("MODEL", "of a finished splat: COLMAP model or transforms.json, used first"),
    "splat.up": ("AXIS", "of a finished splat: z, -y, ... or X,Y,Z"),
    "splat.unit": ("UNIT", "of a finished splat: metre"),
    "photos.max_side": ("PX", "long side in pixels at which the map is trained"),
    "train.budget": ("N", "most Gaussians of the map, or of each block"),
    "train.iterations": ("N", None),
    "train.time_limit": ("S", "seconds of training; all schedules shrink to fit"),
    "photos.memory": (
        "SIZE",
        "such as 8G: for photos, labels and depth; more of them is on disk; of a splat: for the run",
    ),
    "photos.holdout": ("N", "every N-th view, or the input's test part, is kept for scoring, 0 trains on all"),
    "seed": ("S", None),
    "device": ("DEVICE", "auto, cpu or cuda"),
}
"""Settings with an option of their own: the last part of their name."""


def _option(key: str) -> str:
    return f"--{key.rpartition('.')[2].replace('_', '-')}"


def settings_given(args: argparse.Namespace) -> dict[str, tuple[Any, str]]:
    """Key -> (value, option) of every setting that is given by an option of its own."""
    values = {key: getattr(args, key) for key in _SHORTCUTS}
    values |= {"photos.strict": args.strict, "frame.keep_world": args.keep_world}
    return {key: (value, _option(key)) for key, value in values.items() if value is not None}


def _map(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.config import load_config

    config = load_config(args.config, args.pairs, args.preset, options=settings_given(args))
    from perception.pipeline.mapping import build_map
    from perception.report.page import write_own_report
    from perception.report.text import map_facts
    from perception.tasks.engine import Engine

    engine = Engine(args.engine, args.address)
    with ends_as_ctrl_c(), Progress() as progress:
        build_map(args.input, args.output, config, resume=args.resume, progress=progress, engine=engine)
        info = write_own_report(args.output, progress)
    return map_facts(args.output, info), ""


def _update(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.map.outputs import refuse_inputs
    from perception.report.page import write_own_report
    from perception.report.text import map_facts
    from perception.visits.scene import update_settings
    from perception.visits.update import update_map

    refuse_inputs([args.output], [args.map])
    config = update_settings(args.map, args.config, args.pairs, settings_given(args))
    with ends_as_ctrl_c(), Progress() as progress:
        update_map(args.map, args.input, args.output, config, resume=args.resume, progress=progress)
        info = write_own_report(args.output, progress)
    return map_facts(args.output, info), ""


def _fleet(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.fleet import run_fleet
    from perception.tasks.engine import Engine

    with ends_as_ctrl_c(), Progress() as progress:
        made = run_fleet(args.jobs, Engine(args.engine, args.address), progress)
    failed = [job for job in made if "error" in job]
    if failed:
        progress.log("\n".join(f"{job['output']}: {job['error']}" for job in failed))
        found = f"{len(failed)} of {len(made)} maps could not be made"
        raise InputError(f"{args.jobs}: {found}; mend the jobs and run it again")
    return {"maps": made}, "\n".join("{output}: {instances} instances".format(**job) for job in made)


def _info(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.map.files import read_info
    from perception.map.map import Map
    from perception.map.write import verify_map
    from perception.report.text import info_text

    info = read_info(args.map)
    entries = Map.open(args.map).instances
    texts = {entry["id"]: entry["texts"] for entry in entries if entry.get("texts")}
    lines = [info_text(args.map, info, entries)]
    info = {**info, "texts": texts} if texts else info
    if args.verify:
        info["verified"] = verify_map(args.map)
        lines += [f"{name}: {state}" for name, state in info["verified"].items()]
    return info, "\n".join(lines)


def _report(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.map.outputs import refuse_inputs
    from perception.query import load_map
    from perception.report.page import write_map_report

    refuse_inputs([args.output], [args.map])
    page = write_map_report(load_map(args.map), args.output, args.ask)
    return {"report": str(page)}, str(page)


def _demo(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.demo import run_demo

    with ends_as_ctrl_c(), Progress() as progress:
        return run_demo(args.output, progress, args.seed)


def _calibrate(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.calibration.board import Board
    from perception.calibration.calibrate import run_calibration

    counts = args.squares.lower().split("x")
    if len(counts) != 2 or not all(count.isdigit() for count in counts):
        raise InputError(f"--squares is '{args.squares}'; expected columns x rows of squares, such as 8x11")
    marker = args.marker if args.marker is not None else 0.75 * args.square
    board = Board(args.board, (int(counts[0]), int(counts[1])), args.square, marker, args.dictionary)
    return run_calibration(args.input, args.output, board, args.model)


def _frames(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.bags.frames import FrameOptions, run_frames

    names = ("topic", "camera_info", "camera", "fixed_frame", "odometry", "depth", "max_frames", "spacing", "strict")
    return run_frames(args.bag, args.output, FrameOptions(**{name: getattr(args, name) for name in names}))
