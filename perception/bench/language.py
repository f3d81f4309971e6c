"""How well prompts find their instances on a scene with exact truth, silhouettes perfect: `main([SCENE,
...])`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from perception.bench.prompts import ABSENT, accuracy, chance
from perception.bench.truth import TruthScene, read_truth, truth_directions, truth_view_scores
from perception.instances.crops import choose_views
from perception.instances.describe import describe_instances
from perception.language.base import Encoder, make_encoder, reading_of
from perception.language.description import InstanceDescription
from perception.language.ranking import PRESENT, Ranker


def main(argv: Sequence[str] | None = None) -> int:
    """Command line: top-1, top-3, random and colour-blind baselines, false positives, latency; JSON with
    --json.
    """
    parser = argparse.ArgumentParser(prog="perception bench language", description=__doc__)
    parser.add_argument("scenes", nargs="+", help="folders with scene.json, transforms.json, masks_gt, gt_points.ply")
    parser.add_argument("--encoder", default="conse")
    parser.add_argument("--background", default="plain", choices=["plain", "dim", "blur", "fill"])
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--diversity", type=float, default=0.0, help="0 to 1: views shall look from different sides")
    parser.add_argument("--levels", type=int, default=0, help="crops a view; 0: as suits the encoder")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(argv)
    reports = [measure_scene(folder, options) for folder in options.scenes]
    if options.json:
        print(json.dumps({"scenes": reports}))
    else:
        for report in reports:
            print("\n".join(f"{key:>24}: {value}" for key, value in report.items()), end="\n\n")
    return 0


def measure_scene(folder: str, options: argparse.Namespace) -> dict[str, Any]:
    """Describe the scene's instances and ask it everything; figures by name."""
    start = time.perf_counter()
    encoder = make_encoder(options.encoder)
    if encoder is None:
        raise SystemExit("perception bench language: an encoder is needed, found 'none'")
    scene = read_truth(folder)
    choices = choose_views(truth_view_scores(scene), options.views, truth_directions(scene), options.diversity)
    names = [frame["file_path"] for frame in scene.frames]
    before = time.perf_counter()
    descriptions = describe_instances(
        encoder,
        choices,
        scene.load,
        names,
        levels=options.levels or reading_of(encoder).zooms,
        background=options.background,
    )
    seconds = time.perf_counter() - before
    report = {"scene": scene.about["name"], "encoder": encoder.identity, "instances": len(descriptions)}
    report |= {"describe_seconds": round(seconds, 1)}
    report |= score_queries(scene, descriptions, encoder)
    report |= latency(descriptions, options.encoder)
    return report | {"seconds": round(time.perf_counter() - start, 1)}


def score_queries(scene: TruthScene, descriptions: list[InstanceDescription], encoder: Encoder) -> dict[str, Any]:
    """Accuracy over the scene's prompts and false positives over ABSENT at the default threshold."""
    queries = scene.queries()
    ranker = Ranker(descriptions, encoder)
    answers = [ranker.rank(text) for text, _ in queries]
    top1, top3 = accuracy([[i for i, _ in a.hits] for a in answers], [q for _, q in queries])
    blind = [
        InstanceDescription(d.embedding, d.per_view, np.zeros_like(d.palette), d.views, d.boxes) for d in descriptions
    ]
    grey = Ranker(blind, encoder)
    blind1, blind3 = accuracy([[i for i, _ in grey.rank(t).hits] for t, _ in queries], [q for _, q in queries])
    said = [
        a.present and any(i in right for i, s in a.hits[:3] if s >= PRESENT)
        for a, (_, right) in zip(answers, queries, strict=True)
    ]
    wrong = [text for text in ABSENT if ranker.rank(text).present]
    chance1, chance3 = chance([len(q) for _, q in queries], len(descriptions))
    return {
        "prompts": len(queries),
        "top1": top1,
        "top3": top3,
        "top3_and_present": round(float(np.mean(said)), 3),
        "color_blind_top1": blind1,
        "color_blind_top3": blind3,
        "random_top1": chance1,
        "random_top3": chance3,
        "absent_prompts": len(ABSENT),
        "false_positives": round(len(wrong) / len(ABSENT), 3),
        "false_positive_prompts": wrong,
        "failed_prompts": [
            text
            for a, (text, right) in zip(answers, queries, strict=True)
            if not any(i in right for i, _ in a.hits[:3])
        ],
    }


def latency(descriptions: list[InstanceDescription], spec: str, instances: int = 200) -> dict[str, float]:
    """Milliseconds a query on `instances` instances (repeats of those given): cold encoder and ranker, then
    warm.
    """
    many = [descriptions[n % len(descriptions)] for n in range(instances)]
    start = time.perf_counter()
    encoder = make_encoder(spec)
    if encoder is None:
        return {}
    ranker = Ranker(many, encoder)
    ranker.rank("red mug")
    cold = time.perf_counter() - start
    warm = []
    for n in range(100):
        start = time.perf_counter()
        ranker.rank(f"the blue thing number {n}")
        warm.append(time.perf_counter() - start)
    median, p99 = np.quantile(warm, [0.5, 0.99]) * 1e3
    return {
        "query_cold_ms": round(cold * 1e3, 1),
        "query_warm_median_ms": round(float(median), 2),
        "query_warm_p99_ms": round(float(p99), 2),
    }


if __name__ == "__main__":
    raise SystemExit(main())
