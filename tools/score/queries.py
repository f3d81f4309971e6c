"""Scores the answers of maps to text prompts, on scenes with exact truth.

python tools score.queries MAP SCENE …

A hit is right when the true object under most of the instance's exported points answers the prompt. Prompts
are those of scene.json whose objects some photo shows. Absent prompts: 30 things of street, farm, sea and
museum, and household things that the scene does not name, which are the harder half. Reliability: over all prompts of
all scenes, present and absent, the score of the best hit, and whether the prompt is one of the scene.
Prompts with a word in capitals are about printed words; those in `absent` of scene.json, about words that are on
nothing. They are also scored apart, with the texts read on the instances and without.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import bench_parser
from perception.errors import InputError
from perception.language.shape_words import singular
from perception.query import QueryMap, load_map
from perception.query.ranking import Ranker, Ranking, answering
from perception.query.text_ranking import TextRanking
from score.instances import read_scene, read_truth_cloud
from score.reliability import SCORED, finish_reliability, parse_pairs

PRINTED = re.compile(r"\b[A-Z]{2,}\b")
PRINTED_FIGURES = "top1", "top3", "returned_precision", "returned_recall", "false_positive_prompts", "failed_prompts"
# No word of these two lists may stand in language/probes.txt, which sets the threshold (there is a test).
ABSENT = (
    "elephant", "car", "airplane", "bicycle", "motorcycle", "train", "horse", "giraffe", "sailing boat",
    "traffic light", "church", "bridge", "palm tree", "shark", "penguin", "tractor", "helicopter", "snowman",
    "waterfall", "castle", "whale", "lighthouse", "tank", "skateboard", "surfboard", "umbrella", "camel", "violin",
    "wheelchair", "parachute",
)  # fmt: skip
HOUSEHOLD = (
    "laptop", "television", "sofa", "bed", "chair", "desk lamp", "guitar", "backpack", "vase", "basketball",
    "teddy bear", "scissors", "bowl", "mug", "kettle", "toothbrush", "hair dryer", "washing machine", "refrigerator",
    "bathtub", "toilet", "clothes iron", "broom", "bucket", "wardrobe", "piano", "telephone", "wrist watch",
    "tennis ball", "saucepan",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints one figure per line; JSON goes to the output folder."""
    options, pairs = parse_pairs(bench_parser("queries", __doc__), "MAP SCENE", arguments)
    reports, lines = [measure(gmap, scene) for gmap, scene in pairs], []
    for report in reports:
        shown = {key: ", ".join(map(str, value)) if isinstance(value, list) else value for key, value in report.items()}
        lines += [f"{key:>26}: {value}" for key, value in shown.items() if key != SCORED]
    finish_reliability("queries", options, reports, lines, "presence")


def measure(map_path: Path, scene: Path) -> dict[str, Any]:
    """All figures by name."""
    queries, unseen = read_queries(scene)
    opened = load_map(map_path)
    if not opened.instances:
        raise InputError(f"{map_path}: holds no instances; map again with masks")
    owners = true_objects(opened, scene)
    report: dict[str, Any] = {"map": str(map_path), "scene": scene.name, "instances": len(opened.instances)}
    report |= {"encoder": str(opened.language["encoder"]), "prompts": len(queries), "unseen_prompts": unseen}
    words = read_words(scene)
    near = [t for t in HOUSEHOLD if not {singular(w) for w in t.split()} & words]
    report |= _figures(TextRanking(opened, opened.encoders).rank, owners, queries, near)
    printed = [query for query in queries if PRINTED.search(query[0])]
    nowhere = [text for text in read_scene(scene).get("absent", []) if PRINTED.search(text)]
    report |= {"printed_prompts": len(printed), "printed_absent_prompts": len(nowhere)} if printed else {}
    unread = QueryMap.of(opened, info={**opened.info, "instances": {}})  # as mapped without reading texts
    for name, gmap in (("printed", opened), ("printed_without_texts", unread)) if printed else ():
        found = _figures(TextRanking(gmap, opened.encoders).rank, owners, printed, nowhere)
        report |= {f"{name}_{key}": found[key] for key in PRINTED_FIGURES}
    return report | latency(opened.ranker, [text for text, _ in queries])


def read_queries(scene: Path) -> tuple[list[tuple[str, set[int]]], int]:
    """Prompts of scene.json with the true ids that answer them, and the number of prompts left out as never visible."""
    about = read_scene(scene)
    visible = {entry["id"] for entry in about["instances"] if entry.get("gt_points", 1)}
    queries = [(query["text"], set(query["instance_ids"]) & visible) for query in about["queries"]]
    kept = [(text, ids) for text, ids in queries if ids]
    return kept, len(queries) - len(kept)


