"""`perception relink` and `perception upgrade`: new photo paths for moved maps, the new format for older maps."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = command(commands, "relink", _relink, "tell a map where its photos lie now")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("folder", type=Path, metavar="DIR", help="the folder that holds the photos")
    p = command(commands, "upgrade", _upgrade, "bring an older map to the newest format and encoder")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("-o", "--output", type=Path, metavar="OUT.gsmap", help="default: in place")


def _relink(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.io.relink import relink

    facts = relink(args.map, args.folder)
    lines = [f"{args.map}: {facts['linked']} photos found in {args.folder}"]
    lines += [f"warning: {name}: not found there" for name in facts["missing"]]
    lines += [f"warning: {name}: another size than the photo of the map; left out" for name in facts["differ"]]
    return facts, "\n".join(lines)


def _upgrade(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.upgrade import upgrade_map
    from perception.progress import Progress

    facts = upgrade_map(args.map, args.output, progress=Progress(quiet=args.json))
    (old, new), (before, after) = facts["format_version"], facts["encoder"]
    said = f"embeddings by {after}, before by {before}" if before != after else "embeddings as they were"
    return facts, f"{facts['map']}: format version {new}, before {old}; {said}"
