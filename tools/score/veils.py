"""Thins a posed scene, maps the photos left, and scores the others: PSNR, worst view, veils.

python tools score.veils INPUT [--every N] [--set KEY=VALUE] [--seeds 0,1] [--name NAME] [-o OUTPUT]

Poses come from all photos, once, and stay in OUTPUT; of every N-th photo a sparse cloud is triangulated anew. Gaussians
are trained on these without masks. The scored photos are those held out of training, and at most OTHERS of those left
out by thinning. Veil: the share of their pixels whose rendered depth lies before HALF the nearest sparse point of the
view; haze: the mean opacity of what lies there, which also counts veils that one can see through. Each render lies
beside its photo in OUTPUT/NAME.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.bench.output import Column, bench_parser, finish, table
from perception.config import MapConfig, load_config
from perception.evaluate.images import ssim
from perception.export.render import write_picture
from perception.frame.recentre import recentred
from perception.gaussians.model import Gaussians
from perception.gaussians.photos import exposed_as_neighbours, load_all, split_scene
from perception.gaussians.state import sized
from perception.gaussians.stereo import with_stereo
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView, depth_image, psnr, render, render_view
from perception.inputs.load import load_scene
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.pipeline.optimise import initial_gaussians
from perception.posed.triangulate import posed_scene
from perception.progress import Progress
from perception.sfm.options import NO_CLOUD, ReadOptions
from perception.types import Scene, View

OTHERS = 16
"""Most photos left out by thinning that are scored."""
HALF, NEAREST = 0.5, 0.01
"""A veil lies before HALF the depth of the nearest sparse points in the view, of which the share NEAREST is noise."""
COLUMNS: tuple[Column, ...] = (
    ("photos", "photos", "d"),
    ("scored", "scored", "d"),
    ("PSNR", "psnr", ".2f"),
    ("median", "median", ".2f"),
    ("worst", "worst", ".2f"),
    ("worst/median", "least", ".0%"),
    ("SSIM", "ssim", ".4f"),
    ("trained", "trained", ".2f"),
    ("veil", "veil", ".2%"),
    ("haze", "haze", ".2%"),
    ("Gaussians", "gaussians", "d"),
    ("CPU s", "cpu_seconds", ".0f"),
)


def posed(source: Path, every: int, folder: Path) -> tuple[Scene, list[View]]:
    """The scene of every `every`-th photo with poses from all, and the photos left out."""
    name = source.resolve().name
    options = ReadOptions(folder / f"{name}-sfm", progress=Progress(), poses="auto")
    scene = load_saved_scene(folder / f"{name}-1")
    if scene is None:
        save_scene(folder / f"{name}-1", scene := recentred(load_scene(source, options)))
    if every == 1:
        return scene, []
    thinned = load_saved_scene(folder / f"{name}-{every}")
    if thinned is None:
        kept = [replace(view, gain=None) for view in scene.views[::every]]
        options = replace(options, workdir=folder / f"{name}-{every}-sfm", poses="keep")
        thinned = posed_scene(kept, NO_CLOUD, {"input": "transforms", "warnings": []}, options, 1)
        save_scene(folder / f"{name}-{every}", thinned)
    kept_names = {view.name for view in thinned.views}
    return thinned, [view for view in scene.views if view.name not in kept_names]


def scored_views(left_out: list[View], held_out: list[View], training: list[View]) -> list[View]:
    """The held-out photos and OTHERS of those left out, which have the gains of their neighbours."""
    picked = np.unique(np.linspace(0, len(left_out) - 1, min(OTHERS, len(left_out))).round().astype(int))
    gain = None if training[0].gain is None else (1.0, 1.0, 1.0)
    others = [replace(left_out[index], gain=gain) for index in picked]
    return [*held_out, *exposed_as_neighbours(others, training)]


def measure(scene: Scene, left_out: list[View], config: MapConfig, folder: Path) -> dict[str, Any]:
    """One row: a map of the scene and its figures in the photos it has not seen; writes their renders."""
    scene, training, held_out = split_scene(scene, config.photos)
    side = config.photos.max_side
    views, held = load_all(training, side, Progress(quiet=True)), load_all(held_out, side, Progress(quiet=True))
    started, cpu = time.perf_counter(), time.process_time()
    config = sized(config, len(views))
    started_from = views
    if config.losses.depth_weight > 0:
        started_from = with_stereo(training, views, scene.points)
    start = initial_gaussians(scene, config, started_from)
    trainer = Trainer(start, views, config, held, by_stereo=started_from is not views)
    trainer.run()
    seconds, cpu = time.perf_counter() - started, time.process_time() - cpu
    gaussians = trainer.gaussians
    scored = load_all(scored_views(left_out, held_out, training), side, Progress(quiet=True))
    figures = [_figures(gaussians, view, scene.points, folder) for view in scored]
    of = {key: np.array([entry[key] for entry in figures]) for key in ("psnr", "ssim", "veil", "haze")}
    return {
        "photos": len(scene.views),
        "scored": len(scored),
        "psnr": float(of["psnr"].mean()),
        "median": float(np.median(of["psnr"])),
        "worst": float(of["psnr"].min()),
        "least": float(of["psnr"].min() / np.median(of["psnr"])),
        "ssim": float(of["ssim"].mean()),
        "trained": float(np.mean([psnr(render_view(gaussians, view), view.photo, view.weight) for view in views[::4]])),
        "veil": float(of["veil"].mean()),
        "haze": float(of["haze"].mean()),
        "gaussians": len(gaussians),
        "seconds": seconds,
        "cpu_seconds": cpu,
        "views": {view.name: entry for view, entry in zip(scored, figures, strict=True)},
        "decisions": trainer.record.decisions,
    }


def _figures(gaussians: Gaussians, view: TrainingView, points: np.ndarray, folder: Path) -> dict[str, float]:
    height, width = view.photo.shape[:2]
    image = render_view(gaussians, view)
    limit = HALF * nearest_point(view, points)
    depth = depth_image(gaussians, view.camera_from_world, view.K, width, height).numpy()
    pose = view.camera_from_world
    before = gaussians.means @ pose[2, :3] + pose[2, 3] < limit
    front = render(gaussians.rows(torch.nonzero(before).flatten()), pose, view.K, width, height)
    photo, rendered = view.photo.numpy(), np.rint(255 * image.numpy()).astype(np.uint8)
    write_picture(folder / f"{Path(view.name).stem}.png", np.concatenate([photo, rendered], axis=1))
    return {
        "psnr": psnr(image, view.photo, view.weight),
        "ssim": ssim(image.numpy(), photo / 255.0, None if view.weight is None else view.weight.numpy()),
        "veil": float(((depth > 0) & (depth < limit)).mean()),
        "haze": float(front.alphas[0].mean()),
    }


def nearest_point(view: TrainingView, points: np.ndarray) -> float:
    """Depth of the nearest sparse points in the picture, without the share NEAREST; 0 where it shows none."""
    pose, K = view.camera_from_world.double().numpy(), view.K.double().numpy()
    height, width = view.photo.shape[:2]
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    ahead = z > 0
    depth = np.where(ahead, z, 1)
    column, row = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
    inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return float(np.quantile(z[inside], NEAREST)) if inside.any() else 0.0


def main() -> None:
    parser = bench_parser("veils", __doc__)
    parser.add_argument("source", type=Path, metavar="INPUT", help="anything that `perception map` reads")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="map every N-th photo (1)")
    parser.add_argument("--seeds", default="0", help="comma-separated; one row each (0)")
    parser.add_argument("--name", help="of the rows and of the folder of renders (of the input and N)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    options = parser.parse_args()
    source: Path = options.source
    name = options.name or f"{source.resolve().name}-{options.every}"
    scene, left_out = posed(source, options.every, options.output)
    rows = []
    for seed in options.seeds.split(","):
        config = load_config(pairs=["device=cpu", *options.pairs, f"seed={seed}"])
        row = measure(scene, left_out, config, options.output / name)
        rows.append({"group": name, "name": f"seed {seed}", **row})
    options.output = options.output / name
    finish("veils", options, {"rows": rows}, table(rows, COLUMNS))


if __name__ == "__main__":
    main()
