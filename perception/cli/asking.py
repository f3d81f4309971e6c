"""`perception query`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command
from perception.errors import InputError


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = command(commands, "query", _query, 'ranked 3D instances for each text, or "not present"')
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("text", nargs="+", metavar="TEXT")
    p.add_argument("--top", type=int, default=3, metavar="K")
    p.add_argument("--min-score", type=float, metavar="X")
    p.add_argument("--parts", action="store_true", help='rank parts of things, such as "handle of the mug"')
    p.add_argument("--points", type=Path, metavar="OUT.ply", help="write the hits' points, labelled by instance_id")


def _query(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.summary import query_text, write_hits
    from perception.query import load_map

    opened = load_map(args.map)
    if args.parts:
        from perception.query import PartsMap

        if args.points or args.min_score is not None:
            raise InputError("query: --parts goes without --points and --min-score; leave one out")
        parts = PartsMap(opened)
        answers = [(text, parts.query(text, args.top)) for text in args.text]
    else:
        answers = [(text, opened.query(text, args.top, args.min_score)) for text in args.text]
    if args.points:
        write_hits(args.points, opened, [hit for _, hits in answers for hit in hits])
    results = [{"text": text, "present": bool(hits), "hits": [h.to_json() for h in hits]} for text, hits in answers]
    return {"results": results, "frame": opened.frame, "metric": opened.metric}, query_text(answers, opened.metric)
