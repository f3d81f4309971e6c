"""Measures how the pairs of many photos are found: seconds, peak memory, and the share of the true pairs.

    python tools speed.pairing --photos 1000 10000

The photos are made: a walk in which each photo sees 220 landmarks and the next one moves on by 20. Of these a fifth is
not found, and a fifth as many features are clutter. True pairs share .3 of their landmarks or more.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

import numpy as np

SEEN, STEP = 220, 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, nargs="+", default=[1000, 10_000])
    counts = parser.parse_args().photos
    if len(counts) > 1:  # each in a process of its own, for its peak
        for count in counts:
            subprocess.run([sys.executable, "tools", "speed.pairing", "--photos", str(count)], check=True)
        return
    from perception.machine import peak_memory_mib
    from perception.progress import Progress
    from perception.sfm.pairs import coarse_votes, similar_photos

    descriptors = walk(counts[0])
    at = [time.perf_counter()]
    similar = similar_photos(descriptors)
    at.append(time.perf_counter())
    votes = coarse_votes(descriptors, similar, Progress(quiet=True))
    at.append(time.perf_counter())
    apart = int(0.7 * SEEN / STEP)
    true = {(i, j) for i in range(counts[0]) for j in range(i + 1, min(i + apart, counts[0] - 1) + 1)}
    rows, columns = votes.nonzero()
    found = len(true & set(zip(rows.tolist(), columns.tolist(), strict=True))) / len(true)
    seconds, pairs = np.diff(at), sum(map(len, similar)) // 2
    print(
        f"{counts[0]} photos: similar ones {seconds[0]:.1f} s, matches of {pairs} pairs {seconds[1]:.1f} s, "
        f"peak {peak_memory_mib():.0f} MiB, {found:.3f} of the true pairs",
        flush=True,
    )


def walk(photos: int) -> list[np.ndarray]:
    """Features [F, 128] uint8 of each photo; landmarks are made as they come into sight."""
    rng = np.random.default_rng(0)

    def unit(rows: np.ndarray) -> np.ndarray:
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)

    looks, result = rng.exponential(1.0, (SEEN, 128)).astype(np.float32), []
    for _ in range(photos):
        chosen = looks[rng.random(SEEN) < 0.8]
        rows = np.concatenate([chosen + rng.normal(0, 0.25, chosen.shape), rng.exponential(1.0, (SEEN // 5, 128))])
        result.append(np.rint(512 * unit(rows)).clip(0, 255).astype(np.uint8))
        looks = np.concatenate([looks[STEP:], rng.exponential(1.0, (STEP, 128)).astype(np.float32)])
    return result


if __name__ == "__main__":
    main()
