"""Measures one store of many maps: time, peak memory, and its answers against those of the maps.

    python tools speed.store                                       1,000 maps of 60 instances, about 15 minutes
    python tools speed.store --maps 50 --prompts 20
    pip install lancedb qdrant-edge-py && python tools speed.store --compare

The maps are made: an instance is a ball of points whose embedding is that of a random word of the offline encoder with
noise, of a random colour. A third of the prompts are such words, a third have a colour, a third are of other things.
With --compare LanceDB and Qdrant Edge hold the same vectors in two forms: the embeddings, compared by cosine; and with
what is relative to a map folded in, so that the dot product with the prompt is z. Recall is the share of this store's
answers (score 0.8 or more, beside the best of their map) that are among the first 100 of theirs.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

NOISE = 0.02  # standard deviation per dimension; words then match their instances with cosines as photos' do
TOP = 1000


class Kept:
    """An encoder that keeps the rows of texts that it has seen."""

    def __init__(self, encoder: Any) -> None:
        self.encoder, self.known = encoder, {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.encoder, name)

    def encode_texts(self, texts: list[str]) -> np.ndarray:
        if new := [text for text in dict.fromkeys(texts) if text not in self.known]:
            self.known.update(zip(new, self.encoder.encode_texts(new), strict=True))
        return np.array([self.known[text] for text in texts], np.float32).reshape(-1, self.encoder.dim)


class Noisy(Kept):
    """Rows as photos would give them: those of the texts with noise."""

    rng = np.random.default_rng(0)

    def encode_texts(self, texts: list[str]) -> np.ndarray:
        rows = super().encode_texts(texts)
        rows = rows + self.rng.normal(0, NOISE, rows.shape)
        return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def words() -> list[str]:
    from perception.query.naming import vocabulary

    return vocabulary()


def prompts(count: int) -> list[str]:
    """The questions: words, words with a colour, things that are no word of the maps."""
    from perception.language.colors import COLOR_NAMES
    from perception.query.ranking import probes

    rng = np.random.default_rng(1)
    kinds = [[str(w) for w in rng.permutation(group)[: count // 3 + 1]] for group in (words(), words(), probes())]
    kinds[1] = [f"{rng.choice(COLOR_NAMES)} {word}" for word in kinds[1]]
    return [prompt for group in zip(*kinds, strict=False) for prompt in group][:count]


def make_maps(folder: Path, maps: int, instances: int) -> dict[str, Any]:
    """Writes the maps, which is not what is measured."""
    from perception.language.colors import palette
    from perception.language.conse import ConseEncoder
    from support import synthetic_map

    encoder, rng, plain = Noisy(ConseEncoder()), np.random.default_rng(2), synthetic_map._language

    def coloured(names: Any, encoder: Any) -> dict[str, np.ndarray]:
        arrays = plain(names, encoder)
        colors = rng.integers(0, 256, (len(names), 1, 3), dtype=np.uint8)
        return {**arrays, "palettes": np.stack([palette(color) for color in colors])}

    synthetic_map._language = coloured
    known = words()
    for n in range(maps):
        names = [str(word) for word in rng.choice(known, instances)]
        many = {"gaussians": 40 * instances, "sh_degree": 0, "feature_dim": 2, "seed": n}
        synthetic_map.write_synthetic_map(folder / f"{n:05}.gsmap", names, encoder, **many)
    return {}


def build(folder: Path, store: Path) -> dict[str, Any]:
    from perception.query.indexing import index_maps

    maps = sorted(folder.glob("*.gsmap"))
    started = time.perf_counter()
    index_maps(store, maps)
    first = time.perf_counter() - started
    index_maps(store, maps)
    size = sum(file.stat().st_size for file in store.rglob("*") if file.is_file())
    return {"build_s": first, "again_s": time.perf_counter() - started - first, "mib": size / 2**20}


def ask(store: Path, texts: list[str]) -> dict[str, Any]:
    from perception import load_map
    from perception.machine import torch_on_one_thread

    started = time.perf_counter()
    opened = load_map(store)
    opening = time.perf_counter() - started
    opened.warm()
    ready = time.perf_counter() - started
    seconds, encoding, answers = [], [], []
    for text in texts:
        began = time.perf_counter()
        hits = opened.query(text, TOP)
        seconds.append(time.perf_counter() - began)
        began = time.perf_counter()
        with torch_on_one_thread():
            opened.ranker.encoder.embed([f"{text} thing"])  # the encoder may keep what it has seen
        encoding.append(time.perf_counter() - began)
        answers.append([(hit.map, hit.instance_id, hit.score) for hit in hits])
    return {
        "open_s": opening,
        "ready_s": ready,
        "median_ms": 1e3 * np.median(seconds),
        "p99_ms": 1e3 * np.percentile(seconds, 99),
        "encoding_ms": 1e3 * np.median(encoding),
        "answers": answers,
    }


def alone(folder: Path, texts: list[str]) -> dict[str, Any]:
    """The answers of every map asked alone, over all maps best first."""
    from perception import load_map
    from perception.language.conse import ConseEncoder

    encoder, answers = Kept(ConseEncoder()), [[] for _ in texts]
    for path in sorted(folder.glob("*.gsmap")):
        gmap = load_map(path, encoders=lambda _: encoder)
        for n, text in enumerate(texts):
            answers[n] += [(str(path.resolve()), hit.instance_id, hit.score) for hit in gmap.query(text, TOP)]
    return {"answers": [sorted(found, key=lambda hit: -hit[2])[:TOP] for found in answers]}


def vectors(store: Path, texts: list[str], folded: bool) -> tuple[np.ndarray, np.ndarray, list[tuple[str, int]]]:
    """(rows [I, D], rows of the prompts [T, D], (map, id) of the rows); folded: their dot products are z, scaled."""
    from perception import load_map
    from perception.language.colors import without_color_words

    opened = load_map(store)
    ranker = opened.ranker
    keys = [
        (entry["map"], int(i))
        for entry, own in zip(opened.maps, opened._maps.slices, strict=True)
        for i in opened._maps.records["id"][own]
    ]
    encoder = ranker.encoder
    asked = encoder.embed([without_color_words(text) for text in texts])
    if not folded:
        rows = np.concatenate([load_map(Path(entry["map"])).language["embeddings"] for entry in opened.maps])
        return rows, asked, keys
    middle, spread = ranker.prepared.null.T
    rows = np.concatenate([*ranker.prepared.compared, -middle[:, None]], axis=1) / spread[:, None]
    parts = []
    for (columns, part), usual in zip(encoder.parts, encoder._usual, strict=True):
        unit = asked[:, columns] / np.linalg.norm(asked[:, columns], axis=1, keepdims=True)
        parts.append(part.weight * unit * (usual / encoder._spreads(asked, columns, part))[:, None])
    return rows.astype(np.float32), np.concatenate([*parts, np.ones((len(texts), 1))], axis=1).astype(np.float32), keys


def compared(
    store: Path, folder: Path, texts: list[str], answers: list[Any], name: str, folded: bool
) -> dict[str, Any]:
    """Build time, times of top 10 and top 100, and recall of `answers` among the first 100."""
    rows, asked, keys = vectors(store, texts, folded)
    started = time.perf_counter()
    search = DATABASES[name](rows, folder, "dot" if folded else "cosine")
    result: dict[str, Any] = {"build_s": time.perf_counter() - started}
    for top in (10, 100):
        seconds, shares = [], []
        for row, wanted in zip(asked, answers, strict=True):
            began = time.perf_counter()
            found = {keys[n] for n in search(row, top)}
            seconds.append(time.perf_counter() - began)
            first = [(path, i) for path, i, _ in wanted[:top]]
            shares += [len(found & set(first)) / len(first)] if first else []
        result |= {f"top{top}_ms": 1e3 * float(np.median(seconds)), f"recall{top}": float(np.mean(shares))}
    return result


def lance(rows: np.ndarray, folder: Path, metric: str, index: bool) -> Callable[[np.ndarray, int], list[int]]:
    import lancedb
    import pyarrow as pa

    vector = pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1)), rows.shape[1])
    table = lancedb.connect(folder).create_table("rows", pa.table({"n": np.arange(len(rows)), "vector": vector}))
    if index:
        table.create_index(metric=metric, vector_column_name="vector", index_type="IVF_HNSW_SQ")

    def search(row: np.ndarray, top: int) -> list[int]:
        query = (
            table.search(row, vector_column_name="vector").distance_type(metric).select(["n", "_distance"]).limit(top)
        )
        return [int(n) for n in query.to_arrow()["n"].to_numpy()]

    return search


def qdrant(rows: np.ndarray, folder: Path, metric: str) -> Callable[[np.ndarray, int], list[int]]:
    import qdrant_edge as qdrant

    distance = qdrant.Distance.Dot if metric == "dot" else qdrant.Distance.Cosine
    config = qdrant.EdgeConfig(vectors={"row": qdrant.EdgeVectorParams(size=rows.shape[1], distance=distance)})
    shard = qdrant.EdgeShard.create(str(folder), config)
    for start in range(0, len(rows), 1000):
        block = range(start, min(start + 1000, len(rows)))
        points = [qdrant.Point(id=n, vector={"row": rows[n].tolist()}, payload={}) for n in block]
        shard.update(qdrant.UpdateOperation.upsert_points(points))
    while shard.optimize():
        pass

    def search(row: np.ndarray, top: int) -> list[int]:
        wanted = qdrant.SearchRequest(query=qdrant.Query.Nearest(row.tolist(), using="row"), limit=top)
        return [int(point.id) for point in shard.search(wanted)]

    return search


DATABASES: dict[str, Callable[..., Callable[[np.ndarray, int], list[int]]]] = {
    "LanceDB, no index": lambda *given: lance(*given, index=False),
    "LanceDB, IVF_HNSW_SQ": lambda *given: lance(*given, index=True),
    "Qdrant Edge, HNSW": qdrant,
}


def apart(work: Callable[..., dict[str, Any]], *given: Any) -> dict[str, Any]:
    """`work` in a process of its own, with the peak memory of that in MiB."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_measured, work, given).result()


