"""Compares structure from motion by submodels, in one piece, and global, from the same matches.

By submodels is what `map` does with many photos; in parts: the same, with bundle adjustment as of very many; global is
pycolmap.global_mapping. Printed are seconds, photos with a pose, and the distance of their cameras from given ones
after alignment.

python tools speed.global_sfm SCENE --first 300 --ways by_submodels in_parts
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pycolmap

from perception.geometry import align_similarity
from perception.progress import Progress
from perception.sfm import parts
from perception.sfm.database import FeatureStore, build_features
from perception.sfm.incremental import REPEATABLE_PHOTOS, map_photos, pipeline_options
from perception.sfm.options import ReadOptions
from perception.sfm.submodels import map_submodels


def by_submodels(store: FeatureStore, count: int) -> Any:
    found = map_submodels(store, ReadOptions(store.folder))
    assert found is not None, "contradicted"
    return found[0][0]


def in_parts(store: FeatureStore, count: int) -> Any:
    with patch.object(parts, "WHOLE", 0):
        return by_submodels(store, count)


def incremental(store: FeatureStore, count: int) -> Any:
    few = count <= REPEATABLE_PHOTOS
    models, _ = map_photos(store, pipeline_options(False, 0, few), count, Progress(quiet=True))
    return models[0]


def globally(store: FeatureStore, count: int) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    out = store.folder / "global"
    out.mkdir()
    models = pycolmap.global_mapping(store.database, store.image_root, out, options)
    return max(models.values(), key=lambda model: model.num_reg_images())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a folder with a transforms.json of true poses")
    parser.add_argument("--first", type=int, help="so many photos only")
    ways = {find.__name__: find for find in (by_submodels, in_parts, incremental, globally)}
    parser.add_argument("--ways", nargs="+", choices=ways, default=list(ways), help="those to compare (default: all)")
    options = parser.parse_args()
    frames = json.loads((options.scene / "transforms.json").read_text(encoding="utf-8"))["frames"][: options.first]
    photos = [options.scene / frame["file_path"] for frame in frames]
    truth = np.array([frame["transform_matrix"] for frame in frames], float)[:, :3, 3]
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        store = build_features(photos, [None] * len(photos), ReadOptions(Path(folder)))
        print(f"{len(photos)} photos: features and matches {time.perf_counter() - started:.0f} s", flush=True)
        for find in map(ways.__getitem__, options.ways):
            started, begun = time.perf_counter(), time.process_time()
            model = find(store, len(photos))
            seconds, cpu = time.perf_counter() - started, time.process_time() - begun
            found = {model.images[i].name: model.images[i].projection_center() for i in model.reg_image_ids()}
            where = np.array([name in found for name in store.names])
            centres = np.array([found[name] for name in store.names if name in found])
            scale, turn, shift = align_similarity(truth[where], centres)
            away = np.linalg.norm(scale * centres @ turn.T + shift - truth[where], axis=1)
            middle, most_of, most = 1000 * np.quantile(away, [0.5, 0.95, 1])
            errors = f"median {middle:.1f}, 95 % {most_of:.1f}, most {most:.1f} thousandths of a unit"
            spent = f"{seconds:.0f} s ({cpu:.0f} CPU s)"
            print(f"{find.__name__}: {spent}, {where.sum()} posed, {errors}", flush=True)


if __name__ == "__main__":
    main()
