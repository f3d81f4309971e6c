"""The command `perception`: arguments in, one library call, words or JSON out. Heavy imports wait for their command."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from perception import __version__
from perception.errors import InputError


class _Parser(argparse.ArgumentParser):
    """argparse with one clear line and exit code 2 on bad usage."""

    def error(self, message: str) -> Any:  # type: ignore[override]
        raise InputError(f"{self.prog}: {message} (see {self.prog} --help)")


def build_parser() -> argparse.ArgumentParser:
    """All subcommands and their options."""
    parser = _Parser(prog="perception", description="From photos to a 3D instance map that answers text prompts.")
    parser.add_argument("--version", action="version", version=f"perception {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for add in (
        _add_demo,
        _add_map,
        _add_export,
        _add_query,
        _add_render,
        _add_eval,
        _add_info,
        _add_report,
        _add_bench,
    ):
        add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0, 2 for bad usage or input, 130 on Ctrl-C."""
    # Threads of torch's OpenMP that spin while they wait would take the cores from the kernels' own threads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        args = build_parser().parse_args(argv)
        result, text = args.run(args)
        if args.json:
            print(json.dumps(result, allow_nan=False, default=str))
        elif text:
            print(text)
    except InputError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; what was done is kept, repeat the command with --resume", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 0
    return 0


Run = Callable[[argparse.Namespace], tuple[dict[str, Any], str]]


def _command(commands: Any, name: str, run: Run, summary: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=summary)
    parser.set_defaults(run=run)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else there")
    return parser


# ------------------------------------------------------------------------ map


def _add_map(commands: Any) -> None:
    p = _command(commands, "map", _map, "build a map from photos, a COLMAP workspace or a transforms.json")
    p.add_argument("input", type=Path, metavar="INPUT")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="MAP")
    p.add_argument("--masks", metavar="SOURCE", help="auto, builtin, sam:PATH or labels:DIR")
    p.add_argument("--config", type=Path, metavar="FILE.toml")
    p.add_argument("--preset", default="default", help="fast, default or quality")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    p.add_argument("--camera", type=Path, metavar="FILE.yaml", help="fixed intrinsics, ROS camera_info")
    p.add_argument("--max-side", metavar="PX", help="long side in pixels at which the map is trained")
    p.add_argument("--budget", metavar="N", help="most Gaussians the map may have")
    p.add_argument("--iterations", metavar="N")
    p.add_argument("--time-limit", metavar="S", help="seconds of training; all schedules shrink to fit")
    p.add_argument("--holdout", metavar="N", help="every N-th view is kept for scoring, 0 trains on all")
    p.add_argument("--seed", metavar="S")
    p.add_argument("--device", help="auto, cpu or cuda")
    p.add_argument("--resume", action="store_true", help="go on with an interrupted run")


_SHORTCUTS = {
    "masks": "masks",
    "camera": "photos.camera",
    "max_side": "photos.max_side",
    "budget": "train.budget",
    "iterations": "train.iterations",
    "time_limit": "train.time_limit",
    "holdout": "photos.holdout",
    "seed": "seed",
    "device": "device",
}


