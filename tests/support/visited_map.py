"""A synthetic map of three visits with an exact record: what stood where at each, and what nobody looked at.

Things lie on a shelf (a flat plate of points) in cells of a grid, z up.

    visit    0        1                    2
    mug      cell 0   removed              removed
    banana   cell 1   moved to cell 6      stays
    lamp     cell 2   stays                moved to cell 7
    kettle   cell 3   not looked at        not looked at
    violin   –        added at cell 4      stays
    drum     –        –                    added at cell 5
    teapot   cell 8   removed              back, at cell 8
    shelf    –        stays                stays
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import instance_entry
from perception.language.description import InstanceDescription, to_arrays
from perception.map.map import Map
from perception.map.write import write_map
from support.query_maps import HashEncoder
from support.views_at import views_at

NAMES = ("mug", "banana", "lamp", "kettle", "violin", "drum", "teapot", "shelf")
"""The instance of NAMES[k] has the id 10 + k."""
TIMES = ("2026-11-23T09:00:00Z", "2026-11-24T09:00:00Z", "2026-11-25T19:41:58Z")
STOOD = (
    {"mug": 0, "banana": 1, "lamp": 2, "kettle": 3, "teapot": 8},
    {"banana": 6, "lamp": 2, "kettle": 3, "violin": 4},
    {"banana": 6, "lamp": 7, "kettle": 3, "violin": 4, "drum": 5, "teapot": 8},
)
"""The cell of each thing as of each visit."""
STATES = {
    "mug": "removed", "banana": "unchanged", "lamp": "moved", "kettle": "unseen", "violin": "unchanged",
    "drum": "added", "teapot": "added", "shelf": "unchanged",
}  # fmt: skip
SEEN = {"mug": 0, "kettle": 0}
"""The visit that saw a thing last, where that is not the newest."""
_BALL, _PLATE = 200, 800


def number(name: str) -> int:
    """The id of a thing."""
    return 10 + NAMES.index(name)


def cell(k: int) -> np.ndarray:
    """[3] centre of the things in a cell."""
    return np.array([k % 3, k // 3, 0.2])


def ball(name: str, k: int) -> np.ndarray:
    """[P, 3] float32 points of a thing in cell k; the same shape in every cell."""
    rng = np.random.default_rng(number(name))
    return (cell(k) + np.clip(rng.normal(0, 0.07, (_BALL, 3)), -0.2, 0.2)).astype(np.float32)


def write_visited_map(path: Path) -> Path:
    """Writes the map of the table above; its prompts are answered with `query_maps.encoders`."""
    past, points, entries = list[tuple[str, int, int]](), list[np.ndarray](), list[dict[str, Any]]()
    for name in NAMES:
        today = STOOD[2].get(name)
        if name == "shelf":
            rng = np.random.default_rng(1)
            own = (rng.uniform([-0.6, -0.6, -0.02], [2.6, 2.6, 0.0], (_PLATE, 3))).astype(np.float32)
        else:
            own = ball(name, STOOD[0][name] if today is None else today)
        entry = instance_entry(number(name), own.astype(np.float64), np.ones(len(own)), 0.9, 2, None)
        entry |= {"state": STATES[name], "confidence": 0.9, "first_seen": 0, "last_seen": SEEN.get(name, 2)}
        entry |= {"first_seen": 0 if name == "shelf" else min(v for v in range(3) if name in STOOD[v])}
        entry["last_looked_for"] = 0 if name == "kettle" else 2
        if STATES[name] == "removed":
            entry["num_gaussians"], own = 0, own[:0]
        left = [(v, STOOD[v].get(name)) for v in (0, 1) if STOOD[v].get(name) != STOOD[v + 1].get(name)]
        entry["past"] = [_spot(name, v, k) for v, k in left if v >= entry["first_seen"]]
        past += [(name, v, k) for v, k in left if k is not None and v >= entry["first_seen"]]
        entries.append(entry)
        points.append(own)
    means = np.concatenate(points)
    count = len(means)
    encoder, palette = HashEncoder(), np.zeros((24, 4), np.float32)
    palette[0] = [50, 0, 0, 1]
    rows = encoder.encode_texts(NAMES)
    seen = [InstanceDescription(row, row[None], palette, ["0.jpg"], [(0, 0, 8, 8)]) for row in rows]
    gmap = Map(
        means=means,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(0.02), np.float32),
        opacity_logits=np.full(count, 2.0, np.float32),
        sh=np.random.default_rng(2).normal(0, 0.1, (count, 4, 3)).astype(np.float32),
        features=np.zeros((count, 4), np.float32),
        instance_ids=np.repeat([e["id"] for e in entries], [len(own) for own in points]).astype(np.int32),
        membership=np.ones(count, np.float32),
        instances=entries,
        info={
            "frame": "map", "metric": True, "source": "kitchen", "seed": 0,
            "config": {"language": {"encoder": "hash"}, "photos": {"max_side": 800}}, "quality": {},
            "gravity": {"direction": [0.0, 0.0, -1.0], "standard_error_deg": 1.0, "source": "made"},
            "visits": [{"time": t, "input": f"visit{n}", "photos": 2} for n, t in enumerate(TIMES)],
        },
        views=views_at(np.eye(4)[None].repeat(2, 0).astype(np.float32)),
        language=to_arrays(seen, encoder.identity),
        past={
            "means": np.concatenate([ball(name, k) for name, _, k in past]),
            "ids": np.repeat([number(name) for name, _, _ in past], _BALL).astype(np.int32),
            "until": np.repeat([until for _, until, _ in past], _BALL).astype(np.int32),
        },
    )  # fmt: skip
    write_map(path, gmap)
    return path


def _spot(name: str, until: int, k: int | None) -> dict[str, Any]:
    """The entry of `past` of a thing that was in cell k, or away, until a visit."""
    if k is None:
        where = instance_entry(0, ball(name, 8).astype(np.float64), np.ones(_BALL), 1.0, 0, None)
        return {key: where[key] for key in ("centroid", "obb", "aabb")} | {"until": until, "transform": None, "gone": True}
    where = instance_entry(0, ball(name, k).astype(np.float64), np.ones(_BALL), 1.0, 0, None)
    motion = np.eye(4)
    following = STOOD[until + 1].get(name)
    if following is not None:
        motion[:3, 3] = cell(following) - cell(k)
    transform = None if following is None else motion.tolist()
    return {key: where[key] for key in ("centroid", "obb", "aabb")} | {"until": until, "transform": transform}
