"""`perception calibrate` and `perception frames`: what a robot's camera brings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command
from perception.errors import InputError


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
    _add_calibrate(commands)


def _add_calibrate(commands: Any) -> None:
    p = command(commands, "calibrate", _calibrate, "a camera file from photos or a video of a calibration board")
    p.add_argument("input", type=Path, metavar="INPUT", help="a folder of photos, or a video")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="CAMERA.yaml")
    p.add_argument("--board", choices=("charuco", "checkerboard"), default="charuco")
    p.add_argument("--squares", default="8x11", metavar="COLSxROWS", help="squares, not inner corners")
    p.add_argument("--square", type=float, default=0.02, metavar="M", help="side of a square (default 0.02)")
    p.add_argument("--marker", type=float, metavar="M", help="side of a marker (default 3/4 of the square)")
    p.add_argument("--dictionary", default="5X5_100", help="of the markers, as OpenCV names it")
    p.add_argument("--model", choices=("auto", "pinhole", "fisheye"), default="auto")
    p.add_argument("--pictures", type=Path, metavar="DIR", help="detections (default: beside the camera file)")


def _calibrate(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.calibration import Board, run_calibration

    words = args.squares.lower().split("x")
    if len(words) != 2 or not all(word.isdigit() for word in words):
        raise InputError(f"--squares is '{args.squares}'; expected columns x rows of squares, such as 8x11")
    marker = args.marker if args.marker is not None else 0.75 * args.square
    board = Board(args.board, (int(words[0]), int(words[1])), args.square, marker, args.dictionary)
    pictures = args.pictures or args.output.with_name(f"{args.output.stem}_detections")
    return run_calibration(args.input, args.output, board, args.model, pictures)
