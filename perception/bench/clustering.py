"""HDBSCAN of features, sketch against full run: seconds, peak memory, agreement (`perception bench clustering`).

Each run is a process of its own, so that peaks are its own. Synthetic: noisy clusters in 8 dimensions, a tenth of the
rows outliers.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.children import child_options

RUN = """
import json, resource, sys, time
import numpy as np
from dataclasses import replace
from perception.config import InstanceConfig
from perception.bench.clustering import synthetic
from perception.instances.cluster import cluster_features
rows, most, out = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
features, _ = synthetic(rows)
config = InstanceConfig(max_clustered=most, min_cluster_size=max(32, rows // 1000), min_samples=10)
wall, cpu = time.perf_counter(), time.process_time()
labels, _ = cluster_features(features, config)
np.save(out, labels)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"seconds": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "peak_mib": peak}))
"""


def synthetic(rows: int, clusters: int = 100, width: int = 8, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """features [rows, width] float32 about `clusters` centres of uneven size, and truth (−1 = outlier, a tenth)."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(0, 1, (clusters, width))
    shares = rng.dirichlet(np.full(clusters, 2.0))
    truth = rng.choice(clusters, rows, p=shares)
    features = centres[truth] + rng.normal(0, 0.08, (rows, width)) * rng.uniform(0.5, 1.5, (clusters, 1))[truth]
    outlier = rng.random(rows) < 0.1
    features[outlier] = rng.uniform(-3, 3, (int(outlier.sum()), width))
    return features.astype(np.float32), np.where(outlier, -1, truth)


def measure(rows: int, most: int, folder: Path) -> tuple[dict[str, float], np.ndarray]:
    """One run in a process of its own: (seconds, CPU seconds, peak MiB), labels."""
    out = folder / f"{rows}_{most}.npy"
    command = [sys.executable, "-c", RUN, str(rows), str(most), str(out)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, **child_options())
    return json.loads(done.stdout), np.load(out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the table, or one JSON object with --json."""
    from sklearn.metrics import adjusted_rand_score

    from perception.config import InstanceConfig

    parser = argparse.ArgumentParser(prog="perception bench clustering", description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, nargs="+", default=[100_000, 300_000, 1_000_000])
    parser.add_argument("--sketch", type=int, default=InstanceConfig().max_clustered, help="rows clustered exactly")
    parser.add_argument("--no-full", action="store_true", help="the sketch alone, compared with the truth")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for rows in args.rows:
            truth = synthetic(rows)[1]
            row: dict[str, Any] = {"rows": rows}
            sketch, labels = measure(rows, args.sketch, Path(folder))
            row |= {"sketch": sketch, "truth_ari": float(adjusted_rand_score(truth, labels))}
            if not args.no_full:
                full, exact = measure(rows, rows, Path(folder))
                row |= {"full": full, "ari": float(adjusted_rand_score(exact, labels))}
            results.append(row)
    if args.json:
        print(json.dumps(results))
        return 0
    for row in results:
        for kind in ("sketch", "full"):
            if kind in row:
                r = row[kind]
                print(
                    f"{row['rows']:>9} {kind:<7}{r['seconds']:>7.1f} s {r['cpu']:>7.1f} CPU s {r['peak_mib']:>6.0f} MiB"
                )
        compared = f", {row['ari']:.4f} against the full run" if "ari" in row else ""
        print(f"{'':>9} ARI of the sketch: {row['truth_ari']:.4f} against the truth{compared}")
    return 0
