"""`perception query`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    p = command(commands, "query", _query, 'ranked 3D instances for each text, or "not present"')
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("text", nargs="+", metavar="TEXT")
    p.add_argument("--top", type=int, default=20, metavar="K", help="at most so many hits of those that answer (20)")
    p.add_argument("--min-score", type=float, metavar="X", help="all with this score instead of those that answer")
    p.add_argument("--points", type=Path, metavar="OUT.ply", help="write the hits' points, labelled by instance_id")


def _query(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.summary import query_text, write_hits
    from perception.query import load_map

    opened = load_map(args.map)
    answers = [(text, opened.query(text, args.top, args.min_score)) for text in args.text]
    if args.points:
        write_hits(args.points, [hit for _, hits in answers for hit in hits])
    results = [{"text": text, "present": bool(hits), "hits": [h.to_json() for h in hits]} for text, hits in answers]
    return {"results": results, "frame": opened.frame, "metric": opened.metric}, query_text(answers, opened.metric)
