"""Prompts for objects that are absent from a scene, and accuracy measures for ranked answers."""

from __future__ import annotations

import numpy as np

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


def accuracy(ranked: list[list[int]], right: list[set[int]]) -> tuple[float, float]:
    """Share of prompts with a correct instance at rank 1, and within ranks 1 to 3."""
    top1 = np.mean([bool(answers & set(order[:1])) for order, answers in zip(ranked, right, strict=True)])
    top3 = np.mean([bool(answers & set(order[:3])) for order, answers in zip(ranked, right, strict=True)])
    return round(float(top1), 3), round(float(top3), 3)


def chance(sizes: list[int], count: int) -> tuple[float, float]:
    """The same two values expected for a random order: 1 − C(count − m, k) / C(count, k)."""

    def hit(m: int, k: int) -> float:
        return 1.0 - float(np.prod([(count - m - j) / (count - j) for j in range(min(k, count))]).clip(0))

    return round(float(np.mean([hit(m, 1) for m in sizes])), 3), round(float(np.mean([hit(m, 3) for m in sizes])), 3)


def singular(word: str) -> str:
    """The word without its plural s."""
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word