def _measured(work: Callable[..., dict[str, Any]], given: tuple[Any, ...]) -> dict[str, Any]:
    return {**work(*given), "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def agreement(ours: list[Any], theirs: list[Any]) -> dict[str, Any]:
    """Share of the maps' answers that the store gives, of its own that the maps give; largest difference of scores."""
    pairs = [
        ({hit[:2]: hit[2] for hit in map(tuple, a)}, {hit[:2]: hit[2] for hit in map(tuple, b)})
        for a, b in zip(ours, theirs, strict=True)
    ]
    both, given, wanted = (
        sum(counts) for counts in zip(*((len(a.keys() & b.keys()), len(a), len(b)) for a, b in pairs), strict=True)
    )
    apart = max((abs(a[key] - b[key]) for a, b in pairs for key in a.keys() & b.keys()), default=0.0)
    return {
        "answers": wanted,
        "recall": both / max(wanted, 1),
        "precision": both / max(given, 1),
        "scores_apart": apart,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=int, default=1000, metavar="N")
    parser.add_argument("--instances", type=int, default=60, metavar="N", help="of each map")
    parser.add_argument("--prompts", type=int, default=120, metavar="N")
    parser.add_argument("--every", type=int, default=6, metavar="N", help="ask every N-th prompt of each map alone too")
    parser.add_argument("--compare", action="store_true", help="with LanceDB and Qdrant Edge, which must be installed")
    parser.add_argument("--folder", type=Path, help="where to work, with what lies there; else temporary")
    parser.add_argument("--json", type=Path, metavar="OUT.json")
    args = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp(prefix="store-"))
    maps, store, texts = folder / f"maps-{args.maps}-{args.instances}", folder / "all.store", prompts(args.prompts)
    try:
        if not maps.exists():
            apart(make_maps, folder / "making", args.maps, args.instances)
            (folder / "making").rename(maps)
        facts: dict[str, Any] = {}

        def done(key: str, values: dict[str, Any]) -> None:
            facts[key] = values
            print(f"{key}: " + ", ".join(f"{name} {value:.4g}" for name, value in values.items()), flush=True)

        if not store.exists() or args.folder is None:
            done("build", apart(build, maps, store))
        asked = apart(ask, store, texts)
        answers = asked.pop("answers")
        done("ask", asked)
        some = slice(None, None, args.every)
        done("agreement", agreement(answers[some], apart(alone, maps, texts[some])["answers"]))
        for folded in (False, True) if args.compare else ():
            for name in DATABASES:
                with tempfile.TemporaryDirectory(dir=folder) as place:
                    values = apart(compared, store, Path(place), texts, answers, name, folded)
                    done(f"{name}, {'folded' if folded else 'cosine'}", values)
        if args.json is not None:
            args.json.write_text(json.dumps(facts, indent=1) + "\n")
    finally:
        if args.folder is None:
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
