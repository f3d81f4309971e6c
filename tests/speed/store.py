"""One store of many synthetic maps: time to index, to open and to ask, memory, and recall against asking each map.

python tests/speed/store.py [--maps 1000] [--instances 60] [--prompts 200]

With lancedb or qdrant-client installed, their cosine search over the same embeddings is timed too, and how many of the
n instances that answer a prompt are among its n nearest.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

HOMES = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(HOMES), str(HOMES.parent)]
NOISE = 0.6
"""Length of the noise that is added to the unit embedding of an instance's name."""


class NoisyEncoder:
    """The offline encoder, whose texts get noise where they stand for pictures."""

    def __init__(self, encoder: Any, seed: int) -> None:
        self.encoder, self.rng = encoder, np.random.default_rng(seed)
        self.identity, self.dim, self.templates = encoder.identity, encoder.dim, encoder.templates
        self.known: dict[str, np.ndarray] = {}

    def encode_texts(self, texts: list[str]) -> np.ndarray:
        new = [text for text in dict.fromkeys(texts) if text not in self.known]
        self.known |= dict(zip(new, self.encoder.encode_texts(new), strict=True)) if new else {}
        rows = np.stack([self.known[text] for text in texts])
        noise = self.rng.normal(size=rows.shape)
        rows = rows + NOISE * noise / np.linalg.norm(noise, axis=1, keepdims=True)
        return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    return work(), time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--maps", type=int, default=1000)
    parser.add_argument("--instances", type=int, default=60)
    parser.add_argument("--prompts", type=int, default=200)
    parser.add_argument("--check", type=int, default=5, help="prompts that each map is asked too")
    options = parser.parse_args()
    from perception import load_map
    from perception.language.conse import class_names
    from perception.language.encoders import make_encoder
    from perception.query.store import index_maps
    from support.synthetic_map import write_synthetic_map

    encoder = make_encoder("conse")
    names = [group[0].lower() for group in class_names()]
    rng, noisy = np.random.default_rng(0), NoisyEncoder(encoder, 0)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        paths = [home / f"{n:04}.gsmap" for n in range(options.maps)]
        for n, path in enumerate(paths):
            things = rng.choice(names, options.instances, replace=False).tolist()
            write_synthetic_map(path, things, noisy, gaussians=20 * options.instances, sh_degree=0, seed=n)
        store = home / "all.store"
        facts, build = timed(lambda: index_maps(paths, store))
        _, again = timed(lambda: index_maps(paths, store))
        size = sum(file.stat().st_size for file in store.rglob("*") if file.is_file())
        opened, opening = timed(lambda: load_map(store, lambda spec: encoder))
        _, first = timed(opened.warm)
        prompts = rng.choice(names, options.prompts, replace=False).tolist()
        times = [timed(lambda prompt=prompt: opened.query(prompt, 10, 0.0))[1] for prompt in prompts]
        median, high = 1e3 * np.percentile(times, [50, 99])
        print(f"{facts['maps']} maps, {facts['instances']} instances, {size / 2**20:.0f} MiB")
        print(f"index {build:.1f} s, again {again:.1f} s, open {opening:.1f} s, first prompt {first:.1f} s")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"prompt: median {median:.0f} ms, p99 {high:.0f} ms; peak {peak:.0f} MiB")
        checked = prompts[: options.check]
        alone: list[list[tuple[float, str, int]]] = [[] for _ in checked]
        for path in paths:
            gmap = load_map(path, lambda spec: encoder)
            for prompt, found in zip(checked, alone, strict=True):
                hits = gmap.ranker.rank(prompt).hits[:10]
                found += [(-score, path.name, gmap.instances[n]["id"]) for n, score in hits]
        same = 0
        for prompt, found in zip(checked, alone, strict=True):
            least = (
                -sorted(found)[9][0] - 1e-6
            )  # of the ten best; many instances of 1,000 maps have nearly equal scores
            wanted = {(name, number) for score, name, number in found if -score >= least}
            same += len(wanted & {(hit.map.name, hit.instance_id) for hit in opened.query(prompt, 10, 0.0)})
        print(f"recall of the ten best answers against asking each map: {same / (10 * len(checked)):.3f}", flush=True)
        others(opened, encoder, prompts, home)


def others(store: Any, encoder: Any, prompts: list[str], home: Path) -> None:
    """Vector databases over the same embeddings."""
    rows = store.ranker._plain
    places = {(store.maps[m]["path"], store.instances[n]["id"]): n for n, m in enumerate(store._map_of)}
    asked = [encoder.encode_texts([encoder.templates[0].replace("{}", prompt)])[0] for prompt in prompts]
    ours = [{places[str(hit.map), hit.instance_id] for hit in store.query(prompt, 1000)} for prompt in prompts]
    for name, make in (("lancedb", _lance), ("qdrant_client", _qdrant)):
        if importlib.util.find_spec(name) is None:
            print(f"{name}: not installed")
            continue
        search, build = timed(partial(make, rows, home))
        shares, times = [], []
        for row, own in zip(asked, ours, strict=True):
            ids, seconds = timed(partial(search, row, max(len(own), 10)))
            times.append(seconds)
            shares += [len(own & set(ids[: len(own)])) / len(own)] if own else []
        median, high = 1e3 * np.percentile(times, [50, 99])
        share = f"{np.mean(shares):.3f} of the answers among as many nearest"
        print(f"{name}: build {build:.1f} s, median {median:.0f} ms, p99 {high:.0f} ms, {share}", flush=True)


def _lance(rows: np.ndarray, home: Path) -> Callable[[np.ndarray, int], list[int]]:
    import lancedb
    import pyarrow

    width = rows.shape[1]
    vectors = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(rows.reshape(-1)), width)
    table = pyarrow.table({"id": pyarrow.array(range(len(rows))), "vector": vectors})
    made = lancedb.connect(str(home / "lance")).create_table("instances", table)
    return lambda row, k: made.search(row).metric("cosine").limit(k).to_arrow()["id"].to_pylist()


def _qdrant(rows: np.ndarray, home: Path) -> Callable[[np.ndarray, int], list[int]]:
    from qdrant_client import QdrantClient, models

    client = QdrantClient(path=str(home / "qdrant"))
    params = models.VectorParams(size=rows.shape[1], distance=models.Distance.COSINE)
    client.create_collection("instances", vectors_config=params)
    client.upload_collection("instances", vectors=rows, ids=range(len(rows)))
    return lambda row, k: [point.id for point in client.query_points("instances", row, limit=k).points]


if __name__ == "__main__":
    main()
