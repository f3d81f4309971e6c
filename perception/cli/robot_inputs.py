"""`perception calibrate` and `perception frames`: camera calibration, and frames from recordings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from perception.cli.parser import command
from perception.errors import InputError


def register(commands: Any) -> None:
    """Adds this module's subcommands."""
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
    p.add_argument("bag", type=Path, metavar="BAG", help="ROS 1 .bag, ROS 2 bag folder, or .mcap")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--topic", help="of the images (default: the bag's only one)")
    p.add_argument("--camera-info", metavar="TOPIC", help="default: beside the images")
    p.add_argument("--camera", type=Path, metavar="FILE.yaml", help="a camera file instead of camera_info")
    p.add_argument("--poses", action=argparse.BooleanOptionalAction, default=True, help="from tf and odometry")
    p.add_argument("--fixed-frame", metavar="FRAME", help="the world (default: map, odom, world, or the tree's root)")
    p.add_argument("--odometry", metavar="TOPIC")
    p.add_argument(
        "--depth", metavar="TOPIC", help="none, or a topic (default: registered to the images, or the only one)"
    )
    p.add_argument("--max-frames", type=int, default=200, metavar="N")
    p.add_argument("--spacing", type=float, default=0.08, metavar="S", help="least motion, as share of the width")


def _calibrate(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.calibration.board import Board
    from perception.calibration.calibrate import run_calibration

    words = args.squares.lower().split("x")
    if len(words) != 2 or not all(word.isdigit() for word in words):
        raise InputError(f"--squares is '{args.squares}'; expected columns x rows of squares, such as 8x11")
    marker = args.marker if args.marker is not None else 0.75 * args.square
    board = Board(args.board, (int(words[0]), int(words[1])), args.square, marker, args.dictionary)
    return run_calibration(args.input, args.output, board, args.model)


def _frames(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.bags.frames import FrameOptions, run_frames

    names = ("topic", "camera_info", "camera", "poses", "fixed_frame", "odometry", "depth", "max_frames", "spacing")
    return run_frames(args.bag, args.output, FrameOptions(**{name: getattr(args, name) for name in names}))
