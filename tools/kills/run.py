"""Kills mapping, updating, exporting and label editing at random moments; afterwards nothing may be lost.

    python tools kills.run                     # 100 kills of each, about 20 minutes on two cores
    python tools kills.run save upgrade export # in a map's folder that holds photos and notes, too
    python tools kills.run editing --kills 1000 --seed 7
    python tools kills.run --signal TERM       # SIGTERM instead of SIGKILL

After every kill the map from before must open with all its checksums, no half-written file may lie under a final name,
and the same command again (`perception map --resume`) must end with, bit for bit, what the undisturbed run ended with,
leaving nothing beside it. `--kills` moments are drawn uniformly over the length of the undisturbed run, `--writes` more
at or up to 3 ms after a change to the file system, half of them among the last, where the map takes its place.
"""

from __future__ import annotations

import argparse
import collections
import json
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kills import children
from kills.cases import KEPT, Case, Editing, Exporting, Keeping, Mapping, Updating, command
from kills.children import Moment

NAMES = ("mapping", "updating", "exporting", "editing", *KEPT)
FINAL = 40
"""Changes to the file system that count as the end of a run."""
RESUME_KILLED = 0.25
"""Share of the trials in which the run that goes on is killed once more."""


def main() -> int:
    """Runs the kills asked for and prints a table; 1 when something was lost."""
    args = _arguments()
    _warm()
    with tempfile.TemporaryDirectory(prefix="kills-", dir=args.folder) as folder:
        cases = _cases(Path(folder), args)
        rows = [_kill(cases[name], Path(folder), args) for name in args.what]
    print(f"{'':12}{'kills':>7}{'survived':>10}{'resumes killed':>16}{'run, s':>9}  left behind")
    for row in rows:
        left = ", ".join(f"{word} {n}" for word, n in sorted(row["left"].items()))
        print(
            f"{row['what']:12}{row['kills']:>7}{row['survived']:>10}{row['killed_again']:>16}"
            f"{row['run_seconds']:>9.2f}  {left}"
        )
        for told in row["lost"]:
            print(f"  LOST {told}")
    if args.json is not None:
        args.json.write_text(json.dumps({"seed": args.seed, "machine": platform.processor(), "cases": rows}, indent=1))
    return int(any(row["lost"] for row in rows))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=list(NAMES), help=f"of {', '.join(NAMES)}; all by default")
    parser.add_argument("--kills", type=int, default=100, metavar="N", help="at uniformly drawn times")
    parser.add_argument("--writes", type=int, default=30, metavar="N", help="around changes to the file system")
    parser.add_argument("--signal", choices=("KILL", "TERM"), default="KILL")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scene", type=Path, help="a small scene that lies ready (tests/conftest.py's)")
    parser.add_argument(
        "--sfm", action=argparse.BooleanOptionalAction, default=True, help="from photos alone, or with given poses"
    )
    parser.add_argument("--iterations", type=int, default=120, help="of training")
    parser.add_argument("--fresh", action=argparse.BooleanOptionalAction, default=True, help="compare with no fork too")
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one by default")
    parser.add_argument("--json", type=Path, metavar="OUT.json")
    args = parser.parse_args()
    if wrong := set(args.what) - set(NAMES):
        parser.error(f"{', '.join(sorted(wrong))}: expected {', '.join(NAMES)}")
    return args


def _warm() -> None:
    """Everything imported that the commands import, and nothing of it run."""
    import cv2  # noqa: F401
    import scipy.sparse.csgraph
    import scipy.spatial  # noqa: F401
    import torch  # noqa: F401

    import perception.edit.editor
    import perception.edit.upgrade  # noqa: F401
    from perception.photos.lens import load_pycolmap

    load_pycolmap()


def _cases(folder: Path, args: argparse.Namespace) -> dict[str, Case]:
    """The scene, a finished map of it, and the cases around them."""
    scene = args.scene
    if scene is None:
        scene = folder / "scene"
        children.ask(lambda: _make_scene(scene))
    source = scene / "images" if args.sfm else scene / "transforms.json"
    mapping = Mapping(source, scene / "labels", args.iterations)
    gmap = folder / "earlier.gsmap"
    _do(lambda: command(*mapping.words(gmap)), folder)
    first = folder / "first"
    shutil.copytree(gmap, first / "m.gsmap")
    (first / "out").mkdir()
    exporting = Exporting(gmap, scene / "truth" / "gt_points.ply", first / "out")
    _do(lambda: exporting.export(first, "--no-smooth", "--color", "original"), folder)
    kept: dict[str, Case] = {name: Keeping(name, gmap) for name in KEPT}
    if "updating" in args.what:
        earlier, later = (folder / "visits" / f"visit{n}" for n in range(2))
        children.ask(lambda: _make_visits(folder / "visits"))
        words = ("--masks", f"labels:{earlier / 'labels'}", "--iterations", 400, "--set", "language.encoder=none")
        _do(lambda: command("map", earlier, "-o", folder / "before.gsmap", *words), folder)
        kept["updating"] = Updating(folder / "before.gsmap", later)
    return {"mapping": mapping, "exporting": exporting, "editing": Editing(gmap), **kept}


def _do(work: Callable[[], int], folder: Path) -> float:
    """Seconds that `work` took in a child; AssertionError with what it said when it failed."""
    end = children.run(work, folder)
    assert end.code == 0, end.said
    return end.seconds


def _make_scene(scene: Path) -> None:
    """Nine neighbouring photos of the demo's tabletop with their label images."""
    from worlds import make_photos

    truth = make_photos(scene / "images", views=24, width=320, height=240, light_samples=2)
    (scene / "labels").mkdir()
    for name in truth.names[9:]:
        (scene / "images" / name).unlink()
    for name in truth.names[:9]:
        label = Path(name).with_suffix(".png").name
        shutil.copy(scene / "truth" / "labels" / label, scene / "labels" / label)


def _make_visits(folder: Path) -> None:
    """Two visits of a table of which some things go and others come."""
    from worlds.visits import make_visits

    share = {"moved": 0.1, "turned": 0.0, "removed": 0.1, "added": 0.1}
    size = {"views": 20, "later_views": 10, "width": 160, "height": 120, "light_samples": 2, "seed": 3}
    make_visits(folder, visits=2, share=share, **size)


def _kill(case: Case, folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    rng = np.random.default_rng([args.seed, NAMES.index(case.name)])
    lengths, writes = _undisturbed(case, folder)
    if isinstance(case, Mapping) and args.fresh:
        _check_forking(case, folder)
    row: dict[str, Any] = {"what": case.name, "kills": 0, "survived": 0, "killed_again": 0, "lost": []}
    row |= {"run_seconds": float(np.mean(lengths)), "writes": len(writes[0]), "left": collections.Counter()}
    for trial in range(3 * (args.kills + args.writes)):  # a run may end before its kill
        if row["kills"] == args.kills + args.writes:
            break
        uniform = row["kills"] < args.kills
        number = signal.Signals[f"SIG{args.signal}"]
        moment = _moment(rng, lengths[trial % case.variants], writes[trial % case.variants], uniform, number)
        twice = rng.random() < RESUME_KILLED
        second = Moment(rng.uniform(0, lengths[trial % case.variants]), signal=number) if twice else None
        place = folder / f"{case.name}-{trial}"
        try:
            _one(case, place, trial, moment, second, row)
        except AssertionError as error:
            row["lost"].append(f"{case.name} trial {trial} {moment}: {error}")
            row["survived"] -= 1
        shutil.rmtree(place, ignore_errors=True)
        if sys.stderr.isatty() or trial % 20 == 19:
            print(f"{case.name}: {row['kills']} kills, {len(row['lost'])} lost", file=sys.stderr, flush=True)
    return row


def _undisturbed(case: Case, folder: Path) -> tuple[list[float], list[list[str]]]:
    """How long each variant takes and which changes it makes; keeps what it ends with as the case's `whole`."""
    lengths, writes = [], []
    case.whole = []
    for variant in range(case.variants):
        place = folder / f"{case.name}-whole-{variant}"
        place.mkdir()
        case.lay_out(place, variant)
        seconds, changes = children.watch(partial(case.work, place, variant), place)
        lengths.append(seconds)
        writes.append(changes)
        case.whole.append(children.ask(partial(case.result, place, variant)))
    return lengths, writes


def _check_forking(case: Mapping, folder: Path) -> None:
    """A fresh interpreter must end with the very map that a forked child ends with."""
    place = folder / "fresh"
    place.mkdir()
    case.lay_out(place, 0)
    words = case.words(place / "out.gsmap")
    subprocess.run([sys.executable, "-m", "perception.cli", *words], check=True, cwd=folder, capture_output=True)
    assert children.ask(lambda: case.result(place, 0)) == case.whole[0], "a forked run differs from a fresh process"
    shutil.rmtree(place)


def _moment(rng: np.random.Generator, length: float, writes: list[str], uniform: bool, number: int) -> Moment:
    if uniform:
        return Moment(rng.uniform(0, length), None, number)
    first = max(1, len(writes) - FINAL) if rng.random() < 0.5 else 1
    seconds = float(rng.choice([0.0, rng.uniform(0, 0.003)]))
    return Moment(seconds, int(rng.integers(first, len(writes) + 1)), number)


def _one(case: Case, place: Path, trial: int, moment: Moment, second: Moment | None, row: dict[str, Any]) -> None:
    """One kill and the way back."""
    place.mkdir()
    case.lay_out(place, trial)
    end = children.run(lambda: case.work(place, trial), place, moment)
    assert end.killed or end.code == 0, end.said
    row["kills"] += end.killed
    row["survived"] += end.killed
    row["left"][children.ask(lambda: case.after_kill(place, trial)) if end.killed else "ended before"] += 1
    if second is not None:
        end = children.run(lambda: case.again(place, trial), place, second)
        assert end.killed or end.code == 0, end.said
        row["killed_again"] += end.killed
        children.ask(lambda: case.after_kill(place, trial))
    end = children.run(lambda: case.again(place, trial), place)
    assert end.code == 0, f"cannot go on: {end.said}"
    assert children.ask(lambda: case.result(place, trial)) == case.whole[trial % case.variants], "another result"


if __name__ == "__main__":
    started = time.monotonic()
    code = main()
    print(f"{time.monotonic() - started:.0f} s")
    sys.exit(code)
