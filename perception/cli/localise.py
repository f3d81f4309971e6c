"""`perception localise`: where photos were taken, in the frame of a map."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from perception.cli.parser import map_command
from perception.errors import InputError


def register(commands: Any) -> None:
    """Adds this module's subcommand."""
    p = map_command(commands, "localise", _localise, "poses of new photos in the map's frame, with standard error")
    p.add_argument("new", type=Path, nargs="+", metavar="PHOTOS", help="photos, or what `map` takes: poses are ignored")
    p.add_argument("-o", "--output", type=Path, metavar="transforms.json", help="the poses, as nerfstudio reads them")
    p.add_argument(
        "--photos", type=Path, metavar="DIR", help="where the map's photos lie, if not where it records them"
    )
    p.add_argument("--camera", type=Path, metavar="FILE.yaml", help="intrinsics of the new photos, ROS camera_info")


def _localise(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.localise.report import localise_photos
    from perception.progress import Progress

    with Progress(quiet=args.json) as progress:
        facts, lines = localise_photos(args.map, args.new, args.output, args.photos, args.camera, progress)
    if not any(photo["localised"] for photo in facts["photos"]):
        if args.json:
            print(json.dumps(facts, allow_nan=False))
        first = facts["photos"][0]
        raise InputError(f"{args.map}: none of {len(facts['photos'])} photos: {first['name']}: {first['why']}")
    return facts, "\n".join(lines)