def read_words(scene: Path) -> set[str]:
    """Every word that scene.json uses for its objects. None of them may count as absent."""
    texts = [query["text"] for query in read_scene(scene)["queries"]]
    return {singular(word) for text in texts for word in re.findall(r"[a-z]+", text.lower())}


def true_objects(opened: QueryMap, scene: Path) -> list[int]:
    """The true id that most exported points of each instance carry; −1 where no point has one."""
    from perception.export.export_map import export_labels

    cloud = read_truth_cloud(scene, opened)
    labels = export_labels(opened.means, opened.instance_ids, cloud)
    truth = cloud.labels["instance_id"]
    owners = []
    for entry in opened.instances:
        under = truth[(labels == entry["id"]) & (truth > 0)]
        owners.append(int(np.bincount(under).argmax()) if len(under) else -1)
    return owners


def _figures(
    rank: Callable[[str], Ranking], owners: list[int], queries: list[tuple[str, set[int]]], near: list[str]
) -> dict[str, Any]:
    right = [{n for n, owner in enumerate(owners) if owner in ids} for _, ids in queries]
    answers = [rank(text) for text, _ in queries]
    found = [bool({i for i, _ in a[:3]} & ids) for a, ids in zip(answers, right, strict=True)]
    top1, top3 = accuracy([[i for i, _ in a] for a in answers], right)
    absent = {text: rank(text) for text in (*ABSENT, *near)}
    wrong, wrong_near = ([text for text in texts if answering(absent[text])] for texts in (ABSENT, near))
    return {
        "top1": top1,
        "top3": top3,
        "answered_present": round(float(np.mean([bool(answering(a)) for a in answers])), 3),
        **returned([[owners[i] for i, _ in answering(a)] for a in answers], [ids for _, ids in queries]),
        "absent_prompts": len(ABSENT),
        "false_positives": round(len(wrong) / len(ABSENT), 3),
        "household_absent_prompts": len(near),
        "household_false_positives": round(len(wrong_near) / max(len(near), 1), 3),
        "false_positive_prompts": wrong + wrong_near,
        "failed_prompts": [text for (text, _), f in zip(queries, found, strict=True) if not f],
        "unmapped_prompts": [text for (text, _), ids in zip(queries, right, strict=True) if not ids],
        SCORED: [
            (a[0][1], n < len(answers)) for n, a in enumerate([*answers, *(absent[text] for text in (*ABSENT, *near))])
        ],
    }


def returned(found: list[list[int]], true: list[set[int]]) -> dict[str, float]:
    """Precision and recall of all returned hits, and the prompts' mean F1 = 2 · objects found / (hits + objects).

    found: the true object under each returned hit; true: the objects that answer the prompt, each counted once.
    """
    pairs = list(zip(found, true, strict=True))
    objects = [len(set(hits) & ids) for hits, ids in pairs]
    right = sum(hit in ids for hits, ids in pairs for hit in hits)
    f1 = [2 * n / (len(hits) + len(ids)) for n, (hits, ids) in zip(objects, pairs, strict=True)]
    return {
        "returned_hits": sum(map(len, found)),
        "returned_precision": round(right / max(sum(map(len, found)), 1), 3),
        "returned_recall": round(sum(objects) / max(sum(map(len, true)), 1), 3),
        "returned_f1": round(float(np.mean(f1)), 3),
    }


def latency(ranker: Ranker, texts: Sequence[str]) -> dict[str, float]:
    """Median and 99th percentile latency in ms of prompts that are not cached, over at least 100 of them."""
    seconds = []
    for n in range(max(100, len(texts))):
        text = f"{texts[n % len(texts)]} {n}"  # the added number makes the prompt new to every cache
        start = time.perf_counter()
        ranker.rank(text)
        seconds.append(time.perf_counter() - start)
    median, p99 = np.quantile(seconds, [0.5, 0.99]) * 1e3
    return {"warm_median_ms": round(float(median), 2), "warm_p99_ms": round(float(p99), 2)}


def accuracy(ranked: list[list[int]], right: list[set[int]]) -> tuple[float, float]:
    """Share of prompts with a correct instance at rank 1, and within ranks 1 to 3."""
    pairs = list(zip(ranked, right, strict=True))
    top1, top3 = (float(np.mean([bool(answers & set(order[:k])) for order, answers in pairs])) for k in (1, 3))
    return round(top1, 3), round(top3, 3)


if __name__ == "__main__":
    main()