def _map(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.config import load_config

    given = [f"{key}={getattr(args, name)}" for name, key in _SHORTCUTS.items() if getattr(args, name) is not None]
    config = load_config(args.config, args.pairs + given, args.preset)
    from perception.pipeline.mapping import build_map
    from perception.progress import Progress

    gmap = build_map(args.input, args.output, config, resume=args.resume, progress=Progress())
    from perception.pipeline.summary import map_facts

    return map_facts(args.output, gmap.info, len(gmap), len(gmap.instances)), ""


def _add_info(commands: Any) -> None:
    p = _command(commands, "info", _info, "what a map holds, how it was made, how good it is")
    p.add_argument("map", type=Path, metavar="MAP")


def _info(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.io.store import read_info
    from perception.pipeline.summary import info_text

    info = read_info(args.map)
    return info, info_text(args.map, info)


def _add_report(commands: Any) -> None:
    p = _command(commands, "report", _report, "one self-contained page: held-out views, curves, instances, answers")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.html")
    p.add_argument("--ask", action="append", default=[], metavar="TEXT", help="a prompt to answer on the page")


def _report(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.reporting import write_map_report
    from perception.query import load_map

    page = write_map_report(load_map(args.map), args.output, args.ask)
    return {"report": str(page)}, str(page)


# ---------------------------------------------------------------------- query


def _add_query(commands: Any) -> None:
    p = _command(commands, "query", _query, 'ranked 3D instances for each text, or "not present"')
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("text", nargs="+", metavar="TEXT")
    p.add_argument("--top", type=int, default=3, metavar="K")
    p.add_argument("--min-score", type=float, metavar="X")
    p.add_argument("--points", type=Path, metavar="OUT.ply", help="write the hits' points, labelled by instance_id")


def _query(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.summary import query_text, write_hits
    from perception.query import load_map

    opened = load_map(args.map)
    answers = [(text, opened.query(text, args.top, args.min_score)) for text in args.text]
    if args.points:
        write_hits(args.points, opened.gmap, [hit for _, hits in answers for hit in hits])
    results = [{"text": text, "present": bool(hits), "hits": [h.to_json() for h in hits]} for text, hits in answers]
    return {"results": results, "frame": opened.frame, "metric": opened.metric}, query_text(answers, opened.metric)


# ------------------------------------------------------------- export, render


def _add_export(commands: Any) -> None:
    p = _command(commands, "export", _export, "instances onto a point cloud or mesh, or onto the map's own points")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--points", type=Path, metavar="CLOUD")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.add_argument("--smooth", action=argparse.BooleanOptionalAction, default=True)
    p.add_argument("--rule", choices=("nearest", "densest"), default="nearest", help="nearest mean is the paper's")
    p.add_argument("--max-distance", type=float, metavar="D", help="points farther than D from any Gaussian stay -1")
    p.add_argument("--fill", action=argparse.BooleanOptionalAction, default=True, help="noise Gaussians do not vote")
    p.add_argument("--segments", type=Path, metavar="X.segs.json", help="ScanNet segments instead of our own")
    p.add_argument("--color", choices=("original", "instance"), default="original")
    p.add_argument("--split", type=Path, metavar="DIR", help="one cloud an instance")
    p.add_argument("--boxes", type=Path, metavar="OUT.json", help="3D boxes")
    p.add_argument("--scannet", type=Path, metavar="DIR", help="ScanNet submission layout")
    p.add_argument("--mcap", type=Path, metavar="OUT.mcap", help="ROS 2 bag with cloud and detections")


def _export(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.export import ExportOptions, Outputs
    from perception.io.store import read_info
    from perception.pipeline.exporting import export_map

    info = read_info(args.map)
    options = ExportOptions(
        rule=args.rule,
        drop_noise=args.fill,
        max_distance=args.max_distance,
        smooth=args.smooth,
        segments=args.segments,
    )
    outputs = Outputs(
        args.color, args.split, args.boxes, args.scannet, args.mcap, info.get("frame", "map"), bool(info.get("metric"))
    )
    return export_map(args.map, args.output, args.points, options, outputs)


def _add_render(commands: Any) -> None:
    p = _command(commands, "render", _render, "pictures of the map from given cameras")
    p.add_argument("map", type=Path, metavar="MAP")
    p.add_argument("--cameras", type=Path, metavar="transforms.json", help="default: the map's held-out views")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    p.add_argument("--what", default="rgb", metavar="KINDS", help="comma-separated: rgb, depth, instances, features")


def _render(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.rendering import render_map

    return render_map(args.map, args.output, args.cameras, args.what.split(","))


# ----------------------------------------------------------------------- eval


def _add_eval(commands: Any) -> None:
    parser = commands.add_parser("eval", help="score predictions by the field's own rules")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True, parser_class=_Parser)
    p = _command(kinds, "instances", _eval_instances, "AP, AP50, AP25 of labelled clouds")
    p.add_argument("prediction", type=Path, metavar="PRED.ply")
    p.add_argument("truth", type=Path, metavar="GT.ply")
    p.add_argument("--protocol", default="scannet", choices=("scannet", "mask3d", "scannetpp"))
    p = _command(kinds, "images", _eval_images, "PSNR and SSIM per view and mean")
    p.add_argument("prediction", type=Path, metavar="PRED_DIR")
    p.add_argument("truth", type=Path, metavar="GT_DIR")


def _eval_instances(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.evaluate import run_instances

    return run_instances(args.prediction, args.truth, protocol=args.protocol)


def _eval_images(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.evaluate import run_images

    return run_images(args.prediction, args.truth)


# ---------------------------------------------------------------- demo, bench


def _add_demo(commands: Any) -> None:
    p = _command(commands, "demo", _demo, "photos -> SfM -> map -> export -> text query, on a scene it makes itself")
    p.add_argument("-o", "--output", type=Path, default=Path("perception-demo"), metavar="DIR")


def _demo(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from perception.pipeline.demo import run_demo

    return run_demo(args.output)


def _add_bench(commands: Any) -> None:
    p = _command(commands, "bench", _bench, "measure speed against error on this machine")
    p.add_argument("name", metavar="NAME", help="rasterizer, training, masks, language")
    p.add_argument("rest", nargs=argparse.REMAINDER, metavar="...")


def _bench(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    import importlib

    names = ("rasterizer", "training", "masks", "language")
    if args.name not in names:
        raise InputError(f"bench: found '{args.name}', expected one of: {', '.join(names)}")
    importlib.import_module(f"perception.bench.{args.name}").main(args.rest)
    return {}, ""


if __name__ == "__main__":
    sys.exit(main())
