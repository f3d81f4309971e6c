"""`perception eval` and `perception bench`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import Parser, command


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    parser = commands.add_parser("eval", help="score predictions by the field's own rules")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True, parser_class=Parser)
    p = command(kinds, "instances", _eval_instances, "AP, AP50, AP25 of labelled clouds")
    p.add_argument("prediction", type=Path, metavar="PRED.ply")
    p.add_argument("truth", type=Path, metavar="GT.ply")
    p.add_argument("--protocol", default="scannet", choices=("scannet", "mask3d", "segment3d", "scannetpp"))
    p = command(kinds, "images", _eval_images, "PSNR and SSIM per view and mean")
    p.add_argument("prediction", type=Path, metavar="PRED_DIR")
    p.add_argument("truth", type=Path, metavar="GT_DIR")

    p = command(commands, "bench", _bench, "measure speed against error on this machine")
    p.add_argument("name", metavar="NAME", choices=("rasterizer",), help="rasterizer")
    p.add_argument("rest", nargs=argparse.REMAINDER, metavar="...")


def _eval_instances(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.evaluate.instances import run_instances

    return run_instances(args.prediction, args.truth, args.protocol)


def _eval_images(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.evaluate.images import run_images

    return run_images(args.prediction, args.truth)


def _bench(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.bench import rasterizer

    rasterizer.main([*args.rest, *(["--json"] if args.json else [])], Parser)
    args.json = False  # it has printed its object
    return {}, ""
